"""Rigid-body equations of a serial arm, for whole batches of configurations: no loop over copies, one over links.

For joint angles q, velocities v, accelerations a (rad, rad/s, rad/s^2), torques tau in N m,

    tau = M(q) a + c(q, v) + g(q) + d v,        M = M_links + armature * I,

by the Newton-Euler equations written in world axes. With z_i the axis of joint i, p_i its place, c_b the centre of
mass of body b, and sums over the joints up to a body (forwards) or the bodies from a joint on (backwards),

    w_i = w_{i-1} + z_i v_i,    w'_i = w'_{i-1} + z_i a_i + w_{i-1} x z_i v_i,
    p''_i = p''_{i-1} + w'_{i-1} x r + w_{i-1} x (w_{i-1} x r),      r = p_i - p_{i-1},     p''_0 = -gravity,
    F_b = m_b c''_b,    N_b = I_b w' + w x I_b w,
    tau_i = z_i . sum_{b >= i} (N_b + (c_b - p_i) x F_b) + armature a_i + d v_i.

All quantities are sums along the chain, so that only the frames need a loop. The bodies are the links, what the
`Tip` carries, and, where asked for, a point mass at the tip of each copy.

Reference: Luh, Walker, Paul 1980, "On-line computational scheme for mechanical manipulators"; Featherstone 2008,
"Rigid body dynamics algorithms", Sec. 5.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.serial_arm import Link, Tip, Vector3, inertia_matrix, rotation
from beliefgym.envs.system import Array, constant

Floats = NDArray[np.float64]
Weights = list[tuple[int, float]]


class Frames(NamedTuple):
    """Where the links stand, in world axes.

    Attributes:
        x, y, z: for each link and, last, for the tip: its frame's axes (..., 3); z is the joint's axis.
        origin: for each link and, last, for the tip: the frame's place (..., 3) in m.
    """

    x: list[Array]
    y: list[Array]
    z: list[Array]
    origin: list[Array]


@dataclass(frozen=True, kw_only=True)
class RigidArm:
    """A serial arm of hinge joints; see the module.

    Args:
        links: from the base outwards. tip: what is fixed to the last link.
        base_xyz: m, base_rpy: rad: the frame that the first joint sits in.
        damping: N m s/rad, armature: kg m^2, of every joint.
        gravity: m/s^2, downwards along -z.
    """

    links: tuple[Link, ...]
    tip: Tip
    base_xyz: Vector3 = (0.0, 0.0, 0.0)
    base_rpy: Vector3 = (0.0, 0.0, 0.0)
    damping: float = 0.0
    armature: float = 0.0
    gravity: float = 9.81

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.links)

    @property
    def parts(self) -> tuple[Link | Tip, ...]:
        """The links, and what is fixed to the last."""
        return (*self.links, self.tip)

    @cached_property
    def limits(self) -> tuple[Floats, Floats]:
        """Lowest and highest joint angles in rad, each (dof,); infinite for continuous joints."""
        return np.array([item.low for item in self.links]), np.array([item.high for item in self.links])

    @cached_property
    def efforts(self) -> Floats:
        """Largest torques in N m, (dof,)."""
        return np.array([item.effort for item in self.links])

    def frames(self, angles: Array) -> Frames:
        """Forward kinematics, by elementwise operations of any array-API namespace.

        Args:
            angles: (..., dof) rad.

        Returns:
            dof + 1 frames: the links, then the tip.
        """
        xp = array_namespace(angles)
        nothing = 0.0 * angles[..., :1]
        x, y, z = (constant(column, angles) + nothing for column in rotation(self.base_rpy).T)
        origin = constant(np.array(self.base_xyz), angles) + nothing
        cosines, sines = xp.cos(angles), xp.sin(angles)
        result = Frames([], [], [], [])
        for i, (place, *columns) in enumerate(self._placements):
            axes = x, y, z
            origin = _combine(axes, place, origin)
            x, y, z = (_combine(axes, column) for column in columns)
            if i < len(self.links):
                cosine, sine = cosines[..., i : i + 1], sines[..., i : i + 1]
                x, y = cosine * x + sine * y, cosine * y - sine * x
            for parts, part in zip(result, (x, y, z, origin), strict=True):
                parts.append(part)
        return result

    def tip_position(self, angles: Array) -> Array:
        """The tip's place, (..., dof) rad -> (..., 3) m, in any array-API namespace."""
        return self.frames(angles).origin[-1]

    def joint_positions(self, angles: ArrayLike) -> Floats:
        """Places of the joints and, last, of the tip: (..., dof) rad -> (..., dof + 1, 3) m."""
        return np.stack(self.frames(np.asarray(angles, dtype=np.float64)).origin, axis=-2)

    def tip_jacobian(self, angles: ArrayLike) -> tuple[Floats, Floats]:
        """The tip's place and its derivative with the angles, column i: z_i x (tip - p_i).

        Args:
            angles: (..., dof) rad.

        Returns:
            tip (..., 3) m and Jacobian (..., 3, dof) m/rad.
        """
        frames = self.frames(np.asarray(angles, dtype=np.float64))
        tip = frames.origin[-1]
        axes, places = np.stack(frames.z[:-1], axis=-2), np.stack(frames.origin[:-1], axis=-2)
        return tip, np.cross(axes, tip[..., None, :] - places).swapaxes(-1, -2)

    def inverse_dynamics(
        self,
        angles: ArrayLike,
        velocities: ArrayLike,
        accelerations: ArrayLike,
        payload: ArrayLike | None = None,
    ) -> Floats:
        """The torques of a motion: M a + c + g + d v.

        Args:
            angles, velocities, accelerations: (..., dof), of shapes that broadcast.
            payload: kg, point mass at the tip, a number or (...) one for each copy; none if None.

        Returns:
            (..., dof) N m.
        """
        angles, velocities, accelerations = (
            np.asarray(array, dtype=np.float64) for array in (angles, velocities, accelerations)
        )
        forces = self._newton_euler(angles, velocities, accelerations, self.gravity, payload)
        return forces + self.damping * velocities + self.armature * accelerations

    def gravity_torque(self, angles: ArrayLike, payload: ArrayLike | None = None) -> Floats:
        """g(q): the torques that hold the arm still, (..., dof) rad -> (..., dof) N m."""
        angles = np.asarray(angles, dtype=np.float64)
        nothing = np.zeros(self.dof)
        return self._newton_euler(angles, nothing, nothing, self.gravity, payload)

    def mass_matrix(self, angles: ArrayLike, payload: ArrayLike | None = None) -> Floats:
        """M(q) with the armature, (..., dof) rad -> (..., dof, dof) kg m^2, symmetric."""
        angles = np.asarray(angles, dtype=np.float64)
        carried = None if payload is None else np.asarray(payload, dtype=np.float64)[..., None]
        identity = np.eye(self.dof)
        columns = self._newton_euler(angles[..., None, :], np.zeros(self.dof), identity, 0.0, carried)
        return 0.5 * (columns + columns.swapaxes(-1, -2)) + self.armature * identity

    def accelerations(
        self, angles: ArrayLike, velocities: ArrayLike, torques: ArrayLike, payload: ArrayLike | None = None
    ) -> Floats:
        """Forward dynamics: M^-1 (tau - c - g - d v), without joint limits; (..., dof) rad/s^2."""
        bias = self.inverse_dynamics(angles, velocities, np.zeros(self.dof), payload)
        free = np.asarray(torques, dtype=np.float64) - bias
        mass = self.mass_matrix(angles, payload)
        return np.asarray(np.linalg.solve(mass, free[..., None])[..., 0], dtype=np.float64)

    def _newton_euler(
        self, angles: Floats, v: Floats, a: Floats, gravity: float, payload: ArrayLike | None
    ) -> Floats:
        """M_links a + c + gravity's torques, (..., dof)."""
        frames = self.frames(angles)
        axes = np.stack(frames.z[:-1], axis=-2)  # (..., dof, 3)
        places = np.stack(frames.origin[:-1], axis=-2)
        turn = axes * v[..., None]
        w = np.cumsum(turn, axis=-2)
        w_before = w - turn
        w_change: Floats = np.cumsum(axes * a[..., None] + np.cross(w_before, turn), axis=-2)

        rise = np.zeros(
            (*w_change.shape[:-1], 3)
        )  # p''_i, with gravity as an upward acceleration of the base
        arms = np.diff(places, axis=-2)
        rise[..., 1:, :] = np.cumsum(_swing(w[..., :-1, :], w_change[..., :-1, :], arms), axis=-2)
        rise[..., 2] += gravity

        masses, inertias, rides_on = self._bodies
        at, rotations = self._centres(frames)
        if payload is None:
            masses, inertias, rides_on = masses[:-1], inertias[:-1], rides_on[:-1]
            at, rotations = at[..., :-1, :], rotations[..., :-1, :, :]
        else:
            carried = np.asarray(payload, dtype=np.float64)[..., None]
            fixed = np.broadcast_to(masses[:-1], (*carried.shape[:-1], len(masses) - 1))
            masses = np.concatenate([fixed, carried], axis=-1)
        w, w_change, rise = w[..., rides_on, :], w_change[..., rides_on, :], rise[..., rides_on, :]
        force = masses[..., None] * (rise + _swing(w, w_change, at - places[..., rides_on, :]))
        w_own, change_own = (np.einsum("...ki,...k->...i", rotations, u) for u in (w, w_change))
        spin = np.einsum("bij,...bj->...bi", inertias, w_own)
        moment_own = np.einsum("bij,...bj->...bi", inertias, change_own) + np.cross(w_own, spin)
        moment = np.einsum("...ik,...k->...i", rotations, moment_own) + np.cross(
            at, force
        )  # about the origin

        last = self.dof - 1  # the bodies beyond the last link ride on it
        force[..., last, :] = force[..., last:, :].sum(axis=-2)
        moment[..., last, :] = moment[..., last:, :].sum(axis=-2)
        force, moment = (np.cumsum(u[..., last::-1, :], axis=-2)[..., ::-1, :] for u in (force, moment))
        torque: Floats = (axes * (moment - np.cross(places, force))).sum(axis=-1)
        return torque

    @cached_property
    def _placements(self) -> list[list[Weights]]:
        """Place and axes x, y, z of each part at angle 0, by the axes of the part before."""
        return [[_weights(vector) for vector in (part.xyz, *rotation(part.rpy).T)] for part in self.parts]

    @cached_property
    def _bodies(self) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Masses (dof + 2,), inertias (dof + 2, 3, 3) and the link that each rides on; the last is the payload."""
        items = self.parts
        masses = np.array([*(item.mass for item in items), 0.0])
        inertias = np.stack([*(inertia_matrix(item.inertia) for item in items), np.zeros((3, 3))])
        return masses, inertias, np.minimum(np.arange(self.dof + 2), self.dof - 1)

    def _centres(self, frames: Frames) -> tuple[Floats, Floats]:
        """Centres of mass (..., dof + 2, 3) and rotations (..., dof + 2, 3, 3) of the bodies."""
        centres = [
            _combine((x, y, z), _weights(item.com), origin)
            for item, x, y, z, origin in zip(self.parts, *frames, strict=True)
        ]
        at = np.stack([*centres, frames.origin[-1]], axis=-2)
        columns = [np.stack([*part, part[-1]], axis=-2) for part in frames[:3]]
        return at, np.stack(columns, axis=-1)


def _swing(w: Floats, w_change: Floats, arm: Floats) -> Floats:
    """Acceleration of the end of an arm against its beginning: w' x r + w x (w x r)."""
    return np.cross(w_change, arm) + np.cross(w, np.cross(w, arm))


def _weights(vector: ArrayLike) -> Weights:
    """Axis and weight of the components that are not 0 but for rounding (turns by pi/2 leave 6e-17)."""
    numbers = np.asarray(vector, dtype=np.float64).tolist()
    return [(i, weight) for i, weight in enumerate(numbers) if abs(weight) > 1e-12]


def _combine(axes: tuple[Array, Array, Array], weights: Weights, start: Array | None = None) -> Array:
    """start + sum of weight * axis."""
    total = start
    for i, weight in weights:
        part = axes[i] if weight == 1.0 else weight * axes[i]
        total = part if total is None else total + part
    return total
