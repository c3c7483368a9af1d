"""`HintErrors`: how far estimates of a hint are from the truth, over time and over trajectories.

    e_i = 1/T sum_t |h_hat_t - h_t|,     mean +- standard deviation over trajectories i

with h_hat_t estimated from x_0 .. x_t: the estimate may use the observation made at the same time.

The thesis calls this "mean L2 error" and prints the squared norm. Its Table 3.8 shows that the norm is meant: the
filter that learns nothing there (Linear KF) has 89, the standard deviation in grams of masses spread over 45 .. 355 g.

Reference: thesis proposal, Sec. 3.4.3, Tables 3.6 to 3.8 and Fig. 3.24.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from beliefgym.learning.filter_errors import nan_mean

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HintErrors:
    """Errors in the units of the hint.

    Attributes:
        difference: (n_episodes, n_steps + 1, n_hint) h_hat_t - h_t, NaN past an episode's end.
        std: the same shape, the standard deviation that the filter gave, NaN where it gave none.
    """

    difference: Array
    std: Array

    @property
    def norm(self) -> Array:
        """(n_episodes, n_steps + 1) |h_hat_t - h_t|, over the components of the hint."""
        return np.sqrt(np.square(self.difference).sum(axis=2))

    @property
    def by_episode(self) -> Array:
        """(n_episodes,) mean over t of the norm: e_i."""
        return nan_mean(self.norm, 1)

    @property
    def mean(self) -> float:
        """Mean over episodes: the number of Tables 3.6 to 3.8."""
        return float(nan_mean(self.by_episode, 0))

    @property
    def deviation(self) -> float:
        """Standard deviation over episodes: the +- 1 sigma of these tables."""
        return float(np.nanstd(self.by_episode))

    @property
    def rmse(self) -> Array:
        """(n_hint,) root mean squared error of each component, over all times of all episodes."""
        return np.sqrt(nan_mean(np.square(self.difference).reshape(-1, self.difference.shape[2]), 0))

    @property
    def by_time(self) -> Array:
        """(n_steps + 1,) mean norm over the episodes that are that long: Fig. 3.24."""
        return nan_mean(self.norm, 0)

    @property
    def standard_error_by_time(self) -> Array:
        """(n_steps + 1,) standard error of `by_time`; NaN where fewer than two episodes are that long."""
        norm = self.norm
        n = np.isfinite(norm).sum(axis=0)
        spread = np.sqrt(nan_mean(np.square(norm - self.by_time), 0))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(n > 1, spread / np.sqrt(n - 1.0), np.nan)

    @property
    def mean_squared_z(self) -> Array:
        """(n_hint,) mean of ((h_hat - h) / std)^2: 1 where the given uncertainty is right, above where it is small."""
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.square(self.difference / self.std)
        return nan_mean(z.reshape(-1, z.shape[2]), 0)

    def coverage(self, probability: float = 0.95) -> Array:
        """(n_hint,) the share of hints inside the central interval that a normal distribution gives them."""
        limit = ndtri(0.5 + 0.5 * probability) * self.std
        there = np.isfinite(self.difference) & np.isfinite(self.std)
        inside = np.where(there, np.abs(self.difference) <= limit, np.nan)
        return nan_mean(inside.reshape(-1, inside.shape[2]), 0)
