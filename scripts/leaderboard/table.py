"""From records to the leaderboard's numbers: for each cell, each agent on a task, each agent over all.

Nothing here depends on when or in which order the cells ran, so an interrupted and an unbroken run give the
same leaderboard. A failed cell, or one that has not run, is a row with its reason; every summary says on
how many of its cells it stands.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from beliefgym.scripts.leaderboard.grid import Cell, Grid
from beliefgym.scripts.leaderboard.records import Record
from beliefgym.scripts.leaderboard.statistics import (
    Estimate,
    estimate,
    mean,
    median,
    normalised_score,
    probability_of_improvement,
)

NOT_RUN = "has not run yet"


@dataclass(frozen=True)
class CellRow:
    """One cell.

    Args:
        cell: the cell.
        record: its record; None where it has not run.
        reason: why there is no result; None where there is one.
        mean_return, std_return: over its evaluation episodes; NaN where it failed.
        score: (mean return - random) / (expert - random); NaN where it failed.
        training_steps: environment steps of training; None where it failed.
    """

    cell: Cell
    record: Record | None
    reason: str | None
    mean_return: float = math.nan
    std_return: float = math.nan
    score: float = math.nan
    training_steps: int | None = None

    @property
    def is_finished(self) -> bool:
        """Whether it has a score."""
        return self.reason is None

    @property
    def result(self) -> dict[str, Any] | None:
        """What the cell runner returned; None where there is no result."""
        return self.record.result if self.record else None


@dataclass(frozen=True)
class Row:
    """One agent, on one task or over all.

    Args:
        agent: its label.
        rank: from 1; None without a finished cell.
        score: interquartile mean of its runs' scores, with interval.
        score_mean, score_median: other summaries of the same runs.
        n_finished, n_cells: cells that finished, and cells of the grid.
        n_tasks: tasks with a finished cell.
        mean_return, standard_error: over runs, on one task; NaN over all tasks, and the error with one run.
        training_steps: environment steps of each run, where there is one number for all; None otherwise.
    """

    agent: str
    rank: int | None
    score: Estimate
    score_mean: Estimate
    score_median: Estimate
    n_finished: int
    n_cells: int
    n_tasks: int
    mean_return: float = math.nan
    standard_error: float = math.nan
    training_steps: int | None = None


@dataclass(frozen=True)
class TaskTable:
    """The ranking on one task.

    Args:
        task: its label.
        references: the pairs (random, expert) of mean returns that its cells were scored with: one, unless
            the references changed between cells.
        rows: the agents, best first.
    """

    task: str
    references: tuple[tuple[float, float], ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Leaderboard:
    """Everything that the tables and figures show.

    Args:
        grid: the grid.
        cells: a row for each cell, in the grid's order.
        overall: the agents over all tasks, best first; those that lack a task come after those that have all.
        tasks: the ranking on each task.
        improvement: probability that a run of the agent named first beats one of the second on the same task.
    """

    grid: Grid
    cells: tuple[CellRow, ...]
    overall: tuple[Row, ...]
    tasks: tuple[TaskTable, ...]
    improvement: Mapping[tuple[str, str], Estimate]

    @property
    def unfinished(self) -> tuple[CellRow, ...]:
        """The cells without a score."""
        return tuple(row for row in self.cells if not row.is_finished)

    def scores(self, agent: str) -> list[list[float]]:
        """For each task of the grid the scores of the agent's finished runs."""
        return [[row.score for row in _finished(self.cells, agent, task)] for task in self.grid.tasks]


def leaderboard(grid: Grid, records: Mapping[str, Record]) -> Leaderboard:
    """The leaderboard of a grid.

    Args:
        grid: the grid.
        records: the records there are, by the cells' keys.
    """
    cells = tuple(_cell_row(cell, records.get(cell.key)) for cell in grid.cells)
    overall = [_row(cells, agent, grid.tasks) for agent in grid.agents if _chosen(cells, agent)]
    tasks = []
    for task in grid.tasks:
        rows = [_row(cells, agent, [task]) for agent in grid.agents if _chosen(cells, agent, task)]
        results = [row.result for row in cells if row.cell.task_label == task and row.result]
        references = {(result["random_score"], result["expert_score"]): None for result in results}
        tasks.append(TaskTable(task, tuple(references), _ranked(rows)))
    board = Leaderboard(grid, cells, _ranked(overall), tuple(tasks), {})
    improvement = {}
    for i, ours in enumerate(grid.agents):
        for theirs in grid.agents[i + 1 :]:
            won = probability_of_improvement(board.scores(ours), board.scores(theirs))
            improvement[ours, theirs] = won
            improvement[theirs, ours] = Estimate(1 - won.value, 1 - won.high, 1 - won.low, won.n_runs)
    return Leaderboard(grid, cells, board.overall, board.tasks, improvement)


def _cell_row(cell: Cell, record: Record | None) -> CellRow:
    if record is None:
        return CellRow(cell, None, NOT_RUN)
    if record.result is None:
        return CellRow(cell, record, record.reason)
    result: dict[str, Any] = record.result
    returns = np.asarray(result["returns"], dtype=np.float64)
    return CellRow(
        cell,
        record,
        None,
        mean_return=float(returns.mean()),
        std_return=float(returns.std()),
        score=normalised_score(returns, result["random_score"], result["expert_score"]),
        training_steps=result["training"]["steps"],
    )


def _chosen(cells: tuple[CellRow, ...], agent: str, task: str | None = None) -> list[CellRow]:
    return [row for row in cells if row.cell.agent_label == agent and task in (None, row.cell.task_label)]


def _finished(cells: tuple[CellRow, ...], agent: str, task: str) -> list[CellRow]:
    return [row for row in _chosen(cells, agent, task) if row.is_finished]


def _row(cells: tuple[CellRow, ...], agent: str, tasks: tuple[str, ...] | list[str]) -> Row:
    """The agent's row over some tasks, not ranked yet."""
    runs = [_finished(cells, agent, task) for task in tasks]
    strata = [[row.score for row in task] for task in runs]
    returns = np.array([row.mean_return for task in runs for row in task])
    steps = {row.training_steps for task in runs for row in task}
    on_one_task = len(tasks) == 1
    return Row(
        agent=agent,
        rank=None,
        score=estimate(strata),
        score_mean=estimate(strata, mean),
        score_median=estimate(strata, median),
        n_finished=returns.size,
        n_cells=sum(len(_chosen(cells, agent, task)) for task in tasks),
        n_tasks=sum(1 for task in runs if task),
        mean_return=float(returns.mean()) if on_one_task and returns.size else math.nan,
        standard_error=_standard_error(returns) if on_one_task else math.nan,
        training_steps=steps.pop() if len(steps) == 1 else None,
    )


def _standard_error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / math.sqrt(values.size)) if values.size > 1 else math.nan


def _ranked(rows: list[Row]) -> tuple[Row, ...]:
    """Best first: more tasks, then the higher score; who has no score comes last and without a rank."""
    order = sorted(rows, key=lambda row: (-row.n_tasks, -row.score.value if row.n_finished else math.inf))
    return tuple(
        Row(**{**vars(row), "rank": rank if row.n_finished else None})
        for rank, row in enumerate(order, start=1)
    )
