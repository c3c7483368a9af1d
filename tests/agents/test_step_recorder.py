"""What a `StepRecorder` gives back is what stepping by hand saw, whatever the environment and its ends."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from diary import Diary

from beliefgym.agents.step_recorder import StepRecorder
from beliefgym.wrappers import Task

BALANCE = Task("beliefgym/CartPoleBalancePosition-v0", {"hint": True})  # discrete actions, early ends
NOISY = Task("beliefgym/PendulumPositionNoisyHard-v0", {"hint": True})  # all copies end at 100 steps
HOPPER = Task("beliefgym/HopperPosition-v0", {"hint": True})  # three torques, a SyncVectorEnv, early ends
CASES = {
    "native, discrete": (BALANCE, {}),
    "SyncVectorEnv, discrete": (BALANCE, {"native": False}),
    "native, time limit": (NOISY, {}),
    "SyncVectorEnv, continuous": (HOPPER, {}),
    "short limit": (Task(BALANCE.env_id, {"hint": True, "max_episode_steps": 13}), {}),
}


def recorded(task, n_envs=3, n_steps=120, resets=(), keeps_hints=True, **how):
    """A recorder above a diary, after random steps and resets from outside before the steps of `resets`."""
    diary = Diary(task.make_vec(n_envs, **how))
    recorder = StepRecorder(diary, keeps_hints=keeps_hints)
    recorder.reset(seed=3)
    recorder.action_space.seed(3)
    for t in range(n_steps):
        if t in resets:
            recorder.reset()
        recorder.step(recorder.action_space.sample())
    if n_steps in resets:
        recorder.reset()
    return recorder, diary


def stepped(diary):
    """The episodes with at least one step, each with its copy and first step."""
    found = []
    for copy, own in enumerate(diary.episodes):
        start = 0
        for episode in own:
            if episode["actions"]:
                found.append((start, copy, episode))
            start += len(episode["actions"])
    return found


@pytest.mark.parametrize("resets", [(), (0, 31, 32, 120)], ids=["", "resets from outside"])
@pytest.mark.parametrize("case", CASES)
def test_episodes_are_those_that_stepping_by_hand_saw(case, resets):
    task, how = CASES[case]
    recorder, diary = recorded(task, resets=resets, **how)
    episodes, places = recorder.episodes(lambda raw: np.concatenate([raw, 2.0 * raw[:, :1]], axis=1))
    expected = stepped(diary)
    assert recorder.n_recorded == diary.n_steps == 120
    assert len(episodes) == len(expected) >= 6
    assert places.tolist() == [[start, copy] for start, copy, _ in expected]
    for i, (_, _, episode) in enumerate(expected):
        length = len(episode["actions"])
        assert episodes.lengths[i] == length
        assert np.array_equal(episodes.observations[i, : length + 1], np.array(episode["observations"]))
        assert np.array_equal(episodes.actions[i, :length], np.array(episode["actions"]))
        assert np.array_equal(episodes.rewards[i, :length], episode["rewards"])
        hints = np.array(episode["hints"])
        assert np.array_equal(episodes.hints[i, : length + 1, :-1], hints)
        assert np.array_equal(episodes.hints[i, : length + 1, -1], 2.0 * hints[:, 0])
        assert episodes.terminated[i] == (episode["end"] == "terminated")


def test_the_cases_end_in_every_way():
    """Without this the test above could pass on episodes that never end."""
    ends = {case: recorded(task, **how)[1].ends for case, (task, how) in CASES.items()}
    assert ends == {
        "native, discrete": {"terminated"},
        "SyncVectorEnv, discrete": {"terminated"},
        "native, time limit": {"truncated"},
        "SyncVectorEnv, continuous": {"terminated"},
        "short limit": {"terminated", "truncated"},
    }


@pytest.mark.parametrize("case", [case for case in CASES if CASES[case][0] is not NOISY])
def test_hints_belong_to_the_observations_beside_them(case):
    """The positions that a task shows are components of the state in its hint; at an end it is the final state's."""
    task, how = CASES[case]
    recorder, _ = recorded(task, **how)
    episodes, _ = recorder.episodes(lambda raw: raw)
    inside = episodes.observation_mask
    shown = [0, 2] if "CartPole" in task.env_id else slice(1, 6)
    same = episodes.hints[inside][:, shown], episodes.observations[inside]
    np.testing.assert_allclose(*same, rtol=0, atol=1e-6)  # observations are of single precision


