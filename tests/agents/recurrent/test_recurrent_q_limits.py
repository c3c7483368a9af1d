"""What `RecurrentQSARSA` refuses, what it has to be told, and when it says that it has diverged."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from recurrent_agents import BALANCE, by_network, roll, small
from recurrent_cases import Scripted

from beliefgym.agents import evaluate
from beliefgym.agents.recurrent.memory import GRU
from beliefgym.agents.recurrent.recurrent_agent import DivergenceError

TOLD = {"rtol": 0, "atol": 1e-5}  # single precision, over a few dozen steps


@pytest.fixture(scope="module")
def rewarded():
    return small(previous_rewards=True).learn(160)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bootstrap": "taken"}, 'show what those did next, .* take bootstrap="expected", or reuse=1'),
        ({"reuse": 0}, "reuse, n_batches and batch_rows of at least 1, got 0, 2 and 32"),
        ({"n_batches": 0}, "n_batches and batch_rows of at least 1, got 2, 0 and 32"),
        ({"batch_rows": 0}, "n_batches and batch_rows of at least 1, got 2, 2 and 0"),
        ({"gradient": "residual", "reuse": 1}, "take delay_value=False"),
        ({"auxiliary": {"rewards": {}}}, "an auxiliary objective out of"),
        ({"cell": "rnn"}, "expected cell to be one of"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        small(**options)


def test_a_cell_of_ones_own_trains_and_is_not_saved(tmp_path):
    class Own(GRU):
        """Any."""

    agent = small(cell=Own).learn(32)
    with pytest.raises(ValueError, match="expected a cell by name in an agent that is saved"):
        agent.save(tmp_path / "agent")


def test_rewards_have_to_be_told_between_steps(rewarded):
    observation = np.zeros((2, 2), dtype=np.float32)
    _, memory = rewarded.predict(observation)  # an episode's start has no reward before it
    for _ in range(2):
        with pytest.raises(
            ValueError, match=r"call agent.tell_reward\(reward\) between .* previous_rewards=False"
        ):
            rewarded.predict(observation, memory)
        rewarded.tell_reward(np.array([1.0, 2.0]))
        rewarded.predict(observation, memory)  # and is used up
    rewarded.predict(observation, memory, np.ones(2, dtype=bool))
    rewarded.tell_reward(1.0)
    rewarded.predict(observation, memory)  # one number for one copy, or for all


def test_rewards_told_are_what_the_network_was_trained_on(rewarded):
    observations, starts, actions, rewards, memory = roll(rewarded, tell=True)
    scale = rewarded._reward_scale
    assert scale != 1.0
    _, last = by_network(rewarded, observations, starts, actions, rewards, scale)
    np.testing.assert_allclose(memory.state.numpy(), last, **TOLD)
    _, without = by_network(rewarded, observations, starts, actions, 0.0 * rewards)
    assert np.abs(without - last).max() > 1e-3
    assert evaluate(rewarded, BALANCE, n_episodes=3).lengths.min() > 0


@pytest.mark.parametrize("rate", [1e5, 1e30])
@pytest.mark.parametrize(
    "options",
    [{}, {"average": 0.0, "temperature": 0.0, "n_batches": 1}, {"average": 0.0, "n_batches": 1}],
    ids=["averaged", "arg max", "soft-max"],
)
def test_divergence_is_told_where_it_is_noticed(rate, options):
    agent = small(learning_rate=rate, **options)
    with pytest.raises(DivergenceError, match=r"has diverged at step \d+: .* Try a smaller learning_rate"):
        agent.learn(1600)


def test_divergence_in_the_last_step_of_all_is_told_at_the_latest_when_acting():
    agent = small(learning_rate=1e30, average=0.0, n_batches=1)
    with pytest.raises(DivergenceError, match="has diverged"):
        agent.learn(16).predict(np.zeros(2, dtype=np.float32))


@pytest.mark.parametrize("options", [{}, {"reward_scale": 1.0}], ids=["auto", "as they are"])
def test_rewards_that_are_not_finite_are_told(options, scripted, monkeypatch):
    step = Scripted.step
    monkeypatch.setattr(
        Scripted, "step", lambda self, action: (*step(self, action)[:1], np.inf, *step(self, action)[2:])
    )
    with pytest.raises(DivergenceError, match="has diverged at step 0"):
        small(scripted, **options).learn(160)


def test_decoders_of_auxiliary_objectives_are_saved_with_their_moments(tmp_path):
    agent = small(auxiliary={"predictive_state": {"k": 2}}).learn(64)
    agent.save(tmp_path / "agent")
    loaded = type(agent).load(tmp_path / "agent")
    held, found = (one.loss.auxiliary.state_dict() for one in (agent, loaded))
    assert held.keys() == found.keys()
    assert all(torch.equal(held[key], found[key]) for key in held)
    assert held["predictive_state.count"].min() > 0


def test_actions_that_are_not_counted_from_0_are_refused():
    class Shifted(gym.Env):
        """Two actions, 1 and 2."""

        observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        action_space = gym.spaces.Discrete(2, start=1)

    gym.register("Shifted-v0", entry_point=Shifted)
    try:
        with pytest.raises(ValueError, match=r"counted from 0, .* shift them with"):
            small("Shifted-v0")
    finally:
        del gym.registry["Shifted-v0"]
