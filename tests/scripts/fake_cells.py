"""A cell runner that trains nothing: its agents' names say what they do, so that the engine can be tested."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from beliefgym.scripts.leaderboard import AgentVariant, Grid, product

RANDOM, EXPERT = -1200.0, -140.0
LEVEL = {"random": 0.0, "weak": 0.3, "strong": 0.9}
LIGHT = (
    "beliefgym.scripts.leaderboard.cell_process",
    "fake_cells",
    "pytest",
)  # a fork server that starts soon


class FakeTask:
    """Stands in for a task."""

    def __init__(self, label: str) -> None:
        self.label = label

    def to_dict(self) -> dict[str, Any]:
        return {"env_id": f"beliefgym/{self.label}", "kwargs": {}, "wrappers": []}


def make_grid(
    agents: tuple[str | AgentVariant, ...] = ("weak", "strong"),
    *,
    tasks: tuple[str, ...] = ("Pendulum-v0", "CartPole-v0"),
    seeds: int = 2,
    name: str = "standard",
    time_limit_s: float = 30.0,
    total_timesteps: int = 1000,
) -> Grid:
    """A small grid of fake tasks."""
    cells = product(
        map(FakeTask, tasks), agents, range(seeds), total_timesteps=total_timesteps, eval_episodes=5
    )
    return Grid(name, cells, time_limit_s)


def result_of(cell: Mapping[str, Any]) -> dict[str, Any]:
    """A complete result that depends on the cell only."""
    rng = np.random.default_rng([cell["seed"], *map(ord, cell["agent"] + cell["task_label"])])
    level = LEVEL.get(cell["agent"], 0.5) + 0.05 * rng.normal()
    scores = level + 0.02 * rng.normal(size=cell["eval_episodes"])
    steps = cell["total_timesteps"]
    return {
        "returns": [float(RANDOM + score * (EXPERT - RANDOM)) for score in scores],
        "random_score": RANDOM,
        "expert_score": EXPERT,
        "learning_curve": [
            {
                "step": steps * k // 5,
                "mean_return": float(RANDOM + level * k / 5 * (EXPERT - RANDOM)),
                "std": 9.0,
            }
            for k in range(6)
        ],
        "training": {"steps": steps, "wall_time_s": 0.5},
        "versions": {"torch": "2.13.0"},
        "git_commit": "abc",
        "spec": {},
    }


def run_cell(cell: dict[str, Any], report: Callable[[Mapping[str, Any]], None]) -> dict[str, Any]:
    """What the agent's name says; leaves its process number in $FAKE_CELLS_DIR where that is set."""
    if folder := os.environ.get("FAKE_CELLS_DIR"):
        Path(folder, str(os.getpid())).touch()
    report({"step": 1, "total": cell["total_timesteps"], "note": str(os.getpid())})
    behaviour = BEHAVIOURS.get(cell["agent"])
    return behaviour(cell) if behaviour else result_of(cell)


def slow(cell: Mapping[str, Any]) -> dict[str, Any]:
    time.sleep(0.4)
    if cell["seed"] == 1 and cell["agent"] == "slow-fails-once":
        raise RuntimeError("diverged | at step 7")
    return result_of(cell)


def fail(cell: Mapping[str, Any]) -> dict[str, Any]:
    print("the last words")
    raise ValueError("the loss is nan at step 12\nand more")


def hang(cell: Mapping[str, Any]) -> dict[str, Any]:
    time.sleep(1000)
    return {}


def hang_deaf(cell: Mapping[str, Any]) -> dict[str, Any]:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return hang(cell)


def hang_in_c(cell: Mapping[str, Any]) -> dict[str, Any]:
    ctypes.PyDLL(None).sleep(1000)  # a PyDLL call keeps the interpreter's lock: no other thread runs
    return {}


def crash(cell: Mapping[str, Any]) -> dict[str, Any]:
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


def segfault(cell: Mapping[str, Any]) -> dict[str, Any]:
    return {"value": ctypes.string_at(0)}


def leave(cell: Mapping[str, Any]) -> dict[str, Any]:
    os._exit(3)


def leave_a_child(cell: Mapping[str, Any]) -> dict[str, Any]:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
    return {**result_of(cell), "spec": {"child": child.pid}}


def nan(cell: Mapping[str, Any]) -> dict[str, Any]:
    result = result_of(cell)
    result["learning_curve"][2]["std"] = float("nan")
    return result


def too_few(cell: Mapping[str, Any]) -> dict[str, Any]:
    return {**result_of(cell), "returns": [1.0, 2.0]}


def not_json(cell: Mapping[str, Any]) -> dict[str, Any]:
    return {**result_of(cell), "spec": {"shape": np.float32(1.0)}}


def threads(cell: Mapping[str, Any]) -> dict[str, Any]:
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return {**result_of(cell), "spec": {name: os.environ[name] for name in names}}


BEHAVIOURS: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "slow": slow,
    "slow-fails-once": slow,
    "fail": fail,
    "hang": hang,
    "hang-deaf": hang_deaf,
    "hang-in-c": hang_in_c,
    "crash": crash,
    "segfault": segfault,
    "leave": leave,
    "leave-a-child": leave_a_child,
    "nan": nan,
    "too-few": too_few,
    "not-json": not_json,
    "threads": threads,
}


def is_alive(pid: int) -> bool:
    """Whether a process runs (a zombie does not)."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def wait_until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Whether the condition came true in time."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until:
        if condition():
            return True
        time.sleep(0.02)
    return condition()


def main() -> int:
    """Runs a small leaderboard in a process of its own: results folder and agents come from the command line."""
    from beliefgym.scripts.leaderboard import LeaderboardOptions, run_leaderboard

    results, *agents = sys.argv[1:]
    grid = make_grid(tuple(agents), tasks=("Pendulum-v0", "CartPole-v0"))
    options = LeaderboardOptions(
        grid, "fake_cells:run_cell", Path(results), command="beliefgym leaderboard", preload=LIGHT[:2]
    )
    return run_leaderboard(options)


if __name__ == "__main__":
    sys.exit(main())
