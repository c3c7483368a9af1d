"""The loss among TorchRL's own pieces: its recurrent modules, its target updates, its optimiser's view of parameters.

Double precision: TOLD is some roundings of sums of a few dozen terms of unit size, taken in another order.
"""

import copy

import pytest
import torch
from recurrent_cases import gradient, loss_by_loop, made_up_rollout, q_network
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.testing import assert_close
from torchrl.modules import GRUModule, LSTMModule
from torchrl.objectives import HardUpdate, SoftUpdate

from beliefgym.agents.recurrent.auxiliary import make_auxiliary
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss

TOLD = {"rtol": 1e-10, "atol": 1e-11}
OPTIONS = {
    "one step": {"n_steps": 0, "gradient": "residual"},
    "lambda": {"weights": 0.7, "bootstrap": "expected", "epsilon": 0.3},
    "importance": {"weights": 0.7, "bootstrap": "expected", "epsilon": 0.3, "importance": True},
}
each_option = pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)


class Embedded(nn.Module):
    """What the encoder does before its memory."""

    def __init__(self, encoder):
        super().__init__()
        self.embed = encoder.embed
        self.mean, self.scale = encoder.mean, encoder.scale

    def forward(self, observation, previous_action):
        """(.., n) -> (.., width)."""
        x = ((observation - self.mean) / self.scale).clamp(-10.0, 10.0)
        return self.embed(torch.cat([x, previous_action], -1))


def in_torchrls_pieces(network, cell, state="recurrent_state"):
    """The same layers, in a sequence with TorchRL's memory, whose state has this name."""
    seen = TensorDictModule(
        Embedded(network.encoder), in_keys=["observation", "previous_action"], out_keys=["embed"]
    )
    head = TensorDictModule(network.head, in_keys=["hidden"], out_keys=["action_value"])
    layer = network.encoder.memory.layer
    if cell == "gru":
        keys = {"in_keys": ["embed", state, "is_init"], "out_keys": ["hidden", ("next", state)]}
        return TensorDictSequential(seen, GRUModule(gru=layer, **keys), head)
    names = [f"{state}_h", f"{state}_c"]
    keys = {
        "in_keys": ["embed", *names, "is_init"],
        "out_keys": ["hidden", *[("next", name) for name in names]],
    }
    return TensorDictSequential(seen, LSTMModule(lstm=layer, **keys), head)


def rollout_for(cell):
    """One rollout for both: TorchRL's states have an axis for layers."""
    rollout = made_up_rollout(state_size=10 if cell == "lstm" else 5)
    other = rollout.clone()
    state = other.pop("recurrent_state")[..., None, :]
    if cell == "gru":
        return rollout, other.set("recurrent_state", state)
    return rollout, other.update({"recurrent_state_h": state[..., :5], "recurrent_state_c": state[..., 5:]})


@pytest.mark.parametrize("cell", ["gru", "lstm"])
@each_option
def test_a_sequence_with_torchrls_memory_gives_the_same_loss(cell, options):
    network = q_network(cell)
    ours, theirs = rollout_for(cell)
    copied = copy.deepcopy(network)
    expected = RecurrentSarsaLoss(network, gamma=0.9, **options)(ours)["loss_value"]
    found = RecurrentSarsaLoss(in_torchrls_pieces(copied, cell), gamma=0.9, **options)(theirs)["loss_value"]
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, copied), gradient(expected, network), **TOLD)


def test_a_state_may_have_another_name():
    network = q_network("gru")
    ours, theirs = rollout_for("gru")
    expected = RecurrentSarsaLoss(network)(ours)["loss_value"]
    loss = RecurrentSarsaLoss(in_torchrls_pieces(network, "gru", state="memory"))
    loss.set_keys(recurrent_state="memory")
    found = loss(theirs.rename_key_("recurrent_state", "memory"))["loss_value"]
    assert_close(found, expected, **TOLD)
    theirs["memory"] += 1.0
    assert abs(loss(theirs)["loss_value"] - found) > 1e-3


@pytest.mark.parametrize("bootstrap", ["taken", "expected", "max", "double"])
@pytest.mark.parametrize("updater", ["soft", "hard"])
def test_targets_come_from_parameters_that_torchrls_updates_move(bootstrap, updater):
    network, target = q_network("lstm"), q_network("lstm")
    loss = RecurrentSarsaLoss(network, gamma=0.9, bootstrap=bootstrap, epsilon=0.2, delay_value=True)
    update = (
        SoftUpdate(loss, eps=0.75) if updater == "soft" else HardUpdate(loss, value_network_update_interval=2)
    )
    rollout = made_up_rollout()
    options = {"gamma": 0.9, "weights": 0.9, "bootstrap": bootstrap, "epsilon": 0.2, "n_steps": None}
    generator = torch.Generator().manual_seed(0)
    values = []
    for i in range(3):  # the hard update comes after two steps without
        with torch.no_grad():
            for ours, theirs in zip(network.parameters(), target.parameters(), strict=True):
                ours += 0.3 * torch.randn(ours.shape, dtype=ours.dtype, generator=generator)
                if updater == "soft":
                    theirs.lerp_(ours, 0.25)
                elif i == 2:
                    theirs.copy_(ours)
        update.step()
        found = loss(rollout)["loss_value"]
        expected = loss_by_loop(network, rollout, target=target, **options)
        assert_close(found, expected, **TOLD)
        assert_close(gradient(found, network), gradient(expected, network), **TOLD)
        values.append(found.item())
    assert len(set(values)) == 3


def test_what_an_optimiser_is_given_is_the_network_and_the_objectives_but_no_target():
    network = q_network("gru")
    objectives = {"predictive_rewards": make_auxiliary("predictive_rewards", 5, 3, 4).double()}
    loss = RecurrentSarsaLoss(network, delay_value=True, auxiliary=objectives)
    SoftUpdate(loss, eps=0.9)
    expected = {id(p) for module in (network, *objectives.values()) for p in module.parameters()}
    assert {id(p) for p in loss.parameters()} == expected
    assert not any(p.requires_grad for p in loss.target_value_network_params.values(True, True))
    rollout = made_up_rollout(state_size=5)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    before = {key: value.clone() for key, value in network.state_dict().items()}
    first = None
    for _ in range(20):
        answer = loss(rollout)
        total = answer["loss_value"] + answer["loss_predictive_rewards"]
        first = first or total.item()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    assert total.item() < 0.9 * first
    moved = [key for key, value in network.state_dict().items() if not torch.equal(value, before[key])]
    assert set(before) - set(moved) == {"encoder.mean", "encoder.scale"}
    target = loss.target_value_network_params
    assert all(torch.equal(target.get(tuple(key.split("."))), value) for key, value in before.items())


def test_a_state_dict_holds_network_and_targets():
    losses = [RecurrentSarsaLoss(q_network("gru", seed=seed), delay_value=True) for seed in (0, 1)]
    for loss in losses:
        SoftUpdate(loss, eps=0.9)
    losses[1].load_state_dict(losses[0].state_dict())
    rollout = made_up_rollout(state_size=5)
    first, second = (loss(rollout)["loss_value"] for loss in losses)
    assert_close(first, second, rtol=0, atol=0)


def test_rollouts_are_left_as_they_were():
    rollout = made_up_rollout()
    before = rollout.clone()
    RecurrentSarsaLoss(q_network())(rollout)
    assert set(rollout.keys(True, True)) == set(before.keys(True, True))
    assert (rollout == before).all()
