"""Learning a linear-Gaussian system: expectation maximisation, maximum a posteriori, and the start of both.

For trajectories x_0 .. x_L of any lengths and the system of Eq. 3.34 with s_0 ~ N(mu_0, P_0), the E-step finds the
states' means and covariances given the whole trajectory (Kalman filter, then Rauch-Tung-Striebel smoother),

    J_t = P_{t|t} A' P_{t+1|t}^-1,   m_{t|L} = m_{t|t} + J_t (m_{t+1|L} - m_{t+1|t}),
    V_{t|L} = P_{t|t} + J_t (V_{t+1|L} - P_{t+1|t}) J_t',         Cov(s_{t+1}, s_t | x_0 .. x_L) = V_{t+1|L} J_t'

and the M-step maximises over A, C, Q, R, mu_0, P_0 the expected log density plus the log prior

    -1/2 [w log|Q| + tr Q^-1 (Psi_Q + beta_1 A A')]  -1/2 [w log|R| + tr R^-1 (Psi_R + beta_2 C C')]
    -1/2 [w log|P_0| + tr P_0^-1 Psi_0]

a matrix normal prior on A and C of mean 0, given Q and R, times inverse Wishart priors; w counts as observations (the
powers of |Q| and |R| of the matrix normal are taken into it; the density has a finite integral where w is more than
2 dim + n_states, with dim that of Q or R, and the maximum exists for less). Then, with E the posterior expectation and
N transitions,

    A = E[sum s_{t+1} s_t'] (E[sum s_t s_t'] + beta_1 I)^-1,
    Q = (E[sum (s_{t+1} - A s_t)(s_{t+1} - A s_t)'] + beta_1 A A' + Psi_Q) / (N + w)

and so for C and R. All zero, that is maximum likelihood. Known states are the case of no posterior covariance.

P_{t|t} and J_t depend on t alone, and V is linear: the sum over trajectories W_t = sum_i V_{t|L_i} follows one
recursion, W_t = n_t P_{t|t} + J_t (W_{t+1} - n_{t+1} P_{t+1|t}) J_t', where n_t trajectories reach time t. So one
E-step is one matrix product a time step, of whatever lengths the trajectories are.

Deviation from maximum likelihood: Q, R and P_0 are kept above a floor (`NOISE_FLOOR`), and the M-step is the exact
maximum under that constraint; likelihood (posterior) therefore still never falls.

References: Shumway & Stoffer, "An approach to time series smoothing and forecasting using the EM algorithm", 1982;
Ghahramani & Hinton, "Parameter estimation for linear dynamical systems", 1996; thesis proposal, Sec. 3.4.3 (MAP).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, lstsq, solve_triangular

from beliefgym.learning.linear_gaussian import LinearGaussianSystem, filter_gain, symmetric
from beliefgym.learning.windows import cut_windows

Array = NDArray[np.float64]
NOISE_FLOOR = 1e-8  # least variance of any noise, as a share of the component's own (states: of 1)
SETTLED = 1e-13  # the filter's covariance is taken as constant once a step changes it by less than this share
WINDOW_RIDGE = 1e-6  # added to the windows' variances in the start, as a share
START_RADIUS = 0.999  # the start's A is shrunk to this spectral radius
MAX_LAGS = 10


@dataclass(frozen=True, eq=False)
class Priors:
    """The prior above, and the scales that the floor refers to.

    Attributes:
        transition_penalty, observation_penalty: beta_1, beta_2. weight: w. noise: Psi_Q = w noise diag(state_variance),
            Psi_R = w noise diag(observation_variance), Psi_0 = w diag(state_variance).
        state_variance: (n_states,). observation_variance: (n_obs,); both positive.
    """

    transition_penalty: float
    observation_penalty: float
    weight: float
    noise: float
    state_variance: Array
    observation_variance: Array

    def log_density(self, system: LinearGaussianSystem) -> float:
        """Up to a constant."""
        A, C = system.transition_matrix, system.observation_matrix
        terms = (
            (system.transition_covariance, self.noise * self.state_variance, self.transition_penalty, A),
            (
                system.observation_covariance,
                self.noise * self.observation_variance,
                self.observation_penalty,
                C,
            ),
            (system.initial_covariance, self.state_variance, 0.0, A),
        )
        total = 0.0
        for covariance, scale, penalty, matrix in terms:
            if self.weight == 0 and penalty == 0:
                continue
            spread = self.weight * np.diag(scale) + penalty * matrix @ matrix.T
            total += self.weight * float(np.linalg.slogdet(covariance)[1])
            total += float(np.trace(np.linalg.solve(covariance, spread)))
        return -0.5 * total


class Trajectories:
    """The observations of all trajectories, without padding: all of t = 0, then all of t = 1, ..

    Attributes:
        rows: (m, n_obs). order: (n_episodes,) episodes from the longest to the shortest, as they stand at each time.
        n_at: n_t. current: (n_transitions,) rows that a row follows, for rows n_at[0] onwards.
    """

    def __init__(self, observations: Array, lengths: NDArray[np.int64]) -> None:
        self.order = np.argsort(-lengths, kind="stable")
        longest = int(lengths.max())
        self.n_at = np.array([np.count_nonzero(lengths >= t) for t in range(longest + 1)])
        self.start = np.concatenate([[0], np.cumsum(self.n_at)])
        self.rows = self.flat(observations)
        following = zip(self.start[:-2], self.n_at[1:], strict=True)
        self.current = np.concatenate([np.arange(i, i + n) for i, n in following])

    def flat(self, array: Array) -> Array:
        """(n_episodes, n_steps + 1, d) -> (m, d)."""
        return np.concatenate([array[self.order[:n], t] for t, n in enumerate(self.n_at)])

    def at(self, t: int) -> slice:
        """The rows of time t."""
        return slice(self.start[t], self.start[t + 1])


@dataclass(frozen=True, eq=False)
class StateMoments:
    """What the M-step needs of the states given the trajectories.

    Attributes:
        means: (m, n_states), in the order of `Trajectories.rows`.
        every, next, current, initial: (n_states, n_states) sums of posterior covariances over all times, over all that
            follow another, over all that another follows, and over times 0.
        lag: sum of Cov(s_{t+1}, s_t). log_likelihood: of all trajectories.
    """

    means: Array
    every: Array
    next: Array
    current: Array
    initial: Array
    lag: Array
    log_likelihood: float

    @classmethod
    def known(cls, states: Array) -> StateMoments:
        """Of states that are known: (m, n_states)."""
        zero = np.zeros((states.shape[1], states.shape[1]))
        return cls(states, zero, zero, zero, zero, zero, np.nan)


def expectation(system: LinearGaussianSystem, trajectories: Trajectories) -> StateMoments:
    """The E-step, exact from the first observation on."""
    A, Q, n_at = system.transition_matrix, system.transition_covariance, trajectories.n_at
    G, projection, whitening, basis = system.whitened_observation()
    y = trajectories.rows @ projection.T
    m, n_times = len(y), len(n_at)
    # forward: means given the past (predicted) and the present too (filtered), and their covariances
    predicted, filtered = np.empty((m, system.n_states)), np.empty((m, system.n_states))
    before, after, smoother = [], [], []
    P, settled = np.array(system.initial_covariance), False
    predicted[: n_at[0]] = system.initial_mean
    log_determinant, mahalanobis = 0.0, 0.0
    for t in range(n_times):
        at = trajectories.at(t)
        if not settled:
            gain, left = filter_gain(P, G)
            root = np.linalg.cholesky(G @ P @ G.T + np.eye(len(G)))
            half_log = float(np.log(np.diag(root)).sum())
            following = symmetric(A @ left @ A.T + Q)
            back = np.linalg.solve(following, A @ left).T
        before.append(P)
        after.append(left)
        smoother.append(back)
        settled = settled or bool(np.abs(following - P).max() <= SETTLED * np.abs(P).max())
        P = P if settled else following
        error = y[at] - predicted[at] @ G.T
        mahalanobis += float(np.square(solve_triangular(root, error.T, lower=True)).sum())
        log_determinant += 2.0 * n_at[t] * half_log
        filtered[at] = predicted[at] + error @ gain
        if t + 1 < n_times:
            predicted[trajectories.at(t + 1)] = filtered[at][: n_at[t + 1]] @ A.T
    # the components of x that say nothing of s
    rest = trajectories.rows @ whitening.T - y @ basis.T if len(G) < system.n_obs else np.zeros(0)
    mahalanobis += float(np.square(rest).sum())
    log_determinant -= 2.0 * m * float(np.log(np.diag(whitening)).sum())
    constant = m * system.n_obs * np.log(2.0 * np.pi)
    # backward
    means = filtered
    W = n_at[-1] * after[-1]
    every, following_sum, current, lag = W.copy(), np.zeros_like(W), np.zeros_like(W), np.zeros_like(W)
    for t in range(n_times - 2, -1, -1):
        J, n_next = smoother[t], n_at[t + 1]
        later = trajectories.at(t + 1)
        reaches = slice(trajectories.start[t], trajectories.start[t] + n_next)
        means[reaches] += (means[later] - predicted[later]) @ J.T
        following_sum += W
        lag += W @ J.T
        W_reaching = symmetric(n_next * after[t] + J @ (W - n_next * before[t + 1]) @ J.T)
        current += W_reaching
        W = W_reaching + (n_at[t] - n_next) * after[t]
        every += W
    log_likelihood = -0.5 * (constant + log_determinant + mahalanobis)
    return StateMoments(means, every, following_sum, current, W, lag, log_likelihood)


def maximisation(moments: StateMoments, trajectories: Trajectories, priors: Priors) -> LinearGaussianSystem:
    """The M-step, in closed form; with known states the maximum a posteriori itself."""
    s, x, w = moments.means, trajectories.rows, priors.weight
    n = trajectories.n_at[0]
    following, current = s[n:], s[trajectories.current]
    A = _ridge(
        current.T @ current + moments.current, following.T @ current + moments.lag, priors.transition_penalty
    )
    error = following - current @ A.T
    crossed = A @ moments.lag.T
    squares = error.T @ error + moments.next - crossed - crossed.T + A @ moments.current @ A.T
    squares += priors.transition_penalty * A @ A.T + w * priors.noise * np.diag(priors.state_variance)
    Q = _floored(squares / (len(following) + w), priors.state_variance)

    C = _ridge(s.T @ s + moments.every, x.T @ s, priors.observation_penalty)
    error = x - s @ C.T
    squares = error.T @ error + C @ moments.every @ C.T
    squares += priors.observation_penalty * C @ C.T + w * priors.noise * np.diag(priors.observation_variance)
    R = _floored(squares / (len(x) + w), priors.observation_variance)

    mean = s[:n].mean(axis=0)
    error = s[:n] - mean
    squares = error.T @ error + moments.initial + w * np.diag(priors.state_variance)
    P = _floored(squares / (n + w), priors.state_variance)
    return LinearGaussianSystem(A, C, Q, R, initial_mean=mean, initial_covariance=P)


def expectation_maximisation(
    trajectories: Trajectories, start: LinearGaussianSystem, priors: Priors
) -> Iterator[tuple[LinearGaussianSystem, float, float]]:
    """The start and all that follow it, without end: (system, log likelihood, log posterior up to a constant)."""
    system = start
    while True:
        moments = expectation(system, trajectories)
        yield system, moments.log_likelihood, moments.log_likelihood + priors.log_density(system)
        system = maximisation(moments, trajectories, priors)


def subspace_start(
    observations: Array,
    lengths: NDArray[np.int64],
    variance: Array,
    n_states: int,
    rng: np.random.Generator,
) -> LinearGaussianSystem:
    """A system from delay windows: its states are what the past k observations say of the next k.

    The next k are regressed on the past k; the first n_states principal directions of what is predicted, in the
    metric of the next k's own covariance, are the states, of unit variance (canonical variate analysis; Van Overschee &
    De Moor, "Subspace identification for linear systems", 1996, Ch. 3). A, C, Q, R follow by least squares. k is at
    most 10, and less where trajectories are short or there would be fewer than 3 windows a coefficient. States beyond
    what the windows tell apart start from noise.

    Args:
        observations: (n_episodes, n_steps + 1, n_obs). lengths: (n_episodes,). variance: (n_obs,), positive.
        n_states: n. rng: of the noise.
    """
    n_obs, longest = observations.shape[2], int(lengths.max())
    z = observations / np.sqrt(variance)
    k = max(1, min(MAX_LAGS, longest // 2))
    needed = -(-n_states // n_obs)
    while k > max(1, needed) and np.maximum(lengths - 2 * k + 2, 0).sum() < 3 * k * n_obs:
        k -= 1
    windows = cut_windows(z, np.empty((*z.shape[:1], z.shape[1] - 1, 0)), lengths, k, k)
    m = len(windows)
    past, future = windows.past_observations.reshape(m, -1), windows.future_observations.reshape(m, -1)
    eye = WINDOW_RIDGE * np.eye(k * n_obs)
    expected = past @ np.linalg.solve(past.T @ past / m + eye, past.T @ future / m)
    root = np.linalg.cholesky(future.T @ future / m + eye)
    canonical = solve_triangular(root, expected.T, lower=True)
    values, vectors = np.linalg.eigh(canonical @ canonical.T / m)
    values, vectors = values[::-1][:n_states], vectors[:, ::-1][:, :n_states]
    told = values > WINDOW_RIDGE
    s = rng.standard_normal((m, n_states))
    s[:, np.flatnonzero(told)] = canonical.T @ vectors[:, told] / np.sqrt(values[told])

    C = _ridge(s.T @ s, windows.future_observations[:, 0].T @ s, WINDOW_RIDGE * m)
    error = windows.future_observations[:, 0] - s @ C.T
    R = _floored(error.T @ error / m, np.ones(n_obs))
    pairs = np.flatnonzero((np.diff(windows.episode) == 0) & (np.diff(windows.time) == 1))
    A = START_RADIUS * np.eye(n_states)
    if len(pairs):
        A = _ridge(s[pairs].T @ s[pairs], s[pairs + 1].T @ s[pairs], WINDOW_RIDGE * m)
    A *= min(1.0, START_RADIUS / max(float(np.abs(np.linalg.eigvals(A)).max()), np.finfo(float).tiny))
    error = s[pairs + 1] - s[pairs] @ A.T if len(pairs) else s
    Q = _floored(error.T @ error / len(error), np.ones(n_states))
    unit = np.sqrt(variance)
    return LinearGaussianSystem(
        A, unit[:, None] * C, Q, R * np.outer(unit, unit), initial_covariance=np.eye(n_states)
    )


def _ridge(gram: Array, cross: Array, penalty: float) -> Array:
    """cross (gram + penalty I)^-1; the least one where that is singular."""
    gram = symmetric(gram) + penalty * np.eye(len(gram))
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0, scale, 1.0)
    scaled, right = gram / np.outer(scale, scale), (cross / scale).T
    try:
        solution = cho_solve(cho_factor(scaled, lower=True), right)
    except LinAlgError:
        solution = lstsq(scaled, right)[0]
    return solution.T / scale


def _floored(covariance: Array, variance: Array) -> Array:
    """The covariance that maximises the Gaussian likelihood among those of at least NOISE_FLOOR diag(variance)."""
    floor = np.sqrt(NOISE_FLOOR * variance)
    scale = np.outer(floor, floor)
    values, vectors = np.linalg.eigh(symmetric(covariance) / scale)
    if values[0] >= 1.0:
        return symmetric(covariance)
    return symmetric((vectors * np.maximum(values, 1.0)) @ vectors.T) * scale
