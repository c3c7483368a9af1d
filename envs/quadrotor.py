"""Quadrotor in hover under wind: hold a point in gusts, with an inertial measurement unit on board.

The vehicle of the attitude-estimation test bed of the thesis proposal's Sec. 3.4.3: roll and pitch are the hints, the
gyroscope and accelerometer the observations. Rigid body, four rotors with lag, drag in the moving air, sensor biases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.quaternions import (
    euler_angles,
    from_euler_angles,
    normalise,
    product,
    rotate,
    rotate_inverse,
    tilt_cosine,
)
from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas


@dataclass(frozen=True, kw_only=True)
class Quadrotor(System):
    """A 0.7 kg quadrotor that is to hover at the origin in a wind; nothing is asked of its heading.

    World axes: z up. Body axes: x forward, y left, z up (so a positive pitch is nose down). q = (q_x, q_y, q_z, q_w),
    the vector part first, turns body to world. With rotor thrusts T_i (front, left, back, right), T = sum T_i, arm l,
    c = yaw_ratio, J the inertia, b_z = (0, 0, 1), and the drag D = diag(drag_0, drag_0, drag_1) of the air that the
    vehicle moves through, which acts at the rotors' height h over the centre of mass:

        F = T b_z + D R(q)^T (wind - v)                               (body axes, without gravity)
        tau = (l (T_left - T_right), l (T_back - T_front), c (T_front - T_left + T_back - T_right)) + h b_z x F
        p' = v,   v' = R(q) F / m - (0, 0, g),   q' = q (w, 0) / 2,   J w' = tau - w x J w,   T_i' = (C_i - T_i) / lag

    RK4 over dt = 0.02 s with the wind and the commands C_i held and the rotors' lag solved exactly; q is normalised
    after each step. With a = exp(-dt / gust_time), normal numbers n, and mean_wind_z = 0:

        wind_{t+1} = mean_wind + a (wind_t - mean_wind) + gust_std sqrt(1 - a^2) n       (Ornstein-Uhlenbeck)
        gyro_bias_{t+1} = gyro_bias_t + gyro_bias_walk sqrt(dt) n

    | #     | state                                                                         | unit  |
    |-------|-------------------------------------------------------------------------------|-------|
    | 0-2   | position_x, position_y, position_z (from the point to hover at)                | m     |
    | 3-5   | velocity_x, velocity_y, velocity_z                                            | m/s   |
    | 6-9   | q_x, q_y, q_z, q_w                                                            | 1     |
    | 10-12 | roll_rate, pitch_rate, yaw_rate: w, in body axes                              | rad/s |
    | 13-16 | rotor_front, rotor_left, rotor_back, rotor_right: thrusts T_i                 | N     |
    | 17-19 | wind_x, wind_y, wind_z: velocity of the air, in world axes                    | m/s   |
    | 20-21 | mean_wind_x, mean_wind_y: constant in an episode                              | m/s   |
    | 22-24 | gyro_bias_x, gyro_bias_y, gyro_bias_z: a slow random walk                     | rad/s |
    | 25-27 | accelerometer_bias_x, accelerometer_bias_y, accelerometer_bias_z: constant    | m/s^2 |

    | #     | observation                                                                   | range     |
    |-------|-------------------------------------------------------------------------------|-----------|
    | 0-21  | state components 0-21, in their order                                         | q: -1..1  |
    | 22-24 | gyro_x, gyro_y, gyro_z: w + gyro_bias, rad/s                                  | unbounded |
    | 25-27 | accelerometer_x, accelerometer_y, accelerometer_z: F / m + its bias, m/s^2     | unbounded |

    | # | action       | range  | what it commands                                                               |
    |---|--------------|--------|--------------------------------------------------------------------------------|
    | 0 | thrust       | -1..1  | thrust of all rotors, m g (1 + thrust): 0 carries the weight                   |
    | 1 | roll_torque  | -1..1  | torque about body x, of max_tilt_torque                                        |
    | 2 | pitch_torque | -1..1  | torque about body y, of max_tilt_torque                                        |
    | 3 | yaw_torque   | -1..1  | torque about body z, of max_yaw_torque                                         |

    The commands are shared out to the four rotors, and each is then limited to 0..max_rotor_thrust.
    Hint: roll, pitch (rad) of q, in the order yaw, pitch, roll.

    Reward, in 0..1, of the state reached, with d the distance, theta the tilt of the rotors' axis, u the action:

        1/(1 + (2 d)^2) (1 + cos theta)/2 (1 + 1/(1 + |v|^2))/2 (1 + 1/(1 + |w|^2/9))/2 (9 + 1/(1 + |u|^2))/10

    Start: position uniform in a ball of radius start_distance, velocity in one of start_speed, w in one of start_rate;
    tilt uniform up to start_tilt in any direction, heading within +-start_yaw; rotors that carry the weight; mean wind
    of any direction and a speed uniform up to max_mean_wind; gusts and biases from their normal distributions.
    End (terminated): farther than max_distance from the point, or tilted more than max_tilt; or after 500 steps (10 s).

    Versions: v0, the first. `beliefgym/QuadrotorHover-v0` shows all that the motion depends on: observations 0-21, with
    the wind. `beliefgym/QuadrotorHoverIMU-v0` shows gyro and accelerometer only: the position can only be reckoned from
    the start. `beliefgym/QuadrotorHoverIMUPosition-v0` adds the position, as motion capture gives it. `...Noisy-v0` of
    both has white noise of 0.01 rad/s, 0.2 m/s^2 and 0.002 m (chosen: a vibrating MEMS). An accelerometer feels no
    gravity: it reads 0 in free fall and g along body z in hover, and shows a tilt only by what follows it.

    Sources of the numbers: AscTec Hummingbird as in RotorS (mass with rotors, inertia, arm, yaw_ratio, rotor_height,
    max_rotor_thrust; lag, the slower of its two; drag_0, its rotor drag at the rotor speed of hover) and RotorPy
    (drag_1, the loss of thrust with the speed of climb). gyro_bias_std: RotorS's ADIS16448. Chosen here, since the
    thesis gives no numbers: dt, torque limits, wind, gyro_bias_walk, accelerometer bias (after a calibration on the
    ground), reward, start, end. Left out: drag that grows with the square of the speed, the rotors' angular momentum,
    the ground.

    Args:
        mass: kg. inertia: kg m^2, of the body axes. arm: m. rotor_height: m. gravity: m/s^2.
        yaw_ratio: m, reaction torque for each N of thrust. drag: N s/m, across and along the rotors' axis.
        max_rotor_thrust: N, of one rotor. lag: s, of the rotors. max_tilt_torque: N m. max_yaw_torque: N m.
        max_mean_wind: m/s. gust_std: m/s, of each axis. gust_time: s.
        gyro_bias_std: rad/s. gyro_bias_walk: rad/s for each sqrt(s). accelerometer_bias_std: m/s^2.
        start_distance: m. start_speed: m/s. start_tilt: rad. start_yaw: rad. start_rate: rad/s.
        max_distance: m. max_tilt: rad.

    Reference: thesis proposal, Sec. 3.4.3; Furrer, Burri, Achtelik, Siegwart 2016, "RotorS: a modular Gazebo MAV
    simulator framework"; Folk, Paulos, Kumar 2023, "RotorPy"; Martin and Salaun 2010, "The true role of accelerometer
    feedback in quadrotor control".
    """

    dt: float = 0.02
    mass: float = 0.716
    inertia: tuple[float, float, float] = (0.007, 0.007, 0.012)
    arm: float = 0.17
    rotor_height: float = 0.01
    gravity: float = 9.81
    yaw_ratio: float = 0.016
    drag: tuple[float, float] = (0.146, 0.42)
    max_rotor_thrust: float = 6.0
    lag: float = 0.025
    max_tilt_torque: float = 0.25
    max_yaw_torque: float = 0.03
    max_mean_wind: float = 4.0
    gust_std: float = 1.0
    gust_time: float = 1.0
    gyro_bias_std: float = 0.01
    gyro_bias_walk: float = 5e-4
    accelerometer_bias_std: float = 0.05
    start_distance: float = 1.0
    start_speed: float = 0.5
    start_tilt: float = 0.3
    start_yaw: float = 0.5
    start_rate: float = 0.5
    max_distance: float = 10.0
    max_tilt: float = 0.5 * math.pi

    state_names: ClassVar = (
        *(f"position_{axis}" for axis in "xyz"),
        *(f"velocity_{axis}" for axis in "xyz"),
        *("q_x", "q_y", "q_z", "q_w", "roll_rate", "pitch_rate", "yaw_rate"),
        *("rotor_front", "rotor_left", "rotor_back", "rotor_right"),
        *("wind_x", "wind_y", "wind_z", "mean_wind_x", "mean_wind_y"),
        *(f"gyro_bias_{axis}" for axis in "xyz"),
        *(f"accelerometer_bias_{axis}" for axis in "xyz"),
    )
    action_names: ClassVar = ("thrust", "roll_torque", "pitch_torque", "yaw_torque")
    observation_names: ClassVar = (
        *state_names[:22],
        *(f"gyro_{axis}" for axis in "xyz"),
        *(f"accelerometer_{axis}" for axis in "xyz"),
    )
    disturbance_names: ClassVar = (
        *(f"gust_{axis}" for axis in "xyz"),
        *(f"gyro_walk_{axis}" for axis in "xyz"),
    )
    hint_names: ClassVar = ("roll", "pitch")
    quaternions: ClassVar = (6,)

    def __post_init__(self) -> None:
        super().__post_init__()
        above = "mass arm gravity yaw_ratio max_rotor_thrust lag max_tilt_torque max_yaw_torque gust_time"
        for name in (*above.split(), "max_distance", "max_tilt"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        least = "max_mean_wind gust_std gyro_bias_std gyro_bias_walk accelerometer_bias_std start_distance start_speed"
        for name in (*least.split(), "start_tilt", "start_yaw", "start_rate"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"expected {name} finite and at least 0, got {getattr(self, name)!r}")
        if len(self.inertia) != 3 or not min(self.inertia) > 0:
            raise ValueError(f"expected inertia as three numbers above 0, got {self.inertia!r}")
        if len(self.drag) != 2 or not min(self.drag) >= 0:
            raise ValueError(f"expected drag as two numbers of at least 0, got {self.drag!r}")
        if 4.0 * self.max_rotor_thrust <= self.weight:
            raise ValueError(
                f"expected four rotors that lift more than the weight of {self.weight:.3g} N, got "
                f"max_rotor_thrust = {self.max_rotor_thrust!r} N"
            )
        for start, end in (("start_distance", "max_distance"), ("start_tilt", "max_tilt")):
            if getattr(self, start) >= getattr(self, end):
                raise ValueError(
                    f"expected {start} below {end}, got {getattr(self, start):g} and {getattr(self, end):g}"
                )

    @property
    def weight(self) -> float:
        """m g in N."""
        return self.mass * self.gravity

    @property
    def disturbance_std(self) -> tuple[float, ...]:
        """Of the three changes of the wind in a step (m/s) and of the three gyro biases (rad/s)."""
        gust = self.gust_std * math.sqrt(-math.expm1(-2.0 * self.dt / self.gust_time))
        return (gust,) * 3 + (self.gyro_bias_walk * math.sqrt(self.dt),) * 3

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """-1 and 1."""
        return -np.ones(4), np.ones(4)

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Only the quaternion is bounded."""
        high = np.full(len(self.observation_names), np.inf)
        high[6:10] = 1.0
        return -high, high

    @property
    def state_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A rotor pushes upwards, up to its limit."""
        high = np.full(self.n_state, np.inf)
        low = -high
        low[13:17], high[13:17] = 0.0, self.max_rotor_thrust
        return low, high

    def commands(self, action: Array) -> list[Array]:
        """The thrusts in N that an action (..., 4) asks of the front, left, back and right rotor, each (...)."""
        xp = array_namespace(action)
        lift = (0.25 * self.weight) * (1.0 + action[..., 0])
        roll, pitch = ((0.5 * self.max_tilt_torque / self.arm) * action[..., i] for i in (1, 2))
        yaw = (0.25 * self.max_yaw_torque / self.yaw_ratio) * action[..., 3]
        asked = (lift - pitch + yaw, lift + roll - yaw, lift + pitch + yaw, lift - roll - yaw)
        return [xp.clip(thrust, 0.0, self.max_rotor_thrust) for thrust in asked]

    def body_force(self, air: Any, rotors: Any) -> tuple[Array, Array, Array]:
        """F of the class in body axes, from the vehicle's velocity in the air, also in body axes, and the thrusts."""
        across, along = self.drag
        front, left, back, right = rotors
        return -across * air[0], -across * air[1], front + left + back + right - along * air[2]

    def derivative(self, body: Array, rotors: Any, wind: Any) -> Array:
        """Time derivative of position, velocity, q and body rates.

        Args:
            body: (..., 13). rotors: four thrusts (...), N. wind: three components (...), m/s.

        Returns:
            (..., 13).
        """
        xp = array_namespace(body)
        velocity, q, rates = (
            [body[..., i] for i in span] for span in (range(3, 6), range(6, 10), range(10, 13))
        )
        p, r, y = rates
        front, left, back, right = rotors
        air = rotate_inverse(q, [v - w for v, w in zip(velocity, wind, strict=True)])
        force = self.body_force(air, rotors)
        acceleration = rotate(q, [(1.0 / self.mass) * f for f in force])
        jx, jy, jz = self.inertia
        roll = self.arm * (left - right) - self.rotor_height * force[1]
        pitch = self.arm * (back - front) + self.rotor_height * force[0]
        yaw = self.yaw_ratio * ((front + back) - (left + right))
        nothing = xp.zeros_like(p)
        turning = product(q, (0.5 * p, 0.5 * r, 0.5 * y, nothing))
        spin = (
            (roll - (jz - jy) * (r * y)) * (1.0 / jx),
            (pitch - (jx - jz) * (p * y)) * (1.0 / jy),
            (yaw - (jy - jx) * (p * r)) * (1.0 / jz),
        )
        falling = acceleration[2] - self.gravity
        return xp.stack([*velocity, acceleration[0], acceleration[1], falling, *turning, *spin], axis=-1)

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        xp = array_namespace(state)
        s, dt = [state[..., i] for i in range(28)], self.dt
        start, wind, bias = s[13:17], s[17:20], s[22:25]
        asked = self.commands(action)
        half, full = (math.exp(-part * dt / self.lag) for part in (0.5, 1.0))
        middle = [c + half * (t - c) for c, t in zip(asked, start, strict=True)]
        end = [c + full * (t - c) for c, t in zip(asked, start, strict=True)]

        body = state[..., :13]
        k1 = self.derivative(body, start, wind)
        k2 = self.derivative(body + (0.5 * dt) * k1, middle, wind)
        k3 = self.derivative(body + (0.5 * dt) * k2, middle, wind)
        k4 = self.derivative(body + dt * k3, end, wind)
        moved = body + (dt / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
        after = [moved[..., i] for i in range(13)]

        keep = math.exp(-dt / self.gust_time)
        mean = (s[20], s[21], xp.zeros_like(s[19]))
        air = [m + keep * (w - m) for m, w in zip(mean, wind, strict=True)]
        if disturbance is not None:
            air = [air[i] + disturbance[..., i] for i in range(3)]
            bias = [bias[i] + disturbance[..., 3 + i] for i in range(3)]
        parts = [*after[:6], *normalise(after[6:10]), *after[10:], *end, *air, *s[20:22], *bias, *s[25:]]
        return xp.stack(parts, axis=-1)

    def observe(self, state: Array) -> Array:
        """Motion, rotors and wind, then gyroscope and accelerometer with their biases."""
        s = [state[..., i] for i in range(28)]
        air = rotate_inverse(s[6:10], [s[3 + i] - s[17 + i] for i in range(3)])
        force = self.body_force(air, s[13:17])
        gyro = [s[10 + i] + s[22 + i] for i in range(3)]
        accelerometer = [(1.0 / self.mass) * force[i] + s[25 + i] for i in range(3)]
        return array_namespace(state).stack([*s[:22], *gyro, *accelerometer], axis=-1)

    def hint(self, state: Array) -> Array:
        """Roll and pitch in rad, (..., 2)."""
        roll, pitch, _ = euler_angles([state[..., i] for i in range(6, 10)])
        return array_namespace(state).stack([roll, pitch], axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Near, level, slow and gentle; in 0..1; see the class."""
        distance, speed, turning = (_square(next_state, start, 3) for start in (0, 3, 10))
        level = 0.5 * (1.0 + tilt_cosine([next_state[..., i] for i in range(6, 10)]))
        slow = 0.5 * (1.0 + 1.0 / (1.0 + speed))
        still = 0.5 * (1.0 + 1.0 / (1.0 + (1.0 / 9.0) * turning))
        gentle = 0.9 + 0.1 / (1.0 + _square(action, 0, 4))
        return level * slow * still * gentle / (1.0 + 4.0 * distance)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """What the reward lacks of 1, to second order: 4 d^2 + (1 - cos theta)/2 + (|v|^2 + |w|^2/9)/2 + |u|^2/10."""
        distance, speed, turning = (_square(state, start, 3) for start in (0, 3, 10))
        tilt = 0.5 * (1.0 - tilt_cosine([state[..., i] for i in range(6, 10)]))
        return 4.0 * distance + tilt + 0.5 * (speed + (1.0 / 9.0) * turning) + 0.1 * _square(action, 0, 4)

    def terminated(self, state: Array) -> Array:
        """Where the vehicle is too far away or tilted too far."""
        upright = tilt_cosine([state[..., i] for i in range(6, 10)])
        return (_square(state, 0, 3) > self.max_distance**2) | (upright < math.cos(self.max_tilt))

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """See the start in the class."""
        unit, normal = streams.uniform(14, mask), streams.normal(9, mask)
        state = np.zeros((len(unit), self.n_state))
        for start, radius, column in (
            (0, self.start_distance, 0),
            (3, self.start_speed, 3),
            (10, self.start_rate, 6),
        ):
            state[:, start : start + 3] = radius * _in_ball(unit[:, column : column + 3])
        half, side = 0.5 * self.start_tilt * unit[:, 9], 2.0 * np.pi * unit[:, 10]
        lean = (np.sin(half) * np.cos(side), np.sin(half) * np.sin(side), np.zeros_like(half), np.cos(half))
        yaw = self.start_yaw * (2.0 * unit[:, 11] - 1.0)
        heading = from_euler_angles(np.zeros_like(yaw), np.zeros_like(yaw), yaw)
        state[:, 6:10] = np.stack(product(heading, lean), axis=1)
        state[:, 13:17] = 0.25 * self.weight
        direction, speed = 2.0 * np.pi * unit[:, 12], self.max_mean_wind * unit[:, 13]
        state[:, 20:22] = speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        state[:, 17:20] = self.gust_std * normal[:, :3]
        state[:, 17:19] += state[:, 20:22]
        state[:, 22:25] = self.gyro_bias_std * normal[:, 3:6]
        state[:, 25:28] = self.accelerometer_bias_std * normal[:, 6:9]
        return state

    def expert(self) -> Any:
        """LQR around the steady hover in the mean wind; knows the state, the wind too, and leaves the heading alone."""
        from beliefgym.envs.planning.quadrotor import quadrotor_expert

        return quadrotor_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The vehicle in space, the point to hover at, and the wind."""
        from beliefgym.envs.quadrotor_picture import draw_quadrotor

        draw_quadrotor(canvas, self, state)


def _square(values: Array, start: int, size: int) -> Array:
    """Sum of the squares of some components, (...)."""
    total = values[..., start] * values[..., start]
    for i in range(start + 1, start + size):
        total = total + values[..., i] * values[..., i]
    return total


def _in_ball(unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) spread evenly in the unit ball, from uniform numbers (n, 3)."""
    z, angle = 2.0 * unit[:, 0] - 1.0, 2.0 * np.pi * unit[:, 1]
    ring = np.sqrt(1.0 - z * z)
    points: NDArray[np.float64] = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return points * np.cbrt(unit[:, 2:3])
