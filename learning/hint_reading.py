"""`HintReading`: how a hint is read off beliefs, and how sure of it one may be.

    g = argmin sum_{t, i} |g(m_{t+1}) - h_t|^2      over the beliefs of the training trajectories      (Eq. 3.42)

is a plain regression: what g answers never enters a belief. Of several regressors the one with the lowest error in
cross-validation over whole trajectories is taken.

The variance is a regression too. A filter linear in (m, x) cannot carry second moments (it takes the square of x), so
that they are not read off the belief but learned from residuals r_t = h_t - g(m_{t+1}) that g was not fitted to:

    log sigma^2(m) = w'[m, m^2] + b,     with w by ridge regression of log r^2, and b so that mean r^2 / sigma^2 = 1

where the penalty is that of the highest normal likelihood in cross-validation, an infinite one (a constant variance)
among them.

Reference: thesis proposal, Sec. 3.4.1, "Hint pre-image computation". The variance is this package's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.aggregation import learner_for, predict_unchecked
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.splits import fold_indices

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
N_FOLDS = 5
PENALTIES = (
    10.0,
    1.0,
    0.1,
    0.01,
)  # a sample, of standardised features; of the variance, beside a constant one
SMALLEST = 1e-6  # of the mean squared residual: what is added to each before the logarithm
LEAST_SQUARED = np.finfo(float).eps ** 2  # of standardised residuals: below it they are rounding
CLIPPED = 3.0  # standard deviations at which the features of the variance stop


class HintReading:
    """g and sigma, of standardised hints.

    Attributes:
        name: of the regressor that was chosen. errors: its and the others' root mean squared error in cross-validation,
            by name; empty where there was nothing to choose.
        model: g, fitted. variance: sigma^2, fitted.
    """

    name: str
    errors: dict[str, float]
    model: Any
    variance: ResidualVariance

    def fit(
        self,
        rows: Array,
        hints: Array,
        episode: Indices,
        candidates: Mapping[str, Any],
        unseen: tuple[Array, Array, Indices] | None = None,
    ) -> HintReading:
        """Choose and fit g, then sigma.

        Args:
            rows: (n, size) beliefs m_{t+1}. hints: (n, d) standardised h_t. episode: (n,) the trajectory of each.
            candidates: regressors by name.
            unseen: the same three of trajectories that nothing was fitted to; sigma then is that of their residuals,
                otherwise that of residuals in cross-validation.
        """
        names, residuals = list(candidates), {}
        self.errors = {}
        if len(names) > 1 or unseen is None:
            for name in names:
                residuals[name] = _out_of_fold(rows, hints, episode, candidates[name])
                self.errors[name] = float(np.sqrt(np.square(residuals[name]).sum(axis=1).mean()))
        self.name = min(self.errors, key=lambda name: self.errors[name]) if len(names) > 1 else names[0]
        self.model = fitted(candidates[self.name], rows, hints)
        if unseen is None:
            self.variance = ResidualVariance().fit(rows, np.square(residuals[self.name]), episode)
        else:
            others, truth, which = unseen
            residual = predict_unchecked(self.model, others, truth.shape[1]) - truth
            self.variance = ResidualVariance().fit(others, np.square(residual), which)
        return self

    def mean(self, rows: Array, d: int) -> Array:
        """(n, size) -> (n, d)."""
        return predict_unchecked(self.model, rows, d)


class ResidualVariance:
    """sigma^2 of the module's equation.

    Attributes:
        penalty: that was chosen; infinite for a constant variance.
        centre, spread: (2 size,) of the features. weights: (2 size, d). offset: (d,). low, high: (d,) bounds of
            log sigma^2, those of the rows it was fitted to.
    """

    penalty: float
    centre: Array
    spread: Array
    weights: Array
    offset: Array
    low: Array
    high: Array

    def fit(self, rows: Array, squared: Array, episode: Indices) -> ResidualVariance:
        """Learn from squared residuals.

        Args:
            rows: (n, size) beliefs. squared: (n, d). episode: (n,) the trajectory of each.
        """
        squared = np.maximum(squared, LEAST_SQUARED)
        features = np.concatenate([rows, np.square(rows)], axis=1)
        self.centre, spread = features.mean(axis=0), features.std(axis=0)
        self.spread = np.where(spread > 0, spread, 1.0)
        standardised = self._features(rows)
        likelihood = dict.fromkeys((np.inf, *PENALTIES), 0.0)
        for left, out in _folds(episode):
            for penalty in likelihood:
                self._solve(standardised[left], squared[left], penalty)
                log_variance = self._log_variance(standardised[out])
                likelihood[penalty] -= float((log_variance + squared[out] * np.exp(-log_variance)).sum())
        self.penalty = max(likelihood, key=lambda penalty: likelihood[penalty])
        self._solve(standardised, squared, self.penalty)
        return self

    def __call__(self, rows: Array) -> Array:
        """sigma^2: (n, size) -> (n, d)."""
        if not np.isfinite(self.penalty):
            return np.broadcast_to(np.exp(self.offset), (len(rows), len(self.offset)))
        return np.exp(self._log_variance(self._features(rows)))

    def _features(self, rows: Array) -> Array:
        features = np.concatenate([rows, rows * rows], axis=1)
        features -= self.centre
        features /= self.spread
        return self.clipped(features)

    @staticmethod
    def clipped(features: Array) -> Array:
        """Standardised features within the bounds."""
        return np.minimum(np.maximum(features, -CLIPPED), CLIPPED)

    def _log_variance(self, standardised: Array) -> Array:
        return np.clip(standardised @ self.weights + self.offset, self.low, self.high)

    def _solve(self, standardised: Array, squared: Array, penalty: float) -> None:
        mean = np.maximum(squared.mean(axis=0), np.finfo(float).tiny)
        shape = standardised.shape[1], squared.shape[1]
        self.weights, self.offset = np.zeros(shape), np.log(mean)
        self.low, self.high = np.full(shape[1], -np.inf), np.full(shape[1], np.inf)
        if not np.isfinite(penalty):
            return
        ridge = Ridge(alpha=penalty).fit(standardised, np.log(squared + SMALLEST * mean))
        self.weights, self.offset = ridge._weights.copy(), ridge._offset.copy()
        log_variance = self._log_variance(standardised)
        scale = np.log(np.maximum((squared * np.exp(-log_variance)).mean(axis=0), np.finfo(float).tiny))
        self.offset = self.offset + scale
        self.low, self.high = log_variance.min(axis=0) + scale, log_variance.max(axis=0) + scale


def fitted(regressor: Any, rows: Array, targets: Array) -> Any:
    """A clone of a regressor, fitted; one that takes a single target only is fitted for each component."""
    return learner_for(regressor, "follow_the_leader", rows, targets).frozen()


def _out_of_fold(rows: Array, hints: Array, episode: Indices, regressor: Any) -> Array:
    """Residuals of each row by a regressor that has not seen its trajectory; by one that has, of a single one."""
    residual = predict_unchecked(fitted(regressor, rows, hints), rows, hints.shape[1]) - hints
    for left, out in _folds(episode):
        model = fitted(regressor, rows[left], hints[left])
        residual[out] = predict_unchecked(model, rows[out], hints.shape[1]) - hints[out]
    return residual


def _folds(episode: Indices) -> Iterator[tuple[Indices, Indices]]:
    """Rows to fit to and rows left out, by whole trajectories; none where there is one trajectory."""
    present, place = np.unique(episode, return_inverse=True)
    if len(present) < 2:
        return
    for left, out in fold_indices(len(present), min(N_FOLDS, len(present)), 0, None):
        yield np.flatnonzero(np.isin(place, left)), np.flatnonzero(np.isin(place, out))
