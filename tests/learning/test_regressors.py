"""The regressors linear in features, against scikit-learn's ridge, numpy's lstsq and the exact Gaussian kernel."""

import pickle

import numpy as np
import pytest
from sklearn import linear_model
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process.kernels import RBF
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils.estimator_checks import parametrize_with_checks

from beliefgym.learning import PolynomialRidge, RandomForest, RandomFourierRidge, Ridge
from beliefgym.learning.random_fourier import cosine_and_sine

LINEAR = [
    Ridge(alpha=1e-3),
    Ridge(alpha=1e-3, fit_intercept=False),
    RandomFourierRidge(n_frequencies=20, bandwidth=1.5, alpha=1e-4, random_state=3),
    RandomFourierRidge(
        n_frequencies=20, alpha=1e-4, include_inputs=True, fit_intercept=False, random_state=3
    ),
    PolynomialRidge(degree=3, alpha=1e-4),
    PolynomialRidge(alpha=1e-4, fit_intercept=False, interaction_only=True),
]
each_linear = pytest.mark.parametrize("regressor", LINEAR, ids=repr)


def data(n=200, n_inputs=3, n_targets=2, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, n_inputs)) + 0.5
    Y = np.sin(X @ rng.normal(size=(n_inputs, n_targets))) + 0.1 * rng.normal(size=(n, n_targets)) + 2.0
    return X, Y, rng.uniform(0.1, 3.0, size=n)


def sklearn_ridge(features, Y, alpha, fit_intercept, weights=None):
    """The same minimiser: scikit-learn's loss is not divided by the sum of the weights."""
    total = len(features) if weights is None else weights.sum()
    ridge = linear_model.Ridge(alpha=total * alpha, fit_intercept=fit_intercept, solver="svd", tol=0)
    return ridge.fit(features, Y, weights)


