"""The T-maze: its rules step by step, what the partial form hides, and what can be reached with and without memory."""

from itertools import product

import gymnasium as gym
import numpy as np
import pytest
import torch

import beliefgym  # noqa: F401
from beliefgym.agents import evaluate, make_agent
from beliefgym.envs import TMaze
from beliefgym.envs.random_streams import RandomStreams
from beliefgym.wrappers import Task

FULL, MEMORY = "beliefgym/TMaze-v0", "beliefgym/TMazeMemory-v0"
BOTH = pytest.mark.parametrize("env_id", [FULL, MEMORY])
SOUTH, FORWARD, NORTH = 0, 1, 2


def start(cue):
    return np.array([0.0, cue, 0.0])


def make_vec(env_id, n, mode="DISABLED", **kwargs):
    return gym.make_vec(env_id, n, vectorization_mode="vector_entry_point", autoreset_mode=mode, **kwargs)


def test_the_spaces():
    full, memory = gym.make(FULL), gym.make(MEMORY)
    assert full.action_space == memory.action_space == gym.spaces.Discrete(3)
    names = ("at_start", "in_corridor", "at_junction", "cue_seen", "cue", "place")
    assert full.unwrapped.observation_names == names
    assert memory.unwrapped.observation_names == names[:4]
    assert full.observation_space.high.tolist() == [1, 1, 1, 1, 1, 10]
    assert memory.observation_space.low.tolist() == [0, 0, 0, -1]
    assert gym.make(MEMORY, length=30).unwrapped.system.length == 30


def test_an_episode_by_hand():
    """Length 3, the cue names the north; a wall at the start, one in the corridor, one behind the junction."""
    told = [  # action, at_start, in_corridor, at_junction, cue_seen, cue, place, reward, the end
        (SOUTH, 1, 0, 0, 1, 1, 0, -0.1, False),
        (FORWARD, 0, 1, 0, 0, 1, 1, 0.0, False),
        (NORTH, 0, 1, 0, 0, 1, 1, -0.1, False),
        (FORWARD, 0, 1, 0, 0, 1, 2, 0.0, False),
        (FORWARD, 0, 0, 1, 0, 1, 3, 0.0, False),
        (FORWARD, 0, 0, 1, 0, 1, 3, -0.1, False),
        (NORTH, 0, 0, 0, 0, 1, 3, 4.0, True),
    ]
    full, memory = gym.make(FULL, length=3), gym.make(MEMORY, length=3)
    assert full.reset(options={"state": start(1.0)})[0].tolist() == [1, 0, 0, 1, 1, 0]
    assert memory.reset(options={"state": start(1.0)})[0].tolist() == [1, 0, 0, 1]
    for action, *seen, reward, end in told:
        for env, shown in ((full, seen), (memory, seen[:4])):
            found = env.step(action)
            assert found[0].tolist() == shown
            assert found[1:] == (pytest.approx(reward), end, False, {})
    assert full.unwrapped.state.tolist() == [3.0, 1.0, 1.0]


@pytest.mark.parametrize("cue", [-1.0, 1.0])
@pytest.mark.parametrize("length", [1, 2, 10, 37])
def test_the_cue_names_the_arm(length, cue):
    for action, arm in ((SOUTH, -1.0), (NORTH, 1.0)):
        env = gym.make(MEMORY, length=length)
        env.reset(options={"state": start(cue)})
        for _ in range(length):
            assert env.step(FORWARD)[1:4] == (0.0, False, False)
        _, reward, terminated, truncated, _ = env.step(action)
        assert reward == pytest.approx(4.0 if arm == cue else -0.1)
        assert (terminated, truncated) == (True, False)
        assert env.unwrapped.state.tolist() == [length, cue, arm]


def test_walls_cost_and_move_nothing_until_the_time_is_over():
    env = gym.make(MEMORY)
    first, _ = env.reset(options={"state": start(-1.0)})
    for t in range(50):
        observation, reward, terminated, truncated, _ = env.step(NORTH if t % 2 else SOUTH)
        assert np.array_equal(observation, first)
        assert reward == pytest.approx(-0.1)
        assert (terminated, truncated) == (False, t == 49)


def test_both_cues_are_equally_likely_and_told_by_the_seed():
    env = make_vec(FULL, 10_000)
    cues = env.reset(seed=0)[0][:, 4]
    assert set(cues) == {-1.0, 1.0}
    assert abs(cues.mean()) < 0.04  # four standard errors of a mean over 10,000
    assert np.array_equal(env.reset(seed=0)[0][:, 4], cues)
    system = TMaze()
    later = [system.initial_state(streams)[0, 1] for streams in [RandomStreams([5])] for _ in range(1000)]
    assert abs(np.mean(later)) < 0.13  # one copy's episodes, four standard errors


