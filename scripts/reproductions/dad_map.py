"""`beliefgym reproduce dad-map`: where Data as Demonstrator helps, and where there is nothing to help.

The improvement over single-step training for every combination of noise, capacity of the model and length of the
prediction, both arms tuned alike at each point (dad_tuning.py).
"""

from __future__ import annotations

from itertools import product
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from beliefgym.learning import RandomFourierRidge
from beliefgym.scripts.leaderboard.plots import INK
from beliefgym.scripts.reproductions import dad_data as data
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_figures import STYLE, save
from beliefgym.scripts.reproductions.dad_tuning import TUNING_VERSION, tune
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

Point = tuple[str, float, int, int]  # system, noise, frequencies, steps
POINTS: list[Point] = [
    *(("pendulum", *rest) for rest in product((0.0, 0.003, 0.01, 0.03), (10, 30, 100), (10, 30, 100))),
    *(("cart-pole", *rest) for rest in product((0.0, 0.003, 0.01, 0.03), (30, 100, 300), (30,))),
    *(("helicopter", *rest) for rest in product((0.0, 0.1, 1.0), (30, 100, 300), (30,))),
]
SETTING = {
    "data_version": data.VERSION,
    "tuning_version": TUNING_VERSION,
    "trajectories": 400,
    "bandwidths": [1.0, 2.0],
    "alphas": [1e-8, 1e-6, 1e-4],
    "horizons": [5, 10, None],
    "n_iterations": 20,
    "screening": 3,
}
COLUMNS = ("what", "single step", "DaD", "improvement", "verdict", "meets")


def run(request: Request) -> Report:
    """Every point of the map at every seed."""
    seeds = range(request.seed, request.seed + request.seeds)
    cells = {_name(point, seed): _cell(point, seed) for point in POINTS for seed in seeds}
    folder = request.folder / "cells" / "dad-map"
    found = run_cells(f"{__name__}:cell", cells, folder, request.jobs, request.told)
    rows = [row(point, [found[_name(point, seed)] for seed in seeds]) for point in POINTS]
    with matplotlib.rc_context(STYLE):
        save(map_figure(rows), request.folder / "dad-map.png")
    verdicts = [one["verdict"] for one in rows]
    counts = {word: verdicts.count(word) for word in ("helps", "no difference", "hurts", "failed")}
    notes = [
        ", ".join(f"{word}: {count}" for word, count in counts.items() if count)
        + f", of {len(rows)} points.",
        "`helps` and `hurts`: the 95 % interval of the paired improvement over seeds leaves zero out. `meets`: not "
        "worse than single step by more than its interval.",
        WHY,
    ]
    caption = "Improvement of DaD over single step in per cent, mean over seeds; bold: the interval leaves zero out."
    return Report(ABOUT, COLUMNS, rows, dict(SETTING), {"dad-map.png": caption}, notes)


ABOUT = (
    "Improvement of DaD over single-step training on test trajectories, by noise, number of random frequencies and "
    "length of the trajectories; 400 trajectories a system, split 80 / 10 / 10."
)
WHY = (
    "Read it so: the error that process noise puts into any prediction is the floor for both; where single-step "
    "training already stands on it nothing is left to improve. DaD helps where the model class cannot hold the "
    "dynamics exactly (few frequencies, strong ridge) or where a small error of the fit is fed back many times."
)


def row(point: Point, results: list[dict[str, Any]]) -> Row:
    """One point: errors, improvement and verdict."""
    system, noise, m, n_steps = point
    unit = "gusts" if system == "helicopter" else "noise"
    base: Row = {
        "what": f"{system}, {unit} {noise:g}, {m} frequencies, {n_steps} steps",
        "point": list(point),
    }
    good = [result for result in results if "failed" not in result]
    if not good:
        reason = {"single step": results[0]["failed"], "DaD": "", "improvement": ""}
        return base | reason | {"verdict": "failed", "meets": None}
    improvement = Interval.of([100.0 * (1.0 - result["dad"] / result["single"]) for result in good])
    if len(good) > 1 and improvement.low > 0:
        verdict = "helps"
    elif len(good) > 1 and improvement.high < 0:
        verdict = "hurts"
    else:
        verdict = "no difference"
    return base | {
        "single step": Interval.of([result["single"] for result in good]).text(),
        "DaD": Interval.of([result["dad"] for result in good]).text(),
        "improvement": improvement.text(".1f", " %"),
        "verdict": verdict,
        "meets": verdict != "hurts",
        "values": improvement.to_dict(),
    }


