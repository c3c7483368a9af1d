"""How environments are registered: systems with their siblings, and environments with wrappers around them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym

NAMESPACE = "beliefgym"
ENTRY_POINT = "beliefgym.envs.env:SystemEnv"
VECTOR_ENTRY_POINT = "beliefgym.envs.vector_env:SystemVectorEnv"
# by name only: what is registered here is loaded by Gymnasium when it is made
COMPOSED_ENTRY_POINT = "beliefgym.wrappers.composed:make_composed"
COMPOSED_VECTOR_ENTRY_POINT = "beliefgym.wrappers.composed:make_vector_env"


def register_system(
    name: str,
    system: str,
    *,
    max_episode_steps: int | None,
    partial: dict[str, Sequence[str]] | None = None,
    noisy: dict[str, tuple[Sequence[str] | None, float | Sequence[float]]] | None = None,
    parameters: dict[str, Any] | None = None,
    version: int = 0,
) -> None:
    """Register a system's fully observed environment and its partially observed and noisy siblings.

    Args:
        name: CamelCase name of the task; the id is `beliefgym/{name}-v{version}`.
        system: "module:Class" of the `System`.
        max_episode_steps: time limit in steps.
        partial: suffix -> the observation components that this sibling shows; "" for those of the full one, where the
            system can observe more.
        noisy: suffix -> the components (None for all) and the standard deviation of their noise, one number or one
            each, in their units; `gym.make(id, noise=...)` sets another.
        parameters: parameters of the system that differ from its defaults.
        version: version in the id.
    """
    for suffix, components in {"": None, **(partial or {})}.items():
        kwargs: dict[str, Any] = {"system": system, **(parameters or {})}
        if components is not None:
            kwargs["components"] = list(components)
        gym.register(
            id=f"{NAMESPACE}/{name}{suffix}-v{version}",
            entry_point=ENTRY_POINT,
            vector_entry_point=VECTOR_ENTRY_POINT,
            max_episode_steps=max_episode_steps,
            kwargs=kwargs,
        )
    for suffix, (components, std) in (noisy or {}).items():
        shown = {} if components is None else {"components": list(components)}
        register_composed(
            f"{name}{suffix}",
            system=system,
            layers=[("ObservationNoise", {"std": std})],
            exposes={"noise": ("ObservationNoise", "std")},
            parameters={**(parameters or {}), **shown},
            max_episode_steps=max_episode_steps,
            version=version,
        )


def register_composed(
    name: str,
    *,
    layers: Sequence[tuple[str, dict[str, Any]]],
    max_episode_steps: int | None,
    system: str | None = None,
    base: str | None = None,
    exposes: dict[str, tuple[str, str]] | None = None,
    parameters: dict[str, Any] | None = None,
    version: int = 0,
) -> None:
    """Register an environment that is another one with wrappers around it.

    Args:
        name: CamelCase name of the task; the id is `beliefgym/{name}-v{version}`.
        layers: (name of a wrapper of beliefgym.wrappers, its arguments), innermost first.
        max_episode_steps: time limit in steps.
        system: "module:Class" of a `System` below the wrappers; the id then has a native vector form.
        base: "module:Class" of another single environment below the wrappers.
        exposes: parameter -> (wrapper, argument): parameters of `gym.make` that set a wrapper's argument.
        parameters: parameters of what is below that differ from its defaults.
        version: version in the id.

    Raises:
        ValueError: neither or both of system and base.
    """
    if (system is None) == (base is None):
        raise ValueError("expected either system or base, and not both")
    kwargs: dict[str, Any] = {
        "base": base or ENTRY_POINT,
        "layers": [[wrapper, dict(arguments)] for wrapper, arguments in layers],
        "exposes": {key: list(target) for key, target in (exposes or {}).items()},
        **(parameters or {}),
    }
    if system is not None:
        kwargs |= {"system": system, "vector_base": VECTOR_ENTRY_POINT}
    gym.register(
        id=f"{NAMESPACE}/{name}-v{version}",
        entry_point=COMPOSED_ENTRY_POINT,
        vector_entry_point=COMPOSED_VECTOR_ENTRY_POINT if system else None,
        max_episode_steps=max_episode_steps,
        kwargs=kwargs,
    )


def has_native_vector_form(env_id: str) -> bool:
    """Whether `gym.make_vec(..., vectorization_mode="vector_entry_point")` is beliefgym's own for this id."""
    return gym.spec(env_id).vector_entry_point in (VECTOR_ENTRY_POINT, COMPOSED_VECTOR_ENTRY_POINT)


def registered_ids() -> list[str]:
    """The ids of all beliefgym environments, sorted."""
    return sorted(spec.id for spec in gym.registry.values() if spec.namespace == NAMESPACE)
