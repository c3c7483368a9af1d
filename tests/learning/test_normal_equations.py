"""Least squares from sums: batch by batch, for many ridge values, far from zero and with dependent features."""

import numpy as np
import pytest
from sklearn import linear_model

from beliefgym.learning import PolynomialRidge, RandomFourierRidge, Ridge
from beliefgym.learning.normal_equations import NormalEquations

EPS = np.finfo(float).eps


def data(n=300, n_inputs=4, n_targets=2, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, n_inputs))
    return (
        X,
        X @ rng.normal(size=(n_inputs, n_targets)) + rng.normal(size=(n, n_targets)),
        rng.uniform(size=n),
    )


def centred(values, weights=None):
    """About the weighted mean, twice: once leaves the mean's own rounding."""
    for _ in range(2):
        values = values - np.average(values, axis=0, weights=weights)
    return values


@pytest.mark.parametrize(
    "regressor",
    [
        Ridge(alpha=0.01),
        Ridge(alpha=0.01, fit_intercept=False),
        PolynomialRidge(alpha=0.01),
        RandomFourierRidge(n_frequencies=10, alpha=0.001, random_state=0),
    ],
    ids=repr,
)
@pytest.mark.parametrize("weighted", [False, True])
def test_ten_batches_are_one_fit(regressor, weighted):
    X, Y, weights = data()
    once = regressor.__class__(**regressor.get_params()).fit(X, Y, weights if weighted else None)
    many = regressor.__class__(**regressor.get_params())
    for part in np.array_split(np.argsort(X[:, 0]), 10):  # sorted: the first batch is unlike the others
        many.accumulate(X[part], Y[part], weights[part] if weighted else None)
    # condition number up to 1e3, sums of 300 rows in another order: 1e3 * sqrt(300) * 1e-16
    np.testing.assert_allclose(many.coef_, once.coef_, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(many.intercept_, once.intercept_, rtol=1e-11, atol=1e-11)
    assert many.equations_.n_rows == once.equations_.n_rows == 300
    assert many.equations_.weight == pytest.approx(
        weights.sum() if weighted else 300, rel=1e-13
    )  # 300 roundings


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("n_batches", [1, 10])
def test_data_far_from_zero_lose_no_digits(weighted, n_batches):
    X, Y, weights = data()
    weights = weights if weighted else None
    near = linear_model.LinearRegression().fit(X, Y, weights)
    far = Ridge(alpha=0.0)
    for part in np.array_split(np.arange(len(X)), n_batches):
        far.accumulate(X[part] + 1e6, Y[part] - 1e6, None if weights is None else weights[part])
    # X + 1e6 itself is rounded to 1e-10; sums about zero would lose 1e12 of 1e16, and show errors of 1e-4
    np.testing.assert_allclose(far.coef_, near.coef_, rtol=0, atol=1e-9)
    np.testing.assert_allclose(far.predict(X + 1e6) + 1e6, near.predict(X), rtol=0, atol=3e-9)


def test_a_first_batch_of_no_weight_does_not_set_the_shift():
    X, Y, _ = data()
    equations = NormalEquations(4, 2)
    equations.add(X[:10], Y[:10], np.zeros(10))
    equations.add(X + 1e6, Y)
    least = linear_model.LinearRegression().fit(X, Y)
    np.testing.assert_allclose(equations.solve(0.0)[0].T, least.coef_, rtol=0, atol=1e-9)  # as above


@pytest.mark.parametrize("regressor", [Ridge(), Ridge(fit_intercept=False), PolynomialRidge()], ids=repr)
def test_solutions_are_separate_fits(regressor):
    X, Y, weights = data()
    alphas = [0.0, 1e-6, 1e-2, 1.0, 1e4]
    model = regressor.__class__(**regressor.get_params()).fit(X, Y, weights)
    before = model.coef_.copy()
    found = model.solutions(alphas)
    for alpha, one in zip(alphas, found, strict=True):
        separate = regressor.__class__(**{**regressor.get_params(), "alpha": alpha}).fit(X, Y, weights)
        assert one.get_params() == separate.get_params()
        # eigendecomposition and Cholesky of a matrix of condition number below 1e3
        np.testing.assert_allclose(one.predict(X), separate.predict(X), rtol=0, atol=1e-11)
    assert np.abs(found[0].coef_ - found[3].coef_).max() > 0.01  # the values of alpha do matter
    np.testing.assert_array_equal(model.coef_, before)
    one = found[2].accumulate(X, -Y)  # continues with its own alpha, and alone
    both = regressor.__class__(**{**regressor.get_params(), "alpha": 1e-2})
    both.fit(np.vstack([X, X]), np.vstack([Y, -Y]), np.concatenate([weights, np.ones(len(X))]))
    np.testing.assert_allclose(one.coef_, both.coef_, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(model.solve().coef_, before)
    np.testing.assert_array_equal(found[0].predict(X), model.solutions([0.0])[0].predict(X))


def dependent(kind, rng, n):
    X = rng.normal(size=(n, 3))
    if kind == "the same column twice":
        return np.column_stack([X, X[:, 0]])
    if kind == "a sum of two":
        return np.column_stack([X + 100.0, X[:, 0] + X[:, 1]])
    if kind == "two dependent ones":
        return np.column_stack([X, X[:, 0] - X[:, 1], X[:, 2] / 3 + X[:, 0]])
    if kind == "a constant":
        return np.column_stack([X, np.full(n, rng.normal())])
    return rng.normal(size=(5, 8))


@pytest.mark.parametrize("fit_intercept", [True, False])
@pytest.mark.parametrize(
    "kind",
    ["the same column twice", "a sum of two", "two dependent ones", "a constant", "more columns than rows"],
)
def test_without_a_penalty_dependent_features_get_the_least_norm_solution(kind, fit_intercept):
    # many draws: whether rounding makes a zero pivot positive is a matter of luck
    for seed in range(40):
        rng = np.random.default_rng(seed)
        X = dependent(kind, rng, n=(30, 2000)[seed % 2])
        if kind == "a sum of two" and not fit_intercept:
            X = X - (100.0, 100.0, 100.0, 0.0)  # else three columns nearly alike: condition number 1e4
        Y = rng.normal(size=(len(X), 2)) + X[:, :2]
        model = Ridge(alpha=0.0, fit_intercept=fit_intercept).fit(X, Y)
        Z, V = (centred(X), centred(Y)) if fit_intercept else (X, Y)
        least = np.linalg.lstsq(Z, V, rcond=1e-10)[0]  # dependent directions: below 1e-12 of the largest
        # condition number of the normal equations up to 1e6 for a few of the draws with as few rows as columns
        np.testing.assert_allclose(model.coef_.T, least, rtol=0, atol=1e-9, err_msg=f"seed {seed}")
        np.testing.assert_allclose(model.solutions([0.0])[0].coef_.T, least, rtol=0, atol=1e-9)


@pytest.mark.parametrize("alpha", [0.0, 1e-12, 1e-6])
def test_a_constant_feature_gets_no_weight_whatever_the_weights_and_batches(alpha):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        X, Y, weights = data(seed=seed)
        P = np.column_stack([X, np.full(len(X), rng.normal() * 10.0 ** rng.uniform(-3, 6))])
        model = Ridge(alpha=alpha)
        for part in np.array_split(np.arange(len(X)), 5):
            model.accumulate(P[part], Y[part], weights[part])
        without = Ridge(alpha=alpha).fit(X, Y, weights)
        # condition number 2
        np.testing.assert_allclose(model.predict(P), without.predict(X), rtol=0, atol=1e-12)


def test_features_of_very_different_scales_keep_their_weights():
    X, Y, _ = data()
    scale = 10.0 ** np.array([-9, -3, 0, 6])
    model, scaled = Ridge(alpha=0.0).fit(X, Y), Ridge(alpha=0.0).fit(X * scale, Y)
    # Cholesky does not feel the scaling of columns
    np.testing.assert_allclose(scaled.coef_ * scale, model.coef_, rtol=0, atol=1e-12)


@pytest.mark.parametrize("intercept", [True, False])
@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("far", [0.0, 1e3])
def test_the_mean_squared_error_from_sums_is_the_direct_one(intercept, weighted, far):
    X, Y, weights = data()
    Z, V = X + far, Y - far
    equations = NormalEquations(4, 2, intercept=intercept)
    for part in np.array_split(np.arange(len(X)), 7):
        equations.add(Z[part], V[part], weights[part] if weighted else None)
    rng = np.random.default_rng(1)
    for A, b in [
        equations.solve(0.1),
        (rng.normal(size=(4, 2)), rng.normal(size=2) if intercept else np.zeros(2)),
    ]:
        squares = np.square(Z @ A + b - V).sum(axis=1)
        direct = np.average(squares, weights=weights if weighted else None)
        # the sums cancel: 1e-16 of the mean square of targets and predictions, times a few terms
        power = np.square(Z @ A).sum(axis=1).mean() + np.square(V).sum(axis=1).mean()
        assert equations.mean_squared_error(A, b) == pytest.approx(direct, rel=0, abs=100 * EPS * power)


def test_sums_of_nothing():
    equations = NormalEquations(3, 2)
    assert np.isnan(equations.mean_squared_error(np.zeros((3, 2)), np.zeros(2)))
    for A, b in (equations.solve(1.0), equations.solve(0.0), *equations.path([0.0, 1.0])):
        assert not A.any()
        assert not b.any()
    X, Y, _ = data(n_inputs=3)
    equations.add(X[:0], Y[:0])
    assert (equations.n_rows, equations.weight) == (0, 0.0)
    equations.add(X, Y, np.zeros(len(X)))
    assert not equations.solve(0.0)[0].any()


def test_a_copy_is_independent():
    X, Y, _ = data()
    equations = NormalEquations(4, 2)
    equations.add(X, Y)
    copy, before = equations.copy(), equations.solve(0.1)
    copy.add(X, -Y)
    np.testing.assert_array_equal(equations.solve(0.1)[0], before[0])
    assert (equations.n_rows, copy.n_rows) == (300, 600)
    assert np.abs(copy.solve(0.1)[0]).max() < 1e-12  # Y and -Y cancel to rounding


def test_what_is_given_stays_untouched():
    X, Y, weights = data()
    given = [a.copy() for a in (X, Y, weights)]
    Ridge().fit(X, Y, weights).accumulate(X, Y, weights).predict(X)
    RandomFourierRidge(n_frequencies=3, random_state=0).fit(X, Y, weights).predict(X)
    for array, before in zip((X, Y, weights), given, strict=True):
        np.testing.assert_array_equal(array, before)
