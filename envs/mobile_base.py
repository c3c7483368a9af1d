"""A differential-drive robot, the Videre Erratic of the thesis proposal (Sec. 3.2.3), that drives to a goal pose.

`MobileBaseKinematic` takes its commanded velocities at once (3 states), `MobileBase` lags behind them under limits of
acceleration (5 states). Source of the constants: the published data of the Erratic and of its planner's settings.
"""

from __future__ import annotations

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

LANDMARKS = ((2.5, 1.5), (-1.5, 2.5), (-0.5, -3.0))  # m, in the goal's frame
POSE = ("x", "y", "cos_theta", "sin_theta")
SIGHTINGS = (
    *("range_1", "cos_bearing_1", "sin_bearing_1"),
    *("range_2", "cos_bearing_2", "sin_bearing_2"),
    *("range_3", "cos_bearing_3", "sin_bearing_3"),
)


@dataclass(frozen=True, kw_only=True)
class MobileBaseKinematic(System):
    """A robot on two wheels that moves as it is told, and drives to a goal pose.

    With the goal at the origin, its heading along x, and the commands (v, omega) held for a period dt, the robot
    drives an arc, which is integrated exactly (h = omega dt / 2):

        x' = x + v dt sinc(h) cos(theta + h),   y' = y + v dt sinc(h) sin(theta + h),   theta' = theta + omega dt

    | # | state | unit |   | # | observation   | range (m)        |   | # | action    | range               |
    |---|-------|------|   |---|---------------|------------------|   |---|-----------|---------------------|
    | 0 | x     | m    |   | 0 | x             | unbounded        |   | 0 | speed     | -0.5..0.5 m/s       |
    | 1 | y     | m    |   | 1 | y             | unbounded        |   | 1 | turn_rate | -1.745..1.745 rad/s |
    | 2 | theta | rad  |   | 2 | cos_theta     | -1..1            |   |   |           |                     |
    |   |       |      |   | 3 | sin_theta     | -1..1            |   |   |           |                     |
    |   |       |      |   | . | range_i       | 0 and above      |   |   |           |                     |
    |   |       |      |   | . | cos_bearing_i | -1..1            |   |   |           |                     |
    |   |       |      |   | . | sin_bearing_i | -1..1            |   |   |           |                     |

    The last three stand for each landmark, i = 1, 2, 3 (range_1, cos_bearing_1, sin_bearing_1, range_2, cos_bearing_2,
    sin_bearing_2, range_3, cos_bearing_3, sin_bearing_3): its distance and its direction from the robot's heading. A
    landmark outside the camera's field of view shows 0 in all three. Landmarks stand at (2.5, 1.5), (-1.5, 2.5) and
    (-0.5, -3) m in the goal's frame.

    The thesis gives the goal in the robot's frame at the start. That is the same task in other coordinates:
    `state_for_goal(ahead, left, turn)` is the start state for such a goal, `goal_in_robot_frame(state)` leads back.

    Reward, in 0..1, of the state reached, with the distance r = (x^2 + y^2 + e^2)^(1/2) - e smoothed by e = 5 cm:

        exp(-r / 1 m) (2 + cos theta) / 3

    Start: at rest, anywhere within start_distance of the goal (uniform in the area), any heading. End: after 200
    steps (20 s).

    | id                                       | shows                                  |
    |------------------------------------------|----------------------------------------|
    | beliefgym/MobileBaseKinematic-v0         | x, y, cos_theta, sin_theta             |
    | beliefgym/MobileBaseKinematicPosition-v0 | x, y: the heading shows in motion only |

    Versions: v0, the first.

    The wheels turn at v +- omega wheel_separation / 2; a command that would drive one faster than max_wheel_speed is
    scaled down as a whole, which keeps the curve. The source limits v and omega only; its firmware's 1 m/s straight
    ahead is taken for the wheels' limit, which its limits of v and omega do not reach.

    Chosen here: dt, the goal's heading, the reward, the start, the length, the landmarks and the field of view.

    Args:
        max_speed: m/s. max_turn_rate: rad/s. max_wheel_speed: m/s. wheel_separation: m. wheel_diameter: m (drawn only).
        start_distance: m. field_of_view: rad, of the camera that sees landmarks; 2 pi sees all round.

    Reference: thesis proposal, Sec. 3.2.3 (Videre Erratic).
    """

    dt: float = 0.1
    max_speed: float = 0.5
    max_turn_rate: float = float(np.deg2rad(100.0))
    max_wheel_speed: float = 1.0
    wheel_separation: float = 0.3305
    wheel_diameter: float = 0.15
    start_distance: float = 3.0
    field_of_view: float = float(np.deg2rad(120.0))

    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "theta")
    action_names: ClassVar[tuple[str, ...]] = ("speed", "turn_rate")
    observation_names: ClassVar[tuple[str, ...]] = (*POSE, *SIGHTINGS)

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = ("max_speed", "max_turn_rate", "max_wheel_speed", "wheel_separation", "wheel_diameter")
        for name in (*positive, "start_distance", "field_of_view"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        if self.field_of_view > 2.0 * np.pi:
            raise ValueError(f"expected field_of_view of at most 2 pi rad, got {self.field_of_view!r}")

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Limits of the commanded speed in m/s and turn rate in rad/s."""
        high = np.array([self.max_speed, self.max_turn_rate])
        return -high, high

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cosines and sines are bounded, ranges are at least 0."""
        names = self.observation_names
        high = np.array([1.0 if name.startswith(("cos", "sin")) else np.inf for name in names])
        return np.where([name.startswith("range") for name in names], 0.0, -high), high

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        xp = array_namespace(state)
        speed, turn_rate = self._within_the_wheels_limit(action)
        half = (0.5 * self.dt) * turn_rate
        small = xp.abs(half) < 1e-3
        chord = xp.where(small, 1.0 - half * half / 6.0, xp.sin(half) / xp.where(small, 1.0 + 0.0 * half, half))
        chord = chord * speed * self.dt
        middle = state[..., 2] + half
        x, y = state[..., 0] + chord * xp.cos(middle), state[..., 1] + chord * xp.sin(middle)
        return xp.stack([x, y, middle + half], axis=-1)

    def observe(self, state: Array) -> Array:
        """The pose, then the sightings of the landmarks."""
        return array_namespace(state).stack(self._pose_and_sightings(state), axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Near and aligned; in 0..1; see the class."""
        xp = array_namespace(next_state)
        x, y = next_state[..., 0], next_state[..., 1]
        distance = xp.sqrt(x * x + y * y + SMOOTHED**2) - SMOOTHED
        return xp.exp(-distance) * (2.0 + xp.cos(next_state[..., 2])) * (1.0 / 3.0)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """A smooth cost that leads to the reward: x^2 + y^2 + (1 - cos theta) / 2, and a little for the commands."""
        xp = array_namespace(state)
        x, y = state[..., 0], state[..., 1]
        v, w = action[..., 0] * (1.0 / self.max_speed), action[..., 1] * (1.0 / self.max_turn_rate)
        return x * x + y * y + 0.5 * (1.0 - xp.cos(state[..., 2])) + 0.01 * (v * v + w * w)

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """At rest, uniform in the disc of start_distance about the goal, any heading."""
        drawn = streams.uniform(3, mask)
        distance, direction = self.start_distance * np.sqrt(drawn[:, 0]), 2.0 * np.pi * drawn[:, 1]
        state = np.zeros((len(drawn), self.n_state))
        state[:, 0], state[:, 1] = distance * np.cos(direction), distance * np.sin(direction)
        state[:, 2] = np.pi * (2.0 * drawn[:, 2] - 1.0)
        return state

    def state_for_goal(self, ahead: float, left: float, turn: float = 0.0) -> NDArray[np.float64]:
        """The state, at rest, of a robot that sees its goal in its own frame: (n_state,).

        Args:
            ahead: m, along the robot's heading. left: m, across it.
            turn: rad, from the robot's heading to the goal's.
        """
        c, s = np.cos(turn), np.sin(turn)
        state = np.zeros(self.n_state)
        state[:3] = -c * ahead - s * left, s * ahead - c * left, -turn
        return state

    def goal_in_robot_frame(self, state: Array) -> Array:
        """The goal's place in the robot's frame and the turn to its heading: (..., n_state) -> (..., 3)."""
        xp = array_namespace(state)
        x, y, theta = state[..., 0], state[..., 1], state[..., 2]
        c, s = xp.cos(theta), xp.sin(theta)
        return xp.stack([-c * x - s * y, s * x - c * y, -theta], axis=-1)

    def expert(self) -> Any:
        """Iterative LQR on the true model about curves of a polar control law, tracked by its gains."""
        from beliefgym.envs.planning.mobile_base import mobile_base_expert

        return mobile_base_expert(self)

    def _within_the_wheels_limit(self, action: Array) -> tuple[Array, Array]:
        """Commanded speed and turn rate, scaled down where a wheel would turn too fast."""
        xp = array_namespace(action)
        speed, turn_rate = action[..., 0], action[..., 1]
        fastest = xp.abs(speed) + (0.5 * self.wheel_separation) * xp.abs(turn_rate)
        share = self.max_wheel_speed / xp.where(
            fastest > self.max_wheel_speed, fastest, self.max_wheel_speed + 0.0 * fastest
        )
        return speed * share, turn_rate * share

    def _pose_and_sightings(self, state: Array) -> list[Array]:
        xp = array_namespace(state)
        x, y, theta = state[..., 0], state[..., 1], state[..., 2]
        c, s = xp.cos(theta), xp.sin(theta)
        parts = [x, y, c, s]
        edge = float(np.cos(0.5 * self.field_of_view))
        for mark_x, mark_y in LANDMARKS:
            dx, dy = mark_x - x, mark_y - y
            distance = xp.sqrt(dx * dx + dy * dy + 1e-18)  # keeps the direction finite on the landmark itself
            ahead, left = (c * dx + s * dy) / distance, (c * dy - s * dx) / distance
            parts += [xp.where(ahead >= edge, part, 0.0 * part) for part in (distance, ahead, left)]
        return parts

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The goal pose, the landmarks (green where they are seen) and the field of view, and the robot."""
        canvas.view(center=(0.0, 0.0), width=2.0 * self.start_distance + 2.0)
        x, y, theta = (float(value) for value in state[:3])
        seen = np.asarray(self.observe(state[None]))[0, -len(SIGHTINGS) :: 3] > 0.0
        if self.field_of_view < 2.0 * np.pi:
            for side in (-0.5, 0.5):
                edge = theta + side * self.field_of_view
                canvas.line((x, y), (x + 12.0 * np.cos(edge), y + 12.0 * np.sin(edge)), 0.015, "guide")
        for (mark_x, mark_y), visible in zip(LANDMARKS, seen, strict=True):
            canvas.circle((mark_x, mark_y), 0.13, "target" if visible else "faint")
        canvas.circle((0.0, 0.0), 0.3, "target", width=0.04)
        canvas.arrow((0.0, 0.0), (0.55, 0.0), 0.05, "target")
        self._draw_robot(canvas, x, y, theta)
        if action is not None:
            reach = 0.7 * float(action[0]) / self.max_speed
            tip = (x + reach * np.cos(theta), y + reach * np.sin(theta))
            canvas.arrow((x, y), tip, 0.05, "force")
            canvas.turn_arrow((x, y), 0.33, -0.6 * float(action[1]) / self.max_turn_rate, "force")

    def _draw_robot(self, canvas: Canvas, x: float, y: float, theta: float) -> None:
        """Body, two wheels and a nose that shows the heading."""
        forward, left = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        center = np.array([x, y])

        def at(ahead: float, across: float) -> tuple[float, float]:
            place = center + ahead * forward + across * left
            return float(place[0]), float(place[1])

        half, wheel = 0.5 * self.wheel_separation, 0.5 * self.wheel_diameter
        canvas.rod(at(-0.1, 0.0), at(0.1, 0.0), 1.7 * half, "body")
        for across in (-half, half):
            canvas.line(at(-wheel, across), at(wheel, across), 0.05, "joint")
        canvas.circle(at(0.15, 0.0), 0.045, "background")


@dataclass(frozen=True, kw_only=True)
class MobileBase(MobileBaseKinematic):
    """A robot on two wheels that lags behind its commands, and drives to a goal pose.

    With the goal at the origin, its heading along x, and the commands (v_c, omega_c) held for a period dt,

        dx/dt = v cos(theta)      dv/dt     = clip((v_c - v) / lag, -max_acceleration, max_acceleration)
        dy/dt = v sin(theta)      domega/dt = clip((omega_c - omega) / lag, -max_turn_..., max_turn_acceleration)
        dtheta/dt = omega,        integrated by RK4.

    | # | state            | unit  |   | # | observation      | range       |   | # | action    | range               |
    |---|------------------|-------|---|---|------------------|-------------|---|---|-----------|---------------------|
    | 0 | x                | m     |   | 0 | x                | unbounded   |   | 0 | speed     | -0.5..0.5 m/s       |
    | 1 | y                | m     |   | 1 | y                | unbounded   |   | 1 | turn_rate | -1.745..1.745 rad/s |
    | 2 | theta            | rad   |   | 2 | cos_theta        | -1..1       |   |   |           |                     |
    | 3 | velocity         | m/s   |   | 3 | sin_theta        | -1..1       |   |   |           |                     |
    | 4 | angular_velocity | rad/s |   | 4 | velocity         | unbounded   |   |   |           |                     |
    |   |                  |       |   | 5 | angular_velocity | unbounded   |   |   |           |                     |
    |   |                  |       |   | . | range_i          | 0 and above |   |   |           |                     |
    |   |                  |       |   | . | cos_bearing_i    | -1..1       |   |   |           |                     |
    |   |                  |       |   | . | sin_bearing_i    | -1..1       |   |   |           |                     |

    The last three stand for each landmark, i = 1, 2, 3 (range_1, cos_bearing_1, sin_bearing_1, range_2, cos_bearing_2,
    sin_bearing_2, range_3, cos_bearing_3, sin_bearing_3). Landmarks, field of view, wheels, reward, start, and the
    goal in the robot's frame are those of `MobileBaseKinematic`, whose data sheet says what was chosen. The episode
    ends after 200 steps (20 s).

    | id                               | shows                                                                  |
    |----------------------------------|------------------------------------------------------------------------|
    | beliefgym/MobileBase-v0          | x, y, cos_theta, sin_theta, velocity, angular_velocity                 |
    | beliefgym/MobileBasePosition-v0  | x, y: heading and speeds show in motion only                           |
    | beliefgym/MobileBaseLandmarks-v0 | the landmarks' ranges and bearings: mostly none or one is in view, so  |
    |                                  | that the pose must be pieced together                                  |

    Versions: v0, the first. The lag was chosen here; the source has none.

    Args:
        lag: s, of the first-order approach to the commands.
        max_acceleration: m/s^2. max_turn_acceleration: rad/s^2. The others: see `MobileBaseKinematic`.

    Reference: thesis proposal, Sec. 3.2.3 (Videre Erratic).
    """

    lag: float = 0.25
    max_acceleration: float = 2.5
    max_turn_acceleration: float = 3.2

    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "theta", "velocity", "angular_velocity")
    observation_names: ClassVar[tuple[str, ...]] = (*POSE, "velocity", "angular_velocity", *SIGHTINGS)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("lag", "max_acceleration", "max_turn_acceleration"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")

    def derivative(self, state: Array, command: Array) -> Array:
        """Time derivative of the state, (..., 5), under commands (..., 2) that the wheels can follow."""
        xp = array_namespace(state)
        theta, v, w = state[..., 2], state[..., 3], state[..., 4]
        a, b = self.max_acceleration, self.max_turn_acceleration
        speed_up = xp.clip((command[..., 0] - v) * (1.0 / self.lag), -a, a)
        turn_up = xp.clip((command[..., 1] - w) * (1.0 / self.lag), -b, b)
        return xp.stack([v * xp.cos(theta), v * xp.sin(theta), w, speed_up, turn_up], axis=-1)

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        command = array_namespace(state).stack(list(self._within_the_wheels_limit(action)), axis=-1)
        return rk4(self.derivative, state, command, self.dt)

    def observe(self, state: Array) -> Array:
        """The pose, the velocities, then the sightings of the landmarks."""
        parts = self._pose_and_sightings(state)
        parts[len(POSE) : len(POSE)] = [state[..., 3], state[..., 4]]
        return array_namespace(state).stack(parts, axis=-1)


SMOOTHED = 0.05  # m; e of the reward
