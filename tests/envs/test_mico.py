"""The payload lift: the arm against kinematics and energies written anew, the payload in every term, the task."""

import copy
from functools import cache
from xml.etree import ElementTree

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import beliefgym  # noqa: F401
from beliefgym.envs import MicoLift
from beliefgym.envs.mico_arm import EFFORTS, LINKS, TIP, cylinder
from beliefgym.envs.payload_models import PayloadModels
from beliefgym.envs.planning.mico import PayloadFeedforward, mico_arm
from beliefgym.envs.random_streams import RandomStreams

QUIET = MicoLift(actuation_noise_std=0.0)
MASSES = np.array([0.045, 0.2, 0.355])


def poses(n=20, seed=0):
    """(n, 6) joint angles within the ranges."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-3, 1, 0.8, -3, -3, -3], [3, 5.2, 5.4, 3, 3, 3], (n, 6))


def turn(axis, angle):
    """Rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return matrix


def bodies(angles, payload):
    """Mass, place, rotation and inertia of every moving body, by a chain of its own: [(m, (3,), (3, 3), (3, 3))]."""
    place, frame, found = np.zeros(3), np.eye(3), []
    for item, angle in zip((*LINKS, TIP), (*angles, 0.0), strict=True):
        place = place + frame @ item.xyz
        roll, pitch, yaw = item.rpy
        frame = frame @ turn(2, yaw) @ turn(1, pitch) @ turn(0, roll) @ turn(2, angle)
        found.append((item.mass, place + frame @ item.com, frame, np.diag(item.inertia[:3])))
    return [*found, (payload, place, frame, np.zeros((3, 3)))]


def potential_energy(angles, payload):
    return 9.81 * sum(mass * place[2] for mass, place, _, _ in bodies(angles, payload))


def kinetic_energy(angles, velocities, payload, armature):
    """From the bodies' places and rotations a moment before and after."""
    h = 1e-6
    before, after = (bodies(angles + sign * h * velocities, payload) for sign in (-1, 1))
    energy = 0.5 * armature * (velocities**2).sum()
    for (mass, p0, r0, inertia), (_, p1, r1, _) in zip(before, after, strict=True):
        velocity = (p1 - p0) / (2 * h)
        skew = (0.5 * (r0 + r1)).T @ (r1 - r0) / (2 * h)  # R'dR/dt: the spin in the body's axes
        spin = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        energy += 0.5 * mass * velocity @ velocity + 0.5 * spin @ inertia @ spin
    return energy


def gradient(function, at, h=1e-6):
    return np.array([(function(at + h * e) - function(at - h * e)) / (2 * h) for e in np.eye(len(at))])


def bias_and_mass(model, angles, velocities=None):
    """MuJoCo's own c + g (6,) and M (6, 6)."""
    data = mujoco.MjData(model)
    data.qpos[:] = angles
    data.qvel[:] = 0.0 if velocities is None else velocities
    mujoco.mj_forward(model, data)
    matrix = np.zeros((6, 6))
    mujoco.mj_fullM(model, data, matrix)
    return data.qfrc_bias.copy(), matrix


def compiled_with(mass):
    """The model compiled from XML in which the payload has its mass already."""
    root = ElementTree.fromstring(QUIET.mjcf())
    root.find(".//body[@name='payload']/inertial").set("mass", repr(mass))
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.option.timestep = QUIET.dt / QUIET.substeps
    return spec.compile()


@cache
def run(controller, copies=200):
    """Returns (copies,), last errors (copies, 6), greatest speeds and torques (6,): of a whole episode."""
    if controller == "none":
        act = lambda state: np.zeros((len(state), 6))  # noqa: E731
    else:
        act = PayloadFeedforward(QUIET, None if controller == "expert" else controller).act
    system = MicoLift()
    streams = RandomStreams(range(copies))
    state, total = system.initial_state(streams), np.zeros(copies)
    speed, torque = np.zeros(6), np.zeros(6)
    for _ in range(160):
        action = act(state)
        moved = system.step(state, action, streams.normal(system.noise_size))
        total += system.reward(state, action, moved)
        state = moved
        speed = np.maximum(speed, np.abs(state[:, 6:12]).max(axis=0))
        torque = np.maximum(torque, np.abs(state[:, 12:18]).max(axis=0))
    return total, np.abs(system.tracking_error(state)), speed, torque


