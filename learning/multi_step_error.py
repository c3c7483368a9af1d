"""How far predictions of many steps are off, as the thesis measures it.

For a trajectory of T_k predicted steps (its given start does not count), with the Euclidean norm over components,

    e_k = sqrt(1/T_k sum_t |xi_hat_k(t) - xi_k(t)|^2),     p_k = sqrt(1/T_k sum_t |xi_k(t)|^2),

and the normalised multi-step error of a set of trajectories is the mean of e_k / p_k.

Reference: thesis proposal, Sec. 3.1.3, "Performance Evaluation".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MultiStepErrors:
    """Errors of predicted trajectories, in the units of the observations.

    Attributes:
        rmse: (n,) e_k. power: (n,) p_k.
        by_step: (n_steps,) root mean square over the trajectories of the error after 1, 2, ... steps.
        power_by_step: (n_steps,) the same of the true trajectories.
        n_diverged: trajectories that were cut; from there on the last prediction counts.
    """

    rmse: Array
    power: Array
    by_step: Array
    power_by_step: Array
    n_diverged: int = 0

    @property
    def normalised(self) -> Array:
        """(n,) e_k / p_k; a trajectory that is zero throughout takes the mean power of all."""
        power = np.where(self.power > 0, self.power, self.power.mean())
        return np.divide(self.rmse, power, out=np.where(self.rmse > 0, np.inf, 0.0), where=power > 0)

    @property
    def mean(self) -> float:
        """The mean of e_k / p_k."""
        return float(self.normalised.mean())


def multi_step_errors(
    predicted: Array, truth: Array, lengths: NDArray[np.int64], n_diverged: int = 0
) -> MultiStepErrors:
    """Compare trajectories.

    Args:
        predicted, truth: (n, n_steps + 1, n_obs); the first row is the given start and does not count.
        lengths: (n,) steps of each trajectory; those of 0 steps are left out.
        n_diverged: noted in the result.

    Raises:
        ValueError: shapes that differ, or not one step.
    """
    if predicted.shape != truth.shape:
        raise ValueError(f"expected predictions of the truth's shape {truth.shape}, got {predicted.shape}")
    used = lengths > 0
    if not used.any():
        raise ValueError(f"expected a trajectory of at least one step, got {len(lengths)} of none")
    inside = np.arange(truth.shape[1] - 1) < lengths[used, None]
    error = np.square(predicted[used, 1:] - truth[used, 1:]).sum(axis=2) * inside
    power = np.square(truth[used, 1:]).sum(axis=2) * inside
    n_steps, n_at_step = lengths[used], np.maximum(inside.sum(axis=0), 1)
    return MultiStepErrors(
        rmse=np.sqrt(error.sum(axis=1) / n_steps),
        power=np.sqrt(power.sum(axis=1) / n_steps),
        by_step=np.sqrt(error.sum(axis=0) / n_at_step),
        power_by_step=np.sqrt(power.sum(axis=0) / n_at_step),
        n_diverged=n_diverged,
    )
