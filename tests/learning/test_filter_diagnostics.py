"""Stability, calibration and error curves of filters, against closed forms."""

import numpy as np
import pytest
from scipy.stats import norm
from sklearn.exceptions import NotFittedError

from beliefgym.learning import PolynomialRidge, RandomFourierRidge, Ridge, Sequences
from beliefgym.learning.autoregressive_filter import AutoregressiveFilter
from beliefgym.learning.filter_diagnostics import (
    STEP,
    calibration,
    error_over_time,
    filter_jacobian,
    look_ahead_errors,
    spectral_radius,
    stability,
)
from beliefgym.learning.filters import Filter
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_forward import ForwardPSIM
from beliefgym.learning.standardisation import Standardisation
from beliefgym.learning.subspace_identification import N4SID

A = np.array([[0.88, 0.29, 0.1], [-0.29, 0.88, 0.0], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.2, -1.0, 0.0]])
Q = np.array([[0.2, 0.05, 0.0], [0.05, 0.1, 0.0], [0.0, 0.0, 0.3]])
R = np.array([[0.5, 0.1], [0.1, 0.2]])
SYSTEM = LinearGaussianSystem(A, C, Q, R)


def some_data(n_episodes, n_steps, seed):
    return SYSTEM.sample(n_episodes, n_steps, np.random.default_rng(seed))


def zeros(n_episodes, n_steps, n_obs=1):
    return Sequences.from_observations(np.zeros((n_episodes, n_steps + 1, n_obs)))


class Map(Filter):
    """A filter with a given F, and a given variance of the next observation, whose mean is 0."""

    def __init__(self, update, initial, n_obs=1, variance=None, standardise=False):
        self.update_function, self.initial, self.variance = update, np.atleast_1d(initial), variance
        self.n_obs_, self.model_ = n_obs, None
        self._scale = Standardisation.none(np.zeros((0, n_obs)))

    def fit(self, train, validation=None):
        return self

    def _initial(self):
        return self.initial

    def _update(self, belief, z):
        return self.update_function(belief, z)

    def _observe(self, belief):
        return np.zeros((len(belief), self.n_obs_))

    def predict_variance(self, belief):
        return self.variance(belief)


class Inflated(KalmanFilter):
    """Four times the variance."""

    def predict_variance(self, belief):
        return 4.0 * super().predict_variance(belief)


# derivatives ----------------------------------------------------------------------------------------------------------


def test_central_differences_are_the_derivatives_of_random_fourier_features():
    data = some_data(10, 40, 0)
    regressor = RandomFourierRidge(n_frequencies=30, include_inputs=True, alpha=1e-3, random_state=0)
    psim = PSIM(regressor, n_future=2, n_iterations=2, standardise="together").fit(data)
    belief, x = psim.beliefs(data)[:, 7], data.observations[:, 7]
    found = filter_jacobian(psim, belief, x)
    inputs = np.concatenate([belief, psim._scale.apply(x)], axis=1)
    np.testing.assert_allclose(found, psim.model_.jacobian(inputs)[:, :, :4], rtol=0, atol=1e-8)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_central_differences_have_the_same_digits_in_every_unit(unit):
    def update(m, z):
        return unit * np.stack([np.sin(m[:, 0] / unit) + z[:, 0], m[:, 0] * m[:, 1] / unit**2], axis=1)

    filter = Map(update, [0.0, 0.0])
    m, x = unit * np.array([[0.3, -1.2], [2.0, 0.4]]), np.zeros((2, 1))
    expected = [[[np.cos(a), 0.0], [b, a]] for a, b in m / unit]
    found = filter_jacobian(filter, m, x)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2 * STEP**2)
    # and where a component is 0, as in first beliefs
    found = filter_jacobian(filter, unit * np.array([[0.0, 0.0], [1.0, 1.0]]), x)[0]
    np.testing.assert_allclose(found, [[1.0, 0.0], [0.0, 0.0]], atol=2 * STEP**2)


