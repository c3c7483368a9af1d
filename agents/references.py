"""Reference scores: what the random policy and the expert return on each task, measured and committed.

A score on the leaderboard is (return - random) / (expert - random). The table is envs/references.json, which travels
with the package; `beliefgym envs --measure` writes it anew.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym

import beliefgym.envs
from beliefgym.agents.evaluation import evaluate
from beliefgym.agents.registry import make_agent
from beliefgym.envs import registered_ids
from beliefgym.wrappers.task import Task

PATH = Path(beliefgym.envs.__file__).with_name("references.json")
N_EPISODES = 1000
SEED = 2_000_000  # apart from the seeds of training (small) and of the leaderboard's evaluation


@dataclass(frozen=True)
class References:
    """Mean returns that set the scale of a task's score.

    Args:
        random: mean return of the random policy.
        expert: mean return of the expert.
        random_standard_error, expert_standard_error: over episodes.
    """

    random: float
    expert: float
    random_standard_error: float
    expert_standard_error: float

    def score(self, mean_return: float) -> float:
        """(return - random) / (expert - random)."""
        return (mean_return - self.random) / (self.expert - self.random)


@cache
def _table() -> dict[str, Any]:
    table: dict[str, Any] = json.loads(PATH.read_text())["references"] if PATH.exists() else {}
    return table


def references(task: Task | str, n_episodes: int = N_EPISODES) -> References:
    """The reference scores of a task.

    Wrappers that change only the observation leave the returns of both policies as they are, so the table's
    numbers of the plain environment hold; with other parameters of the environment they are measured here.

    Raises:
        ValueError: the environment has no expert.
    """
    task = task if isinstance(task, Task) else Task(task)
    if (
        not task.kwargs
        and not any(name == "DiscreteActions" for name, _ in task.wrappers)
        and task.env_id in _table()
    ):
        return References(**_table()[task.env_id])
    return measure(task, n_episodes)


def measure(task: Task | str, n_episodes: int = N_EPISODES) -> References:
    """Run the random policy and the expert on a task."""
    random, expert = (
        evaluate(make_agent(name, task, seed=SEED), task, n_episodes, seed=SEED)
        for name in ("random", "expert")
    )
    return References(random.mean, expert.mean, random.standard_error, expert.standard_error)


def measure_all(env_ids: Iterable[str], path: Path = PATH, told: Callable[[str], None] = print) -> None:
    """Measure the references of the given environments and write the table; what it says of others stays.

    The table is read and written anew after each environment, so that nothing measured is lost to an interruption or to
    another process that measures other environments.
    """
    measured: dict[Any, References] = {}
    for env_id in env_ids:
        key = _what_decides_returns(env_id)
        if key not in measured:
            measured[key] = measure(env_id)
        found = measured[key]
        told(f"{env_id}: random {found.random:.1f}, expert {found.expert:.1f}")
        table = json.loads(path.read_text())["references"] if path.exists() else {}
        table[env_id] = {name: round(value, 4) for name, value in vars(found).items()}
        known = {name: table[name] for name in registered_ids() if name in table}  # sorted
        temporary = path.with_suffix(".tmp")
        temporary.write_text(
            json.dumps({"n_episodes": N_EPISODES, "seed": SEED, "references": known}, indent=1) + "\n"
        )
        os.replace(temporary, path)
    _table.cache_clear()


def _what_decides_returns(env_id: str) -> Any:
    """Equal for ids that differ only in what they show: neither the random policy nor the expert looks at that."""
    env = gym.make(env_id)
    system = getattr(env.unwrapped, "system", None)
    return env_id if system is None else (system, str(env.action_space), gym.spec(env_id).max_episode_steps)
