"""`beliefgym benchmark env`: steps per second of the environments, and of SB3 fed from them.

The native vector environment of the pendulum against Gymnasium's SyncVectorEnv and AsyncVectorEnv on Pendulum-v1
(the same physics) and against EnvPool's Pendulum where it is installed; every other environment against its nearest
peer, and the systems as torch batches (every_env.py); then SB3's `collect_rollouts` and PPO from
end to end, through `SB3VecEnv` against SB3's own `make_vec_env`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from beliefgym.scripts.benchmarks.every_env import every_environment, torch_batches
from beliefgym.scripts.benchmarks.measuring import rates, row
from beliefgym.wrappers.sb3 import SB3VecEnv

COPIES = (1, 64, 1024, 16384)
OURS = "beliefgym native"
ASYNC_MOST = 64  # AsyncVectorEnv runs a process for each copy
SB3_COPIES = 64


def run(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure everything.

    Args:
        told: hears what is being measured.

    Returns:
        rows, and the physical limits measured beside them.
    """
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    limits: dict[str, Any] = {
        "AsyncVectorEnv": f"not run beyond {ASYNC_MOST} copies, since it starts a process for each",
        "kernel": gym.make("beliefgym/Pendulum-v0").get_wrapper_attr("kernel_name"),
    }
    for n in COPIES:
        told(f"pendulum, {n} copies")
        rows += _steps(n, limits)
    rows += every_environment(told)
    rows += torch_batches(told)
    told(f"SB3 collect_rollouts, {SB3_COPIES} environments")
    rows += _collecting()
    told("PPO from end to end")
    rows += _training()
    return rows, limits


def _steps(n: int, limits: dict[str, Any]) -> list[dict[str, Any]]:
    actions = np.random.default_rng(0).uniform(-2.0, 2.0, (n, 1)).astype(np.float32)
    contestants: dict[str, Callable[[], int]] = {}
    opened: list[Any] = []

    def stepping(name: str, env: Any) -> None:
        env.reset()
        batch = max(1, 4096 // n)

        def call() -> int:
            for _ in range(batch):
                env.step(actions)
            return batch * n

        opened.append(env)
        contestants[name] = call

    stepping(OURS, gym.make_vec("beliefgym/Pendulum-v0", num_envs=n, vectorization_mode="vector_entry_point"))
    stepping("SyncVectorEnv", gym.make_vec("Pendulum-v1", num_envs=n, vectorization_mode="sync"))
    if n <= ASYNC_MOST:
        stepping("AsyncVectorEnv", gym.make_vec("Pendulum-v1", num_envs=n, vectorization_mode="async"))
    try:
        import envpool
    except ImportError:
        limits["envpool"] = 'not installed: pip install "beliefgym[rivals]"'
    else:
        stepping("EnvPool", envpool.make("Pendulum-v1", env_type="gymnasium", num_envs=n, seed=0))
        limits["envpool"] = envpool.__version__
    found = rates(contestants, repeats=3 if n > 1024 else 5)
    for env in opened:
        env.close()
    limits[f"share of the three sines at {n} copies"] = _sine_share(n, found[OURS].value)
    targets = {("SyncVectorEnv", 64): 50.0, ("EnvPool", 1024): 1.0, ("EnvPool", 16384): 1.0}
    return [
        row(f"Pendulum steps/s, {n} copies", found[OURS], name, rate, targets.get((name, n)))
        for name, rate in found.items()
        if name != OURS
    ]


def _sine_share(n: int, steps_per_second: float) -> dict[str, float]:
    """The least that a step must do is a sine for the physics, a sine and a cosine for the observation.

    Returns:
        steps/s that these three alone would allow, the share of it that is reached, and the rate of useful bytes
        (16 read and 16 written of state, 4 of action, 12 of observation, 8 of reward, 2 of flags).
    """
    angle = np.random.default_rng(0).uniform(-3.0, 3.0, n)

    def sines() -> int:
        np.sin(angle), np.sin(angle), np.cos(angle)
        return n

    bound = rates({"sines": sines}, repeats=3, seconds=0.2)["sines"].value
    return {
        "bound_steps_per_s": bound,
        "share": steps_per_second / bound,
        "useful_GB_per_s": steps_per_second * 58 / 1e9,
    }


class _Quiet(BaseCallback):
    def _on_step(self) -> bool:
        return True


def _sb3_env(kind: str) -> VecEnv:
    if kind == OURS:
        return SB3VecEnv(
            gym.make_vec(
                "beliefgym/Pendulum-v0",
                num_envs=SB3_COPIES,
                vectorization_mode="vector_entry_point",
                autoreset_mode="SAME_STEP",
            )
        )
    return make_vec_env(kind, n_envs=SB3_COPIES, seed=0)


_RIVALS = {
    "Pendulum-v1": "make_vec_env(Pendulum-v1)",
    "beliefgym/Pendulum-v0": "make_vec_env(beliefgym/Pendulum-v0)",
}


def _collecting(n_steps: int = 64) -> list[dict[str, Any]]:
    contestants: dict[str, Callable[[], int]] = {}

    def collecting(env: VecEnv) -> Callable[[], int]:
        model = PPO("MlpPolicy", env, n_steps=n_steps, device="cpu", seed=0)
        _, callback = model._setup_learn(10**9, _Quiet())

        def call() -> int:
            model.collect_rollouts(env, callback, model.rollout_buffer, n_steps)
            return n_steps * SB3_COPIES

        return call

    for kind in (OURS, *_RIVALS):
        contestants[kind] = collecting(_sb3_env(kind))
    env = _sb3_env(OURS)
    model = PPO("MlpPolicy", env, n_steps=n_steps, device="cpu", seed=0)
    observation = obs_as_tensor(np.asarray(env.reset()), model.device)

    def policy_alone() -> int:
        with torch.no_grad():
            for _ in range(n_steps):
                model.policy(observation)
        return n_steps * SB3_COPIES

    bound = "the policy's forward pass alone (the bound)"
    contestants[bound] = policy_alone
    found = rates(contestants)
    what = f"SB3 collect_rollouts frames/s, {SB3_COPIES} environments"
    rows = [row(what, found[OURS], name, found[kind], 5.0) for kind, name in _RIVALS.items()]
    return [*rows, row(what, found[OURS], bound, found[bound])]


def _training(total: int = 2 * 64 * SB3_COPIES) -> list[dict[str, Any]]:
    def training(kind: str) -> Callable[[], int]:
        model = PPO("MlpPolicy", _sb3_env(kind), n_steps=64, batch_size=512, n_epochs=4, device="cpu", seed=0)

        def call() -> int:
            model.learn(total)
            return total

        return call

    found = rates({kind: training(kind) for kind in (OURS, *_RIVALS)}, repeats=3)
    what = f"SB3 PPO end to end frames/s, {SB3_COPIES} environments"
    return [row(what, found[OURS], name, found[kind]) for kind, name in _RIVALS.items()]
