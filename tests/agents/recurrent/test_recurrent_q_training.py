"""How `RecurrentQSARSA` trains: what it records, scales, averages, keeps, anneals."""

import copy

import numpy as np
import pytest
import torch
from recurrent_agents import BALANCE, SMALL, Watched, watched
from recurrent_cases import Scripted

from beliefgym.agents.recurrent.network import HISTORY_KEYS


@torch.no_grad()
def along(network, rollout, row, begin, end):
    """The state (1, state_size) of a network after steps of one row from an episode's start."""
    inputs = (rollout[key][row, begin:end][None] for key in HISTORY_KEYS)
    return network.values(*inputs, torch.zeros(1, network.state_size))[2]


def test_the_same_seed_gives_the_same_agent_and_no_other_randomness_is_touched():
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first, second, other = (watched(seed=seed) for seed in (3, 3, 4))
    assert torch.equal(torch.get_rng_state(), torch_state)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    for key, value in first.acting.state_dict().items():
        assert torch.equal(second.acting.state_dict()[key], value), key
    assert first.history == second.history
    weight = "encoder.embed.0.weight"
    assert not torch.equal(first.network.state_dict()[weight], other.network.state_dict()[weight])


@pytest.mark.parametrize("reward_scale", ["auto", 0.25])
@pytest.mark.parametrize("previous_rewards", [False, True])
def test_rewards_are_recorded_in_one_scale_from_the_first_rollout_on(
    scripted, reward_scale, previous_rewards
):
    """1 + 0.1 t in the first episode, and 1 more in each that follows; two copies do the same."""
    agent = watched(scripted, reward_scale=reward_scale, previous_rewards=previous_rewards)
    rollout = torch.cat(agent.rollouts, dim=1)
    env, raw = Scripted(lengths=(5, 12, 9)), []
    env.reset()
    for _ in range(rollout.shape[1]):
        _, reward, terminated, truncated, _ = env.step(0)
        raw.append(reward)
        if terminated or truncated:
            env.reset()
    scale = 0.25
    if reward_scale == "auto":
        scale = np.sqrt(1 - agent.gamma**2) / np.sqrt(np.mean(np.square(raw[:8])))
    assert agent._reward_scale == pytest.approx(scale, rel=1e-6)  # of single precision
    raw = np.array(raw)
    for row in range(2):
        told = {"rtol": 1e-5, "err_msg": f"copy {row}"}  # single precision
        np.testing.assert_allclose(rollout["next", "reward"][row, :, 0], scale * raw, **told)
        np.testing.assert_allclose(rollout["next", "previous_reward"][row, :, 0], scale * raw, **told)
        previous = np.where(rollout["is_init"][row, :, 0], 0.0, scale * np.concatenate([[0.0], raw[:-1]]))
        np.testing.assert_allclose(rollout["previous_reward"][row, :, 0], previous, **told)


@pytest.mark.parametrize("previous_rewards", [False, True])
def test_states_are_those_of_the_acting_network_over_running_episodes(scripted, previous_rewards):
    """Whatever it was when they began; from the second rollout on, when rewards have their scale."""
    agent = watched(scripted, steps=128, previous_rewards=previous_rewards, learning_rate=0.05)
    rollout = torch.cat(agent.rollouts, dim=1)
    crossed = 0
    for i in range(1, 8):
        for row in range(2):
            begin = max(t for t in range(8 * i + 1) if rollout["is_init"][row, t])
            state = torch.zeros(1, agent.network.state_size)
            if begin < 8 * i:
                state = along(agent.actors[i], rollout, row, begin, 8 * i)
                crossed += 1
            found = rollout["recurrent_state"][row, 8 * i]
            # single precision, over at most 12 steps
            torch.testing.assert_close(found, state[0], rtol=0, atol=1e-5)
    assert crossed > 6
    assert max(record["state_drift"] for record in agent.history[1:]) > 1e-3


