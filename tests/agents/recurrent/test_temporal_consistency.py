"""What is recorded, and that states recomputed from it are those in which the network acted (Sec. 4.3.1).

Single precision, and a batch's sums are taken in another order than a row's: TOLD is some roundings of numbers of unit
size, which a memory carries on.
"""

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from recurrent_cases import Scripted, q_network

from beliefgym.agents.recurrent.collector import Acted, RolloutCollector
from beliefgym.wrappers.task import Task

TOLD = {"rtol": 0, "atol": 2e-5}
BALANCE = Task("beliefgym/CartPoleBalancePosition-v0")  # falls after about 20 steps of random pushes
LENGTHS = ((1, 3, 1, 1, 2), (70, 4), (5, 150), (2,))
each_cell = pytest.mark.parametrize("cell", ["lstm", "gru", "none", "stack4"])
each_memory = pytest.mark.parametrize("cell", ["lstm", "gru", "stack4"])


def scripted(n=4):
    makers = [lambda i=i: Scripted(i, LENGTHS[i % len(LENGTHS)]) for i in range(n)]
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)


class Acting:
    """Acts with a network by chance, and keeps what it thought at each step."""

    def __init__(self, network, seed=0):
        self.network, self.values, self.states = network, [], []
        self.random = torch.Generator().manual_seed(seed)

    @torch.no_grad()
    def __call__(self, seen):
        values, _, state = self.network.values(*(x[:, None] for x in seen[:3]), seen.state)
        self.values.append(values[:, 0])
        self.states.append(state)
        action = torch.multinomial(torch.softmax(values[:, 0], -1), 1, generator=self.random)
        return Acted(action[:, 0], torch.softmax(values[:, 0], -1).gather(1, action)[:, 0], state)


def small(cell, env, **more):
    return q_network(
        cell,
        env.single_observation_space.shape[0],
        int(env.single_action_space.n),
        dtype=torch.float32,
        **more,
    )


def episodes(rollout):
    """(row, steps) of all episodes in it, those that it cuts too."""
    found = []
    for row, begins in enumerate(rollout["is_init"][..., 0].tolist()):
        for t, fresh in enumerate(begins):
            if fresh:
                found.append((row, []))
            found[-1][1].append(t)
    return found


def whole(network, rollout, row, steps):
    """Q and the last state, from the episode's start, in one run over it alone."""
    keys = ("observation", "previous_action", "previous_reward")
    with torch.no_grad():
        q, _, state = network.values(
            *(rollout[key][row, steps][None] for key in keys), torch.zeros(1, network.state_size)
        )
    return q[0], state[0]


@each_cell
@pytest.mark.parametrize("env", [BALANCE.make_vec(4), scripted()], ids=["cart-pole", "scripted"])
def test_a_network_over_stored_episodes_thinks_what_it_thought_when_acting(cell, env):
    network = small(cell, env, rewards=True)
    acting = Acting(network)
    collector = RolloutCollector(env, network.state_size, seed=3)
    rollout = torch.cat([collector.collect(acting, n) for n in (17, 40, 23)], dim=1)
    values, states = torch.stack(acting.values, 1), torch.stack(acting.states, 1)
    found = episodes(rollout)
    assert len(found) > 8
    for row, steps in found:
        q, state = whole(network, rollout, row, steps)
        torch.testing.assert_close(values[row, steps], q, **TOLD)
        torch.testing.assert_close(states[row, steps[-1]], state, **TOLD)
        # the state before each step is the one after the last
        assert torch.equal(rollout["recurrent_state"][row, steps[1:]], states[row, steps[:-1]])
        assert (rollout["recurrent_state"][row, steps[0]] == 0.0).all()


@each_memory
@pytest.mark.parametrize("n_steps", [1, 2, 6, 75, 141])
def test_refreshed_states_are_those_of_the_network_over_each_running_episode(cell, n_steps):
    """Episodes of different lengths, some just begun, some longer than what is first reserved."""
    env = scripted()
    network = small(cell, env, rewards=True)
    collector = RolloutCollector(env, network.state_size, seed=0)
    acting = Acting(network)
    rollout = torch.cat([collector.collect(acting, n) for n in (1, n_steps)], dim=1)
    other = small(cell, env, seed=1, rewards=True)
    drift = collector.refresh(other.encoder)
    refreshed = collector.collect(Acting(other), 1)["recurrent_state"][:, 0]
    carried = torch.stack(acting.states, 1)[:, -1] * ~rollout["next", "done"][:, -1]
    expected = torch.zeros_like(refreshed)
    for row, steps in episodes(rollout):
        if steps[-1] == n_steps and not rollout["next", "done"][row, -1]:
            expected[row] = whole(other, rollout, row, steps)[1]
    torch.testing.assert_close(refreshed, expected, **TOLD)
    away = (carried - expected).norm() / expected.norm()
    assert drift == pytest.approx(float(away), abs=1e-4)  # as above, in a norm
    assert drift > 0.1


