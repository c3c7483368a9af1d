"""The picture of a flag on its pole, by numpy alone: no display, no OpenGL, the same on every machine.

The vertices of the cloth are interpolated by cubic splines to a lattice finer than the pixels (an orthographic
projection is linear, so pixels and depths are interpolated, not points in space). Of the lattice points that fall
on a pixel the nearest is kept, and has the light

    s = a + b |n . l|      on the side that the sun shines on,      s = a + t b |n . l|      on the other

of a thin, translucent Lambert surface with unit normal n, direction l to the sun, ambient light a, diffuse light b
and transmission t. Every side of a pixel is divided by `smoothing` and averaged. The design is nobody's flag.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter, map_coordinates

from beliefgym.envs.projection import Camera

Floats = NDArray[np.float64]

CAMERA = Camera(
    azimuth=-np.pi / 2 - 0.35, elevation=-0.12
)  # before the flag, a little to the pole's side and below
SUN = np.array(
    [-0.45, -0.65, 0.61]
)  # towards the sun; the wind blows along x, the viewer stands at negative y
AMBIENT, DIFFUSE, TRANSMISSION = 0.34, 0.86, 0.45
LUMA = np.array([0.299, 0.587, 0.114])  # grey of red, green and blue (ITU-R BT.601)
INDIGO, CREAM, RUST, GOLD = (38, 58, 122), (246, 238, 220), (200, 72, 44), (240, 176, 48)
POLE_RADIUS = 0.018  # in lengths of the flag
SAMPLE = 0.6  # lattice spacing in pixels; less than 1 / sqrt(2), so that no pixel of the cloth is missed
SHADE = 4  # lattice cells of the light in one of the cloth's


class FlagPicture:
    """Pictures of one size.

    Args:
        columns, rows: vertices of the cloth along its length and height.
        length, height: of the flag in m; its hoist stands at x = 0 and z in -height/2..height/2.
        pixels: (width, height) of the picture.
        smoothing: pixels drawn for each pixel shown, along each side.
    """

    def __init__(
        self,
        columns: int,
        rows: int,
        length: float,
        height: float,
        pixels: tuple[int, int],
        smoothing: int = 2,
    ) -> None:
        if min(pixels) < 1 or smoothing < 1:
            raise ValueError(f"expected at least 1 pixel and 1 of smoothing, got {pixels} and {smoothing}")
        self._grid = (columns, rows)
        self._smoothing = smoothing
        self._size = (pixels[0] * smoothing, pixels[1] * smoothing)
        self._center = np.array([0.46 * length, -0.06 * height])
        # as large as the whole of the flag and a margin allow
        self._scale = min(self._size[0] / (1.22 * length), self._size[1] / (1.5 * height))  # pixels per m
        fine = [int(np.ceil(side * self._scale / SAMPLE)) + 1 for side in (length, height)]
        light = [SHADE * (n - 1) + 1 for n in self._grid]
        self._spline = [_spline(n, f) for n, f in zip(self._grid, fine, strict=True)]
        self._light_spline = [_spline(n, f) for n, f in zip(self._grid, light, strict=True)]
        self._light_slope = [_spline(n, f, 1) for n, f in zip(self._grid, light, strict=True)]
        self._fine = fine
        self._design = _design(fine[0], fine[1]).reshape(-1, 3)
        self._background = self._draw_background(length, height)
        places, depth = CAMERA.project(np.eye(3))
        self._view = np.column_stack([places, depth])  # (3, 3): right, up, away

    def frame(self, vertices: Floats) -> NDArray[np.uint8]:
        """One picture.

        Args:
            vertices: (columns * rows, 3) in m, the rows of a column one after the other from below.

        Returns:
            (height, width, 3).
        """
        grid = vertices.reshape(*self._grid, 3)
        seen = _lattice(self._spline[0], self._spline[1], grid @ self._view)
        width, height = self._size
        x = np.floor(width / 2 + (seen[..., 0] - self._center[0]) * self._scale).astype(np.int64).ravel()
        y = np.floor(height / 2 - (seen[..., 1] - self._center[1]) * self._scale).astype(np.int64).ravel()
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixel = (y * width + x)[inside]
        # depth in steps of 0.1 mm before the number of the lattice point: the smallest is the nearest
        depth = np.round((seen[..., 2].ravel()[inside] + 1e3) * 1e4).astype(np.int64)
        nearest = np.full(width * height, np.iinfo(np.int64).max)
        np.minimum.at(nearest, pixel, (depth << 32) | np.flatnonzero(inside))
        covered = np.flatnonzero(nearest != np.iinfo(np.int64).max)
        point = nearest[covered] & 0xFFFFFFFF
        image = self._background.copy()
        image[covered] = self._design[point] * self._light(grid, point)[:, None]
        k = self._smoothing
        image = image.reshape(height // k, k, width // k, k, 3).mean(axis=(1, 3))
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def _light(self, grid: Floats, point: NDArray[np.int64]) -> Floats:
        """The light at points of the lattice, linear between those of a coarser one."""
        along = _lattice(self._light_slope[0], self._light_spline[1], grid)
        up = _lattice(self._light_spline[0], self._light_slope[1], grid)
        normal = np.cross(along, up)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-12
        sun = normal @ (SUN / np.linalg.norm(SUN))
        front = sun * (normal @ self._view[:, 2]) < 0.0  # sun and viewer on one side
        light = AMBIENT + DIFFUSE * np.where(front, 1.0, TRANSMISSION) * np.abs(sun)
        i, j = (
            number * ((coarse - 1) / (fine - 1))
            for number, coarse, fine in zip(
                np.divmod(point, self._fine[1]), light.shape, self._fine, strict=True
            )
        )
        return np.asarray(map_coordinates(light, [i, j], order=1, mode="nearest"))

    def _draw_background(self, length: float, height: float) -> Floats:
        """(pixels, 3): sky with soft clouds, and the pole with its knob."""
        wide, high = self._size
        image = _sky(wide, high)
        x = self._center[0] + (np.arange(wide) + 0.5 - wide / 2) / self._scale
        y = self._center[1] - (np.arange(high) + 0.5 - high / 2) / self._scale
        radius = POLE_RADIUS * length
        top = 0.5 * height + 2.0 * radius
        across = (x + radius) / radius
        metal = 120.0 + 110.0 * np.sqrt(np.clip(1.0 - (across + 0.35) ** 2, 0.0, 1.0))
        pole = (np.abs(across) < 1.0)[None, :] & (y < top)[:, None]
        image[pole] = np.broadcast_to(metal[None, :, None], image.shape)[pole]
        right, up = (x[None, :] + radius) / (2.0 * radius), (y[:, None] - top - radius) / (2.0 * radius)
        knob = right**2 + up**2 < 1.0
        facing = np.sqrt(np.clip(1.0 - right**2 - up**2, 0.0, 1.0))
        shine = np.clip(0.35 + 0.75 * (0.6 * facing - 0.5 * right + 0.6 * up), 0.3, 1.15)
        image[knob] = (shine[..., None] * np.array(GOLD))[knob]
        return image.reshape(-1, 3)


def _lattice(along: Floats, up: Floats, values: Floats) -> Floats:
    """(columns, rows, 3) to (fine columns, fine rows, 3) by one matrix for each direction."""
    n_columns, n_rows, k = values.shape
    stretched = (along @ values.reshape(n_columns, -1)).reshape(len(along), n_rows, k)
    return np.asarray(np.matmul(up, stretched))


def _spline(n: int, fine: int, slope: int = 0) -> Floats:
    """(fine, n) matrix of the cubic spline (or its slope) through n equidistant values."""
    spline = make_interp_spline(np.arange(n), np.eye(n), k=min(3, n - 1))
    return np.ascontiguousarray(spline(np.linspace(0.0, n - 1, fine), nu=slope))


def _design(fine_columns: int, fine_rows: int) -> Floats:
    """(fine columns, fine rows, 3) colours: a band with a golden ring and disc at the hoist, five stripes, a hem."""
    u, v = np.linspace(0.0, 1.5, fine_columns)[:, None], np.linspace(0.0, 1.0, fine_rows)[None, :]
    stripe = np.floor(5.0 * np.clip(v, 0.0, 0.999)).astype(int) % 2
    color = np.where((stripe == 0)[..., None], np.array(RUST), np.array(CREAM)) + np.zeros((len(u), 1, 1))
    color[u[:, 0] < 0.58] = INDIGO
    distance = np.hypot(u - 0.29, v - 0.5)
    color[(distance < 0.12) | ((distance > 0.165) & (distance < 0.205))] = GOLD
    hem = (u > 1.5 - 0.025) | (v < 0.02) | (v > 0.98)
    color[hem] *= 0.88
    return np.asarray(color)


def _sky(width: int, height: int) -> Floats:
    """(height, width, 3) a clear sky, paler towards the horizon, with a few thin clouds."""
    down = np.linspace(0.0, 1.0, height)[:, None, None]
    sky = (1.0 - down) * np.array([98.0, 156.0, 212.0]) + down * np.array([222.0, 234.0, 243.0])
    noise = np.random.default_rng(8).normal(size=(120, 160))
    cloud = sum(s * gaussian_filter(noise, (0.45 * s, s), mode="wrap") for s in (3.0, 7.0, 14.0))
    cloud = np.clip((cloud - cloud.mean()) / cloud.std() - 0.35, 0.0, 2.0) / 2.0
    rows, columns = np.linspace(0, 119, height).astype(int), np.linspace(0, 159, width).astype(int)
    cover = gaussian_filter(cloud[np.ix_(rows, columns)], width / 160)[..., None]
    return np.asarray(sky + 0.75 * cover * (250.0 - sky))
