"""Importance weights by hand, against exact enumeration, and least squares that carries them."""

import numpy as np
import pytest
from controlled_systems import TwoStates
from scipy.stats import multivariate_normal
from sklearn.linear_model import Ridge as ScikitRidge

from beliefgym.learning import Sequences
from beliefgym.learning.importance_weights import (
    BlindReference,
    effective_sample_share,
    future_log_weights,
    log_ratios,
    normalised_weights,
)
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.weighted_aggregate import WeightedAggregate

SYSTEM = TwoStates()
QUARTER = BlindReference("marginal", np.array([[0.0], [1.0], [1.0], [1.0]]), 2)  # mu = (1/4, 3/4)


def two_episodes():
    """Of 3 steps and of 2, with a third action that is padding."""
    actions = np.array([[[0.0], [1.0], [1.0]], [[1.0], [0.0], [7.0]]])
    probabilities = np.array([[0.5, 0.25, 0.75], [0.5, 0.125, 1e-9]])
    return Sequences(
        np.zeros((2, 4, 1)),
        actions,
        np.zeros((2, 3)),
        lengths=[3, 2],
        action_log_probs=np.log(probabilities),
    )


def test_ratios_are_the_reference_over_the_policy_and_one_past_an_end():
    found = np.exp(log_ratios(two_episodes(), QUARTER))
    np.testing.assert_allclose(found, [[0.5, 3.0, 1.0], [1.5, 2.0, 1.0]], rtol=1e-14)


