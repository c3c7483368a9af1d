"""The pool: every way in which a cell can end, and that nothing is left behind."""

import multiprocessing.forkserver
import os
import signal
from collections.abc import Mapping
from typing import Any

import fake_cells
import pytest
from fake_cells import LIGHT, is_alive, make_grid, wait_until

from beliefgym.scripts.leaderboard.grid import Cell
from beliefgym.scripts.leaderboard.pool import Outcome, exit_reason, run_cells


class Ear:
    """Keeps what the pool says."""

    def __init__(self) -> None:
        self.outcomes: dict[str, Outcome] = {}
        self.pids: dict[str, int] = {}
        self.running = 0
        self.most_running = 0

    def started(self, cell: Cell) -> None:
        self.running += 1
        self.most_running = max(self.most_running, self.running)

    def progressed(self, cell: Cell, progress: Mapping[str, Any]) -> None:
        self.pids[cell.agent] = int(progress["note"])

    def ended(self, cell: Cell, outcome: Outcome) -> None:
        self.running -= 1
        self.outcomes[cell.agent] = outcome

    def ticked(self) -> None:
        pass


def run(*agents: str, ear: Ear | None = None, time_limit_s: float = 20.0, **options: Any) -> Ear:
    ear = ear or Ear()
    grid = make_grid(agents, tasks=("Pendulum-v0",), seeds=1)
    run_cells(
        grid.cells,
        "fake_cells:run_cell",
        ear,
        time_limit_s=time_limit_s,
        preload=LIGHT,
        grace_s=0.3,
        **options,
    )
    return ear


def test_results_come_back_and_every_kind_of_failure_has_its_reason() -> None:
    ear = run("weak", "fail", "crash", "segfault", "leave", "not-json", "nan", "threads")
    assert ear.outcomes["weak"].result == fake_cells.result_of(
        make_grid(("weak",), tasks=("Pendulum-v0",)).cells[0].to_dict()
    )
    assert ear.outcomes["weak"].reason is None
    reasons = {agent: outcome.reason for agent, outcome in ear.outcomes.items() if outcome.result is None}
    assert reasons == {
        "fail": "ValueError: the loss is nan at step 12",
        "crash": "was killed by signal 9 (SIGKILL); often the machine was out of memory: try --processes 1",
        "segfault": "was killed by signal 11 (SIGSEGV)",
        "leave": "ended with exit code 3 before it returned a result",
        "not-json": "result.spec.shape is a numpy.float32, which is not plain JSON: use numbers, text, lists and dicts",
        "nan": "result.learning_curve[2].std is nan, not a finite number",
    }  # fmt: skip
    details = {agent: outcome.details or "" for agent, outcome in ear.outcomes.items()}
    assert "in fail" in details["fail"]
    assert "and more" in details["fail"]
    assert "the last words" in details["fail"]
    assert "string_at" in details["segfault"]  # the Python line on which the process crashed
    assert ear.outcomes["threads"].result["spec"] == {
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    assert ear.most_running == 2


def test_hanging_cells_are_stopped_at_their_time_limit_and_take_no_other_with_them() -> None:
    ear = run("hang", "hang-deaf", "hang-in-c", "weak", time_limit_s=2.0, processes=3)
    for agent in ("hang", "hang-deaf", "hang-in-c"):
        outcome = ear.outcomes[agent]
        assert outcome.reason == "exceeded its time limit of 2 s"
        assert 2.0 <= outcome.wall_time_s < 20.0  # stopped in the end, also on a busy machine; else 1000 s
        assert not is_alive(ear.pids[agent])
    assert "in hang" in (ear.outcomes["hang"].details or "")  # the Python line on which it hung
    assert ear.outcomes["weak"].reason is None


def test_what_a_cell_has_started_ends_with_it() -> None:
    result = run("leave-a-child").outcomes["leave-a-child"].result
    assert result is not None
    child = result["spec"]["child"]
    assert wait_until(lambda: not is_alive(child), 5.0)


def test_an_error_in_the_main_process_stops_the_cells_first() -> None:
    class Broken(Ear):
        def ended(self, cell: Cell, outcome: Outcome) -> None:
            raise OSError("No space left on device")

    ear = Broken()
    with pytest.raises(OSError, match="No space left"):
        run("hang", "slow", ear=ear)
    assert not is_alive(ear.pids["hang"])


def test_ctrl_c_stops_the_cells() -> None:
    class Impatient(Ear):
        def ticked(self) -> None:
            if len(self.pids) == 2:
                os.kill(os.getpid(), signal.SIGINT)

    ear = Impatient()
    with pytest.raises(KeyboardInterrupt):
        run("hang", "hang-deaf", ear=ear)
    assert not any(map(is_alive, ear.pids.values()))


def test_the_death_of_the_fork_server_ends_its_cells_and_the_next_one_gets_a_new_server() -> None:
    class Murderer(Ear):
        def progressed(self, cell: Cell, progress: Mapping[str, Any]) -> None:
            super().progressed(cell, progress)
            if cell.agent == "hang":
                os.kill(multiprocessing.forkserver._forkserver._forkserver_pid, signal.SIGKILL)

    ear = run("hang", "weak", ear=Murderer(), processes=1)
    assert ear.outcomes["hang"].reason == "ended with exit code 255 before it returned a result"
    assert wait_until(lambda: not is_alive(ear.pids["hang"]), 5.0)
    assert ear.outcomes["weak"].reason is None


@pytest.mark.parametrize("runner", ["fake_cells", "no_such_module:run", "fake_cells.nothing:run", ":run"])
def test_a_runner_that_is_not_there_is_told_before_anything_runs(runner: str) -> None:
    with pytest.raises(ValueError, match=f"cell runner {runner!r} cannot be found: write module:function"):
        run_cells(make_grid().cells, runner, Ear(), time_limit_s=1.0)


def test_a_function_that_is_not_there_is_the_cells_failure() -> None:
    ear = Ear()
    cells = make_grid(("weak",), tasks=("Pendulum-v0",), seeds=1).cells
    run_cells(cells, "fake_cells:nothing", ear, time_limit_s=9.0, preload=LIGHT)
    assert ear.outcomes["weak"].reason == (
        "ValueError: module fake_cells has no function nothing: see the cell runner 'fake_cells:nothing'"
    )


def test_no_processes_are_refused() -> None:
    with pytest.raises(ValueError, match="processes is at least 1, not 0"):
        run("weak", processes=0)


def test_an_exit_code_is_put_into_words() -> None:
    assert exit_reason(0) == "ended with exit code 0 before it returned a result"
    assert exit_reason(-6) == "was killed by signal 6 (SIGABRT)"
    assert exit_reason(-99) == "was killed by signal 99 (an unknown signal)"
