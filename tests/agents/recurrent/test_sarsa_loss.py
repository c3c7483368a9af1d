"""The loss of Recurrent-Q SARSA against a slow loop over single episodes, and what it must not depend on.

Double precision: TOLD is some roundings of sums of a few dozen terms of unit size, taken in another order.
"""

import pytest
import torch
from recurrent_cases import STATE_SIZES, gradient, loss_by_loop, made_up_rollout, q_network, values_along
from torch.testing import assert_close

from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")  # targets are set by hand here

TOLD = {"rtol": 1e-10, "atol": 1e-11}
FORMS = {
    "one step": {"n_steps": 0},
    "sum over three": {"n_steps": 2, "weights": [0.5, 0.0, 2.0]},
    "geometric, past the end": {"n_steps": 9, "weights": 0.7},
    "lambda": {"n_steps": None, "weights": 0.7},
}
each_form = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
each_bootstrap = pytest.mark.parametrize("bootstrap", ["taken", "expected", "max", "double"])
each_gradient = pytest.mark.parametrize("kind", ["semi", "residual"])


def by_loop(network, rollout, **more):
    return loss_by_loop(network, rollout, **{"gamma": 0.9, "weights": 0.9, "bootstrap": "taken", **more})


def loss_of(network, **more):
    return RecurrentSarsaLoss(network, **{"gamma": 0.9, **more})


def apart(loss, cell):
    """Gives the target network weights of its own; that network."""
    other = q_network(cell, seed=7)
    for key, value in (*other.named_parameters(), *other.named_buffers()):
        loss.target_value_network_params.get(tuple(key.split("."))).data.copy_(value.data)
    return other


@each_bootstrap
@each_form
@pytest.mark.parametrize("cell", ["lstm", "none"])
def test_value_and_gradient_are_those_of_single_episodes_with_fixed_targets(cell, form, bootstrap):
    network = q_network(cell)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell])
    delayed = bootstrap == "double"
    loss = loss_of(network, bootstrap=bootstrap, epsilon=0.2, delay_value=delayed, **form)
    target = apart(loss, cell) if delayed else None
    found = loss(rollout)["loss_value"]
    expected = by_loop(network, rollout, target=target, bootstrap=bootstrap, epsilon=0.2, **form)
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)


@each_bootstrap
@pytest.mark.parametrize("form", [FORMS["one step"], FORMS["lambda"]], ids=["one step", "lambda"])
@pytest.mark.parametrize("policy", [{"epsilon": 0.3}, {"temperature": 0.5}], ids=str)
def test_targets_of_a_network_of_their_own_follow_its_policy(form, bootstrap, policy):
    network = q_network("gru")
    rollout = made_up_rollout(state_size=5)
    loss = loss_of(network, bootstrap=bootstrap, delay_value=True, **policy, **form)
    target = apart(loss, "gru")
    found = loss(rollout)["loss_value"]
    expected = by_loop(network, rollout, target=target, bootstrap=bootstrap, **policy, **form)
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)
    assert abs(found - by_loop(network, rollout, bootstrap=bootstrap, **policy, **form)) > 1e-3


@pytest.mark.parametrize(
    ("form", "importance"), [*((form, False) for form in FORMS.values()), (FORMS["lambda"], True)], ids=str
)
def test_munchausen_rewards_what_the_policy_would_do_and_its_entropy(form, importance):
    network = q_network("gru")
    rollout = made_up_rollout(state_size=5)
    rollout["action_probability"] = 0.1 + 0.9 * torch.rand(
        rollout.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    options = {"epsilon": 0.1, "temperature": 0.4, "importance": importance, **form}
    loss = loss_of(network, bootstrap="expected", munchausen=0.9, delay_value=True, **options)
    target = apart(loss, "gru")
    found = loss(rollout)["loss_value"]
    more = {"target": target, "bootstrap": "expected", **options}
    expected = by_loop(network, rollout, munchausen=0.9, **more)
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)
    assert abs(found - by_loop(network, rollout, **more)) > 1e-3


def test_munchausen_of_an_arg_max_changes_nothing():
    network, rollout = q_network(), made_up_rollout()
    plain, other = (loss_of(network, bootstrap="expected", munchausen=m) for m in (0.0, 0.9))
    assert torch.equal(plain(rollout)["loss_value"], other(rollout)["loss_value"])


def test_policy_settings_may_be_changed_between_calls():
    network = q_network("gru")
    rollout = made_up_rollout(state_size=5)
    loss = loss_of(network, bootstrap="expected")
    loss.epsilon, loss.temperature = 0.4, 0.8
    expected = by_loop(network, rollout, bootstrap="expected", n_steps=None, epsilon=0.4, temperature=0.8)
    assert_close(loss(rollout)["loss_value"], expected, **TOLD)


@each_gradient
@each_form
def test_a_batch_is_the_mean_over_the_steps_of_its_rows(form, kind):
    """So what else is in a batch does not matter to a row, whatever the lengths of its episodes."""
    loss = loss_of(q_network("gru"), gradient=kind, **form)
    rollout = made_up_rollout(n=6, state_size=5, p_end=0.25)
    alone = torch.stack([loss(row[None])["loss_value"] for row in rollout])
    assert_close(loss(rollout)["loss_value"], alone.mean(), **TOLD)


