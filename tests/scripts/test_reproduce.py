"""`beliefgym reproduce`: its records, and that its criteria can fail."""

import json

import gymnasium as gym
import numpy as np
import pytest

from beliefgym.envs import registered_ids
from beliefgym.scripts import reproduce
from beliefgym.scripts.cli import main
from beliefgym.scripts.reproductions import env_experts
from beliefgym.scripts.reproductions.successes import TRIALS, Success, Trial


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return ended.value.code


def test_an_unknown_reproduction_is_told(capsys):
    assert run("reproduce", "env-expert") == 2
    assert "there is no reproduction 'env-expert'; did you mean 'env-experts'?" in capsys.readouterr().err


def test_a_record_holds_rows_command_and_versions(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(env_experts, "N_STARTS", 5)
    monkeypatch.setattr(env_experts, "TRIALS", TRIALS[:1])
    assert run("reproduce", "env-experts", "--seed", "4", "--results", str(tmp_path)) == 0
    record = json.loads((tmp_path / "reproduction" / "env-experts.json").read_text())
    assert record["command"] == "beliefgym reproduce env-experts --seed 4"
    assert record["rows"][0]["ours"] == "5 of 5"
    assert record["rows"][0]["meets"] is True
    assert "torch" in record["versions"]
    page = (tmp_path / "reproduction" / "env-experts.md").read_text()
    assert "| Pendulum-v0: held upright for the last second | 5 of 5 |" in page


def test_a_miss_stays_in_the_table(tmp_path, monkeypatch, capsys):
    impossible = Success("impossible", lambda system, states: np.ones(states.shape[1]), 0.5, "m")
    monkeypatch.setattr(env_experts, "N_STARTS", 3)
    monkeypatch.setattr(env_experts, "TRIALS", [Trial("beliefgym/CartPoleSwingUp-v0", impossible)])
    assert run("reproduce", "env-experts", "--results", str(tmp_path)) == 0
    (row,) = json.loads((tmp_path / "reproduction" / "env-experts.json").read_text())["rows"]
    assert row["ours"] == "0 of 3"
    assert row["meets"] is False


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.label.partition(":")[0])
def test_a_random_policy_does_not_meet_the_criterion(trial):
    """A criterion that anything meets would say nothing."""
    env_id, success = trial.env_id, trial.success
    env = gym.make_vec(env_id, 20, vectorization_mode="vector_entry_point", **trial.parameters).unwrapped
    system, steps = env.system, trial.steps or gym.spec(env_id).max_episode_steps
    env.reset(seed=0)
    env.action_space.seed(0)
    history, ended = [], np.zeros(20, dtype=bool)
    for _ in range(min(steps, 400)):
        ended |= env.step(env.action_space.sample())[2]
        history.append(env.state)
    measure = success.measure(system, np.stack(history[-max(1, round(1 / system.dt)) :]))
    assert ((measure < success.limit) & ~ended).mean() < 0.2


def test_every_family_with_a_planner_has_a_criterion():
    judged = {type(gym.make(trial.env_id).unwrapped.system) for trial in TRIALS}
    for env_id in registered_ids():
        system = getattr(gym.make(env_id).unwrapped, "system", None)
        assert system is None or type(system) in judged, f"{env_id} has an expert and no criterion"


def test_names_point_at_functions():
    for path in reproduce.REPRODUCTIONS.values():
        module, _, function = path.partition(":")
        assert callable(getattr(__import__(module, fromlist=[function]), function))
