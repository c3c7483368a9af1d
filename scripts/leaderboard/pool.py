"""A pool of local processes: one process for each cell, with a time limit, and a reason for every failure.

Processes are forked from a fork server that has the heavy modules loaded, so a cell starts in milliseconds
and a crash takes nothing else with it. One loop in the main process waits for messages, ends and deadlines
of all cells.
"""

import importlib.util
import json
import math
import multiprocessing
import os
import signal
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any, Protocol

from beliefgym.scripts.leaderboard.cell_process import ONE_THREAD, run_in_this_process
from beliefgym.scripts.leaderboard.errors import LeaderboardError
from beliefgym.scripts.leaderboard.folder import timestamp
from beliefgym.scripts.leaderboard.grid import Cell

HEAVY_MODULES = (
    *("torch", "stable_baselines3", "sb3_contrib", "gymnasium"),
    *("beliefgym.scripts.run_cell", "beliefgym.scripts.cli", "beliefgym.scripts.leaderboard.cell_process"),
)
TICK_S = 0.5  # longest wait between two looks at deadlines and the display
GRACE_S = 5.0  # between SIGTERM and SIGKILL, and for a process to end after its result
START_ATTEMPTS = 3
LOG_TAIL = 4000  # characters of the last output kept for a failed cell


@dataclass(frozen=True)
class Outcome:
    """What became of one cell.

    Args:
        result: what the runner returned; None where the cell failed.
        reason: one line on why it failed; None where it did not.
        details: traceback and last output of a failed cell.
        started, finished: UTC timestamps.
        wall_time_s: from the start of the process to its end, in seconds.
    """

    result: dict[str, Any] | None
    reason: str | None
    details: str | None
    started: str
    finished: str
    wall_time_s: float


class Listener(Protocol):
    """Who hears what the cells do; called in the main process, in its main thread."""

    def started(self, cell: Cell) -> None: ...

    def progressed(self, cell: Cell, progress: Mapping[str, Any]) -> None: ...

    def ended(self, cell: Cell, outcome: Outcome) -> None: ...

    def ticked(self) -> None: ...


def run_cells(
    cells: Sequence[Cell],
    runner: str,
    listener: Listener,
    *,
    time_limit_s: float,
    processes: int = 2,
    preload: Sequence[str] = HEAVY_MODULES,
    grace_s: float = GRACE_S,
) -> None:
    """Runs the cells, each in a process of its own, and tells the listener what becomes of each.

    A cell that raises, crashes or exceeds its time ends as an `Outcome` with a reason. Where this call
    itself ends early (Ctrl-C, an error in the listener), all cells that still run are stopped first.

    Args:
        cells: what to run, in this order.
        runner: `module:function`, called in the process as `function(cell, report)`.
        listener: who hears of it.
        time_limit_s: wall time of one cell, in seconds.
        processes: cells at a time.
        preload: modules that the fork server loads once; those that are not installed are left out.
        grace_s: time between SIGTERM and SIGKILL, in seconds.

    Raises:
        ValueError: where `processes` is below 1 or the runner's module does not exist.
    """
    if processes < 1:
        raise ValueError(f"processes is at least 1, not {processes}: 2 suits a machine with 2 cores")
    _check_runner(runner)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    waiting = deque(cells)
    running: list[_Running] = []
    with _environment(ONE_THREAD), tempfile.TemporaryDirectory(prefix="beliefgym-cells-") as logs:
        try:
            while waiting or running:
                while waiting and len(running) < processes:
                    one = _Running(waiting.popleft(), runner, context, Path(logs), time_limit_s)
                    running.append(one)  # before it starts, so that it is stopped whatever comes
                    one.start()
                    listener.started(one.cell)
                _wait_for_news(running)
                for one in list(running):
                    for progress in one.hear():
                        listener.progressed(one.cell, progress)
                    if one.process.exitcode is not None:
                        running.remove(one)
                        listener.ended(one.cell, one.end())
                    elif time.monotonic() >= one.deadline:
                        one.push_out(grace_s)
                listener.ticked()
        finally:
            _stop(running, grace_s)


