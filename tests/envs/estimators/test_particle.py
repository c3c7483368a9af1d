"""The particle filter of a known system, against the exact filter of a linear one and a cloud by hand."""

import pickle
import warnings

import numpy as np
import pytest
from physics_examples import (
    PENDULUM_PRIOR,
    PRIOR,
    SENSOR,
    SINE,
    SINE_NOISE,
    SWING,
    Linear,
    Squared,
    filtered,
    linear_data,
    pendulum_data,
    textbook,
)
from sklearn.base import clone

from beliefgym.envs import ParticleFilter, Pendulum
from beliefgym.envs.estimators.particle import effective_size, systematic
from beliefgym.learning import Sequences


def of_linear(system=None, **parameters):
    return ParticleFilter.of(system or Linear(), prior=PRIOR, observation_noise_std=SENSOR, **parameters)


def of_swing(system=SWING, prior=PENDULUM_PRIOR, **parameters):
    return ParticleFilter.of(
        system, prior=prior, observed=SINE, observation_noise_std=SINE_NOISE, **parameters
    )


@pytest.mark.parametrize("system", [Linear(), Linear(actuation_noise_std=0.3, wind=(0.2, 0.0))])
def test_many_particles_are_the_kalman_filter(system):
    """The mean of N independent draws misses by P^(1/2) / sqrt(N). Uneven weights leave an effective size above N / 2
    at a step's start, of which an observation keeps a share (here above a fifth), and what a step missed fades by the
    next observations. So the error is below P^(1/2) sqrt(2 x 5 / N) x 4 with room for the largest of 208 numbers."""
    count = 20_000
    data = linear_data(system=system)
    B = np.array([0.1, 0.7])
    Q = np.diag([0.09, 0.04])
    if system.wind:
        Q = Q + 0.09 * np.outer(B, B) + np.diag([0.04, 0.0])
    missing = np.zeros(data.observations.shape, dtype=bool)
    missing[:, 5] = True
    missing[:, 8, 0] = True
    means, covariances = filtered(of_linear(system, n_particles=count), data, missing)
    x = np.where(missing, np.nan, data.observations)
    for i in range(len(data)):
        expected, P = textbook(x[i], data.actions[i], Q=Q)
        deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        bound = 4.0 * np.sqrt(10.0 / count)
        assert (np.abs(means[i] - expected) < bound * deviation).all()
        off = np.abs(covariances[i] - P) / (deviation[:, :, None] * deviation[:, None])
        assert off.max() < 2.0 * bound  # a variance misses by sqrt(2) as much


def test_it_tracks_the_pendulum_by_its_sine_alone():
    data = pendulum_data(n=30)
    estimator = of_swing(n_particles=1000)
    errors = estimator.hint_errors(data)
    late = np.sqrt(np.square(errors.difference[:, 20:]).mean(axis=(0, 1)))
    assert late[0] < 0.06  # the prior's is 0.2 rad
    assert late[1] < 0.25
    assert (np.abs(errors.mean_squared_z - 1.0) < 0.3).all()


def test_two_peaks_stay_two_where_the_observation_cannot_tell():
    """sin(theta) is the same at pi - theta. Without speed and noise both stay; a normal belief has one peak."""
    still = Pendulum.uncontrolled(gravity=1e-9)
    prior = (np.array([0.5 * np.pi, 0.0]), np.diag([1.0, 0.0]))
    estimator = of_swing(still, prior, n_particles=4000)
    belief = estimator.initial_belief()
    for _ in range(5):
        belief = estimator.update(belief, [[np.sin(1.0)]])
    states, log_weights = estimator._split(belief)
    left = np.abs(states[0, :, 0] - 1.0) < 0.3
    right = np.abs(states[0, :, 0] - (np.pi - 1.0)) < 0.3
    weights = np.exp(log_weights[0])
    assert 0.4 < weights[left].sum() < 0.6
    assert weights[left].sum() + weights[right].sum() > 0.99


