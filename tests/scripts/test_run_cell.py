"""One real cell: what it reports, that it repeats, and that the tiers say everything that decides it."""

import json

import pytest

from beliefgym.envs import registered_ids
from beliefgym.scripts.leaderboard.errors import LeaderboardError
from beliefgym.scripts.leaderboard.grid import Cell
from beliefgym.scripts.leaderboard.records import check_result
from beliefgym.scripts.leaderboard.tiers import TIERS, build_cells, tier
from beliefgym.scripts.run_cell import run_cell
from beliefgym.wrappers import Task

NOISY = Task("beliefgym/PendulumPosition-v0", {}, (("ObservationNoise", {"std": 0.1}),))


def small_cell(seed=0):
    (cell,) = build_cells([NOISY], {"ppo-stack": 600}, [seed], eval_episodes=4)
    options = dict(cell.agent_options)
    options["arguments"] = {"policy": "MlpPolicy", "n_steps": 50, "batch_size": 50}
    return Cell.from_dict(
        {**cell.to_dict(), "agent_options": options, "curve_points": 3, "curve_episodes": 2}
    )


def decided(result):
    """What of a result may not depend on the machine's speed."""
    return {key: value for key, value in result.items() if key not in ("training", "evaluation", "machine")}


def test_a_cell_says_everything_and_repeats_itself():
    told = []
    result = run_cell(small_cell().to_dict(), told.append)
    check_result(result, small_cell())
    assert json.loads(json.dumps(result)) == result
    assert len(result["returns"]) == 4
    assert [point["step"] for point in result["learning_curve"]] == [0, 200, 400, 600]
    assert result["expert_score"] > result["random_score"]
    assert "ObservationNoise" in result["spec"]
    assert result["versions"]["stable-baselines3"].startswith("2.")
    assert told[-1]["step"] == told[-1]["total"] == 600
    assert decided(run_cell(small_cell().to_dict(), told.append)) == decided(result)
    assert decided(run_cell(small_cell(seed=1).to_dict(), told.append)) != decided(result)


def test_references_are_cells_too():
    (cell,) = build_cells([NOISY], {"random": 0}, [0], eval_episodes=50)
    result = run_cell(cell.to_dict(), lambda progress: None)
    assert result["learning_curve"] == []
    assert sum(result["returns"]) / 50 == pytest.approx(result["random_score"], abs=200)  # 4 standard errors


@pytest.mark.parametrize("name", TIERS)
def test_tiers_hold_position_only_tasks_with_every_option_written_out(name):
    grid = tier(name)
    if name == "difficulty":  # the fully observed forms belong to what it compares
        assert {cell.task["env_id"] for cell in grid.cells} == set(registered_ids())
    for cell in grid.cells:
        is_partial = any(word in cell.task_label for word in ("Position", "Noisy"))
        assert is_partial or name == "difficulty" or cell.task_label == "Pendulum-v0"
        if cell.total_timesteps:
            assert cell.agent_options["arguments"]["policy"] in ("MlpPolicy", "MlpLstmPolicy")
    if name == "full":
        learning = [cell for cell in grid.cells if cell.total_timesteps]
        assert min(cell.total_timesteps for cell in learning) >= 30_000
        assert {cell.seed for cell in learning} == {0, 1, 2}
        assert len(learning) == 2 * 5 * 3
        assert min(cell.eval_episodes for cell in grid.cells) >= 100


def test_an_unknown_tier_is_told():
    with pytest.raises(LeaderboardError, match="no tier 'standart'; did you mean 'standard'"):
        tier("standart")
