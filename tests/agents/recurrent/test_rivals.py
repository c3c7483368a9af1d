"""The rivals of Recurrent-Q SARSA: their batches, their losses against sums by hand, and the agent's face."""

from copy import deepcopy
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch

from beliefgym.agents.recurrent.drqn import DRQN
from beliefgym.agents.recurrent.memory import MEMORIES, Stack, make_memory
from beliefgym.agents.recurrent.network import HISTORY_KEYS, HistoryEncoder
from beliefgym.agents.recurrent.pqn import RecurrentPQN
from beliefgym.agents.recurrent.q_sarsa import RecurrentQSARSA
from beliefgym.agents.recurrent.r2d2 import R2D2
from beliefgym.agents.recurrent.target_network import target_updater
from beliefgym.wrappers import Task

ENV = "beliefgym/CartPoleBalancePosition-v0"
SIZES = {"hidden_size": 8, "width": 8, "rollout_steps": 16}
REPLAY = {**SIZES, "n_envs": 2, "batch_size": 6, "n_batches": 2, "learning_starts": 60, "capacity": 400}
AGENTS = {
    "DRQN, random": (DRQN, {**REPLAY, "unroll": 5}),
    "DRQN, sequential": (DRQN, {**REPLAY, "updates": "sequential", "double": True}),
    "DRQN, hard target, rewards seen": (DRQN, {**REPLAY, "target_update": 3, "previous_rewards": True}),
    "DQN, stack of 4": (DRQN, {**REPLAY, "cell": "stack4", "unroll": 4, "burn_in": 3}),
    "R2D2": (R2D2, {**REPLAY, "sequence_length": 6, "burn_in": 3, "n_steps": 3}),
    "R2D2, GRU, zero state": (R2D2, {**REPLAY, "zero_state": True, "burn_in": 0, "cell": "gru"}),
    "PQN": (RecurrentPQN, {**SIZES, "n_envs": 3, "epochs": 2, "n_minibatches": 2}),
    "PQN, no memory": (RecurrentPQN, {**SIZES, "n_envs": 3, "n_minibatches": 1, "cell": "none"}),
    "SARSA, stack of 4": (RecurrentQSARSA, {**SIZES, "n_envs": 2, "cell": "stack4", "n_batches": 2}),
}
ROUNDING = {"rtol": 2e-4, "atol": 1e-5}  # of float32 sums of some tens of terms


def trained(kind, options, seed=3, steps=192):
    return kind(ENV, seed, **options).learn(steps)


@cache
def shared(name):
    """The agent of `AGENTS` after a little training, for tests that leave it as it is."""
    return trained(*AGENTS[name])


