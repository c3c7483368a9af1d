"""Recurrent soft actor-critic: states as when acting, learning rates, SB3's face, files, errors."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from beliefgym.agents import evaluate
from beliefgym.agents.recurrent.action_units import ActionUnits
from beliefgym.agents.recurrent.collector import RolloutCollector
from beliefgym.agents.recurrent.memory import GRU
from beliefgym.agents.recurrent.recurrent_agent import DivergenceError
from beliefgym.agents.recurrent.replay import EpisodeReplay
from beliefgym.agents.recurrent.sac import RecurrentSAC
from beliefgym.agents.recurrent.sac_networks import log_density
from beliefgym.wrappers.task import Task

PENDULUM = "beliefgym/PendulumPosition-v0"  # cut after 200 steps, torques within 2
SMALL = {
    "hidden_size": 8,
    "width": 16,
    "n_envs": 2,
    "batch_size": 4,
    "sequence_length": 16,
    "learning_starts": 64,
}


def small(seed=0, **more):
    return RecurrentSAC(PENDULUM, seed, **{**SMALL, **more})


def actions(agent, n=3, n_steps=5, **more):
    """What it does with fixed observations."""
    rng = np.random.default_rng(0)
    state, found = None, []
    for _ in range(n_steps):
        observation = rng.uniform(-1.0, 1.0, (n, 2)).astype(np.float32)
        action, state = agent.predict(observation, state, **more)
        found.append(action)
    return np.stack(found)


@pytest.fixture(scope="module")
def trained():
    """An agent with some gradient steps behind it."""
    return small(updates_per_step=0.5).learn(160)


@pytest.mark.parametrize("cell", ["lstm", "gru", "none"])
def test_states_over_stored_episodes_are_those_in_which_actions_were_drawn(cell):
    """By the actions' densities, which an agent that does not learn must find again from the stored steps alone."""
    agent = small(cell=cell, updates_per_step=0.0, n_envs=3, learning_starts=270).learn(270)
    replay = EpisodeReplay(3 * 360)
    # from step 90 on: the next episode, and 50 steps of another
    replay.extend(agent._collector.collect(agent._act, 360))
    batch = replay.episodes(8, torch.Generator().manual_seed(0))
    assert sorted(set(batch["mask"].sum(1).tolist())) == [50, 200]
    history = (batch[key] for key in ("observation", "previous_action", "previous_reward"))
    with torch.no_grad():
        mean, log_std, _ = agent.actor(*history, torch.zeros(8, agent.actor.state_size))
        found = log_density(mean, log_std, batch["action"])
    # single precision, of which atanh near 1 loses some digits
    there = batch["mask"]
    torch.testing.assert_close(found[there].exp(), batch["action_probability"][there], rtol=1e-3, atol=1e-4)


def test_encoders_have_a_learning_rate_of_their_own():
    agent = small(learning_rate=3e-3)
    groups = {group["name"]: group for group in agent.optimizer.param_groups}
    assert groups["heads"]["lr"] == pytest.approx(3e-3)
    assert groups["encoders"]["lr"] == pytest.approx(1e-4)
    assert len(groups) == 2
    encoders = {id(p) for network in (agent.actor, agent.critic) for p in network.encoder.parameters()}
    assert {id(p) for p in groups["encoders"]["params"]} == encoders
    assert {id(p) for group in groups.values() for p in group["params"]} == {
        id(p) for p in agent.loss.parameters()
    }


def test_learning_rates_fall_linearly():
    agent = small(learning_rate="linear:1e-3", encoder_learning_rate="linear:4e-4")
    agent._anneal(0.75)
    assert [group["lr"] for group in agent.optimizer.param_groups] == pytest.approx([2.5e-4, 1e-4])


@pytest.mark.parametrize(("frozen", "moved"), [("critic", "actor"), ("actor", "critic")])
def test_a_loss_moves_its_own_network_alone(frozen, moved):
    agent = small(updates_per_step=0.0).learn(64)
    networks = {"actor": agent.actor, "critic": agent.critic}
    before = {name: [p.clone() for p in network.parameters()] for name, network in networks.items()}
    agent.loss(agent.sample())[f"loss_{moved}"].backward()
    agent.optimizer.step()

    def same(name):
        return all(torch.equal(p, q) for p, q in zip(networks[name].parameters(), before[name], strict=True))

    assert same(frozen)
    assert not same(moved)


def test_learning_takes_every_step_and_begins_when_told():
    agent = small(updates_per_step=0.5, rollout_steps=8)
    agent.learn(100)
    assert [record["steps"] for record in agent.history] == [64, 16, 16, 16]
    assert agent.num_timesteps == 112
    assert "loss_critic" not in agent.history[0]
    assert "loss_critic" in agent.history[1]
    assert all(np.isfinite(value) for value in agent.history[-1].values() if isinstance(value, float))


