"""Data as Demonstrator as a user meets it: the history, the choice of a model, divergence, any regressor, errors."""

import pickle
import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.ensemble import GradientBoostingRegressor
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from beliefgym.learning import (
    DataAsDemonstrator,
    PolynomialRidge,
    RandomForest,
    RandomFourierRidge,
    Ridge,
    Sequences,
    data_as_demonstrator,
)

LENGTHS = (9, 4, 1, 0, 12, 7, 11)
HISTORY = {
    "iteration",
    "train_multi_step",
    "validation_multi_step",
    "train_single_step",
    "validation_single_step",
    "aggregate_single_step",
    "n_pairs",
    "n_added",
    "n_outlying",
    "n_diverged",
    "seconds",
}


def oscillator(lengths=LENGTHS, n_act=1, seed=0, n_obs=2):
    """A damped pendulum under random pushes: angle and velocity, or the angle alone."""
    rng = np.random.default_rng(seed)
    x = np.zeros((len(lengths), max(lengths) + 1, 2))
    u = rng.normal(size=(len(lengths), max(lengths), 1))
    x[:, 0] = 1.5 * rng.normal(size=(len(lengths), 2))
    for t in range(max(lengths)):
        x[:, t + 1, 0] = x[:, t, 0] + 0.3 * x[:, t, 1]
        x[:, t + 1, 1] = 0.95 * x[:, t, 1] - 0.3 * np.sin(x[:, t, 0]) + 0.1 * n_act * u[:, t, 0]
    return Sequences.from_observations(x[:, :, :n_obs], actions=u[:, :, :n_act], lengths=lengths)


def fourier(**parameters):
    return RandomFourierRidge(n_frequencies=20, random_state=0, **parameters)


def assert_same_fit(a, b):
    for name in HISTORY - {"seconds"}:
        np.testing.assert_array_equal(a.history_[name], b.history_[name], err_msg=name)
    test = oscillator(seed=7)
    np.testing.assert_array_equal(a.errors(test).rmse, b.errors(test).rmse)
    assert a.best_iteration_ == b.best_iteration_


