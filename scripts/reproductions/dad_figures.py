"""Figures of the Data as Demonstrator experiments, after the thesis's Figs. 3.2 to 3.8."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.rendering import Canvas
from beliefgym.scripts.leaderboard.plots import FAINT, GRID, INK, PALETTE, STYLE

SINGLE, DAD, TRUTH = PALETTE[1], PALETTE[0], INK
STEPS = (1, 8, 16, 23, 30)  # those of Fig. 3.2
Groups = dict[str, list[dict[str, Any]]]


def save(figure: Figure, path: Path) -> None:
    """Write a PNG, the same bytes for the same numbers."""
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def plain(axes: Axes, title: str, x: str, y: str) -> None:
    """The common dress of a small plot."""
    axes.set_title(title, fontsize=10, loc="left", color=INK)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)


def table_figures(rows: list[dict[str, Any]], groups: Groups, folder: Path) -> dict[str, str]:
    """All figures of `dad-table` into the folder.

    Args:
        rows: of the table. groups: title of a row -> results of its seeds.

    Returns:
        file name -> caption.
    """
    made = {}
    with matplotlib.rc_context(STYLE):
        shown = [row for row in rows if "values" in row]
        if shown:
            save(errors_figure(shown), folder / "dad-table-errors.png")
            made["dad-table-errors.png"] = (
                "Multi-step error on test trajectories, mean and 95 % interval over seeds (after Fig. 3.8)."
            )
        if groups:
            short = {name.replace("random Fourier features", "RFF"): group for name, group in groups.items()}
            save(horizon_figure(short), folder / "dad-table-horizon.png")
            made["dad-table-horizon.png"] = (
                "Error after each predicted step, as a share of the signal's power; seeds thin, their mean thick."
            )
            save(iterations_figure(short), folder / "dad-table-iterations.png")
            made["dad-table-iterations.png"] = (
                "DaD's iterations at the first seed: multi-step error (after Fig. 3.3) above, single-step loss on the "
                "aggregate (after Fig. 3.4) below; the ring is the model that validation chose."
            )
    return made


def errors_figure(rows: list[dict[str, Any]]) -> Figure:
    """Both arms' errors for each system as bars, on a logarithmic axis."""
    figure = Figure(figsize=(9.0, 1.2 + 0.52 * len(rows)), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(rows))
    for shift, arm, colour, label in ((-0.2, "single", SINGLE, "single step"), (0.2, "dad", DAD, "DaD")):
        value = np.array([row["values"][arm]["value"] for row in rows])
        low, high = np.array([row["values"][arm]["interval"] for row in rows]).T
        spread = np.nan_to_num(np.clip(np.array([value - low, high - value]), 0, None))
        spread[0] = np.minimum(spread[0], 0.98 * value)
        axes.barh(place + shift, value, 0.36, color=colour, label=label, xerr=spread, error_kw={"lw": 1.2})
    axes.set_yticks(place, [row["what"].replace("random Fourier features", "RFF") for row in rows])
    axes.invert_yaxis()
    axes.set_xscale("log")
    for at, row in zip(place, rows, strict=True):
        gain = row["values"]["improvement"]["value"]
        axes.text(
            1.01, float(at), f"{gain:+.0f} %", transform=axes.get_yaxis_transform(), va="center", color=FAINT
        )
    plain(
        axes,
        "",
        "multi-step error / signal power; at the right: improvement",
        "",
    )
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def horizon_figure(groups: Groups) -> Figure:
    """Error after each step, a small plot for each system and learner."""
    figure, grid = _grid(len(groups))
    for axes, (title, results) in zip(grid, groups.items(), strict=False):
        for arm, colour, label in (("single", SINGLE, "single step"), ("dad", DAD, "DaD")):
            curves = np.array(
                [np.divide(r[arm]["by_step"], np.mean(r[arm]["power_by_step"])) for r in results]
            )
            steps = np.arange(1, curves.shape[1] + 1)
            axes.plot(steps, curves.T, color=colour, linewidth=0.6, alpha=0.45)
            axes.plot(steps, curves.mean(axis=0), color=colour, linewidth=2, label=label)
        plain(axes, _broken(title), "step", "error / power")
        axes.set_yscale("log")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def iterations_figure(groups: Groups, columns: int = 5) -> Figure:
    """Multi-step error and aggregate's single-step loss over DaD's iterations, first seed; runs of one are left out."""
    histories = {
        title: results[0]["dad"]
        for title, results in groups.items()
        if len(results[0]["dad"]["history"]["iteration"]) > 1 and title.count(", ") < 2
    }
    lines = max(1, -(-len(histories) // columns))
    figure = Figure(figsize=(2.5 * columns + 0.4, 4.4 * lines + 0.4), layout="constrained")
    grid = figure.subplots(2 * lines, columns, squeeze=False)
    for place, (title, run) in enumerate(histories.items()):
        line, column = divmod(place, columns)
        above, below = grid[2 * line, column], grid[2 * line + 1, column]
        history, best = run["history"], run["best_iteration"]
        above.plot(history["iteration"], history["train_multi_step"], color=SINGLE, label="training rollouts")
        above.plot(history["iteration"], history["validation_multi_step"], color=DAD, label="validation")
        above.plot(best, history["validation_multi_step"][best], "o", ms=9, mfc="none", mec=DAD)
        below.plot(history["iteration"], history["aggregate_single_step"], color=INK)
        plain(above, _broken(title), "", "multi-step error" if not column else "")
        plain(below, "", "iteration", "loss on the aggregate" if not column else "")
        above.set_yscale("log")
        below.set_yscale("log")
    for place in range(len(histories), lines * columns):
        line, column = divmod(place, columns)
        grid[2 * line, column].set_visible(False)
        grid[2 * line + 1, column].set_visible(False)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def motion_figure(states: dict[str, NDArray[np.float64]]) -> Figure:
    """The free pendulum at five steps: the truth, the single-step model's and DaD's predictions.

    Args:
        states: "truth", "single", "dad" -> (31, 3) cos, sin, velocity, as the environment shows them.
    """
    rows = (("truth", "true", TRUTH), ("single", "single step", SINGLE), ("dad", "DaD", DAD))
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    grid = figure.subplots(3, len(STEPS))
    for r, (arm, label, colour) in enumerate(rows):
        for c, step in enumerate(STEPS):
            axes = grid[r, c]
            axes.imshow(picture(states[arm][step]))
            axes.set_xticks([])
            axes.set_yticks([])
            for spine in axes.spines.values():
                spine.set_visible(True)
                spine.set_color(GRID)
            if r == 0:
                axes.set_title(f"step {step}", fontsize=10)
            if c == 0:
                axes.set_ylabel(label, color=colour, fontsize=11)
    return figure


def picture(shown: NDArray[np.float64], size: int = 220) -> NDArray[np.uint8]:
    """A pendulum as its environment draws it, and a dot where its tip is predicted, on the circle or off it."""
    canvas = Canvas(size, size)
    Pendulum.uncontrolled().draw(canvas, np.array([np.arctan2(shown[1], shown[0]), shown[2]]), None)
    canvas.circle((float(shown[1]), float(shown[0])), 0.06, "force")
    return canvas.image()


def _broken(title: str) -> str:
    """A row's title in at most two lines."""
    system, _, rest = title.partition(", ")
    return f"{system}\n{rest}"


def _grid(n: int, columns: int = 4) -> tuple[Figure, list[Axes]]:
    lines = -(-n // columns)
    figure = Figure(figsize=(2.9 * min(n, columns) + 0.3, 2.5 * lines + 0.5), layout="constrained")
    grid = list(np.ravel(figure.subplots(lines, min(n, columns), squeeze=False)))
    for axes in grid[n:]:
        axes.set_visible(False)
    return figure, grid
