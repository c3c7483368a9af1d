"""What counts as having done each task: a measure of the last second's true states, and its limit.

A measure takes a system and states (k, n, n_state) of the last second and gives (n,) numbers; below the limit is
success. Where holding matters it is the largest value over the second, where arriving matters the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Success:
    """A criterion.

    Args:
        description: in words.
        measure: (system, states (k, n, n_state)) -> (n,).
        limit: success is below it.
        unit: of the measure.
    """

    description: str
    measure: Callable[[Any, Floats], Floats]
    limit: float
    unit: str


def _columns(system: Any, states: Floats, *names: str) -> Floats:
    """(k, n, len(names)) of named state components."""
    return states[..., [system.state_names.index(name) for name in names]]


def _from_upright(*names: str, upright: float = 0.0) -> Callable[[Any, Floats], Floats]:
    """The largest angle from upright over the last second, of all the named joints."""

    def measure(system: Any, states: Floats) -> Floats:
        angle = _columns(system, states, *names) - upright
        largest: Floats = np.abs((angle + np.pi) % (2 * np.pi) - np.pi).max(axis=(0, 2))
        return largest

    return measure


def _distance_at_the_end(*names: str) -> Callable[[Any, Floats], Floats]:
    """How far the named coordinates are from 0 in the last state."""

    def measure(system: Any, states: Floats) -> Floats:
        distance: Floats = np.linalg.norm(_columns(system, states, *names)[-1], axis=-1)
        return distance

    return measure


_POSITION = ("position_north", "position_east", "position_down")


def _funnel_error_at_the_end(system: Any, states: Floats) -> Floats:
    """How far the helicopter is from its place on the funnel in the last state."""
    names = [f"position_error_{axis}" for axis in ("forward", "right", "down")]
    columns = [system.observation_names.index(name) for name in names]
    distance: Floats = np.linalg.norm(system.observe(states[-1])[..., columns], axis=-1)
    return distance


def _lag_at_the_end(system: Any, states: Floats) -> Floats:
    """How far the joint that is farthest from its reference is from it in the last state."""
    lag: Floats = np.abs(system.tracking_error(states[-1])).max(axis=-1)
    return lag


def _joint_error_at_the_end(system: Any, states: Floats) -> Floats:
    """How far the joint that is farthest from the target is from it in the last state."""
    error: Floats = np.abs(states[-1][..., :7] - np.array(system.target)).max(axis=-1)
    return error


def _arm_missed_at_the_end(system: Any, states: Floats) -> Floats:
    """0 in the arm that the cue named, 1 in none, 2 in the other one, in the last state."""
    cue, arm = np.moveaxis(_columns(system, states, "cue", "arm")[-1], -1, 0)
    missed: Floats = 1.0 - cue * arm
    return missed


def _hand_error_at_the_end(system: Any, states: Floats) -> Floats:
    """How far the hand is from its target in the last state."""
    seen = system.observe(states[-1])
    hand, target = (
        seen[..., [system.observation_names.index(f"{point}_{axis}") for axis in "xyz"]]
        for point in ("hand", "target")
    )
    distance: Floats = np.linalg.norm(hand - target, axis=-1)
    return distance


_UPRIGHT = Success("held upright for the last second", _from_upright("theta"), 0.2, "rad")
_HOVERS = Success("within 0.5 m of the hover point at the end", _distance_at_the_end(*_POSITION), 0.5, "m")
_JOINTS = Success(
    "every joint within 0.01 rad of the target at the end", _joint_error_at_the_end, 1e-2, "rad"
)


@dataclass(frozen=True)
class Trial:
    """An expert's task.

    Args:
        env_id: of the environment.
        success: the criterion.
        parameters: of the system, where they differ from the registered ones.
        steps: after which success is judged; the time limit by default. A task that ends when it is done has them.
    """

    env_id: str
    success: Success
    parameters: Mapping[str, Any] = field(default_factory=dict)
    steps: int | None = None

    @property
    def label(self) -> str:
        """The task and the criterion in words."""
        changed = "".join(f", {name}={value}" for name, value in self.parameters.items())
        return f"{self.env_id.rpartition('/')[2]}{changed}: {self.success.description}"


TRIALS: tuple[Trial, ...] = (
    Trial("beliefgym/Pendulum-v0", _UPRIGHT),
    Trial("beliefgym/CartPoleSwingUp-v0", _UPRIGHT),
    Trial(
        "beliefgym/CartPoleBalance-v0",
        Success("still standing after 500 steps", _from_upright("theta"), 0.2, "rad"),
    ),
    # at gusts of 1 the optimum of the source's cost stays in the air but does not stay within 0.5 m; a stiffer LQR does
    Trial("beliefgym/HelicopterHover-v0", _HOVERS, {"wrench_noise_std": 0.1}),
    Trial("beliefgym/HelicopterHover-v0", _HOVERS),
    Trial("beliefgym/HelicopterHover-v0", _HOVERS, {"expert_effort": 0.02, "max_change": 1.0}),
    Trial(
        "beliefgym/HelicopterFunnel-v0",
        Success("within 0.5 m of its target at the end of the funnel", _funnel_error_at_the_end, 0.5, "m"),
    ),
    Trial(
        "beliefgym/HelicopterCompetition-v0",
        Success(
            "in the air for 6000 steps, within 1 m at the end", _distance_at_the_end(*_POSITION), 1.0, "m"
        ),
    ),
    Trial(
        "beliefgym/MicoLift-v0",
        Success("every joint within 0.01 rad of the lift's end", _lag_at_the_end, 1e-2, "rad"),
    ),
    Trial(
        "beliefgym/QuadrotorHover-v0",
        Success(
            "within 0.2 m of the hover point at the end",
            _distance_at_the_end("position_x", "position_y", "position_z"),
            0.2,
            "m",
        ),
    ),
    # one step's default noise alone turns each wrist joint by about 0.008 rad: there 0.01 rad cannot be held
    Trial("beliefgym/BaxterReach-v0", _JOINTS, {"actuation_noise_std": 0.0}),
    Trial("beliefgym/BaxterReach-v0", _JOINTS),
    Trial(
        "beliefgym/BaxterReachHand-v0",
        Success("the hand within 1 cm of its target at the end", _hand_error_at_the_end, 1e-2, "m"),
    ),
    *(
        Trial(
            env_id, Success("within 5 cm of the goal at the end", _distance_at_the_end("x", "y"), 0.05, "m")
        )
        for env_id in ("beliefgym/MobileBase-v0", "beliefgym/MobileBaseKinematic-v0")
    ),
    Trial(
        "beliefgym/DoublePendulumSwingUp-v0",
        Success(
            "both links held upright for the last second",
            _from_upright("theta_1", "theta_2", upright=np.pi),
            0.2,
            "rad",
        ),
    ),
    Trial(
        "beliefgym/TMaze-v0",
        Success("in the arm that the cue named after 11 steps", _arm_missed_at_the_end, 0.5, "arms"),
        steps=11,
    ),
)
