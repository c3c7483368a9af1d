"""The helicopter against scipy's rotations, its symmetries, and the check values of its source.

`python tests/envs/test_helicopter.py` prints the table of docs/helicopter-check-values.md.
"""

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import beliefgym  # noqa: F401
from beliefgym.envs import Helicopter, HelicopterFunnel
from beliefgym.envs.planning.lqr import (
    error_basis,
    error_dynamics,
    error_state,
    helicopter_weights,
    hover_expert,
    steady_state_gain,
    trajectory_gains,
)
from beliefgym.envs.random_streams import RandomStreams

UNLIMITED = 1e9  # the source has no limit on the actions


def flying_states(n, seed=0):
    """Any attitudes, velocities and rates."""
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(n, 21))
    state[:, 17:] /= np.linalg.norm(state[:, 17:], axis=1)[:, None]
    return state


def step_with_scipy(state, action, force, torque):
    """The source's step with rotation objects; m = 5 kg, I = 0.3 kg m^2, dt = 0.05 s."""
    u = state[:, :4] + action
    velocity, position, rates = state[:, 8:11], state[:, 11:14], state[:, 14:17]
    attitude = Rotation.from_quat(state[:, 17:])
    ub, vb, wb = attitude.inv().apply(velocity).T
    body = np.stack([-0.048 * ub, -0.57 - 0.12 * vb, 1.21 - 0.0005 * wb - 27.5 * u[:, 3]], axis=1)
    acceleration = attitude.apply(body) + [0.0, 0.0, 9.81] + force / 5.0
    p, q, r = rates.T
    turning = np.stack(
        [
            -0.086 - 3.47 * p + 13.20 * u[:, 0],
            0.015 - 3.06 * q - 9.21 * u[:, 1],
            -0.139 - 2.58 * r + 14.84 * u[:, 2],
        ],
        axis=1,
    )
    turned = (attitude * Rotation.from_rotvec(0.05 * rates)).as_quat()
    turned *= np.sign((turned * state[:, 17:]).sum(axis=1))[:, None]
    return np.concatenate(
        [
            u,
            action,
            velocity + 0.05 * acceleration,
            position + 0.05 * velocity,
            rates + 0.05 * (turning + torque / 0.3),
            turned,
        ],
        axis=1,
    )


def test_a_step_is_the_sources_with_an_independent_rotation():
    system, rng = Helicopter(wrench_noise_std=2.0), np.random.default_rng(1)
    state, action, noise = flying_states(300), rng.uniform(-0.3, 0.3, (300, 4)), rng.normal(size=(300, 6))
    expected = step_with_scipy(state, action, 2.0 * noise[:, :3], 2.0 * noise[:, 3:])
    assert system.step(state, action, noise) == pytest.approx(
        expected, abs=1e-13
    )  # roundings of numbers ~ 10


def test_trim_stays_and_is_the_stated_one():
    system = Helicopter()
    trim = system.trim
    assert trim[:4] == pytest.approx([0.006515, 0.001629, 0.009367, 0.400125], abs=5e-7)  # digits stated
    assert 2.0 * np.arcsin(trim[17]) == pytest.approx(0.058137, abs=5e-7)
    assert system.flow(trim, np.zeros(4)) == pytest.approx(trim, abs=1e-15)


def test_turning_the_world_about_the_vertical_turns_the_flight():
    system, rng = Helicopter(wrench_noise_std=0.0), np.random.default_rng(2)
    state = flying_states(50)
    yaw = Rotation.from_rotvec([0.0, 0.0, 1.1])
    turned = state.copy()
    turned[:, 8:11], turned[:, 11:14] = yaw.apply(state[:, 8:11]), yaw.apply(state[:, 11:14])
    turned[:, 17:] = (yaw * Rotation.from_quat(state[:, 17:])).as_quat()
    for _ in range(100):
        action = rng.uniform(-0.02, 0.02, (50, 4))
        state, turned = system.step(state, action), system.step(turned, action)
    body = [*range(8), 14, 15, 16]
    # 100 steps of roundings, in positions of up to some 1000 m
    assert turned[:, body] == pytest.approx(state[:, body], abs=1e-9)
    assert turned[:, 8:11] == pytest.approx(yaw.apply(state[:, 8:11]), abs=1e-8)
    assert turned[:, 11:14] == pytest.approx(yaw.apply(state[:, 11:14]), abs=1e-8)
    between = Rotation.from_quat(turned[:, 17:]).inv() * yaw * Rotation.from_quat(state[:, 17:])
    assert between.magnitude() == pytest.approx(0.0, abs=1e-9)