@pytest.mark.parametrize("resets", [(), (0, 31), (31, 120)], ids=["", "reset", "reset at the end"])
@pytest.mark.parametrize("case", CASES)
def test_running_episodes_are_what_there_is_of_them(case, resets):
    task, how = CASES[case]
    recorder, diary = recorded(task, resets=resets, **how)
    running = recorder.running()
    assert running.n_act == recorder.steps().actions.shape[2]
    for copy, own in enumerate(diary.episodes):
        episode, length = own[-1], len(own[-1]["actions"])
        assert running.lengths[copy] == length
        assert np.array_equal(running.observations[copy, : length + 1], np.array(episode["observations"]))
        assert np.array_equal(running.actions[copy, :length].ravel(), np.ravel(episode["actions"]))
        assert np.array_equal(running.rewards[copy, :length], episode["rewards"])


@pytest.mark.parametrize("case", CASES)
def test_steps_lead_to_the_next_observation_of_the_same_episode(case):
    task, how = CASES[case]
    recorder, diary = recorded(task, resets=(31,), **how)
    steps = recorder.steps()
    for start, copy, episode in stepped(diary):
        last = start + len(episode["actions"]) - 1
        times = slice(start, last + 1)
        observations = np.array(episode["observations"])
        assert np.array_equal(steps.observations[times, copy], observations[:-1])
        assert np.array_equal(steps.next_observations[times, copy], observations[1:])
        assert np.array_equal(steps.actions[times, copy], episode["actions"])
        assert np.array_equal(steps.rewards[times, copy], episode["rewards"])
        assert not steps.terminated[start:last, copy].any()
        assert not steps.truncated[start:last, copy].any()
        assert steps.terminated[last, copy] == (episode["end"] == "terminated")
        assert steps.truncated[last, copy] == (episode["end"] == "truncated")


def test_what_is_recorded_stays_when_the_caller_writes_into_his_arrays():
    recorder = StepRecorder(BALANCE.make_vec(2), keeps_hints=True)
    observations, _ = recorder.reset(seed=0)
    first, actions = observations.copy(), np.array([1, 0])
    observations[:] = 7.0
    after, *_, infos = recorder.step(actions)
    second = after.copy()
    actions[:], after[:], infos["hint"][:] = 5, 7.0, 7.0
    recorder.step(np.array([0, 0]))
    steps = recorder.steps()
    assert np.array_equal(steps.observations, [first, second])
    assert steps.actions[0].ravel().tolist() == [1, 0]
    assert np.abs(recorder.episodes(lambda raw: raw)[0].hints).max() < 1.0


def test_names_go_into_the_episodes():
    recorder, _ = recorded(BALANCE, n_steps=5)
    episodes, _ = recorder.episodes(lambda raw: raw, observation_names=("a", "b"), hint_names=tuple("cdef"))
    assert (episodes.observation_names, episodes.hint_names) == (("a", "b"), tuple("cdef"))
    assert recorder.episodes()[0].hints is None


def test_misuse_is_told():
    other = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync")
    with pytest.raises(ValueError, match="expected a vector environment with autoreset SAME_STEP, got"):
        StepRecorder(other)
    without = StepRecorder(Task("beliefgym/PendulumPosition-v0").make_vec(2), keeps_hints=True)
    with pytest.raises(ValueError, match=r"expected 'hint' in the infos"):
        without.reset()
    recorder = StepRecorder(BALANCE.make_vec(2))
    with pytest.raises(RuntimeError, match=r"expected reset\(\) before step\(\)"):
        recorder.step(np.zeros(2, dtype=int))
    with pytest.raises(RuntimeError, match=r"expected reset\(\) before running\(\)"):
        recorder.running()
    recorder.reset(seed=0)
    with pytest.raises(ValueError, match="reset of all copies"):
        recorder.reset(options={"reset_mask": np.array([True, False])})
    for ask in (recorder.steps, recorder.episodes):
        with pytest.raises(RuntimeError, match=r"expected at least one step\(\)"):
            ask()
    assert recorder.running().lengths.tolist() == [0, 0]
    recorder.step(np.zeros(2, dtype=int))
    with pytest.raises(ValueError, match="expected a recorder with keeps_hints=True"):
        recorder.episodes(lambda raw: raw)
