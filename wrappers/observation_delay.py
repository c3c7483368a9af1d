"""A late observation: the agent sees what was k steps ago."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from beliefgym.wrappers.transform import Interface, Mask, ObservationTransform, TransformObservation

Fill = Literal["initial", "zeros"]


class DelayObservations(ObservationTransform):
    """y_t = x_{t-k}, batched; see `ObservationDelay`.

    The last k observations of all copies lie in one ring (k, n, n_obs), whose oldest entry is at `_oldest`
    for every
    copy: a copy that begins anew has its whole column rewritten, so the copies stay in step.
    """

    def __init__(self, below: Interface, steps: int, fill: Fill) -> None:
        space = below.observation_space
        if steps > 0 and fill == "zeros":
            space = Box(np.minimum(space.low, 0), np.maximum(space.high, 0), dtype=space.dtype.type)
        super().__init__(space, below.observation_names)
        self._ring = np.zeros((steps, below.n, len(below.observation_names)), dtype=space.dtype)
        self._oldest = 0
        self._fill = fill

    def reset(
        self, observations: NDArray[Any], mask: Mask = None, seeds: Sequence[int | None] | None = None
    ) -> NDArray[Any]:
        """The first observations, or zeros."""
        steps = len(self._ring)
        rows = slice(None) if mask is None else mask
        if steps > 0 and self._fill == "zeros":
            self._ring[:, rows] = 0
            self._ring[self._oldest - 1, rows] = observations[rows]  # the newest
            return np.zeros_like(observations)
        self._ring[:, rows] = observations[rows]
        return observations.copy()

    def step(self, observations: NDArray[Any], actions: NDArray[Any], mask: Mask = None) -> NDArray[Any]:
        """The observations of k steps before."""
        steps = len(self._ring)
        if steps == 0:
            return observations.copy()
        delayed = self._ring[self._oldest].copy()
        self._ring[self._oldest] = observations
        self._oldest = (self._oldest + 1) % steps
        return delayed


class ObservationDelay(TransformObservation):
    """Shows the observation of k steps ago.

    y_t = x_{t-k};  while t < k: x_0 (fill "initial") or 0 (fill "zeros")

    The last observation of an episode is late as all others are: it is x_{T-k}.

    Args:
        env: an environment with a one-dimensional Box observation.
        steps: the delay k in steps; 0 changes nothing.
        fill: what to show while t < k. With "zeros" the bounds are widened to hold 0.

    Raises:
        TypeError: a vector environment, another observation space, or steps that is not an integer.
        ValueError: a negative delay, or an unknown fill.
    """

    def __init__(self, env: gym.Env[Any, Any], steps: int, fill: Fill = "initial") -> None:
        steps = check_delay(steps, fill)
        RecordConstructorArgs.__init__(self, steps=steps, fill=fill)
        super().__init__(env, partial(DelayObservations, steps=steps, fill=fill))


def check_delay(steps: int, fill: str) -> int:
    """The delay as a Python integer; raises TypeError or ValueError as `ObservationDelay` says."""
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer):
        raise TypeError(f"expected the delay in whole steps (an int), got {steps!r}")
    if steps < 0:
        raise ValueError(
            f"expected a delay of at least 0 steps, got {steps}: an observation cannot come early"
        )
    if fill not in ("initial", "zeros"):
        raise ValueError(f'expected fill to be "initial" or "zeros", got {fill!r}')
    return int(steps)
