"""`GaussianPhysicsFilter`: beliefs that are a mean and a covariance, and how functions move them.

    y = f(s), s ~ N(m, P):     y ~ N(mu, S_y),     C = Cov(s, y)                      (mu, S_y, C: `_transform`)
    step:        m <- mu,  P <- S_y + Q            with f the dynamics; noise that enters them is part of s
    correction:  m <- m + K (x - mu),  P <- P - K S K',  K = C S^-1,  S = S_y + R      with f the sensors

What is missing of x is left out of f. This is exact where f is linear. A belief is m, the upper triangle of P row by
row, and 0 before any update or 1.

Reference: Sarkka, "Bayesian filtering and smoothing", 2013, Ch. 5 and 6.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.estimators.physics_filter import NumericalError, PhysicsFilter, StateEstimate
from beliefgym.learning.linear_gaussian import symmetric

Array = NDArray[np.float64]
Function = Callable[[Array], Array]  # points (n, k, d) -> (n, k, e), each by itself
HOPELESS = 1e-3  # an eigenvalue of the correlations this far below 0 is no rounding


class Moments(NamedTuple):
    """Of y = f(s): mean (n, e), covariance (n, e, e), and cross (n, d, e), the covariance of s and y."""

    mean: Array
    covariance: Array
    cross: Array


class GaussianPhysicsFilter(PhysicsFilter):
    """Base of the Kalman filters of a known, nonlinear system; a subclass implements `_transform`."""

    @abstractmethod
    def _transform(self, function: Function, mean: Array, covariance: Array) -> Moments:
        """The moments of a function of N(mean, covariance), (n, d) and (n, d, d)."""

    def _initial(self) -> Array:
        return self._joined(self.prior_.mean, self.prior_.covariance, 0.0)[0]

    def _state(self, belief: Array) -> StateEstimate:
        n = self.system.n_state
        P = np.empty((len(belief), n, n))
        rows, columns = np.triu_indices(n)
        P[:, rows, columns] = belief[:, n:-1]
        P[:, columns, rows] = belief[:, n:-1]
        return StateEstimate(belief[:, :n].copy(), P)

    def _predict(self, belief: Array, action: Array) -> Array:
        mean, P = self._state(belief)
        added = self._set.additive_variance
        if added is not None:
            moved = self._transform(lambda points: self._step(points, action), mean, P)
            return self._joined(moved.mean, moved.covariance + np.diag(added), 1.0)
        n, q = self.system.n_state, self.system.noise_size
        joint = np.zeros((len(mean), n + q, n + q))
        joint[:, :n, :n] = P
        joint[:, np.arange(n, n + q), np.arange(n, n + q)] = 1.0
        extended = np.concatenate([mean, np.zeros((len(mean), q))], axis=1)
        moved = self._transform(lambda points: self._step(points, action), extended, joint)
        return self._joined(moved.mean, moved.covariance, 1.0)

    def _correct(self, belief: Array, z: Array) -> Array:
        present = ~np.isnan(z)
        if not present.any():
            return belief
        mean, P = self._state(belief)
        expected = self._transform(self._sensed, mean, P)
        S = expected.covariance * (present[:, :, None] & present[:, None])
        diagonal = np.arange(z.shape[1])
        S[:, diagonal, diagonal] += np.where(present, self._set.noise_variance, 1.0)
        gain = gain_of(expected.cross * present[:, None], S)
        error = np.where(present, z - expected.mean, 0.0)
        mean = mean + np.einsum("nij,nj->ni", gain, error)
        return self._joined(mean, P - gain @ S @ gain.swapaxes(1, 2), 1.0)

    def _expect(self, belief: Array) -> Array:
        return self._transform(self._sensed, *self._state(belief)).mean

    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        mean, P = self._state(belief)
        columns = self._set.hint_columns
        if columns is None:
            return self._moments(belief, self._hint)
        return mean[:, columns], np.sqrt(np.maximum(P[:, columns, columns], 0.0))

    def _moments(self, belief: Array, function: Function) -> tuple[Array, Array]:
        mean, P, _ = self._transform(function, *self._state(belief))
        return mean, np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))

    def _step(self, points: Array, action: Array) -> Array:
        """(n, k, n_state or n_state + noise_size), (n, n_action) -> (n, k, n_state), in one call of the system."""
        n, k, _ = points.shape
        size = self.system.n_state
        flat = points.reshape(n * k, -1)
        noise = flat[:, size:] if flat.shape[1] > size else None
        moved: Array = self.system.step(flat[:, :size], np.repeat(action, k, axis=0), noise)
        return moved.reshape(n, k, size)

    def _joined(self, mean: Array, covariance: Array, seen: float) -> Array:
        P = symmetric(covariance)
        finite = np.isfinite(mean).all(axis=1) & np.isfinite(P).all(axis=(1, 2))
        if not finite.all():
            row = int(np.flatnonzero(~finite)[0])
            raise NumericalError(
                f"the belief of this {type(self).__name__} is not finite any more: row {row}, mean "
                f"{dict(zip(self.system.state_names, mean[row].tolist(), strict=True))}; the state left what the "
                "system can simulate, or the noise is too small for what was observed"
            )
        upper = P[(slice(None), *np.triu_indices(P.shape[1]))]
        return np.concatenate([self._possible(mean), upper, np.full((len(mean), 1), seen)], axis=1)


def gain_of(cross: Array, S: Array) -> Array:
    """K = C S^-1: (n, d, e), (n, e, e) -> (n, d, e)."""
    scale = np.sqrt(np.abs(np.diagonal(S, axis1=1, axis2=2)))  # so that units do not matter
    scale = np.where(scale > 0, scale, 1.0)
    try:
        whitened = np.linalg.solve(
            S / (scale[:, :, None] * scale[:, None]), cross.swapaxes(1, 2) / scale[:, :, None]
        )
    except np.linalg.LinAlgError as error:
        raise NumericalError("the covariance of the expected observations is singular") from error
    gain: Array = (whitened / scale[:, :, None]).swapaxes(1, 2)
    return gain


def covariance_root(covariance: Array) -> Array:
    """L with L L' = P for each row (n, d, d): Cholesky's, or from eigenvalues where P is not positive definite.

    Rows are taken one by one where one of them has no Cholesky factor, so that each has the same root in any batch.
    Eigenvalues below 0 by rounding count as 0.

    Raises:
        NumericalError: a row is far from a covariance.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.stack([_root(P, row) for row, P in enumerate(covariance)])


def _root(P: Array, row: int) -> Array:
    try:
        return np.asarray(np.linalg.cholesky(P), dtype=np.float64)
    except np.linalg.LinAlgError:
        variance = np.diag(P)
        d = np.sqrt(np.maximum(variance, 0.0))
        scale = np.where(d > 0, d, 1.0)
        correlation = P / np.outer(scale, scale) * np.outer(d > 0, d > 0)
        values, vectors = np.linalg.eigh(correlation)
        if values[0] < -HOPELESS or variance.min() < -HOPELESS * variance.max():
            raise NumericalError(
                f"the covariance of row {row} is not positive semidefinite: variances {variance.tolist()}, least "
                f"eigenvalue of its correlations {values[0]:g}; sigma points with negative weights, or noise too small "
                "for what was observed, do that"
            ) from None
        root: Array = d[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return root
