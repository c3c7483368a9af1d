"""Baxter's left arm: 7 torque-controlled joints on a mount at the torso.

The table is that of the robot's published description (RethinkRobotics/baxter_common, BSD-3): all joints turn about
their frame's z axis. Axes of the torso's frame: x forwards, y to the robot's left, z upwards. What a task adds is in
baxter.py and baxter_hand.py.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar
from xml.etree import ElementTree

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.mujoco_system import MujocoSystem
from beliefgym.envs.rigid_body import RigidArm
from beliefgym.envs.serial_arm import Link, Tip, Vector3, mjcf
from beliefgym.envs.system import Array, constant

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams

Floats = NDArray[np.float64]
Capsules = tuple[tuple[Vector3, Vector3, float], ...]

_H = math.pi / 2


def _link(
    joint: tuple[str, Vector3, Vector3, float, float, float, float],
    body: tuple[str, float, Vector3, Vector3, Vector3],
    shape: Capsules,
) -> Link:
    name, xyz, rpy, low, high, effort, velocity = joint
    link, mass, com, diagonal, products = body
    return Link(
        joint=name,
        xyz=xyz,
        rpy=rpy,
        low=low,
        high=high,
        effort=effort,
        velocity=velocity,
        link=link,
        mass=mass,
        com=com,
        inertia=(*diagonal, *products),
        shape=shape,
    )


# joint: place, turn, lowest and highest angle, effort, rated speed;  link: mass, centre of mass, inertia;
# the capsules were chosen here
LINKS: tuple[Link, ...] = (
    _link(
        ("s0", (0.055695, 0.0, 0.011038), (0.0, 0.0, 0.0), -1.70168, 1.70168, 50.0, 1.5),
        (
            "upper_shoulder",
            5.70044,
            (0.01783, 0.00086, 0.19127),
            (0.0470910, 0.0376698, 0.0359599),
            (0.00012788, 0.00614870, 0.00078087),
        ),
        (((0.0, 0.0, 0.05), (0.0, 0.0, 0.24), 0.075), ((0.0, 0.0, 0.25), (0.069, 0.0, 0.27035), 0.07)),
    ),
    _link(
        ("s1", (0.069, 0.0, 0.27035), (-_H, 0.0, 0.0), -2.147, 1.047, 100.0, 1.5),
        (
            "lower_shoulder",
            3.22698,
            (0.06845, 0.00269, -0.00529),
            (0.0117521, 0.0278860, 0.0207875),
            (-0.00030096, 0.00207676, -0.00018822),
        ),
        (((0.0, 0.0, 0.0), (0.102, 0.0, 0.0), 0.065),),
    ),
    _link(
        ("e0", (0.102, 0.0, 0.0), (_H, 0.0, _H), -3.05418, 3.05418, 50.0, 1.5),
        (
            "upper_elbow",
            4.31272,
            (-0.00276, 0.00132, 0.18086),
            (0.0266173, 0.0284436, 0.0124801),
            (0.00029271, 0.00392190, 0.00108389),
        ),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 0.24), 0.06), ((0.0, 0.0, 0.24), (0.069, 0.0, 0.26242), 0.055)),
    ),
    _link(
        ("e1", (0.069, 0.0, 0.26242), (-_H, -_H, 0.0), -0.05, 2.618, 50.0, 1.5),
        (
            "lower_elbow",
            2.07206,
            (0.02611, 0.00159, -0.01117),
            (0.00711583, 0.0131823, 0.00926852),
            (0.00036036, 0.00074595, -0.00019663),
        ),
        (((0.0, 0.0, 0.0), (0.10359, 0.0, 0.0), 0.055),),
    ),
    _link(
        ("w0", (0.10359, 0.0, 0.0), (_H, 0.0, _H), -3.059, 3.059, 15.0, 4.0),
        (
            "upper_forearm",
            2.24665,
            (-0.00168, 0.0046, 0.13952),
            (0.0166774, 0.0167546, 0.00374631),
            (0.00018404, 0.00018658, -0.00064732),
        ),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 0.2707), 0.05),),
    ),
    _link(
        ("w1", (0.01, 0.0, 0.2707), (-_H, -_H, 0.0), -1.5708, 2.094, 15.0, 4.0),
        (
            "lower_forearm",
            1.60979,
            (0.06041, 0.00697, 0.006),
            (0.00387607, 0.00700538, 0.00552755),
            (-0.00044385, -0.00021115, 0.00015348),
        ),
        (((0.0, 0.0, 0.0), (0.115975, 0.0, 0.0), 0.047),),
    ),
    _link(
        ("w2", (0.115975, 0.0, 0.0), (_H, 0.0, _H), -3.059, 3.059, 15.0, 4.0),
        (
            "wrist",
            0.35093,
            (0.00198, 0.00125, 0.01855),
            (0.00025289, 0.00026886, 0.00030741),
            (5.753e-6, -1.593e-6, -5.198e-6),
        ),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 0.06), 0.042),),
    ),
)
HAND = Tip(
    xyz=(0.0, 0.0, 0.11355),
    mass=0.19125,
    com=(0.01093, 0.00042, -0.01532),
    inertia=(0.00017588, 0.00021166, 0.00023745, 1.471e-6, 2.436e-5, 1.727e-6),
    shape=(((0.0, 0.0, -0.05), (0.0, 0.0, -0.012), 0.03),),
)
MOUNT_XYZ, MOUNT_RPY = (0.024645, 0.219645, 0.118588), (0.0, 0.0, 0.7854)
JOINTS = tuple(link.joint for link in LINKS)
LIMIT_TIME = 0.01  # s, of the soft joint limits
PAST_LIMIT = 0.5  # rad: full torques at random threw the arm 0.33 beyond its limits


@lru_cache(maxsize=32)
def baxter_arm(damping: float, armature: float, gravity: float) -> RigidArm:
    """The rigid-body equations of the left arm on its mount, in the torso's frame."""
    return RigidArm(
        links=LINKS,
        tip=HAND,
        base_xyz=MOUNT_XYZ,
        base_rpy=MOUNT_RPY,
        damping=damping,
        armature=armature,
        gravity=gravity,
    )