def test_one_update_is_what_its_lines_say():
    system = Linear()
    estimator = of_linear(system, n_particles=50, resample_below=0.0)
    first = estimator.initial_belief(2)
    rng = np.random.default_rng(0)  # the default seed
    rng.standard_normal((2, 50, 2))
    states, log_weights = estimator._split(first)
    np.testing.assert_allclose(log_weights, -np.log(50))
    x, action = np.array([[1.0, 2.0], [0.0, np.nan]]), np.array([[0.5], [-1.0]])
    seen = estimator.update(first, x[[0, 0]])
    assert (seen[:, -1] == 1.0).all()
    np.testing.assert_array_equal(estimator._split(seen)[0], states)  # no step before the first observation
    found, found_weights = estimator._split(estimator.update(seen, x, action, missing="predict"))
    noise = rng.standard_normal((100, 2)).reshape(2, 50, 2)
    for row in range(2):
        moved = system.step(states[row], np.tile(action[row], (50, 1)), noise[row])
        np.testing.assert_allclose(found[row], moved, atol=1e-12)
        error = np.concatenate([x[[0]] - states[row] @ [[1.0, 0.0], [0.5, -1.0]]])
        once = np.exp(-0.5 * np.square(error / SENSOR).sum(axis=1))
        error = np.nan_to_num((x[row] - system.observe(moved)) / SENSOR)
        twice = once * np.exp(-0.5 * np.square(error).sum(axis=1))
        np.testing.assert_allclose(np.exp(found_weights[row]), twice / twice.sum(), atol=1e-12)


def test_draws_are_reproducible_and_predictions_do_not_disturb_them():
    data = pendulum_data(n=3)
    estimator = of_swing(n_particles=200)
    first = estimator.estimate_hints(data).mean
    np.testing.assert_array_equal(estimator.estimate_hints(data).mean, first)
    np.testing.assert_array_equal(of_swing(n_particles=200).estimate_hints(data).mean, first)
    assert not np.array_equal(of_swing(n_particles=200, random_state=1).estimate_hints(data).mean, first)
    rng = np.random.default_rng(0)
    again = of_swing(n_particles=200, random_state=rng)
    np.testing.assert_array_equal(again.estimate_hints(data).mean, first)
    belief = estimator.initial_belief(3)
    for t in range(data.n_steps + 1):
        estimator.predict_observation(belief)
        estimator.forecast(belief, 2)
        belief = estimator.update(belief, data.observations[:, t])
        np.testing.assert_array_equal(estimator.predict_hint(belief).mean, first[:, t])
    expected = estimator.predict_observation(belief)  # of the particles that the next update has
    following = estimator.update(belief, np.full((3, 1), np.nan), missing="predict")
    np.testing.assert_allclose(expected, estimator._expect(following), atol=1e-12)
    different = estimator.initial_belief(3)
    assert not np.array_equal(different[0], different[1])


def test_without_an_observation_the_weights_stay_and_the_cloud_spreads():
    data = pendulum_data(n=2)
    estimator = of_swing(n_particles=2000)
    belief = estimator.beliefs(data)[:, 31]
    before = np.linalg.det(estimator.estimate_state(belief).covariance)
    for _ in range(10):
        belief = estimator.update(belief, np.full((2, 1), np.nan), missing="predict")
    assert (np.linalg.det(estimator.estimate_state(belief).covariance) > 2.0 * before).all()


def test_systematic_resampling_takes_each_as_often_as_it_weighs():
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.full(30, 0.3), size=5)
    weights[2] = 0.0
    weights[2, 7] = 1.0
    start = rng.random(5)
    start[0] = 0.0
    chosen = systematic(weights, start)
    for row in range(5):
        times = np.bincount(chosen[row], minlength=30)
        assert times.sum() == 30
        assert (np.abs(times - 30 * weights[row]) < 1.0 + 1e-9).all()
        points = (start[row] + np.arange(30)) / 30
        by_hand = np.searchsorted(np.cumsum(weights[row]), points, side="right")
        np.testing.assert_array_equal(chosen[row], by_hand)
    np.testing.assert_allclose(effective_size(np.log(np.full((1, 8), 0.125))), 8.0)


def test_clouds_are_resampled_where_they_have_become_uneven_only():
    data = linear_data(n=3)
    sizes = []
    estimator = of_linear(n_particles=500, resample_below=1.0)
    assert estimator.effective_size(estimator.initial_belief(2)) == pytest.approx([500, 500])
    for share in (0.0, 0.5):
        estimator = of_linear(n_particles=500, resample_below=share)
        sizes.append(estimator.effective_size(estimator.beliefs(data)[:, -1]))
    assert (sizes[0] < 0.3 * sizes[1]).all()


