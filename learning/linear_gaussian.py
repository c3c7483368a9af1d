"""`LinearGaussianSystem`: a linear dynamical system with Gaussian noise, and its stationary Kalman filter.

    s_{t+1} = A s_t + eps_s,   eps_s ~ N(0, Q),        x_t = C s_t + eps_x,   eps_x ~ N(0, R)          (Eq. 3.34)

Its predictor knows E[s_t | x_0 .. x_{t-1}]. With the predicted covariance P it has the gain and innovation covariance

    K = A P C' S^-1,           S = C P C' + R,

and the limit of P over time, where there is one, solves the Riccati equation P = A P A' - K S K' + Q.

References: thesis proposal, Sec. 3.3.4; Anderson & Moore, "Optimal filtering", 1979, Secs. 3.1, 4.4 and 9.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import (
    LinAlgError,
    cholesky,
    qr,
    solve_discrete_are,
    solve_discrete_lyapunov,
    solve_triangular,
)

from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
ASYMMETRY = 1e-8  # a covariance may differ from its transpose by this share of the deviations, as rounding
NEGATIVE = 1e-10  # a correlation matrix may have eigenvalues this far below 0, as rounding
RICCATI_RESIDUAL = (
    1e-8  # share of P by which the equation may be missed before the recursion is asked instead
)
RICCATI_STEPS = 20_000
RICCATI_CHANGE = 1e-12  # the recursion has arrived where a step changes P by less than this share


class StationaryGain(NamedTuple):
    """What the stationary Kalman predictor needs.

    Attributes:
        gain: K (n_states, n_obs). innovation_covariance: S (n_obs, n_obs). predicted_covariance: P (n_states, n_states)
            of s_t given x_0 .. x_{t-1}.
    """

    gain: Array
    innovation_covariance: Array
    predicted_covariance: Array


class WhitenedObservation(NamedTuple):
    """The observation as y = W x = G s + N(0, I), of at most n_states components, and what is left of it.

    With R = L L' and L^-1 C = U G (U with orthonormal columns), y = U' L^-1 x says all that x says of s. So a filter
    inverts matrices of the state's size however many components are observed, and of whatever units.

    Attributes:
        matrix: G (r, n_states). projection: W (r, n_obs). whitening: L^-1 (n_obs, n_obs). basis: U (n_obs, r).
    """

    matrix: Array
    projection: Array
    whitening: Array
    basis: Array


@dataclass(frozen=True, init=False, eq=False, repr=False)
class LinearGaussianSystem:
    """A linear-Gaussian state-space model, checked once and read-only.

    Args:
        transition_matrix: A (n_states, n_states).
        observation_matrix: C (n_obs, n_states).
        transition_covariance: Q (n_states, n_states), positive semidefinite.
        observation_covariance: R (n_obs, n_obs), positive definite.
        initial_mean: (n_states,) E[s_0]; zeros by default.
        initial_covariance: (n_states, n_states) Cov[s_0]; by default the stationary one, where A is stable.

    Raises:
        ValueError: shapes, NaN or infinities, a matrix that is no covariance, or no initial covariance for an A that
            has no stationary distribution.
    """

    transition_matrix: Array
    observation_matrix: Array
    transition_covariance: Array
    observation_covariance: Array
    initial_mean: Array
    initial_covariance: Array

    def __init__(
        self,
        transition_matrix: ArrayLike,
        observation_matrix: ArrayLike,
        transition_covariance: ArrayLike,
        observation_covariance: ArrayLike,
        *,
        initial_mean: ArrayLike | None = None,
        initial_covariance: ArrayLike | None = None,
    ) -> None:
        A = np.array(transition_matrix, dtype=np.float64)
        if A.ndim != 2 or A.shape[0] != A.shape[1] or not len(A):
            raise ValueError(f"transition_matrix: expected shape (n_states, n_states), got {A.shape}")
        n = len(A)
        C = np.array(observation_matrix, dtype=np.float64)
        if C.ndim != 2 or C.shape[1] != n or not len(C):
            raise ValueError(f"observation_matrix: expected shape (n_obs, {n}), got {C.shape}")
        self._set("transition_matrix", A)
        self._set("observation_matrix", C)
        self._set("transition_covariance", _covariance("transition_covariance", transition_covariance, n))
        R = _covariance("observation_covariance", observation_covariance, len(C))
        try:
            cholesky(R, lower=True)
        except LinAlgError:
            raise ValueError(
                "observation_covariance: expected a positive definite matrix, got one that is singular; give exact "
                "sensors a small variance"
            ) from None
        self._set("observation_covariance", R)
        mean = np.zeros(n) if initial_mean is None else np.array(initial_mean, dtype=np.float64)
        if mean.shape != (n,):
            raise ValueError(f"initial_mean: expected shape ({n},), got {mean.shape}")
        self._set("initial_mean", mean)
        if initial_covariance is None:
            initial_covariance = self._stationary_state_covariance(self.transition_covariance)
        self._set("initial_covariance", _covariance("initial_covariance", initial_covariance, n))

    @property
    def n_states(self) -> int:
        """Components of a state."""
        return self.observation_matrix.shape[1]

    @property
    def n_obs(self) -> int:
        """Components of an observation."""
        return self.observation_matrix.shape[0]

    @property
    def spectral_radius(self) -> float:
        """The largest absolute eigenvalue of A; below 1 the system is stable."""
        return float(np.abs(np.linalg.eigvals(self.transition_matrix)).max())

    def sample(self, n_episodes: int, n_steps: int, rng: np.random.Generator) -> Sequences:
        """Draw trajectories of Eq. 3.34.

        Args:
            n_episodes: trajectories. n_steps: steps of each; it has n_steps + 1 observations. rng: of the noise.

        Returns:
            Observations x and true states s; no actions.
        """
        start, push = (
            covariance_factor(self.initial_covariance),
            covariance_factor(self.transition_covariance),
        )
        blur = covariance_factor(self.observation_covariance)
        s = np.empty((n_episodes, n_steps + 1, self.n_states))
        s[:, 0] = self.initial_mean + rng.standard_normal((n_episodes, self.n_states)) @ start.T
        for t in range(n_steps):
            noise = rng.standard_normal((n_episodes, self.n_states)) @ push.T
            s[:, t + 1] = s[:, t] @ self.transition_matrix.T + noise
        x = s @ self.observation_matrix.T
        x += rng.standard_normal(x.shape) @ blur.T
        return Sequences.from_observations(x, states=s)

    def sample_innovations(
        self,
        n_episodes: int,
        n_steps: int,
        rng: np.random.Generator,
        start: Literal["mean", "stationary"] = "mean",
    ) -> Sequences:
        """Draw trajectories of the stationary Kalman filter of this system, its innovations form:

            s_{t+1} = A s_t + K e_t,        x_t = C s_t + e_t,        e_t ~ N(0, S)

        as the thesis proposal's synthetic experiment does ("the sequences of observations are collected from the
        linear stationary Kalman filter of the LDS"). It does not say from which s_0.

        With start "mean", s_0 is the initial mean (0 unless given) and so is known: the stationary filter of this
        system then recovers every s_t without error, its innovations are e_t, and it is the best filter from t = 0 on,
        of expected squared error tr S at every step. With start "stationary", s_0 is drawn from the stationary
        distribution of the innovations form: the observations then have the same law as those of the system itself
        started from its stationary distribution. The stationary filter is the best in the limit only; from t = 0
        on it is the time-varying filter of the system with the stationary initial covariance.

        Args:
            n_episodes, n_steps, rng: as of `sample`. start: "mean", or "stationary" where A is stable.

        Returns:
            Observations x, and as states the s above, which are the filter's own.

        Raises:
            ValueError: no stationary gain; another start; start "stationary" where A is not stable.
        """
        K, S, _ = self.stationary_gain()
        s = np.empty((n_episodes, n_steps + 1, self.n_states))
        s[:, 0] = self.initial_mean
        if start == "stationary":
            spread = covariance_factor(self._stationary_state_covariance(K @ S @ K.T))
            s[:, 0] = rng.standard_normal((n_episodes, self.n_states)) @ spread.T
        elif start != "mean":
            raise ValueError(f'expected start to be "mean" or "stationary", got {start!r}')
        e = rng.standard_normal((n_episodes, n_steps + 1, self.n_obs)) @ covariance_factor(S).T
        for t in range(n_steps):
            s[:, t + 1] = s[:, t] @ self.transition_matrix.T + e[:, t] @ K.T
        return Sequences.from_observations(s @ self.observation_matrix.T + e, states=s)

    def stationary_gain(self) -> StationaryGain:
        """The limit of the Kalman predictor: gain, innovation covariance and predicted state covariance.

        Raises:
            ValueError: there is no limit, or it does not depend on the noise alone: a component of the state that does
                not fade is not observed, or is never disturbed.
        """
        A, C = self.transition_matrix, self.observation_matrix
        G, W, _, _ = self.whitened_observation()
        P = self._riccati_solution(G)
        K = np.linalg.solve(G @ P @ G.T + np.eye(len(G)), G @ P @ A.T).T @ W
        radius = float(np.abs(np.linalg.eigvals(A - K @ C)).max())
        if not radius < 1.0:
            raise ValueError(
                f"expected a system with a stationary filter, got one whose filter's errors do not fade (spectral "
                f"radius of A - K C {radius:g}): a component of the state that does not fade is not observed, or is "
                "never disturbed; use the time-varying filter, stationary=False"
            )
        return StationaryGain(K, symmetric(C @ P @ C.T + self.observation_covariance), P)

    def whitened_observation(self) -> WhitenedObservation:
        """The observation with unit noise and at most n_states components."""
        p = self.n_obs
        L = cholesky(self.observation_covariance, lower=True)
        whitening = solve_triangular(L, np.eye(p), lower=True)
        G = whitening @ self.observation_matrix
        if p <= self.n_states:
            return WhitenedObservation(G, whitening, whitening, np.eye(p))
        U, G = qr(G, mode="economic")
        return WhitenedObservation(G, U.T @ whitening, whitening, U)

    def _riccati_solution(self, G: Array) -> Array:
        """P = A (P - P G' (G P G' + I)^-1 G P) A' + Q, stabilising where there is one."""
        A, Q = self.transition_matrix, self.transition_covariance
        if not Q.any() and self.spectral_radius < 1.0:
            return np.zeros_like(Q)
        try:
            P = symmetric(solve_discrete_are(A.T, G.T, Q, np.eye(len(G))))
            residual = np.abs(predicted_covariance(P, A, Q, G) - P).max()
            if residual <= RICCATI_RESIDUAL * np.abs(P).max() + np.finfo(float).tiny:
                return P
        except (LinAlgError, ValueError):
            pass
        P = self.initial_covariance + Q
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(RICCATI_STEPS):
                before, P = P, predicted_covariance(P, A, Q, G)
                if not np.isfinite(P).all():
                    break
                if np.abs(P - before).max() <= RICCATI_CHANGE * np.abs(P).max():
                    return P
        raise ValueError(
            "expected a system with a stationary filter, got one whose predicted covariance does not settle: a "
            "component of the state that does not fade is not observed, or is never disturbed; use the time-varying "
            "filter, stationary=False"
        )

    def _stationary_state_covariance(self, noise: Array) -> Array:
        """Sigma = A Sigma A' + noise."""
        if not self.spectral_radius < 1.0:
            raise ValueError(
                f"expected a stable transition_matrix for a stationary distribution, got one of spectral radius "
                f"{self.spectral_radius:g}; pass initial_covariance, or another start"
            )
        return symmetric(solve_discrete_lyapunov(self.transition_matrix, noise))

    def _set(self, name: str, value: Array) -> None:
        if not np.isfinite(value).all():
            raise ValueError(f"{name}: expected finite numbers, got {value.tolist()}")
        value.setflags(write=False)
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"LinearGaussianSystem(n_states={self.n_states}, n_obs={self.n_obs})"


