"""The losses of recurrent soft actor-critic as a loss module of TorchRL's, to be used alone or by `RecurrentSAC`.

    V_t      = min_i Q'_i(h'_t, a) - alpha log pi(a | h^pi_t),  a ~ pi
    y_t      = r_t + gamma (1 - terminated_t) [V_{t+1} + w_{t+1} (y_{t+1} - min_i Q'_i(h'_{t+1}, a_{t+1}))]
    w_t      = lambda min(1, pi(a_t | h^pi_t) / mu_t), mu_t the density with which a_t was drawn
    J_critic = mean_t 1/2 sum_i |Q_i(h_t, a_t) - y_t|^2 + sum_j lambda_j (auxiliary objective j on h)
    J_actor  = mean_t [alpha log pi(a | h^pi_t) - min_i Q_i(h_t, a)],  a ~ pi through its noise; Q, h and alpha fixed
    J_alpha  = -mean_t log alpha [log pi(a | h^pi_t) + target entropy]

All hidden states are rolled along the recorded episode, one slot past its last step: a truncation's last observation
has a value, a termination has none. All four are taken at the same parameters and minimised in one step, as TorchRL's
SACLoss does. lambda = 0 is plain soft actor-critic; with traces (Retrace) rewards reach many steps back at once, and
sequences are there anyway.

Reference: Haarnoja et al. 2018b, Eqs. 5-7 and 18; for histories Ni et al. 2022; for the traces Munos et al. 2016.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor, nn

from beliefgym.agents.recurrent.auxiliary import Pieces
from beliefgym.agents.recurrent.bound_loss import BoundLoss
from beliefgym.agents.recurrent.sac_networks import (
    RecurrentActor,
    RecurrentCritic,
    log_density,
    squashed_gaussian,
)
from beliefgym.agents.recurrent.segments import Segments, batch_segments
from beliefgym.agents.recurrent.targets import lambda_returns


class RecurrentSACLoss(BoundLoss):
    """Losses of actor, critic and temperature along recorded sequences.

    The input is a tensordict (n, n_steps) in TorchRL's layout with the keys of `RolloutCollector`, actions in (-1, 1):
    rows may hold several episodes (`is_init`), or be padded ("mask"). Rows that begin inside an episode begin with a
    state of zeros, hence `burn_in`. Target parameters are moved by TorchRL's `SoftUpdate`.

    Args:
        actor_network, critic_network: their modules.
        gamma: discount.
        trace_decay: lambda. importance: False leaves out the factor min(1, pi / mu).
        target_entropy: of the actions in (-1, 1)^n, in nats.
        initial_temperature: alpha at the start, in units of scaled rewards.
        burn_in: steps at the front of a piece that begins inside an episode that bring up its state, without loss.
        auxiliary: objectives on the critic's hidden state, by name. auxiliary_weights: their lambdas; a plain
            attribute, to be annealed.
        generator: of the policy's noise; None for PyTorch's own.

    Output:
        "loss_critic", "loss_actor", "loss_alpha", "loss_<auxiliary>" (times their weights), and without gradient
        "td_error" (root mean square), "mean_value", "largest_value" (of |Q|), "entropy", "alpha".

    Raises:
        ValueError: settings out of range.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the tensordict, to be changed by `set_keys`."""

        observation: NestedKey = "observation"
        previous_action: NestedKey = "previous_action"
        previous_reward: NestedKey = "previous_reward"
        action: NestedKey = "action"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        action_probability: NestedKey = "action_probability"
        is_init: NestedKey = "is_init"
        mask: NestedKey = "mask"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    actor_network: RecurrentActor
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    critic_network: RecurrentCritic
    critic_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: RecurrentActor,
        critic_network: RecurrentCritic,
        *,
        gamma: float = 0.99,
        trace_decay: float = 0.0,
        importance: bool = True,
        target_entropy: float,
        initial_temperature: float = 0.1,
        burn_in: int = 0,
        auxiliary: Mapping[str, nn.Module] | None = None,
        auxiliary_weights: Mapping[str, float] | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if (
            not (0.0 <= gamma <= 1.0 and 0.0 <= trace_decay <= 1.0)
            or initial_temperature <= 0.0
            or burn_in < 0
        ):
            raise ValueError(
                "expected gamma and trace_decay from 0 to 1, initial_temperature above 0 and burn_in of at least 0, "
                f"got {gamma}, {trace_decay}, {initial_temperature} and {burn_in}"
            )
        self.convert_to_functional(actor_network, "actor_network")
        self.convert_to_functional(critic_network, "critic_network", create_target_params=True)
        self.gamma, self.target_entropy, self.burn_in = gamma, target_entropy, burn_in
        self.trace_decay, self.importance = trace_decay, importance
        self.log_alpha = nn.Parameter(torch.tensor(math.log(initial_temperature)))
        self.auxiliary = nn.ModuleDict(dict(auxiliary or {}))
        self.auxiliary_weights = {
            name: float((auxiliary_weights or {}).get(name, 1.0)) for name in self.auxiliary
        }
        self.generator = generator

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        del kwargs  # targets are computed here

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """See the class.

        Raises:
            ValueError: a batch that is not (n, n_steps), or has no step that counts.
        """
        if tensordict.ndim != 2:
            raise ValueError(
                f"expected a batch (n, n_steps) of sequences, got batch size {tuple(tensordict.shape)}"
            )
        keys = self.tensor_keys
        pieces = batch_segments(tensordict, keys.is_init, keys.mask)
        observation, previous_action, previous_reward = (
            pieces.slots(tensordict.get(key), tensordict.get(("next", key)))
            for key in (keys.observation, keys.previous_action, keys.previous_reward)
        )
        history = (observation, previous_action, previous_reward)
        action = pieces.steps(tensordict.get(keys.action))
        rewards = pieces.steps(tensordict.get(("next", keys.reward))[..., 0])
        terminated = pieces.steps(tensordict.get(("next", keys.terminated))[..., 0])
        discounts = self.gamma * (~terminated).to(rewards.dtype)
        weights = self._weights(pieces, rewards)
        n, alpha = len(pieces), self.log_alpha.exp().detach()

        actor, critic = self.bound("actor_network"), self.bound("critic_network")
        averaged, fixed = self.bound("critic_network", "target"), self.bound("critic_network", "fixed")
        mean, log_std, _ = actor(*history, observation.new_zeros(n, actor.state_size))
        noise = torch.empty_like(mean).normal_(generator=self.generator)
        drawn, log_probability = squashed_gaussian(mean, log_std, noise)

        first = observation.new_zeros(n, critic.state_size)
        with torch.no_grad():
            later_hidden, _ = averaged.hidden(*history, first)
            later = averaged.values(later_hidden[:, 1:], observation[:, 1:], drawn[:, 1:]).min(0).values
            following = later - alpha * log_probability[:, 1:]
            targets = rewards + discounts * following
            if self.trace_decay > 0.0:
                anchors = averaged.values(later_hidden[:, :-1], observation[:, :-1], action).min(0).values
                traces = self.trace_decay * self._corrections(tensordict, pieces, mean, log_std, action)
                targets = lambda_returns(
                    rewards,
                    discounts,
                    following,
                    _shifted(traces) * (~pieces.is_last).to(rewards.dtype),
                    _shifted(anchors),
                )
        hidden, _ = critic.hidden(*history, first)
        values = critic.values(hidden[:, :-1], observation[:, :-1], action)
        best = fixed.values(hidden[:, :-1].detach(), observation[:, :-1], drawn[:, :-1]).min(0).values
        errors = (values - targets).square()
        log_probability = log_probability[:, :-1]
        entropy = -(log_probability.detach() * weights).sum()
        out = {
            "loss_critic": 0.5 * (errors.sum(0) * weights).sum(),
            "loss_actor": ((alpha * log_probability - best) * weights).sum(),
            "loss_alpha": self.log_alpha * (entropy - self.target_entropy),
            "td_error": (errors.detach().mean(0) * weights).sum().sqrt(),
            "mean_value": (values.detach().mean(0) * weights).sum(),
            "largest_value": (values.detach().abs() * pieces.mask).max(),
            "entropy": entropy,
            "alpha": alpha,
        }
        if any(self.auxiliary_weights.values()):
            given = Pieces(
                hidden,
                later_hidden,
                critic.encoder.standardised(observation),
                action,
                rewards,
                lambda: lambda_returns(rewards, discounts, later, (~pieces.is_last).to(rewards.dtype), later),
                pieces.mask,
            )
            for name, objective in self.auxiliary.items():
                if weight := self.auxiliary_weights[name]:
                    out[f"loss_{name}"] = weight * objective(given)
        return TensorDict(out, [])

    def _corrections(
        self, tensordict: TensorDictBase, pieces: Segments, mean: Tensor, log_std: Tensor, action: Tensor
    ) -> Tensor:
        """(n_pieces, n_steps) min(1, pi / mu) of the actions taken; 1 without `importance`."""
        if not self.importance:
            return torch.ones_like(action[..., 0])
        drawn_with = tensordict.get(self.tensor_keys.action_probability, None)
        if drawn_with is None:
            raise ValueError(
                "traces need the density of each action when it was drawn, under "
                f"{self.tensor_keys.action_probability!r}; let the collector record it, or set importance=False"
            )
        behaviour = pieces.steps(drawn_with[..., 0] if drawn_with.ndim == 3 else drawn_with).log()
        return (log_density(mean[:, :-1], log_std[:, :-1], action) - behaviour).clamp(max=0.0).exp()

    def _weights(self, pieces: Segments, like: Tensor) -> Tensor:
        """(n_pieces, n_steps) the share of each step in a mean; 0 for padding and for what brings up a state."""
        position = torch.arange(pieces.mask.shape[1], device=like.device)
        counts = pieces.mask & (pieces.fresh[:, None] | (position >= self.burn_in))
        return counts.to(like.dtype) / counts.sum().clamp(min=1)


def _shifted(x: Tensor) -> Tensor:
    """x_{t+1} at t; the last column is repeated, and must not count."""
    return torch.cat([x[:, 1:], x[:, -1:]], dim=1)
