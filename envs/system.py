"""A system: pure, batched dynamics with named states, from which environments, experts and models are made.

A system is a frozen dataclass whose fields are its physical parameters. Its functions know no randomness and
no time; they take arrays (..., n) of numpy or torch (the array API), so that one text serves the single
environment, the batch of thousands of copies, the planner's derivatives and a physics filter:

    s_{t+1} = P(f(s_t, u_t + sigma_u eps_u, sigma_d eps_d) + sigma_s eps_s)
    y_t = h(s_t),     r_t = r(s_t, u_t, s_{t+1})

with u_t clipped to the action limits, eps standard normal, d the disturbances that a system names (forces of the
wind, a drifting bias), and P the way back to a possible state (unit quaternions). To add a system: write one file
with one subclass, and one call in catalogue.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas

Array = Any  # an array of any namespace of the array API


@dataclass(frozen=True, kw_only=True)
class System(ABC):
    """Base class of all systems; the parameters that every system has.

    Args:
        dt: control period in s.
        process_noise_std: standard deviation of the noise added to the state after each step, in the units of
            the state; one number for all components, or one each.
        actuation_noise_std: standard deviation of the noise added to the clipped action, in its units; one
            number, or one for each action.

    Raises:
        ValueError: a non-positive dt, a negative or non-finite noise, or a list of the wrong length.
    """

    dt: float = 0.05
    process_noise_std: float | tuple[float, ...] = 0.0
    actuation_noise_std: float | tuple[float, ...] = 0.0

    state_names: ClassVar[tuple[str, ...]]
    action_names: ClassVar[tuple[str, ...]]
    observation_names: ClassVar[tuple[str, ...]]
    disturbance_names: ClassVar[tuple[str, ...]] = ()
    hint_names: ClassVar[tuple[str, ...] | None] = None  # None: the hint is the whole state
    rates: ClassVar[
        Mapping[str, str]
    ] = {}  # position -> velocity, by name: what a filter of positions estimates
    quaternions: ClassVar[tuple[int, ...]] = ()  # where in the state a unit quaternion begins

    def __post_init__(self) -> None:
        if not self.dt > 0:
            raise ValueError(f"expected dt above 0 s, got {self.dt!r}")
        for name, size in (("process_noise_std", self.n_state), ("actuation_noise_std", self.n_action)):
            value = getattr(self, name)
            if not isinstance(value, int | float):
                object.__setattr__(self, name, tuple(float(v) for v in value))
            std = np.asarray(getattr(self, name), dtype=float)
            if std.ndim and len(std) != size:
                raise ValueError(f"expected {name} as one number or {size} of them, got {len(std)}")
            if not (np.isfinite(std).all() and (std >= 0).all()):
                raise ValueError(f"expected {name} finite and at least 0, got {value!r}")

    @property
    def n_state(self) -> int:
        """Number of state components."""
        return len(self.state_names)

    @property
    def n_action(self) -> int:
        """Number of action components."""
        return len(self.action_names)

    @property
    def noise_size(self) -> int:
        """Standard normal numbers that one step takes: those of actions, states, disturbances whose std is not 0."""
        return int(np.count_nonzero(self._noise_scale))

    @property
    def disturbance_std(self) -> tuple[float, ...]:
        """Standard deviation of each disturbance, drawn afresh at every step, in its units."""
        return ()

    @property
    def _noise_scale(self) -> NDArray[np.float64]:
        return np.concatenate(
            [
                np.broadcast_to(np.asarray(self.actuation_noise_std, dtype=float), self.n_action),
                np.broadcast_to(np.asarray(self.process_noise_std, dtype=float), self.n_state),
                np.asarray(self.disturbance_std, dtype=float),
            ]
        )

    @property
    @abstractmethod
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest action, each (n_action,)."""

    @property
    @abstractmethod
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounds of the full observation, each (n_observation,); infinite where there is none."""

    @property
    def state_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest possible start state, each (n_state,); infinite unless a system says so."""
        return np.full(self.n_state, -np.inf), np.full(self.n_state, np.inf)

    @abstractmethod
    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """The state one control period later, without noise and without limits on the action.

        Args:
            state: (..., n_state).
            action: (..., n_action).
            disturbance: (..., n_disturbance) in their units, or None for none; a system that names no disturbances
                may leave the argument out.

        Returns:
            (..., n_state).
        """

    def project(self, state: Array) -> Array:
        """The possible state nearest to one that noise was added to: quaternions get their unit norm back."""
        if not self.quaternions:
            return state
        xp = array_namespace(state)
        parts = [state[..., i] for i in range(self.n_state)]
        for start in self.quaternions:
            q = parts[start : start + 4]
            norm = xp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
            parts[start : start + 4] = [component / norm for component in q]
        return xp.stack(parts, axis=-1)

    def hint(self, state: Array) -> Array:
        """What `info["hint"]` holds, (..., n_hint): the state, unless a system names other privileged quantities."""
        return state

    @abstractmethod
    def observe(self, state: Array) -> Array:
        """The full observation of a state: (..., n_state) -> (..., n_observation)."""

    @abstractmethod
    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Reward of a transition; the action is clipped to its limits already. Shape (...)."""

    @abstractmethod
    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Start states drawn from the start distribution, (n, n_state); only rows of the mask are drawn."""

    def terminated(self, state: Array) -> Array:
        """Where the task ends for good, bool (...); nowhere unless a system says so."""
        xp = array_namespace(state)
        return xp.zeros(state.shape[:-1], dtype=xp.bool, device=state.device)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """What planners minimise, (...); the negative reward unless a system names a smoother one."""
        return -self.reward(state, action, state)

    def clip(self, action: Array) -> Array:
        """The action within its limits, same shape."""
        xp = array_namespace(action)
        low, high = self.action_limits
        if xp.__name__.endswith("numpy"):
            return np.minimum(np.maximum(action, low), high)
        return xp.minimum(xp.maximum(action, constant(low, action)), constant(high, action))

    def step(self, state: Array, action: Array, noise: Array | None = None) -> Array:
        """One control period with limits and noise.

        Args:
            state: (..., n_state).
            action: (..., n_action), clipped to its limits here.
            noise: (..., noise_size) standard normal numbers, or None for none.

        Returns:
            (..., n_state).
        """
        action = self.clip(action)
        if noise is None:
            return self.flow(state, action)
        m, n = self.n_action, self.n_state
        action_noise = self._noise_part(noise, 0, m)
        state_noise = self._noise_part(noise, m, m + n)
        disturbance = self._noise_part(noise, m + n, len(self._noise_scale))
        if action_noise is not None:
            action = action + action_noise
        moved = self.flow(state, action) if disturbance is None else self.flow(state, action, disturbance)
        return moved if state_noise is None else self.project(moved + state_noise)

    def _noise_part(self, noise: Array, start: int, stop: int) -> Array | None:
        """Components start..stop of the scaled noise, of which only those whose std is not 0 were drawn."""
        scale = self._noise_scale
        if not scale[start:stop].any():
            return None
        xp = array_namespace(noise)
        first = int(np.count_nonzero(scale[:start]))
        if scale[start:stop].all():
            return noise[..., first : first + stop - start] * constant(scale[start:stop], noise)
        drawn = iter(range(first, self.noise_size))
        nothing = xp.zeros_like(noise[..., 0])
        parts = [noise[..., next(drawn)] * float(std) if std else nothing for std in scale[start:stop]]
        return xp.stack(parts, axis=-1)

    def expert(self) -> Any:
        """A controller that knows the true model and the full state; see planning/.

        Returns:
            an object with `act(state, restart) -> action`, batched: state (n, n_state), restart (n,) bool where a
            new episode has begun (its plan is made anew), action (n, n_action) within the limits.
        """
        raise ValueError(f"{type(self).__name__} has no expert; override System.expert to give it one")

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """Draw one state (n_state,) and the last action (n_action,) on a canvas."""
        raise ValueError(f"{type(self).__name__} has no picture; override System.draw to give it one")


def constant(values: NDArray[np.float64], like: Array) -> Array:
    """Numbers (k,) as an array of the namespace, type and device of another."""
    return array_namespace(like).asarray(values, dtype=like.dtype, device=like.device)


def wrap_angle(angle: Array) -> Array:
    """The same angle in [-pi, pi)."""
    return angle - 2.0 * np.pi * array_namespace(angle).floor(angle / (2.0 * np.pi) + 0.5)


def build_system(system_class: type[System], parameters: dict[str, Any]) -> System:
    """A system from its class and parameters by name.

    Raises:
        TypeError: an unknown parameter; the message names the nearest and lists all.
    """
    known = [field.name for field in fields(system_class)]
    for name in parameters:
        if name not in known:
            near = get_close_matches(name, known, n=1)
            raise TypeError(
                f"{system_class.__name__} has no parameter {name!r}"
                + (f"; did you mean {near[0]!r}?" if near else "")
                + f" (its parameters: {', '.join(known)})"
            )
    arguments: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in parameters.items()}
    return system_class(**arguments)
