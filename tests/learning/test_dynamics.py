"""What all dynamics models share (coordinates, single steps, rollouts, errors), on single-step regressions."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError

from beliefgym.learning import (
    DataAsDemonstrator,
    DivergenceWarning,
    MultiStepErrors,
    PolynomialRidge,
    RandomFourierRidge,
    Ridge,
    Sequences,
    multi_step_errors,
)

LENGTHS = (9, 4, 1, 0, 12, 7)


def trajectories(lengths=LENGTHS, n_act=1, seed=0, padding=0, scale=(1.0, 50.0), offset=(0.0, 20.0)):
    """A damped, nonlinear oscillator under random actions, in two components of different scales."""
    rng = np.random.default_rng(seed)
    x = np.zeros((len(lengths), max(lengths) + padding + 1, 2))
    u = rng.normal(size=(len(lengths), max(lengths) + padding, max(n_act, 1)))
    x[:, 0] = rng.normal(size=(len(lengths), 2))
    for t in range(u.shape[1]):
        push = u[:, t].sum(axis=1) if n_act else 0.0
        x[:, t + 1, 0] = x[:, t, 0] + 0.3 * x[:, t, 1]
        x[:, t + 1, 1] = 0.9 * x[:, t, 1] - 0.3 * np.sin(x[:, t, 0]) + 0.2 * push
    return Sequences.from_observations(
        x * scale + offset, actions=u[:, :, :n_act] if n_act else None, lengths=lengths
    )


def single_step(regressor=None, **parameters):
    """The ordinary regression: DaD without iterations."""
    return DataAsDemonstrator(
        Ridge(alpha=0.0) if regressor is None else regressor, n_iterations=0, **parameters
    )


def test_a_rollout_feeds_predictions_back():
    train = trajectories()
    model = single_step(RandomFourierRidge(n_frequencies=30, random_state=0)).fit(train)
    x, actions = train.observations[:, 0], train.actions
    predicted = model.rollout(x, 12, actions)
    assert predicted.shape == (6, 13, 2)
    np.testing.assert_array_equal(predicted[:, 0], x)
    now = x
    for t in range(12):
        now = model.predict(now, actions[:, t])
        # through the data's units and back at each step: a few roundings, little amplified by a damped system
        np.testing.assert_allclose(predicted[:, t + 1], now, rtol=1e-11, atol=1e-11)
    for i in range(6):
        one = model.rollout(x[i], 12, actions[i])
        assert one.shape == (13, 2)
        np.testing.assert_allclose(one, predicted[i], rtol=1e-11, atol=1e-11)  # BLAS sums one row otherwise
        np.testing.assert_array_equal(one[0], x[i])
    assert model.rollout(x, 0, actions[:, :0]).shape == (6, 1, 2)
    assert model.rollout(x[:0], 3, actions[:0, :3]).shape == (0, 4, 2)


def test_errors_are_the_thesis_formula_in_plain_loops():
    train, test = trajectories(), trajectories(seed=5)
    model = single_step(PolynomialRidge()).fit(train)
    errors = model.errors(test)
    rmse, power, ratios = [], [], []
    squares, powers = [[] for _ in range(12)], [[] for _ in range(12)]
    for k, length in enumerate(LENGTHS):
        if length == 0:
            continue
        truth = test.observations[k]
        x, e, p = truth[0], 0.0, 0.0
        for t in range(length):
            x = model.predict(x[None], test.actions[k, t][None])[0]
            squares[t].append(np.sum((x - truth[t + 1]) ** 2))
            powers[t].append(np.sum(truth[t + 1] ** 2))
            e, p = e + squares[t][-1], p + powers[t][-1]
        rmse.append((e / length) ** 0.5)
        power.append((p / length) ** 0.5)
        ratios.append(rmse[-1] / power[-1])
    # the loops go through the data's units at each step: a few roundings, amplified by at most e^12 and mostly damped
    np.testing.assert_allclose(errors.rmse, rmse, rtol=1e-9)
    np.testing.assert_allclose(errors.power, power, rtol=1e-14)
    np.testing.assert_allclose(errors.normalised, ratios, rtol=1e-9)
    assert errors.mean == pytest.approx(np.mean(ratios), rel=1e-9)
    np.testing.assert_allclose(errors.by_step, [np.mean(s) ** 0.5 for s in squares], rtol=1e-9)
    np.testing.assert_allclose(errors.power_by_step, [np.mean(s) ** 0.5 for s in powers], rtol=1e-14)
    assert errors.n_diverged == 0
    assert min(rmse) > 1e-3  # else the comparison would be of rounding


def test_the_single_step_error_is_that_of_predict():
    train, test = trajectories(), trajectories(seed=5)
    model = single_step().fit(train)
    steps = test.transitions()
    error = model.predict(steps.observations, steps.actions) - steps.next_observations
    expected = np.sqrt(np.square(error).sum(axis=1).mean())
    assert model.single_step_error(test) == pytest.approx(
        expected, rel=1e-12
    )  # the same numbers, summed otherwise


def test_normalised_errors_of_trajectories_at_zero():
    errors = MultiStepErrors(np.array([1.0, 2.0, 0.0]), np.array([4.0, 0.0, 2.0]), np.ones(1), np.ones(1))
    np.testing.assert_array_equal(errors.normalised, [0.25, 1.0, 0.0])  # the second takes the mean power, 2
    nothing = MultiStepErrors(np.array([1.0, 0.0]), np.zeros(2), np.ones(1), np.ones(1))
    np.testing.assert_array_equal(nothing.normalised, [np.inf, 0.0])
    with pytest.raises(
        ValueError, match=r"expected predictions of the truth's shape \(1, 3, 2\), got \(1, 2, 2\)"
    ):
        multi_step_errors(np.zeros((1, 2, 2)), np.zeros((1, 3, 2)), np.array([2]))
    with pytest.raises(ValueError, match="expected a trajectory of at least one step, got 2 of none"):
        multi_step_errors(np.zeros((2, 2, 2)), np.zeros((2, 2, 2)), np.array([0, 0]))


@pytest.mark.parametrize(("target", "standardise"), [("delta", False), ("next", True), ("next", False)])
def test_least_squares_do_not_depend_on_the_coordinates(target, standardise):
    train, test = trajectories(), trajectories(seed=1)
    a, b = single_step().fit(train), single_step(target=target, standardise=standardise).fit(train)
    steps = test.transitions()
    # normal equations in raw units: condition number (50 / 1)^2 times 2e-16 is 1e-12, of numbers of about 100
    np.testing.assert_allclose(
        a.predict(steps.observations, steps.actions), b.predict(steps.observations, steps.actions), atol=1e-9
    )
    x = test.observations[:, 0]
    np.testing.assert_allclose(a.rollout(x, 12, test.actions), b.rollout(x, 12, test.actions), atol=1e-8)


def test_standardised_models_do_not_depend_on_the_units():
    plain = single_step(RandomFourierRidge(n_frequencies=30, random_state=0))
    metres, others = trajectories(), trajectories(scale=(1e3, 50.0), offset=(7e3, 20.0))
    a = plain.fit(metres).errors(metres).rmse
    predicted = plain.rollout(metres.observations[:, 0], 12, metres.actions)
    plain.fit(others)
    again = plain.rollout(others.observations[:, 0], 12, others.actions)
    # 7e3 beside 1e3 costs one digit of 16; ridge 1e-6 amplifies by up to 1e5 a step
    np.testing.assert_allclose(
        (again - (7e3, 20.0)) / (1e3, 50.0), (predicted - (0.0, 20.0)) / (1.0, 50.0), atol=1e-6
    )
    assert a.shape == (5,)


def unstable(n=4, n_steps=12, growth=1.5):
    starts = np.linspace(0.5, 2.0, n)[:, None]
    return Sequences.from_observations((starts * growth ** np.arange(n_steps + 1.0))[:, :, None])


def test_a_diverging_rollout_is_cut_held_and_told():
    train = unstable()
    model = single_step(divergence_limit=5.0).fit(train)
    rows = train.observations[train.observation_mask]
    limit = rows.mean() + 5.0 * rows.std()
    starts = np.array([[2.0], [0.0], [1.0]])
    truth = starts * 1.5 ** np.arange(41.0)
    n_inside = (truth <= limit).sum(axis=1)  # the first that does not fit is step n_inside
    message = (
        f"2 of 3 rollouts diverged and were cut, the first \\(trajectory 0\\) in step {n_inside[0]} of 40; "
        "they stay at their last prediction inside 5 standard deviations of the training data"
    )
    with pytest.warns(DivergenceWarning, match=message) as caught:
        predicted = model.rollout(starts, 40)
    assert caught[0].filename == __file__
    for i in (0, 2):
        # 25 steps of growth 1.5: the coefficient's error of 1e-15 counts 25 times
        np.testing.assert_allclose(predicted[i, : n_inside[i], 0], truth[i, : n_inside[i]], rtol=1e-12)
        np.testing.assert_array_equal(predicted[i, n_inside[i] :, 0], predicted[i, n_inside[i] - 1, 0])
    assert n_inside[0] == n_inside[2] - 2  # 1.5 < 2 < 1.5^2
    np.testing.assert_allclose(predicted[1], 0.0, atol=1e-5)  # intercept of 1e-13, grown by 1.5^40 = 1e7


def test_divergence_in_errors_is_counted_within_the_episodes_only():
    model = single_step(divergence_limit=5.0).fit(unstable())
    far = unstable(n=2, n_steps=30)
    short = Sequences.from_observations(far.observations, lengths=[30, 3])
    assert model.errors(short).n_diverged == 1
    assert model.errors(far).n_diverged == 2
    assert np.isfinite(model.errors(far).rmse).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error", DivergenceWarning)
        model.rollout(far.observations[0, 0], 3)


def test_overflow_to_infinity_and_nan_stays_out():
    train = trajectories(n_act=0)
    model = single_step(PolynomialRidge(degree=3, alpha=0.0), divergence_limit=1e300).fit(train)
    with np.errstate(over="ignore", invalid="ignore"), pytest.warns(DivergenceWarning):
        predicted = model.rollout([[1e3, 1e5]], 200)
    assert np.isfinite(predicted).all()


def test_padding_does_not_matter():
    train, other = trajectories(), trajectories(seed=3)
    longer = [
        Sequences.from_observations(
            np.pad(s.observations, ((0, 0), (0, 8), (0, 0)), constant_values=np.nan),
            actions=np.pad(s.actions, ((0, 0), (0, 8), (0, 0)), constant_values=np.nan),
            lengths=s.lengths,
        )
        for s in (train, other)
    ]
    regressor = RandomFourierRidge(n_frequencies=20, random_state=0)
    parameters = {"n_iterations": 3, "horizon": 4}
    a = DataAsDemonstrator(regressor, **parameters).fit(train, other)
    b = DataAsDemonstrator(regressor, **parameters).fit(*longer)
    steps = other.transitions()
    np.testing.assert_array_equal(
        a.predict(steps.observations, steps.actions), b.predict(steps.observations, steps.actions)
    )
    for field in ("rmse", "power", "by_step", "power_by_step"):
        values, padded = getattr(a.errors(other), field), getattr(b.errors(longer[1]), field)
        np.testing.assert_allclose(padded[: len(values)], values, rtol=1e-13)  # sums with zeros between
        assert not padded[len(values) :].any()
    whole = DataAsDemonstrator(regressor, n_iterations=3)
    np.testing.assert_allclose(
        whole.fit(train).history_["train_multi_step"],
        whole.fit(longer[0]).history_["train_multi_step"],
        rtol=1e-10,
    )


def test_episodes_of_no_or_one_step():
    train = trajectories(lengths=(0, 1, 6, 1, 0, 5))
    with_empty = single_step().fit(train)
    without = single_step().fit(train[[1, 2, 3, 5]])
    test = trajectories(seed=1)
    # the starts of empty episodes count for the scales only
    np.testing.assert_allclose(with_empty.errors(test).rmse, without.errors(test).rmse, rtol=1e-9)
    assert len(with_empty.errors(train).rmse) == 4
    only = DataAsDemonstrator(Ridge(alpha=1e-3), n_iterations=2).fit(trajectories(lengths=(1, 1, 1, 1, 0)))
    np.testing.assert_array_equal(only.history_["n_added"], [4, 0, 0])
    assert np.isfinite(only.history_["train_multi_step"]).all()


@pytest.mark.parametrize("standardise", [True, False])
@pytest.mark.parametrize("target", ["delta", "next"])
@pytest.mark.parametrize("value", [0.0, 3.7, -1e6])
def test_a_constant_component_is_told_and_predicted_constant(standardise, target, value):
    moving = trajectories()
    constant = np.full((*moving.observations.shape[:2], 1), value)
    train = Sequences.from_observations(
        np.concatenate([moving.observations, constant], axis=2),
        actions=np.concatenate([moving.actions, np.full_like(moving.actions, 2.0)], axis=2),
        lengths=LENGTHS,
        observation_names=("x", "v", "still"),
    )
    model = single_step(Ridge(alpha=0.0), standardise=standardise, target=target)
    with pytest.warns(UserWarning, match="nothing can be learned of them") as caught:
        model.fit(train)
    assert [str(w.message) for w in caught] == [
        f"{what} do not vary in the training data: nothing can be learned of them, they get scale 1"
        for what in ("observations ['still']", "actions [1]")
    ]
    assert {w.filename for w in caught} == {__file__}
    predicted = model.rollout(train.observations[:, 0], 12, train.actions)
    np.testing.assert_allclose(predicted[:, :, 2], value, rtol=1e-13, atol=1e-13)  # roundings of the value
    without = single_step(Ridge(alpha=0.0), standardise=standardise, target=target).fit(moving)
    # the constant's rounding (1e-10 of 1e6) does not reach the others
    np.testing.assert_allclose(
        predicted[:, :, :2], without.rollout(moving.observations[:, 0], 12, moving.actions), atol=1e-8
    )


def test_a_model_that_does_not_use_actions_needs_none():
    train = trajectories()
    model = single_step(use_actions=False).fit(train)
    assert (model.n_obs_, model.n_act_) == (2, 0)
    bare = Sequences.from_observations(train.observations, lengths=LENGTHS)
    np.testing.assert_array_equal(model.errors(train).rmse, single_step().fit(bare).errors(bare).rmse)
    assert model.predict([[0.0, 0.0]]).shape == (1, 2)


def test_before_fit():
    model = DataAsDemonstrator()
    for call in (
        lambda: model.predict([[0.0]]),
        lambda: model.rollout([0.0], 1),
        lambda: model.errors(trajectories()),
        lambda: model.single_step_error(trajectories()),
    ):
        with pytest.raises(
            NotFittedError, match=r"this DataAsDemonstrator is not fitted yet; call fit\(train, valid"
        ):
            call()


def test_bad_calls_say_what_was_expected():
    train = trajectories()
    model, bare = single_step().fit(train), single_step().fit(trajectories(n_act=0))
    x, u = train.observations[:, 0], train.actions
    nan = u.copy()
    nan[2, 5] = np.nan
    for call, message in (
        (lambda: model.predict(x), r"expected actions of shape \(6, 1\), got None"),
        (lambda: model.predict(x, u[:, :2]), r"expected actions of shape \(6, 1\), got \(6, 2, 1\)"),
        (lambda: model.predict(x[:, :1], u[:, 0]), r"observations: expected shape \(n, 2\), got \(6, 1\)"),
        (lambda: model.predict(x[0], u[0, 0]), r"observations: expected shape \(n, 2\), got \(2,\)"),
        (
            lambda: model.predict(x * np.nan, u[:, 0]),
            r"observations: expected finite numbers, got nan at index \(0, 0\)",
        ),
        (
            lambda: model.rollout(x, 12, nan),
            r"actions: expected finite numbers, got nan at index \(2, 5, 0\)",
        ),
        (
            lambda: model.rollout(x * np.inf, 12, u),
            r"initial_states: expected finite numbers, got -?inf at index \(0, 0\)",
        ),
        (lambda: model.rollout(x, 11, u), r"expected actions of shape \(6, 11, 1\), got \(6, 12, 1\)"),
        (lambda: model.rollout(x, 12), r"expected actions of shape \(6, 12, 1\), got None"),
        (lambda: model.rollout(x[0], 12, u), r"expected actions of shape \(1, 12, 1\), got \(1, 6, 12, 1\)"),
        (lambda: model.rollout(x[:, :1], 12, u), r"initial_states: expected shape \(n, 2\), got \(6, 1\)"),
        (lambda: bare.rollout(x, 12, u), "expected no actions: this model was fitted without"),
        (lambda: bare.rollout(x, -1), "expected n_steps to be a whole number of at least 0, got -1"),
        (lambda: bare.rollout(x, 1.5), r"expected n_steps to be a whole number of at least 0, got 1\.5"),
        (
            lambda: model.errors(trajectories(n_act=2)),
            "expected trajectories with 2 observations and 1 actions as at fit, got 2 and 2",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_an_unknown_standardisation_is_told():
    with pytest.raises(
        ValueError, match=r"expected standardise to be one of \[True, 'together', False\], got 'all'"
    ):
        DataAsDemonstrator(Ridge(), standardise="all").fit(trajectories())
