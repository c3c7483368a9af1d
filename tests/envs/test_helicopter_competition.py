"""The competition's helicopter against scipy's rotations, its gust's statistics, its price of a crash, its expert."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import beliefgym  # noqa: F401
from beliefgym.envs import HelicopterCompetition

DOWN = np.array([0.0, 0.0, 9.81])


def flying_states(n, seed=0):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(n, 20))
    state[:, 9:13] /= np.linalg.norm(state[:, 9:13], axis=1)[:, None]
    state[:, 19] = rng.integers(0, 6000, n)
    return state


def step_with_scipy(state, action, noise, multiplier, wind):
    """Ten Euler substeps of 0.01 s, with rotation objects."""
    sigma = np.array([0.1941, 0.2975, 0.6058, 0.1508, 0.2492, 0.0734])
    velocity, position, rates = state[:, :3], state[:, 3:6], state[:, 6:9]
    attitude = Rotation.from_quat(state[:, 9:13])
    gust = 0.8 * state[:, 13:19] + 0.2 * multiplier * sigma * noise
    for _ in range(10):
        u, v, w = attitude.inv().apply(velocity).T
        body = np.stack(
            [
                -0.18 * (u + wind[0]) + gust[:, 0],
                -0.43 * (v + wind[1]) - 0.54 + gust[:, 1],
                -0.49 * w - 42.15 * action[:, 3] + gust[:, 2],
            ],
            axis=1,
        )
        turning = -np.array([12.78, 10.12, 8.16]) * rates
        turning += np.array([33.04, -33.32, 70.54]) * action[:, :3] + gust[:, 3:]
        position = position + 0.01 * velocity
        velocity = velocity + 0.01 * (attitude.apply(body) + DOWN)
        attitude = attitude * Rotation.from_rotvec(0.01 * rates)
        rates = rates + 0.01 * turning
    q = attitude.as_quat()
    q *= np.sign((q * state[:, 9:13]).sum(axis=1))[:, None]
    return np.concatenate([velocity, position, rates, q, gust, state[:, 19:] + 1.0], axis=1)


def test_a_step_is_ten_substeps_with_an_independent_rotation():
    system, rng = HelicopterCompetition(wind=(3.0, -2.0)), np.random.default_rng(1)
    state, action, noise = flying_states(200), rng.uniform(-1.0, 1.0, (200, 4)), rng.normal(size=(200, 6))
    expected = step_with_scipy(state, action, noise, 2.0, (3.0, -2.0))
    # roundings of numbers up to 10, ten times
    assert system.step(state, action, noise) == pytest.approx(expected, abs=1e-12)


def test_observations_are_in_body_axes():
    system, state = HelicopterCompetition(), flying_states(100)
    attitude = Rotation.from_quat(state[:, 9:13]).inv()
    expected = [attitude.apply(state[:, :3]), attitude.apply(state[:, 3:6]), state[:, 6:9], state[:, 9:12]]
    seen = system.observe(state)
    assert seen == pytest.approx(np.concatenate(expected, axis=1), abs=1e-14)
    assert system.stage_cost(state, None) == pytest.approx((seen**2).sum(axis=1), rel=1e-12)


def test_turning_the_world_about_the_vertical_changes_nothing_that_is_felt():
    system, rng = HelicopterCompetition(), np.random.default_rng(2)
    state = flying_states(50)
    yaw = Rotation.from_rotvec([0.0, 0.0, 0.7])
    turned = state.copy()
    turned[:, :3], turned[:, 3:6] = yaw.apply(state[:, :3]), yaw.apply(state[:, 3:6])
    turned[:, 9:13] = (yaw * Rotation.from_quat(state[:, 9:13])).as_quat()
    for _ in range(30):
        action, noise = rng.uniform(-0.3, 0.3, (50, 4)), rng.normal(size=(50, 6))
        state, turned = system.step(state, action, noise), system.step(turned, action, noise)
    assert system.observe(turned)[:, :9] == pytest.approx(
        system.observe(state)[:, :9], abs=1e-10
    )  # of up to ~100
    assert np.linalg.norm(turned[:, 9:13], axis=1) == pytest.approx(1.0, abs=1e-9)


def test_trim_stays_also_in_wind():
    for wind in ((0.0, 0.0), (4.0, -3.0)):
        system = HelicopterCompetition(wind=wind)
        after = system.flow(system.trim, system.trim_action)
        assert after[:19] == pytest.approx(system.trim[:19], abs=1e-14)
        assert after[19] == 1.0


@pytest.mark.parametrize("multiplier", [1.0, 2.0])
def test_the_gusts_settle_at_their_standard_deviation(multiplier):
    """n' = 0.8 n + 0.2 s e has the standard deviation 0.2 s / sqrt(1 - 0.64) = s / 3."""
    system, rng = HelicopterCompetition(gust_multiplier=multiplier), np.random.default_rng(3)
    n = 20_000
    state = np.zeros((n, 20))
    state[:, 12] = 1.0
    for _ in range(30):  # 0.8^30 = 1e-3 of the start is left
        state = system.step(state, np.zeros((n, 4)), rng.standard_normal((n, 6)))
    expected = multiplier * np.array([0.1941, 0.2975, 0.6058, 0.1508, 0.2492, 0.0734]) / 3.0
    assert state[:, 13:19].std(axis=0) == pytest.approx(expected, rel=0.02)  # 4 standard errors


