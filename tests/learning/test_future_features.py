"""Features of the future: what a predictive state holds, variances and observations read off it, and their units."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning.future_features import FirstMoments, OwnFeatures, SecondMoments, future_features
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_backprop import BackpropPSIM
from beliefgym.learning.psim_forward import ForwardPSIM
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences


def turning(n, n_steps=20, seed=0, lengths=None):
    """A noisy turn that fades, both components observed with noise."""
    rng = np.random.default_rng(seed)
    s = np.empty((n, n_steps + 1, 2))
    s[:, 0] = rng.normal(size=(n, 2))
    for t in range(n_steps):
        s[:, t + 1] = 0.95 * s[:, t] @ np.array([[0.8, 0.6], [-0.6, 0.8]]).T + 0.3 * rng.normal(size=(n, 2))
    return Sequences.from_observations(s + 0.3 * rng.normal(size=s.shape), lengths=lengths)


def first_moments(futures):
    return futures.reshape(len(futures), -1)


def mixed_moments(futures):
    """An invertible map of the future; its condition number is about 30."""
    flat = futures.reshape(len(futures), -1)
    d = flat.shape[1]
    return 5.0 + flat @ np.random.default_rng(3).normal(size=(d, d))


def test_first_moments_are_the_observations_one_after_the_other():
    futures = np.arange(24.0).reshape(4, 3, 2)
    phi = future_features("first", futures)
    assert type(phi) is FirstMoments
    assert phi.size == 6
    np.testing.assert_array_equal(phi(futures)[1], np.arange(6.0, 12.0))
    np.testing.assert_array_equal(phi.read(phi(futures)), futures)
    np.testing.assert_array_equal(phi.read_next(phi(futures)), futures[:, 0])
    np.testing.assert_array_equal(phi.read_last(phi(futures)), futures[:, 2])


def test_second_moments_are_the_observations_and_then_their_squares():
    futures = np.random.default_rng(0).normal(size=(50, 3, 2)) + np.array([0.0, 2.0])
    phi = future_features("second", futures)
    assert type(phi) is SecondMoments
    assert phi.size == 12
    found, squares = phi(futures), np.square(futures).reshape(50, 6)
    np.testing.assert_array_equal(found[:, :6], futures.reshape(50, 6))
    np.testing.assert_allclose(
        found[:, 6:], (squares - squares.mean(axis=0)) / squares.std(axis=0), atol=1e-12
    )
    for read, expected in (
        (phi.read, futures),
        (phi.read_next, futures[:, 0]),
        (phi.read_last, futures[:, 2]),
    ):
        np.testing.assert_array_equal(read(found), expected)
    np.testing.assert_allclose(phi.read_variance(found), 0.0, atol=1e-12)  # a single future has none
    variance = phi.read_variance(found.mean(axis=0, keepdims=True))
    np.testing.assert_allclose(variance[0], futures.var(axis=0), rtol=1e-12)
    impossible = found.copy()
    impossible[:, 6:] -= 5.0
    assert (phi.read_variance(impossible) == 0.0).all()


def test_own_features_are_standardised_and_read_by_regression():
    rng = np.random.default_rng(0)
    futures = rng.normal(size=(200, 2, 2))
    phi = future_features(lambda f: np.exp(f.reshape(len(f), -1))[:, :3] * [1.0, 100.0, 1e-4], futures)
    assert type(phi) is OwnFeatures
    assert phi.size == 3
    np.testing.assert_allclose(phi(futures).mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(phi(futures).std(axis=0), 1.0, rtol=1e-12)
    np.testing.assert_allclose(phi.read(phi(futures))[7], futures.mean(axis=0), rtol=1e-12)  # not learned yet
    states = rng.normal(size=(200, 3))
    phi.learn_to_read(states, futures)
    design = np.column_stack([states, np.ones(200)])
    expected = design @ np.linalg.lstsq(design, futures.reshape(200, 4), rcond=None)[0]
    # the reading's ridge of 1e-8 a sample moves it by about as much
    np.testing.assert_allclose(phi.read(states).reshape(200, 4), expected, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(phi.read_last(states), phi.read(states)[:, 1])


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda f: f, r"gives \(\d+, d\), got \(\d+, 2, 2\)"),
        (lambda f: f[:-1, 0], r"gives \(\d+, d\), got \(\d+, 2\)"),
        (lambda f: f[:, 0, 0], r"gives \(\d+, d\), got \(\d+,\)"),
        (lambda f: f[:, :0, 0], r"gives \(\d+, d\), got \(\d+, 0\)"),
        (lambda f: np.full((len(f), 1), np.nan), "finite numbers from the function"),
        (lambda f: np.where(f[:, 0] > 2.5, np.inf, 0.0), "finite numbers from the function"),
    ],
    ids=["three axes", "rows lost", "one axis", "no feature", "NaN", "infinite"],
)
@pytest.mark.parametrize("kind", [PSIM, ForwardPSIM])
def test_functions_of_the_future_that_are_no_features_are_told(kind, function, message):
    with pytest.raises(ValueError, match=message):
        kind(n_future=2, features=function).fit(turning(50))


FAMILY = {
    "dagger": lambda features, alpha=1e-10: PSIM(
        Ridge(alpha=alpha), n_future=2, n_iterations=3, features=features, belief_limit=np.inf
    ),
    "forward": lambda features, alpha=1e-10: ForwardPSIM(
        Ridge(alpha=alpha), n_future=2, features=features, belief_limit=np.inf
    ),
    "backprop": lambda features, alpha=1e-10: BackpropPSIM(
        FAMILY["dagger"](features, alpha), init="dagger", n_epochs=2, random_state=0
    ),
}


@pytest.mark.parametrize("family", FAMILY)
@pytest.mark.parametrize("own", [first_moments, mixed_moments])
def test_an_own_function_that_holds_the_first_moments_is_as_good_as_they_are(family, own):
    train, test = turning(500), turning(200, seed=1)
    plain = FAMILY[family]("first").fit(train)
    ours = FAMILY[family](own).fit(train)
    assert ours.belief_size == plain.belief_size
    forecasts = [f.forecast(f.beliefs(test)[:, 8], 6) for f in (plain, ours)]
    difference = np.square(forecasts[0] - forecasts[1]).mean(axis=(0, 2))
    # the reading is a regression, on 1e4 rows and 4 features: errors of some 1e-4 of the observations' variance of 1
    assert difference.max() < 2e-3
    assert ours.errors(test).mean == pytest.approx(plain.errors(test).mean, rel=5e-3)


@pytest.mark.parametrize("family", ["dagger", "forward"])
def test_without_a_penalty_an_invertible_map_of_the_features_changes_nothing(family):
    train, test = turning(50), turning(20, seed=1)
    found = [
        FAMILY[family](own, 1e-14).fit(train).errors(test, 4).squared
        for own in (first_moments, mixed_moments)
    ]
    # a reading's ridge of 1e-8, times the square of the map's condition number, of squared errors of 0.5
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-3)


def bent_features(futures):
    """Six features of which no observation is a linear function."""
    return np.concatenate(
        [np.sin(2.0 * futures[:, 0]), np.tanh(futures[:, 1] * 2.0), futures[:, 1] ** 3], axis=1
    )


@pytest.mark.parametrize("family", FAMILY)
def test_observations_are_read_off_the_beliefs_of_the_filter_that_was_chosen(family):
    """The regression of the futures on the chosen filter's own beliefs, not on those of another iteration."""
    train, validation = turning(100, lengths=np.arange(100) % 18 + 3), turning(50, seed=1)
    model = FAMILY[family](bent_features, 1e-3)
    if family == "backprop":
        model.set_params(n_epochs=6, learning_rate=0.3)
    if family == "forward":
        model.set_params(min_trajectories=30)
    model.fit(train, validation)
    beliefs, futures, states = model.beliefs(train), [], []
    read = train.lengths if family != "forward" else np.minimum(train.lengths, model.n_steps_)
    for i, length in enumerate(read):
        for t in range(length):
            futures.append(train.observations[i, t : t + 2].ravel())
            states.append(model._state(beliefs[i : i + 1, t])[0])
    if family == "backprop":
        assert model.best_epoch_ < 6
    design = np.column_stack([states, np.ones(len(states))])
    expected = (design @ np.linalg.lstsq(design, np.array(futures), rcond=None)[0]).reshape(-1, 2, 2)
    found = model.forecast(np.concatenate([beliefs[i, :n] for i, n in enumerate(read)]), 2)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)  # a reading's ridge of 1e-8
    mean = np.square(validation.observations - train.observations[:, :3].mean(axis=(0, 1))).sum(axis=2).mean()
    assert model.errors(validation).mean < 0.45 * mean


