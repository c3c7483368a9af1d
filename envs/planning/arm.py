"""Experts for reaching with a torque-controlled arm: inverse dynamics, LQR at a fixed target, inverse kinematics.

The way to a target configuration: with e = target - q and the control period h, each joint has a desired velocity
that it can still brake from, and a desired acceleration towards it,

    v_d = e min(k, v_max / |e|, sqrt(2 b / |e|)),     a_d = (v_d - v) / time,

and the torque is that of this acceleration, with the damping of the velocity at the period's end (which matters where
damping is large beside inertia: the wrist),

    tau = g + c + d v + s (M a_d + d h a_d),

with the largest s in 0..1 that keeps the torques within the efforts: the direction of the motion stays. Near a target
that all copies share, the infinite-horizon LQR of MuJoCo's own linearisation takes over,

    tau = g(target) - K [q - target; v],      K for the system's stage cost.

A target of the hand becomes a configuration by damped least squares from several configurations at once,

    dq = J' (J J' + lambda I)^-1 (x - hand(q)),       clipped to the joint limits less a margin,

of which the nearest to the arm's start is taken.

Reference: Luh, Walker, Paul 1980, "Resolved-acceleration control"; Wampler 1986, "Manipulator inverse kinematic
solutions based on vector formulations and damped least-squares methods".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import control
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.planning.linearisation import expand_cost
from beliefgym.envs.rigid_body import RigidArm

if TYPE_CHECKING:
    from beliefgym.envs.baxter import BaxterReach
    from beliefgym.envs.baxter_arm import BaxterArm
    from beliefgym.envs.baxter_hand import BaxterReachHand

Floats = NDArray[np.float64]

APPROACH, SETTLING = 0.3, 1.4  # k in 1/h, and the time of a_d in h
OVERSPEED = 3.0  # v_max as a multiple of the rated speeds, which the simulated arm can exceed
BRAKING = 15.0  # b in rad/s^2
NEAR, SLOW = 0.2, 1.0  # rad and rad/s, largest over the joints: where the LQR takes over
STARTS, ITERATIONS, LAMBDA, STRIDE = 12, 60, 1e-3, 0.4  # of the inverse kinematics; m^2; rad
MARGIN = 0.05  # rad, from the joint limits
FOUND = 1e-4  # m


def inverse_kinematics(arm: RigidArm, targets: ArrayLike, start: ArrayLike) -> tuple[Floats, Floats]:
    """Configurations whose tips are at the targets; see the module.

    Args:
        arm: all its joints have limits.
        targets: (n, 3) m.
        start: (n, dof) rad; the solution nearest to it, in the joint that is farthest away, is taken.

    Returns:
        angles (n, dof) rad within the joint limits, and the tips' distances (n,) from the targets in m: below 1e-4
        where a solution was found; else it is the nearest that was found.
    """
    targets, start = np.asarray(targets, dtype=np.float64), np.asarray(start, dtype=np.float64)
    low, high = (limit + side * MARGIN for limit, side in zip(arm.limits, (1.0, -1.0), strict=True))
    spread = np.random.default_rng(0).uniform(low, high, (STARTS - 1, arm.dof))
    q = np.concatenate([start[:, None], np.broadcast_to(spread, (len(start), *spread.shape))], axis=1)
    q = np.clip(q, low, high)
    damping = LAMBDA * np.eye(3)
    for _ in range(ITERATIONS):
        tip, jacobian = arm.tip_jacobian(q)
        pull = np.linalg.solve(
            jacobian @ jacobian.swapaxes(-1, -2) + damping, (targets[:, None] - tip)[..., None]
        )
        stride = (jacobian.swapaxes(-1, -2) @ pull)[..., 0]
        q = np.clip(q + np.clip(stride, -STRIDE, STRIDE), low, high)
    distance = np.linalg.norm(arm.tip_position(q) - targets[:, None], axis=-1)
    way = np.abs(q - start[:, None]).max(axis=-1)
    best = np.argmin(np.where(distance < FOUND, way, 1e3 + distance), axis=1)
    rows = np.arange(len(q))
    return q[rows, best], distance[rows, best]


class ReachController:
    """Moves every copy of an arm to a configuration of its own; see the module.

    Args:
        system: the task.
        configuration: where the arm of a copy is to go, (k, n_state) -> (k, 7) rad; asked at the start of an episode.
        gain: K of the LQR at a target that all copies share; None for none.
    """

    def __init__(
        self, system: BaxterArm, configuration: Callable[[Floats], Floats], gain: Floats | None = None
    ) -> None:
        self.system = system
        self.gain = gain
        self._configuration = configuration
        self._rated = OVERSPEED * np.array([link.velocity for link in system.arm.links])
        self.targets = np.zeros((0, system.arm.dof))
        self._held = self.targets
        self._known = np.zeros(0, dtype=bool)

    def act(self, state: ArrayLike, restart: ArrayLike | None = None) -> Floats:
        """The torques of one step of n copies; call it once a step, in order.

        Args:
            state: (n, n_state).
            restart: bool (n,), where a new episode has begun; nowhere if None. Another number of copies than in
                the last call means a new batch: all find their configuration anew.

        Returns:
            (n, 7) N m, within the efforts.

        Raises:
            ValueError: a wrong shape, or a state that is not finite.
        """
        state, begun = checked_batch(self.system, state, restart)
        n, dof = len(state), self.system.arm.dof
        if n != len(self._known):
            self.targets, self._held = np.zeros((n, dof)), np.zeros((n, dof))
            self._known = np.zeros(n, dtype=bool)
        self._known &= ~begun
        new = np.flatnonzero(~self._known)
        if len(new):
            self.targets[new] = self._configuration(state[new])
            self._held[new] = self.system.arm.gravity_torque(self.targets[new])
            self._known[new] = True
        angles, velocity = state[:, :dof], state[:, dof : 2 * dof]
        torque = self._approach(angles, velocity)
        if self.gain is not None:
            error = angles - self.targets
            near = (np.abs(error).max(axis=1) < NEAR) & (np.abs(velocity).max(axis=1) < SLOW)
            holding = self._held - np.concatenate([error, velocity], axis=1) @ self.gain.T
            torque = np.where(near[:, None], holding, torque)
        return self.system.clip(torque)

    def _approach(self, angles: Floats, velocity: Floats) -> Floats:
        """Inverse dynamics of the way to the targets, (n, 7) N m."""
        arm, h = self.system.arm, self.system.dt
        error = self.targets - angles
        way = np.abs(error) + 1e-12
        pace = np.minimum(np.minimum(APPROACH / h, self._rated / way), np.sqrt(2.0 * BRAKING / way))
        wanted = (pace * error - velocity) / (SETTLING * h)
        still = arm.inverse_dynamics(angles, velocity, np.zeros(arm.dof))
        moving = arm.inverse_dynamics(angles, velocity, wanted) - still + arm.damping * h * wanted
        room = np.where(moving > 0.0, arm.efforts - still, arm.efforts + still)
        scale = np.clip((room / (np.abs(moving) + 1e-12)).min(axis=1, keepdims=True), 0.0, 1.0)
        return still + scale * moving


def joint_reach_expert(system: BaxterReach) -> ReachController:
    """A new controller for any number of copies of the task with a fixed configuration."""
    target = np.array(system.target)
    at_rest, held = np.concatenate([target, np.zeros(len(target))]), system.arm.gravity_torque(target)
    weight = expand_cost(system.stage_cost, at_rest[None], held[None])[1][0]
    n = len(at_rest)
    a, b = system.transition_derivatives(at_rest, held)
    gain, _, _ = control.dlqr(a, b, weight[:n, :n], weight[n:, n:], method="scipy")
    return ReachController(
        system, lambda state: np.broadcast_to(target, (len(state), len(target))), np.asarray(gain)
    )


def hand_reach_expert(system: BaxterReachHand) -> ReachController:
    """A new controller for any number of copies of the task with a place for the hand."""

    def configuration(state: Floats) -> Floats:
        dof = system.arm.dof
        return inverse_kinematics(system.arm, state[:, 2 * dof :], state[:, :dof])[0]

    return ReachController(system, configuration)
