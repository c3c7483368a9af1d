"""One finished cell is one record: a JSON file with the cell, its configuration's hash and what came out.

    {"format": 1, "cell": {...}, "config_hash": "...", "status": "finished" | "failed", "reason": null | text,
     "details": null | text, "result": {...} | null, "started": ..., "finished": ..., "wall_time_s": ...}

A failed cell is a record too, with the reason in one line and the traceback or the last output in `details`.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from beliefgym.scripts.leaderboard.errors import CorruptRecordError
from beliefgym.scripts.leaderboard.folder import ResultPaths, move_aside, timestamp, write_atomically
from beliefgym.scripts.leaderboard.grid import Cell, Grid, plain_json

RECORD_FORMAT = 1


class ResultError(ValueError):
    """What a cell runner returned is not a complete result; the message names the field."""


@dataclass(frozen=True)
class Record:
    """What is kept of one cell.

    Args:
        cell: the cell as plain JSON.
        config_hash: the cell's `config_hash` when it ran.
        status: `finished` or `failed`.
        reason: one line on why it failed; None where it finished.
        details: traceback or last output of a failed cell.
        result: what the cell runner returned; None where it failed.
        started, finished: UTC timestamps.
        wall_time_s: from the start of the process to its end, in seconds.
        format: version of this layout.
    """

    cell: dict[str, Any]
    config_hash: str
    status: Literal["finished", "failed"]
    reason: str | None
    details: str | None
    result: dict[str, Any] | None
    started: str
    finished: str
    wall_time_s: float
    format: int = RECORD_FORMAT

    @property
    def is_finished(self) -> bool:
        """Whether the cell came to its end with a complete result."""
        return self.status == "finished"


def check_result(result: Any, cell: Cell) -> dict[str, Any]:
    """The result of a cell as plain JSON, complete and finite.

    A result holds at least `returns` (the return of each evaluation episode), `random_score` and
    `expert_score` (mean returns of the references), `learning_curve` (a list of {"step", "mean_return",
    "std"}) and `training` ({"steps", "wall_time_s"}).

    Raises:
        ResultError: naming the first field that is missing, not a finite number, or of the wrong length.
    """
    if not isinstance(result, Mapping):
        raise ResultError(f"the result of a cell is a dict, not a {type(result).__name__}")
    try:
        result = plain_json(result, "result")
    except ValueError as error:
        raise ResultError(str(error)) from error
    if lacking := [name for name in RESULT_FIELDS if name not in result]:
        raise ResultError(f"the result lacks {', '.join(lacking)}; it needs {', '.join(RESULT_FIELDS)}")
    returns = result["returns"]
    if not isinstance(returns, list) or len(returns) != cell.eval_episodes:
        came = f"{len(returns)}" if isinstance(returns, list) else f"a {type(returns).__name__}"
        raise ResultError(
            f"result.returns has one number for each of {cell.eval_episodes} episodes, not {came}"
        )
    for index, value in enumerate(returns):
        _number(value, f"result.returns[{index}]")
    low, high = (_number(result[name], f"result.{name}") for name in ("random_score", "expert_score"))
    if not high > low:
        raise ResultError(
            f"result.expert_score is above result.random_score, not {high:g} against {low:g}: measure the "
            "references of this task again, or it cannot be scored"
        )
    if not isinstance(result.get("versions", {}), dict):
        raise ResultError("result.versions is a dict from package to version")
    if not isinstance(result["training"], dict):
        raise ResultError("result.training is a dict with steps and wall_time_s")
    for name in ("steps", "wall_time_s"):
        _number(result["training"].get(name), f"result.training.{name}")
    if not isinstance(result["learning_curve"], list):
        raise ResultError("result.learning_curve is a list of {step, mean_return, std}")
    for index, point in enumerate(result["learning_curve"]):
        if not isinstance(point, dict):
            raise ResultError(f"result.learning_curve[{index}] is a dict with step, mean_return and std")
        for name in ("step", "mean_return", "std"):
            _number(point.get(name), f"result.learning_curve[{index}].{name}")
    return result


RESULT_FIELDS = ("returns", "random_score", "expert_score", "learning_curve", "training")


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ResultError(f"{name} is a finite number, not {value!r}")
    return value


def write_record(path: Path, record: Record) -> None:
    """Writes the record whole or not at all."""
    write_atomically(path, json.dumps(asdict(record), indent=1, allow_nan=False) + "\n")


def read_record(path: Path) -> Record:
    """The record in a file.

    Raises:
        CorruptRecordError: naming the file and what is wrong with it.
        FileNotFoundError: where there is no such file.
    """
    try:
        data = json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:  # JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise CorruptRecordError(f"{path} is not readable JSON ({error})") from error
    if not isinstance(data, dict):
        raise CorruptRecordError(f"{path} holds a {type(data).__name__}, not a record")
    if data.get("format") != RECORD_FORMAT:
        raise CorruptRecordError(
            f"{path} has record format {data.get('format')!r}, this version reads {RECORD_FORMAT}"
        )
    names = {f.name for f in fields(Record)}
    if names != set(data):
        raise CorruptRecordError(f"{path} lacks or has too much: {', '.join(sorted(names ^ set(data)))}")
    record = Record(**data)
    try:
        cell = Cell.from_dict(record.cell)
        if cell.config_hash != record.config_hash:
            raise ValueError(
                f"its config_hash {record.config_hash} is not that of its cell, {cell.config_hash}"
            )
        if record.status not in ("finished", "failed"):
            raise ValueError(f"its status is {record.status!r}, not finished or failed")
        _number(record.wall_time_s, "wall_time_s")
        if record.is_finished:
            check_result(record.result, cell)
        elif not isinstance(record.reason, str):
            raise ValueError("it failed without a reason")
    except (ValueError, TypeError) as error:
        raise CorruptRecordError(f"{path} is not a complete record: {error}") from error
    return record


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


@dataclass(frozen=True)
class Change:
    """A record on disk that belongs to another configuration of its cell.

    Args:
        cell: the cell of the grid.
        path: the record's file.
        differences: one line for each field that differs, old -> new.
    """

    cell: Cell
    path: Path
    differences: tuple[str, ...]


@dataclass(frozen=True)
class Stock:
    """What lies in the records folder for a grid.

    Args:
        records: the usable records, by the cell's key.
        changed: records of another configuration.
        corrupt: for each unreadable file, what is wrong with it, with the file's name.
        strangers: files that belong to no cell of the grid.
    """

    records: dict[str, Record]
    changed: tuple[Change, ...]
    corrupt: dict[Path, str]
    strangers: tuple[Path, ...]


def take_stock(grid: Grid, paths: ResultPaths) -> Stock:
    """Reads every record of the grid from disk; changes nothing."""
    records: dict[str, Record] = {}
    changed: list[Change] = []
    corrupt: dict[Path, str] = {}
    for cell in grid.cells:
        path = paths.record(cell)
        try:
            record = read_record(path)
        except FileNotFoundError:
            continue
        except CorruptRecordError as error:
            corrupt[path] = str(error)
            continue
        if record.config_hash == cell.config_hash:
            records[cell.key] = record
        else:
            old = Cell.from_dict(record.cell).config()
            changed.append(Change(cell, path, tuple(differences(old, cell.config()))))
    own = {paths.record(cell) for cell in grid.cells}
    found = (path for path in sorted(paths.records.rglob("*.json")) if ".old-" not in path.name)
    return Stock(records, tuple(changed), corrupt, tuple(path for path in found if path not in own))


def differences(old: Any, new: Any, name: str = "") -> list[str]:
    """One line for each field that differs: `total_timesteps: 30000 -> 50000`."""
    if isinstance(old, dict) and isinstance(new, dict):
        lines = []
        for key in dict.fromkeys([*old, *new]):
            lines += differences(
                old.get(key, _ABSENT), new.get(key, _ABSENT), f"{name}.{key}" if name else key
            )
        return lines
    return [] if old == new else [f"{name}: {_shown(old)} -> {_shown(new)}"]


_ABSENT = object()


def _shown(value: Any) -> str:
    return "(not there)" if value is _ABSENT else json.dumps(value)


def set_aside_corrupt(path: Path) -> Path:
    """Moves an unreadable record to `seed-0.json.corrupt`: its cell runs again and nothing is lost."""
    return move_aside(path, f"{path.name}.corrupt")


def set_aside_old(path: Path) -> Path:
    """Moves the record of an older configuration to `seed-0.old-<timestamp>.json`."""
    stamp = timestamp().replace("+00:00", "Z").replace(":", "")
    return move_aside(path, f"{path.stem}.old-{stamp}.json")
