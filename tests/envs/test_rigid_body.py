"""The batched rigid-body equations against MuJoCo, for an arm with nothing in line with anything."""

import mujoco
import numpy as np
import pytest
import torch

from beliefgym.envs.rigid_body import RigidArm
from beliefgym.envs.serial_arm import Link, Tip, mjcf

DOF = 6
BASE = {"base_xyz": (0.1, -0.2, 0.3), "base_rpy": (0.3, -0.4, 0.5), "damping": 0.7, "armature": 0.02}


def random_inertia(rng):
    """Six numbers of a body that could exist: principal moments obey the triangle inequality."""
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = axes @ np.diag([0.02, 0.03, 0.04]) @ axes.T
    return tuple(float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))


def three(rng, size):
    return tuple(float(x) for x in size * rng.normal(size=3))


@pytest.fixture(scope="module")
def parts():
    rng = np.random.default_rng(0)
    links = tuple(
        Link(
            joint=f"joint_{i}",
            xyz=three(rng, 0.2),
            rpy=three(rng, 1.0),
            low=-3.0,
            high=3.0,
            effort=50.0,
            velocity=1.0,
            link=f"link_{i}",
            mass=float(1.0 + rng.random()),
            com=three(rng, 0.1),
            inertia=random_inertia(rng),
        )
        for i in range(DOF)
    )
    tip = Tip(
        xyz=three(rng, 0.2), rpy=three(rng, 1.0), mass=0.5, com=three(rng, 0.1), inertia=random_inertia(rng)
    )
    return links, tip


@pytest.fixture(scope="module")
def arm(parts):
    links, tip = parts
    return RigidArm(links=links, tip=tip, **BASE)


@pytest.fixture(scope="module")
def model(parts):
    return mujoco.MjModel.from_xml_string(mjcf("random", *parts, **BASE))


@pytest.fixture(scope="module")
def motions():
    rng = np.random.default_rng(1)
    return (
        rng.uniform(-2.5, 2.5, (20, DOF)),
        rng.normal(size=(20, DOF)) * 3.0,
        rng.normal(size=(20, DOF)) * 10.0,
    )


def mujoco_inverse(model, q, v, a):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse.copy()


