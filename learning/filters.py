"""`Filter`: what every learned or known filter shares. A belief is what a filter knows of the observations to come.

    m_0 = initial_belief,     m_{t+1} = F(m_t, x_t),     x_hat_t = predict_observation(m_t)           (Eq. 3.17)

m_t has seen x_0 .. x_{t-1}, so that x_hat_t is a prediction, made before x_t is known. Everything goes over a whole
batch at once: one call a time step for all trajectories. A filter that was fitted without actions takes them, where a
caller hands them to every filter, and does not look at them.

Reference: thesis proposal, Secs. 3.3.1 and 3.3.2. There time starts at 1; here at 0.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.exceptions import NotFittedError

from beliefgym.learning.dynamics import STANDARDISATIONS, DivergenceWarning, Standardise
from beliefgym.learning.filter_errors import FilterErrors
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]


class Filter(BaseEstimator, ABC):
    """Base of the filters: `fit`, then `initial_belief`, `update`, `predict_observation`, `forecast`.

    A subclass has the parameter `standardise` and implements `fit`, which begins with `_begin`, and `_initial`,
    `_update` and `_observe` in standardised observations. It may set `_bound` (belief_size,): components of a belief
    are then kept within +-_bound, and the first time that matters a `DivergenceWarning` says so.

    Attributes:
        n_obs_: components of an observation. belief_size: numbers in a belief.
    """

    standardise: Standardise
    _fitted_attribute = "model_"  # there once a fit has given something to filter with
    _bound: Array | None = None
    _told_divergence = False

    @abstractmethod
    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Learn from trajectories; see the subclass."""

    @abstractmethod
    def _initial(self) -> Array:
        """(belief_size,) the belief before any observation."""

    @abstractmethod
    def _update(self, belief: Array, z: Array) -> Array:
        """The next belief: (n, belief_size) and standardised observations (n, n_obs) -> (n, belief_size); no checks."""

    @abstractmethod
    def _observe(self, belief: Array) -> Array:
        """The standardised observation that a belief expects: (n, belief_size) -> (n, n_obs); no checks."""

    def _forecast(self, belief: Array, horizon: int) -> Array:
        """Standardised (n, horizon, n_obs); by default each prediction is taken for the observation that comes."""
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        for step in range(horizon):
            predicted[:, step] = self._observe(belief)
            if step + 1 < horizon:
                belief = self._advance(belief, predicted[:, step])
        return predicted

    @property
    def belief_size(self) -> int:
        """Numbers in a belief."""
        self._check_fitted()
        return len(self._initial())

    def initial_belief(self, n: int = 1) -> Array:
        """The belief before any observation, n times: (n, belief_size)."""
        self._check_fitted()
        return np.tile(self._initial(), (n, 1))

    def update(self, belief: ArrayLike, observation: ArrayLike, action: ArrayLike | None = None) -> Array:
        """Take in one observation (Eq. 3.17).

        Args:
            belief: (n, belief_size), of `initial_belief` or the last update.
            observation: (n, n_obs), in the units of the training data.
            action: not looked at by a filter fitted without actions.

        Returns:
            (n, belief_size), of the observations that follow.

        Raises:
            NotFittedError, ValueError: not fitted; shapes, NaN or infinities, and where.
        """
        b = self._checked_belief(belief)
        x = np.asarray(observation, dtype=np.float64)
        if x.shape != (len(b), self.n_obs_):
            raise ValueError(f"observation: expected shape {(len(b), self.n_obs_)}, got {x.shape}")
        check_finite("observation", x)
        return self._advance(b, self._scale.apply(x))

    def predict_observation(self, belief: ArrayLike) -> Array:
        """x_hat, the next observation that the belief expects: (n, belief_size) -> (n, n_obs)."""
        return self._scale.invert(self._observe(self._checked_belief(belief)))

    def forecast(self, belief: ArrayLike, horizon: int, actions: ArrayLike | None = None) -> Array:
        """The next `horizon` observations that the belief expects: x_hat_t .. x_hat_{t + horizon - 1}.

        Args:
            belief: (n, belief_size). horizon: at least 1. actions: as of `update`.

        Returns:
            (n, horizon, n_obs).
        """
        b = self._checked_belief(belief)
        if isinstance(horizon, bool) or not isinstance(horizon, int | np.integer) or horizon < 1:
            raise ValueError(f"expected horizon to be a whole number of at least 1, got {horizon!r}")
        return self._scale.invert(self._forecast(b, int(horizon)))

    def beliefs(self, sequences: Sequences) -> Array:
        """Filter whole trajectories: m_0 .. m_{n_steps + 1} of each.

        Returns:
            (n_episodes, n_steps + 2, belief_size); after an episode's end its last belief stands.
        """
        z = self._standardised(sequences)
        n, n_rows, _ = z.shape
        found = np.empty((n, n_rows + 1, self.belief_size))
        belief = self.initial_belief(n)
        found[:, 0] = belief
        for t in range(n_rows):
            going = sequences.lengths >= t
            belief = self._advance(belief, z[:, t])
            if not going.all():
                belief[~going] = found[~going, t]
            found[:, t + 1] = belief
        return found

    def errors(self, sequences: Sequences, horizon: int = 1) -> FilterErrors:
        """Filter whole trajectories and compare what is predicted with what comes (Figs. 3.20 and Table 3.3).

        Args:
            sequences: trajectories. horizon: observations ahead at each step, at least 1.
        """
        z = self._standardised(sequences)
        n, n_rows, _ = z.shape
        squared = np.full((n, n_rows, horizon), np.nan)
        belief = self.initial_belief(n)
        for t in range(n_rows):
            ahead = min(horizon, n_rows - t)
            predicted = self._scale.invert(self._forecast(belief, ahead))
            difference = predicted - sequences.observations[:, t : t + ahead]
            squared[:, t, :ahead] = np.square(difference).sum(axis=2)
            belief = self._advance(belief, z[:, t])
        last = sequences.lengths[:, None, None]
        squared[np.arange(n_rows)[:, None] + np.arange(horizon) > last] = np.nan
        power = np.square(sequences.observations[sequences.observation_mask]).sum(axis=1).mean()
        return FilterErrors(squared, float(power))

    def _advance(self, belief: Array, z: Array) -> Array:
        """`_update` within the bounds."""
        following = self._update(belief, z)
        bound = self._bound
        if bound is None or bool((np.abs(following) <= bound).all()):
            return following
        outside = ~(np.abs(following) <= bound)
        if not self._told_divergence:
            self._told_divergence = True
            row, component = (int(i) for i in np.argwhere(outside)[0])
            warnings.warn(
                f"a belief of this {type(self).__name__} left its bounds (row {row}, component {component}: "
                f"{following[row, component]:g} in standardised units, bound {bound[component]:g}) and is kept inside; "
                "this is told once. Observations unlike the training data, or an unstable filter, do that",
                DivergenceWarning,
                stacklevel=3,
            )
        following = np.where(np.isnan(following), belief, following)
        return np.clip(following, -bound, bound)

    def _begin(self, train: Sequences, validation: Sequences | None = None) -> None:
        """Check the data and take the coordinates from those to train on."""
        for sequences in (train,) if validation is None else (train, validation):
            if not isinstance(sequences, Sequences):
                raise TypeError(
                    f"expected Sequences, got {type(sequences).__name__}; arrays go through "
                    "Sequences.from_observations(observations)"
                )
            if not sequences.n_transitions:
                raise ValueError(f"expected at least one step, got {sequences!r}")
        if validation is not None and validation.n_obs != train.n_obs:
            raise ValueError(
                f"expected validation with {train.n_obs} observations as in training, got {validation.n_obs}"
            )
        if self.standardise not in STANDARDISATIONS:
            raise ValueError(
                f"expected standardise to be one of {list(STANDARDISATIONS)}, got {self.standardise!r}"
            )
        self.n_obs_ = train.n_obs
        self._told_divergence, self._bound = False, None
        rows = train.observations[train.observation_mask]
        self._scale: Standardisation = STANDARDISATIONS[self.standardise](rows)
        constant = Standardisation.of(rows).constant
        if constant.any():
            names = train.observation_names
            told = [names[i] if names else int(i) for i in np.flatnonzero(constant)]
            warnings.warn(
                f"observations {told} do not vary in the training data: nothing can be learned of them",
                stacklevel=3,
            )

    def _standardised(self, sequences: Sequences) -> Array:
        """(n_episodes, n_steps + 1, n_obs), 0 past an episode's end, where no belief is to leave its bounds."""
        self._check_fitted()
        if sequences.n_obs != self.n_obs_:
            raise ValueError(
                f"expected trajectories with {self.n_obs_} observations as at fit, got {sequences.n_obs}"
            )
        z = self._scale.apply(sequences.observations)
        z[~sequences.observation_mask] = 0.0
        return z

    def _checked_belief(self, belief: ArrayLike) -> Array:
        self._check_fitted()
        b = np.asarray(belief, dtype=np.float64)
        if b.ndim != 2 or b.shape[1] != self.belief_size:
            raise ValueError(f"belief: expected shape (n, {self.belief_size}), got {b.shape}")
        return b

    def _check_fitted(self) -> None:
        if not self.__sklearn_is_fitted__():
            raise NotFittedError(f"this {type(self).__name__} is not fitted yet; call fit(train, validation)")

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "n_obs_") and hasattr(self, self._fitted_attribute)


def check_finite(what: str, array: Array) -> None:
    """Raise where a number is NaN or infinite, and say which."""
    if not np.isfinite(array).all():
        where: Any = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{what}: expected finite numbers, got {array[where]} at index {where}")


def check_whole(name: str, value: Any, least: int) -> None:
    """Raise unless value is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"expected {name} to be a whole number of at least {least}, got {value!r}")
