"""The lagged error and its weighted sibling, against finite differences, ridge regression and linear systems."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning import (
    DataAsDemonstrator,
    DivergenceWarning,
    PolynomialRidge,
    RandomForest,
    RandomFourierRidge,
    Ridge,
    Sequences,
)
from beliefgym.learning.backprop_through_time import (
    BackpropThroughTime,
    LaggedError,
    WeightedMultiHorizon,
)
from beliefgym.learning.multi_step_loss import torch_features

A = np.array([[0.9, 0.3], [-0.3, 0.9]])
REGRESSORS = [
    Ridge(alpha=1e-3),
    RandomFourierRidge(n_frequencies=7, bandwidth=1.5, alpha=1e-3, random_state=0),
    RandomFourierRidge(n_frequencies=5, include_inputs=True, fit_intercept=False, alpha=1e-3, random_state=0),
    PolynomialRidge(degree=3, alpha=1e-3),
    PolynomialRidge(degree=2, interaction_only=True, alpha=1e-3),
]
each_regressor = pytest.mark.parametrize("regressor", REGRESSORS, ids=repr)


def curved(n=30, n_steps=8, noise=0.02, seed=0, lengths=None):
    """A turning system that saturates, pushed by one action."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, n_steps, 1))
    x = np.empty((n, n_steps + 1, 2))
    x[:, 0] = rng.normal(size=(n, 2))
    for t in range(n_steps):
        x[:, t + 1] = np.tanh(x[:, t] @ A.T + u[:, t] * [0.1, 0.3])
    x += noise * rng.standard_normal(x.shape)
    return Sequences.from_observations(x, actions=u, lengths=lengths)


def turning(n, n_steps, noise, seed=0):
    """A linear system, observed with noise."""
    rng = np.random.default_rng(seed)
    x = np.stack([rng.normal(size=(n, 2))] * (n_steps + 1), axis=1)
    for t in range(n_steps):
        x[:, t + 1] = x[:, t] @ A.T
    return Sequences.from_observations(x + noise * rng.standard_normal(x.shape))


def objective_of(model, train):
    """The loss that `fit` minimises, and parameters near its start."""
    model.n_epochs = 0
    model.fit(train)
    regressor = model._ridge(train)
    objective = model._objective(train, regressor)

    def loss(weights, offset, items=None):
        items = np.arange(objective.n_items) if items is None else items
        return objective.loss_and_gradient(weights, offset, items, 0.0, np.random.default_rng(0))

    return loss, objective.n_items, regressor._weights, regressor._offset


@each_regressor
def test_features_in_torch_are_the_regressors_own(regressor):
    X = np.random.default_rng(1).normal(size=(50, 3))
    fitted = clone(regressor).fit(X, X[:, :2])
    ours = torch_features(fitted)(torch.from_numpy(X)).numpy()
    np.testing.assert_allclose(ours, fitted.features(X), rtol=1e-13, atol=1e-15)  # rounding


@each_regressor
@pytest.mark.parametrize("target", ["delta", "next"])
def test_the_gradient_is_that_of_finite_differences(regressor, target):
    train = curved(n=6, lengths=[8, 8, 3, 1, 0, 5])
    model = BackpropThroughTime(regressor, horizon=4, horizon_weights=0.7, target=target)
    loss, _, weights, offset = objective_of(model, train)
    rng = np.random.default_rng(2)
    weights = weights + 0.1 * rng.standard_normal(weights.shape)
    _, by_weights, by_offset = loss(weights, offset)
    for _ in range(5):
        dw, db = rng.standard_normal(weights.shape), rng.standard_normal(offset.shape)
        step = 1e-5
        up = loss(weights + step * dw, offset + step * db)[0]
        down = loss(weights - step * dw, offset - step * db)[0]
        slope = (by_weights * dw).sum() + by_offset @ db
        # central differences are off by step^2 of the third derivative, and by 1e-16 / step of the loss
        assert (up - down) / (2 * step) == pytest.approx(slope, rel=1e-5, abs=1e-8)


