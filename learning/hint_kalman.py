"""`KalmanHints`: a Kalman filter whose states are the hints.

Where the hints of the training data are taken for the states, s_t = h_t, the system of Eq. 3.34 is two regressions,

    A = argmin sum |A h_t - h_{t+1}|^2 + beta_1 |A|^2,     C = argmin sum |C h_t - x_t|^2 + beta_2 |C|^2
    Q = cov(A h_t - h_{t+1}),   R = cov(C h_t - x_t),   mu_0 = mean(h_0),   Sigma_0 = cov(h_0)

and the estimate is the filtered one, which has seen the present observation, with its own standard deviation,

    h_hat_t = E[h_t | x_0 .. x_t] = m_t + K_t (x_t - C m_t),      K_t = P_t C' (C P_t C' + R)^-1,
    Sigma_t = P_t - K_t C P_t,      m_{t+1} = A h_hat_t,      P_{t+1} = A Sigma_t A' + Q.

Where components of x_t are missing, the rows of C and the rows and columns of R that belong to the others take their
place; where all are, h_hat_t = m_t and Sigma_t = P_t. That is exact, correlated noise included.

Deviation from the thesis: all is in standardised observations and hints, and Q and R are the maximum of the posterior
whose mode A and C are, which adds beta_1 A A' / N to Q and so for R (see `kalman_learning`); without penalties they are
the residuals' covariances. The system has no offset beside the data's means: what moves about another point than the
mean of its hints (short swings, all from one side) is fitted worse, and Q and R say so.

Reference: thesis proposal, Sec. 3.4.3, the baseline "Linear KF".
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filter_errors import nan_mean
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.splits import fold_indices

Array = NDArray[np.float64]
Penalties = float | Sequence[float]
GRID = (1e-4, 0.01, 1.0, 100.0, 10_000.0)
N_FOLDS = 5


class KalmanHints(HintFilter):
    """A linear Kalman filter of the hints, learned by ridge regression.

    The belief is that of the learned `KalmanFilter`, of h_{t+1}, then the filtered mean of h_t and its variances, all
    of standardised hints. Before any observation these are the first hint's.

    Args:
        transition_penalties: beta_1, the candidates; a number is the only one. For the sum over all data of
            standardised hints, so that twice the data halve its effect.
        observation_penalties: beta_2 likewise.
        hints_from: the trajectories' array that holds the hints, "hints" or "states".
        standardise: bring components to one scale: True each by its own standard deviation, "together" all by one
            number, False not; the model then has no offset and expects data about 0.
        stationary: use the gain of the limit from the start. The covariance is then not followed: it is the limit's
            at every time, after missing observations too.

    Attributes:
        kalman_: the `KalmanFilter` that was learned; its `system_` holds A, C, Q, R, mu_0 and Sigma_0.
        transition_penalty_, observation_penalty_: the pair of the lowest mean hint error, on the validation
            trajectories, or without them in cross-validation over whole training trajectories.
        penalty_errors_: (n_1, n_2) these errors; infinite for a pair whose filter diverges. NaN where there was nothing
            to choose.
        n_hint_, hint_names_, prior_mean_, prior_std_: as of `HintFilter`.

    Example:
        >>> KalmanHints().fit(train, validation).hint_errors(test).mean  # doctest: +SKIP
    """

    _fitted_attribute = "kalman_"

    def __init__(
        self,
        *,
        transition_penalties: Penalties = GRID,
        observation_penalties: Penalties = GRID,
        hints_from: Literal["hints", "states"] = "hints",
        standardise: Standardise = True,
        stationary: bool = False,
    ) -> None:
        self.transition_penalties = transition_penalties
        self.observation_penalties = observation_penalties
        self.hints_from = hints_from
        self.standardise = standardise
        self.stationary = stationary

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Choose the penalties, then learn the system from all training trajectories.

        Args:
            train: trajectories with hints, of any lengths; actions are not looked at.
            validation: chooses the penalties; without, cross-validation over the training trajectories does.

        Raises:
            ValueError: no hints, penalties out of range, too few trajectories to choose by, no pair of penalties whose
                filter gives finite estimates (with stationary: that has a limit). TypeError: not `Sequences`.
        """
        grid = self._grid("transition_penalties"), self._grid("observation_penalties")
        self.__dict__.pop("kalman_", None)
        self._begin(train, validation)
        self._begin_hints(train, validation)
        self.penalty_errors_ = np.full((len(grid[0]), len(grid[1])), np.nan)
        best = 0, 0
        if self.penalty_errors_.size > 1:
            parts = [(train, validation)] if validation is not None else list(_folds(train))
            for i, j in np.ndindex(self.penalty_errors_.shape):
                self.penalty_errors_[i, j] = self._error_of(grid[0][i], grid[1][j], parts)
            if not np.isfinite(self.penalty_errors_).any():
                raise ValueError(
                    f"expected a pair of penalties whose filter gives finite estimates, got none of "
                    f"{self.penalty_errors_.size}; pass larger ones"
                    + (", or stationary=False" if self.stationary else "")
                )
            best = divmod(int(np.argmin(self.penalty_errors_)), len(grid[1]))
        self.transition_penalty_, self.observation_penalty_ = grid[0][best[0]], grid[1][best[1]]
        kalman = KalmanFilter(
            method="map",
            states_from=self.hints_from,
            stationary=self.stationary,
            standardise=self.standardise,
            transition_penalty=self.transition_penalty_,
            observation_penalty=self.observation_penalty_,
            noise_weight=0.0,
        )
        with warnings.catch_warnings():  # `_begin` has told of constant components
            warnings.simplefilter("ignore", UserWarning)
            self.kalman_: KalmanFilter = kalman.fit(train)
        self._note_beliefs(train)
        return self

    def _initial(self) -> Array:
        system = self.kalman_.system_
        return np.concatenate(
            [self.kalman_._initial(), system.initial_mean, np.diag(system.initial_covariance)]
        )

    def _update(self, belief: Array, z: Array) -> Array:
        return self._step(belief, z, self.kalman_)

    def _follow(self, belief: Array, z: Array, action: Array | None) -> Array:
        """By what was observed of each row alone; rows that miss the same components go together."""
        seen = ~np.isnan(z)
        if seen.all():
            return self._advance(belief, z)
        following = np.empty_like(belief)
        patterns, place = np.unique(seen, axis=0, return_inverse=True)
        for i, pattern in enumerate(patterns):
            rows = np.flatnonzero(place.reshape(-1) == i)
            following[rows] = self._step(belief[rows], z[rows][:, pattern], self._seeing(pattern))
        return following

    def _observe(self, belief: Array) -> Array:
        return self.kalman_._observe(belief[:, : -2 * self.n_hint_])

    def _forecast(self, belief: Array, horizon: int) -> Array:
        return self.kalman_._forecast(belief[:, : -2 * self.n_hint_], horizon)

    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        mean, variance = belief[:, -2 * self.n_hint_ : -self.n_hint_], belief[:, -self.n_hint_ :]
        # a covariance of Joseph's form is positive up to rounding
        std = np.sqrt(np.maximum(variance, 0.0)) * self._hint_scale.scale
        return self._hint_scale.invert(mean), std

    def _step(self, belief: Array, z: Array, seeing: KalmanFilter | None) -> Array:
        """The next belief, by the filter of the components in z (n, ..), or None where there is none."""
        own, kalman = belief[:, : -2 * self.n_hint_], self.kalman_
        limit = kalman._limit
        mean, P = (own, limit.predicted_covariance[None]) if limit else kalman._split(own)
        filtered, left = (mean, P) if seeing is None else seeing._filtered(mean, P, z)
        A = kalman.system_.transition_matrix
        parts = [filtered @ A.T]
        if not limit:
            following = A @ left @ A.T + kalman.system_.transition_covariance
            parts.append(following[(slice(None), *kalman._triangle())])
        parts += [filtered, np.diagonal(left, axis1=1, axis2=2)]
        return np.concatenate([np.broadcast_to(part, (len(belief), part.shape[1])) for part in parts], axis=1)

    def _seeing(self, pattern: NDArray[np.bool_]) -> KalmanFilter | None:
        """The filter of the same system that is shown some of the components."""
        if pattern.all() or not pattern.any():
            return self.kalman_ if pattern.all() else None
        system = self.kalman_.system_
        part = LinearGaussianSystem(
            system.transition_matrix,
            system.observation_matrix[pattern],
            system.transition_covariance,
            system.observation_covariance[np.ix_(pattern, pattern)],
            initial_covariance=system.initial_covariance,
        )
        return KalmanFilter.of(part, stationary=False)

    def _error_of(
        self, transition: float, observation: float, parts: list[tuple[Sequences, Sequences]]
    ) -> float:
        """Mean hint error of a pair of penalties over the trajectories left out."""
        candidate = clone(self).set_params(transition_penalties=transition, observation_penalties=observation)
        errors = []
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", UserWarning)
            for left, out in parts:
                try:
                    norm = candidate.fit(left).hint_errors(out).norm
                except (ValueError, np.linalg.LinAlgError):
                    return np.inf
                if not np.isfinite(norm[out.observation_mask]).all():
                    return np.inf
                errors.append(nan_mean(norm, 1))
        return float(np.concatenate(errors).mean())

    def _grid(self, name: str) -> tuple[float, ...]:
        given = getattr(self, name)
        try:
            values = np.atleast_1d(np.asarray(given, dtype=np.float64))
        except (TypeError, ValueError):
            values = np.zeros(0)
        if values.ndim != 1 or not len(values) or not (np.isfinite(values) & (values >= 0)).all():
            raise ValueError(
                f"expected {name} as a number or several, each finite and at least 0, got {given!r}"
            )
        return tuple(float(value) for value in values)


def _folds(train: Sequences) -> Iterator[tuple[Sequences, Sequences]]:
    """Trajectories to fit to and trajectories left out."""
    with_steps = np.flatnonzero(train.lengths > 0)
    if len(with_steps) < 2:
        raise ValueError(
            f"expected at least 2 trajectories of at least one step to choose penalties by cross-validation, got "
            f"{len(with_steps)}; pass validation, or one transition_penalties and one observation_penalties"
        )
    for left, out in fold_indices(len(with_steps), min(N_FOLDS, len(with_steps)), 0, None):
        yield train[with_steps[left]], train[with_steps[out]]
