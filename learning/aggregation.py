"""Learning on a growing data set: what every dataset-aggregation algorithm asks of a learner.

Three learners stand behind the same calls. `SufficientStatistics` (follow the leader, for regressors that can
`accumulate`) keeps sums and no data. `StoredAggregate` (follow the leader, for every other regressor) keeps the data
and fits a clone to all of it. `GradientSteps` (online gradient descent, for regressors linear in features) takes one
gradient step for each batch, and keeps neither.

Inputs are encoded once: the features that a rollout needs for its prediction are those that the correction at that
point adds to the sums.

Reference: thesis proposal, Sec. 3.1.2: Follow-the-Leader, and online methods that need not store the data set.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.multioutput import MultiOutputRegressor
from sklearn.utils import get_tags

from beliefgym.learning.linear_in_features import BLOCK_BYTES, LinearInFeatures

Array = NDArray[np.float64]
Code = Array  # an input as the learner keeps it: its features, or itself
Algorithm = Literal["follow_the_leader", "online_gradient"]


class Learner(Protocol):
    """A regressor on an aggregate."""

    n_pairs: int
    """Input-target pairs in the aggregate."""

    def encode(self, X: Array) -> Code:
        """Inputs (n, n_inputs) in the form that `predict` and `add` take."""

    def predict(self, code: Code) -> Array:
        """(n, d), by the model of the last `refit`."""

    def add(self, code: Code, Y: Array) -> None:
        """Add pairs; the model stays as it is until `refit`."""

    def discount(self, factor: float) -> None:
        """Weigh all that is in the aggregate by a factor in (0, 1]."""

    def refit(self) -> None:
        """Bring the model up to the aggregate."""

    def mean_squared_error(self) -> float:
        """Of the model on the aggregate, summed over components, in the targets' units squared."""

    def frozen(self) -> Any:
        """The present model as a fitted regressor that later calls do not touch."""


def learner_for(regressor: Any, algorithm: Algorithm, X: Array, Y: Array, step_size: float = 0.1) -> Learner:
    """The learner that suits a regressor, started on a first data set and fitted to it.

    Args:
        regressor: unfitted; it is cloned.
        algorithm: "follow_the_leader" or "online_gradient".
        X: (n, n_inputs). Y: (n, d).
        step_size: of "online_gradient", see `GradientSteps`.

    Raises:
        ValueError: an unknown algorithm. TypeError: online gradient descent with a regressor not linear in features.
    """
    if algorithm == "online_gradient":
        if not isinstance(regressor, LinearInFeatures):
            raise TypeError(
                "expected a regressor linear in features (Ridge, RandomFourierRidge, PolynomialRidge) for "
                f"'online_gradient', got {type(regressor).__name__}"
            )
        return GradientSteps(regressor, X, Y, step_size)
    if algorithm != "follow_the_leader":
        raise ValueError(f"expected algorithm to be one of {get_args(Algorithm)}, got {algorithm!r}")
    if isinstance(regressor, LinearInFeatures):
        return SufficientStatistics(regressor, X, Y)
    return StoredAggregate(regressor, X, Y)


class SufficientStatistics:
    """Follow the leader without keeping data: iteration n costs what iteration 1 does.

    Args: as of `learner_for`.
    """

    def __init__(self, regressor: LinearInFeatures, X: Array, Y: Array) -> None:
        self._regressor = clone(regressor).fit(X, Y)
        self.n_pairs = len(X)

    def encode(self, X: Array) -> Code:
        """The features."""
        return self._regressor.features(X)

    def predict(self, code: Code) -> Array:
        """(n, d)."""
        return self._regressor.predict_features(code)

    def add(self, code: Code, Y: Array) -> None:
        """One symmetric rank-n update."""
        self._regressor.equations_.add(code, Y)
        self.n_pairs += len(code)

    def discount(self, factor: float) -> None:
        """Of the sums."""
        self._regressor.equations_.discount(factor)

    def refit(self) -> None:
        """One Cholesky solve."""
        self._regressor.solve()

    def mean_squared_error(self) -> float:
        """From the sums."""
        regressor = self._regressor
        return regressor.equations_.mean_squared_error(regressor._weights, regressor._offset)

    def frozen(self) -> LinearInFeatures:
        """The coefficients as they are."""
        return self._regressor.frozen()


