"""`ParticleFilter`: a belief as a cloud of weighted states, the bootstrap filter.

    s^i <- step(s^i, a_{t-1}, eps^i),      w^i <- w^i prod_j exp(-(x_j - h_j(s^i))^2 / (2 R_j)) / sum

Before a step, a cloud whose effective size 1 / sum (w^i)^2 is below `resample_below` n_particles is drawn anew from its
weights by systematic resampling: with one u uniform in 0..1, particle i is taken as often as the points (u + k) /
n_particles fall into its part of the cumulated weights. What is missing of x does not weigh. Weights are kept as
logarithms, so that an observation however unlikely leaves the nearest particles, not none.

Where sensors are clipped to limits, an observation at one tells no more than that the sensor was there or beyond: its
weight is the probability of that, Phi((h_j(s) - high_j) / sqrt R_j) or Phi((low_j - h_j(s)) / sqrt R_j).

It is right for any belief, also of several peaks, as the number of particles grows. A component of the state that has
no noise, such as an unknown mass, keeps only the values drawn at the start; `roughening` moves them.

References: Gordon, Salmond & Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state estimation", 1993 (with
the roughening); Kitagawa, "Monte Carlo filter and smoother", 1996; Doucet & Johansen, "A tutorial on particle filtering
and smoothing", 2009.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr

from beliefgym.envs.estimators.physics_filter import PhysicsFilter, StateEstimate
from beliefgym.envs.estimators.physics_setup import Parameters
from beliefgym.envs.system import System
from beliefgym.learning.filters import check_whole
from beliefgym.learning.linear_gaussian import covariance_factor

Array = NDArray[np.float64]


class ParticleFilter(PhysicsFilter):
    """The bootstrap particle filter of a known system.

    A belief is n_particles states, one after the other, their log weights, and 0 before any update or 1. The random
    numbers are drawn from one generator, which every `initial_belief` sets back to `random_state`: the same calls after
    it give the same numbers. Rows draw one after the other, so that a row's numbers depend on the rows beside it.
    `predict_observation` and `forecast` leave the generator as it is.

    The prior is normal; draws outside the system's possible states are taken to the nearest possible one.

    Args:
        system, observation_noise_std, observed, hint, prior: as of `PhysicsFilter`.
        n_particles: at least 2.
        resample_below: share of n_particles, in 0..1; 0 never resamples, 1 does at every step.
        roughening: K of Gordon et al.: each resampled particle moves by a normal number of standard deviation
            K E n_particles^(-1/n_state), E the range of the component over the particles before. 0 for none.
        clipped_to: (low, high) that the observations, noise and all, are clipped to, each one number or (n_obs,); None
            where they are not.
        random_state: seed or generator; of a generator a copy is used. None is different every time.

    Example:
        >>> ParticleFilter(system=Pendulum(), observation_noise_std=0.1).fit(train)  # doctest: +SKIP
    """

    _rng: np.random.Generator
    _told_impossible = False

    def __init__(
        self,
        *,
        system: System,
        observation_noise_std: float | tuple[float, ...],
        observed: tuple[str, ...] | None = None,
        hint: str | tuple[str, ...] = "hint",
        prior: tuple[ArrayLike, ArrayLike] | None = None,
        n_particles: int = 1000,
        resample_below: float = 0.5,
        roughening: float = 0.0,
        clipped_to: tuple[ArrayLike, ArrayLike] | None = None,
        random_state: int | np.random.Generator | None = 0,
    ) -> None:
        super().__init__(
            system=system,
            observation_noise_std=observation_noise_std,
            observed=observed,
            hint=hint,
            prior=prior,
        )
        self.n_particles = n_particles
        self.resample_below = resample_below
        self.roughening = roughening
        self.clipped_to = clipped_to
        self.random_state = random_state

    @property
    def belief_size(self) -> int:
        """n_particles (n_state + 1) + 1."""
        self._check_fitted()
        return int(self.n_particles) * (self.system.n_state + 1) + 1

    def initial_belief(self, n: int = 1) -> Array:
        """Clouds drawn from the prior, another for each row, after setting the generator back."""
        self._check_fitted()
        self._rng = self._generator()
        return self._drawn(n, self._rng)

    def effective_size(self, belief: ArrayLike) -> Array:
        """(n,) 1 / sum of squared weights: n_particles where all weigh the same, 1 where one has all."""
        return effective_size(self._split(self._checked_belief(belief))[1])

    def _initial(self) -> Array:
        return self._drawn(1, self._generator())[0]

    def _generator(self) -> np.random.Generator:
        return np.random.default_rng(copy.deepcopy(self.random_state))

    def _drawn(self, n: int, rng: np.random.Generator) -> Array:
        count, size = int(self.n_particles), self.system.n_state
        factor = covariance_factor(self.prior_.covariance[0])
        states = self.prior_.mean + rng.standard_normal((n, count, size)) @ factor.T
        return self._joined(self._possible(states), np.full((n, count), -np.log(count)), 0.0)

    def _predict(self, belief: Array, action: Array) -> Array:
        states, log_weights = self._split(belief)
        states, log_weights = self._resampled(states, log_weights)
        n, count, size = states.shape
        q = self.system.noise_size
        noise = self._rng.standard_normal((n * count, q)) if q else None
        with np.errstate(over="ignore", invalid="ignore"):
            moved = self.system.step(states.reshape(-1, size), np.repeat(action, count, axis=0), noise)
        moved = moved.reshape(n, count, size)
        lost = ~np.isfinite(moved).all(axis=2)
        if lost.any():  # they left what the system can simulate; they stay, with no weight
            moved = np.where(lost[:, :, None], states, moved)
            log_weights = self._normalised(np.where(lost, -np.inf, log_weights))
        return self._joined(moved, log_weights, 1.0)

    def _correct(self, belief: Array, z: Array) -> Array:
        present = ~np.isnan(z)
        if not present.any():
            return belief
        states, log_weights = self._split(belief)
        with np.errstate(over="ignore", invalid="ignore"):
            sensed = self._sensed(states)
            error = np.where(present[:, None], z[:, None] - sensed, 0.0)
            each = -0.5 * np.square(error) / self._set.noise_variance
            if self.clipped_to is not None:
                self._weigh_limits(each, sensed, z)
            likelihood = each.sum(axis=2)
            following = log_weights + np.where(np.isnan(likelihood), -np.inf, likelihood)
        return self._joined(states, self._normalised(following), 1.0)

    def _weigh_limits(self, each: Array, sensed: Array, z: Array) -> None:
        """Put the log-probability of a limit, over the density's factor, where an observation is at one; in place."""
        assert self.clipped_to is not None
        std = np.sqrt(self._set.noise_variance)
        for limit, sign in zip(self.clipped_to, (-1.0, 1.0), strict=True):
            at = np.broadcast_to(np.asarray(limit, dtype=np.float64), z.shape[1:])
            row, component = np.nonzero(z >= at if sign > 0 else z <= at)
            beyond = sign * (sensed[row, :, component] - at[component, None]) / std[component, None]
            each[row, :, component] = log_ndtr(beyond)

    def _expect(self, belief: Array) -> Array:
        states, log_weights = self._split(belief)
        return weighted_mean(self._sensed(states), np.exp(log_weights))

    def _forecast(self, belief: Array, horizon: int, actions: Array | None = None) -> Array:
        kept = self._rng
        self._rng = copy.deepcopy(kept)
        try:
            return super()._forecast(belief, horizon, actions)
        finally:
            self._rng = kept

    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        return self._moments(belief, self._hint)

    def _moments(self, belief: Array, function: Callable[[Array], Array]) -> tuple[Array, Array]:
        states, log_weights = self._split(belief)
        values, weights = function(states), np.exp(log_weights)
        mean = weighted_mean(values, weights)
        return mean, np.sqrt(weighted_mean(np.square(values - mean[:, None]), weights))

    def _state(self, belief: Array) -> StateEstimate:
        states, log_weights = self._split(belief)
        weights = np.exp(log_weights)
        mean = weighted_mean(states, weights)
        deviation = states - mean[:, None]
        covariance = (weights[:, :, None] * deviation).swapaxes(1, 2) @ deviation
        return StateEstimate(self._possible(mean), covariance)

    def _resampled(self, states: Array, log_weights: Array) -> tuple[Array, Array]:
        """Clouds of even weights where they had become uneven."""
        count = int(self.n_particles)
        rows = np.flatnonzero(effective_size(log_weights) < self.resample_below * count)
        if not len(rows):
            return states, log_weights
        spread = np.ptp(states[rows], axis=1, keepdims=True)
        chosen = systematic(np.exp(log_weights[rows]), self._rng.random(len(rows)))
        states, log_weights = states.copy(), log_weights.copy()
        states[rows] = np.take_along_axis(states[rows], chosen[:, :, None], axis=1)
        log_weights[rows] = -np.log(count)
        if self.roughening > 0:
            width = self.roughening * count ** (-1.0 / states.shape[2]) * spread
            moved = states[rows] + width * self._rng.standard_normal((len(rows), *states.shape[1:]))
            states[rows] = self._possible(moved)
        return states, log_weights

    def _normalised(self, log_weights: Array) -> Array:
        """Weights that sum to 1; even ones where none is left, which is told once."""
        top = log_weights.max(axis=1, keepdims=True)
        none = ~np.isfinite(top[:, 0])
        if none.any():
            log_weights = np.where(none[:, None], 0.0, log_weights)
            top = np.where(none[:, None], 0.0, top)
            if not self._told_impossible:
                self._told_impossible = True
                warnings.warn(
                    f"no particle can have made an observation (row {int(np.flatnonzero(none)[0])} of the batch): all "
                    "its weights are made even again; this is told once. Observations unlike the system's, or "
                    "particles that it cannot simulate, do that",
                    stacklevel=2,
                )
        shifted = log_weights - top
        normal: Array = shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True))
        return normal

    def _split(self, belief: Array) -> tuple[Array, Array]:
        """States (n, n_particles, n_state) and log weights (n, n_particles)."""
        count = int(self.n_particles)
        return belief[:, : -count - 1].reshape(len(belief), count, -1), belief[:, -count - 1 : -1]

    def _joined(self, states: Array, log_weights: Array, seen: float) -> Array:
        n = len(states)
        return np.concatenate([states.reshape(n, -1), log_weights, np.full((n, 1), seen)], axis=1)

    def _checked(self) -> Parameters:
        setting = super()._checked()
        check_whole("n_particles", self.n_particles, 2)
        if not 0 <= self.resample_below <= 1:
            raise ValueError(f"expected resample_below in 0..1, got {self.resample_below!r}")
        if not 0 <= self.roughening < np.inf:
            raise ValueError(f"expected roughening finite and at least 0, got {self.roughening!r}")
        if self.clipped_to is not None:
            low, high = (np.asarray(limit, dtype=np.float64) for limit in self.clipped_to)
            n_obs = len(setting.observed)
            if low.shape not in ((), (n_obs,)) or high.shape not in ((), (n_obs,)) or not (low < high).all():
                raise ValueError(
                    f"expected clipped_to as (low, high), each one number or {n_obs}, low below high, got "
                    f"{self.clipped_to!r}"
                )
        self._told_impossible = False
        return setting


def effective_size(log_weights: Array) -> Array:
    """(n, n_particles) -> (n,) 1 / sum w^2."""
    size: Array = 1.0 / np.exp(2.0 * log_weights).sum(axis=1)
    return size


def systematic(weights: Array, start: Array) -> NDArray[np.intp]:
    """Systematic resampling of every row at once.

    Args:
        weights: (n, k) that sum to 1. start: (n,) u, in 0 <= u < 1.

    Returns:
        (n, k) which particle stands at each place; each is there floor(k w) or ceil(k w) times.
    """
    n, k = weights.shape
    total = np.cumsum(weights, axis=1)
    total = total / total[:, -1:]
    upto = np.ceil(k * total - start[:, None]).astype(
        np.intp
    )  # points (u + j) / k below the cumulated weight
    upto[:, -1] = k
    times = np.diff(np.clip(upto, 0, k), axis=1, prepend=0)
    return np.repeat(np.tile(np.arange(k), n), times.ravel()).reshape(n, k)


def weighted_mean(values: Array, weights: Array) -> Array:
    """(n, k, d), (n, k) that sum to 1 -> (n, d)."""
    mean: Array = (weights[:, None] @ values)[:, 0]
    return mean
