"""Unit quaternions by components: turns in space for systems that fly.

A quaternion is four numbers of each copy in the order (x, y, z, w): the vector part, then the scalar part. q stands
for the turn that takes a vector from body axes to world axes,

    v_world = q (v, 0) q*,       (p q) turns by q first, then by p.

Every function takes and returns tuples of components, arrays (...) of any array namespace, and has no branch on a
value: the lines run under numpy and torch (with finite derivatives everywhere) and can be traced into a compiled loop.

Reference: Diebel 2006, "Representing Attitude: Euler Angles, Unit Quaternions, and Rotation Vectors", Sec. 6 and 7.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

Array = Any  # an array (...) of any namespace of the array API
Vector = tuple[Array, Array, Array]
Quaternion = tuple[Array, Array, Array, Array]

_SMALL = 1e-4  # rad^2: below it the three terms of the series are exact to 2e-17


def product(p: Iterable[Array], q: Iterable[Array]) -> Quaternion:
    """Hamilton's product p q.

        vec(p q) = w_p vec(q) + w_q vec(p) + vec(p) x vec(q),      w = w_p w_q - vec(p) . vec(q)

    Args:
        p: four components (...), order x, y, z, w. q: the same.

    Returns:
        four components (...).
    """
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + qw * px + (py * qz - pz * qy),
        pw * qy + qw * py + (pz * qx - px * qz),
        pw * qz + qw * pz + (px * qy - py * qx),
        pw * qw - px * qx - py * qy - pz * qz,
    )


def conjugate(q: Iterable[Array]) -> Quaternion:
    """The inverse turn: (-x, -y, -z, w)."""
    x, y, z, w = q
    return -x, -y, -z, w


def rotate(q: Iterable[Array], v: Iterable[Array]) -> Vector:
    """A vector in body axes as seen in world axes.

        v' = v + w t + vec(q) x t,      t = 2 vec(q) x v

    Args:
        q: four components (...) of a unit quaternion. v: three components (...).

    Returns:
        three components (...), in the units of v.
    """
    x, y, z, w = q
    a, b, c = v
    t = (2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a))
    return (
        a + w * t[0] + (y * t[2] - z * t[1]),
        b + w * t[1] + (z * t[0] - x * t[2]),
        c + w * t[2] + (x * t[1] - y * t[0]),
    )


def rotate_inverse(q: Iterable[Array], v: Iterable[Array]) -> Vector:
    """A vector in world axes as seen in body axes: `rotate` by the inverse turn."""
    return rotate(conjugate(q), v)


def exponential(turn: Iterable[Array]) -> Quaternion:
    """The quaternion of a turn by |a| about a, as body rates times a time step give it.

        [a sin(|a|/2) / |a|; cos(|a|/2)],      near 0 by their series in |a|^2, so that derivatives exist there

    Args:
        turn: three components a (...), rad.

    Returns:
        four components (...) of a unit quaternion.
    """
    a, b, c = turn
    xp = array_namespace(a, b, c)
    square = a * a + b * b + c * c
    small = square < _SMALL
    angle = xp.sqrt(xp.where(small, xp.ones_like(square), square))  # never 0: no derivative is infinite
    scale = xp.where(
        small, 0.5 - square * (1.0 / 48.0 - square * (1.0 / 3840.0)), xp.sin(0.5 * angle) / angle
    )
    w = xp.where(small, 1.0 - square * (1.0 / 8.0 - square * (1.0 / 384.0)), xp.cos(0.5 * angle))
    return scale * a, scale * b, scale * c, w


def normalise(q: Iterable[Array]) -> Quaternion:
    """The unit quaternion of the same direction; q must not be 0."""
    x, y, z, w = q
    shrink = 1.0 / array_namespace(x).sqrt(x * x + y * y + z * z + w * w)
    return x * shrink, y * shrink, z * shrink, w * shrink


def integrate(q: Iterable[Array], rates: Iterable[Array], dt: float) -> Quaternion:
    """The attitude after dt at constant body rates, with unit norm: q exp(rates dt).

    Args:
        q: four components (...). rates: three components (...) in body axes, rad/s. dt: s.

    Returns:
        four components (...).
    """
    a, b, c = rates
    return normalise(product(q, exponential((dt * a, dt * b, dt * c))))


def euler_angles(q: Iterable[Array]) -> Vector:
    """Roll, pitch and yaw (z-y'-x'' order: yaw first), rad; roll and yaw in -pi..pi, pitch in -pi/2..pi/2.

    The pitch is atan2(s, sqrt(1 - s^2)) with s = 2 (w y - z x) held within -1..1.
    """
    x, y, z, w = q
    xp = array_namespace(x)
    one = xp.ones_like(x)
    s = xp.minimum(xp.maximum(2.0 * (w * y - z * x), -one), one)
    return (
        xp.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        xp.atan2(s, xp.sqrt(1.0 - s * s)),
        xp.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def from_euler_angles(roll: Array, pitch: Array, yaw: Array) -> Quaternion:
    """The quaternion of yaw, then pitch, then roll (rad): the inverse of `euler_angles`."""
    xp = array_namespace(roll, pitch, yaw)
    zero = xp.zeros_like(roll)
    about = [(xp.sin(0.5 * angle), xp.cos(0.5 * angle)) for angle in (roll, pitch, yaw)]
    (sr, cr), (sp, cp), (sy, cy) = about
    return product(product((zero, zero, sy, cy), (zero, sp, zero, cp)), (sr, zero, zero, cr))


def tilt_cosine(q: Iterable[Array]) -> Array:
    """Cosine of the angle between the body's and the world's z axis: 1 level, -1 upside down."""
    x, y, _, _ = q
    return 1.0 - 2.0 * (x * x + y * y)


def random_turn(uniform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions spread evenly over all turns, from uniform numbers in 0..1.

    Args:
        uniform: (n, 3).

    Returns:
        (n, 4), order x, y, z, w.

    Reference: Shoemake 1992, "Uniform random rotations", Graphics Gems III.
    """
    a, b, c = uniform[:, 0], 2.0 * np.pi * uniform[:, 1], 2.0 * np.pi * uniform[:, 2]
    s, t = np.sqrt(1.0 - a), np.sqrt(a)
    return np.stack([s * np.sin(b), s * np.cos(b), t * np.sin(c), t * np.cos(c)], axis=1)
