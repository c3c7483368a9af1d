"""The control experiments in miniature: cells, tuning by the tuning seeds alone, rows, and the figures' files."""

import json

import numpy as np
import pytest

from beliefgym.agents import DaDControl
from beliefgym.scripts.reproduce import REPRODUCTIONS
from beliefgym.scripts.reproductions import (
    control_arm,
    control_base,
    control_cart_pole,
    control_helicopter,
    control_rivals,
    control_trials,
)
from beliefgym.scripts.reproductions.control_loop import Comparison, Panel
from beliefgym.scripts.reproductions.control_swing_up import (
    TRIAL_STEPS,
    swing_up_task,
    try_fresh_starts,
)
from beliefgym.scripts.reproductions.report import Request


def fake_cell(cell, extra):
    """Costs that depend on the settings, and on the seed where it is not a tuning seed."""
    if cell["seed"] >= 100:
        level = abs(cell["settings"]["alpha"] - 3.0)
    else:
        level = 10.0 - cell["settings"]["alpha"] - (1.0 if cell["dad"] else 0.0) + 0.1 * cell["seed"]
    return {"test_costs": [level + 1.0] * cell["iterations"]}


def _comparison():
    panels = {"one, panel": Panel({"version": 1}, [{"alpha": a} for a in (1.0, 3.0, 9.0)], "lower", True)}
    return Comparison("control-fake", f"{__name__}:fake_cell", panels, 4, 2, (100, 101), (3, 10))


def test_settings_are_chosen_on_the_tuning_seeds_and_gains_are_paired(tmp_path):
    """alpha=9 would be best on the reported seeds; the tuning seeds say 3."""
    rows, chosen, figure = _comparison().run(Request(0, 3, 1, tmp_path, told=lambda text: None))
    assert {one["settings"]["alpha"] for one in chosen.values()} == {3.0}
    (row,) = rows
    expected = np.mean([100.0 * 1.0 / (8.0 + 0.1 * seed) for seed in range(3)])
    assert row["values"]["gain"]["value"] == pytest.approx(expected)
    assert row["meets"] is True
    assert (tmp_path / figure).exists()
    assert len(list((tmp_path / "cells" / "control-fake").glob("tuning-*.json"))) == 3 * 2 + 3 * 2 * 2


def unlike_cell(cell, extra):
    """The arms are tuned to different settings, and with DaD's DAgger only costs the same."""
    best = 3.0 if cell["dad"] else 1.0
    level = abs(cell["settings"]["alpha"] - best) if cell["seed"] >= 100 else 10.0 - cell["settings"]["alpha"]
    return {"test_costs": [level + 1.0] * cell["iterations"]}


def test_a_gain_that_comes_from_other_settings_is_shown_to(tmp_path):
    comparison = Comparison(**{**_comparison().__dict__, "function": f"{__name__}:unlike_cell"})
    (unlike, alike), _, _ = comparison.run(Request(0, 3, 1, tmp_path, told=lambda text: None))
    assert unlike["values"]["gain"]["value"] == pytest.approx(20.0)
    assert alike["what"].endswith("DAgger only with DaD's settings")
    assert alike["values"]["gain"]["value"] == pytest.approx(0.0)


def test_a_panel_whose_runs_fail_is_a_row_with_the_reason(tmp_path):
    comparison = _comparison()
    comparison = Comparison(**{**comparison.__dict__, "function": f"{__name__}:failing_cell"})
    (row,), _, _ = comparison.run(Request(0, 2, 1, tmp_path, told=lambda text: None))
    assert "no luck" in row["what"]
    assert row["meets"] is False


def failing_cell(cell, extra):
    """Always."""
    raise RuntimeError("no luck")


def test_a_cart_pole_cell_gives_a_cost_for_each_iteration():
    cell = {
        "regressor": "ridge",
        "controller": "plan",
        "settings": {"alpha": 1e-2},
        "actuation_noise": 1.0,
        "dad": True,
        "dad_horizon": 5,
        "iterations": 2,
        "seed": 100,
    }
    result = json.loads(json.dumps(control_cart_pole.run_cell(cell, None)))
    assert len(result["test_costs"]) == len(result["trial_costs"]) == 2
    assert np.isfinite(result["test_costs"]).all()
    assert min(result["test_costs"]) > 0.0


def test_a_helicopter_cell_gives_a_cost_for_each_iteration():
    cell = control_helicopter._cell("rff", True, "random", {"alpha": 1e-5, "bandwidth": 10})
    result = control_helicopter.run_cell({**cell, "seeds": [100], "iterations": 2, "test_trials": 3}, None)
    (run,) = result["runs"]
    assert len(run["test_costs"]) == 2
    assert np.isfinite(run["test_costs"]).all()


def test_the_count_of_trials_says_when_the_task_was_solved(monkeypatch):
    """With a test that is passed at once wherever the own trial was upright: k trials came before that policy."""
    condition = control_trials.CONDITIONS["position and velocity"]
    passed = []

    class Passed:
        solved = True

        def to_dict(self):
            return {}

    def tried(agent, task):
        passed.append(len(agent.trials))
        return Passed()

    monkeypatch.setattr(control_trials, "try_fresh_starts", tried)
    cell = {"condition": condition.__dict__, "dad": False, "seed": 300, "most_trials": 8}
    result = control_trials.run_cell(cell, None)
    assert result["trials"] == passed[0] - 2  # but for the exploration trial and the policy's own
    assert len(result["trial_costs"]) == result["trials"] + 1


def test_doing_nothing_does_not_solve_the_swing_up():
    task = swing_up_task()
    idle = DaDControl(task, trial_steps=TRIAL_STEPS)
    test = try_fresh_starts(idle, task, n=4)
    assert not test.upright.any()
    assert test.costs.min() > 400.0  # hanging costs 8 a step: 480 for 60 steps


def test_rivals_run_the_same_trials(monkeypatch):
    cell = {"method": "dagger", "seed": 100, "trials": 1, "tests": 2}
    result = control_rivals.run_cell(cell, None)
    assert result["trials"] == [1, 2]
    assert result["steps"][0] == TRIAL_STEPS
    with pytest.raises(ValueError, match="expected method to be one of"):
        control_rivals.run_cell({**cell, "method": "magic"}, None)


def test_every_control_experiment_is_registered():
    modules = (
        control_arm,
        control_base,
        control_cart_pole,
        control_helicopter,
        control_rivals,
        control_trials,
    )
    targets = {target for name, target in REPRODUCTIONS.items() if name.startswith("control-")}
    assert targets == {f"{module.__name__}:run" for module in modules}
