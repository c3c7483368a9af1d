"""`beliefgym reproduce recurrent-returns`: how good recurrent agents become on cart-poles, pendulum and hopper.

Recurrent-Q SARSA on the cart-pole by its positions, exact and under noise of 0.1, 0.2 and 0.3, and on the pendulum
by its position (a grid of torques), where the soft actor-critic sibling stands beside it, which also learns the hopper
by its positions; all with the options they are registered with. The reference under noise knows the system: a Kalman
filter and feedback of its mean, pushing with full force to the side of k' m. The expert's k is that of LQR; the best k
is searched for on validation episodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.optimize import differential_evolution

from beliefgym.agents import evaluate, make_agent
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row
from beliefgym.scripts.training import LearningCurve
from beliefgym.wrappers.task import Task

NAME = "recurrent-returns"
VERSION = 1  # of the protocol
TEST_SEED, TEST_EPISODES = 1_000_000, 300
TUNING_SEED, TUNING_EPISODES = 4_000_000, 100
CURVE_POINTS, CURVE_EPISODES = 40, 20
FIGURE_COLUMNS = 4
FULL_FORCE = 100.0  # a gain so large that every mean but the smallest asks for full force
SEARCH = {"popsize": 8, "maxiter": 8}  # of the best gain


@dataclass(frozen=True)
class Aim:
    """A task, and what has to come out.

    Args:
        title: in table and figure. env_id: the task. agent: registered name; "kalman" for the reference. steps: of
            training. target: mean return that is asked for. scale: what the return is divided by in the table.
        target_of: why that. seeds: at most so many.
        solved_before: the target has to be reached by an evaluation before so many steps, and to be held by the test at
            the end, in nine of ten seeds; None for the mean over seeds alone.
    """

    title: str
    env_id: str
    agent: str
    steps: int
    target: float
    scale: float = 1.0
    target_of: str = ""
    seeds: int = 10
    solved_before: int | None = None


def _noisy() -> dict[str, Aim]:
    levels = {  # steps, target, published best at 15 million steps
        ("Easy", 0.1): (600_000, 0.98, "0.995"),
        ("Medium", 0.2): (1_000_000, 0.62, "0.659"),
        ("Hard", 0.3): (1_000_000, 0.37, "0.404"),
    }
    return {
        f"cart-pole-{level.lower()}": Aim(
            f"cart-pole, noise {std}",
            f"beliefgym/CartPoleBalanceNoisy{level}-v0",
            "recurrent-q",
            steps,
            target,
            200.0,
            f"published best at 15 million steps: {best}",
            5,
        )
        for (level, std), (steps, target, best) in levels.items()
    }


AIMS: dict[str, Aim] = {
    "cart-pole": Aim(
        "cart-pole, positions",
        "beliefgym/CartPoleBalancePosition-v0",
        "recurrent-q",
        200_000,
        500.0,
        solved_before=50_000,
    ),
    **_noisy(),
    "pendulum": Aim(
        "pendulum, position",
        "beliefgym/PendulumPosition-v0",
        "recurrent-q",
        100_000,
        -200.0,
        target_of="recurrent PPO: -217.9",
    ),
    "pendulum-sac": Aim(
        "pendulum, position",
        "beliefgym/PendulumPosition-v0",
        "recurrent-sac",
        20_000,
        -200.0,
        target_of="recurrent PPO at 100,000 steps: -217.9",
        seeds=5,
    ),
    "hopper-sac": Aim(
        "Hopper, positions",
        "beliefgym/HopperPosition-v0",
        "recurrent-sac",
        100_000,
        332.6,
        target_of="PPO on 4 frames; recurrent PPO: 281",
        seeds=5,
    ),
}
COLUMNS = ("what", "steps", "seeds", "score", "worst seed", "target", "solved early", "meets")
ABOUT = (
    f"{TEST_EPISODES} test episodes after training; means over seeds with 95 % intervals, of returns, under noise of "
    "returns divided by 200, the largest. `target`: the least mean that was asked for, in the first row 500 "
    f"at the end of every seed; `solved early`: seeds that had 500 in an evaluation of {CURVE_EPISODES} episodes "
    f"before {AIMS['cart-pole'].solved_before:,} steps. Kalman filter: of the exact model, `LQR` with the expert's "
    "gain, `tuned` with the best gain of a search on validation episodes; it learns nothing."
)


def run(request: Request) -> Report:
    """All tasks and seeds; what has been run is not run again."""
    seeds = range(request.seed, request.seed + request.seeds)
    cells: dict[str, dict[str, Any]] = {}
    for slug, aim in AIMS.items():
        if aim.scale != 1.0:
            for kind in ("LQR", "tuned"):
                cells[f"{slug}--kalman-{kind.lower()}"] = _reference(aim, kind)
    for slug, aim in AIMS.items():
        cells |= {f"{slug}--{seed}": _cell(aim, seed) for seed in seeds[: aim.seeds]}
    module = "beliefgym.scripts.reproductions.recurrent_returns"
    done = run_cells(f"{module}:cell", cells, request.folder / "cells" / NAME, request.jobs, request.told)
    failed = [f"Failed: {name}: {result['failed']}" for name, result in done.items() if "failed" in result]
    good = {name: result for name, result in done.items() if "failed" not in result}
    rows: list[Row] = []
    curves: dict[str, list[list[dict[str, float]]]] = {}
    for slug, aim in AIMS.items():
        learned = [good[f"{slug}--{seed}"] for seed in seeds[: aim.seeds] if f"{slug}--{seed}" in good]
        if learned:
            rows.append(_row(aim, learned))
            curves[slug] = [one["curve"] for one in learned]
        for kind in ("LQR", "tuned"):
            if (result := good.get(f"{slug}--kalman-{kind.lower()}")) is not None:
                rows.append(_reference_row(aim, kind, result))
    path = request.folder / f"{NAME}.png"
    figure(path, curves)
    caption = "Returns on validation episodes over environment steps: every seed, and their median."
    configuration = {
        "version": VERSION,
        "cells": {name: cells[name] for name in list(cells)[: len(AIMS) + 6]},
    }
    return Report(ABOUT, COLUMNS, rows, configuration, {path.name: caption}, failed)


def _cell(aim: Aim, seed: int) -> dict[str, Any]:
    return {
        "version": VERSION,
        "env_id": aim.env_id,
        "agent": aim.agent,
        "options": make_agent(
            aim.agent, aim.env_id, seed=seed
        ).options(),  # defaults too: when one changes, it runs anew
        "steps": aim.steps,
        "seed": seed,
    }


def _reference(aim: Aim, kind: str) -> dict[str, Any]:
    return {"version": VERSION, "env_id": aim.env_id, "agent": "filter-expert", "gain": kind}


def cell(cell: dict[str, Any], _: Any) -> dict[str, Any]:
    """One training with its test, or one reference."""
    torch.set_num_threads(1)
    task = Task(cell["env_id"])
    if cell["agent"] == "filter-expert":
        return _kalman(task, cell["gain"] == "tuned")
    agent = make_agent(cell["agent"], task, seed=cell["seed"], **cell["options"])
    learning = LearningCurve(agent, task, cell["steps"], CURVE_POINTS, CURVE_EPISODES)
    learning.train()
    return {
        "curve": learning.curve,
        "returns": evaluate(agent, task, TEST_EPISODES, seed=TEST_SEED).returns.tolist(),
    }


def _kalman(task: Task, tuned: bool) -> dict[str, Any]:
    """The filter's feedback on test episodes; of a tuned gain, the best of a search over k = (k_x, k_v, 1, k_w)."""

    def controlled(gain: list[float] | None, seed: int, episodes: int) -> np.ndarray[Any, Any]:
        rows = None if gain is None else [[-FULL_FORCE * k for k in gain]]
        agent = make_agent("filter-expert", task, seed=0, filter="ekf", gain=rows)
        return evaluate(agent, task, episodes, seed=seed).returns

    gain = None
    if tuned:
        found = differential_evolution(
            lambda k: -float(controlled([k[0], k[1], 1.0, k[2]], TUNING_SEED, TUNING_EPISODES).mean()),
            bounds=[(-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0)],
            **SEARCH,
            polish=False,
            rng=0,
        )
        gain = [float(found.x[0]), float(found.x[1]), 1.0, float(found.x[2])]
    return {"gain": gain, "returns": controlled(gain, TEST_SEED, TEST_EPISODES).tolist()}