def test_the_quaternion_keeps_its_norm():
    """Under the expert, 10,000 steps; also with noise added to the state."""
    for noise, steps in ((0.0, 10_000), (0.001, 500)):
        system, rng = Helicopter(process_noise_std=noise), np.random.default_rng(3)
        state, expert = np.tile(system.trim, (5, 1)), system.expert()
        for _ in range(steps):
            state = system.step(state, expert.act(state), rng.standard_normal((5, system.noise_size)))
        assert not system.terminated(state).any()
        assert np.linalg.norm(state[:, 17:], axis=1) == pytest.approx(1.0, abs=1e-9)


def test_gusts_have_their_standard_deviation_and_frame():
    """At trim the gust force moves the NED velocity by dt n_F / m, whatever the attitude."""
    system, rng = Helicopter(wrench_noise_std=0.7), np.random.default_rng(4)
    n = 40_000
    state = np.tile(system.trim, (n, 1))
    state[:, 17:] = Rotation.random(random_state=0).as_quat()
    noise = rng.standard_normal((n, 6))
    moved = system.step(state, np.zeros((n, 4)), noise) - system.flow(state, np.zeros((n, 4)))
    assert moved[:, 8:11] == pytest.approx(0.05 / 5.0 * 0.7 * noise[:, :3], abs=1e-14)
    assert moved[:, 14:17] == pytest.approx(0.05 / 0.3 * 0.7 * noise[:, 3:], abs=1e-14)


def cost_with_scipy(state):
    """dt dx' Q dx as written in the source."""
    trim = Helicopter().trim
    turn = (Rotation.from_quat(trim[17:]).inv() * Rotation.from_quat(state[:, 17:])).as_quat()[:, :3]
    dx = np.concatenate([state[:, :17] - trim[:17], turn], axis=1)
    q = 0.05 * np.array([0.0] * 4 + [1000.0] * 4 + [1.0] * 12)
    return (q * dx**2).sum(axis=1)


def test_the_cost_is_the_sources_and_the_reward_falls_with_it():
    system, still = Helicopter(), np.zeros((300, 4))
    state = flying_states(300)
    cost = cost_with_scipy(state)
    assert system.stage_cost(state, still) == pytest.approx(cost, rel=1e-12)
    assert system.reward(state, still, state) == pytest.approx(1.0 / (1.0 + cost), rel=1e-12)
    assert system.reward(state[:1], still[:1], system.trim[None]) == pytest.approx(1.0, abs=1e-15)


def test_a_crash_never_pays():
    """Every step in the air earns something: the worst state inside the limits still adds to the return."""
    system = Helicopter()
    rng = np.random.default_rng(5)
    state = flying_states(1000)
    state[:, 8:14] *= 8.0
    state[:, 4:8] = rng.uniform(-0.3, 0.3, (1000, 4))
    state = state[~np.asarray(system.terminated(state))]
    assert len(state) > 100
    assert (system.reward(state, np.zeros((len(state), 4)), state) > 0.0).all()


def test_each_limit_ends_the_episode():
    system = Helicopter()
    states = np.tile(system.trim, (9, 1))
    states[1, 13], states[2, 13] = -20.1, -19.9
    states[3, 8], states[4, 8] = 20.1, 19.9
    states[5, 15], states[6, 15] = -4.01 * np.pi, -3.99 * np.pi
    for row, tilt in ((7, 91.0), (8, 89.0)):
        states[row, 17:] = Rotation.from_euler("ZYX", [40.0, tilt, 0.0], degrees=True).as_quat()
    assert np.asarray(system.terminated(states)).tolist() == [0, 1, 0, 1, 0, 1, 0, 1, 0]


def test_it_starts_evenly_in_a_ball_at_rest():
    system, n = Helicopter(), 4000
    state = system.initial_state(RandomStreams(range(n)))
    distance = np.linalg.norm(state[:, 11:14], axis=1)
    assert distance.max() <= 10.0
    assert ((distance / 10.0) ** 3).mean() == pytest.approx(
        0.5, abs=0.02
    )  # 4 standard errors: .289 / sqrt(4000)
    assert state[:, 11:14].mean(axis=0) == pytest.approx(0.0, abs=0.3)  # 4 x 4.47 / sqrt(4000)
    rest = [i for i in range(21) if not 11 <= i < 14]
    assert state[:, rest] == pytest.approx(np.tile(system.trim[rest], (n, 1)), abs=1e-15)


