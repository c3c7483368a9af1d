"""`Sequences` from CSV files with a header row, and back.

Row t of a trajectory holds the observation x_t, the action a_t that leads from row t to row t + 1, and the
reward r_t of that step. A step t -> t + 1 is usable where x_t, a_t, r_t and x_{t+1} are all there and their
time stamps are dt apart; an episode is a longest run of usable steps. The last row of an episode gives only
its observation, so that an action or reward missing there is no loss.
"""

from __future__ import annotations

import csv
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.csv_table import Columns, Rows, read_rows
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.whole_files import written_whole

_MOST_NAMED = 3  # dropped pieces that a warning names

FilePath = str | os.PathLike[str]


def from_csv(
    path: FilePath | Sequence[FilePath],
    *,
    observations: str | Sequence[str],
    actions: str | Sequence[str] = (),
    rewards: str | None = None,
    episode: str | None = None,
    time: str | None = None,
    time_tolerance: float = 0.01,
    gaps: Literal["split", "error"] = "split",
    missing: Literal["split", "error"] = "split",
    min_steps: int = 1,
    delimiter: str = ",",
) -> Sequences:
    """Read trajectories from one CSV file or several (UTF-8, one header row, numbers with a decimal point).

    Without `episode` a file is one trajectory; with it, rows of one label in one file are. No trajectory
    goes from one file to the next. Rows of one label may lie apart (interleaved recordings) where `time`
    checks their order; without `time` that is an error. A blank line inside a file without `episode` is a
    row whose cells are all missing. Episodes come in the order in which their trajectories begin.

    Args:
        path: the file, or files with the same columns.
        observations, actions: column names, or shell patterns ("joint_*"); a pattern leaves out the columns
            that the other arguments name in full. Components are named after their columns.
        rewards: column of rewards; zeros without it.
        episode: column whose text says to which trajectory a row belongs.
        time: column of time stamps, as numbers (s). The time step dt is the median step of all trajectories
            (of two middle ones the smaller).
        time_tolerance: a step that differs from dt by more than this fraction of dt is a gap.
        gaps: "split" ends the episode before a gap and starts the next one after it; "error" raises.
        missing: "split" does the same around a missing, NaN or infinite cell: a row without an observation
            is left out, a row without an action or reward ends its episode; "error" raises.
        min_steps: episodes of fewer steps are dropped. `Sequences` pads all to the longest, so that many
            scraps beside one very long episode cost memory: drop them here.
        delimiter: the character between cells.

    Returns:
        The episodes; none is `terminated`. The metadata holds "source" (file names), "dt" (with `time`) and
        "episode_labels" (for each episode as read: its label or file, the `groups` of `Sequences.folds`).

    Warns:
        UserWarning: gaps, missing cells and dropped episodes (how many, where the first is), and columns
            that are constant: they carry no information, and standardisation gives them scale 1.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown column, text that is no number, time that does not increase, a row of another
            width (each with the line, as an editor counts), or not one episode left.
    """
    _check_options(time_tolerance, gaps, missing, min_steps)
    paths = [Path(path)] if isinstance(path, str | os.PathLike) else [Path(p) for p in path]
    if not paths:
        raise ValueError("expected at least one CSV file, got none")
    rows = read_rows(paths, Columns(_texts(observations), _texts(actions), rewards, episode, time), delimiter)
    columns = rows.columns

    notes: list[str] = []
    step = _usable_steps(rows, notes, raises=missing == "error")
    dt = None
    if time is not None:
        dt, gap = _time_step_and_gaps(rows, step, time_tolerance, notes, raises=gaps == "error")
        step &= ~gap
    first, lengths = _pieces(rows, step)
    _note_dropped(rows, first, lengths, min_steps, notes)
    kept = lengths >= min_steps
    first, lengths = first[kept], lengths[kept]
    if not len(first):
        raise ValueError(
            f"{paths[0]}: expected an episode of at least {min_steps} steps, got none of {len(rows.values)} "
            f"rows{''.join('; ' + note for note in notes)}. Leave out columns that have no numbers, raise "
            "time_tolerance or lower min_steps"
        )
    index = np.minimum(first[:, None] + np.arange(lengths.max() + 1), len(rows.values) - 1)
    n_obs, n_seen, n_act = len(columns.observations), columns.n_seen, len(columns.actions)
    metadata = {"source": rows.names, "episode_labels": [rows.labels[i] for i in rows.trajectory[first]]}
    sequences = Sequences(
        rows.values[:, :n_obs][index],
        rows.values[:, n_seen : n_seen + n_act][index[:, :-1]],
        rows.values[:, -1][index[:, :-1]] if rewards else np.zeros((len(index), index.shape[1] - 1)),
        lengths=lengths,
        observation_names=columns.observations,
        action_names=columns.actions,
        metadata=metadata if dt is None else {**metadata, "dt": dt},
    )
    if constant := _constant_columns(sequences):
        notes.append(f"constant columns, which carry no information to a model: {', '.join(constant)}")
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return sequences


