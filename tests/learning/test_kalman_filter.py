"""Linear-Gaussian systems and their Kalman filters, against conditioning of the joint Gaussian and other libraries."""

import pickle

import control
import numpy as np
import pytest
from scipy.linalg import block_diag
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning import Sequences
from beliefgym.learning.filters import Filter
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem

A = np.array([[0.88, 0.29, 0.1], [-0.29, 0.88, 0.0], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.2, -1.0, 0.0]])
Q = np.array([[0.2, 0.05, 0.0], [0.05, 0.1, 0.0], [0.0, 0.0, 0.3]])
R = np.array([[0.5, 0.1], [0.1, 0.2]])
P0 = np.diag([2.0, 1.0, 0.5])
MEAN = np.array([1.0, -2.0, 0.5])
both = pytest.mark.parametrize("stationary", [True, False])


def a_system(**changes):
    parts = {"A": A, "C": C, "Q": Q, "R": R, **changes}
    matrices = [parts.pop(name) for name in "ACQR"]
    return LinearGaussianSystem(*matrices, **parts)


def joint_gaussian(system, n_times):
    """Mean and covariance of (s_0, .., x_0, ..) stacked: s = (I - shift A)^-1 noise, x = C s + noise."""
    n = system.n_states
    noise = block_diag(system.initial_covariance, *[system.transition_covariance] * (n_times - 1))
    unroll = np.eye(n * n_times)
    for t in range(1, n_times):
        rows, before = slice(t * n, (t + 1) * n), slice((t - 1) * n, t * n)
        unroll[rows] += system.transition_matrix @ unroll[before]
    mean = unroll[:, :n] @ system.initial_mean
    seen = np.kron(np.eye(n_times), system.observation_matrix)
    both_of = np.vstack([unroll, seen @ unroll])
    covariance = both_of @ noise @ both_of.T
    covariance[n * n_times :, n * n_times :] += np.kron(np.eye(n_times), system.observation_covariance)
    return np.concatenate([mean, seen @ mean]), covariance


def conditioned(mean, covariance, wanted, given, values):
    """Mean and covariance of the components `wanted` where those `given` have these values."""
    if not len(given):
        return mean[wanted], covariance[np.ix_(wanted, wanted)]
    cross = covariance[np.ix_(wanted, given)]
    gain = np.linalg.solve(covariance[np.ix_(given, given)], cross.T).T
    return mean[wanted] + gain @ (values - mean[given]), covariance[np.ix_(wanted, wanted)] - gain @ cross.T


@pytest.mark.parametrize("n_obs", [1, 2, 5])
def test_the_time_varying_filter_is_conditioning_of_the_joint_gaussian(n_obs):
    rng = np.random.default_rng(n_obs)
    noise = rng.normal(size=(n_obs, n_obs))
    system = a_system(
        C=rng.normal(size=(n_obs, 3)),
        R=noise @ noise.T + 0.1 * np.eye(n_obs),
        initial_mean=MEAN,
        initial_covariance=P0,
    )
    n_times, n = 6, 3
    data = system.sample(4, n_times - 1, rng)
    kalman = KalmanFilter.of(system, stationary=False)
    beliefs = kalman.beliefs(data)
    mean, covariance = joint_gaussian(system, n_times)
    index = n * n_times + np.arange(n_times * n_obs).reshape(n_times, n_obs)
    for i in range(4):
        for t in range(n_times):
            belief, values = beliefs[i : i + 1, t], data.observations[i, :t].ravel()
            states = np.arange(t * n, (t + 1) * n)
            expected, P = conditioned(mean, covariance, states, index[:t].ravel(), values)
            np.testing.assert_allclose(kalman.predict_state(belief)[0], expected, atol=1e-10)
            np.testing.assert_allclose(belief[0, n:], P[np.triu_indices(n)], atol=1e-10)
            expected, S = conditioned(mean, covariance, index[t], index[:t].ravel(), values)
            np.testing.assert_allclose(kalman.predict_observation(belief)[0], expected, atol=1e-10)
            np.testing.assert_allclose(kalman.predict_variance(belief)[0], np.diag(S), atol=1e-10)
            present = data.observations[i, : t + 1].ravel()
            expected, _ = conditioned(mean, covariance, states, index[: t + 1].ravel(), present)
            filtered = kalman.filter_state(belief, data.observations[i, t : t + 1])[0]
            np.testing.assert_allclose(filtered, expected, atol=1e-10)


