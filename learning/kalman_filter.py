"""`KalmanFilter`: the filter of a linear-Gaussian system, known or learned.

For the system s_{t+1} = A s_t + eps_s, x_t = C s_t + eps_x (Eq. 3.34), with the predicted state s_hat_t = E[s_t |
x_0 .. x_{t-1}] and its covariance P_t as the belief,

    s_hat_{t+1} = A s_hat_t + K_t (x_t - C s_hat_t),     x_hat_t = C s_hat_t,     K_t = A P_t C' (C P_t C' + R)^-1
    P_{t+1} = A P_t A' - K_t (C P_t C' + R) K_t' + Q

The stationary filter takes the limit of K_t from the start, and its belief is s_hat alone.

A system is learned from observations by expectation maximisation, with or without priors, or, where the trajectories
hold the states, by the regression of Sec. 3.4.3:

    A = argmin sum |A s_t - s_{t+1}|^2 + beta_1 |A|^2,     C = argmin sum |C s_t - x_t|^2 + beta_2 |C|^2
    Q = cov(A s_t - s_{t+1}),   R = cov(C s_t - x_t),   mu_0 = mean(s_0),   P_0 = cov(s_0)

Deviations from the thesis proposal, which says no more than this: observations and states are standardised, so that
the betas mean the same for every unit and the model has an offset; Q and R are the maximum of the same posterior as A
and C, which adds beta_1 A A' / N to Q and so for R, and may have a prior of their own; see `kalman_learning`.

References: Kalman, "A new approach to linear filtering and prediction problems", 1960; Anderson & Moore, "Optimal
filtering", 1979; thesis proposal, Secs. 3.3.4 and 3.4.3; for learning see `kalman_learning`.
"""

from __future__ import annotations

import time
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.dynamics import STANDARDISATIONS, Standardise
from beliefgym.learning.filters import Filter, check_finite, check_whole
from beliefgym.learning.kalman_learning import (
    Priors,
    StateMoments,
    Trajectories,
    expectation_maximisation,
    maximisation,
    subspace_start,
)
from beliefgym.learning.linear_gaussian import (
    LinearGaussianSystem,
    StationaryGain,
    filter_gain,
)
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
METHODS = ("em", "map", "known")
HISTORY = ("iteration", "log_likelihood", "log_posterior", "validation_error", "seconds")


