"""`beliefgym reproduce psim-amount`: predictive state filters against a recurrent network, by the amount of data.

Who wins, with how many trajectories, at which training time: PSIM-Linear_d, PSIM-RFF_d and a GRU filter, tuned as in
`psim-recorded`, on some of the training trajectories of the recorded assembly and motion capture (five folds), and of a
pendulum seen by the noisy cosine and sine of its angle (five seeds; simulated, so that data do not run out).
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from beliefgym.learning import Sequences
from beliefgym.scripts.reproductions import psim_methods as methods
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.psim_data import (
    ASSEMBLY,
    MOCAP,
    RECORDINGS,
    Recording,
    noisy_pendulum,
    parts,
    present,
)
from beliefgym.scripts.reproductions.psim_figures import SHOWN, numbers
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

PENDULUM = "pendulum"
SIZES = {
    ASSEMBLY: (5, 15, 0),
    MOCAP: (5, 15, 0),
    PENDULUM: (10, 30, 100, 300, 1000),
}  # 0 for all there are
PENDULUM_STEPS, PENDULUM_NOISE, N_TEST = 50, 0.1, 500
SETTINGS = {**RECORDINGS, PENDULUM: Recording("noisy pendulum (simulated)", "", 5, True, "1")}
LINEAR, WAVES, NETWORK = "PSIM-Linear_d", "PSIM-RFF_d", "GRU"
COLUMNS = ("what", "error", "seconds", "over GRU", "seconds over GRU")


def run(request: Request) -> Report:
    """Every fold, or seed, with every number of trajectories."""
    names = [name for name in SIZES if name == PENDULUM or present(name, request.data)]
    cells: dict[str, dict[str, Any]] = {}
    for name in names:
        for fold in range(request.seed, request.seed + request.seeds):
            for size in SIZES[name]:
                cells[f"{name}-{size}-{fold}"] = {
                    "data": name,
                    "n": size,
                    "fold": fold,
                    "data_version": SETTINGS[name].version,
                    "methods_version": methods.VERSION,
                }
    paths = {"data": None if request.data is None else str(request.data)}
    found = run_cells(
        f"{__name__}:cell", cells, request.folder / "cells" / "psim-amount", request.jobs, request.told, paths
    )
    rows: list[Row] = []
    curves: dict[str, dict[str, list[tuple[float, Interval]]]] = {}
    for name in names:
        curves[SETTINGS[name].title] = {method: [] for method in (LINEAR, WAVES, NETWORK)}
        for size in SIZES[name]:
            good = [
                one for key, one in found.items() if key.startswith(f"{name}-{size}-") and "failed" not in one
            ]
            if not good:
                continue
            n = float(np.mean([one["n_trajectories"] for one in good]))
            for method, curve in curves[SETTINGS[name].title].items():
                curve.append((n, Interval.of([one["methods"][method]["test"] for one in good])))
                rows.append(_row(f"{SETTINGS[name].title}, {n:.0f} trajectories", method, good))
    made = "psim-amount.png"
    _figure(request.folder / made, curves)
    absent = [name for name in SIZES if name not in names]
    notes = list(NOTES)
    if absent:
        notes.append(f"Without data, and so left out: {', '.join(absent)} (`--data` names the folder).")
    return Report(ABOUT, COLUMNS, rows, {"sizes": SIZES, "noise": PENDULUM_NOISE}, {made: CAPTION}, notes)


ABOUT = (
    "One-step error on test trajectories and seconds of training, tuning included, by the number of training "
    "trajectories; means over folds or seeds with 95 % intervals, ratios as geometric means, paired."
)
CAPTION = (
    "One-step error by the number of training trajectories, mean and its 95 % interval over folds or seeds."
)
NOTES = [
    "PSIM's seconds hold its whole grid (6 ridges; 12 settings of random features); the network's settings were chosen "
    "beforehand, and its seconds are one training. One thread, while another process ran: orders of magnitude.",
    "Validation trajectories are the fold's own whatever the number to train on; for the pendulum a fifth of it, at "
    "least 10.",
]


def cell(cell: dict[str, Any], paths: dict[str, Any]) -> dict[str, Any]:
    """All three methods on one amount of data."""
    import torch

    torch.set_num_threads(1)
    recording = SETTINGS[cell["data"]]
    train, validation, test = _parts(cell, paths)
    data, seed = (train, validation), cell["fold"]
    with methods.quiet():
        chosen = {
            LINEAR: methods.tuned(methods.linear_psim(recording), methods.RIDGES, *data),
            WAVES: dict(islice(methods.waves_group(recording, data, seed), 2))[WAVES],
            NETWORK: dict(islice(methods.recurrent_group(recording, data, seed), 1))[NETWORK],
        }
        results = {
            name: {
                "test": one.filter.errors(test).mean,
                "validation": one.validation,
                "seconds": one.seconds,
                "seconds_tuning": one.seconds_tuning,
                "setting": one.setting,
            }
            for name, one in chosen.items()
        }
    return {"methods": results, "n_trajectories": len(train), "n_train": train.n_transitions}


def _parts(cell: dict[str, Any], paths: dict[str, Any]) -> tuple[Sequences, Sequences, Sequences]:
    if cell["data"] == PENDULUM:
        rng = np.random.default_rng([cell["fold"], 7])
        sizes = (cell["n"], max(10, cell["n"] // 5), N_TEST)
        train, validation, test = (noisy_pendulum(n, PENDULUM_STEPS, PENDULUM_NOISE, rng) for n in sizes)
        return train, validation, test
    train, validation, test = parts(cell["data"], cell["fold"], paths)
    order = np.random.default_rng(cell["fold"]).permutation(len(train))
    return train[np.sort(order[: cell["n"] or len(train)])], validation, test


def _row(what: str, method: str, good: list[dict[str, Any]]) -> Row:
    error = Interval.of([one["methods"][method]["test"] for one in good])
    seconds = Interval.of([one["methods"][method]["seconds_tuning"] for one in good])
    row: Row = {"what": f"{what}: {method}", "error": error.text(".4g"), "seconds": f"{seconds.mean:.2g}"}
    if method != NETWORK:
        for column, key in (("over GRU", "test"), ("seconds over GRU", "seconds_tuning")):
            log = Interval.of(
                [np.log(one["methods"][method][key] / one["methods"][NETWORK][key]) for one in good]
            )
            mean, low, high = (float(np.exp(v)) for v in (log.mean, log.low, log.high))
            row[column] = Interval(mean, low, high, log.n).text(".2f") if key == "test" else f"{mean:.2f}"
    return row | {"meets": None, "values": {"error": error.to_dict(), "seconds": seconds.to_dict()}}


def _figure(path: Path, curves: dict[str, dict[str, list[tuple[float, Interval]]]]) -> None:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.2 * len(curves), 3.4), layout="constrained")
        for ax, (title, methods_curves) in zip(
            figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True
        ):
            for method, curve in methods_curves.items():
                n = [one[0] for one in curve]
                mean = np.array([one[1].mean for one in curve])
                low = np.array([max(one[1].low, 0.3 * one[1].mean) for one in curve])
                high = np.array([one[1].high for one in curve])
                ax.plot(n, mean, color=SHOWN[method], label=method, marker="o", markersize=3)
                ax.fill_between(n, low, high, color=SHOWN[method], alpha=0.15, linewidth=0)
            ax.set_xscale("log")
            ax.set_yscale("log")
            plain(ax, title, "training trajectories", "one-step error")
            numbers(ax.xaxis, np.round(n))
            numbers(ax.yaxis)
            ax.legend(frameon=True, framealpha=0.85, edgecolor="none", fontsize=8)
        save(figure, path)
