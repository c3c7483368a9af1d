"""A simulated flag in the wind: a video texture made by physics, where no recorded video is at hand.

It stands in for the recorded 'Flag' of the thesis proposal's Sec. 3.1.3 and is not it: wherever frames or scores of it
are shown they are to be called simulated. A rectangular cloth, its hoist pinned to a pole, is a 2-D flex of MuJoCo:
triangles with membrane and bending elasticity and Rayleigh damping. MuJoCo's own fluid forces act on bodies with
geoms, not on a flex; so each triangle of area A and unit normal n, in air that moves at v relative to it, gets

    F = rho / 2 A |v| (C_n (v . n) n + C_t (v - (v . n) n)),

a third of it at each vertex: quasi-steady pressure and friction, rho / 2 A C_n v^2 on a plate that faces the wind
and proportional to the sine of the incidence on one nearly along it. With tension T and mass m for each area, a small
deflection w then obeys m w_tt = T w_xx - k (w_t + U w_x), k = rho C_n U / 2, whose waves grow where the wind U is
faster than sqrt(T / m): the flag flaps in a steady wind too. The wind is

    u(t, x) = (U, 0, 0) + g(t - x / U),      dg_i = -g_i / tau dt + sigma_i sqrt(2 / tau) dW_i,

Ornstein-Uhlenbeck gusts carried along the flag at the mean speed.

All numbers are chosen, none is fitted to a video: a large flag (6 m by 4 m) in a gentle breeze, because its waves
are slow enough to be partly predictable over the thesis's step of five frames (ridge regression from 10 to 20
principal components of 80 x 60 grey pixels explains 0.80 of their variance; 28 components hold 80 % of that of the
pixels, 86 hold 90 %). Cloth of 0.2 kg/m^2 and C_n = 1.2 (a plate facing the wind) are of the order of real ones.
The stiffness is what an explicit step of 0.5 ms bears, and keeps 99 % of the edges within 2 % of their length and
all within 6 %; the thickness is an effective one, whose bending stiffness smooths wrinkles near the spacing of the
vertices; C_t is that of a rough surface. The cloth does not touch itself or the pole, and does not move the air.

Integrator: semi-implicit Euler. MuJoCo 3.17 refuses a flex with elasticity under `implicitfast`; its `discrete`
integrator, unknown to older versions, costs eight times as much a step, so that longer steps gain nothing.

Reference: Wejchert and Haumann, Animation aerodynamics, SIGGRAPH 1991 (force for each facet); Taylor, The spectrum
of turbulence, 1938 (gusts carried by the mean wind); MuJoCo's documentation of flexcomp.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter
from scipy.sparse import csr_matrix

from beliefgym.envs.flag_picture import LUMA, FlagPicture
from beliefgym.envs.simulation import NonFiniteError

Floats = NDArray[np.float64]

GRAVITY = 9.81  # m/s^2
POISSON = 0.3
FASTEST = 1e3  # m/s; a vertex as fast as this has diverged
WIND_STEPS = 4  # simulation steps over which the force of the air is held: 2 ms by default


@dataclass(frozen=True, kw_only=True)
class SimulatedFlag:
    """A cloth on a pole in gusty wind, and its video.

    Axes: x along the mean wind, z up; the hoist is at x = 0, z in -height/2..height/2. The vertices go up the hoist
    first, then up each next column.

    Args:
        length, height: of the flag in m.
        columns, rows: vertices along the length and the height.
        area_density: kg/m^2, spread evenly over the vertices.
        stiffness: N/m, Young's modulus times thickness.
        thickness: m, sets the bending stiffness: stiffness thickness^2 / (12 (1 - 0.3^2)) in N m.
        damping: s, Rayleigh's coefficient of the elastic forces.
        air_density: rho in kg/m^3.
        normal_coefficient, friction_coefficient: C_n and C_t.
        wind_speed: U in m/s, at least 0; gusts are everywhere the same at once where it is 0.
        gust: sigma in m/s of each component (along the wind, across it, upwards).
        gust_time: tau in s.
        dt: s between frames.
        substeps: simulation steps in a frame, a multiple of 4.
        warm_up: s of motion before the first frame, in which the flag forgets that it began flat.

    Raises:
        ValueError: a count or number out of its range.
    """

    length: float = 6.0
    height: float = 4.0
    columns: int = 21
    rows: int = 15
    area_density: float = 0.2
    stiffness: float = 16000.0
    thickness: float = 0.015
    damping: float = 1e-4
    air_density: float = 1.2
    normal_coefficient: float = 1.2
    friction_coefficient: float = 0.05
    wind_speed: float = 5.0
    gust: tuple[float, float, float] = (0.8, 0.6, 0.3)
    gust_time: float = 2.0
    dt: float = 1.0 / 25.0
    substeps: int = 80
    warm_up: float = 10.0

    def __post_init__(self) -> None:
        positive = ("length", "height", "area_density", "stiffness", "thickness", "gust_time", "dt")
        for name in positive:
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"expected {name} above 0 and finite, got {getattr(self, name)!r}")
        coefficients = ("damping", "air_density", "normal_coefficient", "friction_coefficient")
        for name in (*coefficients, "wind_speed", "warm_up"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"expected {name} of at least 0 and finite, got {getattr(self, name)!r}")
        if len(self.gust) != 3 or not all(0.0 <= sigma < np.inf for sigma in self.gust):
            raise ValueError(f"expected gust as three numbers of at least 0 in m/s, got {self.gust!r}")
        if min(self.columns, self.rows) < 3:
            raise ValueError(f"expected at least 3 columns and rows, got {self.columns} and {self.rows}")
        if self.substeps < WIND_STEPS or self.substeps % WIND_STEPS:
            raise ValueError(f"expected substeps as a multiple of {WIND_STEPS}, got {self.substeps!r}")

    @property
    def model(self) -> Any:
        """The compiled `mujoco.MjModel`, made once for each flag. Shared: copy it before you change it."""
        return _compiled(self)

    @property
    def rest(self) -> Floats:
        """(n_vertices, 3) the flat flag in m."""
        x = np.linspace(0.0, self.length, self.columns)
        z = np.linspace(-0.5 * self.height, 0.5 * self.height, self.rows)
        return np.column_stack([np.repeat(x, self.rows), np.zeros(x.size * z.size), np.tile(z, x.size)])

    @property
    def triangles(self) -> NDArray[np.int32]:
        """(n_triangles, 3) numbers of vertices."""
        return np.asarray(self.model.flex_elem).reshape(-1, 3)

    @property
    def edges(self) -> NDArray[np.int32]:
        """(n_edges, 2) numbers of vertices."""
        return np.asarray(self.model.flex_edge)

    def simulate(self, seconds: float, seed: int) -> Floats:
        """The cloth's motion.

        Args:
            seconds: of video.
            seed: of the gusts; the frames of a shorter video are the first ones of a longer one.

        Returns:
            (n_frames, n_vertices, 3) positions in m.

        Raises:
            NonFiniteError: the simulation diverged; says when.
        """
        n_frames = round(seconds / self.dt)
        if n_frames < 1:
            raise ValueError(f"expected at least one frame of {self.dt} s, got {seconds!r} s")
        n_before = round(self.warm_up / self.dt)
        frames = np.empty((n_frames, self.columns * self.rows, 3))
        for i, positions in enumerate(self._motion(n_before + n_frames, n_before, seed)):
            if i >= n_before:
                frames[i - n_before] = positions
        return frames

    def aerodynamic_force(self, positions: Floats, velocities: Floats, wind: ArrayLike) -> Floats:
        """The force of the air on each vertex: the module's F.

        Args:
            positions: (n_vertices, 3) in m. velocities: (n_vertices, 3) in m/s.
            wind: (3,), or (n_triangles, 3), in m/s.

        Returns:
            (n_vertices, 3) in N.
        """
        corners, share = positions[self.triangles], _shares(self)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double_area = np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None]
        normal /= np.maximum(double_area, 1e-12)
        relative = np.asarray(wind) - share.T @ velocities
        across = np.einsum("ij,ij->i", relative, normal)[:, None] * normal
        speed = np.sqrt(np.einsum("ij,ij->i", relative, relative))[:, None]
        pressure = self.normal_coefficient * across + self.friction_coefficient * (relative - across)
        return np.asarray(share @ (0.25 * self.air_density * double_area * speed * pressure))

    def render(
        self, positions: Floats, width: int = 320, height: int = 240, *, grey: bool = False
    ) -> NDArray[np.uint8]:
        """Pictures of the flag on its pole before the sky; needs neither a display nor OpenGL.

        Args:
            positions: (n_frames, n_vertices, 3) in m.
            width, height: pixels.
            grey: one channel of luminance instead of three of colour.

        Returns:
            (n_frames, height, width, 3), or (n_frames, height, width) in grey.
        """
        expected = (self.columns * self.rows, 3)
        if positions.ndim != 3 or positions.shape[1:] != expected:
            raise ValueError(f"expected positions (n_frames, {expected[0]}, 3), got shape {positions.shape}")
        picture = FlagPicture(self.columns, self.rows, self.length, self.height, (width, height))
        frames = np.empty(
            (len(positions), height, width) if grey else (len(positions), height, width, 3), np.uint8
        )
        for i, vertices in enumerate(positions):
            frame = picture.frame(vertices)
            frames[i] = np.round(frame @ LUMA) if grey else frame
        return frames

    def video(
        self, seconds: float, seed: int, width: int = 320, height: int = 240, *, grey: bool = False
    ) -> NDArray[np.uint8]:
        """`simulate`, then `render`; call what you show of it simulated.

        Returns:
            (n_frames, height, width, 3), or (n_frames, height, width) in grey.
        """
        return self.render(self.simulate(seconds, seed), width, height, grey=grey)

    def _motion(self, n_frames: int, n_before: int, seed: int) -> Iterator[Floats]:
        """The positions at the start of each frame, always in the same array."""
        model, pinned, triangles = self.model, self.rows, self.triangles
        data = mujoco.MjData(model)
        step = WIND_STEPS * model.opt.timestep
        per_frame = self.substeps // WIND_STEPS
        lag = 1.0 / (self.wind_speed * step) if self.wind_speed else 0.0  # in wind steps for each m
        start = int(np.ceil(lag * self.length)) + 1  # the gust that has just reached the fly at time 0
        gusts = self._gusts(start + n_frames * per_frame + 2, step, seed)
        rest = self.rest
        positions, velocities = rest.copy(), np.zeros_like(rest)
        # three slide joints along the axes for each vertex that is free
        moved, speed, force = (a.reshape(-1, 3) for a in (data.qpos, data.qvel, data.qfrc_applied))
        for k in range(n_frames * per_frame):
            if k % per_frame == 0:
                yield positions
            x = np.clip(positions[triangles, 0].mean(axis=1), 0.0, self.length)
            age = start + k - lag * x
            before = age.astype(np.int64)
            part = (age - before)[:, None]
            wind = (1.0 - part) * gusts[before] + part * gusts[before + 1]
            force[:] = self.aerodynamic_force(positions, velocities, wind)[pinned:]
            mujoco.mj_step(model, data, WIND_STEPS)
            fastest = np.abs(speed).max()
            if not fastest < FASTEST:
                raise NonFiniteError(
                    f"the simulated flag diverged at t = {(k + 1) * step - n_before * self.dt:.3f} s (the first frame "
                    f"is at 0): expected vertices below {FASTEST:g} m/s, got {fastest:g} m/s; take more substeps "
                    f"than {self.substeps}, or less stiffness, damping or wind"
                )
            positions[pinned:] = rest[pinned:] + moved
            velocities[pinned:] = speed

    def _gusts(self, n: int, step: float, seed: int) -> Floats:
        """(n, 3) the wind (U, 0, 0) + g in m/s: the exact recursion of the process, from its stationary law."""
        white = np.random.default_rng(np.random.SeedSequence(seed)).standard_normal((n, 3))
        keep = np.exp(-step / self.gust_time)
        white[1:] *= np.sqrt(1.0 - keep**2)
        return np.asarray(
            lfilter([1.0], [1.0, -keep], white, axis=0) * self.gust + [self.wind_speed, 0.0, 0.0]
        )


@lru_cache(maxsize=8)
def _compiled(flag: SimulatedFlag) -> Any:
    dx, dz = flag.length / (flag.columns - 1), flag.height / (flag.rows - 1)
    xml = f"""
    <mujoco model="simulated flag">
      <option timestep="{flag.dt / flag.substeps}" integrator="Euler" gravity="0 0 {-GRAVITY}">
        <flag contact="disable"/>
      </option>
      <worldbody>
        <flexcomp name="cloth" type="grid" dim="2" count="{flag.columns} {flag.rows} 1" spacing="{dx} {dz} 1"
            mass="{flag.area_density * flag.length * flag.height}" radius="0.005"
            pos="{0.5 * flag.length} 0 0" xyaxes="1 0 0 0 0 1">
          <elasticity young="{flag.stiffness / flag.thickness}" poisson="{POISSON}" thickness="{flag.thickness}"
              damping="{flag.damping}" elastic2d="both"/>
          <contact selfcollide="none"/>
          <pin gridrange="0 0 0 {flag.rows - 1}"/>
        </flexcomp>
      </worldbody>
    </mujoco>"""
    spec = mujoco.MjSpec.from_string(xml)
    # without this MuJoCo answers a diverged step with a silent reset to the model's initial state
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return spec.compile()


@lru_cache(maxsize=8)
def _shares(flag: SimulatedFlag) -> Any:
    """(n_vertices, n_triangles) sparse: a third where the triangle has the vertex."""
    triangles = flag.triangles
    numbers = np.repeat(np.arange(len(triangles)), 3)
    shape = (flag.columns * flag.rows, len(triangles))
    return csr_matrix((np.full(triangles.size, 1.0 / 3.0), (triangles.ravel(), numbers)), shape=shape)
