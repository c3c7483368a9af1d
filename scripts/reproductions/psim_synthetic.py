"""`beliefgym reproduce psim-synthetic`: how fast filters converge with the number of trajectories (Fig. 3.19).

A linear system of 4 states and 2 observations, exactly 2-observable, whose observations come from its own stationary
Kalman filter; filters learned from N trajectories of 50 steps, against that Kalman filter. The thesis draws
log(e / e_F); beside it stands e / e_F - 1, on logarithmic axes, where a rate is a slope.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefgym.learning import Sequences
from beliefgym.learning.autoregressive_filter import AutoregressiveFilter
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.filters import Filter
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_forward import ForwardPSIM
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

Floats = NDArray[np.float64]
VERSION = 1  # of the protocol
N_TRAJECTORIES = (10, 30, 100, 300, 1000, 3000, 10000)
N_STEPS, N_TEST = 50, 4000
N_STATES, N_OBS, K = 4, 2, 2
RADII = (0.98, 0.9)  # of the two pairs of eigenvalues of A
CLOSED = (0.8, 0.92)  # spectral radius of A - K C: the filter remembers about ten steps
PROCESS_NOISE = 0.1  # variance, against 1 of the observations
CONDITION = 30.0  # largest of the observability matrix [C; C A]
ALPHAS = (1e-8, 1e-3, 1e-2, 1e-1)
STARTS = {"mean": "from the mean", "stationary": "from anywhere"}
PASTS = (5, 10, 20, 35)
LARGEST = 1.02  # the ratio to the Kalman filter that both trainings are to reach
DAGGER, LITERAL, FORWARD = "PSIM, DAgger", "PSIM, DAgger as printed", "PSIM, forward training"
METHODS = (DAGGER, LITERAL, FORWARD, *(f"AR-{p}" for p in PASTS))
COLOURS = {
    DAGGER: "#c2410c",
    LITERAL: "#e9a06b",
    FORWARD: "#1d4ed8",
    "AR-5": "#9ca3af",
    "AR-10": "#7b8494",
    "AR-20": "#565f6e",
    "AR-35": "#2f3742",
}
COLUMNS = ("what", *(f"N = {n}" for n in (10, 100, 1000, 10000)), "target", "meets")


def run(request: Request) -> Report:
    """Every seed is another system, with data and tests of its own."""
    seeds = range(request.seed, request.seed + request.seeds)
    cells = {f"{start}-{seed}": _cell(start, seed) for start in STARTS for seed in seeds}
    found = run_cells(
        f"{__name__}:cell", cells, request.folder / "cells" / "psim-synthetic", request.jobs, request.told
    )
    rows: list[Row] = []
    ratios: dict[str, dict[str, Floats]] = {}
    for start, title in STARTS.items():
        good = [found[f"{start}-{s}"] for s in seeds if "failed" not in found[f"{start}-{s}"]]
        ratios[title] = {
            method: np.array([np.divide(one["errors"][method], one["kalman"]) for one in good])
            for method in METHODS
        }
        rows += [_row(method, title, table) for method, table in ratios[title].items()]
        rows.append(_order(title, ratios[title]))
    name = "psim-synthetic.png"
    _figure(request.folder / name, ratios)
    return Report(ABOUT, COLUMNS, rows, _cell("", -1), {name: CAPTION}, NOTES)


ABOUT = (
    "One-step error over that of the system's own stationary Kalman filter, by the number of training trajectories; "
    "mean over seeds and its 95 % interval. Every seed is another system. The ridge is chosen from one grid for every "
    "method, on further trajectories (a fifth of N, at least 10)."
)
CAPTION = (
    "Fig. 3.19: left as in the thesis, log(e / e_F); right the excess e / e_F - 1. Trajectories start at the filter's "
    "own mean (above), where the stationary filter is the best there is, or anywhere (below), where it is not."
)
NOTES = [
    "`PSIM, DAgger` starts from beliefs regressed on the past (init 'history'), whose pairs start the aggregate; "
    "`as printed` is Algorithm 4 to the letter, with F_0 the constant m_1 and an empty aggregate: what a poor F_0 met "
    "leaves it at a rate of one over the number of iterations (20), whatever N.",
    "`from anywhere`: states start from their stationary distribution, unknown to the filter. Over the first steps the "
    "stationary filter is then not optimal, and a filter of its own for each step (forward training) can be better.",
]


def system(seed: int) -> LinearGaussianSystem:
    """A random system of the kind above.

    Args:
        seed: of its matrices.
    """
    rng = np.random.default_rng([seed, 319])
    while True:
        a = np.zeros((N_STATES, N_STATES))
        for pair, radius in enumerate(RADII):
            angle = rng.uniform(0.1, 1.5)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            a[2 * pair : 2 * pair + 2, 2 * pair : 2 * pair + 2] = radius * turn
        mix = np.linalg.qr(rng.standard_normal((N_STATES, N_STATES)))[0]
        a, c = mix @ a @ mix.T, rng.standard_normal((N_OBS, N_STATES))
        if np.linalg.cond(np.vstack([c, c @ a])) > CONDITION:
            continue
        found = LinearGaussianSystem(a, c, PROCESS_NOISE * np.eye(N_STATES), np.eye(N_OBS))
        closed = np.abs(KalmanFilter.of(found).transition_eigenvalues).max()
        if CLOSED[0] < closed < CLOSED[1]:
            return found


def cell(cell: dict[str, Any], _: Any) -> dict[str, Any]:
    """All methods and sizes on one system."""
    seed, start = cell["seed"], cell["start"]
    truth = system(seed)
    rng = np.random.default_rng([seed, 1, list(STARTS).index(start)])
    test = truth.sample_innovations(N_TEST, N_STEPS, rng, start=start)
    kalman = KalmanFilter.of(truth).errors(test).mean
    largest = cell["sizes"][-1]
    train = truth.sample_innovations(largest, N_STEPS, rng, start=start)
    validation = truth.sample_innovations(largest // 5, N_STEPS, rng, start=start)
    errors: dict[str, list[float]] = {method: [] for method in METHODS}
    chosen: dict[str, list[float]] = {method: [] for method in METHODS}
    warnings.simplefilter("ignore", DivergenceWarning)
    for n in cell["sizes"]:
        parts = train[:n], validation[: max(10, n // 5)]
        for method in METHODS:
            alpha, best = _tuned(method, cell["alphas"], *parts)
            errors[method].append(best.errors(test).mean)
            chosen[method].append(alpha)
    return {"kalman": kalman, "errors": errors, "alphas": chosen}


def _tuned(method: str, alphas: list[float], train: Sequences, validation: Sequences) -> tuple[float, Filter]:
    fitted = [_method(method, alpha).fit(train, validation) for alpha in alphas]
    best = int(np.argmin([one.errors(validation).mean for one in fitted]))
    return alphas[best], fitted[best]


def _method(method: str, alpha: float) -> Filter:
    ridge = Ridge(alpha=alpha)
    if method == FORWARD:
        return ForwardPSIM(ridge, n_future=K)
    if method == DAGGER:
        return PSIM(ridge, n_future=K, n_past=10)
    if method == LITERAL:
        return PSIM(ridge, n_future=K, init="prior")
    return AutoregressiveFilter(ridge, n_past=int(method.removeprefix("AR-")))


def _cell(start: str, seed: int) -> dict[str, Any]:
    return {
        "version": VERSION,
        "start": start,
        "seed": seed,
        "sizes": list(N_TRAJECTORIES),
        "alphas": list(ALPHAS),
        "n_steps": N_STEPS,
        "radii": list(RADII),
        "closed": list(CLOSED),
        "process_noise": PROCESS_NOISE,
    }


def _row(method: str, title: str, ratio: Floats) -> Row:
    row: Row = {"what": f"{method}, {title}", "meets": None, "target": ""}
    for i, n in enumerate(N_TRAJECTORIES):
        interval = Interval.of(ratio[:, i])
        row[f"N = {n}"] = interval.text(".4f" if interval.mean < 2 else ".3g")
        row[f"ratio at {n}"] = interval.to_dict()
    if method in (DAGGER, LITERAL, FORWARD):
        row |= {
            "target": f"at most {LARGEST:g} at the largest N",
            "meets": bool(ratio[:, -1].mean() <= LARGEST),
        }
    return row


def _order(title: str, ratios: dict[str, Floats]) -> Row:
    """Forward training over DAgger as printed, paired: above 1 with few trajectories, at most 1 with many."""
    over = ratios[FORWARD] / ratios[LITERAL]
    row: Row = {
        "what": f"forward training / DAgger as printed, {title}",
        "target": "above 1 first, at most 1 last",
    }
    for i, n in enumerate(N_TRAJECTORIES):
        row[f"N = {n}"] = Interval.of(over[:, i]).text(".4f" if over[:, i].mean() < 2 else ".3g")
    row["meets"] = bool(over[:, 0].mean() > 1 and over[:, -1].mean() <= 1)
    return row


def _figure(path: Path, ratios: dict[str, dict[str, Floats]]) -> None:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 7.0), layout="constrained")
        for line, (title, tables) in zip(figure.subplots(2, 2), ratios.items(), strict=True):
            for method, ratio in tables.items():
                log = np.log(ratio)
                mean, error = log.mean(axis=0), log.std(axis=0) / len(log) ** 0.5
                line[0].plot(
                    N_TRAJECTORIES, mean, color=COLOURS[method], label=method, marker="o", markersize=3
                )
                line[0].fill_between(
                    N_TRAJECTORIES, mean - error, mean + error, color=COLOURS[method], alpha=0.2, linewidth=0
                )
                excess = (ratio - 1.0).mean(axis=0)
                shown = excess > 0
                line[1].plot(
                    np.array(N_TRAJECTORIES)[shown],
                    excess[shown],
                    color=COLOURS[method],
                    label=method,
                    marker="o",
                    markersize=3,
                )
            line[0].set_ylim(-0.005, 0.1)
            line[1].set_yscale("log")
            for ax, what in zip(line, ("log(e / e_F)", "e / e_F - 1"), strict=True):
                ax.set_xscale("log")
                plain(ax, f"trajectories start {title}", "training trajectories N", what)
            line[0].legend(frameon=True, framealpha=0.85, edgecolor="none", fontsize=8)
        save(figure, path)