@each_cell
def test_nothing_drifts_where_nothing_has_changed(cell):
    env = BALANCE.make_vec(4)
    network = small(cell, env)
    collector = RolloutCollector(env, network.state_size, seed=0)
    assert collector.refresh(network.encoder) == 0.0  # nothing has been seen yet
    for _ in range(3):
        collector.collect(Acting(network), 11)
        assert collector.refresh(network.encoder) < 1e-5  # roundings


@each_memory
def test_refreshing_makes_a_changed_network_consistent_over_episodes_it_did_not_begin(cell):
    away = {}
    for refresh in (True, False):
        env = scripted()
        networks = [small(cell, env, seed=seed) for seed in range(3)]
        collector = RolloutCollector(env, networks[0].state_size, seed=0)
        parts, values = [], []
        for network in networks:
            if refresh:
                collector.refresh(network.encoder)
            acting = Acting(network)
            parts.append(collector.collect(acting, 9))
            values.append(torch.stack(acting.values, 1))
        rollout = torch.cat(parts, dim=1)
        away[refresh] = 0.0
        for row, steps in episodes(rollout):
            last = [t for t in steps if t >= 18]
            q, _ = whole(networks[-1], rollout, row, steps)
            difference = (values[-1][row, [t - 18 for t in last]] - q[[steps.index(t) for t in last]]).abs()
            away[refresh] = max([away[refresh], *difference.flatten().tolist()])
    assert away[True] < TOLD["atol"]
    assert away[False] > 1e-3


def test_what_is_recorded_is_what_was_seen_and_done():
    """Against the script that the environments follow, over ends by themselves and cuts."""
    env = scripted()
    collector = RolloutCollector(env, 0, seed=0)
    collector.reward_scale = 0.5
    collected, finished = [], []
    for n in (3, 10, 90):
        collected.append(collector.collect(Acting(small("none", env)), n))
        finished += collector.finished
    rollout = torch.cat(collected, dim=1)
    expected_finished = []
    for row in range(4):
        episode, t, total, previous = 0, 0, 0.0, None
        for i in range(rollout.shape[1]):
            step, after = rollout[row, i], rollout["next"][row, i]
            length = LENGTHS[row][episode % len(LENGTHS[row])]
            over, cut = t + 1 == length, episode % 2 == 0
            reward = episode + 0.1 * (t + 1)
            total += reward
            assert step["observation"].numpy() == pytest.approx([row, 0.3 * episode, 0.2 * t])
            assert after["observation"].numpy() == pytest.approx([row, 0.3 * episode, 0.2 * (t + 1)])
            assert after["reward"].item() == pytest.approx(0.5 * reward)
            flags = [after[key].item() for key in ("done", "terminated", "truncated")]
            assert flags == [over, over and not cut, over and cut]
            assert step["is_init"].item() == (t == 0)
            taken = np.eye(4)[step["action"].item()]
            assert after["previous_action"].tolist() == taken.tolist()
            assert after["previous_reward"].item() == after["reward"].item()
            told = [[0.0] * 4, 0.0] if t == 0 else previous
            assert [step["previous_action"].tolist(), step["previous_reward"].item()] == told
            previous = [taken.tolist(), after["reward"].item()]
            t += 1
            if over:
                expected_finished.append((total, t))
                episode, t, total = episode + 1, 0, 0.0
    np.testing.assert_allclose(sorted(finished), sorted(expected_finished), rtol=1e-12)


def test_recorded_observations_are_those_of_the_same_actions_again():
    """In the native vector environment, whose last observations come from elsewhere."""
    env = BALANCE.make_vec(3)
    rollout = RolloutCollector(env, 10, seed=5).collect(Acting(small("lstm", env)), 60)
    assert rollout["next", "done"].sum() > 2
    again = BALANCE.make_vec(3)
    observation, _ = again.reset(seed=5)
    for t in range(60):
        assert np.array_equal(rollout["observation"][:, t].numpy(), observation.astype(np.float32))
        observation, reward, terminated, truncated, infos = again.step(rollout["action"][:, t].numpy())
        done = terminated | truncated
        following = observation.copy()
        for i in np.flatnonzero(done):
            following[i] = infos["final_obs"][i]
        assert np.array_equal(rollout["next", "observation"][:, t].numpy(), following.astype(np.float32))
        assert np.array_equal(rollout["next", "reward"][:, t, 0].numpy(), reward.astype(np.float32))
        assert np.array_equal(rollout["next", "done"][:, t, 0].numpy(), done)


def test_the_probability_recorded_is_that_of_the_action_taken():
    env = BALANCE.make_vec(3)
    acting = Acting(small("gru", env))
    rollout = RolloutCollector(env, 5, seed=0).collect(acting, 30)
    policy = torch.softmax(torch.stack(acting.values, 1), -1)
    expected = policy.gather(-1, rollout["action"][..., None])[..., 0]
    assert torch.equal(rollout["action_probability"], expected)
