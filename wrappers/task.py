"""A task: an environment id, its parameters and the wrappers around it, as data.

Single and vector environments, records and command lines are all made from the same `Task`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

import beliefgym.wrappers as single_wrappers
import beliefgym.wrappers.vector as vector_wrappers
from beliefgym.envs.registration import NAMESPACE, has_native_vector_form

NAMES = (
    "PartialObservation",
    "ObservationNoise",
    "ObservationDelay",
    "ActionHistory",
    "DiscreteActions",
    "BeliefObservation",
)


@dataclass(frozen=True)
class Task:
    """An environment with its parameters and wrappers.

    Args:
        env_id: a registered Gymnasium id, of beliefgym (whose namespace may be left out) or of any other package
            ("module:id" imports it first).
        kwargs: parameters for `gym.make`.
        wrappers: (name, arguments) of beliefgym wrappers, innermost first.

    Raises:
        ValueError: an unknown wrapper or environment; the message names the nearest.
    """

    env_id: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    wrappers: tuple[tuple[str, Mapping[str, Any]], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "wrappers", tuple((name, dict(arguments)) for name, arguments in self.wrappers)
        )
        object.__setattr__(self, "kwargs", dict(self.kwargs))
        for name, _ in self.wrappers:
            if name not in NAMES:
                raise ValueError(_unknown("wrapper", name, NAMES))
        object.__setattr__(self, "env_id", full_id(self.env_id))

    @property
    def label(self) -> str:
        """A short name: the id without its namespace, then what was changed."""
        parts = [self.env_id.rpartition("/")[2]]
        parts += [f"{name}={_plain(value)}" for name, value in self.kwargs.items()]
        for name, arguments in self.wrappers:
            inner = ",".join(f"{key}={_plain(value)}" for key, value in arguments.items())
            parts.append(f"{name}({inner})")
        return " ".join(parts)

    def make(self, **kwargs: Any) -> gym.Env[Any, Any]:
        """The single environment; extra arguments (such as render_mode) go to `gym.make`."""
        env = gym.make(self.env_id, **{**self.kwargs, **kwargs})
        for name, arguments in self.wrappers:
            env = getattr(single_wrappers, name)(env, **arguments)
        return env

    def make_vec(
        self, num_envs: int, autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP, native: bool = True
    ) -> VectorEnv[Any, Any, Any]:
        """The vector environment: native where a system has one (and `native`), else Gymnasium's SyncVectorEnv."""
        if native and has_native_vector_form(self.env_id):
            env: VectorEnv[Any, Any, Any] = gym.make_vec(
                self.env_id,
                num_envs=num_envs,
                vectorization_mode="vector_entry_point",
                autoreset_mode=autoreset_mode.name,
                **self.kwargs,
            )
        else:
            env = SyncVectorEnv(
                [lambda: gym.make(self.env_id, **self.kwargs) for _ in range(num_envs)],
                autoreset_mode=autoreset_mode,
            )
        for name, arguments in self.wrappers:
            env = getattr(vector_wrappers, name)(env, **arguments)
        return env

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as it stands in records and saved agents.

        Raises:
            TypeError: an argument that JSON does not hold, such as a filter instead of its file's path.
        """
        try:
            text = json.dumps({"env_id": self.env_id, "kwargs": self.kwargs, "wrappers": self.wrappers})
        except TypeError as error:
            raise TypeError(
                f"the task {self.label!r} does not go into plain data: {error}; pass numbers, strings, lists and "
                "mappings, and a filter as the path of the file that save_filter wrote"
            ) from error
        plain: dict[str, Any] = json.loads(text)
        return plain

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Task:
        """The task of `to_dict`."""
        return cls(
            data["env_id"], data["kwargs"], tuple((name, arguments) for name, arguments in data["wrappers"])
        )


def full_id(env_id: str) -> str:
    """The id under which an environment is registered; `Name-v0` is looked for in beliefgym too.

    Raises:
        ValueError: no such environment; the message names the nearest.
    """
    short = f"{NAMESPACE}/{env_id}"
    if env_id not in gym.registry and short in gym.registry:
        return short
    try:
        gym.spec(env_id)  # imports the package of "module:id"
    except (gym.error.Error, ModuleNotFoundError) as error:
        known = list(gym.registry)
        near = get_close_matches(env_id, known, n=1, cutoff=0.5) or get_close_matches(
            short, known, n=1, cutoff=0.5
        )
        raise ValueError(
            f"there is no environment {env_id!r}"
            + (f"; did you mean {near[0]!r}?" if near else "")
            + " (`beliefgym envs` lists them)"
        ) from error
    return env_id


def _unknown(kind: str, name: str, known: tuple[str, ...]) -> str:
    near = get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"there is no {kind} {name!r}{hint} (known: {', '.join(known)})"


def _plain(value: Any) -> str:
    return "+".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