def test_where_it_is_one_matrix_that_is_the_derivative():
    data, kalman = some_data(20, 60, 0), KalmanFilter.of(SYSTEM)
    belief, x = kalman.beliefs(data)[:, 5], data.observations[:, 5]
    gain, _, _ = SYSTEM.stationary_gain()
    np.testing.assert_allclose(filter_jacobian(kalman, belief, x)[3], A - gain @ C, atol=1e-12)
    for filter in (PSIM(n_future=2, n_iterations=2), N4SID(n_states=3), PSIM(n_future=2, features="second")):
        filter.fit(data)
        b = filter.beliefs(data)[:, 5]
        shifted = b + 0.1 * np.eye(filter.belief_size)[0]
        difference = (filter.update(shifted, x) - filter.update(b, x)) / 0.1
        np.testing.assert_allclose(filter_jacobian(filter, b, x)[:, :, 0], difference, atol=1e-9)


def test_the_derivative_of_a_forward_psim_leaves_its_step_out():
    data = some_data(40, 12, 0)
    psim = ForwardPSIM(Ridge(alpha=1e-3), n_future=2).fit(data)
    beliefs = psim.beliefs(data)
    for t in (0, 3, psim.n_steps_ + 1):
        found = filter_jacobian(psim, beliefs[:, t], data.observations[:, t])
        weights = psim.model_[min(t, psim.n_steps_ - 1)]._weights
        np.testing.assert_allclose(found[5], weights[:4].T, atol=1e-9)
    assert stability(psim, data).is_contracting


def test_wrong_beliefs_and_observations_are_told():
    kalman = KalmanFilter.of(SYSTEM)
    with pytest.raises(ValueError, match=r"belief: expected shape \(n, 3\)"):
        filter_jacobian(kalman, np.zeros((2, 4)), np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"observation: expected shape \(2, 2\), got \(1, 2\)"):
        filter_jacobian(kalman, np.zeros((2, 3)), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="belief: expected finite numbers"):
        filter_jacobian(kalman, np.full((1, 3), np.nan), np.zeros((1, 2)))
    with pytest.raises(NotFittedError):
        filter_jacobian(PSIM(), np.zeros((1, 3)), np.zeros((1, 2)))


# stability ------------------------------------------------------------------------------------------------------------


def test_the_radius_of_a_kalman_filter_is_that_of_a_minus_k_c():
    kalman = KalmanFilter.of(SYSTEM)
    gain, _, _ = SYSTEM.stationary_gain()
    radius = np.abs(np.linalg.eigvals(A - gain @ C)).max()
    assert spectral_radius(kalman) == pytest.approx(radius, rel=1e-12)
    found = stability(kalman)
    assert found.radius_median == found.radius_max == pytest.approx(radius, rel=1e-12)
    assert found.lyapunov_exponent == pytest.approx(np.log(radius), rel=1e-12)
    assert found.is_contracting
    # the time-varying filter comes to it, along its trajectories
    varying = stability(KalmanFilter.of(SYSTEM, stationary=False), some_data(2, 300, 0))
    assert varying.radius_median == pytest.approx(radius, abs=1e-6)
    assert varying.lyapunov_exponent == pytest.approx(np.log(radius), abs=0.01)
    # and so does the distance of two filters that start apart
    data, distance = some_data(1, 50, 1), []
    apart = [kalman.initial_belief(), kalman.initial_belief() + 1.0]
    for x in data.observations[0]:
        distance.append(np.linalg.norm(apart[1] - apart[0]))
        apart = [kalman.update(belief, x[None]) for belief in apart]
    rate = np.log(distance[50] / distance[20]) / 30
    assert rate == pytest.approx(found.lyapunov_exponent, abs=0.02)


def test_followed_along_trajectories_a_linear_filter_has_the_logarithm_of_its_radius():
    matrix = np.array([[0.9, 0.5, 0.0], [0.0, 0.4, 0.3], [0.0, 0.0, -0.7]])
    found = stability(Map(lambda m, z: m @ matrix.T + z, np.zeros(3)), zeros(4, 200))
    assert found.lyapunov_exponent == pytest.approx(np.log(0.9), abs=1e-6)
    assert found.radius_max == pytest.approx(0.9, abs=1e-8)
    unstable = stability(
        Map(lambda m, z: np.clip(m @ (1.5 * matrix.T) + z, -3, 3), np.zeros(3)), zeros(4, 200)
    )
    assert unstable.lyapunov_exponent == pytest.approx(np.log(1.35), abs=1e-6)
    assert not unstable.is_contracting


