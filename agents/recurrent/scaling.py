"""Sizes of what is put into networks: running moments of observations, and a scale of rewards."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class RunningMoments:
    """Mean and deviation of everything seen (Chan et al. 1979).

    Args:
        size: of a row.
    """

    def __init__(self, size: int) -> None:
        self._count, self._mean, self._sum = 0.0, np.zeros(size), np.zeros(size)

    def add(self, rows: NDArray[Any]) -> None:
        """Further rows (n, size)."""
        n, mean = len(rows), rows.mean(0, dtype=np.float64)
        total = self._count + n
        self._sum += ((rows - mean) ** 2).sum(0) + (mean - self._mean) ** 2 * self._count * n / total
        self._mean += (mean - self._mean) * n / total
        self._count = total

    def mean_and_scale(self) -> tuple[Tensor, Tensor]:
        """(size,) each, in single precision; the scale is the deviation, 1 where it is below 1e-6."""
        deviation = np.sqrt(self._sum / max(self._count, 1.0))
        scale = np.where(deviation > 1e-6, deviation, 1.0)
        return torch.as_tensor(self._mean, dtype=torch.float32), torch.as_tensor(scale, dtype=torch.float32)

    def to_array(self) -> NDArray[np.float64]:
        """(3, size): count, mean and sum of squared deviations."""
        return np.stack([np.full_like(self._mean, self._count), self._mean, self._sum])

    def from_array(self, array: NDArray[np.float64]) -> None:
        """The reverse of `to_array`."""
        self._count, self._mean, self._sum = float(array[0, 0]), array[1].copy(), array[2].copy()


def natural_scale(rewards: Tensor, gamma: float) -> float:
    """sqrt(1 - gamma^2) / rms(r): discounted sums of rewards that are independent have about unit size.

    1 where all rewards are 0.
    """
    size = float(rewards.square().mean().sqrt())
    return float(np.sqrt(max(1.0 - gamma**2, 1e-4)) / size) if size > 0.0 else 1.0
