"""The quadrotor against scipy's rotations and integrator, conservation laws, symmetry, its sensors and its expert."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import beliefgym  # noqa: F401
from beliefgym.envs import Quadrotor
from beliefgym.envs.planning.quadrotor import steady_hover, without_heading
from beliefgym.envs.random_streams import RandomStreams
from beliefgym.envs.simulation import Simulation

CALM = {
    "max_mean_wind": 0.0,
    "gust_std": 0.0,
    "gyro_bias_std": 0.0,
    "gyro_bias_walk": 0.0,
    "accelerometer_bias_std": 0.0,
}
NO_AIR = {**CALM, "drag": (0.0, 0.0)}


def starts(system: Quadrotor, n: int) -> np.ndarray:
    return system.initial_state(RandomStreams(range(n)))


def hovering(n: int = 1, mass: float = 0.716) -> np.ndarray:
    """(n, 28) at the origin, level, at rest, rotors carrying the weight, no wind, no bias."""
    state = np.zeros((n, 28))
    state[:, 9] = 1.0
    state[:, 13:17] = mass * 9.81 / 4
    return state


def by_name(system: Quadrotor, state: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(system.observation_names, system.observe(state).T, strict=True))


def textbook(system: Quadrotor, action: np.ndarray, wind: np.ndarray):
    """Newton's and Euler's equations of four separate rotors, by matrices and cross products; state of 17 numbers."""
    weight, arm, ratio = system.mass * system.gravity, system.arm, system.yaw_ratio
    places = np.array([[arm, 0, 0], [0, arm, 0], [-arm, 0, 0], [0, -arm, 0]])
    turns = np.array(
        [1.0, -1.0, 1.0, -1.0]
    )  # the body feels the reaction of a clockwise rotor as a positive yaw
    # thrust and torques of four rotors as a matrix, solved for the rotors
    wrench_of = np.stack([np.ones(4), places[:, 1], -places[:, 0], ratio * turns])
    limits = [system.max_tilt_torque, system.max_tilt_torque, system.max_yaw_torque]
    wanted = np.array([weight * (1 + action[0]), *(limits * action[1:])])
    asked = np.clip(np.linalg.solve(wrench_of, wanted), 0.0, system.max_rotor_thrust)
    inertia = np.diag(system.inertia)
    drag = np.diag([system.drag[0], system.drag[0], system.drag[1]])

    def derivative(_, y):
        velocity, rates, rotors = y[3:6], y[10:13], y[13:17]
        turn = Rotation.from_quat(y[6:10]).as_matrix()
        push = drag @ turn.T @ (wind - velocity)
        up = np.array([0.0, 0.0, 1.0])
        acceleration = turn @ (push + rotors.sum() * up) / system.mass - system.gravity * up
        torque = sum(np.cross(place, thrust * up) for place, thrust in zip(places, rotors, strict=True))
        torque = torque + ratio * (turns @ rotors) * up + np.cross(system.rotor_height * up, push)
        spin = np.linalg.solve(inertia, torque - np.cross(rates, inertia @ rates))
        x, y_, z, w = y[6:10]
        rows = np.array([[w, -z, y_], [z, w, -x], [-y_, x, w], [-x, -y_, -z]])
        return np.concatenate(
            [velocity, acceleration, 0.5 * rows @ rates, spin, (asked - rotors) / system.lag]
        )

    return derivative


@pytest.mark.parametrize(
    ("dt", "tolerance"),
    # RK4 and Simpson's rule on the rotors' lag of 0.025 s: the error of a step falls with dt^5
    [(0.02, 3e-4), (0.002, 1e-8)],
)
def test_steps_follow_an_independent_integrator(dt, tolerance):
    system = Quadrotor(dt=dt, rotor_height=0.03, inertia=(0.006, 0.008, 0.012))
    rng = np.random.default_rng(0)
    state = starts(system, 8)
    state[:, 3:6] += rng.normal(size=(8, 3)) * 2.0
    state[:, 10:13] += rng.normal(size=(8, 3))
    for _ in range(4):
        action = rng.uniform(-1.0, 1.0, (8, 4))  # low thrusts with torques meet the rotors' lower limit
        moved = system.flow(state, action)
        for s, u, found in zip(state, action, moved, strict=True):
            exact = solve_ivp(textbook(system, u, s[17:20]), (0, dt), s[:17], rtol=1e-10, atol=1e-11).y[:, -1]
            exact[6:10] /= np.linalg.norm(exact[6:10])
            assert found[:17] == pytest.approx(exact, abs=tolerance)
        state = moved


def test_it_falls_freely_without_thrust_and_air():
    system = Quadrotor(**NO_AIR)
    state = hovering()
    state[:, 3:6] = 0.5, -0.3, 2.0
    state[:, 13:17] = 0.0
    for _ in range(50):
        assert system.observe(state)[0, 25:] == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)  # weightless
        state = system.step(state, np.array([[-1.0, 0.0, 0.0, 0.0]]))
    assert state[0, 3:6] == pytest.approx([0.5, -0.3, 2.0 - 9.81], rel=1e-12)
    assert state[0, :3] == pytest.approx([0.5, -0.3, 2.0 - 9.81 / 2], rel=1e-12)


def test_energy_and_angular_momentum_are_kept_without_thrust_and_air():
    system = Quadrotor(**NO_AIR, inertia=(0.005, 0.008, 0.012))
    state = starts(system, 50)
    state[:, 10:13] = np.random.default_rng(1).normal(size=(50, 3)) * 3.0
    state[:, 13:17] = 0.0
    inertia = np.array(system.inertia)

    def energy(s):
        moving = 0.5 * system.mass * (s[:, 3:6] ** 2).sum(axis=1)
        return moving + 0.5 * (inertia * s[:, 10:13] ** 2).sum(axis=1) + system.mass * 9.81 * s[:, 2]

    def momentum(s):
        return Rotation.from_quat(s[:, 6:10]).apply(inertia * s[:, 10:13])

    before = energy(state), momentum(state)
    for _ in range(200):
        state = system.step(state, np.array([[-1.0, 0.0, 0.0, 0.0]] * 50))
    assert energy(state) == pytest.approx(before[0], rel=1e-4)  # RK4 turning 0.2 rad in a step, for 4 s
    assert momentum(state) == pytest.approx(before[1], abs=1e-4 * np.abs(before[1]).max())
    assert np.abs(state[:, 10:13] - 0).max() > 1.0  # it did tumble


def test_each_command_does_what_its_name_says():
    system = Quadrotor(**NO_AIR)
    body, still = hovering()[:, :13], np.zeros((3, 1))
    for axis, torque in enumerate((0.25, 0.25, 0.03)):
        action = np.zeros((1, 4))
        action[0, 1 + axis] = 1.0
        found = system.derivative(body, system.commands(action), still)[0]
        expected = np.zeros(3)
        expected[axis] = torque / system.inertia[axis]
        assert found[10:13] == pytest.approx(expected, abs=1e-12)
        assert found[5] == pytest.approx(0.0, abs=1e-12)  # no torque costs lift
    lifted = system.derivative(body, system.commands(np.array([[0.3, 0.0, 0.0, 0.0]])), still)[0]
    assert lifted[5] == pytest.approx(0.3 * 9.81)
    names = system.state_names[13:17]
    left = dict(zip(names, system.commands(np.array([[0.0, 1.0, 0.0, 0.0]])), strict=True))
    assert left["rotor_left"] > left["rotor_front"] == left["rotor_back"] > left["rotor_right"]


def test_rotors_stay_within_their_limits():
    system = Quadrotor(max_tilt_torque=2.0)
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 4), axis=-1).reshape(-1, 4)
    asked = np.stack(system.commands(corners), axis=1)
    assert asked.min() == 0.0
    assert asked.max() == system.max_rotor_thrust
    state = hovering(16)
    for _ in range(20):
        state = system.flow(state, corners)
    assert state[:, 13:17] == pytest.approx(asked, abs=1e-6)  # 16 time constants later: e^-16 = 1e-7
    assert state[:, 13:17].min() >= 0.0


def test_the_quaternion_keeps_its_norm_over_ten_thousand_steps():
    simulation = Simulation(Quadrotor(), 16, "quadrotor")  # which goes on where an episode would have ended
    simulation.reset(list(range(16)))
    rng, worst = np.random.default_rng(2), 0.0
    for _ in range(10_000):
        simulation.step(rng.uniform(-1.0, 1.0, (16, 4)))
        worst = max(worst, np.abs(np.linalg.norm(simulation.state[:, 6:10], axis=1) - 1.0).max())
    assert worst < 1e-9
    assert np.abs(simulation.state[:, 10:13]).max() > 5.0  # rad/s


def turned(state: np.ndarray, angle: float) -> np.ndarray:
    """The same states in a world turned about the vertical."""
    turn, result = Rotation.from_euler("z", angle), state.copy()
    for start in (0, 3, 17):
        result[:, start : start + 3] = turn.apply(state[:, start : start + 3])
    mean = turn.apply(np.column_stack([state[:, 20:22], np.zeros(len(state))]))
    result[:, 20:22] = mean[:, :2]
    result[:, 6:10] = (turn * Rotation.from_quat(state[:, 6:10])).as_quat()
    return result


@pytest.mark.parametrize("angle", [0.7, np.pi, -2.5])
def test_no_heading_is_special(angle):
    """Turning the world turns what happens, and changes nothing for sensors, hint, reward and expert."""
    system = Quadrotor(gust_std=0.7)
    state = starts(system, 50)
    rng = np.random.default_rng(3)
    action = rng.uniform(-1.0, 1.0, (50, 4))
    other = turned(state, angle)
    after, other_after = system.flow(state, action), system.flow(other, action)
    sign = np.sign((turned(after, angle)[:, 6:10] * other_after[:, 6:10]).sum(axis=1, keepdims=True))
    other_after[:, 6:10] *= sign  # q and -q are one attitude
    # in between RK4's stages a quaternion is not of norm 1, which the fourth order leaves room for
    assert other_after == pytest.approx(turned(after, angle), abs=1e-6)
    assert system.observe(other)[:, 22:] == pytest.approx(system.observe(state)[:, 22:], abs=1e-12)
    assert system.hint(other) == pytest.approx(system.hint(state), abs=1e-12)
    assert system.reward(other, action, other_after) == pytest.approx(system.reward(state, action, after))
    expert = system.expert()
    assert expert.act(other) == pytest.approx(expert.act(state), abs=1e-9)
    assert without_heading(other) == pytest.approx(without_heading(state), abs=1e-12)


def test_the_accelerometer_reads_g_upwards_in_a_hover_with_and_without_wind():
    system = Quadrotor()
    state, action = steady_hover(system, np.array([[0.0, 0.0], [3.0, -2.0], [0.0, 4.0]]))
    felt = system.observe(state)[:, 25:]
    assert felt[0] == pytest.approx([0.0, 0.0, 9.81], abs=1e-12)
    world = Rotation.from_quat(state[:, 6:10]).apply(felt)
    assert world == pytest.approx(np.tile([0.0, 0.0, 9.81], (3, 1)), abs=1e-12)
    # it leans into the wind: the rotors' axis points against it
    lean = Rotation.from_quat(state[1:, 6:10]).apply([0.0, 0.0, 1.0])[:, :2]
    assert (lean * state[1:, 20:22]).sum(axis=1).max() < -0.1
    assert system.flow(state, action) == pytest.approx(state, abs=1e-12)  # and it stays


def test_the_accelerometer_is_the_acceleration_less_gravity():
    system = Quadrotor(dt=1e-5, **{**CALM, "max_mean_wind": 4.0})
    state = starts(system, 30)
    state[:, 3:6] += np.random.default_rng(4).normal(size=(30, 3)) * 2.0
    after = system.flow(state, np.zeros((30, 4)))
    felt = (after[:, 3:6] - state[:, 3:6]) / system.dt + [0.0, 0.0, 9.81]
    expected = Rotation.from_quat(state[:, 6:10]).inv().apply(felt)
    assert system.observe(state)[:, 25:] == pytest.approx(
        expected, abs=1e-3
    )  # one-sided difference at 1e-5 s


def test_a_tilt_at_rest_in_still_air_is_not_seen_by_the_accelerometer():
    """What makes attitude estimation on a quadrotor hard: only the drag that follows tells."""
    system = Quadrotor(**CALM)
    state = hovering()
    state[0, 6:10] = Rotation.from_euler("ZYX", [0.0, 0.2, -0.1]).as_quat()
    assert system.observe(state)[0, 25:] == pytest.approx([0.0, 0.0, 9.81], abs=1e-12)


def test_the_biases_are_on_the_sensors_and_only_there():
    system = Quadrotor()
    state = hovering(1, system.mass)
    state[0, 10:13] = 0.1, 0.2, 0.3
    state[0, 22:28] = 0.01, 0.02, 0.03, 0.4, 0.5, 0.6
    seen = by_name(system, state)
    assert [seen[f"gyro_{axis}"][0] for axis in "xyz"] == pytest.approx([0.11, 0.22, 0.33])
    assert [seen[f"accelerometer_{axis}"][0] for axis in "xyz"] == pytest.approx([0.4, 0.5, 9.81 + 0.6])
    assert seen["roll_rate"][0] == pytest.approx(0.1)
    unbiased = state.copy()
    unbiased[0, 22:28] = 0.0
    action = np.array([[0.1, 0.2, 0.3, 0.4]])
    assert system.flow(state, action)[:, :22] == pytest.approx(system.flow(unbiased, action)[:, :22], abs=0.0)


def test_the_hint_is_scipys_roll_and_pitch():
    system = Quadrotor()
    state = hovering(200)
    state[:, 6:10] = Rotation.random(200, rng=np.random.default_rng(5)).as_quat()
    yaw_pitch_roll = Rotation.from_quat(state[:, 6:10]).as_euler("ZYX")
    # near a pitch of 90 deg the two formulas divide by its cosine, 1e-3 at the closest of these 200
    assert system.hint(state) == pytest.approx(yaw_pitch_roll[:, [2, 1]], abs=1e-9)
    info = gym.make("beliefgym/QuadrotorHoverIMU-v0", hint=True).reset(seed=0)[1]
    assert info["hint"].shape == (2,)


def test_wind_and_biases_have_their_declared_spread():
    system = Quadrotor(gust_std=1.5, gust_time=0.4, gyro_bias_std=0.02, gyro_bias_walk=0.01)
    n, steps = 4000, 40
    rng = np.random.default_rng(6)
    first = state = starts(system, n)
    gusts = [state[:, 17:20] - np.column_stack([state[:, 20:22], np.zeros(n)])]
    for _ in range(steps):
        # the air does not depend on the motion, so the vehicle may as well stand still
        moved = system.step(first, np.zeros((n, 4)), rng.standard_normal((n, system.noise_size)))
        assert np.array_equal(moved[:, 20:22], first[:, 20:22])
        assert np.array_equal(moved[:, 25:28], first[:, 25:28])
        state = np.concatenate([hovering(n)[:, :17], moved[:, 17:]], axis=1)
        first = state
        gusts.append(state[:, 17:20] - np.column_stack([state[:, 20:22], np.zeros(n)]))
    # 4000 samples: a std is known to 1.1 %, a correlation to 1.6 %; four times that
    for moment in (0, steps // 2, steps):
        assert gusts[moment].std(axis=0) == pytest.approx([1.5] * 3, rel=0.05)
        assert np.abs(gusts[moment].mean(axis=0)).max() < 0.1
    lag = round(system.gust_time / system.dt)
    correlation = (gusts[10] * gusts[10 + lag]).mean(axis=0) / 1.5**2
    assert correlation == pytest.approx([np.exp(-1.0)] * 3, abs=0.065)
    expected = np.sqrt(0.02**2 + 0.01**2 * steps * system.dt)
    assert state[:, 22:25].std(axis=0) == pytest.approx([expected] * 3, rel=0.05)


def test_it_starts_as_declared():
    system = Quadrotor()
    state = starts(system, 4000)
    distance, speed = np.linalg.norm(state[:, :3], axis=1), np.linalg.norm(state[:, 20:22], axis=1)
    assert distance.max() <= 1.0
    assert distance.mean() == pytest.approx(0.75, abs=0.02)  # even in a ball: 3/4 of the radius
    assert np.linalg.norm(state[:, 3:6], axis=1).max() <= 0.5
    assert np.linalg.norm(state[:, 10:13], axis=1).max() <= 0.5
    assert speed.mean() == pytest.approx(2.0, abs=0.1)
    turn = Rotation.from_quat(state[:, 6:10])
    tilt = np.arccos(turn.apply([0.0, 0.0, 1.0])[:, 2])
    assert tilt.max() <= 0.3 + 1e-9
    assert tilt.mean() == pytest.approx(0.15, abs=0.01)
    assert state[:, 13:17] == pytest.approx(0.716 * 9.81 / 4)
    assert state[:, 25:28].std(axis=0) == pytest.approx([0.05] * 3, rel=0.05)
    straight = starts(Quadrotor(start_tilt=0.0), 1000)
    yaw = Rotation.from_quat(straight[:, 6:10]).as_euler("ZYX")[:, 0]
    assert np.abs(yaw).max() <= 0.5
    assert yaw.std() == pytest.approx(0.5 / np.sqrt(3), rel=0.1)


def test_the_reward_is_one_in_a_still_hover_and_as_the_data_sheet_says():
    system = Quadrotor()
    assert system.reward(hovering(), np.zeros((1, 4)), hovering())[0] == pytest.approx(1.0)
    rng = np.random.default_rng(7)
    state, action = starts(system, 300), rng.uniform(-1.0, 1.0, (300, 4))
    state[:, :6] *= 3.0
    state[:, 6:10] = Rotation.random(300, rng=rng).as_quat()
    d, v, w, u = (np.linalg.norm(a, axis=1) for a in (state[:, :3], state[:, 3:6], state[:, 10:13], action))
    upright = Rotation.from_quat(state[:, 6:10]).as_matrix()[:, 2, 2]
    near, level = 1 / (1 + (d / 0.5) ** 2), (1 + upright) / 2
    rest = (1 + 1 / (1 + v**2)) / 2 * (1 + 1 / (1 + (w / 3) ** 2)) / 2 * (9 + 1 / (1 + u**2)) / 10
    reward = system.reward(state, action, state)
    assert reward == pytest.approx(near * level * rest, rel=1e-12)
    assert ((reward >= 0.0) & (reward <= 1.0)).all()


def test_the_stage_cost_is_the_lack_of_reward_near_the_hover():
    system = Quadrotor()
    rng = np.random.default_rng(8)
    state = hovering(100)
    state[:, [*range(6), *range(10, 13)]] += 0.01 * rng.normal(size=(100, 9))
    state[:, 6:10] = Rotation.from_rotvec(0.01 * rng.normal(size=(100, 3))).as_quat()
    action = 0.01 * rng.normal(size=(100, 4))
    lack = 1.0 - system.reward(state, action, state)
    # the terms left out are of fourth order: of 0.01, relative to squares, some 1e-2 of them
    assert system.stage_cost(state, action) == pytest.approx(lack, rel=2e-2)


def test_distance_and_tilt_end_an_episode():
    system = Quadrotor()
    state = hovering(4)
    state[1, :3] = 6.0, 6.0, 6.0  # 10.4 m
    state[2, 6:10] = Rotation.from_euler("ZYX", [0.3, 1.5, 0.0]).as_quat()
    state[3, 6:10] = Rotation.from_euler("ZYX", [0.3, 0.0, 1.6]).as_quat()
    assert system.terminated(state).tolist() == [False, True, False, True]
    env = gym.make("beliefgym/QuadrotorHover-v0")
    env.reset(seed=0)
    ended = [env.step(np.array([0.0, 1.0, 0.0, 0.0]))[2] for _ in range(40)]
    assert ended.index(True) > 5  # a full roll torque turns it over in well under a second


def test_the_expert_hovers_in_the_wind():
    env = gym.make_vec("beliefgym/QuadrotorHover-v0", 500, vectorization_mode="vector_entry_point")
    assert env.unwrapped.kernel_name == "numba"
    env.reset(seed=0)
    expert = env.unwrapped.system.expert()
    total, ended = np.zeros(500), np.zeros(500, dtype=bool)
    for _ in range(499):  # the last step would start the next episode
        _, reward, terminated, truncated, _ = env.step(expert.act(env.unwrapped.state))
        total, ended = total + reward, ended | terminated | truncated
    distance = np.linalg.norm(env.unwrapped.state[:, :3], axis=1)
    assert not ended.any()
    assert (distance < 0.2).mean() >= 0.99
    assert distance.mean() < 0.02  # a few mm to cm under gusts of 1 m/s
    assert total.mean() > 450.0


def test_the_expert_hovers_from_far_away_and_any_heading():
    system = Quadrotor(start_distance=3.0, start_speed=1.0, start_tilt=0.6, start_yaw=np.pi, start_rate=1.0)
    expert, streams = system.expert(), RandomStreams(range(200))
    state = system.initial_state(streams)
    for _ in range(500):
        state = system.step(state, expert.act(state), streams.normal(system.noise_size))
        assert not system.terminated(state).any()
    assert np.linalg.norm(state[:, :3], axis=1).max() < 0.2


def test_the_ids_show_what_they_say():
    imu = [f"{sensor}_{axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz"]
    position = [f"position_{axis}" for axis in "xyz"]
    shown = {
        suffix: list(gym.make(f"beliefgym/QuadrotorHover{suffix}-v0").unwrapped.observation_names)
        for suffix in ("", "IMU", "IMUPosition")
    }
    assert shown["IMU"] == imu
    assert shown["IMUPosition"] == position + imu
    assert shown[""] == list(Quadrotor.observation_names[:22])
    assert gym.spec("beliefgym/QuadrotorHoverIMU-v0").max_episode_steps == 500


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"mass": 0.0}, "expected mass above 0, got 0.0"),
        ({"gust_std": -1.0}, "expected gust_std finite and at least 0"),
        ({"inertia": (1.0, 1.0)}, "expected inertia as three numbers above 0"),
        ({"drag": (0.1, -0.1)}, "expected drag as two numbers of at least 0"),
        ({"max_rotor_thrust": 1.5}, "expected four rotors that lift more than the weight of 7.02 N"),
        ({"start_distance": 12.0}, "expected start_distance below max_distance, got 12 and 10"),
    ],
)
def test_impossible_parameters_are_told(wrong, message):
    with pytest.raises(ValueError, match=message):
        Quadrotor(**wrong)
