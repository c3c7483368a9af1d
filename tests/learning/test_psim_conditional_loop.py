"""Conditional PSIM in plain loops: what actions change, the filter on what is left, and what they change once more."""

import numpy as np
import pytest
from by_hand import weighted_ridge
from controlled_systems import linear
from scipy.stats import norm

from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim_conditional import ConditionalPSIM

LENGTHS = (9, 4, 12, 7, 11, 8, 5)
KEPT = []


class Keeping(Ridge):
    """Notes the model of each iteration."""

    def frozen(self):
        KEPT.append(super().frozen())
        return KEPT[-1]


def by_hand(train, *, k, effects, importance, n_iterations, alpha, effect_ridge):
    """The stages line by line: what actions change, F_0 .. F_N on what is left, and the beliefs of each."""
    rows, acts = train.observations[train.observation_mask], train.actions[train.step_mask]
    mu = norm(acts.mean(), acts.std())
    xs, us, phi, w, pasts, codes = [], [], [], [], [], []
    for i, L in enumerate(train.lengths):
        x = (train.observations[i, : L + 1] - rows.mean(axis=0)) / rows.std(axis=0)
        a = train.actions[i, :L]
        u = (a - acts.mean(axis=0)) / acts.std(axis=0)
        ratio = mu.pdf(a[:, 0]) / np.exp(train.action_log_probs[i, :L])
        seen = np.vstack([np.zeros((2 * k, 2)), np.hstack([x[:-1], u])])
        times = range(L + 2 - k)
        xs.append(x), us.append(u)
        phi.append(np.array([x[t : t + k, 0] for t in times]))
        codes.append(np.array([u[t : t + k - 1, 0] for t in times]))
        w.append(np.array([[np.prod(ratio[t : t + i]) for i in range(k)] for t in times]))
        pasts.append(np.array([seen[t : t + 2 * k][::-1].ravel() for t in times]))
    ends = np.cumsum([len(p) for p in phi])[:-1]
    phi, codes, w, pasts = (np.concatenate(one) for one in (phi, codes, w, pasts))
    w = w / w.mean(axis=0) if importance else np.ones(w.shape)
    one = np.ones(w.shape)

    def inputs(states):
        """[u_j, u_j s] of each later action j."""
        if effects == "constant":
            return [codes[:, [j]] for j in range(k - 1)]
        return [np.hstack([codes[:, [j]], codes[:, [j]] * states]) for j in range(k - 1)]

    def regressed(states, beside, futures):
        found, acting = [], inputs(states)
        for i in range(1, k):
            X = np.hstack([*acting[:i], *beside])
            _, coefficients, _ = weighted_ridge(X, futures[:, [i]], w[:, [i]], effect_ridge)
            found.append(coefficients[0, : i * acting[0].shape[1]])
        return found

    guess, *_ = weighted_ridge(pasts, phi, one, 1e-6)
    s = np.array([guess(past) for past in pasts])
    first = regressed(s, [pasts], phi)
    for i in range(1, k):
        phi[:, i] -= np.hstack(inputs(s)[:i]) @ first[i - 1]
    guess, *_ = weighted_ridge(pasts, phi, one, 1e-6)
    s = np.array([guess(past) for past in pasts])
    phi_of, s_of = np.split(phi, ends), np.split(s, ends)
    m_0 = np.mean([p[0] for p in phi_of], axis=0)
    D = [
        (np.concatenate([guessed[t], x[t], u[t]]), p[t + 1])
        for x, u, p, guessed in zip(xs, us, phi_of, s_of, strict=True)
        for t in range(len(p) - 1)
    ]
    found = []
    for _ in range(n_iterations + 1):
        F, A_n, b_n = weighted_ridge(*zip(*D, strict=True), np.ones((len(D), k)), alpha)
        beliefs = []
        for x, u, p in zip(xs, us, phi_of, strict=True):
            m = [m_0]
            for t in range(len(x) - 1):
                z = np.concatenate([m[t], x[t], u[t]])
                if t + 1 < len(p):
                    D.append((z, p[t + 1]))
                m.append(F(z))
            beliefs.append(np.array(m))
        at = np.concatenate([m[: len(p)] for m, p in zip(beliefs, phi_of, strict=True)])
        futures = np.concatenate(
            [[x[t : t + k, 0] for t in range(len(p))] for x, p in zip(xs, phi_of, strict=True)]
        )
        found.append((A_n, b_n, beliefs, regressed(at, [], futures - at)))
    return found


@pytest.mark.parametrize("importance", [False, True])
@pytest.mark.parametrize("effects", ["constant", "bilinear"])
def test_it_is_its_stages_line_by_line(effects, importance):
    train, k, N = linear(len(LENGTHS), max(LENGTHS), 0, feedback=0.4, mean=0.5, lengths=LENGTHS), 3, 3
    del KEPT[:]
    settings = {"effects": effects, "importance": importance, "effect_ridge": 1e-2}
    model = ConditionalPSIM(Keeping(alpha=1e-2), n_future=k, n_iterations=N, belief_limit=np.inf, **settings)
    model.fit(train)
    literal = by_hand(train, k=k, n_iterations=N, alpha=1e-2, **settings)
    for n, (A_n, b_n, _, _) in enumerate(literal):
        # normal equations against an SVD; the regression on the past has a penalty of 1e-6 and few rows more than
        # regressors, with a condition number of about 1e3, squared
        np.testing.assert_allclose(KEPT[n].coef_, A_n, rtol=0, atol=1e-7, err_msg=f"iteration {n}")
        np.testing.assert_allclose(KEPT[n].intercept_, b_n, rtol=0, atol=1e-7)
    assert np.abs(KEPT[-1].coef_ - KEPT[-2].coef_).max() > 1e-5
    *_, beliefs, last = literal[model.best_iteration_]
    for i, expected in enumerate(beliefs):
        np.testing.assert_allclose(model.beliefs(train)[i, : len(expected)], expected, rtol=0, atol=1e-7)
    each = 1 if effects == "constant" else 1 + k
    assert model.effects_.shape == ((k - 1) * each, k)
    for i in range(k):
        own = last[i - 1] if i else []
        np.testing.assert_allclose(model.effects_[: i * each, i], own, rtol=0, atol=1e-7)
        np.testing.assert_array_equal(model.effects_[i * each :, i], 0.0)
