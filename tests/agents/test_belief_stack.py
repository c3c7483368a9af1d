"""One filter's beliefs everywhere: in the replay buffer, in the episodes that run, before the policy, in training and
after it; against what the filter shows of episodes that a `Diary` cut by hand.

Beliefs and observations are of single precision, and online and offline the same sums are taken in another order: TOLD
is a few roundings of a number of size 10, the largest here. The ridge is strong, since a filter that is fitted to a few
dozen steps with a weak one is chaotic and makes anything of a rounding.
"""

from __future__ import annotations

import numpy as np
import pytest
from diary import Diary, rows, seen

import beliefgym.agents.belief_policy as module
from beliefgym.agents import BeliefPolicy
from beliefgym.agents.step_recorder import StepRecorder
from beliefgym.wrappers import Task

TOLD = {"rtol": 1e-6, "atol": 1e-6}
STABLE = {"n_frequencies": 20, "n_iterations": 2, "alpha": 1.0}
NOISY = "beliefgym/PendulumPositionNoisyHard-v0"  # ends at 100 steps
HOPPER = "beliefgym/HopperPosition-v0"  # a SyncVectorEnv of three torques; falls early
SWING = "beliefgym/CartPoleSwingUpPosition-v0"  # forces of up to 10 N
BALANCE = "beliefgym/CartPoleBalancePosition-v0"  # two pushes; falls early
ARGUMENTS = {
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "buffer_size": 3000,
    "batch_size": 16,
    "train_freq": 4,
}
PPO = {
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "n_steps": 20,
    "batch_size": 30,
    "n_epochs": 1,
}


def agent_of(env_id, **options):
    """A small one, that refits often."""
    usual = {"algorithm": "SAC", "filter_options": STABLE, "explore_steps": 90, "refit_every": 130}
    usual |= {"refit_growth": 1.0, "n_envs": 3}
    arguments = {**(PPO if options.get("algorithm") == "PPO" else ARGUMENTS), **options.pop("arguments", {})}
    return BeliefPolicy(env_id, seed=1, **{**usual, **options}, arguments=arguments)


@pytest.fixture
def diary_of(monkeypatch):
    """Makes an agent learn above a diary."""
    made = []

    def recorder(env, keeps_hints):
        made.append(Diary(env))
        return StepRecorder(made[-1], keeps_hints)

    monkeypatch.setattr(module, "StepRecorder", recorder)

    def learn(agent, steps, callback=None):
        agent.learn(steps, callback=callback)
        return made[-1]

    return learn


CASES = {
    "psim-hints, time limit": (NOISY, {"filter": "psim-hints"}),
    "psim-actions, time limit": (NOISY, {"filter": "psim-actions"}),
    "psim, early ends": (HOPPER, {"filter": "psim"}),
    "psim-hints, early ends": (HOPPER, {"filter": "psim-hints"}),
    "imf": (NOISY, {"filter": "imf", "n_envs": 1, "explore_steps": 150, "refit_every": 100}),
    "buffer wraps": (NOISY, {"filter": "psim-actions", "arguments": {"buffer_size": 250}}),
    "buffer wraps while exploring": (HOPPER, {"filter": "psim", "arguments": {"buffer_size": 60}}),
    "normalised": (SWING, {"filter": "psim-hints", "normalize": True}),
    "rescaled": (SWING, {"filter": "psim-actions", "rescale_actions": True}),
    "TD3, both": (SWING, {"algorithm": "TD3", "normalize": True, "rescale_actions": True}),
    "DQN": (BALANCE, {"algorithm": "DQN", "filter": "psim-actions"}),
    "belief alone": (NOISY, {"filter": "psim-hints", "include_observation": False}),
}


