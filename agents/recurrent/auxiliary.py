"""Auxiliary objectives: what else a hidden state should tell besides action values.

    loss = Bellman residual + sum_j lambda_j mean_t |f_j(h_t) - target_j,t|^2

h_t has seen x_t, a_{t-1} and all before. With a decoder f is linear; on the hidden state itself f picks the first
entries of h_t, which then *are* the prediction (h_{t+1} = phi_{t+1} in Fig. 4.5; h_t in R^k for rewards). Entries of
an LSTM or a GRU lie in (-1, 1): targets are standardised by running moments and, on the hidden state, divided by 3.

References: thesis proposal, Sec. 4.3.2, Eq. 4.19 (dynamics), H6 (predictive state), H7 (predictive rewards, future
values); Venkatraman et al. 2017 (predictive-state decoders); Ni et al. 2024 (latent self-prediction).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

SPREAD = 3.0  # standard deviations that fit into (-1, 1) on the hidden state


@dataclass(frozen=True)
class Pieces:
    """What an objective is given: pieces of episodes, see `Segments`.

    Args:
        hidden: (n_pieces, n_steps + 1, hidden_size) h of every slot. target_hidden: the same of the averaged network,
            without gradient.
        observation: (n_pieces, n_steps + 1, n_observation), standardised. actions: (n_pieces, n_steps, n_action).
        rewards: (n_pieces, n_steps). returns: gives (n_pieces, n_steps) discounted returns, bootstrapped at the
            end of each piece.
        mask: (n_pieces, n_steps) bool, the steps that exist.
    """

    hidden: Tensor
    target_hidden: Tensor
    observation: Tensor
    actions: Tensor
    rewards: Tensor
    returns: Callable[[], Tensor]
    mask: Tensor


class AuxiliaryObjective(nn.Module, ABC):
    """Base class: a subclass tells `target_size` numbers for every step, and which of them exist.

    Args:
        hidden_size: size of h. target_size: numbers that are predicted at each step.
        on_hidden: the first entries of h are the prediction, in place of a linear decoder's.

    Raises:
        ValueError: a hidden state that is too small to hold the prediction.
    """

    name: str
    mean: Tensor
    std: Tensor
    count: Tensor

    def __init__(self, hidden_size: int, target_size: int, on_hidden: bool = False) -> None:
        super().__init__()
        if on_hidden and hidden_size < target_size:
            raise ValueError(
                f"expected a hidden state of at least {target_size} to hold the prediction of {self.name!r} itself, "
                f"got {hidden_size}; take a larger hidden_size, a smaller k, or a decoder (on_hidden=False)"
            )
        self.on_hidden, self.target_size = on_hidden, target_size
        self.decoder = None if on_hidden else nn.Linear(hidden_size, target_size)
        for name in ("mean", "std"):
            self.register_buffer(name, torch.full((target_size,), float(name == "std")))
        self.register_buffer("count", torch.zeros(target_size))

    @abstractmethod
    def targets(self, pieces: Pieces) -> tuple[Tensor, Tensor]:
        """(n_pieces, n_steps, target_size) numbers, and where they exist (broadcastable to that, bool)."""

    def forward(self, pieces: Pieces) -> Tensor:
        """The mean squared error over all predictions that exist, in units of the targets' variance."""
        targets, exists = self.targets(pieces)
        exists = exists.expand(targets.shape)
        if self.training:
            self._learn_moments(targets, exists)
        targets = (targets - self.mean) / self.std
        hidden = pieces.hidden[:, : targets.shape[1]]
        predicted = SPREAD * hidden[..., : self.target_size] if self.decoder is None else self.decoder(hidden)
        weights = exists.to(targets.dtype)
        return ((predicted - targets).square() * weights).sum() / weights.sum().clamp(min=1.0)

    @torch.no_grad()
    def _learn_moments(self, targets: Tensor, exists: Tensor) -> None:
        """Running mean and deviation of each target, every batch weighing as much until the hundredth, then 1 %."""
        weights = exists.to(targets.dtype)
        total = weights.sum((0, 1)).clamp(min=1.0)
        mean = (targets * weights).sum((0, 1)) / total
        variance = ((targets - mean).square() * weights).sum((0, 1)) / total
        there = weights.sum((0, 1)) > 0.0  # of a target that is far ahead a batch may hold none
        self.count += there
        share = torch.where(there, (1.0 / self.count.clamp(min=1.0)).clamp(min=0.01), 0.0)
        old = self.mean.clone()
        self.mean.add_(share * (mean - old))
        spread = (1 - share) * (self.std.square() + (old - self.mean).square())
        spread += share * (variance + (mean - self.mean).square())
        self.std.copy_(spread.sqrt().clamp(min=1e-3))


def futures(x: Tensor, k: int, mask: Tensor) -> tuple[Tensor, Tensor]:
    """The next k of a sequence at each of its steps.

    Args:
        x: (n, n_steps, d). k: how many. mask: (n, n_steps) bool, where x exists.

    Returns:
        (n, n_steps, k d): x_t, ..., x_{t+k-1}, and where each of them exists.
    """
    n, n_steps, d = x.shape
    padded = torch.cat([x, x.new_zeros(n, k - 1, d)], dim=1)
    there = torch.cat([mask, mask.new_zeros(n, k - 1)], dim=1)
    windows = padded.unfold(1, k, 1).transpose(2, 3).reshape(n, n_steps, k * d)
    return windows, there.unfold(1, k, 1)[..., None].expand(n, n_steps, k, d).reshape(n, n_steps, k * d)