@pytest.mark.parametrize("regressor", [fourier(), RandomForest(n_estimators=5, random_state=0)], ids=repr)
def test_the_history_has_an_entry_an_iteration(regressor):
    train, validation = oscillator(), oscillator(seed=1)
    model = DataAsDemonstrator(regressor, n_iterations=4, horizon=None).fit(train, validation)
    assert set(model.history_) == HISTORY
    for name, values in model.history_.items():
        assert values.shape == (5,), name
        assert np.isfinite(values).all(), name
    history = model.history_
    np.testing.assert_array_equal(history["iteration"], np.arange(5))
    np.testing.assert_array_equal(
        history["n_pairs"], 44 + 38 * np.arange(5)
    )  # sums of the lengths, and of one fewer
    np.testing.assert_array_equal(history["n_added"], [44, 38, 38, 38, 38])
    assert (history["seconds"] > 0).all()
    # the chosen model's entries are what the fitted object says of itself; the same sums in another order
    best = model.best_iteration_
    assert history["validation_multi_step"][best] == pytest.approx(model.errors(validation).mean, rel=1e-12)
    assert history["train_multi_step"][best] == pytest.approx(model.errors(train).mean, rel=1e-9)
    assert history["validation_single_step"][best] == pytest.approx(
        model.single_step_error(validation), rel=1e-12
    )
    assert history["train_single_step"][best] == pytest.approx(model.single_step_error(train), rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("alpha", [1e-6, 1e-3])
def test_the_model_of_the_lowest_validation_error_is_returned(seed, alpha):
    train, validation = oscillator(seed=seed), oscillator(seed=seed + 10)
    model = DataAsDemonstrator(fourier(alpha=alpha), n_iterations=6).fit(train, validation)
    errors = model.history_["validation_multi_step"]
    assert model.best_iteration_ == np.argmin(errors)
    assert model.errors(validation).mean == pytest.approx(errors.min(), rel=1e-12)  # the same numbers again
    assert model.errors(validation).mean <= errors[0]
    plain = DataAsDemonstrator(fourier(alpha=alpha), n_iterations=0).fit(train)
    assert plain.errors(validation).mean == pytest.approx(errors[0], rel=1e-12)


def test_without_validation_the_training_rollouts_choose():
    chosen = set()
    for seed in range(6):
        train = oscillator(seed=seed)
        for parameters in ({"horizon": None}, {"horizon": 4, "stride": 2}):
            model = DataAsDemonstrator(fourier(alpha=1e-3), n_iterations=4, **parameters).fit(train)
            errors = model.history_["train_multi_step"]
            assert model.best_iteration_ == np.argmin(errors)
            rollouts = train.segments(4, 2, keep_tail=True) if parameters["horizon"] else train
            # rolled out at once or along the way: BLAS sums otherwise
            assert model.errors(rollouts).mean == pytest.approx(errors.min(), rel=1e-9)
            for name in ("validation_multi_step", "validation_single_step"):
                assert np.isnan(model.history_[name]).all()
            chosen.add(model.best_iteration_)
    assert len(chosen) > 1  # not always the same


def test_diverging_rollouts_are_cut_counted_and_give_no_corrections_after():
    # five steps of two numbers are little to learn a cubic from
    train = oscillator(lengths=(5, 5, 5, 2), n_act=0, seed=2)
    regressor, limit = PolynomialRidge(degree=3, alpha=0.0), 1.8
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain = DataAsDemonstrator(regressor, n_iterations=0, divergence_limit=limit).fit(train)
        model = DataAsDemonstrator(regressor, n_iterations=4, divergence_limit=limit).fit(train)
    rows = train.observations[train.observation_mask]
    diverged = added = 0
    for episode in train.to_episodes():
        x = episode["observations"][:1]
        for t in range(len(episode["observations"]) - 1):
            added += t > 0
            x = plain.predict(x)
            if (np.abs(x - rows.mean(axis=0)) > limit * rows.std(axis=0)).any():
                diverged += 1
                break
    assert 0 < diverged < 4
    assert 0 < added < 4 + 4 + 4 + 1
    assert model.history_["n_diverged"][1] == diverged
    assert model.history_["n_added"][1] == added


@pytest.mark.filterwarnings("ignore::beliefgym.learning.DivergenceWarning")
def test_a_model_that_explodes_is_still_trained_on_finite_numbers():
    # x_{t+1} = 1.5 x_t for three steps, then rolled out for 60 along data that turned round
    rise = 1.5 ** np.arange(4.0)
    x = np.concatenate([np.tile(rise, (6, 1)), np.zeros((6, 57))], axis=1) * np.linspace(0.5, 1.5, 6)[:, None]
    lengths = np.array([3, 3, 3, 3, 3, 60])
    train = Sequences.from_observations(x[:, :, None], lengths=lengths)
    for regressor in (Ridge(), PolynomialRidge(degree=3), fourier(include_inputs=True)):
        model = DataAsDemonstrator(regressor, n_iterations=5, divergence_limit=2.0, target="next").fit(train)
        for name in HISTORY - {"validation_multi_step", "validation_single_step"}:
            assert np.isfinite(model.history_[name]).all(), name
        assert (np.diff(model.history_["n_pairs"]) >= 0).all()
        assert np.isfinite(model.rollout(x[:, :1], 60)).all()


@pytest.mark.parametrize(
    "regressor",
    [
        RandomForest(n_estimators=5, random_state=0),
        KNeighborsRegressor(3),
        LinearRegression(),
        make_pipeline(StandardScaler(), LinearRegression()),
        GradientBoostingRegressor(n_estimators=5, random_state=0),
        None,
    ],
    ids=repr,
)
@pytest.mark.parametrize("n_obs", [1, 2])
def test_any_regressor_works(regressor, n_obs):
    train, validation = oscillator(n_obs=n_obs), oscillator(n_obs=n_obs, seed=1)
    model = DataAsDemonstrator(regressor, n_iterations=2, horizon=4).fit(train, validation)
    assert model.rollout(validation.observations[:, 0], 12, validation.actions).shape == (7, 13, n_obs)
    assert (np.diff(model.history_["n_pairs"]) > 0).all()
    still = validation.observations[:, :1].repeat(13, axis=1)  # predicting no motion at all
    motion = np.square(still - validation.observations).sum(axis=2)[validation.observation_mask].sum()
    assert np.square(model.errors(validation).rmse).sum() < motion


def test_the_same_seed_gives_the_same_fit_and_the_progress_bar_changes_nothing(capsys):
    train, validation = oscillator(), oscillator(seed=1)
    for regressor in (fourier(), RandomForest(n_estimators=3, random_state=0)):
        a = DataAsDemonstrator(regressor, n_iterations=3).fit(train, validation)
        assert "DaD" not in capsys.readouterr().err
        b = DataAsDemonstrator(regressor, n_iterations=3, progress_bar=True)
        assert_same_fit(a, b.fit(train, validation))
        assert "DaD" in capsys.readouterr().err
        b.set_params(progress_bar=False)
        assert_same_fit(a, b.fit(oscillator(seed=3)).fit(train, validation))  # a second fit starts anew
    other = DataAsDemonstrator(RandomFourierRidge(n_frequencies=20, random_state=1), n_iterations=3)
    assert not np.array_equal(other.fit(train).errors(train).rmse, a.errors(train).rmse)


def test_parameters_clone_and_pickle():
    train, validation = oscillator(), oscillator(seed=1)
    model = DataAsDemonstrator(fourier(), n_iterations=3, horizon=4, outlier_ratio=3.0)
    regressor = model.regressor
    model.fit(train, validation)
    assert model.regressor is regressor
    assert not hasattr(regressor, "coef_")  # what is given stays unfitted
    again = clone(model)
    assert not hasattr(again, "model_")
    assert again.get_params()["regressor__n_frequencies"] == 20
    assert {k: v for k, v in again.get_params().items() if k != "regressor"} == {
        k: v for k, v in model.get_params().items() if k != "regressor"
    }
    assert_same_fit(model, again.fit(train, validation))
    assert_same_fit(model, pickle.loads(pickle.dumps(model)))
    again.set_params(regressor__alpha=1.0, n_iterations=0).fit(train)
    assert again.model_.alpha == 1.0
    assert len(again.history_["n_pairs"]) == 1


def test_a_fitted_model_holds_no_data():
    def size(n_iterations, lengths):
        model = DataAsDemonstrator(Ridge(), n_iterations=n_iterations).fit(oscillator(lengths=lengths))
        return len(pickle.dumps(model)) - 8 * sum(len(v) for v in model.history_.values())

    # numbers of other magnitude pickle to a few bytes more; 3000 steps would be 48,000 bytes
    assert abs(size(1, (30,) * 100) - size(20, (3,) * 10)) < 100


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"n_iterations": -1}, "expected n_iterations to be a whole number of at least 0, got -1"),
        ({"n_iterations": 2.0}, r"expected n_iterations to be a whole number of at least 0, got 2\.0"),
        ({"n_iterations": True}, "expected n_iterations to be a whole number of at least 0, got True"),
        ({"horizon": 0}, "expected horizon to be a whole number of at least 1, got 0"),
        ({"horizon": 5, "stride": 0}, "expected stride to be a whole number of at least 1, got 0"),
        (
            {"horizon": None, "stride": 2},
            r"expected a horizon beside the stride: rollouts of which length start there\?",
        ),
        ({"outlier_threshold": 0.0}, r"expected outlier_threshold above 0, got 0\.0"),
        ({"outlier_ratio": float("nan")}, "expected outlier_ratio above 0, got nan"),
        ({"target": "last"}, "expected target to be 'delta' or 'next', got 'last'"),
        ({"divergence_limit": 0}, "expected divergence_limit above 0, got 0"),
        ({"algorithm": "ogd"}, "expected algorithm to be one of .*, got 'ogd'"),
        (
            {"algorithm": "online_gradient", "step_size": 0.0},
            r"expected step_size finite and above 0, got 0\.0",
        ),
        ({"regressor": Ridge(alpha=-1.0)}, r"expected alpha finite and at least 0, got -1\.0"),
    ],
    ids=repr,
)
def test_parameters_out_of_range(parameters, message):
    with pytest.raises(ValueError, match=message):
        DataAsDemonstrator(**{"regressor": Ridge(), **parameters}).fit(oscillator())


