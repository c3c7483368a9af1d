"""Subspace identification: the system, its steady-state Kalman filter, and data of every bad kind."""

import numpy as np
import pytest
from by_hand import eigenvalue_error, predictions
from scipy.linalg import solve_discrete_are
from sklearn.base import clone

from beliefgym.learning import Sequences
from beliefgym.learning import subspace_identification as module
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.subspace_identification import N4SID
from beliefgym.learning.window_projections import window_triangle

ROTATION = 0.9 * np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
A = np.block([[ROTATION, np.zeros((2, 1))], [np.zeros((1, 2)), np.full((1, 1), 0.6)]])
C = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -1.0]])
Q = np.diag([0.3, 0.2, 0.4])
R = np.diag([0.2, 0.3])
WEIGHTINGS = ["n4sid", "cva"]


def simulate(n, length, seed=0, a=A, c=C, q=Q, r=R, burn_in=100):
    """Stationary trajectories of s' = A s + w, x = C s + v."""
    rng = np.random.default_rng(seed)
    state, rows = np.zeros((n, len(a))), []
    for t in range(burn_in + length + 1):
        if t >= burn_in:
            rows.append(state @ c.T + rng.normal(size=(n, len(c))) @ np.sqrt(r))
        state = state @ a.T + rng.normal(size=(n, len(a))) @ np.sqrt(q)
    return np.stack(rows, axis=1)


def kalman(x, a=A, c=C, q=Q, r=R):
    """Predictions (n, n_rows, d) of the stationary Kalman filter, A - K C and the innovations' covariance."""
    p = solve_discrete_are(a.T, c.T, q, r)
    s = c @ p @ c.T + r
    gain = a @ p @ c.T @ np.linalg.inv(s)
    state, rows = np.zeros((len(x), len(a))), []
    for t in range(x.shape[1]):
        rows.append(state @ c.T)
        state = state @ a.T + (x[:, t] - rows[-1]) @ gain.T
    return np.stack(rows, axis=1), a - gain @ c, s


def spectral_radius(matrix):
    return np.abs(np.linalg.eigvals(matrix)).max()


def oscillations(n=20, length=60, seed=0):
    """Noise-free sums of two oscillations about 5, in three components: four states."""
    rng, t = np.random.default_rng(seed), np.arange(length + 1)
    sizes, phases = rng.normal(size=(n, 2, 1)), rng.uniform(0, 6, size=(n, 2, 1))
    waves = sizes * np.cos(np.array([[0.3], [0.7]]) * t + phases)
    return np.einsum("nft,fd->ntd", waves, np.random.default_rng(5).normal(size=(2, 3))) + 5.0


def book(x, n, i):
    """A, C, K of one trajectory from Hankel matrices and pseudo-inverses, unweighted."""
    columns = np.stack([x[t : t + 2 * i].ravel() for t in range(len(x) - 2 * i + 1)], axis=1)
    columns = columns - columns.mean(axis=1, keepdims=True)
    d = x.shape[1]
    past, later = columns[: i * d], columns[d : (i + 1) * d]
    now, future = columns[i * d : (i + 1) * d], columns[i * d :]
    _, _, v = np.linalg.svd(future @ np.linalg.pinv(past) @ past, full_matrices=False)
    to_state = v[:n] @ np.linalg.pinv(past)
    state, both = to_state @ past, np.concatenate([to_state @ later, now])
    coefficients = both @ np.linalg.pinv(state)
    rest = both - coefficients @ state
    noise = rest @ rest.T
    a, c = coefficients[:n], coefficients[n:]
    p = solve_discrete_are(a.T, c.T, noise[:n, :n], noise[n:, n:], s=noise[:n, n:])
    return a, c, (a @ p @ c.T + noise[:n, n:]) @ np.linalg.inv(c @ p @ c.T + noise[n:, n:])