class _Running:
    """A cell's process and what is known of it."""

    def __init__(
        self, cell: Cell, runner: str, context: ForkServerContext, logs: Path, time_limit_s: float
    ) -> None:
        self.cell = cell
        self.connection, self._theirs = context.Pipe(duplex=False)
        self._log = logs / cell.key.replace("/", "+")
        self._time_limit_s = time_limit_s
        self.process = context.Process(
            target=run_in_this_process,
            args=(cell.to_dict(), runner, self._theirs, str(self._log)),
            name=cell.key,
        )
        self.deadline = math.inf
        self._message: dict[str, Any] | None = None  # the result or the error, once it has come
        self._overdue = False
        self._signals_sent = 0

    def start(self) -> None:
        """Starts the process and then its clock: the first start waits for the fork server's modules."""
        for attempt in range(START_ATTEMPTS):
            try:
                self.process.start()
                break
            except (
                EOFError,
                ConnectionError,
            ) as error:  # the server is dying; a new one starts once it is dead
                if attempt == START_ATTEMPTS - 1:
                    raise LeaderboardError(
                        "the server that starts the cells' processes has ended, most likely while it loaded its "
                        "modules: see its message above, or try `python -c 'import stable_baselines3, beliefgym'`"
                    ) from error
                time.sleep(TICK_S)
        self._started, self._begun = timestamp(), time.monotonic()
        self.deadline = self._begun + self._time_limit_s
        self._theirs.close()

    def hear(self) -> list[dict[str, Any]]:
        """Takes all messages that have come; returns those on progress."""
        news = []
        try:
            while not self.connection.closed and self.connection.poll():
                message = json.loads(self.connection.recv_bytes())
                if message["kind"] == "progress":
                    news.append(message["progress"])
                else:
                    self._message = message
                    self.deadline = time.monotonic() + GRACE_S  # to end by itself
        except (EOFError, OSError):  # the process has closed its end, or was killed in the middle of a word
            self.connection.close()
        return news

    def push_out(self, grace_s: float) -> None:
        """SIGTERM the first time, SIGKILL after that."""
        self._overdue = self._overdue or self._message is None
        self.send(signal.SIGTERM if self._signals_sent == 0 else signal.SIGKILL)
        self.deadline = time.monotonic() + grace_s

    def send(self, number: signal.Signals) -> None:
        """Sends a signal to the cell's process group."""
        if self.process.pid is None:
            return
        self._signals_sent += 1
        try:
            os.killpg(self.process.pid, number)
        except ProcessLookupError:  # it has not come to making its group, or has just ended
            with suppress(ProcessLookupError):
                os.kill(self.process.pid, number)

    def end(self) -> Outcome:
        """Frees what the process held and says what became of it."""
        self.hear()
        exit_code = self.process.exitcode
        if self.process.pid is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)  # what the cell itself started and left behind
        self.process.close()
        self.connection.close()
        seconds = round(time.monotonic() - self._begun, 3)
        outcome = partial(Outcome, started=self._started, finished=timestamp(), wall_time_s=seconds)
        message = self._message or {"kind": "none", "reason": exit_reason(exit_code), "details": None}
        if message["kind"] == "result":
            return outcome(result=message["result"], reason=None, details=None)
        reason = (
            f"exceeded its time limit of {self._time_limit_s:g} s" if self._overdue else message["reason"]
        )
        details = "\n".join(filter(None, [message["details"], _tail(self._log)]))
        return outcome(result=None, reason=reason, details=details or None)


def exit_reason(exit_code: int | None) -> str:
    """Why a process ended that neither returned a result nor raised."""
    if exit_code is None or exit_code >= 0:
        return f"ended with exit code {exit_code} before it returned a result"
    name = signal.Signals(-exit_code).name if -exit_code in set(signal.Signals) else "an unknown signal"
    hint = "; often the machine was out of memory: try --processes 1" if name == "SIGKILL" else ""
    return f"was killed by signal {-exit_code} ({name}){hint}"


def _wait_for_news(running: list[_Running]) -> None:
    sources: list[Any] = [one.process.sentinel for one in running]
    sources += [one.connection for one in running if not one.connection.closed]
    nearest = min(one.deadline for one in running) - time.monotonic()
    wait(sources, timeout=min(TICK_S, max(0.0, nearest)))


def _stop(running: list[_Running], grace_s: float) -> None:
    """Ends all processes: SIGTERM, then SIGKILL."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        alive = [one for one in running if one.process.pid is not None and one.process.exitcode is None]
        for one in alive:
            one.send(number)
        until = time.monotonic() + grace_s
        for one in alive:
            one.process.join(max(0.0, until - time.monotonic()))


def _tail(log: Path) -> str:
    if not log.exists():
        return ""
    text = log.read_text(errors="replace").strip()
    return f"Last output:\n{text[-LOG_TAIL:]}" if text else ""


def _check_runner(runner: str) -> None:
    """Refuses a runner whose module is not there before every cell fails on it; does not import it."""
    module, colon, name = runner.partition(":")
    try:
        found = bool(module and colon and name) and importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        found = False
    if not found:
        raise ValueError(
            f"the cell runner {runner!r} cannot be found: write module:function of an installed module"
        )


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Sets environment variables, which a fork server inherits that starts meanwhile; then the old ones."""
    old = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in old.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
