"""How hints are read off beliefs, how sure of them one may be, and the errors of Tables 3.6 to 3.8, by hand."""

import pickle

import numpy as np
import pytest
from by_hand import RidgeOfAll
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.ensemble import GradientBoostingRegressor
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from beliefgym.learning import Sequences
from beliefgym.learning.hint_autoregressive import AutoregressiveHints
from beliefgym.learning.hint_errors import HintErrors
from beliefgym.learning.hint_reading import CLIPPED, HintReading, ResidualVariance
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.splits import fold_indices

CANDIDATES = {
    "linear": Ridge(),
    "steps": RandomForest(n_estimators=20, random_state=0),
    "waves": RandomFourierRidge(n_frequencies=100, bandwidth=1.0, alpha=1e-4, random_state=0),
}


def beliefs(n_episodes=12, n_rows=40, size=3, seed=0):
    """Rows, each trajectory about a level of its own, and the trajectory of each."""
    rng = np.random.default_rng(seed)
    rows = 0.5 * rng.normal(size=(n_episodes, 1, size)) + rng.normal(size=(n_episodes, n_rows, size))
    return rows.reshape(-1, size), np.repeat(np.arange(n_episodes), n_rows)


TRUTHS = {
    "linear": lambda m: m @ np.array([[1.0, -1.0], [0.5, 0.0], [0.0, 2.0]]),
    "steps": lambda m: np.where(m[:, :2] > 0, 1.0, -1.0),
    "waves": lambda m: np.stack([np.sin(2.0 * m[:, 0] + m[:, 1]), np.cos(2.0 * m[:, 1])], axis=1),
}


@pytest.mark.parametrize("name", TRUTHS)
def test_the_regressor_that_is_right_is_chosen(name):
    rows, episode = beliefs()
    truth = TRUTHS[name](rows)
    hints = truth + 0.1 * np.random.default_rng(1).normal(size=truth.shape)
    reading = HintReading().fit(rows, hints, episode, CANDIDATES)
    assert reading.name == name
    assert set(reading.errors) == set(CANDIDATES)
    assert reading.errors[name] == min(reading.errors.values())
    assert type(reading.model) is type(CANDIDATES[name])
    # fitted to all rows, as by hand
    expected = clone(CANDIDATES[name]).fit(rows, hints).predict(rows)
    np.testing.assert_allclose(reading.mean(rows, 2), expected, atol=1e-10)
    assert not hasattr(CANDIDATES[name], "n_features_in_")  # what was given is not touched


def test_levels_of_trajectories_do_not_pass_for_knowledge():
    """The hint is noise about a level of each trajectory, that rows tell it by: learned by heart, it helps nowhere."""
    rng = np.random.default_rng(0)
    episode = np.repeat(np.arange(20), 30)
    rows = rng.normal(size=(20, 2))[episode] + 1e-3 * rng.normal(size=(600, 2))
    hints = rng.normal(size=(20, 1))[episode]
    forest = RandomForest(n_estimators=10, random_state=0)
    reading = HintReading().fit(rows, hints, episode, {"linear": Ridge(alpha=10.0), "forest": forest})
    assert reading.name == "linear"
    assert (
        np.abs(forest.fit(rows, hints).predict(rows) - hints[:, 0][:, None]).mean() < 0.1
    )  # by heart it is right
    assert reading.errors["forest"] > 0.7


