"""`beliefgym leaderboard`: train, evaluate and rank a grid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beliefgym.scripts.leaderboard.folder import ResultPaths
from beliefgym.scripts.leaderboard.grid import Grid
from beliefgym.scripts.leaderboard.rescore import rescore
from beliefgym.scripts.leaderboard.run import LeaderboardOptions, run_leaderboard
from beliefgym.scripts.leaderboard.tiers import RUNNER, build_cells, tier
from beliefgym.wrappers.task import Task


@dataclass(frozen=True)
class Leaderboard:
    """Train, evaluate and rank agents; what has finished is never run twice.

    For example:

        beliefgym leaderboard
        beliefgym leaderboard --tier full --processes 8
        beliefgym leaderboard --name mine --envs beliefgym/Pendulum-v0 --agents ppo my_package:MyAgent --steps 50000
    """

    tier: str = "standard"
    """smoke (a minute), standard (a quarter of an hour on 2 cores), full (an hour and a half), difficulty (an agent
    without memory on every environment; an hour), or belief-pendulum, belief-noisy, belief-more and belief-tasks
    (agents on beliefs; an hour each, the last two)."""
    name: str = ""
    """Name of a leaderboard of your own, with --envs, --agents, --steps and --seeds in place of a tier's."""
    envs: tuple[str, ...] = ()
    """Environments of your own leaderboard."""
    agents: tuple[str, ...] = ()
    """Its agents; the random policy and the expert are there without being named."""
    steps: int = 100_000
    """Its training steps."""
    seeds: int = 3
    """Its number of seeds."""
    time_limit: float = 3600.0
    """Seconds after which one of its cells is stopped and becomes a failed row."""
    results_dir: Path = Path("results")
    """Folder of records, tables and figures; only one leaderboard at a time works in it."""
    processes: int = 2
    """Cells at a time, each on one thread."""
    redo_changed: bool = False
    """Run cells again whose configuration has changed; their old records are kept aside."""
    keep_failed: bool = False
    """Leave failed cells as they are; otherwise they are tried again."""
    report_only: bool = False
    """Run nothing; write tables and figures from the records there are."""
    rescore: bool = False
    """First put the present reference scores (`beliefgym envs --measure`) into the finished records."""

    def run(self) -> int:
        """Run; 0, 1 where cells have failed, 2 where it could not start, 130 after Ctrl-C."""
        grid = self._grid()
        if self.rescore:
            changed = rescore(grid, ResultPaths(self.results_dir, grid.name))
            print(f"{changed} records now hold the present reference scores")
        options = LeaderboardOptions(
            grid=grid,
            runner=RUNNER,
            results_dir=self.results_dir,
            command=self._command(),
            processes=self.processes,
            redo_changed=self.redo_changed,
            keep_failed=self.keep_failed,
            report_only=self.report_only,
        )
        return run_leaderboard(options)

    def _grid(self) -> Grid:
        own = (self.name, self.envs, self.agents)
        if not any(own):
            return tier(self.tier)
        if not all(own):
            raise ValueError("a leaderboard of your own needs --name, --envs and --agents together")
        steps = {"random": 0, "expert": 0} | dict.fromkeys(self.agents, self.steps)
        cells = build_cells([Task(env) for env in self.envs], steps, range(self.seeds), eval_episodes=100)
        return Grid(self.name, cells, time_limit_s=self.time_limit)

    def _command(self) -> str:
        if not self.name:
            return f"beliefgym leaderboard --tier {self.tier}"
        envs, agents = " ".join(self.envs), " ".join(self.agents)
        return (
            f"beliefgym leaderboard --name {self.name} --envs {envs} --agents {agents} "
            f"--steps {self.steps} --seeds {self.seeds}"
        )
