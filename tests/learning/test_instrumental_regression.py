"""Two-stage regression: the predictive state filter, its rank, and data of every bad kind."""

import numpy as np
import pytest
from by_hand import eigenvalue_error, predictions
from scipy.linalg import solve_discrete_are
from sklearn.base import clone

from beliefgym.learning import Sequences
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.instrumental_regression import InstrumentalVariableRegression

ROTATION = 0.9 * np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
A = np.block([[ROTATION, np.zeros((2, 1))], [np.zeros((1, 2)), np.full((1, 1), 0.6)]])
C = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -1.0]])
Q = np.diag([0.3, 0.2, 0.4])
R = np.diag([0.2, 0.3])


def simulate(n, length, seed=0, burn_in=100):
    """Stationary trajectories of s' = A s + w, x = C s + v."""
    rng = np.random.default_rng(seed)
    state, rows = np.zeros((n, 3)), []
    for t in range(burn_in + length + 1):
        if t >= burn_in:
            rows.append(state @ C.T + rng.normal(size=(n, 2)) @ np.sqrt(R))
        state = state @ A.T + rng.normal(size=(n, 3)) @ np.sqrt(Q)
    return np.stack(rows, axis=1)


def kalman(x):
    """Predictions (n, n_rows, d) of the stationary Kalman filter, A - K C and the innovations' covariance."""
    p = solve_discrete_are(A.T, C.T, Q, R)
    s = C @ p @ C.T + R
    gain = A @ p @ C.T @ np.linalg.inv(s)
    state, rows = np.zeros((len(x), 3)), []
    for t in range(x.shape[1]):
        rows.append(state @ C.T)
        state = state @ A.T + (x[:, t] - rows[-1]) @ gain.T
    return np.stack(rows, axis=1), A - gain @ C, s


def two_stages(series, k, n_past, rank):
    """A filter as a function of a trajectory: its predictions; numpy's least squares on windows stacked one by one."""
    d = series[0].shape[1]
    history, extended = [], []
    for x in series:
        for t in range(n_past, len(x) - k):
            history.append(np.concatenate([[1.0], x[t - n_past : t].ravel()]))
            extended.append(x[t : t + k + 1].ravel())
    history, extended = np.array(history), np.array(extended)
    p = history @ np.linalg.lstsq(history, extended, rcond=None)[0]  # S1B
    m = history @ np.linalg.lstsq(history, extended[:, :-d], rcond=None)[0]  # S1A
    centre = m.mean(axis=0)
    directions = np.linalg.svd(m - centre, full_matrices=False)[2][:rank].T if rank else np.eye(k * d)
    states = np.concatenate([np.ones((len(m), 1)), (m - centre) @ directions], axis=1)
    w = np.linalg.lstsq(states, p, rcond=None)[0]  # S2
    sigma = (extended - p).T @ (extended - p) / len(p)
    gain = sigma[d:, :d] @ np.linalg.inv(sigma[:d, :d])
    starts = [x[:k].ravel() for x in series if len(x) >= k]
    first = np.sum([s - centre for s in starts], axis=0) / (len(starts) + 1)

    def filtered(x):
        state, found = directions.T @ first, []
        for row in x:
            q = np.concatenate([[1.0], state]) @ w
            found.append(q[:d])
            state = directions.T @ (q[d:] + gain @ (row - q[:d]) - centre)
        return np.array(found)

    return filtered


@pytest.mark.parametrize("rank", [3, 5, None])
@pytest.mark.parametrize("n_past", [None, 4])
def test_the_filter_is_that_of_two_least_squares_on_stacked_windows(rank, n_past):
    x = simulate(6, 40)
    series = [row[: 41 - 4 * i] + 10.0 for i, row in enumerate(x)]
    model = InstrumentalVariableRegression(n_future=3, n_past=n_past, rank=rank, standardise=False)
    model.fit(Sequences.from_episodes(series))
    expected = two_stages(series, 3, 6 if n_past is None else n_past, rank)
    assert model.belief_size == (rank or 6)
    for row in simulate(2, 15, seed=1) + 10.0:
        found = predictions(model, Sequences.from_observations(row[None]))[0]
        # 1e-10 of the covariance without history is added to the one with it
        np.testing.assert_allclose(found, expected(row), atol=1e-8)


