"""Learned Kalman filters: against textbook EM, pykalman, direct maximisation, and the known filter as the ceiling."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.stats import invwishart, multivariate_normal
from sklearn.base import clone

from beliefgym.learning import Sequences
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.kalman_learning import (
    NOISE_FLOOR,
    Priors,
    StateMoments,
    Trajectories,
    expectation,
    maximisation,
)
from beliefgym.learning.linear_gaussian import LinearGaussianSystem

A = np.array([[0.88, 0.29, 0.1], [-0.29, 0.88, 0.0], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.2, -1.0, 0.0]])
Q = np.array([[0.2, 0.05, 0.0], [0.05, 0.1, 0.0], [0.0, 0.0, 0.3]])
R = np.array([[0.5, 0.1], [0.1, 0.2]])
SYSTEM = LinearGaussianSystem(
    A, C, Q, R, initial_mean=[1.0, -2.0, 0.5], initial_covariance=np.diag([2.0, 1.0, 0.5])
)
STATIONARY = LinearGaussianSystem(A, C, Q, R)
NO_PRIORS = Priors(0.0, 0.0, 0.0, 0.0, np.ones(3), np.ones(2))
FIELDS = (
    "transition_matrix",
    "observation_matrix",
    "transition_covariance",
    "observation_covariance",
    "initial_mean",
    "initial_covariance",
)
LENGTHS = np.array([6, 0, 3, 6, 1])


def different_lengths():
    x = SYSTEM.sample(5, 6, np.random.default_rng(0)).observations
    return x, Trajectories(Sequences.from_observations(x, lengths=LENGTHS).observations, LENGTHS)


def posterior(system, x):
    """Mean and covariance of all states given all of one trajectory, and its log density, from the joint Gaussian."""
    n_times, n = len(x), system.n_states
    noise = block_diag(system.initial_covariance, *[system.transition_covariance] * (n_times - 1))
    shift = np.kron(np.eye(n_times, k=-1), system.transition_matrix)
    unroll = np.linalg.inv(np.eye(n * n_times) - shift)
    mean, covariance = unroll[:, :n] @ system.initial_mean, unroll @ noise @ unroll.T
    seen = np.kron(np.eye(n_times), system.observation_matrix)
    S = seen @ covariance @ seen.T + np.kron(np.eye(n_times), system.observation_covariance)
    gain = np.linalg.solve(S, seen @ covariance).T
    log_density = multivariate_normal(seen @ mean, S).logpdf(x.ravel())
    return mean + gain @ (x.ravel() - seen @ mean), covariance - gain @ seen @ covariance, log_density


def assert_same_system(ours, theirs, rtol=1e-9, atol=1e-9):
    for field in FIELDS:
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol, atol, err_msg=field)


def test_the_states_moments_are_those_of_the_joint_gaussian_for_different_lengths():
    x, trajectories = different_lengths()
    moments = expectation(SYSTEM, trajectories)
    place = {(int(e), t): k for k, (t, e) in enumerate(
        (t, e) for t, n in enumerate(trajectories.n_at) for e in trajectories.order[:n]
    )}  # fmt: skip
    sums = {name: np.zeros((3, 3)) for name in ("every", "next", "current", "initial", "lag")}
    total = 0.0
    for i, length in enumerate(LENGTHS):
        mean, V, log_density = posterior(SYSTEM, x[i, : length + 1])
        total += log_density
        V = V.reshape(length + 1, 3, length + 1, 3)
        for t in range(length + 1):
            np.testing.assert_allclose(moments.means[place[i, t]], mean[3 * t : 3 * t + 3], atol=1e-10)
            sums["every"] += V[t, :, t]
            if t:
                sums["next"] += V[t, :, t]
                sums["current"] += V[t - 1, :, t - 1]
                sums["lag"] += V[t, :, t - 1]
        sums["initial"] += V[0, :, 0]
    for name, value in sums.items():
        np.testing.assert_allclose(getattr(moments, name), value, atol=1e-10, err_msg=name)
    assert moments.log_likelihood == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("n_obs", [1, 3, 7])
def test_the_likelihood_is_that_of_the_joint_gaussian_for_any_number_of_observations(n_obs):
    rng = np.random.default_rng(n_obs)
    noise = rng.normal(size=(n_obs, n_obs))
    system = LinearGaussianSystem(A, rng.normal(size=(n_obs, 3)), Q, noise @ noise.T + 0.01 * np.eye(n_obs))
    x = system.sample(2, 5, rng).observations
    moments = expectation(system, Trajectories(x, np.array([5, 5])))
    expected = sum(posterior(system, one)[2] for one in x)
    assert moments.log_likelihood == pytest.approx(expected, rel=1e-11)


def test_one_iteration_is_the_textbooks_for_different_lengths():
    x, trajectories = different_lengths()
    ours = maximisation(expectation(SYSTEM, trajectories), trajectories, NO_PRIORS)
    second = np.zeros((3, 3, 3))  # sums of E[s s'] over all, followed, following; then the cross terms
    cross, seen, power = np.zeros((3, 3)), np.zeros((2, 3)), np.zeros((2, 2))
    first_mean, first_square = np.zeros(3), np.zeros((3, 3))
    for i, length in enumerate(LENGTHS):
        mean, V, _ = posterior(SYSTEM, x[i, : length + 1])
        square = (V + np.outer(mean, mean)).reshape(length + 1, 3, length + 1, 3)
        for t in range(length + 1):
            second[0] += square[t, :, t]
            seen += np.outer(x[i, t], mean[3 * t : 3 * t + 3])
            power += np.outer(x[i, t], x[i, t])
            if t:
                second[1] += square[t - 1, :, t - 1]
                second[2] += square[t, :, t]
                cross += square[t, :, t - 1]
        first_mean += mean[:3] / 5
        first_square += square[0, :, 0] / 5
    A_new, C_new = cross @ np.linalg.inv(second[1]), seen @ np.linalg.inv(second[0])
    textbook = LinearGaussianSystem(
        A_new,
        C_new,
        (second[2] - A_new @ cross.T) / LENGTHS.sum(),
        (power - C_new @ seen.T) / (LENGTHS + 1).sum(),
        initial_mean=first_mean,
        initial_covariance=first_square - np.outer(first_mean, first_mean),
    )
    assert_same_system(ours, textbook)


def test_one_iteration_on_one_trajectory_is_pykalmans():
    pykalman = pytest.importorskip("pykalman")
    x = SYSTEM.sample(1, 40, np.random.default_rng(0)).observations
    names = [
        "transition_matrices",
        "observation_matrices",
        "transition_covariance",
        "observation_covariance",
        "initial_state_mean",
        "initial_state_covariance",
    ]
    start = {name: np.array(getattr(SYSTEM, field)) for name, field in zip(names, FIELDS, strict=True)}
    theirs = pykalman.KalmanFilter(**start).em(x[0], n_iter=1, em_vars=names)
    trajectories = Trajectories(x, np.array([40]))
    ours = maximisation(expectation(SYSTEM, trajectories), trajectories, NO_PRIORS)
    for name, field in zip(names, FIELDS, strict=True):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, name), atol=1e-9, err_msg=field)


def rotations(n=20, n_steps=60):
    """A circle, without any noise."""
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    x = np.stack([np.random.default_rng(0).normal(size=(n, 2))] * (n_steps + 1), axis=1)
    for t in range(n_steps):
        x[:, t + 1] = x[:, t] @ turn.T
    return x


def hard_data():
    x = STATIONARY.sample(20, 40, np.random.default_rng(0)).observations
    return {
        "plain": x,
        "one trajectory": x[:1],
        "two observations each": x[:, :2],
        "duplicate": np.concatenate([x, x[:, :, :1]], axis=2),
        "small and large": x * [1e-6, 1e6],
        "no noise": rotations(),
        "random walk": np.cumsum(x, axis=1),
    }


@pytest.mark.parametrize("case", list(hard_data()))
@pytest.mark.parametrize("method", ["em", "map"])
@pytest.mark.parametrize("standardise", [True, False])
def test_likelihood_and_posterior_never_fall(case, method, standardise):
    data = Sequences.from_observations(hard_data()[case])
    kalman = KalmanFilter(
        n_states=4, method=method, n_iterations=25, tolerance=0.0, standardise=standardise, random_state=0
    ).fit(data)
    rising = kalman.history_["log_likelihood" if method == "em" else "log_posterior"]
    assert len(rising) > 5
    assert np.diff(rising).min() > -1e-8 * np.abs(rising).max()  # rounding, at noise of NOISE_FLOOR
    assert rising[-1] > rising[0]
    assert np.isfinite(kalman.forecast(kalman.beliefs(data)[:, -1], 5)).all()


@pytest.mark.parametrize("stationary", [True, False])
def test_the_learned_filter_comes_close_to_the_known_one(stationary):
    rng = np.random.default_rng(0)
    train, validation, test = (STATIONARY.sample(n, 60, rng) for n in (150, 30, 300))
    known = KalmanFilter.of(STATIONARY, stationary=stationary).errors(test, horizon=5)
    kalman = KalmanFilter(n_states=3, stationary=stationary, n_iterations=60).fit(train, validation)
    learned = kalman.errors(test, horizon=5)
    assert 0.999 < learned.mean / known.mean < 1.005
    np.testing.assert_allclose(learned.by_look_ahead, known.by_look_ahead, rtol=0.015)
    start = clone(kalman).set_params(n_iterations=0).fit(train)
    assert start.errors(test).mean / known.mean > 1.01  # the iterations are needed
    beliefs = kalman.beliefs(test)[:, 5:-1].reshape(-1, kalman.belief_size)
    x = test.observations[:, 5:].reshape(-1, 2)
    inside = np.abs(x - kalman.predict_observation(beliefs)) < np.sqrt(kalman.predict_variance(beliefs))
    np.testing.assert_allclose(inside.mean(axis=0), 0.6827, atol=0.015)
    found, true = (np.sort_complex(np.linalg.eigvals(a)) for a in (kalman.system_.transition_matrix, A))
    np.testing.assert_allclose(
        found[1:], true[1:], atol=0.02
    )  # the fast third is hardly seen in the observations


def test_it_learns_many_observations_of_few_states():
    rng = np.random.default_rng(0)
    system = LinearGaussianSystem(A, rng.normal(size=(30, 3)), Q, np.diag(rng.uniform(0.2, 2.0, 30)))
    train, test = system.sample(40, 60, rng), system.sample(200, 60, rng)
    known = KalmanFilter.of(system).errors(test).mean
    assert KalmanFilter(n_states=3).fit(train).errors(test).mean / known == pytest.approx(1.0, abs=0.01)


def test_validation_chooses_the_iterate():
    rng = np.random.default_rng(3)
    train, validation = STATIONARY.sample(2, 25, rng), STATIONARY.sample(50, 25, rng)
    kalman = KalmanFilter(n_states=6, n_iterations=40, tolerance=0.0).fit(train, validation)
    errors = kalman.history_["validation_error"]
    assert kalman.best_iteration_ == np.argmin(errors) < 40  # it overfits
    assert kalman.errors(validation).mean == pytest.approx(errors.min(), rel=1e-12)
    alone = clone(kalman).fit(train)
    assert alone.best_iteration_ == len(alone.history_["iteration"]) - 1
    assert np.isnan(alone.history_["validation_error"]).all()
    assert alone.errors(validation).mean > errors.min()


def test_it_stops_where_little_is_gained():
    data = STATIONARY.sample(10, 40, np.random.default_rng(0))
    gains = np.diff(KalmanFilter(n_states=3, n_iterations=30).fit(data).history_["log_likelihood"])
    tolerance = gains[9] / data.observations.size
    stopped = KalmanFilter(n_states=3, n_iterations=30, tolerance=tolerance).fit(data).history_
    assert stopped["iteration"][-1] == np.flatnonzero(gains <= gains[9])[0] + 1 < 30


@pytest.mark.parametrize("standardise", [True, False])
def test_units_do_not_change_what_is_learned(standardise):
    x = STATIONARY.sample(10, 40, np.random.default_rng(0)).observations
    unit = np.array([1e-6, 1e6])
    plain, scaled = (Sequences.from_observations(data) for data in (x, x * unit))
    for method in ("em", "map"):
        kalman = KalmanFilter(n_states=3, method=method, n_iterations=10, standardise=standardise)
        one, other = clone(kalman).fit(plain), clone(kalman).fit(scaled)
        belief, belief_scaled = one.beliefs(plain)[:, -1], other.beliefs(scaled)[:, -1]
        expected = one.predict_observation(belief)
        np.testing.assert_allclose(other.predict_observation(belief_scaled) / unit, expected, atol=1e-5)
        variance = other.predict_variance(belief_scaled) / unit**2
        np.testing.assert_allclose(variance, one.predict_variance(belief), rtol=1e-5)
    # atol and rtol: the units' rounding, grown over the iterations


def test_a_constant_component_is_told_predicted_and_leaves_the_others():
    x = STATIONARY.sample(10, 40, np.random.default_rng(0)).observations
    constant = np.concatenate([x, np.full((10, 41, 1), 7.3)], axis=2)
    kalman = KalmanFilter(n_states=3, n_iterations=10)
    plain = clone(kalman).fit(Sequences.from_observations(x))
    with pytest.warns(UserWarning, match=r"observations \[2\] do not vary"):
        other = clone(kalman).fit(Sequences.from_observations(constant))
    predicted = other.predict_observation(other.beliefs(Sequences.from_observations(constant))[:, -1])
    expected = plain.predict_observation(plain.beliefs(Sequences.from_observations(x))[:, -1])
    np.testing.assert_allclose(predicted[:, 2], 7.3, rtol=1e-12)
    np.testing.assert_allclose(predicted[:, :2], expected, atol=1e-6)
    unlike = constant[:, :5] + [0.0, 0.0, 3.0]  # what never varied in training says nothing later
    ours = other.beliefs(Sequences.from_observations(unlike))[:, -1]
    np.testing.assert_allclose(
        ours, other.beliefs(Sequences.from_observations(constant[:, :5]))[:, -1], atol=1e-6
    )


def test_a_duplicate_component_is_predicted_as_its_original():
    x = STATIONARY.sample(20, 40, np.random.default_rng(0)).observations
    twice = Sequences.from_observations(np.concatenate([x, x[:, :, :1]], axis=2))
    plain = KalmanFilter(n_states=3).fit(Sequences.from_observations(x))
    kalman = KalmanFilter(n_states=3).fit(twice)
    predicted = kalman.predict_observation(kalman.beliefs(twice)[:, -1])
    np.testing.assert_allclose(predicted[:, 2], predicted[:, 0], atol=1e-3)  # NOISE_FLOOR: 1e-4 deviations
    theirs = plain.predict_observation(plain.beliefs(Sequences.from_observations(x))[:, -1])
    np.testing.assert_allclose(predicted[:, :2], theirs, atol=0.05)  # both near the maximum, not at it
    variance = kalman.predict_variance(kalman.initial_belief())[0]
    assert variance[2] == pytest.approx(variance[0], rel=1e-3)
    least = np.linalg.eigvalsh(kalman.system_.observation_covariance)[0]
    assert least == pytest.approx(NOISE_FLOOR, rel=1e-3)


def test_states_beyond_what_the_data_tell_apart_start_from_the_seed_and_do_no_harm():
    x = STATIONARY.sample(30, 3, np.random.default_rng(0)).observations
    data = Sequences.from_observations(x)
    kalman = KalmanFilter(n_states=7, n_iterations=3, random_state=1)
    one, again = (clone(kalman).fit(data).errors(data).mean for _ in range(2))
    assert one == again
    assert one < KalmanFilter(n_states=1, n_iterations=0).fit(data).errors(data).mean


def known_state_data():
    """Episodes of different lengths with true states of other units and means, as hints too."""
    data = STATIONARY.sample(8, 15, np.random.default_rng(5))
    states = data.states * [1.0, 10.0, 0.1] + [3.0, 0.0, -2.0]
    return Sequences.from_observations(
        data.observations + np.array([5.0, 0.0]),
        lengths=[15, 4, 9, 15, 0, 3, 7, 15],
        states=states,
        hints=states,
    )


def pairs_of(array, lengths):
    before = np.concatenate([array[i, :length] for i, length in enumerate(lengths)])
    after = np.concatenate([array[i, 1 : length + 1] for i, length in enumerate(lengths)])
    return before, after, np.concatenate([array[i, : length + 1] for i, length in enumerate(lengths)])


def test_known_states_with_weak_priors_are_least_squares():
    data = known_state_data()
    kalman = KalmanFilter(
        method="map",
        states_from="hints",
        standardise=False,
        transition_penalty=0.0,
        observation_penalty=0.0,
        noise_weight=0.0,
    ).fit(data)
    before, after, s = pairs_of(data.states, data.lengths)
    x = pairs_of(data.observations, data.lengths)[2]
    A_hat = np.linalg.lstsq(before, after)[0].T
    C_hat = np.linalg.lstsq(s, x)[0].T
    first = data.states[:, 0]
    e, d = after - before @ A_hat.T, x - s @ C_hat.T
    expected = LinearGaussianSystem(
        A_hat,
        C_hat,
        e.T @ e / len(e),
        d.T @ d / len(d),
        initial_mean=first.mean(axis=0),
        initial_covariance=np.cov(first.T, bias=True),
    )
    assert_same_system(kalman.system_, expected, rtol=1e-8, atol=1e-10)


def test_known_states_with_penalties_are_the_ridge_regressions_of_section_3_4():
    data = known_state_data()
    kalman = KalmanFilter(
        method="map",
        states_from="states",
        transition_penalty=3.0,
        observation_penalty=0.7,
        noise_weight=0.0,
        stationary=False,
    ).fit(data)
    rows = data.states[data.observation_mask]
    z = (data.states - rows.mean(axis=0)) / rows.std(axis=0)
    seen = data.observations[data.observation_mask]
    y = (data.observations - seen.mean(axis=0)) / seen.std(axis=0)
    before, after, s = pairs_of(z, data.lengths)
    x = pairs_of(y, data.lengths)[2]

    def augmented(inputs, targets, penalty):
        """Least squares with a row of sqrt(penalty) for each coefficient; residuals of those rows too."""
        inputs = np.vstack([inputs, np.sqrt(penalty) * np.eye(3)])
        targets = np.vstack([targets, np.zeros((3, targets.shape[1]))])
        found = np.linalg.lstsq(inputs, targets)[0]
        return found.T, targets - inputs @ found

    A_hat, e = augmented(before, after, 3.0)
    C_hat, d = augmented(s, x, 0.7)
    system = kalman.system_
    np.testing.assert_allclose(system.transition_matrix, A_hat, atol=1e-10)
    np.testing.assert_allclose(system.observation_matrix, C_hat, atol=1e-10)
    np.testing.assert_allclose(system.transition_covariance, e.T @ e / len(before), atol=1e-10)
    np.testing.assert_allclose(system.observation_covariance, d.T @ d / len(x), atol=1e-10)


def test_known_states_maximise_the_posterior():
    """A numerical maximum of the matrix normal times inverse Wishart posterior, with scipy's own densities."""
    rng = np.random.default_rng(0)
    system = LinearGaussianSystem([[0.8, 0.2], [-0.1, 0.7]], [[1.0, 0.5]], 0.3 * np.eye(2), [[0.2]])
    data = system.sample(3, 8, rng)
    trajectories = Trajectories(data.observations, data.lengths)
    priors = Priors(2.0, 1.5, 9.0, 0.4, np.array([1.0, 2.0]), np.array([3.0]))
    ours = maximisation(StateMoments.known(trajectories.flat(data.states)), trajectories, priors)
    before, after, s = pairs_of(data.states, data.lengths)

    def log_posterior(matrix, covariance, inputs, targets, penalty, scale):
        dim, n = matrix.shape
        likelihood = multivariate_normal(np.zeros(dim), covariance).logpdf(targets - inputs @ matrix.T).sum()
        # the columns of the matrix are N(0, covariance / penalty); powers of the determinant: w = df + dim + 1 + n
        prior = multivariate_normal(np.zeros(dim), covariance / penalty).logpdf(matrix.T).sum()
        return (
            likelihood + prior + invwishart(9.0 - dim - 1 - n, 9.0 * 0.4 * np.diag(scale)).logpdf(covariance)
        )

    x = data.observations.reshape(-1, 1)
    for matrix, covariance, arguments in (
        (ours.transition_matrix, ours.transition_covariance, (before, after, 2.0, [1.0, 2.0])),
        (ours.observation_matrix, ours.observation_covariance, (s, x, 1.5, [3.0])),
    ):
        dim, lower = len(matrix), np.tril_indices(len(matrix))

        def unpack(theta, shape=matrix.shape, dim=dim, lower=lower):
            root = np.zeros((dim, dim))
            root[lower] = theta[shape[0] * shape[1] :]
            return theta[: shape[0] * shape[1]].reshape(shape), root @ root.T

        start = np.concatenate([0.5 * matrix.ravel(), np.eye(dim)[lower]])
        found = minimize(
            lambda theta, unpack=unpack, arguments=arguments: -log_posterior(*unpack(theta), *arguments),
            start,
            method="BFGS",
            options={"gtol": 1e-7},
        )
        best, best_covariance = unpack(found.x)
        np.testing.assert_allclose(matrix, best, atol=1e-4)  # of finite differences
        np.testing.assert_allclose(covariance, best_covariance, atol=1e-4)
        assert log_posterior(matrix, covariance, *arguments) >= -found.fun - 1e-9


