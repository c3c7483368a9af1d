"""The helicopter of the reinforcement-learning competitions: hover for ten minutes in gusts that nobody sees.

Another identification of an XCell helicopter than helicopter.py's, with sticks as actions (not their changes), gusts
that last, narrow limits and a heavy price on crashing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.quaternions import (
    exponential,
    from_euler_angles,
    normalise,
    product,
    rotate,
    rotate_inverse,
)
from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas


@dataclass(frozen=True, kw_only=True)
class HelicopterCompetition(System):
    """Hover at the origin, level and to the north, for 6000 steps of 0.1 s; the gust is hidden.

    With (u, v, w) the velocity in body axes, sticks a in -1..1, wind W and gust n,

        n' = gust_memory n + (1 - gust_memory) gust_multiplier gust_std N(0, I)                once a control step
        acceleration = [-0.18 (u + W1) + n1;  -0.54 - 0.43 (v + W2) + n2;  -0.49 w - 42.15 a4 + n3]   in body axes
        pqr_dot = -[12.78; 10.12; 8.16] pqr + [33.04; -33.32; 70.54] a_123 + [n4; n5; n6],

    then 10 explicit Euler substeps of dt / 10 (position, velocity, quaternion, rates; each from values at its start).

    | #     | state                                                                                        | unit    |
    |-------|----------------------------------------------------------------------------------------------|---------|
    | 0-2   | velocity_north, velocity_east, velocity_down                                                 | m/s     |
    | 3-5   | position_north, position_east, position_down                                                 | m       |
    | 6-8   | roll_rate, pitch_rate, yaw_rate (body axes)                                                  | rad/s   |
    | 9-12  | q_x, q_y, q_z, q_w (body to NED)                                                             | 1       |
    | 13-15 | gust_forward, gust_right, gust_down (body axes)                                              | m/s^2   |
    | 16-18 | gust_roll, gust_pitch, gust_yaw                                                              | rad/s^2 |
    | 19    | step                                                                                         | 1       |

    | #    | observation (errors to hover, unbounded but for q)                       | unit  |
    |------|--------------------------------------------------------------------------|-------|
    | 0-2  | velocity_forward, velocity_right, velocity_below: the velocity in body axes | m/s   |
    | 3-5  | position_forward, position_right, position_below: the position in body axes | m     |
    | 6-8  | roll_rate, pitch_rate, yaw_rate                                          | rad/s |
    | 9-11 | q_x, q_y, q_z (-1..1)                                                    | 1     |

    Actions: aileron, elevator, rudder, collective, each -1..1 (stick).

    Reward: minus the sum of the squares of the 12 observations of the state reached; in a crash, the worst reward of a
    state within the limits, for this step and each that was left of n_steps (so a crash never pays).
    Start: at rest, level, no gust, position uniform in a cube of half side start_distance (0: at the origin, as the
    competition). End: a component of the position (NED) beyond max_position, of the velocity (NED) beyond max_velocity,
    a body rate beyond max_rate, or |q_w| below min_q_w (a turn of 30 degrees in all); or after 6000 steps.
    Versions: v0, the first. `beliefgym/HelicopterCompetitionPosition-v0` shows position and q only.
    On this scale every agent that stays in the air scores about 1, since the random policy returns -1e7: compare
    returns, not scores.

    Chosen here: the competition's own gusts (gust_multiplier 2) and velocity limit (5 m/s); rlpy has 1 and 10. The step
    of the crash counts as one of those left. expert_effort, the expert's price on sticks, which the reward lacks.
    Deviation from the sources: q is normalised once a control step.

    Args:
        gravity: m/s^2. gust_std: of the six gust components, m/s^2 and rad/s^2. gust_multiplier: factor on them.
        gust_memory: what is left of a gust after a control step. wind: m/s, along the body's first two axes, up to 5.
        start_distance: m. max_position: m. max_velocity: m/s. max_rate: rad/s. min_q_w: 1. n_steps: of an episode.
        expert_effort: weight of the squared sticks' change from trim in the expert's cost.

    Reference: RL-competition 2008 and 2009 (generalised helicopter); Abbeel, Ganapathi and Ng 2006, "Learning vehicular
    dynamics, with application to modeling helicopters"; rlpy's HelicopterHover domain; thesis proposal, Sec. 3.2.3.
    """

    dt: float = 0.1
    gravity: float = 9.81
    gust_std: tuple[float, ...] = (0.1941, 0.2975, 0.6058, 0.1508, 0.2492, 0.0734)
    gust_multiplier: float = 2.0
    gust_memory: float = 0.8
    wind: tuple[float, float] = (0.0, 0.0)
    start_distance: float = 0.0
    max_position: float = 20.0
    max_velocity: float = 5.0
    max_rate: float = 4.0 * math.pi
    min_q_w: float = math.cos(math.radians(15.0))
    n_steps: int = 6000
    expert_effort: float = 0.1

    state_names: ClassVar = (
        *(f"velocity_{axis}" for axis in ("north", "east", "down")),
        *(f"position_{axis}" for axis in ("north", "east", "down")),
        *("roll_rate", "pitch_rate", "yaw_rate", "q_x", "q_y", "q_z", "q_w"),
        *(f"gust_{axis}" for axis in ("forward", "right", "down", "roll", "pitch", "yaw")),
        "step",
    )
    action_names: ClassVar = ("aileron", "elevator", "rudder", "collective")
    observation_names: ClassVar = (
        *(f"velocity_{axis}" for axis in ("forward", "right", "below")),
        *(f"position_{axis}" for axis in ("forward", "right", "below")),
        *("roll_rate", "pitch_rate", "yaw_rate", "q_x", "q_y", "q_z"),
    )
    disturbance_names: ClassVar = state_names[13:19]
    quaternions: ClassVar = (9,)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("max_position", "max_velocity", "max_rate", "n_steps", "expert_effort"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        for name in ("gust_multiplier", "start_distance"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"expected {name} finite and at least 0, got {getattr(self, name)!r}")
        if not 0 <= self.gust_memory <= 1:
            raise ValueError(f"expected gust_memory within 0..1, got {self.gust_memory!r}")
        if len(self.gust_std) != 6 or len(self.wind) != 2:
            raise ValueError(f"expected 6 gust_std and 2 wind, got {self.gust_std!r} and {self.wind!r}")
        if max(abs(w) for w in self.wind) > 5.0:
            raise ValueError(f"expected wind within -5..5 m/s, got {self.wind!r}")
        if self.start_distance > self.max_position:
            raise ValueError(
                f"expected start_distance up to max_position, got {self.start_distance:g} m and {self.max_position:g} m"
            )

    @property
    def disturbance_std(self) -> tuple[float, ...]:
        """What one step adds to each gust component."""
        factor = (1.0 - self.gust_memory) * self.gust_multiplier
        return tuple(factor * std for std in self.gust_std)

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Stick limits."""
        return np.full(4, -1.0), np.full(4, 1.0)

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Only q is bounded: the state that ends an episode lies beyond the limits."""
        high = np.full(12, np.inf)
        high[9:] = 1.0
        return -high, high

    @property
    def state_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The count of steps is not below 0."""
        low, high = super().state_limits
        low[19] = 0.0
        return low, high

    @property
    def worst_reward(self) -> float:
        """The reward of a state at all of its limits at once."""
        return -(
            3.0 * (self.max_position**2 + self.max_velocity**2 + self.max_rate**2) + 1.0 - self.min_q_w**2
        )

    @property
    def trim(self) -> NDArray[np.float64]:
        """(20,) hover at the origin without gusts: side force and wind held by roll and pitch."""
        pitch = -math.asin(0.18 * self.wind[0] / self.gravity)
        roll = math.asin((0.54 + 0.43 * self.wind[1]) / (self.gravity * math.cos(pitch)))
        state = np.zeros(20)
        state[9:13] = from_euler_angles(*np.array([roll, pitch, 0.0]))
        return state

    @property
    def trim_action(self) -> NDArray[np.float64]:
        """(4,) the sticks that keep `trim`."""
        _, _, down = rotate_inverse(self.trim[9:13], (0.0, 0.0, self.gravity))
        return np.array([0.0, 0.0, 0.0, float(down) / 42.15])

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        xp = array_namespace(state)
        velocity, position, rates, q, gust = (
            tuple(state[..., i] for i in range(first, last))
            for first, last in ((0, 3), (3, 6), (6, 9), (9, 13), (13, 19))
        )
        gust = tuple(self.gust_memory * n for n in gust)
        if disturbance is not None:
            gust = tuple(n + disturbance[..., i] for i, n in enumerate(gust))
        h = self.dt / _SUBSTEPS
        lift = gust[2] - 42.15 * action[..., 3]
        push = (gust[0] - 0.18 * self.wind[0], gust[1] - 0.54 - 0.43 * self.wind[1], lift)
        torque = tuple(_RATE_GAIN[i] * action[..., i] + gust[3 + i] for i in range(3))
        for _ in range(_SUBSTEPS):
            body = rotate_inverse(q, velocity)
            force = rotate(q, tuple(push[i] - _DRAG[i] * body[i] for i in range(3)))
            position = tuple(position[i] + h * velocity[i] for i in range(3))
            velocity = (
                velocity[0] + h * force[0],
                velocity[1] + h * force[1],
                velocity[2] + h * (force[2] + self.gravity),
            )
            q = product(q, exponential(tuple(h * rate for rate in rates)))
            rates = tuple(rates[i] + h * (torque[i] - _RATE_DAMPING[i] * rates[i]) for i in range(3))
        parts = [*velocity, *position, *rates, *normalise(q), *gust, state[..., 19] + 1.0]
        return xp.stack(parts, axis=-1)

    def observe(self, state: Array) -> Array:
        """Velocity and position in body axes, body rates, vector part of the quaternion."""
        xp = array_namespace(state)
        q = [state[..., i] for i in range(9, 13)]
        velocity = rotate_inverse(q, [state[..., i] for i in range(3)])
        position = rotate_inverse(q, [state[..., i] for i in range(3, 6)])
        return xp.stack([*velocity, *position, *(state[..., i] for i in range(6, 12))], axis=-1)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """Sum of the squared observations (in NED axes: a turn changes no length)."""
        return sum(state[..., i] * state[..., i] for i in range(12))

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Minus the cost; in a crash the worst reward for each step that was left."""
        xp = array_namespace(next_state)
        left = xp.maximum(self.n_steps - state[..., 19], xp.ones_like(state[..., 19]))
        crashed = self.terminated(next_state)
        return xp.where(crashed, self.worst_reward * left, -self.stage_cost(next_state, action))

    def terminated(self, state: Array) -> Array:
        """Where a limit is passed."""
        xp = array_namespace(state)

        def largest(first: int) -> Array:
            x, y, z = (xp.abs(state[..., i]) for i in range(first, first + 3))
            return xp.maximum(xp.maximum(x, y), z)

        return (
            (largest(0) > self.max_velocity)
            | (largest(3) > self.max_position)
            | (largest(6) > self.max_rate)
            | (xp.abs(state[..., 12]) < self.min_q_w)
        )

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """At rest and level, displaced within a cube."""
        unit = streams.uniform(3, mask)
        state = np.zeros((len(unit), 20))
        state[:, 3:6] = self.start_distance * (2.0 * unit - 1.0)
        state[:, 12] = 1.0
        return state

    def expert(self) -> Any:
        """Steady-state LQR at trim, which knows the gust."""
        from beliefgym.envs.planning.lqr import competition_expert

        return competition_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The helicopter in space, the point to hover at, an arrow for the thrust."""
        from beliefgym.envs.helicopter_picture import draw_helicopter

        thrust = 1.0 if action is None else float(action[3]) / self.trim_action[3]
        draw_helicopter(canvas, state[3:6], state[9:13], thrust, np.zeros(3))


_SUBSTEPS = 10
_DRAG = (0.18, 0.43, 0.49)
_RATE_DAMPING = (12.78, 10.12, 8.16)
_RATE_GAIN = (33.04, -33.32, 70.54)
