"""Unscented and extended Kalman filters of a known system, against the Kalman filter, textbooks and filterpy."""

import pickle
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from physics_examples import (
    NOISE,
    PENDULUM_PRIOR,
    PRIOR,
    SENSOR,
    SINE,
    SINE_NOISE,
    SWING,
    A,
    B,
    C,
    Linear,
    Squared,
    filtered,
    linear_data,
    pendulum_data,
    simulated,
    textbook,
)
from sklearn.base import clone

from beliefgym.envs import ExtendedKalmanFilter, Pendulum, Quadrotor, UnscentedKalmanFilter
from beliefgym.envs.estimators import NumericalError
from beliefgym.envs.estimators.gaussian_filter import covariance_root
from beliefgym.envs.estimators.unscented import sigma_points
from beliefgym.envs.random_streams import RandomStreams
from beliefgym.learning import Sequences
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem

kinds = pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])


def of_linear(kind, system=None, **parameters):
    return kind.of(system or Linear(), prior=PRIOR, observation_noise_std=SENSOR, **parameters)


def of_swing(kind, system=SWING, prior=PENDULUM_PRIOR, **parameters):
    return kind.of(system, prior=prior, observed=SINE, observation_noise_std=SINE_NOISE, **parameters)


@kinds
def test_on_a_linear_system_it_is_the_kalman_filter_of_the_package(kind):
    system = LinearGaussianSystem(
        A,
        C,
        np.diag(np.square(NOISE)),
        np.diag(np.square(SENSOR)),
        initial_mean=PRIOR[0],
        initial_covariance=PRIOR[1],
    )
    data = system.sample(3, 20, np.random.default_rng(0))
    known = KalmanFilter.of(system, stationary=False)
    means, covariances = filtered(of_linear(kind), data)
    beliefs = known.beliefs(data)
    for t in range(21):
        expected = known.filter_state(beliefs[:, t], data.observations[:, t])
        np.testing.assert_allclose(means[:, t], expected, atol=1e-8)
        P = covariances[:, t]
        predicted = (A @ P @ A.T + np.diag(np.square(NOISE)))[(slice(None), *np.triu_indices(2))]
        np.testing.assert_allclose(predicted, beliefs[:, t + 1, 2:], atol=1e-8)


@kinds
def test_with_actions_and_missing_observations_it_is_the_textbook_filter(kind):
    data = linear_data()
    missing = np.random.default_rng(1).random(data.observations.shape) < 0.4
    missing[:, 3] = True
    missing[0, 0] = True
    means, covariances = filtered(of_linear(kind), data, missing)
    x = np.where(missing, np.nan, data.observations)
    for i in range(len(data)):
        expected, P = textbook(x[i], data.actions[i])
        np.testing.assert_allclose(means[i], expected, atol=1e-8)
        np.testing.assert_allclose(covariances[i], P, atol=1e-8)


@kinds
def test_noise_of_actions_and_disturbances_enters_the_step(kind):
    system = Linear(process_noise_std=NOISE, actuation_noise_std=0.3, wind=(0.2, 0.0))
    Q = np.diag(np.square(NOISE)) + 0.09 * np.outer(B, B) + np.diag([0.04, 0.0])
    data = linear_data(system=system)
    means, covariances = filtered(of_linear(kind, system), data)
    for i in range(len(data)):
        expected, P = textbook(data.observations[i], data.actions[i], Q=Q)
        np.testing.assert_allclose(means[i], expected, atol=1e-8)
        np.testing.assert_allclose(covariances[i], P, atol=1e-8)