def test_states_are_given_in_the_units_they_were_learned_in():
    rng = np.random.default_rng(0)
    unit, offset = np.array([1.0, 1e4, 1e-4]), np.array([3.0, 0.0, -2.0])
    plain = STATIONARY.sample(200, 50, rng)
    data = Sequences.from_observations(plain.observations + 4.0, hints=plain.states * unit + offset)
    learned = KalmanFilter(method="map", states_from="hints").fit(data[:150])
    test, hints = data[150:], data[150:].hints[:, 10:]
    known = KalmanFilter.of(STATIONARY)
    shifted = Sequences.from_observations(plain.observations[150:])
    for kalman, seen, scale, shift in ((known, shifted, unit, offset), (learned, test, 1.0, 0.0)):
        m = kalman.beliefs(seen)[:, 10:-1].reshape(-1, 3)
        before = kalman.predict_state(m) * scale + shift
        after = kalman.filter_state(m, seen.observations[:, 10:].reshape(-1, 2)) * scale + shift
        errors = [np.square((s - hints.reshape(-1, 3)) / unit).mean(axis=0) for s in (before, after)]
        assert (errors[1] < errors[0]).all()
        if kalman is known:
            ceiling = errors
    np.testing.assert_allclose(errors, ceiling, rtol=0.02)


