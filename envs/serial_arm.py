"""Serial arms of hinge joints as data, in the convention of URDF, and their model for MuJoCo.

Joint i sits in the frame of link i - 1 at `xyz`, turned by `rpy`: R = Rz(yaw) Ry(pitch) Rx(roll), a fixed-axis
roll, then pitch, then yaw; the link turns by q_i about the z axis of that frame. Mass, centre of mass and inertia
(about the centre of mass) are in the link's frame. SI units.

One table serves MuJoCo (`mjcf`) and the batched rigid-body equations of rigid_body.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Link:
    """A joint and the link that it carries.

    Args:
        joint: name of the joint.
        xyz: m, the joint's place in the frame of the link before. rpy: rad.
        low, high: joint limits in rad; infinite for a continuous joint.
        effort: largest torque in N m. velocity: rated speed in rad/s.
        link: name of the link.
        mass: kg. com: m. inertia: Ixx, Iyy, Izz, Ixy, Ixz, Iyz in kg m^2 about the centre of mass.
        shape: capsules that stand for the link in pictures and (when asked for) contacts: (start, end, radius) in m.
    """

    joint: str
    xyz: Vector3
    rpy: Vector3
    low: float
    high: float
    effort: float
    velocity: float
    link: str
    mass: float
    com: Vector3
    inertia: tuple[float, float, float, float, float, float]
    shape: tuple[tuple[Vector3, Vector3, float], ...] = ()

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) from the joint's frame at q = 0 to the frame of the link before."""
        return rotation(self.rpy)


@dataclass(frozen=True, kw_only=True)
class Tip:
    """What is fixed to the last link: a hand or tool.

    Args:
        xyz: m, in the last link's frame. rpy: rad.
        mass: kg; 0 for a mere point. com: m. inertia: as of a `Link`.
        shape: capsules for the picture.
    """

    xyz: Vector3
    rpy: Vector3 = (0.0, 0.0, 0.0)
    mass: float = 0.0
    com: Vector3 = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    shape: tuple[tuple[Vector3, Vector3, float], ...] = ()


def rotation(rpy: Vector3) -> NDArray[np.float64]:
    """(3, 3) matrix Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = (tuple(f(a) for a in rpy) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def inertia_matrix(inertia: tuple[float, float, float, float, float, float]) -> NDArray[np.float64]:
    """(3, 3) from Ixx, Iyy, Izz, Ixy, Ixz, Iyz."""
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def mjcf(
    name: str,
    links: Sequence[Link],
    tip: Tip,
    *,
    base_xyz: Vector3 = (0.0, 0.0, 0.0),
    base_rpy: Vector3 = (0.0, 0.0, 0.0),
    damping: float = 0.0,
    armature: float = 0.0,
    gravity: float = 9.81,
    extra: Callable[[ElementTree.Element], None] | None = None,
) -> str:
    """The MuJoCo model of an arm with a torque motor at each joint and a site `tip` at its end.

    Args:
        name: of the model.
        links: from the base outwards. tip: what is fixed to the last link.
        base_xyz: m, base_rpy: rad: the frame that the first joint sits in.
        damping: N m s/rad, armature: kg m^2, of every joint.
        gravity: m/s^2, downwards along -z.
        extra: may change the finished tree (add a payload, a table) before it is written.

    Returns:
        XML. The motors' control is the torque in N m, limited to the efforts; contacts are off.
    """
    root = ElementTree.Element("mujoco", model=name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    option = ElementTree.SubElement(
        root, "option", gravity=_numbers((0.0, 0.0, -gravity)), integrator="implicitfast"
    )
    ElementTree.SubElement(option, "flag", contact="disable")
    world = ElementTree.SubElement(root, "worldbody")
    parent = _body(world, "base", base_xyz, base_rpy)
    for item in links:
        parent = _body(parent, item.link, item.xyz, item.rpy)
        limits = {} if math.isinf(item.high) else {"range": _numbers((item.low, item.high))}
        joint = {"name": item.joint, "type": "hinge", "axis": "0 0 1"}
        ElementTree.SubElement(
            parent, "joint", {**joint, "damping": repr(damping), "armature": repr(armature), **limits}
        )
        _inertial(parent, item.mass, item.com, item.inertia)
        _capsules(parent, item.shape)
    hand = _body(parent, "hand", tip.xyz, tip.rpy)
    if tip.mass:
        _inertial(hand, tip.mass, tip.com, tip.inertia)
    _capsules(hand, tip.shape)
    ElementTree.SubElement(hand, "site", name="tip")
    actuators = ElementTree.SubElement(root, "actuator")
    for item in links:
        ElementTree.SubElement(
            actuators,
            "motor",
            name=item.joint,
            joint=item.joint,
            gear="1",
            ctrlrange=_numbers((-item.effort, item.effort)),
        )
    if extra is not None:
        extra(root)
    return ElementTree.tostring(root, encoding="unicode")


def _inertial(
    body: ElementTree.Element,
    mass: float,
    com: Vector3,
    inertia: tuple[float, float, float, float, float, float],
) -> None:
    ElementTree.SubElement(
        body, "inertial", pos=_numbers(com), mass=repr(mass), fullinertia=_numbers(inertia)
    )


def _capsules(body: ElementTree.Element, shape: Sequence[tuple[Vector3, Vector3, float]]) -> None:
    for start, end, radius in shape:
        ElementTree.SubElement(
            body, "geom", type="capsule", fromto=_numbers((*start, *end)), size=repr(radius), mass="0"
        )


def _body(parent: ElementTree.Element, name: str, xyz: Vector3, rpy: Vector3) -> ElementTree.Element:
    """A body whose frame is given by its x and y axes."""
    matrix = rotation(rpy)
    axes = _numbers((*matrix[:, 0], *matrix[:, 1]))
    return ElementTree.SubElement(parent, "body", name=name, pos=_numbers(xyz), xyaxes=axes)


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
