"""Learning from live streams: the sums, the regret, drift, resets, and what is refused."""

import pickle
from copy import deepcopy

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from beliefgym.learning import RandomFourierRidge, Ridge, Sequences
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_forward import ForwardPSIM
from beliefgym.learning.psim_stream import LearningStream

TURN = np.array([[0.88, 0.29, 0.1], [-0.29, 0.88, 0.0], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.2, -1.0, 0.0]])
Q = np.array([[0.2, 0.05, 0.0], [0.05, 0.1, 0.0], [0.0, 0.0, 0.3]])
R = np.array([[0.5, 0.1], [0.1, 0.2]])
NEVER = 10**9


def a_system(A=TURN):
    return LinearGaussianSystem(A, C, Q, R)


def some_data(n_episodes, n_steps, seed, A=TURN):
    return a_system(A).sample(n_episodes, n_steps, np.random.default_rng(seed))


def a_psim(n_episodes=6, n_steps=40, **parameters):
    parameters = {"n_future": 2, "n_iterations": 3, **parameters}
    return PSIM(**parameters).fit(some_data(n_episodes, n_steps, 0))


def sums_of(learner):
    equations = learner._regressor.equations_
    return [np.tril(equations._gram), equations._cross, equations._sum_z, equations._sum_y, equations.weight]


REGRESSORS = {
    "linear": Ridge(alpha=1e-4),
    "fourier": RandomFourierRidge(n_frequencies=20, include_inputs=True, alpha=1e-3, random_state=0),
}


