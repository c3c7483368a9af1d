"""PSIM+Hints and the Inference Machine Filter: against the Kalman filter, Algorithm 5 line by line, and a pendulum."""

import pickle
from contextlib import nullcontext

import numpy as np
import pytest
from by_hand import eigenvalue_error
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from beliefgym.envs import Pendulum
from beliefgym.learning import Sequences
from beliefgym.learning.hint_autoregressive import AutoregressiveHints
from beliefgym.learning.hint_errors import HintErrors
from beliefgym.learning.hint_gaps import LEAST_ROWS, gap_growth
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim_hints import InferenceMachineFilter, PSIMHints
from beliefgym.learning.random_fourier import RandomFourierRidge

A = np.array([[0.88, 0.29, 0.1], [-0.29, 0.88, 0.0], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.2, -1.0, 0.0]])
Q = np.array([[0.2, 0.05, 0.0], [0.05, 0.1, 0.0], [0.0, 0.0, 0.3]])
R = np.array([[0.5, 0.1], [0.1, 0.2]])
# started with the covariance that its stationary filter predicts, so that this filter is the best from x_0 on
PREDICTED = LinearGaussianSystem(A, C, Q, R).stationary_gain().predicted_covariance
SYSTEM = LinearGaussianSystem(A, C, Q, R, initial_covariance=PREDICTED)
GAIN = PREDICTED @ C.T @ np.linalg.inv(C @ PREDICTED @ C.T + R)
# s_f' = A s_f + GAIN (x - C A s_f), of the filtered state s_f
CLOSED_LOOP = (np.eye(3) - GAIN @ C) @ A
LENGTHS = (9, 4, 2, 12, 7, 11, 8, 5)
KEPT = []  # the regressor of every hypothesis, as `Keeping` notes them


class Keeping(Ridge):
    """Notes the model of each iteration, of which the filter itself keeps only the best."""

    def frozen(self):
        KEPT.append(super().frozen())
        return KEPT[-1]


def sampled(n, n_steps=40, seed=0):
    """Trajectories whose hints are the states."""
    data = SYSTEM.sample(n, n_steps, np.random.default_rng(seed))
    return Sequences.from_observations(data.observations, hints=data.states)


def bent(n=None, n_steps=12, seed=0, lengths=None, garbage=0.0, padded=0):
    """A turning, pushed and bent system in units far from standard; the hints are its state, its observations partial.

    Args: garbage: what is given past an episode's end. padded: rows of it beyond the longest episode.
    """
    lengths = (n_steps,) * n if lengths is None else lengths
    rng = np.random.default_rng(seed)
    n, n_steps = len(lengths), max(lengths)
    s = np.empty((n, n_steps + 1, 2))
    s[:, 0] = rng.normal(size=(n, 2))
    for t in range(n_steps):
        turned = s[:, t] @ np.array([[0.9, 0.5], [-0.5, 0.9]]).T
        s[:, t + 1] = np.tanh(turned) + 0.3 * rng.normal(size=(n, 2))
    x = np.stack([s[:, :, 0] + 0.5 * s[:, :, 1] ** 2, 30.0 + 20.0 * s[:, :, 1]], axis=2)
    x = x + [0.3, 6.0] * rng.normal(size=x.shape)
    h = s * [1e-2, 1.0] + [100.0, 0.0]
    x, h = (np.pad(a, ((0, 0), (0, padded), (0, 0))) for a in (x, h))
    after = np.arange(x.shape[1]) > np.array(lengths)[:, None]
    x[after], h[after] = garbage, garbage
    return Sequences.from_observations(x, hints=h, lengths=lengths)


def swings(n, n_steps=60, seed=0):
    """Free pendulums, started anywhere but near upright; sin(theta) is seen, theta is the hint."""
    rng, system = np.random.default_rng(seed), Pendulum.uncontrolled(dt=0.05)
    state = rng.uniform(-1.0, 1.0, (n, 2)) * (0.9 * np.pi, 1.0) + (np.pi, 0.0)
    states = [state]
    for _ in range(n_steps):
        states.append(system.step(states[-1], np.zeros((n, 1)), np.zeros((n, system.noise_size))))
    angle = np.stack(states, axis=1)[:, :, :1]
    return Sequences.from_observations(np.sin(angle) + 0.01 * rng.standard_normal(angle.shape), hints=angle)


def known_estimates(data):
    """E[s_t | x_0 .. x_t] by the Kalman filter of the true system."""
    known = KalmanFilter.of(SYSTEM)
    beliefs = known.beliefs(data)
    return np.stack(
        [known.filter_state(beliefs[:, t], data.observations[:, t]) for t in range(data.n_steps + 1)], axis=1
    )


def step_by_step(fitted, x):
    """Estimates of one trajectory (T, n_obs) by the public calls: means and standard deviations (T, n_hint)."""
    belief, found = fitted.initial_belief(), []
    for row in x:
        belief = fitted.update(belief, row[None])
        found.append(fitted.predict_hint(belief))
    return np.array([e.mean[0] for e in found]), np.array([e.std[0] for e in found])


FILTERS = {
    "imf": InferenceMachineFilter(Ridge(alpha=1e-3), n_iterations=4, preimage=Ridge()),
    "futures": PSIMHints(Ridge(alpha=1e-3), n_future=3, n_iterations=4),
    "hints too": PSIMHints(Ridge(alpha=1e-3), n_future=2, n_hints=3, n_iterations=4, preimage="belief"),
    "second": PSIMHints(
        RandomFourierRidge(n_frequencies=20, include_inputs=True, alpha=1e-2, random_state=0),
        n_future=2,
        features="second",
        n_iterations=3,
        preimage=[Ridge(), Ridge(alpha=1.0)],
    ),
    "padded": PSIMHints(
        Ridge(alpha=1e-3), n_future=4, n_iterations=3, pad_end=True, hint_weight=2.0, preimage=Ridge()
    ),
}
each = pytest.mark.parametrize("name", FILTERS)
quiet = pytest.mark.filterwarnings("ignore:.* of 8 trajectories", "ignore:a belief of this")


