"""A policy of any form as one function of a batch of observations, with what it gives checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from beliefgym.envs.copies import Array, Copies, Mask


class Predictor(Protocol):
    """A policy with Stable-Baselines3's face."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Actions for a batch of observations, and the policy's memory."""
        ...


Policy = Predictor | Callable[[Any], Any] | str | None


class Actor:
    """The policy, whatever its form, as a function of a batch of observations; checks what it gives."""

    def __init__(self, policy: Policy, copies: Copies, seed: int, deterministic: bool) -> None:
        self._space = copies.action_space
        self._n = copies.n
        self._deterministic = deterministic
        self._memory: Any = None
        self._calls = 0
        if policy is None or (isinstance(policy, str) and policy == "random"):
            self.name, self._form = "random", "random"
            self._samples = batch_space(copies.action_space, copies.n)
            # A stream apart from the environment's, which is started with the same seed.
            self._samples.seed(int(np.random.SeedSequence(seed, spawn_key=(1,)).generate_state(1)[0]))
            density = _log_density_of_sampling(copies.action_space)
            self._log_prob = None if density is None else np.full(copies.n, density)
            return
        self._policy: Any = policy
        self.name = getattr(policy, "__qualname__", type(policy).__name__)
        predicts = callable(getattr(policy, "predict", None))
        # A policy with `explores_always` false has no density where it acts deterministically.
        without = predicts and deterministic and not getattr(policy, "explores_always", True)
        if callable(getattr(policy, "predict_with_log_prob", None)) and not without:
            self._form = "predict_with_log_prob"
        elif predicts:
            self._form = "predict"
        elif callable(policy):
            self._form = "function"
        else:
            raise TypeError(
                'expected a policy that is None, "random", a function of observations, or an object with '
                f"predict(observation, state, episode_start, deterministic), got {policy!r}"
            )

    def __call__(self, observation: Any, episode_start: Mask) -> tuple[NDArray[Any], Array | None]:
        """Actions for the environment (n, ...), and their log probabilities (n,) where known."""
        self._calls += 1
        if self._form == "random":
            return self._samples.sample(), self._log_prob
        if self._form == "function":
            return self._checked(self._policy(observation)), None
        answer = getattr(self._policy, self._form)(
            observation, state=self._memory, episode_start=episode_start, deterministic=self._deterministic
        )
        self._memory = answer[1]
        if self._form == "predict":
            return self._checked(answer[0]), None
        log_prob = np.array(answer[2], dtype=np.float64)
        if log_prob.shape != (self._n,):
            raise ValueError(
                f"expected log_prob of shape ({self._n},) from {self.name}, got {log_prob.shape}"
            )
        return self._checked(answer[0]), log_prob

    def _checked(self, action: Any) -> NDArray[Any]:
        array, shape = np.asarray(action), (self._n, *(self._space.shape or ()))
        if array.shape != shape and array.shape != (self._n, int(np.prod(shape[1:]))):
            raise ValueError(
                f"expected actions of shape {shape} for {self._space} from {self.name}, got {array.shape}"
            )
        array = array.reshape(shape)
        if array.dtype.kind not in "fiub":
            raise ValueError(f"expected numbers as actions from {self.name}, got dtype {array.dtype}")
        if array.dtype.kind == "f" and np.isnan(array).any():
            copy = int(np.argwhere(np.isnan(array))[0, 0])
            raise ValueError(
                f"expected finite actions from {self.name}, got nan for copy {copy} of {self._n} at step "
                f"{self._calls - 1} of the run; look at the policy and at the observation it was given"
            )
        if array.dtype.kind == "f" and not isinstance(self._space, Box) and (array != np.floor(array)).any():
            raise ValueError(
                f"expected whole numbers as actions for {self._space} from {self.name}, got {array}"
            )
        if isinstance(self._space, Discrete):
            low, high = int(self._space.start), int(self._space.start + self._space.n) - 1
            if ((array < low) | (array > high)).any():
                raise ValueError(f"expected actions from {low} to {high} from {self.name}, got {array}")
        return array.astype(self._space.dtype)


def _log_density_of_sampling(space: gym.Space[Any]) -> float | None:
    """Log density (log probability) of `space.sample()`; None for a box without width or without bounds."""
    if isinstance(space, Discrete | MultiDiscrete):
        return -float(np.log(space.n if isinstance(space, Discrete) else space.nvec).sum())
    if isinstance(space, MultiBinary):
        return -float(np.log(2.0) * np.prod(space.shape))
    if not (isinstance(space, Box) and space.is_bounded() and (space.high > space.low).all()):
        return None
    widths = space.high.astype(np.float64) - space.low
    return -float(np.log(widths + (0.0 if np.issubdtype(space.dtype, np.floating) else 1.0)).sum())
