"""Recurrent soft actor-critic's losses against slow loops over single steps, with torch.distributions' densities.

Double precision throughout: the same sums in another order, so EXACT is some roundings of numbers of unit size.
"""

from copy import deepcopy

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Independent, Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from torchrl.objectives import SoftUpdate

from beliefgym.agents.recurrent.auxiliary import make_auxiliary
from beliefgym.agents.recurrent.network import HistoryEncoder
from beliefgym.agents.recurrent.sac_loss import RecurrentSACLoss
from beliefgym.agents.recurrent.sac_networks import (
    RecurrentActor,
    RecurrentCritic,
    log_density,
    squashed_gaussian,
)

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")

EXACT = {"rtol": 1e-9, "atol": 1e-9}
GAMMA, TARGET_ENTROPY = 0.9, -1.5
N_OBSERVATION, N_ACTION, N_HIDDEN = 3, 2, 5


def encoder(cell):
    return HistoryEncoder(N_OBSERVATION, N_ACTION, N_HIDDEN, 6, cell, rewards=True)


def made_up_loss(cell="lstm", seed=0, **more):
    """With parameters large enough for memory to matter, and target parameters of their own."""
    actor = RecurrentActor(encoder(cell), N_OBSERVATION, N_ACTION, 6).double()
    critic = RecurrentCritic(encoder(cell), N_OBSERVATION, N_ACTION, 6).double()
    loss = RecurrentSACLoss(
        actor,
        critic,
        gamma=GAMMA,
        target_entropy=TARGET_ENTROPY,
        initial_temperature=0.3,
        generator=torch.Generator(),
        **more,
    )
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameters in (actor.parameters(), critic.parameters()):
            for parameter in parameters:
                parameter.copy_(0.6 * torch.randn(parameter.shape, generator=random))
        for value in loss.target_critic_network_params.values(True, True):
            value.data.copy_(0.6 * torch.randn(value.shape, generator=random))
        loss.target_critic_network_params["encoder", "mean"].zero_()
        loss.target_critic_network_params["encoder", "scale"].fill_(1.0)
    return loss


def made_up_rollout(n=5, n_steps=7, p_end=0.3, seed=0):
    """Rows of episodes that end anywhere, by themselves or cut; row 0 begins inside one, row 1 at a start."""
    rng = np.random.default_rng(seed)
    shape = (n, n_steps)
    done = rng.random(shape) < p_end
    terminated = done & (rng.random(shape) < 0.5)
    begins = np.concatenate([rng.random((n, 1)) < 0.5, done[:, :-1]], axis=1)
    begins[0, 0], begins[1:2, 0] = False, True
    observation, following = rng.standard_normal((2, *shape, N_OBSERVATION))
    following[:, :-1] = np.where(done[:, :-1, None], following[:, :-1], observation[:, 1:])
    action, reward = rng.uniform(-0.95, 0.95, (*shape, N_ACTION)), rng.standard_normal((*shape, 1))
    past_action = np.concatenate([rng.uniform(-1, 1, (n, 1, N_ACTION)), action[:, :-1]], axis=1)
    past_reward = np.concatenate([rng.standard_normal((n, 1, 1)), reward[:, :-1]], axis=1)
    past_action[begins], past_reward[begins] = 0.0, 0.0
    after = {
        "observation": following,
        "previous_action": action,
        "previous_reward": reward,
        "reward": reward,
        "terminated": terminated[..., None],
        "truncated": (done & ~terminated)[..., None],
    }
    now = {
        "observation": observation,
        "previous_action": past_action,
        "previous_reward": past_reward,
        "is_init": begins[..., None],
        "action": action,
        "action_probability": rng.uniform(0.1, 1.0, shape),
    }
    return TensorDict({**now, "next": TensorDict(after, shape)}, shape)


def of(loss, batch, seed=0):
    loss.generator.manual_seed(seed)
    return loss(batch)


def pieces_by_loop(batch):
    """(row, first step, step after the last) of every piece."""
    found = []
    for row, begins in enumerate(batch["is_init"][..., 0].tolist()):
        for t, fresh in enumerate(begins):
            if t == 0 or fresh:
                found.append([row, t, t])
            found[-1][2] = t + 1
    return found


def policy(mean, log_std):
    return Independent(TransformedDistribution(Normal(mean, log_std.exp()), [TanhTransform()]), 1)


