"""PSIM+ACTIONS against the Kalman filter and against exact expectations under blind actions, and what it refuses."""

import warnings

import numpy as np
import pytest
from controlled_systems import (
    TwoStates,
    expected_futures,
    kalman_squared_errors,
    kalman_states,
    linear,
)
from sklearn.base import clone
from sklearn.linear_model import LinearRegression

from beliefgym.learning import Sequences
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.psim_actions import PSIMActions
from beliefgym.learning.psim_conditional import ConditionalPSIM

IMPORTANCE = (None, "ordinary", "weighted")
ELSEWHERE = {
    "same": linear(200, 30, 90, feedback=0.4),
    "blind": linear(200, 30, 91),
    "opposite": linear(200, 30, 92, feedback=-0.2, mean=0.5),
}


@pytest.mark.parametrize("feedback", [0.0, 0.4])
@pytest.mark.parametrize("importance", IMPORTANCE)
def test_on_a_linear_gaussian_system_it_becomes_the_kalman_filter(importance, feedback):
    """Data from one policy, forecasts under three, of which it is told the actions."""
    train = linear(2000, 30, 1, feedback=feedback)
    model = PSIMActions(n_future=2, n_iterations=5, importance=importance, per_decision=True)
    model.fit(train, train[:100])
    for name, data in ELSEWHERE.items():
        ratio = np.nanmean(model.errors(data, 8).squared[:, 1:], axis=(0, 1))
        ratio /= np.nanmean(kalman_squared_errors(data, 8)[:, 1:], axis=(0, 1))
        # over seeds 1 to 4: one step ahead 1.000 to 1.004, further ahead 1.008; under the policy that pushes the other
        # way, where states are that training has few of, 1.02 and 1.05 with weights, whose effective samples are fewer,
        # and 1.007 and 1.02 without; below 1 by chance, from what 200 test trajectories have
        is_far = name == "opposite"
        assert 0.997 < ratio[0] < (1.025 if is_far else 1.01), name
        assert ratio.min() > 0.99, name
        assert ratio.max() < (1.06 if is_far else 1.015), name


def test_with_weights_a_belief_holds_what_blind_actions_bring_about_and_else_what_the_policy_does():
    """m_t against E_G[x_t, x_{t+1} | h_t] and E_P[..], both from the Kalman filter's state."""
    train, test = linear(2000, 30, 1, feedback=0.4), ELSEWHERE["same"]
    states = kalman_states(test)[:, 1:]
    of_policy = expected_futures(states, 2, 0.4)
    of_blind = expected_futures(states, 2, 0.0, train.actions.mean())
    apart = np.square(of_policy - of_blind).mean(axis=(0, 1))
    assert apart[1] > 0.07
    for importance in IMPORTANCE:
        model = PSIMActions(n_future=2, n_iterations=5, importance=importance).fit(train, train[:100])
        beliefs = model.beliefs(test)[:, 1:-1] * model._scale.scale + model._scale.offset
        own, other = (of_policy, of_blind) if importance is None else (of_blind, of_policy)
        # measured 0.0002 without and 0.001 with weights, whose effective samples are two thirds
        assert np.square(beliefs - own).mean(axis=(0, 1)).max() < 0.005, importance
        assert np.square(beliefs - other).mean(axis=(0, 1))[1] > 0.06, importance


