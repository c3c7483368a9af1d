"""The previous actions as a part of the observation.

Where the observation is partial, what was done tells about what cannot be seen; and under a delay of k steps
the last k actions are what the agent must know besides the late observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from beliefgym.wrappers.components import action_names
from beliefgym.wrappers.transform import Interface, Mask, ObservationTransform, TransformObservation


class AppendActions(ObservationTransform):
    """y_t = (x_t, a_{t-1}, ..., a_{t-k}), batched; see `ActionHistory`."""

    def __init__(self, below: Interface, length: int) -> None:
        space = below.observation_space
        if not np.issubdtype(space.dtype, np.floating):
            raise TypeError(
                f"an action history needs an observation of floating-point numbers, got {space.dtype}; "
                "put gymnasium.wrappers.DtypeObservation(env, numpy.float32) around the environment first"
            )
        self._encode = ActionCode(below, space.dtype)
        low, high = np.tile(self._encode.low, length), np.tile(self._encode.high, length)
        history = [
            f"previous_action_{lag}[{part}]" for lag in range(1, length + 1) for part in self._encode.names
        ]
        super().__init__(
            Box(
                np.concatenate([space.low, np.minimum(low, 0)]),
                np.concatenate([space.high, np.maximum(high, 0)]),
                dtype=space.dtype.type,
            ),
            below.observation_names + _distinct(history, below.observation_names),
        )
        self._history = np.zeros((below.n, len(history)), dtype=space.dtype)  # newest first

    def reset(
        self, observations: NDArray[Any], mask: Mask = None, seeds: Sequence[int | None] | None = None
    ) -> NDArray[Any]:
        """The first observations and zeros."""
        self._history[slice(None) if mask is None else mask] = 0
        return np.concatenate([observations, self._history], axis=1)

    def step(self, observations: NDArray[Any], actions: NDArray[Any], mask: Mask = None) -> NDArray[Any]:
        """The observations and the actions that led to them, newest first."""
        newest = self._encode(actions)
        width = newest.shape[1]
        self._history[:, width:] = self._history[:, :-width]
        self._history[:, :width] = newest
        return np.concatenate([observations, self._history], axis=1)


class ActionCode:
    """Actions as vectors of real numbers: those of a Box as they are, discrete ones one-hot.

    Args:
        below: the interface of the environment.
        dtype: of the code.

    Raises:
        TypeError: an action space other than Box, Discrete, MultiBinary or a one-dimensional MultiDiscrete.
    """

    def __init__(self, below: Interface, dtype: np.dtype[Any]) -> None:
        space = below.action_space
        self._dtype = dtype
        self._limits: tuple[Any, Any]
        self._first: NDArray[Any] | None = None  # of discrete actions: where the code of the choice 0 stands
        if isinstance(space, Box):
            self._limits = space.low.ravel().astype(dtype), space.high.ravel().astype(dtype)
            self.low, self.high = self._limits
            self.names = action_names(below.env, self.low.size)
            return
        if isinstance(space, MultiBinary):
            size = int(np.prod(space.shape))
            self._limits = np.zeros(size, dtype), np.ones(size, dtype)
            self.low, self.high = self._limits
            self.names = action_names(below.env, size)
            return
        if isinstance(space, Discrete):
            start, count = np.array([space.start]), np.array([space.n])
        elif isinstance(space, MultiDiscrete) and len(space.shape) == 1:
            start, count = space.start, space.nvec
        else:
            raise TypeError(
                f"expected a Box, Discrete, MultiBinary or 1-D MultiDiscrete action space, got {space}; "
                "put gymnasium.wrappers.TransformAction around the environment first"
            )
        self._limits = start, start + count - 1
        self._first = np.cumsum(count) - count - start
        self.low, self.high = np.zeros(count.sum(), dtype), np.ones(count.sum(), dtype)
        self.names = tuple(
            f"{name}={first + i}"
            for name, first, n in zip(action_names(below.env, len(count)), start, count, strict=True)
            for i in range(n)
        )

    def __call__(self, actions: NDArray[Any]) -> NDArray[Any]:
        """(n, ...) actions -> (n, n_code), clipped into the action space."""
        flat = np.clip(actions.reshape(len(actions), -1), *self._limits)
        if self._first is None:
            return flat.astype(self._dtype, copy=False)
        code = np.zeros((len(flat), len(self.low)), self._dtype)
        code[np.arange(len(flat))[:, None], flat.astype(np.intp) + self._first] = 1
        return code


class ActionHistory(TransformObservation):
    """Appends the previous k actions to the observation, newest first.

    y_t = (x_t, a_{t-1}, a_{t-2}, ..., a_{t-k}),  a_s = 0 for s < 0

    Here x_t is the observation after a_{t-1}. A Box action is appended as it was given, clipped to its
    bounds; a discrete one as a one-hot vector (all zeros before the first). The components are called
    `previous_action_1[torque]`, `previous_action_1[action_0=2]`, ...

    Args:
        env: an environment with a one-dimensional Box observation of floating-point numbers.
        length: the number k of actions, at least 1.

    Raises:
        TypeError: a vector environment, another observation or action space, or length that is not an
            integer.
        ValueError: a length below 1.
    """

    def __init__(self, env: gym.Env[Any, Any], length: int) -> None:
        length = check_length(length)
        RecordConstructorArgs.__init__(self, length=length)
        super().__init__(env, partial(AppendActions, length=length))


def check_length(length: int) -> int:
    """The length as a Python integer; raises TypeError or ValueError as `ActionHistory` says."""
    if isinstance(length, bool) or not isinstance(length, int | np.integer):
        raise TypeError(f"expected the length as a number of actions (an int), got {length!r}")
    if length < 1:
        raise ValueError(
            f"expected a length of at least 1 action, got {length}; leave the wrapper out for none"
        )
    return int(length)


def _distinct(new: list[str], taken: tuple[str, ...]) -> tuple[str, ...]:
    """The new names, with `#2`, `#3`, ... where a history lies on a history."""
    names, repeat = new, 1
    while set(names) & set(taken):
        repeat += 1
        names = [f"{name}#{repeat}" for name in new]
    return tuple(names)