def _stiffen_limits(root: ElementTree.Element) -> None:
    for joint in root.iter("joint"):
        joint.set("solreflimit", f"{LIMIT_TIME} 1")


@dataclass(frozen=True, kw_only=True)
class BaxterArm(MujocoSystem):
    """What the tasks of Baxter's left arm have in common: the arm, its torques and where it starts.

    Args:
        damping: N m s/rad of every joint (0.7 in the robot's description; other published models have 0).
        armature: kg m^2 of every joint. gravity: m/s^2.
        start_range: part of each joint's range, around its middle, that start angles are uniform in.
        start_speed: rad/s; start velocities are uniform within +-this.

    Raises:
        ValueError: a start_range beyond 0..1, or a negative speed, damping or armature.
    """

    substeps: int = 20
    actuation_noise_std: float | tuple[float, ...] = (0.5, 1.0, 0.5, 0.5, 0.15, 0.15, 0.15)
    damping: float = 0.7
    armature: float = 0.01
    gravity: float = 9.81
    start_range: float = 0.8
    start_speed: float = 0.1

    action_names: ClassVar = tuple(f"{joint}_torque" for joint in JOINTS)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.start_range <= 1.0:
            raise ValueError(f"expected start_range within 0..1, got {self.start_range!r}")
        for name in ("damping", "armature", "start_speed"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"expected {name} of at least 0, got {getattr(self, name)!r}")

    @property
    def arm(self) -> RigidArm:
        """The arm's rigid-body equations."""
        return baxter_arm(self.damping, self.armature, self.gravity)

    def mjcf(self) -> str:
        """See `MujocoSystem.mjcf`."""
        return mjcf(
            "baxter_left_arm",
            LINKS,
            HAND,
            base_xyz=MOUNT_XYZ,
            base_rpy=MOUNT_RPY,
            damping=self.damping,
            armature=self.armature,
            gravity=self.gravity,
            extra=_stiffen_limits,
        )

    @property
    def action_limits(self) -> tuple[Floats, Floats]:
        """The joints' efforts in N m."""
        return -self.arm.efforts, self.arm.efforts

    @property
    def observation_limits(self) -> tuple[Floats, Floats]:
        """None: the joint limits are soft."""
        high = np.full(len(self.observation_names), np.inf)
        return -high, high

    @property
    def state_limits(self) -> tuple[Floats, Floats]:
        """Joint angles at most `PAST_LIMIT` beyond the joint limits; see `System.state_limits`."""
        free = np.full(self.n_state - 7, np.inf)
        low, high = self.arm.limits
        return np.concatenate([low - PAST_LIMIT, -free]), np.concatenate([high + PAST_LIMIT, free])

    def advance(self, state: Floats, action: Floats) -> Floats:
        """See `MujocoSystem.advance`; what comes after the motion in the state stays as it is."""
        moved = self.simulate(state[..., :14], action)
        return moved if self.n_state == 14 else np.concatenate([moved, state[..., 14:]], axis=-1)

    @abstractmethod
    def nearness(self, state: Array) -> Array:
        """How near the arm is to its target, in 0..1, (...)."""

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Near, slow and gentle; in 0..1; see the class."""
        xp = array_namespace(next_state)
        velocity = next_state[..., 7:14]
        effort = action / constant(self.arm.efforts, action)
        slow = xp.mean(1.0 / (1.0 + velocity * velocity), axis=-1)
        gentle = 1.0 - xp.mean(effort * effort, axis=-1)
        return self.nearness(next_state) * (0.8 + 0.1 * slow + 0.1 * gentle)

    def reaching_cost(self, miss: Array, velocity: Array, torque: Array) -> Array:
        """|miss|^2 + 0.01 |velocity|^2 + 0.01 |torque / effort|^2: (..., k), (..., 7), (..., 7) -> (...)."""
        xp = array_namespace(miss)
        effort = torque / constant(self.arm.efforts, torque)
        quadratic = xp.sum(miss * miss, axis=-1)
        return (
            quadratic + 0.01 * xp.sum(velocity * velocity, axis=-1) + 0.01 * xp.sum(effort * effort, axis=-1)
        )

    def draw_angles(self, streams: RandomStreams, mask: NDArray[np.bool_] | None, part: float) -> Floats:
        """Joint angles uniform in the middle part of each joint's range, (n, 7) rad."""
        low, high = self.arm.limits
        return 0.5 * (low + high) + part * (streams.uniform(7, mask) - 0.5) * (high - low)

    def initial_motion(self, streams: RandomStreams, mask: NDArray[np.bool_] | None) -> Floats:
        """Start angles and velocities, (n, 14)."""
        angles = self.draw_angles(streams, mask, self.start_range)
        velocities = (2.0 * streams.uniform(7, mask) - 1.0) * self.start_speed
        return np.concatenate([angles, velocities], axis=1)
