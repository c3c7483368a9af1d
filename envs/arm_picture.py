"""Pictures of Baxter's left arm: its links as rods between the joints, the far ones first; torso, pedestal, floor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.projection import Camera
from beliefgym.envs.rigid_body import RigidArm

if TYPE_CHECKING:
    from beliefgym.envs.rendering import Canvas

Floats = NDArray[np.float64]

FLOOR = -0.93  # m, below the torso's frame
RIM = 0.018  # m, the dark edge that sets a link off against the one behind it
CAMERA = Camera(azimuth=0.45, elevation=0.35)


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
    canvas.view(center=(0.25, -0.06), height=2.3)
    _draw_robot(canvas)
    if ghost is not None:
        for start, end, radius in _rods(arm, ghost):
            canvas.rod(start, end, 2.0 * radius, "guide")
    if place is not None:
        foot = np.array([place[0], place[1], FLOOR])
        (at, below), _ = CAMERA.project([place, foot])
        canvas.line(below, at, 0.008, "guide")
        _ring(canvas, foot, 0.05, "guide")
    for start, end, radius in _rods(arm, angles):
        canvas.rod(start, end, 2.0 * radius, "joint")
        canvas.rod(start, end, 2.0 * radius - RIM, "body")
    joints = arm.joint_positions(angles)
    points, depth = CAMERA.project(joints)
    for i in np.argsort(-depth):
        canvas.circle(points[i], 0.016 if i < len(points) - 1 else 0.03, "joint")
    if place is not None:
        canvas.circle(at, 0.035, "target")
        canvas.circle(at, 0.065, "target", 0.012)
    if ghost is not None:
        (tip,), _ = CAMERA.project(arm.tip_position(ghost))
        canvas.circle(tip, 0.05, "target", 0.014)


def _draw_robot(canvas: Canvas) -> None:
    """Floor, pedestal, torso and head, none of which moves."""
    _ring(canvas, np.array([0.0, 0.0, FLOOR]), 0.55, "guide")
    solids = (
        ((0.0, 0.0, FLOOR + 0.1), (0.0, 0.0, -0.15), 0.11),
        ((0.0, 0.0, -0.02), (0.0, 0.0, 0.4), 0.15),
        ((-0.02, -0.1, 0.32), (-0.02, 0.1, 0.32), 0.15),
        ((0.0, 0.12, 0.16), (0.05, 0.21, 0.14), 0.1),
        ((0.06, 0.0, 0.66), (0.06, 0.0, 0.68), 0.1),
    )
    for start, end, radius in solids:
        (first, last), _ = CAMERA.project([start, end])
        canvas.rod(first, last, 2.0 * radius, "faint")
        canvas.rod(first, last, 2.0 * radius - RIM, "guide")


def _ring(canvas: Canvas, center: Floats, radius: float, color: str) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = center + radius * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    points, _ = CAMERA.project(circle)
    for start, end in zip(points[:-1], points[1:], strict=True):
        canvas.line(start, end, 0.012, color)


def _rods(arm: RigidArm, angles: Floats) -> list[tuple[tuple[float, float], tuple[float, float], float]]:
    """The capsules of links and hand in the picture's plane, the farthest first."""
    frames = arm.frames(angles)
    rods, depths = [], []
    for item, x, y, z, origin in zip((*arm.links, arm.tip), *frames, strict=True):
        turn = np.stack([x, y, z], axis=1)
        for start, end, radius in item.shape:
            (first, last), depth = CAMERA.project([origin + turn @ start, origin + turn @ end])
            rods.append((first, last, radius))
            depths.append(depth.mean())
    return [rods[i] for i in np.argsort(-np.array(depths))]
