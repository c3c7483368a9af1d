"""PSIM against Algorithm 4 in plain loops and against the Kalman filter, and what every filter promises its users."""

import pickle

import numpy as np
import pytest
from by_hand import RidgeOfAll, poison_empty
from sklearn.base import clone
from sklearn.ensemble import GradientBoostingRegressor
from sklearn.linear_model import LinearRegression
from sklearn.neighbors import KNeighborsRegressor

import beliefgym.learning.psim as psim_module
import beliefgym.learning.psim_pairs as pairs_module
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences

LENGTHS = (9, 4, 2, 12, 7, 11, 8, 5)
KEPT = []  # the regressor of every hypothesis, as `Keeping` notes them


class Keeping(Ridge):
    """Notes the model of each iteration, of which PSIM itself keeps only the best."""

    def frozen(self):
        KEPT.append(super().frozen())
        return KEPT[-1]


def saturating(n=None, n_steps=12, seed=0, lengths=None, noise=0.3):
    """A turning, pushed system, of which a bent and a straight component are observed with noise."""
    lengths = (n_steps,) * n if lengths is None else lengths
    rng = np.random.default_rng(seed)
    n, n_steps = len(lengths), max(lengths)
    s = np.empty((n, n_steps + 1, 2))
    s[:, 0] = rng.normal(size=(n, 2))
    for t in range(n_steps):
        turned = s[:, t] @ np.array([[0.9, 0.5], [-0.5, 0.9]]).T
        s[:, t + 1] = np.tanh(turned) + 0.3 * rng.normal(size=(n, 2))
    x = np.stack([s[:, :, 0] + 0.5 * s[:, :, 1] ** 2, 3.0 + 2.0 * s[:, :, 1]], axis=2)
    return Sequences.from_observations(x + noise * rng.normal(size=x.shape), lengths=lengths)


class Linear:
    """z -> A' z + b."""

    def __init__(self, A, b):
        self.A, self.b = A, b

    def __call__(self, z):
        return z @ self.A + self.b


def ridge_by_lstsq(alpha):
    """The minimiser of 1/W sum_i w_i |A' z_i + b - y_i|^2 + alpha |A|^2, by an augmented least-squares problem."""

    def learn(X, Y, w):
        x, y, root = np.average(X, axis=0, weights=w), np.average(Y, axis=0, weights=w), np.sqrt(w)[:, None]
        rows = np.vstack([root * (X - x), np.sqrt(w.sum() * alpha) * np.eye(X.shape[1])])
        right = np.vstack([root * (Y - y), np.zeros((X.shape[1], Y.shape[1]))])
        A = np.linalg.lstsq(rows, right, rcond=None)[0]
        return Linear(A, y - x @ A)

    return learn


def by_scikit_learn(regressor):
    """A regressor without sums, on the whole aggregate."""

    def learn(X, Y, w):
        fitted = clone(regressor).fit(X, Y)
        return lambda z: fitted.predict(z[None])[0]

    return learn


