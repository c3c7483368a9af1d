"""The expert of the quadrotor in hover: a linear quadratic regulator around the steady hover in the mean wind.

With the heading taken away (position, velocity, wind and attitude seen from world axes turned with the vehicle), the
mean wind W blowing along the unit vector n, and drag d_0 across, d_1 along the rotors' axis, the vehicle hovers
steadily leaning into the wind by theta with thrust T,

    tan theta = d_0 W / (m g),      T = m g cos theta + d_1 W sin theta,

and torques that hold the drag's. The action is that hover's, less K dx with dx the error to it: position, velocity, the
vector part of the attitude's error, body rates, rotors, and the gust, which the regulator knows to decay. K is that of
the windless hover, of the lack of reward to the second order. Heading and biases are no part of dx. What position,
velocity and gust ask of the two tilting torques is limited to what a tilt of MAX_LEAN asks: from far away a linear law
would turn the vehicle over.

Reference: Anderson and Moore 1990, "Optimal Control: Linear Quadratic Methods", Ch. 2; envs/planning/lqr.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.planning.linearisation import expand_cost
from beliefgym.envs.planning.lqr import error_basis, error_dynamics, error_state, steady_state_gain
from beliefgym.envs.quadrotor import Quadrotor
from beliefgym.envs.quaternions import conjugate, product, rotate_inverse

Floats = NDArray[np.float64]

MAX_LEAN = 0.6  # rad
# of the 27 components of the error: all but the heading, the mean wind and the biases
REGULATED = tuple(i for i in range(19) if i != 8)
OUTER = [0, 1, 2, 3, 4, 5, 15, 16, 17]  # of these: position, velocity and gust


def quadrotor_expert(system: Quadrotor) -> QuadrotorController:
    """A new controller for any number of copies of the system; see the module."""
    target, action = steady_hover(system, np.zeros((1, 2)))
    a, b, _ = error_dynamics(system, target[0], action[0], target[0])
    weight = expand_cost(system.stage_cost, target[0], action[0])[1]
    basis = error_basis(system, target[0])
    kept = list(REGULATED)
    q = (basis.T @ weight[: system.n_state, : system.n_state] @ basis)[np.ix_(kept, kept)]
    r = weight[system.n_state :, system.n_state :]
    gain, _ = steady_state_gain(a[np.ix_(kept, kept)], b[kept], q, r)
    return QuadrotorController(system=system, gain=gain)


@dataclass(frozen=True, kw_only=True, eq=False)
class QuadrotorController:
    """Action of the steady hover less K times the error to it; it has no memory.

    Args:
        system: whose steady hover and limits count. gain: K (4, 18).
    """

    system: Quadrotor
    gain: Floats

    def act(self, state: ArrayLike, restart: NDArray[np.bool_] | None = None) -> Floats:
        """The action of each copy.

        Args:
            state: (n, 28). restart: (n,) or None; changes nothing.

        Returns:
            (n, 4), within the limits.
        """
        states, _ = checked_batch(self.system, state, restart)
        ahead = without_heading(states)
        target, action = steady_hover(self.system, ahead[:, 20:22])
        error = error_state(self.system, ahead, target)[:, list(REGULATED)]
        feedback = error @ self.gain.T
        outer = error[:, OUTER] @ self.gain[1:3, OUTER].T
        size = np.linalg.norm(outer, axis=1, keepdims=True)
        allowed = np.abs(self.gain[1, 6]) * np.sin(0.5 * MAX_LEAN)
        feedback[:, 1:3] += outer * (allowed / np.maximum(size, allowed) - 1.0)
        return np.asarray(self.system.clip(action - feedback), dtype=float)


def without_heading(state: Floats) -> Floats:
    """The states as seen from world axes that have turned with the heading: the attitude left is a tilt, q_z = 0.

    Args:
        state: (n, 28).

    Returns:
        (n, 28).
    """
    q = [state[:, i] for i in range(6, 10)]
    norm = np.hypot(q[2], q[3])
    upside_down = norm < 1e-12  # no heading there: none is taken away
    norm = np.where(upside_down, 1.0, norm)
    nothing = np.zeros_like(norm)
    heading = (
        nothing,
        nothing,
        np.where(upside_down, 0.0, q[2] / norm),
        np.where(upside_down, 1.0, q[3] / norm),
    )
    seen = state.copy()
    for start in (0, 3, 17):
        seen[:, start : start + 3] = np.stack(
            rotate_inverse(heading, [state[:, start + i] for i in range(3)]), axis=1
        )
    mean = rotate_inverse(heading, (state[:, 20], state[:, 21], nothing))
    seen[:, 20:22] = np.stack(mean[:2], axis=1)
    seen[:, 6:10] = np.stack(product(conjugate(heading), q), axis=1)
    return seen


def steady_hover(system: Quadrotor, mean_wind: Floats) -> tuple[Floats, Floats]:
    """The state that stays as it is in a steady wind, at the origin, and its action.

    Args:
        system: the vehicle. mean_wind: (n, 2) m/s.

    Returns:
        (n, 28) with no heading, no gust and no bias, (n, 4).
    """
    speed = np.hypot(mean_wind[:, 0], mean_wind[:, 1])
    along = mean_wind / np.where(speed > 0.0, speed, 1.0)[:, None]
    across, axial = system.drag
    lean = np.arctan2(across * speed, system.weight)
    nothing = np.zeros_like(lean)
    q = (np.sin(0.5 * lean) * along[:, 1], -np.sin(0.5 * lean) * along[:, 0], nothing, np.cos(0.5 * lean))
    thrust = system.weight * np.cos(lean) + axial * speed * np.sin(lean)
    air = rotate_inverse(q, (-mean_wind[:, 0], -mean_wind[:, 1], nothing))
    force = system.body_force(air, (thrust, nothing, nothing, nothing))
    action = np.stack(
        [
            thrust / system.weight - 1.0,
            system.rotor_height * force[1] / system.max_tilt_torque,
            -system.rotor_height * force[0] / system.max_tilt_torque,
            nothing,
        ],
        axis=1,
    )
    state = np.zeros((len(mean_wind), system.n_state))
    state[:, 6:10] = np.stack(q, axis=1)
    state[:, 13:17] = np.stack(system.commands(action), axis=1)
    state[:, 17:19] = state[:, 20:22] = mean_wind
    return state, action
