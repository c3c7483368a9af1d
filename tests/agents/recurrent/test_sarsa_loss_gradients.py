"""Gradients of the loss against finite differences, the two kinds of them, and importance weights.

Double precision: TOLD is some roundings of sums of a few dozen terms of unit size, taken in another order.
"""

import pytest
import torch
from recurrent_cases import (
    STATE_SIZES,
    gradient,
    loss_by_loop,
    made_up_rollout,
    pieces_by_loop,
    policy_by_hand,
    q_network,
    values_along,
)
from torch.testing import assert_close

from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss

TOLD = {"rtol": 1e-10, "atol": 1e-11}
FORMS = {
    "one step": {"n_steps": 0},
    "sum over three": {"n_steps": 2, "weights": [0.5, 0.0, 2.0]},
    "to the end": {"n_steps": None, "weights": 0.7},
}
each_form = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
each_bootstrap = pytest.mark.parametrize("bootstrap", ["taken", "expected", "max"])


def slope(function, network, direction, step=1e-6):
    """Of a function of all parameters along a direction, by central differences."""
    parameters = list(network.parameters())
    parts = [
        d.view_as(p)
        for d, p in zip(direction.split([p.numel() for p in parameters]), parameters, strict=True)
    ]
    values = []
    with torch.no_grad():
        for shift in (step, -2 * step, step):
            for p, d in zip(parameters, parts, strict=True):
                p += shift * d
            values.append(function().item())
    return (values[0] - values[1]) / (2 * step)


def directions(network, n=4):
    size = sum(p.numel() for p in network.parameters())
    return torch.randn(n, size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


@each_bootstrap
@each_form
@pytest.mark.parametrize("cell", ["lstm", "gru"])
def test_the_residual_gradient_is_that_of_the_loss_as_a_function_of_all_parameters(cell, form, bootstrap):
    """With arg max and epsilon, under which the policy is constant nearly everywhere."""
    network = q_network(cell)
    rollout = made_up_rollout(state_size=STATE_SIZES[cell])
    loss = RecurrentSarsaLoss(
        network, gamma=0.9, bootstrap=bootstrap, gradient="residual", epsilon=0.2, **form
    )
    found = gradient(loss(rollout)["loss_value"], network)
    for direction in directions(network):
        expected = slope(lambda: loss(rollout)["loss_value"], network, direction)
        # differences are off by step^2 times a third derivative, and by 1e-16 / step of the loss
        assert float(found @ direction) == pytest.approx(expected, rel=1e-6, abs=1e-8)


@each_bootstrap
@each_form
def test_the_semi_gradient_is_that_of_the_distance_to_targets_that_stay(form, bootstrap):
    network, fixed = q_network("lstm"), q_network("lstm")
    rollout = made_up_rollout()
    loss = RecurrentSarsaLoss(network, gamma=0.9, bootstrap=bootstrap, epsilon=0.2, **form)
    found = gradient(loss(rollout)["loss_value"], network)
    options = {"gamma": 0.9, "weights": 0.9, "bootstrap": bootstrap, "epsilon": 0.2, **form}
    for direction in directions(network, 2):
        expected = slope(lambda: loss_by_loop(network, rollout, target=fixed, **options), network, direction)
        assert float(found @ direction) == pytest.approx(expected, rel=1e-6, abs=1e-8)  # as above


@pytest.mark.parametrize(
    "form", [FORMS["one step"], FORMS["sum over three"]], ids=["one step", "sum over three"]
)
@pytest.mark.parametrize("bootstrap", ["taken", "expected"])
def test_both_kinds_give_one_value_and_gradients_of_their_own(form, bootstrap):
    """The policy is held where it is, soft as it may be: Eq. 4.17 is about the values of a policy that is given."""
    network = q_network("lstm")
    rollout = made_up_rollout()
    options = {"gamma": 0.9, "bootstrap": bootstrap, "temperature": 0.5, **form}
    values, found = {}, {}
    for kind in ("semi", "residual"):
        values[kind] = RecurrentSarsaLoss(network, gradient=kind, **options)(rollout)["loss_value"]
        expected = loss_by_loop(network, rollout, fixed=kind == "semi", **{"weights": 0.9, **options})
        found[kind] = gradient(values[kind], network)
        assert_close(found[kind], gradient(expected, network), **TOLD)
    assert_close(values["semi"], values["residual"], rtol=0, atol=0)
    assert (found["semi"] - found["residual"]).norm() > 0.1 * found["semi"].norm()


@pytest.mark.parametrize("bootstrap", ["taken", "max"])
def test_a_sum_to_the_end_weighted_as_lambda_returns_pulls_where_they_do(bootstrap):
    """sum_n w_n (Q - y^n)^2 has the gradient 2 (Q - sum_n w_n y^n) dQ, if the w sum to 1 and targets are fixed.

    lambda-returns are (1 - lambda) sum_n lambda^n y^n, with all that is left on the last y before the end. With k + 1
    residuals for the longest piece and lambda^k on the last, every shorter piece too has lambda^{L-1} on its own last,
    since past its end all y are one. The values differ, by the spread of the y.
    """
    network = q_network("lstm")
    rollout = made_up_rollout()
    k = max(end - begin for _, begin, end in pieces_by_loop(rollout["is_init"][..., 0])) - 1
    shares = [0.3 * 0.7**n for n in range(k)] + [0.7**k]
    traced = RecurrentSarsaLoss(network, gamma=0.9, bootstrap=bootstrap, weights=0.7)(rollout)["loss_value"]
    expected = gradient(traced, network)
    for n_steps, weights in ((k, shares), (k + 3, [*shares, 0.0, 0.0, 0.0]), (200, 0.7)):  # 0.7^200 is 0
        loss = RecurrentSarsaLoss(network, gamma=0.9, bootstrap=bootstrap, n_steps=n_steps, weights=weights)
        summed = loss(rollout)["loss_value"]
        assert_close(gradient(summed, network), expected, **TOLD)
        assert summed > traced + 0.01


@each_bootstrap
def test_residuals_to_the_end_are_weighted_as_lambda_returns(bootstrap):
    network = q_network("lstm")
    rollout = made_up_rollout()
    options = {"gamma": 0.9, "bootstrap": bootstrap, "gradient": "residual"}
    found = RecurrentSarsaLoss(network, weights=0.7, **options)(rollout)["loss_value"]
    k = rollout.shape[1]
    shares = [0.3 * 0.7**n for n in range(k)] + [0.7**k]
    expected = RecurrentSarsaLoss(network, n_steps=k, weights=shares, **options)(rollout)["loss_value"]
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)