def test_the_logistic_map_doubles_and_henons_grows_as_published():
    logistic = Map(lambda m, z: 4.0 * m * (1.0 - m), [0.3])
    assert stability(logistic, zeros(1, 4000)).lyapunov_exponent == pytest.approx(np.log(2.0), abs=0.02)

    def henon(m, z):
        return np.stack([1.0 - 1.4 * m[:, 0] ** 2 + m[:, 1], 0.3 * m[:, 0]], axis=1)

    found = stability(Map(henon, [0.1, 0.1]), zeros(1, 6000))
    assert found.lyapunov_exponent == pytest.approx(0.4192, abs=0.02)
    assert not found.is_contracting
    assert found.radius_max > found.radius_median > 0


def test_contractions_that_take_turns_may_grow():
    """Both derivatives have the radius 1/2; their product has 4.49."""
    one, other = np.array([[0.5, 2.0], [0.0, 0.5]]), np.array([[0.5, 0.0], [2.0, 0.5]])

    def update(m, z):
        return np.where(z > 0, np.sin(m) @ one.T, np.sin(m) @ other.T)

    x = np.tile([[[1.0], [-1.0]]], (3, 60, 1))
    found = stability(Map(update, np.zeros(2)), Sequences.from_observations(x))
    assert found.radius_max == pytest.approx(0.5, abs=1e-4)  # a double eigenvalue: root of the rounding
    growth = np.abs(np.linalg.eigvals(one @ other)).max()
    assert found.lyapunov_exponent == pytest.approx(0.5 * np.log(growth), abs=1e-6)
    assert not found.is_contracting


def test_a_contraction_has_a_negative_exponent_below_its_bound():
    rng = np.random.default_rng(0)
    W = 0.8 * np.linalg.qr(rng.normal(size=(4, 4)))[0]
    filter = Map(lambda m, z: np.tanh(m @ W.T + z), np.zeros(4))
    data = Sequences.from_observations(rng.normal(size=(6, 81, 1)), lengths=[80, 60, 80, 3, 0, 80])
    found = stability(filter, data)
    assert found.is_contracting
    assert found.lyapunov_exponent < np.log(0.8)  # |J v| <= 0.8 |v|
    assert found.radius_max <= 0.8 + 1e-8
    assert found == stability(filter, data)  # the same each time


def test_an_autoregressive_filter_forgets_in_its_window():
    data = some_data(4, 60, 0)
    found = stability(AutoregressiveFilter(n_past=5).fit(data), data)
    assert (found.radius_max, found.lyapunov_exponent) == (0.0, -np.inf)
    assert found.is_contracting


def test_a_derivative_that_varies_needs_trajectories():
    filter = Map(lambda m, z: np.tanh(m), [0.1])
    with pytest.raises(ValueError, match="whose derivative varies; stability"):
        spectral_radius(filter)
    with pytest.raises(ValueError, match="trajectories of at least one step for a Map"):
        stability(filter)
    with pytest.raises(NotFittedError):
        spectral_radius(PSIM())
    with pytest.raises(NotFittedError):
        stability(PSIM(), zeros(2, 3))


# calibration ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stationary", [True, False])
def test_the_filter_of_the_system_is_calibrated(stationary):
    if stationary:
        data = SYSTEM.sample_innovations(100, 200, np.random.default_rng(0))
    else:
        data = some_data(100, 200, 0)
    found = calibration(KalmanFilter.of(SYSTEM, stationary), data)
    # 20 000 numbers a component: standard error sqrt(2 / n) = 0.01 of a mean square, below 0.0025 of a share (40 000)
    np.testing.assert_allclose(found.mean_squared_z, 1.0, atol=0.03)
    np.testing.assert_allclose(found.nominal, [0.5, 0.6827, 0.9, 0.95])
    np.testing.assert_allclose(found.coverage, found.nominal, atol=0.01)
    _, S, _ = SYSTEM.stationary_gain()
    expected = norm(scale=np.sqrt(np.diag(S))).entropy().sum()
    assert found.log_likelihood == pytest.approx(-expected, abs=0.02)
    assert found.constant_log_likelihood == pytest.approx(found.log_likelihood, abs=2e-3)
    assert found.n_without_variance == 0


def test_second_moments_of_a_quadratic_filter_are_calibrated_and_those_of_a_linear_one_are_not():
    """E[x^2] takes the square of the latest observation, which a filter linear in it has not."""
    train, test = some_data(200, 50, 1), some_data(200, 50, 2)
    coverage = {}
    for regressor in (Ridge(), PolynomialRidge(degree=2)):
        filter = PSIM(regressor, n_future=2, features="second", n_iterations=5).fit(train)
        found = calibration(filter, test)
        coverage[type(regressor)] = found.coverage
    np.testing.assert_allclose(coverage[PolynomialRidge], found.nominal, atol=0.02)
    assert coverage[Ridge][-1] < 0.9


