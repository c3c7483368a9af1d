"""The leaderboard's figures: scores with intervals, performance profiles, and learning curves for each task.

Colours belong to agents, in the order of the grid, so an agent looks the same in every figure whatever its
rank; agents that do not learn are grey. They follow the palette of Okabe and Ito, which readers with colour
blindness tell apart (https://jfly.uni-koeln.de/color/); from the ninth agent on the dashes of the line differ
as well. PNG and SVG files are the same bytes for the same numbers: no date, and fixed identifiers in the SVG.
"""

import io
from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from beliefgym.scripts.leaderboard.folder import ResultPaths, write_atomically
from beliefgym.scripts.leaderboard.report import curve_name
from beliefgym.scripts.leaderboard.statistics import performance_profile
from beliefgym.scripts.leaderboard.table import Leaderboard, TaskTable

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#B8A800")
DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)))
INK, FAINT, GRID = "#222222", "#6B6B6B", "#E3E3E3"
STILL = "#9E9E9E"  # agents that do not learn: random, expert
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so it is the same everywhere
    "font.size": 10,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "svg.hashsalt": "beliefgym",
    "svg.fonttype": "path",
}
BELOW_RANDOM = 0.5  # how far below the random policy a curve is shown, as a share of random to expert


def write_plots(board: Leaderboard, paths: ResultPaths) -> None:
    """Writes scores, profiles and a figure of learning curves for each task, as PNG and SVG."""
    with matplotlib.rc_context(STYLE):
        _save(scores_figure(board), paths, "scores")
        _save(profiles_figure(board), paths, "profiles")
        for table in board.tasks:
            _save(curves_figure(board, table), paths, curve_name(table.task))


def scores_figure(board: Leaderboard) -> Figure:
    """Interquartile mean scores over all tasks as bars, with 95 % intervals and each run as a dot."""
    rows = list(board.overall)
    figure = Figure(figsize=(8.0, 1.5 + 0.46 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for position, row in enumerate(rows):
        colour, _ = _look(board, row.agent)
        runs = np.array([score for task in board.scores(row.agent) for score in task])
        if not runs.size:
            axes.text(0.01, position, "no finished cell", va="center", color=FAINT, style="italic")
            continue
        axes.barh(position, row.score.value, height=0.58, color=colour, alpha=0.85, linewidth=0)
        axes.scatter(
            runs,
            np.full(runs.size, position + 0.16),
            s=13,
            color="white",
            edgecolors=INK,
            linewidths=0.6,
            alpha=0.9,
            zorder=3,
        )
        if row.score.has_interval:
            ends = [row.score.low, row.score.high]
            axes.plot(
                ends, [position - 0.07] * 2, color=INK, linewidth=1.6, marker="|", markersize=8, zorder=4
            )
    _reference_lines(axes.axvline)
    names = [
        row.agent if row.n_finished == row.n_cells else f"{row.agent} ({row.n_finished}/{row.n_cells})"
        for row in rows
    ]
    axes.set_yticks(range(len(rows)), names)
    axes.set_ylim(len(rows) - 0.45, -0.55)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x", color=GRID, linewidth=0.8)
    low, high = _score_limits(board)
    axes.set_xlim(low, high)
    for position, row in enumerate(rows):
        if row.n_finished:
            axes.text(
                1.015, position, f"{row.score.value:.2f}", va="center", transform=axes.get_yaxis_transform()
            )
    axes.set_xlabel("score: 0 is the random policy, 1 the expert")
    _title(axes, "Score over all tasks", "interquartile mean, 95 % interval (line) and single runs (dots)")
    return figure


def profiles_figure(board: Leaderboard) -> Figure:
    """Share of runs above each score, for each agent, with a 95 % band."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    low, high = _score_limits(board)
    for row in board.overall:
        if not row.n_finished:
            continue
        colour, dashes = _look(board, row.agent)
        scores = board.scores(row.agent)
        own = np.concatenate([np.asarray(task, float) for task in scores])
        thresholds = np.unique(np.concatenate([[low, high], own]))  # the profile is constant in between
        share, bottom, top = performance_profile(scores, thresholds)
        axes.step(
            thresholds, share, where="post", color=colour, linestyle=dashes, linewidth=2, label=row.agent
        )
        axes.fill_between(thresholds, bottom, top, step="post", color=colour, alpha=0.10, linewidth=0)
    axes.set_xlim(low, high)
    axes.set_ylim(-0.02, 1.03)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:.0f} %"))
    axes.grid(color=GRID, linewidth=0.8)
    _reference_lines(axes.axvline)
    axes.set_xlabel("score: 0 is the random policy, 1 the expert")
    _title(
        axes,
        "Performance profiles",
        "share of runs above each score, with 95 % bands; further right is better",
    )
    _legend(figure, axes)
    return figure


def curves_figure(board: Leaderboard, table: TaskTable) -> Figure:
    """Mean evaluation return over training steps, with the range over seeds as a band."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    shown = []
    for row in table.rows:
        curves = _curves(board, table.task, row.agent)
        if not curves:
            continue
        steps, values = _common_steps(curves)
        colour, dashes = _look(board, row.agent)
        mean = values.mean(axis=0)
        axes.plot(steps, mean, color=colour, linestyle=dashes, linewidth=2, label=row.agent)
        if len(values) > 1:
            axes.fill_between(
                steps, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.15, linewidth=0
            )
        shown.append(values)
    if not shown:
        axes.text(
            0.5, 0.5, "no agent with a learning curve", ha="center", transform=axes.transAxes, color=FAINT
        )
    bottom, top = _return_limits(table, shown)
    for low, high in table.references:
        for value, name in ((low, "random"), (high, "expert")):
            axes.axhline(value, color=FAINT, linewidth=1.1, linestyle=(0, (4, 3)), zorder=1)
            axes.text(
                0.995, value, f"{name} {_signed(value)}", transform=axes.get_yaxis_transform(),
                ha="right", va="bottom", fontsize=8.5, color=FAINT, zorder=5,
            )  # fmt: skip
    axes.set_ylim(bottom, top)
    axes.margins(x=0)
    axes.grid(color=GRID, linewidth=0.8)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda step, _: f"{step / 1000:g}k" if step else "0"))
    axes.set_xlabel("environment steps of training")
    axes.set_ylabel("return of an episode")
    seeds = len({row.cell.seed for row in board.cells if row.cell.task_label == table.task})
    _title(axes, table.task, f"mean and range over {seeds} seeds" if seeds > 1 else "one seed")
    if shown:
        _legend(figure, axes)
    return figure