@pytest.mark.parametrize("case", CASES)
def test_every_row_of_the_replay_buffer_is_what_the_last_filter_shows(case, diary_of):
    env_id, options = CASES[case]
    agent = agent_of(env_id, **options)
    diary = diary_of(agent, 380)
    buffer, n = agent.model.replay_buffer, agent.n_envs
    size = agent.arguments["buffer_size"] // n
    expected = rows(agent.filter_, diary)
    n_fits = sum(entry["what"] == "fit" for entry in agent.history_)
    assert n_fits == 3
    assert diary.ends
    assert (buffer.pos, buffer.full) == (diary.n_steps % size, diary.n_steps >= size)
    assert buffer.full == ("wraps" in case)
    space = agent.action_space
    skipped = 0 if agent.include_observation else agent.observation_space.shape[0]
    for copy in range(n):
        assert len(expected[copy]) == diary.n_steps
        for t in range(max(0, diary.n_steps - size), diary.n_steps):
            row, kept = expected[copy][t], (t % size, copy)
            for name in ("observations", "next_observations"):
                np.testing.assert_allclose(getattr(buffer, name)[kept], row[name][skipped:], **TOLD)
            actions = row["actions"]
            if hasattr(space, "high"):
                actions = actions / space.high  # of boxes around 0
            np.testing.assert_allclose(buffer.actions[kept], actions, **TOLD)
            assert buffer.rewards[kept] == pytest.approx(row["rewards"], rel=1e-6)
            assert buffer.dones[kept] == row["dones"]
            assert buffer.timeouts[kept] == row["timeouts"]


@pytest.mark.parametrize(
    ("env_id", "filter", "algorithm"), [(NOISY, "psim-hints", "PPO"), (HOPPER, "psim-actions", "SAC")]
)
def test_the_policy_acts_at_every_step_on_what_the_filter_of_that_time_shows(
    env_id, filter, algorithm, diary_of
):
    """Refits come in the midst of episodes: the first step after one is on the new filter already."""
    agent = agent_of(env_id, algorithm=algorithm, filter=filter, normalize=False)
    noted = []

    def note(local, _):
        noted.append((agent.filter_, agent.model._last_obs.copy()))
        return True

    diary = diary_of(agent, 380, callback=note)
    assert len({id(filter) for filter, _ in noted}) == 3
    explored = diary.n_steps - len(noted)
    shown = {id(filter): rows(filter, diary) for filter, _ in noted}
    for t, (filter, observations) in enumerate(noted, start=explored):
        expected = [shown[id(filter)][copy][t]["observations"] for copy in range(3)]
        np.testing.assert_allclose(observations, expected, **TOLD)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("algorithm", ["SAC", "PPO"])
def test_after_a_takeover_all_that_runs_is_that_of_the_running_episodes(algorithm, normalize, diary_of):
    agent = agent_of(HOPPER, algorithm=algorithm, filter="psim-actions", normalize=normalize)
    diary = diary_of(agent, 380)
    before = [agent.model._last_obs, agent._stack._belief_env.transform.tracker._belief]
    face, normalizer = agent._stack._sb3_env, agent._stack.normalizer
    before += [face._returns.copy(), face._lengths.copy()] + ([normalizer.returns] if normalize else [])
    agent._take_over()  # with the same filter: nothing changes
    after = [agent.model._last_obs, agent._stack._belief_env.transform.tracker._belief]
    after += [face._returns, face._lengths] + ([normalizer.returns] if normalize else [])
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a, b, **TOLD)
    running = [own[-1] for own in diary.episodes]
    expected = np.array([seen(agent.filter_, episode)[-1] for episode in running])
    if normalize:
        expected = normalizer.normalize_obs(expected)
        gamma = normalizer.gamma
        for copy, episode in enumerate(running):
            discounted = sum(r * gamma**i for i, r in enumerate(reversed(episode["rewards"])))
            assert normalizer.returns[copy] == pytest.approx(discounted, rel=1e-5)  # float32 rewards
    np.testing.assert_allclose(agent.model._last_obs, expected, **TOLD)
    assert face._returns == pytest.approx([sum(episode["rewards"]) for episode in running], rel=1e-6)
    assert face._lengths.tolist() == [len(episode["rewards"]) for episode in running]
    assert agent.model._last_episode_starts.tolist() == [not episode["rewards"] for episode in running]


def test_refits_keep_the_coordinates_of_the_first_filter():
    agent, filters = agent_of(NOISY, filter="psim-hints"), []
    agent.learn(380, callback=lambda local, _: filters.append(agent.filter_) or True)
    first, last = filters[0], filters[-1]
    assert not np.array_equal(first.model_._weights, last.model_._weights)
    for name in ("_scale", "_hint_scale", "belief_scale_"):
        for part in ("offset", "scale"):
            assert np.array_equal(getattr(getattr(last, name), part), getattr(getattr(first, name), part))


