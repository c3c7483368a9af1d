"""Environments that are registered as a base environment with wrappers around it: noisy, delayed, discrete siblings.

The single and the vector form are made from the same list of layers, so `gym.make` and `gym.make_vec` cannot differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

import beliefgym.wrappers as single_wrappers
import beliefgym.wrappers.vector as vector_wrappers

Layer = tuple[str, Mapping[str, Any]]


def make_env(
    base: str,
    layers: Sequence[Layer],
    exposes: Mapping[str, Sequence[str]] | None = None,
    **parameters: Any,
) -> gym.Env[Any, Any]:
    """A base environment with its wrappers; the entry point of composed ids.

    Args:
        base: "module:Class" of the single environment.
        layers: (name of a wrapper of beliefgym.wrappers, its arguments), innermost first.
        exposes: parameter -> (wrapper, argument): what a caller may set of the wrappers by a parameter of its own.
        **parameters: exposed parameters, and those of the base environment, which checks them.
    """
    layers, parameters = _settled(layers, exposes, parameters)
    env = _load(base)(**parameters)
    for name, arguments in layers:
        env = getattr(single_wrappers, name)(env, **arguments)
    return env


def make_vector_env(
    base: str,
    layers: Sequence[Layer],
    vector_base: str,
    exposes: Mapping[str, Sequence[str]] | None = None,
    **parameters: Any,
) -> VectorEnv[Any, Any, Any]:
    """The native vector form; the vector entry point of composed ids.

    Args:
        base: not used here; a part of the registered arguments, which both forms share.
        layers, exposes: as in `make_env`.
        vector_base: "module:Class" of the vector environment.
        **parameters: exposed parameters, and those of the base environment (num_envs among them).
    """
    layers, parameters = _settled(layers, exposes, parameters)
    env = _load(vector_base)(**parameters)
    for name, arguments in layers:
        env = getattr(vector_wrappers, name)(env, **arguments)
    return env


def make_composed(**arguments: Any) -> gym.Env[Any, Any]:
    """`make_env` without the vector form's arguments; what is registered."""
    arguments.pop("vector_base", None)
    return make_env(**arguments)


def _settled(
    layers: Sequence[Layer], exposes: Mapping[str, Sequence[str]] | None, parameters: Mapping[str, Any]
) -> tuple[list[tuple[str, dict[str, Any]]], dict[str, Any]]:
    """The layers with the exposed parameters put in, and the parameters that are left for the base."""
    settled = [(name, dict(arguments)) for name, arguments in layers]
    left = dict(parameters)
    for parameter, (wrapper, argument) in (exposes or {}).items():
        if parameter in left:
            value = left.pop(parameter)
            for name, arguments in settled:
                if name == wrapper:
                    arguments[argument] = value
    return settled, left


def _load(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)
