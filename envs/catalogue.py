"""Which environments there are: one call a system."""

from __future__ import annotations

from typing import Any

from beliefgym.envs.registration import register_composed, register_system, registered_ids

Layer = tuple[str, dict[str, Any]]  # a wrapper and its arguments


def register_all() -> None:
    """Register every environment of the package; a second call changes nothing."""
    if registered_ids():
        return
    _pendulums()
    _cart_pole_balancing()
    _helicopters()
    _quadrotor()
    _mobile_base()
    _arms()
    _locomotion()
    _t_maze()


def _pendulums() -> None:
    """One pole, one pole on a cart, two poles."""
    register_system(
        "Pendulum",
        "beliefgym.envs.pendulum:Pendulum",
        max_episode_steps=200,
        partial={"Position": ("cos_theta", "sin_theta")},
    )
    hide: Layer = ("PartialObservation", {"keep": ["cos_theta", "sin_theta"]})
    for level, std, n_steps in (("Easy", 0.1, 200), ("Medium", 0.2, 150), ("Hard", 0.3, 100)):
        register_composed(
            f"PendulumPositionNoisy{level}",
            system="beliefgym.envs.pendulum:Pendulum",
            layers=[hide, ("ObservationNoise", {"std": std, "clip": True})],
            exposes={"noise": ("ObservationNoise", "std")},
            max_episode_steps=n_steps,
        )
    register_system(
        "CartPoleSwingUp",
        "beliefgym.envs.cart_pole:CartPole",
        max_episode_steps=200,
        partial={"Position": ("x", "cos_theta", "sin_theta")},
    )
    register_system(
        "DoublePendulumSwingUp",
        "beliefgym.envs.double_pendulum:DoublePendulum",
        max_episode_steps=200,
        partial={"Position": ("cos_theta_1", "sin_theta_1", "cos_theta_2", "sin_theta_2")},
    )


def _cart_pole_balancing() -> None:
    """CartPole as the suites of hidden-state tasks have it: full, positions only, and positions with noise."""
    push: Layer = ("DiscreteActions", {"bins": 2})
    hide: Layer = ("PartialObservation", {"keep": ["x", "theta"]})
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


def _helicopters() -> None:
    """Hover and funnel of Abbeel and Ng's helicopter, and the helicopter of the RL competitions."""
    quaternion = ("q_x", "q_y", "q_z", "q_w")
    register_system(
        "HelicopterHover",
        "beliefgym.envs.helicopter:Helicopter",
        max_episode_steps=400,
        partial={"Position": ("position_north", "position_east", "position_down", *quaternion)},
        noisy={"Noisy": (None, 0.1)},
    )
    register_composed(
        "HelicopterHoverDelayed",
        system="beliefgym.envs.helicopter:Helicopter",
        layers=[("ObservationDelay", {"steps": 1})],
        exposes={"delay": ("ObservationDelay", "steps")},
        max_episode_steps=400,
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


def _quadrotor() -> None:
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
    noise = [0.01] * 3 + [0.2] * 3  # rad/s, m/s^2
    register_system(
        "QuadrotorHover",
        "beliefgym.envs.quadrotor:Quadrotor",
        max_episode_steps=500,
        partial={"": motion, "IMU": imu, "IMUPosition": (*position, *imu)},
        noisy={"IMUNoisy": (imu, noise), "IMUPositionNoisy": ((*position, *imu), [0.002] * 3 + noise)},
    )


def _mobile_base() -> None:
    """The base with and without lag: the goal in the robot's frame, position alone, landmarks, and their noise."""
    lagging, kinematic = (f"beliefgym.envs.mobile_base:MobileBase{kind}" for kind in ("", "Kinematic"))
    goal = ("goal_forward", "goal_left", "cos_theta", "sin_theta")
    motion = (*goal, "velocity", "turn_rate")
    landmarks = tuple(f"{kind}_{k}" for k in (1, 2, 3) for kind in ("range", "cos_bearing", "sin_bearing"))
    register_system("MobileBaseKinematic", kinematic, max_episode_steps=200, partial={"": goal})
    register_system(
        "MobileBase",
        lagging,
        max_episode_steps=200,
        partial={"": motion, "Position": ("x", "y"), "Landmarks": landmarks},
        noisy={
            "Noisy": (motion, [0.006] * 2 + [0.051] * 2 + [0.0] * 2),  # m; rad as cosine and sine show it
            "LandmarksNoisy": (landmarks, 0.05),
        },
    )


def _arms() -> None:
    """Baxter's left arm reaches a joint configuration or a place; the Mico lifts what it does not know."""
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
    sensors = tuple(f"{kind}_{joint}" for kind in ("joint", "torque") for joint in range(1, 7))
    register_system(
        "MicoLift",
        "beliefgym.envs.mico:MicoLift",
        max_episode_steps=160,
        partial={"Torque": sensors},
        noisy={"TorqueNoisy": (sensors, [0.002] * 6 + [0.3] * 6)},  # rad, N m
    )


def _locomotion() -> None:
    """Gymnasium's planar MuJoCo tasks with their velocities hidden."""
    for name in ("Hopper", "Walker2d", "HalfCheetah", "Swimmer", "InvertedPendulum"):
        register_composed(
            f"{name}Position",
            base=f"beliefgym.envs.locomotion:{name}Env",
            layers=[("PartialObservation", {"keep": ["qpos_*"]})],
            parameters={"shown": ["qpos_*"]},
            max_episode_steps=1000,
        )


def _t_maze() -> None:
    """The T-maze with everything in view, and with the cue at the start only; the steps are five times the length."""
    memory = ["at_start", "in_corridor", "at_junction", "cue_seen"]
    for suffix, shown in {"": {}, "Memory": {"components": memory}}.items():
        register_composed(
            f"TMaze{suffix}",
            system="beliefgym.envs.t_maze:TMaze",
            layers=[("DiscreteActions", {"bins": 3})],
            parameters=shown,
            max_episode_steps=50,
        )
