"""Figures of the filter experiments on recorded data, after the thesis's Fig. 3.20."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike

from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.psim_data import RECORDINGS

SHOWN = {
    "AR-5": "#9ca3af",
    "N4SID": "#4b5563",
    "IVR": "#a16207",
    "Kalman, EM": "#0f766e",
    "GRU": "#7c3aed",
    "PSIM-Linear_d": "#1d4ed8",
    "PSIM-RFF_d": "#c2410c",
}
BARS = 0.8  # of the room of a method


def recorded_figures(found: dict[str, Any], order: tuple[str, ...], folder: Path) -> dict[str, str]:
    """Both figures into the folder: file name -> caption."""
    names = [name for name in RECORDINGS if found.get(name)]
    if not names:
        return {}
    with matplotlib.rc_context(STYLE):
        save(_look_ahead(found, names), folder / "psim-recorded-look-ahead.png")
        save(_errors(found, names, order), folder / "psim-recorded-errors.png")
    return {
        "psim-recorded-errors.png": "One-step errors as a share of the signal's power: folds, and their mean.",
        "psim-recorded-look-ahead.png": (
            "Error by look-ahead as a share of the signal's power, mean over ten folds with its standard error (after "
            "Fig. 3.20). What is above the power is cut off."
        ),
    }


def numbers(axis: Axis, places: ArrayLike | None = None) -> None:
    """Plain numbers on a logarithmic axis; where it spans little, on minor ticks too.

    Args:
        axis: of a plot that is drawn. places: ticks; None leaves them.
    """
    low, high = axis.get_view_interval()
    if places is not None:
        axis.set_ticks(np.asarray(places))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    few = places is None and high / low < 30
    axis.set_minor_locator(LogLocator(subs=(2, 4, 6) if few else (0.5,)) if places is None else NullLocator())
    axis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}") if few else NullFormatter())


def _look_ahead(found: dict[str, Any], names: list[str]) -> Figure:
    figure, axes = _grid(len(names), 3.1)
    for ax, name in zip(axes, names, strict=False):
        for method, colour in SHOWN.items():
            folds = list(found[name].get(method, {}).values())
            if not folds:
                continue
            share = np.array([np.divide(one["by_look_ahead"], one["power"]) for one in folds])
            mean, error = share.mean(axis=0), share.std(axis=0) / len(share) ** 0.5
            steps = np.arange(1, len(mean) + 1)
            ax.plot(steps, mean, color=colour, label=method, marker="o", markersize=2.5)
            ax.fill_between(
                steps, np.maximum(mean - error, 0.3 * mean), mean + error, color=colour, alpha=0.15, lw=0
            )
        ax.set_yscale("log")
        ax.set_ylim(top=1.3)
        plain(ax, RECORDINGS[name].title, "look-ahead (steps)", "error / power")
        numbers(ax.yaxis)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=8)
    return figure


def _errors(found: dict[str, Any], names: list[str], order: tuple[str, ...]) -> Figure:
    figure, axes = _grid(len(names), 3.6)
    for ax, name in zip(axes, names, strict=False):
        methods = [method for method in order if method in found[name]]
        for place, method in enumerate(reversed(methods)):
            share = np.array([one["test"] / one["power"] for one in found[name][method].values()])
            colour = SHOWN.get(method, "#94a3b8" if not method.startswith("PSIM") else "#60a5fa")
            ax.scatter(
                np.minimum(share, 1.0), np.full(len(share), place), s=8, color=colour, alpha=0.4, linewidths=0
            )
            ax.scatter([min(share.mean(), 1.0)], [place], s=34, color=colour, marker="|", linewidths=2.2)
        ax.set_yticks(range(len(methods)), list(reversed(methods)), fontsize=7.5)
        ax.set_xscale("log")
        plain(ax, RECORDINGS[name].title, "error / power", "")
        numbers(ax.xaxis)
    return figure


def _grid(n: int, height: float) -> tuple[Figure, Any]:
    columns = min(n, 3)
    lines = -(-n // columns)
    figure = Figure(figsize=(4.2 * columns, height * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax in axes[n:]:
        ax.axis("off")
    return figure, axes