def moving_mean(n, seed, noise=0.5, n_steps=10):
    """x_t ~ N(0.8 x_{t-1}, noise^2): its square has the mean (0.8 x_{t-1})^2 + noise^2."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, n_steps + 1, 1))
    for t in range(n_steps):
        x[:, t + 1] = 0.8 * x[:, t] + noise * rng.normal(size=(n, 1))
    return x


def moving_variance(n, seed, n_steps=10):
    """x_t ~ N(0, 0.5 + 0.3 x_{t-1}^2)."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, n_steps + 1, 1))
    for t in range(n_steps):
        x[:, t + 1] = np.sqrt(0.5 + 0.3 * x[:, t] ** 2) * rng.normal(size=(n, 1))
    return x


@pytest.mark.parametrize(
    ("standardise", "scale", "offset"),
    [(True, 1.0, 0.0), (True, 1e3, 5e3), ("together", 1.0, 0.0), ("together", 1e3, 5e3), (False, 1.0, 0.0)],
)
@pytest.mark.parametrize(
    ("kind", "data"), [(PSIM, moving_mean), (PSIM, moving_variance), (ForwardPSIM, moving_mean)]
)
def test_the_variance_of_what_comes_is_read_off_second_moments(kind, data, standardise, scale, offset):
    """Where E[x_t] moves, and where the variance does: E[x_t^2] is quadratic in the last observation."""
    regressor = PolynomialRidge(degree=2, alpha=1e-5)
    model = kind(regressor, n_future=1, features="second", standardise=standardise)
    model.fit(Sequences.from_observations(offset + scale * data(4000, 0)))
    x = data(300, 1)
    beliefs = model.beliefs(Sequences.from_observations(offset + scale * x))
    found = np.stack([model.predict_variance(beliefs[:, t])[:, 0] for t in range(1, 11)], axis=1)
    last = x[:, :10, 0]
    expected = np.full(last.shape, 0.25) if data is moving_mean else 0.5 + 0.3 * last**2
    error = np.sqrt(np.mean((found / scale**2 - expected) ** 2))
    # squares have deviations of about 1 about their means: a regression on n of them misses by sqrt(10 / n), and
    # forward training has 4000 a step, PSIM 40000
    assert error < (0.09 if kind is ForwardPSIM else 0.03)
    if data is moving_variance:
        assert error < 0.3 * expected.std()


