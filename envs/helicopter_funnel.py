"""Helicopter funnel: fly sideways around a circle with the nose to its centre.

The helicopter of helicopter.py follows a target in time: hover, four circles, hover. The state counts the steps, so
that the task is Markov.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import fsolve

from beliefgym.envs.helicopter import Helicopter, weighted_squares
from beliefgym.envs.quaternions import conjugate, from_euler_angles, product, rotate, rotate_inverse
from beliefgym.envs.system import Array

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas


@dataclass(frozen=True, kw_only=True)
class HelicopterFunnel(Helicopter):
    """The nose-in funnel: 100 steps of hover, 4 circles of 100 steps, 100 steps of hover.

    The target at angle phi stands at -radius (cos phi, sin phi, 0), its nose to the centre (yaw phi). On the circle
    phi grows by 2 pi / 5 rad/s, so it moves sideways at radius 2 pi / 5 m/s and yaws at 2 pi / 5 rad/s, in the attitude
    and with the body rates of steady flight around that circle; in hover its attitude is that of `Helicopter.trim`.
    Dynamics, actions, gusts, limits: see `Helicopter`; here the distance counts from the target.

    State: the 21 components of `Helicopter` (u_prev_aileron, u_prev_elevator, u_prev_rudder, u_prev_collective,
    du_prev_aileron, du_prev_elevator, du_prev_rudder, du_prev_collective, velocity_north, velocity_east, velocity_down,
    position_north, position_east, position_down, roll_rate, pitch_rate, yaw_rate, q_x, q_y, q_z, q_w), then step.

    | #     | observation (errors: actual minus target, in axes turned by the target's yaw)   | unit  |
    |-------|---------------------------------------------------------------------------------|-------|
    | 0-3   | u_prev_aileron, u_prev_elevator, u_prev_rudder, u_prev_collective               | stick |
    | 4-7   | du_prev_aileron, du_prev_elevator, du_prev_rudder, du_prev_collective           | stick |
    | 8-10  | velocity_error_forward, velocity_error_right, velocity_error_down               | m/s   |
    | 11-13 | position_error_forward, position_error_right, position_error_down               | m     |
    | 14-16 | roll_rate_error, pitch_rate_error, yaw_rate_error (body axes)                   | rad/s |
    | 17-20 | q_error_x, q_error_y, q_error_z, q_error_w: q_target^-1 q, its w at least 0      | 1     |
    | 21    | progress: step / number of steps, 0..1                                          | 1     |

    Actions: du_aileron, du_elevator, du_rudder, du_collective, each -0.3..0.3 a step.

    Cost, with errors to the target: dt (1000 |du_prev|^2 + 0.01 |velocity|^2 + 10 |position|^2 + |pqr|^2 +
    10 |vec(q_target^-1 q)|^2). Reward: 1 / (1 + cost) of the state reached, in 0..1.

    Start: at trim around (-radius, 0, 0), position uniform in a ball of radius start_distance (1 m). End: as
    `Helicopter`, with the distance from the target; or after 600 steps, when the target has come to its end.
    Versions: v0, the first. `beliefgym/HelicopterFunnelPosition-v0` shows the position's and the attitude's error and
    progress only.

    Chosen here: the frame of the observed errors, the attitude on the circle (the source says where the nose points),
    the reward's shape, start_distance, max_change, the limits. Of the source: gusts of standard deviation 0.1, weights,
    steps, radius.

    Args:
        radius: m. circles: how many. circle_steps: steps of each. hover_steps: before and after.
        others: see `Helicopter`.

    Reference: Abbeel and Ng 2005; Ross and Bagnell 2012 (nose-in funnel); thesis proposal, Sec. 3.2.3.
    """

    wrench_noise_std: float = 0.1
    start_distance: float = 1.0
    radius: float = 5.0
    circles: int = 4
    circle_steps: int = 100
    hover_steps: int = 100

    state_names: ClassVar = (*Helicopter.state_names, "step")
    observation_names: ClassVar = (
        *Helicopter.state_names[:8],
        *(f"velocity_error_{axis}" for axis in ("forward", "right", "down")),
        *(f"position_error_{axis}" for axis in ("forward", "right", "down")),
        *(f"{axis}_rate_error" for axis in ("roll", "pitch", "yaw")),
        *(f"q_error_{axis}" for axis in "xyzw"),
        "progress",
    )
    weights: ClassVar = (1000.0, 0.01, 10.0, 1.0, 10.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("radius", "circles", "circle_steps", "hover_steps"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")

    @property
    def n_steps(self) -> int:
        """Steps of the whole figure."""
        return 2 * self.hover_steps + self.circles * self.circle_steps

    @property
    def turn_rate(self) -> float:
        """Yaw rate on the circle, rad/s."""
        return 2.0 * math.pi / (self.circle_steps * self.dt)

    @property
    def state_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The count of steps is not below 0."""
        low, high = super().state_limits
        low[21] = 0.0
        return low, high

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The quaternion is bounded, and the progress from below (an episode may be run on beyond the figure)."""
        low, high = super().observation_limits
        low[20] = 0.0
        return np.append(low, 0.0), np.append(high, np.inf)

    @cached_property
    def circling(self) -> NDArray[np.float64]:
        """(21,) the state of steady flight around the circle, at phi = 0, position (-radius, 0, 0).

        Roll, pitch and collective such that the accelerations are radius turn_rate^2 forward, 0 right, 0 down; body
        rates of a turn about the vertical; sticks that keep them.
        """
        velocity = (0.0, -self.radius * self.turn_rate, 0.0)
        wanted = np.array([self.radius * self.turn_rate**2, 0.0, -self.gravity])

        def missing(unknown: NDArray[np.float64]) -> NDArray[np.float64]:
            q = from_euler_angles(*np.append(unknown[:2], 0.0))
            body = rotate_inverse(q, velocity)
            lift = self.lift_offset - self.drag[2] * body[2] - self.lift * unknown[2]
            force = rotate(q, (-self.drag[0] * body[0], self.side_force - self.drag[1] * body[1], lift))
            return np.asarray(force, dtype=float) - wanted

        lean = math.atan2(wanted[0], self.gravity)
        solution, _, found, message = fsolve(
            missing, [0.0, -lean, self.gravity / self.lift], xtol=1e-12, full_output=True
        )
        if found != 1:
            raise ValueError(
                f"no steady flight around a circle of {self.radius:g} m in {self.circle_steps} steps: {message}; "
                "expected a larger radius or more circle_steps"
            )
        q = from_euler_angles(*np.append(solution[:2], 0.0))
        rates = rotate_inverse(q, (0.0, 0.0, self.turn_rate))
        state = np.zeros(21)
        for i in range(3):
            state[i] = (self.rate_damping[i] * rates[i] - self.rate_offset[i]) / self.rate_gain[i]
        state[3] = solution[2]
        state[8:11], state[11], state[14:17], state[17:21] = velocity, -self.radius, rates, q
        return state

    def _target(self, step: Array) -> tuple[Array, Array, list[Array]]:
        """cos and sin of the target's yaw, and its 21 state components (lists of arrays like `step`)."""
        xp = array_namespace(step)
        zero = xp.zeros_like(step)
        turning = step - float(self.hover_steps)
        length = float(self.circles * self.circle_steps)
        on_circle = xp.where((turning >= 0.0) & (turning < length), xp.ones_like(step), zero)
        angle = (2.0 * math.pi / self.circle_steps) * xp.minimum(xp.maximum(turning, zero), zero + length)
        c, s = xp.cos(angle), xp.sin(angle)
        hover, circle = self.trim.tolist(), self.circling.tolist()
        hover[11] = -self.radius
        level = [h + on_circle * (k - h) for h, k in zip(hover, circle, strict=True)]  # at phi = 0
        velocity = (c * level[8] - s * level[9], s * level[8] + c * level[9], level[10])
        position = (c * level[11] - s * level[12], s * level[11] + c * level[12], level[13])
        yaw = (zero, zero, xp.sin(0.5 * angle), xp.cos(0.5 * angle))
        return c, s, [*level[:8], *velocity, *position, *level[14:17], *product(yaw, level[17:21])]

    def targets(self, steps: ArrayLike) -> NDArray[np.float64]:
        """(n, 22) the target's states at the given steps (n,); it stays at its last place after the end."""
        step = np.asarray(steps, dtype=float)
        return np.stack([*self._target(step)[2], step], axis=-1)

    def _errors(self, state: Array) -> list[Array]:
        """Errors of velocity (3) and position (3) in turned axes, body rates (3), quaternion (4)."""
        c, s, target = self._target(state[..., 21])
        off = [state[..., i] - target[i] for i in range(8, 17)]
        errors = []
        for x, y, z in (off[:3], off[3:6]):
            errors += [c * x + s * y, c * y - s * x, z]
        q = product(conjugate(target[17:21]), [state[..., i] for i in range(17, 21)])
        xp = array_namespace(state)
        sign = xp.where(q[3] < 0.0, -xp.ones_like(q[3]), xp.ones_like(q[3]))
        return [*errors, *off[6:], *(sign * component for component in q)]

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        xp = array_namespace(state)
        moved = super().flow(state, action, disturbance)
        return xp.stack([*(moved[..., i] for i in range(21)), state[..., 21] + 1.0], axis=-1)

    def observe(self, state: Array) -> Array:
        """Sticks, errors to the target, progress."""
        xp = array_namespace(state)
        progress = state[..., 21] * (1.0 / self.n_steps)
        return xp.stack([*(state[..., i] for i in range(8)), *self._errors(state), progress], axis=-1)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """dt dx^T Q dx of the source, see the class; the action counts as du_prev of the state that it leads to."""
        e = self._errors(state)
        change, velocity, position, rates, turn = self.weights
        sticks = [state[..., i] for i in range(4, 8)]
        return weighted_squares(
            ((change, sticks), (velocity, e[:3]), (position, e[3:6]), (rates, e[6:9]), (turn, e[9:12])),
            self.dt,
        )

    def terminated(self, state: Array) -> Array:
        """Where the helicopter is too far from its target, too fast, turning too fast or tilted too far."""
        return self._out_of_control(state, self._errors(state)[3:6])

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """As `Helicopter`, around the place where the circle begins, at step 0."""
        state = super().initial_state(streams, mask)
        state[:, 11] -= self.radius
        return np.concatenate([state, np.zeros((len(state), 1))], axis=1)

    def expert(self) -> Any:
        """LQR along the target: gains and a look ahead for each step."""
        from beliefgym.envs.planning.lqr import funnel_expert

        return funnel_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The circle, the target on it, and the helicopter."""
        from beliefgym.envs.helicopter_picture import draw_helicopter

        target = self.targets(state[21:22])[0]
        collective = float(state[3]) / float(self.trim[3])
        draw_helicopter(canvas, state[11:14], state[17:21], collective, target[11:14], circle=self.radius)