@pytest.mark.parametrize("rank", [3, None])
def test_the_filter_approaches_the_stationary_kalman_filter(rank):
    x = simulate(200, 200, seed=2)
    model = InstrumentalVariableRegression(n_future=3, n_past=10, rank=rank)
    model.fit(Sequences.from_observations(x))
    test = simulate(100, 60, seed=3)
    expected, closed, covariance = kalman(test)
    found = predictions(model, Sequences.from_observations(test))
    # 40,000 steps: relative errors of 1e-2, and as much of an innovation in the predictions
    if rank is not None:
        assert eigenvalue_error(model.system_matrices_.transition, A) < 0.02
        assert eigenvalue_error(model.transition_matrix, closed) < 0.04
    gap = np.square(found - expected).sum(axis=2).mean() / np.trace(covariance)
    assert gap < (1e-3 if rank else 5e-3)  # full rank: 6 x 8 numbers, of which 15 mean something
    variance = model.predict_variance(model.initial_belief(2))
    np.testing.assert_allclose(variance, np.tile(np.diag(covariance), (2, 1)), rtol=0.02)


def test_errors_shrink_with_data():
    test = simulate(100, 60, seed=3)
    expected, gaps = kalman(test)[0], []
    for n in (5, 50, 500):
        model = InstrumentalVariableRegression(n_future=3, n_past=10, rank=3)
        model.fit(Sequences.from_observations(simulate(n, 80, seed=4)))
        found = predictions(model, Sequences.from_observations(test))
        gaps.append(np.square(found - expected).sum(axis=2).mean())
    assert gaps[0] > 4 * gaps[1] > 16 * gaps[2]  # as 1/n, which is 10, with room for chance


def test_instruments_remove_the_bias_of_a_regression_on_the_future_itself():
    """A regression of xi on psi itself, with one observation as its future, is blind to the noise in it."""
    rng = np.random.default_rng(0)
    s, rows = rng.normal(size=400) / np.sqrt(1 - 0.81), []
    for _ in range(100):
        rows.append(s + rng.normal(size=400))
        s = 0.9 * s + rng.normal(size=400)
    x = np.stack(rows, axis=1)[:, :, None]
    model = InstrumentalVariableRegression(n_future=1, n_past=5).fit(Sequences.from_observations(x))
    plain = (x[:, 1:] * x[:, :-1]).mean() / np.square(x).mean()
    assert abs(model.system_matrices_.transition.item() - 0.9) < 0.01  # 1 / sqrt(40,000), and some
    assert plain < 0.8  # 0.9 * 5.26 / 6.26


def test_validation_finds_the_rank():
    train, validation = simulate(200, 100, seed=5), simulate(200, 100, seed=6)
    model = InstrumentalVariableRegression(rank=[1, 2, 3, 5, 8])
    model.fit(Sequences.from_observations(train), Sequences.from_observations(validation))
    assert model.rank_ == model.belief_size == 3
    assert sorted(model.errors_by_rank_) == [1, 2, 3, 5, 8]
    alone = clone(model).set_params(rank=3).fit(Sequences.from_observations(train))
    assert model.errors_by_rank_[3] == alone.errors(Sequences.from_observations(validation)).mean
    np.testing.assert_array_equal(
        model.forecast(model.initial_belief(), 9), alone.forecast(alone.initial_belief(), 9)
    )
    assert model.singular_values_[2] > 5 * model.singular_values_[3]


def oscillations(n=20, length=60, seed=0):
    """Noise-free sums of two oscillations about 5, in three components: four states."""
    rng, t = np.random.default_rng(seed), np.arange(length + 1)
    sizes, phases = rng.normal(size=(n, 2, 1)), rng.uniform(0, 6, size=(n, 2, 1))
    waves = sizes * np.cos(np.array([[0.3], [0.7]]) * t + phases)
    return np.einsum("nft,fd->ntd", waves, np.random.default_rng(5).normal(size=(2, 3))) + 5.0


