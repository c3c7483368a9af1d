"""Bringing components of different units to one scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CONSTANT = 1e-12  # a standard deviation below this share of the largest value is rounding, not variation


@dataclass(frozen=True, eq=False)
class Standardisation:
    """z = (x - offset) / scale, for each component.

    Attributes:
        offset, scale: (d,). constant: (d,) bool, components that do not vary; their scale is 1.
    """

    offset: Array
    scale: Array
    constant: NDArray[np.bool_]

    @classmethod
    def of(cls, rows: Array) -> Standardisation:
        """Mean 0 and standard deviation 1 on these rows (n, d)."""
        offset, std = rows.mean(axis=0), rows.std(axis=0)
        constant = std <= CONSTANT * np.abs(rows).max(axis=0, initial=0.0)
        return cls(offset, np.where(constant, 1.0, std), constant)

    @classmethod
    def together(cls, rows: Array) -> Standardisation:
        """Mean 0, and one scale for all components, their root mean square deviation: components of one unit."""
        each = cls.of(rows)
        deviation = np.where(each.constant, 0.0, each.scale)
        common = float(np.sqrt(np.square(deviation).mean())) if len(deviation) else 1.0
        return cls(each.offset, np.full(len(deviation), common if common > 0 else 1.0), each.constant)

    @classmethod
    def none(cls, rows: Array) -> Standardisation:
        """The identity."""
        d = rows.shape[1]
        return cls(np.zeros(d), np.ones(d), np.zeros(d, dtype=np.bool_))

    def apply(self, x: Array) -> Array:
        """(..., d) -> (..., d) on one scale."""
        return (x - self.offset) / self.scale

    def invert(self, z: Array) -> Array:
        """(..., d) -> (..., d) in the data's units."""
        return z * self.scale + self.offset
