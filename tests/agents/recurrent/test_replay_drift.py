"""How far the hidden states that a replay's updates learn from are off."""

import pytest
import torch

from beliefgym.agents.recurrent import DRQN, R2D2
from beliefgym.agents.recurrent.network import HISTORY_KEYS
from beliefgym.agents.recurrent.replay_drift import replay_drift

TASK = "beliefgym/CartPoleBalancePosition-v0"


@pytest.fixture
def filled(monkeypatch):
    """An agent whose replay was filled by the network that it still has, moments of observations included."""
    monkeypatch.setattr("beliefgym.agents.recurrent.recurrent_agent.MOMENTS_SHARE", -1.0)
    return R2D2(TASK, seed=0, learning_starts=10_000).learn(2_000)


def drift(agent, **options):
    return replay_drift(
        agent.network.encoder, agent._replay, torch.Generator().manual_seed(1), length=5, **options
    )


def test_states_of_the_same_network_are_right_and_zeros_are_not(filled):
    assert drift(filled, stored=True) < 1e-4
    assert drift(filled, burn_in=1000) < 1e-6  # from every episode's start
    assert drift(filled) > 0.05
    assert drift(filled, burn_in=3) < drift(filled)


def test_it_is_what_single_episodes_add_up_to(filled):
    generator = torch.Generator().manual_seed(1)
    encoder = filled.network.encoder
    episodes = filled._replay.episodes(16, generator)
    lengths = episodes["mask"].sum(1)
    steps = (torch.rand(16, generator=generator) * lengths).long()
    error = size = 0.0
    with torch.no_grad():
        for episode, length, step in zip(episodes, lengths.tolist(), steps.tolist(), strict=True):
            seen = [episode[key][None, :length] for key in HISTORY_KEYS]
            zero = torch.zeros(1, encoder.memory.state_size)
            true, _ = encoder(*seen, zero)
            begin = max(step - 2, 0)
            window, _ = encoder(*(x[:, begin : step + 5] for x in seen), zero)
            error += float((window[:, step - begin :] - true[:, step : step + 5]).square().sum())
            size += float(true[:, step : step + 5].square().sum())
    assert drift(filled, burn_in=2) == pytest.approx((error / size) ** 0.5, rel=1e-4)


@pytest.mark.parametrize(
    ("agent", "options", "told"),
    [(DRQN, {}, True), (DRQN, {"updates": "sequential"}, False), (R2D2, {"zero_state": True}, True)],
)
def test_the_history_tells_it_and_training_goes_on_as_before(agent, options, told, monkeypatch):
    trained = agent(TASK, seed=0, learning_starts=256, **options).learn(1_024)
    found = [one["kept_state_drift"] for one in trained.history if "kept_state_drift" in one]
    assert bool(found) == told
    assert all(0.0 <= value < 2.0 for value in found)
    monkeypatch.setattr(f"{agent.__module__}.replay_drift", lambda *_, **__: 0.0)
    silent = agent(TASK, seed=0, learning_starts=256, **options).learn(1_024)
    for a, b in zip(trained.network.parameters(), silent.network.parameters(), strict=True):
        assert torch.equal(a, b)