def _curves(board: Leaderboard, task: str, agent: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Steps and mean returns of each finished run that has a curve of at least two points."""
    found = []
    for row in board.cells:
        if (row.cell.task_label, row.cell.agent_label) == (task, agent) and row.result:
            points = sorted((point["step"], point["mean_return"]) for point in row.result["learning_curve"])
            if len(points) > 1:
                found.append(
                    (np.array([p[0] for p in points], float), np.array([p[1] for p in points], float))
                )
    return found


def _common_steps(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """The runs' curves at the same steps: those of the first, between which the others are interpolated.

    Returns:
        Steps of shape (n_points,), where every run has values, and returns of shape (n_runs, n_points).
    """
    start, end = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    steps = curves[0][0]
    steps = np.unique(np.clip(steps, start, max(start, end)))
    return steps, np.stack([np.interp(steps, own, values) for own, values in curves])


def _look(board: Leaderboard, agent: str) -> tuple[str, Any]:
    """Colour and dashes of an agent: by its place among those that learn; grey for those that do not."""
    learning = {cell.agent_label: None for cell in board.grid.cells if cell.total_timesteps}
    others = [label for label in board.grid.agents if label not in learning]
    if agent in others:
        return STILL, DASHES[others.index(agent) % len(DASHES)]
    place = list(learning).index(agent)
    return PALETTE[place % len(PALETTE)], DASHES[place // len(PALETTE) % len(DASHES)]


def _signed(value: float) -> str:
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def _score_limits(board: Leaderboard) -> tuple[float, float]:
    """Ends of the score axis: random, expert and all runs, but no further down than one below random."""
    scores = [row.score for row in board.cells if row.is_finished]
    low, high = min([0.0, *scores]), max([1.0, *scores])
    return max(low - 0.03, -1.0), high + 0.03


def _return_limits(table: TaskTable, shown: list[np.ndarray]) -> tuple[float, float]:
    """Ends of the return axis: always the references, and no further down than some way below random."""
    values = [value for pair in table.references for value in pair] + [
        float(v) for s in shown for v in (s.min(), s.max())
    ]
    if not values:
        return 0.0, 1.0
    bottom, top = min(values), max(values)
    if table.references:
        low, high = min(pair[0] for pair in table.references), max(pair[1] for pair in table.references)
        bottom = max(bottom, low - BELOW_RANDOM * (high - low))
    margin = 0.06 * (top - bottom or 1.0)
    return bottom - margin, top + margin


def _reference_lines(line: Callable[..., Any]) -> None:
    for score in (0.0, 1.0):
        line(score, color=FAINT, linewidth=1.1, linestyle=(0, (4, 3)), zorder=1)


def _title(axes: Axes, title: str, note: str) -> None:
    axes.set_title(title, loc="left", fontsize=12.5, fontweight="bold", pad=22)
    axes.text(0, 1.025, note, transform=axes.transAxes, fontsize=9.5, color=FAINT, va="bottom")


def _legend(figure: Figure, axes: Axes) -> None:
    """Beside the axes, best agent first."""
    if axes.get_legend_handles_labels()[1]:
        figure.legend(loc="outside right center", frameon=False, handlelength=2.4)


def _save(figure: Figure, paths: ResultPaths, name: str) -> None:
    for ending, options in (("png", {"dpi": 160}), ("svg", {"metadata": {"Date": None}})):
        file = io.BytesIO()
        figure.savefig(file, format=ending, facecolor="white", **options)  # type: ignore[arg-type]
        write_atomically(paths.plots / f"{name}.{ending}", file.getvalue())
