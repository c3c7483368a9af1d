"""`beliefgym reproduce env-experts`: how often each expert does its task, from 500 starts.

An expert is the scale of a leaderboard's scores, so it must do the task. Each environment runs as it is registered,
its noise included; success is judged on the true states of the last second of the episode.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from beliefgym.agents import make_agent
from beliefgym.envs import System
from beliefgym.scripts.reproductions.report import Report, Request, Row
from beliefgym.scripts.reproductions.successes import TRIALS, Trial
from beliefgym.wrappers.task import Task

N_STARTS = 500
TARGET = 0.99
FIRST_SEED = 3_000_000  # apart from training, the leaderboard and the references


@dataclass(frozen=True)
class Outcome:
    """What 500 episodes of an expert came to.

    Attributes:
        succeeded: (n,) bool. ended_early: (n,) bool. measure: (n,) what success is judged by, in its unit.
    """

    succeeded: NDArray[np.bool_]
    ended_early: NDArray[np.bool_]
    measure: NDArray[np.float64]


def run(request: Request) -> Report:
    """The rows of all experts that have a criterion; the request's seed is added to the first seed of the starts."""
    rows: list[Row] = []
    for trial in TRIALS:
        request.told(trial.label)
        found = outcome(trial, N_STARTS, FIRST_SEED + request.seed)
        rate = float(found.succeeded.mean())
        rows.append(
            {
                "what": trial.label,
                "ours": f"{found.succeeded.sum()} of {N_STARTS}",
                "reference": f"median {np.median(found.measure):.2g} {trial.success.unit}, "
                f"99th percentile {np.percentile(found.measure, 99):.2g}, ended early {found.ended_early.sum()}",
                "target": f"{TARGET:.0%}",
                "meets": rate >= TARGET,
            }
        )
    about = (
        f"Experts on their true models, {N_STARTS} starts each, noise as registered. The third column is the measure "
        "that success is judged by."
    )
    return Report(about, ("what", "ours", "reference", "target", "meets"), rows)


def outcome(trial: Trial, n: int, seed: int) -> Outcome:
    """Run an expert in n copies for one whole episode, or for the trial's steps.

    Args:
        trial: the task.
        n: number of starts.
        seed: of the first.
    """
    task = Task(trial.env_id, trial.parameters)
    env = task.make_vec(n, AutoresetMode.NEXT_STEP)
    system: System = env.unwrapped.system  # type: ignore[attr-defined]
    expert: Any = make_agent("expert", task, seed=0)
    expert.set_env(env)
    steps = trial.steps or gym.spec(trial.env_id).max_episode_steps
    assert steps is not None
    last_second = max(1, round(1.0 / system.dt))
    observation, _ = env.reset(seed=seed)
    ended_early = np.zeros(n, dtype=np.bool_)
    history: list[NDArray[np.float64]] = []
    memory: Any = None
    for t in range(steps):
        action, memory = expert.predict(observation, memory, np.full(n, t == 0), deterministic=True)
        observation, _, terminated, _, _ = env.step(action)
        ended_early |= terminated & (t < steps - 1)
        if t >= steps - last_second:
            history.append(env.unwrapped.state)  # type: ignore[attr-defined]
    measure = trial.success.measure(system, np.stack(history))
    return Outcome((measure < trial.success.limit) & ~ended_early, ended_early, measure)
