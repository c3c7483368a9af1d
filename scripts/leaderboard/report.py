"""The leaderboard as files and on the terminal: Markdown, CSV, and a table in colour.

The ranking holds nothing that differs between an interrupted and an unbroken run. Wall times and dates,
which do, are in a CSV file of their own.
"""

import csv
import io
import math
from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from beliefgym.scripts.leaderboard.folder import ResultPaths, write_atomically
from beliefgym.scripts.leaderboard.grid import slug
from beliefgym.scripts.leaderboard.statistics import RESAMPLES, Estimate
from beliefgym.scripts.leaderboard.table import CellRow, Leaderboard, Row, TaskTable

NONE = "—"
HEAD = ("rank", "agent", "score (IQM)", "95 % interval", "mean", "median", "cells")
TASK_HEAD = ("rank", "agent", "mean return ± s.e.", "score (IQM)", "95 % interval", "training steps", "seeds")

CSV_COLUMNS = (
    *("task", "agent", "seed", "status", "reason", "mean_return", "std_return", "score", "eval_episodes"),
    *("training_steps", "random_score", "expert_score", "config_hash", "record"),
)
TIMING_COLUMNS = (
    *("task", "agent", "seed", "status", "wall_time_s", "training_wall_time_s", "training_steps_per_s"),
    *("started", "finished"),
)


def write_report(board: Leaderboard, paths: ResultPaths, command: str) -> None:
    """Writes the ranking in Markdown and CSV and the timing in CSV, each whole or not at all.

    Args:
        board: the leaderboard.
        paths: where the files go.
        command: the command that makes this table again.
    """
    write_atomically(paths.table, markdown(board, paths, command))
    write_atomically(paths.csv, _csv(CSV_COLUMNS, (_csv_row(row, paths) for row in board.cells)))
    write_atomically(paths.timing, _csv(TIMING_COLUMNS, map(_timing_row, board.cells)))