def cell(cell: dict[str, Any], extra: Any) -> dict[str, Any]:
    """One point and seed: test errors of both tuned arms."""
    system, noise = cell["system"], cell["noise"]
    disturbance = {"gusts": noise} if system == "helicopter" else {"noise": noise}
    train, validation, test = data.simulated_parts(
        system, cell["seed"], n=cell["trajectories"], n_steps=cell["n_steps"], **disturbance
    )
    scale = train.n_obs**0.5
    pair = tune(
        train,
        validation,
        RandomFourierRidge(n_frequencies=cell["n_frequencies"], random_state=cell["seed"]),
        [{"bandwidth": b * scale, "alpha": a} for b, a in product(cell["bandwidths"], cell["alphas"])],
        [{"horizon": horizon} for horizon in cell["horizons"]],
        n_iterations=cell["n_iterations"],
        screening=cell["screening"],
    )
    return {
        "single": pair.single.model.errors(test).mean,
        "dad": pair.dad.model.errors(test).mean,
        "learner": {"single": pair.single.learner, "dad": pair.dad.learner},
        "options": pair.dad.options,
        "best_iteration": pair.dad.model.best_iteration_,
    }


def map_figure(rows: list[Row]) -> Figure:
    """One small table of colours for each system and length."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for one in rows:
        if "values" in one:
            groups.setdefault((one["point"][0], one["point"][3]), []).append(one)
    figure = Figure(figsize=(2.5 * len(groups) + 1.0, 3.1), layout="constrained")
    image = None
    for axes, ((system, n_steps), group) in zip(
        figure.subplots(1, len(groups), squeeze=False)[0], groups.items(), strict=True
    ):
        noises = sorted({one["point"][1] for one in group})
        sizes = sorted({one["point"][2] for one in group})
        values = np.full((len(noises), len(sizes)), np.nan)
        for one in group:
            r, c = noises.index(one["point"][1]), sizes.index(one["point"][2])
            values[r, c] = one["values"]["value"]
            sure = one["verdict"] in ("helps", "hurts")
            axes.text(
                c,
                r,
                f"{values[r, c]:.0f}",
                ha="center",
                va="center",
                fontsize=11,
                fontweight="bold" if sure else "normal",
                color="white" if abs(values[r, c]) > 50 else INK,
            )
        image = axes.imshow(values, cmap="RdBu", vmin=-80, vmax=80, aspect="auto")
        axes.set_xticks(range(len(sizes)), [str(size) for size in sizes])
        axes.set_yticks(range(len(noises)), [f"{noise:g}" for noise in noises])
        axes.set_title(f"{system}\n{n_steps} steps", fontsize=10)
        axes.set_xlabel("frequencies")
        axes.set_ylabel("gusts (N, N m)" if system == "helicopter" else "noise")
        for spine in axes.spines.values():
            spine.set_visible(False)
    if image is not None:
        figure.colorbar(image, ax=figure.axes, label="improvement, %", shrink=0.8)
    return figure


def _name(point: Point, seed: int) -> str:
    system, noise, m, n_steps = point
    return f"{system}-{noise:g}-{m}-{n_steps}-{seed}"


def _cell(point: Point, seed: int) -> dict[str, Any]:
    system, noise, m, n_steps = point
    return {"system": system, "noise": noise, "n_frequencies": m, "n_steps": n_steps, "seed": seed, **SETTING}
