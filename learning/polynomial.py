"""`PolynomialRidge`: ridge regression on all monomials of the inputs up to a degree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sklearn.preprocessing import PolynomialFeatures

from beliefgym.learning.linear_in_features import LinearInFeatures

Array = NDArray[np.float64]


class PolynomialRidge(LinearInFeatures):
    """Ridge regression on the monomials x^a with 1 <= |a| <= degree; the constant is the intercept.

    Args:
        degree: at least 1. With n inputs there are (n + degree choose degree) - 1 monomials.
        alpha: ridge penalty a sample, as in Eq. 3.9, at least 0.
        fit_intercept: whether there is an unpenalised constant.
        interaction_only: only products of different inputs.

    Example:
        >>> PolynomialRidge(degree=3).fit(X, y).predict(X)  # doctest: +SKIP
    """

    def __init__(
        self,
        *,
        degree: int = 2,
        alpha: float = 1e-6,
        fit_intercept: bool = True,
        interaction_only: bool = False,
    ) -> None:
        self.degree = degree
        self.alpha = alpha
        self.fit_intercept = fit_intercept
        self.interaction_only = interaction_only

    def _prepare(self, n_inputs: int) -> int:
        monomials = PolynomialFeatures(
            self.degree, include_bias=False, interaction_only=self.interaction_only
        )
        monomials.fit(np.zeros((1, n_inputs)))
        self.powers_ = monomials.powers_
        # each monomial is one input times a monomial of lower degree that stands before it
        self._factors = [_factor(power, self.powers_[:i]) for i, power in enumerate(self.powers_)]
        return len(self.powers_)

    def features(self, X: Array) -> Array:
        """(n, n_inputs) -> (n, number of monomials), in scikit-learn's order."""
        columns = np.empty((len(self._factors), len(X)))
        inputs = np.ascontiguousarray(X.T)
        for i, (lower, variable) in enumerate(self._factors):
            if lower is None:
                columns[i] = inputs[variable]
            else:
                np.multiply(columns[lower], inputs[variable], out=columns[i])
        return np.ascontiguousarray(columns.T)

    def feature_jacobian(self, X: Array, weights: Array) -> Array:
        """sum_a A_a a_j x^(a - e_j), by the product rule along the chain of monomials."""
        n, k = X.shape
        inputs = np.ascontiguousarray(X.T)
        columns = np.ascontiguousarray(self.features(X).T)
        slopes = np.zeros((len(self._factors), k, n))  # d monomial / d x_j
        for i, (lower, variable) in enumerate(self._factors):
            if lower is None:
                slopes[i, variable] = 1.0
            else:
                np.multiply(slopes[lower], inputs[variable], out=slopes[i])
                slopes[i, variable] += columns[lower]
        by_output = weights.T @ slopes.reshape(len(slopes), k * n)
        return np.ascontiguousarray(by_output.reshape(-1, k, n).transpose(2, 0, 1))

    def _check_parameters(self) -> None:
        super()._check_parameters()
        if not (isinstance(self.degree, int | np.integer) and self.degree >= 1):
            raise ValueError(f"expected degree to be a whole number >= 1, got {self.degree!r}")


def _factor(power: NDArray[np.int64], before: NDArray[np.int64]) -> tuple[int | None, int]:
    """Where the monomial divided by its last variable stands, and that variable."""
    variable = int(np.flatnonzero(power)[-1])
    if power.sum() == 1:
        return None, variable
    lower = power.copy()
    lower[variable] -= 1
    return int(np.flatnonzero((before == lower).all(axis=1))[0]), variable
