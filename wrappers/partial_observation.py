"""Some components of the observation only: the plainest way to make a task partially observed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from beliefgym.wrappers.components import plain_keep, select_components
from beliefgym.wrappers.transform import Interface, Mask, ObservationTransform, TransformObservation


class KeepComponents(ObservationTransform):
    """y = x[keep], batched; see `PartialObservation`."""

    def __init__(self, below: Interface, keep: str | Sequence[str | int]) -> None:
        index = select_components(below.observation_names, keep)
        space = below.observation_space
        super().__init__(
            Box(space.low[index], space.high[index], dtype=space.dtype.type),
            tuple(below.observation_names[i] for i in index),
        )
        self._index = np.array(index)

    def reset(
        self, observations: NDArray[Any], mask: Mask = None, seeds: Sequence[int | None] | None = None
    ) -> NDArray[Any]:
        """The kept components of the first observations."""
        return observations.take(self._index, axis=1)

    def step(self, observations: NDArray[Any], actions: NDArray[Any], mask: Mask = None) -> NDArray[Any]:
        """The kept components."""
        return observations.take(self._index, axis=1)


class PartialObservation(TransformObservation):
    """Shows some components of the observation, in the order given.

    y_t = x_t[keep]

    Args:
        env: an environment with a one-dimensional Box observation; `component_names(env)` tells the names.
        keep: names, indices (negative ones count from the end) and patterns such as "qpos_*", in any mixture.

    Raises:
        TypeError: a vector environment, another observation space, or an entry of another type.
        ValueError: nothing kept, a component kept twice, or an unknown name.
        IndexError: an index out of range.

    Example:
        >>> env = PartialObservation(gym.make("Hopper-v5"), keep=["qpos_*"])
        >>> env.observation_names
        ('qpos_rootz', 'qpos_rooty', 'qpos_thigh_joint', 'qpos_leg_joint', 'qpos_foot_joint')
    """

    def __init__(self, env: gym.Env[Any, Any], keep: str | Sequence[str | int]) -> None:
        keep = plain_keep(keep)
        RecordConstructorArgs.__init__(self, keep=keep)
        super().__init__(env, partial(KeepComponents, keep=keep))