def test_the_system_is_that_of_hankel_matrices_and_pseudo_inverses():
    x = simulate(1, 400)[0]
    model = N4SID(n_states=3, n_block_rows=4, standardise=False).fit(Sequences.from_observations(x[None]))
    a, c, gain = book(x, 3, 4)
    found = model.system_matrices_
    # what does not depend on the states' coordinates; 1e-10 of the variances is added to the noise before K
    for power in range(4):
        np.testing.assert_allclose(
            found.observation @ np.linalg.matrix_power(found.transition, power) @ found.gain,
            c @ np.linalg.matrix_power(a, power) @ gain,
            atol=1e-7,
        )
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(found.transition)), np.sort_complex(np.linalg.eigvals(a)), atol=1e-9
    )


def test_eigenvalues_are_those_of_nfoursid():
    nfoursid = pytest.importorskip("nfoursid.nfoursid")
    import pandas

    x = simulate(1, 3000, seed=1)[0]
    table = pandas.DataFrame(x, columns=["a", "b"])
    other = nfoursid.NFourSID(table, output_columns=["a", "b"], num_block_rows=7)
    other.subspace_identification()
    rivals = other.system_identification(rank=3)[0].a
    transitions = [
        N4SID(n_states=3, n_block_rows=7, weighting=weighting)
        .fit(Sequences.from_observations(x[None]))
        .system_matrices_.transition
        for weighting in WEIGHTINGS
    ]
    # it does not centre the windows and drops others at the series' end: some 1e-4
    assert eigenvalue_error(transitions[0], rivals) < 1e-3
    for transition in (rivals, *transitions):
        assert eigenvalue_error(transition, A) < 0.03  # 1 / sqrt(3000) is 0.02


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_the_filter_approaches_the_stationary_kalman_filter(weighting):
    x = simulate(200, 200, seed=2)
    model = N4SID(n_states=3, weighting=weighting).fit(Sequences.from_observations(x))
    test = simulate(100, 60, seed=3)
    expected, closed, covariance = kalman(test)
    found = predictions(model, Sequences.from_observations(test))
    # 40,000 steps for 15 numbers: relative errors of 1e-2, and as much of an innovation in the predictions
    assert eigenvalue_error(model.system_matrices_.transition, A) < 0.02
    assert eigenvalue_error(model.transition_matrix, closed) < 0.04
    assert np.square(found - expected).sum(axis=2).mean() < 1e-3 * np.trace(covariance)
    ratio = np.square(found - test).sum(axis=2).mean() / np.square(expected - test).sum(axis=2).mean()
    assert ratio < 1.001
    variance = model.predict_variance(model.initial_belief(2))
    np.testing.assert_allclose(variance, np.tile(np.diag(covariance), (2, 1)), rtol=0.02)  # 40,000 samples
    scale = model._scale.scale
    np.testing.assert_allclose(
        model.system_matrices_.innovation_covariance * np.outer(scale, scale), covariance, atol=0.02
    )


def test_errors_shrink_with_data():
    test = simulate(100, 60, seed=3)
    expected = kalman(test)[0]
    gaps = []
    for n in (5, 50, 500):
        model = N4SID(n_states=3).fit(Sequences.from_observations(simulate(n, 80, seed=4)))
        found = predictions(model, Sequences.from_observations(test))
        gaps.append(np.square(found - expected).sum(axis=2).mean())
    assert gaps[0] > 4 * gaps[1] > 16 * gaps[2]  # as 1/n, which is 10, with room for chance


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_validation_finds_the_order(weighting):
    train, validation = simulate(200, 100, seed=5), simulate(200, 100, seed=6)
    model = N4SID(n_states=[1, 2, 3, 5, 8], n_block_rows=7, weighting=weighting)
    model.fit(Sequences.from_observations(train), Sequences.from_observations(validation))
    errors = model.errors_by_rank_
    assert model.n_states_ == model.belief_size == 3
    assert sorted(errors) == [1, 2, 3, 5, 8]
    alone = N4SID(n_states=3, n_block_rows=7, weighting=weighting).fit(Sequences.from_observations(train))
    assert errors[3] == alone.errors(Sequences.from_observations(validation)).mean
    assert alone.errors_by_rank_ == {}
    assert errors[8] < 1.001 * errors[3]  # more states than there are do no harm
    assert model.singular_values_[2] > 3 * model.singular_values_[3]


