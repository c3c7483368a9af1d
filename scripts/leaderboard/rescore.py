"""Reference scores measured anew, put into the records that were made with older ones; no return is touched."""

from __future__ import annotations

from dataclasses import replace

from beliefgym.agents.references import references
from beliefgym.scripts.leaderboard.folder import ResultPaths, check_writable, hold_lock
from beliefgym.scripts.leaderboard.grid import Grid
from beliefgym.scripts.leaderboard.records import take_stock, write_record
from beliefgym.wrappers.task import Task


def rescore(grid: Grid, paths: ResultPaths) -> int:
    """Write the present reference scores into the finished records of a grid.

    Args:
        grid: the cells.
        paths: where their records are.

    Returns:
        how many records have changed.

    Raises:
        ResultsFolderError: the folder cannot be written, or another run is using it.
    """
    check_writable(paths, grid)
    changed = 0
    with hold_lock(paths):
        records = take_stock(grid, paths).records
        for cell in grid.cells:
            record = records.get(cell.key)
            if record is None or record.result is None:
                continue
            scale = references(Task.from_dict(cell.task))
            result = {**record.result, "random_score": scale.random, "expert_score": scale.expert}
            if result != record.result:
                write_record(paths.record(cell), replace(record, result=result))
                changed += 1
    return changed