def test_starts_with_speed_and_turn():
    system = Helicopter(start_speed=2.0, start_turn=0.5)
    state = system.initial_state(RandomStreams(range(2000)))
    speed = np.linalg.norm(state[:, 8:11], axis=1)
    turn = (Rotation.from_quat(state[:, 17:]) * Rotation.from_quat(system.trim[17:]).inv()).magnitude()
    for sizes, largest in ((speed, 2.0), (turn, 0.5)):
        assert 0.95 * largest < sizes.max() <= largest + 1e-12
        assert sizes.mean() == pytest.approx(0.5 * largest, rel=0.06)  # 4 standard errors of a uniform


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"mass": 0.0}, "expected mass above 0"),
        ({"wrench_noise_std": -1.0}, "expected wrench_noise_std finite and at least 0"),
        ({"drag": (1.0, 2.0)}, "expected drag as three numbers"),
        ({"start_distance": 30.0}, "expected start_distance below max_distance"),
        ({"inertia": (0.3, 0.3, 0.0)}, "expected inertia above 0"),
    ],
)
def test_impossible_parameters_are_told(parameters, message):
    with pytest.raises(ValueError, match=message):
        Helicopter(**parameters)


# The regulator


@pytest.mark.parametrize("system", [Helicopter(), HelicopterFunnel()], ids=["hover", "funnel"])
def test_errors_and_their_basis_agree(system):
    """E is the derivative of the state by its error: small moves along E's columns are read back as they were."""
    target = flying_states(20, seed=6)
    if isinstance(system, HelicopterFunnel):
        target = np.concatenate([target, np.arange(20.0)[:, None]], axis=1)
    basis = error_basis(system, target)
    size = system.n_state - 1
    assert basis.swapaxes(1, 2) @ basis == pytest.approx(np.tile(np.eye(size), (20, 1, 1)), abs=1e-14)
    move = 1e-6 * np.random.default_rng(7).normal(size=(20, size))
    near = system.project(target + np.einsum("nij,nj->ni", basis, move))
    assert error_state(system, near, target) == pytest.approx(move, abs=1e-11)  # second order: move^2
    near[:, 17:21] *= -1.0  # the same attitude
    assert error_state(system, near, target) == pytest.approx(move, abs=1e-11)


def test_the_error_model_is_the_sources_finite_difference():
    system = Helicopter()
    a, b, c = error_dynamics(system, system.trim, np.zeros(4), system.trim)
    assert c == pytest.approx(0.0, abs=1e-15)
    step = 1e-5
    for j, dx in enumerate(step * np.eye(20)):
        ends = []
        for sign in (1.0, -1.0):
            state = system.trim.copy()
            state[:17] += sign * dx[:17]
            turn = np.append(sign * dx[17:], np.sqrt(1.0 - dx[17:] @ dx[17:]))
            state[17:] = (Rotation.from_quat(system.trim[17:]) * Rotation.from_quat(turn)).as_quat()
            ends.append(error_state(system, system.flow(state, np.zeros(4)), system.trim))
        assert a[:, j] == pytest.approx((ends[0] - ends[1]) / (2.0 * step), abs=1e-8)
    for j, du in enumerate(np.eye(4)):
        difference = system.flow(system.trim, du) - system.flow(system.trim, -du)
        assert b[:17, j] == pytest.approx(difference[:17] / 2.0, abs=1e-12)  # linear in du


def test_the_regulators_cost_is_its_riccati_matrix():
    """A small error without gusts costs x'Px over a long flight of the true model."""
    system = Helicopter(wrench_noise_std=0.0)
    state_weights, action_weights = helicopter_weights(system)
    a, b, _ = error_dynamics(system, system.trim, np.zeros(4), system.trim)
    gain, _ = steady_state_gain(a, b, np.diag(state_weights), np.diag(action_weights))
    closed = a - b @ gain
    riccati, power = np.zeros((20, 20)), np.eye(20)
    for _ in range(1500):  # the sum of the closed loop's own costs
        riccati += power.T @ (np.diag(state_weights) + gain.T @ np.diag(action_weights) @ gain) @ power
        power = closed @ power
    move = 1e-3 * np.random.default_rng(8).normal(size=(20, 20))
    state = system.project(system.trim + move @ error_basis(system, system.trim).T)
    state[:, 4:8] = 0.0  # du_prev costs nothing afterwards, and counts in the first stage cost
    error = error_state(system, state, system.trim)
    cost, expert = 0.0, system.expert()
    for _ in range(1500):
        cost = cost + system.stage_cost(state, None)
        state = system.step(state, expert.act(state))
    # the model is nonlinear: the cost's third-order part is about 1e-3 of it
    assert cost == pytest.approx(np.einsum("ni,ij,nj->n", error, riccati, error), rel=0.01)