@pytest.mark.parametrize("per_decision", [False, True])
@pytest.mark.parametrize("importance", IMPORTANCE)
def test_expectations_under_blind_actions_are_those_by_enumeration(importance, per_decision):
    """m_0 and m_1 of two states with a policy that looks: F has all products of x_0 and a_0, and no later step."""
    system, k = TwoStates(), 3
    regressor = PolynomialRidge(degree=2, alpha=1e-9)
    settings = {"n_choices": 2, "belief_limit": np.inf, "n_iterations": 1, "n_future": k}
    settings |= {"importance": importance, "per_decision": per_decision}
    histories, errors = [[], *([(x, a)] for x in (0, 1) for a in (0, 1))], []
    for n in (1_000, 50_000):
        data = system.sample(n, k, 0)
        share = data.actions.mean()
        mu = np.array([1.0 - share, share])
        exact = np.array([system.expected(h, k, None if importance is None else mu) for h in histories])
        other = np.array([system.expected(h, k, mu if importance is None else None) for h in histories])
        model = PSIMActions(regressor, **settings).fit(data)
        m_0 = model.initial_belief()
        m = [m_0] + [model.update(m_0, [[float(x)]], [[float(a)]]) for ((x, a),) in histories[1:]]
        found = np.concatenate(m) * model._scale.scale + model._scale.offset
        errors.append(np.sqrt(np.square(found - exact).mean()))
    first = data.observations[:, 0, 0] * 2 + data.actions[:, 0, 0]
    n_effective = np.array([n, *np.bincount(first.astype(int))]) * model.effective_samples_[-1]
    # each is a mean over n tests of deviation at most 1/2; 15 of them stay within 4 standard errors
    assert (np.abs(found - exact) < 4.0 * 0.5 / np.sqrt(n_effective)[:, None]).all()
    assert errors[1] < 0.4 * errors[0]  # 1/7 in the limit
    assert np.abs(found - other)[:, 1:].max() > 0.15


def test_a_function_of_ones_own_takes_weights_too():
    """Futures themselves, as a function: one step ahead they are read off as from first moments."""
    train, test = linear(300, 20, 1, feedback=0.4), ELSEWHERE["blind"]
    named = PSIMActions(n_future=2, n_iterations=3, importance="weighted").fit(train)
    own = clone(named).set_params(features=lambda futures: futures.reshape(len(futures), -1)).fit(train)
    # the same expectations in another scale, read by a regression on 6000 rows
    assert own.errors(test).mean == pytest.approx(named.errors(test).mean, rel=2e-3)


def test_second_moments_weigh_each_square_as_its_observation():
    train = linear(200, 20, 1, feedback=0.4)
    model = PSIMActions(n_future=2, features="second", importance="weighted", per_decision=True).fit(train)
    np.testing.assert_array_equal(model._target_block, [0, 1, 0, 1])
    assert model.belief_size == 4


@pytest.mark.parametrize("importance", ["ordinary", "weighted"])
def test_bounds_of_beliefs_are_those_of_futures_not_of_what_they_weigh(importance):
    """A weighed sample may be many times its future; an expectation of it is not."""
    train = linear(100, 20, 1, feedback=0.4)
    plain = PSIMActions(n_future=2, n_iterations=1).fit(train)
    weighed = clone(plain).set_params(importance=importance).fit(train)
    np.testing.assert_array_equal(weighed._bound, plain._bound)


@pytest.mark.parametrize("kind", [PSIMActions, ConditionalPSIM])
def test_without_a_penalty_learning_differences_gives_the_same_filter(kind):
    """F = G + phi([x, .., x]) is linear where G is."""
    train, test = linear(30, 20, 0), ELSEWHERE["same"]
    settings = {"n_future": 2, "n_iterations": 3}
    first, second = (
        kind(Ridge(alpha=0.0), target=target, **settings).fit(train) for target in ("next", "delta")
    )
    # condition numbers below 1e3, squared, times 1e-16, over four iterations
    np.testing.assert_allclose(second.beliefs(test), first.beliefs(test), rtol=0, atol=1e-8)
    ahead = [one.forecast(first.beliefs(test)[:, 3], 5, test.actions[:, 3:]) for one in (first, second)]
    np.testing.assert_allclose(*ahead, rtol=0, atol=1e-8)
    assert np.abs(second.model_.coef_ - first.model_.coef_).max() > 0.5


