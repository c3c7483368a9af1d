"""Names for the components of an observation, whatever the environment, and their choice by name or index.

A beliefgym environment and each of its wrappers say `observation_names`. For Gymnasium's MuJoCo tasks (v5)
the names come from the joints of the model; every other environment gets `observation_0`, `observation_1`,
...
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv, VectorWrapper

from beliefgym.envs.joint_names import observation_names

AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]


def layers(env: AnyEnv) -> Iterator[AnyEnv]:
    """The wrappers of an environment from the outermost in, then the environment.

    Through a `SyncVectorEnv` the way goes on into its first copy; other vector environments end it.
    """
    layer: AnyEnv | None = env
    while layer is not None:
        yield layer
        if isinstance(layer, gym.Wrapper | VectorWrapper):
            layer = layer.env
        else:
            copies = getattr(layer, "envs", None) if isinstance(layer, VectorEnv) else None
            layer = copies[0] if copies else None


def observation_box(env: AnyEnv) -> Box:
    """The observation space of one copy.

    Raises:
        TypeError: it is not a one-dimensional Box.
    """
    space = env.single_observation_space if isinstance(env, VectorEnv) else env.observation_space
    if not isinstance(space, Box) or len(space.shape) != 1:
        module = "gymnasium.wrappers.vector" if isinstance(env, VectorEnv) else "gymnasium.wrappers"
        raise TypeError(
            f"expected an environment with a one-dimensional Box observation, got {space}; "
            f"put {module}.FlattenObservation around the environment first"
        )
    return space


def component_names(env: AnyEnv) -> tuple[str, ...]:
    """The name of each component of an environment's observation.

    Args:
        env: single or vector environment with a one-dimensional Box observation of n_obs components.

    Returns:
        n_obs names: the `observation_names` of the outermost layer that has them; else those of a MuJoCo
        model's joints (`qpos_<joint>`, `qvel_<joint>`; `qpos_<joint>_<i>` for a joint of several
        coordinates); else, and where a wrapper of another package has changed the number of components,
        `observation_0`, `observation_1`, ...

    Raises:
        TypeError: the observation is not a one-dimensional Box.
    """
    (n_obs,) = observation_box(env).shape
    names = _attribute(env, "observation_names")
    if names is None:
        names = _mujoco_names(list(layers(env))[-1])
    if names is None or len(names) != n_obs:
        return tuple(f"observation_{i}" for i in range(n_obs))
    return tuple(names)


def action_names(env: AnyEnv, n_act: int) -> tuple[str, ...]:
    """The name of each of n_act action components: the environment's `action_names`, else `action_0`, ..."""
    names = _attribute(env, "action_names")
    if names is None or len(names) != n_act:
        return tuple(f"action_{i}" for i in range(n_act))
    return tuple(names)


def plain_keep(keep: str | Sequence[str | int]) -> list[str | int]:
    """A choice of components as plain data: a list of names, patterns and Python integers.

    Raises:
        TypeError: an entry is neither a string nor an integer.
    """
    plain: list[str | int] = []
    for entry in [keep] if isinstance(keep, str) else keep:
        if isinstance(entry, bool | np.bool_) or not isinstance(entry, str | int | np.integer):
            raise TypeError(
                f"expected keep to hold names, patterns or indices, got {entry!r} ({type(entry).__name__}); "
                "of a boolean mask pass numpy.flatnonzero(mask)"
            )
        plain.append(entry if isinstance(entry, str) else operator.index(entry))
    return plain


def select_components(names: Sequence[str], keep: str | Sequence[str | int]) -> list[int]:
    """The indices of chosen components, in the order of the choice.

    Args:
        names: of all components.
        keep: names, indices (negative ones count from the end) and patterns such as "qpos_*", in any mixture;
            a pattern stands for all names that it matches, in their order.

    Raises:
        TypeError: an entry is neither a string nor an integer.
        ValueError: nothing chosen, a component chosen twice, an unknown name (told with the nearest) or a
            pattern without match.
        IndexError: an index out of range.
    """
    chosen: list[int] = []
    for entry in plain_keep(keep):
        for index in _indices(names, entry):
            if index in chosen:
                raise ValueError(f"observation component {names[index]!r} is kept twice (again by {entry!r})")
            chosen.append(index)
    if not chosen:
        raise ValueError(
            f"expected to keep at least one observation component of {', '.join(names)}; got none"
        )
    return chosen


def _indices(names: Sequence[str], entry: str | int) -> list[int]:
    if isinstance(entry, int):
        if not -len(names) <= entry < len(names):
            raise IndexError(
                f"observation index {entry} is out of range: the observation has {len(names)} components "
                f"({', '.join(names)})"
            )
        return [entry % len(names)]
    if entry in names:  # before patterns: a name may hold brackets
        return [names.index(entry)]
    matches = [i for i, name in enumerate(names) if fnmatchcase(name, entry)]
    if not matches:
        near = get_close_matches(entry, names, n=1)
        raise ValueError(
            f"there is no observation component {entry!r}"
            + (f"; did you mean {near[0]!r}?" if near else "")
            + f" (the observation has {', '.join(names)})"
        )
    return matches


def _attribute(env: AnyEnv, name: str) -> Any:
    """The attribute of the outermost layer that has it, or None."""
    return next((value for layer in layers(env) if (value := getattr(layer, name, None)) is not None), None)


def _mujoco_names(base: AnyEnv) -> list[str] | None:
    structure, model = getattr(base, "observation_structure", None), getattr(base, "model", None)
    return None if structure is None or model is None else observation_names(model, structure)
