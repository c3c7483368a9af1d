"""The systems of `beliefgym reproduce actions-interventions`, their policies, and what is exactly true of them.

    LinearWorld   s' = A s + B a + noise, x = C s + noise: everything by the Kalman filter
    RingWorld     places on a ring, coloured alike, a step left or right that may slip: everything by Bayes' rule

(and, apart, actions_pendulum.py). A world knows of a history h_t = x_0, a_0, .., a_{t-1} what its filter knows of it
(`known`), and from that

    E[x_{t+i} | h_t, do(a_t ..)]   under prescribed actions
    E[x_{t+i} | h_t, policy]       under a policy, or under the blind reference mu of the weights (Eqs. 4.12 to 4.14)

and the error that is left to the first of them, the least there is. Actions are recorded with their log-probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning import Sequences

Floats = NDArray[np.float64]
LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Feedback:
    """a_t ~ N(-gain times what is fed back, std^2); gain 0 is blind.

    Attributes:
        gain: its strength. sees: "observation" for x_t, "estimate" for the Kalman filter's prediction of what x_{t+1}
            would be without a push, over C B: at gain 1 that push is taken back whole. std: of the exploration.
    """

    gain: float
    sees: str = "observation"
    std: float = 0.6


@dataclass(frozen=True)
class LinearWorld:
    """A slow turn, of which one component is seen, with a disturbance that fades in about ten steps.

    It starts from its stationary distribution without pushes. Three states, one observation, one action.
    """

    radius: float = 0.93
    angle: float = 0.45
    persistence: float = 0.9
    process: float = 0.15
    measurement: float = 0.2

    @property
    def matrices(self) -> tuple[Floats, Floats, Floats]:
        """A (3, 3), B (3, 1), C (1, 3)."""
        c, s = self.radius * np.cos(self.angle), self.radius * np.sin(self.angle)
        a = np.array([[c, s, 0.3], [-s, c, 0.0], [0.0, 0.0, self.persistence]])
        return a, np.array([[0.6], [0.3], [0.0]]), np.array([[1.0, 0.0, 0.0]])

    @cached_property
    def noise(self) -> tuple[Floats, float]:
        """Covariance of the state's noise (3, 3), variance of the observation's."""
        return self.process**2 * np.eye(3), self.measurement**2

    @cached_property
    def start(self) -> Floats:
        """Covariance of s_0."""
        from scipy.linalg import solve_discrete_lyapunov

        return np.asarray(solve_discrete_lyapunov(self.matrices[0], self.noise[0]))

    def gains(self, n: int) -> tuple[Floats, Floats]:
        """Of x_0 .. x_{n-1} on the filter's state (n, 3), and the covariances of s_t given h_t (n, 3, 3)."""
        a, _, c = self.matrices
        q, r = self.noise
        gains, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
        p = self.start
        for t in range(n):
            covariances[t] = p
            gains[t] = (p @ c.T)[:, 0] / float((c @ p @ c.T)[0, 0] + r)
            p = a @ (p - np.outer(gains[t], c @ p)) @ a.T + q
        return gains, covariances

    def sample(self, policy: Feedback, n: int, n_steps: int, rng: np.random.Generator) -> Sequences:
        """Trajectories under a policy."""
        a, b, c = self.matrices
        gains, _ = self.gains(n_steps + 1)
        s = rng.standard_normal((n, 3)) @ np.linalg.cholesky(self.start).T
        known = np.zeros((n, 3))
        x, u, logs = np.empty((n, n_steps + 1, 1)), np.empty((n, n_steps, 1)), np.empty((n, n_steps))
        for t in range(n_steps + 1):
            x[:, t] = s @ c.T + self.measurement * rng.standard_normal((n, 1))
            if t == n_steps:
                break
            known = known + (x[:, t] - known @ c.T) * gains[t]
            mean = self.mean_action(policy, x[:, t], known)
            u[:, t] = mean + policy.std * rng.standard_normal((n, 1))
            logs[:, t] = _log_normal(u[:, t, 0] - mean[:, 0], policy.std)
            s = s @ a.T + u[:, t] @ b.T + self.process * rng.standard_normal((n, 3))
            known = known @ a.T + u[:, t] @ b.T
        return Sequences(x, u, np.zeros((n, n_steps)), action_log_probs=logs)

    def mean_action(self, policy: Feedback, x: Floats, known: Floats) -> Floats:
        """(.., 1) of an observation (.., 1) and the estimate that has seen it (.., 3)."""
        if policy.sees == "observation":
            return -policy.gain * x
        return -policy.gain * known @ self.cancelling

    @property
    def cancelling(self) -> Floats:
        """(3, 1) (C B)^-1 C A, the push that takes back what is foreseen of the next observation."""
        a, b, c = self.matrices
        cancelling: Floats = (c @ a).T / float((c @ b)[0, 0])
        return cancelling

    def known(self, sequences: Sequences) -> Floats:
        """E[s_t | h_t]: (n, n_steps + 1, 3)."""
        return self._filtered(sequences)[0]

    def _filtered(self, sequences: Sequences) -> tuple[Floats, Floats]:
        """E[s_t | h_t], and E[s_t | h_t, x_t]."""
        a, b, c = self.matrices
        x, u = sequences.observations, sequences.actions
        gains, _ = self.gains(x.shape[1])
        before, after = np.zeros((*x.shape[:2], 3)), np.zeros((*x.shape[:2], 3))
        for t in range(x.shape[1]):
            after[:, t] = before[:, t] + (x[:, t] - before[:, t] @ c.T) * gains[t]
            if t + 1 < x.shape[1]:
                before[:, t + 1] = after[:, t] @ a.T + u[:, t] @ b.T
        return before, after

    def under_actions(self, known: Floats, actions: Floats, horizon: int) -> Floats:
        """E[x_{t+i} | h_t, do(actions)]: (n, 3) and (n, horizon - 1 or more, 1) -> (n, horizon, 1)."""
        a, b, c = self.matrices
        expected = np.empty((len(known), horizon, 1))
        for i in range(horizon):
            expected[:, i] = known @ c.T
            if i + 1 < horizon:
                known = known @ a.T + actions[:, i] @ b.T
        return expected

    def under_policy(self, known: Floats, policy: Feedback, horizon: int) -> Floats:
        """E[x_{t+i} | h_t] where the policy goes on acting: (n, 3) -> (n, horizon, 1).

        E[x_t | h_t] = C E[s_t | h_t] and the estimate that has seen x_t is on average the one before: both kinds of
        feedback close the loop around the mean.
        """
        a, b, c = self.matrices
        closed = a - policy.gain * b @ (c if policy.sees == "observation" else self.cancelling.T)
        expected = np.empty((len(known), horizon, 1))
        for i in range(horizon):
            expected[:, i] = known @ c.T
            known = known @ closed.T
        return expected

    def under_reference(self, known: Floats, actions: Floats, horizon: int) -> Floats:
        """The same where actions are blind, of the recorded actions' (n_recorded, 1) own marginal distribution."""
        blind = np.broadcast_to(actions.mean(axis=0), (len(known), horizon, 1))
        return self.under_actions(known, blind, horizon)

    def least_errors(self, known: Floats, actions: Floats, horizon: int) -> Floats:
        """(horizon,) mean squared error of `under_actions` itself, after the filter has settled."""
        a, _, c = self.matrices
        q, r = self.noise
        p = self.gains(200)[1][-1]
        least = np.empty(horizon)
        for i in range(horizon):
            least[i] = float((c @ p @ c.T)[0, 0]) + r
            p = a @ p @ a.T + q
        return least

    def divergence(self, ours: Feedback, theirs: Feedback, sequences: Sequences) -> float:
        """Mean of KL(ours | theirs) of the next action, nats, over the histories of ours."""
        known = self._filtered(sequences)[1][:, :-1]
        x = sequences.observations[:, :-1]
        gap = self.mean_action(ours, x, known) - self.mean_action(theirs, x, known)
        return float(np.square(gap).mean() / (2.0 * theirs.std**2)) + kl_of_stds(ours.std, theirs.std)


