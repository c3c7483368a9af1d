"""White measurement noise on the observation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from beliefgym.envs.random_streams import RandomStreams, fresh_seeds
from beliefgym.wrappers.components import AnyEnv, layers
from beliefgym.wrappers.transform import Interface, Mask, ObservationTransform, TransformObservation

Std = float | Sequence[float] | NDArray[np.float64]

# The streams below a copy's seed: 0 is the physics', this is the innermost noise wrapper's, and each further
# one stacked on it takes the next at this distance, which leaves the numbers between to other wrappers.
STREAM = 1
STREAM_STRIDE = 1 << 16


class AddNoise(ObservationTransform):
    """y = x + std eps, batched; see `ObservationNoise`.

    Attributes:
        std: (n_obs,) in the components' units. clips: whether y is kept within the observation space.
    """

    def __init__(self, below: Interface, std: Std, clip: bool) -> None:
        space = below.observation_space
        if not np.issubdtype(space.dtype, np.floating):
            raise TypeError(
                f"noise needs an observation of floating-point numbers, got {space.dtype}; "
                "put gymnasium.wrappers.DtypeObservation(env, numpy.float32) around the environment first"
            )
        self.std = _checked_std(std, below.observation_names)
        self.clips = clip
        noisy = (self.std > 0) & (not clip)
        low, high = np.where(noisy, -np.inf, space.low), np.where(noisy, np.inf, space.high)
        super().__init__(
            Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type),
            below.observation_names,
        )
        stream = STREAM + STREAM_STRIDE * _noise_layers(below.env)
        self._streams = RandomStreams(fresh_seeds(below.n), stream)

    def reset(
        self, observations: NDArray[Any], mask: Mask = None, seeds: Sequence[int | None] | None = None
    ) -> NDArray[Any]:
        """The first observations with noise; a seed starts a copy's stream anew."""
        if seeds is not None:
            self._streams.reseed(seeds)
        return self._add(observations, mask)

    def step(self, observations: NDArray[Any], actions: NDArray[Any], mask: Mask = None) -> NDArray[Any]:
        """The observations with noise."""
        return self._add(observations, mask)

    def _add(self, observations: NDArray[Any], mask: Mask) -> NDArray[Any]:
        noise = self.std * self._streams.normal(len(self.std), mask)
        noisy = (observations + noise).astype(observations.dtype, copy=False)
        if self.clips:
            np.clip(noisy, self.observation_space.low, self.observation_space.high, out=noisy)
        return noisy


class ObservationNoise(TransformObservation):
    """Adds Gaussian noise, drawn afresh at every step and component, to the observation.

    y_t = x_t + std eps_t,  eps_t ~ N(0, I)

    The first observation of an episode and the last are noisy as all others are. The noise has a random
    stream of its own, which `reset(seed=...)` starts anew and `reset()` lets run on; noise wrappers stacked
    on each other draw different numbers. (Those that sit inside the worker processes of an AsyncVectorEnv
    cannot be counted from outside: put noise on one side only.)

    Args:
        env: an environment with a one-dimensional Box observation of floating-point numbers.
        std: standard deviation in the components' units: one for all, or one for each component.
        clip: keep the observation within the bounds of the observation space. If False, the bounds of the
            components with noise become infinite.

    Raises:
        TypeError: a vector environment, or another observation space.
        ValueError: std of the wrong length, negative or not finite.
    """

    def __init__(self, env: gym.Env[Any, Any], std: Std, clip: bool = False) -> None:
        RecordConstructorArgs.__init__(self, std=np.asarray(std).tolist(), clip=clip)
        super().__init__(env, partial(AddNoise, std=std, clip=clip))


def _checked_std(std: Std, names: tuple[str, ...]) -> NDArray[np.float64]:
    given = np.asarray(std, dtype=np.float64)
    if given.shape not in ((), (len(names),)):
        raise ValueError(
            f"expected std to be one number or one for each of the {len(names)} components "
            f"({', '.join(names)}), got an array of shape {given.shape}"
        )
    values = np.broadcast_to(given, len(names)).copy()
    for name, value in zip(names, values, strict=True):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"expected std to be finite and at least 0, got {value} for {name!r}")
    return values


def _noise_layers(env: AnyEnv) -> int:
    return sum(isinstance(getattr(layer, "transform", None), AddNoise) for layer in layers(env))