def lifted(masses, steps=160, starts=None):
    """States after some steps without noise or action, one copy a mass."""
    state = QUIET.initial_state(RandomStreams(range(len(masses)) if starts is None else starts))
    state[:, 18] = masses
    for _ in range(steps):
        state = QUIET.step(state, np.zeros((len(masses), 6)))
    return state


def test_the_table_has_the_robots_masses_and_cylinders():
    # the sum of the description's masses, with base and four finger links
    assert QUIET.model.body_mass.sum() == pytest.approx(4.353954, abs=1e-9)
    # a cylinder of 3 kg, h = 2 m, r = 1 m: m (3 + 4)/12 = 1.75 and m/2 = 1.5
    assert cylinder(3.0, 2.0, 1.0, "y") == pytest.approx((1.75, 1.5, 1.75, 0.0, 0.0, 0.0))
    upper_arm = QUIET.model.body("link_2")
    across = 0.85968 * (3 * 0.03**2 + 0.25**2) / 12
    assert sorted(upper_arm.inertia) == pytest.approx([0.85968 * 0.03**2 / 2, across, across], rel=1e-9)
    assert [item.velocity for item in LINKS] == pytest.approx([0.6283] * 3 + [0.8378] * 3, abs=1e-4)
    assert np.isinf([LINKS[i].high for i in (0, 3, 4, 5)]).all()
    assert [LINKS[1].low, LINKS[1].high, LINKS[2].low, LINKS[2].high] == pytest.approx(
        [0.87266, 5.41052, 0.61087, 5.67232], abs=1e-5
    )


def test_upright_the_tip_is_over_the_base():
    # 0.15675 + 0.11875 + 0.29 + 0.1231 + 2 * 0.06414 + 0.16 = 0.97688 m, all links in a line
    upright = np.array([0.0, np.pi, np.pi, 0.0, 0.0, 0.0])
    data = mujoco.MjData(QUIET.model)
    data.qpos[:] = upright
    mujoco.mj_forward(QUIET.model, data)
    assert data.site("tip").xpos[2] == pytest.approx(0.97688, abs=5e-6)  # the table's rounding
    assert data.site("tip").xpos == pytest.approx(bodies(upright, 0.0)[-1][1], abs=1e-12)


@pytest.mark.parametrize("mass", [0.0, 0.355])
def test_gravity_torques_are_the_gradient_of_the_potential_energy(mass):
    model = QUIET.loaded_models(np.array([mass]))[0]
    for angles in poses():
        expected = gradient(lambda q: potential_energy(q, mass), angles)
        # central differences of some 10 J at h = 1e-6: rounding at 1e-9
        assert bias_and_mass(model, angles)[0] == pytest.approx(expected, abs=1e-7)
        assert mico_arm(QUIET).gravity_torque(angles, mass) == pytest.approx(expected, abs=1e-7)


def test_the_payload_enters_the_inertia():
    rng = np.random.default_rng(1)
    arm = mico_arm(QUIET)
    empty = QUIET.loaded_models(np.zeros(1))[0]
    for mass, model in zip(MASSES, QUIET.loaded_models(MASSES), strict=True):
        fresh = compiled_with(float(mass))
        for name in ("body_mass", "body_subtreemass", "dof_M0", "dof_invweight0", "body_invweight0"):
            assert getattr(model, name) == pytest.approx(getattr(fresh, name), rel=1e-9, abs=1e-12), name
        for angles in poses(5):
            velocities = rng.normal(size=6)
            bias, matrix = bias_and_mass(model, angles, velocities)
            for other in zip((bias, matrix), bias_and_mass(fresh, angles, velocities), strict=True):
                assert other[0] == pytest.approx(other[1], abs=1e-12)
            assert matrix == pytest.approx(arm.mass_matrix(angles, mass), abs=1e-10)
            assert bias == pytest.approx(
                arm.inverse_dynamics(angles, velocities, np.zeros(6), mass), abs=1e-9
            )
            # a point mass adds m J'J
            jacobian = gradient(lambda q: bodies(q, 0.0)[-1][1], angles).T
            added = matrix - bias_and_mass(empty, angles)[1]
            assert added == pytest.approx(mass * jacobian.T @ jacobian, abs=1e-8)