def belief_of_state(fitted):
    """Mb with m_{t+1} = Mb s_f + constant in standardised coordinates: h_t, then C A^j s_f of each future."""
    rows = [np.eye(3) / fitted._hint_scale.scale[:, None]]
    for j in range(1, fitted.n_future + 1):
        rows.append(C @ np.linalg.matrix_power(A, j) / fitted._scale.scale[:, None])
    return np.vstack(rows)


@pytest.mark.parametrize("preimage", ["belief", Ridge()], ids=["belief", "ridge"])
@pytest.mark.parametrize("k", [0, 3])
def test_on_a_linear_gaussian_system_it_becomes_the_kalman_filter(k, preimage):
    """Every quantity of the filter of Eq. 3.43: estimates, errors, F itself and its eigenvalues."""
    make = PSIMHints(Ridge(), n_future=k, n_iterations=10, preimage=preimage)
    if not k:
        make = InferenceMachineFilter(Ridge(), n_iterations=10, preimage=preimage)
    test = sampled(200, seed=9)
    best = known_estimates(test)
    lowest = HintErrors(best - test.hints, np.ones_like(best)).mean
    distances = []
    for n in (25, 200, 1600):
        fitted = clone(make).fit(sampled(n))
        difference = fitted.estimate_hints(test).mean - best
        distances.append(np.sqrt(np.square(difference).mean()))
    # regression coefficients converge as 1/sqrt(n): each time a factor sqrt(8) = 2.8, with room for chance
    assert distances[1] < 0.7 * distances[0]
    assert distances[2] < 0.7 * distances[1]
    assert distances[2] < 0.02
    assert fitted.hint_errors(test).mean / lowest == pytest.approx(1.0, abs=0.01)
    lift = belief_of_state(fitted)
    F = fitted.model_.coef_
    down = np.linalg.pinv(lift)
    loop, gain = down @ F[:, : fitted.belief_size] @ lift, down @ F[:, fitted.belief_size :]
    # 64,000 pairs: standard errors of coefficients of about 1/sqrt(64000) = 0.004, times 3 for the conditioning of A's
    np.testing.assert_allclose(loop, CLOSED_LOOP, atol=0.03)
    np.testing.assert_allclose(gain / fitted._scale.scale, GAIN, atol=0.02)
    assert eigenvalue_error(loop, CLOSED_LOOP) < 0.05
    if not k:  # the whole belief, nothing left out
        assert eigenvalue_error(F[:, :3], CLOSED_LOOP) < 0.05


def test_given_standard_deviations_are_right_on_a_linear_gaussian_system():
    train, validation, test = sampled(200), sampled(100, seed=1), sampled(300, seed=2)
    deviation = np.sqrt(np.diag((np.eye(3) - GAIN @ C) @ PREDICTED))
    for make in (InferenceMachineFilter(Ridge()), PSIMHints(Ridge(), n_future=2, preimage="belief")):
        for unseen in (None, validation):
            fitted = clone(make).set_params(n_iterations=3).fit(train, unseen)
            errors = fitted.hint_errors(test)
            # 12,000 squares of little correlation: standard error 0.02 to 0.03
            np.testing.assert_allclose(errors.mean_squared_z, 1.0, atol=0.1)
            np.testing.assert_allclose(errors.coverage(0.9), 0.9, atol=0.03)
            np.testing.assert_allclose(fitted.estimate_hints(test).std.mean((0, 1)), deviation, rtol=0.06)


def ridge_by_lstsq(alpha, X, Y):
    """The minimiser of 1/n sum |A' z + b - y|^2 + alpha |A|^2 by an augmented least-squares problem: A, b."""
    x, y = X.mean(axis=0), Y.mean(axis=0)
    rows = np.vstack([X - x, np.sqrt(len(X) * alpha) * np.eye(X.shape[1])])
    right = np.vstack([Y - y, np.zeros((X.shape[1], Y.shape[1]))])
    A = np.linalg.lstsq(rows, right, rcond=None)[0]
    return A, y - x @ A


def algorithm_5(train, *, alpha, k, n_hints, init, n_iterations, weight, pad_end, squares, n_past):
    """Algorithm 5 line by line: lists, every trajectory and every step for itself.

    Returns:
        for n = 0 .. N: F_n, its beliefs m_0 .. (a list of arrays), |D_n|, the mean squared hint error.
    """
    episodes = train.to_episodes()
    xs, hs = [[np.array(e[name]) for e in episodes] for name in ("observations", "hints")]
    xs, hs = (
        [(one - np.concatenate(all).mean(axis=0)) / np.concatenate(all).std(axis=0) for one in all]
        for all in (xs, hs)
    )
    phis = []  # phi(h_0, x_{0:k-1}), then phi(h_t, x_{t+1:t+k}) of t = 0, 1, ..
    for x, h in zip(xs, hs, strict=True):
        last, phi = len(x) - 1, []
        for t in range(-1, last + 1):
            at = [max(t, 0) + i for i in range(n_hints)], [t + 1 + i for i in range(k)]
            if max([*at[0], *at[1]]) > last and not pad_end:
                break
            hints = [weight * h[min(i, last)] for i in at[0]]
            phi.append(np.concatenate([*hints, *(x[min(i, last)] for i in at[1])]))
        phis.append(np.array(phi))
    if squares:
        flat = np.square(np.concatenate(phis))
        mean, std = flat.mean(axis=0), flat.std(axis=0)
        phis = [np.hstack([phi, (phi**2 - mean) / std]) for phi in phis]
    m_0 = np.mean([phi[0] for phi in phis], axis=0)
    D = []
    if init == "teacher":
        first = [
            (np.concatenate([phi[t], x[t]]), phi[t + 1])
            for x, phi in zip(xs, phis, strict=True)
            for t in range(len(phi) - 1)
        ]
    else:
        pasts = []
        for x, phi in zip(xs, phis, strict=True):
            before = np.vstack([np.zeros((n_past, x.shape[1])), x])
            pasts.append([before[t : t + n_past][::-1].ravel() for t in range(len(phi))])
        A_1, b_1 = ridge_by_lstsq(1e-6, np.concatenate(pasts), np.concatenate(phis))
        first = D = [
            (np.concatenate([past[t] @ A_1 + b_1, x[t]]), phi[t + 1])
            for x, phi, past in zip(xs, phis, pasts, strict=True)
            for t in range(len(phi) - 1)
        ]
        D = list(first)
    F = ridge_by_lstsq(alpha, *map(np.array, zip(*first, strict=True)))
    found = []
    for _ in range(n_iterations + 1):
        size, beliefs, errors = len(D), [], []
        for x, h, phi in zip(xs, hs, phis, strict=True):
            m = [m_0]
            for t in range(len(x)):
                z = np.concatenate([m[t], x[t]])
                if t + 1 < len(phi):
                    D.append((z, phi[t + 1]))
                m.append(z @ F[0] + F[1])
            beliefs.append(np.array(m))
            errors.append(np.square(np.array(m)[1:, : h.shape[1]] / weight - h).sum(axis=1).mean())
        found.append((F, beliefs, size, np.mean(errors)))
        F = ridge_by_lstsq(alpha, *map(np.array, zip(*D, strict=True)))
    return found


