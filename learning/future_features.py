"""Features of the k observations to come, whose expectation is the predictive state.

    phi_1(f_t) = [x_t, .., x_{t+k-1}]                                                      (Eq. 3.32)
    phi_2(f_t) = [x_t, .., x_{t+k-1}, x_t^2, .., x_{t+k-1}^2]                              (Eq. 3.33)

or a function of the user's. Where moments of the observations stand among the features, an expectation of them is read
off the predictive state; for any other function it is read by a ridge regression learned beside the filter.

Observations here are standardised, and so are the features that are not observations themselves: squares of raw
observations far from zero would lose all digits of a variance.

Reference: thesis proposal, Sec. 3.3.4.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.normal_equations import NormalEquations
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
FeatureFunction = Callable[[Array], Array]
Features = Literal["first", "second"] | FeatureFunction
READING_RIDGE = 1e-8  # a sample; the read-out of features of the user's


class FutureFeatures(ABC):
    """phi, and how the observations are read off an expectation of it.

    Args:
        n_future: k. n_obs: components of an observation.
    """

    def __init__(self, n_future: int, n_obs: int) -> None:
        self.n_future, self.n_obs = n_future, n_obs

    @property
    @abstractmethod
    def size(self) -> int:
        """Features."""

    @abstractmethod
    def __call__(self, futures: Array) -> Array:
        """phi: (n, k, n_obs) -> (n, size)."""

    @abstractmethod
    def read(self, state: Array) -> Array:
        """E[x_t .. x_{t+k-1}] from E[phi]: (n, size) -> (n, k, n_obs)."""

    def read_next(self, state: Array) -> Array:
        """E[x_t] alone: (n, size) -> (n, n_obs)."""
        return self.read(state)[:, 0]

    def read_last(self, state: Array) -> Array:
        """E[x_{t+k-1}] alone: (n, size) -> (n, n_obs)."""
        return self.read(state)[:, -1]


class FirstMoments(FutureFeatures):
    """phi_1, Eq. 3.32: the observations themselves."""

    @property
    def size(self) -> int:
        """k n_obs."""
        return self.n_future * self.n_obs

    def __call__(self, futures: Array) -> Array:
        """See the base."""
        return futures.reshape(len(futures), self.n_future * self.n_obs)

    def read(self, state: Array) -> Array:
        """The first k n_obs features."""
        return state[:, : self.n_future * self.n_obs].reshape(len(state), self.n_future, self.n_obs)

    def read_next(self, state: Array) -> Array:
        """The first n_obs features."""
        return state[:, : self.n_obs]


class SecondMoments(FirstMoments):
    """phi_2, Eq. 3.33: the observations and their squares, brought to mean 0 and deviation 1 on `futures`.

    Args:
        futures: (n, k, n_obs), of the training data.
    """

    def __init__(self, futures: Array) -> None:
        super().__init__(*futures.shape[1:])
        self.squares = Standardisation.of(np.square(futures).reshape(len(futures), -1))

    @property
    def size(self) -> int:
        """2 k n_obs."""
        return 2 * super().size

    def __call__(self, futures: Array) -> Array:
        """See the base."""
        flat = futures.reshape(len(futures), -1)
        return np.concatenate([flat, self.squares.apply(np.square(flat))], axis=1)

    def read_variance(self, state: Array) -> Array:
        """E[x^2] - E[x]^2 of each observation, at least 0: (n, size) -> (n, k, n_obs)."""
        first = state[:, : self.n_future * self.n_obs]
        second = self.squares.invert(state[:, self.n_future * self.n_obs :])
        return np.maximum(second - np.square(first), 0.0).reshape(len(state), self.n_future, self.n_obs)


class OwnFeatures(FutureFeatures):
    """A function of the user's, brought to mean 0 and deviation 1 on `futures`; it is read by regression.

    Args:
        function: (n, k, n_obs), standardised observations -> (n, d). futures: (n, k, n_obs), of the training data.

    Raises:
        ValueError: a result of another shape, or one that is not finite.
    """

    def __init__(self, function: FeatureFunction, futures: Array) -> None:
        super().__init__(*futures.shape[1:])
        self.function = function
        self.scale = Standardisation.of(self._called(futures))
        flat = futures.reshape(len(futures), -1)
        self.weights, self.offset = np.zeros((self.size, flat.shape[1])), flat.mean(axis=0)

    @property
    def size(self) -> int:
        """d."""
        return len(self.scale.offset)

    def __call__(self, futures: Array) -> Array:
        """See the base."""
        return self.scale.apply(self._called(futures))

    def read(self, state: Array) -> Array:
        """By the regression last given to `learn_to_read`."""
        return (state @ self.weights + self.offset).reshape(len(state), self.n_future, self.n_obs)

    def learn_to_read(self, states: Array, futures: Array) -> None:
        """Regress observations on predictive states.

        Args:
            states: (n, d), as a filter has them. futures: (n, k, n_obs), what came.
        """
        equations = NormalEquations(self.size, self.n_future * self.n_obs)
        equations.add(np.ascontiguousarray(states), futures.reshape(len(futures), -1))
        self.weights, self.offset = equations.solve(READING_RIDGE)

    def _called(self, futures: Array) -> Array:
        features = np.asarray(self.function(futures), dtype=np.float64)
        if features.ndim != 2 or len(features) != len(futures) or not features.shape[1]:
            raise ValueError(
                f"features: expected a function of futures {futures.shape} that gives ({len(futures)}, d), got "
                f"{features.shape}"
            )
        if not np.isfinite(features).all():
            raise ValueError("features: expected finite numbers from the function of futures, got others")
        return features


def future_features(features: Features, futures: Array) -> FutureFeatures:
    """The features that a name or a function stands for.

    Args:
        features: "first", "second" or a function. futures: (n, k, n_obs), of the training data, standardised.

    Raises:
        ValueError: another name.
    """
    if features == "first":
        return FirstMoments(*futures.shape[1:])
    if features == "second":
        return SecondMoments(futures)
    if callable(features):
        return OwnFeatures(features, futures)
    raise ValueError(
        f"expected features to be 'first', 'second' or a function of futures (n, k, n_obs), got {features!r}"
    )
