"""Steps per second of every environment at 1, 64 and 1024 copies, against the nearest task of Gymnasium.

The rival is Gymnasium's SyncVectorEnv over the task of its own that is nearest in kind, stepped in turns with ours in
one run. No two tasks do the same work (a helicopter has 21 states, an Acrobot four), so the rows say what a user gets
by `gym.make_vec`, not which code is better written; for the arms a plain Python loop over `mj_step` on the very same
model is measured too. Systems are also stepped as torch tensors in one large batch, which is what a planner or a GPU
does with them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch

from beliefgym.envs import registered_ids
from beliefgym.envs.baxter_arm import BaxterArm
from beliefgym.envs.mujoco_system import MujocoSystem
from beliefgym.envs.random_streams import RandomStreams
from beliefgym.envs.registration import has_native_vector_form
from beliefgym.envs.system import System
from beliefgym.scripts.benchmarks.measuring import Rate, rates, row

COPIES = (1, 64, 1024)
MILLION = 1e6
TORCH_COPIES = 100_000
# the start of a name -> the nearest task of Gymnasium; the longest start that fits counts
PEERS = {
    "Pendulum": "Pendulum-v1",
    "CartPole": "CartPole-v1",
    "DoublePendulum": "Acrobot-v1",
    "Helicopter": "Acrobot-v1",
    "Quadrotor": "Acrobot-v1",
    "MobileBase": "MountainCarContinuous-v0",
    "Baxter": "Pusher-v5",
    "Mico": "Pusher-v5",
    "TMaze": "FrozenLake-v1",
    "HopperPosition": "Hopper-v5",
    "Walker2dPosition": "Walker2d-v5",
    "HalfCheetahPosition": "HalfCheetah-v5",
    "SwimmerPosition": "Swimmer-v5",
    "InvertedPendulumPosition": "InvertedPendulum-v5",
}


def every_environment(told: Callable[[str], None]) -> list[dict[str, Any]]:
    """Rows for all ids at all sizes.

    Args:
        told: hears what is being measured.
    """
    rows: list[dict[str, Any]] = []
    for env_id in registered_ids():
        for n in COPIES:
            told(f"{env_id}, {n} copies")
            rows += _against_its_peer(env_id, n)
    return rows


def peer(env_id: str) -> str:
    """The task of Gymnasium that is nearest to an id.

    Raises:
        ValueError: none is named here.
    """
    name = env_id.rpartition("/")[2]
    starts = [start for start in PEERS if name.startswith(start)]
    if not starts:
        raise ValueError(f"no peer of {env_id} is named; add one to PEERS in {__name__}")
    return PEERS[max(starts, key=len)]


def _against_its_peer(env_id: str, n: int) -> list[dict[str, Any]]:
    native = has_native_vector_form(env_id)
    mode = "vector_entry_point" if native else "sync"
    ours = gym.make_vec(env_id, num_envs=n, vectorization_mode=mode)
    theirs = gym.make_vec(peer(env_id), num_envs=n, vectorization_mode="sync")
    contestants = {"ours": _stepping(ours), "theirs": _stepping(theirs)}
    system = getattr(ours.unwrapped, "system", None)
    # the action of this arm is the control of its motors, so the loop does the same work
    if n == max(COPIES) and isinstance(system, BaxterArm):
        contestants["loop"] = _mj_step_loop(system, n)
    found = rates(contestants, repeats=3, seconds=0.25)
    ours.close()
    theirs.close()
    what = f"{env_id.rpartition('/')[2]} steps/s, {n} copies"
    rows = [row(what, found["ours"], f"SyncVectorEnv({peer(env_id)})", found["theirs"])]
    if "loop" in found:
        rows.append(row(what, found["ours"], "Python loop over mj_step", found["loop"], 5.0))
    elif n == max(COPIES) and native and not isinstance(system, MujocoSystem):
        rows.append(row(what, found["ours"], "1,000,000 steps/s", Rate(MILLION, MILLION, MILLION), 1.0))
    return rows


def _stepping(env: Any) -> Callable[[], int]:
    """Random actions, a new one for each call of the batch, with episodes that end and begin as they do."""
    env.reset(seed=0)
    env.action_space.seed(0)
    chosen = [env.action_space.sample() for _ in range(8)]
    n = env.num_envs
    batch = max(8, 2048 // n)

    def call() -> int:
        for i in range(batch):
            env.step(chosen[i % 8])
        return batch * n

    return call


def _mj_step_loop(system: BaxterArm, n: int) -> Callable[[], int]:
    """What one writes first: a loop over copies, and for each over the substeps."""
    model = system.model
    data = mujoco.MjData(model)
    state = system.initial_state(RandomStreams(range(n)))
    low, high = system.action_limits
    actions = np.random.default_rng(0).uniform(low, high, (n, model.nu))
    moved = state.copy()

    def call() -> int:
        for i in range(n):
            data.qpos[:] = state[i, : model.nq]
            data.qvel[:] = state[i, model.nq : model.nq + model.nv]
            data.ctrl[:] = actions[i]
            for _ in range(system.substeps):
                mujoco.mj_step(model, data)
            moved[i, : model.nq] = data.qpos
            moved[i, model.nq : model.nq + model.nv] = data.qvel
        return n

    return call


def torch_batches(told: Callable[[str], None]) -> list[dict[str, Any]]:
    """Every system stepped as float32 torch tensors, 100,000 copies at once, on the CPU and where there is one on CUDA.

    The rival is the same function on numpy arrays in float64. Where there is a GPU its numbers are first compared with
    the CPU's.

    Raises:
        ArithmeticError: the GPU's step differs from the CPU's by more than single precision explains.
    """
    rows: list[dict[str, Any]] = []
    seen: set[System] = set()
    for env_id in registered_ids():
        if not has_native_vector_form(env_id):
            continue
        system = gym.make(env_id).unwrapped.system  # type: ignore[attr-defined]
        if system in seen or isinstance(system, MujocoSystem):
            continue
        seen.add(system)
        told(f"{type(system).__name__} in torch")
        rows += _torch_batch(system)
    return rows


def _torch_batch(system: System) -> list[dict[str, Any]]:
    state = system.initial_state(RandomStreams(range(TORCH_COPIES)))
    low, high = system.action_limits
    action = np.random.default_rng(0).uniform(low, high, (TORCH_COPIES, system.n_action))
    name = type(system).__name__
    contestants: dict[str, Callable[[], int]] = {"numpy float64": _calling(system, state, action)}
    for device in ("cpu", *(("cuda",) if torch.cuda.is_available() else ())):
        inputs = [torch.as_tensor(array, dtype=torch.float32, device=device) for array in (state, action)]
        contestants[f"torch float32, {device}"] = _calling(system, *inputs)
        moved, expected = system.step(*inputs).cpu().double().numpy(), system.step(state, action)
        error = float((np.abs(moved - expected) / (1.0 + np.abs(expected))).max())
        if not error < 1e-4:
            raise ArithmeticError(f"{name} on {device} differs from numpy by {error:g} (relative, one step)")
    found = rates(contestants, repeats=3, seconds=0.25)
    base = found["numpy float64"]
    what = f"{name}.step in one batch of {TORCH_COPIES:,}, steps/s"
    return [
        row(f"{what}: {key}", rate, "numpy float64", base) for key, rate in found.items() if rate is not base
    ]


def _calling(system: System, state: Any, action: Any) -> Callable[[], int]:
    def call() -> int:
        moved = system.step(state, action)
        if torch.is_tensor(moved) and moved.is_cuda:
            torch.cuda.synchronize()
        return len(state)

    return call