def test_log_likelihoods_are_those_of_scipys_normal_distribution():
    data = Sequences.from_observations(some_data(4, 20, 0).observations, lengths=[20, 7, 0, 13])
    kalman = KalmanFilter.of(SYSTEM, stationary=False)
    found, beliefs, x = calibration(kalman, data), kalman.beliefs(data), data.observations
    logs, squares, errors = [], [], []
    for i in range(4):
        for t in range(1, data.lengths[i] + 1):
            b = beliefs[i, t : t + 1]
            mean, deviation = kalman.predict_observation(b)[0], np.sqrt(kalman.predict_variance(b)[0])
            logs.append(norm(mean, deviation).logpdf(x[i, t]).sum())
            squares.append(np.square((x[i, t] - mean) / deviation))
            errors.append(x[i, t] - mean)
    assert found.log_likelihood == pytest.approx(np.mean(logs), rel=1e-12)
    np.testing.assert_allclose(found.mean_squared_z, np.mean(squares, axis=0), rtol=1e-12)
    spread = np.sqrt(np.square(errors).mean(axis=0))
    assert found.constant_log_likelihood == pytest.approx(norm(0.0, spread).logpdf(errors).sum(axis=1).mean())
    assert found.coverage[2] == pytest.approx((np.array(squares) <= norm.ppf(0.95) ** 2).mean())


def test_four_times_the_variance_is_a_quarter_of_the_square():
    data = some_data(30, 60, 0)
    right, inflated = calibration(KalmanFilter.of(SYSTEM), data), calibration(Inflated.of(SYSTEM), data)
    np.testing.assert_allclose(inflated.mean_squared_z, 0.25 * right.mean_squared_z, rtol=1e-12)
    assert inflated.coverage[1] == pytest.approx(norm.cdf(2.0) - norm.cdf(-2.0), abs=0.01)
    lost = (
        np.log(4.0) - 0.375 * right.mean_squared_z.sum()
    )  # 2 components: 2 (log 4) / 2, and z^2 / 2 (1 - 1/4)
    assert right.log_likelihood - inflated.log_likelihood == pytest.approx(lost, rel=1e-9)
    assert inflated.constant_log_likelihood == pytest.approx(right.constant_log_likelihood)


def test_a_variance_of_the_right_times_beats_the_best_constant():
    """x_{t+1} ~ N(0, s^2) with s = 2 after a positive observation and 1/2 after a negative one."""
    rng, x = np.random.default_rng(0), np.zeros((200, 101, 1))
    x[:, 0, 0] = rng.normal(size=200)
    for t in range(100):
        x[:, t + 1] = np.where(x[:, t] > 0, 2.0, 0.5) * rng.normal(size=(200, 1))
    filter = Map(lambda m, z: z, [0.0], variance=lambda m: np.where(m > 0, 4.0, 0.25))
    found = calibration(filter, Sequences.from_observations(x))
    assert found.log_likelihood == pytest.approx(
        -0.5 * (np.log(2 * np.pi) + 1.0), abs=0.02
    )  # log 4 + log 1/4 = 0
    constant = -0.5 * (np.log(2 * np.pi * 2.125) + 1.0)
    assert found.constant_log_likelihood == pytest.approx(constant, abs=0.02)
    np.testing.assert_allclose(found.mean_squared_z, 1.0, atol=0.03)


def test_units_do_not_change_z():
    data = some_data(20, 60, 0)
    scaled = Sequences.from_observations(data.observations * [1e-3, 1e3])
    found = [
        calibration(PSIM(n_future=2, features="second", n_iterations=2).fit(d), d, least_variance=0.1)
        for d in (data, scaled)
    ]
    np.testing.assert_allclose(found[1].mean_squared_z, found[0].mean_squared_z, rtol=1e-6)
    np.testing.assert_allclose(found[1].coverage, found[0].coverage, atol=1e-3)
    assert found[1].log_likelihood == pytest.approx(found[0].log_likelihood, abs=1e-6)  # 1e-3 and 1e3 cancel