def to_csv(sequences: Sequences, path: FilePath) -> Path:
    """Write observations, actions and rewards to one CSV file; an existing file is replaced in one move.

    The columns are episode, step, time (s, where metadata["dt"] is known), the observations, the actions and
    reward, under their names or as observation_0, ..., action_0, ... Numbers keep every digit. What else a
    `Sequences` may hold (states, hints, log probabilities, terminated) has no column; `save_npz` keeps it.

    Returns:
        The path.

    Raises:
        FileNotFoundError: the folder does not exist.
        ValueError: two columns of one name.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"cannot write {path}: the folder {path.parent} does not exist; create it first"
        )
    dt = sequences.metadata.get("dt")
    header = ["episode", "step", *(["time"] if dt is not None else [])]
    header += sequences.observation_names or [f"observation_{i}" for i in range(sequences.n_obs)]
    header += sequences.action_names or [f"action_{i}" for i in range(sequences.n_act)]
    header += ["reward"]
    if repeated := sorted({name for name in header if header.count(name) > 1}):
        raise ValueError(f"expected each column name once, got {repeated} more than once; rename components")
    with written_whole(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for number, one in enumerate(sequences.to_episodes()):
            taken = np.column_stack([one["actions"], one["rewards"]]).tolist()
            taken.append([""] * (sequences.n_act + 1))
            for step, seen in enumerate(one["observations"].tolist()):
                at = [number, step] if dt is None else [number, step, step * dt]
                writer.writerow([*at, *seen, *taken[step]])
    return path


def _usable_steps(rows: Rows, notes: list[str], raises: bool) -> NDArray[np.bool_]:
    """(n - 1,) whether row t and row t + 1 are one trajectory's and hold all that the step needs."""
    same = rows.trajectory[1:] == rows.trajectory[:-1]
    finite, n_seen = np.isfinite(rows.values), rows.columns.n_seen
    absent = ~finite
    absent[:-1, n_seen:] &= same[:, None]  # nothing is lost with a trajectory's last action
    absent[-1, n_seen:] = False
    if absent.any():
        row = rows.earliest(np.flatnonzero(absent.any(axis=1)))
        name = rows.columns.numbers[int(np.argmax(absent[row]))]
        first = f"{rows.where(row)}, column {name!r}"
        if raises:
            got = rows.values[row][absent[row]][0]
            raise ValueError(
                f"{first}: expected a finite number, got {'a missing one' if np.isnan(got) else got}; "
                "repair it, or pass missing='split' to cut the trajectory there"
            )
        n_cells, n_rows = int(absent.sum()), int(absent.any(axis=1).sum())
        notes.append(
            f"{n_cells} missing numbers in {n_rows} of {len(finite)} rows, the first at {first}; trajectories "
            "are cut there"
        )
    seen: NDArray[np.bool_] = np.all(finite[:, :n_seen], axis=1)
    return same & seen[:-1] & seen[1:] & finite[:-1, n_seen:].all(axis=1)


