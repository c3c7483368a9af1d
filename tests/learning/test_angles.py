"""Components that are angles: a model must not see where a recording starts to count, nor a jump at +-pi."""

import numpy as np
import pytest

from beliefgym.learning import (
    DataAsDemonstrator,
    PolynomialRidge,
    RandomForest,
    RandomFourierRidge,
    Sequences,
)
from beliefgym.learning.model_derivatives import derivatives

TURN = 2.0 * np.pi
A_TURN = np.array([0.0, TURN])  # of the angle, component 1


def wrapped(sequences):
    """The same recording with its angle, component 1, in [-pi, pi)."""
    x = sequences.observations.copy()
    x[:, :, 1] = (x[:, :, 1] + np.pi) % TURN - np.pi
    return Sequences.from_observations(x, actions=sequences.actions, lengths=sequences.lengths)


def spinning(seed=0, n=12, steps=30):
    """(speed, angle) of a driven pendulum of which some trajectories go round; recorded without a jump."""
    rng = np.random.default_rng(seed)
    x = np.zeros((n, steps + 1, 2))
    u = rng.normal(size=(n, steps, 1))
    x[:, 0] = rng.normal(size=(n, 2)) * (3.0, 2.0)
    for t in range(steps):
        speed, angle = x[:, t, 0], x[:, t, 1]
        x[:, t + 1, 0] = speed + 0.1 * (9.8 * np.sin(angle) + 2.0 * u[:, t, 0])
        x[:, t + 1, 1] = angle + 0.1 * x[:, t + 1, 0]
    lengths = steps - np.arange(n) % 4
    assert (np.abs(x[:, :, 1]) > 1.5 * np.pi).any(), "some go round"
    return Sequences.from_observations(x, actions=u, lengths=lengths)


def model_of(regressor=None, **how):
    regressor = RandomFourierRidge(n_frequencies=40, random_state=0) if regressor is None else regressor
    return DataAsDemonstrator(regressor, **{"n_iterations": 2, "angles": (1,), **how})


REGRESSORS = [
    RandomFourierRidge(n_frequencies=40, random_state=0),
    PolynomialRidge(degree=2, alpha=1e-6),
    RandomForest(n_estimators=5, random_state=0),
]


@pytest.mark.parametrize("regressor", REGRESSORS, ids=lambda one: type(one).__name__)
def test_whole_turns_change_nothing_but_the_angle_itself(regressor):
    train = spinning()
    model = model_of(regressor, n_iterations=0).fit(train)
    x, u = train.observations[:, 5], train.actions[:, 5]
    ahead, a_turn_later = model.predict(x, u), model.predict(x + 2 * A_TURN, u)
    # cos(theta + 4 pi) is cos(theta) to 1e-15; a forest's float32 thresholds do not see that
    np.testing.assert_allclose(a_turn_later, ahead + 2 * A_TURN, atol=1e-10)
    for here, there in zip(derivatives(model, x, u), derivatives(model, x - A_TURN, u), strict=True):
        np.testing.assert_allclose(there, here, atol=1e-9)


@pytest.mark.parametrize("n_iterations", [0, 3])
@pytest.mark.parametrize("standardise", [True, False])
def test_a_wrapped_recording_gives_the_same_model(n_iterations, standardise):
    train, test = spinning(), spinning(seed=1)
    how = {"n_iterations": n_iterations, "standardise": standardise, "horizon": 6}
    one, other = model_of(**how).fit(train), model_of(**how).fit(wrapped(train))
    # the differences of wrapped angles carry 1e-15 of rounding; feature sums and rollouts amplify it
    np.testing.assert_allclose(
        other.history_["train_single_step"], one.history_["train_single_step"], rtol=1e-6
    )
    np.testing.assert_array_equal(other.history_["n_added"], one.history_["n_added"])
    x, u = test.observations[:, 3], test.actions[:, 3]
    # (which iteration is kept goes by e_k / p_k, whose p_k does depend on the turns of a recording)
    assert one.best_iteration_ == other.best_iteration_
    np.testing.assert_allclose(other.predict(x, u), one.predict(x, u), atol=1e-6)
    blind = model_of(**how, angles=None).fit(wrapped(train))
    jump = np.abs(blind.predict(x, u) - one.predict(x, u)).max()
    assert jump > 0.5, "without angles the jumps of the recording are learned"


