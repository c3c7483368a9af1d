"""AR-k: regression on the last k observations, from the first step of every trajectory."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.linear_model import HuberRegressor

from beliefgym.learning import RandomForest, Ridge, Sequences
from beliefgym.learning.autoregressive_filter import AutoregressiveFilter
from beliefgym.learning.dynamics import DivergenceWarning

LEAST_SQUARES = Ridge(alpha=0.0)


def episodes(lengths=(30, 12, 7, 1), n_obs=2, seed=0):
    """Walks that are pulled back, far from zero, in different units; lists of (L + 1, n_obs)."""
    rng = np.random.default_rng(seed)
    found = []
    for length in lengths:
        x = np.zeros((length + 1, n_obs))
        for t in range(length):
            x[t + 1] = 0.8 * x[t] - 0.3 * x[t - 1] + rng.normal(size=n_obs)
        found.append(x * np.geomspace(1, 100, n_obs) + 50.0)
    return found


def least_squares(series, k, pad):
    """(inputs with a constant, coefficients): windows stacked one by one, newest first."""
    mean = np.concatenate(series).mean(axis=0)
    inputs, targets = [], []
    for x in series:
        for t in range(1 if pad else k, len(x)):
            past = [x[t - j] if t - j >= 0 else mean for j in range(1, k + 1)]
            inputs.append(np.concatenate([*past, [1.0]]))
            targets.append(x[t])
    return np.linalg.lstsq(np.array(inputs), np.array(targets), rcond=None)[0], mean


@pytest.mark.parametrize("standardise", [True, "together", False])
@pytest.mark.parametrize("pad", [True, False])
@pytest.mark.parametrize("k", [1, 3])
def test_predictions_are_those_of_least_squares_on_stacked_windows(k, pad, standardise):
    series = episodes()
    coefficients, mean = least_squares(series, k, pad)
    model = AutoregressiveFilter(LEAST_SQUARES, n_past=k, pad_start=pad, standardise=standardise)
    model.fit(Sequences.from_episodes(series))
    x = episodes((9,), seed=5)[0]
    belief = model.initial_belief()
    for t in range(len(x)):
        past = [x[t - j] if t - j >= 0 else mean for j in range(1, k + 1)]
        expected = np.concatenate([*past, [1.0]]) @ coefficients
        # predictions of size 100 by two solvers of a problem of condition 1e2 to 1e4 (raw units): 1e-10 at most
        np.testing.assert_allclose(model.predict_observation(belief)[0], expected, rtol=1e-9)
        belief = model.update(belief, x[t : t + 1])


def test_the_belief_is_the_last_observations_newest_first_after_the_mean():
    series = episodes()
    model = AutoregressiveFilter(n_past=3, standardise=False).fit(Sequences.from_episodes(series))
    assert model.belief_size == 6
    np.testing.assert_allclose(
        model.initial_belief()[0], np.tile(np.concatenate(series).mean(axis=0), 3), rtol=1e-14
    )
    belief = model.initial_belief()
    for row in np.arange(8.0).reshape(4, 1, 2) + 50:
        belief = model.update(belief, row)
    np.testing.assert_array_equal(belief[0], [56, 57, 54, 55, 52, 53])
    standardised = clone(model).set_params(standardise=True).fit(Sequences.from_episodes(series))
    np.testing.assert_array_equal(standardised.initial_belief(), np.zeros((1, 6)))


def test_a_noiseless_second_order_process_is_predicted_exactly():
    t = np.arange(40)
    x = np.stack([3 + np.cos(0.3 * t + phase) for phase in np.linspace(0, 6, 8)])[:, :, None]
    data = Sequences.from_observations(x)
    model = AutoregressiveFilter(LEAST_SQUARES, n_past=2, pad_start=False).fit(data)
    errors = model.errors(data, horizon=10).squared
    assert np.nanmax(errors[:, 2:]) < 1e-20  # ten steps of 1e-13 each, squared
    assert errors[:, 0, 0].min() > 1e-4  # nothing seen: not exact
    one = AutoregressiveFilter(LEAST_SQUARES, n_past=1, pad_start=False).fit(data)
    assert one.errors(data).mean > 0.01  # one observation is not the state


def test_short_trajectories_count_with_padding_and_are_told_without():
    short = Sequences.from_episodes(episodes((2, 1, 2)))
    assert np.isfinite(AutoregressiveFilter(n_past=5).fit(short).errors(short).mean)
    with pytest.raises(ValueError, match="at least n_past \\+ 1 = 6 observations, got 3 of at most 3"):
        AutoregressiveFilter(n_past=5, pad_start=False).fit(short)


def test_padding_serves_the_first_steps():
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(size=(300, 16, 1)), axis=1) * 0.3 + rng.normal(size=(300, 16, 1))
    train, test = Sequences.from_observations(x[:150]), Sequences.from_observations(x[150:])
    by_time = [
        AutoregressiveFilter(n_past=8, pad_start=pad).fit(train).errors(test).by_time for pad in (True, False)
    ]
    assert by_time[0][1:8].mean() < by_time[1][1:8].mean()
    assert by_time[0][8:].mean() > by_time[1][8:].mean()


@pytest.mark.parametrize(
    "regressor",
    [
        RandomForest(n_estimators=10, min_samples_leaf=5, random_state=0),
        ExtraTreesRegressor(n_estimators=10, min_samples_leaf=5, random_state=0),
        HuberRegressor(),  # one target only
    ],
    ids=["RandomForest", "ExtraTreesRegressor", "HuberRegressor"],
)
def test_any_regressor_predicts_better_than_the_mean(regressor):
    train, test = Sequences.from_episodes(episodes((100,) * 10)), Sequences.from_episodes(episodes((50,) * 5))
    error = AutoregressiveFilter(regressor, n_past=2).fit(train).errors(test).mean
    spread = np.square(test.observations - test.observations.mean(axis=(0, 1))).sum(axis=2).mean()
    # the innovations' share of the variance is 1 - 0.8 rho_1 + 0.3 rho_2 = 0.57, with rho_1 = 0.8 / 1.3
    assert error < 0.8 * spread


def test_a_nonlinear_regressor_learns_a_nonlinear_map():
    x = np.empty((20, 60, 1))
    x[:, 0, 0] = np.random.default_rng(0).uniform(0.1, 0.9, 20)
    for t in range(59):
        x[:, t + 1] = 3.8 * x[:, t] * (1 - x[:, t])
    data = Sequences.from_observations(x)
    forest = AutoregressiveFilter(RandomForest(n_estimators=20, random_state=0), n_past=1)
    linear = AutoregressiveFilter(n_past=1)
    train, test = data[:15], data[15:]
    assert forest.fit(train).errors(test).mean < 0.01 * linear.fit(train).errors(test).mean


def test_a_batch_is_its_trajectories_one_by_one():
    data = Sequences.from_episodes(episodes())
    model = AutoregressiveFilter(n_past=3).fit(data)
    whole = model.beliefs(data)
    for i, one in enumerate(data):
        np.testing.assert_allclose(whole[i : i + 1], model.beliefs(one), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(model.errors(data).by_episode[i], model.errors(one).mean, rtol=1e-9)


def test_constant_duplicate_and_wildly_scaled_components():
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(size=(10, 50, 1)), axis=1)
    many = np.concatenate([x, x, np.full_like(x, 7.0), 1e9 * x, 1e-9 * x], axis=2)
    one = AutoregressiveFilter(LEAST_SQUARES, n_past=3).fit(Sequences.from_observations(x))
    with pytest.warns(UserWarning, match="observations \\[2\\] do not vary"):
        model = AutoregressiveFilter(LEAST_SQUARES, n_past=3).fit(Sequences.from_observations(many))
    forecast = model.forecast(model.beliefs(Sequences.from_observations(many))[:, -1], 5)
    expected = one.forecast(one.beliefs(Sequences.from_observations(x))[:, -1], 5)
    np.testing.assert_allclose(forecast[:, :, 2], 7.0)
    for i, scale in enumerate([1, 1, None, 1e9, 1e-9]):
        if scale:
            # the pseudo-inverse of a Gram matrix keeps about half the digits
            np.testing.assert_allclose(forecast[:, :, [i]], scale * expected, rtol=1e-6, atol=1e-6 * scale)


def test_a_forecast_that_grows_is_cut_and_told():
    x = 1.2 ** np.arange(30)[None, :, None] * np.array([[[1.0]], [[-1.0]]])
    data = Sequences.from_observations(x)
    model = AutoregressiveFilter(LEAST_SQUARES, n_past=1, pad_start=False).fit(data)
    belief = model.beliefs(data)[:, -1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.forecast(belief, 5)  # 1.2^5 times the largest: within the limit of 10
    with pytest.warns(DivergenceWarning, match="kept inside"):
        far = model.forecast(belief, 1000)
    assert np.abs(far).max() <= 12.1 * np.abs(x).max()  # the limit, and one more step from there


def test_parameters_are_checked_and_cloned():
    data = Sequences.from_episodes(episodes())
    for wrong in (0, 1.5, True):
        with pytest.raises(ValueError, match="expected n_past to be a whole number of at least 1"):
            AutoregressiveFilter(n_past=wrong).fit(data)
    model = AutoregressiveFilter(Ridge(alpha=0.1), n_past=4, pad_start=False)
    twin = clone(model)
    assert twin.get_params(deep=False)["pad_start"] is False
    assert twin.fit(data).regressor.alpha == 0.1
    np.testing.assert_array_equal(
        twin.predict_observation(twin.initial_belief()),
        model.fit(data).predict_observation(model.initial_belief()),
    )
