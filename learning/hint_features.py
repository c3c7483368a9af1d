"""Features of hints and of the observations to come, whose expectation is the belief of `PSIMHints`.

    v_t = [h_t, .., h_{t+l-1}, x_{t+1}, .., x_{t+k}],     phi_1 = v,     phi_2 = [v, v^2]        (Eq. 3.37, Sec. 3.4.3)

or a function of the user's. All hints and observations are standardised, and so are the squares.

Reference: thesis proposal, Secs. 3.4.1 (footnote 9 for l hints) and 3.4.3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin

from beliefgym.learning.future_features import READING_RIDGE, FutureFeatures
from beliefgym.learning.normal_equations import NormalEquations
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
HintFunction = Callable[[Array, Array], Array]
HintFeatures = Literal["first", "second"] | HintFunction


class HintMoments(FutureFeatures):
    """phi_1, and with `squares` phi_2.

    Args:
        n_hints: l. hint_size: components of a hint. n_future: k. n_obs: components of an observation.
        squares: brings v^2 to mean 0 and deviation 1; None for phi_1.
    """

    def __init__(
        self, n_hints: int, hint_size: int, n_future: int, n_obs: int, squares: Standardisation | None = None
    ) -> None:
        super().__init__(n_future, n_obs)
        self.n_hints, self.hint_size, self.squares = n_hints, hint_size, squares

    @property
    def n_first(self) -> int:
        """Components of v."""
        return self.n_hints * self.hint_size + self.n_future * self.n_obs

    @property
    def size(self) -> int:
        """Features."""
        return self.n_first * (1 if self.squares is None else 2)

    def __call__(self, flat: Array) -> Array:
        """phi: v (n, n_first) -> (n, size)."""
        if self.squares is None:
            return flat
        return np.concatenate([flat, self.squares.apply(np.square(flat))], axis=1)

    def read_hint(self, state: Array) -> Array:
        """E[h_t]: (n, size) -> (n, hint_size)."""
        return state[:, : self.hint_size]

    def read(self, state: Array) -> Array:
        """E[x_{t+1} .. x_{t+k}]: (n, size) -> (n, k, n_obs)."""
        start = self.n_hints * self.hint_size
        return state[:, start : self.n_first].reshape(len(state), self.n_future, self.n_obs)

    def variance(self, state: Array) -> Array:
        """E[v^2] - E[v]^2, at least 0, of phi_2: (n, size) -> (n, n_first)."""
        assert self.squares is not None
        second = self.squares.invert(state[:, self.n_first :])
        return np.maximum(second - np.square(state[:, : self.n_first]), 0.0)


class OwnHintFeatures(HintMoments):
    """A function of the user's, brought to mean 0 and deviation 1; v is read off its expectation by regression.

    Args:
        function: hints (n, l, hint_size) and futures (n, k, n_obs), standardised -> (n, d).
        flat: (n, n_first) v of the training data. The sizes are as of `HintMoments`.

    Raises:
        ValueError: a result of another shape, or one that is not finite.
    """

    def __init__(
        self, function: HintFunction, flat: Array, n_hints: int, hint_size: int, n_future: int, n_obs: int
    ) -> None:
        super().__init__(n_hints, hint_size, n_future, n_obs)
        self.function = function
        self.scale = Standardisation.of(self._called(flat))
        self.weights, self.offset = np.zeros((self.size, flat.shape[1])), flat.mean(axis=0)

    @property
    def size(self) -> int:
        """d."""
        return len(self.scale.offset)

    def __call__(self, flat: Array) -> Array:
        """See the base."""
        return self.scale.apply(self._called(flat))

    def read_hint(self, state: Array) -> Array:
        """By the regression last given to `learn_to_read`."""
        return super().read_hint(state @ self.weights + self.offset)

    def read(self, state: Array) -> Array:
        """By the regression last given to `learn_to_read`."""
        return super().read(state @ self.weights + self.offset)

    def learn_to_read(self, states: Array, flat: Array) -> None:
        """Regress v (n, n_first) on beliefs (n, d), as a filter has them."""
        equations = NormalEquations(self.size, flat.shape[1])
        equations.add(np.ascontiguousarray(states), flat)
        self.weights, self.offset = equations.solve(READING_RIDGE)

    def _called(self, flat: Array) -> Array:
        n, first = len(flat), self.n_hints * self.hint_size
        hints = flat[:, :first].reshape(n, self.n_hints, self.hint_size)
        futures = flat[:, first:].reshape(n, self.n_future, self.n_obs)
        features = np.asarray(self.function(hints, futures), dtype=np.float64)
        if features.ndim != 2 or len(features) != n or not features.shape[1]:
            raise ValueError(
                f"features: expected a function of hints {hints.shape} and futures {futures.shape} that gives "
                f"({n}, d), got {features.shape}"
            )
        if not np.isfinite(features).all():
            raise ValueError("features: expected finite numbers from the function, got others")
        return features


class FromBelief(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """The regressor that reads the hint's first moment, which is part of the belief, and learns nothing.

    Args:
        phi: the features. weight: what the hint was multiplied by.
    """

    def __init__(self, phi: HintMoments, weight: float = 1.0) -> None:
        self.phi = phi
        self.weight = weight

    def fit(self, X: Array, y: Array) -> FromBelief:
        """Nothing to do."""
        return self

    def predict_unchecked(self, X: Array) -> Array:
        """(n, size) -> (n, hint_size)."""
        return self.phi.read_hint(X) / self.weight

    predict = predict_unchecked


def hint_features(
    features: Any, flat: Array, n_hints: int, hint_size: int, n_future: int, n_obs: int
) -> HintMoments:
    """The features that a name or a function stands for.

    Args:
        features: "first", "second" or a function. flat: (n, n_first) v of the training data.

    Raises:
        ValueError: another name.
    """
    if features == "first":
        return HintMoments(n_hints, hint_size, n_future, n_obs)
    if features == "second":
        return HintMoments(n_hints, hint_size, n_future, n_obs, Standardisation.of(np.square(flat)))
    if callable(features):
        return OwnHintFeatures(features, flat, n_hints, hint_size, n_future, n_obs)
    raise ValueError(
        "expected features to be 'first', 'second' or a function of hints (n, l, n_hint) and futures (n, k, n_obs), "
        f"got {features!r}"
    )