class StoredAggregate:
    """Follow the leader for any regressor: the aggregate is kept, and a clone is fitted to all of it.

    A regressor with a method `for_aggregate(iteration, growth)` (`RandomForest`) is asked for its form at each
    iteration. One that takes a single target only is fitted once for each component.

    Args: as of `learner_for`.
    """

    def __init__(self, regressor: Any, X: Array, Y: Array) -> None:
        if Y.shape[1] > 1 and not get_tags(regressor).target_tags.multi_output:
            regressor = MultiOutputRegressor(regressor)
        self._prototype = regressor
        self._n_targets = Y.shape[1]
        self._inputs, self._targets = [X], [Y]
        self.n_pairs, self._n_first = len(X), len(X)
        self._iteration = 0
        self.refit()

    def encode(self, X: Array) -> Code:
        """The inputs themselves."""
        return X

    def predict(self, code: Code) -> Array:
        """(n, d)."""
        return predict_unchecked(self._model, code, self._n_targets)

    def add(self, code: Code, Y: Array) -> None:
        """Append."""
        if len(code):
            self._inputs.append(code)
            self._targets.append(Y)
            self.n_pairs += len(code)

    def discount(self, factor: float) -> None:
        """Not here."""
        raise TypeError(
            "expected a regressor linear in features (Ridge, RandomFourierRidge, PolynomialRidge) with discount "
            f"{factor:g}, got {type(self._prototype).__name__}"
        )

    def refit(self) -> None:
        """Fit a clone to the whole aggregate."""
        self._inputs, self._targets = [np.concatenate(self._inputs)], [np.concatenate(self._targets)]
        prototype = self._prototype
        if hasattr(prototype, "for_aggregate"):
            prototype = prototype.for_aggregate(self._iteration, self.n_pairs / self._n_first)
        targets = self._targets[0]
        self._model = clone(prototype).fit(self._inputs[0], targets if self._n_targets > 1 else targets[:, 0])
        self._iteration += 1

    def mean_squared_error(self) -> float:
        """By predicting the aggregate."""
        error = predict_unchecked(self._model, self._inputs[0], self._n_targets) - self._targets[0]
        return float(np.square(error).sum(axis=1).mean())

    def frozen(self) -> Any:
        """The fitted clone; `refit` makes another."""
        return self._model


class GradientSteps:
    """Online gradient descent on the squared loss of each batch, from the first data set's minimiser.

        A <- A - eta_n (1/|B| Z'(Z A - Y) + alpha A),     eta_n = step_size / (L sqrt(n + 1))

    in iteration n, for each batch B of corrections, where L is the largest mean square of a feature vector seen, an
    upper bound of the loss's curvature. The predictions of an iteration all come from its first model.

    Args: as of `learner_for`; step_size above 0, at most 2 for steps that never overshoot.
    """

    def __init__(self, regressor: LinearInFeatures, X: Array, Y: Array, step_size: float) -> None:
        if not (np.isfinite(step_size) and step_size > 0):
            raise ValueError(f"expected step_size finite and above 0, got {step_size!r}")
        self._regressor = clone(regressor).fit(X, Y)
        self._alpha, self._step_size = regressor.alpha, step_size
        self._weights, self._offset = self._regressor._weights.copy(), self._regressor._offset.copy()
        self._curvature = 0.0
        self._iteration = 0
        self._loss, self._loss_pairs = 0.0, 0
        self.n_pairs = len(X)

    def encode(self, X: Array) -> Code:
        """The features."""
        return self._regressor.features(X)

    def predict(self, code: Code) -> Array:
        """(n, d)."""
        return self._regressor.predict_features(code)

    def add(self, code: Code, Y: Array) -> None:
        """One gradient step."""
        if not len(code):
            return
        self.n_pairs += len(code)
        self._curvature = max(self._curvature, float(np.square(code).sum(axis=1).mean()) + 1.0)
        step = self._step_size / (self._curvature * (self._iteration + 1) ** 0.5)
        residual = code @ self._weights + self._offset - Y
        self._loss += float(np.square(residual).sum())
        self._loss_pairs += len(code)
        self._weights -= step * (code.T @ residual / len(code) + self._alpha * self._weights)
        if self._regressor.fit_intercept:
            self._offset = self._offset - step * residual.mean(axis=0)

    def discount(self, factor: float) -> None:
        """Nothing: gradient steps hold no aggregate."""

    def refit(self) -> None:
        """Take the stepped coefficients for the next predictions."""
        self._regressor._set(self._weights.copy(), self._offset.copy())
        self._iteration += 1

    def mean_squared_error(self) -> float:
        """The online loss so far: each batch's before its own step; of the first data set at the start."""
        if self._loss_pairs:
            return self._loss / self._loss_pairs
        return self._regressor.equations_.mean_squared_error(self._weights, self._offset)

    def frozen(self) -> LinearInFeatures:
        """The coefficients as they are."""
        return self._regressor.frozen()


def predict_unchecked(regressor: Any, X: Array, n_targets: int) -> Array:
    """(n, n_inputs) -> (n, n_targets), without input checks where the regressor has such a way."""
    if hasattr(regressor, "predict_unchecked"):
        return regressor.predict_unchecked(X)
    rows = max(1, BLOCK_BYTES // 512)
    if len(X) <= rows:
        return np.asarray(regressor.predict(X), dtype=np.float64).reshape(len(X), n_targets)
    parts = [regressor.predict(X[i : i + rows]) for i in range(0, len(X), rows)]
    return np.concatenate(parts).reshape(len(X), n_targets)