def test_a_rollout_goes_round_without_a_jump():
    train = wrapped(spinning())
    model = model_of(n_iterations=0).fit(train)
    start, u = np.array([[6.5, 3.0], [-6.5, -3.0]]), np.zeros((2, 12, 1))
    path = model.rollout(start, 12, u)
    truth = np.empty_like(path)
    truth[:, 0] = start
    for t in range(12):
        truth[:, t + 1, 0] = truth[:, t, 0] + 0.98 * np.sin(truth[:, t, 1])
        truth[:, t + 1, 1] = truth[:, t, 1] + 0.1 * truth[:, t + 1, 0]
    assert truth[0, -1, 1] > 1.5 * np.pi
    assert truth[1, -1, 1] < -1.5 * np.pi
    np.testing.assert_allclose(path, truth, atol=0.5)  # the fit's own error over 12 steps; a jump is 6.3
    elsewhere = model.rollout(start - 3 * A_TURN, 12, u)
    np.testing.assert_allclose(elsewhere, path - 3 * A_TURN, atol=1e-9)  # rounding, over 12 steps


def test_errors_are_compared_modulo_a_turn():
    train, test = spinning(), spinning(seed=2)
    model = model_of(n_iterations=0).fit(train)
    plain, turned = model.errors(test), model.errors(wrapped(test))
    np.testing.assert_allclose(turned.rmse, plain.rmse, rtol=1e-6)  # rounding, amplified by 30 steps
    np.testing.assert_allclose(turned.by_step, plain.by_step, rtol=1e-6)
    assert model.single_step_error(wrapped(test)) == pytest.approx(model.single_step_error(test), rel=1e-9)
    predicted = model.rollout(test.observations[:, 0], test.n_steps, test.actions)
    error = predicted - test.observations
    error[:, :, 1] = np.arctan2(np.sin(error[:, :, 1]), np.cos(error[:, :, 1]))
    length = int(test.lengths[0])
    by_hand = np.sqrt((error[0, 1 : length + 1] ** 2).sum(axis=1).mean())
    assert plain.rmse[0] == pytest.approx(by_hand, rel=1e-12)


def test_a_prediction_a_turn_off_is_no_error_and_no_outlier():
    """A perfect model of an angle that is recorded wrapped has errors of rounding, and DaD drops nothing."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=(6, 40, 1))
    angle = np.cumsum(np.concatenate([rng.normal(size=(6, 1)), 0.4 + 0.1 * u[:, :, 0]], axis=1), axis=1)
    x = (np.stack([0.0 * angle + rng.normal(size=angle.shape), angle], -1) + np.pi) % TURN - np.pi
    train = Sequences.from_observations(x[:, :, 1:], actions=u)
    model = DataAsDemonstrator(
        PolynomialRidge(degree=1, alpha=0.0),
        n_iterations=1,
        angles=[np.int64(0)],
        outlier_threshold=1e-3,
        horizon=None,
    ).fit(train)
    assert model.errors(train).rmse.max() < 1e-10  # noise-free, 40 steps of rounding
    assert model.history_["n_outlying"][1] == 0


@pytest.mark.parametrize("angles", [(2,), (-1,), (True,), ("theta",), (0, 1.0)])
def test_angles_that_are_no_components_raise(angles):
    with pytest.raises(ValueError, match=r"expected angles as numbers of components, 0 to 1, got"):
        model_of(angles=angles).fit(spinning())


def test_angles_need_differences_as_target():
    with pytest.raises(
        ValueError, match="expected target='delta' with angles: a difference of angles has no jump"
    ):
        model_of(target="next").fit(spinning())


@pytest.mark.parametrize("none", [None, (), set()])
def test_no_angles_is_the_model_without(none):
    train = spinning()
    x, u = train.observations[:, 3], train.actions[:, 3]
    expected = DataAsDemonstrator(RandomFourierRidge(n_frequencies=40, random_state=0), n_iterations=0).fit(
        train
    )
    found = model_of(n_iterations=0, angles=none).fit(train)
    np.testing.assert_array_equal(found.predict(x, u), expected.predict(x, u))
