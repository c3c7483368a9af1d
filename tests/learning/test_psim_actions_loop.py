"""PSIM+ACTIONS in plain loops with weights by hand, and where the weights or the actions say nothing."""

import numpy as np
import pytest
from by_hand import weighted_ridge
from controlled_systems import linear
from scipy.stats import norm
from sklearn.base import clone

from beliefgym.learning import Sequences
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_actions import PSIMActions

LENGTHS = (9, 4, 12, 7, 11, 8, 5)
IMPORTANCE = (None, "ordinary", "weighted")
KEPT = []  # the regressor of every hypothesis, as `Keeping` notes them


class Keeping(Ridge):
    """Notes the model of each iteration, of which the filter itself keeps only the best."""

    def frozen(self):
        KEPT.append(super().frozen())
        return KEPT[-1]


def by_hand(train, *, k, importance, per_decision, state, init, n_iterations, alpha, truncate=None):
    """Dataset aggregation with weights, line by line: a growing list, every trajectory and every step for itself.

    Returns:
        A, b and beliefs (a list of arrays) of F_0 .. F_N, and the share of effective samples of each observation.
    """
    rows, acts = train.observations[train.observation_mask], train.actions[train.step_mask]
    mu = norm(acts.mean(), acts.std())
    episodes = []
    for i, L in enumerate(train.lengths):
        x, a = train.observations[i, : L + 1], train.actions[i, :L]
        episodes.append(
            (
                (x - rows.mean(axis=0)) / rows.std(axis=0),
                (a - acts.mean(axis=0)) / acts.std(axis=0),
                mu.pdf(a[:, 0]) / np.exp(train.action_log_probs[i, :L]),
            )
        )
    joint = state == "joint"
    n_before = [
        *range(k),
        *(range(1, k + 1) if joint else []),
    ]  # actions that each part of phi has the weight of
    if not per_decision:
        n_before = [max(n_before)] * len(n_before)
    phi, w = [], []
    for x, u, ratio in episodes:
        times = range(len(x) - k + 1 - joint)
        phi.append([np.concatenate([x[t : t + k, 0], *([u[t : t + k, 0]] if joint else [])]) for t in times])
        w.append([np.array([np.prod(ratio[t : t + n]) for n in n_before]) for t in times])
    mean = np.mean(np.concatenate(w), axis=0)
    w = [[one / mean for one in each] for each in w]
    if truncate is not None:
        w = [[np.minimum(one, truncate) for one in each] for each in w]
        mean = np.mean(np.concatenate(w), axis=0)
        w = [[one / mean for one in each] for each in w]
    share = [c.sum() ** 2 / (len(c) * (c**2).sum()) for c in np.concatenate(w).T[:k]]
    if importance != "weighted":
        if importance == "ordinary":
            phi = [[p * one for p, one in zip(*each, strict=True)] for each in zip(phi, w, strict=True)]
        else:
            share = [1.0] * k
        w = [[np.ones(len(n_before)) for _ in each] for each in w]
    m_0 = np.average([p[0] for p in phi], axis=0, weights=[one[0] for one in w])
    D = []

    def start_with(states):
        for (x, u, _), p, one, s in zip(episodes, phi, w, states, strict=True):
            for t in range(len(p) - 1):
                D.append((np.concatenate([s[t], x[t], u[t]]), p[t + 1], one[t + 1]))

    if init == "history":
        pasts = []
        for x, u, _ in episodes:
            seen = np.vstack([np.zeros((2 * k, 2)), np.hstack([x[:-1], u])])
            pasts.append([seen[t : t + 2 * k][::-1].ravel() for t in range(len(x))])
        all_pasts = [past[t] for past, p in zip(pasts, phi, strict=True) for t in range(len(p))]
        guess, *_ = weighted_ridge(all_pasts, np.concatenate(phi), np.concatenate(w), 1e-6)
        start_with([[guess(one) for one in past] for past in pasts])
    elif init == "teacher":
        start_with(phi)
    if init == "prior":
        F, A, b = (lambda z: m_0), np.zeros((len(m_0), len(m_0) + 2)), m_0
    else:
        F, A, b = weighted_ridge(*zip(*D, strict=True), alpha)
    if init == "teacher":
        D = []
    found = []
    for _ in range(n_iterations + 1):
        beliefs = []
        for (x, u, _), p, one in zip(episodes, phi, w, strict=True):
            m = [m_0]
            for t in range(len(x) - 1):
                z = np.concatenate([m[t], x[t], u[t]])
                if t + 1 < len(p):
                    D.append((z, p[t + 1], one[t + 1]))
                m.append(F(z))
            beliefs.append(np.array(m))
        found.append((A, b, beliefs))
        F, A, b = weighted_ridge(*zip(*D, strict=True), alpha)
    return found, share


