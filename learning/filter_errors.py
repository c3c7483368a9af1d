"""`FilterErrors`: how far a filter's predictions are from what came, over time and look-ahead.

    e = mean over trajectories of 1/T sum_{t=1}^{T} |x_hat_t - x_t|^2

with x_hat_t predicted from x_0 .. x_{t-1}; the prediction of x_0, from nothing, does not count. That is the filter
error of Table 3.3, and with predictions j observations further ahead that of Fig. 3.20.

Reference: thesis proposal, Sec. 3.3.4.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FilterErrors:
    """Squared errors in the squared units of the observations, summed over components.

    Attributes:
        squared: (n_episodes, n_steps + 1, horizon); entry [i, t, j] is that of x_{t+j} predicted from x_0 .. x_{t-1},
            NaN past an episode's end.
        power: mean of |x_t|^2, to compare with.
    """

    squared: Array
    power: float

    @property
    def by_episode(self) -> Array:
        """(n_episodes,) mean over t from 1, one observation ahead; NaN for an episode of one observation."""
        return nan_mean(self.squared[:, 1:, 0], 1)

    @property
    def mean(self) -> float:
        """e, of Table 3.3."""
        return float(nan_mean(self.by_episode, 0))

    @property
    def by_look_ahead(self) -> Array:
        """(horizon,) the same for each look-ahead, of Fig. 3.20."""
        return nan_mean(nan_mean(self.squared[:, 1:], 1), 0)

    @property
    def by_time(self) -> Array:
        """(n_steps + 1,) mean over episodes after t = 0, 1, .. observations, one observation ahead."""
        return nan_mean(self.squared[:, :, 0], 0)


def nan_mean(values: Array, axis: int) -> Array:
    """The mean of what is there; NaN, without a warning, of nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmean(values, axis=axis))