def test_a_step_moves_the_loaded_arm():
    state = lifted(MASSES, steps=80)
    action = np.random.default_rng(2).uniform(-0.1, 0.1, (3, 6))
    moved = QUIET.step(state, action)
    times = state[0, 19] + np.arange(5) * 0.01
    for k, mass in enumerate(MASSES):
        r, speed, _ = QUIET.reference(times, state[k, 20:])
        control = r + speed * np.array(QUIET.damping) / QUIET.stiffness + action[k]
        expected = QUIET.simulate(state[k : k + 1, :12], control[None], [compiled_with(float(mass))])[0]
        assert moved[k, :12] == pytest.approx(expected, abs=1e-12)


def test_without_servos_and_weight_compensation_energy_is_conserved():
    model = copy.copy(QUIET.loaded_models(np.array([0.355]))[0])
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
    model.body_gravcomp[:] = 0.0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = 1e-3
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, 2.6, 3.9, 0.2, -0.4, 0.5]
    data.qvel[:] = [0.5, -0.2, 0.4, 1.0, -1.0, 0.5]
    start = data.qpos.copy()

    def energies():
        return potential_energy(data.qpos, 0.355), kinetic_energy(data.qpos, data.qvel, 0.355, 0.02)

    before = energies()
    for _ in range(300):
        mujoco.mj_step(model, data)
    after = energies()
    assert np.abs(data.qpos - start).max() > 0.3  # it has fallen
    assert after[1] - before[1] > 1.0  # J, so that the sum below is a test
    # RK4 at 1 ms; the kinetic energy by differences, 1e-8
    assert sum(after) == pytest.approx(sum(before), abs=1e-5)


def test_torques_at_full_stretch_are_within_the_limits():
    for elbow in (np.pi, LINKS[2].low):
        stretched = np.array([0.0, np.pi / 2, elbow, 0.0, 0.0, 0.0])
        torque = bias_and_mass(QUIET.loaded_models(np.array([0.355]))[0], stretched)[0]
        assert (np.abs(torque) < 0.5 * EFFORTS).all()
    assert np.abs(torque).max() > 1.0
    assert (run("expert", 500)[3] < 0.5 * EFFORTS).all()
    assert (run("none")[3] < 0.5 * EFFORTS).all()


def test_the_motors_give_no_more_than_their_limits():
    state = lifted(MASSES[:1], steps=5)
    state[:, :6] -= 5.0  # a reference far away: K 5 rad = 150 N m
    assert QUIET.step(state, np.zeros((1, 6)))[0, 12] == pytest.approx(EFFORTS[0])


def test_before_the_grasp_nothing_tells_the_mass():
    state = lifted(MASSES, steps=60, starts=[4, 4, 4])
    assert np.ptp(state[:, :18], axis=0).max() == 0.0
    assert state[0, 19] == pytest.approx(QUIET.grasp_time)
    assert np.abs(QUIET.tracking_error(state)).max() < 1e-9  # the arm's own weight is compensated


def test_the_load_shows_in_the_torques_of_the_lift():
    light, heavy = lifted(np.array([0.045, 0.355]), steps=85, starts=[4, 4])
    # 0.31 kg at some 0.5 m: 1.5 N m at the second joint
    assert abs(heavy[13] - light[13]) > 1.0
    assert abs(heavy[14] - light[14]) > 0.5


def test_the_arm_sags_by_the_payloads_weight():
    state = lifted(MASSES)
    for row, mass in zip(state, MASSES, strict=True):
        pull = gradient(lambda q: 9.81 * bodies(q, 0.0)[-1][1][2], row[:6])  # J'g
        # at rest the spring carries the payload; the swing after the lift has decayed to 1e-4 rad within 2.5 s
        assert QUIET.tracking_error(row) == pytest.approx(-mass * pull / QUIET.stiffness, abs=2e-4)


def test_one_instant_of_angles_and_torques_tells_the_mass_and_angles_do_not():
    copies = 400
    masses = np.random.default_rng(3).uniform(0.045, 0.355, copies)
    state = lifted(masses)
    angles, torques = state[:, :6], state[:, 12:18]
    # physics: torque - g_0(q) = m J'g, a regression on one number
    arm = mico_arm(QUIET)
    own = arm.gravity_torque(angles)
    per_kilogram = arm.gravity_torque(angles, np.ones(copies)) - own
    found = (per_kilogram * (torques - own)).sum(axis=1) / (per_kilogram**2).sum(axis=1)
    assert np.abs(found - masses).max() < 2e-4  # kg; the arm is not quite at rest yet

    def held_out_error(*columns):
        """Root mean square error in kg of quadratic regression, fitted on one half."""
        x = np.concatenate(columns, axis=1)
        x = (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-9)
        pairs = [x[:, i] * x[:, j] for i in range(x.shape[1]) for j in range(i + 1)]
        features = np.column_stack([np.ones(copies), x, *pairs])
        half = copies // 2
        weights = np.linalg.lstsq(features[:half], masses[:half], rcond=1e-6)[0]
        return np.sqrt(np.mean((features[half:] @ weights - masses[half:]) ** 2))

    spread = 0.31 / np.sqrt(12.0)  # of the drawn masses
    assert held_out_error(angles) > 0.7 * spread
    assert held_out_error(angles, torques) < 0.05 * spread


