"""Forward training against Algorithm 3 in plain loops, plain regressions and the Kalman filter; its steps of time."""

import pickle

import numpy as np
import pytest
from by_hand import poison_empty
from sklearn.base import clone
from sklearn.linear_model import LinearRegression
from sklearn.linear_model import Ridge as ScikitRidge
from sklearn.neighbors import KNeighborsRegressor

from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim_forward import ForwardPSIM
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences

LENGTHS = (9, 4, 6, 12, 7, 11, 8, 5, 9, 10)


def swinging(n=None, n_steps=8, seed=0, lengths=None):
    """A damped turn with a bend, one of two components far from zero, observed with noise."""
    lengths = (n_steps,) * n if lengths is None else lengths
    rng = np.random.default_rng(seed)
    n, n_steps = len(lengths), max(lengths)
    s = np.empty((n, n_steps + 1, 2))
    s[:, 0] = rng.normal(size=(n, 2))
    for t in range(n_steps):
        turned = s[:, t] @ np.array([[0.9, 0.5], [-0.5, 0.9]]).T
        s[:, t + 1] = np.tanh(turned) + 0.3 * rng.normal(size=(n, 2))
    x = s * [1.0, 2.0] + [0.0, 30.0]
    return Sequences.from_observations(x + 0.3 * rng.normal(size=x.shape), lengths=lengths)


def algorithm_3(train, k, regressor, min_trajectories=1):
    """Algorithm 3, line by line, one trajectory at a time, with a fitted clone of the regressor for each step.

    Returns:
        F_0, F_1, .. and the beliefs of each trajectory, those of F_{last} beyond.
    """
    episodes = [e["observations"] for e in train.to_episodes()]
    rows = np.concatenate(episodes)
    episodes = [(x - rows.mean(axis=0)) / rows.std(axis=0) for x in episodes]
    f = [[x[t : t + k].ravel() for t in range(len(x) - k + 1)] for x in episodes]
    m = [[np.mean([one[0] for one in f], axis=0)] for _ in episodes]
    F = []
    for t in range(max(len(x) for x in episodes) - 1):
        D = [
            (np.concatenate([m[i][t], x[t]]), f[i][t + 1])
            for i, x in enumerate(episodes)
            if t + 1 < len(f[i])
        ]
        if len(D) >= min_trajectories:
            F.append(clone(regressor).fit(np.array([z for z, _ in D]), np.array([y for _, y in D])))
        for i, x in enumerate(episodes):
            if t + 1 < len(x):
                m[i].append(F[-1].predict(np.concatenate([m[i][t], x[t]])[None])[0])
    return F, [np.array(one) for one in m]


