"""What a recurrent agent begins with when it goes on learning from a file: targets, replay, moments, scale."""

import numpy as np
import pytest
import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from beliefgym.agents.recurrent import DRQN, R2D2, RecurrentPQN, RecurrentQSARSA, RecurrentSAC

BALANCE, PENDULUM = "beliefgym/CartPoleBalancePosition-v0", "beliefgym/PendulumPosition-v0"
SIZES = {"hidden_size": 8, "width": 8, "n_envs": 2, "rollout_steps": 8}
REPLAY = {**SIZES, "batch_size": 4, "n_batches": 2, "learning_starts": 48}
# with learning rates at which networks, averages and targets are well apart
AGENTS = {
    "SARSA": (RecurrentQSARSA, BALANCE, {**SIZES, "reuse": 2, "n_batches": 2, "learning_rate": 0.01}),
    "SARSA, no average": (RecurrentQSARSA, BALANCE, {**SIZES, "reuse": 1, "n_batches": 2, "average": 0.0}),
    "DRQN": (DRQN, BALANCE, {**REPLAY, "unroll": 5, "learning_rate": 0.01}),
    "DRQN, hard target": (DRQN, BALANCE, {**REPLAY, "unroll": 5, "learning_rate": 0.01, "target_update": 3}),
    "R2D2": (R2D2, BALANCE, {**REPLAY, "sequence_length": 6, "burn_in": 2, "learning_rate": 0.01}),
    "PQN": (RecurrentPQN, BALANCE, {**SIZES, "n_minibatches": 2}),
    "SAC": (RecurrentSAC, PENDULUM, {**SIZES, "batch_size": 4, "sequence_length": 8, "learning_starts": 48}),
}
LOSSES = {RecurrentSAC: "loss_critic"}


def named(tensors):
    """Of a tensordict of parameters, "path.to.tensor" -> a copy."""
    return {key: value.detach().clone() for key, value in tensors.flatten_keys(".").items()}


def targets(agent):
    """The target network's tensors; none without one."""
    found = agent._target_params()
    return {} if found is None else named(found)


def saved_as(name, agent):
    """What the file has under a name."""
    tensors = load_tensors(agent.parts()["networks.safetensors"])
    return {
        key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")
    }


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)


@pytest.fixture(params=AGENTS)
def pair(request, tmp_path):
    """An agent that has learned, and the same from its file."""
    kind, env_id, options = AGENTS[request.param]
    agent = kind(env_id, 3, **options).learn(160)
    agent.save(tmp_path / "agent")
    return agent, kind.load(tmp_path / "agent")


def test_targets_are_the_network_that_was_saved_as_averaged_or_acting(pair):
    agent, loaded = pair
    found = targets(loaded)
    if agent._target_params() is None:
        assert not found
        return
    assert same(found, saved_as("averaged" if isinstance(agent, RecurrentSAC) else "acting", agent))
    assert not same(found, targets(type(agent)(agent.task, 3, **agent.options())))
    assert torch.equal(found["encoder.mean"], agent._moments.mean_and_scale()[0])
    # DRQN and R2D2 act with the network that learns, and their targets lag behind it, which a file does not tell
    assert same(found, targets(agent)) is not isinstance(agent, DRQN | R2D2)


def test_the_rest_of_the_file_comes_back_and_the_replay_does_not(pair):
    agent, loaded = pair
    for name in ("network", "acting", "actor", "critic", "averaged", "auxiliary"):
        assert same(saved_as(name, loaded), saved_as(name, agent))
    assert loaded.parts() == agent.parts()
    assert loaded._reward_scale == agent._reward_scale
    assert (loaded.num_timesteps, loaded.history, loaded._collector) == (160, [], None)
    if hasattr(agent, "_replay"):
        assert len(agent._replay) > 0
        assert len(loaded._replay) == 0
    assert getattr(loaded, "_rollouts", []) == []


def test_learning_goes_on_once_the_replay_has_enough(pair):
    agent, loaded = pair
    before, loss = targets(loaded), LOSSES.get(type(loaded), "loss_value")
    seen = []
    loaded.learn(96, callback=lambda *_: seen.append(targets(loaded)))
    assert loaded.num_timesteps == 160 + 96
    starts = loaded.options().get("learning_starts", 0)
    in_replay = np.cumsum([record["steps"] for record in loaded.history])
    learned = [loss in record for record in loaded.history]
    assert learned[-1]
    assert not any(learned[: np.searchsorted(in_replay, starts)])
    assert all(np.isfinite(record[loss]) for record in loaded.history if loss in record)
    # until then targets stay what was saved, but for the moments of observations
    for tensors, has_learned in zip(seen, learned, strict=True):
        held = [torch.equal(tensors[key], before[key]) for key in tensors if "head" in key]
        assert has_learned or all(held)
    assert not before or not all(held)
    assert loaded._reward_scale == agent._reward_scale


def test_weights_of_another_network_are_refused():
    agent = DRQN(BALANCE, **SIZES)
    tensors = load_tensors(agent.parts()["networks.safetensors"])
    name, bias = "network.head.layers.1.bias", torch.zeros(1)
    for change, message in (
        ({name: bias}, rf"expected weights as DRQN has .* {name} of shape \(1,\) in the file, \(8,\) here"),
        ({"network.more": bias}, r"got 1 others: network.more of shape \(1,\) in the file, None here"),
    ):
        with pytest.raises(ValueError, match=message):
            agent.restore({"networks.safetensors": save_tensors({**tensors, **change})})