@each_regressor
def test_the_loss_is_the_weighted_error_of_rollouts_from_every_step(regressor):
    train = curved(n=5, lengths=[8, 2, 0, 1, 6])
    model = WeightedMultiHorizon(regressor, horizon=3, horizon_weights=0.5)
    loss, _, weights, offset = objective_of(model, train)
    z, u = model._coordinates(train)
    errors = {1: [], 2: [], 3: []}
    for i, length in enumerate(train.lengths):
        for t in range(length):
            now = z[i : i + 1, t]
            for h in range(1, min(3, length - t) + 1):
                now = model._step(now, u[i : i + 1, t + h - 1])
                errors[h].append(np.square(now - z[i, t + h]).sum())
    expected = sum(w * np.mean(errors[h]) for h, w in ((1, 4 / 7), (2, 2 / 7), (3, 1 / 7)))
    assert loss(weights, offset)[0] == pytest.approx(expected, rel=1e-12)
    assert model.criterion(train) == pytest.approx(expected, rel=1e-12)


def test_mini_batches_estimate_the_loss_without_bias():
    train = curved(n=8, lengths=[8, 2, 0, 1, 6, 8, 3, 7])
    loss, n_items, weights, offset = objective_of(LaggedError(Ridge(), horizon=5), train)
    assert n_items == train.n_transitions == 35
    parts = np.random.default_rng(0).permutation(n_items).reshape(7, 5)
    found = [loss(weights, offset, part) for part in parts]
    for i in range(3):
        np.testing.assert_allclose(
            np.mean([f[i] for f in found], axis=0), loss(weights, offset)[i], rtol=1e-10, atol=1e-13
        )


@each_regressor
@pytest.mark.parametrize("target", ["delta", "next"])
def test_the_lagged_error_of_one_step_has_the_ridge_solution_as_its_minimum(regressor, target):
    """The loss is convex there, so that a gradient of zero is its minimum."""
    model = LaggedError(regressor, horizon=1, target=target)
    loss, _, weights, offset = objective_of(model, curved(lengths=np.arange(30) % 9))
    by_weights, by_offset = loss(weights, offset)[1:]
    penalty = 2.0 * regressor.alpha * np.square(model._change_scale) * weights
    np.testing.assert_allclose(by_weights, -penalty, atol=1e-11)  # sums of terms of order 1, to rounding
    if regressor.fit_intercept:
        np.testing.assert_allclose(by_offset, 0.0, atol=1e-11)


@pytest.mark.parametrize("init", ["zeros", "random"])
@pytest.mark.parametrize("fit_intercept", [True, False])
@pytest.mark.parametrize("precondition", [True, False])
def test_training_on_one_step_ends_at_the_ridge_solution(init, fit_intercept, precondition):
    train = curved()
    regressor = RandomFourierRidge(
        n_frequencies=3, bandwidth=2.0, alpha=1e-1, fit_intercept=fit_intercept, random_state=0
    )
    model = LaggedError(
        regressor,
        horizon=1,
        init=init,
        precondition=precondition,
        n_epochs=150,
        learning_rate=0.1,
        random_state=0,
    )
    loss, n_items, weights, offset = objective_of(clone(model), train)
    assert n_items <= model.batch_size  # so that the history's loss is that of all the data
    least = loss(weights, offset)[0]
    losses = model.fit(train).history_["loss"]
    least += regressor.alpha * np.square(model._change_scale * weights).sum()
    assert losses[1] > 1.1 * least
    assert losses[-1] == pytest.approx(least, rel=1e-4)  # Adam's last steps are of 1e-5


