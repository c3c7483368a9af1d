"""The Kalman filter of hints against the known filter, other libraries and conditioning by hand."""

import pickle
import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning import Sequences
from beliefgym.learning.hint_errors import HintErrors
from beliefgym.learning.hint_kalman import GRID, KalmanHints
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.splits import fold_indices

A = np.array([[0.88, 0.29, 0.1], [-0.29, 0.88, 0.0], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.2, -1.0, 0.0]])
Q = np.array([[0.2, 0.05, 0.0], [0.05, 0.1, 0.0], [0.0, 0.0, 0.3]])
R = np.array([[0.5, 0.1], [0.1, 0.2]])
START = {"initial_mean": np.array([1.0, -2.0, 0.5]), "initial_covariance": np.diag([2.0, 1.0, 0.5])}
SYSTEM = LinearGaussianSystem(A, C, Q, R, **START)
PLAIN = {"transition_penalties": 1e-6, "observation_penalties": 1e-6}


def sampled(n, n_steps=30, seed=0, lengths=None, system=SYSTEM):
    """Trajectories whose hints are the states."""
    data = system.sample(n, n_steps, np.random.default_rng(seed))
    return Sequences.from_observations(data.observations, hints=data.states, lengths=lengths)


def with_units(data):
    """Other units and offsets, ragged."""
    return Sequences.from_observations(
        data.observations * [2.0, 1e3] + [5.0, -1e4],
        hints=data.hints * [1e-3, 10.0, 1.0] + [0.2, 0.0, -30.0],
        lengths=data.lengths,
    )


def raw(fitted):
    """A, C, Q, R, mu_0, Sigma_0 and the offsets of hints and observations, in the data's units."""
    system, h, x = fitted.kalman_.system_, fitted._hint_scale, fitted._scale
    to_h, to_x = np.diag(h.scale), np.diag(x.scale)
    from_h = np.diag(1.0 / h.scale)
    return (
        to_h @ system.transition_matrix @ from_h,
        to_x @ system.observation_matrix @ from_h,
        to_h @ system.transition_covariance @ to_h,
        to_x @ system.observation_covariance @ to_x,
        h.invert(system.initial_mean),
        to_h @ system.initial_covariance @ to_h,
        h.offset,
        x.offset,
    )


def by_hand(fitted, x):
    """E[h_t | x_0 .. x_t] and Cov, and the prediction of h_{t+1}, of one trajectory (T, n_obs) that may hold NaN."""
    A, C, Q, R, m, P, h_offset, x_offset = raw(fitted)
    means, covariances, m = [], [], m - h_offset
    for row in x:
        seen = np.flatnonzero(~np.isnan(row))
        if len(seen):
            c = C[seen]
            K = P @ c.T @ np.linalg.inv(c @ P @ c.T + R[np.ix_(seen, seen)])
            m = m + K @ (row[seen] - x_offset[seen] - c @ m)
            P = P - K @ c @ P
        means.append(m + h_offset)
        covariances.append(P)
        m, P = A @ m, A @ P @ A.T + Q
    return np.array(means), np.array(covariances)


def step_by_step(fitted, x, missing="raise"):
    """The public calls, one observation at a time: means and standard deviations (T, n_hint)."""
    belief, found = fitted.initial_belief(), []
    for row in x:
        belief = fitted.update(belief, row[None], missing=missing)
        found.append(fitted.predict_hint(belief))
    return np.array([e.mean[0] for e in found]), np.array([e.std[0] for e in found])


def test_on_much_data_it_is_the_true_systems_filter():
    train, test = sampled(1500, 40), sampled(400, 40, seed=1)
    fitted = KalmanHints(**PLAIN).fit(train)
    *learned, mean, covariance = raw(fitted)[:6]
    for found, true in zip(learned, (A, C, Q, R), strict=True):
        np.testing.assert_allclose(found, true, atol=0.02)  # 60,000 transitions
    np.testing.assert_allclose(mean, START["initial_mean"], atol=0.1)  # 1,500 starts
    np.testing.assert_allclose(covariance, START["initial_covariance"], atol=0.2)
    known, estimates = KalmanFilter.of(SYSTEM, stationary=False), []
    beliefs = known.beliefs(test)
    for t in range(41):
        estimates.append(known.filter_state(beliefs[:, t], test.observations[:, t]))
    best = HintErrors(np.stack(estimates, axis=1) - test.hints, np.ones((400, 41, 3)))
    errors = fitted.hint_errors(test)
    assert 0.999 < errors.mean / best.mean < 1.01
    np.testing.assert_allclose(errors.by_time, best.by_time, rtol=0.03)
    np.testing.assert_allclose(errors.mean_squared_z, 1.0, atol=0.05)
    np.testing.assert_allclose(errors.coverage(0.9), 0.9, atol=0.02)