def test_constant_and_duplicate_states_are_learned_from():
    data = STATIONARY.sample(20, 30, np.random.default_rng(0))
    states = np.concatenate([data.states, data.states[:, :, :1], np.full((20, 31, 1), 2.5)], axis=2)
    data = Sequences.from_observations(data.observations, hints=states)
    kalman = KalmanFilter(
        method="map",
        states_from="hints",
        transition_penalty=0.0,
        observation_penalty=0.0,
        noise_weight=0.0,
        stationary=False,
    ).fit(data)
    found = kalman.predict_state(kalman.beliefs(data)[:, -1])
    np.testing.assert_allclose(found[:, 3], found[:, 0], atol=1e-3)
    np.testing.assert_allclose(found[:, 4], 2.5, atol=1e-3)
    known = KalmanFilter.of(STATIONARY, stationary=False).errors(data).mean
    assert kalman.errors(data).mean < 1.02 * known


def test_strong_priors_win():
    data = STATIONARY.sample(5, 20, np.random.default_rng(0))
    kalman = KalmanFilter(
        n_states=2,
        method="map",
        transition_penalty=1e9,
        observation_penalty=1e9,
        noise_weight=1e9,
        noise_scale=0.25,
        n_iterations=3,
    ).fit(data)
    np.testing.assert_allclose(kalman.system_.transition_matrix, 0.0, atol=1e-6)
    np.testing.assert_allclose(kalman.system_.observation_covariance, 0.25 * np.eye(2), atol=1e-5)
    np.testing.assert_allclose(kalman.system_.transition_covariance, 0.25 * np.eye(2), atol=1e-5)