def test_roughening_finds_a_constant_that_no_particle_began_with():
    """A constant without noise: the cloud shrinks to a few of its first values, and roughening moves these."""
    frozen = Pendulum.uncontrolled(gravity=1e-9)
    prior = (np.zeros(2), np.diag([0.16, 0.0]))
    far = np.full((1, 1), np.sin(0.9))
    found = []
    for roughening in (0.0, 0.5):
        estimator = ParticleFilter.of(
            frozen,
            prior=prior,
            observed=SINE,
            observation_noise_std=0.01,
            n_particles=20,
            roughening=roughening,
        )
        belief = estimator.initial_belief()
        for _ in range(40):
            belief = estimator.update(belief, far)
        found.append(abs(estimator.predict_hint(belief).mean[0, 0] - 0.9))
        speeds = estimator._split(belief)[0][0, :, 1]
        assert np.abs(speeds).max() < 1e-6  # what is known stays known
    assert found[1] < 0.02 < found[0]


def test_an_impossible_observation_is_told_once_and_does_not_count():
    estimator = of_linear(n_particles=100)
    belief = estimator.initial_belief(2)
    belief = estimator.update(belief, np.zeros((2, 2)))
    with pytest.warns(UserWarning, match="no particle can have made an observation .row 1 of the batch"):
        after = estimator.update(belief, [[0.0, 0.0], [1e200, 0.0]])
    np.testing.assert_allclose(estimator.effective_size(after)[1], 100)
    assert np.isfinite(after).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimator.update(belief, [[0.0, 0.0], [1e200, 0.0]])
        unlikely = estimator.update(belief, [[0.0, 0.0], [1e4, 0.0]])  # far, but the nearest are still known
    assert estimator.effective_size(unlikely)[1] < 2.0


def test_particles_that_cannot_be_simulated_lose_their_weight():
    estimator = of_linear(n_particles=4)
    belief = estimator.update(estimator.initial_belief(), np.zeros((1, 2)))
    states, log_weights = estimator._split(belief)
    states[0, 2] = 1.7e308
    belief = estimator._joined(states, np.full_like(log_weights, -np.log(4)), 1.0)
    after, weights = estimator._split(estimator.update(belief, np.full((1, 2), np.nan), missing="predict"))
    assert np.isfinite(after).all()
    np.testing.assert_allclose(np.exp(weights[0]), [1 / 3, 1 / 3, 0.0, 1 / 3])


def test_hints_prior_actions_and_files():
    data = linear_data(n=100, system=Squared())
    estimator = ParticleFilter(system=Squared(), observation_noise_std=SENSOR, n_particles=3000).fit(data)
    assert estimator.belief_size == 3000 * 3 + 1 == estimator.initial_belief().shape[1]
    first = data.hints[:, 0]
    scale = first.std(axis=0) / np.sqrt(3000)
    assert (np.abs(estimator.prior_mean_ - np.mean(first, axis=0))[1] < 4.0 * scale[1]).all()
    few = data[:5]
    errors = estimator.hint_errors(few)
    assert errors.by_time[-1] < errors.by_time[0]
    blind = Sequences.from_observations(few.observations, hints=few.hints, hint_names=few.hint_names)
    assert errors.mean < estimator.hint_errors(blind).mean
    again = pickle.loads(pickle.dumps(estimator))
    np.testing.assert_array_equal(again.estimate_hints(few).mean, estimator.estimate_hints(few).mean)
    some = clone(estimator).set_params(hint=("q",), n_particles=500).fit(data)
    state = some.estimate_state(some.beliefs(few)[:, 3])
    np.testing.assert_allclose(some.predict_hint(some.beliefs(few)[:, 3]).mean[:, 0], state.mean[:, 1])
    assert few.n_steps == few.lengths[0]


def test_episodes_may_end_early():
    data = pendulum_data(n=3)
    short = Sequences.from_observations(
        data.observations, actions=data.actions, hints=data.hints, lengths=[60, 10, 30]
    )
    estimate = of_swing(n_particles=100).estimate_hints(short)
    assert np.isnan(estimate.mean[1, 11:]).all()
    assert np.isfinite(estimate.mean[1, :11]).all()
    beliefs = of_swing(n_particles=100).beliefs(short)
    np.testing.assert_array_equal(beliefs[1, -1], beliefs[1, 11])
    assert np.isfinite(of_swing(n_particles=100).errors(short).mean)


def test_what_is_wrong_is_told():
    for parameters, message in (
        ({"n_particles": 1}, "n_particles to be a whole number of at least 2"),
        ({"resample_below": 1.5}, "resample_below in 0..1"),
        ({"roughening": -1.0}, "roughening finite and at least 0"),
        ({"observed": ("third",)}, "unknown name 'third'"),
    ):
        with pytest.raises(ValueError, match=message):
            of_linear(**parameters)