@each_form
def test_padding_is_as_if_it_were_not_there(form):
    network = q_network("lstm")
    rollout = made_up_rollout(n=3)
    n_valid = (4, 7, 1)
    padded = rollout.clone().set("mask", torch.arange(7) < torch.tensor(n_valid)[:, None])
    for row, n in enumerate(n_valid):
        for key in ("observation", "previous_action", ("next", "observation"), ("next", "reward")):
            padded[key][row, n:] = torch.nan
    found = loss_of(network, **form)(padded)["loss_value"]
    expected = by_loop(network, rollout, mask=padded["mask"], **form)
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)


@pytest.mark.parametrize("form", [FORMS["sum over three"], FORMS["lambda"]], ids=["sum over three", "lambda"])
@each_gradient
@pytest.mark.parametrize("cell", STATE_SIZES)
def test_episodes_of_one_step_each(cell, form, kind):
    network = q_network(cell)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell], p_end=1.0)
    rollout["is_init"][:] = True
    rollout["previous_action"][:] = 0.0
    found = loss_of(network, gradient=kind, **form)(rollout)["loss_value"]
    expected = by_loop(network, rollout, fixed=kind == "semi", **{**form, "n_steps": 0})
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)


@pytest.mark.parametrize("form", [FORMS["one step"], FORMS["sum over three"], FORMS["lambda"]], ids=str)
def test_what_happens_before_an_episode_begins_changes_nothing_in_it(form):
    """All steps up to a row's first start are changed, its later ones keep their residuals."""
    network = q_network("lstm", rewards=True)
    loss = loss_of(network, **form)
    rollout = made_up_rollout(n=1, n_steps=9, p_end=0.0)
    rollout["is_init"][0, 4] = True
    rollout["next", "terminated"][0, 3] = True
    rollout["previous_action"][0, 4] = rollout["previous_reward"][0, 4] = 0.0
    before, after = rollout[:, :4], rollout[:, 4:]
    changed = rollout.clone()
    for key in ("observation", "previous_action", "previous_reward", "recurrent_state"):
        changed[key][:, :4] += 1.0
        if key != "recurrent_state":
            changed["next", key][:, :4] += 1.0
    parts = [9 * loss(x)["loss_value"] - 4 * loss(x[:, :4])["loss_value"] for x in (rollout, changed)]
    for part in parts:
        assert_close(part, 5 * loss(after)["loss_value"], **TOLD)
    assert abs(loss(changed[:, :4])["loss_value"] - loss(before)["loss_value"]) > 1e-3


@pytest.mark.parametrize(
    ("bootstrap", "kind"), [("taken", "semi"), ("expected", "semi"), ("max", "semi"), ("taken", "residual")]
)
@pytest.mark.parametrize("form", [FORMS["one step"], FORMS["lambda"]], ids=["one step", "lambda"])
@pytest.mark.parametrize("end", ["terminated", "truncated", "neither"])
def test_the_last_observation_counts_unless_the_episode_has_terminated(end, form, bootstrap, kind):
    network = q_network("gru")
    loss = loss_of(network, bootstrap=bootstrap, gradient=kind, **form)
    rollout = made_up_rollout(n=2, state_size=5, p_end=0.0)
    if end != "neither":
        rollout["next", end][0, 4] = rollout["next", "done"][0, 4] = True
        rollout["is_init"][0, 5] = True
    at = 4 if end != "neither" else 6
    changed = rollout.clone()
    changed["next", "observation"][0, at] += 1.0
    first, second = (loss(x)["loss_value"] for x in (rollout, changed))
    if end == "terminated":
        assert torch.equal(first, second)
        assert torch.equal(gradient(first, network), gradient(second, network))
    else:
        assert abs(first - second) > 1e-4


@pytest.mark.parametrize("burn_in", [1, 3, 20])
@each_gradient
def test_burn_in_leaves_out_first_steps_of_episodes_that_began_before(burn_in, kind):
    network = q_network("lstm")
    rollout = made_up_rollout(n=6, p_end=0.15)
    found = loss_of(network, burn_in=burn_in, n_steps=1, gradient=kind)(rollout)["loss_value"]
    expected = by_loop(network, rollout, burn_in=burn_in, n_steps=1, fixed=kind == "semi")
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)
    assert abs(found - loss_of(network, n_steps=1, gradient=kind)(rollout)["loss_value"]) > 1e-3


def test_burn_in_of_everything_leaves_zero():
    rollout = made_up_rollout(n=2, p_end=0.0)
    rollout["is_init"][:] = False
    assert loss_of(q_network(), burn_in=7)(rollout)["loss_value"].item() == 0.0


def test_what_is_told_besides_is_over_the_same_steps():
    network = q_network("gru")
    rollout = made_up_rollout(n=1, n_steps=5, state_size=5, p_end=0.0)
    rollout["is_init"][0, 0] = True
    answer = loss_of(network, n_steps=0)(rollout)
    q, _ = values_along(network, rollout, (0, 0, 5))
    chosen = q[torch.arange(5), rollout["action"][0]]
    assert_close(answer["mean_value"], chosen.mean().detach(), **TOLD)
    assert_close(answer["largest_value"], q.abs().max().detach(), **TOLD)
    assert_close(answer["td_error"], answer["loss_value"].detach().sqrt(), **TOLD)
    assert [key for key, value in answer.items() if value.requires_grad] == ["loss_value"]
