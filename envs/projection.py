"""A camera for systems that move in space: points (k, 3) in metres to points on a `Canvas`, and their distance.

The picture is an orthographic projection: with unit vectors e_right, e_up and e_away of the camera,

    (x, y) = (p . e_right, p . e_up),      depth = p . e_away        (larger is farther: draw it first)

World axes: z upwards. A system that counts z downwards (NED) turns its points over first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Camera:
    """Where the viewer stands.

    Args:
        azimuth: rad, from which side: 0 looks along -x (the viewer stands on the x axis), pi/2 along -y.
        elevation: rad above the horizon, in -pi/2..pi/2.
    """

    azimuth: float
    elevation: float

    def project(self, points: ArrayLike) -> tuple[list[tuple[float, float]], NDArray[np.float64]]:
        """Points (k, 3) or (3,) -> k places (x, y) in the picture's plane in m, and depths (k,) in m."""
        array = np.atleast_2d(np.asarray(points, dtype=float))
        if array.shape[1] != 3:
            raise ValueError(f"expected points (k, 3), got shape {array.shape}")
        a, e = self.azimuth, self.elevation
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        away = -np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        up = np.array([-np.cos(a) * np.sin(e), -np.sin(a) * np.sin(e), np.cos(e)])
        return [(float(x), float(y)) for x, y in zip(array @ right, array @ up, strict=True)], array @ away
