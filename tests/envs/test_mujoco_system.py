"""Batches by MuJoCo's rollout against a plain loop over mj_step, and what may go wrong."""

import multiprocessing
from dataclasses import dataclass, field
from typing import ClassVar

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv

import beliefgym  # noqa: F401
from beliefgym.envs import NonFiniteError, SystemEnv, SystemVectorEnv
from beliefgym.envs.mujoco_system import MujocoSystem

SWING = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body><joint name="shoulder" type="hinge" axis="0 1 0" range="-2 2" damping="0.1" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      <body name="forearm" pos="0.3 0 0"><joint name="elbow" type="{elbow}" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
  <sensor><jointvel joint="shoulder"/><framepos objtype="body" objname="forearm"/></sensor>
</mujoco>
"""


@dataclass(frozen=True, kw_only=True)
class Swing(MujocoSystem):
    """Two hinges; the fifth state component is a constant."""

    dt: float = 0.04
    substeps: int = 8
    elbow: str = field(default="hinge")

    state_names: ClassVar = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity", "load")
    action_names: ClassVar = ("shoulder_torque", "elbow_torque")
    observation_names: ClassVar = state_names

    def mjcf(self):
        return SWING.format(elbow=self.elbow)

    @property
    def action_limits(self):
        return np.full(2, -np.inf), np.full(2, np.inf)

    @property
    def observation_limits(self):
        return np.full(5, -np.inf), np.full(5, np.inf)

    def advance(self, state, action):
        return np.concatenate([self.simulate(state[..., :4], action), state[..., 4:]], axis=-1)

    def observe(self, state):
        return state

    def reward(self, state, action, next_state):
        return -(next_state[..., 0] ** 2)

    def initial_state(self, streams, mask=None):
        return streams.uniform(5, mask)


def drawn(n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 5)), rng.normal(size=(n, 2)) * 2.0


def by_loop(system, state, controls, model=None):
    """One control period of one state (4,) by mj_step; controls (2,) or (substeps, 2)."""
    model = system.model if model is None else model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state[:2], state[2:4]
    for control in np.broadcast_to(controls, (system.substeps, 2)):
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel]), data.sensordata.copy()  # measured at the last step's start


def test_the_rollout_is_a_plain_loop_over_mj_step_bit_for_bit():
    system = Swing()
    assert system.model.opt.timestep == pytest.approx(0.005, abs=0)
    state, action = drawn(40)
    state[:5, 0] = 2.3  # beyond the limit: the constraint solver works too
    moved = system.flow(state, action)
    assert np.array_equal(
        moved[:, :4], [by_loop(system, s, u)[0] for s, u in zip(state, action, strict=True)]
    )
    assert np.array_equal(moved[:, 4], state[:, 4])


def test_controls_for_each_substep_models_for_each_row_and_sensors():
    system = Swing()
    state, _ = drawn(6)
    controls = np.random.default_rng(1).normal(size=(6, system.substeps, 2))
    models = []
    for i in range(6):
        model = mujoco.MjModel.from_xml_string(system.mjcf())
        model.opt.timestep = system.dt / system.substeps
        model.body_mass[2] *= 1.0 + i
        models.append(model)
    moved, sensed = system.simulate_and_sense(state[:, :4], controls, models)
    expected = [by_loop(system, *row) for row in zip(state, controls, models, strict=True)]
    assert np.array_equal(moved, [motion for motion, _ in expected])
    assert np.array_equal(sensed, [values for _, values in expected])
    assert abs(moved[0] - system.simulate(state[:, :4], controls)[0]).max() == 0
    assert abs(moved[1:] - system.simulate(state[:, :4], controls)[1:]).max() > 1e-3


def test_a_copy_moves_the_same_alone_in_a_batch_and_on_any_number_of_threads(monkeypatch):
    system = Swing()
    state, action = drawn(100)
    monkeypatch.setenv("BELIEFGYM_THREADS", "1")
    together = system.flow(state, action)
    for i in (0, 57, 99):
        assert np.array_equal(system.flow(state[i], action[i]), together[i])
    assert np.array_equal(system.flow(state[::-1].copy(), action[::-1].copy())[::-1], together)
    assert np.array_equal(
        system.flow(state.reshape(4, 25, 5), action.reshape(4, 25, 2)).reshape(100, 5), together
    )
    assert system.flow(state[:0], action[:0]).shape == (0, 5)
    for threads in ("2", "3"):
        monkeypatch.setenv("BELIEFGYM_THREADS", threads)
        assert np.array_equal(system.flow(state, action), together)


@pytest.mark.parametrize("wrong", ["0", "-1", "two", "1.5", ""])
def test_a_wrong_number_of_threads_is_told(monkeypatch, wrong):
    monkeypatch.setenv("BELIEFGYM_THREADS", wrong)
    with pytest.raises(ValueError, match="expected BELIEFGYM_THREADS as a whole number of at least 1"):
        Swing().flow(*drawn(2))


def test_torch_gets_the_same_numbers_and_no_gradients():
    system = Swing()
    state, action = drawn(10)
    moved = system.flow(torch.from_numpy(state), torch.from_numpy(action))
    assert isinstance(moved, torch.Tensor)
    assert np.array_equal(moved.numpy(), system.flow(state, action))
    single = system.flow(torch.from_numpy(state).float(), torch.from_numpy(action).float())
    assert single.dtype == torch.float32
    for which in (0, 1):
        tensors = [torch.from_numpy(state), torch.from_numpy(action)]
        tensors[which].requires_grad_()
        with pytest.raises(TypeError, match="torch cannot differentiate; use transition_derivatives"):
            system.flow(*tensors)


def test_transition_derivatives_are_differences_of_the_flow():
    system = Swing()
    state, action = (array[0] for array in drawn(1, seed=3))
    a, b = system.transition_derivatives(state[:4], action)
    point, step = np.concatenate([state[:4], action]), 1e-5
    shifted = point + step * np.concatenate([np.eye(6), -np.eye(6)])
    ends = system.simulate(shifted[:, :4], shifted[:, 4:])
    # both are central differences of a smooth motion: 1e-5 is their own error, with velocities of a few rad/s
    assert np.concatenate([a, b], axis=1) == pytest.approx((ends[:6] - ends[6:]).T / (2 * step), abs=1e-5)


def test_divergence_is_told_with_its_copy_and_step(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings in the working folder
    env = SystemVectorEnv(Swing, num_envs=3)
    env.reset(seed=0)
    actions = np.zeros((3, 2))
    env.step(actions)
    actions[1, 0] = 1e9  # within a few substeps the acceleration is no number any more
    with pytest.raises(NonFiniteError, match=r"Swing: state 'shoulder' of copy 1 became nan at step 2"):
        env.step(actions)


def test_a_diverged_row_is_not_an_old_state_and_leaves_the_others_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    system = Swing()
    state, action = drawn(20)
    expected = system.flow(state, action)
    bad_state, bad_action = state.copy(), action.copy()
    bad_state[3, 2] = 1e7  # finite, and so is MuJoCo's last state before it gives up
    bad_state[4, 1] = np.nan
    bad_action[5, 0] = np.nan  # which MuJoCo would take for no torque
    bad_action[6, 0] = np.inf
    moved = system.flow(bad_state, bad_action)
    good = np.ones(20, dtype=bool)
    good[3:7] = False
    assert np.isnan(moved[3:7, :4]).all()
    assert np.array_equal(moved[good], expected[good])
    assert np.array_equal(system.flow(state, action), expected)  # and nothing is left behind


def test_a_nan_action_is_told_without_a_warning_of_mujoco(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = SystemEnv(Swing)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action 'elbow_torque' of copy 0 is NaN at step 1"):
        env.step(np.array([0.0, np.nan]))
    assert not list(tmp_path.iterdir())


def test_what_a_model_must_be():
    with pytest.raises(ValueError, match="substeps as a whole number of at least 1, got 0"):
        Swing(substeps=0)
    with pytest.raises(ValueError, match="substeps as a whole number of at least 1, got 2.5"):
        Swing(substeps=2.5)
    with pytest.raises(ValueError, match="expected hinge and slide joints only"):
        Swing(elbow="ball").model  # noqa: B018

    class Short(Swing):
        state_names = ("shoulder", "elbow", "shoulder_velocity")

    with pytest.raises(ValueError, match="begins with 2 positions and 2 velocities, got 3 components"):
        Short().model  # noqa: B018


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_it_works_in_worker_processes(context):
    if context not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system cannot {context}")
    env_id = "beliefgym/BaxterReach-v0"
    here = gym.make_vec(env_id, 32, vectorization_mode="vector_entry_point")
    here.reset(seed=0)
    here.step(np.zeros((32, 7)))  # this process has its threads already when it forks
    workers = AsyncVectorEnv([lambda: gym.make("beliefgym:beliefgym/BaxterReach-v0")] * 2, context=context)
    try:
        single = gym.make(env_id)
        expected = [single.reset(seed=4)[0], *(single.step(np.full(7, 2.0))[0] for _ in range(5))]
        found = [workers.reset(seed=4)[0], *(workers.step(np.full((2, 7), 2.0))[0] for _ in range(5))]
        assert np.array_equal(np.array(expected), np.array(found)[:, 0])
    finally:
        workers.close()