def test_trajectory_gains_solve_the_whole_problem_at_once():
    """Against least squares over all actions of a small random problem with offsets."""
    rng = np.random.default_rng(9)
    steps, n, m = 12, 4, 2
    a, b, c = (
        rng.normal(size=(steps, n, n)) * 0.6,
        rng.normal(size=(steps, n, m)),
        rng.normal(size=(steps, n)),
    )
    q, r = np.diag([1.0, 0.5, 0.0, 2.0]), np.diag([0.3, 0.1])
    start = rng.normal(size=n)
    gains, offsets = trajectory_gains(a, b, c, q, r)
    x, actions = start, []
    for t in range(steps):
        actions.append(-offsets[t] - gains[t] @ x)
        x = a[t] @ x + b[t] @ actions[-1] + c[t]
    # x_t = free_t + effect_t @ all actions
    free, effect = start, np.zeros((n, steps * m))
    rows, goals = [np.kron(np.eye(steps), np.sqrt(r))], [np.zeros(steps * m)]
    for t in range(steps):
        effect = a[t] @ effect
        effect[:, t * m : (t + 1) * m] = b[t]
        free = a[t] @ free + c[t]
        rows.append(np.sqrt(q) @ effect)
        goals.append(-np.sqrt(q) @ free)
    best = np.linalg.lstsq(np.concatenate(rows), np.concatenate(goals), rcond=None)[0]
    assert np.concatenate(actions) == pytest.approx(best, abs=1e-9)


def flown(effort=1.0, n=500, **parameters):
    """Distances at the end, whether terminated, whether an action touched its limit: the registered task."""
    env = gym.make_vec(
        "beliefgym/HelicopterHover-v0",
        n,
        vectorization_mode="vector_entry_point",
        autoreset_mode="DISABLED",
        **parameters,
    )
    env.reset(seed=0)
    system = env.unwrapped.system
    expert, clipped = hover_expert(system, effort), 0
    terminated, ended = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for _ in range(400):
        action = expert.act(env.unwrapped.state)
        clipped += (np.abs(action) >= system.max_change).sum()
        _, _, terminated, truncated, _ = env.step(action)
        ended |= terminated
        if (terminated | truncated).any():
            break
    return np.linalg.norm(env.unwrapped.state[:, 11:14], axis=1), ended, clipped / (400 * 4 * n)


def test_the_expert_comes_home_from_ten_metres():
    distance, terminated, clipped = flown(wrench_noise_std=0.1)
    assert not terminated.any()
    assert (distance < 0.5).mean() >= 0.99
    # at the default gusts it never crashes or touches a limit, but the cost's optimum wanders: as far as from trim
    distance, terminated, clipped = flown()
    wandering, _, _ = flown(start_distance=0.0)
    assert not terminated.any()
    assert clipped == 0.0
    assert np.quantile(distance, 0.99) < 1.8
    assert np.median(distance) == pytest.approx(
        np.median(wandering), rel=0.15
    )  # 3 standard errors of 500 each


def test_with_less_price_on_the_sticks_it_stays_within_half_a_metre():
    """Gusts of 1 N and 1 N m can be held to half a metre, at several times the cost and with wider limits."""
    distance, terminated, clipped = flown(effort=0.01, max_change=1.0)
    assert not terminated.any()
    assert (distance < 0.5).mean() >= 0.99
    assert clipped < 0.01


# The source's check values


def _costs(noise, horizon, delay, n, seed):
    """(n,) costs of the steady-state LQR from trim, seeing the state `delay` steps late."""
    system = Helicopter(wrench_noise_std=noise, max_change=UNLIMITED)
    expert, rng = system.expert(), np.random.default_rng(seed)
    state = np.tile(system.trim, (n, 1))
    seen, cost = [state] * (delay + 1), np.zeros(n)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(horizon):
            action = expert.act(seen.pop(0))
            state = system.step(state, action, rng.standard_normal((n, 6)))
            cost = cost + system.stage_cost(state, action)
            seen.append(state)
    return cost