def test_the_variance_before_any_observation_is_that_of_the_first_ones():
    train = turning(300)
    model = PSIM(Ridge(), n_future=2, n_iterations=1, features="second").fit(train)
    found = model.predict_variance(model.initial_belief(3))
    np.testing.assert_allclose(found, np.tile(train.observations[:, 0].var(axis=0), (3, 1)), rtol=1e-10)
    assert (model.predict_variance(model.beliefs(train)[:, 5]) >= 0).all()


def test_a_belief_without_second_moments_has_no_variance():
    with pytest.raises(ValueError, match="expected features='second'"):
        PSIM(n_future=2, n_iterations=1).fit(turning(20)).predict_variance(np.zeros((1, 4)))
    with pytest.raises(NotFittedError, match="this PSIM is not fitted yet"):
        PSIM(features="second").predict_variance(np.zeros((1, 4)))
    model = PSIM(n_future=2, n_iterations=1, features="second").fit(turning(20))
    with pytest.raises(ValueError, match=r"belief: expected shape \(n, 8\), got \(1, 4\)"):
        model.predict_variance(np.zeros((1, 4)))


MODELS = {
    "dagger": PSIM(Ridge(alpha=1e-3), n_future=2, n_iterations=4),
    "second moments": PSIM(Ridge(alpha=1e-3), n_future=2, n_iterations=4, features="second"),
    "own features": PSIM(Ridge(alpha=1e-3), n_future=2, n_iterations=4, features=mixed_moments),
    "fourier": PSIM(
        RandomFourierRidge(n_frequencies=30, alpha=1e-2, random_state=0), n_future=2, n_iterations=3
    ),
    "forward": ForwardPSIM(Ridge(alpha=1e-2), n_future=2),
    "backprop": BackpropPSIM(
        PSIM(Ridge(alpha=1e-3), n_future=2), n_epochs=3, learning_rate=0.05, random_state=0
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_other_units_change_predictions_by_the_units_only(name):
    """Metres to millimetres and kelvin to degrees Celsius; standardised, the numbers are the same to rounding."""
    train, test = turning(30), turning(10, seed=1)
    factor, offset = np.array([1e3, 1.0]), np.array([0.0, -273.15])
    others = [Sequences.from_observations(s.observations * factor + offset) for s in (train, test)]
    model, other = clone(MODELS[name]).fit(train), clone(MODELS[name]).fit(others[0])
    beliefs, other_beliefs = model.beliefs(test)[:, 6], other.beliefs(others[1])[:, 6]
    # -273.15 costs three of sixteen digits
    np.testing.assert_allclose(other_beliefs, beliefs, rtol=0, atol=1e-9)
    expected = model.forecast(beliefs, 5) * factor + offset
    np.testing.assert_allclose(
        other.forecast(other_beliefs, 5) / factor, expected / factor, rtol=0, atol=1e-8
    )
    if name == "second moments":
        variance = model.predict_variance(beliefs) * factor**2
        np.testing.assert_allclose(other.predict_variance(other_beliefs), variance, rtol=1e-6)


def test_components_of_one_unit_keep_their_proportions_when_brought_together():
    """With "together" a common factor changes nothing, and a factor of one component alone does."""
    train, test = turning(30), turning(10, seed=1)
    model = PSIM(Ridge(alpha=1.0), n_future=2, n_iterations=2, standardise="together")
    reference = clone(model).fit(train).errors(test).mean

    def error(factor):
        fitted = clone(model).fit(Sequences.from_observations(train.observations * factor))
        return fitted.errors(Sequences.from_observations(test.observations * factor)).mean

    assert error(1e3) == pytest.approx(1e6 * reference, rel=1e-9)
    assert error(np.array([1.0, 10.0])) / reference != pytest.approx(50.5, rel=0.01)
