"""Ridge regression on a fixed feature map, by accumulating sufficient statistics: `Ridge` and what stands on it.

    y_hat = A' phi(x) + b,      min  1/W sum_i w_i |A' phi(x_i) + b - y_i|^2 + alpha |A|^2     (Eq. 3.9)

`fit` starts anew; `accumulate` adds to what is there, at a cost that does not depend on how much that is. After any
sequence of `accumulate` calls the model is what one `fit` on all of it would give, to rounding.

Reference: thesis proposal, Sec. 3.1.3.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data

from beliefgym.learning.normal_equations import NormalEquations

Array = NDArray[np.float64]
BLOCK_BYTES = 2**26  # features are made and used in blocks of rows of about this size


class LinearInFeatures(MultiOutputMixin, RegressorMixin, BaseEstimator, ABC):
    """Ridge regression on features phi(x); a subclass says which.

    A subclass has `alpha` and `fit_intercept` among its parameters, draws or counts its features in
    `_prepare(n_inputs)`, which returns their number, and computes them in `features(X)`.

    Attributes:
        coef_: (d, m), or (m,) where y was 1-D. intercept_: (d,), or a float. n_features_in_: inputs.
        equations_: the sufficient statistics.
    """

    alpha: float
    fit_intercept: bool
    _bounded_features = False  # bounded near zero: sums need no shift

    @abstractmethod
    def _prepare(self, n_inputs: int) -> int:
        """Draw or count the features of n_inputs inputs; their number."""

    @abstractmethod
    def features(self, X: Array) -> Array:
        """(n, n_inputs) float64 -> (n, m), C-contiguous; no checks: the inner loop of rollouts."""

    @abstractmethod
    def feature_jacobian(self, X: Array, weights: Array) -> Array:
        """d (weights' phi) / d x at each row: (n, n_inputs) and (m, d) -> (n, d, n_inputs); no checks."""

    def jacobian(self, X: Array) -> Array:
        """The derivative of the prediction by the inputs: (n, n_inputs) -> (n, d, n_inputs); no checks."""
        rows = self._rows_a_block()
        if len(X) <= rows:
            return self.feature_jacobian(X, self._weights)
        blocks = [self.feature_jacobian(X[i : i + rows], self._weights) for i in range(0, len(X), rows)]
        return np.concatenate(blocks)

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> Self:
        """Fit to these data alone.

        Args:
            X: (n, n_inputs). y: (n, d) or (n,). sample_weight: (n,), at least 0; ones by default.

        Raises:
            ValueError: shapes, NaN, infinities, a negative alpha or weight.
        """
        self._check_parameters()
        inputs, targets = self._checked(X, y, reset=True)
        self._start(inputs.shape[1], 1 if targets.ndim == 1 else targets.shape[1], targets.ndim)
        self._add_checked(inputs, targets, sample_weight)
        return self

    def accumulate(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> Self:
        """Add data to what was fitted or accumulated before; the same as one `fit` on all of it.

        The first call fixes the feature map and the numbers of inputs and targets. Arguments as of `fit`.
        """
        if not hasattr(self, "coef_"):
            return self.fit(X, y, sample_weight)
        self._check_not_frozen()
        inputs, targets = self._checked(X, y, reset=False)
        n_targets = 1 if targets.ndim == 1 else targets.shape[1]
        if n_targets != self._weights.shape[1]:
            raise ValueError(f"expected y with {self._weights.shape[1]} targets as before, got {n_targets}")
        self._add_checked(inputs, targets, sample_weight)
        return self

    def predict(self, X: ArrayLike) -> Array:
        """(n, n_inputs) -> (n, d), or (n,) where y was 1-D."""
        check_is_fitted(self)
        inputs: Any = validate_data(self, X, dtype=np.float64, order="C", reset=False)
        predicted = self.predict_unchecked(inputs)
        return predicted[:, 0] if self._y_ndim == 1 else predicted

    def predict_unchecked(self, X: Array) -> Array:
        """(n, n_inputs) -> (n, d), without checks: the inner loop of rollouts."""
        rows = self._rows_a_block()
        if len(X) <= rows:
            return self.predict_features(self.features(X))
        blocks = [self.predict_features(self.features(X[i : i + rows])) for i in range(0, len(X), rows)]
        return np.concatenate(blocks)

    def predict_features(self, features: Array) -> Array:
        """A' phi + b: (n, m) -> (n, d); no checks."""
        predicted: Array = features @ self._weights
        predicted += self._offset
        return predicted

    def solve(self) -> Self:
        """Bring the coefficients up to what was accumulated."""
        self._check_not_frozen()
        self._set(*self.equations_.solve(self.alpha))
        return self

    def solutions(self, alphas: ArrayLike) -> list[Self]:
        """This regressor for each of many ridge values, from one eigendecomposition of what was accumulated.

        The copies share this one's statistics as they are now; `accumulate` on one changes it alone.
        """
        check_is_fitted(self)
        self._check_not_frozen()
        values = [float(alpha) for alpha in np.atleast_1d(np.asarray(alphas, dtype=float))]
        found = []
        for alpha, solution in zip(values, self.equations_.path(values), strict=True):
            one = self.frozen()
            one.alpha = alpha
            one.equations_ = self.equations_.copy()
            one._set(*solution)
            found.append(one)
        return found

    def frozen(self) -> Self:
        """A copy that predicts as this one does now, whatever this one learns later; it holds no statistics."""
        check_is_fitted(self)
        one = self.__class__.__new__(self.__class__)
        one.__dict__.update({k: v for k, v in self.__dict__.items() if k != "equations_"})
        return one

    def _start(self, n_inputs: int, n_targets: int, y_ndim: int) -> None:
        """Forget all data; the feature map is drawn anew."""
        n_features = self._prepare(n_inputs)
        self.n_features_in_ = n_inputs
        self._y_ndim = y_ndim
        self.equations_ = NormalEquations(
            n_features, n_targets, intercept=self.fit_intercept, shifted=not self._bounded_features
        )
        self._set(np.zeros((n_features, n_targets)), np.zeros(n_targets))

    def _checked(self, X: ArrayLike, y: ArrayLike, reset: bool) -> tuple[Any, Any]:
        return validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64, order="C", reset=reset
        )

    def _add_checked(self, X: Array, y: Array, sample_weight: ArrayLike | None) -> None:
        weights = None
        if sample_weight is not None:
            weights = _check_sample_weight(sample_weight, X, dtype=np.float64, ensure_non_negative=True)
        targets = y.reshape(len(y), -1).astype(np.float64, copy=False)
        rows = self._rows_a_block()
        for i in range(0, len(X), rows):
            block = slice(i, i + rows)
            self.equations_.add(
                self.features(X[block]), targets[block], None if weights is None else weights[block]
            )
        self.solve()

    def _set(self, weights: Array, offset: Array) -> None:
        self._weights, self._offset = np.ascontiguousarray(weights), offset
        self.coef_: Any = weights.T if self._y_ndim == 2 else weights[:, 0]
        self.intercept_: Any = offset if self._y_ndim == 2 else float(offset[0])

    def _rows_a_block(self) -> int:
        return max(256, BLOCK_BYTES // (8 * max(1, len(self._weights))))

    def _check_not_frozen(self) -> None:
        if not hasattr(self, "equations_"):
            raise ValueError(
                f"expected a {type(self).__name__} that still holds its sums, got a frozen copy, which only predicts; "
                "accumulate on the original, or fit anew"
            )

    def _check_parameters(self) -> None:
        if not (np.isfinite(self.alpha) and self.alpha >= 0):
            raise ValueError(f"expected alpha finite and at least 0, got {self.alpha!r}")


class Ridge(LinearInFeatures):
    """Linear regression with a ridge penalty: y_hat = A' x + b.

    Args:
        alpha: ridge penalty a sample, as in Eq. 3.9, at least 0: scikit-learn's `Ridge` calls n times this alpha.
        fit_intercept: whether there is a b; it is not penalised.

    Example:
        >>> Ridge(alpha=1e-6).fit(X, y).predict(X)  # doctest: +SKIP
    """

    def __init__(self, *, alpha: float = 1e-6, fit_intercept: bool = True) -> None:
        self.alpha = alpha
        self.fit_intercept = fit_intercept

    def _prepare(self, n_inputs: int) -> int:
        return n_inputs

    def features(self, X: Array) -> Array:
        """The inputs themselves."""
        return X

    def feature_jacobian(self, X: Array, weights: Array) -> Array:
        """A' at every row."""
        return np.broadcast_to(weights.T, (len(X), *weights.T.shape))