class Watching(RegressorMixin, BaseEstimator):
    """Least squares that notes which rows it was fitted to and which it is asked for; the first input names them."""

    calls = ()

    def fit(self, X, y):
        Watching.calls.append(("fit", set(X[:, 0])))
        self.model_ = LinearRegression().fit(X, y)
        return self

    def predict(self, X):
        Watching.calls.append(("predict", set(X[:, 0])))
        return self.model_.predict(X)

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def test_folds_never_share_a_trajectory():
    episode = np.array([7, 7, 3, 3, 3, 11, 11, 2, 2, 5, 5, 8, 8, 8, 3, 7])  # any numbers, in any order
    rows = np.stack([episode, np.random.default_rng(0).normal(size=len(episode))], axis=1)
    Watching.calls = []
    HintReading().fit(rows, np.ones((len(episode), 2)), episode, {"it": Watching()})
    fits = [ids for what, ids in Watching.calls if what == "fit"]
    assert fits[0] == fits[-1] == set(episode)  # where there is nothing left out, and in the end
    assert len(fits) == 7
    left_out = []
    for (first, seen), (second, asked) in zip(Watching.calls[2:12:2], Watching.calls[3:12:2], strict=True):
        assert (first, second) == ("fit", "predict")
        assert not seen & asked
        assert seen | asked == set(episode)
        left_out += asked
    assert sorted(left_out) == sorted(set(episode))  # each once


@pytest.mark.parametrize("n_episodes", [2, 3, 5, 12])
def test_the_error_is_that_of_an_independent_cross_validation(n_episodes):
    rows, episode = beliefs(n_episodes, 15)
    hints = TRUTHS["waves"](rows)
    reading = HintReading().fit(rows, hints, episode, {"a": Ridge(alpha=1e-2), "b": Ridge(alpha=1e-5)})
    for name, alpha in (("a", 1e-2), ("b", 1e-5)):
        squares = []
        for left, out in fold_indices(n_episodes, min(5, n_episodes), 0, None):
            held = np.isin(episode, out)
            np.testing.assert_array_equal(np.isin(episode, left), ~held)
            model = RidgeOfAll(alpha).fit(rows[~held], hints[~held])
            squares.append(np.square(model.predict(rows[held]) - hints[held]).sum(axis=1))
        error = np.sqrt(np.concatenate(squares).mean())
        assert reading.errors[name] == pytest.approx(error, rel=1e-9)


def test_one_trajectory_is_judged_by_itself():
    rows, _ = beliefs(1, 50)
    hints = TRUTHS["waves"](rows)
    reading = HintReading().fit(rows, hints, np.zeros(50, int), {"a": Ridge(alpha=1.0), "b": Ridge()})
    residual = RidgeOfAll(1e-6).fit(rows, hints).predict(rows) - hints
    assert reading.name == "b"
    assert reading.errors["b"] == pytest.approx(np.sqrt(np.square(residual).sum(axis=1).mean()), rel=1e-9)
    assert reading.variance.penalty == np.inf
    np.testing.assert_allclose(reading.variance(rows[:4]), [np.square(residual).mean(axis=0)] * 4, rtol=1e-9)


def test_unseen_trajectories_tell_the_variance_and_nothing_else():
    rows, episode = beliefs()
    rng = np.random.default_rng(0)
    hints = TRUTHS["linear"](rows) + 0.1 * rng.normal(size=(len(rows), 2))
    others, which = beliefs(seed=1)
    truth = TRUTHS["linear"](others) + [0.3, 3.0] * rng.normal(size=(len(others), 2))
    alone = HintReading().fit(rows, hints, episode, CANDIDATES)
    reading = HintReading().fit(rows, hints, episode, CANDIDATES, (others, truth, which))
    assert reading.name == alone.name
    assert reading.errors == alone.errors
    np.testing.assert_array_equal(reading.mean(others, 2), alone.mean(others, 2))
    # 480 squares: relative standard error sqrt(2 / 480) = 0.06
    np.testing.assert_allclose(alone.variance(others).mean(axis=0), [0.01, 0.01], rtol=0.25)
    np.testing.assert_allclose(reading.variance(others).mean(axis=0), [0.09, 9.0], rtol=0.25)
    single = HintReading().fit(rows, hints, episode, {"it": Ridge()}, (others, truth, which))
    assert single.errors == {}
    assert single.name == "it"


def test_a_regressor_of_one_target_is_fitted_for_each_component():
    rows, episode = beliefs(6, 20)
    hints = TRUTHS["steps"](rows)
    regressor = GradientBoostingRegressor(n_estimators=5, random_state=0)
    reading = HintReading().fit(rows, hints, episode, {"boosted": regressor})
    for i in range(2):
        expected = clone(regressor).fit(rows, hints[:, i]).predict(rows)
        np.testing.assert_allclose(reading.mean(rows, 2)[:, i], expected, rtol=1e-12)


