"""Hint filters on a stream: as on whole trajectories, and through gaps and wild observations."""

import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.envs import collect
from beliefgym.learning import Sequences
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.hint_autoregressive import AutoregressiveHints
from beliefgym.learning.hint_estimator import HintEstimator
from beliefgym.learning.hint_kalman import KalmanHints
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_hints import InferenceMachineFilter, PSIMHints
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.row_predictor import row_predictor

A = np.array([[0.88, 0.29, 0.1], [-0.29, 0.88, 0.0], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.2, -1.0, 0.0]])
Q = np.array([[0.2, 0.05, 0.0], [0.05, 0.1, 0.0], [0.0, 0.0, 0.3]])
R = np.array([[0.5, 0.1], [0.1, 0.2]])
# started with the covariance that its stationary filter predicts, so that this filter is the best from x_0 on
PREDICTED = LinearGaussianSystem(A, C, Q, R).stationary_gain().predicted_covariance
SYSTEM = LinearGaussianSystem(A, C, Q, R, initial_covariance=PREDICTED)
GAIN = PREDICTED @ C.T @ np.linalg.inv(C @ PREDICTED @ C.T + R)


def sampled(n, n_steps=40, seed=0):
    """Trajectories whose hints are the states."""
    data = SYSTEM.sample(n, n_steps, np.random.default_rng(seed))
    return Sequences.from_observations(data.observations, hints=data.states)


def with_units(data):
    """Other units and offsets, one of them no hint of one's own size."""
    return Sequences.from_observations(
        data.observations * [2.0, 1e3] + [5.0, -1e4], hints=data.hints * [1e-3, 10.0, 1.0] + [0.2, 0.0, -30.0]
    )


def waves(n=30, **parameters):
    return RandomFourierRidge(n_frequencies=n, alpha=1e-3, random_state=0, **parameters)


FILTERS = {
    "ridge": PSIMHints(Ridge(), n_future=3, n_iterations=2, preimage=Ridge()),
    "belief": PSIMHints(Ridge(), n_future=2, n_hints=2, hint_weight=2.0, n_iterations=2, preimage="belief"),
    "fourier": PSIMHints(
        waves(include_inputs=True), n_future=2, n_iterations=2, preimage=[waves(), waves(include_inputs=True)]
    ),
    "polynomial": PSIMHints(
        PolynomialRidge(alpha=1e-3), n_future=1, n_iterations=2, preimage=PolynomialRidge()
    ),
    "forest": PSIMHints(
        Ridge(), n_future=2, n_iterations=2, preimage=RandomForest(n_estimators=3, random_state=0)
    ),
    "second": PSIMHints(waves(), n_future=1, features="second", n_iterations=2, preimage=Ridge()),
    "own": PSIMHints(
        Ridge(), n_future=1, features=lambda h, f: h[:, 0] + 0.5, n_iterations=2, preimage="belief"
    ),
    "imf": InferenceMachineFilter(Ridge(), n_iterations=2, preimage=Ridge()),
    "imf fourier": InferenceMachineFilter(waves(include_inputs=True), n_iterations=2, preimage="belief"),
    "unscaled": InferenceMachineFilter(Ridge(), n_iterations=2, preimage=Ridge(), standardise=False),
    "window": AutoregressiveHints(waves(), n_past=3),
    "kalman": KalmanHints(transition_penalties=1.0, observation_penalties=1.0),
    "stationary": KalmanHints(transition_penalties=1.0, observation_penalties=1.0, stationary=True),
}
FITTED = {}
each = pytest.mark.parametrize("name", FILTERS)
gap = np.full(2, np.nan)


def fitted(name):
    """Fitted once for all tests, which do not change it."""
    if name not in FITTED:
        FITTED[name] = clone(FILTERS[name]).fit(with_units(sampled(30)), with_units(sampled(20, seed=1)))
    return FITTED[name]


def streamed(estimator, x):
    """Estimates of one trajectory (T, n_obs): means and standard deviations (T, n_hint)."""
    estimator.reset()
    found = [estimator.update(row) for row in x]
    return np.array([e.mean for e in found]), np.array([e.std for e in found])