@pytest.mark.parametrize("init", ["teacher", "history"])
@pytest.mark.parametrize(
    ("k", "n_hints", "weight", "pad_end", "features"),
    [
        (0, 1, 1.0, False, "first"),
        (3, 1, 1.0, False, "first"),
        (2, 4, 1.0, False, "first"),
        (2, 1, 3.0, True, "second"),
        (0, 2, 0.5, True, "first"),
        (0, 1, 1.0, False, "second"),
    ],
)
@quiet
def test_it_is_algorithm_5(init, k, n_hints, weight, pad_end, features):
    """Beliefs and coefficients of every iteration, on ragged trajectories."""
    alpha, N, train = 1e-2, 3, bent(lengths=LENGTHS)
    del KEPT[:]
    model = PSIMHints(
        Keeping(alpha=alpha),
        n_future=k,
        n_hints=n_hints,
        hint_weight=weight,
        pad_end=pad_end,
        features=features,
        init=init,
        n_iterations=N,
        belief_limit=np.inf,
        preimage="belief",
    ).fit(train)
    used = train if pad_end else train[train.lengths >= max(k, n_hints - 1)]
    literal = algorithm_5(
        used,
        alpha=alpha,
        k=k,
        n_hints=n_hints,
        init=init,
        n_iterations=N,
        weight=weight,
        pad_end=pad_end,
        squares=features == "second",
        n_past=2 * max(k, 5),
    )
    chosen = model.model_
    for n, (F, beliefs, size, error) in enumerate(literal):
        # normal equations against a QR of the design: condition numbers below 1e4 at this alpha, squared, times 2e-16
        np.testing.assert_allclose(KEPT[n].coef_.T, F[0], rtol=0, atol=1e-8, err_msg=f"iteration {n}")
        np.testing.assert_allclose(KEPT[n].intercept_, F[1], rtol=0, atol=1e-8, err_msg=f"iteration {n}")
        model.model_ = KEPT[n]
        found = model.beliefs(used)
        for i, expected in enumerate(beliefs):
            np.testing.assert_allclose(found[i, : len(expected)], expected, rtol=0, atol=1e-7)
        assert model.history_["train_error"][n] == pytest.approx(error, rel=1e-7)
        if n:
            assert model.history_["n_pairs"][n] == size
    assert model.best_iteration_ == int(np.argmin([error for *_, error in literal]))
    assert chosen is KEPT[model.best_iteration_]
    assert np.abs(KEPT[N].coef_ - KEPT[N - 1].coef_).max() > 1e-5  # otherwise the comparison would say little
    expected = np.concatenate(literal[model.best_iteration_][1])[:, :2] / weight
    model.model_ = chosen
    scale = train[used.lengths >= 0] if pad_end else used  # of what is learned from
    rows = scale.hints[scale.observation_mask]
    mean = np.concatenate(
        [e[: length + 1] for e, length in zip(model.estimate_hints(used).mean, used.lengths, strict=True)]
    )
    starts = np.concatenate([[0], np.cumsum(used.lengths + 2)[:-1]])
    expected = np.delete(expected, starts, axis=0) * rows.std(axis=0) + rows.mean(axis=0)
    np.testing.assert_allclose(mean, expected, rtol=1e-7)


