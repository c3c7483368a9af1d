"""The flattened forest against scikit-learn's, tree for tree."""

import pickle

import numpy as np
import pytest
from sklearn.ensemble import RandomForestRegressor
from sklearn.exceptions import NotFittedError

from beliefgym.learning import RandomForest

EPS = np.finfo(float).eps


def data(n=400, n_inputs=3, n_targets=2, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, n_inputs))
    return X, np.sin(3 * X[:, :1]) * np.arange(1, n_targets + 1) + X[:, 1:2] + 0.1 * rng.normal(
        size=(n, n_targets)
    )


def assert_same_forest(ours, theirs, X):
    """Equal leaves; their mean differs by the order of summation alone: n_estimators half ulps of the largest."""
    expected = theirs.predict(X)
    np.testing.assert_allclose(
        ours.predict(X), expected, rtol=0, atol=ours.n_estimators * EPS * np.abs(expected).max()
    )


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"max_depth": None},
        {"max_depth": 1},
        {"min_samples_leaf": 7},
        {"max_features": 0.5},
        {"max_features": "sqrt"},
        {"max_features": 2},
        {"max_samples": 100},
        {"max_samples": 0.3},
        {"n_estimators": 1},
    ],
    ids=repr,
)
@pytest.mark.parametrize("n_targets", [1, 3])
def test_predictions_are_scikit_learns(parameters, n_targets):
    X, Y = data(n_targets=n_targets)
    parameters = {"n_estimators": 12, "max_depth": 15, "random_state": 4, **parameters}
    ours = RandomForest(**parameters).fit(X, Y)
    theirs = RandomForestRegressor(**parameters).fit(X, Y if n_targets > 1 else Y[:, 0])
    fresh = data(300, seed=1)[0] * 1.5
    expected = theirs.predict(fresh).reshape(300, n_targets)
    assert ours.predict(fresh).shape == expected.shape
    atol = 12 * EPS * np.abs(expected).max()  # as in assert_same_forest
    np.testing.assert_allclose(ours.predict(fresh), expected, rtol=0, atol=atol)
    for row in range(5):
        np.testing.assert_allclose(ours.predict(fresh[row : row + 1])[0], expected[row], rtol=0, atol=atol)


def test_one_tree_gives_scikit_learns_numbers_bit_for_bit():
    X, Y = data()
    ours = RandomForest(n_estimators=1, max_depth=None, random_state=0).fit(X, Y)
    theirs = RandomForestRegressor(1, random_state=0).fit(X, Y)
    np.testing.assert_array_equal(ours.predict(X), theirs.predict(X))


def test_points_on_a_split_go_where_scikit_learn_sends_them():
    X = np.arange(60.0)[:, None] % 7
    Y = X[:, 0] ** 2
    ours = RandomForest(n_estimators=5, random_state=0).fit(X, Y)
    theirs = RandomForestRegressor(5, max_depth=15, random_state=0).fit(X, Y)
    grid = np.arange(-1.0, 8.0, 0.5)[:, None]  # thresholds lie halfway between whole numbers
    for shift in (0.0, 1e-9, -1e-9):  # below float32's resolution, in which scikit-learn compares
        assert_same_forest(ours, theirs, grid + shift)


def test_more_rows_than_a_block(monkeypatch):
    X, Y = data()
    ours = RandomForest(n_estimators=10, random_state=0).fit(X, Y)
    expected = ours.predict(X)
    for block in (1, 70, 4000, 4010):  # 1 row, 7 rows, all but none left over, one row more than needed
        monkeypatch.setattr("beliefgym.learning.random_forest.BLOCK", block)
        # numpy may sum a single row's trees in another order
        np.testing.assert_allclose(ours.predict(X), expected, rtol=0, atol=10 * EPS * np.abs(expected).max())


def test_one_and_two_dimensional_targets():
    X, Y = data(n_targets=1)
    flat, column = (RandomForest(n_estimators=5, random_state=0).fit(X, y) for y in (Y[:, 0], Y))
    assert flat.predict(X).shape == (400,)
    assert column.predict(X).shape == (400, 1)
    np.testing.assert_array_equal(flat.predict(X), column.predict(X)[:, 0])
    assert flat.predict_unchecked(X).shape == (400, 1)


def test_a_constant_target_is_all_leaf():
    X, Y = data()
    model = RandomForest(n_estimators=3, random_state=0).fit(X, np.full_like(Y, 2.5))
    np.testing.assert_array_equal(model.predict(X), np.full_like(Y, 2.5))


@pytest.mark.parametrize("leaf", [1, 3])
@pytest.mark.parametrize("iteration", [0, 1, 3, 8, 24])
@pytest.mark.parametrize("growth", [1.0, 1.7, 5.0, 26.0])
def test_leaves_grow_with_the_aggregate_as_said(leaf, iteration, growth):
    forest = RandomForest(min_samples_leaf=leaf, max_depth=4, random_state=1)
    grown = forest.for_aggregate(iteration, growth)
    eta = 1 / np.sqrt(1 + iteration)
    assert abs(grown.min_samples_leaf - leaf * max(1, eta * growth)) <= 0.5  # the nearest whole number
    assert isinstance(grown.min_samples_leaf, int)
    assert grown.get_params() == {**forest.get_params(), "min_samples_leaf": grown.min_samples_leaf}
    assert forest.min_samples_leaf == leaf
    fixed = RandomForest(min_samples_leaf=leaf, leaf_growth=False)
    assert fixed.for_aggregate(iteration, growth).get_params() == fixed.get_params()


def test_the_leaf_size_holds_in_the_trees():
    X, Y = data()
    grown = RandomForest(n_estimators=4, max_depth=None, random_state=0).for_aggregate(3, 40.0)
    assert grown.min_samples_leaf == 20  # 40 / sqrt(4)
    grown.fit(X, Y)
    assert grown.min_samples_leaf_ == 20
    theirs = RandomForestRegressor(4, min_samples_leaf=20, random_state=0).fit(X, Y)
    assert_same_forest(grown, theirs, X)


def test_a_number_of_samples_above_n_is_all_of_them():
    X, Y = data()
    many, all_of_them = (
        RandomForest(n_estimators=3, max_samples=k, random_state=0).fit(X, Y) for k in (10_000, 400)
    )
    np.testing.assert_array_equal(many.predict(X), all_of_them.predict(X))
    assert many.max_samples == 10_000


def test_a_pickled_forest_predicts_the_same():
    X, Y = data()
    model = RandomForest(n_estimators=3, random_state=0).fit(X, Y)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(model)).predict(X), model.predict(X))


def test_bad_calls():
    with pytest.raises(NotFittedError):
        RandomForest().predict([[0.0]])
    X, Y = data()
    model = RandomForest(n_estimators=2, random_state=0).fit(X, Y)
    with pytest.raises(ValueError, match="X has 2 features, but RandomForest is expecting 3"):
        model.predict(X[:, :2])
    with pytest.raises(ValueError, match="contains NaN"):
        model.predict(X * np.nan)
