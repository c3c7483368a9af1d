"""A finite choice of actions for an environment with continuous ones: a grid in the action box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete, Space
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from beliefgym.wrappers.transform import require_single

SpaceKind = Literal["discrete", "multi_discrete"]
MAX_CHOICES = 4096


class ActionGrid:
    """From numbers of grid points to actions, batched; see `DiscreteActions`."""

    def __init__(self, action_space: Space[Any], bins: int | Sequence[int], space: SpaceKind) -> None:
        box = _checked_box(action_space)
        counts = _checked_bins(bins, len(box.low))
        levels = [
            np.linspace(low, high, n, dtype=np.float64).astype(box.dtype)
            for low, high, n in zip(box.low, box.high, counts, strict=True)
        ]
        self.action_space: Discrete | MultiDiscrete
        self._points: NDArray[Any]
        if space == "discrete":
            choices = int(np.prod(counts.astype(object)))  # Python integers: no overflow
            if choices > MAX_CHOICES:
                raise ValueError(
                    f"{' x '.join(map(str, counts))} bins give {choices} choices, more than "
                    f"{MAX_CHOICES}; use fewer bins or "
                    'space="multi_discrete", where each action component is chosen for itself'
                )
            self._points = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(
                choices, len(counts)
            )
            self._counts = np.array(choices)
            self._shape: tuple[int, ...] = ()
            self.action_space = Discrete(choices)
        elif space == "multi_discrete":
            self._points = np.zeros((len(counts), counts.max()), dtype=box.dtype)
            for row, level in zip(self._points, levels, strict=True):
                row[: len(level)] = level
            self._columns = np.arange(len(counts))
            self._counts = counts
            self._shape = counts.shape
            self.action_space = MultiDiscrete(counts)
        else:
            raise ValueError(f'expected space to be "discrete" or "multi_discrete", got {space!r}')

    def __call__(self, actions: NDArray[Any]) -> NDArray[Any]:
        """(n,) or (n, n_act) numbers -> (n, n_act) actions.

        Raises:
            TypeError: numbers that are not integers.
            ValueError: the wrong shape, or a number out of range.
        """
        if actions.dtype.kind not in "iu":
            raise TypeError(
                f"expected integer actions in {self.action_space}, got {actions.dtype}: {actions.tolist()}"
            )
        if actions.shape[1:] != self._shape:
            raise ValueError(
                f"expected actions of shape {self._shape} for one environment, got shape {actions.shape[1:]}"
            )
        wrong = (actions < 0) | (actions >= self._counts)
        if wrong.any():
            at = tuple(np.argwhere(wrong)[0])
            highest = int(np.broadcast_to(self._counts, actions.shape)[at]) - 1
            raise ValueError(f"expected actions from 0 to {highest}, got {actions[at]}")
        points: NDArray[Any] = self._points[(self._columns, actions) if self._shape else actions]
        return points


class DiscreteActions(gym.ActionWrapper[Any, Any, Any], RecordConstructorArgs):
    """Lets an agent choose from a grid of actions, evenly spaced from low to high, both ends included.

    a = low + i (high - low) / (bins - 1),  i = 0, ..., bins - 1

    Args:
        env: an environment with a bounded one-dimensional Box action space of n_act components.
        bins: points along each action component, at least 2: one number for all, or one for each.
        space: "discrete": the action is one number for a point of the grid, the last component running
            fastest (Discrete(bins^n_act), at most 4096 points); "multi_discrete": one number for each
            component.

    Raises:
        TypeError: a vector environment, an action space that is not a one-dimensional Box, bins that are no
            integers; in `step`, an action that is no integer.
        ValueError: an unbounded action space, too few bins or bins of the wrong length, too many points; in
            `step`, an action out of range.
    """

    def __init__(
        self, env: gym.Env[Any, Any], bins: int | Sequence[int], space: SpaceKind = "discrete"
    ) -> None:
        RecordConstructorArgs.__init__(self, bins=np.asarray(bins).tolist(), space=space)
        require_single(env, type(self).__name__)
        super().__init__(env)
        self._grid = ActionGrid(env.action_space, bins, space)
        self.action_space = self._grid.action_space

    def action(self, action: Any) -> NDArray[Any]:
        """The point (n_act,) of the grid."""
        point: NDArray[Any] = self._grid(np.asarray(action)[None])[0]
        return point


def _checked_box(space: Space[Any]) -> Box:
    if not isinstance(space, Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
        raise TypeError(f"expected a one-dimensional Box action space of floating-point numbers, got {space}")
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise ValueError(
            f"a grid needs a bounded action space, got {space}; give it bounds first with gymnasium.wrappers."
            "TransformAction(env, lambda action: action, action_space=gymnasium.spaces.Box(low, high))"
        )
    return space


def _checked_bins(bins: int | Sequence[int], n_act: int) -> NDArray[np.int64]:
    given = np.asarray(bins)
    if given.dtype.kind not in "iu":
        raise TypeError(f"expected bins to be an int or one int for each action component, got {bins!r}")
    if given.shape not in ((), (n_act,)):
        raise ValueError(
            f"expected one number of bins or one for each of {n_act} action components, got {bins!r}"
        )
    if (given < 2).any():
        raise ValueError(f"expected at least 2 bins (the two ends of the range), got {bins!r}")
    return np.broadcast_to(given, n_act).astype(np.int64)