@pytest.mark.parametrize("standardise", [True, "together", False])
def test_filtered_means_are_those_of_filterpy_and_pykalman(standardise):
    filterpy = pytest.importorskip("filterpy.kalman")
    pykalman = pytest.importorskip("pykalman")
    data = sampled(20, lengths=[30, 5, 0, 17] * 5)
    if standardise is not False:
        data = with_units(data)
    fitted = KalmanHints(standardise=standardise, transition_penalties=2.0, observation_penalties=0.5).fit(
        data
    )
    A, C, Q, R, m, P, h_offset, x_offset = raw(fitted)
    x = data.observations[0] - x_offset
    theirs = filterpy.KalmanFilter(dim_x=3, dim_z=2)
    theirs.x, theirs.P, theirs.F, theirs.H, theirs.Q, theirs.R = (m - h_offset)[:, None], P, A, C, Q, R
    means, covariances = pykalman.KalmanFilter(
        A, C, Q, R, initial_state_mean=m - h_offset, initial_state_covariance=P
    ).filter(x)
    mean, std = step_by_step(fitted, data.observations[0])
    for t in range(31):
        theirs.update(x[t][:, None])
        np.testing.assert_allclose(
            mean[t], np.ravel(theirs.x) + h_offset, rtol=1e-8, atol=1e-8 * fitted._hint_scale.scale.min()
        )
        np.testing.assert_allclose(std[t] ** 2, np.diag(theirs.P), rtol=1e-8)
        np.testing.assert_allclose(std[t] ** 2, np.diag(covariances[t]), rtol=1e-8)
        theirs.predict()
    np.testing.assert_allclose((mean - h_offset - means) / fitted._hint_scale.scale, 0.0, atol=1e-8)


def test_the_system_is_ridge_regression_of_standardised_hints():
    data = with_units(sampled(12, 15, lengths=[15, 4, 0, 9] * 3))
    fitted = KalmanHints(transition_penalties=3.0, observation_penalties=7.0).fit(data)
    rows = data.hints[data.observation_mask]
    h = (data.hints - rows.mean(axis=0)) / rows.std(axis=0)
    rows = data.observations[data.observation_mask]
    x = (data.observations - rows.mean(axis=0)) / rows.std(axis=0)
    pairs = [(i, t) for i, length in enumerate(data.lengths) for t in range(length)]
    before, after = (np.array([h[i, t + j] for i, t in pairs]) for j in (0, 1))
    s, z = h[data.observation_mask], x[data.observation_mask]
    system = fitted.kalman_.system_
    A_hat = np.linalg.solve(before.T @ before + 3.0 * np.eye(3), before.T @ after).T
    C_hat = np.linalg.solve(s.T @ s + 7.0 * np.eye(3), s.T @ z).T
    np.testing.assert_allclose(system.transition_matrix, A_hat, atol=1e-10)
    np.testing.assert_allclose(system.observation_matrix, C_hat, atol=1e-10)
    e, d = after - before @ A_hat.T, z - s @ C_hat.T
    np.testing.assert_allclose(
        system.transition_covariance, (e.T @ e + 3.0 * A_hat @ A_hat.T) / len(e), atol=1e-10
    )
    np.testing.assert_allclose(
        system.observation_covariance, (d.T @ d + 7.0 * C_hat @ C_hat.T) / len(d), atol=1e-10
    )
    np.testing.assert_allclose(system.initial_mean, h[:, 0].mean(axis=0), atol=1e-10)
    np.testing.assert_allclose(system.initial_covariance, np.cov(h[:, 0].T, bias=True), atol=1e-10)


