"""`InstrumentalVariableRegression`: a predictive state filter learned by two stages of regression (IVR).

    psi_t = x_t .. x_{t+k-1}            the future,  m_t = E[psi_t | x_0 .. x_{t-1}] the predictive state
    xi_t  = x_t .. x_{t+k}              the extended future,  p_t = E[xi_t | x_0 .. x_{t-1}]
    h_t   = 1, x_{t-1} .. x_{t-n}       features of the history, the instruments

    S1A:  m~_t = E[psi_t | h_t],    S1B:  p~_t = E[xi_t | h_t]      regressions on the history
    S2:   p~_t = W m~_t + w                                         regression of the one estimate on the other

Futures overlap and share their noise, so that a regression of xi_t on psi_t itself would be biased; given the history
the estimates have no noise of the future in them. To filter, extend the state and condition on what comes. For
continuous observations both are Gaussian, with a covariance of xi_t given the past, Sigma, that no longer changes:

    p_t = W m_t + w,        m_{t+1} = (p_t)_{1..k} + K (x_t - (p_t)_0),        K = Sigma_{1..k, 0} Sigma_{00}^{-1}

with blocks 0 .. k of n_obs numbers, which is a linear system in innovations form: W_shift m_t + K (x_t - W_obs m_t).

Rank r: with m~_t = U_r U_r' m~_t of the leading singular vectors of the first stage's estimates (about their mean), the
belief is s_t = U_r' (m_t - mean), and the same equations hold for s_t.

Reference: Hefny, Downey & Gordon, "Supervised learning for dynamical system learning", NIPS 2015, Secs. 2 and 3 and
their Kalman filter with constant gain; thesis proposal, Sec. 3.3.4, the baseline IVR.

Here and there:
- Sigma is the covariance of what the regression S1B leaves, that of a filter which has seen n observations, where the
  paper solves for the stationary covariance of a Kalman filter;
- 1e-10 of the covariance without any history is added to it: where there is no noise, K is still one that forgets m_0;
- m_0 is the mean of the first futures of the training trajectories and of one more at the mean of all futures: the
  first future of a single trajectory says little of another one's.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filters import check_whole
from beliefgym.learning.linear_filter import LinearFilter, SystemMatrices, ranks_to_try
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.window_projections import ROUNDING, scaled_svd, tell_few_windows, window_triangle

Array = NDArray[np.float64]
FLOOR = 1e-10  # share of the covariance without history that is added to that given the history
SINGULAR = 1e-13  # eigenvalues of a correlation matrix below this share of the largest are rounding


class InstrumentalVariableRegression(LinearFilter):
    """Two-stage regression with linear regressions, filtering with a constant gain.

    Args:
        n_future: k, observations in a predictive state.
        n_past: n, observations in the features of the history; None for 2 n_future.
        rank: r; several to choose from, by the lowest one-step error on the validation trajectories, all from one
            decomposition; None for the full k n_obs, whose filter of noisy data may be unstable.
        ridge: penalty a sample of both stages, at least 0; of the first on features of unit variance. Without it,
            directions that the data do not have are left out (pseudo-inverse).
        standardise: bring components to one scale: True each by its own standard deviation, "together" all by one
            number (components of one unit), False not. The ranks are chosen in these units.
        belief_limit: bound of a belief's components, as a multiple of those of the training futures.

    Attributes:
        rank_: r as used. system_matrices_: the filter of s_t, see `SystemMatrices`.
        singular_values_: of the first stage's estimates. errors_by_rank_: {r: one-step error}.

    Example:
        >>> InstrumentalVariableRegression(rank=range(1, 31)).fit(train, validation).rank_  # doctest: +SKIP
    """

    def __init__(
        self,
        *,
        n_future: int = 5,
        n_past: int | None = None,
        rank: int | Sequence[int] | None = None,
        ridge: float = 0.0,
        standardise: Standardise = True,
        belief_limit: float = 3.0,
    ) -> None:
        self.n_future = n_future
        self.n_past = n_past
        self.rank = rank
        self.ridge = ridge
        self.standardise = standardise
        self.belief_limit = belief_limit

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Both regressions, and where several ranks are asked for, the choice.

        Args:
            train: trajectories; those of fewer than n_past + n_future + 1 observations are left out of the
                regressions, and told.
            validation: trajectories to choose the rank on. Without them those to train on choose.

        Raises:
            ValueError: no trajectory long enough, nothing that varies, parameters out of range. TypeError: not
                `Sequences`.
        """
        check_whole("n_future", self.n_future, 1)
        if self.n_past is not None:
            check_whole("n_past", self.n_past, 1)
        if not (np.isfinite(self.ridge) and self.ridge >= 0):
            raise ValueError(f"expected ridge finite and at least 0, got {self.ridge!r}")
        k, n_past = self.n_future, 2 * self.n_future if self.n_past is None else self.n_past
        self._begin(train, validation)
        y = self._deviations(train)
        d = y.shape[2]
        triangle, n_windows = window_triangle(y, train.lengths, n_past + k + 1, "n_past + n_future + 1")
        tell_few_windows(n_windows, n_past * d, "n_past")
        mean = triangle[0, 1 + n_past * d :] / triangle[0, 0]  # of the extended future
        history, extended = triangle[1:, 1 : 1 + n_past * d], triangle[1:, 1 + n_past * d :]
        estimates = _first_stage(history, extended, self.ridge)
        gain = _gain(extended - estimates, extended, d)
        unit = np.tile(y[train.observation_mask].std(axis=0) if self.rank is None else np.ones(d), k)
        left, values, right = np.linalg.svd(estimates[:, : k * d] / unit, full_matrices=False)
        self.singular_values_ = values
        there = int((values > ROUNDING * values.max(initial=0.0)).sum())
        if self.rank is None and there:
            ranks = [there]
        else:
            limit = f"n_future * {d} observations that vary"
            ranks = ranks_to_try("rank", self.rank, there, k * d, limit)
        starts = train.lengths + 1 >= k
        first = (y[starts, :k].reshape(-1, k * d) - mean[:-d]).sum(axis=0) / (starts.sum() + 1)

        def second_stage(rank: int) -> tuple[Array, Array]:
            """W, (k d + d, size), and the directions U_r of the state, (k d, size)."""
            regression = (left[:, :rank] * (values[:rank] / (values[:rank] ** 2 + self.ridge))).T @ estimates
            if self.rank is None:
                return regression.T @ right[:rank] / unit, np.eye(k * d)
            return regression.T, right[:rank].T

        def build(rank: int) -> SystemMatrices:
            w, u = second_stage(rank)
            self._extension, self._mean = w, mean
            drift = u.T @ (mean[d:] - mean[:-d])
            return self._system(u.T @ w[d:], w[:d], u.T @ gain, drift, mean[:d], u.T @ first)

        chosen = self._choose(ranks, build, train, validation)
        if chosen is None:
            raise ValueError(f"found no filter with finite errors of the ranks {ranks}; try smaller ones")
        self.rank_ = chosen
        self._extension, directions = second_stage(chosen)
        largest = _largest(y, mean, directions, train.lengths, k)
        self._bound = self.belief_limit * np.where(largest > 0, largest, 1.0)
        self._measure(train, n_past)
        radius = float(np.abs(np.linalg.eigvals(self.transition_matrix)).max())
        if radius >= 1:
            warnings.warn(
                f"the filter of rank {chosen} is unstable (spectral radius {radius:.3g}): its beliefs are kept within "
                f"{self.belief_limit:g} times those of the training futures; other ranks, chosen on validation "
                "trajectories, or a ridge may give a stable one",
                stacklevel=2,
            )
        self._note_beliefs(train)
        return self

    def _forecast(self, belief: Array, horizon: int) -> Array:
        """An extended state forecasts k + 1 observations; further ahead, predictions are taken for what comes."""
        k = self.n_future
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        predicted[:, : k + 1] = self._extended(belief)[:, :horizon]
        for step in range(k + 1, horizon):
            belief = self._advance(belief, self._observe(belief))
            predicted[:, step] = self._extended(belief)[:, k]
        return predicted

    def _extended(self, belief: Array) -> Array:
        """p_t: (n, belief_size) -> (n, k + 1, n_obs)."""
        blocks = (len(belief), self.n_future + 1)
        extended = np.tile(self._centre, (*blocks, 1))
        extended[:, :, self._varying] += (belief @ self._extension.T + self._mean).reshape(*blocks, -1)
        return extended


