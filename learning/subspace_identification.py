"""`N4SID`: a linear filter from projections of futures on pasts, by stochastic subspace identification.

    s_{t+1} = A s_t + b + K (x_t - x_hat_t),     x_hat_t = C s_t + c                        (innovations form)

With i block rows, each window of 2 i observations gives its past p_t = x_{t-i} .. x_{t-1} and its future
f_t = x_t .. x_{t+i-1}, the columns of Y_p and Y_f:

    O_i = Y_f / Y_p                                         the orthogonal projection of the futures on the pasts
    W O_i = U S V'                                          singular value decomposition; of order n, S_n and V_n
    s_t = J p_t,  with J Y_p = V_n'                         states of a Kalman filter that has seen i observations
    [s_{t+1}; x_t] = [A; C] s_t + [b; c] + [rho_w; rho_v]   least squares over all windows
    [Q S; S' R] = cov [rho_w; rho_v]
    P = A P A' + Q - K (C P C' + R) K',   K = (A P C' + S) (C P C' + R)^{-1}                Riccati equation

The weight W is the identity ("n4sid") or the inverse square root of the covariance of Y_f ("cva": the singular values
are then canonical correlations, whatever the units).

References: Van Overschee & De Moor, "Subspace Identification for Linear Systems", 1996 (2012), Secs. 3.3 (weights) and
3.4 (stochastic algorithms); Larimore, "Canonical variate analysis in identification, filtering, and adaptive control",
CDC 1990; Verhaegen & Verdult, "Filtering and System Identification", 2007, Ch. 9; thesis proposal, Sec. 3.3.4, the
baseline N4SID.

Here and there:
- s_{t+1} is J p_{t+1}, the same map one observation later (Larimore; Verhaegen & Verdult). Van Overschee & De Moor
  project once more, on i + 1 observations, and divide by a shorter observability matrix: that spares A the bias of a
  finite i, but with more states than the data have it is often unstable, and the filter then bad;
- windows come from many trajectories, of any lengths, and cross none of their ends;
- deviations from the windows' means are projected, where the books have data of mean zero, and b is the means' drift:
  trajectories that start alike are not stationary;
- Van Overschee & De Moor find K from A, C and the output covariances; the Riccati equation in Q, S and R, as in
  Verhaegen & Verdult, needs no stable A;
- the filter does not start from s = 0 but from the least-squares fit to the starts of the training trajectories.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_discrete_are

from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filters import check_whole
from beliefgym.learning.linear_filter import LinearFilter, SystemMatrices, ranks_to_try
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.window_projections import ROUNDING, scaled_svd, tell_few_windows, window_triangle

Array = NDArray[np.float64]
Weighting = Literal["n4sid", "cva"]
N_STARTS = 200  # observations of each trajectory that the initial state is fitted to
# shares of the variances that are added to the noise, until the filter is stable
FLOORS = (1e-10, 1e-6, 1e-4, 1e-2, 1.0)


class N4SID(LinearFilter):
    """Subspace identification without inputs, and the steady-state Kalman filter of what was identified.

    Args:
        n_states: order n; several to choose from, or None for a grid up to 64. The choice is that of the lowest
            one-step error on the validation trajectories, all orders from one decomposition.
        n_block_rows: i. n is at most i n_obs. The system is that of a filter that has seen i observations: a slow
            filter needs a larger i, and trajectories of 2 i observations.
        weighting: "n4sid" or "cva", see above.
        standardise: bring components to one scale: True each by its own standard deviation, "together" all by one
            number (components of one unit), False not. It matters for the weighting "n4sid" alone.
        belief_limit: bound of a state's components, as a multiple of the largest in filtering the training data.

    Attributes:
        n_states_: n. system_matrices_: A, b, C, c, K and the innovations' covariance, see `SystemMatrices`; states
            have unit variance. singular_values_: all of S. errors_by_rank_: {n: one-step error}.

    Example:
        >>> N4SID(n_states=range(1, 21)).fit(train, validation).n_states_  # doctest: +SKIP
    """

    def __init__(
        self,
        *,
        n_states: int | Sequence[int] | None = None,
        n_block_rows: int = 10,
        weighting: Weighting = "n4sid",
        standardise: Standardise = True,
        belief_limit: float = 3.0,
    ) -> None:
        self.n_states = n_states
        self.n_block_rows = n_block_rows
        self.weighting = weighting
        self.standardise = standardise
        self.belief_limit = belief_limit

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Identify the system, and where several orders are asked for, choose.

        Args:
            train: trajectories; those of fewer than 2 n_block_rows observations are left out, and told.
            validation: trajectories to choose the order on. Without them those to train on choose, which favours
                large orders.

        Raises:
            ValueError: no trajectory long enough, nothing that varies, parameters out of range, or no order that gives
                a stable filter. TypeError: not `Sequences`.
        """
        check_whole("n_block_rows", self.n_block_rows, 1)
        if self.weighting not in get_args(Weighting):
            raise ValueError(f"expected weighting to be one of {get_args(Weighting)}, got {self.weighting!r}")
        self._begin(train, validation)
        y = self._deviations(train)
        unit = y[train.observation_mask].std(axis=0)
        y, d = y / unit, y.shape[2]
        triangle, n_windows = window_triangle(y, train.lengths, 2 * self.n_block_rows, "2 n_block_rows")
        tell_few_windows(n_windows, self.n_block_rows * d, "n_block_rows")
        spaces = _Projections(triangle, d, unit if self.weighting == "n4sid" else None)
        self.singular_values_ = spaces.singular_values
        limit = f"n_block_rows * {d} observations that vary"
        orders = ranks_to_try("n_states", self.n_states, spaces.rank, self.n_block_rows * d, limit)
        floors: dict[int, float] = {}

        def build(n: int) -> SystemMatrices | None:
            states, following, drift = spaces.states(n)
            targets = np.concatenate([following, spaces.now], axis=1)
            coefficients = states.T @ targets  # the states are orthonormal
            residuals = targets - states @ coefficients
            a, c = coefficients[:, :n].T, coefficients[:, n:].T
            gain, innovations, floors[n] = _steady_state_gain(
                a, c, residuals.T @ residuals, targets.T @ targets
            )
            if gain is None:
                return None
            first = _first_state(a, c, gain, drift, innovations, y[:, :N_STARTS] - spaces.mean, train.lengths)
            return self._system(a, unit[:, None] * c, gain / unit, drift, unit * spaces.mean, first)

        chosen = self._choose(orders, build, train, validation)
        if chosen is None:
            raise ValueError(
                f"found no stable filter with {orders} states; try fewer states, or other n_block_rows"
            )
        self.n_states_ = chosen
        self._bound = self.belief_limit * self._measure(train, self.n_block_rows)
        if floors[chosen] > FLOORS[0]:
            warnings.warn(
                f"the Riccati equation of the {chosen} identified states has no stabilising solution with the noise "
                f"that was found; {floors[chosen]:g} of the variances was added to it. Fewer states, or other "
                "n_block_rows, may do without",
                stacklevel=2,
            )
        self._note_beliefs(train)
        return self