@pytest.mark.parametrize("rank", [4, [2, 3, 4, 6], None])
def test_without_noise_predictions_become_exact(rank):
    data = Sequences.from_observations(oscillations(length=300))
    model = InstrumentalVariableRegression(rank=rank).fit(data[:15], data[15:])
    assert model.rank_ == 4
    values = np.linalg.eigvals(model.system_matrices_.transition)
    values = values[np.abs(values) > 1e-3]  # full rank: the others are 0
    np.testing.assert_allclose(np.sort(np.angle(values)), [-0.7, -0.3, 0.3, 0.7], atol=1e-9)
    errors = model.errors(data[15:], horizon=9)  # the filter forgets by 0.95 a step: 1e-6 after 270
    assert np.nanmax(errors.squared[:, 270:]) < 1e-9
    assert errors.by_time[0] > 0.1


def test_a_full_belief_is_the_expected_future_about_its_mean():
    x = simulate(60, 60, seed=7)
    data = Sequences.from_observations(x)
    model = InstrumentalVariableRegression(n_future=4, standardise=False).fit(data)
    belief = model.beliefs(data)[:, 30]
    mean = x[:, 8:57].mean(axis=(0, 1))  # of the first blocks of all futures after a complete past
    np.testing.assert_allclose(belief[:, :2] + mean, model.predict_observation(belief), atol=1e-10)