def retraced(network, **more):
    return RecurrentSarsaLoss(network, **{"gamma": 0.9, "bootstrap": "expected", "weights": 0.8, **more})


def probabilities(network, rollout, epsilon=0.0, temperature=0.0):
    """pi(a_t | h_t) of the actions recorded."""
    found = torch.empty(rollout.shape, dtype=torch.float64)
    for row, begin, end in pieces_by_loop(rollout["is_init"][..., 0]):
        with torch.no_grad():
            q, _ = values_along(network, rollout, (row, begin, end))
        for t in range(begin, end):
            found[row, t] = policy_by_hand(q[t - begin], epsilon, temperature)[rollout["action"][row, t]]
    return found


@pytest.mark.parametrize("policy", [{"epsilon": 0.3}, {"epsilon": 0.1, "temperature": 0.7}], ids=str)
def test_importance_weights_are_retraces(policy):
    network = q_network("lstm")
    rollout = made_up_rollout()
    found = retraced(network, importance=True, **policy)(rollout)["loss_value"]
    options = {"gamma": 0.9, "weights": 0.8, "bootstrap": "expected", "n_steps": None, **policy}
    expected = loss_by_loop(network, rollout, importance=True, **options)
    assert_close(found, expected, **TOLD)
    assert_close(gradient(found, network), gradient(expected, network), **TOLD)
    assert abs(found - retraced(network, **policy)(rollout)["loss_value"]) > 1e-3


@pytest.mark.parametrize("policy", [{"epsilon": 0.3}, {"temperature": 0.7}], ids=str)
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_importance_weights_change_nothing_on_the_policys_own_actions(policy, share):
    """Nor where they were less likely than under the policy: weights are at most 1."""
    network = q_network("gru")
    rollout = made_up_rollout(state_size=5)
    rollout["action_probability"] = (share * probabilities(network, rollout, **policy))[..., None]
    weighted, plain = (
        retraced(network, importance=i, **policy)(rollout)["loss_value"] for i in (True, False)
    )
    assert_close(weighted, plain, **TOLD)


def test_importance_weights_cut_at_actions_the_policy_never_takes():
    """So one step is left at each, where what was done next is never what arg max would do."""
    network = q_network("gru")
    rollout = made_up_rollout(state_size=5)
    rollout["action"] = best_or_worst(network, rollout, worst=True)
    found = retraced(network, importance=True)(rollout)["loss_value"]
    one_step = RecurrentSarsaLoss(network, gamma=0.9, bootstrap="expected", n_steps=0)(rollout)["loss_value"]
    assert_close(found, one_step, **TOLD)
    rollout["action"] = best_or_worst(network, rollout, worst=False)
    found, plain = (retraced(network, importance=i)(rollout)["loss_value"] for i in (True, False))
    assert_close(found, plain, **TOLD)


def best_or_worst(network, rollout, worst):
    """Actions at every step; those recorded as previous stay as they are."""
    action = torch.empty_like(rollout["action"])
    for row, begin, end in pieces_by_loop(rollout["is_init"][..., 0]):
        q, _ = values_along(network, rollout, (row, begin, end))
        action[row, begin:end] = (q.argmin(-1) if worst else q.argmax(-1))[:-1]
    return action