class KalmanFilter(Filter):
    """A Kalman filter: `KalmanFilter.of(system)` of a known system, `KalmanFilter(n_states=..).fit(train)` learned.

    Args:
        n_states: components of the state; not looked at with states_from or a known system.
        method: "em" for maximum likelihood by expectation maximisation, "map" with the priors below, "known" for the
            filter of `system`, which `fit` leaves as it is.
        states_from: with method "map", the trajectories' array that holds the states, "hints" or "states": A, C, Q, R
            are then learned in one regression from these. None to learn without knowing the states.
        n_iterations: the most iterations of expectation maximisation; 0 leaves the start.
        tolerance: it stops where an iteration gains less log likelihood (posterior) than this for each number observed.
        stationary: whether the belief is the state's mean alone, with the gain of the limit; otherwise it is the mean
            and the upper triangle of the covariance, row by row, exact from the first observation on.
        standardise: bring the observations, and known states, to mean 0 and one scale; without, the model has no
            offset and expects data about 0.
        transition_penalty, observation_penalty: beta_1 and beta_2 of method "map", in standardised units; for the sum
            over all data, so that twice the data halve their effect.
        noise_weight: w of method "map": the priors of Q, R and P_0 count as so many observations.
        noise_scale: the variance of these prior observations for Q and R, as a share of the variance of the states
            (1 where they are not known) and of the observations. For P_0 it is the state's own.
        system: of method "known".
        random_state: of the part of the start that the data leave open; it matters where n_states is more than what
            windows of the data can tell apart.

    Attributes:
        system_: the `LinearGaussianSystem`, in standardised observations (and known states).
        history_: arrays, one entry an iterate, the start first: "iteration", "log_likelihood" and "log_posterior" (up
            to a constant) of the standardised training data, "validation_error" (`errors(validation).mean`; infinite
            where an iterate has no stationary filter, NaN without validation), "seconds".
        best_iteration_: the iterate that was kept.

    Example:
        >>> KalmanFilter(n_states=4).fit(train, validation).errors(test).mean  # doctest: +SKIP
    """

    _fitted_attribute = "system_"

    def __init__(
        self,
        *,
        n_states: int = 4,
        method: Literal["em", "map", "known"] = "em",
        states_from: Literal["hints", "states"] | None = None,
        n_iterations: int = 100,
        tolerance: float = 1e-6,
        stationary: bool = True,
        standardise: Standardise = True,
        transition_penalty: float = 1.0,
        observation_penalty: float = 1.0,
        noise_weight: float = 10.0,
        noise_scale: float = 0.1,
        system: LinearGaussianSystem | None = None,
        random_state: int | np.random.Generator | None = None,
    ) -> None:
        self.n_states = n_states
        self.method = method
        self.states_from = states_from
        self.n_iterations = n_iterations
        self.tolerance = tolerance
        self.stationary = stationary
        self.standardise = standardise
        self.transition_penalty = transition_penalty
        self.observation_penalty = observation_penalty
        self.noise_weight = noise_weight
        self.noise_scale = noise_scale
        self.system = system
        self.random_state = random_state

    @classmethod
    def of(cls, system: LinearGaussianSystem, stationary: bool = True) -> Self:
        """The filter of a known system, ready to use: on data of that system no other has a smaller expected error.

        The stationary one is best in the limit, and from t = 0 on for `system.sample_innovations` from the mean; the
        time-varying one is best from t = 0 on for `system.sample`.
        """
        made = cls(
            n_states=system.n_states, method="known", system=system, stationary=stationary, standardise=False
        )
        made._check_parameters()
        made._use_known()
        return made

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Learn the system.

        Args:
            train: trajectories of any lengths; actions are not looked at.
            validation: chooses among the iterates of expectation maximisation, by the filter's error one observation
                ahead; without, the last one is kept, whose likelihood (posterior) is the highest.

        Raises:
            ValueError: parameters out of range, no states where states_from asks for them, other components in
                validation than in training, or no stationary filter of what was learned.
            TypeError: not `Sequences`.
        """
        self._check_parameters()
        known = None if self.system is None or self.method != "known" else self.system.n_obs
        if known is not None and isinstance(train, Sequences) and train.n_obs != known:
            raise ValueError(
                f"expected trajectories with {known} observations as the system, got {train.n_obs}"
            )
        self._begin(train, validation)
        for attribute in ("system_", "history_", "best_iteration_"):
            self.__dict__.pop(attribute, None)
        if self.method == "known":
            self._use_known()
        elif self.states_from is not None:
            self._fit_known_states(train)
        else:
            self._fit_by_iterations(train, validation)
        self._note_beliefs(train)
        return self

    def predict_variance(self, belief: ArrayLike) -> Array:
        """The variance of each component of the next observation: (n, belief_size) -> (n, n_obs), data's units squared.

        The stationary filter's is the limit's, at every time.
        """
        b = self._checked_belief(belief)
        C, R = self.system_.observation_matrix, self.system_.observation_covariance
        P = self._limit.predicted_covariance[None] if self._limit else self._split(b)[1]
        variance = np.einsum("pi,nij,pj->np", C, P, C) + np.diag(R)
        return np.broadcast_to(variance * np.square(self._scale.scale), (len(b), self.n_obs_)).copy()

    def predict_state(self, belief: ArrayLike) -> Array:
        """The state's mean given all observations so far, E[s_t | x_0 .. x_{t-1}]: (n, belief_size) -> (n, n_states).

        In the units of the system, or of the states that it was learned from; otherwise the state's coordinates have
        no meaning.
        """
        return self._state_scale.invert(self._mean(self._checked_belief(belief)))

    def filter_state(self, belief: ArrayLike, observation: ArrayLike) -> Array:
        """The state's mean given the present observation too, E[s_t | x_0 .. x_t].

        Args:
            belief: (n, belief_size) m_t. observation: (n, n_obs) x_t.

        Returns:
            (n, n_states), in the units of `predict_state`.
        """
        b = self._checked_belief(belief)
        x = np.asarray(observation, dtype=np.float64)
        if x.shape != (len(b), self.n_obs_):
            raise ValueError(f"observation: expected shape {(len(b), self.n_obs_)}, got {x.shape}")
        check_finite("observation", x)
        P = self._limit.predicted_covariance[None] if self._limit else self._split(b)[1]
        return self._state_scale.invert(self._filtered(self._mean(b), P, self._scale.apply(x))[0])

    @property
    def transition_matrix(self) -> Array:
        """A - K C (n_states, n_states) with the gain of the limit: s_hat_{t+1} = (A - K C) s_hat_t + K x_t."""
        self._check_fitted()
        limit = self._limit or self.system_.stationary_gain()
        return self.system_.transition_matrix - limit.gain @ self.system_.observation_matrix

    @property
    def transition_eigenvalues(self) -> NDArray[np.complex128]:
        """(n_states,) those of `transition_matrix`, the largest first: how fast the filter forgets."""
        values = np.linalg.eigvals(self.transition_matrix).astype(np.complex128)
        return values[np.argsort(-np.abs(values), kind="stable")]

    def _initial(self) -> Array:
        mean = self.system_.initial_mean
        if self._limit:
            return mean
        return np.concatenate([mean, self.system_.initial_covariance[self._triangle()]])

    def _update(self, belief: Array, z: Array) -> Array:
        A = self.system_.transition_matrix
        if self._limit:
            error = z - belief @ self.system_.observation_matrix.T
            return belief @ A.T + error @ self._limit.gain.T
        mean, P = self._split(belief)
        mean, left = self._filtered(mean, P, z)
        P = A @ left @ A.T + self.system_.transition_covariance
        upper = P[(slice(None), *self._triangle())]
        return np.concatenate([mean @ A.T, np.broadcast_to(upper, (len(mean), upper.shape[1]))], axis=1)

    def _observe(self, belief: Array) -> Array:
        return self._mean(belief) @ self.system_.observation_matrix.T

    def _forecast(self, belief: Array, horizon: int) -> Array:
        """C A^h s_hat: what feeding the predictions back gives, without the covariances, which they do not move."""
        mean, A, C = self._mean(belief), self.system_.transition_matrix, self.system_.observation_matrix
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        for step in range(horizon):
            predicted[:, step] = mean @ C.T
            mean = mean @ A.T
        return predicted

    def _filtered(self, mean: Array, P: Array, z: Array) -> tuple[Array, Array]:
        """Mean (n, n_states) and covariance given z too; P is (n, n_states, n_states), or the same for all (1, ..)."""
        G, projection, _, _ = self._whitened
        gain, left = filter_gain(P, G)
        error = z @ projection.T - mean @ G.T
        return mean + (error @ gain[0] if len(P) == 1 else (error[:, None] @ gain)[:, 0]), left

    def _mean(self, belief: Array) -> Array:
        return belief[:, : self.system_.n_states]

    def _split(self, belief: Array) -> tuple[Array, Array]:
        """Means, and covariances: one (1, n_states, n_states) where all rows have the same."""
        n = self.system_.n_states
        mean, upper = belief[:, :n], belief[:, n:]
        if len(upper) > 1 and (upper == upper[0]).all():
            upper = upper[:1]
        P = np.empty((len(upper), n, n))
        rows, columns = self._triangle()
        P[:, rows, columns] = upper
        P[:, columns, rows] = upper
        return mean, P

    def _triangle(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        rows, columns = np.triu_indices(self.system_.n_states)
        return rows, columns

    def _use(self, system: LinearGaussianSystem) -> None:
        """Become the filter of this system, in standardised coordinates."""
        self._limit: StationaryGain | None = system.stationary_gain() if self.stationary else None
        self._whitened = system.whitened_observation()
        self.system_ = system

    def _use_known(self) -> None:
        system: Any = self.system
        self.n_obs_ = system.n_obs
        self._scale = Standardisation.none(np.zeros((0, system.n_obs)))
        self._state_scale = Standardisation.none(np.zeros((0, system.n_states)))
        self._use(system)

    def _fit_known_states(self, train: Sequences) -> None:
        states: Array | None = getattr(train, str(self.states_from))
        if states is None:
            raise ValueError(
                f"expected trajectories with {self.states_from}, got {train!r}; states_from=None learns without"
            )
        rows = states[train.observation_mask]
        self._state_scale = STANDARDISATIONS[self.standardise](rows)
        trajectories = Trajectories(self._scale.apply(train.observations), train.lengths)
        known = trajectories.flat(self._state_scale.apply(states))
        self._use(maximisation(StateMoments.known(known), trajectories, self._priors(trajectories, known)))

    def _fit_by_iterations(self, train: Sequences, validation: Sequences | None) -> None:
        started = time.perf_counter()
        z = self._scale.apply(train.observations)
        trajectories = Trajectories(z, train.lengths)
        priors = self._priors(trajectories, None)
        rng = np.random.default_rng(self.random_state)
        start = subspace_start(z, train.lengths, priors.observation_variance, int(self.n_states), rng)
        self._state_scale = Standardisation.none(np.zeros((0, start.n_states)))
        found: dict[str, list[float]] = {name: [] for name in HISTORY}
        best, best_error, before = start, np.inf, -np.inf
        self.best_iteration_ = 0
        for system, likelihood, posterior in expectation_maximisation(trajectories, start, priors):
            error = np.nan if validation is None else self._error_of(system, validation)
            iteration = len(found["iteration"])
            row = (iteration, likelihood, posterior, error, time.perf_counter() - started)
            for name, value in zip(HISTORY, row, strict=True):
                found[name].append(value)
            if validation is None or error < best_error:
                best, best_error, self.best_iteration_ = system, error, iteration
            gained = posterior - before
            if iteration >= self.n_iterations or gained <= self.tolerance * trajectories.rows.size:
                break
            before = posterior
        self.history_ = {name: np.array(values) for name, values in found.items()}
        self._use(best)

    def _error_of(self, system: LinearGaussianSystem, validation: Sequences) -> float:
        try:
            self._use(system)
        except ValueError:
            return np.inf
        return self.errors(validation).mean

    def _priors(self, trajectories: Trajectories, states: Array | None) -> Priors:
        """Those of method "map", or none; the scales of the noise are the data's own."""
        with_priors = self.method == "map"
        return Priors(
            transition_penalty=self.transition_penalty if with_priors else 0.0,
            observation_penalty=self.observation_penalty if with_priors else 0.0,
            weight=self.noise_weight if with_priors else 0.0,
            noise=self.noise_scale,
            state_variance=np.ones(int(self.n_states)) if states is None else _variance(states),
            observation_variance=_variance(trajectories.rows),
        )

    def _check_parameters(self) -> None:
        check_whole("n_states", self.n_states, 1)
        check_whole("n_iterations", self.n_iterations, 0)
        if self.method not in METHODS:
            raise ValueError(f"expected method to be one of {list(METHODS)}, got {self.method!r}")
        if self.states_from not in (None, "hints", "states"):
            raise ValueError(
                f'expected states_from to be "hints", "states" or None, got {self.states_from!r}'
            )
        if self.states_from is not None and self.method != "map":
            raise ValueError(
                f'expected method="map" with states_from={self.states_from!r}, got {self.method!r}; penalties and '
                "noise_weight of 0 give least squares"
            )
        for name in ("tolerance", "transition_penalty", "observation_penalty", "noise_weight", "noise_scale"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"expected {name} finite and at least 0, got {value!r}")
        if self.method == "known":
            if not isinstance(self.system, LinearGaussianSystem):
                raise ValueError(
                    f'expected a LinearGaussianSystem as system with method="known", got {self.system!r}'
                )
            if self.standardise is not False:
                raise ValueError(
                    f"expected standardise=False with a known system, got {self.standardise!r}; it is in the units of "
                    "the observations"
                )


def _variance(rows: Array) -> Array:
    """(d,) of the components about their mean; 1 for those that do not vary."""
    scale = Standardisation.of(rows)
    return np.where(scale.constant, 1.0, np.square(scale.scale))