WRONG = {
    "n_states": ({"n_states": 0}, "expected n_states to be a whole number of at least 1, got 0"),
    "method": ({"method": "mle"}, r"expected method to be one of \['em', 'map', 'known'\], got 'mle'"),
    "iterations": ({"n_iterations": 1.5}, "expected n_iterations to be a whole number"),
    "penalty": ({"transition_penalty": -1.0}, "expected transition_penalty finite and at least 0"),
    "weight": ({"noise_weight": np.inf}, "expected noise_weight finite and at least 0"),
    "em with states": ({"states_from": "hints"}, 'expected method="map" with states_from='),
    "other states": ({"method": "map", "states_from": "labels"}, "expected states_from to be"),
    "no hints": (
        {"method": "map", "states_from": "hints"},
        "expected trajectories with hints, got Sequences",
    ),
    "no system": ({"method": "known"}, "expected a LinearGaussianSystem as system"),
    "known, scaled": ({"method": "known", "system": STATIONARY}, "expected standardise=False with a known"),
}


@pytest.mark.parametrize("case", list(WRONG))
def test_wrong_parameters_are_told(case):
    parameters, message = WRONG[case]
    data = STATIONARY.sample(2, 10, np.random.default_rng(0))
    with pytest.raises(ValueError, match=message):
        KalmanFilter(**parameters).fit(data)


def test_parameters_stay_as_they_are():
    kalman = KalmanFilter(n_states=2, n_iterations=2)
    before = kalman.get_params()
    kalman.fit(STATIONARY.sample(3, 10, np.random.default_rng(0)))
    assert kalman.get_params() == before
    assert clone(kalman).get_params() == before