def test_no_trace_of_the_cue_after_the_first_step_forward():
    """Copies with opposite cues and the same actions see the same, until an arm's reward tells."""
    n, rng = 400, np.random.default_rng(0)
    env = make_vec(MEMORY, 2 * n, "NEXT_STEP")
    first, info = env.reset(options={"state": np.repeat([start(-1.0), start(1.0)], n, axis=0)})
    assert info == {}
    assert first[:n, 3].tolist() == [-1.0] * n
    assert first[n:, 3].tolist() == [1.0] * n
    running = np.ones(n, dtype=bool)
    for t in range(40):
        actions = rng.choice(3, size=n, p=[0.2, 0.6, 0.2]) if t else np.full(n, FORWARD)
        observation, reward, terminated, _, info = env.step(np.tile(actions, 2))
        assert info == {}
        south, north = observation[:n][running], observation[n:][running]
        assert np.array_equal(south, north)
        assert (south[:, 3] == 0.0).all()
        assert np.array_equal(terminated[:n], terminated[n:])
        ended = running & terminated[:n]
        assert np.allclose(reward[:n][ended] + reward[n:][ended], 3.9)  # one of the two was right
        assert np.array_equal(reward[:n][running & ~ended], reward[n:][running & ~ended])
        running &= ~ended
    assert running.mean() < 0.05


def test_the_full_form_shows_the_cue_all_the_way():
    env = gym.make(FULL)
    env.reset(options={"state": start(-1.0)})
    for place in range(1, 11):
        assert env.step(FORWARD)[0][4:].tolist() == [-1.0, place]


@BOTH
def test_the_hint_is_cue_and_place(env_id):
    env = gym.make(env_id, hint=True)
    assert env.unwrapped.hint_names == ("cue", "place")
    assert env.reset(options={"state": start(-1.0)})[1]["hint"].tolist() == [-1.0, 0.0]
    assert env.step(FORWARD)[4]["hint"].tolist() == [-1.0, 1.0]
    assert gym.make(env_id).reset(seed=0)[1] == {}


@BOTH
@pytest.mark.parametrize("length", [1, 10, 30])
def test_the_batch_is_the_single_one(env_id, length):
    n, rng = 16, np.random.default_rng(1)
    vector = make_vec(env_id, n, "SAME_STEP", length=length)
    singles = [gym.make(env_id, length=length) for _ in range(n)]
    observations = vector.reset(seed=7)[0]
    for i, env in enumerate(singles):
        assert np.array_equal(env.reset(seed=7 + i)[0], observations[i])
    for _ in range(120):
        actions = rng.choice(3, size=n, p=[0.2, 0.6, 0.2])
        observations, rewards, terminated, truncated, info = vector.step(actions)
        for i, env in enumerate(singles):
            observation, *rest = env.step(actions[i])
            assert rest[:3] == [rewards[i], terminated[i], truncated[i]]
            if terminated[i] or truncated[i]:
                assert np.array_equal(info["final_obs"][i], observation)
                observation = env.reset()[0]
            assert np.array_equal(observation, observations[i])


@BOTH
@pytest.mark.parametrize("length", [1, 10, 100])
def test_the_expert_gets_four_on_every_seed(env_id, length):
    task = Task(env_id, {"length": length, "max_episode_steps": 200})
    result = evaluate(make_agent("expert", task), task, n_episodes=500, seed=11)
    assert (result.returns == 4.0).all()
    assert (result.lengths == length + 1).all()


def test_without_memory_the_best_is_half():
    """All 81 deterministic maps from what is seen to an action, for both cues."""
    policies = np.array(list(product(range(3), repeat=4)))  # at start with -1, with +1; corridor; junction
    n = len(policies)
    returns = np.zeros(2 * n)
    env = make_vec(MEMORY, 2 * n, "NEXT_STEP")
    seen, _ = env.reset(options={"state": np.repeat([start(-1.0), start(1.0)], n, axis=0)})
    running = np.ones(2 * n, dtype=bool)
    for _ in range(50):
        kind = np.select([seen[:, 3] < 0, seen[:, 3] > 0, seen[:, 1] > 0], [0, 1, 2], 3)
        seen, reward, terminated, truncated, _ = env.step(np.tile(policies, (2, 1))[np.arange(2 * n), kind])
        returns += reward * running
        running &= ~(terminated | truncated)
    mean = returns.reshape(2, n).mean(axis=0)
    assert mean.max() == pytest.approx(1.95)
    best = {tuple(policy) for policy in policies[np.isclose(mean, 1.95)].tolist()}
    assert best == {(FORWARD, FORWARD, FORWARD, SOUTH), (FORWARD, FORWARD, FORWARD, NORTH)}