def _drifts(noise, n, seed):
    """(n,) distances after 400 steps of trim without control."""
    system, rng = Helicopter(wrench_noise_std=noise), np.random.default_rng(seed)
    state = np.tile(system.trim, (n, 1))
    for _ in range(400):
        state = system.step(state, np.zeros((n, 4)), rng.standard_normal((n, 6)))
    return np.linalg.norm(state[:, 11:14], axis=1)


def _of_thirty(values, statistic):
    """Value of a statistic, and the range of 99 % of what 30 runs would give for it."""
    rng = np.random.default_rng(0)
    draws = statistic(rng.choice(values, (4000, 30)), axis=1)
    low, high = np.quantile(draws, [0.005, 0.995])
    return float(statistic(values)), float(low), float(high)


@cache
def check_values(n=2000):
    """Rows (check, stated, ours, low, high): low..high must hold the stated value."""
    system = Helicopter()
    trim = system.trim
    rows = [
        ("trim aileron", 0.006515, trim[0], trim[0] - 5e-7, trim[0] + 5e-7),
        ("trim elevator", 0.001629, trim[1], trim[1] - 5e-7, trim[1] + 5e-7),
        ("trim rudder", 0.009367, trim[2], trim[2] - 5e-7, trim[2] + 5e-7),
        ("trim collective", 0.400125, trim[3], trim[3] - 5e-7, trim[3] + 5e-7),
    ]
    roll = 2.0 * np.arcsin(trim[17])
    rows.append(("trim roll (rad)", 0.058137, roll, roll - 5e-7, roll + 5e-7))
    a, b, _ = error_dynamics(system, trim, np.zeros(4), trim)
    state_weights, action_weights = helicopter_weights(system)
    gain, eigenvalues = steady_state_gain(a, b, np.diag(state_weights), np.diag(action_weights))
    for name, stated, ours in (
        ("closed-loop spectral radius", 0.9751, np.abs(eigenvalues).max()),
        ("Frobenius norm of K", 1.2223, np.linalg.norm(gain)),
    ):
        rows.append((name, stated, ours, ours - 5e-5, ours + 5e-5))
    for noise, horizon, stated in (
        (1.0, 100, 9.92),
        (1.0, 400, 49.3),
        (0.1, 100, 0.103),
        (0.1, 400, 0.469),
    ):
        costs = _costs(noise, horizon, 0, n, seed=horizon)
        rows.append((f"mean cost, gusts {noise:g}, {horizon} steps", stated, *_of_thirty(costs, np.mean)))
    for noise, stated in ((0.1, 94.0), (1.0, 685.0)):
        rows.append(
            (
                f"open loop, gusts {noise:g}: median distance after 400 steps (m)",
                stated,
                *_of_thirty(_drifts(noise, n, seed=1), np.median),
            )
        )
    for delay, stated in ((1, 63.0), (2, 97.0), (3, 1.6e5)):
        costs = _costs(1.0, 400, delay, n, seed=delay)
        rows.append(
            (f"delay {delay}: median cost, gusts 1, 400 steps", stated, *_of_thirty(costs, np.median))
        )
    return rows


@pytest.mark.parametrize("row", range(16))
def test_check_value(row):
    name, stated, ours, low, high = check_values()[row]
    assert low <= stated <= high, f"{name}: stated {stated}, ours {ours} ({low}..{high})"


def test_check_values_are_all_tested():
    assert len(check_values()) == 16


def test_a_delay_of_four_diverges():
    assert np.median(_costs(1.0, 400, 4, 200, seed=4)) > 1e9


# The funnel


