"""A differential-drive base (Videre Erratic) that is to drive to a pose, with and without the lag of its motors.

With pose (x, y, theta) in the goal's frame, speed v, turning rate w, commands v_c and w_c,

    x' = v cos(theta),   y' = v sin(theta),   theta' = w
    v' = clip((v_c - v) / lag, -a, a),        w' = clip((w_c - w) / lag, -b, b)

for the base with a lag (integrated by RK4), and v = v_c, w = w_c for the kinematic one, whose arc is exact:

    x <- x + v dt s cos(theta + w dt / 2),   y <- y + v dt s sin(theta + w dt / 2),   s = sin(w dt / 2) / (w dt / 2)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.integrators import rk4
from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas

WHEEL_SEPARATION, WHEEL_DIAMETER = 0.3305, 0.15  # m, of the Erratic
WHEEL_SPEED = 1.0  # m/s, the firmware's limit
N_LANDMARKS = 3


@dataclass(frozen=True, kw_only=True)
class MobileBaseKinematic(System):
    """A differential-drive base without inertia drives to a pose: the goal is the origin, heading along x.

    The goal's frame is x forward, y left of the goal pose; the robot's frame is the same of the robot.

    | # | state  | unit |   | #     | observation                                   | unit | range         |
    |---|--------|------|   |-------|-----------------------------------------------|------|---------------|
    | 0 | x      | m    |   | 0-1   | goal_forward, goal_left: in the robot's frame | m    |               |
    | 1 | y      | m    |   | 2-3   | cos_theta, sin_theta                          | 1    | -1..1         |
    | 2 | theta  | rad  |   | 4-5   | x, y                                          | m    |               |
    |   |        |      |   | 6-8   | range_1, cos_bearing_1, sin_bearing_1         | m, 1 | 0.., -1..1    |
    |   |        |      |   | 9-11  | range_2, cos_bearing_2, sin_bearing_2         | m, 1 | 0.., -1..1    |
    |   |        |      |   | 12-14 | range_3, cos_bearing_3, sin_bearing_3         | m, 1 | 0.., -1..1    |

    | # | action     | range                          |
    |---|------------|--------------------------------|
    | 0 | speed      | -0.5..0.5 m/s                  |
    | 1 | turning    | -1.745..1.745 rad/s (100 deg/s)|

    A landmark outside of the field of view reads 0, 0, 0. The wheels then run at speed +- turning * separation / 2, at
    most 0.79 m/s, which the firmware's limit of 1 m/s allows.

    Reward, in 0..1, of the state reached, with d the distance to the goal (chosen here):

        (0.7 + 0.3 (1 + cos theta)/2) / (1 + (d / 0.25 m)^2)

    Start: at rest, uniform in the disc of radius start_distance around the goal, any heading. End: after 200 steps.
    Versions: v0, the first.

    | id                                    | shows                                                       |
    |---------------------------------------|-------------------------------------------------------------|
    | beliefgym/MobileBaseKinematic-v0      | 0-3                                                         |
    | beliefgym/MobileBase-v0               | 0-3, velocity and turn_rate (the base with a lag)           |
    | beliefgym/MobileBaseNoisy-v0          | the same with odometry noise: 0.006 m, 0.051 rad            |
    | beliefgym/MobileBasePosition-v0       | x, y: the position without the heading                      |
    | beliefgym/MobileBaseLandmarks-v0      | 6-14: range and bearing of the landmarks in view            |
    | beliefgym/MobileBaseLandmarksNoisy-v0 | the same with noise of 0.05 m and 0.05 rad (chosen)         |

    Of the sources (erratic_robot, Videre's manual): wheels, limits, accelerations, odometry noise. Chosen here: dt,
    lag, the actuation noise of 0.01 m/s and 0.03 rad/s, landmarks, field of view, start, length and reward.

    Args:
        max_speed: m/s. max_turning: rad/s.
        start_distance: m.
        landmarks: ((x, y), ...) in m in the goal's frame, three of them.
        field_of_view: rad, the whole angle in which landmarks are seen, around straight ahead.

    Reference: thesis proposal, Sec. 3.2.3 (Videre Erratic: state 3, control 2).
    """

    dt: float = 0.1
    actuation_noise_std: float | tuple[float, ...] = (0.01, 0.03)
    max_speed: float = 0.5
    max_turning: float = math.radians(100.0)
    start_distance: float = 3.0
    landmarks: tuple[tuple[float, float], ...] = ((2.5, 1.5), (2.5, -1.5), (-2.5, 0.0))
    field_of_view: float = math.pi

    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "theta")
    action_names: ClassVar = ("speed", "turning")
    observation_names: ClassVar[tuple[str, ...]] = (
        *("goal_forward", "goal_left", "cos_theta", "sin_theta", "x", "y"),
        *(
            f"{kind}_{k}"
            for k in range(1, N_LANDMARKS + 1)
            for kind in ("range", "cos_bearing", "sin_bearing")
        ),
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "landmarks", tuple((float(x), float(y)) for x, y in self.landmarks))
        super().__post_init__()
        for name in ("max_speed", "max_turning", "start_distance", "field_of_view"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        if len(self.landmarks) != N_LANDMARKS:
            raise ValueError(f"expected {N_LANDMARKS} landmarks (x, y), got {len(self.landmarks)}")
        fastest = self.max_speed + 0.5 * WHEEL_SEPARATION * self.max_turning
        if fastest > WHEEL_SPEED:
            raise ValueError(
                f"expected limits that the wheels can follow (at most {WHEEL_SPEED:g} m/s), but max_speed and "
                f"max_turning together ask for {fastest:.3g} m/s"
            )

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Speed in m/s and turning rate in rad/s."""
        high = np.array([self.max_speed, self.max_turning])
        return -high, high

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cosines and sines are within -1..1, ranges at least 0."""
        names = self.observation_names
        turns = [name.startswith(("cos", "sin")) for name in names]
        high = np.where(turns, 1.0, np.inf)
        low = np.where([name.startswith("range") for name in names], 0.0, -high)
        return low, high

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """The exact arc of constant speed and turning rate."""
        xp = array_namespace(state)
        x, y, theta = state[..., 0], state[..., 1], state[..., 2]
        path, half = self.dt * action[..., 0], (0.5 * self.dt) * action[..., 1]
        straight = xp.abs(half) < 1e-4
        safe = xp.where(straight, xp.ones_like(half), half)
        chord = path * xp.where(straight, 1.0 - half * half * (1.0 / 6.0), xp.sin(safe) / safe)
        middle = theta + half
        return xp.stack([x + chord * xp.cos(middle), y + chord * xp.sin(middle), theta + 2.0 * half], axis=-1)

    def observe(self, state: Array) -> Array:
        """Goal, heading, position and landmarks; see the class."""
        return array_namespace(state).stack(self._seen(state), axis=-1)

    def _seen(self, state: Array) -> list[Array]:
        xp = array_namespace(state)
        x, y, theta = state[..., 0], state[..., 1], state[..., 2]
        c, s = xp.cos(theta), xp.sin(theta)
        seen = [-(c * x + s * y), s * x - c * y, c, s, x, y]
        for landmark_x, landmark_y in self.landmarks:
            dx, dy = landmark_x - x, landmark_y - y
            distance = xp.sqrt(dx * dx + dy * dy)
            far = xp.maximum(distance, 1e-9 + 0.0 * distance)
            ahead, left = (c * dx + s * dy) / far, (c * dy - s * dx) / far
            # at full angle the cosine of the half angle is -1, and the rounding of a unit vector is not to hide it
            visible = ahead >= math.cos(0.5 * min(self.field_of_view, 2 * math.pi)) - 1e-9
            nothing = 0.0 * distance
            seen += [xp.where(visible, value, nothing) for value in (distance, ahead, left)]
        return seen

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Near the goal, and turned as the goal is; in 0..1; see the class."""
        xp = array_namespace(next_state)
        x, y, theta = next_state[..., 0], next_state[..., 1], next_state[..., 2]
        return (0.7 + 0.15 * (1.0 + xp.cos(theta))) / (1.0 + (x * x + y * y) * 16.0)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """A smooth cost that leads to the reward: x^2 + y^2 + (1 - cos theta) / 2 + v_c^2 / 10 + w_c^2 / 100."""
        xp = array_namespace(state)
        x, y, theta = state[..., 0], state[..., 1], state[..., 2]
        speed, turning = action[..., 0], action[..., 1]
        return (
            x * x + y * y + 0.5 * (1.0 - xp.cos(theta)) + 0.1 * (speed * speed) + 0.01 * (turning * turning)
        )

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """At rest, uniform in the disc, any heading."""
        drawn = streams.uniform(3, mask)
        distance, angle = self.start_distance * np.sqrt(drawn[:, 0]), 2.0 * np.pi * drawn[:, 1]
        state = np.zeros((len(drawn), self.n_state))
        state[:, 0], state[:, 1] = distance * np.cos(angle), distance * np.sin(angle)
        state[:, 2] = np.pi * (2.0 * drawn[:, 2] - 1.0)
        return state

    def expert(self) -> Any:
        """A stabilising law in polar coordinates, driving forwards or backwards; see planning/mobile_base.py."""
        from beliefgym.envs.planning.mobile_base import mobile_base_expert

        return mobile_base_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """Goal pose, landmarks (filled where seen), the robot with its wheels, and its command."""
        x, y, theta = (float(value) for value in state[:3])
        canvas.view(center=(0.0, 0.0), width=2.0 * self.start_distance + 1.0)
        seen = np.asarray(self.observe(state))[6:15:3] > 0.0
        for (landmark_x, landmark_y), visible in zip(self.landmarks, seen, strict=True):
            if visible:
                canvas.line((x, y), (landmark_x, landmark_y), 0.02, "guide")
            canvas.circle((landmark_x, landmark_y), 0.12, "joint" if visible else "guide")
        canvas.circle((0.0, 0.0), 0.3, "target", 0.04)
        canvas.arrow((0.0, 0.0), (0.55, 0.0), 0.05, "target")
        heading, side = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        center = np.array([x, y])
        for sign in (-1.0, 1.0):
            wheel = center + sign * (0.5 * WHEEL_SEPARATION + 0.04) * side
            canvas.line(_point(wheel - 0.11 * heading), _point(wheel + 0.11 * heading), 0.07, "joint")
        canvas.circle((x, y), 0.18, "body")
        canvas.line((x, y), _point(center + 0.17 * heading), 0.05, "background")
        if action is not None:
            reach = 0.18 + 0.6 * abs(float(action[0])) / self.max_speed
            tip = center + np.sign(action[0]) * reach * heading
            canvas.arrow(_point(center + np.sign(action[0]) * 0.18 * heading), _point(tip), 0.05, "force")
            canvas.turn_arrow((x, y), 0.32, -0.5 * float(action[1]) / self.max_turning, "force")


@dataclass(frozen=True, kw_only=True)
class MobileBase(MobileBaseKinematic):
    """A differential-drive base whose motors follow the commands with a lag drives to a pose.

    `MobileBaseKinematic` says all but this: the state has two more components,

    | # | state     | unit  |   | #  | observation | unit  |
    |---|-----------|-------|   |----|-------------|-------|
    | 3 | velocity  | m/s   |   | 15 | velocity    | m/s   |
    | 4 | turn_rate | rad/s |   | 16 | turn_rate   | rad/s |

    which follow the commands speed and turning by a first-order lag within the accelerations that the base's planner
    uses, 2.5 m/s^2 and 3.2 rad/s^2 (of the source; the lag of 0.15 s is chosen). The others are

    x, y, theta; goal_forward, goal_left, cos_theta, sin_theta; range_k, cos_bearing_k, sin_bearing_k of the landmarks:
    range_1, cos_bearing_1, sin_bearing_1, range_2, cos_bearing_2, sin_bearing_2, range_3, cos_bearing_3, sin_bearing_3.

    Versions: v0, the first.

    Args:
        lag: s, of both motors. max_acceleration: m/s^2. max_turning_acceleration: rad/s^2.

    Reference: thesis proposal, Sec. 3.2.3.
    """

    lag: float = 0.15
    max_acceleration: float = 2.5
    max_turning_acceleration: float = 3.2

    state_names: ClassVar[tuple[str, ...]] = (*MobileBaseKinematic.state_names, "velocity", "turn_rate")
    observation_names: ClassVar[tuple[str, ...]] = (
        *MobileBaseKinematic.observation_names,
        "velocity",
        "turn_rate",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("lag", "max_acceleration", "max_turning_acceleration"):
            if not getattr(self, name) > 0:
                raise ValueError(
                    f"expected {name} above 0, got {getattr(self, name)!r} (without a lag: MobileBaseKinematic)"
                )

    def derivative(self, state: Array, action: Array) -> Array:
        """Time derivative of the state, (..., 5), under commands (..., 2)."""
        xp = array_namespace(state)
        theta, velocity, rate = state[..., 2], state[..., 3], state[..., 4]
        pull = (action[..., 0] - velocity) / self.lag
        turn = (action[..., 1] - rate) / self.lag
        return xp.stack(
            [
                velocity * xp.cos(theta),
                velocity * xp.sin(theta),
                rate,
                _limited(pull, self.max_acceleration),
                _limited(turn, self.max_turning_acceleration),
            ],
            axis=-1,
        )

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """RK4 over one control period."""
        return rk4(self.derivative, state, action, self.dt)

    def _seen(self, state: Array) -> list[Array]:
        return [*super()._seen(state), state[..., 3], state[..., 4]]


def _limited(value: Array, limit: float) -> Array:
    xp = array_namespace(value)
    most = limit + 0.0 * value
    return xp.minimum(xp.maximum(value, -most), most)


def _point(vector: NDArray[np.float64]) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])