def _time_step_and_gaps(
    rows: Rows, step: NDArray[np.bool_], tolerance: float, notes: list[str], raises: bool
) -> tuple[float | None, NDArray[np.bool_]]:
    """The time step dt, and (n - 1,) which of the usable steps take another time."""
    time = rows.values[:, len(rows.columns.observations)]
    known = np.flatnonzero(np.isfinite(time))
    same = rows.trajectory[known[1:]] == rows.trajectory[known[:-1]]
    backward = np.flatnonzero(same & (np.diff(time[known]) <= 0))
    if len(backward):
        row = rows.earliest(known[backward + 1])
        before = int(known[np.searchsorted(known, row) - 1])
        raise ValueError(
            f"{rows.where(row)}: expected the time to increase within a trajectory, got {time[row]:.15g} "
            f"after {time[before]:.15g} (line {rows.line[before]}); sort the rows, or name the column "
            "that labels the trajectories (episode=...)"
        )
    steps = np.diff(time[known])[same & (np.diff(known) == 1)]
    if not len(steps):
        return None, np.zeros_like(step)
    dt = float(f"{np.quantile(steps, 0.5, method='lower'):.12g}")  # without the rounding of 0.3 - 0.2
    with np.errstate(invalid="ignore"):  # times that are not finite are in no usable step
        gap = step & ~(np.abs(np.diff(time) - dt) <= tolerance * dt)
    if gap.any():
        row = rows.earliest(np.flatnonzero(gap))
        found = f"from {time[row]:.15g} to {time[row + 1]:.15g} (line {rows.line[row + 1]})"
        if raises:
            raise ValueError(
                f"{rows.where(row)}: expected time steps of dt = {dt:g} within {tolerance:.3g} dt, got one {found}; "
                "raise time_tolerance, or pass gaps='split' to cut the trajectory there"
            )
        notes.append(
            f"{int(gap.sum())} of {int(step.sum())} steps in time are gaps, more than {tolerance:.3g} dt away from "
            f"dt = {dt:g}; the first at {rows.where(row)}, {found}; trajectories are cut there; raise "
            "time_tolerance where the clock jitters"
        )
    return dt, gap


def _pieces(rows: Rows, step: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First row and length of every longest run of usable steps, single observations included."""
    seen = np.isfinite(rows.values[:, : rows.columns.n_seen]).all(axis=1)
    first = np.flatnonzero(seen & ~np.append(False, step))
    return first, np.flatnonzero(seen & ~np.append(step, False)) - first


def _note_dropped(
    rows: Rows, first: NDArray[np.int64], lengths: NDArray[np.int64], min_steps: int, notes: list[str]
) -> None:
    short = np.flatnonzero(lengths < min_steps)
    if not len(short):
        return
    named = [
        f"{rows.labels[rows.trajectory[first[i]]]!r} lines {rows.line[first[i]]} to "
        f"{rows.line[first[i] + lengths[i]]}"
        for i in short[:_MOST_NAMED]
    ]
    more = f" and {len(short) - len(named)} more" if len(short) > len(named) else ""
    notes.append(
        f"dropped {len(short)} of {len(lengths)} episodes, shorter than min_steps={min_steps} steps: "
        f"{', '.join(named)}{more}"
    )


def _constant_columns(sequences: Sequences) -> list[str]:
    constant: list[str] = []
    for names, inside in (
        (sequences.observation_names or (), sequences.observations[sequences.observation_mask]),
        (sequences.action_names or (), sequences.actions[sequences.step_mask]),
    ):
        if len(inside) > 1:
            constant += [name for name, span in zip(names, np.ptp(inside, axis=0), strict=True) if span == 0]
    return constant


def _check_options(time_tolerance: float, gaps: str, missing: str, min_steps: int) -> None:
    for name, value in (("gaps", gaps), ("missing", missing)):
        if value not in ("split", "error"):
            raise ValueError(f"{name}: expected 'split' or 'error', got {value!r}")
    if not 0 <= time_tolerance < 1:
        raise ValueError(f"time_tolerance: expected a fraction of dt from 0 to 1, got {time_tolerance!r}")
    if isinstance(min_steps, bool) or not isinstance(min_steps, int | np.integer) or min_steps < 0:
        raise ValueError(f"min_steps: expected a whole number of at least 0, got {min_steps!r}")


def _texts(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)
