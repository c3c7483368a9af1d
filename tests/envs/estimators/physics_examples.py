"""Systems, data and textbook filters that the tests of the physics filters share."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from beliefgym.envs import Pendulum, System
from beliefgym.learning import Sequences

A = np.array([[0.9, 0.2], [-0.3, 0.8]])
B = np.array([0.1, 0.7])
C = np.array([[1.0, 0.5], [0.0, -1.0]])
NOISE = (0.3, 0.2)  # of the states
SENSOR = (0.4, 0.6)
PRIOR = (np.array([1.0, -2.0]), np.array([[1.5, 0.4], [0.4, 0.8]]))


@dataclass(frozen=True, kw_only=True)
class Linear(System):
    """s' = A s + B (u + actuation noise) + G d + process noise, y = C s; as entering noise, or as added noise."""

    process_noise_std: float | tuple[float, ...] = NOISE
    wind: tuple[float, ...] = ()  # standard deviation of d

    state_names: ClassVar = ("p", "q")
    action_names: ClassVar = ("push",)
    observation_names: ClassVar = ("first", "second")

    @property
    def action_limits(self):
        return np.array([-5.0]), np.array([5.0])

    @property
    def observation_limits(self):
        return np.full(2, -np.inf), np.full(2, np.inf)

    @property
    def disturbance_std(self):
        return self.wind

    def flow(self, state, action, disturbance=None):
        moved = state @ A.T + action * B
        return moved if disturbance is None else moved + disturbance

    def observe(self, state):
        return state @ C.T

    def reward(self, state, action, next_state):
        return -(next_state[..., 0] ** 2)

    def initial_state(self, streams, mask=None):
        return streams.uniform(2, mask)


@dataclass(frozen=True, kw_only=True)
class Squared(Linear):
    """The hint is no state: p^2 and p - q."""

    hint_names: ClassVar = ("energy", "gap")

    def hint(self, state):
        return np.stack([state[..., 0] ** 2, state[..., 0] - state[..., 1]], axis=-1)


def textbook(x, actions, *, Q=None):
    """Kalman's filter of `Linear` for one trajectory: the filtered means and covariances. NaN in x is left out."""
    Q = np.diag(np.square(NOISE)) if Q is None else Q
    R = np.diag(np.square(SENSOR))
    m, P = PRIOR
    means, covariances = [], []
    for t, z in enumerate(x):
        if t:
            m, P = A @ m + B * actions[t - 1, 0], A @ P @ A.T + Q
        there = ~np.isnan(z)
        H = C[there]
        S = H @ P @ H.T + R[np.ix_(there, there)]
        K = P @ H.T @ np.linalg.inv(S)
        m, P = m + K @ (z[there] - H @ m), P - K @ H @ P
        means.append(m)
        covariances.append(P)
    return np.array(means), np.array(covariances)


def simulated(system, start, actions, noise_std, rng, observed=None):
    """Trajectories of a system: states, noisy observations and hints, from start (n, n_state), actions (n, T, m)."""
    n, n_steps, _ = actions.shape
    states = np.empty((n, n_steps + 1, system.n_state))
    states[:, 0] = start
    for t in range(n_steps):
        noise = rng.standard_normal((n, system.noise_size)) if system.noise_size else None
        states[:, t + 1] = system.step(states[:, t], actions[:, t], noise)
    names = system.observation_names if observed is None else observed
    x = system.observe(states)[..., [system.observation_names.index(name) for name in names]]
    return Sequences.from_observations(
        x + noise_std * rng.standard_normal(x.shape),
        actions=actions,
        states=states,
        hints=system.hint(states),
        observation_names=names,
        state_names=system.state_names,
        hint_names=system.hint_names or system.state_names,
    )


def linear_data(n=4, n_steps=12, seed=0, system=None):
    rng = np.random.default_rng(seed)
    start = rng.multivariate_normal(*PRIOR, size=n)
    actions = rng.uniform(-2, 2, (n, n_steps, 1))
    return simulated(system or Linear(), start, actions, np.array(SENSOR), rng)


SINE = ("sin_theta",)
SINE_NOISE = 0.1
SWING = Pendulum.uncontrolled(damping=0.3, process_noise_std=(0.01, 0.05))
PENDULUM_PRIOR = (np.array([np.pi + 0.5, 0.0]), np.diag([0.2, 0.3]) ** 2)  # hanging, swung out a little


def pendulum_data(system=SWING, n=20, n_steps=60, seed=0, torque=0.0):
    """Pendulums that start where the prior says."""
    rng = np.random.default_rng(seed)
    start = rng.multivariate_normal(*PENDULUM_PRIOR, size=n)
    actions = np.tile(torque * np.sign(np.sin(0.15 * np.arange(n_steps)))[:, None], (n, 1, 1))
    return simulated(system, start, actions, SINE_NOISE, rng, SINE)


def filtered(estimator, data, missing=None):
    """Filter trajectories step by step with `update`: (n, T + 1, d) means and covariances of the states."""
    x = data.observations.copy()
    if missing is not None:
        x[missing] = np.nan
    belief = estimator.initial_belief(len(data))
    means, covariances = [], []
    for t in range(data.n_steps + 1):
        action = data.actions[:, t - 1] if t and data.n_act else None
        belief = estimator.update(belief, x[:, t], action, missing="predict")
        mean, covariance = estimator.estimate_state(belief)
        means.append(mean)
        covariances.append(covariance)
    return np.stack(means, axis=1), np.stack(covariances, axis=1)
