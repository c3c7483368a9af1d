"""The base of all wrappers that change the observation: one batched transform, two thin shells.

An `ObservationTransform` works on n copies at once. `TransformObservation` puts it around one environment (a
batch of one), `VectorTransformObservation` around a vector environment, where episodes end at different
times. So both forms are one implementation, and copy i of a vector environment shows what it would show
alone.

With x the observations below and T the transform, a step gives T.step(x). Where an episode ended:

    SAME_STEP  x is the next episode's first observation and infos["final_obs"] the old one's last:
               final_obs <- T.step(final_obs), then T.reset(x)
    NEXT_STEP  the step after the end is the reset, its action counts for nothing: T.reset(x)
    DISABLED   the user calls reset(options={"reset_mask": ended}): T.reset(x) for these rows, while the
               others show again what they showed last
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Space
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from beliefgym.envs.random_streams import spread_seeds
from beliefgym.wrappers.components import AnyEnv, component_names, observation_box

Mask = NDArray[np.bool_] | None


@dataclass(frozen=True)
class Interface:
    """What a transform knows of the environment below it.

    Args:
        env: the environment, for looking only.
        n: number of copies.
        observation_space: of one copy; the shape is (n_obs,).
        observation_names: n_obs names.
        action_space: of one copy.
    """

    env: AnyEnv
    n: int
    observation_space: Box
    observation_names: tuple[str, ...]
    action_space: Space[Any]

    @classmethod
    def of(cls, env: AnyEnv) -> Interface:
        """The interface of a single or vector environment."""
        return cls(
            env=env,
            n=env.num_envs if isinstance(env, VectorEnv) else 1,
            observation_space=observation_box(env),
            observation_names=component_names(env),
            action_space=env.single_action_space if isinstance(env, VectorEnv) else env.action_space,
        )


class ObservationTransform(ABC):
    """A change of the observations of n copies, each with its own history.

    Both methods return an array of their own, never a view of their argument.

    Args:
        observation_space: of one copy's changed observation, shape (n_out,).
        observation_names: n_out names.
    """

    def __init__(self, observation_space: Box, observation_names: tuple[str, ...]) -> None:
        self.observation_space = observation_space
        self.observation_names = observation_names

    @abstractmethod
    def reset(
        self, observations: NDArray[Any], mask: Mask = None, seeds: Sequence[int | None] | None = None
    ) -> NDArray[Any]:
        """Begin episodes.

        Args:
            observations: (n, n_obs) the first observations.
            mask: (n,) the copies that begin; None for all. The state of the others stays, their rows of the
                result mean nothing.
            seeds: n seeds for the copies' random streams; None, as a whole or one, lets a stream run on.

        Returns:
            (n, n_out).
        """

    @abstractmethod
    def step(self, observations: NDArray[Any], actions: NDArray[Any], mask: Mask = None) -> NDArray[Any]:
        """Go on with episodes.

        Args:
            observations: (n, n_obs) the observations after the actions.
            actions: (n, ...) the actions.
            mask: (n,) the copies that go on; None for all. The others are about to begin anew by `reset`:
                they draw no random numbers, and their rows of the result mean nothing.

        Returns:
            (n, n_out).
        """


BuildTransform = Callable[[Interface], ObservationTransform]


class TransformObservation(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A transform around one environment; the base of the wrappers in `beliefgym.wrappers`.

    Args:
        env: an environment with a one-dimensional Box observation.
        build: makes the transform for the environment's interface.

    Raises:
        TypeError: a vector environment, or another observation space.
    """

    def __init__(self, env: gym.Env[Any, Any], build: BuildTransform) -> None:
        require_single(env, type(self).__name__)
        super().__init__(env)
        interface = Interface.of(env)
        self.transform = build(interface)
        self.observation_space = self.transform.observation_space
        self._dtype = interface.observation_space.dtype

    @property
    def observation_names(self) -> tuple[str, ...]:
        """The name of each component of the observation."""
        return self.transform.observation_names

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`. A seed starts the transform's random stream anew."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self.transform.reset(np.asarray(observation, self._dtype)[None], seeds=[seed])[0], info

    def step(self, action: Any) -> tuple[NDArray[Any], Any, bool, bool, dict[str, Any]]:
        """One step; see `gymnasium.Env.step`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        changed = self.transform.step(np.asarray(observation, self._dtype)[None], np.asarray(action)[None])
        return changed[0], reward, terminated, truncated, info


class VectorTransformObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """A transform around a vector environment; the base of the wrappers in `beliefgym.wrappers.vector`.

    Args:
        env: a vector environment whose copies have a one-dimensional Box observation.
        build: makes the transform for the environment's interface.

    Raises:
        TypeError: a single environment, or another observation space.
        ValueError: the environment does not say how it resets.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], build: BuildTransform) -> None:
        require_vector(env, type(self).__name__)
        super().__init__(env)
        self._mode = _autoreset_mode(env)
        interface = Interface.of(env)
        self.transform = build(interface)
        self.single_observation_space = self.transform.observation_space
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._dtype = interface.observation_space.dtype
        self._restarting: Mask = None  # NEXT_STEP: the copies that the next step resets, if any
        self._shown: NDArray[Any] | None = None

    @property
    def observation_names(self) -> tuple[str, ...]:
        """The name of each component of one copy's observation."""
        return self.transform.observation_names

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """When finished copies start anew, under the name by which TorchRL asks for it."""
        return self._mode

    def reset(  # type: ignore[override]
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start episodes; see `gymnasium.vector.VectorEnv.reset`.

        Args:
            seed: s gives copy i the seed s + i, a sequence gives one each; the transform's random streams
                start anew with them. None lets the streams run on.
            options: for the environment; "reset_mask" (n,) bool tells which copies begin.

        Returns:
            (n, n_out) observations, infos.
        """
        mask = None if options is None else options.get("reset_mask")  # the environment may pop it
        observations, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        observations = np.asarray(observations, self._dtype)
        seeds = spread_seeds(seed, self.num_envs)
        if mask is None:
            self._restarting = None
            return self._show(self.transform.reset(observations, seeds=seeds)), infos
        if self._restarting is not None:
            self._restarting = _if_any(self._restarting & ~mask)
        seeds = [s if begins else None for s, begins in zip(seeds, mask, strict=True)]
        changed = self.transform.reset(observations, mask, seeds)
        if self._shown is not None:
            changed = np.where(mask[:, None], changed, self._shown)
        return self._show(changed), infos

    def step(
        self, actions: Any
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every copy; see `gymnasium.vector.VectorEnv.step`."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        observations, actions = np.asarray(observations, self._dtype), np.asarray(actions)
        ended = _if_any(np.logical_or(terminations, truncations))
        if self._mode is AutoresetMode.SAME_STEP and ended is not None:
            changed, infos = self._end_and_begin(observations, actions, ended, infos)
        elif self._restarting is not None:
            going_on = self.transform.step(observations, actions, ~self._restarting)
            begun = self.transform.reset(observations, self._restarting)
            changed = np.where(self._restarting[:, None], begun, going_on)
        else:
            changed = self.transform.step(observations, actions)
        if self._mode is AutoresetMode.NEXT_STEP:
            self._restarting = ended
        return self._show(changed), rewards, terminations, truncations, infos

    def _end_and_begin(
        self,
        observations: NDArray[Any],
        actions: NDArray[Any],
        ended: NDArray[np.bool_],
        infos: dict[str, Any],
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """SAME_STEP: the last observations of the old episodes first, then the first ones of the new."""
        if "final_obs" not in infos:
            raise RuntimeError(
                f"{self.env} has ended an episode in mode SAME_STEP without infos['final_obs'], so its "
                "last observation is lost; use a vector environment that gives it, or another autoreset mode"
            )
        rows = np.flatnonzero(ended)
        last = observations.copy()
        last[rows] = np.stack(list(infos["final_obs"][rows]))
        going_on = self.transform.step(last, actions)
        final_observations = np.full(self.num_envs, None, dtype=object)
        for row, observation in zip(rows, going_on[rows], strict=True):
            final_observations[row] = observation
        going_on[rows] = self.transform.reset(observations, ended)[rows]
        return going_on, {**infos, "final_obs": final_observations}

    def _show(self, changed: NDArray[Any]) -> NDArray[Any]:
        self._shown = changed.copy()  # the caller may write into what he gets
        return changed


def require_single(env: Any, name: str) -> None:
    """Raise TypeError unless env is a single environment; name is the wrapper's class."""
    if isinstance(env, VectorEnv):
        raise TypeError(
            f"beliefgym.wrappers.{name} wraps a single environment, got the vector environment {env}; "
            f"use beliefgym.wrappers.vector.{name}"
        )
    if not isinstance(env, gym.Env):
        raise TypeError(f"beliefgym.wrappers.{name} wraps a gymnasium.Env, got {type(env).__name__}")


def require_vector(env: Any, name: str) -> None:
    """Raise TypeError unless env is a vector environment; name is the wrapper's class."""
    if isinstance(env, gym.Env):
        raise TypeError(
            f"beliefgym.wrappers.vector.{name} wraps a vector environment, got the single environment {env}; "
            f"use beliefgym.wrappers.{name}"
        )
    if not isinstance(env, VectorEnv):
        raise TypeError(
            f"beliefgym.wrappers.vector.{name} wraps a gymnasium VectorEnv, got {type(env).__name__}"
        )


def _autoreset_mode(env: VectorEnv[Any, Any, Any]) -> AutoresetMode:
    mode = env.metadata.get("autoreset_mode")
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        raise ValueError(
            f"expected env.metadata['autoreset_mode'] of {env} to be an AutoresetMode, got {mode!r}; "
            "set it to how the environment resets finished copies"
        ) from error


def _if_any(mask: NDArray[np.bool_]) -> Mask:
    return mask if mask.any() else None