def squares_of(variance, seed):
    return variance * np.square(np.random.default_rng(seed).normal(size=variance.shape))


@pytest.mark.parametrize("scale", [1.0, 1e-8, 1e8])
def test_a_log_linear_variance_is_recovered(scale):
    rows, episode = beliefs(60, 60)
    truth = scale * np.exp(rows @ np.array([[0.8, 0.0], [-0.5, 0.3], [0.0, 0.0]]) + [0.0, 1.0])
    found = ResidualVariance().fit(rows, squares_of(truth, 1), episode)
    assert np.isfinite(found.penalty)
    error = np.log(found(rows)) - np.log(truth)
    # log of a squared normal has deviation 2.2: coefficients of 3,600 rows have 0.04 each; 6 of them, and penalties
    assert np.sqrt(np.square(error).mean()) < 0.15
    assert np.abs(np.median(error, axis=0)).max() < 0.1


def test_a_variance_that_grows_with_the_square_is_recovered():
    rows, episode = beliefs(60, 60)
    truth = np.exp(0.4 * np.square(rows[:, :1]))
    found = ResidualVariance().fit(rows, squares_of(truth, 1), episode)
    inside = (np.abs(rows) < 2.0).all(axis=1)
    assert np.abs(np.log(found(rows[inside])) - np.log(truth[inside])).max() < 0.5
    assert found(np.array([[2.0, 0.0, 0.0]])) > 2.5 * found(np.zeros((1, 3)))


def test_a_constant_variance_is_found_constant_or_nearly_so():
    constant = 0
    for seed in range(10):
        rows, episode = beliefs(30, 40, seed=seed)
        squared = squares_of(np.full((len(rows), 2), [4.0, 0.01]), 100 + seed)
        found = ResidualVariance().fit(rows, squared, episode)
        constant += found.penalty == np.inf
        assert found.penalty >= 10.0
        assert np.log(found(rows)).std(axis=0).max() < 0.03  # a variance that is right to 3 %
        if found.penalty == np.inf:
            np.testing.assert_allclose(found(rows), [squared.mean(axis=0)] * len(rows), rtol=1e-12)
    assert constant >= 4  # the heaviest penalty is as good, so that chance decides


@pytest.mark.parametrize("varies", [True, False])
def test_the_mean_square_of_its_data_in_its_deviations_is_one(varies):
    rows, episode = beliefs(20, 30)
    squared = squares_of(np.exp(varies * 1.5 * rows[:, :2]) * [1.0, 1e-6], 1)
    found = ResidualVariance().fit(rows, squared, episode)
    assert np.isfinite(found.penalty) == varies
    np.testing.assert_allclose((squared / found(rows)).mean(axis=0), 1.0, rtol=1e-9)


def test_the_penalty_has_the_highest_likelihood_out_of_fold():
    rows, episode = beliefs(8, 10)
    squared = squares_of(np.exp(0.5 * rows[:, :1]), 3)
    found = ResidualVariance().fit(rows, squared, episode)
    features = np.concatenate([rows, np.square(rows)], axis=1)
    features = np.clip((features - features.mean(axis=0)) / features.std(axis=0), -CLIPPED, CLIPPED)
    likelihood = {}
    for penalty in (np.inf, 10.0, 1.0, 0.1, 0.01):
        likelihood[penalty] = 0.0
        for left, out in fold_indices(8, 5, 0, None):
            fit, held = np.isin(episode, left), np.isin(episode, out)
            log = np.zeros(len(rows))
            if np.isfinite(penalty):
                target = np.log(squared[fit] + 1e-6 * squared[fit].mean())
                ridge = RidgeOfAll(penalty).fit(features[fit], target)
                log = ridge.predict(features).reshape(-1)
                log = np.clip(log, log[fit].min(), log[fit].max())
            log = log + np.log(np.mean(squared[fit, 0] / np.exp(log[fit])))
            likelihood[penalty] -= (log[held] + squared[held, 0] / np.exp(log[held])).sum()
    assert found.penalty == max(likelihood, key=likelihood.get)
    assert len({round(value, 3) for value in likelihood.values()}) == 5