CASES = [
    *((importance, True, "observations", "history", None) for importance in IMPORTANCE),
    *((importance, False, "joint", "history", None) for importance in IMPORTANCE),
    ("weighted", True, "joint", "history", None),
    ("ordinary", True, "joint", "prior", 2.0),
    ("weighted", False, "observations", "prior", 2.0),
    ("weighted", True, "observations", "teacher", 1.5),
    (None, False, "observations", "teacher", None),
]


@pytest.mark.parametrize(("importance", "per_decision", "state", "init", "truncate"), CASES)
@pytest.mark.filterwarnings("ignore:.* futures carry the weight")
def test_it_is_dataset_aggregation_with_these_weights(importance, per_decision, state, init, truncate):
    """Coefficients and beliefs of every iteration, and of one more by `partial_fit`, which has no weights."""
    alpha, N, k = 1e-2, 3, 3
    train = linear(len(LENGTHS), max(LENGTHS), 0, feedback=0.4, mean=0.5, lengths=LENGTHS)
    del KEPT[:]
    settings = {"importance": importance, "per_decision": per_decision, "state": state, "init": init}
    settings["truncate"] = truncate
    model = PSIMActions(Keeping(alpha=alpha), n_future=k, n_iterations=N, belief_limit=np.inf, **settings)
    model.fit(train)
    literal, share = by_hand(train, k=k, n_iterations=N + 1, alpha=alpha, **settings)
    first = 1 if init == "prior" else 0
    assert len(KEPT) == N + 1 - first
    chosen = model.model_
    if importance is None:
        model.partial_fit(train)
    for n in range(first, N + 1 + (importance is None)):
        A, b, beliefs = literal[n]
        # normal equations against an SVD: condition numbers below 1e4 at this alpha, squared, times 2e-16
        np.testing.assert_allclose(KEPT[n - first].coef_, A, rtol=0, atol=1e-8, err_msg=f"iteration {n}")
        np.testing.assert_allclose(KEPT[n - first].intercept_, b, rtol=0, atol=1e-8)
        model.model_ = KEPT[n - first]
        found = model.beliefs(train)
        for i, expected in enumerate(beliefs):
            np.testing.assert_allclose(found[i, : len(expected)], expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(model.effective_samples_, share, rtol=1e-10)
    if model.best_iteration_ or init != "prior":
        assert chosen is KEPT[model.best_iteration_ - first]
    assert np.abs(KEPT[-1].coef_ - KEPT[-2].coef_).max() > 1e-5  # otherwise the comparison would say little


@pytest.mark.parametrize("importance", ["ordinary", "weighted"])
@pytest.mark.parametrize("state", ["observations", "joint"])
def test_where_the_policy_is_the_reference_weights_change_nothing(importance, state):
    """Log-probabilities that are all the same, as of a uniform policy, and the uniform reference."""
    blind = linear(20, 15, 0)
    data = Sequences(
        blind.observations, blind.actions, blind.rewards, action_log_probs=np.full((20, 15), -3.0)
    )
    plain = PSIMActions(n_future=3, n_iterations=3, state=state).fit(data, data)
    settings = {"importance": importance, "reference": "uniform", "per_decision": True}
    weighed = clone(plain).set_params(**settings).fit(data, data)
    # sums of products with weights of one, taken in another order
    np.testing.assert_allclose(weighed.beliefs(data), plain.beliefs(data), rtol=0, atol=1e-9)
    for name in set(plain.history_) - {"seconds", "aggregate_error"}:
        np.testing.assert_allclose(weighed.history_[name], plain.history_[name], rtol=1e-9, err_msg=name)
    np.testing.assert_allclose(weighed.effective_samples_, 1.0, rtol=1e-12)


def test_actions_that_never_change_make_it_a_filter_without():
    """In the standardisation they are 0, and so is what is learned of them."""
    still = linear(20, 15, 0)
    data = Sequences(still.observations, np.full((20, 15, 1), 3.7), still.rewards)
    model, psim = (one(n_future=2, n_iterations=3).fit(data) for one in (PSIMActions, PSIM))
    np.testing.assert_allclose(model.beliefs(data), psim.beliefs(data), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(model.model_.coef_[:, 3], [0.0, 0.0])