def _row(aim: Aim, results: list[dict[str, Any]]) -> Row:
    means = [float(np.mean(one["returns"])) / aim.scale for one in results]
    score = Interval.of(means)
    row: Row = {
        "what": f"{aim.title}: {aim.agent}",
        "steps": f"{aim.steps:,}",
        "score": score.text(".4g" if aim.scale == 1.0 else ".3f"),
        "worst seed": f"{min(means):.4g}",
        "target": f"{aim.target:g}" + (f" ({aim.target_of})" if aim.target_of else ""),
        "meets": bool(score.mean >= aim.target),
        "seeds": str(len(means)),
        "values": {"score": score.to_dict(), "means": means},
    }
    if aim.solved_before is not None:
        early = [
            any(p["mean_return"] >= aim.target and p["step"] < aim.solved_before for p in one["curve"])
            for one in results
        ]
        held = [mean >= aim.target for mean in means]
        both = sum(a and b for a, b in zip(early, held, strict=True))
        row["meets"] = both >= 0.9 * len(means)
        row["solved early"] = f"{sum(early)} of {len(early)}, at the end {sum(held)}"
    return row


def _reference_row(aim: Aim, kind: str, result: dict[str, Any]) -> Row:
    returns = np.asarray(result["returns"]) / aim.scale
    margin = 1.96 * returns.std(ddof=1) / np.sqrt(len(returns))
    gain = "" if result["gain"] is None else f", k = ({', '.join(f'{k:.2f}' for k in result['gain'])})"
    return {
        "what": f"{aim.title}: Kalman filter, {kind}{gain}",
        "steps": "0",
        "score": f"{returns.mean():.3f} +- {margin:.3f} (episodes)",
        "meets": None,
        "values": {"mean": float(returns.mean()), "margin": float(margin), "gain": result["gain"]},
    }