def test_a_component_without_residuals_does_not_spoil_the_others():
    rows, episode = beliefs(30, 40)
    squared = squares_of(np.exp(rows[:, :1]), 1)
    alone = ResidualVariance().fit(rows, squared, episode)
    for others in (np.zeros_like(squared), np.full_like(squared, 1e-300)):
        found = ResidualVariance().fit(rows, np.concatenate([others, squared], axis=1), episode)
        assert found.penalty == alone.penalty
        np.testing.assert_allclose(found(rows)[:, 1], alone(rows)[:, 0], rtol=1e-9)
        assert np.isfinite(found(rows)).all()
        assert (found(rows)[:, 0] < 1e-20).all()  # a variance of rounding
    nothing = ResidualVariance().fit(rows, np.zeros((len(rows), 1)), episode)
    assert (nothing(rows) < 1e-20).all()
    some = squared.copy()
    some[::2] = 0.0  # exact every other time
    assert np.isfinite(ResidualVariance().fit(rows, some, episode)(rows)).all()


def test_far_from_its_data_the_variance_stays_within_what_it_was_there():
    rows, episode = beliefs(30, 40)
    squared = squares_of(np.exp(rows[:, :1]), 1)
    found = ResidualVariance().fit(rows, squared, episode)
    inside = found(rows)
    far = found(np.array([[1e6, 0.0, 0.0], [-1e6, 1e6, 0.0], [1e150, -1e150, 1e150]]))
    assert (far >= inside.min() * (1 - 1e-9)).all()
    assert (far <= inside.max() * (1 + 1e-9)).all()


def test_beliefs_that_do_not_vary_do():
    rows = np.full((60, 2), 3.0)
    squared = squares_of(np.full((60, 1), 2.0), 1)
    found = ResidualVariance().fit(rows, squared, np.repeat(np.arange(6), 10))
    np.testing.assert_allclose(found(rows), squared.mean(), rtol=1e-9)


# --- AutoregressiveHints


def windows_data(lengths=(9, 4, 0, 12, 7, 11), seed=0):
    """Noisy observations in units of their own, and a hint of the last three of them."""
    rng = np.random.default_rng(seed)
    n, n_rows = len(lengths), max(lengths) + 1
    x = rng.normal(size=(n, n_rows + 2, 2))
    h = x[:, 2:, :1] + 0.5 * x[:, 1:-1, 1:] - 0.2 * x[:, :-2, :1] + 0.01 * rng.normal(size=(n, n_rows, 1))
    h = np.concatenate([10.0 + h, np.sin(h)], axis=2)
    return Sequences.from_observations(x[:, 2:] * [3.0, 0.1] + [50.0, 1.0], hints=h, lengths=lengths)


def rows_of(array, data):
    return array[data.observation_mask]