@both
def test_a_forecast_is_conditioning_and_feeding_predictions_back(stationary):
    system = a_system(initial_mean=MEAN, initial_covariance=P0)
    data = system.sample(3, 7, np.random.default_rng(0))
    kalman = KalmanFilter.of(system, stationary=stationary)
    belief = kalman.beliefs(data)[:, 4]
    forecast = kalman.forecast(belief, 4)
    np.testing.assert_allclose(forecast, Filter._forecast(kalman, belief, 4), atol=1e-12)
    if not stationary:
        mean, covariance = joint_gaussian(system, 8)
        index = 24 + np.arange(16)
        expected, _ = conditioned(mean, covariance, index[8:], index[:8], data.observations[1, :4].ravel())
        np.testing.assert_allclose(forecast[1].ravel(), expected, atol=1e-10)


def test_agrees_with_filterpy_and_pykalman():
    filterpy = pytest.importorskip("filterpy.kalman")
    pykalman = pytest.importorskip("pykalman")
    system = a_system(initial_mean=MEAN, initial_covariance=P0)
    data = system.sample(1, 30, np.random.default_rng(0))
    x = data.observations[0]
    theirs = filterpy.KalmanFilter(dim_x=3, dim_z=2)
    theirs.x, theirs.P, theirs.F, theirs.H, theirs.Q, theirs.R = MEAN[:, None], P0, A, C, Q, R
    beliefs = KalmanFilter.of(system, stationary=False).beliefs(data)[0]
    for t in range(31):
        np.testing.assert_allclose(beliefs[t, :3], np.ravel(theirs.x), atol=1e-10)
        np.testing.assert_allclose(beliefs[t, 3:], theirs.P[np.triu_indices(3)], atol=1e-10)
        theirs.update(x[t][:, None])
        theirs.predict()
    others = pykalman.KalmanFilter(A, C, Q, R, initial_state_mean=MEAN, initial_state_covariance=P0)
    means, _ = others.filter(x)
    kalman = KalmanFilter.of(system, stationary=False)
    np.testing.assert_allclose(kalman.filter_state(beliefs[:-1], x), means, atol=1e-10)


def test_the_stationary_gain_is_pythoncontrols():
    gain, S, P = a_system().stationary_gain()
    L, P_theirs, poles = control.dlqe(A, np.eye(3), C, Q, R)
    np.testing.assert_allclose(gain, L, atol=1e-10)
    np.testing.assert_allclose(P, P_theirs, atol=1e-10)
    np.testing.assert_allclose(S, C @ P_theirs @ C.T + R, atol=1e-10)
    kalman = KalmanFilter.of(a_system())
    np.testing.assert_allclose(kalman.transition_matrix, A - L @ C, atol=1e-10)
    np.testing.assert_allclose(
        np.sort_complex(kalman.transition_eigenvalues), np.sort_complex(poles), atol=1e-10
    )
    assert (np.diff(np.abs(kalman.transition_eigenvalues)) <= 1e-12).all()


