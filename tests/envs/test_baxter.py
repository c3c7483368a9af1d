"""Baxter's arm against its published table, energy, and its own tasks; the experts reach their targets.

The oracle is written here from the table alone: forward kinematics by scipy's rotations, and the mass matrix and
gravity torques from numerical derivatives of the bodies' places and turns (Lagrange). It shares no line with
serial_arm.py, rigid_body.py or MuJoCo.
"""

import mujoco
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from beliefgym.envs import BaxterReach, BaxterReachHand, SystemEnv
from beliefgym.envs.baxter import NEUTRAL
from beliefgym.envs.baxter_arm import JOINTS, LINKS
from beliefgym.envs.planning import hand_reach_expert, inverse_kinematics, joint_reach_expert
from beliefgym.envs.random_streams import RandomStreams

H = np.pi / 2
MOUNT = ((0.024645, 0.219645, 0.118588), (0.0, 0.0, 0.7854))
# xyz, rpy, mass, com, Ixx, Iyy, Izz, Ixy, Ixz, Iyz of each joint and link; last the hand, which is fixed
TABLE = [
    ((0.055695, 0, 0.011038), (0, 0, 0), 5.70044, (0.01783, 0.00086, 0.19127)),
    ((0.069, 0, 0.27035), (-H, 0, 0), 3.22698, (0.06845, 0.00269, -0.00529)),
    ((0.102, 0, 0), (H, 0, H), 4.31272, (-0.00276, 0.00132, 0.18086)),
    ((0.069, 0, 0.26242), (-H, -H, 0), 2.07206, (0.02611, 0.00159, -0.01117)),
    ((0.10359, 0, 0), (H, 0, H), 2.24665, (-0.00168, 0.0046, 0.13952)),
    ((0.01, 0, 0.2707), (-H, -H, 0), 1.60979, (0.06041, 0.00697, 0.006)),
    ((0.115975, 0, 0), (H, 0, H), 0.35093, (0.00198, 0.00125, 0.01855)),
    ((0, 0, 0.11355), (0, 0, 0), 0.19125, (0.01093, 0.00042, -0.01532)),
]
INERTIAS = [
    (0.0470910, 0.0376698, 0.0359599, 0.00012788, 0.00614870, 0.00078087),
    (0.0117521, 0.0278860, 0.0207875, -0.00030096, 0.00207676, -0.00018822),
    (0.0266173, 0.0284436, 0.0124801, 0.00029271, 0.00392190, 0.00108389),
    (0.00711583, 0.0131823, 0.00926852, 0.00036036, 0.00074595, -0.00019663),
    (0.0166774, 0.0167546, 0.00374631, 0.00018404, 0.00018658, -0.00064732),
    (0.00387607, 0.00700538, 0.00552755, -0.00044385, -0.00021115, 0.00015348),
    (0.00025289, 0.00026886, 0.00030741, 5.753e-6, -1.593e-6, -5.198e-6),
    (0.00017588, 0.00021166, 0.00023745, 1.471e-6, 2.436e-5, 1.727e-6),
]
MASSES = np.array([row[2] for row in TABLE])
LOW = np.array([-1.70168, -2.147, -3.05418, -0.05, -3.059, -1.5708, -3.059])
HIGH = np.array([1.70168, 1.047, 3.05418, 2.618, 3.059, 2.094, 3.059])
EFFORT = np.array([50.0, 100.0, 50.0, 50.0, 15.0, 15.0, 15.0])


def bodies(q):
    """Centres of mass (8, 3), turns (8,) and the hand's place (3,) at angles q, from the table."""
    place, turn = np.array(MOUNT[0]), Rotation.from_euler("xyz", MOUNT[1])
    centres, turns = [], []
    for (xyz, rpy, _, com), angle in zip(TABLE, [*q, 0.0], strict=True):
        place = place + turn.apply(xyz)
        turn = turn * Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec([0.0, 0.0, angle])
        centres.append(place + turn.apply(com))
        turns.append(turn)
    return np.array(centres), turns, place


def potential(q):
    """Energy in the field of gravity in J."""
    return 9.81 * float(MASSES @ bodies(q)[0][:, 2])