@dataclass(frozen=True)
class Colour:
    """a_t = 1 (a step right) with a probability that the colour x_t decides; sharpness 0 is blind.

    p(right | colour) = 1/2 + sharpness / 2 for the colours of `right`, 1/2 - sharpness / 2 for the others.
    """

    sharpness: float
    right: tuple[bool, ...] = (True, False, True)

    @property
    def table(self) -> Floats:
        """(n_colours, 2) pi(a | x)."""
        p = 0.5 + 0.5 * self.sharpness * np.where(self.right, 1.0, -1.0)
        return np.stack([1.0 - p, p], axis=1)


@dataclass(frozen=True)
class RingWorld:
    """Five places on a ring in three colours, two of them twice; a step right or left slips, colours are misread.

    Five states, three observations as unit vectors, two actions. It starts anywhere.
    """

    colours: tuple[int, ...] = (0, 1, 2, 1, 2)
    slip: float = 0.1
    misread: float = 0.05

    @property
    def matrices(self) -> tuple[Floats, Floats]:
        """P(s' | s, a) (2, 5, 5) and P(x | s) (5, 3)."""
        n = len(self.colours)
        right = np.roll(np.eye(n), 1, axis=1)
        moves = np.stack([(1.0 - self.slip) * right.T, (1.0 - self.slip) * right])
        seen = np.eye(3)[list(self.colours)]
        return moves + self.slip * np.eye(n), (1.0 - self.misread) * seen + self.misread / 2.0 * (1.0 - seen)

    def sample(self, policy: Colour, n: int, n_steps: int, rng: np.random.Generator) -> Sequences:
        """Trajectories under a policy."""
        moves, seen = self.matrices
        table = policy.table
        s = rng.integers(len(seen), size=n)
        x, u, logs = np.empty((n, n_steps + 1, 3)), np.empty((n, n_steps, 1)), np.empty((n, n_steps))
        for t in range(n_steps + 1):
            colour = _drawn(seen[s], rng)
            x[:, t] = np.eye(3)[colour]
            if t == n_steps:
                break
            a = _drawn(table[colour], rng)
            u[:, t, 0], logs[:, t] = a, np.log(table[colour, a])
            s = _drawn(moves[a, s], rng)
        return Sequences(x, u, np.zeros((n, n_steps)), action_log_probs=logs)

    def known(self, sequences: Sequences) -> Floats:
        """P(s_t | h_t): (n, n_steps + 1, 5)."""
        moves, seen = self.matrices
        x, u = sequences.observations, sequences.actions[:, :, 0].astype(np.intp)
        known = np.full((*x.shape[:2], len(seen)), 1.0 / len(seen))
        for t in range(x.shape[1] - 1):
            now = known[:, t] * (x[:, t] @ seen.T)
            now /= now.sum(axis=1, keepdims=True)
            known[:, t + 1] = np.einsum("ns,nsr->nr", now, moves[u[:, t]])
        return known

    def under_actions(self, known: Floats, actions: Floats, horizon: int) -> Floats:
        """P(x_{t+i} | h_t, do(actions)): (n, 5) and (n, horizon - 1 or more, 1) -> (n, horizon, 3)."""
        moves, seen = self.matrices
        expected = np.empty((len(known), horizon, 3))
        for i in range(horizon):
            expected[:, i] = known @ seen
            if i + 1 < horizon:
                known = np.einsum("ns,nsr->nr", known, moves[actions[:, i, 0].astype(np.intp)])
        return expected

    def under_policy(self, known: Floats, policy: Colour, horizon: int) -> Floats:
        """P(x_{t+i} | h_t) where the policy goes on acting: (n, 5) -> (n, horizon, 3)."""
        moves, seen = self.matrices
        return self._stepped(known, np.einsum("sa,asr->sr", seen @ policy.table, moves), horizon)

    def under_reference(self, known: Floats, actions: Floats, horizon: int) -> Floats:
        """The same where actions are drawn blindly, as often as among the recorded ones (n_recorded, 1)."""
        shares = np.bincount(actions[:, 0].astype(np.intp), minlength=2) / len(actions)
        return self._stepped(known, np.einsum("a,asr->sr", shares, self.matrices[0]), horizon)

    def _stepped(self, known: Floats, step: Floats, horizon: int) -> Floats:
        seen = self.matrices[1]
        expected = np.empty((len(known), horizon, 3))
        for i in range(horizon):
            expected[:, i] = known @ seen
            known = known @ step
        return expected

    def least_errors(self, known: Floats, actions: Floats, horizon: int) -> Floats:
        """(horizon,) mean squared error of `under_actions` itself, over these histories and actions."""
        expected = self.under_actions(known, actions, horizon)
        least: Floats = (1.0 - np.square(expected).sum(axis=2)).mean(axis=0)  # E|x - p|^2 = 1 - |p|^2
        return least

    def divergence(self, ours: Colour, theirs: Colour, sequences: Sequences) -> float:
        """Mean of KL(ours | theirs) of the next action, nats, over the histories of ours."""
        p, q = ours.table, theirs.table
        by_colour = (p * np.log(p / q)).sum(axis=1)
        return float((sequences.observations[:, :-1] @ by_colour).mean())


def _drawn(probabilities: Floats, rng: np.random.Generator) -> NDArray[np.intp]:
    """One choice for each row of probabilities: (n, m) -> (n,)."""
    edges = probabilities.cumsum(axis=1)
    return np.minimum((rng.random((len(edges), 1)) > edges).sum(axis=1), edges.shape[1] - 1)


def _log_normal(deviation: Floats, std: float) -> Floats:
    log: Floats = -0.5 * np.square(deviation / std) - np.log(std) - 0.5 * LOG_2PI
    return log


def kl_of_stds(ours: float, theirs: float) -> float:
    """What different exploration adds to KL(ours | theirs)."""
    ratio = (ours / theirs) ** 2
    return 0.5 * float(ratio - 1.0 - np.log(ratio))
