"""New reference scores change the scores of finished records and nothing else of them."""

import json

from beliefgym.agents import references
from beliefgym.scripts.leaderboard.folder import ResultPaths
from beliefgym.scripts.leaderboard.grid import Grid
from beliefgym.scripts.leaderboard.rescore import rescore
from beliefgym.scripts.leaderboard.run import LeaderboardOptions, run_leaderboard
from beliefgym.scripts.leaderboard.tiers import RUNNER, build_cells
from beliefgym.wrappers import Task


def test_rescoring_writes_the_present_references_and_keeps_the_returns(tmp_path, monkeypatch):
    task = Task("beliefgym/PendulumPosition-v0")
    grid = Grid("small", build_cells([task], {"random": 0}, [0, 1], eval_episodes=5), time_limit_s=120)
    assert run_leaderboard(LeaderboardOptions(grid, RUNNER, tmp_path, plots=False)) == 0
    paths = ResultPaths(tmp_path, "small")
    before = [json.loads(paths.record(cell).read_text()) for cell in grid.cells]
    assert rescore(grid, paths) == 0
    other = references.References(
        random=-2000.0, expert=-100.0, random_standard_error=1.0, expert_standard_error=1.0
    )
    monkeypatch.setattr("beliefgym.scripts.leaderboard.rescore.references", lambda task: other)
    assert rescore(grid, paths) == 2
    for cell, old in zip(grid.cells, before, strict=True):
        new = json.loads(paths.record(cell).read_text())
        assert (new["result"].pop("random_score"), new["result"].pop("expert_score")) == (-2000.0, -100.0)
        del old["result"]["random_score"], old["result"]["expert_score"]
        assert new == old
