"""Drawing of the arm that lifts a payload."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.projection import Camera

if TYPE_CHECKING:
    from beliefgym.envs.mico import MicoLift
    from beliefgym.envs.rendering import Canvas
    from beliefgym.envs.rigid_body import RigidArm

CAMERA = Camera(azimuth=-1.15, elevation=0.3)
THICKNESS = (0.08, 0.075, 0.06, 0.055, 0.05, 0.045, 0.04)  # m, of the rods from base to tip
LARGEST = 0.05  # m, drawn radius of the heaviest payload
HALF_GRIP = 0.022  # m, from the hand's axis to a finger's end


def draw_mico(system: MicoLift, canvas: Canvas, state: NDArray[np.float64]) -> None:
    """The arm in blue, its reference as a grey ghost with a green ring at its tip, the payload as a disc.

    The disc's area grows with the mass. Until the gripper takes the payload it stands on a post at the start.
    """
    from beliefgym.envs.planning.mico import mico_arm

    arm = mico_arm(system)
    time, start, mass = state[19], state[20:26], max(float(state[18]), 0.0)
    reference = system.reference(time, start)[0]
    now, wanted, begin = (_Skeleton(arm, angles) for angles in (state[:6], reference, start))
    canvas.view(center=(0.22, 0.3), height=1.0)
    for distance in (0.2, 0.4, 0.6):
        angles = np.linspace(0.0, 2.0 * math.pi, 73)
        circle = distance * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
        for one, other in pairwise(CAMERA.project(circle)[0]):
            canvas.line(one, other, 0.003, "guide")
    top, foot = begin.tip, CAMERA.project([begin.tip_place[0], begin.tip_place[1], 0.0])[0][0]
    canvas.rod((top[0], top[1] - 0.02), foot, 0.025, "guide")
    wanted.draw(canvas, "guide", "guide")
    now.draw(canvas, "body", "joint")
    canvas.box((0.0, 0.0), 0.2, 0.045, "joint")
    held = bool(system.carries(np.asarray(time - system.dt)))
    canvas.circle(now.tip if held else top, LARGEST * math.sqrt(mass / system.heaviest), "force")
    canvas.circle(wanted.tip, LARGEST + 0.015, "target", width=0.008)


class _Skeleton:
    """The arm at some angles as rods in the picture, and a gripper of two fingers."""

    def __init__(self, arm: RigidArm, angles: NDArray[np.float64]) -> None:
        frames = arm.frames(angles)
        places = np.stack([np.array([0.0, 0.0, 0.04]), *frames.origin])
        self.tip_place = places[-1]
        palm = 0.45 * places[-2] + 0.55 * places[-1]
        self.points, self.depths = CAMERA.project(np.vstack([places[:-1], palm]))
        self.tip = CAMERA.project(places[-1])[0][0]
        across = HALF_GRIP * frames.x[-1]
        knuckles = [0.5 * (palm + places[-1]) + sign * 1.5 * across for sign in (-1.0, 1.0)]
        ends = [places[-1] + sign * across for sign in (-1.0, 1.0)]
        self.fingers = [
            CAMERA.project([palm, knuckle, end])[0] for knuckle, end in zip(knuckles, ends, strict=True)
        ]

    def draw(self, canvas: Canvas, color: str, joints: str) -> None:
        """Rods from far to near, then the joints and the fingers."""
        for finger in self.fingers:
            for one, other in pairwise(finger):
                canvas.rod(one, other, 0.016, joints)
        for k in sorted(range(len(THICKNESS)), key=lambda k: -(self.depths[k] + self.depths[k + 1])):
            canvas.rod(self.points[k], self.points[k + 1], THICKNESS[k], color)
        for point, width in zip(self.points[2:], THICKNESS[1:], strict=False):
            canvas.circle(point, 0.32 * width, joints)