def test_without_orders_a_grid_is_tried():
    data = Sequences.from_observations(simulate(20, 60, seed=5))
    model = N4SID(n_block_rows=8).fit(data)
    assert list(model.errors_by_rank_) == [*range(1, 13), 15]  # 8 * 2 = 16 is the most
    assert model.errors_by_rank_[model.n_states_] == min(model.errors_by_rank_.values())


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("n_states", [4, [2, 3, 4, 6]])
def test_without_noise_predictions_become_exact(weighting, n_states):
    data = Sequences.from_observations(oscillations())
    model = N4SID(n_states=n_states, weighting=weighting).fit(data[:15], data[15:])
    assert model.n_states_ == 4
    np.testing.assert_allclose(
        np.sort(np.angle(np.linalg.eigvals(model.system_matrices_.transition))),
        [-0.7, -0.3, 0.3, 0.7],
        atol=1e-10,
    )
    errors = model.errors(data[15:], horizon=5)
    # the filter forgets by 0.74 a step, squared and 60 times: 1e-15
    assert np.nanmax(errors.squared[:, 50:]) < 1e-10
    assert errors.by_time[0] > 0.1


def test_windows_cross_no_end_and_none_is_left_out():
    rng = np.random.default_rng(0)
    series = [rng.normal(size=(n, 2)) + 3 for n in (9, 4, 3, 12)]
    data = Sequences.from_episodes(series)
    with pytest.warns(UserWarning, match=r"1 of 4 trajectories have fewer than width = 4 observations"):
        triangle, n_windows = window_triangle(data.observations, data.lengths, 4, "width")
    rows = [np.concatenate([[1], x[t : t + 4].ravel()]) for x in series for t in range(len(x) - 3)]
    assert n_windows == len(rows) == 6 + 1 + 0 + 9
    np.testing.assert_allclose(triangle.T @ triangle, np.transpose(rows) @ rows / len(rows), atol=1e-13)


def test_blocks_of_windows_give_the_same_triangle(monkeypatch):
    data = Sequences.from_observations(simulate(10, 50))
    whole, _ = window_triangle(data.observations, data.lengths, 6, "width")
    monkeypatch.setattr("beliefgym.learning.window_projections.BLOCK_BYTES", 8 * 13 * 20)
    parts, _ = window_triangle(data.observations, data.lengths, 6, "width")
    np.testing.assert_allclose(np.abs(parts), np.abs(whole), atol=1e-12)


def test_padding_changes_nothing():
    x = [row[: 25 + 3 * i] for i, row in enumerate(simulate(30, 120, seed=7))]
    data = Sequences.from_episodes(x)
    longer = Sequences.concatenate([data, Sequences.from_observations(np.zeros((1, 300, 2)))])[:30]
    models = [N4SID(n_states=3).fit(d) for d in (data, longer)]
    # the same numbers in the same order
    for name in ("transition", "observation", "gain", "first", "innovation_covariance"):
        one, other = (getattr(m.system_matrices_, name) for m in models)
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(models[1]._bound, models[0]._bound, rtol=1e-9)


def test_canonical_variates_do_not_depend_on_coordinates():
    train, test = simulate(30, 60, seed=8), simulate(5, 30, seed=9)
    mix = np.array([[2e3, 1e3], [0.01, -0.03]])
    plain = N4SID(n_states=2, weighting="cva").fit(Sequences.from_observations(train))
    expected = predictions(plain, Sequences.from_observations(test)) @ mix.T + 7
    for standardise in (True, "together", False):
        model = clone(plain).set_params(standardise=standardise)
        model.fit(Sequences.from_observations(train @ mix.T + 7))
        found = predictions(model, Sequences.from_observations(test @ mix.T + 7))
        # condition 1e5 of the mixture, before rounding of 1e-16 and the noise's floor of 1e-10
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(mix).sum(axis=1).min())


