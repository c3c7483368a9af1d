"""CSV files with a header row as one table of numbers, each row with its file, line and trajectory.

What `beliefgym.learning.sequences_csv` cuts into episodes. Text is converted a column at a time; a column is
searched cell by cell only where the conversion fails, for the missing cells and for the line of an error.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.sequence_checks import nearest

MISSING_TEXTS = ("", "na", "n/a", "nan", "null", "none")
"""Cells that mean "no number here", in any case; infinite numbers count as missing too."""

_CHUNK_ROWS = 1_000  # rows held as text at a time; few enough to stay in the processor's cache


@dataclass(frozen=True)
class Columns:
    """The columns to read, as the user names them or (after `chosen_from`) as the header does."""

    observations: tuple[str, ...]
    actions: tuple[str, ...]
    rewards: str | None
    episode: str | None
    time: str | None

    @property
    def numbers(self) -> tuple[str, ...]:
        """Columns of numbers, in the order of the table: those of x_t, the time, those of a_t, r_t."""
        time, rewards = ((name,) if name else () for name in (self.time, self.rewards))
        return (*self.observations, *time, *self.actions, *rewards)

    @property
    def n_seen(self) -> int:
        """How many of `numbers` a row needs to be an observation: those of x_t and the time."""
        return len(self.observations) + (self.time is not None)

    def chosen_from(self, header: list[str], where: str) -> Columns:
        """The same with patterns replaced by columns of this header that no argument names in full."""
        asked = (*self.observations, *self.actions, self.rewards, self.episode, self.time)
        free = [name for name in header if name and name not in asked]

        def expand(patterns: Iterable[str]) -> tuple[str, ...]:
            names: dict[str, None] = {}
            for pattern in patterns:
                found = [pattern] if pattern in header else []
                if not found and any(sign in pattern for sign in "*?["):
                    found = [name for name in free if fnmatchcase(name, pattern)]
                if not found:
                    raise ValueError(_unknown(pattern, header, where))
                names.update(dict.fromkeys(found))
            return tuple(names)

        for name in (self.rewards, self.episode, self.time):
            if name is not None and name not in header:
                raise ValueError(_unknown(name, header, where))
        chosen = Columns(
            expand(self.observations), expand(self.actions), self.rewards, self.episode, self.time
        )
        if not chosen.observations:
            raise ValueError("observations: expected at least one column, got none")
        used = (*chosen.numbers, *([self.episode] if self.episode else ()))
        for name in used:
            if used.count(name) > 1:
                raise ValueError(f"column {name!r}: expected one use, got several; name it in one argument")
            if header.count(name) > 1:
                raise ValueError(
                    f"{where}: expected one column {name!r}, got {header.count(name)}; rename the others"
                )
        return chosen


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of all files, one trajectory after the other, in each the rows as read.

    Attributes:
        paths: the files.
        names: how labels and metadata call the files: without folders, unless two names are the same.
        columns: what the columns of `values` are.
        values: (n, k) numbers, NaN where missing.
        trajectory: (n,) index into `labels`.
        labels: a text for each trajectory.
        file: (n,) index into `paths`.
        line: (n,) line in the file, as an editor counts.
        position: (n,) place of the row in the order of reading.
    """

    paths: list[Path]
    names: list[str]
    columns: Columns
    values: NDArray[np.float64]
    trajectory: NDArray[np.int64]
    labels: list[str]
    file: NDArray[np.int64]
    line: NDArray[np.int64]
    position: NDArray[np.int64]

    def where(self, row: int) -> str:
        """The file and line of a row, for a message."""
        return f"{self.paths[self.file[row]]}, line {self.line[row]}"

    def earliest(self, rows: NDArray[np.int64]) -> int:
        """Of these rows the one that was read first."""
        return int(rows[np.argmin(self.position[rows])])


def read_rows(paths: list[Path], columns: Columns, delimiter: str) -> Rows:
    """The chosen columns of files that all have them (patterns are resolved in the first file).

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown, repeated or doubly used column, text that is no number, a row of another
            width, an empty label, rows of one label that lie apart and have no time, or text in no UTF-8.
    """
    tables = []
    for path in paths:
        columns, table = _read_table(path, columns, delimiter)
        tables.append(table)
    return _join(paths, columns, tables)


@dataclass(frozen=True, eq=False)
class _Table:
    """Rows of one file: numbers (n, k) (NaN where missing), labels (n,) and the line of each row."""

    values: NDArray[np.float64]
    labels: list[str]
    line: NDArray[np.int64]


