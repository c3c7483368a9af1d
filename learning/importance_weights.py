"""Importance weights: what a policy made of the actions' futures, taken out again.

A test tau = (x_t, a_t, .., x_{t+k-1}, a_{t+k-1}) comes with the probability g(tau^o | h, do(tau^a)) pi(tau | h), where

    pi(tau | h) = prod_i pi(a_{t+i} | h, x_t, a_t, .., x_{t+i}).                                           (Eq. 4.9)

Weighed by 1 / pi(tau | h) its expectation is one under the distribution G_h of Eqs. 4.12 to 4.14, in which the actions
are prescribed and do not look at the observations. Here the weight is

    w(tau) = mu(tau^a) / pi(tau | h),     mu(tau^a) = prod_i mu(a_{t+i}),

with a blind reference mu: "uniform" is the thesis's weight; "marginal" is a normal distribution with the mean and the
covariance of all recorded actions (of choices: their frequencies), which varies far less where the policy is not far
from blind. With it Z_h, which the thesis leaves as "likely very hard to compute", is known: for any prescribed actions
g sums to 1 over the observations, so that E_P[w | h] = sum_{tau^a} mu(tau^a) = 1 for every history. (With the thesis's
weight it is the number, or the volume, of the action sequences, and also the same for every h.) That needs a policy
which can take every action that mu takes. The thesis's weight is for choices and for actions within bounds: where a
policy's normal noise has none, 1 / pi has no finite mean. With "marginal" the weight of one action has a finite
variance while the variance of what was recorded is below 4/3 of the noise's.

What stands at the i-th place of a test depends on the actions before it alone, so that its weight may leave out the
later ones: per-decision weights (Precup, Sutton & Singh 2000),

    w_i = prod_{j < i} mu(a_{t+j}) / pi(a_{t+j} | ..).

Garbled in the thesis and put right: Table 4.1 and Eq. 4.9 index the last factors by i = 1 .. k with histories from x_t
on, which is the product above; in Table 4.1 "p(a_{t=1})" is a_{t+1}, and pi(a_{t+1} | h_t, x_t, x_t, ..) names x_t
twice.

References: thesis proposal, Sec. 4.2.1, Eqs. 4.7 to 4.14; Bowling, McCracken, James, Neufeld & Wilkinson, "Learning
predictive state representations using non-blind policies", ICML 2006; Precup, Sutton & Singh, "Eligibility traces for
off-policy policy evaluation", ICML 2000.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
Reference = Literal["marginal", "uniform"]
SINGULAR = (
    1e-10  # eigenvalue of the actions' correlations below which one of them is the others', to rounding
)


class BlindReference:
    """mu, up to a factor: log mu(a) of single actions.

    Args:
        kind: "marginal" or "uniform". actions: (n, n_act) recorded. n_choices: of a discrete action; None for numbers.

    Raises:
        ValueError: another kind; actions whose covariance is singular.
    """

    def __init__(self, kind: Reference, actions: Array, n_choices: int | None = None) -> None:
        if kind not in get_args(Reference):
            raise ValueError(f"expected reference to be one of {get_args(Reference)}, got {kind!r}")
        self.kind, self.n_choices = kind, n_choices
        if kind == "uniform":
            return
        if n_choices is not None:
            counts = np.bincount(actions[:, 0].astype(np.intp), minlength=n_choices)
            with np.errstate(divide="ignore"):
                self._log_frequencies: Array = np.log(counts / counts.sum())
            return
        self._mean = actions.mean(axis=0)
        each = Standardisation.of(actions)
        z = each.apply(actions)
        correlation = z.T @ z / len(z)
        if each.constant.any() or np.linalg.eigvalsh(correlation)[0] < SINGULAR:
            covariance = np.atleast_2d(np.cov(actions, rowvar=False, bias=True))
            raise ValueError(
                "expected actions that vary in every component, and not all together, for the reference 'marginal', "
                f"got the covariance {covariance.tolist()}; pass reference='uniform', or explore more widely"
            )
        root = each.scale[:, None] * np.linalg.cholesky(correlation)
        self._whitening, self._log_scale = np.linalg.inv(root), float(np.log(np.diag(root)).sum())

    def log_density(self, actions: Array) -> Array:
        """(n, n_act) -> (n,)."""
        if self.kind == "uniform":
            return np.zeros(len(actions))
        if self.n_choices is not None:
            return self._log_frequencies[actions[:, 0].astype(np.intp)]
        whitened = (actions - self._mean) @ self._whitening.T
        n_act = actions.shape[1]
        return -0.5 * np.square(whitened).sum(axis=1) - self._log_scale - 0.5 * n_act * np.log(2.0 * np.pi)


def log_ratios(sequences: Sequences, reference: BlindReference) -> Array:
    """log mu(a_t) - log pi(a_t | ..) of every step, 0 past an episode's end: (n_episodes, n_steps).

    Raises:
        ValueError: trajectories whose policy has left no log-probabilities.
    """
    log_probs = sequences.action_log_probs
    if log_probs is None:
        raise ValueError(
            f"expected trajectories with action_log_probs for importance weights, got {sequences!r}. Collect under a "
            "policy that tells them: random actions, GaussianPolicy or EpsilonPolicy around your own, or an agent with "
            "predict_with_log_prob and deterministic=False; or pass importance=None and explore without looking"
        )
    mask = sequences.step_mask
    ratios = np.zeros(mask.shape)
    ratios[mask] = reference.log_density(sequences.actions[mask]) - log_probs[mask]
    return ratios


def future_log_weights(ratios: Array, n_factors: int, n_rows: int) -> Array:
    """log w_i of the tests that start at each time: sums of the next i log-ratios.

    Args:
        ratios: (n, n_steps). n_factors: the largest i. n_rows: times.

    Returns:
        (n, n_rows, n_factors + 1), the i-th for what i actions lead to; the first is 0.
    """
    n, n_steps = ratios.shape
    summed = np.zeros((n, max(n_steps, n_rows) + n_factors + 1))
    summed[:, 1 : n_steps + 1] = np.cumsum(ratios, axis=1)
    summed[:, n_steps + 1 :] = summed[:, n_steps : n_steps + 1]
    start = np.arange(n_rows)[:, None]
    return summed[:, start + np.arange(n_factors + 1)] - summed[:, start]


def check_truncate(truncate: float | None) -> None:
    """Raise unless truncate is None or at least 1."""
    if truncate is not None and not truncate >= 1:
        raise ValueError(
            f"expected truncate as a multiple of the mean weight, at least 1, or None, got {truncate!r}"
        )


def normalised_weights(log_weights: Array, truncate: float | None) -> Array:
    """Weights of mean 1, none above `truncate` times the mean of before: (n,) -> (n,).

    Their mean is that of E_P[w] = 1, so that dividing by it is Z, estimated; with truncation the weights are brought
    to mean 1 anew.
    """
    weights = np.exp(log_weights - log_weights.max(initial=-np.inf))
    weights /= weights.mean()
    if truncate is not None:
        weights = np.minimum(weights, truncate)
        weights /= weights.mean()
    return weights


def effective_sample_share(weights: Array) -> float:
    """(sum w)^2 / (n sum w^2): 1 where all weigh the same, 1/n where one has all the weight (Kish 1965)."""
    return float(np.square(weights.sum()) / (len(weights) * np.square(weights).sum()))
