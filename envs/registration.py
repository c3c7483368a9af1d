"""Which environments there are: one line a system."""

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
            entry_point=ENTRY_POINT,
            vector_entry_point=VECTOR_ENTRY_POINT,
            max_episode_steps=max_episode_steps,
            kwargs=kwargs,
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


def _register_helicopters() -> None:
    """Hover and funnel of Abbeel and Ng's helicopter, and the helicopter of the RL competitions."""
    quaternion = ("q_x", "q_y", "q_z", "q_w")
    register_system(
        "HelicopterHover",
        "beliefgym.envs.helicopter:Helicopter",
        max_episode_steps=400,
        partial={"Position": ("position_north", "position_east", "position_down", *quaternion)},
    )
    register_system(
        "HelicopterFunnel",
        "beliefgym.envs.helicopter_funnel:HelicopterFunnel",
        max_episode_steps=600,
        partial={
            "Position": (
                *(f"position_error_{axis}" for axis in ("forward", "right", "down")),
                *(f"q_error_{axis}" for axis in "xyzw"),
                "progress",
            )
        },
    )
    register_system(
        "HelicopterCompetition",
        "beliefgym.envs.helicopter_competition:HelicopterCompetition",
        max_episode_steps=6000,
        partial={"Position": ("position_forward", "position_right", "position_below", *quaternion[:3])},
    )


def _register_quadrotor() -> None:
    """Hover under wind: all of the motion and the wind, the inertial measurement unit, and that with the position."""
    imu = tuple(f"{sensor}_{axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")
    position = ("position_x", "position_y", "position_z")
    motion = (
        *position,
        *(f"velocity_{axis}" for axis in "xyz"),
        *("q_x", "q_y", "q_z", "q_w", "roll_rate", "pitch_rate", "yaw_rate"),
        *("rotor_front", "rotor_left", "rotor_back", "rotor_right"),
        *("wind_x", "wind_y", "wind_z", "mean_wind_x", "mean_wind_y"),
    )
    register_system(
        "QuadrotorHover",
        "beliefgym.envs.quadrotor:Quadrotor",
        max_episode_steps=500,
        partial={"": motion, "IMU": imu, "IMUPosition": (*position, *imu)},
    )
    noise = [0.01] * 3 + [0.2] * 3  # rad/s, m/s^2
    for suffix, components, std in (
        ("IMUNoisy", imu, noise),
        ("IMUPositionNoisy", (*position, *imu), [0.002] * 3 + noise),
    ):
        register_composed(
            f"QuadrotorHover{suffix}",
            system="beliefgym.envs.quadrotor:Quadrotor",
            parameters={"components": list(components)},
            layers=[("ObservationNoise", {"std": std})],
            exposes={"noise": ("ObservationNoise", "std")},
            max_episode_steps=500,
        )


def _register_mico() -> None:
    """The payload lift: everything, and what the robot's own sensors tell, angles and torques."""
    sensors = tuple(f"{kind}_{joint}" for kind in ("joint", "torque") for joint in range(1, 7))
    register_system(
        "MicoLift", "beliefgym.envs.mico:MicoLift", max_episode_steps=160, partial={"Torque": sensors}
    )
    register_composed(
        "MicoLiftTorqueNoisy",
        system="beliefgym.envs.mico:MicoLift",
        parameters={"components": list(sensors)},
        layers=[("ObservationNoise", {"std": [0.002] * 6 + [0.3] * 6})],  # rad, N m
        exposes={"noise": ("ObservationNoise", "std")},
        max_episode_steps=160,
    )


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
    _register_cart_pole_classics()
    _register_helicopters()
    _register_quadrotor()
    _register_mico()
    _register_baxter()
    _register_sensors_of_helicopters()
    _register_locomotion()


def _register_cart_pole_classics() -> None:
    """CartPole as the suites of hidden-state tasks have it: full, positions only, and positions with noise."""
    push = ("DiscreteActions", {"bins": 2})
    hide = ("PartialObservation", {"keep": ["x", "theta"]})
    system = "beliefgym.envs.cart_pole_balance:CartPoleBalance"
    for suffix, layers in {"": [push], "Position": [hide, push]}.items():
        register_composed(f"CartPoleBalance{suffix}", system=system, layers=layers, max_episode_steps=500)
    for level, std in {"Easy": 0.1, "Medium": 0.2, "Hard": 0.3}.items():
        register_composed(
            f"CartPoleBalanceNoisy{level}",
            system=system,
            layers=[hide, ("ObservationNoise", {"std": std}), push],
            exposes={"noise": ("ObservationNoise", "std")},
            max_episode_steps=200,
        )


def _register_baxter() -> None:
    """Reaching with Baxter's left arm: a joint configuration, and a place for the hand."""
    angles = tuple(f"{joint}_angle" for joint in ("s0", "s1", "e0", "e1", "w0", "w1", "w2"))
    register_system(
        "BaxterReach",
        "beliefgym.envs.baxter:BaxterReach",
        max_episode_steps=200,
        partial={"Position": angles},
    )
    register_system(
        "BaxterReachHand",
        "beliefgym.envs.baxter_hand:BaxterReachHand",
        max_episode_steps=200,
        partial={"Position": (*angles, "target_x", "target_y", "target_z")},
    )


def _register_sensors_of_helicopters() -> None:
    """The hover with noise on every component, and with a late observation."""
    system = "beliefgym.envs.helicopter:Helicopter"
    register_composed(
        "HelicopterHoverNoisy",
        system=system,
        layers=[("ObservationNoise", {"std": 0.1})],
        exposes={"noise": ("ObservationNoise", "std")},
        max_episode_steps=400,
    )
    register_composed(
        "HelicopterHoverDelayed",
        system=system,
        layers=[("ObservationDelay", {"steps": 1})],
        exposes={"delay": ("ObservationDelay", "steps")},
        max_episode_steps=400,
    )


def _register_locomotion() -> None:
    """Gymnasium's planar MuJoCo tasks with their velocities hidden."""
    for name in ("Hopper", "Walker2d", "HalfCheetah", "Swimmer", "InvertedPendulum"):
        register_composed(
            f"{name}Position",
            base=f"beliefgym.envs.locomotion:{name}Env",
            layers=[("PartialObservation", {"keep": ["qpos_*"]})],
            parameters={"shown": ["qpos_*"]},
            max_episode_steps=1000,
        )
