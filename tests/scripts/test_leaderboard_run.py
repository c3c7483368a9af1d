"""The whole leaderboard: what is finished is kept, whatever ends the run."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from fake_cells import LIGHT, is_alive, make_grid, wait_until
from rich.console import Console

from beliefgym.scripts.leaderboard import (
    Grid,
    LeaderboardOptions,
    ResultPaths,
    read_record,
    run_grid,
    run_leaderboard,
)
from beliefgym.scripts.leaderboard.errors import ChangedConfigurationError, ResultsFolderError
from beliefgym.scripts.leaderboard.folder import hold_lock
from beliefgym.scripts.leaderboard.progress import CellProgress

SLOW_AGENTS = ("slow", "slow-fails-once", "weak")  # 2 tasks, 3 agents, 2 seeds: 12 cells of which 2 fail


def options(results: Path, grid: Grid, **more: object) -> LeaderboardOptions:
    return replace(
        LeaderboardOptions(grid, "fake_cells:run_cell", results, preload=LIGHT, plots=False),
        **more,  # type: ignore[arg-type]
    )


def run(results: Path, grid: Grid, **more: object) -> tuple[int, str]:
    """Exit code and what was said."""
    console = Console(file=StringIO(), width=200)
    code = run_leaderboard(options(results, grid, **more), console)
    return code, console.file.getvalue()  # type: ignore[attr-defined]


def snapshot(folder: Path) -> dict[Path, tuple[int, bytes]]:
    """Time of change and content of every record."""
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*.json")}


def test_a_run_leaves_a_record_a_cell_and_a_second_run_does_nothing(tmp_path: Path) -> None:
    grid = make_grid()
    code, said = run(tmp_path, grid)
    assert code == 0
    assert "Leaderboard standard: 8 cells, 0 finished before, 8 to run on 2 processes." in said
    assert "8/8 finished" in said
    paths = ResultPaths(tmp_path, "standard")
    record = read_record(paths.record(grid.cells[0]))
    assert record.is_finished
    assert record.cell == grid.cells[0].to_dict()
    before, table = snapshot(paths.records), paths.table.read_bytes()
    assert len(before) == 8
    code, said = run(tmp_path, grid)
    assert (code, "nothing to run" in said) == (0, True)
    assert snapshot(paths.records) == before
    assert paths.table.read_bytes() == table


def test_failed_cells_are_rows_and_are_tried_again_unless_they_are_kept(tmp_path: Path) -> None:
    grid = make_grid(("weak", "fail", "nan", "too-few"), tasks=("Pendulum-v0",), seeds=1)
    code, said = run(tmp_path, grid)
    assert code == 1
    assert "failed Pendulum-v0/fail/seed-0: ValueError: the loss is nan at step 12" in said
    assert "3 of 4 cells have no result" in said
    paths = ResultPaths(tmp_path, "standard")
    reasons = {
        agent: read_record(paths.records / f"Pendulum-v0/{agent}/seed-0.json").reason for agent in grid.agents
    }
    assert reasons == {
        "weak": None,
        "fail": "ValueError: the loss is nan at step 12",
        "nan": "result.learning_curve[2].std is nan, not a finite number",
        "too-few": "result.returns has one number for each of 5 episodes, not 2",
    }
    before = snapshot(paths.records)
    code, said = run(tmp_path, grid, keep_failed=True)
    assert "3 failed before and are left so, nothing to run" in said
    assert snapshot(paths.records) == before
    code, said = run(tmp_path, grid)
    assert "1 finished before, 3 failed before and are tried again, 3 to run" in said
    after = snapshot(paths.records)
    assert [path.parent.name for path in before if before[path] == after[path]] == ["weak"]


def test_a_changed_configuration_is_told_and_nothing_is_touched(tmp_path: Path) -> None:
    run(tmp_path, make_grid())
    changed = make_grid(total_timesteps=2000)
    before = snapshot(tmp_path)
    with pytest.raises(ChangedConfigurationError) as error:
        run_grid(options(tmp_path, changed), Console(file=StringIO()))
    message = str(error.value)
    assert "8 records in" in message
    assert "Pendulum-v0/weak/seed-0: total_timesteps: 1000 -> 2000" in message
    assert "--redo-changed" in message
    assert snapshot(tmp_path) == before
    code, said = run(tmp_path, changed)
    assert (code, said.startswith("error: 8 records")) == (2, True)


def test_redo_changed_keeps_the_old_records_aside(tmp_path: Path) -> None:
    grid = make_grid(tasks=("Pendulum-v0",), seeds=1)
    run(tmp_path, grid)
    paths = ResultPaths(tmp_path, "standard")
    old = paths.record(grid.cells[0]).read_bytes()
    code, said = run(
        tmp_path, make_grid(tasks=("Pendulum-v0",), seeds=1, total_timesteps=2000), redo_changed=True
    )
    assert code == 0
    assert (
        "Pendulum-v0/weak/seed-0 has changed (total_timesteps: 1000 -> 2000). Old record: seed-0.old-" in said
    )
    assert read_record(paths.record(grid.cells[0])).cell["total_timesteps"] == 2000
    (aside,) = paths.record(grid.cells[0]).parent.glob("seed-0.old-*.json")
    assert aside.read_bytes() == old


def test_a_corrupt_record_is_set_aside_and_only_its_cell_runs_again(tmp_path: Path) -> None:
    grid = make_grid()
    run(tmp_path, grid)
    paths = ResultPaths(tmp_path, "standard")
    table = paths.table.read_bytes()
    broken = paths.record(grid.cells[3])
    broken.write_text(broken.read_text()[:200])
    before = snapshot(paths.records)
    code, said = run(tmp_path, grid)
    assert code == 0
    assert f"{broken} is not readable JSON" in said
    assert "Moved to seed-0.json.corrupt; its cell runs again." in said
    assert (broken.parent / "seed-0.json.corrupt").read_bytes() == before[broken][1]
    after = snapshot(paths.records)
    assert [path for path in before if before[path] != after[path]] == [broken]
    assert paths.table.read_bytes() == table


def test_report_only_runs_nothing(tmp_path: Path) -> None:
    grid = make_grid(seeds=1)
    run(tmp_path, grid)
    more = make_grid(("weak", "strong", "crash"), seeds=1)
    code, said = run(tmp_path, more, report_only=True)
    assert (code, "nothing to run" in said) == (1, True)
    assert "no result Pendulum-v0/crash/seed-0: has not run yet" in said


def test_records_of_no_cell_are_mentioned(tmp_path: Path) -> None:
    run(tmp_path, make_grid(seeds=1))
    _, said = run(tmp_path, make_grid(("weak",), seeds=1))
    assert "2 records belong to no cell of this grid and are not shown:" in said


def test_a_folder_in_use_is_told(tmp_path: Path) -> None:
    grid = make_grid(seeds=1)
    with (
        hold_lock(ResultPaths(tmp_path, "standard")),
        pytest.raises(ResultsFolderError, match="another leaderboard"),
    ):
        run_grid(options(tmp_path, grid), Console(file=StringIO()))


def test_a_runner_that_is_not_there_and_no_processes_are_errors(tmp_path: Path) -> None:
    code, said = run(tmp_path, make_grid(seeds=1), runner="nothing:run")
    assert (code, "error: the cell runner 'nothing:run' cannot be found" in said) == (2, True)
    code, said = run(tmp_path, make_grid(seeds=1), processes=0)
    assert (code, "error: processes is at least 1, not 0" in said) == (2, True)


def test_bars_follow_the_cells_on_a_terminal(tmp_path: Path) -> None:
    console = Console(file=StringIO(), width=120, force_terminal=True)
    assert run_leaderboard(options(tmp_path, make_grid(("slow",), seeds=1)), console) == 0
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert "all cells" in said
    assert "Pendulum-v0/slow/seed-0" in said
    assert "1/1000" in said


def test_without_a_terminal_a_line_a_minute_says_what_is_running(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beliefgym.scripts.leaderboard.progress.HEARTBEAT_S", 0.0)
    cell = make_grid().cells[0]
    console = Console(file=StringIO(), width=120)
    with CellProgress(console, 8, 0) as progress:
        progress.started(cell)
        progress.progressed(cell, {"step": 500, "total": 1000, "note": "return -3"})
        progress.ticked()
    assert "running: Pendulum-v0/weak/seed-0 500/1,000 return -3" in console.file.getvalue()  # type: ignore[attr-defined]


class Main:
    """A leaderboard in a process of its own, which can be killed."""

    def __init__(self, folder: Path, *agents: str) -> None:
        self.results = folder / "results"
        self.pids = folder / "pids"
        self.pids.mkdir(exist_ok=True)
        path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).parent / "fake_cells.py"), str(self.results), *agents],
            env={**os.environ, "PYTHONPATH": path, "FAKE_CELLS_DIR": str(self.pids)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def records(self) -> int:
        return len(list(self.results.rglob("seed-*.json")))

    def cells(self) -> list[int]:
        return [int(path.name) for path in self.pids.iterdir() if is_alive(int(path.name))]


@pytest.fixture
def mains() -> Iterator[list[Main]]:
    started: list[Main] = []
    yield started
    for main in started:
        if main.process.poll() is None:
            main.process.kill()
        for pid in main.cells():  # none, unless a test has failed; they would keep the pipe open
            os.kill(pid, signal.SIGKILL)
        main.process.communicate()


def test_kill_9_in_the_middle_loses_and_repeats_nothing(tmp_path: Path, mains: list[Main]) -> None:
    folders = [tmp_path / "unbroken", tmp_path / "broken"]
    for folder in folders:
        folder.mkdir()
    unbroken, broken = (Main(folder, *SLOW_AGENTS) for folder in folders)
    mains += [unbroken, broken]

    assert wait_until(lambda: broken.records() >= 4 and bool(broken.cells()), 30)
    broken.process.kill()
    broken.process.wait()
    assert wait_until(lambda: not broken.cells(), 10.0), "cell processes have outlived the main process"
    before = snapshot(broken.results)
    finished = [path for path in before if read_record(path).is_finished]
    assert 0 < len(finished) < 12
    assert not (broken.results / "leaderboard_standard.md").exists()

    again = Main(tmp_path / "broken", *SLOW_AGENTS)
    mains.append(again)
    said, _ = again.process.communicate(timeout=60)
    assert again.process.returncode == 1  # two cells fail in every run
    assert f"{len(finished)} finished before" in said
    after = snapshot(broken.results)
    assert len(after) == 12
    assert all(after[path] == before[path] for path in finished)

    unbroken.process.communicate(timeout=60)
    for name in ("leaderboard_standard.md", "leaderboard_standard.csv", "plots/standard/scores.svg"):
        assert (broken.results / name).read_bytes() == (unbroken.results / name).read_bytes(), name
    assert "RuntimeError: diverged \\| at step 7" in (broken.results / "leaderboard_standard.md").read_text()


def test_kill_9_ends_cells_that_hang_in_c_code_too(tmp_path: Path, mains: list[Main]) -> None:
    main = Main(tmp_path, "hang-in-c", "hang-deaf")
    mains.append(main)
    assert wait_until(lambda: len(main.cells()) == 2, 30)
    main.process.kill()
    assert wait_until(lambda: not main.cells(), 10.0)


def test_ctrl_c_keeps_what_is_finished_and_says_how_to_go_on(tmp_path: Path, mains: list[Main]) -> None:
    main = Main(tmp_path, "weak", "hang")
    mains.append(main)
    assert wait_until(lambda: main.records() == 2 and len(main.cells()) == 2, 30)
    os.killpg(main.process.pid, signal.SIGINT)  # as a terminal does: to the whole group
    said, _ = main.process.communicate(timeout=30)
    assert main.process.returncode == 130
    assert f"Stopped. 2 of 8 cells have finished and are kept in {main.results / 'records/standard'}" in said
    assert "The same command goes on from here: beliefgym leaderboard" in said
    assert "Traceback" not in said
    assert main.cells() == []