@pytest.mark.parametrize("features", ["first", "second"])
@pytest.mark.parametrize("regressor", list(REGRESSORS))
def test_the_sums_are_those_of_the_pairs_met_by_the_filters_in_force_then(regressor, features):
    k, n = 3, 4
    psim = a_psim(regressor=REGRESSORS[regressor], n_future=k, features=features)
    x = some_data(n, 30, 1).observations
    resets = {12: [1], 20: [0, 3], 21: [0]}  # before these observations
    by_hand = deepcopy(psim._learner)
    stream = LearningStream(psim, n=n, refit_every=4)
    inputs = np.empty((n, 31, psim.belief_size + 2))
    started = [[0] for _ in range(n)]
    for t in range(31):
        if t in resets:
            stream.reset(resets[t])
            for row in resets[t]:
                started[row].append(t)
        z = psim._scale.apply(x[:, t])
        inputs[:, t] = np.concatenate([stream.belief, z], axis=1)
        expected = stream.filter().update(stream.belief, x[:, t])  # by the filter in force
        np.testing.assert_array_equal(stream.update(x[:, t]), expected)
    pairs = 0
    z = psim._scale.apply(x)
    for row in range(n):
        for first, end in zip(started[row], [*started[row][1:], 31], strict=True):
            for t in range(first, end - k):
                future = z[row : row + 1, t + 1 : t + 1 + k]
                by_hand.add(by_hand.encode(inputs[row : row + 1, t]), psim._phi(future))
                pairs += 1
    # 30 - k + 1 pairs of the first episode of each row, k fewer for each reset that lets one be complete
    assert pairs == 4 * 28 - 3 * k - 1
    assert stream.n_pairs == psim._learner.n_pairs + pairs
    for ours, theirs in zip(sums_of(stream._learner), sums_of(by_hand), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


def test_an_episode_and_one_refit_are_one_partial_fit():
    data = some_data(1, 60, 2)
    psim = a_psim(n_future=3).partial_fit(some_data(1, 30, 3))  # its filter is now that of its aggregate
    stream = LearningStream(psim, refit_every=61)
    for x in data.observations[0]:
        stream.update(x[None])
    assert stream.n_refits == 1
    psim.partial_fit(data)
    ours, theirs = stream.filter().model_, psim.model_
    np.testing.assert_allclose(ours.coef_, theirs.coef_, rtol=0, atol=1e-10)
    np.testing.assert_allclose(ours.intercept_, theirs.intercept_, rtol=0, atol=1e-10)
    assert stream.n_pairs == psim._learner.n_pairs


def test_online_gradient_takes_zinkevichs_steps():
    psim = a_psim(algorithm="online_gradient", step_size=0.5)
    x = some_data(1, 3, 1).observations[0]
    stream = LearningStream(psim)
    held = psim._learner
    A, b, steps = held._weights.copy(), held._offset.copy(), held._iteration
    beliefs, z = [], psim._scale.apply(x)
    for t in range(4):
        beliefs.append(stream.belief[0])
        stream.update(x[t : t + 1])
    largest = held._curvature
    for t in (0, 1):  # k = 2: pairs of t = 0 at the third observation, of t = 1 at the fourth
        features = np.append(beliefs[t], z[t])
        largest = max(largest, features @ features + 1.0)
        eta = 0.5 / (largest * np.sqrt(steps + 1))
        residual = features @ A + b - z[t + 1 : t + 3].ravel()
        A, b = A - eta * (np.outer(features, residual) + psim._learner._alpha * A), b - eta * residual
        steps += 1
    np.testing.assert_allclose(stream.filter().model_.coef_, A.T, rtol=0, atol=1e-13)
    np.testing.assert_allclose(stream.filter().model_.intercept_, b, rtol=0, atol=1e-13)


def test_from_a_poor_start_the_error_comes_to_the_kalman_filters_and_the_mean_regret_falls():
    data = some_data(1, 3000, 1)
    psim = a_psim(n_episodes=2, n_steps=12)
    known = KalmanFilter.of(a_system()).errors(data).squared[0, :, 0]
    hindsight = PSIM(n_future=2, n_iterations=10).fit(data).errors(data).squared[0, :, 0]
    start = psim.errors(data).squared[0, :, 0]
    stream, found = LearningStream(psim), np.zeros(3001)
    for t, x in enumerate(data.observations[0]):
        stream.update(x[None])
        found[t] = stream.squared_error
    # the start is poor, the last third within 1 % of the best there is
    assert start[1:].mean() > 1.4 * known[1:].mean()
    last = (found[3000] - found[2000]) / 1000
    assert last < 1.01 * known[2001:].mean()
    # regret against the best fixed filter in hindsight
    T = np.array([100, 400, 1500, 3000])
    regret = np.array([(found[t] - hindsight[1 : t + 1].sum()) / t for t in T])
    assert (np.diff(regret) < 0).all()
    assert regret[-1] < 0.25 * regret[0]
    assert regret[-1] < 0.03 * hindsight[1:].mean()
    assert stream.mean_squared_error == pytest.approx(found[3000] / 3000)
    assert stream.n_predicted == 3000


def test_online_gradient_improves_on_a_poor_start():
    data = some_data(1, 3000, 1)
    psim = a_psim(n_episodes=2, n_steps=12, algorithm="online_gradient", step_size=1.0, belief_limit=10.0)
    stream = LearningStream(psim)
    for x in data.observations[0]:
        stream.update(x[None])
    fresh = some_data(5, 200, 9)
    known, start = KalmanFilter.of(a_system()).errors(fresh).mean, psim.errors(fresh).mean
    assert stream.filter().errors(fresh).mean - known < 0.5 * (start - known)


def test_where_the_system_changes_forgetting_follows():
    before, after = some_data(1, 1500, 1), some_data(1, 500, 2, A=TURN.T)  # it turns the other way round
    excess = {}
    fresh = some_data(10, 100, 3, A=TURN.T)
    best = KalmanFilter.of(a_system(TURN.T)).errors(fresh).mean
    for forgetting in (1.0, 0.995):
        stream = LearningStream(a_psim(), forgetting=forgetting)
        for x in np.concatenate([before.observations[0], after.observations[0]]):
            stream.update(x[None])
        excess[forgetting] = stream.filter().errors(fresh).mean / best - 1.0
    assert excess[0.995] < 0.05
    assert excess[1.0] > 2.5 * excess[0.995]


def test_forgetting_weighs_the_pairs_of_j_refits_ago_by_its_power():
    psim = a_psim()
    x = some_data(1, 9, 1).observations[0]
    stream = LearningStream(psim, refit_every=2, forgetting=0.5)
    for t in range(10):
        stream.update(x[t : t + 1])
    # k = 2: 1 pair at t = 2, .., 9; refits after t = 3, 5, 7, 9, each halves what is there
    assert stream.n_refits == 4
    weight = psim._learner._regressor.equations_.weight / 16 + 2 / 16 + 2 / 8 + 2 / 4 + 2 / 2
    assert stream._learner._regressor.equations_.weight == pytest.approx(weight)
    held = stream._learner._regressor
    np.testing.assert_allclose(
        stream.filter().model_.coef_, held.equations_.solve(held.alpha)[0].T, atol=1e-9
    )


def test_without_refits_streams_are_filters_one_by_one_and_together():
    psim = a_psim(features="second")
    data = some_data(5, 20, 1)
    together = LearningStream(psim, n=5, refit_every=NEVER)
    single = [LearningStream(psim, refit_every=NEVER) for _ in range(5)]
    filtered = psim.beliefs(data)
    np.testing.assert_array_equal(together.belief, filtered[:, 0])
    for t in range(21):
        belief = together.update(data.observations[:, t])
        np.testing.assert_array_equal(belief, filtered[:, t + 1])
        for i in range(5):
            alone = single[i].update(data.observations[i : i + 1, t])
            np.testing.assert_allclose(alone[0], belief[i], rtol=0, atol=1e-12)
    assert together.n_refits == 0
    assert together.n_pairs - psim._learner.n_pairs == 5 * (21 - 2)
    total = np.nansum(psim.errors(data).squared[:, 1:, 0])
    assert together.squared_error == pytest.approx(total)
    assert together.n_predicted == 100
    assert sum(one.squared_error for one in single) == pytest.approx(total)
    np.testing.assert_array_equal(together.predict_observation(), psim.predict_observation(belief))
    np.testing.assert_array_equal(together.forecast(4), psim.forecast(belief, 4))


@pytest.mark.parametrize("rows", [[1, 3], [False, True, False, True], np.array([-3, 3]), [3, 1, 1]])
def test_a_reset_begins_again_in_these_rows_alone(rows):
    psim = a_psim()
    x = some_data(4, 20, 1).observations
    reset, other = LearningStream(psim, n=4, refit_every=NEVER), LearningStream(psim, n=4, refit_every=NEVER)
    for t in range(10):
        reset.update(x[:, t])
        other.update(x[:, t])
    belief = reset.reset(rows)
    np.testing.assert_array_equal(belief[[1, 3]], psim.initial_belief(2))
    for t in range(10, 20):
        reset.update(x[:, t])
        other.update(x[:, t])
    np.testing.assert_array_equal(reset.belief[[0, 2]], other.belief[[0, 2]])
    expected = psim.beliefs(Sequences.from_observations(x[[1, 3], 10:20]))[:, -1]
    np.testing.assert_allclose(reset.belief[[1, 3]], expected, rtol=0, atol=1e-12)
    assert other.n_pairs - reset.n_pairs == 2 * 2  # n_future = 2 futures of each row would cross the end
    assert (
        other.n_predicted - reset.n_predicted == 2
    )  # and a first observation is not predicted from anything
    assert np.isnan(LearningStream(psim).mean_squared_error)
    before = reset.belief
    np.testing.assert_array_equal(reset.reset([]), before)
    np.testing.assert_array_equal(reset.reset(), psim.initial_belief(4))


@pytest.mark.parametrize(
    ("rows", "message"), [([4], "rows of 4 streams"), ([True], "a mask of shape"), ([0.5], "whole numbers")]
)
def test_rows_that_are_not_there_are_told(rows, message):
    stream = LearningStream(a_psim(), n=4)
    with pytest.raises(IndexError, match=message):
        stream.reset(rows)


def test_a_refused_observation_leaves_the_stream_as_it_was():
    psim = a_psim()
    x = some_data(2, 30, 1).observations
    disturbed, calm = LearningStream(psim, n=2), LearningStream(psim, n=2)
    for t in range(31):
        if t in (0, 1, 7, 20):
            bad = x[:, t].copy()
            bad[1, 0] = np.nan if t % 2 else np.inf
            with pytest.raises(
                ValueError, match=r"observation: expected finite numbers, got (nan|inf) at index"
            ):
                disturbed.update(bad)
            with pytest.raises(ValueError, match=r"expected shape \(2, 2\), got \(1, 2\)"):
                disturbed.update(x[:1, t])
        np.testing.assert_array_equal(disturbed.update(x[:, t]), calm.update(x[:, t]))
    for ours, theirs in zip(sums_of(disturbed._learner), sums_of(calm._learner), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert disturbed.mean_squared_error == calm.mean_squared_error


def test_a_feature_function_that_fails_leaves_the_stream_as_it_was():
    broken = []

    def features(futures):
        flat = futures.reshape(len(futures), -1)
        return np.full_like(flat, np.nan) if broken else flat

    psim = a_psim(features=features)
    x = some_data(1, 12, 1).observations[0]
    stream, calm = LearningStream(psim), LearningStream(psim)
    for t in range(13):
        if t == 6:
            broken.append(True)
            with pytest.raises(ValueError, match="features: expected finite numbers"):
                stream.update(x[t : t + 1])
            broken.clear()
        np.testing.assert_array_equal(stream.update(x[t : t + 1]), calm.update(x[t : t + 1]))
    assert stream.n_pairs == calm.n_pairs


def test_nothing_is_learned_from_beliefs_that_had_to_be_bounded():
    psim = a_psim()
    stream = LearningStream(psim, refit_every=NEVER)
    x = some_data(1, 20, 1).observations[0]
    for t in range(21):
        if t == 10:
            with pytest.warns(DivergenceWarning, match="left its bounds"):
                stream.update(1e6 * np.ones((1, 2)))
        else:
            stream.update(x[t : t + 1])
    assert (np.abs(stream.belief) <= psim._bound).all()
    # the belief of t = 11 alone is lost; those that follow from it are within their bounds
    assert stream.n_pairs - psim._learner.n_pairs == 21 - 2 - 1


def test_the_given_psim_and_filters_taken_from_the_stream_stay_as_they_are():
    psim = a_psim()
    data, x = some_data(3, 20, 1), some_data(1, 40, 2).observations[0]
    beliefs, sums = psim.beliefs(data), [np.copy(s) for s in sums_of(psim._learner)]
    stream = LearningStream(psim)
    for t in range(20):
        stream.update(x[t : t + 1])
    taken = stream.filter()
    taken_beliefs = taken.beliefs(data)
    assert not np.allclose(taken_beliefs, beliefs, atol=1e-6)
    shown = stream.belief
    shown[:] = 7.0  # a copy
    for t in range(20, 41):
        stream.update(x[t : t + 1])
    np.testing.assert_array_equal(taken.beliefs(data), taken_beliefs)
    np.testing.assert_array_equal(psim.beliefs(data), beliefs)
    for before, after in zip(sums, sums_of(psim._learner), strict=True):
        np.testing.assert_array_equal(before, after)
    psim.partial_fit(data)  # it goes on learning itself; a filter of the stream does not
    with pytest.raises(ValueError, match="still holds its aggregate"):
        taken.partial_fit(data)
    with pytest.raises(ValueError, match="still holds its aggregate"):
        LearningStream(taken)


def test_a_stream_can_be_pickled_in_the_middle():
    x = some_data(2, 30, 1).observations
    stream = LearningStream(a_psim(), n=2, refit_every=3)
    for t in range(15):
        stream.update(x[:, t])
    again = pickle.loads(pickle.dumps(stream))
    for t in range(15, 31):
        np.testing.assert_array_equal(again.update(x[:, t]), stream.update(x[:, t]))
    assert "LearningStream(PSIM, n=2, refit_every=3, forgetting=1" in repr(stream)


def test_any_regressor_learns_from_the_stored_aggregate():
    psim = a_psim(regressor=LinearRegression())
    stream = LearningStream(psim, n=2, refit_every=10)
    linear = LearningStream(a_psim(regressor=Ridge(alpha=0.0)), n=2, refit_every=10)
    x = some_data(2, 30, 1).observations
    for t in range(31):
        np.testing.assert_allclose(stream.update(x[:, t]), linear.update(x[:, t]), rtol=0, atol=1e-8)
    assert stream.n_refits == 3
    with pytest.raises(TypeError, match="linear in features"):
        LearningStream(psim, forgetting=0.9)


def test_what_is_no_stream_is_told():
    psim = a_psim()
    with pytest.raises(TypeError, match="a fitted PSIM, got ForwardPSIM"):
        LearningStream(ForwardPSIM(n_future=2).fit(some_data(5, 10, 0)))
    with pytest.raises(NotFittedError, match="not fitted yet"):
        LearningStream(PSIM())
    for parameters, message in (
        ({"n": 0}, "n to be a whole number"),
        ({"refit_every": 0}, "refit_every to be"),
        ({"forgetting": 0.0}, r"forgetting in \(0, 1\]"),
        ({"forgetting": 1.5}, r"forgetting in \(0, 1\]"),
    ):
        with pytest.raises(ValueError, match=message):
            LearningStream(psim, **parameters)
    with pytest.raises(ValueError, match="'online_gradient', which keeps no aggregate"):
        LearningStream(a_psim(algorithm="online_gradient"), forgetting=0.9)
