"""`AutoregressiveFilter`: the next observation by regression on the last k ones, AR-k.

    x_hat_t = g(x_{t-1}, .., x_{t-k}),     m_t = [x_{t-1}, .., x_{t-k}]          (target "next")
    x_hat_t = x_{t-1} + g(x_{t-1}, .., x_{t-k})                                  (target "delta")

The belief is those k observations themselves, the newest first. Before the first observation all of them are the
training data's mean, and while fewer than k have been seen the mean stands for the missing ones.

Reference: thesis proposal, Sec. 3.3.4, the baseline AR. It does not say what the first k predictions are made of; the
mean, which is also what g is trained on there, is this package's choice.
"""

from __future__ import annotations

from typing import Any, Self, get_args

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.aggregation import learner_for, predict_unchecked
from beliefgym.learning.dynamics import Standardise, Target
from beliefgym.learning.filters import Filter, check_whole
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation
from beliefgym.learning.windows import ragged_range

Array = NDArray[np.float64]
LIMIT = 10.0  # times the largest training observation: where forecasts that grow without bound are cut


class AutoregressiveFilter(Filter):
    """AR-k with any regressor.

    Args:
        regressor: learns g; any scikit-learn regressor. None for `Ridge()`.
        n_past: k, at least 1.
        target: "next" or "delta": what regularisation falls back to, the mean or the last observation.
        standardise: bring components to one scale: True each by its own standard deviation, "together" all by one
            number (components of one unit), False not.
        pad_start: also learn from the first k steps of each trajectory, with the mean for what was not seen yet, so
            that g is trained on what it meets there, and trajectories of any length count. False is the regression
            on complete windows alone: what the first k steps need does not enter its coefficients, which for a long
            k and few steps makes the later predictions better and the first ones worse.

    Attributes:
        model_: the regressor of the standardised m_t, (n, n_past * n_obs) -> (n, n_obs).

    Example:
        >>> AutoregressiveFilter(n_past=20).fit(train).errors(test).mean  # doctest: +SKIP
    """

    def __init__(
        self,
        regressor: Any = None,
        *,
        n_past: int = 5,
        target: Target = "next",
        standardise: Standardise = True,
        pad_start: bool = True,
    ) -> None:
        self.regressor = regressor
        self.n_past = n_past
        self.target = target
        self.standardise = standardise
        self.pad_start = pad_start

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Fit the regressor to every window of every trajectory, none of which crosses an end.

        The targets are x_1 .. x_L, those that `FilterErrors` counts; with `pad_start` false x_k .. x_L.

        Args:
            train: trajectories. With `pad_start` false those of fewer than n_past + 1 observations give nothing.
            validation: not used; checked.

        Raises:
            ValueError: n_past below 1; an unknown target; no window.
        """
        check_whole("n_past", self.n_past, 1)
        if self.target not in get_args(Target):
            raise ValueError(f"expected target to be one of {get_args(Target)}, got {self.target!r}")
        self._begin(train, validation)
        rows = train.observations[train.observation_mask]
        self._first = np.tile(self._scale.apply(rows.mean(axis=0)), self.n_past)
        inputs, targets = self._windows(self._scale.apply(train.observations), train.lengths)
        if self.target == "delta":
            targets = targets - inputs[:, : self.n_obs_]
        regressor = Ridge() if self.regressor is None else self.regressor
        self.model_ = learner_for(regressor, "follow_the_leader", inputs, targets).frozen()
        z = self._scale.apply(rows)
        limit = np.where(Standardisation.of(z).constant, np.inf, LIMIT * np.abs(z).max(axis=0))
        self._bound = np.tile(limit, self.n_past)
        self._note_beliefs(train)
        return self

    def _windows(self, z: Array, lengths: NDArray[np.int64]) -> tuple[Array, Array]:
        """m_t and x_t: (n, n_rows, n_obs) -> (m, n_past * n_obs) and (m, n_obs), by trajectory, then by time."""
        k, d = self.n_past, self.n_obs_
        first = 1 if self.pad_start else k
        episode, offset = ragged_range(np.maximum(lengths + 1 - first, 0))
        if not len(episode):
            raise ValueError(
                f"expected a trajectory of at least n_past + 1 = {k + 1} observations, got {len(lengths)} of at most "
                f"{lengths.max() + 1}; lower n_past, or pass pad_start=True"
            )
        padded = np.concatenate([np.tile(self._first.reshape(k, d), (len(z), 1, 1)), z], axis=1)
        time = offset + first
        back = (time + k)[:, None] - np.arange(1, k + 1)  # x_t is row t + k
        return padded[episode[:, None], back].reshape(len(time), k * d), z[episode, time]

    def _initial(self) -> Array:
        return self._first

    def _update(self, belief: Array, z: Array) -> Array:
        return np.concatenate([z, belief[:, : -self.n_obs_]], axis=1)

    def _observe(self, belief: Array) -> Array:
        answer = predict_unchecked(self.model_, belief, self.n_obs_)
        return answer if self.target == "next" else answer + belief[:, : self.n_obs_]
