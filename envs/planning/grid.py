"""A function on a regular grid of two state components, bilinear between the nodes.

In the cell whose lowest node is (i, j), at the place (p, q) in 0..1,

    V = (1 - p) ((1 - q) V[i, j] + q V[i, j + 1]) + p ((1 - q) V[i + 1, j] + q V[i + 1, j + 1]).

A periodic axis has its first node once more at the end, so that no index needs to wrap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """One state component of a grid.

    Args:
        low, high: its range; a periodic component repeats after high - low.
        nodes: number of grid nodes; both ends are nodes, except that a periodic component's high is its low.
        periodic: whether it is an angle.

    Raises:
        ValueError: fewer than 2 nodes or an empty range.
    """

    low: float
    high: float
    nodes: int
    periodic: bool = False

    def __post_init__(self) -> None:
        if self.nodes < 2 or not self.low < self.high or not np.isfinite(self.high - self.low):
            raise ValueError(f"expected at least 2 nodes in a finite range that is not empty, got {self}")

    @property
    def points(self) -> Floats:
        """The nodes, (nodes,)."""
        return np.linspace(self.low, self.high, self.nodes, endpoint=not self.periodic)

    @property
    def columns(self) -> int:
        """Nodes with the repeated one of a periodic axis."""
        return self.nodes + self.periodic

    def locate(self, values: Floats) -> tuple[NDArray[np.intp], Floats]:
        """The cell of each value and its place in it, in 0..1; beyond the range, the nearest place within it."""
        place = (values - self.low) * ((self.columns - 1) / (self.high - self.low))
        place = place % self.nodes if self.periodic else np.minimum(np.maximum(place, 0.0), self.nodes - 1)
        cell = np.minimum(place.astype(np.intp), self.columns - 2)
        return cell, place - cell


@dataclass(frozen=True, eq=False)
class GridValue:
    """V on a grid, bilinear between the nodes.

    Attributes:
        axes: of the two state components.
        table: (axes[0].columns, axes[1].columns).
        improvements: policy improvements that were made.
        converged: whether the last one left V as it was.
    """

    axes: tuple[Axis, Axis]
    table: Floats
    improvements: int
    converged: bool

    def __call__(self, state: Floats) -> Floats:
        """V at states (..., 2) -> (...)."""
        i, p = self.axes[0].locate(state[..., 0])
        j, q = self.axes[1].locate(state[..., 1])
        corner = i * self.table.shape[1] + j
        return bilinear(self.table.ravel(), self.table.shape[1], corner, p, q)


def bilinear(table: Floats, width: int, corner: NDArray[Any], p: NDArray[Any], q: NDArray[Any]) -> Floats:
    """Interpolate in a flat table whose rows have this width; corner is the cell's lowest node."""
    here = table[corner]
    low = here + (table[corner + 1] - here) * q
    there = table[corner + width]
    return low + (there + (table[corner + (width + 1)] - there) * q - low) * p


def table_of(value: Floats, axes: tuple[Axis, Axis]) -> Floats:
    """The values at the nodes as a table, with the repeated column of a periodic axis."""
    table = value.reshape(axes[0].nodes, axes[1].nodes)
    return np.pad(table, [(0, axis.columns - axis.nodes) for axis in axes], mode="wrap")