def test_states_that_kept_rollouts_begin_with_are_those_of_the_acting_network_too(scripted):
    """As far as an episode began within what is kept, over rollouts that lie within one episode too."""
    agent = watched(scripted, steps=88, rollout_steps=4, reuse=8, learning_rate=0.05)
    kept, network = torch.cat(agent.rollouts[-8:], dim=1), agent.learners[-1]
    assert not all(kept["is_init"][0, 4 * i : 4 * i + 4].any() for i in range(8))
    checked = 0
    for i in range(1, 8):
        for row in range(2):
            begins = [t for t in range(4 * i + 1) if kept["is_init"][row, t]]
            if not begins:
                continue
            expected = torch.zeros(1, agent.network.state_size)
            if begins[-1] < 4 * i:
                expected = along(network, kept, row, begins[-1], 4 * i)
                checked += 1
            found = agent._rollouts[i]["recurrent_state"][row, 0]
            torch.testing.assert_close(found, expected[0], rtol=0, atol=1e-5)  # single precision
    assert checked > 6
    assert agent.history[-1]["kept_state_drift"] > 1e-3


def test_states_are_refreshed_as_far_as_asked(scripted):
    keys = {"all": {"state_drift", "kept_state_drift"}, "running": {"state_drift"}, "none": set()}
    for refresh, expected in keys.items():
        agent = watched(scripted, steps=48, refresh=refresh)
        assert {key for key in agent.history[-1] if key.endswith("state_drift")} == expected
        carried = torch.equal(agent._rollouts[-1]["recurrent_state"], agent.rollouts[-1]["recurrent_state"])
        assert carried or refresh == "all"
    with pytest.raises(ValueError, match="""expected refresh "all", "running" or "none", got 'some'"""):
        watched(scripted, refresh="some")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"reuse": 3, "reuse_reach": None}, [1, 2, 3, 3, 3, 3]),
        ({"reuse": 5, "reuse_reach": 0.5}, [1, 2, 2, 2, 2, 3]),  # half of 6
        ({"reuse": 2, "reuse_reach": 0.9}, [1, 2, 2, 2, 2, 2]),
        ({"reuse": 1, "reuse_reach": 0.5}, [1, 1, 1, 1, 1, 1]),
    ],
    ids=str,
)
def test_rollouts_kept_are_a_share_of_all_so_far_and_at_least_a_few(options, expected, monkeypatch):
    monkeypatch.setattr("beliefgym.agents.recurrent.q_sarsa.YOUNG_REUSE", 2)
    agent, kept = watched(steps=16, **options), []
    for _ in range(6):
        kept.append(len(agent._rollouts))
        agent.learn(16)
    assert kept == expected
    newest = agent.rollouts[-1]
    assert torch.equal(agent._rollouts[-1]["observation"], newest["observation"])


def test_moments_are_those_of_the_first_observations_in_every_network():
    agent = watched()  # ten rollouts, of which two begin within the first 15 %
    seen = torch.cat([r["observation"].flatten(0, 1) for r in agent.rollouts[:2]]).double().numpy()
    assert len(agent.rollouts) == 10
    for moments in (agent.network.encoder, agent.acting.encoder):
        np.testing.assert_allclose(moments.mean, seen.mean(0), rtol=1e-5)  # single precision
        np.testing.assert_allclose(moments.scale, seen.std(0), rtol=1e-5)
    target = agent.loss.target_value_network_params["encoder"]
    assert torch.equal(target["mean"], agent.network.encoder.mean)
    assert torch.equal(target["scale"], agent.network.encoder.scale)


