"""One cell of a leaderboard: train an agent on a task with a seed, evaluate it, and say everything about it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch

from beliefgym.agents import evaluate, make_agent
from beliefgym.agents.references import references
from beliefgym.scripts.leaderboard.grid import Cell
from beliefgym.scripts.training import LearningCurve, git_commit, machine, versions
from beliefgym.wrappers.task import Task


def run_cell(cell_data: Mapping[str, Any], report: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Train and evaluate one cell.

    Args:
        cell_data: `Cell.to_dict()`.
        report: told of the progress, {"step", "total", "note"}.

    Returns:
        plain data: evaluation returns, learning curve, references, timing, versions, spec.
    """
    # cells run side by side; small networks do not gain from more, and batches of MuJoCo would crowd the others out
    torch.set_num_threads(1)
    os.environ.setdefault("BELIEFGYM_THREADS", "1")
    cell = Cell.from_dict(cell_data)
    task = Task.from_dict(cell.task)
    scale = references(task)
    agent = make_agent(cell.agent, task, seed=cell.seed, **cell.agent_options)
    curve: list[dict[str, float]] = []
    started = time.perf_counter()
    if cell.total_timesteps:
        learning = LearningCurve(
            agent, task, cell.total_timesteps, cell.curve_points, cell.curve_episodes, report
        )
        learning.train()
        curve = learning.curve
    training_time = time.perf_counter() - started
    report({"step": cell.total_timesteps, "total": cell.total_timesteps, "note": "evaluating"})
    started = time.perf_counter()
    result = evaluate(agent, task, cell.eval_episodes, seed=cell.eval_seed)
    env = task.make()
    kernel = getattr(env.unwrapped, "kernel_name", None)
    spec = env.spec.to_json() if env.spec is not None else None
    env.close()
    return {
        "returns": result.returns.tolist(),
        "lengths": result.lengths.tolist(),
        "random_score": scale.random,
        "expert_score": scale.expert,
        "learning_curve": curve,
        "training": {
            "steps": cell.total_timesteps,
            "wall_time_s": training_time,
            "threads": torch.get_num_threads(),
        },
        "evaluation": {"episodes": cell.eval_episodes, "wall_time_s": time.perf_counter() - started},
        "spec": spec,
        "kernel": kernel,
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": machine(),
    }
