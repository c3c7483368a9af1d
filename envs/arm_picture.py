"""Pictures of Baxter's left arm: its links as rods between the joints, the far ones first; torso, pedestal, floor."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.projection import Camera
from beliefgym.envs.rigid_body import RigidArm

if TYPE_CHECKING:
    from beliefgym.envs.rendering import Canvas

Floats = NDArray[np.float64]

FLOOR = -0.93  # m, below the torso's frame
RIM = 0.018  # m, the dark edge that sets a link off against the one behind it
CAMERA = Camera(azimuth=0.45, elevation=0.3)
Capsule = tuple[Any, Any, float]  # start and end (3,) in m, radius in m
Rod = tuple[tuple[float, float], tuple[float, float], float]
# pedestal, torso, shoulders, the left arm's mount, neck and head: only drawn
BODY: tuple[Capsule, ...] = (
    ((0.0, 0.0, FLOOR), (0.0, 0.0, 0.0), 0.07),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.35), 0.14),
    ((0.0, -0.2, 0.2), (0.0, 0.2, 0.2), 0.09),
    ((0.0, 0.0, 0.35), (0.02, 0.0, 0.6), 0.05),
    ((0.07, -0.08, 0.66), (0.07, 0.08, 0.66), 0.085),
)


def draw_baxter(
    canvas: Canvas,
    arm: RigidArm,
    angles: Floats,
    *,
    ghost: Floats | None = None,
    place: Floats | None = None,
) -> None:
    """The arm, and what it is to reach.

    Args:
        canvas: drawn on.
        arm: the arm on its mount.
        angles: (7,) rad.
        ghost: (7,) rad, a configuration to be drawn faintly.
        place: (3,) m, a point to be marked.
    """
    canvas.view(center=(0.25, 0.09), height=2.2)
    _ring(canvas, np.array([0.0, 0.0, FLOOR]), 0.4, "guide")
    _silhouette(canvas, _projected(BODY), "faint", "guide")
    if ghost is not None:
        _silhouette(canvas, _projected(_capsules(arm, ghost)), "target", "background", 0.034)
    if place is not None:
        foot = np.array([place[0], place[1], FLOOR])
        (at, below), _ = CAMERA.project([place, foot])
        canvas.line(below, at, 0.008, "faint")
        _ring(canvas, foot, 0.05, "faint")
    for start, end, radius in _projected(_capsules(arm, angles)):
        canvas.rod(start, end, 2.0 * radius, "joint")
        canvas.rod(start, end, 2.0 * radius - RIM, "body")
    points, _ = CAMERA.project(arm.joint_positions(angles))
    for point in points[:-1]:
        canvas.circle(point, 0.016, "joint")
    canvas.circle(points[-1], 0.03, "joint")
    if place is not None:
        canvas.circle(at, 0.035, "target")
        canvas.circle(at, 0.065, "target", 0.012)


def _capsules(arm: RigidArm, angles: Floats) -> list[Capsule]:
    """The capsules of links and hand in space."""
    frames = arm.frames(angles)
    capsules = []
    for item, x, y, z, origin in zip(arm.parts, *frames, strict=True):
        turn = np.stack([x, y, z], axis=1)
        capsules += [
            (origin + turn @ start, origin + turn @ end, radius) for start, end, radius in item.shape
        ]
    return capsules


def _projected(capsules: Sequence[Capsule]) -> list[Rod]:
    """Capsules in the picture's plane, the farthest first."""
    rods, depths = [], []
    for start, end, radius in capsules:
        (first, last), depth = CAMERA.project(np.stack([start, end]))
        rods.append((first, last, radius))
        depths.append(depth.mean())
    return [rods[i] for i in np.argsort(-np.array(depths))]


def _silhouette(canvas: Canvas, rods: Sequence[Rod], edge: str, fill: str, rim: float = RIM) -> None:
    """Rods as one flat shape with an edge."""
    for inset, color in ((0.0, edge), (rim, fill)):
        for start, end, radius in rods:
            canvas.rod(start, end, 2.0 * radius - inset, color)


def _ring(canvas: Canvas, center: Floats, radius: float, color: str) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = center + radius * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    points, _ = CAMERA.project(circle)
    for start, end in pairwise(points):
        canvas.line(start, end, 0.012, color)
