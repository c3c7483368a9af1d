"""The error of 1 .. H predicted steps as a function of a model's coefficients, with its gradient by torch.

    sum_{h=1}^{H} w_h mean_t |z_{t+h} - z_hat_{t+h|t}|^2

in standardised states z, where z_hat_{t+h|t} follows from z_t by h steps with output A' phi + b. The gradient by A and
b goes through all h steps, that is, also through the features phi of every prediction.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from beliefgym.learning.linear_in_features import LinearInFeatures, Ridge
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences

if TYPE_CHECKING:
    from beliefgym.learning.backprop_through_time import BackpropThroughTime

Array = NDArray[np.float64]


class MultiStepLoss:
    """The weighted errors of 1 .. H steps; an item is a sub-trajectory.

    Args:
        model: whose coordinates, horizon and weights these are.
        train: trajectories. regressor: whose features.
    """

    def __init__(self, model: BackpropThroughTime, train: Sequences, regressor: LinearInFeatures) -> None:
        self._pieces = SubTrajectories(*model._coordinates(train), train.lengths, model.horizon)
        self.n_items = len(self._pieces)
        # a mini-batch of n pieces has n n_at_step / n_items of at least h steps on average
        self._share = model._weights_of_steps() * self.n_items / self._pieces.n_at_step
        self._features = torch_features(regressor)
        self._is_difference = model.target == "delta"
        self._scale = torch.from_numpy(model._change_scale)
        self._centre = torch.from_numpy(model._centre)
        self._limit = torch.from_numpy(model.divergence_limit * model._spread)

    def loss_and_gradient(
        self,
        weights: Array,
        offset: Array,
        items: NDArray[np.int64],
        progress: float,
        rng: np.random.Generator,
    ) -> tuple[float, Array, Array]:
        """See `Objective`; neither progress nor rng matters."""
        z, u, inside = self._pieces.cut(items)
        A = torch.from_numpy(weights).requires_grad_()
        b = torch.from_numpy(offset).requires_grad_()
        share = torch.from_numpy(inside * (self._share / len(items)))
        loss = self._loss(A, b, torch.from_numpy(z), torch.from_numpy(u), share)
        by_A, by_b = torch.autograd.grad(loss, (A, b))
        return float(loss.detach()), by_A.numpy(), by_b.numpy()

    def _loss(
        self, A: torch.Tensor, b: torch.Tensor, z: torch.Tensor, u: torch.Tensor, share: torch.Tensor
    ) -> torch.Tensor:
        """sum_{i, h} share_ih |z_{i,h} - z_hat_{i,h}|^2 for (n, H + 1, d) states, (n, H, n_act) actions, (n, H)."""
        now = z[:, 0]
        going = torch.ones(len(z), dtype=torch.bool)
        loss = torch.zeros((), dtype=torch.float64)
        for h in range(u.shape[1]):
            output = self._features(torch.cat([now, u[:, h]], dim=1)) @ A + b
            z_next = now + output * self._scale if self._is_difference else output
            going = going & ((z_next.detach() - self._centre).abs() <= self._limit).all(dim=1)
            now = z_next if going.all() else torch.where(going[:, None], z_next, now)
            loss = loss + share[:, h] @ (now - z[:, h + 1]).square().sum(dim=1)
        return loss


class SubTrajectories:
    """Every piece of up to H steps of some trajectories, from every step on, cut when asked for.

    Args:
        z: (n_episodes, n_steps + 1, d). u: (n_episodes, n_steps, n_act). lengths: (n_episodes,). horizon: H.

    Attributes:
        n_at_step: (H,) pieces of at least h steps.
    """

    def __init__(self, z: Array, u: Array, lengths: NDArray[np.int64], horizon: int) -> None:
        longest = int(lengths.max(initial=0))
        if horizon > longest:
            raise ValueError(
                f"expected horizon of at most the longest trajectory's {longest} steps, got {horizon}"
            )
        self._z, self._u, self._horizon = z, u, horizon
        self._episode, self._start = np.nonzero(np.arange(u.shape[1]) < lengths[:, None])
        self._left = lengths[self._episode] - self._start
        self.n_at_step = np.array([np.count_nonzero(self._left >= h) for h in range(1, horizon + 1)])

    def __len__(self) -> int:
        return len(self._start)

    def cut(self, items: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.bool_]]:
        """States (n, H + 1, d), actions (n, H, n_act), and (n, H) which steps lie inside their episode."""
        episode, steps = self._episode[items, None], np.arange(self._horizon)
        at = self._start[items, None] + np.arange(self._horizon + 1)
        z = self._z[episode, np.minimum(at, self._u.shape[1])]
        u = self._u[episode, np.minimum(at[:, :-1], self._u.shape[1] - 1)]
        return z, u, steps < self._left[items, None]


def torch_features(regressor: LinearInFeatures) -> Callable[[torch.Tensor], torch.Tensor]:
    """The feature map of a fitted regressor for torch: (n, n_inputs) -> (n, m), differentiable.

    Raises:
        TypeError: a regressor whose features are not known here.
    """
    if isinstance(regressor, Ridge):
        return lambda x: x
    if isinstance(regressor, RandomFourierRidge):
        frequencies = torch.from_numpy(regressor.frequencies_)
        scale = regressor.n_frequencies**-0.5
        first = regressor.include_inputs

        def fourier(x: torch.Tensor) -> torch.Tensor:
            angle = x @ frequencies
            waves = torch.cat([angle.cos(), angle.sin()], dim=1) * scale
            return torch.cat([x, waves], dim=1) if first else waves

        return fourier
    if isinstance(regressor, PolynomialRidge):
        factors = regressor._factors

        def monomials(x: torch.Tensor) -> torch.Tensor:
            columns: list[torch.Tensor] = []
            for lower, variable in factors:
                columns.append(x[:, variable] if lower is None else columns[lower] * x[:, variable])
            return torch.stack(columns, dim=1)

        return monomials
    raise TypeError(
        "expected Ridge, RandomFourierRidge or PolynomialRidge, whose features torch can differentiate here, got "
        f"{type(regressor).__name__}"
    )
