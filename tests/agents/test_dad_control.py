"""`DaDControl`: one flag between its two arms, saving without pickles, and whole loops that learn."""

import json
import zipfile

import numpy as np
import pytest

from beliefgym.agents import DaDControl, RegulatorSynthesis, load_agent, make_agent
from beliefgym.agents.policy_synthesis import RecedingHorizonSynthesis
from beliefgym.learning import DataAsDemonstrator, PolynomialRidge, RandomForest, Ridge
from beliefgym.scripts.reproductions.control_swing_up import TRIAL_STEPS, swing_up_task, try_fresh_starts

QUICK = RecedingHorizonSynthesis(horizon=15, candidates=2, iterations=10, again=1, every=5)


def _agent(dad=True, **options):
    return DaDControl(
        "beliefgym/CartPoleSwingUp-v0",
        seed=0,
        dad=dad,
        trial_steps=20,
        **{"regressor": PolynomialRidge(degree=2, alpha=1e-4), "synthesis": QUICK, **options},
    )


def test_the_flag_changes_the_models_iterations_and_nothing_else():
    with_dad, without = _agent(True), _agent(False)
    ours, theirs = with_dad.model.get_params(), without.model.get_params()
    assert {name for name in ours if repr(ours[name]) != repr(theirs[name])} == {"n_iterations"}
    assert theirs["n_iterations"] == 0
    options, others = with_dad.options(), without.options()
    assert {name for name in options if options[name] != others[name]} == {"dad"}


def test_both_arms_explore_alike_and_part_with_the_first_model():
    with_dad, without = _agent(True).run_iterations(1), _agent(False).run_iterations(1)
    first, second = (agent.trials[0].observations for agent in (with_dad, without))
    np.testing.assert_array_equal(first, second)
    single = DataAsDemonstrator(PolynomialRidge(degree=2, alpha=1e-4), n_iterations=0, angles=(1,))
    data = without.dataset().segments(20)[0]  # the exploration trial, which the first model had
    single.fit(data)
    x, u = data.observations[0, :5], data.actions[0, :5]
    np.testing.assert_allclose(without._fitted[0].predict(x, u), single.predict(x, u), rtol=1e-12)


@pytest.mark.parametrize("dad", [True, False])
def test_a_saved_agent_acts_alike_and_goes_on_learning(dad, tmp_path):
    agent = _agent(dad).learn(60)
    agent.save(tmp_path / "agent.zip")
    loaded = load_agent(tmp_path / "agent.zip")
    observation = np.array([[0.1, -0.9, 0.43, 0.0, 0.2]], dtype=np.float32)
    np.testing.assert_allclose(loaded.predict(observation)[0], agent.predict(observation)[0], atol=1e-6)
    assert loaded.history == agent.history
    assert loaded.num_timesteps == agent.num_timesteps
    agent.learn(20), loaded.learn(20)
    np.testing.assert_allclose(loaded.trials[-1].actions, agent.trials[-1].actions, atol=1e-5)


def test_the_file_holds_arrays_and_json_only(tmp_path):
    _agent().learn(40).save(tmp_path / "agent.zip")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        for name in archive.namelist():
            if name.endswith(".json"):
                json.loads(archive.read(name))
            else:
                assert name.endswith(".npz")
                with archive.open(name) as file, np.load(file, allow_pickle=False) as arrays:
                    assert all(arrays[key].dtype != object for key in arrays.files)


def test_an_agent_with_a_cost_of_ones_own_says_why_it_cannot_be_saved(tmp_path):
    agent = _agent(cost=lambda x, u: (x * x).sum(-1))
    with pytest.raises(ValueError, match=r"expected no cost of one's own in an agent that is saved"):
        agent.save(tmp_path / "agent.zip")


def test_any_regressor_stands_inside_even_one_without_derivatives():
    agent = _agent(regressor=RandomForest(n_estimators=5, random_state=0), dad_iterations=1)
    agent.run_iterations(1)
    assert np.isfinite(agent.models[0]["cost"])


def test_a_linear_model_and_a_regulator_bring_the_arm_near_its_target():
    """Without any knowledge of the holding torque; the first policy's cost falls by more than ten times."""
    agent = DaDControl(
        "beliefgym/BaxterReach-v0",
        dad=False,
        regressor=Ridge(),
        synthesis=RegulatorSynthesis(),
        trial_steps=100,
        exploration_trials=1,
        act_with="last",
    )
    agent.run_iterations(6)
    costs = [one["cost"] for one in agent.models]
    assert min(costs[2:]) < 0.1 * costs[0]


def test_the_registered_names_are_the_two_arms():
    task = swing_up_task()
    assert make_agent("dad-control", task).dad is True
    assert make_agent("dagger-control", task).dad is False


@pytest.mark.slow
@pytest.mark.parametrize("dad", [True, False])
def test_the_swing_up_is_solved_within_five_policy_trials(dad):
    """MC-PILCO's budget; 20 of 20 seeds of the committed experiment kept it, so one seed has to."""
    agent = DaDControl(swing_up_task(), seed=31, dad=dad, trial_steps=TRIAL_STEPS, act_with="last")
    agent.run_iterations(5).fit_policy()
    assert agent.num_timesteps <= 6 * TRIAL_STEPS
    assert try_fresh_starts(agent, swing_up_task(), n=40).upright.mean() >= 0.95