def algorithm_4(
    train,
    *,
    learn,
    k,
    n_iterations,
    init,
    features="first",
    discount=1.0,
    limit=np.inf,
    n_past=None,
    standardise=True,
):
    """Algorithm 4, line by line: a growing list D, every trajectory and every step for itself.

    Returns:
        for n = 0 .. N: F_n, its beliefs (a list of arrays), |D_n|, the mean filter error.
    """
    episodes = [e["observations"] for e in train.to_episodes()]
    rows = np.concatenate(episodes)
    if standardise:
        episodes = [(x - rows.mean(axis=0)) / rows.std(axis=0) for x in episodes]
    futures = [[x[t : t + k].ravel() for t in range(len(x) - k + 1)] for x in episodes]
    phi = [[np.array(f) for f in one] for one in futures]
    if features == "second":
        squares = np.square(np.concatenate(futures))
        mean, std = squares.mean(axis=0), squares.std(axis=0)
        phi = [[np.concatenate([f, (f**2 - mean) / std]) for f in one] for one in futures]
    m_1 = np.mean([one[0] for one in phi], axis=0)
    bound = limit * np.abs(np.concatenate(phi)).max(axis=0)
    D = []

    def learn_from(pairs):
        X, Y, w = (np.array(column) for column in zip(*pairs, strict=True))
        return learn(X, Y, w)

    if init == "prior":
        F = Linear(np.zeros((len(m_1) + rows.shape[1], len(m_1))), m_1)
    elif init == "teacher":
        F = learn_from(
            [
                (np.concatenate([p[t], x[t]]), p[t + 1], 1.0)
                for x, p in zip(episodes, phi, strict=True)
                for t in range(len(p) - 1)
            ]
        )
    else:
        n_past = 2 * k if n_past is None else n_past
        pasts = []
        for x in episodes:
            before = np.vstack([np.zeros((n_past, x.shape[1])), x])  # row n_past + t is x_t
            pasts.append([before[t : t + n_past][::-1].ravel() for t in range(len(x))])
        first_stage = ridge_by_lstsq(1e-6)(
            np.array([past[t] for past, p in zip(pasts, phi, strict=True) for t in range(len(p))]),
            np.concatenate(phi),
            np.ones(sum(len(p) for p in phi)),
        )
        D = [
            (np.concatenate([first_stage(past[t]), x[t]]), p[t + 1], 1.0)
            for x, p, past in zip(episodes, phi, pasts, strict=True)
            for t in range(len(p) - 1)
        ]
        F = learn_from(D)
    found = []
    for n in range(n_iterations + 1):
        if n and discount < 1:
            D = [(z, f, w * discount) for z, f, w in D]
        size, beliefs, errors = len(D), [], []
        for x, p in zip(episodes, phi, strict=True):
            m, inside = [m_1], True
            for t in range(len(x) - 1):
                z = np.concatenate([m[t], x[t]])
                if inside and t + 1 < len(p):
                    D.append((z, p[t + 1], 1.0))
                following = F(z)
                inside = bool((np.abs(following) <= bound).all())
                m.append(np.clip(following, -bound, bound))
            beliefs.append(np.array(m))
            error = np.array(m)[1:, : x.shape[1]] - x[1:]
            errors.append(np.square(error).sum(axis=1).mean())
        found.append((F, beliefs, size, np.mean(errors)))
        F = learn_from(D)
    return found


@pytest.mark.parametrize("init", ["prior", "history", "teacher"])
@pytest.mark.parametrize("features", ["first", "second"])
@pytest.mark.parametrize(("k", "discount"), [(2, 1.0), (3, 0.5), (1, 0.9)])
@pytest.mark.filterwarnings("ignore:a belief of this PSIM left its bounds", "ignore:.* of 8 trajectories")
def test_it_is_algorithm_4_as_printed(init, features, k, discount):
    """Beliefs and coefficients of every iteration, with D_0 empty ("prior", "teacher") or not ("history")."""
    alpha, train, N = 1e-2, saturating(lengths=LENGTHS), 4
    del KEPT[:]
    settings = {"init": init, "features": features, "discount": discount}
    model = PSIM(Keeping(alpha=alpha), n_future=k, n_iterations=N, belief_limit=np.inf, **settings).fit(train)
    used = train[train.lengths >= k]
    literal = algorithm_4(used, learn=ridge_by_lstsq(alpha), k=k, n_iterations=N, **settings)
    first = 1 if init == "prior" else 0
    assert len(KEPT) == (N if init == "prior" else N + 1)
    chosen = model.model_
    for n in range(first, N + 1):
        F, beliefs, size, error = literal[n]
        ours = KEPT[n - first]
        # normal equations against a QR of the design: condition numbers below 1e4 at this alpha, squared, times 2e-16
        np.testing.assert_allclose(ours.coef_.T, F.A, rtol=0, atol=1e-8, err_msg=f"iteration {n}")
        np.testing.assert_allclose(ours.intercept_, F.b, rtol=0, atol=1e-8, err_msg=f"iteration {n}")
        model.model_ = ours
        found = model.beliefs(used)
        for i, expected in enumerate(beliefs):
            np.testing.assert_allclose(found[i, : len(expected)], expected, rtol=0, atol=1e-8)
        assert model.history_["train_error"][n] == pytest.approx(error, rel=1e-8)
        if n:
            assert model.history_["n_pairs"][n] == size
    assert model.history_["train_error"][0] == pytest.approx(literal[0][3], rel=1e-8)
    assert model.best_iteration_ == int(np.argmin([error for *_, error in literal]))
    if model.best_iteration_ or init != "prior":
        assert chosen is KEPT[model.best_iteration_ - first]
    # otherwise the comparison would say little
    assert np.abs(KEPT[-1].coef_ - KEPT[-2].coef_).max() > 1e-5


