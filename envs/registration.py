"""Which environments there are: one line a system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym

NAMESPACE = "beliefgym"
VECTOR_ENTRY_POINT = "beliefgym.envs.vector_env:SystemVectorEnv"


def register_system(
    name: str,
    system: str,
    *,
    max_episode_steps: int | None,
    partial: dict[str, Sequence[str]] | None = None,
    parameters: dict[str, Any] | None = None,
    version: int = 0,
) -> None:
    """Register a system's fully observed environment and its partially observed siblings.

    Args:
        name: CamelCase name of the task; the id is `beliefgym/{name}-v{version}`.
        system: "module:Class" of the `System`.
        max_episode_steps: time limit in steps.
        partial: suffix -> the observation components that this sibling shows.
        parameters: parameters of the system that differ from its defaults.
        version: version in the id.
    """
    for suffix, components in {"": None, **(partial or {})}.items():
        kwargs: dict[str, Any] = {"system": system, **(parameters or {})}
        if components is not None:
            kwargs["components"] = list(components)
        gym.register(
            id=f"{NAMESPACE}/{name}{suffix}-v{version}",
            entry_point="beliefgym.envs.env:SystemEnv",
            vector_entry_point=VECTOR_ENTRY_POINT,
            max_episode_steps=max_episode_steps,
            kwargs=kwargs,
        )


def registered_ids() -> list[str]:
    """The ids of all beliefgym environments, sorted."""
    return sorted(spec.id for spec in gym.registry.values() if spec.namespace == NAMESPACE)


def register_all() -> None:
    """Register every environment of the package; a second call changes nothing."""
    if registered_ids():
        return
    register_system(
        "Pendulum",
        "beliefgym.envs.pendulum:Pendulum",
        max_episode_steps=200,
        partial={"Position": ("cos_theta", "sin_theta")},
    )
    register_system(
        "CartPoleSwingUp",
        "beliefgym.envs.cart_pole:CartPole",
        max_episode_steps=200,
        partial={"Position": ("x", "cos_theta", "sin_theta")},
    )