def agree(ours, other, X, tolerance=1e-9):
    """Same coefficients and predictions.

    The normal equations' relative error is their condition number (up to 1e6 here: alpha beside the largest variance)
    times 2e-16, about 1e-10.
    """
    np.testing.assert_allclose(ours.coef_, other.coef_, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(ours.intercept_, other.intercept_, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(ours.predict(X), other.predict(X), rtol=tolerance, atol=tolerance)


@parametrize_with_checks(
    [
        Ridge(),
        Ridge(alpha=0.0),
        Ridge(fit_intercept=False),
        RandomFourierRidge(n_frequencies=50, random_state=0),
        RandomFourierRidge(
            n_frequencies=20, bandwidth=2.0, fit_intercept=False, include_inputs=True, random_state=0
        ),
        PolynomialRidge(),
        PolynomialRidge(alpha=1e-3, fit_intercept=False, interaction_only=True),
        RandomForest(n_estimators=10, random_state=0),
        RandomForest(
            n_estimators=5,
            max_depth=None,
            min_samples_leaf=2,
            max_features="sqrt",
            max_samples=50,
            random_state=0,
        ),
    ]
)
def test_scikit_learns_estimator_checks(estimator, check):
    check(estimator)


@each_linear
@pytest.mark.parametrize("weighted", [False, True])
def test_the_model_is_scikit_learns_ridge_on_the_same_features(regressor, weighted):
    X, Y, weights = data()
    weights = weights if weighted else None
    ours = clone(regressor).fit(X, Y, weights)
    phi = ours.features(X)
    theirs = sklearn_ridge(phi, Y, regressor.alpha, regressor.fit_intercept, weights)
    np.testing.assert_allclose(ours.coef_, theirs.coef_, rtol=1e-7, atol=1e-9)  # as in `agree`
    fresh = data(seed=1)[0]
    np.testing.assert_allclose(
        ours.predict(fresh), theirs.predict(ours.features(fresh)), rtol=1e-8, atol=1e-9
    )
    if not regressor.fit_intercept:
        assert not np.any(ours.intercept_)


@pytest.mark.parametrize("fit_intercept", [True, False])
@pytest.mark.parametrize("weighted", [True, False])
def test_ridge_is_scikit_learns_with_n_alpha(fit_intercept, weighted):
    X, Y, weights = data()
    weights = weights if weighted else None
    for y in (Y, Y[:, 0]):
        ours = Ridge(alpha=0.05, fit_intercept=fit_intercept).fit(X, y, weights)
        theirs = sklearn_ridge(X, y, 0.05, fit_intercept, weights)
        agree(ours, theirs, X, tolerance=1e-12)  # condition number below 100
        assert ours.predict(X).shape == y.shape
        assert ours.coef_.shape == (*y.shape[1:], 3)
    column = Ridge(alpha=0.05, fit_intercept=fit_intercept).fit(X, Y[:, :1], weights)
    np.testing.assert_array_equal(
        column.predict(X)[:, 0], ours.predict(X)
    )  # of Y[:, 0], the last of the loop
    assert (column.coef_.shape, column.intercept_.shape) == ((1, 3), (1,))


def test_a_whole_weight_is_that_many_copies():
    X, Y, _ = data(50)
    copies = np.arange(50) % 4  # some rows not at all
    for regressor in LINEAR:
        weighted = clone(regressor).fit(X, Y, copies)
        agree(weighted, clone(regressor).fit(np.repeat(X, copies, axis=0), np.repeat(Y, copies, axis=0)), X)


@pytest.mark.parametrize("bandwidth", [0.7, 2.0, None])
def test_random_features_approach_the_gaussian_kernel_at_the_monte_carlo_rate(bandwidth):
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 40, 3))
    kernel = RBF(3**0.5 if bandwidth is None else bandwidth)(x, y)
    products = []
    for seed in range(100):
        model = RandomFourierRidge(n_frequencies=100, bandwidth=bandwidth, random_state=seed)
        phi_x, phi_y = (model.fit(x, x).features(z) for z in (x, y))
        products.append(phi_x @ phi_y.T)
        # cos^2 + sin^2 = 1: 100 roundings of 2e-16 / 100 each
        np.testing.assert_allclose(np.square(phi_x).sum(axis=1), 1.0, rtol=1e-14)
    for m, product in ((100, products[0]), (10_000, np.mean(products, axis=0))):
        error = product - kernel
        # each entry is a mean of m cosines of variance below 1, and mostly above 0.1 at these distances
        assert 0.2 * m**-0.5 < np.sqrt(np.square(error).mean()) < m**-0.5
        assert np.abs(error).max() < 5 * m**-0.5  # 1600 entries within 5 standard deviations


def test_random_features_are_cosines_then_sines_after_the_inputs():
    X = data(30)[0]
    model = RandomFourierRidge(n_frequencies=7, bandwidth=0.5, include_inputs=True, random_state=5).fit(X, X)
    angles = X @ model.frequencies_
    expected = np.hstack([X, np.cos(angles) / 7**0.5, np.sin(angles) / 7**0.5])
    np.testing.assert_allclose(
        model.features(X), expected, rtol=0, atol=1e-15
    )  # a few roundings of numbers below 1
    without = RandomFourierRidge(n_frequencies=7, bandwidth=0.5, random_state=5).fit(X, X)
    np.testing.assert_array_equal(without.features(X), model.features(X)[:, 3:])
    twice = RandomFourierRidge(n_frequencies=7, bandwidth=1.0, random_state=5).fit(X, X)
    np.testing.assert_array_equal(twice.frequencies_ * 2, model.frequencies_)


