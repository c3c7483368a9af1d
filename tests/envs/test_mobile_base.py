"""The differential-drive base against an independent integrator, its symmetries, sensors and expert."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import beliefgym  # noqa: F401
from beliefgym.envs import MobileBase, MobileBaseKinematic
from beliefgym.envs.random_streams import RandomStreams

SYSTEMS = [MobileBase(), MobileBaseKinematic()]
both = pytest.mark.parametrize("system", SYSTEMS, ids=["lag", "kinematic"])


def visited(system, n=50, steps=15, seed=0):
    """States on the way of random commands, and a last command for each."""
    rng = np.random.default_rng(seed)
    low, high = system.action_limits
    state = system.initial_state(RandomStreams(range(n)))
    for _ in range(steps):
        action = rng.uniform(low, high, (n, 2))
        state = system.flow(state, action)
    return state, rng.uniform(low, high, (n, 2))


def test_the_arc_is_the_integral_of_the_unicycle():
    system = MobileBaseKinematic()
    state, action = visited(system)
    action[0, 1], action[1, 1] = 0.0, 1e-5  # straight on, and nearly so
    found = system.flow(state, action)
    for start, (v, w), end in zip(state, action, found, strict=True):
        solution = solve_ivp(
            lambda t, s, v=v, w=w: [v * np.cos(s[2]), v * np.sin(s[2]), w],
            (0.0, system.dt),
            start,
            rtol=1e-12,
            atol=1e-13,
        )
        assert end == pytest.approx(solution.y[:, -1], abs=1e-11)  # the integrator's tolerance


def test_the_lag_follows_its_equations():
    """Written again as a function of time, with the accelerations limited."""
    system = MobileBase(dt=0.01)  # RK4's error at the corner where the limit lets go is of the order of dt^2
    state, action = visited(system, steps=40)
    found = system.flow(state, action)

    def derivative(t, s, command):
        pull = np.clip((command - s[3:]) / 0.15, [-2.5, -3.2], [2.5, 3.2])
        return [s[3] * np.cos(s[2]), s[3] * np.sin(s[2]), s[4], *pull]

    for start, command, end in zip(state, action, found, strict=True):
        solution = solve_ivp(
            derivative, (0.0, 0.01), start, args=(command,), rtol=1e-10, atol=1e-12, max_step=5e-4
        )
        assert end == pytest.approx(solution.y[:, -1], abs=5e-5)  # 2e-5 was seen


def test_accelerations_and_speeds_stay_within_the_limits():
    system = MobileBase()
    state, _ = visited(system, steps=0)
    for _ in range(30):
        moved = system.step(state, np.full((50, 2), 9.0))
        change = moved[:, 3:] - state[:, 3:]
        assert (change <= np.array([2.5, 3.2]) * system.dt + 1e-12).all()
        state = moved
    assert state[:, 3:] == pytest.approx(np.tile([0.5, np.radians(100.0)], (50, 1)), rel=1e-3)


@both
def test_mirror_symmetry(system):
    """Left and right are alike: reflect y, theta, turn rate and the turning command."""
    state, action = visited(system)
    mirror = np.ones(system.n_state)
    mirror[[1, 2]] = -1.0
    if system.n_state == 5:
        mirror[4] = -1.0
    there = system.flow(state * mirror, action * [1.0, -1.0])
    assert there == pytest.approx(system.flow(state, action) * mirror, abs=1e-13)
    assert system.reward(state, action, there) == pytest.approx(
        system.reward(state, action, there * mirror), abs=1e-14
    )


@both
def test_the_plane_has_no_preferred_place_or_direction(system):
    """A start turned and moved gives a path turned and moved."""
    state, action = visited(system)
    turn, shift = 0.8, np.array([0.3, -1.1])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def moved(s):
        t = s.copy()
        t[:, :2] = s[:, :2] @ rotation.T + shift
        t[:, 2] = s[:, 2] + turn
        return t

    assert system.flow(moved(state), action) == pytest.approx(moved(system.flow(state, action)), abs=1e-12)


@both
def test_the_goal_and_the_landmarks_are_where_the_robot_sees_them(system):
    state, _ = visited(system)
    seen = dict(zip(system.observation_names, system.observe(state).T, strict=True))
    for i, (x, y, theta) in enumerate(state[:, :3]):
        into_robot = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
        goal = into_robot @ (-np.array([x, y]))
        assert [seen["goal_forward"][i], seen["goal_left"][i]] == pytest.approx(goal, abs=1e-12)
        for k, landmark in enumerate(system.landmarks, start=1):
            point = into_robot @ (np.array(landmark) - [x, y])
            expected = [np.hypot(*point), *(point / np.hypot(*point))] if point[0] >= 0 else [0.0] * 3
            found = [seen[f"{kind}_{k}"][i] for kind in ("range", "cos_bearing", "sin_bearing")]
            assert found == pytest.approx(expected, abs=1e-9)


def test_a_wider_view_sees_behind():
    state, _ = visited(MobileBase())
    around = MobileBase(field_of_view=2 * np.pi)
    ranges = [around.observation_names.index(f"range_{k}") for k in (1, 2, 3)]
    assert (around.observe(state)[:, ranges] > 0).all()
    assert (MobileBase().observe(state)[:, ranges] == 0).any()


@both
def test_the_expert_arrives_without_noise_and_with_it(system):
    for noise in (0.0, (0.01, 0.03)):
        here = type(system)(actuation_noise_std=noise)
        controller = here.expert()
        state = here.initial_state(RandomStreams(range(500)))
        rng = np.random.default_rng(0)
        for t in range(200):
            action = controller.act(state, np.full(500, t == 0))
            noise_now = rng.standard_normal((500, here.noise_size)) if here.noise_size else None
            state = here.step(state, action, noise_now)
        assert (np.hypot(state[:, 0], state[:, 1]) < 0.05).mean() >= 0.99
        assert np.cos(state[:, 2]).min() > np.cos(0.1)


def test_the_expert_decides_anew_when_an_episode_begins():
    system = MobileBaseKinematic()
    controller = system.expert()
    behind, ahead = np.array([[1.0, 0.0, 0.0]]), np.array([[-1.0, 0.0, 0.0]])
    assert controller.act(behind, np.array([True]))[0, 0] < 0  # backwards
    assert controller.act(ahead, np.array([True]))[0, 0] > 0
    assert controller.act(behind, np.array([False]))[0, 0] < controller.act(ahead)[0, 0]


def test_odometry_noise_is_the_source_s():
    n = 4000
    env = gym.make_vec("beliefgym/MobileBaseNoisy-v0", n, vectorization_mode="vector_entry_point")
    shown, _ = env.reset(seed=0)
    system = env.unwrapped.system
    names = ("goal_forward", "goal_left", "cos_theta", "sin_theta", "velocity", "turn_rate")
    truth = system.observe(env.unwrapped.state)[:, [system.observation_names.index(name) for name in names]]
    # 1.1 % is the standard error of a standard deviation over 4000 draws
    assert (shown - truth).std(axis=0)[:4] == pytest.approx([0.006, 0.006, 0.051, 0.051], rel=0.05)
    assert (shown - truth)[:, 4:] == pytest.approx(0.0, abs=1e-6)


def test_impossible_parameters_are_told():
    with pytest.raises(ValueError, match="expected 3 landmarks"):
        MobileBase(landmarks=((0.0, 1.0),))
    with pytest.raises(ValueError, match=r"wheels can follow .* together ask for 1.29 m/s"):
        MobileBase(max_speed=1.0)
    with pytest.raises(ValueError, match="expected lag above 0, got 0.0 .*MobileBaseKinematic"):
        MobileBase(lag=0.0)