@pytest.mark.parametrize("parameters", [{}, {"alpha": 0.5, "beta": 2.0, "kappa": 1.0}])
def test_the_unscented_filter_is_filterpys_on_the_pendulum(parameters):
    theirs_of = pytest.importorskip("filterpy.kalman")
    data = pendulum_data(n=3)
    means, covariances = filtered(of_swing(UnscentedKalmanFilter, **parameters), data)
    points = theirs_of.MerweScaledSigmaPoints(2, **{"alpha": 1.0, "beta": 0.0, "kappa": 1.0} | parameters)
    for i in range(3):
        theirs = theirs_of.UnscentedKalmanFilter(
            2,
            1,
            SWING.dt,
            hx=lambda s: np.sin(s[:1]),
            fx=lambda s, dt: SWING.flow(s, np.zeros(1)),
            points=points,
        )
        theirs.x, theirs.P = PENDULUM_PRIOR[0].copy(), PENDULUM_PRIOR[1].copy()
        theirs.Q = np.diag(np.square(SWING.process_noise_std))
        theirs.R = np.array([[SINE_NOISE**2]])
        theirs.sigmas_f = points.sigma_points(
            theirs.x, theirs.P
        )  # the first observation comes without a step
        for t, x in enumerate(data.observations[i]):
            if t:
                theirs.predict()
            theirs.update(x)
            np.testing.assert_allclose(means[i, t], theirs.x, atol=1e-9)
            np.testing.assert_allclose(covariances[i, t], theirs.P, atol=1e-9)


def test_the_extended_filter_is_the_textbooks_with_derivatives_by_hand():
    """Pendulum-v1's own step, whose Jacobian is short, with a motor and one sine."""
    system = Pendulum(process_noise_std=(0.01, 0.05))
    data = pendulum_data(system, n=2, torque=1.0)
    means, covariances = filtered(of_swing(ExtendedKalmanFilter, system), data)
    dt, k = system.dt, 15.0  # m g l_c / I of a rod
    Q = np.diag(np.square(system.process_noise_std))
    for i in range(2):
        m, P = PENDULUM_PRIOR
        for t, x in enumerate(data.observations[i]):
            if t:
                slope = dt * k * np.cos(m[0])
                F = np.array([[1.0 + dt * slope, dt], [slope, 1.0]])
                speed = m[1] + dt * (k * np.sin(m[0]) + 3.0 * data.actions[i, t - 1, 0])
                m, P = np.array([m[0] + dt * speed, speed]), F @ P @ F.T + Q
            H = np.array([[np.cos(m[0]), 0.0]])
            K = P @ H.T / (H @ P @ H.T + SINE_NOISE**2)
            m, P = m + K[:, 0] * (x[0] - np.sin(m[0])), P - K @ H @ P
            np.testing.assert_allclose(means[i, t], m, atol=1e-7)
            np.testing.assert_allclose(covariances[i, t], P, atol=1e-7)


@kinds
def test_it_tracks_the_pendulum_by_its_sine_alone(kind):
    """Root mean squared errors after a second, well under the prior's 0.2 rad; the given deviations are honest."""
    data = pendulum_data(n=50)
    errors = of_swing(kind).hint_errors(data)
    late = np.sqrt(np.square(errors.difference[:, 20:]).mean(axis=(0, 1)))
    assert late[0] < 0.06
    assert late[1] < 0.25
    assert (np.abs(errors.mean_squared_z - 1.0) < 0.25).all()
    assert (np.abs(errors.coverage(0.95) - 0.95) < 0.03).all()
    blind = np.full(data.observations.shape, True)
    lost, _ = filtered(of_swing(kind), data, blind)
    assert np.sqrt(np.square(lost - data.states)[:, 20:].mean(axis=(0, 1)))[0] > 3.0 * late[0]


