"""`WeightedAggregate`: follow the leader on pairs that carry weights, one for each block of target components.

    min_A  sum_i w_ib |A_b' z_i - y_ib|^2 / sum_i w_ib + alpha |A_b|^2     for each block b

The blocks share the features; each has its own normal equations, since its weights are its own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from beliefgym.learning.linear_in_features import LinearInFeatures
from beliefgym.learning.normal_equations import NormalEquations

Array = NDArray[np.float64]


class WeightedAggregate:
    """A `Learner` whose targets come with their weights behind them.

    Args:
        regressor: linear in features; it is cloned.
        X: (n, n_inputs). Y: (n, d + n_blocks): targets, then the weights of each block, at least 0.
        block: (d,) the block of each target component, 0 to n_blocks - 1.
    """

    def __init__(self, regressor: LinearInFeatures, X: Array, Y: Array, block: NDArray[np.intp]) -> None:
        self._block, self._n_targets = block, len(block)
        self._regressor = clone(regressor)
        self._regressor._check_parameters()
        self._regressor._start(X.shape[1], self._n_targets, 2)
        m, prototype = len(self._regressor._weights), self._regressor.equations_
        self._columns = [np.flatnonzero(block == b) for b in range(int(block.max()) + 1)]
        self._equations = [
            NormalEquations(
                m, len(columns), intercept=prototype.intercept, shifted=prototype._shifts_features
            )
            for columns in self._columns
        ]
        self.n_pairs = 0
        self.add(self.encode(X), Y)
        self.refit()

    def encode(self, X: Array) -> Array:
        """The features."""
        return self._regressor.features(X)

    def predict(self, code: Array) -> Array:
        """(n, d), without weights."""
        return self._regressor.predict_features(code)

    def add(self, code: Array, Y: Array) -> None:
        """One symmetric rank-n update for each block."""
        code = np.ascontiguousarray(code)
        for b, (columns, equations) in enumerate(zip(self._columns, self._equations, strict=True)):
            equations.add(code, Y[:, columns], Y[:, self._n_targets + b])
        self.n_pairs += len(code)

    def discount(self, factor: float) -> None:
        """Of the sums."""
        for equations in self._equations:
            equations.discount(factor)

    def refit(self) -> None:
        """One Cholesky solve for each block."""
        regressor = self._regressor
        weights, offset = np.empty_like(regressor._weights), np.empty(self._n_targets)
        for columns, equations in zip(self._columns, self._equations, strict=True):
            weights[:, columns], offset[columns] = equations.solve(regressor.alpha)
        regressor._set(weights, offset)

    def mean_squared_error(self) -> float:
        """Weighed, summed over components."""
        regressor = self._regressor
        return sum(
            equations.mean_squared_error(regressor._weights[:, columns], regressor._offset[columns])
            for columns, equations in zip(self._columns, self._equations, strict=True)
        )

    def frozen(self) -> LinearInFeatures:
        """The coefficients as they are."""
        return self._regressor.frozen()