def _first_stage(history: Array, extended: Array, ridge: float) -> Array:
    """p~ (rows, (k + 1) d), the projection of the extended future on the history."""
    left, values, _, _ = scaled_svd(history)
    return left @ ((values**2 / (values**2 + ridge))[:, None] * (left.T @ extended))


def _gain(residuals: Array, extended: Array, d: int) -> Array:
    """K (k d, d), from what the first stage leaves of the extended future."""
    given, without = residuals.T @ residuals, extended.T @ extended
    covariance = given + FLOOR * without
    size = np.sqrt(np.diag(without)[:d])
    size[size == 0] = 1.0
    correlation = covariance[:d, :d] / np.outer(size, size)
    inverse = np.linalg.pinv(correlation, rcond=SINGULAR, hermitian=True) / np.outer(size, size)
    return covariance[d:, :d] @ inverse


def _largest(y: Array, mean: Array, directions: Array, lengths: NDArray[np.int64], k: int) -> Array:
    """The largest U_r' (f_t - mean) of all complete futures, in size: (n_episodes, n_rows, d) -> (r,)."""
    d, n_starts = y.shape[2], y.shape[1] + 1 - k
    states = np.zeros((len(y), n_starts, directions.shape[1]))
    for j in range(k):
        block = slice(j * d, (j + 1) * d)
        states += (y[:, j : j + n_starts] - mean[block]) @ directions[block]
    complete = np.arange(n_starts) < (lengths + 2 - k)[:, None]
    return np.abs(states[complete]).max(axis=0)
