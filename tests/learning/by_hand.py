"""What several tests of learning compare with, or do to a model."""

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.linear_model import Ridge as ScikitRidge


class RidgeOfAll(RegressorMixin, BaseEstimator):
    """Scikit-learn's ridge with a penalty a sample: the same minimiser as `Ridge`, from stored data."""

    def __init__(self, alpha=1e-3):
        self.alpha = alpha

    def fit(self, X, y):
        self.ridge_ = ScikitRidge(alpha=len(X) * self.alpha, solver="svd").fit(X, y)
        return self

    def predict(self, X):
        return self.ridge_.predict(X)

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def poison_empty(monkeypatch):
    """From here on `np.empty` gives 1e200, whose square is infinite, where it would give what stood in memory."""
    plain = np.empty

    def poisoned(shape, dtype=float, **others):
        array = plain(shape, dtype, **others)
        if array.dtype == np.float64:
            array[...] = 1e200
        return array

    monkeypatch.setattr(np, "empty", poisoned)


def predictions(model, data):
    """x_hat of every observation, by the filter: (n_episodes, n_rows, n_obs)."""
    beliefs = model.beliefs(data)[:, :-1]
    flat = model.predict_observation(beliefs.reshape(-1, beliefs.shape[2]))
    return flat.reshape(*beliefs.shape[:2], -1)


def eigenvalue_error(found, true):
    """The largest distance from a true eigenvalue to the nearest found one."""
    found, true = np.linalg.eigvals(found), np.linalg.eigvals(true)
    return np.abs(found[:, None] - true).min(axis=0).max()


def weighted_ridge(X, Y, W, alpha):
    """Scikit-learn's ridge, penalty a sample, on each target column with its own weights W (n, d): a function, A, b."""
    X, Y, W = (np.array(one) for one in (X, Y, W))
    fits = [
        ScikitRidge(alpha=alpha * w.sum(), solver="svd").fit(X, y, sample_weight=w)
        for y, w in zip(Y.T, W.T, strict=True)
    ]
    A, b = np.array([f.coef_ for f in fits]), np.array([f.intercept_ for f in fits])
    return lambda z: A @ z + b, A, b
