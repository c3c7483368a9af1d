"""Data as Demonstrator against Algorithms 1 and 2 written out in plain loops, and what it is for: better rollouts."""

import numpy as np
import pytest
from by_hand import RidgeOfAll
from sklearn import linear_model
from sklearn.preprocessing import PolynomialFeatures

from beliefgym.envs.pendulum import Pendulum
from beliefgym.learning import DataAsDemonstrator, PolynomialRidge, RandomFourierRidge, Ridge, Sequences

LENGTHS = (9, 4, 1, 0, 12, 7, 11)
KEPT = []  # the regressor of every iteration, as `Keeping` notes them


class Keeping(PolynomialRidge):
    """Notes the model of each iteration, of which DaD itself keeps only the best."""

    def frozen(self):
        KEPT.append(super().frozen())
        return KEPT[-1]


def oscillator(lengths=LENGTHS, n_act=0, seed=0, nonlinear=1.0):
    """A damped pendulum-like oscillator, (angle, velocity); the sine is what linear models cannot say."""
    rng = np.random.default_rng(seed)
    x = np.zeros((len(lengths), max(lengths) + 1, 2))
    u = rng.normal(size=(len(lengths), max(lengths), 2))[:, :, :n_act]
    x[:, 0] = 1.5 * rng.normal(size=(len(lengths), 2))
    for t in range(max(lengths)):
        angle, speed = x[:, t, 0], x[:, t, 1]
        force = nonlinear * np.sin(angle) + (1 - nonlinear) * angle
        x[:, t + 1, 0] = angle + 0.3 * speed
        x[:, t + 1, 1] = 0.95 * speed - 0.3 * force + 0.1 * u[:, t].sum(axis=1)
    return Sequences.from_observations(x, actions=u, lengths=lengths)


def pieces_of(episodes, horizon, stride):
    """Rollouts' trajectories: pieces from 0, stride, .. that fit, and the uncovered rest; (observations, actions)."""
    if horizon is None:
        return [(e["observations"], e["actions"]) for e in episodes]
    found = []
    for e in episodes:
        start, covered, length = 0, 0, len(e["actions"])
        while start < length and covered < length:
            end = min(start + horizon, length)
            found.append((e["observations"][start : end + 1], e["actions"][start:end]))
            start, covered = start + (horizon if stride is None else stride), end
    return found


def algorithm_1(
    train,
    n_iterations,
    *,
    target,
    alpha=1e-3,
    degree=1,
    horizon=None,
    stride=None,
    threshold=np.inf,
    ratio=np.inf,
):
    """Algorithms 1 and 2, line by line: a growing list D, scikit-learn's ridge, one prediction at a time.

    Returns:
        the model (x, u) -> next x of every iteration, and the number of pairs added before each.
    """
    episodes = train.to_episodes()
    rows = np.concatenate([e["observations"] for e in episodes])
    D = []

    def pair(x, u, x_next):
        D.append((np.concatenate([x, u]), x_next - x if target == "delta" else x_next))

    def learn():
        phi = PolynomialFeatures(degree, include_bias=False)
        features = phi.fit_transform(np.array([z for z, _ in D]))
        ridge = linear_model.Ridge(alpha=len(D) * alpha, solver="svd").fit(
            features, np.array([y for _, y in D])
        )

        def model(x, u):
            y = ridge.predict(phi.transform(np.concatenate([x, u])[None]))[0]
            return x + y if target == "delta" else y

        return model

    for e in episodes:
        for t in range(len(e["actions"])):
            pair(e["observations"][t], e["actions"][t], e["observations"][t + 1])
    models, added = [learn()], [len(D)]
    for _ in range(n_iterations):
        D_before, predictions, pieces = len(D), [], pieces_of(episodes, horizon, stride)
        for xi, u in pieces:
            x_hat = [xi[0]]
            for t in range(len(u)):
                x_hat.append(models[-1](x_hat[t], u[t]))
            predictions.append(x_hat)

        def error(k, t, pieces=pieces, predictions=predictions):
            return np.sqrt(np.mean(((predictions[k][t] - pieces[k][0][t]) / rows.std(axis=0)) ** 2))

        for k, (xi, u) in enumerate(pieces):
            for t in range(1, len(u)):
                mean = np.mean([error(j, t) for j in range(len(pieces)) if len(pieces[j][1]) > t])
                if error(k, t) <= threshold and error(k, t) <= ratio * mean:
                    pair(predictions[k][t], u[t], xi[t + 1])
        added.append(len(D) - D_before)
        models.append(learn())
    return models, added


