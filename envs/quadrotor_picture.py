"""The picture of a quadrotor in space: the vehicle, the point to hover at, and the wind.

The view is as wide as the distance to the point asks for, and the vehicle is drawn in proportion to the view, not to
scale, so that its attitude can be read from afar. The front arm is orange. The filled area of each rotor's disc grows
with its thrust, and a rotor that pushes a tenth more than in a calm hover turns orange. Plumb lines drop from the
vehicle and the point to a grid, whose lines are 0.5 m apart (2 m far from the point). The arrow in the corner is the
wind's velocity, seen from the same side; the level ring around its foot has a radius of 4 m/s.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.projection import Camera
from beliefgym.envs.quaternions import rotate
from beliefgym.envs.rendering import Canvas, Point

if TYPE_CHECKING:
    from beliefgym.envs.quadrotor import Quadrotor

Floats = NDArray[np.float64]

_CAMERA = Camera(azimuth=-1.0, elevation=0.38)
_FULL_SPEED = 4.0  # m/s of wind, the ring in the corner
_PLACES = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))  # of the rotors, in units of the arm
_DISC = 0.5  # radius of a rotor in units of the arm
_LIFT = 0.14  # of the rotors over the arms, in units of the arm


def draw_quadrotor(canvas: Canvas, system: Quadrotor, state: Floats) -> None:
    """Draw one state.

    Args:
        canvas: where to. system: its weight tells what the rotors carry. state: (28,).
    """
    position, q, rotors, wind = state[0:3], state[6:10], state[13:17], state[17:20]
    half = max(1.2, 0.7 * float(np.linalg.norm(position)) + 0.9)
    floor = min(0.0, float(position[2])) - 0.45 * half
    focus = 0.5 * position
    (center,) = _place(focus)
    canvas.view(center=center, height=2.1 * half)
    _grid(canvas, focus, half, floor)
    thin = 0.012 * half
    for point, color in ((np.zeros(3), "target"), (position, "faint")):
        start, end = _place(np.stack([point, [point[0], point[1], floor]]))
        canvas.line(start, end, 0.5 * thin, color)
        canvas.circle(end, 1.4 * thin, color)
    (goal,) = _place(np.zeros(3))
    canvas.circle(goal, 0.055 * half, "target", 1.5 * thin)
    canvas.circle(goal, 0.016 * half, "target")
    _vehicle(canvas, position, q, rotors / (0.25 * system.weight), 0.28 * half)
    _wind(canvas, center, half, wind)


def _place(points: ArrayLike) -> list[Point]:
    return _CAMERA.project(points)[0]


def _vehicle(canvas: Canvas, position: Floats, q: Floats, shares: Floats, size: float) -> None:
    """Arms, then rotors from the farthest to the nearest; shares of thrust are 1 in a calm hover."""

    def world(points: ArrayLike) -> Floats:
        turned = rotate(q, np.atleast_2d(np.asarray(points, dtype=float)).T * size)
        return position + np.stack(turned, axis=-1)

    hubs = world([(x, y, _LIFT) for x, y in _PLACES])
    order = np.argsort(-_CAMERA.project(hubs)[1])
    arms = world([(x, y, 0.0) for x, y in _PLACES])
    (middle,) = _place(position)
    for i in order:
        end, hub = _place([arms[i], hubs[i]])
        canvas.rod(middle, end, 0.085 * size, "force" if i == 0 else "joint")
        canvas.rod(end, hub, 0.07 * size, "joint")
    canvas.circle(middle, 0.19 * size, "joint")
    mast = _place(world([(0.0, 0.0, 0.0), (0.0, 0.0, 0.62)]))
    canvas.arrow(mast[0], mast[1], 0.05 * size, "body")
    angles = np.linspace(0.0, 2.0 * np.pi, 61)
    for i in order:
        x, y = _PLACES[i]
        color = "force" if shares[i] > 1.1 else "body"
        share = math.sqrt(min(max(float(shares[i]), 0.0) / 2.0, 1.0))
        (hub,) = _place(hubs[i])
        circle = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
        rim, filled = (_place(world((x, y, _LIFT) + radius * circle)) for radius in (_DISC, _DISC * share))
        for start, end in zip(
            filled[:30], filled[30:60], strict=True
        ):  # its diameters: a disc may be any ellipse
            canvas.line(start, end, 0.13 * share * _DISC * size, color)
        for outline, width in ((filled, 0.05), (rim, 0.025)):
            for start, end in pairwise(outline):
                canvas.line(start, end, width * size, color)
        canvas.circle(hub, 0.05 * size, "joint")


def _wind(canvas: Canvas, center: Point, half: float, wind: Floats) -> None:
    """An arrow in the upper left corner, in a ring that lies level."""
    radius = 0.32 * half
    foot = np.array([center[0] - 0.66 * half, center[1] + 0.8 * half])

    def at(velocity: ArrayLike) -> list[Point]:
        return [
            (float(foot[0] + radius * x), float(foot[1] + radius * y))
            for x, y in _place(np.asarray(velocity, dtype=float) / _FULL_SPEED)
        ]

    ring = [
        (_FULL_SPEED * math.cos(a), _FULL_SPEED * math.sin(a), 0.0) for a in np.linspace(0.0, 2 * np.pi, 61)
    ]
    for start, end in pairwise(at(ring)):
        canvas.line(start, end, 0.01 * half, "guide")
    (tip,) = at(wind)
    canvas.circle((float(foot[0]), float(foot[1])), 0.02 * half, "joint")
    canvas.arrow((float(foot[0]), float(foot[1])), tip, 0.02 * half, "joint")


def _grid(canvas: Canvas, focus: Floats, half: float, floor: float) -> None:
    """A level grid below everything, around the focus."""
    step = 0.5 if half < 3.0 else 2.0
    reach = step * math.ceil(1.3 * half / step)
    for axis in (0, 1):
        middle, other = (step * round(float(focus[i]) / step) for i in (axis, 1 - axis))
        for at in np.arange(middle - reach, middle + reach + 0.1 * step, step):
            ends = []
            for far in (other - reach, other + reach):
                point = [0.0, 0.0, floor]
                point[axis], point[1 - axis] = at, far
                ends.append(point)
            start, end = _place(ends)
            canvas.line(start, end, 0.006 * half, "guide")