def angle_cases():
    odd = (2.0 * np.arange(-500, 500) + 1.0) * np.pi
    near = np.concatenate([odd * (1 + d) for d in (0.0, 2e-16, -2e-16, 1e-12, -1e-8, 1e-4)])
    rng = np.random.default_rng(0)
    large = rng.normal(size=3000) * 10.0 ** rng.uniform(2, 15, size=3000)
    quarter = np.arange(-400, 401) * np.pi / 4  # zeros of the cosine among them
    return np.concatenate(
        [near, large, quarter, np.linspace(-50, 50, 4001), [0.0, -0.0, 5e-324, 1e-300, 1e300]]
    )


def test_cosine_and_sine_are_numpys_to_rounding():
    angle = angle_cases().reshape(2, -1) if len(angle_cases()) % 2 == 0 else angle_cases()[None]
    cosine, sine = np.empty((2, *angle.shape))
    cosine_and_sine(angle.copy(), cosine, sine)
    # a tangent, a square, a sum, a quotient and a product: 3 to 4 half ulps (1.1e-16) of numbers up to 1
    np.testing.assert_allclose(cosine, np.cos(angle), rtol=0, atol=4.5e-16)
    np.testing.assert_allclose(sine, np.sin(angle), rtol=0, atol=4.5e-16)