class _Projections:
    """O_i in the coordinates of the triangular factor, and its decomposition.

    Args:
        triangle: of windows of 2 i observations after ones, (rows, 1 + 2 i d). d: components.
        unit: (d,) for "n4sid", the unit in which errors of each component count; None for "cva".
    """

    def __init__(self, triangle: Array, d: int, unit: Array | None) -> None:
        means, triangle = triangle[0, 1:] / triangle[0, 0], triangle[1:, 1:]
        half = triangle.shape[1] // 2
        self.now, self.mean = triangle[:, half : half + d], means[half : half + d]
        self._later, self._drift = triangle[:, d : half + d], means[d : half + d] - means[:half]
        self._past, values, right, norms = scaled_svd(triangle[:, :half])
        self._inverse = right.T / values / norms[:, None]  # of the past, (i d, r)
        projected = self._past.T @ _weighted(triangle[:, half:], unit)
        self._states, self.singular_values, _ = np.linalg.svd(projected, full_matrices=False)
        self.rank = int((self.singular_values > ROUNDING * self.singular_values.max(initial=0.0)).sum())

    def states(self, n: int) -> tuple[Array, Array, Array]:
        """s_t, its columns orthonormal, and s_{t+1}, (rows, n) each, about the mean of s_t; b (n,)."""
        chosen = self._states[:, :n]
        to_state = self._inverse @ chosen  # J'
        return self._past @ chosen, self._later @ to_state, self._drift @ to_state


def _weighted(future: Array, unit: Array | None) -> Array:
    """The futures (rows, i d) times W'."""
    return scaled_svd(future)[0] if unit is None else future * np.tile(unit, future.shape[1] // len(unit))


def _steady_state_gain(a: Array, c: Array, noise: Array, total: Array) -> tuple[Array | None, Array, float]:
    """K by the Riccati equation, with as little added to the noise as makes A - K C stable.

    Args:
        a: (n, n). c: (d, n). noise: (n + d, n + d), [Q S; S' R]. total: that of [s_{t+1}; x_t] themselves.

    Returns:
        K (n, d), None where nothing helps; the innovations' covariance (d, d); the share of `total` added.
    """
    n = len(a)
    for floor in FLOORS:
        q = noise + floor * total
        unit = np.trace(q) / len(q)  # the gain does not depend on it
        q = (q + q.T) / (2 * unit)
        r, s = q[n:, n:] + floor * np.eye(len(c)), q[:n, n:]
        try:
            p = solve_discrete_are(a.T, c.T, q[:n, :n], r, s=s)
            innovations = c @ p @ c.T + r
            gain = np.linalg.solve(innovations, (a @ p @ c.T + s).T).T
            np.linalg.cholesky(innovations)
        except (LinAlgError, ValueError):
            continue
        if np.isfinite(gain).all() and np.abs(np.linalg.eigvals(a - gain @ c)).max() < 1:
            return gain, unit * innovations, floor
    return None, np.empty((0, 0)), floor


def _first_state(
    a: Array, c: Array, gain: Array, drift: Array, covariance: Array, y: Array, lengths: NDArray[np.int64]
) -> Array:
    """The expected initial state of another trajectory, from the innovations e_t of a filter that starts from 0.

    Their means over N trajectories are C (A - K C)^t s, with s the mean of the initial states, and noise. With unit
    variance for initial states about their expectation, and for that about 0, the posterior mean of the expectation is
    N / (N + 1) times a ridge regression for s.

    Args:
        covariance: of an innovation. y: (N, n_rows, d), about the mean.
    """
    closed, n, shrink = a - gain @ c, len(a), len(y) / (len(y) + 1)
    state, propagated = np.zeros((len(y), n)), c
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    rows, targets = [np.sqrt(shrink) * np.eye(n)], [np.zeros(n)]
    for t in range(y.shape[1]):
        going = lengths >= t
        weight = np.sqrt(going.sum())
        if not weight:
            break
        rows.append(weight * whiten @ propagated)
        targets.append(weight * whiten @ (y[going, t] - state[going] @ c.T).mean(axis=0))
        state = state @ closed.T + y[:, t] @ gain.T + drift
        propagated = propagated @ closed
    return shrink * np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=ROUNDING)[0]