def test_moments_of_a_further_training_join_those_of_the_first():
    agent = watched(steps=16)
    seen = [agent.rollouts[0]]
    agent.learn(160)
    seen += agent.rollouts[1:3]
    rows = torch.cat([r["observation"].flatten(0, 1) for r in seen]).double().numpy()
    np.testing.assert_allclose(agent.acting.encoder.mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(agent.acting.encoder.scale, rows.std(0), rtol=1e-5)


def test_the_acting_network_is_the_running_average_of_the_fitted_ones():
    agent = Watched(
        BALANCE, 0, **{**SMALL, "average": 0.75, "average_reach": None, "reuse": 1, "n_batches": 1}
    )
    average = {key: value.clone() for key, value in agent.network.named_parameters()}
    for _ in range(4):
        agent.learn(16)
        for key, value in agent.network.named_parameters():
            average[key] = 0.75 * average[key] + 0.25 * value.detach()
            found = dict(agent.acting.named_parameters())[key]
            torch.testing.assert_close(found, average[key], rtol=1e-5, atol=1e-6)  # single precision
    assert not torch.equal(agent.acting.head.layers[1].weight, agent.network.head.layers[1].weight)


def test_without_an_average_the_network_itself_acts():
    agent = watched(average=0.0)
    for key, value in agent.network.state_dict().items():
        assert torch.equal(agent.acting.state_dict()[key], value), key
    assert agent.acting.head.layers[1].weight.data_ptr() != agent.network.head.layers[1].weight.data_ptr()


@pytest.mark.parametrize("reuse", [1, 2, 4])
@pytest.mark.parametrize("n_batches", [1, 3])
def test_every_row_that_is_kept_is_learned_from_once_after_each_rollout(reuse, n_batches):
    agent = watched(steps=96, reuse=reuse, n_batches=n_batches)
    for i, batches in enumerate(agent.batches):
        kept = torch.cat(agent.rollouts[max(0, i + 1 - reuse) : i + 1])
        assert len(batches) == min(n_batches, len(kept))
        rows = torch.cat(batches)

        def fingerprints(x):
            return sorted(tuple(row.flatten().tolist()) for row in x["observation"])

        assert fingerprints(rows) == fingerprints(kept)


def test_exploration_learning_rate_and_objectives_are_annealed():
    agent = watched(
        steps=160,
        epsilon=(0.9, 0.1, 0.5),
        learning_rate="linear:1e-3",
        auxiliary={
            "predictive_rewards": {"weight": "linear:0.5", "k": 3, "on_hidden": True},
            "predictive_state": {"weight": 0.2, "k": 2},
            "dynamics": {},
        },
    )
    for i, (epsilon, rate, weights) in enumerate(agent.seen):
        progress = i / 10
        assert epsilon == pytest.approx(max(0.9 - 1.6 * progress, 0.1))
        assert rate == pytest.approx(1e-3 * (1 - progress))
        expected = {"predictive_rewards": 0.5 * (1 - progress), "predictive_state": 0.2, "dynamics": 1.0}
        assert weights == pytest.approx(expected)
    assert {"loss_predictive_rewards", "loss_predictive_state", "loss_dynamics"} < set(agent.history[0])


def test_probabilities_and_the_policy_learned_about_are_those_of_the_rollout():
    agent = watched(epsilon=(0.5, 0.5, 1.0), temperature=0.3)
    assert (agent.loss.epsilon, agent.loss.temperature) == (0.5, 0.3)
    probability = torch.cat(agent.rollouts, dim=1)["action_probability"]
    assert (probability >= 0.25).all()
    assert (probability <= 0.75).all()
    assert agent.loss.importance


@pytest.mark.parametrize(
    "options",
    [
        # the proposal to the letter
        {
            "average": 0.0,
            "temperature": 0.0,
            "reuse": 1,
            "bootstrap": "taken",
            "gradient": "residual",
            "n_steps": 3,
        },
        {"average": 0.0, "temperature": 0.0, "reuse": 1, "bootstrap": "taken", "gradient": "residual"},
        {"reuse": 1, "bootstrap": "double"},
        {"reuse": 1, "bootstrap": "max", "n_steps": 4, "weights": [0.0, 1.0, 0.0, 0.0, 1.0]},
        {"cell": "none", "previous_actions": False},
        {
            "auxiliary": {
                name: {"weight": 0.1} for name in ("dynamics", "latent_self_prediction", "predictive_values")
            }
        },
    ],
    ids=str,
)
def test_every_form_trains_and_tells_of_it(options):
    agent = Watched(BALANCE, 0, **{**SMALL, **options})
    before = copy.deepcopy(agent.acting.state_dict())
    agent.learn(96)
    assert all(np.isfinite(record["loss_value"]) for record in agent.history)
    assert [record["num_timesteps"] for record in agent.history] == [16 * (i + 1) for i in range(6)]
    for record in agent.history:
        assert record["lengths"] == record["returns"]  # 1 for each step
    assert any(not torch.equal(value, before[key]) for key, value in agent.acting.state_dict().items())


def test_training_gives_no_warnings(recwarn):
    torch.set_warn_always(True)  # PyTorch tells some once a process
    try:
        watched(steps=32)
    finally:
        torch.set_warn_always(False)
    assert [str(w.message) for w in recwarn] == []
