"""Predictive state filters on bad data (short, constant, doubled, wildly scaled, not finite): right, or told."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_backprop import BackpropPSIM
from beliefgym.learning.psim_forward import ForwardPSIM
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences

LINEAR = PSIM(Ridge(alpha=1e-3), n_future=3, n_iterations=4)
FAMILY = {
    "dagger": LINEAR,
    "second moments": clone(LINEAR).set_params(features="second"),
    "fourier": PSIM(
        RandomFourierRidge(n_frequencies=20, alpha=1e-2, include_inputs=True, random_state=0),
        n_future=3,
        n_iterations=3,
    ),
    "forest": PSIM(RandomForest(n_estimators=3, random_state=0), n_future=3, n_iterations=1),
    "forward": ForwardPSIM(Ridge(alpha=1e-1), n_future=3),
    "backprop": BackpropPSIM(clone(LINEAR), n_epochs=4, learning_rate=0.05, random_state=0),
    "fine tuned": BackpropPSIM(clone(LINEAR), init="dagger", n_epochs=2, random_state=0),
}
each = pytest.mark.parametrize("name", FAMILY)
of_torch = {"backprop", "fine tuned"}


def turning(n=30, n_steps=12, seed=0):
    """(n, n_steps + 1, 2) of a noisy turn that fades."""
    rng = np.random.default_rng(seed)
    s = np.empty((n, n_steps + 1, 2))
    s[:, 0] = rng.normal(size=(n, 2))
    for t in range(n_steps):
        s[:, t + 1] = 0.95 * s[:, t] @ np.array([[0.8, 0.6], [-0.6, 0.8]]).T + 0.3 * rng.normal(size=(n, 2))
    return s + 0.3 * rng.normal(size=s.shape)


def sequences(x, lengths=None):
    return Sequences.from_observations(x, lengths=lengths)


@each
def test_short_trajectories_are_left_out_and_told(name):
    x, lengths = turning(), np.full(30, 12)
    lengths[[2, 3, 7, 11]] = 2, 0, 1, 2  # observations: 3, 1, 2, 3, of 4 that are needed
    x[[2, 3, 7, 11]] += 50.0  # they would move the scale and the initial belief
    with pytest.warns(
        UserWarning, match=r"4 of 30 trajectories have fewer than n_future \+ 1 = 4 observations"
    ):
        fitted = clone(FAMILY[name]).fit(sequences(x, lengths))
    without = clone(FAMILY[name]).fit(sequences(x[lengths == 12]))
    test = sequences(turning(seed=1))
    np.testing.assert_array_equal(fitted.beliefs(test), without.beliefs(test))
    np.testing.assert_array_equal(
        fitted.forecast(fitted.beliefs(test)[:, 4], 5), without.forecast(without.beliefs(test)[:, 4], 5)
    )


@each
def test_no_trajectory_that_is_long_enough_is_told_with_the_length_needed(name):
    message = r"at least n_future \+ 1 = 4 observations, got 30 of at most 3; lower n_future"
    with pytest.raises(ValueError, match=message):
        clone(FAMILY[name]).fit(sequences(turning(n_steps=2)))
    if isinstance(FAMILY[name], PSIM):
        with pytest.raises(ValueError, match=message):
            clone(FAMILY[name]).fit(sequences(turning())).partial_fit(sequences(turning(n_steps=2)))
    with pytest.raises(ValueError, match="expected at least one step"):
        clone(FAMILY[name]).fit(sequences(turning(n_steps=0)))
    with pytest.raises(ValueError, match="expected at least one step"):
        clone(FAMILY[name]).fit(sequences(turning())[:0])


@each
def test_the_shortest_trajectories_that_do_are_enough(name):
    x = turning(n=60, n_steps=3)
    fitted = clone(FAMILY[name]).fit(sequences(x))
    assert fitted.errors(sequences(x)).mean < np.square(x).sum(axis=2).mean()
    assert np.isfinite(fitted.errors(sequences(turning(n_steps=0))).squared).all()


@pytest.mark.parametrize(
    ("name", "value", "standardise"),
    [
        (name, value, standardise)
        for name in FAMILY
        for value in (0.1, 0.0, 1e9 + 0.1, -7e-12)
        for standardise in (True, "together", False)
        if standardise or (value < 1.0 and name not in of_torch)
    ],
)
def test_a_component_that_does_not_vary_is_told_and_expected_as_it_is(name, value, standardise):
    model = clone(FAMILY[name])
    model.set_params(**{"psim__standardise" if name in of_torch else "standardise": standardise})
    x = turning()
    constant = np.insert(x, 1, value, axis=2)
    with pytest.warns(UserWarning, match=r"observations \[1\] do not vary in the training data"):
        fitted = clone(model).fit(sequences(constant))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nor is rounding a divergence
        forecast = fitted.forecast(fitted.beliefs(sequences(constant))[:, 5], 6)
    if standardise and name != "backprop":  # from a random start beliefs begin somewhere else
        # Adam steps by its rate of 3e-4 however small a gradient is
        np.testing.assert_allclose(
            forecast[:, :, 1], value, rtol=1e-9, atol=1e-2 if name in of_torch else 1e-9
        )
    assert np.isfinite(forecast).all()
    if name in ("dagger", "second moments", "forward") and standardise is True:
        # the others draw their features, trees or steps for the number of components
        plain = clone(model).fit(sequences(x))
        expected = plain.forecast(plain.beliefs(sequences(x))[:, 5], 6)
        np.testing.assert_allclose(forecast[:, :, [0, 2]], expected, rtol=0, atol=1e-5)


@each
def test_nothing_that_varies_is_told_and_predicted_as_it_is(name):
    x = np.full((10, 9, 2), [3.0, -1e3])
    with pytest.warns(UserWarning, match=r"observations \[0, 1\] do not vary in the training data"):
        fitted = clone(FAMILY[name]).fit(sequences(x), sequences(x))
    if name == "backprop":
        assert np.isfinite(fitted.errors(sequences(x), 3).mean)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fitted.errors(sequences(x), 3).mean < 1e-12
        surprised = fitted.update(fitted.initial_belief(2), [[4.0, 0.0], [3.0, -1e3]])
    assert np.isfinite(surprised).all()


@pytest.mark.parametrize("name", ["dagger", "second moments", "forward", "fine tuned"])
@pytest.mark.parametrize("alpha", [0.0, 1e-8, 1e-3])
def test_a_component_that_stands_there_twice_changes_little(name, alpha):
    """Without a ridge the design is singular; what is predicted is not."""
    nested = "psim__" if name in of_torch else ""
    model = clone(FAMILY[name]).set_params(**{f"{nested}regressor__alpha": alpha})
    train, test = turning(200), turning(100, seed=1)
    error = clone(model).fit(sequences(train)).errors(sequences(test)).mean
    doubled, test_doubled = (np.concatenate([a, a[:, :, :1]], axis=2) for a in (train, test))
    fitted = clone(model).fit(sequences(doubled))
    found = fitted.errors(sequences(test_doubled)).squared
    assert np.isfinite(found).all()
    forecast = fitted.forecast(fitted.beliefs(sequences(test_doubled))[:, 6], 5)
    np.testing.assert_allclose(forecast[:, :, 0], forecast[:, :, 2], rtol=0, atol=1e-4)
    ahead = np.stack(
        [
            fitted.predict_observation(b)
            for b in np.moveaxis(fitted.beliefs(sequences(test_doubled)), 1, 0)[1:-1]
        ],
        axis=1,
    )
    both = np.square(ahead[:, :, :2] - test[:, 1:]).sum(axis=2).mean()
    # a ridge on two copies is half a ridge on one; and with features="second" the copies' squares too
    assert both == pytest.approx(error, rel=1e-2)


@pytest.mark.parametrize("name", [n for n in FAMILY if n != "forest"])
@pytest.mark.parametrize("factor", [[1e-9, 1e9], [1e9, 1e-9], [1e-9, 1e-9], [1e9, 1.0]], ids=str)
def test_wildly_scaled_components_are_predicted_as_well(name, factor):
    factor = np.array(factor)
    offset = 100.0 * factor * [1.0, -1.0]
    train, test = turning(), turning(10, seed=1)
    plain = clone(FAMILY[name]).fit(sequences(train))
    scaled = clone(FAMILY[name]).fit(sequences(train * factor + offset))
    expected = plain.forecast(plain.beliefs(sequences(test))[:, 5], 6)
    found = scaled.forecast(scaled.beliefs(sequences(test * factor + offset))[:, 5], 6)
    # the offset of 100 deviations costs two of sixteen digits, fits and filters some more
    np.testing.assert_allclose((found - offset) / factor, expected, rtol=0, atol=1e-8)


@each
def test_a_shorter_trajectory_far_from_zero_is_not_taken_for_a_divergence(name):
    """What pads it, 0, is thousands of deviations away."""
    x = turning() + 1e4
    lengths = np.tile([12, 5], 15)
    fitted = clone(FAMILY[name]).fit(sequences(x, lengths), sequences(x, lengths))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fitted.beliefs(sequences(x, lengths))
        errors = fitted.errors(sequences(x, lengths), 3)
    for length in (12, 5):
        rows = np.flatnonzero(lengths == length)
        cut = sequences(x[rows, : length + 1])
        np.testing.assert_allclose(
            found[rows, : length + 1], fitted.beliefs(cut)[:, : length + 1], rtol=0, atol=1e-10
        )
        np.testing.assert_allclose(
            errors.squared[rows, : length + 1], fitted.errors(cut, 3).squared, rtol=1e-6, atol=1e-8
        )


@pytest.fixture(scope="module", params=FAMILY)
def fitted(request):
    return clone(FAMILY[request.param]).fit(sequences(turning()))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused_with_their_row(fitted, bad):
    x = turning(5)[:, 0]
    x[3, 1] = bad
    with pytest.raises(
        ValueError, match=rf"observation: expected finite numbers, got {bad} at index \(3, 1\)"
    ):
        fitted.update(fitted.initial_belief(5), x)


def test_wrong_shapes_are_told(fitted):
    size = fitted.belief_size
    belief, x = fitted.initial_belief(4), turning(4)[:, 0]
    for wrong in (belief[0], belief[:, :-1], belief[None]):
        for call in (
            lambda b: fitted.update(b, x),
            fitted.predict_observation,
            lambda b: fitted.forecast(b, 2),
        ):
            with pytest.raises(ValueError, match=rf"belief: expected shape \(n, {size}\), got"):
                call(wrong)
    for wrong in (x[0], x[:, :1], x[:3]):
        with pytest.raises(ValueError, match=r"observation: expected shape \(4, 2\), got"):
            fitted.update(belief, wrong)
    for wrong in (0, -1, 2.0, True):
        with pytest.raises(ValueError, match="horizon to be a whole number of at least 1"):
            fitted.forecast(belief, wrong)
    other = sequences(turning(4)[:, :, :1])
    for call in (fitted.errors, fitted.beliefs):
        with pytest.raises(ValueError, match="trajectories with 2 observations as at fit, got 1"):
            call(other)
    if isinstance(fitted, PSIM):
        with pytest.raises(ValueError, match="trajectories with 2 observations as at fit, got 1"):
            fitted.partial_fit(other)


@each
def test_calls_before_a_fit_and_data_of_another_kind_are_told(name):
    model = clone(FAMILY[name])
    x = turning()
    kind = type(model).__name__
    for call in (
        lambda: model.initial_belief(),
        lambda: model.belief_size,
        lambda: model.update(np.zeros((1, 6)), x[:1, 0]),
        lambda: model.forecast(np.zeros((1, 6)), 2),
        lambda: model.beliefs(sequences(x)),
        lambda: model.errors(sequences(x)),
        *([lambda: model.partial_fit(sequences(x))] if kind == "PSIM" else []),
    ):
        with pytest.raises(NotFittedError, match=f"this {kind} is not fitted yet"):
            call()
    for wrong in (x, [x], None):
        with pytest.raises(TypeError, match="expected Sequences, got"):
            model.fit(wrong)
    with pytest.raises(TypeError, match="expected Sequences, got ndarray"):
        model.fit(sequences(x), x)
    with pytest.raises(ValueError, match="validation with 2 observations as in training, got 1"):
        model.fit(sequences(x), sequences(x[:, :, :1]))


@pytest.mark.parametrize("name", ["dagger", "second moments", "fourier", "fine tuned"])
@pytest.mark.parametrize("factor", [3.0, 1e200, np.nan])
def test_an_unstable_filter_stays_bounded_and_says_so_once(name, factor):
    model = clone(FAMILY[name])
    for _ in range(2):  # a later fit tells anew
        model.fit(sequences(turning()))
        model.model_ = model.model_.frozen()
        model.model_._set(factor * model.model_._weights, model.model_._offset)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            belief, x = model.initial_belief(10), turning(10, n_steps=60, seed=1)
            for t in range(60):
                belief = model.update(belief, x[:, t])
                assert (np.abs(belief) <= model._bound).all()
            assert np.isfinite(model.errors(sequences(x), 10).by_look_ahead).all()
            assert np.isfinite(model.forecast(belief, 100)).all()
        told = [w for w in told if issubclass(w.category, DivergenceWarning)]
        assert len(told) == 1
        assert "left its bounds" in str(told[0].message)
        assert told[0].filename == __file__


def test_an_unstable_filter_of_forward_training_stays_bounded_and_says_so_once():
    model = clone(FAMILY["forward"]).fit(sequences(turning()))
    for F in model.model_:
        F._set(10.0 * F._weights, F._offset)
    with pytest.warns(DivergenceWarning, match="a belief of this ForwardPSIM left its bounds") as told:
        beliefs = model.beliefs(sequences(turning(n_steps=50)))
    assert len(told) == 1
    assert (np.abs(beliefs) <= model._bound).all()
    assert beliefs[0, -1, -1] == 51  # the step has no bound


def test_bounds_are_a_multiple_of_the_largest_features_of_training():
    x = turning()
    for limit in (1.0, 7.5):
        model = PSIM(Ridge(), n_future=2, n_iterations=1, standardise=False, belief_limit=limit).fit(
            sequences(x)
        )
        np.testing.assert_allclose(
            model._bound,
            limit * np.array([*np.abs(x[:, :-1]).max(axis=(0, 1)), *np.abs(x[:, 1:]).max(axis=(0, 1))]),
        )


@each
def test_one_trajectory_is_enough_to_be_fitted(name):
    fitted = clone(FAMILY[name]).fit(sequences(turning(1, n_steps=60)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        assert np.isfinite(fitted.errors(sequences(turning(5, seed=1)), 5).by_look_ahead).all()


def test_a_jump_in_the_test_data_is_survived():
    """An observation of 1e12 deviations: told, bounded, and forgotten again."""
    fitted = clone(FAMILY["dagger"]).fit(sequences(turning(200)))
    x = turning(20, n_steps=40, seed=1)
    jumping = x.copy()
    jumping[:, 5] = 1e12
    with pytest.warns(DivergenceWarning, match="left its bounds"):
        found = fitted.beliefs(sequences(jumping))
    np.testing.assert_allclose(found[:, 35:], fitted.beliefs(sequences(x))[:, 35:], rtol=0, atol=1e-3)
