"""The picture of a helicopter in space, for all of its tasks.

North points to the lower right, the sky is up. The view is as wide as the distance to the target asks for, and the
helicopter is drawn in proportion to the view, not to scale, so that its attitude can be read from afar. Plumb lines
drop from the helicopter and its target to a grid, whose lines are 2 m apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.projection import Camera
from beliefgym.envs.quaternions import rotate
from beliefgym.envs.rendering import Canvas, Point

_CAMERA = Camera(azimuth=-0.85, elevation=0.3)
_GRID = 2.0  # m between lines
# the model in units of its size, in body axes (forward, right, down): rods (start, end, width, colour)
_RODS = (
    ((0.32, 0.0, 0.07), (0.0, 0.0, 0.0), 0.26, "body"),
    ((0.0, 0.0, 0.0), (-0.25, 0.0, -0.02), 0.18, "body"),
    ((-0.25, 0.0, -0.02), (-1.0, 0.0, -0.08), 0.055, "body"),
    ((-0.93, 0.0, 0.02), (-1.08, 0.0, -0.27), 0.05, "body"),
    ((0.05, 0.0, -0.05), (0.05, 0.0, -0.26), 0.04, "joint"),
    *(((0.30, y, 0.27), (-0.30, y, 0.27), 0.03, "joint") for y in (-0.17, 0.17)),
    *(((x, 0.0, 0.08), (x, y, 0.27), 0.025, "joint") for x in (-0.12, 0.16) for y in (-0.17, 0.17)),
)
_HUB = (0.05, 0.0, -0.27)
_ROTOR = 0.85


def draw_helicopter(
    canvas: Canvas,
    position: NDArray[np.float64],
    q: NDArray[np.float64],
    thrust: float,
    target: NDArray[np.float64],
    circle: float = 0.0,
) -> None:
    """Draw a helicopter and where it should be.

    Args:
        canvas: where to.
        position: (3,) NED, m. q: (4,) body to NED. target: (3,) NED, m.
        thrust: of the rotor, 1 where it carries the weight.
        circle: radius in m of the level circle around the origin that the target follows; 0 for none.
    """
    offset = float(np.linalg.norm(position - target))
    half = max(3.2, 1.25 * circle + 1.5, 1.1 * offset + 1.2)
    size = 0.28 * half
    focus = np.zeros(3) if circle else 0.5 * (position + target)
    floor = max(float(target[2]) + 0.45 * half, float(position[2]) + 0.3 * half)

    (center,) = _place([focus])
    canvas.view(center=center, height=2.1 * half)
    _grid(canvas, focus, half, floor)
    thin = 0.012 * half
    if circle:
        angles = np.linspace(0.0, 2.0 * np.pi, 90)
        ring = [(circle * math.cos(a), circle * math.sin(a), 0.0) for a in angles]
        for start, end in pairwise(_place(ring)):
            canvas.line(start, end, thin, "target")
    for point, color in ((target, "target"), (position, "faint")):
        start, end = _place(np.stack([point, np.array([point[0], point[1], floor])]))
        canvas.line(start, end, 0.6 * thin, color)
        canvas.circle(end, 1.5 * thin, color)
    (goal,) = _place([target])
    canvas.circle(goal, 0.05 * half, "target", 1.6 * thin)
    canvas.circle(goal, 0.014 * half, "target")
    _model(canvas, position, q, size, thrust)


def _seen(points: ArrayLike) -> tuple[list[Point], NDArray[np.float64]]:
    """Points (k, 3) or (3,) in NED as seen by the camera: x north, y west, z up."""
    return _CAMERA.project(np.atleast_2d(np.asarray(points, dtype=float)) * np.array([1.0, -1.0, -1.0]))


def _place(points: ArrayLike) -> list[Point]:
    return _seen(points)[0]


def _model(
    canvas: Canvas, position: NDArray[np.float64], q: NDArray[np.float64], size: float, thrust: float
) -> None:
    """Its parts from the farthest to the nearest."""

    def world(points: Sequence[Sequence[float]]) -> NDArray[np.float64]:
        moved = rotate(q, np.asarray(points, dtype=float).T * size)
        return position + np.stack(moved, axis=-1)

    def depth(points: NDArray[np.float64]) -> float:
        return float(_seen(points.mean(axis=0))[1][0])

    def rotor() -> None:
        angles = np.linspace(0.0, 2.0 * np.pi, 60)
        rim = [(_HUB[0] + _ROTOR * math.cos(a), _ROTOR * math.sin(a), _HUB[2]) for a in angles]
        flat = _place(world(rim))
        for start, end in pairwise(flat):
            canvas.line(start, end, 0.03 * size, "faint")
        for a in (0.6, 0.6 + 0.5 * np.pi):
            tips = [
                (_HUB[0] + sign * _ROTOR * math.cos(a), sign * _ROTOR * math.sin(a), _HUB[2])
                for sign in (-1, 1)
            ]
            left, right = _place(world(tips))
            canvas.rod(left, right, 0.045 * size, "joint")
        base, tip = _place(world([_HUB, (_HUB[0], 0.0, _HUB[2] - 0.75 * max(thrust, 0.0))]))
        canvas.arrow(base, tip, 0.05 * size, "force")

    def tail_rotor() -> None:
        angles = np.linspace(0.0, 2.0 * np.pi, 30)
        rim = [(-1.02 + 0.2 * math.cos(a), 0.05, -0.1 + 0.2 * math.sin(a)) for a in angles]
        for start, end in pairwise(_place(world(rim))):
            canvas.line(start, end, 0.03 * size, "joint")

    parts = [(depth(world([_HUB])), rotor), (depth(world([(-1.02, 0.05, -0.1)])), tail_rotor)]
    for start, end, width, color in _RODS:
        ends = world([start, end])

        def rod(ends: NDArray[np.float64] = ends, width: float = width, color: str = color) -> None:
            first, last = _place(ends)
            canvas.rod(first, last, width * size, color)

        parts.append((depth(ends), rod))
    for _, draw in sorted(parts, key=lambda part: -part[0]):
        draw()


def _grid(canvas: Canvas, focus: NDArray[np.float64], half: float, floor: float) -> None:
    """A level grid below everything, around the focus."""
    reach = _GRID * math.ceil(half / _GRID)
    for axis in (0, 1):
        middle = _GRID * round(float(focus[axis]) / _GRID)
        other = _GRID * round(float(focus[1 - axis]) / _GRID)
        for at in np.arange(middle - reach, middle + reach + 0.1, _GRID):
            ends = []
            for far in (other - reach, other + reach):
                point = [0.0, 0.0, floor]
                point[axis], point[1 - axis] = at, far
                ends.append(point)
            first, last = _place(ends)
            canvas.line(first, last, 0.006 * half, "guide")