def test_the_funnels_target_flies_nose_in():
    system = HelicopterFunnel()
    target = system.targets(np.arange(601))
    attitude = Rotation.from_quat(target[:, 17:21])
    assert np.linalg.norm(target[:, 11:14], axis=1) == pytest.approx(5.0)
    nose = attitude.apply([1.0, 0.0, 0.0])[:, :2]
    to_center = -target[:, 11:13] / 5.0
    assert (nose * to_center).sum(axis=1) == pytest.approx(np.linalg.norm(nose, axis=1), rel=1e-12)
    circling = slice(100, 500)
    assert np.linalg.norm(target[circling, 8:11], axis=1) == pytest.approx(2.0 * np.pi)  # 5 m x 2 pi / 5 s
    assert attitude.apply(target[:, 14:17])[circling, 2] == pytest.approx(0.4 * np.pi)  # yaw rate
    turned = np.unwrap(np.arctan2(-target[:, 12], -target[:, 11]))
    assert turned[-1] - turned[0] == pytest.approx(8.0 * np.pi)
    assert target[[0, 99, 500, 600], 11:14] == pytest.approx(np.tile([-5.0, 0.0, 0.0], (4, 1)), abs=1e-12)
    assert (target[:99, 8:11] == 0.0).all()
    # the quaternion never jumps to its other sign
    assert (target[1:, 17:21] * target[:-1, 17:21]).sum(axis=1).min() > 0.9


def test_the_target_on_the_circle_can_be_flown():
    """One step from a target leads to the next, but for the Euler step's second order in dt (7.9 m/s^2 dt^2 / 2)."""
    system = HelicopterFunnel()
    target = system.targets(np.arange(100, 500))
    reached = system.flow(target, np.zeros((400, 4)))
    off = np.abs(error_state(system, reached[:-1], target[1:]))
    assert off[:, 11:14].max() < 0.5 * 7.9 * 0.05**2 * 1.05
    assert off[:, 8:11].max() < 0.5 * 7.9 * 0.4 * np.pi * 0.05**2 * 1.05
    assert off[:, [0, 1, 2, 3, 14, 15, 16, 17, 18, 19]].max() < 1e-12


def test_errors_seen_in_the_funnel_are_zero_on_target_and_turn_with_it():
    system = HelicopterFunnel()
    steps = np.array([0, 150, 333, 499, 600])
    target = system.targets(steps)
    seen = system.observe(target)
    assert seen[:, 8:17] == pytest.approx(0.0, abs=1e-13)
    assert seen[:, 17:21] == pytest.approx(np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)), abs=1e-13)
    assert seen[:, 21] == pytest.approx(steps / 600.0)
    assert system.stage_cost(target, None) == pytest.approx(0.0, abs=1e-20)
    # 1 m outwards is 1 m backwards, wherever on the circle
    out = target.copy()
    out[:, 11:14] *= 1.2
    assert system.observe(out)[:, 11:14] == pytest.approx(np.tile([-1.0, 0.0, 0.0], (5, 1)), abs=1e-12)
    assert system.stage_cost(out, None) == pytest.approx(0.5)  # dt x 10 x 1 m^2


def test_the_funnels_expert_follows_it():
    env = gym.make_vec(
        "beliefgym/HelicopterFunnel-v0",
        50,
        vectorization_mode="vector_entry_point",
        autoreset_mode="DISABLED",
    )
    env.reset(seed=0)
    system, distance = env.unwrapped.system, []
    expert = system.expert()
    for t in range(600):
        _, _, terminated, truncated, _ = env.step(expert.act(env.unwrapped.state))
        assert not terminated.any()
        assert truncated.all() == (t == 599)
        state = env.unwrapped.state
        distance.append(np.linalg.norm((state - system.targets(state[:, 21]))[:, 11:14], axis=1))
    distance = np.array(distance)
    # 30 steps into the circles the jump of the target's speed is made good
    assert distance[150:480].max() < 0.3
    assert distance[150:480].mean() < 0.06
    assert distance[-1].max() < 0.3


def print_table():
    """The rows of docs/helicopter-check-values.md."""
    print("# The helicopter's check values\n")
    print(
        "Check values of the source's simulator, computed apart from this package, beside ours. Costs and\n"
        "distances come from 30 runs there and 2000 here; the last column is the range that holds 99 % of what\n"
        "30 of our runs give, and the tests ask for the check value to lie in it. For the numbers without\n"
        "chance it is the rounding of the check value's digits.\n"
    )
    print("| check | check value | ours | range |\n|---|---|---|---|")
    for name, stated, ours, low, high in check_values():
        print(f"| {name} | {stated:.6g} | {ours:.6g} | {low:.6g} to {high:.6g} |")
    print(
        f"| delay 4: median cost, gusts 1, 400 steps | diverges | {np.median(_costs(1.0, 400, 4, 200, 4)):.2g} | |"
    )
    print("\nMade by `python tests/envs/test_helicopter.py > docs/helicopter-check-values.md`.")


if __name__ == "__main__":
    print_table()
