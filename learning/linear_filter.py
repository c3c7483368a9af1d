"""`LinearFilter`: filters that are a linear system with a constant gain, whose order is chosen on validation data.

    s_{t+1} = A s_t + b + K (x_t - x_hat_t),     x_hat_t = C s_t + c                        (innovations form)

What differs is how A, C and K are found: by projections (`N4SID`) or by two regressions
(`InstrumentalVariableRegression`), both of which have the systems of all orders from one decomposition.

Reference: thesis proposal, Sec. 3.3.4, on both: "we only perform grid search for picking the rank".
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.filters import Filter, check_whole
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
GRID = (*range(1, 13), 15, 19, 24, 31, 39, 50, 64)  # the orders that are tried where none is named


@dataclass(frozen=True, eq=False)
class SystemMatrices:
    """A linear system in innovations form, for standardised observations.

    Attributes:
        transition: A (n, n). observation: C (n_obs, n). gain: K (n, n_obs). drift: b (n,). mean: c (n_obs,).
        first: s_0 (n,).
        innovation_covariance: (n_obs, n_obs), of x_t - x_hat_t in training, once the filter has seen some.
    """

    transition: Array
    observation: Array
    gain: Array
    drift: Array
    mean: Array
    first: Array
    innovation_covariance: Array

    @property
    def closed(self) -> Array:
        """A - K C (n, n)."""
        return self.transition - self.gain @ self.observation


class LinearFilter(Filter):
    """Base of the linear filters; a subclass has the parameter `belief_limit`, and implements `fit`.

    Attributes:
        system_matrices_: see `SystemMatrices`. errors_by_rank_: {order: one-step error}, where several were compared.
    """

    _fitted_attribute = "system_matrices_"
    belief_limit: float
    system_matrices_: SystemMatrices

    @property
    def transition_matrix(self) -> Array:
        """A - K C (n, n), by which the filter forgets: s_{t+1} = (A - K C) s_t + K x_t + .., standardised."""
        self._check_fitted()
        return self.system_matrices_.closed

    def predict_variance(self, belief: ArrayLike) -> Array:
        """Variance of the next observation, whatever the belief: (n, belief_size) -> (n, n_obs), squared units."""
        b = self._checked_belief(belief)
        variance = np.diag(self.system_matrices_.innovation_covariance) * np.square(self._scale.scale)
        return np.tile(variance, (len(b), 1))

    def _deviations(self, train: Sequences) -> Array:
        """The components that vary, about their means: (n_episodes, n_steps + 1, d), 0 past the ends.

        Raises:
            ValueError: nothing varies; belief_limit out of range.
        """
        if not self.belief_limit > 0:
            raise ValueError(f"expected belief_limit above 0, got {self.belief_limit!r}")
        self.__dict__.pop("system_matrices_", None)  # of an earlier fit, in its coordinates
        z, mask = self._scale.apply(train.observations), train.observation_mask
        rows = Standardisation.of(z[mask])
        if rows.constant.all():
            raise ValueError("expected observations that vary, got constants only")
        self._centre, self._varying = rows.offset, np.flatnonzero(~rows.constant)
        return np.where(mask[:, :, None], z - rows.offset, 0.0)[:, :, self._varying]

    def _system(
        self, a: Array, c: Array, gain: Array, drift: Array, mean: Array, first: Array
    ) -> SystemMatrices:
        """From a system for what `_deviations` gives; components that do not vary have their mean."""
        n, d = len(a), self.n_obs_
        observation, into, constant = np.zeros((d, n)), np.zeros((n, d)), self._centre.copy()
        observation[self._varying], into[:, self._varying] = c, gain
        constant[self._varying] += mean
        return SystemMatrices(a, observation, into, drift, constant, first, np.zeros((d, d)))

    def _choose(
        self,
        ranks: list[int],
        build: Callable[[int], SystemMatrices | None],
        train: Sequences,
        validation: Sequences | None,
    ) -> int | None:
        """Filter with the best of several systems from now on; bounds are not set yet.

        Args:
            ranks: to try. build: the system of a rank, or None where there is none.
            validation: to compare them on; None for the training data.

        Returns:
            The rank chosen; None, and nothing to filter with, where there was no system at all.
        """
        self.errors_by_rank_: dict[int, float] = {}
        self._bound = None
        compared = train if validation is None else validation
        best: tuple[float, int, SystemMatrices] | None = None
        for rank in ranks:
            system, error = build(rank), np.inf
            if system is not None:
                self._use(system)
                with np.errstate(over="ignore", invalid="ignore"):  # an unstable one
                    error = self.errors(compared).mean if len(ranks) > 1 else 0.0
                if np.isfinite(error) and (best is None or error < best[0]):
                    best = error, rank, system
            if len(ranks) > 1:
                self.errors_by_rank_[rank] = error
        if best is None:
            self.__dict__.pop("system_matrices_", None)
            return None
        self._use(best[2])
        return best[1]

    def _measure(self, train: Sequences, n_seen: int) -> Array:
        """Filter the training data: the innovations' covariance once n_seen observations are in.

        Returns:
            (belief_size,) the largest of each component of a belief.
        """
        z, lengths = self._standardised(train), train.lengths
        largest = np.abs(self._initial())
        covariance, n_late = np.zeros((self.n_obs_, self.n_obs_)), 0
        belief = self.initial_belief(len(z))
        self._told_divergence = True  # who fits is told of an unstable filter in other words
        for t in range(z.shape[1]):
            going = lengths >= t
            if t >= n_seen:
                errors = z[going, t] - self._observe(belief[going])
                covariance += errors.T @ errors
                n_late += len(errors)
            following = self._advance(belief, z[:, t])
            belief = np.where(going[:, None], following, belief)
            largest = np.maximum(largest, np.abs(belief).max(axis=0))
        self._told_divergence = False
        self._use(replace(self.system_matrices_, innovation_covariance=covariance / max(n_late, 1)))
        return largest

    def _use(self, system: SystemMatrices) -> None:
        self.system_matrices_ = system
        self._closed = np.ascontiguousarray(system.closed.T)

    def _initial(self) -> Array:
        return self.system_matrices_.first

    def _update(self, belief: Array, z: Array) -> Array:
        m = self.system_matrices_
        return belief @ self._closed + (z - m.mean) @ m.gain.T + m.drift

    def _observe(self, belief: Array) -> Array:
        m = self.system_matrices_
        return belief @ m.observation.T + m.mean


def ranks_to_try(name: str, asked: Any, there: int, most: int, limit: str) -> list[int]:
    """The orders that a parameter asks for, as far as the data have them.

    Args:
        name: of the parameter. asked: its value, a whole number or several; None for `GRID`.
        there: directions of the future that the data's past predicts at all. most: the largest order allowed, and
            `limit` what allows it, for messages.

    Raises:
        ValueError: not whole numbers of at least 1; all above `most`; nothing predicted. Less than asked for is told.
    """
    given = list(GRID) if asked is None else list(np.atleast_1d(np.asarray(asked)))
    for rank in given:
        check_whole(name, rank, 1)
    if not given or min(given) > most:
        raise ValueError(f"expected {name} of at most {limit} = {most}, got {asked!r}")
    if not there:
        raise ValueError("expected observations that predict later ones in some direction, got none that do")
    if min(given) > min(there, most):
        warnings.warn(
            f"{name}: asked for {asked!r}, but in these data the past predicts {there} directions of the future; "
            f"taking {there}",
            stacklevel=3,
        )
        return [there]
    return sorted({int(rank) for rank in given if rank <= min(there, most)})