def test_cosine_and_sine_of_zero_are_exact_and_of_infinity_nan():
    cosine, sine = np.empty((2, 1, 5))
    with np.errstate(invalid="ignore"):
        cosine_and_sine(np.array([[0.0, -0.0, np.inf, -np.inf, np.nan]]), cosine, sine)
    np.testing.assert_array_equal(cosine, [[1.0, 1.0, np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(sine, [[0.0, 0.0, np.nan, np.nan, np.nan]])


@pytest.mark.parametrize("interaction_only", [False, True])
@pytest.mark.parametrize(("n_inputs", "degree"), [(1, 5), (2, 3), (4, 3), (3, 1), (5, 2)])
def test_monomials_are_scikit_learns(n_inputs, degree, interaction_only):
    X = data(20, n_inputs)[0]
    model = PolynomialRidge(degree=degree, interaction_only=interaction_only).fit(X, X)
    theirs = PolynomialFeatures(degree, include_bias=False, interaction_only=interaction_only)
    # both multiply at most five numbers, perhaps in another order: relative 4 half ulps
    np.testing.assert_allclose(model.features(X), theirs.fit_transform(X), rtol=1e-15, atol=0)
    np.testing.assert_array_equal(model.powers_, theirs.powers_)


@each_linear
def test_a_frozen_copy_does_not_learn(regressor):
    X, Y, _ = data()
    model = clone(regressor).fit(X, Y)
    frozen, before = model.frozen(), model.predict(X)
    coefficients = frozen.coef_.copy()
    model.accumulate(X + 3.0, -Y)
    assert not np.allclose(model.predict(X), before)
    np.testing.assert_array_equal(frozen.predict(X), before)
    np.testing.assert_array_equal(frozen.coef_, coefficients)
    assert not hasattr(frozen, "equations_")
    assert frozen.get_params() == model.get_params()


@each_linear
def test_a_pickled_model_predicts_and_learns_the_same(regressor):
    X, Y, _ = data()
    model = clone(regressor).fit(X, Y)
    copy = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(copy.predict(X), model.predict(X))
    np.testing.assert_array_equal(copy.accumulate(X, -Y).coef_, model.accumulate(X, -Y).coef_)


@pytest.mark.parametrize("n", [1, 300, 1500])
def test_blocks_of_rows_do_not_matter(monkeypatch, n):
    X, Y, weights = data(n)
    whole = RandomFourierRidge(n_frequencies=5, random_state=0).fit(X, Y, weights)
    expected = whole.predict(X)
    monkeypatch.setattr("beliefgym.learning.linear_in_features.BLOCK_BYTES", 1)  # the least: 256 rows
    np.testing.assert_allclose(whole.predict(X), expected, rtol=1e-14)  # BLAS may sum in another order
    agree(RandomFourierRidge(n_frequencies=5, random_state=0).fit(X, Y, weights), whole, X)


def test_fit_forgets_and_draws_the_same_features():
    X, Y, _ = data()
    model = RandomFourierRidge(n_frequencies=9, random_state=0).fit(X[:, :2], -Y).fit(X, Y)
    once = RandomFourierRidge(n_frequencies=9, random_state=0).fit(X, Y)
    np.testing.assert_array_equal(model.predict(X), once.predict(X))
    other = RandomFourierRidge(n_frequencies=9, random_state=1).fit(X, Y)
    assert not np.allclose(other.frequencies_, once.frequencies_)


@pytest.mark.parametrize(
    ("regressor", "message"),
    [
        (Ridge(alpha=-1.0), r"expected alpha finite and at least 0, got -1\.0"),
        (Ridge(alpha=np.nan), "expected alpha finite and at least 0, got nan"),
        (RandomFourierRidge(alpha=np.inf), "expected alpha finite and at least 0, got inf"),
        (RandomFourierRidge(n_frequencies=0), "expected n_frequencies to be a whole number >= 1, got 0"),
        (
            RandomFourierRidge(n_frequencies=2.5),
            r"expected n_frequencies to be a whole number >= 1, got 2\.5",
        ),
        (RandomFourierRidge(bandwidth=0.0), r"expected bandwidth finite and above 0, got 0\.0"),
        (RandomFourierRidge(bandwidth=np.inf), "expected bandwidth finite and above 0, got inf"),
        (PolynomialRidge(degree=0), "expected degree to be a whole number >= 1, got 0"),
        (PolynomialRidge(degree=1.5), r"expected degree to be a whole number >= 1, got 1\.5"),
    ],
)
def test_parameters_out_of_range(regressor, message):
    with pytest.raises(ValueError, match=message):
        regressor.fit(np.ones((3, 1)), np.ones(3))


def test_bad_calls():
    X, Y, weights = data()
    for call in ("frozen", "predict", "solutions"):
        with pytest.raises(NotFittedError):
            getattr(Ridge(), call)(*() if call == "frozen" else ([[0.0]],))
    model = Ridge().fit(X, Y)
    with pytest.raises(ValueError, match="expected y with 2 targets as before, got 1"):
        model.accumulate(X, Y[:, 0])
    with pytest.raises(ValueError, match="X has 2 features, but Ridge is expecting 3"):
        model.accumulate(X[:, :2], Y)
    with pytest.raises(ValueError, match="Negative values"):
        model.fit(X, Y, -weights)
    with pytest.raises(ValueError, match="contains NaN"):
        model.fit(X, np.where(Y > 2.5, np.nan, Y))


def test_a_frozen_copy_says_that_it_only_predicts():
    X, y = np.arange(12.0).reshape(6, 2), np.arange(6.0)
    frozen = Ridge().fit(X, y).frozen()
    for call in (lambda: frozen.accumulate(X, y), frozen.solve, lambda: frozen.solutions([1.0])):
        with pytest.raises(ValueError, match="got a frozen copy, which only predicts"):
            call()
    assert frozen.fit(X, 2.0 * y).accumulate(X, 2.0 * y).predict(X)[1] == pytest.approx(2.0, abs=1e-3)


def test_targets_far_from_zero_lose_no_digits():
    """Rounding of targets at 1e6 is 1e-10; sums of their squares about zero would lose to 1e-4."""
    rng = np.random.default_rng(0)
    X, y = rng.normal(size=(200, 2)), rng.normal(size=(200, 2))
    near = RandomFourierRidge(n_frequencies=20, random_state=0).fit(X, y)
    far = RandomFourierRidge(n_frequencies=20, random_state=0).fit(X, y + 1e6)
    np.testing.assert_allclose(far.predict(X) - 1e6, near.predict(X), rtol=0, atol=1e-8)
    losses = [one.equations_.mean_squared_error(one._weights, one._offset) for one in (near, far)]
    assert losses[1] == pytest.approx(losses[0], rel=1e-6)
