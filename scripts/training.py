"""Training with a learning curve: the callback that a run, a leaderboard cell and a progress bar share."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from beliefgym.agents import Agent, evaluate
from beliefgym.wrappers.task import Task

PACKAGES = (
    "beliefgym",
    "gymnasium",
    "mujoco",
    "numba",
    "numpy",
    "stable-baselines3",
    "sb3-contrib",
    "torch",
    "torchrl",
)
VALIDATION_SEED = 3_000_000  # apart from training, from the final evaluation and from the references


class LearningCurve(BaseCallback):
    """Evaluates the agent at equally spaced steps of its training, on validation seeds.

    The evaluation is deterministic and runs in an environment of its own: training goes on as if it had not been.

    Args:
        agent: the agent that is learning.
        task: where it is evaluated.
        total_timesteps: length of the training in environment steps.
        points: evaluations, the last at the end.
        episodes: episodes of each.
        report: told of the progress, {"step", "total", "note"}.
    """

    def __init__(
        self,
        agent: Agent,
        task: Task,
        total_timesteps: int,
        points: int,
        episodes: int,
        report: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        super().__init__()
        self.curve: list[dict[str, float]] = []
        self._agent, self._task, self._episodes = agent, task, episodes
        self._total = total_timesteps
        self._every = total_timesteps / points if points else float("inf")
        self._next = self._every
        self._report = report or (lambda progress: None)
        self._told = 0

    def train(self, progress_bar: bool = False) -> None:
        """Train the agent with the curve's first point before and its last after, whatever its callbacks do."""
        self.evaluate(0)
        self._agent.learn(self._total, callback=self, progress_bar=progress_bar)
        self.evaluate(self._total)

    def evaluate(self, step: int) -> None:
        """Add a point to the curve."""
        result = evaluate(self._agent, self._task, self._episodes, seed=VALIDATION_SEED)
        std = float(result.returns.std())
        self.curve.append({"step": step, "mean_return": result.mean, "std": std})

    def _on_step(self) -> bool:
        step = self.num_timesteps
        # An on-policy algorithm finishes its last rollout beyond the total; those steps get no further points.
        if self._next <= step < self._total:
            self.evaluate(step)
            while self._next <= step:  # an agent that explores first has passed some points unseen
                self._next += self._every
        if step - self._told >= self._total / 100:
            self._told = step
            note = f"{self.curve[-1]['mean_return']:.1f}" if self.curve else ""
            self._report({"step": min(step, self._total), "total": self._total, "note": note})
        return True


def versions() -> dict[str, str]:
    """Versions of Python and the packages that decide results."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def git_commit() -> str | None:
    """The commit of this checkout, with "+" where files differ from it; None outside a checkout."""
    folder = Path(__file__).resolve().parent

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(("git", *arguments), cwd=folder, capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    if commit is None:
        return None
    return commit + (
        "+" if git("status", "--porcelain", "--untracked-files=no", "--", "..", ":!../results") else ""
    )


def machine() -> dict[str, Any]:
    """The machine in words: system, processor, cores."""
    import os

    name = platform.processor() or platform.machine()
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
                break
    return {"system": f"{platform.system()} {platform.machine()}", "processor": name, "cores": os.cpu_count()}