def test_the_chosen_penalties_have_the_lowest_cross_validated_error():
    data = sampled(7, 6, seed=3, lengths=[6, 3, 6, 1, 6, 6, 5])
    grid = (0.01, 3.0, 30.0)
    fitted = KalmanHints(transition_penalties=grid, observation_penalties=grid[1:]).fit(data)
    expected = np.empty((3, 2))
    for i, j in np.ndindex(3, 2):
        one = KalmanHints(transition_penalties=grid[i], observation_penalties=grid[1 + j])
        parts = fold_indices(7, 5, 0, None)
        errors = [clone(one).fit(data[left]).hint_errors(data[out]).by_episode for left, out in parts]
        expected[i, j] = np.concatenate(errors).mean()
    np.testing.assert_allclose(fitted.penalty_errors_, expected, rtol=1e-12)
    i, j = np.unravel_index(np.argmin(expected), (3, 2))
    assert (fitted.transition_penalty_, fitted.observation_penalty_) == (grid[i], grid[1 + j])
    assert fitted.kalman_.transition_penalty == grid[i]
    assert fitted.kalman_.observation_penalty == grid[1 + j]


def test_validation_chooses_where_it_is_given():
    train, validation = sampled(4, 5, seed=3), sampled(60, 30, seed=4)
    fitted = KalmanHints().fit(train, validation)
    errors = fitted.penalty_errors_
    assert errors.shape == (len(GRID), len(GRID))
    assert fitted.hint_errors(validation).mean == pytest.approx(errors.min(), rel=1e-12)
    assert errors.min() < 0.99 * errors[0, 0]  # little data: penalties help
    assert fitted.transition_penalty_ == GRID[np.argmin(errors.min(axis=1))]
    one = KalmanHints(
        transition_penalties=fitted.transition_penalty_, observation_penalties=fitted.observation_penalty_
    ).fit(train)
    np.testing.assert_array_equal(one.beliefs(validation), fitted.beliefs(validation))
    assert np.isnan(one.penalty_errors_).all()


def test_without_observations_the_estimate_is_the_pure_prediction():
    data = with_units(sampled(20))
    fitted = KalmanHints(**PLAIN).fit(data)
    A, _, Q, _, _, _, offset, _ = raw(fitted)
    x = data.observations[0].copy()
    x[5:8] = np.nan
    seen, covariances = by_hand(fitted, data.observations[0])
    mean, std = step_by_step(fitted, x, missing="predict")
    np.testing.assert_allclose(mean[:5], seen[:5], rtol=1e-9)
    m, P = seen[4] - offset, covariances[4]
    for t in range(5, 8):
        m, P = A @ m, A @ P @ A.T + Q
        np.testing.assert_allclose(mean[t], m + offset, rtol=1e-9)
        np.testing.assert_allclose(std[t], np.sqrt(np.diag(P)), rtol=1e-9)
    assert (std[7] > std[4]).all()
    assert (std[8] < std[7]).all()