def test_without_futures_the_last_observations_hint_is_learned_from():
    """Episodes of two observations, whose hint is 0, then twice the second one: a row less would leave nothing."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(50, 2, 2))
    x[:, :, 1] = [0.0, 1.0]  # tells which one it is
    h = np.zeros((50, 2, 1))
    h[:, 1] = 2.0 * x[:, 1, :1]
    x[:, 0, 0] = 0.0
    data = Sequences.from_observations(x, hints=h)
    for make in (
        InferenceMachineFilter(Ridge(alpha=1e-10), n_iterations=2, preimage="belief"),
        PSIMHints(Ridge(alpha=1e-10), n_future=1, n_iterations=2, pad_end=True, preimage="belief"),
    ):
        fitted = make.fit(data)
        assert fitted.hint_errors(data).mean < 1e-3
        # 50 episodes of two pairs each, of F_0 and of n = 0, 1
        np.testing.assert_array_equal(fitted.history_["n_pairs"][1:], [200, 300])
    changed = np.array(h)
    changed[:, 1] *= -1.0
    other = clone(fitted).fit(Sequences.from_observations(x, hints=changed))
    np.testing.assert_allclose(other.estimate_hints(data).mean, -fitted.estimate_hints(data).mean, atol=1e-3)


@pytest.mark.parametrize(("k", "n_hints"), [(0, 1), (3, 1), (5, 2), (1, 4), (20, 1)])
def test_with_padded_ends_every_step_of_ragged_trajectories_is_learned_from(k, n_hints):
    data = bent(lengths=(9, 4, 2, 12, 0, 1))
    settings = {"n_future": k, "n_hints": n_hints, "n_iterations": 1, "preimage": Ridge()}
    settings |= {"regressor": Ridge(alpha=1e-2), "belief_limit": np.inf}
    fitted = PSIMHints(**settings, pad_end=True).fit(data)
    every = data.n_transitions + len(data)
    assert fitted.history_["n_pairs"][1] == 2 * every
    if k == 20:
        return  # longer than any trajectory
    needed = max(k, n_hints - 1)
    with pytest.warns(UserWarning, match="nothing is learned") if needed else nullcontext():
        without = PSIMHints(**settings).fit(data)
    assert without.history_["n_pairs"][1] == 2 * np.maximum(data.lengths + 1 - needed, 0).sum()


@each
@quiet
def test_what_stands_past_an_episodes_end_never_matters(name):
    plain = clone(FILTERS[name]).fit(bent(lengths=LENGTHS), bent(lengths=LENGTHS, seed=3))
    other = clone(FILTERS[name]).fit(
        bent(lengths=LENGTHS, garbage=1e6, padded=17),
        bent(lengths=LENGTHS, seed=3, garbage=-1e6, padded=30),
    )
    test = bent(lengths=LENGTHS, seed=5, garbage=1e5, padded=3)
    ours, theirs = plain.estimate_hints(test), other.estimate_hints(test)
    # the same numbers, added in another order
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-8)
    np.testing.assert_allclose(ours.std, theirs.std, rtol=1e-6)
    assert np.isnan(ours.mean[~test.observation_mask]).all()
    assert np.isfinite(ours.mean[test.observation_mask]).all()
    assert plain.gap_growth_.shape == other.gap_growth_.shape
    np.testing.assert_allclose(plain.gap_growth_, other.gap_growth_, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(plain.hint_errors(test).mean, other.hint_errors(test).mean, rtol=1e-8)


@each
@quiet
def test_the_order_of_trajectories_does_not_matter(name):
    train, test = bent(lengths=LENGTHS), bent(lengths=LENGTHS, seed=5)
    fitted = clone(FILTERS[name]).fit(train)
    order = np.random.default_rng(0).permutation(len(train))
    other = clone(FILTERS[name]).set_params(preimage=Ridge()).fit(train[order])
    same = clone(FILTERS[name]).set_params(preimage=Ridge()).fit(train)  # folds do depend on the order
    halves = Sequences.concatenate([train[:3], train[3:]])
    np.testing.assert_allclose(
        other.estimate_hints(test).mean, same.estimate_hints(test).mean, rtol=1e-7, atol=1e-9
    )
    np.testing.assert_array_equal(
        clone(fitted).fit(halves).estimate_hints(test).mean, fitted.estimate_hints(test).mean
    )
    np.testing.assert_allclose(
        fitted.estimate_hints(test[order]).mean, fitted.estimate_hints(test).mean[order], rtol=1e-12
    )


@each
@quiet
def test_a_batch_is_its_trajectories_one_by_one(name):
    fitted = clone(FILTERS[name]).fit(bent(lengths=LENGTHS))
    test = bent(lengths=(9, 4, 0, 12, 1), seed=5)
    mean, std = fitted.estimate_hints(test)
    beliefs = fitted.beliefs(test)
    for i, length in enumerate(test.lengths):
        alone = step_by_step(fitted, test.observations[i, : length + 1])
        np.testing.assert_allclose(mean[i, : length + 1], alone[0], rtol=1e-9)
        np.testing.assert_allclose(std[i, : length + 1], alone[1], rtol=1e-8)
        np.testing.assert_allclose(
            fitted.predict_hint(beliefs[i, 1 : length + 2]).mean, alone[0], rtol=1e-9, atol=1e-12
        )
        assert np.isnan(mean[i, length + 1 :]).all()
        assert np.isnan(std[i, length + 1 :]).all()


@each
@quiet
def test_estimates_know_neither_the_future_nor_the_hints(name):
    fitted = clone(FILTERS[name]).fit(bent(lengths=LENGTHS))
    test = bent(6, seed=5)
    mean, std = fitted.estimate_hints(test)
    for t in (0, 5, 11):
        x = np.array(test.observations)
        x[:, t + 1 :] += np.random.default_rng(t).normal(size=x[:, t + 1 :].shape)
        changed = fitted.estimate_hints(Sequences.from_observations(x))
        np.testing.assert_array_equal(changed.mean[:, : t + 1], mean[:, : t + 1])
        np.testing.assert_array_equal(changed.std[:, : t + 1], std[:, : t + 1])
        assert (np.abs(changed.mean[:, t + 1] - mean[:, t + 1]) > 0).any()
    noise = np.random.default_rng(0).normal(size=(6, 13, 5))
    for hints in (None, noise):  # even of another width
        other = fitted.estimate_hints(Sequences.from_observations(test.observations, hints=hints))
        np.testing.assert_array_equal(other.mean, mean)
        np.testing.assert_array_equal(other.std, std)


def test_a_belief_over_the_future_sees_on_which_side_a_pendulum_is():
    """sin(theta) is the same above and below the horizontal: the thesis's point, Table 3.6."""
    train, test = swings(60), swings(60, seed=1)
    waves = RandomFourierRidge(n_frequencies=100, include_inputs=True, random_state=0)
    settings = {"n_iterations": 8, "preimage": waves}
    filters = {
        "futures": PSIMHints(waves, n_future=10, **settings),
        "imf": InferenceMachineFilter(waves, **settings),
        "window": AutoregressiveHints(waves, n_past=5),
    }
    errors = {name: filter.fit(train).hint_errors(test) for name, filter in filters.items()}
    # 0.13, 0.29 and 0.26 rad
    assert errors["futures"].mean < 0.7 * min(errors["imf"].mean, errors["window"].mean)
    assert errors["futures"].by_time[20:].mean() < 0.5 * errors["imf"].by_time[20:].mean()
    assert errors["futures"].by_time[20:].mean() < 0.5 * errors["window"].by_time[20:].mean()
    assert errors["futures"].by_time[20:].mean() < 0.12  # it knows more with time
    mean = filters["futures"].estimate_hints(test).mean[:, 20:]
    right = (np.cos(mean) > 0) == (np.cos(test.hints[:, 20:]) > 0)
    assert right.mean() > 0.95


def test_belief_and_hint_shapes():
    """n_hints hints, then n_future observations, then their squares."""
    train = bent(30)
    for k, n_hints, features, size in [
        (3, 3, "first", 12),
        (0, 3, "first", 6),
        (2, 1, "second", 12),
        (0, 1, "second", 4),
    ]:
        fitted = PSIMHints(
            Ridge(), n_future=k, n_hints=n_hints, features=features, n_iterations=1, preimage="belief"
        ).fit(train)
        assert fitted.belief_size == size
        assert fitted.initial_belief(3).shape == (3, size)
        assert fitted.beliefs(train).shape == (30, 14, size)
        estimate = fitted.estimate_hints(train)
        assert estimate.mean.shape == estimate.std.shape == (30, 13, 2)
        assert fitted.n_hint_ == 2
        assert fitted.model_.coef_.shape == (size, size + 2)