class RidgeASample(ScikitRidge):
    """Scikit-learn's ridge with a penalty a sample."""

    def fit(self, X, y):
        given, self.alpha = self.alpha, len(X) * self.alpha
        super().fit(X, y)
        self.alpha = given
        return self


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("min_trajectories", [1, 4])
def test_it_is_algorithm_3_as_printed(k, min_trajectories):
    train = swinging(lengths=LENGTHS)
    model = ForwardPSIM(
        Ridge(alpha=1e-2), n_future=k, min_trajectories=min_trajectories, belief_limit=np.inf
    ).fit(train)
    F, m = algorithm_3(train, k, RidgeASample(1e-2, solver="svd"), min_trajectories)
    longest = sorted(LENGTHS)[-min_trajectories]
    assert len(F) == model.n_steps_ == len(model.model_) == longest + 1 - k
    for t, (ours, theirs) in enumerate(zip(model.model_, F, strict=True)):
        # normal equations against a singular value decomposition, condition numbers below 1e4 at this alpha
        np.testing.assert_allclose(ours.coef_, theirs.coef_, rtol=0, atol=1e-9, err_msg=f"step {t}")
        np.testing.assert_allclose(ours.intercept_, theirs.intercept_, rtol=0, atol=1e-9)
    found = model.beliefs(train)
    for i, expected in enumerate(m):
        np.testing.assert_allclose(found[i, : len(expected), :-1], expected, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(found[i, : len(expected), -1], np.arange(len(expected)))
    assert np.abs(model.model_[0].coef_ - model.model_[1].coef_).max() > 1e-3


@pytest.mark.parametrize(
    "regressor",
    [LinearRegression(), KNeighborsRegressor(2), RandomForest(n_estimators=3, random_state=0)],
    ids=["linear", "neighbours", "forest"],
)
def test_it_is_algorithm_3_with_any_regressor(regressor):
    train = swinging(40, n_steps=6)
    model = ForwardPSIM(regressor, n_future=2, belief_limit=np.inf).fit(train)
    _, m = algorithm_3(train, 2, regressor)
    np.testing.assert_allclose(model.beliefs(train)[:, :7, :-1], np.stack(m), rtol=0, atol=1e-8)


@pytest.mark.parametrize("fit_intercept", [True, False])
def test_one_step_is_the_regression_of_the_second_future_on_the_first_observation(fit_intercept):
    """m_0 is the same in every row: with an intercept it says nothing, without it stands for one."""
    train, alpha = swinging(50, n_steps=2), 1e-2
    model = ForwardPSIM(Ridge(alpha=alpha, fit_intercept=fit_intercept), n_future=2).fit(train)
    assert model.n_steps_ == 1
    rows = train.observations.reshape(-1, 2)
    z = (train.observations - rows.mean(axis=0)) / rows.std(axis=0)
    m_0 = np.concatenate([z[:, 0], z[:, 1]], axis=1).mean(axis=0)
    np.testing.assert_allclose(model.initial_belief()[0], [*m_0, 0.0], rtol=0, atol=1e-12)
    X = z[:, 0] if fit_intercept else np.concatenate([np.tile(m_0, (50, 1)), z[:, 0]], axis=1)
    plain = ScikitRidge(alpha=50 * alpha, fit_intercept=fit_intercept)
    expected = plain.fit(X, np.concatenate([z[:, 1], z[:, 2]], axis=1)).predict(X)
    found = model.update(model.initial_belief(50), train.observations[:, 0])
    np.testing.assert_allclose(found[:, :-1], expected, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(found[:, -1], 1.0)


@pytest.mark.parametrize(
    "model",
    [
        ForwardPSIM(Ridge(alpha=1e-2), n_future=2),
        ForwardPSIM(Ridge(alpha=1e-2), n_future=1, features="second"),
        ForwardPSIM(RandomFourierRidge(n_frequencies=20, alpha=1e-1, random_state=0), n_future=2),
        ForwardPSIM(RandomForest(n_estimators=3, random_state=0), n_future=3, min_trajectories=5),
    ],
    ids=["linear", "second moments", "fourier", "forest"],
)
def test_rows_at_different_steps_are_filtered_as_one_by_one(model):
    fitted = clone(model).fit(swinging(40, n_steps=8))
    test = swinging(14, n_steps=13, seed=1)
    found, rows = fitted.beliefs(test), np.arange(14)
    belief, x = found[rows, rows], test.observations[rows, rows]
    np.testing.assert_array_equal(belief[:, -1], rows)
    assert fitted.n_steps_ < 13  # some rows are past the last F
    for call in (
        lambda b, x: fitted.update(b, x),
        lambda b, x: fitted.forecast(b, 6),
        lambda b, x: fitted.predict_observation(b),
    ):
        singly = np.concatenate([call(belief[i : i + 1], x[i : i + 1]) for i in rows])
        np.testing.assert_allclose(call(belief, x), singly, rtol=0, atol=1e-11)
    np.testing.assert_allclose(fitted.update(belief, x), found[rows, rows + 1], rtol=0, atol=1e-11)


def test_past_the_training_trajectories_the_last_filter_goes_on():
    model = ForwardPSIM(Ridge(alpha=1e-2), n_future=2).fit(swinging(40, n_steps=6))
    assert model.n_steps_ == 5
    test = swinging(10, n_steps=20, seed=1)
    beliefs = model.beliefs(test)
    z = (test.observations - model._scale.offset) / model._scale.scale
    for t in range(20):
        F = model.model_[min(t, 4)]
        expected = F.predict(np.concatenate([beliefs[:, t, :-1], z[:, t]], axis=1))
        np.testing.assert_allclose(beliefs[:, t + 1, :-1], expected, rtol=0, atol=1e-11)
    assert np.isfinite(model.errors(test, 5).squared[:, :16]).all()
    assert (beliefs[:, -1, -1] == 21).all()


def test_every_step_of_a_long_forecast_uses_the_filter_of_its_time():
    model = ForwardPSIM(Ridge(alpha=1e-2), n_future=2).fit(swinging(40, n_steps=8))
    belief = model.beliefs(swinging(10, n_steps=8, seed=1))[:, 3]
    found = model.forecast(belief, 5)
    np.testing.assert_allclose(
        model._scale.apply(found[:, :2]), belief[:, :4].reshape(-1, 2, 2), rtol=0, atol=1e-12
    )
    for step in (2, 3, 4):
        belief = model.update(belief, model.predict_observation(belief))
        np.testing.assert_allclose(model._scale.apply(found[:, step]), belief[:, 2:4], rtol=0, atol=1e-11)
    assert belief[0, -1] == 6


@pytest.mark.parametrize(
    "regressor", [Ridge(alpha=1e-2), KNeighborsRegressor(2)], ids=["linear", "neighbours"]
)
def test_what_lies_past_the_ends_never_matters(regressor):
    short = swinging(lengths=LENGTHS)
    padded = Sequences.concatenate([short, swinging(1, n_steps=20)])[: len(LENGTHS)]
    first, second = (ForwardPSIM(regressor, n_future=2, min_trajectories=2).fit(s) for s in (short, padded))
    np.testing.assert_array_equal(first.beliefs(short), second.beliefs(short))
    np.testing.assert_allclose(first.errors(short).mean, second.errors(padded).mean, rtol=1e-12)


@pytest.mark.filterwarnings("error")
def test_nothing_is_read_before_it_is_written(monkeypatch):
    train = swinging(lengths=LENGTHS)
    model = ForwardPSIM(Ridge(alpha=1e-2), n_future=2)
    clean = clone(model).fit(train).errors(train, 4).squared
    poison_empty(monkeypatch)
    np.testing.assert_array_equal(clone(model).fit(train).errors(train, 4).squared, clean)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_on_a_linear_gaussian_system_it_becomes_the_kalman_filter_at_every_step(seed):
    """From an uncertain start the best gain changes from step to step: no stationary filter could follow."""
    turn = 0.95 * np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    system = LinearGaussianSystem(
        turn,
        [[1.0, 0.0]],
        0.02 * np.eye(2),
        [[0.5]],
        initial_mean=[2.0, 0.0],
        initial_covariance=4.0 * np.eye(2),
    )
    test = system.sample(4000, 12, np.random.default_rng(99))
    best = KalmanFilter.of(system, stationary=False).errors(test)
    stationary = KalmanFilter.of(system).errors(test)
    found = []
    for n in (300, 5000):
        train = system.sample(n, 12, np.random.default_rng(seed))
        found.append(ForwardPSIM(Ridge(), n_future=2).fit(train).errors(test))
    few, many = found
    assert stationary.mean > 1.2 * best.mean
    assert many.mean < 1.01 * best.mean
    assert many.mean < few.mean
    np.testing.assert_array_less(many.by_time[:12], 1.03 * best.by_time[:12])  # the last F learned was F_10


def test_it_is_a_scikit_learn_estimator_and_tells_what_is_wrong():
    train = swinging(10)
    model = ForwardPSIM(Ridge(alpha=1e-2), n_future=2)
    assert clone(model).get_params()["regressor__alpha"] == 1e-2
    fitted = clone(model).set_params(n_future=3, regressor__alpha=0.1).fit(train, swinging(3, seed=1))
    assert fitted.belief_size == 7
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.beliefs(train), fitted.beliefs(train))
    np.testing.assert_array_equal(fitted.fit(train).beliefs(train), again.beliefs(train))
    with pytest.raises(ValueError, match="at least 11 trajectories of n_future .* got 10; lower min_traj"):
        clone(model).set_params(min_trajectories=11).fit(train)
    with pytest.raises(ValueError, match="min_trajectories to be a whole number of at least 1, got 0"):
        clone(model).set_params(min_trajectories=0).fit(train)
    with pytest.raises(ValueError, match="validation with 2 observations as in training, got 1"):
        clone(model).fit(train, Sequences.from_observations(train.observations[:, :, :1]))
