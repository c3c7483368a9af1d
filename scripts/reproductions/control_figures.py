"""The figures of the model-based control experiments: cost by iteration, DaD+DAgger against DAgger only.

As in the thesis's Figs. 3.11 to 3.15: the mean over trials of the cumulative cost at each iteration, with its standard
error, on costs normalised by the highest mean of the panel ("normalised to the highest observed cost"). The raw costs
stand in the tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from beliefgym.scripts.leaderboard.plots import FAINT
from beliefgym.scripts.reproductions.dad_figures import DAD, SINGLE, STYLE, plain, save

Floats = NDArray[np.float64]
NAMES = {False: "DAgger only", True: "DAgger + DaD"}
COLOURS = {NAMES[False]: SINGLE, NAMES[True]: DAD}


def mean_and_error(costs: ArrayLike) -> tuple[Floats, Floats]:
    """Mean over the first axis and its standard error: (trials, iterations) -> two of (iterations,)."""
    c = np.asarray(costs, dtype=float)
    error = c.std(axis=0, ddof=1) / len(c) ** 0.5 if len(c) > 1 else np.zeros(c.shape[1])
    return c.mean(axis=0), error


def cost_curves(
    path: Path,
    panels: Mapping[str, Mapping[str, ArrayLike]],
    *,
    log: bool = False,
    x: Sequence[float] | None = None,
    x_label: str = "DAgger iteration",
    references: Mapping[str, Mapping[str, float]] | None = None,
    colours: Mapping[str, str] | None = None,
    normalise: str = "panel",
) -> None:
    """Draw panels side by side and save them.

    Args:
        path: of the figure.
        panels: title -> (line's name -> costs (trials, iterations)).
        log: logarithmic costs. x: the iterations' places; 1, 2, .. if None.
        references: title -> (name -> cost), a dashed line each (the expert's, say).
        colours: line's name -> colour, beyond those of `NAMES`.
        normalise: "panel" by each panel's highest mean, "figure" by the highest of all, "no".
    """
    shades = {**COLOURS, **(colours or {})}
    means = {t: {n: mean_and_error(c) for n, c in lines.items()} for t, lines in panels.items()}
    highest = {t: max(float(np.max(m)) for m, _ in lines.values()) for t, lines in means.items()}
    if normalise == "figure":
        highest = dict.fromkeys(highest, max(highest.values()))
    elif normalise == "no":
        highest = dict.fromkeys(highest, 1.0)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.2 * len(panels), 3.4), layout="constrained")
        axes = figure.subplots(1, len(panels), squeeze=False, sharey=normalise != "panel")[0]
        for ax, (title, lines) in zip(axes, means.items(), strict=True):
            for name, (mean, error) in lines.items():
                at = np.arange(1, len(mean) + 1) if x is None else np.asarray(x)[: len(mean)]
                m, e = mean / highest[title], error / highest[title]
                ax.plot(at, m, color=shades.get(name), label=name, marker="o", markersize=3)
                low = np.maximum(m - e, m * 0.05) if log else m - e
                ax.fill_between(at, low, m + e, color=shades.get(name), alpha=0.2, linewidth=0)
            for name, cost in (references or {}).get(title, {}).items():
                ax.axhline(cost / highest[title], color=FAINT, linestyle="--", linewidth=1, label=name)
            if log:
                ax.set_yscale("log")
            else:
                ax.set_ylim(bottom=0)
            plain(ax, title, x_label, "")
            ax.legend(frameon=True, framealpha=0.85, edgecolor="none", fontsize=8)
            if x is None:
                ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes[0].set_ylabel("cumulative cost" + ("" if normalise == "no" else ", share of the highest"))
        save(figure, path)