def mujoco_mass_matrix(model, q):
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    for column, unit in zip(matrix, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return matrix


def test_inverse_dynamics_are_mujocos(arm, model, motions):
    expected = [mujoco_inverse(model, *motion) for motion in zip(*motions, strict=True)]
    assert arm.inverse_dynamics(*motions) == pytest.approx(np.array(expected), abs=1e-9)  # rounding; ~100 N m


def test_gravity_torques_are_inverse_dynamics_at_rest(arm, model, motions):
    zero = np.zeros(DOF)
    expected = [mujoco_inverse(model, q, zero, zero) for q in motions[0]]
    assert arm.gravity_torque(motions[0]) == pytest.approx(np.array(expected), abs=1e-9)


def test_the_mass_matrix_is_mujocos_and_positive(arm, model, motions):
    matrices = arm.mass_matrix(motions[0])
    assert matrices == pytest.approx(np.array([mujoco_mass_matrix(model, q) for q in motions[0]]), abs=1e-9)
    assert (np.linalg.eigvalsh(matrices) > 0.0199).all()  # at least the armature


def test_accelerations_are_mujocos_and_undo_the_inverse(arm, model, motions):
    q, v, a = motions
    torques = arm.inverse_dynamics(q, v, a)
    assert arm.accelerations(q, v, torques) == pytest.approx(a, abs=1e-8)  # the matrix's condition is ~1e2
    data = mujoco.MjData(model)
    for i in range(5):
        data.qpos[:], data.qvel[:] = q[i], v[i]
        data.qfrc_applied[:] = torques[i]
        mujoco.mj_forward(model, data)
        assert data.qacc == pytest.approx(a[i], abs=1e-6)  # MuJoCo solves for constraints iteratively


def test_the_tip_and_its_jacobian_are_mujocos(arm, model, motions):
    tips, jacobians = arm.tip_jacobian(motions[0])
    data = mujoco.MjData(model)
    for q, tip, jacobian in zip(motions[0], tips, jacobians, strict=True):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        expected = np.zeros((3, DOF))
        mujoco.mj_jacSite(model, data, expected, None, 0)
        assert tip == pytest.approx(data.site("tip").xpos, abs=1e-12)
        assert jacobian == pytest.approx(expected, abs=1e-12)
        joints = np.array([data.joint(f"joint_{i}").xanchor for i in range(DOF)])
        assert arm.joint_positions(q)[:-1] == pytest.approx(joints, abs=1e-12)
    assert arm.tip_position(motions[0]) == pytest.approx(tips, abs=0)


def test_a_payload_is_a_point_mass_at_the_tip(arm, parts, motions):
    links, tip = parts
    masses = np.linspace(0.0, 2.0, len(motions[0]))

    def with_payload(mass):
        def add(root):
            hand = next(body for body in root.iter("body") if body.get("name") == "hand")
            ball = hand.makeelement("body", {"name": "payload"})
            inertia = {"mass": repr(mass), "pos": "0 0 0", "diaginertia": "1e-12 1e-12 1e-12"}
            ball.append(ball.makeelement("inertial", inertia))
            hand.append(ball)

        return mujoco.MjModel.from_xml_string(mjcf("loaded", links, tip, **BASE, extra=add if mass else None))

    models = [with_payload(float(mass)) for mass in masses]
    expected = [mujoco_inverse(m, *motion) for m, *motion in zip(models, *motions, strict=True)]
    assert arm.inverse_dynamics(*motions, masses) == pytest.approx(np.array(expected), abs=1e-9)
    matrices = [mujoco_mass_matrix(m, q) for m, q in zip(models, motions[0], strict=True)]
    assert arm.mass_matrix(motions[0], masses) == pytest.approx(np.array(matrices), abs=1e-9)
    torques = arm.inverse_dynamics(*motions, masses)
    q, v, a = motions
    assert arm.accelerations(q, v, torques, masses) == pytest.approx(a, abs=1e-8)
    # a number serves all copies; no payload is one of 0 kg
    assert arm.gravity_torque(q, 0.7) == pytest.approx(arm.gravity_torque(q, np.full(len(q), 0.7)), abs=1e-12)
    assert arm.gravity_torque(q, 0.0) == pytest.approx(arm.gravity_torque(q), abs=1e-12)
    # its weight: the Jacobian's
    weight = arm.gravity_torque(q, 1.0) - arm.gravity_torque(q)
    assert weight == pytest.approx(9.81 * arm.tip_jacobian(q)[1][:, 2], abs=1e-10)


def test_a_copy_alone_is_as_in_a_batch_and_shapes_broadcast(arm, motions):
    q, v, a = motions
    together = arm.inverse_dynamics(q, v, a)
    for i in range(3):
        assert arm.inverse_dynamics(q[i], v[i], a[i]) == pytest.approx(together[i], abs=1e-10)
    assert np.array_equal(arm.tip_position(q)[3], arm.tip_position(q[3:4])[0])  # bit for bit: it is observed
    nested = arm.inverse_dynamics(q.reshape(4, 5, DOF), v.reshape(4, 5, DOF), np.zeros(DOF))
    assert nested.shape == (4, 5, DOF)
    assert nested.reshape(-1, DOF) == pytest.approx(arm.inverse_dynamics(q, v, 0.0 * a), abs=1e-10)


def test_forward_kinematics_run_on_torch_and_its_derivative_is_the_jacobian(arm, motions):
    q = torch.from_numpy(motions[0][0]).requires_grad_()
    found = torch.autograd.functional.jacobian(arm.tip_position, q).numpy()
    assert found == pytest.approx(arm.tip_jacobian(motions[0][0])[1], abs=1e-12)