@pytest.mark.parametrize("standardise", [True, "together", False])
def test_duplicate_constant_and_wildly_scaled_components(standardise):
    train, test = simulate(30, 60, seed=8), simulate(5, 30, seed=9)

    def worse(x):
        return np.concatenate(
            [x, x[:, :, :1], np.full_like(x[:, :, :1], 7.0), 1e9 * x + 1e9, 1e-9 * x[:, :, :1]], axis=2
        )

    plain = N4SID(n_states=3, weighting="cva").fit(Sequences.from_observations(train))
    expected = worse(predictions(plain, Sequences.from_observations(test)))
    with pytest.warns(UserWarning, match=r"observations \[3\] do not vary"):
        model = (
            clone(plain).set_params(standardise=standardise).fit(Sequences.from_observations(worse(train)))
        )
    found = predictions(model, Sequences.from_observations(worse(test)))
    unit = np.array([1, 1, 1, 1, 1e9, 1e9, 1e-9])
    # 1e9 + 1e9 x loses one digit, duplicates share the floor of the noise
    np.testing.assert_allclose(found / unit, expected / unit, atol=1e-5)
    assert (model.predict_variance(model.initial_belief())[0, 3]) == 0
    unweighted = N4SID(n_states=3, standardise=standardise)
    with pytest.warns(UserWarning, match="do not vary"):
        unweighted.fit(Sequences.from_observations(worse(train)))
    error = np.square(
        predictions(unweighted, Sequences.from_observations(worse(test))) / unit - worse(test) / unit
    )
    best = np.square(expected / unit - worse(test) / unit)
    assert error.mean() < 1.1 * best.mean()  # another weight of components; the same filter but for noise


def test_integrators_and_growing_data_give_stable_filters():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(20, 80, 2))
    walk = np.cumsum(noise, axis=1)
    growing = 1.1 ** np.arange(80)[:, None] * rng.normal(size=(20, 1, 2)) + noise
    for x in (noise, walk, np.cumsum(walk, axis=1), growing):
        for n in (1, 2, 4):
            model = N4SID(n_states=n, n_block_rows=5).fit(Sequences.from_observations(x))
            assert spectral_radius(model.transition_matrix) < 1
            assert np.isfinite(model.errors(Sequences.from_observations(x), 5).by_look_ahead).all()
    walker = N4SID(n_states=2, n_block_rows=5).fit(Sequences.from_observations(walk))
    # each component's best prediction is its last value: an error of 1
    assert walker.errors(Sequences.from_observations(walk)).mean < 1.05 * 2


def test_trajectories_that_start_alike_start_the_filter_there():
    start = np.array([4.0, 0.0, 3.0])
    rng = np.random.default_rng(0)
    state, rows = np.tile(start, (60, 1)), []
    for _ in range(40):
        rows.append(state @ C.T + 0.1 * rng.normal(size=(60, 2)))
        state = state @ A.T + 0.1 * rng.normal(size=(60, 3))
    data = Sequences.from_observations(np.stack(rows, axis=1))
    model = N4SID(n_states=3).fit(data[:40])
    # one trajectory more at the mean takes 1/41 of the way, the rest is A's error in so far a state
    np.testing.assert_allclose(model.predict_observation(model.initial_belief())[0], C @ start, rtol=0.12)
    by_time = model.errors(data[40:]).by_time
    assert by_time[0] < 0.5 < 58 == np.square(C @ start).sum()  # 58 from a start at 0
    assert by_time[1:].mean() < 0.1  # two innovations of 0.03 each