class PredictiveState(AuxiliaryObjective):
    """The next k observations (H6, Fig. 4.5): |f(h_t) - [x_{t+1}, ..., x_{t+k}]|^2; k = 1 is Eq. 4.19 on observations.

    Args:
        hidden_size, n_observation: sizes. k: observations ahead. on_hidden: see `AuxiliaryObjective`.
    """

    name = "predictive_state"

    def __init__(self, hidden_size: int, n_observation: int, k: int = 5, on_hidden: bool = False) -> None:
        super().__init__(hidden_size, k * n_observation, on_hidden)
        self.k = k

    def targets(self, pieces: Pieces) -> tuple[Tensor, Tensor]:
        """See `AuxiliaryObjective.targets`."""
        return futures(pieces.observation[:, 1:], self.k, pieces.mask)


class PredictiveRewards(AuxiliaryObjective):
    """The next k rewards (H7): sum_i |h_t[i] - r_{t+i}|^2, i = 0, ..., k - 1 (the index of r is put right).

    Args:
        hidden_size: size of h. k: rewards ahead. on_hidden: see `AuxiliaryObjective`.
    """

    name = "predictive_rewards"

    def __init__(self, hidden_size: int, k: int = 5, on_hidden: bool = False) -> None:
        super().__init__(hidden_size, k, on_hidden)
        self.k = k

    def targets(self, pieces: Pieces) -> tuple[Tensor, Tensor]:
        """See `AuxiliaryObjective.targets`."""
        return futures(pieces.rewards[..., None], self.k, pieces.mask)


class PredictiveValues(AuxiliaryObjective):
    """The values of the next k steps, from the discounted rewards that followed (end of Sec. 4.3.2).

    Args:
        hidden_size: size of h. k: values ahead. on_hidden: see `AuxiliaryObjective`.
    """

    name = "predictive_values"

    def __init__(self, hidden_size: int, k: int = 5, on_hidden: bool = False) -> None:
        super().__init__(hidden_size, k, on_hidden)
        self.k = k

    def targets(self, pieces: Pieces) -> tuple[Tensor, Tensor]:
        """See `AuxiliaryObjective.targets`."""
        return futures(pieces.returns()[..., None], self.k, pieces.mask)


class Dynamics(AuxiliaryObjective):
    """The next observation under the action taken (Eq. 4.19): |f(h_t, a_t) - x_{t+1}|^2.

    Eq. 4.19 writes f(h_t) and s_{t+1}: the action that leads there is put beside h_t, and the observation in the
    state's place.

    Args:
        hidden_size, n_observation, n_action: sizes.
    """

    name = "dynamics"

    def __init__(self, hidden_size: int, n_observation: int, n_action: int) -> None:
        super().__init__(hidden_size, n_observation)
        self.transition = nn.Sequential(nn.Linear(hidden_size + n_action, hidden_size), nn.ReLU())

    def targets(self, pieces: Pieces) -> tuple[Tensor, Tensor]:
        """See `AuxiliaryObjective.targets`."""
        return pieces.observation[:, 1:], pieces.mask[..., None]

    def forward(self, pieces: Pieces) -> Tensor:
        """See `AuxiliaryObjective.forward`."""
        following = self.transition(torch.cat([pieces.hidden[:, :-1], pieces.actions], dim=-1))
        return super().forward(Pieces(**{**pieces.__dict__, "hidden": following}))


class LatentSelfPrediction(nn.Module):
    """The next hidden state itself (the modern rival): |g(h_t, a_t) - h'_{t+1}|^2, h' of the averaged network, fixed.

    Args:
        hidden_size, n_action: sizes.

    Reference: Ni et al. 2024, with the squared error and a target by exponential averaging.
    """

    name = "latent_self_prediction"

    def __init__(self, hidden_size: int, n_action: int) -> None:
        super().__init__()
        self.transition = nn.Sequential(
            nn.Linear(hidden_size + n_action, hidden_size), nn.ReLU(), nn.Linear(hidden_size, hidden_size)
        )

    def forward(self, pieces: Pieces) -> Tensor:
        """See `AuxiliaryObjective.forward`."""
        predicted = self.transition(torch.cat([pieces.hidden[:, :-1], pieces.actions], dim=-1))
        errors = (predicted - pieces.target_hidden[:, 1:].detach()).square().mean(-1)
        weights = pieces.mask.to(errors.dtype)
        return (errors * weights).sum() / weights.sum().clamp(min=1.0)


OBJECTIVES: dict[str, Callable[..., nn.Module]] = {
    kind.name: kind
    for kind in (Dynamics, PredictiveState, PredictiveRewards, PredictiveValues, LatentSelfPrediction)
}


def make_auxiliary(
    name: str, hidden_size: int, n_observation: int, n_action: int, **options: object
) -> nn.Module:
    """An objective by its name.

    Raises:
        ValueError: an unknown name.
    """
    sizes: dict[str, dict[str, int]] = {
        "dynamics": {"n_observation": n_observation, "n_action": n_action},
        "predictive_state": {"n_observation": n_observation},
        "predictive_rewards": {},
        "predictive_values": {},
        "latent_self_prediction": {"n_action": n_action},
    }
    if name not in sizes:
        raise ValueError(f"expected an auxiliary objective out of {', '.join(sizes)}, got {name!r}")
    module: nn.Module = OBJECTIVES[name](hidden_size=hidden_size, **sizes[name], **options)
    return module