def _read_table(path: Path, columns: Columns, delimiter: str) -> tuple[Columns, _Table]:
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; expected a CSV file")
    values: list[NDArray[np.float64]] = []
    labels: list[str] = []
    lines: list[int] = []
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file, delimiter=delimiter, skipinitialspace=True, strict=True)
        try:
            header = [name.strip() for name in next((row for row in reader if row), [])]
            if not header:
                raise ValueError(f"{path}: expected a header row of column names, got an empty file")
            columns = columns.chosen_from(header, str(path))
            number_at = [header.index(name) for name in columns.numbers]
            label_at = None if columns.episode is None else header.index(columns.episode)
            for rows, line in _chunks(reader, path, len(header), blank_is_missing=label_at is None):
                chunk = np.empty((len(rows), len(number_at)))
                for k, (i, name) in enumerate(zip(number_at, columns.numbers, strict=True)):
                    chunk[:, k] = _numbers([row[i] for row in rows], name, path, line)
                values.append(chunk)
                labels += [""] * len(rows) if label_at is None else [row[label_at].strip() for row in rows]
                lines += line
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(
                f"{path}, after line {reader.line_num}: expected CSV text in UTF-8, got {error}; save it so"
            ) from error
    if not values:
        raise ValueError(f"{path}: expected rows below the header, got none")
    if columns.episode is not None and "" in labels:
        raise ValueError(
            f"{path}, line {lines[labels.index('')]}, column {columns.episode!r}: expected the label of a "
            "trajectory in every row, got an empty cell"
        )
    return columns, _Table(np.concatenate(values), labels, np.array(lines))


def _chunks(
    reader: Any, path: Path, width: int, blank_is_missing: bool
) -> Iterator[tuple[list[list[str]], list[int]]]:
    """Rows and their lines, as an editor counts them, some at a time; blank lines at the end fall away."""
    rows: list[list[str]] = []
    lines: list[int] = []
    blank = 0
    line = reader.line_num + 1
    for row in reader:
        if not row or (width > 1 and len(row) == 1 and not row[0].strip()):
            blank = blank or line
        elif len(row) != width:
            raise ValueError(
                f"{path}, line {line}: expected {width} cells as in the header, got {len(row)}; repair the row"
            )
        else:
            if blank and blank_is_missing:
                rows.append([""] * width)
                lines.append(blank)
            blank = 0
            rows.append(row)
            lines.append(line)
            if len(rows) >= _CHUNK_ROWS:
                yield rows, lines
                rows, lines = [], []
        line = reader.line_num + 1
    if rows:
        yield rows, lines


def _numbers(cells: list[str], name: str, path: Path, lines: list[int]) -> NDArray[np.float64]:
    """One column as floats; cell by cell only where a cell is missing or is no number."""
    try:
        if "_" not in "".join(cells):  # Python takes "1_5" for 15
            return np.array(cells, dtype=np.float64)
    except ValueError:
        pass
    numbers = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if cell.strip().lower() in MISSING_TEXTS:
            continue
        try:
            numbers[i] = float(cell.replace("_", "no number"))
        except ValueError as error:
            raise ValueError(
                f"{path}, line {lines[i]}, column {name!r}: expected a number with a decimal point, or an "
                f"empty cell where it is missing, got {cell.strip()!r}; repair it or leave the column out"
            ) from error
    return numbers


def _join(paths: list[Path], columns: Columns, tables: list[_Table]) -> Rows:
    """The rows of all files, sorted by trajectory and otherwise in the order of reading."""
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        names = [str(path) for path in paths]
    number_of: dict[tuple[int, str], int] = {}
    numbers = [
        number_of.setdefault((i, label), len(number_of))
        for i, table in enumerate(tables)
        for label in table.labels
    ]
    trajectory = np.array(numbers, dtype=np.int64)
    file = np.repeat(np.arange(len(tables)), [len(table.line) for table in tables])
    line = np.concatenate([table.line for table in tables])
    if columns.time is None:
        begins = np.flatnonzero(np.append(True, np.diff(trajectory) != 0))
        again = np.setdiff1d(np.arange(len(begins)), np.unique(trajectory[begins], return_index=True)[1])
        if len(again):
            row = begins[again[0]]
            label = list(number_of)[trajectory[row]][1]
            raise ValueError(
                f"{paths[file[row]]}, line {line[row]}: expected the rows of trajectory {label!r} to stand "
                "together, got more of them after another trajectory; pass time=..., by which their order "
                "can be checked, or give every trajectory a label of its own"
            )
    order = np.argsort(trajectory, kind="stable")
    values = np.concatenate([table.values for table in tables])
    labels = [
        names[i] if columns.episode is None else label if len(tables) == 1 else f"{names[i]}: {label}"
        for i, label in number_of
    ]
    return Rows(
        paths, names, columns, values[order], trajectory[order], labels, file[order], line[order], order
    )


def _unknown(name: str, header: list[str], where: str) -> str:
    advice = ""
    if len(header) == 1 and any(sign in header[0] for sign in ";\t|"):
        advice = "; the header is one cell: pass the delimiter of this file (delimiter=...)"
    return f"{where}: no column {name!r}{nearest(name, header)} (it has {header}){advice}"
