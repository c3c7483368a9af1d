"""`DaDControl`: one flag between its two arms, saving without pickles, and whole loops that learn."""

import json
import warnings
import zipfile

import numpy as np
import pytest

from beliefgym.agents import DaDControl, Exploration, RegulatorSynthesis, load_agent, make_agent
from beliefgym.agents.dad_control import default_regressor
from beliefgym.agents.policy_synthesis import RecedingHorizonSynthesis
from beliefgym.learning import DataAsDemonstrator, PolynomialRidge, RandomForest, RandomFourierRidge, Ridge
from beliefgym.scripts.reproductions.control_swing_up import TRIAL_STEPS, swing_up_task, try_fresh_starts
from beliefgym.wrappers import Task

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


PENDULUM = "beliefgym/Pendulum-v0"
SMALL = {
    "regressor": PolynomialRidge(degree=2, alpha=1e-4),
    "dad_iterations": 3,
    "dad_horizon": 5,
    "synthesis": RegulatorSynthesis(),
    "trial_steps": 15,
}
quiet = pytest.mark.filterwarnings(
    "ignore::beliefgym.envs.planning.model_lqr.ModelWarning"  # models of a few steps; told and tested elsewhere
)


def small(env=PENDULUM, seed=2, **how):
    return DaDControl(env, seed, **(SMALL | how))


def actions_of(agent, seed=0):
    """(8, 2, m) actions of two copies along made-up observations, one of which begins anew."""
    rng = np.random.default_rng(seed)
    angle = np.cumsum(0.1 * rng.normal(size=(8, 2)), axis=0)
    state, found = None, []
    for t in range(8):
        seen = np.stack([np.cos(angle[t]), np.sin(angle[t]), np.full(2, 0.1)], axis=1)
        action, state = agent.predict(seen.astype(np.float32), state, np.array([t == 0, t in (0, 4)]))
        found.append(action)
    return np.array(found)


@quiet
def test_without_dad_only_the_model_differs():
    agents = [
        small(dad=dad, initial_trials=2, exploration_trials=1).run_iterations(2) for dad in (True, False)
    ]
    with_dad, without = agents
    kinds = [one["kind"] for one in with_dad.history]
    assert kinds == [one["kind"] for one in without.history]
    for number, kind in enumerate(kinds):
        if kind == "exploration":
            one, other = (agent.trials[number] for agent in agents)
            np.testing.assert_array_equal(one.observations, other.observations)
            np.testing.assert_array_equal(one.actions, other.actions)
        else:  # another policy, but the same start
            np.testing.assert_array_equal(*(agent.trials[number].observations[0, 0] for agent in agents))
    first, single = with_dad._fitted[0], without._fitted[0]
    assert isinstance(first, DataAsDemonstrator)
    assert len(first.history_["n_pairs"]) == 1 + 3
    assert first.history_["n_added"][1] > 0
    assert len(single.history_["n_pairs"]) == 1
    # before its first iteration DaD is the plain regression, on the same data
    for name in ("n_pairs", "train_single_step"):
        assert first.history_[name][0] == single.history_[name][0]
    plain = DataAsDemonstrator(SMALL["regressor"], n_iterations=0, angles=(0,)).fit(without_later(without, 2))
    x, u = np.array([[0.3, -0.2], [2.0, 1.0]]), np.array([[0.5], [-1.0]])
    np.testing.assert_array_equal(single.predict(x, u), plain.predict(x, u))
    assert first.best_iteration_ > 0
    assert np.abs(first.predict(x, u) - plain.predict(x, u)).max() > 1e-6


def without_later(agent, n_trials):
    """The data of an agent's first trials."""
    again = small(initial_trials=2, exploration_trials=1)
    again.trials = agent.trials[:n_trials]
    return again.dataset()


@quiet
def test_settings_reach_the_model_and_defaults_are_the_documented_ones():
    agent = small(dad_iterations=4, dad_horizon=None)
    assert (agent.model.n_iterations, agent.model.horizon) == (4, None)
    assert small(dad=False).model.n_iterations == 0
    plain = DaDControl(PENDULUM)
    assert repr(plain.model.regressor) == repr(default_regressor())
    assert (plain.model.n_iterations, plain.model.horizon) == (5, 10)
    assert plain.synthesis == RecedingHorizonSynthesis()
    assert plain.exploration == Exploration()