@kinds
def test_without_an_observation_the_belief_is_the_prediction_and_its_covariance_grows(kind):
    data = pendulum_data(n=3)
    estimator = of_swing(kind)
    belief = estimator.beliefs(data)[:, 31]
    expected = estimator.predict_observation(belief)
    gone = estimator.update(belief, np.full((3, 1), np.nan), missing="predict")
    mean, P = estimator.estimate_state(gone)
    before = estimator.estimate_state(belief)
    exact = SWING.flow(before.mean, np.zeros((3, 1)))
    tolerance = 1e-12 if kind is ExtendedKalmanFilter else 0.01
    np.testing.assert_allclose(mean, exact, atol=tolerance)
    np.testing.assert_allclose(expected, np.sin(mean[:, :1]), atol=tolerance)
    seen = estimator.estimate_state(estimator.update(belief, expected))
    assert (np.linalg.det(P) > np.linalg.det(seen.covariance)).all()
    later = gone
    for _ in range(20):
        later = estimator.update(later, np.full((3, 1), np.nan), missing="predict")
    assert (np.linalg.det(estimator.estimate_state(later).covariance) > 2.0 * np.linalg.det(P)).all()
    forecast = estimator.forecast(belief, 22)
    np.testing.assert_allclose(forecast[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(forecast[:, 21], estimator.predict_observation(later), atol=1e-12)
    with pytest.raises(ValueError, match="missing='predict'"):
        estimator.update(belief, np.full((3, 1), np.nan))


@kinds
def test_a_batch_is_one_by_one_and_rows_may_begin_at_different_times(kind):
    data = pendulum_data(n=4)
    estimator = of_swing(kind)
    together = estimator.beliefs(data)
    for i in range(4):
        np.testing.assert_allclose(estimator.beliefs(data[[i]])[0], together[i], atol=1e-12)
    mixed = np.concatenate([together[:1, 10], estimator.initial_belief(1)])
    x = data.observations[:2, [10, 0]]
    found = estimator.update(mixed, np.stack([x[0, 0], x[1, 1]]))
    np.testing.assert_allclose(found, [together[0, 11], together[1, 1]], atol=1e-12)


@kinds
def test_actions_are_used(kind):
    system = Pendulum(process_noise_std=(0.01, 0.05))
    data = pendulum_data(system, torque=1.5)
    estimator = of_swing(kind, system)
    with_actions = estimator.hint_errors(data)
    blind = Sequences.from_observations(data.observations, hints=data.hints)
    assert with_actions.rmse[1] < 0.5 * estimator.hint_errors(blind).rmse[1]
    means, _ = filtered(estimator, data)
    np.testing.assert_allclose(estimator.estimate_hints(data).mean, means, atol=1e-12)
    np.testing.assert_allclose(
        estimator.beliefs(data)[:, -1, :2], means[:, -1], atol=1e-12
    )  # with actions too
    assert estimator.errors(data).mean < 0.8 * estimator.errors(blind).mean
    belief = estimator.beliefs(data)[:, 21]
    ahead = estimator.forecast(belief, 5, data.actions[:, 20:25])
    assert np.abs(ahead - estimator.forecast(belief, 5)).max() > 0.02
    five = estimator.errors(data, horizon=5)
    expected = np.square(ahead - data.observations[:, 21:26]).sum(axis=2)
    np.testing.assert_allclose(five.squared[:, 21], expected, atol=1e-12)


@kinds
def test_the_hint_may_be_a_function_of_the_state_or_some_of_its_components(kind):
    system = Squared()
    data = linear_data(system=system)
    means, covariances = filtered(of_linear(kind), data)
    estimate = of_linear(kind, system).estimate_hints(data)
    m, P = means[..., 0], covariances[..., 0, 0]
    gap = covariances[..., 0, 0] + covariances[..., 1, 1] - 2.0 * covariances[..., 0, 1]
    np.testing.assert_allclose(estimate.mean[..., 1], means[..., 0] - means[..., 1], atol=1e-8)
    np.testing.assert_allclose(estimate.std[..., 1], np.sqrt(gap), atol=1e-8)
    if kind is ExtendedKalmanFilter:  # p^2 linearised at its mean
        np.testing.assert_allclose(estimate.mean[..., 0], m**2, atol=1e-8)
        np.testing.assert_allclose(estimate.std[..., 0], 2.0 * np.abs(m) * np.sqrt(P), atol=1e-6)
    else:  # the points have the moments of a normal distribution up to the fourth, along the first axis
        np.testing.assert_allclose(estimate.mean[..., 0], m**2 + P, atol=1e-8)
        np.testing.assert_allclose(estimate.std[..., 0], np.sqrt(4.0 * m**2 * P + 2.0 * P**2), atol=1e-8)
    some = of_linear(kind, system, hint=("q",))
    assert (some.hint_names_, some.n_hint_) == (("q",), 1)
    np.testing.assert_allclose(some.estimate_hints(data).mean[..., 0], means[..., 1], atol=1e-12)
    errors = some.hint_errors(data)  # found by name among the states
    np.testing.assert_allclose(errors.difference[..., 0], means[..., 1] - data.states[..., 1], atol=1e-12)


@kinds
def test_the_prior_comes_from_the_first_states_of_the_training_data(kind):
    data = linear_data(n=200, n_steps=3)
    given = {"system": Linear(), "observation_noise_std": SENSOR}
    learned = kind(**given).fit(data, data)
    first = data.states[:, 0]
    np.testing.assert_allclose(learned.prior_.mean[0], first.mean(axis=0))
    np.testing.assert_allclose(learned.prior_.covariance[0], np.cov(first.T, bias=True))
    np.testing.assert_allclose(learned.prior_mean_, first.mean(axis=0))
    np.testing.assert_allclose(learned.prior_std_, first.std(axis=0))
    without = Sequences.from_observations(data.observations, actions=data.actions, hints=data.hints)
    np.testing.assert_allclose(kind(**given).fit(without).initial_belief(), learned.initial_belief())
    neither = Sequences.from_observations(data.observations, actions=data.actions)
    with pytest.raises(ValueError, match=r"states, or hints that are the whole state.*give prior=\(mean"):
        kind(**given).fit(neither)
    fixed = kind(**given, prior=PRIOR).fit(neither)
    np.testing.assert_allclose(fixed.initial_belief(), of_linear(kind).initial_belief())
    assert learned.belief_size == 6
    np.testing.assert_allclose(learned.predict_hint(learned.initial_belief(2)).mean[1], first.mean(axis=0))


@kinds
def test_it_pickles_and_clones(kind):
    data = pendulum_data(n=2)
    estimator = of_swing(kind)
    again = pickle.loads(pickle.dumps(estimator))
    np.testing.assert_array_equal(again.estimate_hints(data).mean, estimator.estimate_hints(data).mean)
    made = clone(estimator).fit(data)
    np.testing.assert_array_equal(made.estimate_hints(data).mean, estimator.estimate_hints(data).mean)


@kinds
def test_a_known_component_of_the_start_stays_known(kind):
    """A singular prior, whose covariance has no Cholesky factor."""
    prior = (PENDULUM_PRIOR[0], np.diag([0.04, 0.0]))
    calm = Pendulum.uncontrolled(damping=0.3)
    estimator = of_swing(kind, calm, prior)
    data = pendulum_data(calm, n=2)
    first = estimator.estimate_state(estimator.beliefs(data)[:, 1])
    assert (first.mean[:, 1] == 0.0).all()
    assert np.isfinite(estimator.estimate_hints(data).mean).all()


@kinds
def test_it_keeps_quaternions_and_estimates_the_attitude_of_a_quadrotor(kind):
    """28 state components, noise of the wind and of a bias that enters the step, and a hint that the system computes.

    The start is spread little enough for the equations to be nearly linear; then the given deviations are right."""
    system = Quadrotor(
        start_tilt=0.1, start_yaw=0.15, max_mean_wind=1.2, gust_std=0.3, start_rate=0.15, start_speed=0.15
    )
    seeds = np.random.default_rng(0).integers(2**32, size=5000).astype(np.uint64)
    start = system.initial_state(RandomStreams(seeds))
    names = ("gyro_x", "gyro_y", "gyro_z", "accelerometer_x", "accelerometer_y", "accelerometer_z")
    names += ("position_x", "position_y", "position_z")
    std = np.repeat([0.01, 0.2, 0.002], 3)
    data = simulated(system, start[:50], np.zeros((50, 40, 4)), std, np.random.default_rng(1), names)
    estimator = kind.of(
        system,
        prior=(start.mean(axis=0), np.cov(start.T)),
        observed=names,
        observation_noise_std=tuple(std),
    )
    belief = estimator.beliefs(data)[:, -1]
    norm = np.linalg.norm(estimator.estimate_state(belief).mean[:, 6:10], axis=1)
    np.testing.assert_allclose(norm, 1.0, atol=1e-12)
    errors = estimator.hint_errors(data)
    assert errors.by_time[-1] < 0.2 * errors.by_time[0]
    assert (np.abs(errors.mean_squared_z - 1.0) < 0.5).all()


@dataclass(frozen=True, kw_only=True)
class Bounded(Linear):
    """p is at least 0."""

    @property
    def state_limits(self):
        return np.array([0.0, -np.inf]), np.array([np.inf, np.inf])


def test_sigma_points_outside_the_possible_states_are_taken_to_the_nearest():
    asked = []

    class Asked(Bounded):
        def observe(self, state):
            asked.append(np.min(state[..., 0]))
            return super().observe(state)

    estimator = UnscentedKalmanFilter.of(Asked(), prior=([0.1, 0.0], np.eye(2)), observation_noise_std=SENSOR)
    belief = estimator.update(estimator.initial_belief(), [[-3.0, 0.0]])
    assert min(asked) == 0.0
    assert estimator.estimate_state(belief).mean[0, 0] >= 0.0


def test_the_sigma_points_have_the_moments_that_the_text_promises():
    for d in (1, 2, 3):
        points, mean_weights, weights = sigma_points(d, 1.0, 0.0, None)
        np.testing.assert_allclose(mean_weights @ points**4, 3.0)  # of a normal distribution
        np.testing.assert_allclose(mean_weights, weights)
    points, mean_weights, weights = sigma_points(10, 1.0, 0.0, None)
    assert (mean_weights >= 0).all()
    np.testing.assert_allclose((points.T * weights) @ points, np.eye(10), atol=1e-12)


def test_a_covariance_that_is_none_is_told():
    half = np.array([[1.0, 1.0], [1.0, 1.0]])
    root = covariance_root(np.stack([half, np.eye(2)]))
    np.testing.assert_allclose(root @ root.swapaxes(1, 2), [half, np.eye(2)], atol=1e-12)
    with pytest.raises(NumericalError, match=r"row 1 is not positive semidefinite.*-1"):
        covariance_root(np.stack([np.eye(2), np.array([[1.0, 2.0], [2.0, 1.0]])]))


@kinds
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_belief_that_leaves_what_can_be_simulated_is_told(kind):
    estimator = of_swing(kind)
    belief = np.tile(estimator.initial_belief(2), 1)
    belief[:, -1] = 1.0
    belief[1, 1] = 1e308
    with pytest.raises(NumericalError, match="row 1, mean .*angular_velocity"):
        estimator.update(belief, np.zeros((2, 1)))


def test_without_filterpy_the_extra_is_named(monkeypatch):
    sigma_points.cache_clear()
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    with pytest.raises(ImportError, match=r'pip install "beliefgym\[estimation\]"'):
        of_swing(UnscentedKalmanFilter)


@kinds
def test_what_is_wrong_is_told(kind):
    data = linear_data()
    with pytest.raises(TypeError, match="expected a System"):
        of_linear(kind, system="pendulum")
    for parameters, kind_of, message in (
        (
            {"observed": ("third",)},
            ValueError,
            r"observed: unknown name 'third'; the system has \('first', 'second'\)",
        ),
        ({"observed": "first"}, TypeError, "expected observed as a tuple of names"),
        ({"observed": ("first", "first")}, ValueError, "one or more different names"),
        ({"observation_noise_std": 0.0}, ValueError, "finite and above 0, got 0.0; give exact sensors"),
        ({"observation_noise_std": (0.1, -1.0)}, ValueError, "finite and above 0"),
        ({"observation_noise_std": (0.1,) * 3}, ValueError, "as one number or 2"),
        ({"hint": ("r",)}, ValueError, r"hint: unknown name 'r'; the system has \('p', 'q'\), or \"hint\""),
        ({"prior": (np.zeros(3), np.eye(3))}, ValueError, r"prior: expected a mean of shape \(2,\)"),
        ({"prior": (np.zeros(2), -np.eye(2))}, ValueError, "variances of at least 0"),
        ({"prior": (np.zeros(2), [[1.0, 2.0], [2.0, 1.0]])}, ValueError, "positive semidefinite"),
        ({"prior": (np.zeros(2), [[1.0, 0.5], [0.0, 1.0]])}, ValueError, "symmetric"),
        ({"prior": (np.array([0.0, np.nan]), np.eye(2))}, ValueError, "finite numbers"),
        ({"prior": 3}, ValueError, r"prior as \(mean, covariance\)"),
    ):
        everything = {"system": Linear(), "prior": PRIOR, "observation_noise_std": SENSOR} | parameters
        with pytest.raises(kind_of, match=message):
            kind(**everything).fit(data)
        with pytest.raises(kind_of, match=message):
            kind.of(**everything)
    estimator = of_linear(kind)
    belief = estimator.initial_belief(2)
    with pytest.raises(ValueError, match=r"action: expected shape \(2, 1\) \(\('push',\)\), got \(2, 3\)"):
        estimator.update(belief, np.zeros((2, 2)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="action: expected finite numbers"):
        estimator.update(belief, np.zeros((2, 2)), np.full((2, 1), np.nan))
    with pytest.raises(ValueError, match=r"actions: expected shape \(2, 4, 1\)"):
        estimator.forecast(belief, 4, np.zeros((2, 3, 1)))
    wide = Sequences.from_observations(data.observations, actions=np.zeros((4, 12, 2)))
    with pytest.raises(ValueError, match="with 1 actions as the system"):
        estimator.beliefs(wide)
    with pytest.raises(ValueError, match=r"hints or states \('p', 'q'\)"):
        estimator.hint_errors(wide)
    swapped = Sequences.from_observations(
        data.observations, observation_names=("second", "first"), states=data.states
    )
    fresh = kind(system=Linear(), observation_noise_std=SENSOR)
    with pytest.raises(ValueError, match=r"with the observations \('first', 'second'\)"):
        fresh.fit(swapped)
    with pytest.warns(UserWarning, match="2 state components comes from 2 trajectories: it is singular"):
        fresh.fit(data[:2])
    with pytest.raises(ValueError, match="at least 2 training trajectories"):
        fresh.fit(data[[0]])
    odd = Sequences.from_observations(data.observations, actions=data.actions, states=data.states[..., :1])
    with pytest.raises(ValueError, match=r"states of the components \('p', 'q'\), got 1"):
        fresh.fit(odd)
    inert = Sequences.from_observations(data.observations, states=data.states)
    with pytest.warns(UserWarning, match="takes actions and the trajectories have none"):
        fresh.fit(inert)
    with pytest.raises(ValueError, match="with states, got"):
        kind(system=Squared(), observation_noise_std=SENSOR).fit(
            Sequences.from_observations(data.observations, actions=data.actions, hints=data.hints)
        )


def test_parameters_of_the_unscented_filter_are_checked():
    for parameters, message in (
        ({"alpha": 0.0}, "expected alpha above 0"),
        ({"kappa": -2.0}, "expected kappa above -2"),
        ({"beta": np.nan}, "expected beta as a finite number"),
    ):
        with pytest.raises(ValueError, match=message):
            of_linear(UnscentedKalmanFilter, **parameters)
