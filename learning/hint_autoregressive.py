"""`AutoregressiveHints`: the hint by regression on the last k_p observations, without a belief over the future.

    h_hat_t = AR([x_{t-k_p+1}, .., x_t]),     m_{t+1} = [x_t, .., x_{t-k_p+1}]

The thesis's formula has a window of k_p + 1 observations, its text one of k_p; this is the text's. It waits for k_p
observations before the first estimate; here the training data's mean stands for what was not seen yet, and AR is
trained on such windows too, so that all filters estimate from the first observation on.

Reference: thesis proposal, Sec. 3.4.3, the baseline AR, there with random Fourier features and k_p = 5.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.aggregation import predict_unchecked
from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filters import check_whole
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.hint_gaps import gap_growth
from beliefgym.learning.hint_reading import HintReading, fitted
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]


class AutoregressiveHints(HintFilter):
    """The hint by any regressor from a window of observations.

    Args:
        regressor: learns AR. None for `Ridge()`.
        n_past: k_p, at least 1.
        hints_from: the trajectories' array that holds the hints, "hints" or "states".
        standardise: bring components to one scale: True each by its own standard deviation, "together" all by one
            number, False not.

    Attributes:
        model_: AR, of standardised windows and hints. gap_growth_: as of `PSIMHints`.

    Example:
        >>> AutoregressiveHints(n_past=5).fit(train, validation).hint_errors(test).mean  # doctest: +SKIP
    """

    def __init__(
        self,
        regressor: Any = None,
        *,
        n_past: int = 5,
        hints_from: Any = "hints",
        standardise: Standardise = True,
    ) -> None:
        self.regressor = regressor
        self.n_past = n_past
        self.hints_from = hints_from
        self.standardise = standardise

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Fit AR to every window of every trajectory.

        Args:
            train: trajectories with hints. validation: tells how sure estimates are; without, cross-validation does.

        Raises:
            ValueError: no hints, n_past below 1. TypeError: not `Sequences`.
        """
        check_whole("n_past", self.n_past, 1)
        self.__dict__.pop("model_", None)
        self._begin(train, validation)
        self._begin_hints(train, validation)
        rows = train.observations[train.observation_mask]
        self._first = np.tile(self._scale.apply(rows.mean(axis=0)), self.n_past)
        self.model_: Any = None
        windows, hints, episode = self._rows(train)
        unseen = None if validation is None else self._rows(validation)
        regressor = Ridge() if self.regressor is None else self.regressor
        self._reading = HintReading().fit(
            windows, hints, episode, {type(regressor).__name__: regressor}, unseen
        )
        self.model_ = self._reading.model
        mask = train.observation_mask
        self._observer = fitted(Ridge(), self.beliefs(train)[:, :-1][mask], self._standardised(train)[mask])
        self.gap_growth_ = gap_growth(self, train if validation is None else validation)
        self._note_beliefs(train)
        return self

    def _initial(self) -> Array:
        return self._first

    def _update(self, belief: Array, z: Array) -> Array:
        return np.concatenate([z, belief[:, : -self.n_obs_]], axis=1)

    def _observe(self, belief: Array) -> Array:
        return predict_unchecked(self._observer, belief, self.n_obs_)

    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        mean = self._hint_scale.invert(self._reading.mean(belief, self.n_hint_))
        return mean, np.sqrt(self._reading.variance(belief)) * self._hint_scale.scale