@quiet
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"dad": False, "act_with": "last", "policy_trials": 2},
        {
            "regressor": RandomFourierRidge(n_frequencies=20, random_state=1),
            "synthesis": RecedingHorizonSynthesis(horizon=6, candidates=2, iterations=3, every=2),
            "exploration": Exploration("epsilon", std=(0.5,), epsilon=0.5),
            "exploration_trials": 1,
            "target": ([0.1, 0.0], [0.2]),
        },
        {"delays": 2},
    ],
    ids=["defaults", "last", "everything", "delays"],
)
def test_every_setting_survives_the_file_and_learning_goes_on_as_if_uninterrupted(how, tmp_path):
    agent = small(**how).learn(40)
    agent.registered_name = "mine"
    agent.save(tmp_path / "agent")
    again = load_agent(tmp_path / "agent.zip")
    assert type(again) is DaDControl
    assert again.registered_name == "mine"
    assert again.history == agent.history
    assert again.models == agent.models
    assert again.num_timesteps == agent.num_timesteps
    assert again.best_iteration == agent.best_iteration
    assert json.dumps(again.options()) == json.dumps(agent.options())
    for one, other in zip(again.trials, agent.trials, strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)
        np.testing.assert_array_equal(one.actions, other.actions)
    # the same regression on the same trials, in the same order
    np.testing.assert_array_equal(actions_of(again), actions_of(agent))
    for one in (agent, again):
        one.learn(30)
    assert [one["cost"] for one in again.history] == [one["cost"] for one in agent.history]
    np.testing.assert_array_equal(actions_of(again, seed=1), actions_of(agent, seed=1))


@quiet
def test_an_agent_that_has_learned_nothing_is_saved_too(tmp_path):
    small(target=([0.0, 0.0], [0.25])).save(tmp_path / "new.zip")
    again = load_agent(tmp_path / "new.zip")
    assert again.trials == []
    np.testing.assert_array_equal(actions_of(again), np.float32(0.25))
    assert again.learn(1).history[0]["cost"] == small().learn(1).history[0]["cost"]


@quiet
def test_the_same_seed_gives_the_same_agent_and_another_another():
    one, same, other = (small(seed=seed).learn(40) for seed in (5, 5, 6))
    assert [trial["cost"] for trial in one.history] == [trial["cost"] for trial in same.history]
    assert one.history[0]["cost"] != other.history[0]["cost"]
    assert one.history[0]["cost"] != one.history[1]["cost"]


@quiet
def test_settings_come_as_plain_data_from_a_command_line():
    agent = small(
        synthesis={"class": "beliefgym.agents.policy_synthesis:RegulatorSynthesis", "horizon": 7},
        regressor={"class": "beliefgym.learning.polynomial:PolynomialRidge", "degree": 3},
        exploration={"class": "beliefgym.agents.exploration:Exploration", "kind": "random", "std": [0.1]},
    )
    assert agent.synthesis == RegulatorSynthesis(horizon=7)
    assert agent.model.regressor.degree == 3
    assert agent.exploration == Exploration(std=(0.1,))


@quiet
def test_it_learns_to_swing_up_the_pendulum():
    """Learning smoke: after six trials of 3 s the pendulum stands, which chance does not do."""
    agent = DaDControl(
        Task(PENDULUM, {"start_angle": np.pi, "start_speed": 0.1}),
        0,
        regressor=RandomFourierRidge(
            n_frequencies=60, bandwidth=4.0, alpha=1e-8, include_inputs=True, random_state=0
        ),
        dad_iterations=2,
        synthesis=RecedingHorizonSynthesis(horizon=25, candidates=4, iterations=15, every=2),
        trial_steps=60,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        agent.run_iterations(5)
    best = agent.models[agent.best_iteration]
    assert best["cost"] == min(one["cost"] for one in agent.models)
    trial = agent.trials[1 + agent.best_iteration]
    theta = np.arctan2(trial.observations[0, -10:, 1], trial.observations[0, -10:, 0])
    assert np.abs(theta).max() < 0.3, "it stands for the last half second"
    assert agent.history[0]["cost"] > 2.0 * best["cost"], "and the random actions cost more"


@pytest.mark.slow
@pytest.mark.parametrize("dad", [True, False])
def test_the_swing_up_is_solved_within_five_policy_trials(dad):
    """MC-PILCO's budget; 20 of 20 seeds of the committed experiment kept it, so one seed has to."""
    agent = DaDControl(swing_up_task(), seed=31, dad=dad, trial_steps=TRIAL_STEPS, act_with="last")
    agent.run_iterations(5).fit_policy()
    assert agent.num_timesteps <= 6 * TRIAL_STEPS
    assert try_fresh_starts(agent, swing_up_task(), n=40).upright.mean() >= 0.95