@pytest.mark.parametrize("rank", [3, None])
def test_a_forecast_within_the_extended_future_is_read_off_and_further_ahead_filtered(rank):
    data = Sequences.from_observations(simulate(100, 60, seed=7))
    model = InstrumentalVariableRegression(n_future=3, rank=rank).fit(data)
    belief = model.beliefs(data)[:, 30]
    forecast = model.forecast(belief, 7)
    np.testing.assert_allclose(forecast[:, 0], model.predict_observation(belief), atol=1e-12)
    np.testing.assert_array_equal(forecast[:, :2], model.forecast(belief, 2))
    for step in range(3):
        belief = model.update(belief, model.predict_observation(belief))
        np.testing.assert_allclose(
            forecast[:, step + 4], model.forecast(belief, 4)[:, 3], rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize("standardise", [True, "together", False])
def test_duplicate_constant_and_wildly_scaled_components(standardise):
    train, test = simulate(60, 60, seed=8), simulate(5, 30, seed=9)

    def worse(x):
        return np.concatenate(
            [x, x[:, :, :1], np.full_like(x[:, :, :1], 7.0), 1e9 * x + 1e9, 1e-9 * x[:, :, :1]], axis=2
        )

    unit = np.array([1, 1, 1, 1, 1e9, 1e9, 1e-9])
    with pytest.warns(UserWarning, match=r"observations \[3\] do not vary"):
        full = InstrumentalVariableRegression(n_future=3, standardise=standardise).fit(
            Sequences.from_observations(worse(train))
        )
    plain = InstrumentalVariableRegression(n_future=3).fit(Sequences.from_observations(train))
    expected = worse(predictions(plain, Sequences.from_observations(test)))
    found = predictions(full, Sequences.from_observations(worse(test)))
    # nothing depends on units but what counts as rounding; 1e9 + 1e9 x loses a digit
    np.testing.assert_allclose(found / unit, expected / unit, atol=1e-6)
    assert full.predict_variance(full.initial_belief())[0, 3] == 0
    assert full.rank_ == plain.rank_ == 6
    reduced = clone(full).set_params(rank=3)
    with pytest.warns(UserWarning, match="do not vary"):
        reduced.fit(Sequences.from_observations(worse(train)))
    found = predictions(reduced, Sequences.from_observations(worse(test)))
    error = np.square((found - worse(test)) / unit).mean()
    assert error < 1.1 * np.square((expected - worse(test)) / unit).mean()


def test_a_ridge_shrinks_to_the_mean_and_serves_few_data():
    data = Sequences.from_observations(simulate(3, 25, seed=2))
    test = Sequences.from_observations(simulate(100, 40, seed=1))
    filters = [
        InstrumentalVariableRegression(n_future=3, ridge=ridge).fit(data) for ridge in (0.0, 0.03, 1e9)
    ]
    errors = [f.errors(test).mean for f in filters]
    assert errors[1] < 0.95 * errors[0]  # 51 windows for 12 numbers
    np.testing.assert_allclose(filters[2].system_matrices_.observation, 0.0, atol=1e-6)


def test_a_batch_is_its_trajectories_one_by_one():
    x = [row[: 20 + 5 * i] for i, row in enumerate(simulate(8, 80, seed=7))]
    data = Sequences.from_episodes(x)
    model = InstrumentalVariableRegression(rank=3).fit(data)
    whole, errors = model.beliefs(data), model.errors(data, horizon=8)
    for i, one in enumerate(data):
        np.testing.assert_allclose(whole[i : i + 1], model.beliefs(one), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(errors.by_episode[i], model.errors(one).mean, rtol=1e-10)


def test_an_unstable_filter_is_told_and_bounded():
    x = simulate(1, 60, seed=0)
    data = Sequences.from_observations(x)
    model = InstrumentalVariableRegression(n_future=3, n_past=3)
    with pytest.warns(UserWarning, match="the filter of rank 6 is unstable"):
        model.fit(data)
    assert np.abs(np.linalg.eigvals(model.transition_matrix)).max() > 1
    with pytest.warns(DivergenceWarning, match="kept inside"):
        beliefs = model.beliefs(Sequences.from_observations(simulate(3, 500, seed=1)))
    assert (np.abs(beliefs) <= model._bound).all()
    futures = np.stack([x[0, t : t + 3].ravel() for t in range(59)])
    mean = np.stack([x[0, 3 + j : 58 + j].mean(axis=0) for j in range(3)]).ravel()  # after a complete past
    scale = np.tile(model._scale.scale, 3)
    np.testing.assert_allclose(model._bound, 3 * np.abs((futures - mean) / scale).max(axis=0), rtol=1e-9)


def test_short_trajectories_are_told():
    x = simulate(4, 60, seed=7)
    data = Sequences.from_episodes([x[0], x[1], x[2], x[3, :8]])
    with pytest.warns(UserWarning, match=r"1 of 4 trajectories have fewer than n_past \+ n_future \+ 1 = 10"):
        InstrumentalVariableRegression(n_future=3, rank=3).fit(data)
    with pytest.raises(
        ValueError, match=r"at least n_past \+ n_future \+ 1 = 10 observations, got 1 of at most 8"
    ):
        InstrumentalVariableRegression(n_future=3).fit(data[3])
    with pytest.warns(UserWarning, match="9 windows for a regression on 12 numbers"):
        InstrumentalVariableRegression(n_future=3, rank=1).fit(Sequences.from_observations(x[:1, :18]))


def test_a_higher_rank_than_the_data_have_is_told():
    data = Sequences.from_observations(oscillations())
    with pytest.warns(
        UserWarning, match="rank: asked for 7, but in these data the past predicts 4 directions"
    ):
        assert InstrumentalVariableRegression(rank=7).fit(data).rank_ == 4


def test_parameters_are_checked_and_cloned():
    data = Sequences.from_observations(simulate(5, 60))
    for parameters, message in [
        ({"n_future": 0}, "expected n_future to be a whole number of at least 1"),
        ({"n_past": 0}, "expected n_past to be a whole number of at least 1"),
        ({"rank": 0}, "expected rank to be a whole number of at least 1"),
        ({"rank": 11}, r"expected rank of at most n_future \* 2 observations that vary = 10, got 11"),
        ({"ridge": -1.0}, "expected ridge finite and at least 0"),
        ({"belief_limit": 0}, "expected belief_limit above 0"),
        ({"standardise": "no"}, "expected standardise to be one of"),
    ]:
        with pytest.raises(ValueError, match=message):
            InstrumentalVariableRegression(**parameters).fit(data)
    with (
        pytest.warns(UserWarning, match="do not vary"),
        pytest.raises(ValueError, match="that vary, got const"),
    ):
        InstrumentalVariableRegression().fit(Sequences.from_observations(np.ones((3, 30, 2))))
    with pytest.warns(UserWarning, match="1 windows"), pytest.raises(ValueError, match="predict later ones"):
        InstrumentalVariableRegression().fit(Sequences.from_observations(simulate(1, 15)))  # one window
    model = InstrumentalVariableRegression(rank=range(1, 4), ridge=0.01, belief_limit=5.0)
    twin = clone(model)
    assert twin.get_params() == model.get_params()
    np.testing.assert_array_equal(
        twin.fit(data, data).transition_matrix, model.fit(data, data).transition_matrix
    )