def test_hints_to_come_are_predicted_as_by_the_kalman_filter():
    """n_hints = 3: E[h_t], A E[h_t] and A^2 E[h_t] of what was seen."""
    train, test = sampled(400), sampled(100, seed=9)
    fitted = PSIMHints(Ridge(), n_future=1, n_hints=3, n_iterations=5, preimage="belief").fit(train)
    best = known_estimates(test)
    belief = fitted.beliefs(test)[:, 1:]
    for j in range(3):
        predicted = fitted._hint_scale.invert(belief[:, :, 3 * j : 3 * j + 3])
        # 16,000 pairs; deviations of the states about 1
        np.testing.assert_allclose(predicted, best @ np.linalg.matrix_power(A, j).T, atol=0.15)
    np.testing.assert_allclose(fitted.predict_observation(belief[:, 7]), best[:, 7] @ (C @ A).T, atol=0.2)


@pytest.mark.parametrize("k", [0, 3])
def test_the_weight_of_hints_does_not_move_a_linear_filter_without_penalty(k):
    train, test = sampled(50), sampled(20, seed=1)
    make = PSIMHints(Ridge(alpha=1e-13), n_future=k, n_iterations=3, preimage="belief")
    plain = clone(make).fit(train).estimate_hints(test)
    for weight in (0.1, 20.0):
        other = clone(make).set_params(hint_weight=weight).fit(train).estimate_hints(test)
        # a penalty of 1e-13 (times 400), against eigenvalues of about 1e-3 or more
        np.testing.assert_allclose(other.mean, plain.mean, atol=1e-5)
        np.testing.assert_allclose(other.std, plain.std, rtol=0.02)


def test_the_weight_of_hints_moves_a_filter_that_measures_distances():
    waves = RandomFourierRidge(n_frequencies=30, random_state=0)
    train = bent(30)
    make = PSIMHints(waves, n_future=4, n_iterations=1, preimage=Ridge())
    plain, other = (clone(make).set_params(hint_weight=w).fit(train) for w in (1.0, 5.0))
    assert np.abs(plain.estimate_hints(train).mean - other.estimate_hints(train).mean).max() > 1e-4


def test_second_moments_bring_the_variance_of_the_next_observation():
    """x is noise whose deviation the hint tells: 0.5 or 2, with both observed."""
    rng = np.random.default_rng(0)
    level = np.where(rng.random((300, 1, 1)) < 0.5, 0.5, 2.0)
    noise = level * rng.standard_normal((300, 31, 1))
    told = np.broadcast_to(level, noise.shape)
    data = Sequences.from_observations(np.concatenate([noise, told], axis=2), hints=told)
    fitted = PSIMHints(Ridge(), n_future=1, features="second", n_iterations=2, preimage="belief").fit(data)
    variance = fitted.predict_variance(fitted.beliefs(data)[:, -1])
    assert variance.shape == (300, 2)
    for this in (0.5, 2.0):
        np.testing.assert_allclose(variance[level[:, 0, 0] == this, 0].mean(), this**2, rtol=0.15)
    first = PSIMHints(Ridge(), n_future=1, n_iterations=1, preimage="belief").fit(data)
    none = InferenceMachineFilter(Ridge(), features="second", n_iterations=1, preimage="belief").fit(data)
    for without in (first, none):
        with pytest.raises(ValueError, match="expected features='second' and n_future of at least 1"):
            without.predict_variance(without.initial_belief())


def first_moments(hints, futures):
    return np.concatenate([hints.reshape(len(hints), -1), futures.reshape(len(futures), -1)], axis=1)


@pytest.mark.parametrize("k", [0, 2])
def test_a_function_that_gives_first_moments_is_first_moments(k):
    train, test = sampled(30), sampled(10, seed=1)
    make = PSIMHints(Ridge(alpha=1e-12), n_future=k, n_hints=2, n_iterations=2, preimage="belief")
    named, own = (clone(make).set_params(features=f).fit(train) for f in ("first", first_moments))
    # another scale, and a reading by regression: both only undo each other up to the noise of the regression
    np.testing.assert_allclose(own.estimate_hints(test).mean, named.estimate_hints(test).mean, atol=0.15)
    named, own = (one.set_params(preimage=Ridge()).fit(train) for one in (named, own))
    np.testing.assert_allclose(own.estimate_hints(test).mean, named.estimate_hints(test).mean, atol=1e-4)
    np.testing.assert_allclose(
        own.predict_observation(own.beliefs(test)[:, 5]),
        named.predict_observation(named.beliefs(test)[:, 5]),
        atol=0.3,
    )


def test_a_function_of_ones_own_gets_standardised_hints_and_futures():
    seen = []

    def function(hints, futures):
        seen.append((hints.copy(), futures.copy()))
        return np.concatenate([np.sin(hints[:, 0]), futures[:, 0], hints[:, 1] * hints[:, 0]], axis=1)

    data = bent(20)
    fitted = PSIMHints(Ridge(), n_future=3, n_hints=2, features=function, n_iterations=2, preimage=Ridge())
    assert fitted.fit(data).belief_size == 6
    hints, futures = seen[0]
    assert hints.shape[1:] == (2, 2)
    assert futures.shape[1:] == (3, 2)
    z, h = fitted._scale.apply(data.observations), fitted._hint_scale.apply(data.hints)
    # m_0's first, then those of t = 0 .. 9, of the first trajectory
    np.testing.assert_allclose(hints[0], h[0, :2], atol=1e-12)
    np.testing.assert_allclose(futures[0], z[0, :3], atol=1e-12)
    np.testing.assert_allclose(hints[1:11], [h[0, t : t + 2] for t in range(10)], atol=1e-12)
    np.testing.assert_allclose(futures[1:11], [z[0, t + 1 : t + 4] for t in range(10)], atol=1e-12)
    assert fitted.hint_errors(data).mean < np.linalg.norm(data.hints - data.hints.mean((0, 1)), axis=2).mean()
    assert fitted.forecast(fitted.beliefs(data)[:, 3], 5).shape == (20, 5, 2)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda h, f: h, r"gives \(\d+, d\), got \(\d+, 1, 2\)"),
        (lambda h, f: h[:0, 0], r"got \(0, 2\)"),
        (lambda h, f: h[:, 0] * np.nan, "expected finite numbers from the function"),
    ],
)
def test_a_function_that_answers_something_else_is_told(function, message):
    with pytest.raises(ValueError, match=message):
        PSIMHints(Ridge(), n_future=1, features=function).fit(bent(8))


