"""The figure of `actions-interventions`: what beliefs hold, what simulations cost, and how many samples that takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from beliefgym.scripts.leaderboard.plots import FAINT, INK
from beliefgym.scripts.reproductions.actions_methods import (
    AHEAD,
    CONDITIONAL,
    CONDITIONAL_IS,
    DECISION,
    METHODS,
    NAIVE,
    ORDINARY,
    PLAIN,
    TRUNCATED,
    UNWEIGHED,
    WEIGHTED,
    WITH_WEIGHTS,
    geometric,
)
from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.psim_figures import numbers

Floats = NDArray[np.float64]
Found = Mapping[tuple[str, float], list[dict[str, Any]]]
COLOURS = {
    PLAIN: "#b0b5bd",
    NAIVE: "#6b7280",
    UNWEIGHED: "#111827",
    ORDINARY: "#e9a06b",
    WEIGHTED: "#d9b310",
    DECISION: "#c2410c",
    TRUNCATED: "#7c3aed",
    CONDITIONAL: "#93b4f5",
    CONDITIONAL_IS: "#1d4ed8",
}
MARKERS = {"output": "o", "cancelling": "s", "ring": "^"}
SHORT = {"output": "linear, feedback of x", "cancelling": "linear, cancelling", "ring": "ring of places"}
FIVE = AHEAD.index(5)
BELIEF = (UNWEIGHED, ORDINARY, WEIGHTED, DECISION, TRUNCATED, CONDITIONAL_IS)


def figure(path: Path, found: Found, levels: Mapping[str, tuple[float, ...]]) -> None:
    """Write the figure."""
    with matplotlib.rc_context(STYLE):
        made = Figure(figsize=(12.6, 5.0), layout="constrained")
        belief, simulation, samples = made.subplots(1, 3)
        _belief(belief, found, levels["output"])
        _simulation(simulation, found, levels["cancelling"])
        _samples(samples, found)
        lines = [Line2D([], [], color=COLOURS[name], marker="o", markersize=4) for name in METHODS]
        made.legend(
            lines,
            METHODS,
            loc="outside lower center",
            ncols=5,
            frameon=False,
            fontsize=8.5,
            handlelength=1.6,
        )
        save(made, path)


def _belief(axes: Axes, found: Found, gains: tuple[float, ...]) -> None:
    """Distance of beliefs from do(), by the gain of the recorded feedback of x."""
    for name in BELIEF:
        _curve(
            axes,
            gains,
            [[o["methods"][name]["do"] for o in found.get(("output", g), [])] for g in gains],
            name,
        )
    gap = [[o["methods"][UNWEIGHED]["gap"] for o in found.get(("output", g), [])] for g in gains]
    shown = [(g, geometric(v).mean) for g, v in zip(gains, gap, strict=True) if v]
    axes.plot(*zip(*shown, strict=True), color=FAINT, linestyle=(0, (4, 3)), linewidth=1.2, zorder=1)
    if shown:
        axes.annotate(
            "A's own future",
            shown[len(shown) // 2],
            xytext=(-8, 10),
            textcoords="offset points",
            ha="right",
            fontsize=8.5,
            color=FAINT,
        )
    axes.set_ylim(bottom=0.0)
    plain(axes, "The belief's distance from do() (feedback of x)", "", "root mean square, units of x")
    _gains(axes, found, "output", gains)


def _simulation(axes: Axes, found: Found, gains: tuple[float, ...]) -> None:
    """Error of forecasts under blind actions, by the gain of the recorded feedback that cancels."""
    for name in METHODS:
        errors = [
            [1.0 + o["methods"][name]["excess"]["blind"][FIVE] for o in found.get(("cancelling", g), [])]
            for g in gains
        ]
        _curve(axes, gains, errors, name)
    axes.set_yscale("log")
    plain(axes, "Simulating blind actions, 5 steps (cancelling)", "", "squared error over the exact one")
    numbers(axes.yaxis, (1, 1.2, 1.5, 2, 3, 5, 8, 12))
    axes.set_ylim(0.97, 12.0)
    _gains(axes, found, "cancelling", gains)


def _samples(axes: Axes, found: Found) -> None:
    """Distance from do() in units of A's own, against effective samples: a point a world, policy A and k."""
    for (world, level), results in found.items():
        if world not in MARKERS or not level:
            continue
        for name in WITH_WEIGHTS:
            for k in results[0]["methods"][name]["by_k"]:
                each = [one["methods"][name] for one in results]
                effective = np.array([one["by_k"][k]["effective"] * one["n_train"] for one in each])
                distance = np.array([one["by_k"][k]["do"] / one["by_k"][k]["gap"] for one in each])
                axes.scatter(
                    np.exp(np.log(effective).mean()),
                    np.exp(np.log(distance).mean()),
                    s=26,
                    marker=MARKERS[world],
                    color=COLOURS[name],
                    alpha=0.85,
                    linewidths=0.5,
                    edgecolors="white",
                )
    axes.axhline(1.0, color=FAINT, linestyle=(0, (4, 3)), linewidth=1.2, zorder=1)
    axes.text(
        0.99, 1.04, "no weights", transform=axes.get_yaxis_transform(), ha="right", fontsize=8.5, color=FAINT
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain(axes, "What that takes (all)", "effective samples", "distance from do() over A's own")
    numbers(axes.yaxis, (0.05, 0.1, 0.2, 0.5, 1.0, 2.0))
    axes.set_ylim(0.035, 1.6)
    handles = [Line2D([], [], color=INK, linestyle="", marker=m, markersize=4.5) for m in MARKERS.values()]
    axes.legend(handles, [SHORT[w] for w in MARKERS], fontsize=8, frameon=False, loc="lower left")


def _curve(axes: Axes, x: Iterable[float], values: list[list[float]], name: str) -> None:
    """Geometric means over seeds with their 95 % intervals."""
    shown = [(at, geometric(v)) for at, v in zip(x, values, strict=True) if v]
    at = [place for place, _ in shown]
    front = 3 if name in (TRUNCATED, CONDITIONAL_IS, UNWEIGHED) else 2
    axes.plot(
        at,
        [i.mean for _, i in shown],
        color=COLOURS[name],
        marker="o",
        markersize=3.5,
        linewidth=1.6,
        zorder=front,
    )
    axes.fill_between(
        at,
        [i.low for _, i in shown],
        [i.high for _, i in shown],
        color=COLOURS[name],
        alpha=0.15,
        linewidth=0,
    )


def _gains(axes: Axes, found: Found, world: str, gains: tuple[float, ...]) -> None:
    """Gains of A along the axis, each with its measured divergence from blind actions."""
    drift = [np.mean([one["drift"]["blind"] for one in found.get((world, g), [])] or [np.nan]) for g in gains]
    axes.set_xticks(gains, [f"{g:g}\n{d:.2g}" for g, d in zip(gains, drift, strict=True)])
    axes.set_xlabel("gain of A; below, KL(blind, A) in nats a step")