def filter_gain(P: Array, G: Array) -> tuple[Array, Array]:
    """What an observation y = G s + N(0, I) says of s ~ N(., P): the gain's transpose, and the covariance left.

    Args:
        P: (..., n, n). G: (r, n).

    Returns:
        (G P G' + I)^-1 G P (..., r, n), and (I - k G) P (I - k G)' + k k' (..., n, n), Joseph's form, which stays
        positive semidefinite.
    """
    GP = G @ P
    gain = np.asarray(np.linalg.solve(GP @ G.T + np.eye(len(G)), GP), dtype=np.float64)
    gain_t = np.swapaxes(gain, -1, -2)
    left = np.eye(P.shape[-1]) - gain_t @ G
    return gain, left @ P @ np.swapaxes(left, -1, -2) + gain_t @ gain


def predicted_covariance(P: Array, A: Array, Q: Array, G: Array) -> Array:
    """One step of the Riccati recursion, (..., n, n) -> (..., n, n), for observations y = G s + N(0, I)."""
    return symmetric(A @ filter_gain(P, G)[1] @ A.T + Q)


def symmetric(matrix: Array) -> Array:
    """The symmetric part of (..., n, n)."""
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


def covariance_factor(covariance: Array) -> Array:
    """F with F F' = covariance, which may be singular and of components of any scale."""
    d = np.sqrt(np.diag(covariance))
    scale = np.where(d > 0, d, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return d[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def _covariance(name: str, value: ArrayLike, size: int) -> Array:
    """A symmetric positive semidefinite (size, size), or the message why not."""
    matrix = np.array(value, dtype=np.float64)
    if matrix.shape != (size, size):
        raise ValueError(f"{name}: expected shape {(size, size)}, got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name}: expected finite numbers, got {matrix.tolist()}")
    variance = np.diag(matrix)
    if (variance < 0).any():
        raise ValueError(f"{name}: expected variances of at least 0, got {variance.tolist()}")
    deviation = np.sqrt(variance)
    scale = np.outer(deviation, deviation)
    if (np.abs(matrix - matrix.T) > ASYMMETRY * scale).any():
        raise ValueError(f"{name}: expected a symmetric matrix, got {matrix.tolist()}")
    matrix = symmetric(matrix)
    least = np.linalg.eigvalsh(np.divide(matrix, scale, out=matrix.copy(), where=scale > 0))[0]
    if least < -NEGATIVE * size:
        raise ValueError(
            f"{name}: expected a positive semidefinite matrix, got one whose correlations have the eigenvalue {least:g}"
        )
    return matrix