def test_a_crash_costs_the_worst_reward_for_each_step_left():
    env = gym.make("beliefgym/HelicopterCompetition-v0", gust_multiplier=0.0)
    state = np.zeros(20)
    state[12], state[0], state[3], state[19] = 1.0, 4.0, 19.9, 5990.0
    env.reset(options={"state": state})
    _, reward, terminated, _, _ = env.step(env.unwrapped.system.trim_action)
    assert terminated
    worst = -(3 * 20.0**2 + 3 * 5.0**2 + 3 * (4 * np.pi) ** 2 + 1 - np.cos(np.radians(15.0)) ** 2)
    assert reward == pytest.approx(10 * worst)
    state[3] = 19.0
    env.reset(options={"state": state})
    observation, reward, terminated, _, _ = env.step(env.unwrapped.system.trim_action)
    assert not terminated
    assert reward == pytest.approx(-(observation.astype(float) ** 2).sum(), rel=1e-5)  # float32
    assert reward > worst


def test_each_limit_ends_the_episode():
    system = HelicopterCompetition()
    state = np.zeros((9, 20))
    state[:, 12] = 1.0
    state[1, 1], state[2, 1] = -5.01, -4.99
    state[3, 5], state[4, 5] = 20.01, 19.99
    state[5, 8], state[6, 8] = 4.01 * np.pi, 3.99 * np.pi
    for row, turn in ((7, 30.1), (8, 29.9)):
        state[row, 9:13] = Rotation.from_euler("x", turn, degrees=True).as_quat()
    assert np.asarray(system.terminated(state)).tolist() == [0, 1, 0, 1, 0, 1, 0, 1, 0]


def test_the_expert_flies_all_six_thousand_steps():
    n = 20
    env = gym.make_vec(
        "beliefgym/HelicopterCompetition-v0",
        n,
        vectorization_mode="vector_entry_point",
        autoreset_mode="DISABLED",
    )
    env.reset(seed=0)
    expert, returns = env.unwrapped.system.expert(), np.zeros(n)
    for t in range(6000):
        _, reward, terminated, truncated, _ = env.step(expert.act(env.unwrapped.state))
        returns += reward
        assert not terminated.any()
        assert truncated.all() == (t == 5999)
    assert returns.min() > -150.0  # a mean error of 0.16 over all twelve


def test_the_expert_uses_the_gust_that_it_knows():
    """Blind to the gust it does worse."""
    system = HelicopterCompetition()
    expert, rng, costs = system.expert(), np.random.default_rng(4), []
    for blind in (False, True):
        state, cost = np.tile(system.trim, (100, 1)), 0.0
        for _ in range(300):
            seen = state.copy()
            if blind:
                seen[:, 13:19] = 0.0
            state = system.step(state, expert.act(seen), rng.standard_normal((100, 6)))
            cost += system.stage_cost(state, None).mean()
        costs.append(cost)
    assert costs[0] < 0.8 * costs[1]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"wind": (6.0, 0.0)}, "expected wind within -5..5 m/s"),
        ({"gust_memory": 1.5}, "expected gust_memory within 0..1"),
        ({"gust_std": (1.0,)}, "expected 6 gust_std and 2 wind"),
        ({"max_rate": 0.0}, "expected max_rate above 0"),
        ({"start_distance": 21.0}, "expected start_distance up to max_position"),
    ],
)
def test_impossible_parameters_are_told(parameters, message):
    with pytest.raises(ValueError, match=message):
        HelicopterCompetition(**parameters)