@pytest.mark.parametrize("standardise", [True, False])
@pytest.mark.parametrize("n_past", [1, 5, 20])
def test_autoregression_is_ridge_regression_on_windows(n_past, standardise):
    """The present observation and those before it; the mean of the data where there were none."""
    alpha, train, test = 1e-2, windows_data(), windows_data((3, 12, 1), seed=1)
    fitted = AutoregressiveHints(Ridge(alpha=alpha), n_past=n_past, standardise=standardise).fit(train)
    x, h = rows_of(train.observations, train), rows_of(train.hints, train)
    x_scale = (x.mean(axis=0), x.std(axis=0)) if standardise else (np.zeros(2), np.ones(2))
    h_scale = (h.mean(axis=0), h.std(axis=0)) if standardise else (np.zeros(2), np.ones(2))
    before = x.mean(axis=0) * (0.0 if standardise else 1.0)

    def windows(data):
        found = []
        for one in data.to_episodes():
            z = (np.asarray(one["observations"]) - x_scale[0]) / x_scale[1]
            found += [
                np.concatenate([z[t - i] if t >= i else before for i in range(n_past)]) for t in range(len(z))
            ]
        return np.array(found)

    by_hand = RidgeOfAll(alpha).fit(windows(train), (h - h_scale[0]) / h_scale[1])
    expected = by_hand.predict(windows(test)) * h_scale[1] + h_scale[0]
    mean, std = fitted.estimate_hints(test)
    np.testing.assert_allclose(mean[test.observation_mask], expected, rtol=1e-7)
    assert np.isnan(mean[~test.observation_mask]).all()
    assert (std[test.observation_mask] > 0).all()
    belief = fitted.initial_belief()
    np.testing.assert_allclose(belief[0], np.tile(before, n_past), atol=1e-12)
    for t in range(4):
        belief = fitted.update(belief, test.observations[0, t][None])
        np.testing.assert_allclose(fitted.predict_hint(belief).mean[0], expected[t], rtol=1e-7)
    np.testing.assert_allclose(belief[0], windows(test)[3], atol=1e-9)
    # the next observation, from the window before it
    whole = [np.vstack([np.tile(before, n_past)[None], windows(one)[:-1]]) for one in train]
    ahead = RidgeOfAll(1e-6).fit(np.concatenate(whole), (x - x_scale[0]) / x_scale[1])
    np.testing.assert_allclose(
        fitted.predict_observation(belief)[0],
        ahead.predict(belief)[0] * x_scale[1] + x_scale[0],
        rtol=1e-5,  # with 20 observations the windows of ragged starts are nearly dependent
    )


def test_a_window_that_is_long_enough_sees_what_the_hint_is_made_of():
    train, test = windows_data((30,) * 30), windows_data((30,) * 30, seed=1)
    errors = {}
    for n in (1, 2, 3, 5):
        difference = AutoregressiveHints(n_past=n).fit(train).hint_errors(test).difference
        errors[n] = np.sqrt(np.square(difference[:, 2:, 0]).mean())  # once three were seen
    assert errors[1] == pytest.approx(np.sqrt(0.5**2 + 0.2**2), rel=0.1)  # of what it does not see
    assert errors[2] == pytest.approx(0.2, rel=0.1)
    assert errors[3] < 0.02  # noise of 0.01, and starts that it was trained on too
    assert errors[5] == pytest.approx(errors[3], rel=0.05)


