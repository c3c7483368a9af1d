"""From what an environment shows to coordinates that a dynamics model and a regulator can work in, and back.

Components are recognised by their names. A pair cos_X, sin_X becomes the angle X in rad; four components q_x, q_y, q_z,
q_w of an attitude become the three of the error vec(q*^-1 q) to a target attitude q*, of the shorter turn; all others
stay as they are. From the coordinates a system's state is put together where every component of it is among them, so
that the system's own stage cost is a cost of the coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.quaternions import conjugate, product
from beliefgym.envs.system import System

Floats = NDArray[np.float64]
ATTITUDE = ("q_x", "q_y", "q_z", "q_w")
ERROR = ("q_error_x", "q_error_y", "q_error_z")


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The map of one environment.

    Attributes:
        observation_names: (k,) what is shown. names: (d,) the coordinates.
        angles: which coordinates are angles in rad.
        target_attitude: q* (x, y, z, w), or None where there is no attitude.
    """

    observation_names: tuple[str, ...]
    names: tuple[str, ...]
    angles: tuple[int, ...]
    target_attitude: tuple[float, ...] | None = None

    @classmethod
    def of(cls, observation_names: Sequence[str], system: System | None = None) -> Coordinates:
        """From the observation's names; the target attitude is that of `system.trim`, or no turn at all."""
        shown = tuple(observation_names)
        names: list[str] = []
        angles: list[int] = []
        attitude: tuple[float, ...] | None = None
        for name in shown:
            angle = name[4:]
            if name.startswith("cos_") and f"sin_{angle}" in shown:
                angles.append(len(names))
                names.append(angle)
            elif name.startswith("sin_") and f"cos_{angle}" in shown:
                continue
            elif name in ATTITUDE and set(ATTITUDE) <= set(shown):
                if name == ATTITUDE[0]:
                    names += ERROR
                    attitude = (0.0, 0.0, 0.0, 1.0)
                    trim = getattr(system, "trim", None)
                    if trim is not None and system is not None:
                        attitude = tuple(float(trim[system.state_names.index(q)]) for q in ATTITUDE)
            else:
                names.append(name)
        return cls(shown, tuple(names), tuple(angles), attitude)

    @property
    def size(self) -> int:
        """d."""
        return len(self.names)

    def encode(self, observation: ArrayLike) -> Floats:
        """Observations (..., k) -> coordinates (..., d).

        Raises:
            ValueError: another number of components.
        """
        y = np.asarray(observation, dtype=np.float64)
        if y.shape[-1:] != (len(self.observation_names),):
            raise ValueError(
                f"expected observations (..., {len(self.observation_names)}) as {self.observation_names}, got shape "
                f"{y.shape}"
            )
        column = {name: y[..., i] for i, name in enumerate(self.observation_names)}
        error: list[Any] = []
        if self.target_attitude is not None:
            x, y_, z, w = product(conjugate(list(self.target_attitude)), [column[q] for q in ATTITUDE])
            side = np.where(w < 0.0, -1.0, 1.0)
            error = [side * x, side * y_, side * z]
        found = []
        for i, name in enumerate(self.names):
            if i in self.angles:
                found.append(np.arctan2(column[f"sin_{name}"], column[f"cos_{name}"]))
            elif name in ERROR and self.target_attitude is not None:
                found.append(error[ERROR.index(name)])
            else:
                found.append(column[name])
        return np.stack(found, axis=-1)

    def cost_of(self, system: System, derived: Mapping[str, str] | None = None) -> StateCost:
        """The system's stage cost, of coordinates.

        Args:
            system: whose state is put together from coordinates of the same names.
            derived: state name -> name of the coordinate that stands for it, where it has another one.

        Raises:
            ValueError: a state component that is not among the coordinates; names it.
        """
        sources = dict(derived or {})
        missing = []
        columns: list[int | None] = []
        for name in system.state_names:
            source = sources.get(name, name)
            if name in ATTITUDE and self.target_attitude is not None:
                columns.append(None)
            elif source in self.names:
                columns.append(self.names.index(source))
            else:
                missing.append(name)
        if missing:
            raise ValueError(
                f"expected to find the state of {type(system).__name__} among the coordinates {self.names}, but "
                f"{missing} {'is' if len(missing) == 1 else 'are'} not there; give a cost of the coordinates: "
                "cost=function(x (..., d), u (..., m)) -> (...)"
            )
        return StateCost(self, system.stage_cost, system.state_names, tuple(columns))


@dataclass(frozen=True, eq=False)
class StateCost:
    """A system's stage cost as a function of coordinates, on numpy and torch; see `Coordinates.cost_of`."""

    coordinates: Coordinates
    stage_cost: Callable[[Any, Any], Any]
    state_names: tuple[str, ...]
    columns: tuple[int | None, ...]

    def __call__(self, x: Any, u: Any) -> Any:
        """(..., d), (..., m) -> (...)."""
        return self.stage_cost(self.state(x), u)

    def state(self, x: Any) -> Any:
        """The system's state at coordinates: (..., d) -> (..., n)."""
        xp = array_namespace(x)
        attitude: dict[str, Any] = {}
        if self.coordinates.target_attitude is not None:
            first = self.coordinates.names.index(ERROR[0])
            error = [x[..., first + i] for i in range(3)]
            rest = 1.0 - (error[0] * error[0] + error[1] * error[1] + error[2] * error[2])
            w = xp.sqrt(xp.where(rest > 1e-12, rest, 0.0 * rest + 1e-12))
            turned = product(list(self.coordinates.target_attitude), [*error, w])
            attitude = dict(zip(ATTITUDE, turned, strict=True))
        parts = [
            attitude[name] if column is None else x[..., column]
            for name, column in zip(self.state_names, self.columns, strict=True)
        ]
        return xp.stack(parts, axis=-1)
