"""The expert: it reads the true state, and its return is the one of every leaderboard score.

For a beliefgym system it is a planner that knows the true model; for the locomotion tasks a trained full-state policy.
It does not play by the agents' rules (it sees the full state of a partially observed task), so it is a reference,
not a competitor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from beliefgym.agents.agent import Agent, episode_starts
from beliefgym.wrappers import DiscreteActions
from beliefgym.wrappers.task import Task


class Expert(Agent):
    """The expert controller of a task, in SB3's face: what `expert()` of its unwrapped environment returns.

    It must know the environment it acts in, because an observation does not hold the state: call
    `set_env(env)` with the single, vector or SB3 vector environment first (`evaluate` does).

    Args:
        task: a task whose unwrapped environment offers `state` and `expert()`, a controller with `act(state, restart)`.
        seed: not used; the expert is deterministic.

    Raises:
        ValueError: the environment has no expert.
    """

    def __init__(self, task: Task | str, seed: int = 0) -> None:
        super().__init__(task, seed)
        env = self.task.make()
        make_controller = getattr(env.unwrapped, "expert", None)
        if not callable(make_controller) or not hasattr(env.unwrapped, "state"):
            raise ValueError(
                f"{self.task.env_id} has no expert: its environment does not offer expert() and state; "
                "`beliefgym envs` lists those that do"
            )
        self.system = getattr(env.unwrapped, "system", None)  # None for the locomotion tasks
        self._controller: Any = make_controller()
        env.close()
        self._env: Any = None
        self._table: NDArray[np.float64] | None = None

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Nothing to learn."""
        return self

    def set_env(self, env: Any) -> None:
        """The environment whose state is read.

        Raises:
            TypeError: not an environment.
        """
        if not isinstance(env, gym.Env | VectorEnv | VecEnv):
            raise TypeError(f"expected an environment, got {type(env).__name__}")
        self._env = env

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """See `Agent.predict`; the state only says that the episode goes on.

        Raises:
            RuntimeError: `set_env` was not called.
            ValueError: the environment has another number of copies than the observation.
        """
        if self._env is None:
            raise RuntimeError(
                "the expert reads the true state: call set_env(env) with the environment it acts in"
            )
        observation, single = self.batched(observation)
        true_state = self._true_state()
        if len(true_state) != len(observation):
            raise ValueError(
                f"the environment has {len(true_state)} copies, the observation {len(observation)}"
            )
        action = self._controller.act(true_state, episode_starts(state, episode_start, len(observation)))
        return self._in_action_space(action, single), True

    def _true_state(self) -> NDArray[np.float64]:
        if isinstance(self._env, gym.Env):
            return np.asarray(self._env.unwrapped.state)[None]  # type: ignore[attr-defined]
        if isinstance(self._env, VectorEnv) and hasattr(self._env.unwrapped, "state"):
            return np.asarray(self._env.unwrapped.state)
        env: Any = self._env.unwrapped if isinstance(self._env, VectorEnv) else self._env
        return np.stack(env.get_attr("state"))  # of SB3, or of Gymnasium's SyncVectorEnv and AsyncVectorEnv

    def _in_action_space(self, action: NDArray[np.float64], single: bool) -> NDArray[Any]:
        chosen: NDArray[Any] = action.astype(np.float32)
        if not isinstance(self.action_space, gym.spaces.Box):
            if self._table is None:
                self._table = _discrete_table(self.task)
            chosen = np.argmin(np.abs(action[:, None, :] - self._table).sum(axis=2), axis=1)
        return chosen[0] if single else chosen

    def parts(self) -> dict[str, bytes]:
        """Nothing beyond the header."""
        return {}

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """Nothing to restore."""


def _discrete_table(task: Task) -> NDArray[np.float64]:
    """(choices, n_action) the action behind each choice of `DiscreteActions`."""
    env: Any = task.make()
    while not isinstance(env, DiscreteActions):
        if env is env.unwrapped:
            raise ValueError(f"the expert cannot act in the action space of {task.label}")
        env = env.env
    if not isinstance(env.action_space, gym.spaces.Discrete):
        raise ValueError(f"the expert acts in Discrete and Box action spaces, got {env.action_space}")
    return np.stack([env.action(np.int64(i)) for i in range(int(env.action_space.n))])