def markdown(board: Leaderboard, paths: ResultPaths, command: str) -> str:
    """The whole ranking as a Markdown page."""
    grid = board.grid
    plots = paths.plots.relative_to(paths.results_dir).as_posix()
    parts = [
        f"# Leaderboard: {grid.name}",
        grid.description,
        _explanation(board),
        "## All tasks",
        _markdown_table(HEAD, [overall_cells(row) for row in board.overall]),
        _footnote(board),
        f"![Scores with intervals]({plots}/scores.png)",
        "The share of runs that reach each score:",
        f"![Performance profiles]({plots}/profiles.png)",
    ]
    for table in board.tasks:
        parts += [
            f"## {table.task}",
            reference_line(table),
            _markdown_table(TASK_HEAD, [task_cells(row, table) for row in table.rows]),
            f"![Learning curves on {table.task}]({plots}/{curve_name(table.task)}.png)",
        ]
    if len(grid.agents) > 1:
        parts += [
            "## Probability of improvement",
            "How likely a run of the row's agent scores above a run of the column's on the same task, ties "
            "counting half, averaged over the tasks that both have finished. Bold: its 95 % interval leaves "
            "out one half.",
            _improvement_table(board),
        ]
    parts += [
        "## Cells without a result",
        _unfinished(board),
        "## Make it again",
        _reproduction(board, paths, command),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def print_table(board: Leaderboard, paths: ResultPaths, console: Console) -> None:
    """Shows the ranking on the terminal, then where everything lies."""
    rows = [overall_cells(row) for row in board.overall]
    console.print(_view(f"Leaderboard: {board.grid.name}", _footnote(board), HEAD, rows))
    for table in board.tasks:
        rows = [task_cells(row, table) for row in table.rows]
        console.print(_view(table.task, reference_line(table), TASK_HEAD, rows))
    for row in board.unfinished:
        reason = f"[red]no result[/red] {escape(row.cell.key)}: {escape(str(row.reason))}"
        console.print(reason, soft_wrap=True, highlight=False)
    files = [("table", paths.table), ("cells", paths.csv), ("times", paths.timing), ("plots", paths.plots)]
    for name, path in [*files, ("records", paths.records)]:
        console.print(f"{name:>8}  {escape(str(path))}", soft_wrap=True, highlight=False)


def overall_cells(row: Row) -> list[str]:
    """The texts of an agent's row over all tasks, under `HEAD`."""
    return [
        str(row.rank or NONE),
        row.agent,
        number(row.score.value),
        interval(row.score),
        number(row.score_mean.value),
        number(row.score_median.value),
        f"{row.n_finished}/{row.n_cells}",
    ]


def task_cells(row: Row, table: TaskTable) -> list[str]:
    """The texts of an agent's row on one task, under `TASK_HEAD`."""
    decimals = return_decimals(table)
    mean_return = number(row.mean_return, decimals)
    if not math.isnan(row.standard_error):
        mean_return += f" ± {number(row.standard_error, decimals)}"
    steps = NONE if row.training_steps is None else f"{row.training_steps:,}"
    seeds = f"{row.n_finished}/{row.n_cells}"
    return [
        str(row.rank or NONE),
        row.agent,
        mean_return,
        number(row.score.value),
        interval(row.score),
        steps,
        seeds,
    ]


def reference_line(table: TaskTable) -> str:
    """What score 0 and score 1 are on this task."""
    decimals = return_decimals(table)
    pairs = [
        f"random {number(low, decimals)}, expert {number(high, decimals)}" for low, high in table.references
    ]
    if not pairs:
        return "References: not known, as no cell has finished."
    if len(pairs) == 1:
        return f"References (score 0 and score 1): {pairs[0]}."
    return (
        f"The references changed between these cells ({'; '.join(pairs)}), so their scores cannot be "
        "compared: run them again."
    )


def return_decimals(table: TaskTable) -> int:
    """Decimals that show a return to about 1/10,000 of the way from random to expert."""
    spans = [high - low for low, high in table.references]
    return max(0, min(6, 4 - math.floor(math.log10(max(spans))))) if spans else 1


def number(value: float, decimals: int = 3) -> str:
    """A number with fixed decimals; a dash where there is none, and no negative zero."""
    if math.isnan(value):
        return NONE
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def interval(score: Estimate) -> str:
    """The ends of an interval; a dash where there are too few runs."""
    return f"[{number(score.low)}, {number(score.high)}]" if score.has_interval else NONE


def curve_name(task: str) -> str:
    """File name, without its ending, of the learning curves on a task."""
    return f"curves-{slug(task)}"


def _explanation(board: Leaderboard) -> str:
    episodes = sorted({cell.eval_episodes for cell in board.grid.cells})
    seeds = len({cell.seed for cell in board.grid.cells})
    return (
        f"{_counted(len(board.grid.agents), 'agent')}, {_counted(len(board.grid.tasks), 'task')}, "
        f"{_counted(seeds, 'seed')}; each run is evaluated on {' or '.join(map(str, episodes))} "
        "episodes. A run's score is (return - random) / (expert - random): 0 is the random policy, 1 the "
        "task's expert. IQM is the interquartile mean over runs; its 95 % interval is a bootstrap over runs, "
        f"stratified by task, with {RESAMPLES:,} resamples (Agarwal et al. 2021)."
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _footnote(board: Leaderboard) -> str:
    notes = []
    if any(not row.score.has_interval for row in board.overall):
        notes.append(f"{NONE} in place of an interval: it needs at least two finished runs on each task.")
    partial = [row.agent for row in board.overall if row.n_tasks < len(board.grid.tasks)]
    if partial:
        notes.append(
            f"Not finished on every task, and so ranked after those that are: {', '.join(partial)}; "
            "their scores stand on fewer tasks."
        )
    short = [row.agent for row in board.overall if row.n_finished < row.n_cells]
    if short:
        notes.append(f"With cells that have no result: {', '.join(short)}; reasons are at the end.")
    return " ".join(notes)


def _unfinished(board: Leaderboard) -> str:
    if not board.unfinished:
        return f"None: all {len(board.cells)} cells have finished."
    rows = [
        [row.cell.task_label, row.cell.agent_label, str(row.cell.seed), str(row.reason)]
        for row in board.unfinished
    ]
    counted = f"{len(board.unfinished)} of {len(board.cells)} cells:"
    return f"{counted}\n\n{_markdown_table(('task', 'agent', 'seed', 'reason'), rows)}"


def _reproduction(board: Leaderboard, paths: ResultPaths, command: str) -> str:
    seen: dict[str, dict[str, None]] = {}
    for result in filter(None, (row.result for row in board.cells)):
        for name, version in sorted(result.get("versions", {}).items()):
            seen.setdefault(name, {})[str(version)] = None
    versions = ", ".join(f"{name} {' and '.join(found)}" for name, found in seen.items())
    records = paths.records.relative_to(paths.results_dir).as_posix()
    lines = [
        f"```\n{command}\n```",
        "Finished cells are kept: a second run does only what is missing. The configuration, returns, "
        f"learning curve and versions of each cell are in its record, in [{records}]({records}/); "
        f"[{paths.csv.name}]({paths.csv.name}) has one row a cell, "
        f"[{paths.timing.name}]({paths.timing.name}) the wall times.",
        f"Versions: {versions}." if versions else "",
    ]
    return "\n\n".join(filter(None, lines))


def _improvement_table(board: Leaderboard) -> str:
    agents = [row.agent for row in board.overall]
    rows = [
        [ours, *(NONE if ours == theirs else _chance(board.improvement[ours, theirs]) for theirs in agents)]
        for ours in agents
    ]
    return _markdown_table(("", *agents), rows)


def _chance(probability: Estimate) -> str:
    text = number(probability.value, 2)
    is_clear = probability.has_interval and not probability.low <= 0.5 <= probability.high
    return f"**{text}**" if is_clear else text


def _markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, [":--" if name in LEFT else "--:" for name in head], *rows]
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines)