def test_uniform_actions_come_first():
    agent = small(updates_per_step=0.0, learning_starts=2000, n_envs=4).learn(2000)
    batch = agent._replay.episodes(64, agent._random)
    taken = batch["action"][batch["mask"]]
    # the mean of 2,000 uniform numbers has deviation 0.013, that of their squares 0.007; 64 episodes draw on all
    assert abs(float(taken.mean())) < 0.06
    assert float(taken.square().mean()) == pytest.approx(1 / 3, abs=0.04)


def test_same_seed_same_result():
    first, second, other = (small(seed).learn(128) for seed in (3, 3, 4))
    np.testing.assert_array_equal(actions(first, deterministic=True), actions(second, deterministic=True))
    assert not np.array_equal(actions(first, deterministic=True), actions(other, deterministic=True))
    drop = ("state_drift",)
    assert [{k: v for k, v in r.items() if k not in drop} for r in first.history] == [
        {k: v for k, v in r.items() if k not in drop} for r in second.history
    ]


def test_global_randomness_is_left_alone():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    small().learn(96)
    assert torch.equal(torch.rand(3), expected)


def test_deterministic_actions_are_the_squashed_mean_in_units_of_the_box(trained):
    observation = np.array([0.6, -0.8], dtype=np.float32)
    action, state = trained.predict(observation, deterministic=True)
    nothing = torch.zeros(1, 1, 1)
    with torch.no_grad():
        mean, _, after = trained.actor(
            torch.as_tensor(observation)[None, None],
            nothing,
            nothing,
            torch.zeros(1, trained.actor.state_size),
        )
    assert action.shape == (1,)
    assert action.dtype == np.float32
    assert action.item() == pytest.approx(2.0 * float(mean.tanh()), abs=1e-6)
    torch.testing.assert_close(state.state, after)
    torch.testing.assert_close(state.previous_action, mean[:, 0].tanh())


def test_actions_alone_are_those_in_a_batch(trained):
    together = actions(trained, deterministic=True)
    rng = np.random.default_rng(0)
    state = None
    for t in range(5):
        observation = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)[1]
        action, state = trained.predict(observation, state, deterministic=True)
        np.testing.assert_allclose(action, together[t, 1], atol=1e-5)


def test_episode_start_clears_the_memory(trained):
    first, second = np.array([[0.6, -0.8]]), np.array([[1.0, 0.0]])
    _, state = trained.predict(first, deterministic=True)
    fresh, _ = trained.predict(second, deterministic=True)
    again, _ = trained.predict(second, state, np.array([True]), deterministic=True)
    on, _ = trained.predict(second, state, deterministic=True)
    np.testing.assert_array_equal(fresh, again)
    assert not np.array_equal(fresh, on)


def test_drawn_actions_explore_within_the_box(trained):
    drawn = np.concatenate([actions(trained, n=50) for _ in range(4)])
    assert drawn.std() > 0.1
    assert np.abs(drawn).max() <= 2.0


def test_saved_agents_predict_the_same(trained, tmp_path):
    agent = small(auxiliary={"dynamics": {"weight": 0.5}}).learn(96)
    agent.save(tmp_path / "agent")
    loaded = RecurrentSAC.load(tmp_path / "agent.zip")
    np.testing.assert_array_equal(actions(agent, deterministic=True), actions(loaded, deterministic=True))
    assert loaded.options() == agent.options()
    assert loaded.num_timesteps == agent.num_timesteps
    for ours, theirs in zip(agent.loss.state_dict().values(), loaded.loss.state_dict().values(), strict=True):
        assert torch.equal(torch.as_tensor(ours), torch.as_tensor(theirs))
    loaded.learn(96)  # with a replay that is filled anew
    assert "loss_critic" in loaded.history[-1]


@pytest.mark.parametrize("sequence_length", [None, 8])
@pytest.mark.parametrize("cell", ["lstm", "none"])
def test_learns_from_whole_episodes_and_from_pieces(cell, sequence_length):
    agent = small(cell=cell, sequence_length=sequence_length, burn_in=4).learn(96)
    assert np.isfinite(agent.history[-1]["loss_critic"])


def test_auxiliary_objectives_join_and_fade():
    agent = small(auxiliary={"predictive_state": {"weight": "linear:0.5", "k": 2}, "dynamics": {}})
    weights = []
    for _ in range(2):
        agent.learn(32)
        weights.append(dict(agent.loss.auxiliary_weights))
    agent.learn(64, callback=lambda given, _: weights.append(dict(agent.loss.auxiliary_weights)))
    assert weights[0] == {"predictive_state": 0.5, "dynamics": 1.0}
    assert weights[-1] == {"predictive_state": pytest.approx(0.5 * 16 / 64), "dynamics": 1.0}
    assert {"loss_predictive_state", "loss_dynamics"} <= agent.history[-1].keys()


