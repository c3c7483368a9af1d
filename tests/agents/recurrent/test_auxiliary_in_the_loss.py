"""Auxiliary objectives as the loss calls them: what they are given, where their gradients go, what they weigh.

Double precision: TOLD is some roundings of sums of a few dozen terms of unit size, taken in another order.
"""

import pytest
import torch
from recurrent_cases import gradient, made_up_rollout, pieces_by_loop, policy_by_hand, q_network, values_along
from torch import nn
from torch.testing import assert_close

from beliefgym.agents.recurrent.auxiliary import OBJECTIVES, make_auxiliary
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")  # targets are set by hand here

TOLD = {"rtol": 1e-10, "atol": 1e-11}
each_name = pytest.mark.parametrize("name", OBJECTIVES)


def objective_of(name, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return make_auxiliary(name, 5, 3, 4).double()


class Listener(nn.Module):
    """An objective that keeps what it is given."""

    def forward(self, pieces):
        """0."""
        self.given = pieces
        return pieces.hidden.sum() * 0.0


@pytest.mark.parametrize(("kind", "delayed"), [("semi", False), ("semi", True), ("residual", False)])
def test_objectives_are_given_the_rollouts_own_pieces(kind, delayed):
    network, listener, rollout = q_network("lstm"), Listener(), made_up_rollout()
    loss = RecurrentSarsaLoss(
        network, gamma=0.9, gradient=kind, epsilon=0.3, delay_value=delayed, auxiliary={"listen": listener}
    )
    target = q_network("lstm", seed=3) if delayed else network
    if delayed:
        for key, value in target.state_dict().items():
            loss.target_value_network_params.get(tuple(key.split("."))).data.copy_(value)
    loss(rollout)
    given = listener.given
    pieces = pieces_by_loop(rollout["is_init"][..., 0])
    assert given.mask.sum(1).tolist() == [end - begin for _, begin, end in pieces]
    returns = given.returns()
    assert not returns.requires_grad
    for i, (row, begin, end) in enumerate(pieces):
        n = end - begin
        assert_close(given.hidden[i, : n + 1], values_along(network, rollout, (row, begin, end))[1], **TOLD)
        q, h = values_along(target, rollout, (row, begin, end))
        assert_close(given.target_hidden[i, : n + 1].detach(), h.detach(), **TOLD)
        seen = torch.cat(
            [rollout["observation"][row, begin:end], rollout["next", "observation"][row, [end - 1]]]
        )
        assert_close(given.observation[i, : n + 1], network.encoder.standardised(seen), **TOLD)
        assert torch.equal(given.actions[i, :n], rollout["next", "previous_action"][row, begin:end])
        rewards = rollout["next", "reward"][row, begin:end, 0]
        assert torch.equal(given.rewards[i, :n], rewards)
        over = rollout["next", "terminated"][row, end - 1]
        last = 0.0 if over else (policy_by_hand(q[n].detach(), 0.3, 0.0) @ q[n]).item()
        for t in range(n):
            expected = sum(0.9**j * float(rewards[t + j]) for j in range(n - t)) + 0.9 ** (n - t) * last
            assert float(returns[i, t]) == pytest.approx(expected, rel=1e-10)


@each_name
def test_its_gradient_reaches_the_encoder_and_not_the_head(name):
    network, objective = q_network("lstm"), objective_of(name)
    loss = RecurrentSarsaLoss(network, auxiliary={name: objective})
    loss(made_up_rollout())[f"loss_{name}"].backward()
    for key, parameter in network.encoder.named_parameters():
        assert parameter.grad.abs().max() > 1e-8, key
    assert all(p.grad is None or not p.grad.any() for p in network.head.parameters())
    assert all(p.grad.abs().max() > 1e-8 for p in objective.parameters())


@each_name
def test_weights_multiply_and_nothing_else_changes(name):
    network, rollout = q_network("gru"), made_up_rollout(state_size=5)
    plain = RecurrentSarsaLoss(network)(rollout)
    found = {}
    for weight in (1.0, 0.25):
        loss = RecurrentSarsaLoss(
            network, auxiliary={name: objective_of(name)}, auxiliary_weights={name: weight}
        )
        found[weight] = loss(rollout)
        assert torch.equal(found[weight]["loss_value"], plain["loss_value"])
        assert set(found[weight].keys()) == {*plain.keys(), f"loss_{name}"}
    first, second = (found[weight][f"loss_{name}"] for weight in (1.0, 0.25))
    assert first > 1e-3
    assert_close(second, 0.25 * first, **TOLD)
    assert_close(gradient(second, network), 0.25 * gradient(first, network), **TOLD)


def test_weights_may_be_annealed_to_nothing_which_is_then_not_computed():
    first, second = Listener(), Listener()
    loss = RecurrentSarsaLoss(
        q_network(), auxiliary={"first": first, "second": second}, auxiliary_weights={"first": 0.0}
    )
    assert loss.auxiliary_weights == {"first": 0.0, "second": 1.0}
    rollout = made_up_rollout()
    assert "loss_first" not in set(loss(rollout).keys())
    assert not hasattr(first, "given")
    assert hasattr(second, "given")
    loss.auxiliary_weights = {"first": 0.5, "second": 0.0}
    del second.given
    assert "loss_first" in set(loss(rollout).keys())
    assert not hasattr(second, "given")


def test_latent_self_prediction_pulls_only_at_what_predicts():
    """Its gradient is the one with the next hidden states held as numbers."""
    network, objective, rollout = q_network("lstm"), objective_of("latent_self_prediction"), made_up_rollout()
    for kind in ("semi", "residual"):
        loss = RecurrentSarsaLoss(network, gradient=kind, auxiliary={objective.name: objective})
        found = gradient(loss(rollout)["loss_latent_self_prediction"], network)
        errors = []
        for row, begin, end in pieces_by_loop(rollout["is_init"][..., 0]):
            _, h = values_along(network, rollout, (row, begin, end))
            actions = rollout["next", "previous_action"][row, begin:end]
            predicted = objective.transition(torch.cat([h[:-1], actions], -1))
            errors += (predicted - h[1:].detach()).square().mean(-1)
        expected = gradient(torch.stack(errors).mean(), network)
        assert_close(found, expected, **TOLD)
