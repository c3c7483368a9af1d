"""Long experiments in pieces: cells that run in parallel, are written down one by one, and are not run twice.

A cell is a mapping of JSON values, which is all that its function is given. Its result is written to
FOLDER/NAME.json beside the cell itself; a cell whose file holds the same mapping is read, not run. A cell that fails is
one result with the reason, and runs again the next time.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

Cell = Mapping[str, Any]
PR_SET_PDEATHSIG = 1  # from <sys/prctl.h>


def run_cells(
    function: str,
    cells: Mapping[str, Cell],
    folder: Path,
    jobs: int,
    told: Callable[[str], None] = print,
    extra: Any = None,
    fresh: bool = True,
) -> dict[str, dict[str, Any]]:
    """Run what is missing.

    Args:
        function: "module:name", called as name(cell, extra) -> JSON result in another process.
        cells: name -> cell; the name is its file's.
        folder: of the files.
        jobs: processes; 1 runs here.
        told: hears of each cell that ends.
        extra: handed on, and not part of the cell (a path).
        fresh: every cell in a process of its own, so that its memory goes back; False saves the seconds of its imports.

    Returns:
        name -> result; {"failed": reason} for a cell that did not end well.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, Any]] = {}
    missing: dict[str, Cell] = {}
    for name, cell in cells.items():
        cell = json.loads(json.dumps(dict(cell)))
        held = _read(folder / f"{name}.json")
        if held is not None and held["cell"] == cell:
            found[name] = held["result"]
            continue
        if held is not None:
            told(f"{name}: its configuration has changed since it was run; it runs again")
        missing[name] = cell
    if jobs <= 1:
        for name, cell in missing.items():
            found[name] = _kept(folder, name, cell, _run(function, cell, extra))
            told(f"{name} ({len(found)} of {len(cells)})")
    elif missing:
        with ProcessPoolExecutor(
            jobs,
            mp_context=get_context("spawn"),
            max_tasks_per_child=1 if fresh else None,
            initializer=_end_with_parent,
        ) as pool:
            futures = {pool.submit(_run, function, cell, extra): name for name, cell in missing.items()}
            for future in as_completed(futures):
                name = futures[future]
                try:
                    result = future.result()
                except Exception as error:  # the process itself died
                    result = {"failed": f"{type(error).__name__}: {error}"}
                found[name] = _kept(folder, name, missing[name], result)
                told(f"{name} ({len(found)} of {len(cells)})")
    return {name: found[name] for name in cells}


def _end_with_parent() -> None:
    """On Linux the kernel kills a cell whose main process is gone, however that went."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _run(function: str, cell: Cell, extra: Any) -> dict[str, Any]:
    module, _, name = function.partition(":")
    try:
        return dict(getattr(import_module(module), name)(cell, extra))
    except Exception as error:
        return {"failed": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}


def _kept(folder: Path, name: str, cell: Cell, result: dict[str, Any]) -> dict[str, Any]:
    if "failed" in result:
        return result
    from beliefgym.scripts.training import git_commit, machine, versions  # heavy, and no cell needs it

    record = {
        "cell": dict(cell),
        "result": result,
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": machine(),
    }
    path = folder / f"{name}.json"
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(record) + "\n")
    os.replace(temporary, path)
    return result


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError):
        return None