TEST = with_units(sampled(4, seed=5))


@each
def test_a_stream_is_estimated_as_whole_trajectories_are(name):
    """Trajectory after trajectory through one estimator, and the first again in the end."""
    filter, estimator = fitted(name), HintEstimator(fitted(name))
    mean, std = filter.estimate_hints(TEST)
    beliefs = filter.beliefs(TEST)
    scale = filter._hint_scale.scale
    for i in (0, 1, 2, 3, 0):
        ours = streamed(estimator, TEST.observations[i])
        np.testing.assert_allclose(ours[0] / scale, mean[i] / scale, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(ours[1], std[i], rtol=1e-10)
        size = np.abs(beliefs[i, -1]).max()
        np.testing.assert_allclose(estimator.belief, beliefs[i, -1], rtol=1e-10, atol=1e-10 * size)
        assert estimator.n_seen == 41
        np.testing.assert_array_equal(estimator.estimate.mean, ours[0][-1])


@each
def test_before_any_observation_it_says_the_prior_of_the_training_data(name):
    estimator, first = HintEstimator(fitted(name)), with_units(sampled(30)).hints[:, 0]
    for _ in range(2):
        np.testing.assert_allclose(estimator.estimate.mean, first.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(estimator.estimate.std, first.std(axis=0), rtol=1e-12)
        assert estimator.n_seen == 0
        np.testing.assert_array_equal(estimator.belief, fitted(name).initial_belief()[0])
        estimator.update(TEST.observations[0, 0])
        assert estimator.n_seen == 1
        estimator.reset()


@each
@pytest.mark.parametrize("wrong", [[np.nan, -1e4], [5.0, np.inf], [-np.inf, np.nan]], ids=str)
def test_what_is_refused_leaves_everything_as_it_was(name, wrong):
    estimator, plain = HintEstimator(fitted(name)), HintEstimator(fitted(name))
    for row in TEST.observations[0, :5]:
        plain.update(row)
        estimator.update(row)
    belief, estimate = estimator.belief, estimator.estimate
    message = "got nan at index .*missing='predict' takes NaN" if np.isnan(wrong).any() else "got inf"
    with pytest.raises(ValueError, match=message):
        estimator.update(wrong)
    for other in (np.zeros(3), np.zeros((1, 2)), 1.0):
        with pytest.raises(ValueError, match=r"observation: expected shape \(2,\), got"):
            estimator.update(other)
    np.testing.assert_array_equal(estimator.belief, belief)
    assert estimator.estimate is estimate
    assert estimator.n_seen == 5
    for row in TEST.observations[0, 5:9]:
        for ours, theirs in zip(estimator.update(row), plain.update(row), strict=True):
            np.testing.assert_array_equal(ours, theirs)


@each
def test_infinities_are_refused_where_missing_observations_are_not(name):
    estimator = HintEstimator(fitted(name), missing="predict")
    estimator.update(gap)
    belief = estimator.belief
    with pytest.raises(ValueError, match=r"observation: expected finite numbers, got inf"):
        estimator.update([np.nan, np.inf])
    np.testing.assert_array_equal(estimator.belief, belief)
    assert estimator.n_seen == 1


@pytest.mark.parametrize("name", [name for name in FILTERS if name not in ("kalman", "stationary")])
def test_a_missing_observation_is_the_filters_own_prediction(name):
    """Whole and in part; a Kalman filter knows better, see its own tests."""
    filter, estimator = fitted(name), HintEstimator(fitted(name), missing="predict")
    rng, x = np.random.default_rng(0), np.array(TEST.observations[1, :25])
    x[rng.random(x.shape) < 0.3] = np.nan
    x[5:9] = np.nan
    belief = filter.initial_belief()
    scale = np.abs(filter.beliefs(TEST)).max(axis=(0, 1))
    for row in x:
        filled = np.where(np.isnan(row), filter.predict_observation(belief)[0], row)
        belief = filter.update(belief, filled[None])
        mean, _ = estimator.update(row)
        np.testing.assert_allclose(estimator.belief / scale, belief[0] / scale, atol=1e-9)
        if name != "forest":  # whose thresholds a rounding may cross
            np.testing.assert_allclose(mean, filter.predict_hint(belief).mean[0], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", ["kalman", "stationary"])
def test_a_kalman_filter_goes_on_in_its_own_way(name):
    filter, estimator = fitted(name), HintEstimator(fitted(name), missing="predict")
    x = np.array(TEST.observations[1, :25])
    x[np.random.default_rng(0).random(x.shape) < 0.4] = np.nan
    belief = filter.initial_belief()
    for row in x:
        belief = filter.update(belief, row[None], missing="predict")
        estimate, expected = estimator.update(row), filter.predict_hint(belief)
        np.testing.assert_allclose(estimate.mean, expected.mean[0], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(estimate.std, expected.std[0], rtol=1e-10)  # nothing put on top


def skipping(x):
    """The stationary Kalman filter of the true system: s_f' = A s_f, and the update only where there is an x."""
    s, found = np.zeros(3), []
    for row in x:
        if not np.isnan(row).any():
            s = s + GAIN @ (row - C @ s)
        found.append(s)
        s = A @ s
    return np.array(found)


@pytest.mark.parametrize("k", [0, 3])
def test_through_gaps_a_linear_filter_becomes_the_kalman_filter_that_skips_them(k):
    x = np.array(sampled(30, seed=5).observations)
    x[:, 5], x[:, 12:15], x[:, 20:30] = np.nan, np.nan, np.nan
    expected = np.array([skipping(one) for one in x])
    distances = []
    for n in (25, 200, 1600):
        filter = PSIMHints(Ridge(), n_future=k, n_iterations=4, preimage=Ridge()).fit(sampled(n))
        estimator = HintEstimator(filter, missing="predict")
        found = np.array([streamed(estimator, one)[0] for one in x])
        distances.append(np.sqrt(np.square(found - expected).mean()))
    # as 1/sqrt(n), a factor 2.8 each time, with room for chance
    assert distances[1] < 0.7 * distances[0]
    assert distances[2] < 0.7 * distances[1]
    assert distances[2] < 0.03  # of states of deviation 1


@pytest.mark.parametrize("name", ["imf", "futures", "window", "kalman"])
def test_uncertainty_in_and_after_gaps_is_right(name):
    """Mean squared error in units of what is told, 1, 3 and 10 observations into a gap, and after it."""
    filter = {
        "imf": InferenceMachineFilter(Ridge(), n_iterations=3, preimage=Ridge()),
        "futures": PSIMHints(Ridge(), n_future=3, n_iterations=3, preimage=Ridge()),
        "window": AutoregressiveHints(n_past=4),
        "kalman": FILTERS["kalman"],
    }[name]
    filter.fit(sampled(150), sampled(100, seed=1))
    test = sampled(400, 30, seed=2)
    x = np.array(test.observations)
    x[:, 12:22] = np.nan
    estimator = HintEstimator(filter, missing="predict")
    found = [streamed(estimator, one) for one in x]
    mean, std = (np.array(part) for part in zip(*found, strict=True))
    z = np.square((mean - test.hints) / std).mean(axis=0)
    for t in (11, 12, 14, 21):
        # standard error sqrt(2 / 400) = 0.07, and what the c_j were measured with
        assert (z[t] > 0.7).all(), (t, z[t])
        assert (z[t] < 1.4).all(), (t, z[t])
    # after a gap it is told larger than it is, by a learned filter, for as long as the gap was
    assert (z[22:] < 1.4).all()
    assert (z[22:] > (0.7 if name == "kalman" else 0.1)).all(), z[22:]


@each
def test_uncertainty_grows_in_a_gap_and_is_back_after_as_many_observations(name):
    filter = fitted(name)
    estimator, whole = HintEstimator(filter, missing="predict"), HintEstimator(filter)
    x = TEST.observations[2]
    for row in x[:10]:
        estimator.update(row)
    growth = filter.gap_growth_
    before, found = estimator.estimate.std, []
    for j in range(1, 8):
        std = estimator.update(gap if j != 3 else [np.nan, x[j, 1]]).std  # a part missing counts
        if growth is not None:
            told = filter.predict_hint(estimator.belief[None]).std[0]
            np.testing.assert_allclose(std, np.sqrt(told**2 + growth[j - 1]), rtol=1e-9)
        found.append(std)
    if name != "stationary":  # which knows nothing of it, and says so
        assert (found[-1] > 1.2 * before).any()
    for j in range(6, -3, -1):
        std = estimator.update(x[16 - j]).std
        if growth is not None:
            told = filter.predict_hint(estimator.belief[None]).std[0]
            more = growth[j - 1] if j > 0 else 0.0
            np.testing.assert_allclose(std, np.sqrt(told**2 + more), rtol=1e-9)
    estimator.reset()
    for row in x[:3]:
        np.testing.assert_array_equal(
            estimator.update(row).std, whole.update(row).std
        )  # the gap is forgotten


def test_a_hint_that_is_read_without_any_error_is_told_with_a_finite_one_in_a_gap():
    """Zero or one for whole trajectories; the forest is right to the last bit, until nothing is seen."""
    hints = np.repeat(np.random.default_rng(0).integers(0, 2, (60, 1, 1)).astype(float), 31, axis=1)
    data = Sequences.from_observations(10.0 * hints, hints=hints)
    forest = RandomForest(n_estimators=5, random_state=0)
    filter = AutoregressiveHints(forest, n_past=1, standardise=False).fit(data)
    estimator = HintEstimator(filter, missing="predict")
    estimate = estimator.update([10.0])
    assert estimate.mean[0] == 1.0
    assert estimate.std[0] < 1e-12
    for _ in range(5):
        assert estimator.update([np.nan]).std[0] < 1.0
    assert np.isfinite(filter.gap_growth_).all()
    estimator.reset()
    assert 0.1 < estimator.update([np.nan]).std[0] < 1.0  # from the start, it is one or the other


def test_after_a_gap_longer_than_any_measured_the_longest_counts():
    filter = fitted("imf")
    longest = len(filter.gap_growth_)
    assert longest == 20
    estimator = HintEstimator(filter, missing="predict")
    for row in TEST.observations[0, :5]:
        estimator.update(row)
    for _ in range(3 * longest):
        std = estimator.update(gap).std
    told = filter.predict_hint(estimator.belief[None]).std[0]
    np.testing.assert_allclose(std, np.sqrt(told**2 + filter.gap_growth_[-1]), rtol=1e-9)
    for j in range(1, longest + 1):
        std = estimator.update(TEST.observations[0, 5 + j]).std
        told = filter.predict_hint(estimator.belief[None]).std[0]
        more = filter.gap_growth_[longest - j - 1] if j < longest else 0.0
        np.testing.assert_allclose(std, np.sqrt(told**2 + more), rtol=1e-9)


@each
@pytest.mark.filterwarnings("ignore::beliefgym.learning.dynamics.DivergenceWarning")
def test_beliefs_stay_finite_on_anything_and_recover(name):
    """Gaps, and observations a million deviations out; then the truth again."""
    filter, rng = fitted(name), np.random.default_rng(0)
    estimator, calm = HintEstimator(filter, missing="predict"), HintEstimator(filter)
    long = with_units(sampled(1, 600, seed=6)).observations[0]
    x, scale = np.array(long[:400]), filter._scale.scale if filter.standardise else np.array([3.0, 1e3])
    wild = rng.random(400) < 0.05
    x[wild] += 1e6 * scale * rng.choice([-1.0, 1.0], (wild.sum(), 2))
    x[rng.random(x.shape) < 0.3] = np.nan
    x[100:160] = np.nan
    belief, bound = filter.initial_belief(), np.abs(filter.beliefs(TEST)).max()
    for row in x:
        mean, std = estimator.update(row)
        belief = filter.update(belief, row[None], missing="predict")
        if np.abs(belief).max() <= 10.0 * bound:  # 1e6 is 1e-10 of it by rounding alone
            np.testing.assert_allclose(estimator.belief, belief[0], rtol=1e-6, atol=1e-6)
        belief = estimator.belief[None]
        assert np.isfinite(estimator.belief).all()
        assert np.isfinite(mean).all()
        assert np.isfinite(std).all()
        assert (std > 0).all()
        if filter._bound is not None:
            assert (np.abs(estimator.belief) <= filter._bound).all()
    if name == "polynomial":
        return  # its squares hold it at the bounds for good
    for row in long[:400]:
        calm.update(row)
    for row in long[400:]:
        ours, theirs = estimator.update(row), calm.update(row)
    # errors fade by 0.63 an observation: 0.63^200 is 1e-40
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-6, atol=1e-6 * filter._hint_scale.scale.min())
    np.testing.assert_allclose(ours.std, theirs.std, rtol=1e-6)


@each
@pytest.mark.filterwarnings("ignore::beliefgym.learning.dynamics.DivergenceWarning", "ignore::RuntimeWarning")
def test_the_largest_numbers_there_are_do_not_spoil_a_belief(name):
    """1e308, which some sensors give for no reading: too large to be standardised where the unit is small."""
    data = sampled(30)
    small = Sequences.from_observations(data.observations * [0.1, 1.0], hints=data.hints)
    filter = clone(FILTERS[name]).fit(small)
    estimator, test = HintEstimator(filter), small.observations[0]
    for row in test[:5]:
        estimator.update(row)
    if filter.standardise:
        belief = estimator.belief
        for wild in ([1e308, 0.0], [-1e308, 1e308]):
            with pytest.raises(ValueError, match=r"observation: expected numbers like the .*: too large"):
                estimator.update(wild)
        np.testing.assert_array_equal(estimator.belief, belief)
    estimate = estimator.update([0.0, 1e308])  # which can be
    if name not in ("kalman", "stationary", "window"):  # which are not bounded
        assert np.isfinite(estimator.belief).all()
        assert np.isfinite(estimate.mean).all()
    for row in test[5:]:
        estimate = estimator.update(row)
    if name not in ("kalman", "stationary"):
        assert np.isfinite(estimate.mean).all()
        assert np.isfinite(estimate.std).all()


@pytest.mark.filterwarnings("ignore::beliefgym.learning.dynamics.DivergenceWarning", "ignore::RuntimeWarning")
def test_a_cosine_of_infinity_does_not_spoil_a_belief():
    """A finite observation whose waves are not: F answers NaN, and the belief stays what it was."""
    short = RandomFourierRidge(n_frequencies=20, bandwidth=0.05, alpha=1e-2, random_state=0)
    filter = InferenceMachineFilter(short, n_iterations=1, preimage=Ridge(), standardise=False)
    estimator = HintEstimator(filter.fit(sampled(20)))
    for row in sampled(20).observations[0, :3]:
        estimator.update(row)
    belief = estimator.belief
    assert np.isnan(short.fit(np.eye(2), np.eye(2)).predict_unchecked(np.array([[1e308, 1e308]]))).any()
    estimate = estimator.update([1e308, 1e308])
    np.testing.assert_array_equal(estimator.belief, belief)
    assert np.isfinite(estimate.mean).all()
    assert np.isfinite(estimate.std).all()


def test_a_belief_that_leaves_its_bounds_is_told_and_kept_inside():
    filter = clone(FILTERS["ridge"]).fit(sampled(30))
    estimator = HintEstimator(filter)
    estimator.update([0.0, 0.0])
    with pytest.warns(DivergenceWarning, match="a belief of this PSIMHints left its bounds"):
        estimator.update([1e6, -1e6])
    belief = filter.initial_belief()
    for row in ([0.0, 0.0], [1e6, -1e6]):
        belief = filter.update(belief, [row])
    np.testing.assert_allclose(estimator.belief, belief[0], rtol=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimator.update([-1e6, 1e6])  # told once


@pytest.mark.parametrize("name", [name for name in FILTERS if name != "own"])
def test_a_pickled_estimator_goes_on_in_the_middle_of_a_stream(name):
    estimator = HintEstimator(fitted(name), missing="predict")
    for row in [*TEST.observations[0, :6], gap, gap, gap, TEST.observations[0, 9]]:
        estimator.update(row)
    other = pickle.loads(pickle.dumps(estimator))
    assert other.n_seen == 10
    np.testing.assert_array_equal(other.belief, estimator.belief)
    np.testing.assert_array_equal(other.estimate.mean, estimator.estimate.mean)
    for row in [gap, *TEST.observations[0, 11:16]]:
        for ours, theirs in zip(estimator.update(row), other.update(row), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-12)  # memory may lie otherwise
    other.reset()
    np.testing.assert_array_equal(other.belief, fitted(name).initial_belief()[0])
    assert estimator.n_seen == 16


@each
def test_two_estimators_of_one_filter_do_not_share_anything(name):
    filter = fitted(name)
    one, two = HintEstimator(filter), HintEstimator(filter)
    alone = streamed(HintEstimator(filter), TEST.observations[0])[0]
    found = []
    for a, b in zip(TEST.observations[0], TEST.observations[1], strict=True):
        found.append(one.update(a).mean)
        two.update(b)
    np.testing.assert_array_equal(found, alone)
    belief = one.belief
    belief[:] = 7.0  # a copy
    found[-1][:] = 7.0
    np.testing.assert_array_equal(one.update(TEST.observations[2, 0]).mean.shape, (3,))
    assert not (one.belief == 7.0).any()


def test_estimates_are_arrays_of_their_own():
    constant = clone(FILTERS["imf"]).fit(with_units(sampled(30)), with_units(sampled(1, seed=1)))
    assert constant._reading.variance.penalty == np.inf
    for filter in (constant, *(fitted(name) for name in FILTERS)):
        estimator = HintEstimator(filter)
        first = estimator.update(TEST.observations[0, 0])
        kept = [part.copy() for part in first]
        estimator.update(TEST.observations[0, 1])
        for part, copy in zip(first, kept, strict=True):
            np.testing.assert_array_equal(part, copy)
            part[:] = -1.0
        estimator.reset()
        for part, copy in zip(estimator.update(TEST.observations[0, 0]), kept, strict=True):
            np.testing.assert_array_equal(part, copy)
        HintEstimator(filter).estimate.mean[:] = 0.0
        assert (filter.prior_mean_ != 0.0).any()


@pytest.mark.parametrize(
    "model",
    [
        Ridge(),
        Ridge(fit_intercept=False),
        waves(),
        waves(include_inputs=True),
        waves(fit_intercept=False, bandwidth=0.5),
        PolynomialRidge(),
        RandomForest(n_estimators=3, random_state=0),
    ],
    ids=repr,
)
@pytest.mark.parametrize("d", [1, 2])
def test_a_row_is_predicted_as_a_batch_is(model, d):
    rng = np.random.default_rng(0)
    X, Y = rng.normal(size=(80, 4)), rng.normal(size=(80, d))
    model = clone(model).fit(X, Y)
    predict = row_predictor(model, d)
    expected = model.predict(X).reshape(80, d)
    found = [predict(row) for row in X]
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)  # each an array of its own
    found[0][:] = 7.0
    np.testing.assert_allclose(predict(X[0]), expected[0], rtol=1e-10, atol=1e-12)
    if isinstance(model, Ridge | RandomFourierRidge):
        model.fit(X, -Y)
        np.testing.assert_allclose(predict(X[0]), expected[0], rtol=1e-10, atol=1e-12)


def test_what_is_not_a_fitted_hint_filter_is_told():
    with pytest.raises(NotFittedError, match="this PSIMHints is not fitted yet"):
        HintEstimator(PSIMHints())
    with pytest.raises(TypeError, match=r"expected a HintFilter \(PSIMHints, .*\), got PSIM$"):
        HintEstimator(PSIM(Ridge(), n_iterations=1).fit(sampled(10)))
    with pytest.raises(TypeError, match="got str"):
        HintEstimator("filter")
    with pytest.raises(ValueError, match=r"expected missing to be one of \('raise', 'predict'\), got 'skip'"):
        HintEstimator(fitted("imf"), missing="skip")


def test_actions_of_another_shape_are_told_where_they_are_looked_at():
    estimator = HintEstimator(fitted("kalman"))
    with pytest.raises(ValueError, match=r"action: expected shape \(n_act,\), got \(1, 1\)"):
        estimator.update(TEST.observations[0, 0], np.zeros((1, 1)))
    assert estimator.n_seen == 0
    plain = HintEstimator(fitted("kalman")).update(TEST.observations[0, 0])
    np.testing.assert_array_equal(estimator.update(TEST.observations[0, 0], [1.0]).mean, plain.mean)


def test_lists_and_single_precision_do():
    estimator = HintEstimator(fitted("imf"))
    row = TEST.observations[0, 0].astype(np.float32)
    first = estimator.update(row).mean
    estimator.reset()
    np.testing.assert_array_equal(estimator.update([float(v) for v in row]).mean, first)
    assert first.dtype == np.float64


def test_beside_an_environment():
    """Fitted to recorded episodes with hints, then asked in the loop, where there are none."""
    env = gym.make("beliefgym/PendulumPosition-v0", hint=True, max_episode_steps=40)
    data = collect(env, None, 30, seed=0)
    assert data.hints is not None
    filter = PSIMHints(waves(60, include_inputs=True), n_future=4, n_iterations=4, preimage=Ridge())
    filter.fit(data[:24], data[24:])
    assert filter.hint_names_ == data.hint_names
    env.close()
    env, estimator = gym.make("beliefgym/PendulumPosition-v0", max_episode_steps=40), HintEstimator(filter)
    env.action_space.seed(0)
    for seed in (100, 101):
        observation, _ = env.reset(seed=seed)
        estimator.reset()
        found, seen, action, done = [], [], None, False
        while True:
            seen.append(observation)
            found.append(estimator.update(observation, action))
            if done:
                break
            action = env.action_space.sample()
            observation, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
        whole = filter.estimate_hints(Sequences.from_observations(np.array(seen)[None]))
        np.testing.assert_allclose([e.mean for e in found], whole.mean[0], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose([e.std for e in found], whole.std[0], rtol=1e-8)
        assert len(found) == 41
    # the speed, which is not observed, is known after two observations
    errors = filter.hint_errors(collect(gym.make(env.spec, hint=True), None, 10, seed=200))
    spread = data.hints.reshape(-1, data.hints.shape[2]).std(axis=0)
    assert np.sqrt(np.square(errors.difference[:, 5:]).mean((0, 1)))[-1] < 0.3 * spread[-1]


@pytest.mark.parametrize("name", ["ridge", "fourier"])
def test_torch_is_not_needed_at_run_time(name, tmp_path):
    estimator = HintEstimator(fitted(name), missing="predict")
    for row in (TEST.observations[0, 0], gap):
        estimator.update(row)
    (tmp_path / "estimator.pickle").write_bytes(pickle.dumps(estimator))
    np.save(tmp_path / "x.npy", TEST.observations[0, 2:6])
    code = (
        "import pickle, sys, numpy as np\n"
        "import beliefgym.learning.hint_estimator\n"
        "estimator = pickle.load(open(sys.argv[1] + '/estimator.pickle', 'rb'))\n"
        "found = [estimator.update(row).mean for row in np.load(sys.argv[1] + '/x.npy')]\n"
        "assert not [m for m in sys.modules if m.split('.')[0] == 'torch'], 'torch was imported'\n"
        "np.save(sys.argv[1] + '/mean.npy', found)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert not done.returncode, done.stderr
    expected = [estimator.update(row).mean for row in TEST.observations[0, 2:6]]
    np.testing.assert_allclose(np.load(tmp_path / "mean.npy"), expected, rtol=1e-12)