def assert_is_algorithm_1(train, literal, **parameters):
    """Every iteration's model and count of corrections; the models' difference is far above the tolerance."""
    del KEPT[:]
    names = {"threshold": "outlier_threshold", "ratio": "outlier_ratio"}
    given = {names.get(k, k): v for k, v in literal.items() if k not in ("alpha", "degree")}
    regressor = Keeping(degree=literal.get("degree", 1), alpha=literal.get("alpha", 1e-3))
    settings = {"horizon": None, "standardise": False, **given, **parameters}
    model = DataAsDemonstrator(regressor, n_iterations=3, **settings).fit(train)
    models, added = algorithm_1(train, 3, **literal)
    np.testing.assert_array_equal(model.history_["n_added"], added)
    np.testing.assert_array_equal(model.history_["n_pairs"], np.cumsum(added))
    assert len(KEPT) == 4
    steps, fresh = train.transitions(), np.random.default_rng(1).normal(size=(train.n_transitions, 2))
    predictions = []
    for n, one in enumerate(models):
        model.model_ = KEPT[n]
        predictions.append(model.predict(fresh, steps.actions if train.n_act else None))
        expected = [one(x, u) for x, u in zip(fresh, steps.actions, strict=True)]
        # normal equations against a singular value decomposition: condition numbers below 1e5 at this alpha, times
        # 2e-16, and rollouts of up to 12 steps between the fits
        np.testing.assert_allclose(predictions[n], expected, rtol=0, atol=1e-9, err_msg=f"iteration {n}")
    if sum(added[1:]):
        assert np.abs(predictions[1] - predictions[0]).max() > 1e-4
        assert np.abs(predictions[3] - predictions[2]).max() > 1e-6
    return model


@pytest.mark.parametrize("target", ["delta", "next"])
@pytest.mark.parametrize("n_act", [0, 2])
@pytest.mark.parametrize("degree", [1, 2])
def test_it_is_the_algorithm_as_printed(target, n_act, degree):
    alpha = {1: 1e-3, 2: 0.05}[
        degree
    ]  # squares under a small penalty diverge, which the loops do not know of
    assert_is_algorithm_1(oscillator(n_act=n_act), {"target": target, "degree": degree, "alpha": alpha})


@pytest.mark.parametrize(("horizon", "stride"), [(4, None), (3, 1), (5, 2), (2, 3), (1, 1), (30, None)])
def test_it_is_the_algorithm_from_other_starting_points(horizon, stride):
    train = oscillator(n_act=1)
    model = assert_is_algorithm_1(train, {"target": "delta", "horizon": horizon, "stride": stride})
    step, expected = horizon if stride is None else stride, 0
    for length in (
        LENGTHS
    ):  # each full piece gives horizon - 1 corrections, the uncovered tail one fewer than its steps
        full = (length - horizon) // step + 1 if length >= horizon else 0
        tail = length - full * step if full * step < length and (full - 1) * step + horizon < length else 0
        tail = length if full == 0 else tail
        expected += full * (horizon - 1) + max(tail - 1, 0)
    np.testing.assert_array_equal(model.history_["n_added"][1:], expected)


@pytest.mark.parametrize("limit", [{"threshold": 0.3}, {"ratio": 1.2}, {"threshold": 0.4, "ratio": 1.5}])
def test_outlying_predictions_are_left_out_as_said(limit):
    train = oscillator()
    model = assert_is_algorithm_1(train, {"target": "delta", **limit})
    everything = sum(max(length - 1, 0) for length in LENGTHS)
    outlying = model.history_["n_outlying"]
    np.testing.assert_array_equal(model.history_["n_added"][1:] + outlying[1:], everything)
    assert (outlying[1:] > 0).all()
    assert (outlying[1:] < everything).all()


def test_a_threshold_that_nothing_meets_leaves_the_single_step_model():
    train = oscillator()
    regressor = RandomFourierRidge(n_frequencies=20, random_state=0)
    none = DataAsDemonstrator(regressor, n_iterations=3, outlier_threshold=1e-300).fit(train)
    plain = DataAsDemonstrator(regressor, n_iterations=0).fit(train)
    np.testing.assert_array_equal(none.history_["n_added"], [train.n_transitions, 0, 0, 0])
    np.testing.assert_array_equal(
        none.history_["train_single_step"], [plain.history_["train_single_step"][0]] * 4
    )
    np.testing.assert_array_equal(none.predict(np.eye(2)), plain.predict(np.eye(2)))
    all_of_them = DataAsDemonstrator(regressor, n_iterations=3, outlier_threshold=1e9, outlier_ratio=1e9).fit(
        train
    )
    assert not all_of_them.history_["n_outlying"].any()


