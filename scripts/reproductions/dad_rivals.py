"""`beliefgym reproduce dad-rivals`: Data as Demonstrator among the other ways to train for many steps.

Every method trains the same class of models (random Fourier features, fixed frequencies) on the same trajectories in
the same number of passes over them, and takes the features' bandwidth, the ridge and its own options by the same
criterion, the multi-step error on validation trajectories. What needs a gradient through the model is marked so.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from itertools import product
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from beliefgym.learning import (
    DataAsDemonstrator,
    DirectMultiStep,
    DivergenceWarning,
    DynamicsModel,
    LaggedError,
    RandomFourierRidge,
    ScheduledSampling,
    WeightedMultiHorizon,
)
from beliefgym.scripts.leaderboard.plots import FAINT
from beliefgym.scripts.reproductions import dad_data as data
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_figures import DAD, SINGLE, STYLE, plain, save
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

PASSES = 25
Method = tuple[Callable[..., DynamicsModel], dict[str, Any], list[dict[str, Any]]]
METHODS: dict[str, Method] = {
    "single step": (DataAsDemonstrator, {"n_iterations": 0}, [{}]),
    "DaD": (DataAsDemonstrator, {"n_iterations": PASSES}, [{"horizon": h} for h in (5, 10)]),
    "direct k-step models": (DirectMultiStep, {}, [{"horizon": h} for h in (5, 10, 30)]),
    "scheduled sampling": (
        ScheduledSampling,
        {"n_epochs": PASSES, "random_state": 0},
        [{"horizon": h, "learning_rate": r} for h, r in product((10, None), (3e-4, 3e-3))],
    ),
    "lagged error (gradient through time)": (
        LaggedError,
        {"n_epochs": PASSES, "random_state": 0},
        [{"horizon": h} for h in (5, 10)],
    ),
    "weighted multi-horizon (gradient through time)": (
        WeightedMultiHorizon,
        {"n_epochs": PASSES, "random_state": 0, "horizon": 10},
        [{"horizon_weights": beta} for beta in (0.5, 0.8)],
    ),
}
PROBLEMS = {
    "pendulum, noise 0": ("pendulum", 0.0, 50),
    "pendulum, noise 0.01": ("pendulum", 0.01, 50),
    "cart-pole, noise 0": ("cart-pole", 0.0, 100),
}
SETTING: dict[str, Any] = {
    "data_version": data.VERSION,
    "trajectories": 400,
    "passes": PASSES,
    "bandwidths": [1.0, 2.0],
    "alphas": [1e-8, 1e-6],
}
RATIOS = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
COLUMNS = ("what", "test error", "against single step", "against DaD", "CPU seconds")


def run(request: Request) -> Report:
    """Every method on every problem at every seed."""
    seeds = range(request.seed, request.seed + request.seeds)
    cells = {
        f"{_slug(problem)}-{seed}": {"problem": problem, "seed": seed, "methods": _described(), **SETTING}
        for problem, seed in product(PROBLEMS, seeds)
    }
    folder = request.folder / "cells" / "dad-rivals"
    found = run_cells(f"{__name__}:cell", cells, folder, request.jobs, request.told)
    rows: list[Row] = []
    for problem in PROBLEMS:
        results = [found[f"{_slug(problem)}-{seed}"] for seed in seeds]
        good = [result for result in results if "failed" not in result]
        if not good:
            rows.append({"what": problem, "test error": results[0]["failed"]})
            continue
        rows += [row(problem, method, good) for method in METHODS]
    with matplotlib.rc_context(STYLE):
        save(rivals_figure(rows), request.folder / "dad-rivals.png")
    caption = (
        "Test error of each method over single step's, mean and 95 % interval over seeds; below 1 is better."
    )
    return Report(
        ABOUT, COLUMNS, rows, {**SETTING, "methods": _described()}, {"dad-rivals.png": caption}, NOTES
    )


ABOUT = (
    "Six ways to train one class of models (random Fourier features, 50 or 100 frequencies) for predictions of 30 "
    f"steps from 400 trajectories, {PASSES} passes each; bandwidth, ridge and own options by the multi-step error on "
    "validation trajectories."
)
NOTES = [
    "Ratios are paired over seeds: below 1 the method is better than what stands in the column's head. A pass of a "
    "method with gradients through time visits every sub-trajectory, that is each step several times; its CPU seconds "
    "say what that costs. CPU seconds are of the chosen fit alone, one thread, other work beside it.",
    "The gradient methods start from the single-step solution and need a differentiable model; DaD takes any "
    "regressor. Their learning rates, whitening and scheduled sampling's options were searched beforehand on other "
    "pendulum data, which DaD's were not.",
]


def row(problem: str, method: str, results: list[dict[str, Any]]) -> Row:
    """One method on one problem."""
    error = Interval.of([result[method]["test"] for result in results])
    single = Interval.of([result[method]["test"] / result["single step"]["test"] for result in results])
    dad = Interval.of([result[method]["test"] / result["DaD"]["test"] for result in results])
    return {
        "what": f"{problem}: {method}",
        "problem": problem,
        "method": method,
        "test error": error.text(),
        "against single step": "" if method == "single step" else single.text(),
        "against DaD": "" if method == "DaD" else dad.text(),
        "CPU seconds": f"{np.median([result[method]['cpu_seconds'] for result in results]):.2g}",
        "values": single.to_dict(),
        "meets": None,
    }


def cell(cell: dict[str, Any], extra: Any) -> dict[str, Any]:
    """One problem and seed: each method tuned, then tested."""
    warnings.simplefilter("ignore", DivergenceWarning)
    system, noise, m = PROBLEMS[cell["problem"]]
    train, validation, test = data.simulated_parts(system, cell["seed"], n=cell["trajectories"], noise=noise)
    scale = train.n_obs**0.5
    learners = [
        RandomFourierRidge(n_frequencies=m, bandwidth=b * scale, alpha=a, random_state=cell["seed"])
        for b, a in product(cell["bandwidths"], cell["alphas"])
    ]
    result = {}
    for name, (make, common, options) in METHODS.items():
        tried: list[tuple[float, int, DynamicsModel, dict[str, Any], float]] = []
        for learner, own in product(learners, options):
            started = time.process_time()
            model = make(learner, **common, **own).fit(train, validation)
            spent = time.process_time() - started
            tried.append((model.errors(validation).mean, len(tried), model, own, spent))
        score, _, model, own, spent = min(tried, key=lambda entry: entry[:2])
        result[name] = {
            "test": model.errors(test).mean,
            "validation": score,
            "options": own,
            "bandwidth": model.regressor.bandwidth,  # type: ignore[attr-defined]
            "alpha": model.regressor.alpha,  # type: ignore[attr-defined]
            "cpu_seconds": spent,
        }
    return result


def rivals_figure(rows: list[Row]) -> Figure:
    """Ratios to single step, a small plot a problem."""
    problems = list(dict.fromkeys(row["problem"] for row in rows if "values" in row))
    figure = Figure(figsize=(3.0 * max(1, len(problems)) + 2.2, 3.2), layout="constrained")
    for axes, problem in zip(
        figure.subplots(1, max(1, len(problems)), squeeze=False, sharey=True, sharex=True)[0],
        problems,
        strict=False,
    ):
        shown = [row for row in rows if row.get("problem") == problem and row["method"] != "single step"]
        for place, one in enumerate(shown):
            value, (low, high) = one["values"]["value"], one["values"]["interval"]
            colour = DAD if one["method"] == "DaD" else SINGLE
            axes.plot(value, place, "o", color=colour)
            axes.plot([max(low, 0.02 * value), high], [place, place], color=colour, linewidth=1.4)
        axes.axvline(1.0, color=FAINT, linestyle="--", linewidth=1)
        axes.set_yticks(range(len(shown)), [one["method"].replace(" (", "\n(") for one in shown])
        axes.set_xscale("log")
        axes.set_xticks(RATIOS, [f"{ratio:g}" for ratio in RATIOS])
        axes.minorticks_off()
        plain(axes, problem, "error / single step's", "")
        axes.invert_yaxis()
    return figure


def _described() -> dict[str, Any]:
    return {name: {"common": common, "options": options} for name, (_, common, options) in METHODS.items()}


def _slug(problem: str) -> str:
    return problem.replace(", noise ", "-")