def test_from_noise_free_data_the_true_linear_system_is_recovered():
    train = turning(n=10, n_steps=10, noise=0.0)
    model = LaggedError(
        Ridge(alpha=0.0),
        horizon=10,
        init="zeros",
        n_epochs=300,
        learning_rate=0.1,
        batch_size=100,
        random_state=0,
    ).fit(train)
    jacobian = np.stack([model.predict(e) - model.predict(np.zeros((1, 2))) for e in np.eye(2)[:, None]])[
        :, 0
    ]
    np.testing.assert_allclose(jacobian.T, A, atol=1e-5)  # where 300 steps of Adam end


def test_on_noisy_data_a_long_horizon_beats_single_steps_on_its_own_criterion_and_on_the_truth():
    """Noise in the inputs biases single-step regression towards zero; the lagged error sees through it."""
    train, test = turning(n=40, n_steps=20, noise=0.3), turning(n=200, n_steps=20, noise=0.0, seed=1)
    settings = {"horizon": 20, "learning_rate": 0.01, "batch_size": 100, "random_state": 0}
    single = LaggedError(Ridge(), **settings, n_epochs=0).fit(train)
    lagged = LaggedError(Ridge(), **settings, n_epochs=30).fit(train)
    assert lagged.criterion(train) < 0.7 * single.criterion(train)
    assert lagged.errors(test).mean < 0.3 * single.errors(test).mean


def test_weights_of_the_horizons_decay_and_sum_to_one():
    np.testing.assert_allclose(LaggedError(horizon=4)._weights_of_steps(), np.full(4, 0.25))
    weights = WeightedMultiHorizon(horizon=4, horizon_weights=0.5)._weights_of_steps()
    np.testing.assert_allclose(weights, np.array([8.0, 4.0, 2.0, 1.0]) / 15.0)
    np.testing.assert_allclose(
        BackpropThroughTime(horizon=3, horizon_weights=1.0)._weights_of_steps(), np.full(3, 1 / 3)
    )


def test_the_siblings_are_the_base_with_their_weights():
    train = curved()
    settings = {"regressor": Ridge(), "horizon": 3, "n_epochs": 2, "random_state": 0}
    for sibling, weights in ((LaggedError, "uniform"), (WeightedMultiHorizon, 0.5)):
        ours = clone(sibling(**settings)).fit(train)
        base = BackpropThroughTime(horizon_weights=weights, **settings).fit(train)
        np.testing.assert_array_equal(ours.model_.coef_, base.model_.coef_)
        assert set(ours.get_params()) <= set(base.get_params())


def test_what_lies_past_the_ends_never_matters():
    whole = curved(n=20, n_steps=6)
    short = Sequences.from_observations(whole.observations, actions=whole.actions, lengths=np.arange(20) % 7)
    padded = Sequences.concatenate([short, curved(n=1, n_steps=9)])[:20]
    assert padded.n_steps == 9
    model = LaggedError(Ridge(), horizon=4, n_epochs=3, batch_size=7, random_state=0)
    found = [clone(model).fit(train).model_.coef_ for train in (short, padded)]
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("precondition", [True, False])
def test_the_same_seed_gives_the_same_model_and_the_best_on_validation_is_kept(precondition):
    train, validation = curved(), curved(seed=1)
    model = LaggedError(
        REGRESSORS[1],
        n_epochs=6,
        batch_size=32,
        learning_rate=0.05,
        precondition=precondition,
        random_state=3,
    )
    first, second = clone(model).fit(train, validation), clone(model).fit(train, validation)
    np.testing.assert_array_equal(first.model_.coef_, second.model_.coef_)
    history = first.history_
    assert all(len(values) == 7 for values in history.values())
    assert np.isnan(history["loss"][0])
    assert np.isfinite([history[name] for name in history if name != "loss"]).all()
    assert first.best_epoch_ == np.argmin(history["validation_multi_step"])
    assert first.errors(validation).mean == history["validation_multi_step"].min()
    assert np.isnan(clone(model).fit(train).history_["validation_multi_step"]).all()