def test_the_time_varying_filter_becomes_the_stationary_one():
    system = a_system(initial_mean=MEAN, initial_covariance=P0)
    data = system.sample(5, 200, np.random.default_rng(0))
    fixed, varying = KalmanFilter.of(system), KalmanFilter.of(system, stationary=False)
    ours, theirs = fixed.beliefs(data)[:, -1], varying.beliefs(data)[:, -1]
    np.testing.assert_allclose(ours, theirs[:, :3], atol=1e-10)
    np.testing.assert_allclose(fixed.predict_variance(ours), varying.predict_variance(theirs), atol=1e-10)
    np.testing.assert_allclose(varying.transition_matrix, fixed.transition_matrix, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_of_observations_and_states_do_not_matter(scale):
    x_unit, s_unit = np.array([scale, 1.0]), np.array([1.0, 1.0 / scale, 1.0])
    system = a_system(initial_mean=MEAN, initial_covariance=P0)
    scaled = LinearGaussianSystem(
        A * np.outer(s_unit, 1 / s_unit),
        C * np.outer(x_unit, 1 / s_unit),
        Q * np.outer(s_unit, s_unit),
        R * np.outer(x_unit, x_unit),
        initial_mean=MEAN * s_unit,
        initial_covariance=P0 * np.outer(s_unit, s_unit),
    )
    x = system.sample(3, 20, np.random.default_rng(0)).observations
    for stationary in (True, False):
        plain, other = KalmanFilter.of(system, stationary), KalmanFilter.of(scaled, stationary)
        b = plain.beliefs(Sequences.from_observations(x))[:, -1]
        b_scaled = other.beliefs(Sequences.from_observations(x * x_unit))[:, -1]
        predicted = plain.predict_observation(b)
        np.testing.assert_allclose(other.predict_observation(b_scaled) / x_unit, predicted, atol=1e-7)
        variance = plain.predict_variance(b)
        np.testing.assert_allclose(other.predict_variance(b_scaled) / x_unit**2, variance, rtol=1e-7)
        np.testing.assert_allclose(other.predict_state(b_scaled) / s_unit, plain.predict_state(b), atol=1e-7)


@both
def test_a_batch_is_its_trajectories_one_by_one(stationary):
    system = a_system(initial_mean=MEAN, initial_covariance=P0)
    x = system.sample(5, 12, np.random.default_rng(0)).observations
    data = Sequences.from_observations(x, lengths=[12, 3, 7, 0, 5])
    kalman = KalmanFilter.of(system, stationary=stationary)
    together = kalman.beliefs(data)
    for i in range(5):
        one = kalman.beliefs(data[i])
        np.testing.assert_allclose(together[i], one[0], rtol=0, atol=1e-13)
        assert (together[i, data.lengths[i] + 1 :] == together[i, data.lengths[i] + 1]).all()
    # beliefs of different times in one batch
    mixed = together[0, [0, 1, 5, 9]]
    following = kalman.update(mixed, x[0, [0, 1, 5, 9]])
    np.testing.assert_allclose(following, together[0, [1, 2, 6, 10]], atol=1e-13)
    singly = [kalman.predict_variance(mixed[i : i + 1])[0] for i in range(4)]
    np.testing.assert_allclose(kalman.predict_variance(mixed), singly, atol=1e-14)


def test_samples_have_the_systems_moments():
    system = a_system()
    data = system.sample(20_000, 3, np.random.default_rng(0))
    stacked = np.concatenate([data.states.reshape(20_000, -1), data.observations.reshape(20_000, -1)], axis=1)
    _, covariance = joint_gaussian(system, 4)
    deviation = np.sqrt(np.diag(covariance))
    error = (np.cov(stacked.T, bias=True) - covariance) / np.outer(deviation, deviation)
    assert np.abs(error).max() < 5 / np.sqrt(20_000)  # 5 standard errors of a correlation
    np.testing.assert_allclose(
        covariance[:3, :3], covariance[9:12, 9:12], atol=1e-10
    )  # stationary by default


def test_the_stationary_filter_recovers_the_innovations_form_from_the_first_step():
    system = a_system(initial_mean=MEAN)
    data = system.sample_innovations(400, 30, np.random.default_rng(0))
    kalman = KalmanFilter.of(system)
    np.testing.assert_allclose(kalman.beliefs(data)[:, :-1], data.states, atol=1e-12)
    _, S, _ = system.stationary_gain()
    error = kalman.errors(data)
    assert error.mean == pytest.approx(np.trace(S), rel=0.03)  # 12 000 squares: 1 % standard error
    assert error.by_time[0] == pytest.approx(np.trace(S), rel=0.25)  # 400 squares
    assert error.mean < KalmanFilter.of(system, stationary=False).errors(data).mean


def test_the_innovations_form_from_a_stationary_start_has_the_systems_own_law():
    system = a_system()
    data = system.sample_innovations(20_000, 3, np.random.default_rng(1), start="stationary")
    x = data.observations.reshape(20_000, -1)
    covariance = joint_gaussian(system, 4)[1][12:, 12:]
    deviation = np.sqrt(np.diag(covariance))
    error = (np.cov(x.T, bias=True) - covariance) / np.outer(deviation, deviation)
    assert np.abs(error).max() < 5 / np.sqrt(20_000)  # 5 standard errors of a correlation
    varying = KalmanFilter.of(system, stationary=False).errors(data).by_time
    fixed = KalmanFilter.of(system).errors(data).by_time
    assert (varying[1:] < fixed[1:]).all()


@both
def test_two_thirds_of_the_innovations_lie_within_one_deviation(stationary):
    system = a_system()
    data = system.sample(300, 60, np.random.default_rng(0))
    kalman = KalmanFilter.of(system, stationary=stationary)
    beliefs = kalman.beliefs(data)[:, 20:-1].reshape(300 * 41, -1)
    x = data.observations[:, 20:].reshape(300 * 41, -1)
    inside = np.abs(x - kalman.predict_observation(beliefs)) < np.sqrt(kalman.predict_variance(beliefs))
    np.testing.assert_allclose(inside.mean(axis=0), 0.6827, atol=0.015)  # standard error 0.004


def test_a_known_filter_can_be_cloned_fitted_and_pickled():
    system = a_system()
    data = system.sample(3, 10, np.random.default_rng(0))
    kalman = KalmanFilter.of(system)
    again = clone(kalman)
    with pytest.raises(NotFittedError, match="not fitted yet"):
        again.beliefs(data)
    again.fit(data)
    for other in (again, pickle.loads(pickle.dumps(kalman))):
        np.testing.assert_array_equal(other.beliefs(data), kalman.beliefs(data))
    assert "LinearGaussianSystem(n_states=3, n_obs=2)" in repr(kalman)
    with pytest.raises(ValueError, match="2 observations as the system, got 3"):
        kalman.fit(Sequences.from_observations(np.random.default_rng(0).normal(size=(2, 5, 3))))
    kalman.beliefs(data)  # still usable


def test_an_undisturbed_state_has_a_filter_where_it_fades():
    still = a_system(Q=np.zeros((3, 3)), initial_covariance=P0)
    gain, S, P = still.stationary_gain()
    np.testing.assert_allclose(gain, 0.0, atol=1e-12)
    np.testing.assert_allclose(P, 0.0, atol=1e-12)
    np.testing.assert_allclose(S, R, atol=1e-12)


def test_a_hardly_disturbed_state_has_the_limit_of_the_recursion():
    system = a_system(Q=1e-20 * Q, initial_covariance=P0)
    recursion = KalmanFilter.of(system, stationary=False)
    data = system.sample(1, 600, np.random.default_rng(0))
    P = recursion.beliefs(data)[0, -1, 3:]
    np.testing.assert_allclose(
        P, system.stationary_gain().predicted_covariance[np.triu_indices(3)], rtol=1e-9
    )


def test_an_unstable_system_that_is_observed_has_a_stationary_filter():
    system = LinearGaussianSystem(
        [[1.2, 1.0], [0.0, 1.0]], [[1.0, 0.0]], np.eye(2), [[1.0]], initial_covariance=np.eye(2)
    )
    kalman = KalmanFilter.of(system)
    assert np.abs(kalman.transition_eigenvalues[0]) < 1
    recursion = KalmanFilter.of(system, stationary=False)
    data = system.sample(1, 60, np.random.default_rng(0))
    np.testing.assert_allclose(
        recursion.predict_variance(recursion.beliefs(data)[:, -1]),
        kalman.predict_variance(kalman.initial_belief()),
        rtol=1e-9,
    )


UNSEEN = {"A": np.diag([1.1, 0.5, 0.2]), "C": [[0.0, 1.0, 1.0]], "R": [[1.0]], "initial_covariance": P0}
KEPT = {"A": np.eye(3), "Q": np.zeros((3, 3)), "initial_covariance": P0}


@pytest.mark.parametrize("changes", [UNSEEN, KEPT], ids=["unseen", "undisturbed"])
def test_a_system_without_a_stationary_filter_is_told_and_filtered_with_varying_gain(changes):
    system = a_system(**changes)
    with pytest.raises(ValueError, match="stationary=False"):
        KalmanFilter.of(system)
    kalman = KalmanFilter.of(system, stationary=False)
    data = system.sample(2, 10, np.random.default_rng(0))
    assert np.isfinite(kalman.beliefs(data)).all()
    with pytest.raises(ValueError, match="stationary=False"):
        kalman.transition_matrix  # noqa: B018


NO_SYSTEMS = {
    "A not square": ({"A": np.ones((2, 3))}, "transition_matrix: expected shape"),
    "C of other size": (
        {"C": np.ones((2, 2))},
        r"observation_matrix: expected shape \(n_obs, 3\), got \(2, 2\)",
    ),
    "negative variance": (
        {"Q": np.diag([1.0, 1.0, -0.1])},
        "transition_covariance: expected variances of at",
    ),
    "not symmetric": ({"Q": np.eye(3) + 0.1 * np.eye(3, k=1)}, "transition_covariance: expected a symmetric"),
    "not semidefinite": ({"Q": 2.0 - 1.5 * np.eye(3)}, "transition_covariance: expected a positive semidef"),
    "singular R": ({"R": np.ones((2, 2))}, "give exact sensors a small variance"),
    "NaN": ({"R": np.full((2, 2), np.nan)}, "observation_covariance: expected finite numbers"),
    "infinite": ({"A": A + np.inf}, "transition_matrix: expected finite numbers"),
    "not stable": ({"A": np.eye(3)}, "spectral radius 1; pass initial_covariance"),
    "mean": ({"initial_mean": [1.0]}, r"initial_mean: expected shape \(3,\), got \(1,\)"),
    "initial": ({"initial_covariance": np.eye(2)}, r"initial_covariance: expected shape \(3, 3\)"),
}


@pytest.mark.parametrize("case", list(NO_SYSTEMS))
def test_a_system_that_is_none_is_told(case):
    changes, message = NO_SYSTEMS[case]
    with pytest.raises(ValueError, match=message):
        a_system(**changes)


def test_a_system_is_a_read_only_copy():
    ours = A.copy()
    system = a_system(A=ours)
    ours[0, 0] = 9.0
    assert system.transition_matrix[0, 0] == A[0, 0]
    with pytest.raises(ValueError, match="read-only"):
        system.transition_matrix[0, 0] = 1.0
    with pytest.raises(ValueError, match='"mean" or "stationary"'):
        system.sample_innovations(1, 1, np.random.default_rng(0), start="zero")


@both
def test_wrong_beliefs_and_observations_are_told(stationary):
    kalman = KalmanFilter.of(a_system(), stationary=stationary)
    size = 3 if stationary else 9
    assert kalman.belief_size == size
    with pytest.raises(ValueError, match=rf"belief: expected shape \(n, {size}\)"):
        kalman.predict_variance(np.zeros((2, 4)))
    with pytest.raises(ValueError, match=r"observation: expected shape \(2, 2\), got \(1, 2\)"):
        kalman.filter_state(kalman.initial_belief(2), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="expected finite numbers, got nan"):
        kalman.filter_state(kalman.initial_belief(1), [[np.nan, 0.0]])
