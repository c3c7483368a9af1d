"""The process that runs one cell: how it starts, reports, fails, and never outlives its main process.

The process is forked from a fork server, so its parent is the server, and the server lives for as long as
any of its children does: the death of the main process kills neither by itself. Three things end a cell
process:

- a thread waits on `parent_process().sentinel`, a pipe whose other end only the main process holds, and
  kills the cell's process group when the pipe closes;
- on Linux the kernel sends SIGIO, whose default is to end a process, to the group when that pipe closes:
  this also works where the cell hangs in C code that does not let the thread run;
- on Linux PR_SET_PDEATHSIG kills the cell where the fork server itself is killed.

What the process has to say goes through one pipe as JSON: {"kind": "progress" | "result" | "error", ...}.
What it prints goes to a log file, whose end becomes part of the record of a failed cell.
"""

import ctypes
import faulthandler
import fcntl
import importlib
import json
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any

from beliefgym.scripts.leaderboard.errors import NotPlainJSONError
from beliefgym.scripts.leaderboard.grid import plain_json

REPORT_EVERY_S = 0.1  # a cell may report at every step; more than this no eye can follow
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
PR_SET_PDEATHSIG = 1  # from <sys/prctl.h>
REASON_LENGTH = 300  # characters of an exception's message that make the reason; all of it is in the details

CellRunner = Callable[[dict[str, Any], Callable[[Mapping[str, Any]], None]], Mapping[str, Any]]


def run_in_this_process(cell: dict[str, Any], runner: str, connection: Connection, log: str) -> None:
    """Runs one cell and sends what becomes of it; the target of the process.

    Args:
        cell: the cell as plain JSON.
        runner: `module:function`, called as `function(cell, report)`.
        connection: where reports, the result or the error go.
        log: file that takes everything printed.
    """
    os.setsid()  # a group of its own: Ctrl-C reaches the main process only, a kill reaches grandchildren too
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.update(
        ONE_THREAD
    )  # for libraries not loaded yet, should the fork server be older than this run
    _print_to(log)
    _end_with_the_main_process()
    try:
        result = plain_json(load_runner(runner)(cell, _Reporter(connection)), "result")
        message = {"kind": "result", "result": result}
    except Exception as error:
        message = {"kind": "error", "reason": _reason(error), "details": traceback.format_exc()}
    connection.send_bytes(json.dumps(message).encode())
    connection.close()


def load_runner(runner: str) -> CellRunner:
    """The function that `module:function` names.

    Raises:
        ValueError: where the text is not of that form, or the module has no such function.
    """
    module, colon, name = runner.partition(":")
    if not (module and colon and name):
        raise ValueError(f"a cell runner is written module:function, not {runner!r}")
    function = getattr(importlib.import_module(module), name, None)
    if not callable(function):
        raise ValueError(f"module {module} has no function {name}: see the cell runner {runner!r}")
    return function


class _Reporter:
    """Sends {"step", "total", "note"} to the main process, at most every tenth of a second."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._next = 0.0

    def __call__(self, progress: Mapping[str, Any]) -> None:
        now = time.monotonic()
        if now >= self._next:
            self._next = now + REPORT_EVERY_S
            message = {"kind": "progress", "progress": plain_json(progress, "progress")}
            self._connection.send_bytes(json.dumps(message).encode())


def _reason(error: Exception) -> str:
    """One line that says what happened."""
    lines = str(error).strip().splitlines()
    message = lines[0][:REASON_LENGTH] if lines else ""
    if isinstance(error, NotPlainJSONError):
        return message
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


def _print_to(log: str) -> None:
    """Sends what is printed to the log, and the Python stack where the process crashes or is told to end."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    faulthandler.enable(file=2, all_threads=False)
    faulthandler.register(signal.SIGTERM, file=2, all_threads=False, chain=True)  # then ends, as SIGTERM does


def _end_with_the_main_process() -> None:
    main = multiprocessing.parent_process()
    if main is None:
        raise RuntimeError("a cell runs in a process that multiprocessing started; see pool.run_cells")
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        signal.signal(signal.SIGIO, signal.SIG_DFL)
        fcntl.fcntl(main.sentinel, fcntl.F_SETOWN, -os.getpgrp())
        fcntl.fcntl(main.sentinel, fcntl.F_SETFL, fcntl.fcntl(main.sentinel, fcntl.F_GETFL) | os.O_ASYNC)
    threading.Thread(
        target=_wait_and_die, args=(main.sentinel,), daemon=True, name="main-process-watch"
    ).start()


def _wait_and_die(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os.killpg(0, signal.SIGKILL)
