"""What a person sees while the cells run: bars on a terminal, plain lines where there is none.

On a terminal one bar counts the cells and one bar for each running cell follows its steps; a line stays for
each cell that has ended. Elsewhere (a log file, CI) there is the same line for each cell, and once a minute
one on what is running.
"""

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from beliefgym.scripts.leaderboard.grid import Cell

HEARTBEAT_S = 60.0  # between two lines on what is running, where there is no terminal


class CellProgress:
    """Shows how far the cells are; a context manager.

    Args:
        console: where to show it.
        n_cells: cells of the whole grid.
        n_kept: of these, those that had finished before.
    """

    def __init__(self, console: Console, n_cells: int, n_kept: int) -> None:
        self._console = console
        self._n_cells = n_cells
        self._n_done = n_kept
        self._bars: dict[str, TaskID] = {}
        self._latest: dict[str, str] = {}
        self._next_heartbeat = time.monotonic() + HEARTBEAT_S
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=28),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[note]}", style="dim"),
            console=console,
            disable=not console.is_terminal,
        )
        self._overall = self._progress.add_task("[bold]all cells", total=n_cells, completed=n_kept, note="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for bar in self._bars.values():
            self._progress.remove_task(bar)
        self._progress.stop()

    def started(self, cell: Cell) -> None:
        """A cell starts: a bar for it."""
        self._bars[cell.key] = self._progress.add_task(escape(cell.key), total=None, note="")
        self._latest[cell.key] = "starting"

    def progressed(self, cell: Cell, progress: Mapping[str, Any]) -> None:
        """A cell has said how far it is."""
        step, total, note = progress.get("step"), progress.get("total"), str(progress.get("note", ""))
        self._latest[cell.key] = f"{step:,}/{total:,} {note}".strip() if step and total else note
        self._progress.update(self._bars[cell.key], completed=step, total=total, note=escape(note))

    def ended(self, cell: Cell, line: str, *, failed: bool) -> None:
        """A cell has ended: its bar goes, a line stays."""
        self._n_done += 1
        self._progress.remove_task(self._bars.pop(cell.key))
        self._latest.pop(cell.key)
        self._progress.update(self._overall, completed=self._n_done)
        colour = "red" if failed else "green"
        word = "failed" if failed else "finished"
        counted = f"[dim]{self._n_done}/{self._n_cells}[/dim]"
        self._say(f"{counted} [{colour}]{word}[/{colour}] {escape(cell.key)}: {escape(line)}")

    def ticked(self) -> None:
        """Time has passed: where there are no bars, a line once a minute."""
        if not self._console.is_terminal and time.monotonic() >= self._next_heartbeat:
            self._next_heartbeat = time.monotonic() + HEARTBEAT_S
            running = "; ".join(f"{key} {latest}" for key, latest in self._latest.items())
            self._say(f"[dim]running:[/dim] {escape(running)}")

    def _say(self, text: str) -> None:
        self._progress.console.print(text, soft_wrap=True, highlight=False)