def test_missing_components_leave_the_exact_posterior_of_the_others():
    noise = np.array([[0.5, 0.3, -0.2], [0.3, 0.4, 0.1], [-0.2, 0.1, 0.6]])
    system = LinearGaussianSystem(A, np.vstack([C, [0.3, 0.3, 0.3]]), Q, noise, **START)
    data = sampled(20, system=system)
    fitted = KalmanHints(**PLAIN).fit(data)
    x = data.observations[:6].copy()
    x[np.random.default_rng(0).random(x.shape) < 0.4] = np.nan
    x[1, 0], x[2, 0] = np.nan, [np.nan, 3.0, 1.0]  # from the first observation on
    belief, found = fitted.initial_belief(6), []
    for t in range(31):  # all at once, each with its own gaps
        belief = fitted.update(belief, x[:, t], missing="predict")
        found.append(fitted.predict_hint(belief))
    for i in range(6):
        means, covariances = by_hand(fitted, x[i])
        for t in range(31):
            np.testing.assert_allclose(found[t].mean[i], means[t], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(found[t].std[i], np.sqrt(np.diag(covariances[t])), rtol=1e-9)


def test_whole_trajectories_are_the_steps_one_by_one():
    train, test = sampled(20), sampled(5, seed=1, lengths=[30, 7, 1, 0, 22])
    fitted = KalmanHints(**PLAIN).fit(train)
    mean, std = fitted.estimate_hints(test)
    for i, length in enumerate(test.lengths):
        alone = step_by_step(fitted, test.observations[i, : length + 1])
        np.testing.assert_allclose(mean[i, : length + 1], alone[0], atol=1e-12)
        np.testing.assert_allclose(std[i, : length + 1], alone[1], atol=1e-12)
        assert np.isnan(mean[i, length + 1 :]).all()
    beliefs = fitted.beliefs(test)
    np.testing.assert_allclose(fitted.predict_hint(beliefs[0, 1:]).mean, mean[0], atol=1e-12)


def test_before_any_observation_it_says_the_first_hints():
    data = sampled(20)
    fitted = KalmanHints(**PLAIN).fit(data)
    mean, std = fitted.predict_hint(fitted.initial_belief(3))
    np.testing.assert_allclose(mean, [fitted.prior_mean_] * 3, atol=1e-12)
    np.testing.assert_allclose(std, [fitted.prior_std_] * 3, atol=1e-12)


def test_observations_are_predicted_as_by_the_wrapped_filter():
    data = with_units(sampled(20))
    fitted = KalmanHints(**PLAIN).fit(data)
    belief, own = fitted.beliefs(data)[:, 6], fitted.kalman_.beliefs(data)[:, 6]
    np.testing.assert_allclose(
        fitted.predict_observation(belief), fitted.kalman_.predict_observation(own), rtol=1e-9
    )
    np.testing.assert_allclose(fitted.forecast(belief, 4), fitted.kalman_.forecast(own, 4), rtol=1e-9)
    assert fitted.errors(data).mean == pytest.approx(fitted.kalman_.errors(data).mean, rel=1e-9)


def test_the_stationary_filter_is_the_limit_of_the_other():
    data = sampled(50, 60)
    fixed, varying = (KalmanHints(**PLAIN, stationary=s).fit(data) for s in (True, False))
    assert fixed.belief_size == 9 < varying.belief_size == 15
    ours, theirs = fixed.estimate_hints(data), varying.estimate_hints(data)
    np.testing.assert_allclose(ours.mean[:, -1], theirs.mean[:, -1], atol=1e-8)
    np.testing.assert_allclose(ours.std[:, -1], theirs.std[:, -1], atol=1e-8)
    belief = fixed.beliefs(data)[:, 9]
    np.testing.assert_allclose(
        fixed.predict_hint(fixed.update(belief, data.observations[:, 9])).mean,
        fixed.kalman_.filter_state(belief[:, :3], data.observations[:, 9]),
        atol=1e-12,
    )
    unseen = fixed.update(belief, np.full((50, 2), np.nan), missing="predict")
    np.testing.assert_allclose(
        fixed.predict_hint(unseen).mean, fixed.kalman_.predict_state(belief[:, :3]), atol=1e-12
    )


def test_units_do_not_matter():
    plain = sampled(12, 15, lengths=[15, 4, 0, 9] * 3)
    one, other = (KalmanHints(**PLAIN).fit(data) for data in (plain, with_units(plain)))
    difference, scaled = one.hint_errors(plain).difference, other.hint_errors(with_units(plain)).difference
    np.testing.assert_allclose(scaled / [1e-3, 10.0, 1.0], difference, atol=1e-8)


def test_states_serve_as_hints_and_actions_are_not_looked_at():
    data = sampled(10)
    other = Sequences.from_observations(
        data.observations, states=data.hints, actions=np.random.default_rng(0).normal(size=(10, 30, 1))
    )
    one, states = KalmanHints(**PLAIN).fit(data), KalmanHints(**PLAIN, hints_from="states").fit(other)
    np.testing.assert_array_equal(one.estimate_hints(data).mean, states.estimate_hints(other).mean)


def test_constant_components_are_told_once_and_do_no_harm():
    data = sampled(20)
    still = Sequences.from_observations(
        np.concatenate([data.observations, np.full((20, 31, 1), 7.0)], axis=2),
        hints=np.concatenate([data.hints, np.full((20, 31, 1), 3.0)], axis=2),
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fitted = KalmanHints(transition_penalties=(1e-6, 1.0), observation_penalties=1e-6).fit(still)
    assert [str(w.message).split(" ")[0] for w in told] == ["observations", "hints"]
    plain = KalmanHints(transition_penalties=(1e-6, 1.0), observation_penalties=1e-6).fit(data)
    mean = fitted.estimate_hints(still).mean
    np.testing.assert_allclose(mean[..., 3], 3.0, atol=1e-9)
    np.testing.assert_allclose(mean[..., :3], plain.estimate_hints(data).mean, atol=1e-6)


def test_hints_and_observations_without_noise_are_followed():
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    h = np.stack([np.random.default_rng(0).normal(size=(10, 2))] * 31, axis=1)
    for t in range(30):
        h[:, t + 1] = h[:, t] @ turn.T
    data = Sequences.from_observations(h[..., :1], hints=h)
    # about 0, which the circles turn about, and not about the data's mean
    errors = KalmanHints(**PLAIN, standardise=False).fit(data).hint_errors(data)
    # one position says nothing of the other, two say all, as exactly as NOISE_FLOOR lets them
    assert errors.by_time[0] > 0.3
    assert errors.by_time[1:].max() < 2e-3
    assert np.isfinite(errors.std).all()


def test_a_pickled_and_a_cloned_filter_are_the_same():
    data = sampled(10)
    fitted = KalmanHints(transition_penalties=[0.1, 10.0]).fit(data)
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.beliefs(data), fitted.beliefs(data))
    other = clone(fitted)
    assert other.get_params() == fitted.get_params()
    with pytest.raises(NotFittedError):
        other.initial_belief()
    np.testing.assert_array_equal(other.fit(data).beliefs(data), fitted.beliefs(data))


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, [], [1.0, -2.0], "auto", None, [[1.0]]], ids=str)
@pytest.mark.parametrize("name", ["transition_penalties", "observation_penalties"])
def test_penalties_out_of_range_are_told(name, value):
    with pytest.raises(ValueError, match=rf"expected {name} as a number or several, each finite .* got"):
        KalmanHints(**{name: value}).fit(sampled(4))