def along(step, state, batch, piece):
    """What `step(*inputs, state) -> (outputs, state)` gives at every slot of a piece."""
    row, begin, end = piece
    keys = ("observation", "previous_action", "previous_reward")
    seen = [[batch[key][row, t] for key in keys] for t in range(begin, end)]
    seen.append([batch["next", key][row, end - 1] for key in keys])
    found = []
    for inputs in seen:
        outputs, state = step(*(x[None, None] for x in inputs), state)
        found.append((inputs[0][None, None], *outputs))
    return found


def losses_by_loop(loss, batch, trace_decay=0.0, importance=True, burn_in=0, seed=0):
    """loss_critic, loss_actor, loss_alpha by the sums that define them."""
    actor, critic, target = loss.actor_network, loss.critic_network, deepcopy(loss.critic_network)
    loss.target_critic_network_params.to_module(target)
    alpha = loss.log_alpha.exp().item()
    pieces = pieces_by_loop(batch)
    longest = max(end - begin for _, begin, end in pieces)
    noise = torch.empty(len(pieces), longest + 1, N_ACTION, dtype=torch.float64)
    noise.normal_(generator=torch.Generator().manual_seed(seed))
    critic_losses, actor_losses, log_probabilities = [], [], []
    for i, (row, begin, end) in enumerate(pieces):
        n = end - begin
        zeros = torch.zeros(1, actor.state_size, dtype=torch.float64)
        policies = along(lambda *x: ((m := actor(*x))[:2], m[2]), zeros, batch, (row, begin, end))
        hidden, later = (
            along(
                lambda *x, net=net: ((net.hidden(*x)[0],), net.hidden(*x)[1]), zeros, batch, (row, begin, end)
            )
            for net in (critic, target)
        )
        distributions = [policy(mean[0, 0], log_std[0, 0]) for _, mean, log_std in policies]
        drawn = [
            torch.tanh(mean[0, 0] + log_std[0, 0].exp() * noise[i, t])
            for t, (_, mean, log_std) in enumerate(policies)
        ]

        def q(net, slot, action):
            observation, h = slot
            return net.values(h, observation, action[None, None])[:, 0, 0]

        values = [
            q(target, later[t], drawn[t]).min() - alpha * distributions[t].log_prob(drawn[t])
            for t in range(n + 1)
        ]
        y = [None] * n
        for t in reversed(range(n)):
            after = values[t + 1]
            if t + 1 < n:
                taken = batch["action"][row, begin + t + 1]
                mu = batch["action_probability"][row, begin + t + 1]
                ratio = (
                    (distributions[t + 1].log_prob(taken).exp() / mu).clamp(max=1.0) if importance else 1.0
                )
                after = after + trace_decay * ratio * (y[t + 1] - q(target, later[t + 1], taken).min())
            d = 0.0 if batch["next", "terminated"][row, begin + t, 0] else GAMMA
            y[t] = batch["next", "reward"][row, begin + t, 0] + d * after
        skipped = 0 if batch["is_init"][row, begin, 0] else burn_in
        for t in range(skipped, n):
            errors = q(critic, hidden[t], batch["action"][row, begin + t]) - y[t].detach()
            critic_losses.append(0.5 * errors.square().sum())
            log_probabilities.append(distributions[t].log_prob(drawn[t]))
            actor_losses.append(alpha * log_probabilities[-1] - q(critic, hidden[t], drawn[t]).min())
    log_alpha = loss.log_alpha * -(torch.stack(log_probabilities).mean().item() + TARGET_ENTROPY)
    return torch.stack(critic_losses).mean(), torch.stack(actor_losses).mean(), log_alpha