def test_a_batch_is_its_trajectories_one_by_one():
    x = [row[: 20 + 5 * i] for i, row in enumerate(simulate(8, 80, seed=7))]
    data = Sequences.from_episodes(x)
    model = N4SID(n_states=3).fit(data)
    whole, errors = model.beliefs(data), model.errors(data, horizon=3)
    for i, one in enumerate(data):
        np.testing.assert_allclose(whole[i : i + 1], model.beliefs(one), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(errors.by_episode[i], model.errors(one).mean, rtol=1e-10)


def test_a_forecast_is_the_powers_of_the_transition():
    data = Sequences.from_observations(simulate(5, 60, seed=7))
    model = N4SID(n_states=3, standardise=False).fit(data)
    belief = model.beliefs(data)[:, 30]
    m = model.system_matrices_
    for step, found in enumerate(np.moveaxis(model.forecast(belief, 6), 1, 0)):
        state = belief
        for _ in range(step):
            state = state @ m.transition.T + m.drift
        np.testing.assert_allclose(found, state @ m.observation.T + m.mean, atol=1e-10)


def test_outliers_are_bounded_and_told():
    data = Sequences.from_observations(simulate(10, 60, seed=7))
    model = N4SID(n_states=3).fit(data)
    with pytest.warns(DivergenceWarning, match="left its bounds"):
        belief = model.update(model.initial_belief(), np.full((1, 2), 1e6))
    largest = np.abs(model.beliefs(data)).max(axis=(0, 1))
    assert (np.abs(belief) <= 3 * largest * (1 + 1e-12)).all()


def test_short_trajectories_are_told():
    x = simulate(4, 60, seed=7)
    data = Sequences.from_episodes([x[0], x[1], x[2], x[3, :8]])
    with pytest.warns(UserWarning, match=r"1 of 4 trajectories have fewer than 2 n_block_rows = 12"):
        N4SID(n_states=2, n_block_rows=6).fit(data)
    with pytest.raises(ValueError, match="at least 2 n_block_rows = 12 observations, got 1 of at most 8"):
        N4SID(n_states=2, n_block_rows=6).fit(data[3])
    with pytest.warns(UserWarning, match="6 windows for a regression on 12 numbers"):
        N4SID(n_states=1, n_block_rows=6).fit(Sequences.from_observations(x[:1, :17]))


def test_more_states_than_the_data_have_are_told():
    data = Sequences.from_observations(oscillations())
    with pytest.warns(UserWarning, match="asked for 7, but in these data the past predicts 4 directions"):
        assert N4SID(n_states=7).fit(data).n_states_ == 4


def test_a_fallback_of_the_riccati_equation_is_told(monkeypatch):
    calls = []

    def fails_once(*args, **kwargs):
        calls.append(1)
        if len(calls) == 1:
            raise np.linalg.LinAlgError("no")
        return solve_discrete_are(*args, **kwargs)

    monkeypatch.setattr(module, "solve_discrete_are", fails_once)
    data = Sequences.from_observations(simulate(5, 60))
    with pytest.warns(UserWarning, match="no stabilising solution .* 1e-06 of the variances"):
        model = N4SID(n_states=3).fit(data)
    assert spectral_radius(model.transition_matrix) < 1
    monkeypatch.setattr(module, "solve_discrete_are", lambda *a, **k: np.full((3, 3), np.nan))
    with pytest.raises(ValueError, match=r"found no stable filter with \[3\] states"):
        model.fit(data)
    with pytest.raises(Exception, match="not fitted yet"):
        model.initial_belief()


def test_parameters_are_checked_and_cloned():
    data = Sequences.from_observations(simulate(5, 60))
    for parameters, message in [
        ({"n_block_rows": 0}, "expected n_block_rows to be a whole number of at least 1"),
        ({"n_states": 0}, "expected n_states to be a whole number of at least 1"),
        ({"n_states": [2, 1.5]}, "expected n_states to be a whole number of at least 1"),
        ({"n_states": 21}, r"expected n_states of at most n_block_rows \* 2 .* = 20, got 21"),
        ({"weighting": "moesp"}, "expected weighting to be one of"),
        ({"belief_limit": 0}, "expected belief_limit above 0"),
        ({"standardise": "no"}, "expected standardise to be one of"),
    ]:
        with pytest.raises(ValueError, match=message):
            N4SID(**parameters).fit(data)
    with (
        pytest.warns(UserWarning, match="do not vary"),
        pytest.raises(ValueError, match="that vary, got constants"),
    ):
        N4SID().fit(Sequences.from_observations(np.ones((3, 30, 2))))
    with (
        pytest.warns(UserWarning, match="1 windows"),
        pytest.raises(ValueError, match="predict later ones in some direction"),
    ):
        N4SID().fit(Sequences.from_observations(simulate(1, 19)))  # one window
    model = N4SID(n_states=range(1, 4), weighting="cva", belief_limit=5.0)
    twin = clone(model)
    assert twin.get_params() == model.get_params()
    np.testing.assert_array_equal(
        twin.fit(data, data).transition_matrix, model.fit(data, data).transition_matrix
    )