def test_the_expert_tracks_and_knowing_the_mass_pays():
    total, error, speed, _ = run("expert", 500)
    assert (error.max(axis=1) < 0.01).mean() >= 0.99
    assert (speed < [item.velocity for item in LINKS]).all()
    guess_total, guess_error, _, _ = run(0.2)
    assert (guess_error.max(axis=1) < 0.01).mean() < 0.5
    assert guess_error.max(axis=1).mean() > 4.0 * error.max(axis=1).mean()
    assert total.mean() > guess_total.mean() + 10.0 > run("none")[0].mean() + 20.0


def test_angles_and_torques_are_enough_to_lift_well():
    """A running mean of the static estimates of the mass, as offsets: it sees no mass, velocity, reference or time."""
    system, arm, copies = MicoLift(), mico_arm(QUIET), 200
    streams = RandomStreams(range(copies))
    state, mass, total = system.initial_state(streams), np.zeros(copies), np.zeros(copies)
    for _ in range(160):
        angles, torques = state[:, :6], state[:, 12:18]
        own = arm.gravity_torque(angles)
        per_kilogram = arm.gravity_torque(angles, np.ones(copies)) - own
        estimate = (per_kilogram * (torques - own)).sum(axis=1) / (per_kilogram**2).sum(axis=1)
        mass += 0.1 * (estimate - mass)
        action = mass[:, None] * per_kilogram / np.array(system.stiffness)
        moved = system.step(state, action, streams.normal(system.noise_size))
        total += system.reward(state, action, moved)
        state = moved
    assert run(0.2)[0].mean() + 15.0 < total.mean() < run("expert", 500)[0].mean() - 5.0
    assert (np.abs(system.tracking_error(state)).max(axis=1) < 0.01).mean() > 0.98


def test_the_expert_says_what_it_cannot_take():
    expert = QUIET.expert()
    with pytest.raises(ValueError, match=r"expected state as \(n, 26\), got shape \(26,\)"):
        expert.act(np.zeros(26))
    with pytest.raises(ValueError, match="the state of copy 1 is not finite"):
        expert.act(np.array([np.zeros(26), np.full(26, np.nan)]))


def test_the_reference_is_a_smooth_lift_within_the_rated_speeds():
    start = np.array(QUIET.pose)
    times = np.linspace(-1.0, 9.0, 2001)
    r, speed, acceleration = QUIET.reference(times, np.broadcast_to(start, (2001, 6)))
    assert r[times < 3.0] == pytest.approx(np.broadcast_to(start, r[times < 3.0].shape))
    assert r[-1] == pytest.approx(start + QUIET.lift)
    # central differences at 5 ms of a curve whose third derivative is below 60 * 0.6 / 2.5^3 = 2.3 rad/s^3
    assert np.gradient(r, times, axis=0)[1:-1] == pytest.approx(speed[1:-1], abs=1e-4)
    assert np.gradient(speed, times, axis=0)[1:-1] == pytest.approx(acceleration[1:-1], abs=1e-2)
    assert (np.abs(speed).max(axis=0) <= 0.72 * np.array([item.velocity for item in LINKS])).all()


def test_the_reward_is_a_half_at_the_tolerance():
    state = lifted(MASSES, steps=3)
    zero = np.zeros((3, 6))
    state[:, :6] = QUIET.reference(state[:, 19], state[:, 20:])[0]
    assert QUIET.reward(state, zero, state) == pytest.approx([1.0, 1.0, 1.0])
    state[:, 1] += 0.6 * QUIET.tolerance
    state[:, 4] -= 0.8 * QUIET.tolerance
    assert QUIET.reward(state, zero, state) == pytest.approx([0.5, 0.5, 0.5])