def test_squashed_gaussian_has_torch_distributions_density():
    mean, log_std, noise = torch.randn(
        3, 50, N_ACTION, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    action, log_probability = squashed_gaussian(mean, log_std - 1.0, noise)
    expected = policy(mean, log_std - 1.0).log_prob(action)
    torch.testing.assert_close(log_probability, expected, **EXACT)
    # the inverse of tanh loses digits near 1: |u| < 7 here, so about 1e-16 / (1 - tanh(7)^2) of them
    torch.testing.assert_close(log_density(mean, log_std - 1.0, action), expected, rtol=1e-7, atol=1e-7)


def test_density_of_actions_that_are_rounded_to_the_edge_is_finite():
    mean = torch.tensor([[40.0], [-40.0]])
    action, log_probability = squashed_gaussian(mean, torch.zeros(2, 1), torch.zeros(2, 1))
    assert action.abs().tolist() == [[1.0], [1.0]]
    assert log_probability.isfinite().all()
    assert log_density(mean, torch.zeros(2, 1), action).isfinite().all()


@pytest.mark.parametrize("cell", ["lstm", "gru", "none"])
@pytest.mark.parametrize(
    "form",
    [
        {},
        {"burn_in": 2},
        {"trace_decay": 0.8},
        {"trace_decay": 1.0, "importance": False},
    ],
    ids=str,
)
def test_losses_are_their_sums_step_by_step(cell, form):
    loss, batch = made_up_loss(cell, **form), made_up_rollout()
    answer = of(loss, batch)
    for key, expected in zip(("critic", "actor", "alpha"), losses_by_loop(loss, batch, **form), strict=True):
        torch.testing.assert_close(answer[f"loss_{key}"], expected, check_dtype=False, rtol=1e-6, atol=1e-6)


def test_gradients_are_those_of_the_sums():
    loss, batch = made_up_loss(trace_decay=0.8), made_up_rollout()
    answer, expected = of(loss, batch), losses_by_loop(loss, batch, trace_decay=0.8)
    for key, network, by_loop in (
        ("loss_critic", loss.critic_network, expected[0]),
        ("loss_actor", loss.actor_network, expected[1]),
    ):
        parameters = list(network.parameters())
        for ours, theirs in zip(
            torch.autograd.grad(answer[key], parameters, retain_graph=True),
            torch.autograd.grad(by_loop, parameters, retain_graph=True),
            strict=True,
        ):
            torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-8)  # alpha is in single precision


def test_target_by_hand_of_one_step():
    """y = r + gamma (min Q' - alpha log pi) where an episode was cut, y = r where it ended."""
    loss = made_up_loss("none")
    batch = made_up_rollout(n=2, n_steps=1)
    batch["next", "terminated"][:, 0, 0] = torch.tensor([True, False])
    target = deepcopy(loss.critic_network)
    loss.target_critic_network_params.to_module(target)
    noise = torch.empty(2, 2, N_ACTION, dtype=torch.float64).normal_(
        generator=torch.Generator().manual_seed(0)
    )
    after = [batch["next", key] for key in ("observation", "previous_action", "previous_reward")]
    nothing = torch.zeros(2, 0, dtype=torch.float64)
    mean, log_std, _ = loss.actor_network(*after, nothing)
    action, log_probability = squashed_gaussian(mean[:, 0], log_std[:, 0], noise[:, 1])
    both = target.values(target.hidden(*after, nothing)[0], after[0], action[:, None])[:, :, 0]
    value = both.min(0).values - 0.3 * log_probability
    y = batch["next", "reward"][:, 0, 0] + torch.tensor([0.0, GAMMA]) * value
    before = [batch[key] for key in ("observation", "previous_action", "previous_reward")]
    critic = loss.critic_network
    values = critic.values(critic.hidden(*before, nothing)[0], before[0], batch["action"])[:, :, 0]
    expected = 0.5 * (values - y).square().sum(0).mean()
    torch.testing.assert_close(of(loss, batch)["loss_critic"], expected, rtol=1e-6, atol=1e-6)


def test_last_observation_counts_after_a_truncation_and_not_after_a_termination():
    loss = made_up_loss()
    batch = made_up_rollout(n=1, n_steps=4, p_end=0.0)
    for terminated in (False, True):
        batch["next", "terminated"][0, -1] = terminated
        other = batch.clone()
        other["next", "observation"][0, -1] += 1.0
        same = torch.equal(of(loss, batch)["loss_critic"], of(loss, other)["loss_critic"])
        assert same is terminated


def test_padding_does_not_count():
    loss = made_up_loss(auxiliary={"dynamics": made_auxiliary("dynamics")}).eval()
    batch = made_up_rollout(n=4, n_steps=6)
    batch["mask"] = torch.arange(6) < torch.tensor([6, 3, 1, 5])[:, None]
    other = batch.clone()
    padding = ~batch["mask"]
    for key in ("observation", "action", "previous_action", "previous_reward", "action_probability"):
        other[key][padding] = 7.0
    for key in ("observation", "reward"):
        other["next", key][padding] = -7.0
    other["next", "terminated"][padding] ^= True
    other["is_init"][padding] ^= True
    for key, value in of(loss, batch).items():
        assert torch.equal(value, of(loss, other)[key]), key