def oracle(q, step=1e-5):
    """Gravity torques (7,) and the links' mass matrix (7, 7), by central differences (error ~ 1e-8)."""
    gravity, moved, turned = [], [], []
    for unit in step * np.eye(7):
        (ahead, turns_ahead, _), (behind, turns_behind, _) = bodies(q + unit), bodies(q - unit)
        gravity.append((potential(q + unit) - potential(q - unit)) / (2 * step))
        moved.append((ahead - behind) / (2 * step))
        turned.append(
            [(a * b.inv()).as_rotvec() / (2 * step) for a, b in zip(turns_ahead, turns_behind, strict=True)]
        )
    moved, turned = np.array(moved), np.array(turned)  # (7, 8, 3)
    matrix = np.einsum("b,ibk,jbk->ij", MASSES, moved, moved)
    for b, (xx, yy, zz, xy, xz, yz) in enumerate(INERTIAS):
        turn = bodies(q)[1][b].as_matrix()
        inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        matrix += turned[:, b] @ inertia @ turned[:, b].T
    return np.array(gravity), matrix


CONFIGURATIONS = {
    "stretched": np.zeros(7),
    "neutral": np.array(NEUTRAL),
    "bent": np.array([0.7, -1.3, 1.9, 2.1, -0.8, 1.5, -2.2]),
    "turned": np.array([-1.2, 0.6, -2.4, 0.9, 2.7, -1.1, 0.4]),
}


@pytest.mark.parametrize("q", CONFIGURATIONS.values(), ids=CONFIGURATIONS)
def test_gravity_torques_mass_matrix_and_hand_are_those_of_the_table(q):
    system = BaxterReach()
    gravity, matrix = oracle(q)
    data = mujoco.MjData(system.model)
    data.qpos[:] = q
    mujoco.mj_inverse(system.model, data)
    # 1e-7: the oracle's central differences of energies of ~100 J at a step of 1e-5
    assert data.qfrc_inverse == pytest.approx(gravity, abs=1e-7)
    assert system.arm.gravity_torque(q) == pytest.approx(gravity, abs=1e-7)
    of_mujoco = np.zeros((7, 7))
    mujoco.mj_forward(system.model, data)
    for row, unit in zip(of_mujoco, np.eye(7), strict=True):
        mujoco.mj_mulM(system.model, data, row, unit)
    assert of_mujoco == pytest.approx(matrix + 0.01 * np.eye(7), abs=1e-7)
    assert system.arm.mass_matrix(q) == pytest.approx(matrix + 0.01 * np.eye(7), abs=1e-7)
    assert system.arm.tip_position(q) == pytest.approx(bodies(q)[2], abs=1e-12)
    assert data.site("tip").xpos == pytest.approx(bodies(q)[2], abs=1e-12)


def test_the_model_has_the_tables_masses_limits_and_efforts():
    model = BaxterReach().model
    assert float(sum(model.body_mass)) == pytest.approx(19.71082, abs=1e-12)  # the table's sum, in kg
    assert model.body_mass[model.body_mass > 0] == pytest.approx(MASSES, abs=0)
    assert model.jnt_range == pytest.approx(np.stack([LOW, HIGH], axis=1), abs=0)
    assert model.actuator_ctrlrange == pytest.approx(np.stack([-EFFORT, EFFORT], axis=1), abs=0)
    assert BaxterReach().action_limits[1] == pytest.approx(EFFORT, abs=0)
    assert model.dof_damping == pytest.approx(0.7, abs=0)
    assert BaxterReach(damping=0.0).model.dof_damping == pytest.approx(0.0, abs=0)
    assert model.dof_armature == pytest.approx(0.01, abs=0)
    assert model.opt.timestep == pytest.approx(0.0025, abs=1e-18)
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT


def test_pinocchio_agrees():
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed")
    model = pinocchio.Model()
    joint, place = 0, pinocchio.SE3(pinocchio.rpy.rpyToMatrix(*MOUNT[1]), np.array(MOUNT[0]))
    for i, ((xyz, rpy, mass, com), (xx, yy, zz, xy, xz, yz)) in enumerate(zip(TABLE, INERTIAS, strict=True)):
        at = pinocchio.SE3(pinocchio.rpy.rpyToMatrix(*map(float, rpy)), np.array(xyz, dtype=float))
        if i < 7:
            joint = model.addJoint(joint, pinocchio.JointModelRZ(), place * at, JOINTS[i])
            place = pinocchio.SE3.Identity()
        matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        body = pinocchio.Inertia(mass, np.array(com, dtype=float), matrix)
        model.appendBodyToJoint(joint, body, pinocchio.SE3.Identity() if i < 7 else at)
    rng, arm = np.random.default_rng(0), BaxterReach(damping=0.0, armature=0.0).arm
    for q, v, a in rng.uniform(-1.0, 1.0, (5, 3, 7)):
        expected = pinocchio.rnea(model, model.createData(), q, v, a)
        assert arm.inverse_dynamics(q, v, a) == pytest.approx(expected, abs=1e-9)


