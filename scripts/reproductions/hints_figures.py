"""Error of hints over time, after the thesis's Fig. 3.24."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.hints_data import TASKS
from beliefgym.scripts.reproductions.psim_figures import numbers

COLOURS = {
    "Physics UKF": "#4b5563",
    "particle filter": "#a16207",
    "complementary filter": "#4b5563",
    "AR (k_p = 5)": "#9ca3af",
    "Linear KF": "#0f766e",
    "GRU": "#7c3aed",
    "IMF": "#1d4ed8",
}
PSIM = "#c2410c"


def over_time(path: Path, by_task: dict[str, dict[str, dict[int, dict[str, Any]]]]) -> None:
    """One panel a task: mean error of each method after 1, 2, .. observations, with its standard error."""
    shown = {name: found for name, found in by_task.items() if found and TASKS[name].horizons}
    if not shown:
        return
    drawn: dict[str, Any] = {}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.6 * max(len(shown), 2), 4.4), layout="constrained")
        for ax, (name, found) in zip(
            figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True
        ):
            longest = f"PSIM+Hints (k_f = {TASKS[name].horizons[-1]})"
            for method, colour in {**COLOURS, longest: PSIM}.items():
                if method not in found:
                    continue
                mean, error = _curve(list(found[method].values()))
                steps = np.arange(1, len(mean) + 1)
                (line,) = ax.plot(steps, mean, color=colour, lw=1.8 if method == longest else 1.1)
                ax.fill_between(
                    steps, np.maximum(mean - error, 0.3 * mean), mean + error, color=colour, alpha=0.15, lw=0
                )
                drawn.setdefault(method, line)
            ax.set_yscale("log")
            plain(ax, TASKS[name].title, "observations", f"error ({TASKS[name].unit})")
            numbers(ax.yaxis)
        figure.legend(
            drawn.values(), drawn.keys(), loc="outside lower center", ncols=4, frameon=False, fontsize=8
        )
        save(figure, path)


def _curve(folds: list[dict[str, Any]]) -> tuple[Any, Any]:
    """Mean over all trajectories at each time, and its standard error."""
    sums, squares, n = (
        np.array([one[key] for one in folds], dtype=float).sum(axis=0)
        for key in ("by_time", "squares_by_time", "n_by_time")
    )
    mean = sums / n
    return mean, np.sqrt(np.maximum(squares / n - np.square(mean), 0.0) / np.maximum(n - 1.0, 1.0))