def test_rewards_have_to_be_told_where_they_are_put_in():
    agent = small(previous_rewards=True).learn(96)
    assert agent.needs_rewards
    observation = np.array([[1.0, 0.0]])
    _, state = agent.predict(observation)
    with pytest.raises(ValueError, match="call agent.tell_reward"):
        agent.predict(observation, state)
    found = []
    for reward in (0.0, -16.0):
        agent.tell_reward(np.array([reward]))
        found.append(agent.predict(observation, state, deterministic=True)[0])
    assert not np.array_equal(*found)
    assert evaluate(agent, PENDULUM, n_episodes=2).lengths.tolist() == [200, 200]


def test_callback_sees_rollouts_and_stops():
    seen = []
    agent = small().learn(320, callback=lambda given, _: seen.append(given["num_timesteps"]) or len(seen) < 3)
    assert seen == [64, 80, 96]
    assert agent.num_timesteps == 96


@pytest.mark.parametrize("share", [np.nan, 1.01])
def test_divergence_is_named(share):
    """What is not finite, and what is beyond a hundred times the largest sum of rewards."""
    agent = small(updates_per_step=0.0).learn(80)
    batch = agent.sample()
    largest = 100.0 * float(agent._replay._store["next", "reward"].abs().max()) / (1.0 - agent.gamma)
    assert largest > 1000.0
    heads = [head[-1] for head in agent.critic.heads]
    with torch.no_grad():
        for head in heads:
            head.weight.zero_()
            head.bias.fill_(0.99 * largest)
    agent.step_optimizer(batch)
    with torch.no_grad():
        heads[0].bias.fill_(share * largest)
    with pytest.raises(
        DivergenceError, match=r"RecurrentSAC on .* has diverged at step 80: .*smaller learning_rate.*average"
    ):
        agent.step_optimizer(batch)


def test_actions_that_are_not_finite_are_told_before_they_are_taken():
    agent = small().learn(80)
    with torch.no_grad():
        agent.actor.head[-1].bias.fill_(np.nan)
    with pytest.raises(DivergenceError, match="RecurrentSAC on .* has diverged at step 80"):
        agent.predict(np.zeros((2, agent.n_observation), dtype=np.float32), deterministic=True)


def test_discrete_actions_are_sent_to_recurrent_q_sarsa():
    with pytest.raises(ValueError, match=r"has Discrete\(2\): take RecurrentQSARSA"):
        RecurrentSAC("beliefgym/CartPoleBalancePosition-v0")


def test_actions_without_bounds_are_refused():
    with pytest.raises(ValueError, match="RecurrentSAC needs bounded actions"):
        ActionUnits(Box(-np.inf, np.inf, (2,)), Task(PENDULUM), "RecurrentSAC")
    with pytest.raises(ValueError, match="a flat Box, but .* has Discrete"):
        ActionUnits(Discrete(3), Task(PENDULUM), "RecurrentSAC")


def test_units_of_actions():
    units = ActionUnits(
        Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64), Task(PENDULUM), "it"
    )
    np.testing.assert_allclose(
        units.to_box(np.array([[-1.0, -1.0], [0.0, 0.5], [1.0, 1.0]])), [[-2, 0], [0, 7.5], [2, 10]]
    )
    env = ActionUnits(Box(-2.0, 2.0, (1,)), Task(PENDULUM), "it").around(Task(PENDULUM).make_vec(2))
    assert env.single_action_space == Box(-1.0, 1.0, (1,))
    assert RolloutCollector(env, 3, 0).n_action == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"batch_size": 0}, r"expected n_envs, .* of at least 1, got \{'batch_size': 0\}"),
        ({"sequence_length": 0}, r"of at least 1, got \{'sequence_length': 0\}"),
        (
            {"updates_per_step": -1.0},
            "expected updates_per_step and learning_starts of at least 0, got -1.0 and 64",
        ),
        ({"average": 1.0}, "expected average from 0.5 to below 1, got 1.0"),
        ({"auxiliary": {"nothing": {}}}, "expected an auxiliary objective out of"),
    ],
)
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        small(**settings)


def test_a_cell_of_ones_own_is_not_saved(tmp_path):
    class Own(GRU):
        pass

    agent = small(cell=Own).learn(96)
    with pytest.raises(ValueError, match="expected a cell by name in an agent that is saved"):
        agent.save(tmp_path / "agent.zip")


@pytest.mark.slow
def test_swings_up_a_pendulum_that_it_sees_without_velocity():
    """Random actions reach -1200, the expert -138."""
    agent = RecurrentSAC(PENDULUM, seed=0).learn(20_000)
    assert evaluate(agent, PENDULUM, n_episodes=20, seed=1000).mean > -400