def test_no_epochs_leave_the_single_step_ridge_model():
    train = curved()
    model = LaggedError(REGRESSORS[1], n_epochs=0).fit(train)
    single = DataAsDemonstrator(REGRESSORS[1], n_iterations=0).fit(train)
    np.testing.assert_allclose(
        model.rollout(train.observations[:, 0], 8, train.actions),
        single.rollout(train.observations[:, 0], 8, train.actions),
        rtol=1e-7,
        atol=1e-9,  # the weights went through whitened coordinates and back
    )


def test_a_fitted_model_pickles_and_predicts_as_before():
    train = curved()
    model = LaggedError(REGRESSORS[1], n_epochs=1).fit(train)
    again = pickle.loads(pickle.dumps(model))
    x, u = train.observations[:, 0], train.actions
    np.testing.assert_array_equal(again.rollout(x, 8, u), model.rollout(x, 8, u))


def test_training_rollouts_that_explode_are_cut_as_rollouts_are():
    x = np.exp(0.5 * np.arange(9))[None, :, None] * np.linspace(0.5, 1.0, 6)[:, None, None]
    train = Sequences.from_observations(x)
    model = LaggedError(PolynomialRidge(degree=3), horizon=8, divergence_limit=3.0, target="next")
    loss, _, weights, offset = objective_of(model, train)
    value, by_weights, by_offset = loss(50.0 * weights, offset)
    assert np.isfinite(value)
    assert np.isfinite(by_weights).all()
    assert np.isfinite(by_offset).all()
    model.model_._set(50.0 * weights, offset)
    assert value == pytest.approx(model.criterion(train), rel=1e-10)


@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
def test_training_that_diverges_is_told_with_its_epoch_and_keeps_the_best_model():
    train = curved()
    model = LaggedError(Ridge(), n_epochs=4, learning_rate=1e200, random_state=0)
    with pytest.warns(
        DivergenceWarning, match=r"training diverged in epoch \d of 4 .*best model, of epoch \d, is kept"
    ):
        model.fit(train, curved(seed=1))
    assert np.isfinite(model.model_.coef_).all()
    assert np.isnan(model.history_["validation_multi_step"][-1])


@pytest.mark.parametrize(
    ("error", "parameters", "message"),
    [
        (TypeError, {"regressor": RandomForest()}, "linear in features .* for LaggedError, got RandomForest"),
        (ValueError, {"horizon": 9}, "horizon of at most the longest trajectory's 8 steps, got 9"),
        (ValueError, {"horizon": 0}, "horizon to be a whole number of at least 1, got 0"),
        (ValueError, {"horizon": None}, "horizon to be a whole number of at least 1, got None"),
        (ValueError, {"batch_size": 2.5}, "batch_size to be a whole number of at least 1, got 2.5"),
        (ValueError, {"n_epochs": -1}, "n_epochs to be a whole number of at least 0, got -1"),
        (ValueError, {"learning_rate": 0.0}, "learning_rate above 0, got 0.0"),
        (ValueError, {"max_gradient_norm": -1.0}, "max_gradient_norm above 0 or None, got -1.0"),
        (ValueError, {"init": "ones"}, "init to be 'ridge', 'zeros' or 'random', got 'ones'"),
    ],
)
def test_what_is_wrong_is_told(error, parameters, message):
    with pytest.raises(error, match=message):
        LaggedError(**parameters).fit(curved())


def test_wrong_weights_and_early_calls_are_told():
    with pytest.raises(ValueError, match=r"decay of the horizon's weights in \(0, 1\], got 1.5"):
        WeightedMultiHorizon(horizon_weights=1.5).fit(curved())
    with pytest.raises(ValueError, match="horizon_weights 'uniform' or a number, got 'linear'"):
        BackpropThroughTime(horizon_weights="linear").fit(curved())
    with pytest.raises(NotFittedError, match="this LaggedError is not fitted yet"):
        LaggedError().criterion(curved())


def test_the_package_imports_torch_only_for_these_models():
    script = (
        "import sys, beliefgym.learning as learning; assert 'torch' not in sys.modules; "
        "learning.LaggedError; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
