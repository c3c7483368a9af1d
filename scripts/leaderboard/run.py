"""One leaderboard from beginning to end: look at what is there, run what is missing, rank, write, show."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from beliefgym.scripts.leaderboard.errors import ChangedConfigurationError, LeaderboardError
from beliefgym.scripts.leaderboard.folder import ResultPaths, check_writable, clear_leftovers, hold_lock
from beliefgym.scripts.leaderboard.grid import Cell, Grid
from beliefgym.scripts.leaderboard.pool import HEAVY_MODULES, Outcome, run_cells
from beliefgym.scripts.leaderboard.progress import CellProgress
from beliefgym.scripts.leaderboard.records import (
    Change,
    Record,
    ResultError,
    Stock,
    check_result,
    set_aside_corrupt,
    set_aside_old,
    take_stock,
    write_record,
)
from beliefgym.scripts.leaderboard.report import print_table, write_report
from beliefgym.scripts.leaderboard.table import Leaderboard, leaderboard

ALL_FINISHED, SOME_FAILED, NOT_STARTED, INTERRUPTED = 0, 1, 2, 130
CHANGES_SHOWN = 10  # changed cells listed in the error; the rest are counted


@dataclass(frozen=True)
class LeaderboardOptions:
    """What the command line decides.

    Args:
        grid: the cells.
        runner: the function that trains and evaluates one cell, `module:function`.
        results_dir: where records, tables and figures go.
        command: the command that a reader gives to make the same table.
        processes: cells at a time.
        redo_changed: run cells again whose configuration has changed, keeping the old records aside.
        keep_failed: leave failed cells as they are; otherwise they are tried again.
        report_only: run nothing, only write tables and figures from the records there are.
        plots: whether to draw figures.
        preload: modules that the server of the processes loads once.
    """

    grid: Grid
    runner: str
    results_dir: Path = Path("results")
    command: str = "beliefgym leaderboard"
    processes: int = 2
    redo_changed: bool = False
    keep_failed: bool = False
    report_only: bool = False
    plots: bool = True
    preload: Sequence[str] = field(default=HEAVY_MODULES)


def run_leaderboard(options: LeaderboardOptions, console: Console | None = None) -> int:
    """Runs what is missing of the grid, writes and shows the ranking; for the command line.

    Returns:
        0 where every cell has finished, 1 where some have failed (the table is written all the same), 2
        where it could not start, 130 after Ctrl-C.
    """
    console = console or Console()
    paths = ResultPaths(options.results_dir, options.grid.name)
    try:
        board = run_grid(options, console)
    except (LeaderboardError, ValueError) as error:
        console.print(f"[red]error:[/red] {escape(str(error))}", soft_wrap=True, highlight=False)
        return NOT_STARTED
    except KeyboardInterrupt:
        stock = take_stock(options.grid, paths)
        done = sum(record.is_finished for record in stock.records.values())
        console.print(
            f"Stopped. {done} of {len(options.grid.cells)} cells have finished and are kept in "
            f"{escape(str(paths.records))}. The same command goes on from here: {escape(options.command)}",
            soft_wrap=True,
            highlight=False,
        )
        return INTERRUPTED
    print_table(board, paths, console)
    if not board.unfinished:
        return ALL_FINISHED
    console.print(
        f"{len(board.unfinished)} of {len(board.cells)} cells have no result. Their records hold the "
        "traceback and the last output under `details`; the same command tries them again.",
        soft_wrap=True,
    )
    return SOME_FAILED


def run_grid(options: LeaderboardOptions, console: Console) -> Leaderboard:
    """Runs what is missing of the grid and writes the tables and figures.

    Returns:
        The leaderboard.

    Raises:
        ResultsFolderError: where the results folder cannot be written or another run holds it.
        ChangedConfigurationError: where records belong to other configurations and `redo_changed` is not set.
        ValueError: where `processes` is below 1 or the runner does not exist.
    """
    grid, paths = options.grid, ResultPaths(options.results_dir, options.grid.name)
    check_writable(paths, grid)
    with hold_lock(paths):
        clear_leftovers(paths)
        stock = take_stock(grid, paths)
        if stock.changed and not options.redo_changed:
            raise ChangedConfigurationError(_changed_message(stock.changed, paths))
        todo = [] if options.report_only else _missing(stock, options)
        _say_what_is_there(stock, todo, options, console)
        if todo:
            _clear_the_way(stock, console)
            with CellProgress(console, len(grid.cells), len(grid.cells) - len(todo)) as progress:
                run_cells(
                    todo,
                    options.runner,
                    _Recorder(paths, progress),
                    time_limit_s=grid.time_limit_s,
                    processes=options.processes,
                    preload=options.preload,
                )
        board = leaderboard(grid, take_stock(grid, paths).records)
        write_report(board, paths, options.command)
        if options.plots:
            from beliefgym.scripts.leaderboard.plots import write_plots  # matplotlib, only once it is needed

            write_plots(board, paths)
    return board


class _Recorder:
    """Writes the record of each cell as soon as it has ended, and shows what happens."""

    def __init__(self, paths: ResultPaths, progress: CellProgress) -> None:
        self._paths = paths
        self._progress = progress
        self.progressed = progress.progressed
        self.started = progress.started
        self.ticked = progress.ticked

    def ended(self, cell: Cell, outcome: Outcome) -> None:
        record = as_record(cell, outcome)
        write_record(self._paths.record(cell), record)
        self._progress.ended(cell, _in_short(record), failed=not record.is_finished)


def as_record(cell: Cell, outcome: Outcome) -> Record:
    """The record of a cell; an incomplete or non-finite result makes it a failed one."""
    result, reason = outcome.result, outcome.reason
    if reason is None:
        try:
            result = check_result(result, cell)
        except ResultError as error:
            result, reason = None, str(error)
    return Record(
        cell=cell.to_dict(),
        config_hash=cell.config_hash,
        status="finished" if reason is None else "failed",
        reason=reason,
        details=outcome.details,
        result=result,
        started=outcome.started,
        finished=outcome.finished,
        wall_time_s=outcome.wall_time_s,
    )


def _in_short(record: Record) -> str:
    if record.result is None:
        return f"{record.reason} ({record.wall_time_s:.0f} s)"
    mean_return = sum(record.result["returns"]) / len(record.result["returns"])
    return f"mean return {mean_return:.4g} in {record.wall_time_s:.0f} s"


def _missing(stock: Stock, options: LeaderboardOptions) -> list[Cell]:
    """The cells to run, in order: those without a record, and the failed ones unless they are kept."""
    kept = {key for key, record in stock.records.items() if record.is_finished or options.keep_failed}
    return [cell for cell in options.grid.cells if cell.key not in kept]


def _clear_the_way(stock: Stock, console: Console) -> None:
    """Moves corrupt and outdated records aside; both kinds of cells run again."""
    for path, problem in stock.corrupt.items():
        _say(console, f"{problem}. Moved to {set_aside_corrupt(path).name}; its cell runs again.")
    for change in stock.changed:
        aside = set_aside_old(change.path)
        _say(
            console,
            f"{change.cell.key} has changed ({'; '.join(change.differences)}). Old record: {aside.name}.",
        )


def _say_what_is_there(
    stock: Stock, todo: Sequence[Cell], options: LeaderboardOptions, console: Console
) -> None:
    finished = sum(record.is_finished for record in stock.records.values())
    failed = len(stock.records) - finished
    parts = [f"Leaderboard {options.grid.name}: {len(options.grid.cells)} cells, {finished} finished before"]
    if failed:
        retried = not (options.keep_failed or options.report_only)
        parts.append(f"{failed} failed before and {'are tried again' if retried else 'are left so'}")
    parts.append(f"{len(todo)} to run on {options.processes} processes" if todo else "nothing to run")
    _say(console, ", ".join(parts) + ".")
    if options.report_only:
        for problem in stock.corrupt.values():
            _say(console, f"{problem}. Left as it is.")
    if stock.strangers:
        names = ", ".join(str(path) for path in stock.strangers[:CHANGES_SHOWN])
        _say(
            console,
            f"{len(stock.strangers)} records belong to no cell of this grid and are not shown: {names}",
        )


def _changed_message(changed: Sequence[Change], paths: ResultPaths) -> str:
    lines = [f"  {change.cell.key}: {'; '.join(change.differences)}" for change in changed[:CHANGES_SHOWN]]
    if len(changed) > CHANGES_SHOWN:
        lines.append(f"  and {len(changed) - CHANGES_SHOWN} more")
    listed = "\n".join(lines)
    return (
        f"{len(changed)} records in {paths.records} belong to another configuration (old -> new):\n{listed}\n"
        "Run again with --redo-changed to keep the old records aside and run these cells, or choose another "
        "folder with --results-dir. Nothing was run."
    )


def _say(console: Console, text: str) -> None:
    console.print(escape(text), soft_wrap=True, highlight=False)
