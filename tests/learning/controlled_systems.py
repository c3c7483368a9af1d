"""Systems with actions whose beliefs are known exactly: a linear-Gaussian one, and one of two states."""

from itertools import product

import numpy as np
from scipy.linalg import solve_discrete_are

from beliefgym.learning import Sequences

A = np.array([[0.8, 0.4], [-0.4, 0.7]])  # eigenvalues 0.85 from 0
B = np.array([[0.8], [-0.3]])
C = np.array([[1.0, 0.0]])
Q, R = np.diag([0.1, 0.2]), np.array([[0.3]])
PREDICTED = solve_discrete_are(A.T, C.T, Q, R)  # of s_t given all before t
INNOVATION = C @ PREDICTED @ C.T + R
GAIN = A @ PREDICTED @ C.T @ np.linalg.inv(INNOVATION)


def linear(n, n_steps, seed, feedback=0.0, std=1.0, mean=0.0, lengths=None):
    """s' = A s + B u + w, x = C s + v, under u ~ N(mean - feedback x, std^2); the states are hints too.

    s_0 is drawn with the covariance that the stationary filter predicts, which therefore is the best one from x_0 on.
    """
    rng = np.random.default_rng(seed)
    s = np.empty((n, n_steps + 1, 2))
    x, u = np.empty((n, n_steps + 1, 1)), np.empty((n, n_steps, 1))
    s[:, 0] = rng.multivariate_normal(np.zeros(2), PREDICTED, n)
    noise = rng.normal(size=(n, n_steps, 1))
    for t in range(n_steps + 1):
        x[:, t] = s[:, t] @ C.T + R[0, 0] ** 0.5 * rng.normal(size=(n, 1))
        if t < n_steps:
            u[:, t] = mean - feedback * x[:, t] + std * noise[:, t]
            s[:, t + 1] = s[:, t] @ A.T + u[:, t] @ B.T + rng.multivariate_normal(np.zeros(2), Q, n)
    log_probs = -0.5 * noise[:, :, 0] ** 2 - np.log(std) - 0.5 * np.log(2.0 * np.pi)
    return Sequences(
        x, u, np.zeros((n, n_steps)), lengths=lengths, states=s, hints=s, action_log_probs=log_probs
    )


def kalman_states(data):
    """E[s_t | x_0, a_0, .., a_{t-1}] of t = 0 .. n_steps: (n, n_steps + 1, 2)."""
    s = np.zeros(data.states.shape)
    for t in range(data.n_steps):
        news = data.observations[:, t] - s[:, t] @ C.T
        s[:, t + 1] = s[:, t] @ A.T + data.actions[:, t] @ B.T + news @ GAIN.T
    return s


def kalman_squared_errors(data, horizon):
    """|x_{t+j} - E[x_{t+j} | h_t, do(a_t, ..)]|^2: (n, n_steps + 1, horizon), NaN past the end."""
    squared = np.full((*data.observations.shape[:2], horizon), np.nan)
    s = kalman_states(data)
    for j in range(horizon):
        n_left = data.n_steps + 1 - j
        squared[:, :n_left, j] = np.square(data.observations[:, j:] - s[:, :n_left] @ C.T)[:, :, 0]
        ahead = np.pad(data.actions, ((0, 0), (0, n_left + j), (0, 0)))[:, j : j + s.shape[1]]
        s = s @ A.T + ahead @ B.T
    return squared


def expected_futures(states, k, feedback=0.0, mean=0.0):
    """E[x_t, .., x_{t+k-1}] from E[s_t] under u = mean - feedback x + noise: (..., 2) -> (..., k)."""
    found, closed = [], A - feedback * B @ C
    for _ in range(k):
        found.append(states @ C[0])
        states = states @ closed.T + mean * B[:, 0]
    return np.stack(found, axis=-1)


class TwoStates:
    """Two states, two observations, two actions, and a policy that looks at the last observation and action."""

    start = np.array([0.6, 0.4])
    move = np.array([[[0.95, 0.05], [0.1, 0.9]], [[0.1, 0.9], [0.85, 0.15]]])  # [a, s, s']
    see = np.array([[0.9, 0.1], [0.15, 0.85]])  # [s, x]

    @staticmethod
    def policy(x, last):
        """Probability of a = 1."""
        return 0.15 + 0.5 * x + 0.2 * last

    def probabilities(self, xs, actions):
        """g and pi of one sequence from the start: prod p(x_i | before, do(..)), and prod pi(a_i | before)."""
        forward, pi, last = self.start, 1.0, 0
        for x, a in zip(xs, actions, strict=True):
            p = self.policy(x, last)
            pi *= p if a else 1.0 - p
            forward, last = (forward * self.see[:, x]) @ self.move[a], a
        return forward.sum(), pi

    def tests(self, history, k):
        """Every test of k observations and actions after a history [(x, a), ..]: (xs, actions, g, pi) given it."""
        before = [list(column) for column in zip(*history, strict=True)] if history else [[], []]
        g_of_history, pi_of_history = self.probabilities(*before)
        for xs in product((0, 1), repeat=k):
            for actions in product((0, 1), repeat=k):
                g, pi = self.probabilities([*before[0], *xs], [*before[1], *actions])
                yield xs, actions, g / g_of_history, pi / pi_of_history

    def expected(self, history, k, mu=None):
        """E[x_t .. x_{t+k-1} | h] under blind actions of probabilities mu (E_G), or under the policy: (k,)."""
        total, found = 0.0, np.zeros(k)
        for xs, actions, g, pi in self.tests(history, k):
            weight = g * (pi if mu is None else np.prod([mu[a] for a in actions]))
            total, found = total + weight, found + weight * np.array(xs)
        return found / total

    def sample(self, n, n_steps, seed):
        """Recorded under the policy."""
        rng = np.random.default_rng(seed)
        x, a = np.zeros((n, n_steps + 1, 1), dtype=int), np.zeros((n, n_steps, 1), dtype=int)
        log_probs, last = np.zeros((n, n_steps)), np.zeros(n, dtype=int)
        s = (rng.random(n) < self.start[1]).astype(int)
        for t in range(n_steps + 1):
            x[:, t, 0] = rng.random(n) < self.see[s, 1]
            if t < n_steps:
                p = self.policy(x[:, t, 0], last)
                last = a[:, t, 0] = (rng.random(n) < p).astype(int)
                log_probs[:, t] = np.log(np.where(last, p, 1.0 - p))
                s = (rng.random(n) < self.move[last, s, 1]).astype(int)
        return Sequences(x, a, np.zeros((n, n_steps)), action_log_probs=log_probs)
