"""The cart-pole against Lagrange's equations, energy and work, and its reward and track."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import beliefgym  # noqa: F401
from beliefgym.envs import CartPole


def energy(system: CartPole, state: np.ndarray) -> np.ndarray:
    """Kinetic plus potential energy of cart and point mass, from their positions, in J."""
    _, v, theta, w = state.T
    mass_velocity = np.stack([v + system.length * w * np.cos(theta), -system.length * w * np.sin(theta)])
    kinetic = 0.5 * system.cart_mass * v**2 + 0.5 * system.pole_mass * (mass_velocity**2).sum(axis=0)
    return kinetic + system.pole_mass * system.gravity * system.length * np.cos(theta)


def test_accelerations_solve_lagranges_equations():
    """M(q) q_dd = forces, solved as a linear system, in place of the solved form in the source."""
    system = CartPole(friction=0.0, cart_mass=1.3, pole_mass=0.4, length=0.7)
    rng = np.random.default_rng(0)
    state, force = rng.normal(size=(100, 4)) * 2.0, rng.normal(size=(100, 1)) * 5.0
    derivative = system.derivative(state, force)
    big, m, length, g = system.cart_mass, system.pole_mass, system.length, system.gravity
    for (_, v, theta, w), (u,), found in zip(state, force, derivative, strict=True):
        mass = np.array([[big + m, m * length * np.cos(theta)], [m * length * np.cos(theta), m * length**2]])
        forces = np.array([u + m * length * w**2 * np.sin(theta), m * g * length * np.sin(theta)])
        x_acceleration, theta_acceleration = np.linalg.solve(mass, forces)
        assert found == pytest.approx([v, x_acceleration, w, theta_acceleration], rel=1e-9)


def test_friction_of_the_hinge_takes_its_power():
    """The source's two friction terms are one torque, -f m l w, on the hinge: Lagrange's equations give both."""
    system = CartPole(friction=0.05)
    state = np.random.default_rng(1).normal(size=(200, 4))
    step = 1e-6
    derivative = system.derivative(state, np.zeros((200, 1)))
    power = (energy(system, state + step * derivative) - energy(system, state - step * derivative)) / (
        2 * step
    )
    torque = -system.friction * system.pole_mass * system.length * state[:, 3]
    assert power == pytest.approx(torque * state[:, 3], abs=1e-8)  # central difference of a quadratic at 1e-6


def test_energy_is_kept_without_friction_and_force():
    system = CartPole(friction=0.0, dt=0.01)
    state = np.random.default_rng(2).uniform(-2.0, 2.0, (50, 4))
    start = energy(system, state)
    for _ in range(500):
        state = system.step(state, np.zeros((50, 1)))
    assert energy(system, state) == pytest.approx(start, abs=1e-5)  # RK4 at dt = 0.01 s


def test_a_force_does_work():
    system = CartPole(friction=0.0, dt=0.001)
    state, force = np.array([[0.0, 0.0, np.pi, 0.0]]), np.array([[3.0]])
    start = energy(system, state)
    for _ in range(400):
        state = system.step(state, force)
    assert energy(system, state) - start == pytest.approx(3.0 * state[:, 0], rel=1e-6)


def test_steps_follow_an_independent_integrator():
    system = CartPole()
    state, force = np.array([[0.1, -0.2, 2.5, 0.3]]), np.array([[2.0]])
    exact = solve_ivp(
        lambda t, y: system.derivative(y[None], force)[0], (0.0, 1.0), state[0], rtol=1e-11, atol=1e-12
    ).y[:, -1]
    for _ in range(20):
        state = system.step(state, force)
    assert state[0] == pytest.approx(exact, abs=2e-4)  # RK4, dt = 0.05 s


def test_it_hangs_at_rest_and_stands_unstably():
    system = CartPole()
    hanging = np.array([[0.0, 0.0, np.pi, 0.0]])
    assert system.step(hanging, np.zeros((1, 1))) == pytest.approx(hanging, abs=1e-12)
    fallen = np.array([[0.0, 0.0, 1e-3, 0.0]])
    for _ in range(20):
        fallen = system.step(fallen, np.zeros((1, 1)))
    assert fallen[0, 2] > 0.02


def test_the_reward_is_one_at_rest_upright_and_small_hanging():
    system, still = CartPole(), np.zeros((1, 1))
    upright, hanging = np.zeros((1, 4)), np.array([[0.0, 0.0, np.pi, 0.0]])
    assert system.reward(upright, still, upright) == pytest.approx(1.0)
    assert system.reward(hanging, still, hanging) == pytest.approx(0.0)
    rng = np.random.default_rng(0)
    state, action = rng.normal(size=(1000, 4)) * 5.0, rng.uniform(-10.0, 10.0, (1000, 1))
    reward = system.reward(state, action, state)
    assert ((reward >= 0.0) & (reward <= 1.0)).all()
    # the factors of the docstring, written out anew
    b = lambda z: np.exp(-np.log(10.0) * z**2)  # noqa: E731
    x, _, theta, w = state.T
    factors = (
        (1 + np.cos(theta)) / 2 * (1 + b(x / 2)) / 2 * (1 + b(w / 5)) / 2 * (4 + b(action[:, 0] / 10)) / 5
    )
    assert reward == pytest.approx(factors, rel=1e-12)


def test_leaving_the_track_ends_the_episode():
    env = gym.make("beliefgym/CartPoleSwingUp-v0")
    env.reset(options={"state": [2.39, 2.0, np.pi, 0.0]})
    _, _, terminated, truncated, _ = env.step(np.zeros(1))
    assert terminated
    assert not truncated
    env.reset(options={"state": [2.0, 0.0, np.pi, 0.0]})
    assert not env.step(np.zeros(1))[2]


def test_it_starts_hanging_within_its_spread():
    env = gym.make("beliefgym/CartPoleSwingUp-v0", start_spread=0.05)
    states = np.array([env.reset(seed=s) and env.unwrapped.state for s in range(500)])
    assert np.abs(states - [0.0, 0.0, np.pi, 0.0]).max() <= 0.05
    assert states.std(axis=0) == pytest.approx([0.05 / np.sqrt(3)] * 4, rel=0.1)