def test_hints_from_states_are_those_of_hints():
    data = bent(20)
    names = ["angle", "speed"]
    states = Sequences.from_observations(
        data.observations, states=data.hints, hints=data.hints[:, :, :1] * 0.0 + 3.0, state_names=names
    )
    for make in (FILTERS["imf"], FILTERS["futures"]):
        ours = clone(make).fit(data)
        theirs = clone(make).set_params(hints_from="states").fit(states)
        np.testing.assert_array_equal(ours.estimate_hints(data).mean, theirs.estimate_hints(states).mean)
        np.testing.assert_array_equal(
            ours.hint_errors(data).difference, theirs.hint_errors(states).difference
        )
        assert theirs.hint_names_ == ("angle", "speed")
        assert ours.hint_names_ is None


def test_the_prior_is_that_of_the_first_hints():
    data = bent(20)
    fitted = clone(FILTERS["imf"]).fit(data)
    np.testing.assert_allclose(fitted.prior_mean_, data.hints[:, 0].mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(fitted.prior_std_, data.hints[:, 0].std(axis=0), rtol=1e-12)
    belief = fitted._hint_scale.invert(fitted.initial_belief())[0]
    np.testing.assert_allclose(belief, fitted.prior_mean_, rtol=1e-12)


def test_without_futures_observations_are_predicted_as_by_the_kalman_filter():
    train, test = sampled(400), sampled(50, seed=1)
    fitted = InferenceMachineFilter(Ridge(), n_iterations=5, preimage="belief").fit(train)
    known = KalmanFilter.of(SYSTEM)
    ours, theirs = fitted.beliefs(test)[:, 8], known.beliefs(test)[:, 8]
    predicted = fitted.predict_observation(ours)
    assert predicted.shape == (50, 2)
    np.testing.assert_allclose(
        predicted, known.predict_observation(theirs), atol=0.15
    )  # of deviations of 1 to 2
    ahead = fitted.forecast(ours, 6)
    np.testing.assert_allclose(ahead[:, 0], predicted, rtol=1e-12)
    np.testing.assert_allclose(ahead, known.forecast(theirs, 6), atol=0.25)
    # the second is the prediction of a belief that took the first for what came
    belief = fitted.update(ours, predicted)
    np.testing.assert_allclose(ahead[:, 1], fitted.predict_observation(belief), rtol=1e-9)
    assert fitted.errors(test).mean == pytest.approx(known.errors(test).mean, rel=0.01)


def test_with_futures_a_forecast_is_read_off_the_belief():
    train, test = sampled(400), sampled(50, seed=1)
    fitted = PSIMHints(Ridge(), n_future=3, n_iterations=5, preimage="belief").fit(train)
    belief = fitted.beliefs(test)[:, 8]
    read = fitted._scale.invert(belief[:, 3:].reshape(50, 3, 2))
    np.testing.assert_allclose(fitted.forecast(belief, 3), read, rtol=1e-12)
    known = KalmanFilter.of(SYSTEM)
    np.testing.assert_allclose(
        fitted.forecast(belief, 6), known.forecast(known.beliefs(test)[:, 8], 6), atol=0.25
    )


def test_how_much_a_gap_costs_is_that_of_the_estimates_a_gap_apart():
    """c_j by hand, on ragged trajectories; rows of padding do not change it, nor does one longer trajectory."""
    data = bent(lengths=(9, 4, 2, 12, 7, 11, 8, 5) * 4)
    fitted = clone(FILTERS["imf"]).fit(data)
    longest = max(j for j in range(1, 13) if np.maximum(data.lengths - j + 1, 0).sum() >= LEAST_ROWS)
    squares = [[] for _ in range(longest)]
    for one in data:
        L, beliefs = one.lengths[0], fitted.beliefs(one)[0]
        for start in range(L - longest + 1):
            belief = beliefs[start][None]
            for j in range(longest):
                belief = fitted.update(belief, fitted.predict_observation(belief))
                truth = one.hints[0, start + j]
                missed = fitted.predict_hint(belief).mean[0] - truth
                seen = fitted.predict_hint(beliefs[start + j + 1][None]).mean[0] - truth
                squares[j].append(np.square([missed, seen]))
    more = np.array([np.subtract(*np.mean(of_j, axis=0)) for of_j in squares])
    expected = np.maximum.accumulate(np.maximum(more, 0.0), axis=0)
    np.testing.assert_allclose(fitted.gap_growth_, expected, rtol=1e-8)
    assert longest == 10
    assert (expected[-1] > 0).all()
    padded = bent(lengths=(9, 4, 2, 12, 7, 11, 8, 5) * 4, garbage=1e3, padded=40)
    np.testing.assert_allclose(gap_growth(fitted, padded), expected, rtol=1e-8)
    with_longer = Sequences.concatenate([data, bent(1, 25)])
    assert len(gap_growth(fitted, with_longer)) >= longest
    np.testing.assert_array_equal(
        gap_growth(fitted, data[[2]]), np.zeros((1, 2))
    )  # three observations say nothing


@quiet
def test_the_validation_trajectories_choose_and_tell_how_sure_estimates_are():
    train, validation = bent(lengths=LENGTHS), bent(30, seed=1)
    fitted = InferenceMachineFilter(
        RandomFourierRidge(n_frequencies=50, random_state=0), n_iterations=8, preimage=Ridge()
    ).fit(train, validation)
    history = fitted.history_
    assert fitted.best_iteration_ == np.argmin(history["validation_error"])
    read = fitted.beliefs(validation)[:, 1:, :2] - fitted._hint_scale.apply(validation.hints)
    error = np.square(read).sum(axis=2).mean()
    assert history["validation_error"][fitted.best_iteration_] == pytest.approx(error, rel=1e-9)
    # by construction of sigma on these trajectories
    np.testing.assert_allclose(fitted.hint_errors(validation).mean_squared_z, 1.0, atol=0.2)
    assert (clone(fitted).fit(train).hint_errors(validation).mean_squared_z > 1.0).all()  # told: too small


def test_the_preimage_with_the_lowest_error_is_chosen():
    data = bent(30)
    bad = RandomFourierRidge(n_frequencies=5, bandwidth=1e-3, random_state=0)
    fitted = InferenceMachineFilter(Ridge(), n_iterations=2, preimage=[bad, Ridge(), Ridge(alpha=10.0)]).fit(
        data
    )
    assert set(fitted.preimage_errors_) == {"RandomFourierRidge", "Ridge 1", "Ridge 2"}
    assert min(fitted.preimage_errors_, key=fitted.preimage_errors_.get) == "Ridge 1"
    assert isinstance(fitted.preimage_, Ridge)
    assert fitted.preimage_.alpha == 1e-6
    assert set(PSIMHints(Ridge(), n_iterations=1).fit(data).preimage_errors_) == {
        "Ridge",
        "RandomFourierRidge",
    }


def test_any_scikit_learn_regressor_does():
    data = sampled(20)
    for k in (0, 2):
        fitted, ours = (
            PSIMHints(r, n_future=k, n_iterations=2, preimage=r).fit(data)
            for r in (LinearRegression(), Ridge(alpha=1e-13))
        )
        np.testing.assert_allclose(
            fitted.estimate_hints(data).mean, ours.estimate_hints(data).mean, atol=1e-5
        )
        np.testing.assert_allclose(
            fitted.forecast(fitted.beliefs(data)[:, 4], 4),
            ours.forecast(ours.beliefs(data)[:, 4], 4),
            atol=1e-3,
        )


@each
@quiet
def test_it_is_a_scikit_learn_estimator(name):
    model, train = FILTERS[name], bent(lengths=LENGTHS)
    before = repr(model.get_params())
    fitted = clone(model).fit(train)
    assert repr(clone(fitted).get_params()) == before == repr(model.get_params())
    assert not hasattr(model, "model_")
    again = pickle.loads(pickle.dumps(fitted))
    twice = clone(fitted).fit(train)
    refitted = clone(model).fit(bent(10, seed=4)).fit(train)  # no trace of the data before
    for other in (again, twice, refitted):
        for ours, theirs in zip(fitted.estimate_hints(train), other.estimate_hints(train), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(fitted.gap_growth_, other.gap_growth_)
        assert fitted.preimage_errors_ == other.preimage_errors_
    assert fitted.set_params(regressor__alpha=0.5).regressor.alpha == 0.5
    with pytest.raises(ValueError, match="Invalid parameter 'horizon'"):
        fitted.set_params(horizon=3)


def test_the_inference_machine_has_the_parameters_that_it_uses():
    parameters = InferenceMachineFilter().get_params()
    assert not {"n_future", "n_hints", "pad_end", "hint_weight"} & set(parameters)
    assert set(PSIMHints().get_params()) - set(parameters) == {
        "n_future",
        "n_hints",
        "pad_end",
        "hint_weight",
    }
    data = sampled(10)
    ours = InferenceMachineFilter(Ridge(), n_iterations=2, preimage=Ridge()).fit(data)
    theirs = PSIMHints(Ridge(), n_future=0, n_iterations=2, preimage=Ridge()).fit(data)
    np.testing.assert_array_equal(ours.estimate_hints(data).mean, theirs.estimate_hints(data).mean)


WRONG = [
    ({"n_future": -1}, ValueError, "expected n_future to be a whole number of at least 0, got -1"),
    ({"n_future": 2.0}, ValueError, "expected n_future to be a whole number of at least 0, got 2.0"),
    ({"n_hints": 0}, ValueError, "expected n_hints to be a whole number of at least 1, got 0"),
    ({"hint_weight": 0.0}, ValueError, "expected hint_weight finite and above 0, got 0.0"),
    ({"hint_weight": np.inf}, ValueError, "expected hint_weight finite and above 0, got inf"),
    ({"hints_from": "labels"}, ValueError, "expected hints_from to be 'hints' or 'states', got 'labels'"),
    ({"hints_from": "states"}, ValueError, r"expected .* with states, .*; pass states=\.\. to Sequences"),
    ({"preimage": "state"}, ValueError, "expected preimage as a regressor, several or 'belief', got 'state'"),
    ({"preimage": 3}, TypeError, "expected preimage as a regressor, several or 'belief', got 3"),
    ({"preimage": []}, TypeError, r"expected preimage as a regressor, several or 'belief', got \[\]"),
    ({"features": "third"}, ValueError, "expected features to be 'first', 'second' or a function of hints"),
    ({"n_iterations": 0}, ValueError, "expected n_iterations to be a whole number of at least 1"),
    ({"init": "random"}, ValueError, "expected init to be one of"),
    ({"discount": 0.0}, ValueError, r"expected discount in \(0, 1\]"),
    ({"standardise": "each"}, ValueError, "expected standardise to be one of"),
    ({"belief_limit": 0.0}, ValueError, "expected belief_limit above 0"),
    ({"n_past": 0}, ValueError, "expected n_past to be a whole number of at least 1"),
]


@pytest.mark.parametrize(("parameters", "error", "message"), WRONG, ids=[str(p) for p, *_ in WRONG])
def test_parameters_out_of_range_are_told(parameters, error, message):
    with pytest.raises(error, match=message):
        PSIMHints(**{"regressor": Ridge(), "n_future": 2, **parameters}).fit(bent(5))


def test_data_that_do_not_fit_are_told():
    data = bent(10)
    none = Sequences.from_observations(data.observations)
    wide = Sequences.from_observations(data.observations, hints=np.ones((10, 13, 3)))
    message = r"expected {} with hints, got .*; pass hints=\.\. to Sequences, or .* made with hint=True"
    for make in (FILTERS["imf"], FILTERS["futures"]):
        with pytest.raises(ValueError, match=message.format("training trajectories")):
            clone(make).fit(none)
        with pytest.raises(ValueError, match=message.format("validation")):
            clone(make).fit(data, none)
        with pytest.raises(ValueError, match="expected validation with 2 hints as in training, got 3"):
            clone(make).fit(data, wide)
        with pytest.raises(ValueError, match="expected validation with 2 observations as in training"):
            clone(make).fit(data, Sequences.from_observations(np.ones((2, 5, 1)), hints=np.ones((2, 5, 2))))
        with pytest.raises(TypeError, match="expected Sequences, got ndarray"):
            clone(make).fit(data.observations)
        fitted = clone(make).fit(data)
        with pytest.raises(ValueError, match="expected trajectories with 2 hints as in training, got 3"):
            fitted.hint_errors(wide)
        with pytest.raises(ValueError, match=message.format("trajectories")):
            fitted.hint_errors(none)
        with pytest.raises(ValueError, match="expected trajectories with 2 observations as at fit, got 1"):
            fitted.estimate_hints(Sequences.from_observations(data.observations[:, :, :1]))


def test_too_short_trajectories_are_told_with_what_helps():
    message = (
        r"at least max\(n_future, n_hints - 1\) \+ 1 = 5 observations, got 6 of at most 4; lower n_future or "
        r"n_hints, or pass pad_end=True"
    )
    for sizes in ({"n_future": 4}, {"n_future": 1, "n_hints": 5}):
        with pytest.raises(ValueError, match=message):
            PSIMHints(Ridge(), **sizes).fit(bent(6, 3))
        PSIMHints(Ridge(alpha=0.1), **sizes, pad_end=True, n_iterations=1, preimage=Ridge()).fit(bent(6, 3))
        PSIMHints(Ridge(alpha=0.1), **sizes, n_iterations=1, preimage=Ridge()).fit(bent(6, 4))
    with pytest.raises(ValueError, match="expected at least one step"):
        InferenceMachineFilter(Ridge()).fit(bent(6, 3)[:0])


@quiet
def test_short_trajectories_teach_the_filter_nothing_but_are_told():
    x = bent(lengths=(12,) * 20 + (1, 2))
    with pytest.warns(
        UserWarning, match=r"2 of 22 trajectories have fewer than max\(n_future, n_hints - 1\) \+ 1 = 4"
    ):
        fitted = clone(FILTERS["futures"]).fit(x)
    without = clone(FILTERS["futures"]).fit(x[:20])
    np.testing.assert_allclose(fitted.beliefs(x), without.beliefs(x), rtol=0, atol=1e-9)


def test_hints_that_do_not_vary_are_told_by_name():
    data = bent(10)
    hints = np.concatenate([np.full((10, 13, 1), 7.0), data.hints[:, :, 1:]], axis=2)
    data = Sequences.from_observations(data.observations, hints=hints, hint_names=["mass", "speed"])
    with pytest.warns(UserWarning, match=r"hints \['mass'\] do not vary in the training data"):
        fitted = clone(FILTERS["imf"]).fit(data)
    mean, std = fitted.estimate_hints(data)
    np.testing.assert_allclose(mean[:, :, 0], 7.0, atol=1e-9)
    assert (std[:, :, 0] < 1e-6).all()
    assert np.isfinite(std).all()


def test_calls_that_do_not_fit_are_told():
    model = clone(FILTERS["futures"])
    with pytest.raises(NotFittedError, match=r"not fitted yet; call fit\(train, validation\)"):
        model.predict_hint(np.zeros((1, 8)))
    with pytest.raises(NotFittedError):
        model.estimate_hints(bent(2))
    with pytest.raises(NotFittedError):
        model.hint_errors(bent(2))
    fitted = model.fit(bent(10))
    belief = fitted.initial_belief(2)
    with pytest.raises(ValueError, match=r"belief: expected shape \(n, 8\), got \(2, 7\)"):
        fitted.predict_hint(belief[:, :7])
    with pytest.raises(ValueError, match=r"belief: expected shape \(n, 8\), got \(8,\)"):
        fitted.predict_hint(belief[0])
    with pytest.raises(ValueError, match=r"observation: expected shape \(2, 2\), got \(1, 2\)"):
        fitted.update(belief, np.zeros((1, 2)))
    x = np.array([[0.0, 1.0], [np.nan, 1.0]])
    with pytest.raises(ValueError, match=r"got nan at index \(1, 0\); missing='predict' takes NaN"):
        fitted.update(belief, x)
    with pytest.raises(ValueError, match=r"observation: expected finite numbers, got inf at index \(0, 1\)"):
        fitted.update(belief, np.array([[0.0, np.inf], [np.nan, 1.0]]), missing="predict")
    with pytest.raises(ValueError, match="expected missing to be one of"):
        fitted.update(belief, x, missing="skip")
    with pytest.raises(ValueError, match=r"action: expected shape \(2, n_act\), got \(3, 1\)"):
        fitted.update(belief, np.zeros((2, 2)), np.zeros((3, 1)))
    for one in (fitted, clone(FILTERS["imf"]).fit(bent(10))):
        with pytest.raises(TypeError, match=rf"a {type(one).__name__} does not learn on, .*; fit anew, or"):
            one.partial_fit(bent(3))


def test_what_is_missing_is_taken_from_the_filters_own_prediction():
    fitted = clone(FILTERS["futures"]).fit(bent(20))
    belief = fitted.beliefs(bent(4, seed=1))[:, 5]
    x = np.array(bent(4, seed=1).observations[:, 5])
    expected = fitted.predict_observation(belief)
    partly = x.copy()
    partly[0], partly[1, 1] = np.nan, np.nan
    filled = np.where(np.isnan(partly), expected, x)
    np.testing.assert_allclose(
        fitted.update(belief, partly, missing="predict"),
        fitted.update(belief, filled),
        rtol=1e-10,
        atol=1e-12,
    )


def test_a_failed_fit_leaves_nothing_to_filter_with():
    data = bent(10)
    fitted = clone(FILTERS["futures"]).fit(data)
    for bad in (Sequences.from_observations(data.observations), bent(10, 2)):
        with pytest.raises(ValueError, match="expected"):
            fitted.fit(bad)
        with pytest.raises(NotFittedError):
            fitted.predict_hint(np.zeros((1, 8)))
        fitted.fit(data)
