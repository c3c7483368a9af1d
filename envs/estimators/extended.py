"""`ExtendedKalmanFilter`: a Gaussian belief moved through the physics linearised at its mean.

    mu = f(m),   S_y = J P J',   C = P J',   J = df/ds at m by central differences, h_i = eps^(1/3) max(1, |m_i|)
    P <- (I - K H) P (I - K H)' + K R K'                                              (Joseph's form of the correction)

All perturbed copies of all rows go through the system in one call. Where the system's noise is more than added to the
state, J has its columns too, at noise 0.

References: Jazwinski, "Stochastic processes and filtering theory", 1970; Bucy & Joseph, "Filtering for stochastic
processes with applications to guidance", 1968; thesis proposal, Sec. 3.4.3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.estimators.gaussian_filter import Function, GaussianPhysicsFilter, Moments, gain_of

Array = NDArray[np.float64]
STEP = float(np.cbrt(np.finfo(np.float64).eps))


class ExtendedKalmanFilter(GaussianPhysicsFilter):
    """The extended Kalman filter of a known system.

    Args:
        system, observation_noise_std, observed, hint, prior: as of `PhysicsFilter`.

    Example:
        >>> ExtendedKalmanFilter(system=Pendulum(), observation_noise_std=0.1).fit(train)  # doctest: +SKIP
    """

    def _transform(self, function: Function, mean: Array, covariance: Array) -> Moments:
        y, J = jacobian(function, mean)
        cross = covariance @ J.swapaxes(1, 2)
        return Moments(y, J @ cross, cross)

    def _expect(self, belief: Array) -> Array:
        return self._sensed(self._state(belief).mean)

    def _correct(self, belief: Array, z: Array) -> Array:
        present = ~np.isnan(z)
        if not present.any():
            return belief
        mean, P = self._state(belief)
        expected, H = jacobian(self._sensed, mean)
        H = H * present[:, :, None]
        R = np.where(present, self._set.noise_variance, 1.0)[:, :, None] * np.eye(z.shape[1])
        cross = P @ H.swapaxes(1, 2)
        gain = gain_of(cross, H @ cross + R)
        error = np.where(present, z - expected, 0.0)
        keep = np.eye(mean.shape[1]) - gain @ H
        left = keep @ P @ keep.swapaxes(1, 2) + gain @ R @ gain.swapaxes(1, 2)
        return self._joined(mean + np.einsum("nij,nj->ni", gain, error), left, 1.0)


def jacobian(function: Function, at: Array) -> tuple[Array, Array]:
    """Values (n, e) and derivatives (n, e, d) at rows (n, d), in one call of the function."""
    d = at.shape[1]
    step = STEP * np.maximum(1.0, np.abs(at))
    points = np.repeat(at[:, None], 2 * d + 1, axis=1)
    i = np.arange(d)
    points[:, 1 + i, i] += step
    points[:, 1 + d + i, i] -= step
    width = points[:, 1 + i, i] - points[:, 1 + d + i, i]  # as rounded
    y = function(points)
    slope: Array = ((y[:, 1 : d + 1] - y[:, d + 1 :]) / width[:, :, None]).swapaxes(1, 2)
    return y[:, 0], slope
