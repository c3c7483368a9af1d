"""One face for a single environment and a vector of copies: batches in, batches out, and what is known of
them.

A single environment is one copy that is never reset by itself. Used by `collect`, which needs to read
observations, true states, hints and final values in the same way from both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Space
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from beliefgym.envs.system import System

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]
StepResult = tuple[Any, Array, Mask, Mask, dict[str, Any]]


class Copies(ABC):
    """n copies of an environment; every value is a batch with n rows.

    Attributes:
        env: the environment.
        n: number of copies.
        mode: how a finished copy starts again.
        observation_space, action_space: of one copy.

    Raises:
        ValueError: observations that are neither Box nor Discrete, or actions that are not numbers.
    """

    def __init__(
        self,
        env: AnyEnv,
        n: int,
        mode: AutoresetMode,
        observation_space: Space[Any],
        action_space: Space[Any],
    ) -> None:
        if not isinstance(observation_space, Box | Discrete):
            raise ValueError(
                f"expected a Box or Discrete observation space, got {observation_space}; wrap the "
                "environment in gymnasium.wrappers.FlattenObservation"
            )
        if not isinstance(action_space, Box | Discrete | MultiDiscrete | MultiBinary):
            raise ValueError(
                f"expected a Box, Discrete, MultiDiscrete or MultiBinary action space, got {action_space}"
            )
        self.env, self.n, self.mode = env, n, mode
        self.observation_space, self.action_space = observation_space, action_space

    @abstractmethod
    def reset(self, seed: int | list[int | None] | None, mask: Mask | None) -> tuple[Any, dict[str, Any]]:
        """Start all copies (mask None) or some, whose rows alone count: observations (n, ...), infos."""

    @abstractmethod
    def step(self, action: NDArray[Any]) -> StepResult:
        """Observations, rewards (n,), terminations (n,), truncations (n,), infos."""

    @abstractmethod
    def state(self) -> Array | None:
        """(n, n_state) the true states now, or None where they are not known for certain."""

    def declared(self, field: str) -> Any:
        """The value of an attribute on the outermost layer that has it; None where none has."""
        return next(
            (v for layer in _layers(self.env) if (v := getattr(layer, field, None)) is not None), None
        )

    @property
    def system(self) -> System | None:
        """The system of a beliefgym environment."""
        system = self.declared("system")
        return system if isinstance(system, System) else None

    def names(self, field: str, size: int) -> tuple[str, ...] | None:
        """Declared component names, where there are exactly `size` different ones."""
        names = self.declared(field)
        if names is None and field == "state_names" and self.system is not None:
            names = self.system.state_names
        if not isinstance(names, Sequence) or isinstance(names, str):
            return None
        if not all(isinstance(name, str) for name in names) or not len(names) == len(set(names)) == size:
            return None
        return tuple(names)


class SingleCopy(Copies):
    """A `gymnasium.Env` as one copy."""

    env: gym.Env[Any, Any]

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env, 1, AutoresetMode.DISABLED, env.observation_space, env.action_space)

    def reset(self, seed: int | list[int | None] | None, mask: Mask | None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed[0] if isinstance(seed, list) else seed)
        return np.asarray(observation)[None], _one_row(info)

    def step(self, action: NDArray[Any]) -> StepResult:
        observation, reward, terminated, truncated, info = self.env.step(action[0])
        return (
            np.asarray(observation)[None],
            np.array([reward], dtype=np.float64),
            np.array([terminated], dtype=np.bool_),
            np.array([truncated], dtype=np.bool_),
            _one_row(info),
        )

    def state(self) -> Array | None:
        """Taken from `env.get_wrapper_attr("state")` where that is a number or a flat array of numbers."""
        try:
            state = np.asarray(self.env.get_wrapper_attr("state"))
        except (AttributeError, ValueError):
            return None
        return (
            np.array(state, dtype=np.float64).reshape(1, -1)
            if state.dtype.kind in "fiu" and state.ndim < 2
            else None
        )


class VectorCopies(Copies):
    """A `gymnasium.vector.VectorEnv`.

    Raises:
        ValueError: metadata without an autoreset mode.
    """

    env: VectorEnv[Any, Any, Any]

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = (env.metadata or {}).get("autoreset_mode")
        known = [m for m in AutoresetMode if mode in (m, m.value, m.name)]
        if not known:
            raise ValueError(
                f"expected env.metadata['autoreset_mode'] to be one of {[m.name for m in AutoresetMode]}, "
                f"got {mode!r}; a final observation cannot be told from a first one without it"
            )
        super().__init__(env, env.num_envs, known[0], env.single_observation_space, env.single_action_space)

    def reset(self, seed: int | list[int | None] | None, mask: Mask | None) -> tuple[Any, dict[str, Any]]:
        options = None if mask is None else {"reset_mask": mask.copy()}
        return self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]

    def step(self, action: NDArray[Any]) -> StepResult:
        observation, reward, terminated, truncated, infos = self.env.step(action)
        return (
            observation,
            np.array(reward, dtype=np.float64),
            np.array(terminated, dtype=np.bool_),
            np.array(truncated, dtype=np.bool_),
            infos,
        )

    def state(self) -> Array | None:
        """Taken from `env.unwrapped.state`, if `state_names` vouch that its shape is (n, n_state)."""
        state = getattr(self.env.unwrapped, "state", None)
        if not isinstance(state, np.ndarray) or state.ndim != 2 or len(state) != self.n:
            return None
        if self.names("state_names", state.shape[1]) is None:
            return None
        return np.array(state, dtype=np.float64)


def rows_of(infos: dict[str, Any], key: str, rows: NDArray[np.intp]) -> Array | None:
    """(len(rows), k) the entries `infos[key]` of some copies, or None where one of them has none.

    Args:
        infos: of a vector environment: `infos[key]` is an array with a row a copy (or an object array with an
            entry a copy), `infos["_" + key]` says which copies have one.
        key: the entry.
        rows: the copies.
    """
    mask = infos.get(f"_{key}")
    if key not in infos or (mask is not None and not np.asarray(mask)[rows].all()):
        return None
    chosen = np.asarray(infos[key])[rows]
    if chosen.dtype == object:
        if any(value is None for value in chosen):
            return None
        chosen = np.stack([np.asarray(value) for value in chosen])
    return np.array(chosen, dtype=np.float64).reshape(len(rows), -1)


def _layers(env: Any) -> Iterator[Any]:
    """The environment, what it wraps, and so on inward; of a SyncVectorEnv also its first copy's layers."""
    while isinstance(env, gym.Env | VectorEnv):
        yield env
        env = env.envs[0] if isinstance(env, SyncVectorEnv) else getattr(env, "env", None)


def _one_row(info: dict[str, Any]) -> dict[str, Any]:
    """The hint of a single environment's info, as a vector environment of one copy gives it."""
    return {"hint": np.asarray(info["hint"])[None]} if "hint" in info else {}
