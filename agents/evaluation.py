"""Evaluation: n whole episodes at once, each on a seed of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.wrappers.task import Task


@dataclass(frozen=True)
class Evaluation:
    """Returns and lengths of evaluated episodes, each (n_episodes,)."""

    returns: NDArray[np.float64]
    lengths: NDArray[np.int64]

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return over episodes."""
        return (
            float(self.returns.std(ddof=1) / np.sqrt(len(self.returns)))
            if len(self.returns) > 1
            else float("nan")
        )


def evaluate(
    agent: Any,
    task: Task | str,
    n_episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    max_steps: int = 100_000,
) -> Evaluation:
    """Undiscounted returns of an agent over whole episodes.

    Episode i runs in copy i of one vector environment, from seed `seed + i`, so that no episode counts more for
    being short, and two agents meet the same starts.

    Args:
        agent: anything with SB3's `predict`; its `set_env`, if it has one, is called for beliefgym agents, and its
            `tell_reward` after each step where it says `needs_rewards`.
        task: the task or environment id.
        n_episodes: number of episodes.
        seed: seed of the first episode.
        deterministic: without exploration noise.
        max_steps: gives up after this many steps of an episode that does not end.

    Raises:
        ValueError: no episodes asked for.
        RuntimeError: an episode did not end within max_steps; returns are never cut silently.
    """
    if n_episodes < 1:
        raise ValueError(f"expected at least 1 episode, got {n_episodes}")
    task = task if isinstance(task, Task) else Task(task)
    env = task.make_vec(n_episodes)
    if hasattr(agent, "registered_name"):
        agent.set_env(env)
    observation, _ = env.reset(seed=seed)
    returns = np.zeros(n_episodes)
    lengths = np.zeros(n_episodes, dtype=np.int64)
    running = np.ones(n_episodes, dtype=np.bool_)
    state: Any = None
    start = np.ones(n_episodes, dtype=np.bool_)
    for _ in range(max_steps):
        action, state = agent.predict(
            observation, state=state, episode_start=start, deterministic=deterministic
        )
        observation, reward, terminated, truncated, _ = env.step(action)
        if getattr(agent, "needs_rewards", False):
            agent.tell_reward(reward)
        returns += np.where(running, reward, 0.0)
        lengths += running
        start = terminated | truncated
        running &= ~start
        if not running.any():
            env.close()
            return Evaluation(returns, lengths)
    raise RuntimeError(
        f"{running.sum()} of {n_episodes} episodes of {task.label} did not end within {max_steps} steps; "
        "give the environment a time limit or raise max_steps"
    )