LEFT = {"", "agent", "task", "reason"}


def _view(title: str, caption: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table that fits a terminal of 80 columns: shorter heads, and no training steps."""
    table = Table(title=escape(title), caption=escape(caption), box=box.SIMPLE_HEAD, padding=(0, 1))
    table.title_justify = table.caption_justify = "left"
    shown = [index for index, name in enumerate(head) if SHORT_HEAD.get(name, name)]
    for index in shown:
        name = SHORT_HEAD.get(head[index], head[index])
        table.add_column(name, justify="left" if name in LEFT else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(escape(row[index]) for index in shown), style="bold" if row[0] == "1" else None)
    return table


SHORT_HEAD = {"mean return ± s.e.": "return ± s.e.", "score (IQM)": "score", "training steps": ""}


def _csv(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def _csv_row(row: CellRow, paths: ResultPaths) -> list[object]:
    cell = row.cell
    result = row.result or {}
    measured = (
        [row.mean_return, row.std_return, row.score, cell.eval_episodes, row.training_steps]
        if row.is_finished
        else ["", "", "", cell.eval_episodes, ""]
    )
    return [
        *(cell.task_label, cell.agent_label, cell.seed, _status(row), row.reason or "", *measured),
        *(result.get("random_score", ""), result.get("expert_score", ""), cell.config_hash),
        paths.record(cell).relative_to(paths.results_dir).as_posix(),
    ]


def _timing_row(row: CellRow) -> list[object]:
    named = [row.cell.task_label, row.cell.agent_label, row.cell.seed, _status(row)]
    if row.record is None:
        return [*named, "", "", "", "", ""]
    training: dict[str, float] = row.result["training"] if row.result else {}
    seconds = training.get("wall_time_s", 0)
    rate = round(training["steps"] / seconds, 1) if seconds > 0 and training["steps"] else ""
    trained = seconds if training else ""
    return [*named, row.record.wall_time_s, trained, rate, row.record.started, row.record.finished]


def _status(row: CellRow) -> str:
    return row.record.status if row.record else "missing"
