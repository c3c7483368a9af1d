"""`RecurrentQSARSA` as an agent: how it acts, is evaluated, saved and stopped."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from recurrent_agents import BALANCE, by_network, roll, small
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy

from beliefgym.agents import evaluate, load_agent
from beliefgym.agents.recurrent.q_sarsa import RecurrentQSARSA
from beliefgym.wrappers import Task

PENDULUM = "beliefgym/PendulumPosition-v0"  # torques
TOLD = {"rtol": 0, "atol": 1e-5}  # single precision, over a few dozen steps


@pytest.fixture(scope="module")
def trained():
    return small().learn(160)


@pytest.mark.parametrize("cell", ["lstm", "gru", "none"])
def test_predict_over_episodes_is_the_network_rolled_over_each(cell):
    agent = small(cell=cell).learn(160)
    observations, starts, actions, rewards, memory = roll(agent)
    assert starts.sum() > 4
    values, last = by_network(agent, observations, starts, actions, rewards)
    np.testing.assert_allclose(memory.state.numpy(), last, **TOLD)
    sure = np.abs(values[..., 0] - values[..., 1]) > 1e-4
    assert sure.mean() > 0.8
    assert (actions == values.argmax(-1))[sure].all()


def test_a_batch_is_predicted_as_one_by_one(trained):
    observations, starts, actions, *_ = roll(trained)
    for i in range(3):
        state, batched = None, None
        for t in range(len(starts)):
            alone, state = trained.predict(observations[t, i], state, starts[t, [i]], deterministic=True)
            row, batched = trained.predict(observations[t, [i]], batched, starts[t, [i]], deterministic=True)
            assert np.shape(alone) == ()
            assert row.shape == (1,)
            assert alone == row[0] == actions[t, i]
    with pytest.raises(ValueError, match=r"expected an observation of shape \(2,\)"):
        trained.predict(np.zeros(5))


def test_an_action_matters_to_what_is_predicted_next(trained):
    """The memory holds it; the same observations after another action give other states."""
    observation = np.zeros((1, 2), dtype=np.float32)
    _, memory = trained.predict(observation, deterministic=True)
    other = memory._replace(previous_action=1.0 - memory.previous_action)
    states = [trained.predict(observation, m, deterministic=True)[1].state for m in (memory, other)]
    assert (states[0] - states[1]).abs().max() > 1e-4


def test_without_deterministic_actions_are_drawn_from_the_exploring_policy():
    agent = small(epsilon=(0.6, 0.6, 1.0), temperature=0.0)
    observation = np.repeat([[0.1, 0.05]], 4000, axis=0)
    best = agent.predict(observation[0], deterministic=True)[0]
    chosen, _ = agent.predict(observation)
    # 0.4 + 0.6 / 2, a deviation of the mean of 4000 is sqrt(.7 * .3 / 4000) = 0.0072
    assert (chosen == best).mean() == pytest.approx(0.7, abs=0.03)


def test_a_saved_agent_acts_the_same_and_goes_on_learning(tmp_path):
    agent = small(
        cell="gru",
        auxiliary={"predictive_rewards": {"weight": "linear:0.5", "k": 2}},
        weights=0.8,
        epsilon=(0.5, 0.1, 0.5),
    )
    agent.registered_name = "mine"
    agent.learn(160)
    agent.save(tmp_path / "agent")
    for again in (load_agent(tmp_path / "agent.zip"), RecurrentQSARSA.load(tmp_path / "agent")):
        assert again.registered_name == "mine"
        assert again.options() == agent.options()
        for first, second in zip(roll(agent)[:4], roll(again)[:4], strict=True):
            assert np.array_equal(first, second)
        assert torch.equal(roll(agent)[4].state, roll(again)[4].state)
        assert again.num_timesteps == 160
        before = {key: value.clone() for key, value in again.network.state_dict().items()}
        again.learn(32)
        assert again.num_timesteps == 192
        assert any(not torch.equal(value, before[key]) for key, value in again.network.state_dict().items())


def test_evaluation_and_sb3s_agree(trained):
    ours = evaluate(trained, BALANCE, n_episodes=5, seed=4)
    assert (ours.returns == ours.lengths).all()  # 1 for each step
    env = Task(BALANCE).make()
    theirs = []
    for episode in range(5):
        env.reset(seed=4 + episode)
        start = _StartAt(env, env.unwrapped.state)
        theirs += evaluate_policy(trained, start, n_eval_episodes=1, return_episode_rewards=True, warn=False)[
            0
        ]
    assert ours.returns.tolist() == theirs


class _StartAt(gym.Wrapper):
    """Every reset goes to one state, so that SB3's own resets do not matter."""

    def __init__(self, env, state):
        super().__init__(env)
        self._state = state

    def reset(self, *, seed=None, options=None):
        """To the state."""
        return self.env.reset(options={"state": self._state})


class _Stop(BaseCallback):
    """Stops at a number of steps, and counts."""

    def __init__(self, at):
        super().__init__()
        self.at, self.steps, self.ends = at, [], 0

    def _on_step(self):
        self.steps.append(self.num_timesteps)
        return self.num_timesteps < self.at

    def _on_training_end(self):
        self.ends += 1


def test_sb3s_callbacks_count_steps_and_stop_training():
    agent, callback = small(), _Stop(40)
    agent.learn(320, callback=callback)
    assert agent.num_timesteps == 48  # whole rollouts of 2 x 8
    assert len(callback.steps) == 48
    assert callback.ends == 1
    agent = small().learn(320, callback=lambda found, _: found["num_timesteps"] < 32)
    assert agent.num_timesteps == 32
    agent = small().learn(40, callback=[_Stop(1000)])
    assert agent.num_timesteps == 48  # rounded up


def test_continuous_actions_ask_for_bins():
    with pytest.raises(
        ValueError, match=r"PendulumPosition-v0 has continuous actions, Box.* pass bins=5 .*DiscreteActions"
    ):
        small(PENDULUM)


def test_bins_are_a_grid_of_torques_and_equal_the_wrapper():
    agent = small(PENDULUM, bins=5).learn(160)
    space = Task(PENDULUM).make().action_space
    grid = np.linspace(space.low[0], space.high[0], 5, dtype=np.float32)
    env = Task(PENDULUM).make_vec(64)
    observation, _ = env.reset(seed=0)
    agent.epsilon = 1.0
    action, _ = agent.predict(observation)
    assert action.shape == (64, 1)
    assert set(action[:, 0].tolist()) == set(grid.tolist())
    env.step(action)
    single, _ = agent.predict(observation[0])
    assert single.shape == (1,)
    wrapped = small(Task(PENDULUM, {}, (("DiscreteActions", {"bins": 5}),))).learn(160)
    for key, value in wrapped.network.state_dict().items():
        assert torch.equal(agent.network.state_dict()[key], value), key
    chosen, _ = wrapped.predict(observation, deterministic=True)
    assert np.array_equal(grid[chosen][:, None], agent.predict(observation, deterministic=True)[0])
    assert evaluate(agent, PENDULUM, n_episodes=2).lengths.tolist() == [200, 200]