def made_auxiliary(name):
    torch.manual_seed(0)
    return make_auxiliary(name, N_HIDDEN, N_OBSERVATION, N_ACTION).double()


@pytest.mark.parametrize(
    ("key", "moved"), [("loss_actor", {"actor"}), ("loss_critic", {"critic"}), ("loss_alpha", {"alpha"})]
)
def test_each_loss_has_gradients_for_its_own_network_alone(key, moved):
    loss = made_up_loss(trace_decay=0.9)
    parts = {
        "actor": list(loss.actor_network.parameters()),
        "critic": list(loss.critic_network.parameters()),
        "target": [x for x in loss.target_critic_network_params.values(True, True) if x.requires_grad],
        "alpha": [loss.log_alpha],
    }
    answer = of(loss, made_up_rollout())
    for name, parameters in parts.items():
        found = (
            torch.autograd.grad(answer[key], parameters, retain_graph=True, allow_unused=True)
            if parameters
            else ()
        )
        assert all((gradient is not None) == (name in moved) for gradient in found), name


@pytest.mark.parametrize(
    "name",
    ["dynamics", "predictive_state", "predictive_rewards", "predictive_values", "latent_self_prediction"],
)
def test_auxiliary_objectives_shape_the_critics_memory(name):
    objective = made_auxiliary(name)
    loss = made_up_loss(auxiliary={name: objective}, auxiliary_weights={name: 0.5})
    answer = of(loss, made_up_rollout())
    encoders = [
        network.encoder.memory.layer.weight_hh_l0 for network in (loss.critic_network, loss.actor_network)
    ]
    critics, actors = torch.autograd.grad(answer[f"loss_{name}"], encoders, allow_unused=True)
    assert critics.abs().max() > 0.0
    assert actors is None
    loss.auxiliary_weights[name] = 0.0
    assert f"loss_{name}" not in of(loss, made_up_rollout()).keys()  # noqa: SIM118


def test_torchrl_moves_the_target_parameters():
    loss = made_up_loss()
    updater = SoftUpdate(loss, eps=0.75)  # sets them to the critic's at first
    weight = loss.critic_network.encoder.embed[0].weight
    expected = weight.detach() + 0.25
    with torch.no_grad():
        weight += 1.0
    updater.step()
    found = loss.target_critic_network_params["encoder", "embed", "0", "weight"]
    torch.testing.assert_close(found.data, expected, **EXACT)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gamma": 1.1}, "expected gamma and trace_decay from 0 to 1"),
        ({"trace_decay": -0.1}, "expected gamma and trace_decay from 0 to 1"),
        ({"initial_temperature": 0.0}, "initial_temperature above 0"),
        ({"burn_in": -1}, "burn_in of at least 0"),
    ],
)
def test_settings_out_of_range_are_named(settings, message):
    actor = RecurrentActor(encoder("none"), N_OBSERVATION, N_ACTION)
    critic = RecurrentCritic(encoder("none"), N_OBSERVATION, N_ACTION)
    with pytest.raises(ValueError, match=message):
        RecurrentSACLoss(actor, critic, target_entropy=-1.0, **settings)


def test_batches_of_another_form_are_refused():
    loss, batch = made_up_loss(trace_decay=0.5), made_up_rollout()
    with pytest.raises(
        ValueError, match=r"expected a batch \(n, n_steps\) of sequences, got batch size \(5,\)"
    ):
        loss(batch[:, 0])
    with pytest.raises(ValueError, match="traces need the density of each action when it was drawn"):
        loss(batch.exclude("action_probability"))


def test_a_batch_of_nothing_but_padding_is_refused():
    batch = made_up_rollout()
    batch["mask"] = torch.zeros(5, 7, dtype=torch.bool)
    with pytest.raises(
        ValueError, match=r"at least one step .* got 'mask' False at all of \(5, 7\) steps: leave"
    ):
        made_up_loss()(batch)
    batch["mask"][3, 0] = True
    assert of(made_up_loss(), batch)["loss_critic"].isfinite()
