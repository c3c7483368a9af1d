"""`UnscentedKalmanFilter`: a Gaussian belief moved through the physics at well-chosen points.

    chi_0 = m,  chi_{+-i} = m +- sqrt(d + lambda) L_i,      L L' = P,   lambda = alpha^2 (d + kappa) - d
    mu = sum W^m_i f(chi_i),     e_i = f(chi_i) - mu,     S_y = sum W^c_i e_i e_i',     C = sum W^c_i (chi_i - m) e_i'
    W^m_0 = lambda / (d + lambda),  W^c_0 = W^m_0 + 1 - alpha^2 + beta,  W_i = 1 / (2 (d + lambda))

Points and weights are the library filterpy's (Van der Merwe's scaled set); the sums go over all rows at once. New
points are drawn after the step and after its noise was added, as filterpy does. Where the system's noise is more than
added to the state (it acts through the action, a disturbance, or a projection), the points are of state and noise
together.

References: Julier & Uhlmann, "Unscented filtering and nonlinear estimation", 2004; Van der Merwe, "Sigma-point Kalman
filters for probabilistic inference in dynamic state-space models", 2004; thesis proposal, Sec. 3.4.3.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.estimators.gaussian_filter import (
    Function,
    GaussianPhysicsFilter,
    Moments,
    covariance_root,
)
from beliefgym.envs.estimators.physics_setup import Parameters
from beliefgym.envs.system import System

Array = NDArray[np.float64]


class UnscentedKalmanFilter(GaussianPhysicsFilter):
    """The unscented Kalman filter of a known system.

    Sigma points that lie outside the system's possible states (a negative mass, a quaternion of another norm) are taken
    for the possible state nearest to them.

    Args:
        system, observation_noise_std, observed, hint, prior: as of `PhysicsFilter`.
        alpha: spread of the points, above 0. At 1 a point's distance is that of the plain transform; a small one makes
            it a linearisation, with a large negative weight in the middle. Points lie alpha sqrt(d + kappa) deviations
            away, which for a state of dozens of components may be too far for what they are to describe.
        beta: what is added to the middle point's weight in covariances. Van der Merwe has 2, with a small alpha.
        kappa: None for max(3 - d, 0), d the number of state (and noise) components. With beta = 0, kappa = 3 - d has
            the fourth moments of a Gaussian, but a negative weight for d > 3, with which covariances can stop being
            positive. So there it is 0, the cubature rule, whose weights are never negative.

    Example:
        >>> UnscentedKalmanFilter(system=Pendulum(), observation_noise_std=0.1).fit(train)  # doctest: +SKIP

    Raises:
        ImportError: at `fit` or `of`, without filterpy.
    """

    def __init__(
        self,
        *,
        system: System,
        observation_noise_std: float | tuple[float, ...],
        observed: tuple[str, ...] | None = None,
        hint: str | tuple[str, ...] = "hint",
        prior: tuple[ArrayLike, ArrayLike] | None = None,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float | None = None,
    ) -> None:
        super().__init__(
            system=system,
            observation_noise_std=observation_noise_std,
            observed=observed,
            hint=hint,
            prior=prior,
        )
        self.alpha = alpha
        self.beta = beta
        self.kappa = kappa

    def _transform(self, function: Function, mean: Array, covariance: Array) -> Moments:
        unit, mean_weights, weights = sigma_points(mean.shape[1], self.alpha, self.beta, self.kappa)
        offset = unit @ covariance_root(covariance).swapaxes(1, 2)
        points = mean[:, None] + offset
        n = self.system.n_state
        inside = np.concatenate([self._possible(points[..., :n]), points[..., n:]], axis=2)
        y = function(inside)
        y_mean = mean_weights @ y
        deviation = y - y_mean[:, None]
        weighted = weights[:, None] * deviation
        return Moments(y_mean, deviation.swapaxes(1, 2) @ weighted, offset.swapaxes(1, 2) @ weighted)

    def _checked(self) -> Parameters:
        setting = super()._checked()
        for name in ("alpha", "beta", *(() if self.kappa is None else ("kappa",))):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"expected {name} as a finite number, got {getattr(self, name)!r}")
        if not self.alpha > 0:
            raise ValueError(f"expected alpha above 0, got {self.alpha!r}")
        size = self.system.n_state
        if self.kappa is not None and not self.kappa > -size:
            raise ValueError(f"expected kappa above {-size}, minus the number of states, got {self.kappa!r}")
        sigma_points(size, self.alpha, self.beta, self.kappa)
        return setting


@lru_cache(maxsize=64)
def sigma_points(size: int, alpha: float, beta: float, kappa: float | None) -> tuple[Array, Array, Array]:
    """filterpy's points of N(0, I) and their weights.

    Returns:
        points (2 size + 1, size), weights of the mean and weights of the covariance (2 size + 1,) each.
    """
    try:
        from filterpy.kalman import MerweScaledSigmaPoints
    except ImportError as error:
        raise ImportError(
            'UnscentedKalmanFilter needs filterpy, which is not installed: pip install "beliefgym[estimation]"'
        ) from error
    kappa = max(3.0 - size, 0.0) if kappa is None else kappa
    points = MerweScaledSigmaPoints(size, alpha=alpha, beta=beta, kappa=kappa)
    return points.sigma_points(np.zeros(size), np.eye(size)), points.Wm, points.Wc
