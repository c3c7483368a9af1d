"""`BeliefPolicy`: when it fits and evaluates, which policy it keeps, and that it is an agent as any other."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.spaces import Box
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy

import beliefgym.agents.belief_policy as module
from beliefgym.agents import BeliefPolicy, evaluate, load_agent, make_agent
from beliefgym.scripts.leaderboard.grid import Cell
from beliefgym.scripts.leaderboard.records import check_result
from beliefgym.scripts.leaderboard.tiers import build_cells
from beliefgym.scripts.run_cell import run_cell
from beliefgym.wrappers import Task

SMALL = {"n_frequencies": 20, "n_iterations": 2, "alpha": 0.1}
NET = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}}
OFF_POLICY = {**NET, "buffer_size": 2000, "batch_size": 16}
PPO = {**NET, "n_steps": 20, "batch_size": 30, "n_epochs": 1}
NOISY = "beliefgym/PendulumPositionNoisyHard-v0"  # ends at 100 steps
SWING = "beliefgym/CartPoleSwingUpPosition-v0"
CHOICES = Task(NOISY, {}, (("DiscreteActions", {"bins": 3}),))


def agent_of(task=NOISY, seed=1, **options):
    """A small one, on 3 copies."""
    usual = {"algorithm": "SAC", "filter": "psim-actions", "filter_options": SMALL, "explore_steps": 60}
    usual |= {"refit_every": 100, "refit_growth": 1.0, "n_envs": 3}
    arguments = PPO if options.get("algorithm") == "PPO" else OFF_POLICY
    return BeliefPolicy(task, seed, **{**usual, "arguments": arguments, **options})


def roll(agent, task=None, n=4, steps=40):
    """Actions over episode starts in the midst, (steps, n, n_act)."""
    env = (task or agent.task).make_vec(n)
    observation, _ = env.reset(seed=5)
    state, actions = None, []
    for t in range(steps):
        start = np.arange(n) < (t == 17)
        action, state = agent.predict(observation, state=state, episode_start=start, deterministic=True)
        observation, *_ = env.step(action)
        actions.append(action)
    return np.array(actions)


def weights(agent):
    return {name: value.numpy().copy() for name, value in agent.model.policy.state_dict().items()}


def steps_of(agent, what):
    return [entry["step"] for entry in agent.history_ if entry["what"] == what]


@pytest.mark.parametrize(
    ("options", "fits"),
    [
        ({}, [60, 102, 201, 300]),  # steps come in threes; a fit follows the first of them that is due
        ({"n_refits": 2}, [60, 102, 201]),
        ({"n_refits": 0}, [60]),
        ({"refit_growth": 2.0}, [60, 102, 204]),
        ({"max_fit_steps": 250}, [60, 102, 201, 300]),
        ({"refit_every": 0}, [60]),
        ({"explore_steps": 130}, [132, 201, 300]),
        ({"explore_steps": 1000}, [402]),
        ({"algorithm": "PPO"}, [60, 120, 240, 300]),  # between rollouts of 20 steps on each copy
        ({"filter": "particle", "filter_options": {"n_particles": 10}}, [60]),  # nothing more to be learned
    ],
)
def test_the_filter_is_fitted_when_it_is_due_and_every_step_counts(options, fits):
    agent = agent_of(**options).learn(400)
    assert steps_of(agent, "fit") == fits
    taken = agent._recorder.n_recorded * 3
    assert taken == agent.model.num_timesteps == (420 if options.get("algorithm") == "PPO" else 402)
    for entry in agent.history_:
        all_of_them = 3 * (1 + (entry["step"] - 1) // 300)
        assert entry["episodes"] == (2 if entry["step"] > options.get("max_fit_steps", 500) else all_of_them)
        assert entry["seconds"] > 0


@pytest.mark.parametrize("algorithm", ["SAC", "PPO"])
def test_learning_in_parts_is_learning_at_once(algorithm):
    at_once = agent_of(algorithm=algorithm).learn(420)
    in_parts = agent_of(algorithm=algorithm).learn(180).learn(60).learn(180)
    assert steps_of(in_parts, "fit") == steps_of(at_once, "fit")
    assert in_parts.model.num_timesteps == at_once.model.num_timesteps
    for name, value in weights(at_once).items():
        assert np.array_equal(value, weights(in_parts)[name]), name


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("algorithm", ["SAC", "PPO"])
def test_the_policy_that_is_kept_is_the_best_with_its_filter_and_its_moments(
    algorithm, normalize, monkeypatch
):
    """Scores are given out so that the second evaluation is the best, and refits follow it."""
    acts, scores = [], [-900.0, -100.0, -300.0, -500.0, -200.0]

    def scored(agent, task, n_episodes, seed):
        acts.append((roll(agent), agent.filter_))
        result = evaluate(agent, task, 1, seed=seed)
        return type(result)(np.array([scores[len(acts) - 1]]), result.lengths)

    monkeypatch.setattr(module, "evaluate", scored)
    agent = agent_of(algorithm=algorithm, normalize=normalize, evaluate_every=90).learn(360)
    told = [entry["mean_return"] for entry in agent.history_ if entry["what"] == "evaluation"]
    assert told == scores[: len(told)]
    assert len(told) >= 4
    assert agent.filter_ is acts[1][1] is not acts[2][1]
    assert np.array_equal(roll(agent), acts[1][0])
    assert not np.array_equal(acts[-1][0], acts[1][0])
    agent.learn(60)  # it goes on from there
    assert np.array_equal(roll(agent), acts[1][0])


def test_evaluations_are_told_and_do_not_count_as_training():
    agent = agent_of(evaluate_every=120, evaluation_episodes=2).learn(400)
    assert steps_of(agent, "evaluation") == [120, 240, 360, 402]
    assert agent.evaluation_steps_ == 4 * 2 * 100
    assert agent.model.num_timesteps == 402
    scores = [entry["mean_return"] for entry in agent.history_ if entry["what"] == "evaluation"]
    again = evaluate(agent, agent.task, 2, seed=module.EVALUATION_SEED)
    assert again.mean == pytest.approx(max(scores), rel=1e-12)


def test_hints_are_for_training_only():
    agent = agent_of(filter="psim-hints").learn(150)
    assert agent.filter_.n_hint_ == 3
    assert "hint" not in agent.task.kwargs
    env = agent.task.make_vec(2)
    observation, infos = env.reset(seed=0)
    assert "hint" not in infos
    assert agent.predict(observation)[0].shape == (2, 1)


def test_auto_is_hints_where_there_are_some():
    assert agent_of(filter="auto").filter == "psim-hints"
    assert agent_of("Pendulum-v1", filter="auto").filter == "psim-actions"


@pytest.mark.parametrize(
    ("algorithm", "task", "options"),
    [
        ("SAC", NOISY, {"filter": "psim-hints", "show": "hint"}),
        ("PPO", SWING, {"normalize": True, "rescale_actions": True, "filter": "psim-hints"}),
    ],
)
def test_a_saved_agent_acts_bit_for_bit_and_does_not_learn_on(algorithm, task, options, tmp_path):
    agent = agent_of(task, algorithm=algorithm, **options)
    with pytest.raises(ValueError, match="expected a trained agent to save; call learn first"):
        agent.save(tmp_path / "agent")
    agent.learn(200).save(tmp_path / "agent")
    again = load_agent(tmp_path / "agent.zip")
    assert np.array_equal(roll(again), roll(agent))
    assert again.options() == agent.options()
    again.save(tmp_path / "again")
    assert np.array_equal(roll(load_agent(tmp_path / "again.zip")), roll(agent))
    with pytest.raises(ValueError, match="expected an agent that was trained here, got one from a file"):
        again.learn(100)


def test_filters_that_know_their_system_are_not_saved(tmp_path):
    agent = agent_of(filter="particle", filter_options={"n_particles": 10}).learn(90)
    with pytest.raises(TypeError, match=r"expected a learned filter \(psim, .*\) to save, got 'particle'"):
        agent.save(tmp_path / "agent")


@pytest.mark.parametrize(
    ("algorithm", "task", "options"),
    [
        ("PPO", SWING, {"normalize": True, "rescale_actions": True}),
        ("A2C", NOISY, {"arguments": {**NET, "n_steps": 10}}),
        ("TD3", NOISY, {"include_observation": False, "filter": "psim"}),
        ("TQC", NOISY, {}),
        ("DQN", CHOICES, {}),
        ("PPO", CHOICES, {}),
        ("SAC", "Pendulum-v1", {}),
        ("SAC", "beliefgym/QuadrotorHoverIMU-v0", {"filter": "psim-hints"}),
        ("SAC", NOISY, {"filter": "ekf", "filter_options": {}, "show": "hint"}),
    ],
)
def test_sb3s_algorithms_run_and_act_within_the_box(algorithm, task, options):
    agent = agent_of(task, algorithm=algorithm, **options).learn(250)
    result = evaluate(agent, Task(agent.task.env_id, {}, agent.task.wrappers), 2, seed=0)
    assert np.isfinite(result.returns).all()
    space, actions = agent.action_space, roll(agent)
    assert actions.dtype == space.dtype
    assert all(space.contains(action) for action in actions.reshape(-1, *space.shape))
    if options.get("rescale_actions"):
        assert isinstance(space, Box)
        assert agent.model.action_space == Box(-1.0, 1.0, space.shape, np.float32)


class Counting(BaseCallback):
    steps = 0

    def _on_step(self):
        self.steps += 1
        return True


def test_sb3s_callbacks_are_called_at_every_step_of_the_algorithm():
    one, other, calls = Counting(), Counting(), []
    agent = agent_of().learn(150, callback=[one, other, lambda local, _: calls.append(1) or True])
    assert one.steps == other.steps == len(calls) == 30  # 20 of 50 explore
    agent.learn(30, callback=one).learn(30, callback=lambda local, _: calls.append(1) or True)
    assert one.steps == len(calls) == 40
    assert agent.learn(3000, callback=lambda local, _: False).model.num_timesteps == 213


def test_sb3s_evaluate_policy_takes_it():
    agent = agent_of().learn(90)
    mean, _ = evaluate_policy(agent, agent.task.make(), n_eval_episodes=2, warn=False)
    assert -1700.0 < mean < 0.0  # 100 steps of at most 16.3 each


def test_before_learning_it_acts_at_random_from_its_seed():
    first, again, other = (roll(agent_of(seed=seed)) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.std() == pytest.approx(4.0 / np.sqrt(12.0), rel=0.15)  # uniform in -2 .. 2; 160 draws
    single, _ = agent_of().predict(np.zeros(2, dtype=np.float32))
    assert single.shape == (1,)


@pytest.mark.parametrize("algorithm", ["SAC", "PPO"])
def test_the_same_seed_gives_the_same_agent(algorithm):
    first, again, other = (agent_of(seed=seed, algorithm=algorithm).learn(250) for seed in (1, 1, 2))
    returns = [evaluate(agent, agent.task, 3).returns for agent in (first, again, other)]
    assert np.array_equal(returns[0], returns[1])
    assert not np.array_equal(returns[0], returns[2])


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        (NOISY, {"algorithm": "RecurrentPPO"}, "algorithm to be one of PPO, .* got 'RecurrentPPO'"),
        (NOISY, {"filter": "psmi"}, "filter to be one of psim, .* got 'psmi'"),
        (NOISY, {"explore_steps": 0}, "explore_steps to be a whole number of at least 1, got 0"),
        (NOISY, {"refit_every": -1}, "refit_every to be a whole number of at least 0"),
        (NOISY, {"refit_growth": 0.9}, "expected refit_growth of at least 1, got 0.9"),
        (NOISY, {"max_fit_steps": 0}, "max_fit_steps to be a whole number of at least 1"),
        (NOISY, {"n_refits": 1.5}, "n_refits to be a whole number"),
        (NOISY, {"evaluate_every": -5}, "evaluate_every to be a whole number"),
        (NOISY, {"n_envs": 0}, "n_envs to be a whole number of at least 1"),
        (NOISY, {"show": "state"}, "expected show to be one of .*'belief', 'hint'.* got 'state'"),
        (NOISY, {"show": "hint"}, "a filter that estimates hints with show='hint', got a PSIMActions"),
        (NOISY, {"algorithm": "DQN"}, "DQN needs a Discrete action space, got Box"),
        (CHOICES, {}, "SAC needs a flat Box space, got Discrete"),
        (CHOICES, {"algorithm": "PPO", "rescale_actions": True}, "rescale_actions needs a flat Box space"),
        ("Pendulum-v1", {"filter": "psim-hints"}, "a task that offers hints .*'psim-hints', and Pendulum-v1"),
        ("Pendulum-v1", {"filter": "ekf", "filter_options": {}}, "a beliefgym system for the filter 'ekf'"),
        ("FrozenLake-v1", {}, "a belief needs a flat Box space, got Discrete"),
    ],
)
def test_impossible_options_are_told_at_once(task, options, message):
    with pytest.raises(ValueError, match=message):
        agent_of(task, **options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_steps": 3}, "plain ReplayBuffer, .* got NStepReplayBuffer"),
        (
            {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}},
            "plain ReplayBuffer, .* got ReplayBuffer with optimize_memory_usage",
        ),
    ],
)
def test_replay_buffers_that_hold_no_new_beliefs_are_told_and_leave_it_untrained(arguments, message):
    agent = agent_of(arguments={**OFF_POLICY, **arguments})
    for _ in range(2):  # the second time too
        with pytest.raises(ValueError, match=message):
            agent.learn(200)


def test_a_cell_of_the_leaderboard_repeats_itself():
    assert make_agent("sac-psim-hints", "beliefgym/PendulumPosition-v0").filter == "psim-hints"
    (cell,) = build_cells([Task(NOISY)], {"sac-psim-hints": 200}, [0], eval_episodes=3)
    small = {"filter_options": SMALL, "explore_steps": 60, "refit_every": 100, "arguments": OFF_POLICY}
    options = {**cell.agent_options, **small}
    cell = Cell.from_dict(
        {**cell.to_dict(), "agent_options": options, "curve_points": 2, "curve_episodes": 2}
    )
    results = [run_cell(cell.to_dict(), lambda progress: None) for _ in range(2)]
    check_result(results[0], cell)
    assert results[0]["returns"] == results[1]["returns"]
    assert results[0]["learning_curve"] == results[1]["learning_curve"]


@pytest.mark.slow
def test_it_learns_the_position_only_pendulum():
    """Random policy -1200, expert -140; a policy without memory stays below -700 at this many steps."""
    agent = make_agent("sac-psim-hints", "beliefgym/PendulumPosition-v0", seed=0).learn(12_000)
    assert evaluate(agent, agent.task, 100, seed=1_000_000).mean > -250.0