@pytest.mark.parametrize("mass", [0.0, -0.1, 2.5])
def test_impossible_masses_are_told(mass):
    env = gym.make("beliefgym/MicoLift-v0")
    env.reset(seed=0)
    state = env.unwrapped.state
    state[18] = mass
    with pytest.raises(
        ValueError, match=r"MicoLift-v0: impossible start state .* expected 'payload_mass' within"
    ):
        env.reset(options={"state": state})


def test_any_possible_mass_can_be_set_and_is_the_hint():
    env = gym.make("beliefgym/MicoLiftTorque-v0", hint=True)
    env.reset(seed=0)
    state = env.unwrapped.state
    state[18] = 1.234
    observation, info = env.reset(options={"state": state})
    assert info["hint"] == pytest.approx([1.234])
    assert observation == pytest.approx(state[[*range(6), *range(12, 18)]], abs=1e-6)
    assert env.unwrapped.hint_names == ("payload_mass",)
    for _ in range(5):
        info = env.step(np.zeros(6))[4]
    assert info["hint"] == pytest.approx([1.234])


def test_starts_are_at_rest_within_the_spreads():
    state = QUIET.initial_state(RandomStreams(range(2000)))
    low, high = QUIET.state_limits
    assert ((state >= low) & (state <= high)).all()
    assert np.abs(state[:, :6] - QUIET.pose).max() <= 0.15
    assert np.array_equal(state[:, :6], state[:, 20:])
    assert not state[:, 6:12].any()
    assert state[:, 12:18] == pytest.approx(mico_arm(QUIET).gravity_torque(state[:, :6]), abs=1e-9)
    # 2000 draws: the mean's standard error is 2 g, three of them
    assert state[:, 18].mean() == pytest.approx(0.2, abs=0.006)
    assert 0.045 <= state[:, 18].min() < 0.047 < 0.353 < state[:, 18].max() <= 0.355


def test_a_copy_moves_the_same_in_any_company():
    state = lifted(np.linspace(0.05, 0.35, 40), steps=70)
    action = np.random.default_rng(0).uniform(-0.15, 0.15, (40, 6))
    together = QUIET.step(state, action)
    assert np.array_equal(np.stack([QUIET.step(s, a) for s, a in zip(state, action, strict=True)]), together)
    assert np.array_equal(QUIET.step(state[::-1], action[::-1])[::-1], together)


def test_models_are_made_once_and_the_longest_unused_go():
    models = PayloadModels(QUIET.model, kept=3)
    first = models.of(np.array([0.1, 0.2, 0.1]))
    assert first[0] is first[2]
    assert first[0] is not first[1]
    assert first[1].body("payload").mass == pytest.approx([0.2])
    assert QUIET.model.body("payload").mass == pytest.approx([0.0])  # the system's own is untouched
    models.of(np.array([0.1, 0.3, 0.4]))  # 0.2 was not used for longest
    assert len(models) == 3
    assert models.of(np.array([0.1]))[0] is first[0]
    assert models.of(np.array([0.2]))[0] is not first[1]
    assert len(models.of(np.linspace(0.1, 0.2, 10))) == 10  # a batch larger than what is kept
    assert len(models) == 10


def test_noise_never_makes_a_mass_negative():
    noisy = MicoLift(process_noise_std=(*[0.0] * 18, 0.5, *[0.0] * 7))
    state = lifted(np.full(50, 0.05), steps=62)
    moved = noisy.step(state, np.zeros((50, 6)), np.random.default_rng(0).normal(size=(50, noisy.noise_size)))
    assert moved[:, 18].min() == 0.0
    assert np.isfinite(noisy.step(moved, np.zeros((50, 6)), np.zeros((50, noisy.noise_size)))).all()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"lift_time": 1.0}, "expected a lift within the rated speed of joint_1, 0.628 rad/s, got 1.12"),
        ({"pose": (0.3, 1.95, 4.5)}, "expected pose as 6 numbers, one a joint, got 3"),
        ({"pose": (0.3, 5.2, 4.5, 0, 0, 0)}, "expected every start of joint_2 within"),
        ({"lightest": 0.0}, "expected 0.001 <= lightest <= heaviest <= 2 kg"),
        ({"stiffness": (0.0,) * 6}, "expected stiffness above 0"),
        ({"tolerance": 0.0}, "expected tolerance above 0"),
    ],
)
def test_wrong_parameters_are_told(parameters, message):
    with pytest.raises(ValueError, match=message):
        MicoLift(**parameters)