def drawn_motions(n, seed=0, speed=2.0):
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [rng.uniform(0.8 * LOW, 0.8 * HIGH, (n, 7)), speed * rng.normal(size=(n, 7))], axis=1
    )


def test_inverse_dynamics_are_mujocos():
    system = BaxterReach()
    motion, acceleration = drawn_motions(20), np.random.default_rng(1).normal(size=(20, 7)) * 10.0
    torques = system.arm.inverse_dynamics(motion[:, :7], motion[:, 7:], acceleration)
    data = mujoco.MjData(system.model)
    for row, a, expected in zip(motion, acceleration, torques, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row[:7], row[7:], a
        mujoco.mj_inverse(system.model, data)
        assert data.qfrc_inverse == pytest.approx(expected, abs=1e-9)


def energy(system, motion):
    """Kinetic energy by the mass matrix, potential energy by the table, in J."""
    kinetic = [0.5 * row[7:] @ system.arm.mass_matrix(row[:7]) @ row[7:] for row in motion]
    return np.array(kinetic) + np.array([potential(row[:7]) for row in motion])


def test_energy_is_conserved_without_damping_torque_and_limits():
    system = BaxterReach(damping=0.0, dt=0.05, substeps=100)
    model = mujoco.MjModel.from_xml_string(system.mjcf())
    model.opt.timestep = 0.05 / 100
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    motion = drawn_motions(4)
    before = energy(system, motion)
    for _ in range(20):
        motion = system.simulate(motion, np.zeros((4, 7)), [model] * 4)
    # the arm falls for a second, exchanging ~100 J; RK4 at 0.5 ms has an error of ~1e-7 of that
    assert abs(potential(motion[0, :7]) - potential(drawn_motions(4)[0, :7])) > 1.0
    assert energy(system, motion) == pytest.approx(before, abs=1e-4)


def test_the_integrator_of_the_task_converges_to_the_same_motion_at_first_order():
    errors = []
    state = drawn_motions(20, speed=1.0)
    exact = BaxterReach(substeps=2000).flow(state, np.zeros((20, 7)))
    for substeps in (20, 40):
        errors.append(
            np.abs(BaxterReach(substeps=substeps).flow(state, np.zeros((20, 7))) - exact)[:, :7].max()
        )
    assert errors[0] < 0.02  # rad after one control period at several rad/s
    assert 1.8 < errors[0] / errors[1] < 2.2


def test_joint_limits_hold_and_full_torques_never_diverge():
    system, rng = BaxterReach(), np.random.default_rng(0)
    state = system.initial_state(RandomStreams(range(64)))
    for t in range(60):
        if t % 5 == 0:
            torque = EFFORT * np.sign(rng.normal(size=(64, 7)))
        state = system.flow(state, torque)
        low, high = system.state_limits
        assert ((state >= low) & (state <= high)).all()


def test_the_noise_is_one_percent_of_the_efforts_and_torques_are_clipped():
    system = BaxterReach()
    assert system.actuation_noise_std == pytest.approx(0.01 * EFFORT)
    assert system.noise_size == 7
    state = drawn_motions(3)
    noise = np.random.default_rng(0).standard_normal((3, 7))
    action = np.array([1e3, -1e3, 5.0, 0.0, 1e3, 0.0, -1e3])
    torque = np.clip(action, -EFFORT, EFFORT) + 0.01 * EFFORT * noise
    data = mujoco.MjData(system.model)
    moved = system.step(state, np.broadcast_to(action, (3, 7)), noise)
    for row, expected, control in zip(state, moved, torque, strict=True):
        mujoco.mj_resetData(system.model, data)
        data.qpos[:], data.qvel[:] = row[:7], row[7:]
        # MuJoCo clips the noisy torque to the efforts once more
        data.ctrl[:] = control
        for _ in range(20):
            mujoco.mj_step(system.model, data)
        assert np.concatenate([data.qpos, data.qvel]) == pytest.approx(expected, abs=1e-9)


def test_rewards_by_hand():
    joint, hand = BaxterReach(), BaxterReachHand()
    at_target = np.concatenate([NEUTRAL, np.zeros(7)])
    still = np.zeros(7)
    assert joint.reward(at_target, still, at_target) == pytest.approx(1.0, abs=1e-12)
    off = at_target.copy()
    off[2] += 0.2  # one joint at half
    off[9] = 3.0  # whose slowness is 0.1
    torque = np.where(np.arange(7) == 1, 50.0, 0.0)  # a quarter, squared, of one joint
    expected = 6.5 / 7 * (0.8 + 0.1 * 6.1 / 7 + 0.1 * (1.0 - 0.25 / 7))
    assert joint.reward(at_target, torque, off) == pytest.approx(expected, abs=1e-12)
    place = bodies(np.array(NEUTRAL))[2]
    state = np.concatenate([at_target, place + np.array([0.06, 0.0, 0.08])])
    assert hand.reward(state, still, state) == pytest.approx(0.5, abs=1e-12)  # 0.1 m away
    assert hand.observe(state)[17:] == pytest.approx(place, abs=1e-12)
    assert hand.observe(state)[:17] == pytest.approx(state, abs=0)
    held = system_torque = joint.arm.gravity_torque(np.array(NEUTRAL))
    assert joint.stage_cost(at_target, held) == pytest.approx(0.0, abs=1e-12)
    cost = 0.2**2 + 0.01 * 3.0**2 + 0.01 * ((system_torque / EFFORT) ** 2).sum()
    assert joint.stage_cost(off, still) == pytest.approx(cost, abs=1e-12)


def test_starts_and_targets_lie_where_the_data_sheet_says():
    system = BaxterReachHand()
    state = system.initial_state(RandomStreams(range(2000)))
    middle, half = 0.5 * (LOW + HIGH), 0.4 * (HIGH - LOW)
    assert (np.abs(state[:, :7] - middle) <= half).all()
    assert (np.abs(state[:, :7] - middle).max(axis=0) > 0.98 * half).all()
    assert (np.abs(state[:, 7:14]) <= 0.1).all()
    target = state[:, 14:]
    assert (target[:, 2] >= -0.1).all()
    assert (target[:, 0] >= 0.3).all()
    assert target.std(axis=0).min() > 0.15  # m: spread over the workspace
    # one copy's draw does not depend on the others, though it may take more rounds
    assert np.array_equal(system.initial_state(RandomStreams([7, 3])), state[[7, 3]])
    with pytest.raises(ValueError, match="found no place for the hand .* got table=3 m"):
        BaxterReachHand(table=3.0).initial_state(RandomStreams([0]))


def test_targets_can_be_reached():
    system = BaxterReachHand()
    state = system.initial_state(RandomStreams(range(300)))
    angles, distance = inverse_kinematics(system.arm, state[:, 14:], state[:, :7])
    assert (distance < 1e-4).all()
    assert ((angles > LOW) & (angles < HIGH)).all()
    for q, target in zip(angles[:5], state[:5, 14:], strict=True):
        assert bodies(q)[2] == pytest.approx(target, abs=1e-4)
    # beyond reach: the nearest that it finds, and it says how far that is
    far = np.array([[3.0, 0.0, 0.3]])
    angles, distance = inverse_kinematics(system.arm, far, state[:1, :7])
    assert distance[0] == pytest.approx(np.linalg.norm(bodies(angles[0])[2] - far[0]), abs=1e-9)
    assert distance[0] > 1.0


@pytest.mark.parametrize("system_class", [BaxterReach, BaxterReachHand])
def test_wrong_parameters_are_told(system_class):
    with pytest.raises(ValueError, match="start_range within 0..1, got 1.2"):
        system_class(start_range=1.2)
    with pytest.raises(ValueError, match="damping of at least 0, got -1.0"):
        system_class(damping=-1.0)


def test_a_wrong_target_is_told():
    with pytest.raises(ValueError, match="expected a target of 7 joint angles, got 2"):
        BaxterReach(target=(0.0, 0.0))
    with pytest.raises(ValueError, match="expected the target of e1 within -0.05..2.618 rad, got -1.0"):
        BaxterReach(target=(0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="expected 's1_angle' within -2.647..1.547, got 2"):
        SystemEnv(BaxterReach).reset(options={"state": [0.0, 2.0, *([0.0] * 12)]})


def run(system, n, steps, noisy):
    """The expert over whole episodes: final states, returns (n,) and every error of the task (steps, n)."""
    state = system.initial_state(RandomStreams(range(n)))
    expert, rng = system.expert(), np.random.default_rng(0)
    total, errors = np.zeros(n), []
    for t in range(steps):
        action = expert.act(state, np.full(n, t == 0))
        assert (np.abs(action) <= EFFORT).all()
        noise = rng.standard_normal((n, 7)) if noisy else None
        moved = system.step(state, action, noise)
        total += system.reward(state, action, moved)
        state = moved
        if isinstance(system, BaxterReach):
            errors.append(np.abs(state[:, :7] - system.target).max(axis=1))
        else:
            errors.append(np.linalg.norm(system.arm.tip_position(state[:, :7]) - state[:, 14:], axis=1))
    return state, total, np.array(errors)


@pytest.mark.parametrize("system_class", [BaxterReach, BaxterReachHand])
def test_experts_reach_the_target_exactly_without_noise(system_class):
    state, _, errors = run(system_class(), 48, 100, noisy=False)
    assert (errors[-1] < 1e-3).all()  # rad or m, of the 1e-2 that the task asks for
    assert np.abs(state[:, 7:14]).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("system_class", [BaxterReach, BaxterReachHand])
@pytest.mark.parametrize("noisy", [False, True], ids=["exact", "noisy"])
def test_experts_reach_the_target_from_500_starts(system_class, noisy):
    _, total, errors = run(system_class(), 500, 200, noisy)
    # Under noise no controller holds the wrist within 1e-2 rad: one step's noise alone turns it by 0.15 N m /
    # 0.7 N m s * 0.05 s ~ 0.008 rad, in three joints.
    bound = 0.05 if noisy and system_class is BaxterReach else 0.01
    assert (errors[-1] < bound).mean() >= 0.99
    assert total.mean() > 185.0  # of 200


def test_the_held_target_costs_what_riccatis_equation_says():
    system = BaxterReach(damping=0.7)
    target = np.concatenate([NEUTRAL, np.zeros(7)])
    a, b = system.transition_derivatives(target, system.arm.gravity_torque(np.array(NEUTRAL)))
    weights = np.diag([1.0] * 7 + [0.01] * 7), np.diag(0.01 / EFFORT**2)
    p = solve_discrete_are(a, b, *weights)
    state = target + 0.01 * np.random.default_rng(0).normal(size=(20, 14)) * ([1.0] * 7 + [2.0] * 7)
    expected = np.einsum("ni,ij,nj->n", state - target, p, state - target)
    expert, cost = joint_reach_expert(system), np.zeros(20)
    for _ in range(200):
        action = expert.act(state)
        cost += system.stage_cost(state, action)
        state = system.flow(state, action)
    assert cost == pytest.approx(expected, rel=0.05)  # the arm is not linear over 0.03 rad


def test_an_expert_keeps_the_copies_apart():
    system = BaxterReachHand()
    state = system.initial_state(RandomStreams(range(6)))
    expert = hand_reach_expert(system)
    first = expert.act(state)
    goals = expert.targets.copy()
    other = system.initial_state(RandomStreams(range(10, 16)))
    restart = np.array([False, True, False, False, True, False])
    expert.act(np.where(restart[:, None], other, state), restart)
    assert np.array_equal((expert.targets != goals).any(axis=1), restart)
    for i in (0, 3):
        assert hand_reach_expert(system).act(state[i : i + 1])[0] == pytest.approx(first[i], abs=1e-9)
    with pytest.raises(ValueError, match=r"expected state as \(n, 17\), got shape \(6, 14\)"):
        expert.act(state[:, :14])
    with pytest.raises(ValueError, match="the state of copy 2 is not finite"):
        expert.act(np.where(np.arange(6)[:, None] == 2, np.nan, state))
    with pytest.raises(ValueError, match=r"expected restart as \(6,\), got shape \(2,\)"):
        expert.act(state, np.zeros(2, dtype=bool))


def test_links_say_what_the_observations_are_called():
    assert tuple(link.joint for link in LINKS) == ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
    assert BaxterReach.state_names[0] == "s0_angle"
    assert BaxterReach.state_names[-1] == "w2_velocity"
    assert len(BaxterReach.state_names) == 14