def test_a_variance_of_nothing_is_an_infinite_surprise_unless_a_least_one_is_given():
    x = np.array([[[0.0], [1.0], [0.0], [2.0], [0.0]]])
    filter = Map(lambda m, z: m + 1.0, [0.0], variance=lambda m: np.where(m > 3, 0.0, 1.0))
    found = calibration(filter, Sequences.from_observations(x))  # the last, which is 0 and predicted as 0
    assert found.n_without_variance == 1
    np.testing.assert_allclose(found.mean_squared_z, 5 / 4)
    filter = Map(lambda m, z: m + 1.0, [0.0], variance=lambda m: np.where(m > 2, 0.0, 1.0))
    found = calibration(filter, Sequences.from_observations(x))
    assert found.n_without_variance == 2
    assert np.isinf(found.mean_squared_z[0])
    assert found.log_likelihood == -np.inf
    found = calibration(filter, Sequences.from_observations(x), least_variance=0.1)  # of 5/4
    assert found.n_without_variance == 0
    np.testing.assert_allclose(found.mean_squared_z, (1.0 + 4.0 / 0.125) / 4)
    for value in (-1.0, np.nan):
        with pytest.raises(ValueError, match="least_variance finite and at least 0"):
            calibration(filter, Sequences.from_observations(x), least_variance=value)


def test_filters_without_variances_and_sequences_without_steps_are_told():
    data = some_data(4, 10, 0)
    with pytest.raises(TypeError, match="with predict_variance, got AutoregressiveFilter"):
        calibration(AutoregressiveFilter().fit(data), data)
    with pytest.raises(ValueError, match="features='second'"):
        calibration(PSIM(n_future=2).fit(data), data)
    with pytest.raises(ValueError, match="at least one step"):
        calibration(KalmanFilter.of(SYSTEM), Sequences.from_observations(data.observations, lengths=[0] * 4))


# error curves ---------------------------------------------------------------------------------------------------------


def test_a_known_filters_error_ahead_is_that_of_the_covariances():
    data = SYSTEM.sample_innovations(150, 150, np.random.default_rng(0))
    kalman = KalmanFilter.of(SYSTEM)
    ar = AutoregressiveFilter(n_past=3).fit(some_data(10, 100, 1))
    found = look_ahead_errors({"Kalman": kalman, "AR-3": ar}, data, 6)
    _, _, P = SYSTEM.stationary_gain()
    expected = []
    for _ in range(6):
        expected.append(np.trace(C @ P @ C.T + R))
        P = A @ P @ A.T + Q
    # 22 000 steps; errors of neighbouring steps are alike, and more so further ahead
    np.testing.assert_allclose(found.errors["Kalman"], expected, rtol=0.03)
    assert list(found.errors) == ["Kalman", "AR-3"]
    assert (found.errors["AR-3"] > found.errors["Kalman"]).all()
    np.testing.assert_array_equal(found.steps, np.arange(1, 7))
    assert found.power == pytest.approx(np.square(data.observations).sum(axis=2).mean())
    assert (found.errors["Kalman"] < found.power).all()


def test_curves_are_those_of_the_filters_own_errors():
    data = Sequences.from_observations(some_data(4, 20, 0).observations, lengths=[20, 7, 0, 13])
    kalman, psim = KalmanFilter.of(SYSTEM), PSIM(n_future=2, n_iterations=2).fit(some_data(8, 30, 1))
    ahead, over_time = (
        look_ahead_errors({"a": psim}, data, 3),
        error_over_time({"a": psim, "b": kalman}, data),
    )
    np.testing.assert_array_equal(ahead.errors["a"], psim.errors(data, 3).by_look_ahead)
    np.testing.assert_array_equal(over_time.errors["b"], kalman.errors(data).by_time)
    np.testing.assert_array_equal(over_time.steps, np.arange(21))
    assert over_time.errors["a"].shape == (21,)
    x, belief = data.observations[0], psim.beliefs(data)[0]
    last = np.square(psim.predict_observation(belief[20:21])[0] - x[20]).sum()
    assert over_time.errors["a"][20] == pytest.approx(last)  # the only trajectory that is so long
    assert ahead.power == over_time.power == psim.errors(data).power


def test_no_filters_and_no_horizon_are_told():
    data = some_data(2, 5, 0)
    with pytest.raises(ValueError, match="at least one filter"):
        error_over_time({}, data)
    with pytest.raises(ValueError, match="horizon to be a whole number"):
        look_ahead_errors({"a": KalmanFilter.of(SYSTEM)}, data, 0)
