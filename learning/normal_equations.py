"""Sufficient statistics of least squares: data go in batch by batch, and nothing of them is kept.

For features Z (n, m) and targets Y (n, d) with weights w, ridge regression with an unpenalised intercept,

    min_{A, b}  1/W sum_i w_i |A' z_i + b - y_i|^2 + alpha |A|^2,     W = sum_i w_i        (Eq. 3.9)

needs Z'WZ, Z'WY and the sums of Z and Y only. Adding n rows is one symmetric rank-n update (n m^2 FLOPs, half of a
matrix product) whatever was added before; solving is one Cholesky factorisation (m^3 / 3), or one eigendecomposition
for any number of values of alpha.

Sums are taken about the first batch's weighted mean, so that data far from zero lose no digits to cancellation.

Reference: thesis proposal, Eq. 3.9; Algorithm 1, lines 7 and 9. There the loss has the factor 1/2 throughout.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh
from scipy.linalg.blas import dsyrk

Array = NDArray[np.float64]
LOST = 100.0 * float(np.finfo(float).eps)  # share of a sum of squares that is rounding only


class NormalEquations:
    """The sums that least squares of Y on Z needs.

    Args:
        n_features: m.
        n_targets: d.
        intercept: whether there is a b.
        shifted: take the features' sums about the first batch's mean; those that are bounded near zero (cosines) need
            not. The targets' always are, where there is an intercept.
    """

    def __init__(
        self, n_features: int, n_targets: int, *, intercept: bool = True, shifted: bool = True
    ) -> None:
        self.intercept, self._shifts_features = intercept, shifted and intercept
        self.weight = 0.0
        self.n_rows = 0
        self._gram = np.zeros((n_features, n_features), order="F")  # lower triangle of Z'WZ
        self._cross = np.zeros((n_features, n_targets))
        self._sum_z, self._sum_y = np.zeros(n_features), np.zeros(n_targets)
        self._square_y = np.zeros(n_targets)
        self._shift_z, self._shift_y = np.zeros(n_features), np.zeros(n_targets)

    def add(self, features: Array, targets: Array, weights: Array | None = None) -> None:
        """Add rows.

        Args:
            features: (n, m), C-contiguous. targets: (n, d). weights: (n,), at least 0; ones by default.
        """
        if not len(features):
            return
        total = float(len(features)) if weights is None else float(weights.sum())
        if self.intercept:
            if self.weight == 0 and total > 0:
                self._shift_y = np.average(targets, axis=0, weights=weights)
                if self._shifts_features:
                    self._shift_z = np.average(features, axis=0, weights=weights)
            targets = targets - self._shift_y
            if self._shifts_features:
                features = features - self._shift_z
        if self.intercept:
            self._sum_z += features.sum(axis=0) if weights is None else weights @ features
            self._sum_y += targets.sum(axis=0) if weights is None else weights @ targets
        if weights is not None:
            root = np.sqrt(weights)[:, None]
            features, targets = features * root, targets * root
        # features.T is Fortran-ordered: BLAS reads it without a copy
        self._gram = dsyrk(1.0, features.T, beta=1.0, c=self._gram, lower=1, overwrite_c=1)
        self._cross += features.T @ targets
        self._square_y += np.einsum("ij,ij->j", targets, targets)
        self.weight += total
        self.n_rows += len(features)

    def discount(self, factor: float) -> None:
        """Weigh all that was added by a factor above 0: exponential forgetting, where it is called again and again."""
        for sums in (self._gram, self._cross, self._sum_z, self._sum_y, self._square_y):
            sums *= factor
        self.weight *= factor

    def copy(self) -> NormalEquations:
        """An independent copy."""
        other = NormalEquations.__new__(NormalEquations)
        other.__dict__.update(
            {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in self.__dict__.items()}
        )
        return other

    def solve(self, alpha: float) -> tuple[Array, Array]:
        """The minimiser for one ridge value, by Cholesky; by the pseudo-inverse where a pivot is rounding only.

        Args:
            alpha: at least 0.

        Returns:
            A (m, d) and b (d,).
        """
        gram, cross = self._centred()
        gram[np.diag_indices_from(gram)] += self.weight * alpha
        squares = np.diag(gram).copy()
        try:
            factor = cho_factor(gram, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError:
            return self.path([alpha])[0]
        if (np.square(np.diag(factor[0])) <= LOST * len(gram) * squares).any():
            return self.path([alpha])[0]
        return self._with_intercept(cho_solve(factor, cross, check_finite=False))

    def path(self, alphas: Sequence[float]) -> list[tuple[Array, Array]]:
        """The minimisers for many ridge values, from one eigendecomposition.

        Directions without any variance are left at zero (the solution of least norm).

        Args:
            alphas: at least 0.

        Returns:
            (A, b) for each.
        """
        gram, cross = self._centred()
        values, vectors = eigh(gram, lower=True, overwrite_a=True, check_finite=False)
        rotated = vectors.T @ cross
        floor = LOST * len(values) * max(values[-1], 0.0)
        found = []
        for alpha in alphas:
            shrunk = np.maximum(values, 0.0) + self.weight * alpha
            inverse = np.divide(1.0, shrunk, out=np.zeros_like(shrunk), where=shrunk > floor)
            found.append(self._with_intercept(vectors @ (inverse[:, None] * rotated)))
        return found

    def mean_squared_error(self, weights: Array, intercept: Array) -> float:
        """1/W sum_i w_i |A' z_i + b - y_i|^2 over all that was added, in O(m^2 d).

        Its rounding error is about 1e-16 of the targets' own mean square.

        Args:
            weights: A (m, d). intercept: b (d,).
        """
        if not self.weight:
            return float("nan")
        # about the shifts, the model reads A' (z - s_z) + c with c = b + A' s_z - s_y
        c = intercept + weights.T @ self._shift_z - self._shift_y
        gram = _symmetric(self._gram)
        total = (
            self._square_y.sum()
            - 2.0 * np.vdot(weights, self._cross)
            + np.vdot(weights, gram @ weights)
            + self.weight * (c @ c)
        )
        if self.intercept:
            total += 2.0 * c @ (weights.T @ self._sum_z - self._sum_y)
        return max(float(total), 0.0) / self.weight

    def _centred(self) -> tuple[Array, Array]:
        """Z'WZ (lower triangle) and Z'WY about the weighted means, as copies; 0 for features that do not vary."""
        gram, cross = self._gram.copy(order="F"), self._cross.copy()
        if self.intercept and self.weight:
            gram -= np.outer(self._sum_z, self._sum_z / self.weight)
            cross -= np.outer(self._sum_z, self._sum_y / self.weight)
            constant = np.diag(gram) <= LOST * np.diag(self._gram)
            gram[constant], gram[:, constant], cross[constant] = 0.0, 0.0, 0.0
        return gram, cross

    def _with_intercept(self, weights: Array) -> tuple[Array, Array]:
        if not self.intercept or not self.weight:
            return weights, np.zeros(weights.shape[1])
        mean_z = self._shift_z + self._sum_z / self.weight
        mean_y = self._shift_y + self._sum_y / self.weight
        return weights, mean_y - mean_z @ weights


def _symmetric(lower: Array) -> Array:
    return np.tril(lower) + np.tril(lower, -1).T