def test_training_after_a_callback_has_stopped_it_goes_on_from_where_the_environment_is(diary_of):
    """SB3 forgets the step at which a callback stops it; the recorder does not."""
    agent = agent_of(NOISY, filter="psim-actions", refit_every=0)
    stop_at = {150}
    agent.learn(400, callback=lambda local, _: agent.model.num_timesteps not in stop_at)
    diary = agent._recorder.env
    assert diary.n_steps == 50
    agent.learn(100)
    expected = rows(agent.filter_, diary)
    buffer = agent.model.replay_buffer
    assert buffer.pos == diary.n_steps > 80
    for t in range(diary.n_steps):
        for copy in range(3):
            np.testing.assert_allclose(
                buffer.observations[t, copy], expected[copy][t]["observations"], **TOLD
            )


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (HOPPER, {"filter": "psim-hints"}),
        (BALANCE, {"algorithm": "PPO", "filter": "psim-actions", "normalize": True}),
        (SWING, {"algorithm": "PPO", "filter": "psim-hints", "normalize": True, "rescale_actions": True}),
        (HOPPER, {"filter": "psim-hints", "show": "hint", "include_observation": False}),
    ],
)
def test_predict_shows_the_policy_what_training_showed_it(env_id, options, monkeypatch):
    """In n copies that are not those of training and end at different times."""
    agent = agent_of(env_id, **options).learn(200)
    given, chosen, n, task = [], [], 5, Task(env_id, {"max_episode_steps": 37} if env_id == SWING else {})
    predict = agent.model.predict

    def spy(observations, **named):
        given.append(observations.copy())
        chosen.append(predict(observations, **named))
        return chosen[-1]

    monkeypatch.setattr(agent.model, "predict", spy)
    diary = Diary(task.make_vec(n))
    observation, _ = diary.reset(seed=7)
    state, start, starts = None, np.ones(n, dtype=bool), []
    for _ in range(80):
        starts.append(start)
        action, state = agent.predict(observation, state=state, episode_start=start)
        observation, _, terminated, truncated, _ = diary.step(action)
        start = terminated | truncated
        stretch = agent.action_space.high if agent.rescale_actions else 1
        np.testing.assert_allclose(action, chosen[-1][0] * stretch, **TOLD)
    assert np.sum(starts) > n
    for copy, own in enumerate(diary.episodes):
        if options.get("show") == "hint":
            shown = np.concatenate(
                [hint_seen(agent.filter_, episode) for episode in own if episode["rewards"]]
            )
        else:
            shown = np.concatenate(
                [seen(agent.filter_, episode)[: len(episode["rewards"])] for episode in own]
            )
        if agent.normalize:
            shown = agent._stack.normalizer.normalize_obs(shown)
        np.testing.assert_allclose([row[copy] for row in given], shown[:80], **TOLD)


def hint_seen(filter, episode):
    """The estimate of the hint and its deviation, on the scale of the training data's hints; by `update` alone."""
    found, belief, previous = [], filter.initial_belief(1), None
    scale = filter._hint_scale
    for t in range(len(episode["rewards"])):
        belief = filter.update(belief, episode["observations"][t][None], previous)
        estimate = filter.predict_hint(belief)
        found.append(np.concatenate([scale.apply(estimate.mean)[0], estimate.std[0] / scale.scale]))
        previous = episode["actions"][t][None]
    return np.array(found)


def test_predict_forgets_nothing_of_an_older_state():
    """The state that a call returns is a value: going on from it twice gives the same, from a copy that began too."""
    agent = agent_of(NOISY, filter="psim-actions").learn(150)
    env = agent.task.make_vec(2)
    observation, _ = env.reset(seed=0)
    first, state = agent.predict(observation, deterministic=True)
    following, *_ = env.step(first)
    starts = np.array([False, True])
    once, _ = agent.predict(following, state, starts, deterministic=True)
    again, _ = agent.predict(following, state, starts, deterministic=True)
    assert np.array_equal(once, again)
    alone, _ = agent.predict(following[1], deterministic=True)
    assert np.array_equal(alone, once[1])
