"""The table of Kinova's Mico, a 6-joint arm: kinova-ros, m1n6s200 (BSD-3).

Every link is a cylinder of mass m, height h and radius r, with moments of inertia

    I_across = m (3 r^2 + h^2) / 12,      I_axial = m r^2 / 2.

Joints 1, 4, 5 and 6 turn without limit; joint damping and friction are 0 in the source.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.serial_arm import Link, Tip, Vector3

Six = tuple[float, float, float, float, float, float]


def cylinder(mass: float, height: float, radius: float, axis: Literal["x", "y", "z"]) -> Six:
    """Ixx, Iyy, Izz, Ixy, Ixz, Iyz in kg m^2 of a cylinder about its centre; the formula of the module."""
    across, axial = mass * (3.0 * radius**2 + height**2) / 12.0, 0.5 * mass * radius**2
    xx, yy, zz = (axial if axis == other else across for other in "xyz")
    return xx, yy, zz, 0.0, 0.0, 0.0


def _link(
    number: int,
    xyz: Vector3,
    rpy: Vector3,
    degrees: tuple[float, float],
    effort: float,
    speed: float,
    mass: float,
    com: Vector3,
    height: float,
    radius: float,
    axis: Literal["x", "y", "z"],
) -> Link:
    return Link(
        joint=f"joint_{number}",
        xyz=xyz,
        rpy=rpy,
        low=math.radians(degrees[0]),
        high=math.radians(degrees[1]),
        effort=effort,
        velocity=math.radians(speed),
        link=f"link_{number}",
        mass=mass,
        com=com,
        inertia=cylinder(mass, height, radius, axis),
    )


_H, _THIRD, _FREE = math.pi / 2, math.pi / 3, (-math.inf, math.inf)
_WRIST, _WRIST_COM = (0.0, -0.03703, -0.06414), (0.0, -0.037, -0.0642)
LINKS: tuple[Link, ...] = (
    _link(1, (0, 0, 0.15675), (0, math.pi, 0), _FREE, 40, 36, 0.7477, (0, -0.002, -0.0605), 0.14, 0.04, "z"),
    _link(
        2,
        (0, 0.0016, -0.11875),
        (-_H, 0, math.pi),
        (50, 310),
        80,
        36,
        0.85968,
        (0, -0.145, -0.0076),
        0.25,
        0.03,
        "y",
    ),
    _link(3, (0, -0.29, 0), (0, math.pi, 0), (35, 325), 40, 36, 0.606, (0, 0.0463, -0.0065), 0.08, 0.02, "y"),
    _link(4, (0, 0.1231, -0.0086), (-_H, 0, math.pi), _FREE, 20, 48, 0.426367, _WRIST_COM, 0.02, 0.04, "z"),
    _link(5, _WRIST, (_THIRD, 0, math.pi), _FREE, 20, 48, 0.426367, _WRIST_COM, 0.02, 0.04, "z"),
    _link(6, _WRIST, (_THIRD, 0, math.pi), _FREE, 20, 48, 0.78, (0, 0, -0.06), 0.03, 0.04, "z"),
)
BASE_MASS = 0.46784  # kg, does not move
FINGERS = 4 * 0.01  # kg, two fingers of two links
# the fingers as one cylinder around the hand's axis whose outer end is the end effector: chosen here
TIP = Tip(
    xyz=(0.0, 0.0, -0.16),
    rpy=(math.pi, 0.0, _H),
    mass=FINGERS,
    com=(0.0, 0.0, -0.04),
    inertia=cylinder(FINGERS, 0.08, 0.03, "z"),
)
EFFORTS: NDArray[np.float64] = np.array([item.effort for item in LINKS])  # N m