def test_bad_data():
    model = DataAsDemonstrator(Ridge(), n_iterations=1)
    for data in ((np.zeros((3, 4, 2)),), (oscillator(), np.zeros((3, 4, 2)))):
        with pytest.raises(
            TypeError, match=r"expected Sequences, got ndarray; arrays go through Sequences\.from_obs"
        ):
            model.fit(*data)
    with pytest.raises(
        ValueError, match=r"expected at least one step to learn from, got Sequences\(1 episodes, 0 st"
    ):
        model.fit(oscillator()[[3]])
    with pytest.raises(ValueError, match="expected at least one step to validate on, got Sequences"):
        model.fit(oscillator(), oscillator()[[3]])
    with pytest.raises(
        ValueError, match="expected trajectories with 2 observations and 1 actions as at fit, got 2"
    ):
        model.fit(oscillator(), oscillator(n_act=0))
    forest = DataAsDemonstrator(RandomForest(), algorithm="online_gradient")
    message = r"expected a regressor linear in features \(Ridge, .*\) for 'online_gradient', got RandomForest"
    with pytest.raises(TypeError, match=message):
        forest.fit(oscillator())


def test_a_fit_that_failed_leaves_no_model():
    model = DataAsDemonstrator(Ridge(), algorithm="ogd")
    with pytest.raises(ValueError, match="expected algorithm"):
        model.fit(oscillator())
    with pytest.raises(NotFittedError):
        model.predict(np.zeros((1, 2)))


@pytest.mark.parametrize("limits", [{}, {"outlier_threshold": 0.5, "outlier_ratio": 1.2}], ids=repr)
def test_many_rollouts_go_in_blocks_without_a_difference(limits, monkeypatch):
    train, validation = oscillator(), oscillator(seed=1)
    whole = DataAsDemonstrator(Ridge(), n_iterations=4, **limits).fit(train, validation)
    monkeypatch.setattr(data_as_demonstrator, "ROWS", 2)
    blocks = DataAsDemonstrator(Ridge(), n_iterations=4, **limits).fit(train, validation)
    for name, values in whole.history_.items():
        if name != "seconds":  # sums in another order
            np.testing.assert_allclose(blocks.history_[name], values, rtol=1e-9, atol=1e-13, err_msg=name)