def test_one_remembered_bit_is_enough():
    n = 300
    env = make_vec(MEMORY, n)
    seen, _ = env.reset(seed=0)
    bit, total = seen[:, 3].copy(), np.zeros(n)
    for _ in range(11):
        seen, reward, terminated, _, _ = env.step(np.where(seen[:, 2] > 0, 1 + bit, FORWARD).astype(int))
        total += reward
    assert terminated.all()
    assert (total == 4.0).all()


def test_actions_between_the_three_are_rounded():
    system = TMaze(length=2)
    at_junction = np.array([2.0, 1.0, 0.0])
    actions = np.array([-2.0, -0.34, -0.33, 0.0, 0.33, 0.34, 2.0])[:, None]
    assert system.step(np.tile(at_junction, (7, 1)), actions)[:, 2].tolist() == [-1, -1, 0, 0, 0, 1, 1]


def test_noise_leaves_a_possible_state():
    system = TMaze(process_noise_std=1.0, actuation_noise_std=1.0)
    rng = np.random.default_rng(0)
    state = system.initial_state(RandomStreams(range(500)))
    for _ in range(20):
        noise = rng.standard_normal((500, system.noise_size))
        state = system.step(state, rng.uniform(-1, 1, (500, 1)), noise)
        place, cue, arm = state.T
        assert set(place) <= set(range(11))
        assert set(cue) == {-1.0, 1.0}
        assert set(arm) <= {-1.0, 0.0, 1.0}
        assert (place[arm != 0] == 10).all()


def test_an_arm_is_left_no_more_and_pays_once():
    system = TMaze()
    inside = np.array([[10.0, 1.0, 1.0]] * 3)
    actions = np.array([[-1.0], [0.0], [1.0]])
    moved = system.flow(inside, actions)
    assert np.array_equal(moved, inside)
    assert system.reward(inside, actions, moved).tolist() == [0.0, 0.0, 0.0]


def test_the_stage_cost_is_the_cost_of_the_step():
    system = TMaze(length=1)
    states = torch.tensor([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]], dtype=torch.float64)
    for turn, expected in ((-1.0, [0.1, 0.1]), (0.0, [0.0, 0.1]), (1.0, [0.1, -4.0])):
        cost = system.stage_cost(states, torch.full((2, 1), turn, dtype=torch.float64))
        assert cost.numpy() == pytest.approx(expected)


def test_states_that_cannot_be_are_told():
    env = gym.make(MEMORY)
    with pytest.raises(ValueError, match="copy 0: the nearest possible 'place' is 3, got 2.5"):
        env.reset(options={"state": [2.5, 1.0, 0.0]})
    with pytest.raises(ValueError, match="copy 0: the nearest possible 'cue' is 1, got 0.2"):
        env.reset(options={"state": [2.0, 0.2, 0.0]})
    with pytest.raises(ValueError, match="copy 0: the nearest possible 'arm' is 0, got 1"):
        env.reset(options={"state": [2.0, 1.0, 1.0]})
    with pytest.raises(ValueError, match=r"expected 'place' within 0\.\.10, got 11"):
        env.reset(options={"state": [11.0, 1.0, 0.0]})
    with pytest.raises(ValueError, match="the episode would already be over there"):
        env.reset(options={"state": [10.0, 1.0, 1.0]})


@pytest.mark.parametrize("length", [0, -3, 2.5, True, "3"])
def test_impossible_lengths_are_told(length):
    with pytest.raises(ValueError, match="expected length as a whole number of at least 1, got"):
        TMaze(length=length)


def test_impossible_rewards_are_told():
    with pytest.raises(ValueError, match="expected goal_reward above 0, got 0"):
        TMaze(goal_reward=0)
    with pytest.raises(ValueError, match="expected penalty of at least 0, got -1"):
        TMaze(penalty=-1)
    with pytest.raises(TypeError, match="did you mean 'length'"):
        gym.make(MEMORY, lenght=3)


def test_what_the_picture_shows():
    """The agent on its way; the sign pales when it is no longer seen; other lengths fit in too."""
    green = np.array([0, 158, 115])
    env = gym.make(MEMORY, render_mode="rgb_array")
    env.reset(options={"state": start(1.0)})
    frames = [env.render(), *(env.step(FORWARD) and env.render() for _ in range(3))]
    shares = [(np.abs(f[:, :480].astype(int) - green).sum(axis=2) < 30).mean() for f in frames]
    assert shares[0] > 1.5 * shares[1] > 0  # the sign and the arm's ring; then the ring alone
    assert shares[1] == shares[2]
    assert not np.array_equal(frames[1][:, :480], frames[2][:, :480])
    for length in (1, 30, 200):
        env = gym.make(MEMORY, render_mode="rgb_array", length=length)
        env.reset(seed=0)
        scene = env.render()[:, :480]
        border = np.concatenate([scene[0], scene[-1], scene[:, 0], scene[:, -1]])
        assert (border == scene[0, 0]).all()  # nothing is cut off
