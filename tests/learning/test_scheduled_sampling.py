"""Scheduled sampling, against ridge regression, a loop written out and the schedules of the paper."""

import numpy as np
import pytest
from sklearn.base import clone

from beliefgym.learning import RandomForest, RandomFourierRidge, Ridge, Sequences
from beliefgym.learning.scheduled_sampling import ScheduledSampling, truth_probability

FOURIER = RandomFourierRidge(n_frequencies=6, bandwidth=2.0, alpha=1e-2, random_state=0)


def curved(n=30, n_steps=8, noise=0.02, seed=0, lengths=None):
    """A turning system that saturates, pushed by one action."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, n_steps, 1))
    x = np.empty((n, n_steps + 1, 2))
    x[:, 0] = rng.normal(size=(n, 2))
    for t in range(n_steps):
        x[:, t + 1] = np.tanh(x[:, t] @ np.array([[0.9, -0.3], [0.3, 0.9]]) + u[:, t] * [0.1, 0.3])
    x += noise * rng.standard_normal(x.shape)
    return Sequences.from_observations(x, actions=u, lengths=lengths)


def objective_of(model, train):
    model.n_epochs = 0
    model.fit(train)
    regressor = model._ridge(train)
    return model._objective(train, regressor), regressor


@pytest.mark.parametrize("target", ["delta", "next"])
@pytest.mark.parametrize("decay", ["linear", "exponential", "inverse_sigmoid"])
def test_with_true_inputs_throughout_it_is_plain_one_step_regression(target, decay):
    """Its minimum, where the gradient is zero, is the ridge solution at any time of the training."""
    model = ScheduledSampling(FOURIER, decay=decay, final_truth_probability=1.0, target=target)
    objective, regressor = objective_of(model, curved(lengths=np.arange(30) % 9))
    for progress in (0.0, 0.5, 1.0):
        _, by_weights, by_offset = objective.loss_and_gradient(
            regressor._weights,
            regressor._offset,
            np.arange(objective.n_items),
            progress,
            np.random.default_rng(0),
        )
        penalty = 2.0 * regressor.alpha * np.square(model._change_scale) * regressor._weights
        np.testing.assert_allclose(by_weights, -penalty, atol=1e-11)  # sums of terms of order 1, to rounding
        np.testing.assert_allclose(by_offset, 0.0, atol=1e-11)


def test_training_with_true_inputs_ends_at_the_ridge_solution():
    train = curved()
    model = ScheduledSampling(
        RandomFourierRidge(n_frequencies=3, bandwidth=2.0, alpha=1e-1, random_state=0),
        final_truth_probability=1.0,
        init="zeros",
        n_epochs=150,
        learning_rate=0.1,
        random_state=0,
    )
    single = clone(model).set_params(init="ridge", n_epochs=0).fit(train)
    losses = model.fit(train).history_["loss"]
    z, u = single._coordinates(train)
    episode, t = np.nonzero(train.step_mask)
    errors = single._step(z[episode, t], u[episode, t]) - z[episode, t + 1]
    least = np.square(errors).sum(axis=1).mean()
    least += 1e-1 * np.square(single.model_.coef_.T * single._change_scale).sum()
    assert losses[1] > 1.1 * least
    assert losses[-1] == pytest.approx(least, rel=1e-4)  # Adam's last steps are of 1e-5


@pytest.mark.parametrize("target", ["delta", "next"])
def test_loss_and_gradient_are_those_of_a_regression_on_the_inputs_that_were_used(target):
    """With nothing but predictions as inputs, these are the rollouts of DaD, each with the true next state."""
    train = curved(n=6, lengths=[8, 8, 3, 1, 0, 5])
    model = ScheduledSampling(FOURIER, target=target)
    objective, regressor = objective_of(model, train)
    weights, offset = regressor._weights, regressor._offset
    loss, by_weights, by_offset = objective.loss_and_gradient(
        weights, offset, np.arange(5), 1.0, np.random.default_rng(0)
    )
    z, u = model._coordinates(train)
    rolled = model._forecast(z[:, 0], u)[0]
    episode, t = np.nonzero(train.step_mask)
    inputs, scale = np.concatenate([rolled[episode, t], u[episode, t]], axis=1), model._change_scale
    target_of = (z[episode, t + 1] - rolled[episode, t]) / scale if target == "delta" else z[episode, t + 1]

    def regression(A, b):
        return np.square((regressor.features(inputs) @ A + b - target_of) * scale).sum(axis=1).mean()

    assert loss == pytest.approx(regression(weights, offset), rel=1e-10)
    rng = np.random.default_rng(1)
    for _ in range(5):
        dw, db = rng.standard_normal(weights.shape), rng.standard_normal(offset.shape)
        step = 1e-4  # the regression is quadratic: central differences are exact but for rounding
        up, down = (regression(weights + s * dw, offset + s * db) for s in (step, -step))
        slope = (by_weights * dw).sum() + by_offset @ db
        assert (up - down) / (2 * step) == pytest.approx(slope, rel=1e-7, abs=1e-9)


def test_the_share_of_true_inputs_is_the_schedules():
    """With a model that predicts 100 everywhere, each step on a prediction is told by its features."""
    train = curved(n=400, n_steps=11, noise=0.0)
    model = ScheduledSampling(Ridge(), target="next", divergence_limit=1e6)
    objective, regressor = objective_of(model, train)
    seen = []
    objective._features = lambda X: (seen.append(X[:, 0] == 100.0), regressor.features(X))[1]
    weights, offset = np.zeros_like(regressor._weights), np.full(2, 100.0)
    objective.loss_and_gradient(weights, offset, np.arange(400), 0.25, np.random.default_rng(0))
    assert not seen[0].any()
    share = np.mean(seen[1:])
    assert share == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 4000))  # four standard deviations


def test_mini_batches_estimate_the_loss_without_bias():
    train = curved(n=9, lengths=[8, 2, 0, 1, 6, 8, 3, 7, 8])
    objective, regressor = objective_of(ScheduledSampling(Ridge()), train)
    assert objective.n_items == 8
    arguments = (regressor._weights, regressor._offset)
    found = [
        objective.loss_and_gradient(*arguments, part, 1.0, np.random.default_rng(0))
        for part in np.random.default_rng(0).permutation(8).reshape(4, 2)
    ]
    whole = objective.loss_and_gradient(*arguments, np.arange(8), 1.0, np.random.default_rng(0))
    for i in range(3):
        np.testing.assert_allclose(np.mean([f[i] for f in found], axis=0), whole[i], rtol=1e-10, atol=1e-13)


def test_predictions_that_diverge_are_replaced_by_the_truth():
    train = curved()
    model = ScheduledSampling(Ridge(), target="next")
    objective, regressor = objective_of(model, train)
    weights, offset = np.zeros_like(regressor._weights), np.full(2, 1e9)
    arguments = (weights, offset, np.arange(30))
    all_predicted = objective.loss_and_gradient(*arguments, 1.0, np.random.default_rng(0))
    all_true = objective.loss_and_gradient(*arguments, 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(all_predicted[1], all_true[1])


def test_the_schedules_are_those_of_the_paper():
    s = np.linspace(0.0, 1.0, 101)
    linear, exponential, sigmoid = (
        np.array([truth_probability(decay, 0.05)(x) for x in s])
        for decay in ("linear", "exponential", "inverse_sigmoid")
    )
    np.testing.assert_allclose(np.diff(linear), -0.0095)
    np.testing.assert_allclose(exponential[1:] / exponential[:-1], 0.05**0.01)
    # k / (k + exp(i / k)): the logarithm of 1/eps - 1 is i / k - log k, a line with one k in slope and value
    odds = np.log(1.0 / sigmoid - 1.0)
    k = 10.0 / np.diff(odds)
    np.testing.assert_allclose(k, k[0], rtol=1e-8)
    assert odds[0] == pytest.approx(-np.log(k[0]), rel=1e-8)
    for values in (linear, exponential, sigmoid):
        assert values[0] == pytest.approx(1.0, abs=0.01)  # k / (k + 1) with k above 100
        assert values[-1] == pytest.approx(0.05, rel=1e-8)
        assert (np.diff(values) < 0).all()


def test_the_history_tells_the_schedule_and_the_best_on_validation_is_kept():
    train, validation = curved(), curved(seed=1)
    model = ScheduledSampling(
        FOURIER, horizon=4, n_epochs=5, batch_size=8, learning_rate=0.05, random_state=3
    )
    first, second = clone(model).fit(train, validation), clone(model).fit(train, validation)
    np.testing.assert_array_equal(first.model_.coef_, second.model_.coef_)
    np.testing.assert_allclose(first.history_["truth_probability"], [1.0, 0.8, 0.6, 0.4, 0.2, 0.0])
    assert all(len(values) == 6 for values in first.history_.values())
    assert first.best_epoch_ == np.argmin(first.history_["validation_multi_step"])
    assert first.errors(validation).mean == first.history_["validation_multi_step"].min()


def test_what_lies_past_the_ends_never_matters():
    whole = curved(n=20, n_steps=6)
    short = Sequences.from_observations(whole.observations, actions=whole.actions, lengths=np.arange(20) % 7)
    wide = np.zeros((20, 10, 2))
    wide[:, :7] = whole.observations
    wide[:, 7:] = 1e6
    actions = np.concatenate([whole.actions, np.full((20, 3, 1), 1e6)], axis=1)
    padded = Sequences.from_observations(wide, actions=actions, lengths=np.arange(20) % 7)
    model = ScheduledSampling(Ridge(), horizon=4, n_epochs=3, batch_size=7, random_state=0)
    found = [clone(model).fit(train).model_.coef_ for train in (short, padded)]
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize(
    ("error", "parameters", "message"),
    [
        (TypeError, {"regressor": RandomForest()}, "linear in features .* for ScheduledSampling, got Random"),
        (ValueError, {"decay": "cosine"}, "decay 'linear', 'exponential' or 'inverse_sigmoid', got 'cosine'"),
        (ValueError, {"final_truth_probability": 1.5}, r"in \[0, 1\] with decay 'linear', got 1.5"),
        (ValueError, {"decay": "exponential"}, r"in \(0, 1\] with decay 'exponential', got 0.0"),
        (ValueError, {"horizon": 0}, "horizon to be a whole number of at least 1, got 0"),
        (ValueError, {"batch_size": 0}, "batch_size to be a whole number of at least 1, got 0"),
    ],
)
def test_what_is_wrong_is_told(error, parameters, message):
    with pytest.raises(error, match=message):
        ScheduledSampling(**parameters).fit(curved())