@pytest.mark.parametrize("target", ["delta", "next"])
@pytest.mark.parametrize("n_act", [0, 1])
def test_without_iterations_it_is_the_regression_in_standardised_coordinates(target, n_act):
    train = oscillator(n_act=n_act)
    model = DataAsDemonstrator(Ridge(alpha=0.1), n_iterations=0, target=target).fit(train)
    rows, steps = train.observations[train.observation_mask], train.transitions()
    mean, std = rows.mean(axis=0), rows.std(axis=0)
    z, z_next = (steps.observations - mean) / std, (steps.next_observations - mean) / std
    u = (steps.actions - steps.actions.mean(axis=0)) / steps.actions.std(axis=0)
    X, Y = np.hstack([z, u]), z_next - z if target == "delta" else z_next
    predicted = linear_model.Ridge(alpha=0.1 * len(X)).fit(X, Y).predict(X)
    expected = (predicted + z if target == "delta" else predicted) * std + mean
    actual = model.predict(steps.observations, steps.actions if n_act else None)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)  # well conditioned, numbers of about 1
    assert model.best_iteration_ == 0
    error = np.square(actual - steps.next_observations).sum(axis=1).mean() ** 0.5
    assert model.history_["train_single_step"] == pytest.approx([error], rel=1e-12)


@pytest.mark.parametrize("standardise", [True, False])
@pytest.mark.parametrize("n_act", [0, 2])
@pytest.mark.parametrize("target", ["delta", "next"])
def test_sums_and_a_stored_aggregate_give_the_same_models(standardise, n_act, target):
    train, validation = oscillator(n_act=n_act), oscillator(n_act=n_act, seed=1)
    parameters = {"n_iterations": 5, "target": target, "standardise": standardise, "horizon": 6, "stride": 2}
    sums = DataAsDemonstrator(Ridge(alpha=1e-3), **parameters).fit(train, validation)
    stored = DataAsDemonstrator(RidgeOfAll(alpha=1e-3), **parameters).fit(train, validation)
    for name in sums.history_:
        if name != "seconds":  # rounding of 1e-16, grown over five fits and rollouts of twelve steps
            np.testing.assert_allclose(sums.history_[name], stored.history_[name], rtol=1e-9, err_msg=name)
    assert sums.best_iteration_ == stored.best_iteration_
    np.testing.assert_allclose(sums.errors(train).rmse, stored.errors(train).rmse, rtol=1e-9)


@pytest.mark.parametrize("target", ["delta", "next"])
def test_on_a_linear_system_without_noise_nothing_changes(target):
    train, test = oscillator(n_act=1, nonlinear=0.0), oscillator(n_act=1, nonlinear=0.0, seed=1)
    del KEPT[:]
    regressor = Keeping(degree=1, alpha=0.0)
    model = DataAsDemonstrator(regressor, n_iterations=8, target=target).fit(train, test)
    for n in range(9):
        # the corrections are x_hat -> A x to rounding; the errors of 12 steps are some hundred roundings of 1e-16
        np.testing.assert_allclose(KEPT[n].coef_, KEPT[0].coef_, rtol=0, atol=1e-12)
        assert model.history_["train_multi_step"][n] < 1e-12
        assert model.history_["validation_multi_step"][n] < 1e-12
        assert model.history_["aggregate_single_step"][n] < 1e-6  # from sums: root of 1e-16 times a few


def free_pendulum(n, seed):
    """Angle from hanging (rad) and velocity (rad/s): 30 steps of 0.2 s, from within 2.5 rad."""
    starts = np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 2)) * (2.5, 1.0) + (np.pi, 0.0)
    states = [starts]
    for _ in range(30):
        states.append(Pendulum.uncontrolled(dt=0.2).flow(states[-1], np.zeros((n, 1))))
    return Sequences.from_observations(np.stack(states, axis=1) - (np.pi, 0.0))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pendulum_rollouts_get_better_on_data_never_seen(seed):
    train, validation, test = (
        free_pendulum(300, seed),
        free_pendulum(100, seed + 10),
        free_pendulum(100, seed + 20),
    )
    regressor = RandomFourierRidge(n_frequencies=50, bandwidth=2.0, alpha=1e-4, random_state=0)
    model = DataAsDemonstrator(regressor, n_iterations=12, horizon=5).fit(train, validation)
    plain = DataAsDemonstrator(regressor, n_iterations=0).fit(train)
    # measured 0.51 to 0.52 on three seeds
    assert model.errors(test).mean < 0.7 * plain.errors(test).mean
    assert model.best_iteration_ > 0
    # the price: single steps along the true trajectories, a little (thesis proposal, Figs. 3.3 and 3.4)
    assert model.single_step_error(train) >= plain.single_step_error(train)
