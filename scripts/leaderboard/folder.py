"""The results folder: where each file lies, whether it can be written, and who is using it.

results/leaderboard.md, .csv, _timing.csv             the tier `full`
results/leaderboard_standard.md, .csv, _timing.csv    any other tier, here `standard`
results/plots/<tier>/*.png, *.svg
results/records/<tier>/<task>/<agent>/seed-<n>.json   one record a finished cell
"""

import fcntl
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from beliefgym.scripts.leaderboard.errors import ResultsFolderError
from beliefgym.scripts.leaderboard.grid import Cell, Grid

MAIN_TIER = "full"  # the tier whose table has no suffix


@dataclass(frozen=True)
class ResultPaths:
    """Where the files of one tier lie.

    Args:
        results_dir: the results folder.
        tier: the grid's name.
    """

    results_dir: Path
    tier: str

    def _named(self, ending: str) -> Path:
        suffix = "" if self.tier == MAIN_TIER else f"_{self.tier}"
        return self.results_dir / f"leaderboard{suffix}{ending}"

    @property
    def table(self) -> Path:
        """The ranking in Markdown."""
        return self._named(".md")

    @property
    def csv(self) -> Path:
        """One row a cell."""
        return self._named(".csv")

    @property
    def timing(self) -> Path:
        """Wall times and dates, which differ from run to run."""
        return self._named("_timing.csv")

    @property
    def plots(self) -> Path:
        """The folder of the figures."""
        return self.results_dir / "plots" / self.tier

    @property
    def records(self) -> Path:
        """The folder of the records."""
        return self.results_dir / "records" / self.tier

    @property
    def lock(self) -> Path:
        """The file that one running leaderboard holds."""
        return self.results_dir / ".leaderboard.lock"

    def record(self, cell: Cell) -> Path:
        """The file of one cell's record."""
        return self.records / f"{cell.key}.json"


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes the whole file or nothing: a temporary file in the same folder, fsync, then a rename."""
    data = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with open(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fchmod(file.fileno(), 0o644)
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the rename itself survives a power cut
    finally:
        os.close(folder)


def move_aside(path: Path, name: str) -> Path:
    """Renames a file within its folder without overwriting another, counting up where the name is taken.

    Returns:
        The new path.
    """
    target = path.with_name(name)
    stem, dot, ending = name.partition(".")
    count = 2
    while target.exists():
        target = path.with_name(f"{stem}-{count}{dot}{ending}")
        count += 1
    return path.rename(target)


def timestamp() -> str:
    """The time now in UTC, to the second, as in 2026-01-31T12:00:00+00:00."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def check_writable(paths: ResultPaths, grid: Grid) -> None:
    """Makes every folder that the run will write to and really writes a file in each, before any training.

    Raises:
        ResultsFolderError: naming the folder, the system's reason and the remedy.
    """
    for folder in _folders(paths, grid):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=folder, prefix=".probe-", suffix=".tmp") as probe:
                probe.write(b"probe")
                probe.flush()
        except OSError as error:
            raise ResultsFolderError(
                f"the results cannot be written: {folder}: {error.strerror or error}. Make the folder "
                "writable (chmod u+w), free some space, or choose another with --results-dir. Nothing ran."
            ) from error


def _folders(paths: ResultPaths, grid: Grid) -> Iterable[Path]:
    cells = (paths.record(cell).parent for cell in grid.cells)
    return dict.fromkeys([paths.results_dir, paths.plots, paths.records, *cells])


@contextmanager
def hold_lock(paths: ResultPaths) -> Iterator[None]:
    """Keeps every other leaderboard off the results folder; the kernel lets go when the process ends,
    however.

    Raises:
        ResultsFolderError: where another run holds the folder, with its process number.
    """
    with open(paths.lock, "a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            raise ResultsFolderError(
                f"another leaderboard is running in {paths.results_dir} (process {holder}): wait until it "
                "has ended, stop it, or choose another folder with --results-dir. Nothing was run."
            ) from error
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


def clear_leftovers(paths: ResultPaths) -> None:
    """Removes the temporary files of a run that was killed while it wrote; call it under the lock."""
    for leftover in [
        *paths.results_dir.glob(".*.tmp"),
        *paths.plots.glob(".*.tmp"),
        *paths.records.rglob(".*.tmp"),
    ]:
        leftover.unlink(missing_ok=True)