@pytest.mark.filterwarnings("error")
def test_few_effective_samples_are_told():
    data = linear(20, 20, 1, feedback=3.0, std=0.1)
    model = PSIMActions(n_future=3, n_iterations=1, importance="weighted")
    with pytest.warns(
        UserWarning, match=r"0\.\d\d% of 380 futures carry the weight .* up to 2 actions.*truncate=10"
    ):
        model.fit(data)
    assert model.effective_samples_.shape == (3,)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clone(model).set_params(n_future=1).fit(data)  # x_t needs no weight


BAD = {
    "state": ({"state": "both"}, "expected state to be one of .*joint.* got 'both'"),
    "importance": ({"importance": "some"}, "expected importance to be one of .*weighted.* got 'some'"),
    "truncate": ({"importance": "weighted", "truncate": 0.5}, "truncate as a multiple .* or None, got 0.5"),
    "truncate NaN": ({"truncate": np.nan}, "truncate as a multiple .* or None, got nan"),
    "joint features": (
        {"state": "joint", "features": "second"},
        "expected features='first' and target='next'",
    ),
    "joint target": ({"state": "joint", "target": "delta"}, "expected features='first' and target='next'"),
    "target": (
        {"importance": "ordinary", "target": "delta"},
        "expected target='next' and algorithm=.*'delta'",
    ),
    "algorithm": (
        {"importance": "ordinary", "algorithm": "online_gradient"},
        "algorithm='follow_the_leader' with importance weights, got 'next' and 'online_gradient'",
    ),
    "own": (
        {"importance": "weighted", "per_decision": True, "features": lambda futures: futures[:, 0]},
        "expected features 'first' or 'second' with per_decision, got a function",
    ),
    "reference": ({"importance": "weighted", "reference": "x"}, "expected reference to be one of .* got 'x'"),
    "n_choices": ({"n_choices": 1}, "expected n_choices to be a whole number of at least 2, got 1"),
    "choices": ({"n_choices": 3}, r"whole numbers from 0 to 2 \(n_choices = 3\), got -?\d"),
    "n_iterations": ({"n_iterations": 0}, "n_iterations to be a whole number of at least 1, got 0"),
    "too long": ({"n_future": 11}, "at least n_future \\+ 1 = 12 observations, got 8 of at most 11"),
    "too long, joint": (
        {"n_future": 10, "state": "joint"},
        "at least n_future \\+ 2 = 12 observations with state='joint', got 8 of at most 11",
    ),
}


@pytest.mark.parametrize("case", list(BAD))
def test_parameters_that_do_not_fit_are_told(case):
    parameters, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        PSIMActions(**parameters).fit(linear(8, 10, 0))


def test_data_and_regressors_that_do_not_fit_are_told():
    data = linear(8, 10, 0)
    silent = Sequences(data.observations, data.actions, data.rewards)
    actionless = Sequences.from_observations(data.observations)
    with pytest.raises(
        ValueError, match="expected trajectories with action_log_probs for importance weights"
    ):
        PSIMActions(importance="ordinary").fit(silent)
    for importance in IMPORTANCE:
        with pytest.raises(TypeError, match="expected Sequences, got ndarray"):
            PSIMActions(importance=importance).fit(data.observations)
    with pytest.raises(
        ValueError, match="expected trajectories with actions, .* a filter without them is PSIM"
    ):
        PSIMActions().fit(actionless)
    with pytest.raises(ValueError, match="expected validation with 1 actions as in training, got 0"):
        PSIMActions().fit(data, actionless)
    with pytest.raises(TypeError, match="regressor linear in features .* got LinearRegression"):
        PSIMActions(LinearRegression(), importance="weighted").fit(data)
    PSIMActions(LinearRegression(), n_future=2, n_iterations=1).fit(data)  # without weights any
    weighed = PSIMActions(n_future=2, n_iterations=1, importance="weighted").fit(data)
    with pytest.raises(
        TypeError, match="expected importance=None to learn on; importance weights are of a whole"
    ):
        weighed.partial_fit(data)
    with pytest.raises(TypeError, match="for a regressor with its sums, got 'weighted'"):
        weighed.chosen()
