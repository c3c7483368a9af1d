"""Networks of a loss that hold their parameters: always those of the loss, whatever is done to it."""

import copy
import pickle

import pytest
import torch
from recurrent_cases import made_up_rollout, q_network
from torchrl.objectives import SoftUpdate

from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss
from beliefgym.agents.recurrent.target_network import AveragedParams

BATCH = made_up_rollout()


def new_loss(seed=0):
    loss = RecurrentSarsaLoss(q_network(seed=seed), bootstrap="expected", weights=0.8, delay_value=True)
    AveragedParams(loss, "value_network", 0.9)  # or TorchRL warns that nothing moves the target
    shift(loss, seed)
    return loss


def shift(loss, seed, names=("value_network_params", "target_value_network_params")):
    """Every tensor of both sets of parameters is moved in place."""
    generator = torch.Generator().manual_seed(seed + 10)
    with torch.no_grad():
        for name in names:
            for value in getattr(loss, name).values(True, True):
                value.data += 0.1 * torch.rand(value.shape, generator=generator, dtype=torch.float64)


def result(loss, batch=BATCH):
    answer = loss(batch)
    params = [p for p in loss.parameters() if p.requires_grad]
    gradients = torch.autograd.grad(answer["loss_value"], params, allow_unused=True)
    return torch.stack([answer["loss_value"].detach(), *(g.square().sum() for g in gradients)])


def fresh(loss):
    """What a loss that never ran gives with the same numbers in it."""
    other = new_loss(seed=99)
    for name in ("value_network_params", "target_value_network_params"):
        for key, value in getattr(other, name).items(True, True):
            value.data.copy_(getattr(loss, name).get(key).data)
    return result(other)


def stepped(loss):
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    loss(BATCH)["loss_value"].backward()
    optimizer.step()
    optimizer.zero_grad()
    return loss


def moved(loss):
    shift(loss, 5)
    return loss


def loaded(loss):
    loss.load_state_dict(new_loss(seed=7).state_dict())
    return loss


CHANGES = {
    "a gradient step": stepped,
    "numbers changed in place": moved,
    "loaded": loaded,
    "to single precision and back": lambda loss: loss.float().double(),
    "deepcopy, then changed": lambda loss: moved(copy.deepcopy(loss)),
    "pickle, then changed": lambda loss: moved(pickle.loads(pickle.dumps(loss))),
}


@pytest.mark.parametrize("change", CHANGES)
def test_networks_hold_the_parameters_of_the_loss_after(change):
    loss = new_loss()
    before = result(loss)  # its networks hold their parameters from here on
    changed = CHANGES[change](loss)
    assert torch.allclose(result(changed), fresh(changed), rtol=1e-10)
    assert not torch.equal(result(changed), before)


def test_a_copy_shares_nothing_with_what_it_was_copied_from():
    loss = new_loss()
    before = result(loss)
    shift(copy.deepcopy(loss), 3)
    assert torch.equal(result(loss), before)


def test_the_network_given_is_the_one_that_learns():
    loss = new_loss()
    network = loss.value_network
    target = [value.clone() for value in loss.target_value_network_params.values(True, True)]
    before = [value.clone() for value in network.parameters()]
    stepped(loss)
    assert all(
        not torch.equal(a, b) for a, b in zip(before, network.parameters(), strict=True) if a.numel() > 4
    )
    now = loss.target_value_network_params.values(True, True)
    assert all(torch.equal(a, b) for a, b in zip(target, now, strict=True))


def test_parameters_are_listed_once():
    loss = new_loss()
    n = len(list(loss.parameters()))
    state = set(loss.state_dict())
    result(loss)
    assert len(list(loss.parameters())) == n == len(list(q_network().parameters()))
    assert set(loss.state_dict()) == state


@pytest.mark.parametrize("eps", [0.0, 0.6, 0.99])
def test_the_average_moves_as_torchrl_moves_it(eps):
    ours, theirs = new_loss(), new_loss()
    average = AveragedParams(ours, "value_network", eps)
    soft = SoftUpdate(theirs, eps=eps) if eps else None
    for seed in range(3):
        for loss in (ours, theirs):
            shift(loss, seed, names=("value_network_params",))
        average.step()
        if soft is not None:
            soft.step()
    for key, value in ours.target_value_network_params.items(True, True):
        if not ours.value_network_params.get(key).requires_grad:  # moments of observations stay
            assert not torch.equal(value, ours.value_network_params.get(key)), key
    expected = theirs.target_value_network_params if eps else ours.value_network_params
    for key, value in ours.target_value_network_params.items(True, True):
        if eps == 0.0 and not ours.value_network_params.get(key).requires_grad:
            continue
        assert torch.allclose(value.data, expected.get(key).data, rtol=1e-12), key


def test_a_young_average_reaches_back_over_a_share_of_all_steps():
    loss = new_loss()
    average = AveragedParams(loss, "value_network", 0.9, reach=0.5)
    key = ("encoder", "embed", "0", "bias")
    expected = loss.value_network_params.get(key).data.clone()
    for t in range(1, 41):
        shift(loss, t, names=("value_network_params",))
        average.step()
        eps = min(0.9, 1.0 - 1.0 / (1.0 + 0.5 * t))
        assert eps == 0.9 or t < 18
        expected = eps * expected + (1.0 - eps) * loss.value_network_params.get(key).data
        assert torch.allclose(loss.target_value_network_params.get(key), expected, rtol=1e-12)


@pytest.mark.parametrize(("eps", "reach"), [(-0.1, None), (1.0, None), (0.9, 0.0)])
def test_a_share_out_of_range_is_told(eps, reach):
    with pytest.raises(ValueError, match="from 0 to below 1"):
        AveragedParams(new_loss(), "value_network", eps, reach)