def test_other_errors_say_what_was_expected():
    data = sampled(4)
    with pytest.raises(ValueError, match="expected training trajectories with hints"):
        KalmanHints().fit(Sequences.from_observations(data.observations))
    with pytest.raises(ValueError, match="at least 2 trajectories .* got 1; pass validation, or one"):
        KalmanHints().fit(data[:1])
    KalmanHints(**PLAIN).fit(data[:1])
    KalmanHints().fit(data[:1], data[1:])
    with pytest.raises(TypeError, match="expected Sequences"):
        KalmanHints().fit(data.observations)
    fitted = KalmanHints(**PLAIN).fit(data)
    x = np.array([[np.nan, 1.0]])
    with pytest.raises(ValueError, match=r"got nan at index \(0, 0\); missing='predict'"):
        fitted.update(fitted.initial_belief(), x)
    with pytest.raises(ValueError, match="expected finite numbers, got inf"):
        fitted.update(fitted.initial_belief(), x * [1.0, np.inf], missing="predict")
    with pytest.raises(ValueError, match="belief: expected shape"):
        fitted.predict_hint(np.zeros((1, 3)))


def test_a_failed_fit_leaves_nothing_to_filter_with():
    data = sampled(4)
    fitted = KalmanHints(**PLAIN).fit(data)
    with pytest.raises(ValueError, match="with hints"):
        fitted.fit(Sequences.from_observations(data.observations))
    with pytest.raises(NotFittedError):
        fitted.initial_belief()


def test_a_system_without_a_limit_is_told_by_the_stationary_filter():
    rng = np.random.default_rng(0)
    h = rng.normal(size=(6, 1, 1)) * 1.2 ** np.arange(20)[:, None]
    data = Sequences.from_observations(np.full((6, 20, 1), 2.0), hints=h)  # growing and not observed
    with (
        pytest.warns(UserWarning, match="do not vary"),
        pytest.raises(ValueError, match="got none of 2; pass larger ones, or stationary=False"),
    ):
        KalmanHints(transition_penalties=(0.0, 1e-9), observation_penalties=1.0, stationary=True).fit(data)