def test_a_test_weighs_the_product_of_its_actions_ratios():
    """w_i of what i actions lead to, of the tests that start at each of the 4 observations, by hand."""
    found = np.exp(future_log_weights(log_ratios(two_episodes(), QUARTER), 2, 4))
    first = [[1.0, 0.5, 1.5], [1.0, 3.0, 3.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    second = [[1.0, 1.5, 3.0], [1.0, 2.0, 2.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    np.testing.assert_allclose(found, [first, second], rtol=1e-14)


@pytest.mark.parametrize(("n_steps", "n_factors", "n_rows"), [(7, 3, 8), (2, 5, 3), (4, 0, 5), (3, 2, 6)])
def test_products_are_those_of_plain_loops_whatever_the_lengths(n_steps, n_factors, n_rows):
    ratios = np.random.default_rng(0).normal(size=(3, n_steps))
    found = future_log_weights(ratios, n_factors, n_rows)
    expected = np.array(
        [[[row[t : t + i].sum() for i in range(n_factors + 1)] for t in range(n_rows)] for row in ratios]
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)  # sums of at most 7 numbers of about 1


@pytest.mark.parametrize("history", [[], [(0, 1)], [(1, 0)], [(1, 1), (0, 1)]])
def test_weights_have_mean_one_for_every_history_and_take_the_policy_out(history):
    """Every test of 3 steps, each weighed by the package and summed with its exact probability."""
    k, t = 3, len(history)
    mu = np.array([0.25, 0.75])
    tests = list(SYSTEM.tests(history, k))
    n = len(tests)
    x, a = np.zeros((n, t + k + 1, 1)), np.zeros((n, t + k, 1))
    log_probs = np.zeros((n, t + k))
    for row, (xs, actions, *_) in enumerate(tests):
        x[row, : t + k, 0] = [*(x for x, _ in history), *xs]
        a[row, :, 0] = [*(a for _, a in history), *actions]
        for i in range(t + k):
            p = SYSTEM.policy(x[row, i, 0], a[row, i - 1, 0] if i else 0)
            log_probs[row, i] = np.log(p if a[row, i, 0] else 1.0 - p)
    data = Sequences(x, a, np.zeros((n, t + k)), action_log_probs=log_probs)
    probability = np.array([g * pi for *_, g, pi in tests])
    future = x[:, t : t + k, 0]
    naive = probability @ future
    exact = SYSTEM.expected(history, k, mu)
    for reference, total in ((QUARTER, 1.0), (BlindReference("uniform", a, 2), 2.0)):
        weights = np.exp(future_log_weights(log_ratios(data, reference), k, t + 1)[:, t])
        # Z_h: 1 with probabilities mu, and the number of action sequences with the thesis's weight
        np.testing.assert_allclose(probability @ weights, total ** np.arange(k + 1), rtol=1e-12)
        if reference is QUARTER:
            np.testing.assert_allclose((probability * weights[:, k]) @ future, exact, rtol=1e-12)
            per_decision = [(probability * weights[:, i]) @ future[:, i] for i in range(k)]
            np.testing.assert_allclose(per_decision, exact, rtol=1e-12)
        else:
            uniform = SYSTEM.expected(history, k, np.array([0.5, 0.5]))
            np.testing.assert_allclose((probability * weights[:, k]) @ future / 2.0**k, uniform, rtol=1e-12)
    assert naive[0] == pytest.approx(exact[0], rel=1e-12)  # no action lies before the next observation
    assert np.abs(naive - exact).max() > 0.05  # what the weights are for


def test_the_marginal_reference_is_the_normal_distribution_of_the_recorded_actions():
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(40, 2)) @ np.array([[2.0, 0.0], [3.0, 1e-3]]) + [5.0, -1e3]
    reference = BlindReference("marginal", actions)
    oracle = multivariate_normal(actions.mean(axis=0), np.cov(actions, rowvar=False, bias=True))
    # the correlation matrix has a condition number of 1e7: scipy's inverse and ours agree to 1e-16 times that
    np.testing.assert_allclose(reference.log_density(actions), oracle.logpdf(actions), rtol=1e-7)
    one = BlindReference("marginal", actions[:, :1]).log_density(actions[:3, :1])
    oracle = multivariate_normal(actions[:, 0].mean(), actions[:, 0].var())
    np.testing.assert_allclose(one, oracle.logpdf(actions[:3, 0]), rtol=1e-12)


def test_of_choices_it_is_their_frequencies_and_the_uniform_one_is_flat():
    np.testing.assert_allclose(np.exp(QUARTER.log_density(np.array([[0.0], [1.0]]))), [0.25, 0.75])
    never = BlindReference("marginal", np.array([[0.0], [2.0]]), 3)
    np.testing.assert_allclose(np.exp(never.log_density(np.array([[0.0], [1.0], [2.0]]))), [0.5, 0.0, 0.5])
    for n_choices in (None, 2):
        flat = BlindReference("uniform", np.ones((3, 1)), n_choices)
        np.testing.assert_array_equal(flat.log_density(np.array([[0.0], [1.0]])), [0.0, 0.0])


def test_weights_are_brought_to_mean_one_and_truncated():
    log_weights = np.log([1.0, 2.0, 3.0, 10.0])
    np.testing.assert_allclose(normalised_weights(log_weights, None), [0.25, 0.5, 0.75, 2.5], rtol=1e-14)
    # 2.5 -> 1.5, and the mean of 0.25, 0.5, 0.75, 1.5 is 0.75
    cut = normalised_weights(log_weights, 1.5)
    np.testing.assert_allclose(cut, [1 / 3, 2 / 3, 1.0, 2.0], rtol=1e-14)
    np.testing.assert_allclose(normalised_weights(log_weights, 2.5), normalised_weights(log_weights, None))
    # a factor does not matter, however large: a density may be in any unit
    for shift in (-1e4, 1e4):
        np.testing.assert_allclose(normalised_weights(log_weights + shift, 1.5), cut, rtol=1e-11)


def test_the_effective_share_is_that_of_kish():
    assert effective_sample_share(np.full(7, 0.3)) == pytest.approx(1.0, rel=1e-14)
    assert effective_sample_share(np.array([0.0, 0.0, 5.0, 0.0])) == pytest.approx(0.25, rel=1e-14)
    assert effective_sample_share(np.array([1.0, 2.0, 3.0])) == pytest.approx(36.0 / 42.0, rel=1e-14)


BLOCK = np.array([0, 1, 1, 0, 2])  # not in order


def rows(n, seed):
    """Inputs, targets, and weights of which some are zero."""
    rng = np.random.default_rng(seed)
    X = rng.normal([0.0, 5.0, 0.0], size=(n, 3))
    Y = X @ rng.normal(size=(3, 5)) + X[:, :1] ** 2 + rng.normal(size=(n, 5))
    return X, Y, rng.exponential(size=(n, 3)) * (rng.random((n, 3)) < 0.8)


def each_by_itself(Z, Y, W, alpha, fit_intercept=True):
    """scikit-learn's ridge on each block: coefficients (m, d), offsets (d,), and the sum of weighted mean squares."""
    A, b, error = np.zeros((Z.shape[1], 5)), np.zeros(5), 0.0
    for j, w in enumerate(W[:, BLOCK].T):
        model = ScikitRidge(alpha=alpha * w.sum(), fit_intercept=fit_intercept, solver="svd")
        model.fit(Z, Y[:, j], sample_weight=w)
        A[:, j], b[j] = model.coef_, model.intercept_
        error += np.average(np.square(Y[:, j] - model.predict(Z)), weights=w)
    return A, b, error


@pytest.mark.parametrize("fit_intercept", [True, False])
@pytest.mark.parametrize("alpha", [0.0, 0.1])
def test_a_weighted_aggregate_is_weighted_least_squares_of_each_block(alpha, fit_intercept):
    X, Y, W = rows(50, 0)
    learner = WeightedAggregate(
        Ridge(alpha=alpha, fit_intercept=fit_intercept), X[:20], np.hstack([Y, W])[:20], BLOCK
    )
    # condition numbers below 100, squared, times 1e-16
    A, b, error = each_by_itself(X[:20], Y[:20], W[:20], alpha, fit_intercept)
    np.testing.assert_allclose(learner.frozen().coef_.T, A, rtol=0, atol=1e-10)
    np.testing.assert_allclose(learner.frozen().intercept_, b, rtol=0, atol=1e-10)
    assert learner.mean_squared_error() == pytest.approx(error, rel=1e-10)
    before = learner.frozen()
    learner.discount(0.5)
    learner.add(learner.encode(X[20:]), np.hstack([Y, W])[20:])
    np.testing.assert_array_equal(learner.frozen().coef_, before.coef_)  # until refit
    learner.refit()
    W[:20] *= 0.5
    A, b, error = each_by_itself(X, Y, W, alpha, fit_intercept)
    np.testing.assert_allclose(learner.frozen().coef_.T, A, rtol=0, atol=1e-10)
    np.testing.assert_allclose(learner.predict(learner.encode(X)), X @ A + b, rtol=0, atol=1e-9)
    assert learner.mean_squared_error() == pytest.approx(error, rel=1e-10)
    assert learner.n_pairs == 50
    assert np.abs(before.coef_ - learner.frozen().coef_).max() > 1e-2  # and the frozen one stays


def test_without_a_penalty_it_is_lstsq_on_rows_times_the_root_of_their_weight():
    X, Y, W = rows(40, 1)
    model = WeightedAggregate(Ridge(alpha=0.0), X, np.hstack([Y, W]), BLOCK).frozen()
    Z = np.hstack([X, np.ones((40, 1))])
    for j in range(5):
        root = np.sqrt(W[:, BLOCK[j]])
        found = np.linalg.lstsq(Z * root[:, None], Y[:, j] * root, rcond=None)[0]
        np.testing.assert_allclose(model.coef_[j], found[:3], rtol=0, atol=1e-10)
        assert model.intercept_[j] == pytest.approx(found[3], abs=1e-9)


def test_it_takes_the_features_of_the_regressor_and_leaves_that_as_it_is():
    X, Y, W = rows(60, 2)
    regressor = PolynomialRidge(degree=2, alpha=1e-2)
    model = WeightedAggregate(regressor, X, np.hstack([Y, W]), BLOCK).frozen()
    assert not hasattr(regressor, "coef_")
    Z = model.features(X)
    assert Z.shape == (60, 9)
    A, b, _ = each_by_itself(Z, Y, W, 1e-2)
    np.testing.assert_allclose(
        model.predict(X), Z @ A + b, rtol=0, atol=1e-8
    )  # features of up to 30, squared


def test_what_is_missing_or_wrong_is_told():
    silent = Sequences(np.zeros((1, 3, 1)), np.ones((1, 2, 1)), np.zeros((1, 2)))
    with pytest.raises(
        ValueError, match="with action_log_probs for importance weights, got Sequences.*GaussianPo"
    ):
        log_ratios(silent, QUARTER)
    with pytest.raises(ValueError, match="reference to be one of .*marginal.*uniform.* got 'normal'"):
        BlindReference("normal", np.zeros((3, 1)))
    rng = np.random.default_rng(0)
    one = rng.normal(size=(9, 1))
    # 0.1 has a mean that differs from it by rounding, so that its computed variance is not 0
    for actions in (np.full((7, 1), 0.1), np.zeros((7, 1)), np.hstack([one, 3.0 * one + 1.0])):
        with pytest.raises(
            ValueError, match="actions that vary in every component.*pass reference='uniform'"
        ):
            BlindReference("marginal", actions)
    with pytest.raises(ValueError, match="alpha finite and at least 0, got -1"):
        WeightedAggregate(Ridge(alpha=-1), np.zeros((3, 1)), np.ones((3, 2)), np.zeros(1, dtype=np.intp))