def test_autoregression_is_a_scikit_learn_estimator_and_tells_what_it_needs():
    data = windows_data()
    model = AutoregressiveHints(RandomFourierRidge(n_frequencies=10, random_state=0), n_past=2)
    fitted = clone(model).fit(data, windows_data(seed=1))
    assert not hasattr(model, "model_")
    for other in (pickle.loads(pickle.dumps(fitted)), clone(fitted).fit(data, windows_data(seed=1))):
        for ours, theirs in zip(fitted.estimate_hints(data), other.estimate_hints(data), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert fitted.forecast(fitted.initial_belief(3), 4).shape == (3, 4, 2)
    with pytest.raises(ValueError, match="expected n_past to be a whole number of at least 1, got 0"):
        AutoregressiveHints(n_past=0).fit(data)
    with pytest.raises(ValueError, match="expected training trajectories with hints"):
        fitted.fit(Sequences.from_observations(data.observations))
    with pytest.raises(NotFittedError):
        fitted.estimate_hints(data)
    with pytest.raises(TypeError, match="expected Sequences"):
        fitted.fit(data.observations)


# --- HintErrors


def errors_by_hand():
    """Two components, of episodes of 3, 1 and 2 observations."""
    nan = [np.nan, np.nan]
    difference = [
        [[3.0, 4.0], [0.0, 0.0], [-6.0, 8.0]],  # norms 5, 0, 10
        [[0.0, -2.0], nan, nan],  # 2
        [[1.0, 0.0], [5.0, 12.0], nan],  # 1, 13
    ]
    std = [[[3.0, 2.0], [1.0, 1.0], [6.0, 2.0]], [[1.0, 1.0], nan, nan], [[1.0, 1.0], [1.0, 6.0], nan]]
    return HintErrors(np.array(difference), np.array(std))


def test_errors_are_means_of_norms():
    errors = errors_by_hand()
    np.testing.assert_allclose(errors.norm, [[5, 0, 10], [2, np.nan, np.nan], [1, 13, np.nan]])
    np.testing.assert_allclose(errors.by_episode, [5.0, 2.0, 7.0])
    assert errors.mean == pytest.approx(14.0 / 3.0)
    assert errors.deviation == pytest.approx(np.sqrt(((1 / 3) ** 2 + (8 / 3) ** 2 + (7 / 3) ** 2) / 3))
    np.testing.assert_allclose(
        errors.rmse, np.sqrt([(9 + 0 + 36 + 0 + 1 + 25) / 6, (16 + 0 + 64 + 4 + 0 + 144) / 6])
    )


def test_errors_over_time_are_of_the_episodes_that_are_that_long():
    errors = errors_by_hand()
    np.testing.assert_allclose(errors.by_time, [8 / 3, 6.5, 10.0])
    # sample deviations over the root of the number: of 5, 2, 1 and of 0, 13; one alone has none
    expected = [np.std([5, 2, 1], ddof=1) / np.sqrt(3), np.std([0, 13], ddof=1) / np.sqrt(2), np.nan]
    np.testing.assert_allclose(errors.standard_error_by_time, expected)


def test_uncertainties_are_judged_by_squares_and_by_intervals():
    errors = errors_by_hand()
    np.testing.assert_allclose(
        errors.mean_squared_z, [(1 + 0 + 1 + 0 + 1 + 25) / 6, (4 + 0 + 16 + 4 + 0 + 4) / 6]
    )
    # |z| 1, 0, 1, 0, 1, 5 and 2, 0, 4, 2, 0, 2, against 1.96, 1.645 and 2.58
    np.testing.assert_allclose(errors.coverage(), [5 / 6, 2 / 6])
    np.testing.assert_allclose(errors.coverage(0.99), [5 / 6, 5 / 6])
    np.testing.assert_allclose(errors.coverage(0.6), [2 / 6, 2 / 6])
    z = np.random.default_rng(0).normal(size=(100, 200, 1))
    many = HintErrors(3.0 * z, np.full_like(z, 3.0))
    assert many.coverage(0.5)[0] == pytest.approx(0.5, abs=0.015)  # 20,000: standard error 0.0035
    assert many.mean_squared_z[0] == pytest.approx(1.0, abs=0.04)


def test_without_uncertainties_their_judgements_are_missing_and_all_else_is_there():
    some = errors_by_hand()
    errors = HintErrors(some.difference, np.full_like(some.std, np.nan))
    assert np.isnan(errors.mean_squared_z).all()
    assert np.isnan(errors.coverage()).all()
    assert errors.mean == some.mean
    exact = HintErrors(np.zeros((2, 3, 1)), np.zeros((2, 3, 1)))
    assert exact.mean == 0.0
    np.testing.assert_array_equal(exact.coverage(), [1.0])


def test_errors_of_a_filter_are_estimates_less_hints():
    data = windows_data()
    fitted = AutoregressiveHints(n_past=2).fit(data)
    mean, std = fitted.estimate_hints(data)
    errors = fitted.hint_errors(data)
    inside = data.observation_mask
    np.testing.assert_array_equal(errors.difference[inside], (mean - data.hints)[inside])
    np.testing.assert_array_equal(errors.std[inside], std[inside])
    assert np.isnan(errors.difference[~inside]).all()
    by_hand = [
        np.mean([np.linalg.norm(mean[i, t] - data.hints[i, t]) for t in range(length + 1)])
        for i, length in enumerate(data.lengths)
    ]
    assert errors.mean == pytest.approx(np.mean(by_hand), rel=1e-12)
    assert errors.deviation == pytest.approx(np.std(by_hand), rel=1e-12)