def figure(path: Path, curves: dict[str, list[list[dict[str, float]]]]) -> None:
    """A panel for each task: every seed's learning curve, and the median."""
    if not curves:
        return
    with matplotlib.rc_context(STYLE):
        n_rows = -(-len(curves) // FIGURE_COLUMNS)
        drawing = Figure(figsize=(3.4 * FIGURE_COLUMNS, 2.6 * n_rows), layout="constrained")
        axes = drawing.subplots(n_rows, FIGURE_COLUMNS, squeeze=False)
        for ax in axes.flat[len(curves) :]:
            ax.set_axis_off()
        for ax, (slug, runs) in zip(axes.flat, curves.items(), strict=False):
            aim = AIMS[slug]
            steps = [point["step"] / 1000 for point in runs[0]]
            values = np.array([[point["mean_return"] for point in run] for run in runs]) / aim.scale
            ax.plot(steps, values.T, color="#0072B2", lw=0.6, alpha=0.35)
            ax.plot(steps, np.median(values, axis=0), color="#0072B2", lw=1.6)
            ax.axhline(aim.target, color="#888888", lw=0.8, ls="--")
            label = "return" if aim.scale == 1.0 else "return / 200"
            plain(ax, f"{aim.title}: {aim.agent}", "thousand environment steps", label)
        save(drawing, path)
