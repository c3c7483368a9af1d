"""Helicopter hover: bring a model helicopter to one point in the air and keep it there under gusts.

The model was identified from flights of a real XCell helicopter: forces and torques are linear in body velocities,
body rates and controls. Its 21-dimensional state remembers the last control and the last change of it, since the action
is a change of the control.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.quaternions import conjugate, integrate, product, rotate, rotate_inverse, tilt_cosine
from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas


@dataclass(frozen=True, kw_only=True)
class Helicopter(System):
    """A 5 kg model helicopter with gusts on its body; the task is to hover at the origin, nose to the north.

    NED axes (north, east, down), body axes (forward, right, down), q turns body to NED. With the new control
    u = u_prev + du, v_b = R(q)^T v, and gusts n_F (N, in NED axes) and n_T (N m, in body axes),

        a = [-0.048 v_b1;  -0.57 - 0.12 v_b2;  1.21 - 0.0005 v_b3 - 27.5 u4]                            (body axes)
        v' = v + dt (R(q) a + [0, 0, g] + n_F / m),      ned' = ned + dt v,      q' = q exp(dt pqr) / norm
        pqr' = pqr + dt ([-0.086; 0.015; -0.139] - [3.47; 3.06; 2.58] pqr + [13.20; -9.21; 14.84] u_123 + n_T / I)

    One explicit Euler step: right-hand sides at time t, but forces and torques with the new u.

    | #     | state and observation                                                        | unit  |
    |-------|------------------------------------------------------------------------------|-------|
    | 0-3   | u_prev_aileron, u_prev_elevator, u_prev_rudder, u_prev_collective            | stick |
    | 4-7   | du_prev_aileron, du_prev_elevator, du_prev_rudder, du_prev_collective        | stick |
    | 8-10  | velocity_north, velocity_east, velocity_down                                 | m/s   |
    | 11-13 | position_north, position_east, position_down                                 | m     |
    | 14-16 | roll_rate, pitch_rate, yaw_rate (body axes)                                  | rad/s |
    | 17-20 | q_x, q_y, q_z, q_w (-1..1; all others are unbounded)                         | 1     |

    | #   | action                                            | range      | unit            |
    |-----|---------------------------------------------------|------------|-----------------|
    | 0-3 | du_aileron, du_elevator, du_rudder, du_collective | -0.3..0.3  | stick, per step |

    Cost (`stage_cost`), of the error dx = state - trim, with the attitude's error vec(q_trim* q):

        c = dt (1000 |du_prev|^2 + |velocity|^2 + |position|^2 + |pqr|^2 + |vec(q_trim* q)|^2)

    Reward: 1 / (1 + c) of the state reached, in 0..1. It falls with the cost, and since every step in the air earns
    something a crash is never worth it; the plain -c would pay a learner for crashing early.

    Start: at rest in the trim attitude, position uniform in the ball of radius start_distance around the origin.
    start_speed and start_turn add a velocity and a turn of a random direction, each uniform up to that size.
    End (terminated): distance from the origin above max_distance, speed above max_speed, a body rate above max_rate,
    or the rotor's axis more than max_tilt from the vertical; or after 400 steps.
    Versions: v0, the first. `beliefgym/HelicopterHoverPosition-v0` shows position and q only. In
    `beliefgym/HelicopterHoverNoisy-v0` every component has noise of 0.1 in its unit (the source's observation noise;
    `noise=` sets another), `beliefgym/HelicopterHoverDelayed-v0` shows what was one step ago (`delay=` sets another k;
    Ross and Bagnell used 0 and 1, and the LQR of the source's cost diverges from k = 4 on).

    Chosen here, since the source says nothing of them: the reward's shape, max_change (the source has no limits; the
    expert at noise 1 from 10 m away stays within this one), the limits that end an episode, the start's ball, 400
    steps.
    Deviation from the source: q is normalised after each step.

    Args:
        mass: kg. inertia: kg m^2, of the three body axes. gravity: m/s^2.
        drag: 1/s, of the three body axes. side_force: m/s^2, of the tail rotor to the right. lift_offset: m/s^2.
        lift: m/s^2 for each unit of collective. rate_offset: rad/s^2. rate_damping: 1/s. rate_gain: rad/s^2 for each
            unit of aileron, elevator, rudder.
        wrench_noise_std: standard deviation of each gust force (N) and torque (N m), drawn at every step.
        max_change: limit of each action. start_distance: m. start_speed: m/s. start_turn: rad.
        max_distance: m. max_speed: m/s. max_rate: rad/s. max_tilt: rad.
        expert_effort: factor on the weight of du in the expert's cost. At 1 the expert is the optimum of the source's
            cost and wanders by about 0.6 m under gusts of 1; at 0.02 (with max_change=1.0) it stays within 0.5 m.

    Reference: Abbeel and Ng 2005, "Exploration and apprenticeship learning in reinforcement learning"; Ross and Bagnell
    2012, "Agnostic system identification for model-based reinforcement learning"; thesis proposal, Sec. 3.2.3
    (helicopter simulator, starts up to 10 m away).
    """

    mass: float = 5.0
    inertia: tuple[float, float, float] = (0.3, 0.3, 0.3)
    gravity: float = 9.81
    drag: tuple[float, float, float] = (0.048, 0.12, 0.0005)
    side_force: float = -0.57
    lift_offset: float = 1.21
    lift: float = 27.5
    rate_offset: tuple[float, float, float] = (-0.086, 0.015, -0.139)
    rate_damping: tuple[float, float, float] = (3.47, 3.06, 2.58)
    rate_gain: tuple[float, float, float] = (13.20, -9.21, 14.84)
    wrench_noise_std: float = 1.0
    max_change: float = 0.3
    start_distance: float = 10.0
    start_speed: float = 0.0
    start_turn: float = 0.0
    max_distance: float = 20.0
    max_speed: float = 20.0
    max_rate: float = 4.0 * math.pi
    max_tilt: float = 0.5 * math.pi
    expert_effort: float = 1.0

    state_names: ClassVar = (
        *(f"u_prev_{stick}" for stick in ("aileron", "elevator", "rudder", "collective")),
        *(f"du_prev_{stick}" for stick in ("aileron", "elevator", "rudder", "collective")),
        *(f"velocity_{axis}" for axis in ("north", "east", "down")),
        *(f"position_{axis}" for axis in ("north", "east", "down")),
        *("roll_rate", "pitch_rate", "yaw_rate", "q_x", "q_y", "q_z", "q_w"),
    )
    action_names: ClassVar = ("du_aileron", "du_elevator", "du_rudder", "du_collective")
    observation_names: ClassVar = state_names
    disturbance_names: ClassVar = (
        *(f"force_{axis}" for axis in ("north", "east", "down")),
        *(f"torque_{axis}" for axis in ("roll", "pitch", "yaw")),
    )
    quaternions: ClassVar = (17,)
    # weights of the cost on du_prev, velocity, position, body rates, vec of the attitude's error
    weights: ClassVar[tuple[float, ...]] = (1000.0, 1.0, 1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        above_0 = (
            "mass",
            "lift",
            "max_change",
            "max_distance",
            "max_speed",
            "max_rate",
            "max_tilt",
            "expert_effort",
        )
        for name in above_0:
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        for name in ("wrench_noise_std", "start_distance", "start_speed", "start_turn"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"expected {name} finite and at least 0, got {getattr(self, name)!r}")
        for name in ("inertia", "drag", "rate_offset", "rate_damping", "rate_gain"):
            if len(getattr(self, name)) != 3:
                raise ValueError(f"expected {name} as three numbers, got {getattr(self, name)!r}")
        if not min(self.inertia) > 0:
            raise ValueError(f"expected inertia above 0, got {self.inertia!r}")
        if self.start_distance >= self.max_distance:
            raise ValueError(
                f"expected start_distance below max_distance, got {self.start_distance:g} m and {self.max_distance:g} m"
            )

    @property
    def disturbance_std(self) -> tuple[float, ...]:
        """Of the gust's three forces (N) and three torques (N m)."""
        return (float(self.wrench_noise_std),) * 6

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Greatest change of a stick in one step."""
        high = np.full(4, self.max_change)
        return -high, high

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Only the quaternion is bounded: the state that ends an episode lies beyond the limits."""
        high = np.full(21, np.inf)
        high[17:] = 1.0
        return -high, high

    @property
    def trim(self) -> NDArray[np.float64]:
        """(21,) the state that stays as it is under no action: hovering at the origin, nose north, rolled a little.

        The tail rotor's side force is held by a roll phi = -asin(side_force / g), the weight by the collective.
        """
        aileron, elevator, rudder = (
            -offset / gain for offset, gain in zip(self.rate_offset, self.rate_gain, strict=True)
        )
        roll = -math.asin(self.side_force / self.gravity)
        collective = (self.lift_offset + self.gravity * math.cos(roll)) / self.lift
        state = np.zeros(21)
        state[:4] = aileron, elevator, rudder, collective
        state[17], state[20] = math.sin(0.5 * roll), math.cos(0.5 * roll)
        return state

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        xp = array_namespace(state)
        s = [state[..., i] for i in range(21)]
        velocity, position, rates, q = s[8:11], s[11:14], s[14:17], s[17:21]
        change = [action[..., i] for i in range(4)]
        u = [before + by for before, by in zip(s[:4], change, strict=True)]
        body = rotate_inverse(q, velocity)
        acceleration = rotate(
            q,
            (
                -self.drag[0] * body[0],
                self.side_force - self.drag[1] * body[1],
                self.lift_offset - self.drag[2] * body[2] - self.lift * u[3],
            ),
        )
        force = [acceleration[0], acceleration[1], acceleration[2] + self.gravity]
        turning = [
            self.rate_offset[i] - self.rate_damping[i] * rates[i] + self.rate_gain[i] * u[i] for i in range(3)
        ]
        if disturbance is not None:
            force = [force[i] + disturbance[..., i] * (1.0 / self.mass) for i in range(3)]
            turning = [turning[i] + disturbance[..., 3 + i] * (1.0 / self.inertia[i]) for i in range(3)]
        dt = self.dt
        return xp.stack(
            [
                *u,
                *change,
                *(velocity[i] + dt * force[i] for i in range(3)),
                *(position[i] + dt * velocity[i] for i in range(3)),
                *(rates[i] + dt * turning[i] for i in range(3)),
                *integrate(q, rates, dt),
            ],
            axis=-1,
        )

    def observe(self, state: Array) -> Array:
        """The state itself."""
        return state

    def stage_cost(self, state: Array, action: Array) -> Array:
        """dt dx^T Q dx of the source, see the class; the action counts as du_prev of the state that it leads to."""
        trim = self.trim.tolist()
        attitude = product(conjugate(trim[17:]), [state[..., i] for i in range(17, 21)])
        change, velocity, position, rates, turn = self.weights
        blocks = (
            (change, [state[..., i] for i in range(4, 8)]),
            (velocity, [state[..., i] for i in range(8, 11)]),
            (position, [state[..., i] for i in range(11, 14)]),
            (rates, [state[..., i] for i in range(14, 17)]),
            (turn, attitude[:3]),
        )
        return weighted_squares(blocks, self.dt)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """1 / (1 + cost of the state reached)."""
        return 1.0 / (1.0 + self.stage_cost(next_state, action))

    def terminated(self, state: Array) -> Array:
        """Where the helicopter is too far, too fast, turning too fast or tilted too far."""
        return self._out_of_control(state, [state[..., i] for i in range(11, 14)])

    def _out_of_control(self, state: Array, offset: list[Array]) -> Array:
        """`terminated`, with the offset (3 components, m) from where the helicopter should be."""
        xp = array_namespace(state)
        x, y, z = offset
        u, v, w, p, q, r = (state[..., i] for i in (8, 9, 10, 14, 15, 16))
        fastest = xp.maximum(xp.maximum(xp.abs(p), xp.abs(q)), xp.abs(r))
        return (
            (x * x + y * y + z * z > self.max_distance**2)
            | (u * u + v * v + w * w > self.max_speed**2)
            | (fastest > self.max_rate)
            | (tilt_cosine([state[..., i] for i in range(17, 21)]) < math.cos(self.max_tilt))
        )

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """At trim, displaced within a ball; with a velocity and a turn where their parameters are above 0."""
        unit = streams.uniform(9, mask)
        state = np.tile(self.trim, (len(unit), 1))
        state[:, 11:14] = _direction(unit[:, 0:2]) * (self.start_distance * np.cbrt(unit[:, 2:3]))
        state[:, 8:11] = _direction(unit[:, 3:5]) * (self.start_speed * unit[:, 5:6])
        half = 0.5 * self.start_turn * unit[:, 8:9]
        turn = np.concatenate([np.sin(half) * _direction(unit[:, 6:8]), np.cos(half)], axis=1)
        state[:, 17:21] = np.stack(product(turn.T, state[:, 17:21].T), axis=1)
        return state

    def expert(self) -> Any:
        """Steady-state LQR for the cost, on the dynamics linearised at trim."""
        from beliefgym.envs.planning.lqr import hover_expert

        return hover_expert(self, self.expert_effort)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The helicopter in space, the point to hover at, and an arrow for the rotor's thrust."""
        from beliefgym.envs.helicopter_picture import draw_helicopter

        collective = float(state[3])
        draw_helicopter(canvas, state[11:14], state[17:21], collective / self.trim[3], np.zeros(3))


def weighted_squares(blocks: Any, dt: float) -> Array:
    """dt times the sum of weight * |components|^2 over (weight, components) blocks."""
    total = 0.0
    for weight, components in blocks:
        if weight:
            total = total + (dt * weight) * sum(c * c for c in components)
    return total


def _direction(unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) unit vectors spread evenly over the sphere, from uniform numbers (n, 2)."""
    z = 2.0 * unit[:, 0] - 1.0
    ring, angle = np.sqrt(1.0 - z * z), 2.0 * np.pi * unit[:, 1]
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