def predictions(agent, n=3, n_steps=12):
    """Deterministic actions along an episode of an environment, and what is remembered at its end."""
    env = Task(ENV).make_vec(n)
    observation, _ = env.reset(seed=5)
    state, starts, actions = None, None, []
    for _ in range(n_steps):
        if agent.needs_rewards:
            agent.tell_reward(np.ones(n))
        action, state = agent.predict(observation, state, starts, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(action)
        starts = terminated | truncated
        actions.append(action)
    env.close()
    return np.array(actions), state.state.numpy()


def target_of(agent):
    """The target network as a module of its own."""
    network = deepcopy(agent.network)
    with torch.no_grad():
        named = agent.loss.target_value_network_params.flatten_keys(".")
        for name, value in [*network.named_parameters(), *network.named_buffers()]:
            value.copy_(named[name])
    return network


def apart(agent):
    """The agent, its network moved away from the target network until they would choose other actions."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in agent.network.parameters():
            parameter += torch.randn(parameter.shape, generator=generator)
    return agent


def values_along(network, batch, row, n_steps):
    """Q (n_steps + 1, n_actions) along one piece from the state at its start, one step after another."""
    state = batch["recurrent_state"][row, 0][None]
    if batch["is_init"][row, 0]:
        state = torch.zeros_like(state)
    seen = [[batch[key][row, t] for key in HISTORY_KEYS] for t in range(n_steps)]
    seen.append([batch["next", key][row, n_steps - 1] for key in HISTORY_KEYS])
    values = []
    with torch.no_grad():
        for inputs in seen:
            q, _, state = network.values(*(x[None, None] for x in inputs), state)
            values.append(q[0, 0])
    return torch.stack(values)


def loss_by_hand(agent, batch, n_steps, double, burn_in=0):
    """The mean of |Q - y|^2, y of n_steps rewards and the target network's value, over what is after the burn-in."""
    target, gamma, squares = target_of(agent), agent.gamma, []
    for row in range(len(batch)):
        length = int(batch["mask"][row].sum())
        q, later = (values_along(net, batch, row, length) for net in (agent.network, target))
        reward = batch["next", "reward"][row, :, 0].tolist()
        over = bool(batch["next", "terminated"][row, length - 1])
        for t in range(0 if batch["is_init"][row, 0] else burn_in, length):
            end = min(t + n_steps, length)
            best = later[end][q[end].argmax()] if double else later[end].max()
            value = 0.0 if over and end == length else float(best)
            y = sum(gamma**i * reward[t + i] for i in range(end - t)) + gamma ** (end - t) * value
            squares.append((float(q[t][batch["action"][row, t]]) - y) ** 2)
    return np.mean(squares)


# what is learned from


def test_random_updates_begin_anywhere_from_a_zero_state():
    agent = shared("DRQN, random")
    batch = agent.sample()
    assert (batch["recurrent_state"] == 0).all()
    begins = torch.cat([agent.sample()["is_init"][:, 0, 0] for _ in range(50)])
    # two copies for 96 steps each: about one step in 20 is an episode's first
    assert 0 < begins.float().mean() < 0.3
    assert batch.shape == (6, 5)


def test_sequential_updates_go_through_whole_episodes():
    agent = shared("DRQN, sequential")
    newest = agent._collector._observation
    for _ in range(20):
        batch = agent.sample()
        assert batch["is_init"][:, 0].all()
        assert not (batch["is_init"][:, 1:, 0] & batch["mask"][:, 1:]).any()
        last = batch["mask"].sum(1) - 1
        rows = torch.arange(len(batch))
        over = batch["next", "done"][rows, last, 0]
        runs = (batch["next", "observation"][rows, last][:, None] == newest).all(-1).any(-1)
        assert (over | runs).all()


def test_sequences_begin_with_the_state_that_acted():
    """The stored state is that of the network at the time, which differs from today's."""
    kind, options = AGENTS["R2D2"]
    agent = kind(ENV, 3, **options)
    recorded = {}
    improve = agent.improve

    def spy(rollout, progress):
        for x, s in zip(
            rollout["observation"].flatten(0, 1).tolist(),
            rollout["recurrent_state"].flatten(0, 1).tolist(),
            strict=True,
        ):
            recorded[tuple(x)] = s
        return improve(rollout, progress)

    agent.improve = spy
    batch = agent.learn(192).sample()
    inside = ~batch["is_init"][:, 0, 0]
    assert inside.any()
    assert (batch["recurrent_state"][inside, 0] != 0).any(-1).all()
    for x, s in zip(
        batch["observation"][:, 0].tolist(), batch["recurrent_state"][:, 0].tolist(), strict=True
    ):
        assert recorded[tuple(x)] == s


def test_a_zero_state_can_be_had_in_the_stored_ones_place():
    assert (shared("R2D2, GRU, zero state").sample()["recurrent_state"] == 0).all()


# losses


@pytest.mark.parametrize("double", [False, True])
def test_without_memory_and_unrolled_one_step_drqn_is_dqn(double):
    options = {
        **REPLAY,
        "cell": "none",
        "unroll": 1,
        "batch_size": 40,
        "target_update": 1000,
        "double": double,
    }
    agent = apart(trained(DRQN, options))
    batch = agent.sample()
    assert batch.shape == (40, 1)
    step = batch[:, 0]
    nothing = torch.zeros(40, 0)
    target = target_of(agent)
    assert not torch.equal(target.head.layers[1].weight, agent.network.head.layers[1].weight)
    with torch.no_grad():
        now, following = ([tensors[key][:, None] for key in HISTORY_KEYS] for tensors in (step, step["next"]))
        q = agent.network.values(*now, nothing)[0][:, 0].gather(1, step["action"][:, None])[:, 0]
        later = target.values(*following, nothing)[0][:, 0]
        online = agent.network.values(*following, nothing)[0][:, 0]
    assert 0 < (online.argmax(1) != later.argmax(1)).sum() < 40
    best = later.gather(1, online.argmax(1, keepdim=True))[:, 0] if double else later.max(1).values
    going = ~step["next", "terminated"][:, 0]
    by_hand = (q - step["next", "reward"][:, 0] - agent.gamma * going * best).square().mean()
    torch.testing.assert_close(agent.loss(batch)["loss_value"].detach(), by_hand, **ROUNDING)


@pytest.mark.parametrize("name", ["DRQN, random", "DRQN, sequential"])
def test_drqns_loss_is_that_of_single_episodes_one_step_after_another(name):
    agent = apart(trained(*AGENTS[name]))
    batch = agent.sample()
    double = "sequential" in name
    ours = float(agent.loss(batch)["loss_value"].detach())
    assert ours == pytest.approx(loss_by_hand(agent, batch, 1, double), rel=1e-4)
    assert ours != pytest.approx(loss_by_hand(agent, batch, 1, not double), rel=1e-3)


def test_r2d2s_loss_leaves_out_the_burn_in_and_takes_n_rewards():
    agent = apart(trained(*AGENTS["R2D2"]))
    batch = agent.sample()
    assert (batch["mask"].sum(1) < batch.shape[1]).any(), "expected a sequence that an episode's end cuts"
    ours = float(agent.loss(batch)["loss_value"].detach())
    assert ours == pytest.approx(loss_by_hand(agent, batch, 3, double=True, burn_in=3), rel=1e-4)
    assert ours != pytest.approx(loss_by_hand(agent, batch, 3, double=True), rel=1e-3)
    assert ours != pytest.approx(loss_by_hand(agent, batch, 3, double=False, burn_in=3), rel=1e-3)


def test_dqn_on_stacks_learns_from_whole_stacks():
    """Every step after the burn-in is valued as it is with the frames that the episode had."""
    agent = shared("DQN, stack of 4")
    for _ in range(5):
        batch = agent.sample()
        ours = float(agent.loss(batch)["loss_value"].detach())
        assert ours == pytest.approx(loss_by_hand(agent, batch, 1, double=False, burn_in=3), rel=1e-4)
        assert (batch["is_init"][:, 0, 0] | (batch["mask"].sum(1) > 3)).all()


def test_pqns_targets_are_lambda_returns_of_the_largest_values():
    """G_t = r_t + gamma [(1 - lambda) max_a Q(h_{t+1}, a) + lambda G_{t+1}], backwards through single episodes."""
    agent = trained(*AGENTS["PQN"], steps=480)
    rollout = agent._collector.collect(lambda seen: agent._act(seen, 0.5, 0.0), 40)
    gamma, trace, squares = agent.gamma, agent._own["weights"], []
    for row in rollout:
        cuts = [*sorted({0, *row["is_init"][:, 0].nonzero()[:, 0].tolist()}), len(row)]
        for begin, end in pairwise(cuts):
            piece = row[begin:end]
            q = values_along(agent.network, piece[None], 0, end - begin)
            ahead = q.max(1).values
            over = bool(piece["next", "terminated"][-1])
            g = piece["next", "reward"][-1, 0] + gamma * (0.0 if over else ahead[-1])
            for t in range(end - begin - 1, -1, -1):
                if t < end - begin - 1:
                    g = piece["next", "reward"][t, 0] + gamma * ((1 - trace) * ahead[t + 1] + trace * g)
                squares.append(float(q[t][piece["action"][t]] - g) ** 2)
    assert len(squares) == 3 * 40
    assert float(agent.loss(rollout)["loss_value"].detach()) == pytest.approx(np.mean(squares), rel=1e-4)


# target networks


def test_a_soft_target_follows_a_little_and_a_hard_one_at_once():
    agent = DRQN(ENV, **REPLAY)
    weight = agent.network.head.layers[1].weight
    before = weight.detach().clone()

    def target():
        return agent.loss.target_value_network_params["head", "layers", "1", "weight"]

    with torch.no_grad():
        weight += 1.0
    soft = target_updater(agent.loss, 0.25)  # which also sets the target to the network as it is
    with torch.no_grad():
        weight += 1.0
    soft.step()
    torch.testing.assert_close(target(), before + 1.25)
    hard = target_updater(agent.loss, 3)
    with torch.no_grad():
        weight += 1.0
    for step in range(1, 7):
        hard.step()
        torch.testing.assert_close(target(), before + (2.0 if step < 3 else 3.0 if step < 6 else 13.0))
        if step == 3:
            with torch.no_grad():
                weight += 10.0


# stacks


def test_a_stack_is_frames_side_by_side_with_zeros_before_the_start():
    memory = Stack(3, 5, n_frames=4)
    inputs = torch.randn(2, 9, 3)
    hidden, state = memory(inputs, torch.zeros(2, 9))
    padded = torch.cat([torch.zeros(2, 3, 3), inputs], dim=1)
    stacked = torch.stack([padded[:, t : t + 4].reshape(2, 12) for t in range(9)], dim=1)
    expected, _ = memory.layer(stacked, torch.zeros(2, 0))
    torch.testing.assert_close(hidden, expected)
    assert torch.equal(state, inputs[:, -3:].reshape(2, 9))


@pytest.mark.parametrize("cuts", [(1,) * 9, (2, 1, 5, 1), (4, 5)])
@pytest.mark.parametrize("cell", MEMORIES)
def test_an_episode_in_parts_is_the_episode_at_once(cell, cuts):
    memory = make_memory(cell, 3, 5)
    inputs = torch.randn(2, 9, 3)
    whole, last = memory(inputs, torch.zeros(2, memory.state_size))
    state, parts = torch.zeros(2, memory.state_size), []
    for part in inputs.split(cuts, dim=1):
        hidden, state = memory(part, state)
        parts.append(hidden)
    torch.testing.assert_close(torch.cat(parts, dim=1), whole)
    torch.testing.assert_close(state, last)


def test_an_agent_with_a_stack_acts_on_its_last_frames():
    agent = shared("DQN, stack of 4")
    encoder: HistoryEncoder = agent.acting.encoder
    env = Task(ENV).make_vec(2)
    observation, _ = env.reset(seed=1)
    state, starts, frames = None, None, [torch.zeros(2, 8)] * 3
    previous = torch.zeros(2, agent.n_actions)
    for t in range(10):
        seen = encoder.standardised(torch.as_tensor(observation, dtype=torch.float32))
        with torch.no_grad():
            frames.append(encoder.embed(torch.cat([seen, previous], dim=1)))
            hidden, _ = encoder.memory.layer(torch.cat(frames[-4:], dim=1), torch.zeros(2, 0))
            expected = agent.acting.head(hidden).argmax(1).numpy()
        action, state = agent.predict(observation, state, starts, deterministic=True)
        assert np.array_equal(action, expected)
        observation, *_ = env.step(action)
        previous = torch.nn.functional.one_hot(torch.as_tensor(action), agent.n_actions).float()
        starts = np.zeros(2, dtype=bool)
        if t == 5:  # as if another episode began in the first copy
            starts[0] = True
            previous[0] = 0.0
            frames = [torch.cat([torch.zeros(1, 8), frame[1:]]) for frame in frames]
    env.close()


# the agent's face


@pytest.mark.parametrize("name", AGENTS)
def test_it_learns_and_is_saved_and_loaded(name, tmp_path):
    kind, options = AGENTS[name]
    fresh = kind(ENV, 3, **options)
    agent = shared(name)
    assert agent.num_timesteps == 192
    moved = (
        not torch.equal(before, after)
        for before, after in zip(fresh.network.parameters(), agent.network.parameters(), strict=True)
    )
    assert any(moved)
    assert np.isfinite(agent.history[-1]["loss_value"])
    for ours, theirs in zip(agent.acting.parameters(), agent.network.parameters(), strict=True):
        assert torch.equal(ours, theirs) or kind is RecurrentQSARSA  # which acts with an average
    agent.save(tmp_path / "agent")
    loaded = kind.load(tmp_path / "agent")
    assert loaded.options() == agent.options()
    for ours, theirs in zip(predictions(agent), predictions(loaded), strict=True):
        assert np.array_equal(ours, theirs)
    assert loaded.learn(96).num_timesteps == 192 + 96


@pytest.mark.parametrize("name", AGENTS)
def test_the_same_seed_learns_the_same(name):
    first, again, other = (trained(*AGENTS[name], seed=seed, steps=128) for seed in (3, 3, 4))
    for ours, theirs in zip(first.network.parameters(), again.network.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    assert not torch.equal(first.network.encoder.embed[0].weight, other.network.encoder.embed[0].weight)


def test_nothing_is_learned_before_there_is_enough_in_the_replay():
    agent = DRQN(ENV, **{**REPLAY, "learning_starts": 150}).learn(192)
    learned = ["loss_value" in record for record in agent.history]
    assert learned == [False] * 4 + [True] * 2  # 32 steps a rollout


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DRQN(ENV, updates="bootstrapped"), 'updates "random" or "sequential", got \'bootstrapped\''),
        (lambda: DRQN(ENV, updates="sequential", burn_in=3), "begin with an episode: take burn_in=0"),
        (lambda: DRQN(ENV, unroll=0), "unroll, batch_size and n_batches of at least 1"),
        (lambda: DRQN(ENV, target_update=0.0), "a whole number of gradient steps from 1 on"),
        (lambda: R2D2(ENV, target_update=2.5), "got 2.5"),
        (lambda: R2D2(ENV, n_steps=0), "n_steps, batch_size and n_batches of at least 1"),
        (lambda: R2D2(ENV, sequence_length=10, stride=11), "a stride of at most sequence_length=10"),
        (lambda: RecurrentPQN(ENV, n_envs=4, n_minibatches=5), "n_minibatches from 1 to n_envs=4"),
        (lambda: RecurrentPQN(ENV, weights=1.5), r"weights \(lambda\) from 0 to 1"),
        (lambda: DRQN(ENV, cell="stack3"), "stack2, stack4, stack8"),
        (lambda: Stack(3, 5, n_frames=1), "at least 2 frames, got 1"),
        (lambda: DRQN(ENV, **{**REPLAY, "capacity": 20}).learn(32), r"enlarge the capacity \(now 20\)"),
    ],
)
def test_errors_say_what_to_do(make, message):
    with pytest.raises(ValueError, match=message):
        make()
