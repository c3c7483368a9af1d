"""Pendulum swing-up, by angle and velocity or by position only.

Physics, reward and limits are those of Gymnasium's Pendulum-v1. With other parameters it is the uncontrolled or
damped pendulum of Venkatraman's thesis proposal (Secs. 3.1 and 3.4): `Pendulum.uncontrolled(damping=0.3)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.integrators import rk4
from beliefgym.envs.system import Array, System, wrap_angle

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas


@dataclass(frozen=True, kw_only=True)
class Pendulum(System):
    """A pendulum on a torque-limited motor: swing it up and hold it upright.

    With theta = 0 upright and I = m l^2 / 3 (rod) or m l^2 (point mass at the tip),

        d2 theta/dt2 = (m g l_c / I) sin(theta) - d dtheta/dt + u / I,    l_c = l/2 (rod) or l (point).

    Integrated as Pendulum-v1 does (semi-implicit Euler; the speed clipped to its limit) or by RK4.

    | # | state            | unit  |   | # | observation      | range    |   | # | action | range (N m) |
    |---|------------------|-------|---|---|------------------|----------|---|---|--------|-------------|
    | 0 | theta            | rad   |   | 0 | cos_theta        | -1..1    |   | 0 | torque | -2..2       |
    | 1 | angular_velocity | rad/s |   | 1 | sin_theta        | -1..1    |   |   |        |             |
    |   |                  |       |   | 2 | angular_velocity | -8..8    |   |   |        |             |

    Reward: -(theta^2 + 0.1 angular_velocity^2 + 0.001 torque^2), theta in [-pi, pi), before the step.
    Start: theta uniform in +-start_angle, angular_velocity uniform in +-start_speed. End: after 200 steps.
    Versions: v0, the first. `beliefgym/PendulumPosition-v0` shows cos_theta and sin_theta only. The suites of
    hidden-state tasks add noise to these: `beliefgym/PendulumPositionNoisyEasy-v0`, `..Medium-v0` and `..Hard-v0` with
    the standard deviation 0.1, 0.2 and 0.3, clipped to -1..1, and end after 200, 150 and 100 steps.

    Args:
        gravity: m/s^2. mass: kg. length: m. damping: 1/s.
        max_torque: N m; 0 makes the pendulum uncontrolled.
        max_speed: rad/s; the speed is clipped to it.
        inertia: "rod" or "point".
        integrator: "semi_implicit_euler" or "rk4".
        start_angle: rad. start_speed: rad/s.

    Reference: Gymnasium 1.x, Pendulum-v1; thesis proposal, Sec. 3.1.3.
    """

    gravity: float = 10.0
    mass: float = 1.0
    length: float = 1.0
    damping: float = 0.0
    max_torque: float = 2.0
    max_speed: float = 8.0
    inertia: Literal["rod", "point"] = "rod"
    integrator: Literal["semi_implicit_euler", "rk4"] = "semi_implicit_euler"
    start_angle: float = float(np.pi)
    start_speed: float = 1.0

    state_names: ClassVar = ("theta", "angular_velocity")
    rates: ClassVar = {"theta": "angular_velocity"}
    action_names: ClassVar = ("torque",)
    observation_names: ClassVar = ("cos_theta", "sin_theta", "angular_velocity")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("mass", "length", "max_speed"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        for name, allowed in (("inertia", ("rod", "point")), ("integrator", ("semi_implicit_euler", "rk4"))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"expected {name} to be one of {allowed}, got {getattr(self, name)!r}")

    @classmethod
    def uncontrolled(cls, damping: float = 0.0, **parameters: Any) -> Pendulum:
        """The free pendulum of the thesis proposal: point mass, g = 9.81 m/s^2, RK4, no torque, no speed limit."""
        free: dict[str, Any] = {
            "gravity": 9.81,
            "inertia": "point",
            "integrator": "rk4",
            "max_torque": 0.0,
            "max_speed": np.inf,
        }
        return cls(damping=damping, **(free | parameters))

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Torque limits in N m."""
        return np.array([-self.max_torque]), np.array([self.max_torque])

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cosine, sine, and the speed limit in rad/s."""
        high = np.array([1.0, 1.0, self.max_speed])
        return -high, high

    def _acceleration(self, theta: Array, speed: Array, torque: Array) -> Array:
        if self.inertia == "rod":
            moment, lever = self.mass * self.length**2 / 3.0, 0.5 * self.length
        else:
            moment, lever = self.mass * self.length**2, self.length
        acceleration = (self.mass * self.gravity * lever / moment) * array_namespace(theta).sin(theta)
        acceleration = acceleration + torque * (1.0 / moment)
        return acceleration - self.damping * speed if self.damping else acceleration

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        xp = array_namespace(state)
        if self.integrator == "rk4":

            def derivative(s: Array, u: Array) -> Array:
                return xp.stack([s[..., 1], self._acceleration(s[..., 0], s[..., 1], u[..., 0])], axis=-1)

            moved = rk4(derivative, state, action, self.dt)
            if self.max_speed == np.inf:
                return moved
            return xp.stack([moved[..., 0], xp.clip(moved[..., 1], -self.max_speed, self.max_speed)], axis=-1)
        theta, speed = state[..., 0], state[..., 1]
        speed = speed + self.dt * self._acceleration(theta, speed, action[..., 0])
        speed = xp.clip(speed, -self.max_speed, self.max_speed)
        return xp.stack([theta + self.dt * speed, speed], axis=-1)

    def observe(self, state: Array) -> Array:
        """cos(theta), sin(theta), angular velocity."""
        xp = array_namespace(state)
        theta = state[..., 0]
        return xp.stack([xp.cos(theta), xp.sin(theta), state[..., 1]], axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """-(theta^2 + 0.1 angular_velocity^2 + 0.001 torque^2) of the state before the step."""
        theta, speed, torque = wrap_angle(state[..., 0]), state[..., 1], action[..., 0]
        return -(theta * theta + 0.1 * (speed * speed) + 0.001 * (torque * torque))

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Angle and speed uniform within their start ranges."""
        return (2.0 * streams.uniform(2, mask) - 1.0) * np.array([self.start_angle, self.start_speed])

    def expert(self) -> Any:
        """Dynamic programming on a grid of angle and speed."""
        from beliefgym.envs.planning.dynamic_programming import pendulum_expert

        return pendulum_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The rod, its pivot, and an arc for the torque."""
        canvas.view(center=(0.0, 0.0), height=2.7 * self.length)
        tip = (self.length * np.sin(state[0]), self.length * np.cos(state[0]))
        canvas.circle((0.0, 0.0), 1.0 * self.length, "guide", width=0.008 * self.length)
        canvas.rod((0.0, 0.0), tip, 0.16 * self.length, "body")
        canvas.circle((0.0, 0.0), 0.05 * self.length, "joint")
        if action is not None and self.max_torque > 0:
            canvas.turn_arrow((0.0, 0.0), 0.32 * self.length, float(action[0]) / self.max_torque, "force")
