"""The pendulum against Gymnasium's Pendulum-v1, against energy, and its parameters."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import beliefgym  # noqa: F401
from beliefgym.envs import Pendulum


@pytest.mark.parametrize("seed", range(5))
def test_trajectories_are_those_of_gymnasiums_pendulum(seed):
    ours = gym.make("beliefgym/Pendulum-v0").unwrapped
    theirs = gym.make("Pendulum-v1").unwrapped
    theirs.reset(seed=seed)
    state = np.array(theirs.state)
    observation, _ = ours.reset(options={"state": state})
    rng = np.random.default_rng(seed)
    for _ in range(200):
        assert observation == pytest.approx(theirs._get_obs(), abs=1e-6)
        action = rng.uniform(-3.0, 3.0, 1)  # float64 for both, and beyond the limits too: both clip
        observation, reward, *_ = ours.step(action)
        _, expected, *_ = theirs.step(action)
        assert reward == pytest.approx(expected, abs=1e-6)
        assert ours.state == pytest.approx(theirs.state, abs=1e-6)


def test_spaces_and_time_limit_are_those_of_gymnasiums_pendulum():
    ours, theirs = gym.make("beliefgym/Pendulum-v0"), gym.make("Pendulum-v1")
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.spec.max_episode_steps == theirs.spec.max_episode_steps
    starts = np.array([ours.reset(seed=s) and ours.unwrapped.state for s in range(2000)])
    assert (np.abs(starts) <= [np.pi, 1.0]).all()
    assert np.abs(starts).mean(axis=0) == pytest.approx(
        [np.pi / 2, 0.5], rel=0.05
    )  # uniform: 2.3 standard errors


def test_the_position_only_sibling_hides_the_velocity_and_nothing_else():
    full, partial = gym.make("beliefgym/Pendulum-v0"), gym.make("beliefgym/PendulumPosition-v0")
    a, _ = full.reset(seed=3)
    b, info = partial.reset(seed=3)
    assert info == {}
    for _ in range(20):
        assert np.array_equal(a[:2], b)
        action = full.action_space.sample()
        a, r, *_ = full.step(action)
        b, q, *_ = partial.step(action)
        assert r == q


def energy(system: Pendulum, state: np.ndarray) -> np.ndarray:
    """Kinetic plus potential energy of a point mass in J."""
    speed = system.length * state[:, 1]
    return 0.5 * system.mass * speed**2 + system.mass * system.gravity * system.length * np.cos(state[:, 0])


def test_the_uncontrolled_pendulum_keeps_its_energy():
    system = Pendulum.uncontrolled(dt=0.01)
    state = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2))
    start = energy(system, state)
    for _ in range(1000):
        state = system.step(state, np.zeros((50, 1)))
    # RK4 at dt = 0.01 s loses of the order of (omega dt)^5 a step: 1e-5 of the energy scale in 1000 steps
    assert energy(system, state) == pytest.approx(start, abs=1e-4 * system.gravity)


def test_damping_takes_energy_away_and_brings_it_to_rest_hanging():
    system = Pendulum.uncontrolled(damping=0.3)
    state = np.array([[2.0, 1.0]])
    last = energy(system, state)
    for _ in range(1000):
        state = system.step(state, np.zeros((1, 1)))
        assert energy(system, state) <= last + 1e-6
        last = energy(system, state)
    assert np.cos(state[0, 0]) == pytest.approx(-1.0, abs=1e-4)


def test_rk4_follows_an_independent_integrator():
    """theta_dd = -(g/L) sin(theta_down) - d theta_dot + u, the form of the source, theta_down = theta + pi."""
    system = Pendulum.uncontrolled(damping=0.3, length=1.3, max_torque=5.0)
    state, torque = np.array([[0.5, -0.2]]), 0.7

    def source(t: float, y: np.ndarray) -> list[float]:
        acceleration = torque / (system.mass * system.length**2)
        return [y[1], -(9.81 / 1.3) * np.sin(y[0]) - 0.3 * y[1] + acceleration]

    exact = solve_ivp(source, (0.0, 2.0), [0.5 + np.pi, -0.2], rtol=1e-10, atol=1e-12).y[:, -1]
    for _ in range(40):
        state = system.step(state, np.array([[torque]]))
    assert state[0] + [np.pi, 0.0] == pytest.approx(exact, abs=1e-4)  # RK4, dt = 0.05 s: error of order dt^4


def test_noise_has_the_asked_for_size_and_none_costs_nothing():
    system = Pendulum(process_noise_std=(0.0, 0.2), actuation_noise_std=0.1, max_speed=100.0)
    n = 20_000
    noise = np.random.default_rng(0).standard_normal((n, system.noise_size))
    moved = system.step(np.zeros((n, 2)), np.zeros((n, 1)), noise)
    # speed: 0.2 of its own, and 3 dt 0.1 = 0.015 through the torque
    assert moved[:, 1].std() == pytest.approx(np.hypot(0.2, 0.015), rel=0.02)
    assert moved[:, 0].std() == pytest.approx(0.05 * 0.015, rel=0.02)
    assert Pendulum().noise_size == 0


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"dt": 0.0}, "expected dt above 0 s"),
        ({"mass": -1.0}, "expected mass above 0"),
        ({"inertia": "ring"}, "expected inertia to be one of"),
        ({"process_noise_std": (0.1, 0.1, 0.1)}, "process_noise_std as one number or 2 of them, got 3"),
        ({"actuation_noise_std": -0.1}, "actuation_noise_std finite and at least 0"),
    ],
)
def test_impossible_parameters_are_told(parameters, message):
    with pytest.raises(ValueError, match=message):
        Pendulum(**parameters)


def test_an_unknown_parameter_is_told_with_the_nearest():
    with pytest.raises(TypeError, match=r"no parameter 'dampin'; did you mean 'damping'"):
        gym.make("beliefgym/Pendulum-v0", dampin=0.3)


LEVELS = {"Easy": (0.1, 200), "Medium": (0.2, 150), "Hard": (0.3, 100)}


@pytest.mark.parametrize("level", LEVELS)
def test_the_noisy_siblings_have_the_suites_noise_clipped_to_the_circles_box(level):
    """Around the true position; where it cannot reach the box's sides, its deviation is the suites'."""
    std, n_steps = LEVELS[level]
    n = 4000
    noisy = gym.make_vec(
        f"beliefgym/PendulumPositionNoisy{level}-v0", num_envs=n, vectorization_mode="vector_entry_point"
    )
    plain = gym.make("beliefgym/PendulumPosition-v0")
    assert noisy.single_observation_space == plain.observation_space
    assert noisy.spec.max_episode_steps == n_steps
    observation, _ = noisy.reset(seed=0)
    angle = noisy.unwrapped.state[:, 0]
    true = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.abs(observation).max() <= 1.0
    assert (np.abs(observation) == 1.0).any()
    inside = np.abs(true) < 0.1  # three deviations and more from a side
    error = (observation - true)[inside]
    assert error.std() == pytest.approx(std, rel=0.1)  # some 500 draws: 3 standard errors
    assert error.mean() == pytest.approx(0.0, abs=4.0 * std / np.sqrt(len(error)))
    expected = np.clip(true + std * np.random.default_rng(1).standard_normal(true.shape), -1.0, 1.0)
    at_a_side = (np.abs(observation) == 1.0).mean(), (np.abs(expected) == 1.0).mean()
    assert at_a_side[0] == pytest.approx(at_a_side[1], abs=0.02)  # 4 standard errors of 8,000 draws


@pytest.mark.parametrize("level", LEVELS)
def test_the_noisy_siblings_are_the_same_alone_and_in_a_batch_up_to_their_end(level):
    env_id, n_steps = f"beliefgym/PendulumPositionNoisy{level}-v0", LEVELS[level][1]
    batch = gym.make_vec(env_id, num_envs=3, vectorization_mode="vector_entry_point")
    alone = gym.make(env_id)
    seen, _ = batch.reset(seed=7)
    one, _ = alone.reset(seed=9)
    rng = np.random.default_rng(0)
    for t in range(n_steps):
        assert np.array_equal(seen[2], one)
        actions = rng.uniform(-2.0, 2.0, (3, 1)).astype(np.float32)
        seen, rewards, _, truncated, _ = batch.step(actions)
        one, reward, terminated, ended, _ = alone.step(actions[2])
        assert reward == rewards[2]
        assert not terminated
        assert bool(truncated[2]) == ended == (t + 1 == n_steps)


def test_noise_hides_the_position_and_changes_neither_motion_nor_reward():
    noisy, plain = (gym.make(f"beliefgym/PendulumPosition{kind}-v0") for kind in ("NoisyHard", ""))
    seen, exact = noisy.reset(seed=3)[0], plain.reset(seed=3)[0]
    for _ in range(20):
        assert not np.array_equal(seen, exact)
        assert np.array_equal(noisy.unwrapped.state, plain.unwrapped.state)
        action = plain.action_space.sample()
        (seen, reward, *_), (exact, expected, *_) = noisy.step(action), plain.step(action)
        assert reward == expected


def test_the_noise_is_a_parameter():
    env = gym.make("beliefgym/PendulumPositionNoisyHard-v0", noise=0.0)
    plain = gym.make("beliefgym/PendulumPosition-v0")
    assert np.array_equal(env.reset(seed=3)[0], plain.reset(seed=3)[0])