@pytest.mark.filterwarnings("ignore:a belief of this PSIM left its bounds")
def test_nothing_is_learned_from_beliefs_that_had_to_be_kept_inside():
    train = saturating(lengths=LENGTHS)
    del KEPT[:]
    model = PSIM(Keeping(alpha=1e-3), n_future=2, n_iterations=4, init="teacher", belief_limit=0.3).fit(train)
    literal = algorithm_4(train, learn=ridge_by_lstsq(1e-3), k=2, n_iterations=4, init="teacher", limit=0.3)
    everything = sum(length - 1 for length in LENGTHS)
    for n, (F, beliefs, size, _) in enumerate(literal):
        np.testing.assert_allclose(KEPT[n].coef_.T, F.A, rtol=0, atol=1e-8)
        model.model_ = KEPT[n]
        for i, expected in enumerate(beliefs):
            np.testing.assert_allclose(model.beliefs(train)[i, : len(expected)], expected, rtol=0, atol=1e-8)
        if n:
            assert model.history_["n_pairs"][n] == size < n * everything
    assert (model.history_["n_bounded"] > 0).all()


@pytest.mark.parametrize(
    "regressor", [LinearRegression(), KNeighborsRegressor(3)], ids=["linear", "neighbours"]
)
def test_it_is_algorithm_4_with_regressors_that_keep_no_sums(regressor):
    train = saturating(lengths=LENGTHS)
    model = PSIM(regressor, n_future=2, n_iterations=3, init="teacher", belief_limit=np.inf).fit(train)
    literal = algorithm_4(train, learn=by_scikit_learn(regressor), k=2, n_iterations=3, init="teacher")
    errors = [error for *_, error in literal]
    # the same regressor; rounding of the beliefs moves no neighbour
    np.testing.assert_allclose(model.history_["train_error"], errors, rtol=1e-9)
    np.testing.assert_array_equal(model.history_["n_pairs"][1:], [size for _, _, size, _ in literal[1:]])
    found = model.beliefs(train)
    for i, expected in enumerate(literal[model.best_iteration_][1]):
        np.testing.assert_allclose(found[i, : len(expected)], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("init", ["prior", "history", "teacher"])
@pytest.mark.parametrize("standardise", [True, "together", False])
def test_sums_and_a_stored_aggregate_give_the_same_filter(init, standardise):
    train, validation = saturating(20), saturating(5, seed=1)
    settings = {"n_future": 2, "n_iterations": 5, "init": init, "standardise": standardise}
    sums = PSIM(Ridge(alpha=1e-3), **settings).fit(train, validation)
    stored = PSIM(RidgeOfAll(alpha=1e-3), **settings).fit(train, validation)
    for name in sums.history_:
        if name != "seconds":
            np.testing.assert_allclose(sums.history_[name], stored.history_[name], rtol=1e-8, err_msg=name)
    assert sums.best_iteration_ == stored.best_iteration_
    np.testing.assert_allclose(sums.beliefs(validation), stored.beliefs(validation), rtol=0, atol=1e-8)


@pytest.mark.parametrize("n_kept", [1, 100])
@pytest.mark.parametrize("regressor", [Ridge(alpha=1e-3), RidgeOfAll()], ids=["sums", "stored"])
def test_how_many_pairs_wait_for_the_aggregate_does_not_matter(monkeypatch, n_kept, regressor):
    train = saturating(lengths=LENGTHS)
    model = PSIM(regressor, n_future=2, n_iterations=3)
    at_once = clone(model).fit(train)
    monkeypatch.setattr(pairs_module, "BUFFERED", n_kept)
    in_pieces = clone(model).fit(train)
    np.testing.assert_allclose(in_pieces.beliefs(train), at_once.beliefs(train), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(in_pieces.history_["n_pairs"], at_once.history_["n_pairs"])


@pytest.mark.parametrize(
    "regressor",
    [
        PolynomialRidge(degree=2, alpha=1e-3),
        RandomFourierRidge(n_frequencies=50, alpha=1e-3, include_inputs=True, random_state=0),
        RandomForest(n_estimators=10, random_state=0),
        GradientBoostingRegressor(n_estimators=20, random_state=0),
    ],
    ids=["polynomial", "fourier", "forest", "one target at a time"],
)
def test_any_regressor_makes_a_filter_better_than_the_mean(regressor):
    train, test = saturating(30), saturating(100, seed=1)
    model = PSIM(regressor, n_future=2, n_iterations=2).fit(train, saturating(10, seed=2))
    constant = np.square(test.observations - train.observations.mean(axis=(0, 1))).sum(axis=2).mean()
    assert model.errors(test).mean < 0.7 * constant  # a linear filter has 0.55


def turning_system():
    """Two turns that fade, 2 observations of 4 states; [C; C A] has a condition number of 3."""

    def turn(radius, angle):
        return radius * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    A = np.block([[turn(0.95, 0.6), np.zeros((2, 2))], [np.zeros((2, 2)), turn(0.9, 1.5)]])
    C = np.array([[1.0, 0.0, 0.3, 0.0], [-0.2, 0.0, 1.0, 0.0]])
    return LinearGaussianSystem(A, C, np.diag([0.1, 0.1, 0.3, 0.3]), 0.3 * np.eye(2))


def against_kalman(model, system, test):
    """Error ratio, mean square difference of one-step predictions (a share of the error), of the filter's
    eigenvalues, and of forecasts 12 ahead (a share of the observations' power)."""
    kalman = KalmanFilter.of(system)
    ratio = model.errors(test).mean / kalman.errors(test).mean
    ours, theirs = (
        np.stack([f.forecast(b, 12) for b in np.moveaxis(f.beliefs(test)[:, 1:-1], 1, 0)])
        for f in (model, kalman)
    )
    difference = np.square(ours - theirs).sum(axis=3).mean(axis=(0, 1))
    eigenvalues = [
        np.sort_complex(np.linalg.eigvals(M)) for M in (model.model_.coef_[:, :4], kalman.transition_matrix)
    ]
    return (
        ratio,
        difference[0] / kalman.errors(test).mean,
        np.abs(eigenvalues[0] - eigenvalues[1]).max(),
        difference[11] / kalman.errors(test).power,
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_on_a_linear_gaussian_system_it_becomes_the_kalman_filter(seed):
    """Errors fall as 1 / N: 1.003 times the Kalman filter's at 100 trajectories, 1.0002 at 2000."""
    system = turning_system()
    test = system.sample_innovations(200, 40, np.random.default_rng(99))
    found = []
    for n in (100, 2000):
        train = system.sample_innovations(n, 40, np.random.default_rng(seed))
        model = PSIM(Ridge(), n_future=2, n_iterations=10).fit(train, train[: n // 4])
        found.append(against_kalman(model, system, test))
    few, many = found
    assert 1.0 - 1e-3 < many[0] < 1.002  # the mean alone has 1.89
    assert many[0] < few[0]
    assert many[1] < 1e-3
    assert many[1] < 0.3 * few[1]
    assert many[2] < 0.04  # the eigenvalues are 0.5 and 0.7 from 0
    assert many[2] < few[2]
    assert many[3] < 1e-3
    assert many[3] < 0.3 * few[3]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_from_an_empty_aggregate_it_gets_there_too_with_more_iterations(seed):
    """What F_0, F_1, .. met stays in the aggregate, so that the way is long: measured 1.002 to 1.08, then 1.0004 to
    1.04."""
    system = turning_system()
    test = system.sample_innovations(200, 40, np.random.default_rng(99))
    train = system.sample_innovations(800, 40, np.random.default_rng(seed))
    short, long = (
        against_kalman(
            PSIM(Ridge(), n_future=2, n_iterations=n, init="prior").fit(train, train[:100]), system, test
        )
        for n in (10, 40)
    )
    assert 0.0 < long[0] - 1.0 < 0.7 * (short[0] - 1.0)
    assert long[1] < 0.7 * short[1]
    assert long[2] < 0.8 * short[2]


def random_features(futures):
    """A function of futures of the user's: 15 features."""
    flat = futures.reshape(len(futures), -1)
    return np.tanh(flat @ np.random.default_rng(5).normal(size=(flat.shape[1], 15)) / flat.shape[1] ** 0.5)


FILTERS = {
    "linear": PSIM(Ridge(alpha=1e-3), n_future=3, n_iterations=4),
    "second moments": PSIM(Ridge(alpha=1e-3), n_future=3, n_iterations=4, features="second"),
    "one ahead": PSIM(Ridge(alpha=1e-3), n_future=1, n_iterations=4, standardise="together"),
    "own features": PSIM(Ridge(alpha=1e-3), n_future=3, n_iterations=4, features=random_features),
    "fourier": PSIM(
        RandomFourierRidge(n_frequencies=30, alpha=1e-2, include_inputs=True, random_state=0),
        n_future=3,
        n_iterations=4,
        standardise=False,
    ),
    "forest": PSIM(RandomForest(n_estimators=5, random_state=0), n_future=2, n_iterations=2),
}


@pytest.fixture(scope="module", params=FILTERS)
def fitted(request):
    return clone(FILTERS[request.param]).fit(saturating(20), saturating(5, seed=1))


TEST = saturating(lengths=(10, 4, 0, 12, 1, 7), seed=2)


def test_a_batch_is_filtered_as_one_by_one(fitted):
    beliefs = fitted.beliefs(TEST)[:, 3]
    x = TEST.observations[:, 3]
    calls = {
        "update": lambda b, x: fitted.update(b, x),
        "predict_observation": lambda b, x: fitted.predict_observation(b),
        "forecast": lambda b, x: fitted.forecast(b, 7),
    }
    for name, call in calls.items():
        at_once = call(beliefs, x)
        singly = np.concatenate([call(beliefs[i : i + 1], x[i : i + 1]) for i in range(len(x))])
        # matrix products of one row and of six may round differently
        np.testing.assert_allclose(at_once, singly, rtol=0, atol=1e-11, err_msg=name)
    assert fitted.initial_belief(4).shape == (4, fitted.belief_size)


def test_whole_trajectories_are_filtered_as_by_updates(fitted):
    horizon, squared = 5, np.full((len(TEST), TEST.n_steps + 1, 5), np.nan)
    found = fitted.beliefs(TEST)
    for i, (x, length) in enumerate(zip(TEST.observations, TEST.lengths, strict=True)):
        belief = fitted.initial_belief()
        for t in range(length + 1):
            np.testing.assert_allclose(found[i, t], belief[0], rtol=0, atol=1e-11)
            ahead = fitted.forecast(belief, horizon)[0]
            np.testing.assert_allclose(fitted.predict_observation(belief)[0], ahead[0], rtol=0, atol=1e-12)
            for j in range(min(horizon, length + 1 - t)):
                squared[i, t, j] = np.square(ahead[j] - x[t + j]).sum()
            belief = fitted.update(belief, x[None, t])
        np.testing.assert_allclose(
            found[i, length + 1 :], np.tile(belief, (TEST.n_steps + 1 - length, 1)), atol=1e-11
        )
    errors = fitted.errors(TEST, horizon)
    np.testing.assert_allclose(errors.squared, squared, rtol=1e-9, atol=1e-11)
    going = [i for i, length in enumerate(TEST.lengths) if length]
    by_episode = [squared[i, 1 : TEST.lengths[i] + 1, 0].mean() for i in going]
    assert errors.mean == pytest.approx(np.mean(by_episode), rel=1e-9)
    last = [np.nanmean(squared[i, 1:, 4]) for i in going if TEST.lengths[i] >= 5]
    assert errors.by_look_ahead[4] == pytest.approx(np.mean(last), rel=1e-9)


def test_a_forecast_is_the_belief_and_then_its_own_predictions(fitted):
    k, n_obs, z = fitted.n_future, 2, fitted._scale
    belief = fitted.beliefs(TEST)[:, 2]
    if not callable(fitted.features):
        blocks = z.invert(belief[:, : k * n_obs].reshape(-1, k, n_obs))
        np.testing.assert_allclose(fitted.forecast(belief, k), blocks, rtol=0, atol=1e-12)
        np.testing.assert_allclose(fitted.predict_observation(belief), blocks[:, 0], rtol=0, atol=1e-12)
    expected, following = [*np.moveaxis(fitted.forecast(belief, k), 1, 0)], belief
    for _ in range(4):
        following = fitted.update(following, fitted.predict_observation(following))
        expected.append(fitted.forecast(following, k)[:, -1])
    for horizon in range(1, k + 5):
        found = fitted.forecast(belief, horizon)
        np.testing.assert_allclose(found, np.stack(expected[:horizon], axis=1), rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.filterwarnings("ignore:a belief of this PSIM left its bounds")
def test_what_lies_past_the_ends_never_matters(name):
    short = saturating(lengths=LENGTHS + LENGTHS)
    longer = np.concatenate([short.observations, np.full((16, 5, 2), 1e3)], axis=1)
    padded = Sequences.from_observations(longer, lengths=short.lengths)
    first, second = (clone(FILTERS[name]).set_params(n_future=2).fit(s, s) for s in (short, padded))
    np.testing.assert_array_equal(first.beliefs(short), second.beliefs(short))
    for key in set(first.history_) - {"seconds"}:
        np.testing.assert_allclose(first.history_[key], second.history_[key], rtol=1e-12, err_msg=key)
    found = [f.errors(s, 3).by_look_ahead for f, s in ((first, short), (second, padded))]
    np.testing.assert_allclose(*found, rtol=1e-12)  # means over arrays of other shapes


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.filterwarnings("error")
def test_nothing_is_read_before_it_is_written(monkeypatch, name):
    """`np.empty` gives whatever stood in memory; here that is 1e200, whose square is infinite."""
    train = saturating(lengths=LENGTHS + LENGTHS)
    model = clone(FILTERS[name]).set_params(n_future=2)
    clean = clone(model).fit(train, train)
    poison_empty(monkeypatch)
    again = clone(model).fit(train, train)
    np.testing.assert_array_equal(again.history_["train_error"], clean.history_["train_error"])
    np.testing.assert_array_equal(again.errors(train, 4).squared, clean.errors(train, 4).squared)


@pytest.mark.parametrize("stored", [False, True])
def test_new_trajectories_join_the_aggregate_through_the_last_hypothesis(stored):
    """One more turn of Algorithm 4's loop: D of `fit`, and what F_N meets on the new trajectories."""
    old, new, N, alpha = saturating(lengths=LENGTHS), saturating(lengths=(6, 9, 1, 12), seed=3), 3, 1e-2
    regressor = RidgeOfAll(alpha) if stored else Ridge(alpha=alpha)
    model = PSIM(
        regressor, n_future=2, n_iterations=N, init="teacher", standardise=False, belief_limit=np.inf
    )
    model.fit(old)
    n_pairs = model._learner.n_pairs
    assert n_pairs == model.history_["n_pairs"][-1] == N * sum(length - 1 for length in LENGTHS)
    pairs = []

    def learn(X, Y, w):
        pairs.append((X, Y))
        return ridge_by_lstsq(alpha)(X, Y, w)

    literal = algorithm_4(old, learn=learn, k=2, n_iterations=N, init="teacher", standardise=False)
    F, m_1 = literal[N][0], literal[N][1][0][0]
    (X, Y), D = pairs[N], []
    for e in new.to_episodes():
        x, m = e["observations"], m_1
        for t in range(len(x) - 2):
            z = np.concatenate([m, x[t]])
            D.append((z, x[t + 1 : t + 3].ravel()))
            m = F(z)
    X, Y = np.concatenate([X, [z for z, _ in D]]), np.concatenate([Y, [f for _, f in D]])
    expected = ridge_by_lstsq(alpha)(X, Y, np.ones(len(X)))
    model.partial_fit(new)
    assert model._learner.n_pairs == n_pairs + len(D) == n_pairs + sum((5, 8, 0, 11))
    inputs = np.random.default_rng(0).normal(size=(20, 6))
    np.testing.assert_allclose(model.model_.predict(inputs), expected(inputs), rtol=0, atol=1e-8)


@pytest.mark.parametrize("algorithm", ["follow_the_leader", "online_gradient"])
@pytest.mark.filterwarnings("ignore:a belief of this PSIM left its bounds")
def test_it_gets_better_with_trajectories_that_come_later(algorithm):
    test = saturating(200, seed=9)
    model = PSIM(Ridge(alpha=1e-3), n_future=2, n_iterations=3, algorithm=algorithm, step_size=0.5)
    before = model.fit(saturating(3)).errors(test).mean
    for seed in range(1, 11):
        model.partial_fit(saturating(20, seed=seed))
    best = PSIM(Ridge(alpha=1e-3), n_future=2, n_iterations=3).fit(saturating(203, seed=11)).errors(test).mean
    assert model.errors(test).mean - best < 0.5 * (before - best)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_online_gradient_descent_improves_on_its_first_hypothesis(seed):
    model = PSIM(
        Ridge(alpha=1e-3),
        n_future=2,
        init="prior",
        n_iterations=20,
        algorithm="online_gradient",
        step_size=1.0,
    )
    errors = model.fit(saturating(50, seed=seed), saturating(50, seed=seed + 10)).history_["validation_error"]
    assert model.best_iteration_ > 1
    assert errors[model.best_iteration_] < 0.75 * errors[0]  # all of Algorithm 4 gets to 0.55 to 0.6
    assert errors[model.best_iteration_] < errors[1]


def test_what_forgetting_and_gradients_need_is_told():
    train = saturating(5)
    with pytest.raises(TypeError, match=r"linear in features .* with discount 0.5, got RandomForest"):
        PSIM(RandomForest(n_estimators=2), n_future=2, n_iterations=2, discount=0.5).fit(train)
    with pytest.raises(TypeError, match="linear in features .* for 'online_gradient', got RandomForest"):
        PSIM(RandomForest(n_estimators=2), n_future=2, n_iterations=2, algorithm="online_gradient").fit(train)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"n_future": 0}, "n_future to be a whole number of at least 1, got 0"),
        ({"n_future": 2.0}, "n_future to be a whole number of at least 1, got 2.0"),
        ({"n_iterations": 0}, "n_iterations to be a whole number of at least 1, got 0"),
        ({"n_past": 0}, "n_past to be a whole number of at least 1, got 0"),
        ({"discount": 0.0}, r"discount in \(0, 1\], got 0.0"),
        ({"discount": 1.1}, r"discount in \(0, 1\], got 1.1"),
        ({"init": "zeros"}, "init to be one of .'history', 'teacher', 'prior'., got 'zeros'"),
        ({"features": "third"}, "features to be 'first', 'second' or a function .* got 'third'"),
        ({"algorithm": "sgd"}, "algorithm to be one of .*follow_the_leader.*, got 'sgd'"),
        ({"standardise": "each"}, "standardise to be one of .*, got 'each'"),
        ({"belief_limit": 0.0}, "belief_limit above 0, got 0.0"),
        ({"algorithm": "online_gradient", "step_size": -1.0}, "step_size finite and above 0, got -1.0"),
        ({"regressor": Ridge(alpha=-1.0)}, "alpha finite and at least 0, got -1.0"),
    ],
)
def test_parameters_out_of_range_are_told(parameters, message):
    with pytest.raises(ValueError, match=message):
        PSIM(**{"n_future": 2, "n_iterations": 2, **parameters}).fit(saturating(4))


def test_the_filter_that_is_best_on_validation_trajectories_is_kept():
    train, validation = saturating(4), saturating(30, seed=1)
    del KEPT[:]
    model = PSIM(Keeping(alpha=1e-4), n_future=4, n_iterations=8, standardise=False).fit(train, validation)
    history = model.history_
    assert set(history) == set(psim_module.HISTORY)
    assert all(values.shape == (9,) for values in history.values())
    np.testing.assert_array_equal(history["iteration"], np.arange(9))
    assert model.best_iteration_ == np.argmin(history["validation_error"])
    assert model.best_iteration_ != np.argmin(history["train_error"])  # else the choice would show nothing
    assert model.model_ is KEPT[model.best_iteration_]
    assert model.errors(validation).mean == pytest.approx(history["validation_error"].min(), rel=1e-12)
    assert model.errors(train).mean == pytest.approx(history["train_error"][model.best_iteration_], rel=1e-12)
    alone = clone(model).fit(train)
    np.testing.assert_array_equal(alone.history_["train_error"], history["train_error"])
    assert np.isnan(alone.history_["validation_error"]).all()
    assert alone.best_iteration_ == np.argmin(history["train_error"])


def test_the_aggregates_error_is_that_of_the_hypothesis_on_what_it_was_fitted_to():
    train = saturating(lengths=LENGTHS)
    settings = {"n_future": 2, "n_iterations": 3}
    pairs = []

    def learn(X, Y, w):
        pairs.append((X, Y))
        return ridge_by_lstsq(1e-3)(X, Y, w)

    literal = algorithm_4(train, learn=learn, k=2, n_iterations=3, init="history")
    model = PSIM(Ridge(alpha=1e-3), belief_limit=np.inf, **settings).fit(train)
    for n in (1, 2, 3):
        X, Y = pairs[n]
        error = np.square(literal[n][0](X) - Y).sum(axis=1).mean() ** 0.5
        assert model.history_["aggregate_error"][n] == pytest.approx(error, rel=1e-8)


@pytest.mark.parametrize("name", FILTERS)
def test_it_is_a_scikit_learn_estimator(name):
    model = FILTERS[name]
    before = model.get_params()
    copied = clone(model)
    assert {k: repr(v) for k, v in copied.get_params().items()} == {k: repr(v) for k, v in before.items()}
    train = saturating(6)
    copied.set_params(n_iterations=2, n_future=2).fit(train)
    assert len(copied.history_["train_error"]) == 3
    assert copied.get_params()["n_future"] == 2
    again = pickle.loads(pickle.dumps(copied))
    np.testing.assert_array_equal(again.beliefs(train), copied.beliefs(train))
    np.testing.assert_array_equal(again.errors(train, 3).squared, copied.errors(train, 3).squared)
    twice = clone(copied).fit(train)
    np.testing.assert_array_equal(twice.beliefs(train), copied.beliefs(train))
    refitted = copied.fit(saturating(6, seed=4)).fit(train)  # no trace of the data before
    np.testing.assert_array_equal(refitted.beliefs(train), twice.beliefs(train))
    assert not hasattr(model, "model_")
    assert model.get_params() == before


def test_parameters_of_the_regressor_can_be_set_through_the_filter():
    model = PSIM(Ridge(alpha=1.0)).set_params(regressor__alpha=1e-3, n_future=2)
    assert model.regressor.alpha == 1e-3
    assert model.get_params()["regressor__alpha"] == 1e-3
    with pytest.raises(ValueError, match="Invalid parameter 'horizon'"):
        model.set_params(horizon=3)
