"""The expert of the differential-drive base: a stabilising law in polar coordinates.

With rho the distance to the goal, alpha the goal's bearing seen from the robot, phi the goal's heading seen from the
line to it, and everything mirrored where driving backwards is nearer,

    v = k_rho rho cos(alpha),     w = k_alpha alpha + k_rho (sin(alpha) cos(alpha) / alpha) (alpha + k_phi phi)

makes rho, alpha and phi go to zero from everywhere (its Lyapunov function is rho^2 + alpha^2 + k_phi phi^2). Which way
to drive is decided at the start of an episode and kept. Near the goal the bearing means nothing any more: within
`HERE` the base turns on the spot to the goal's heading and corrects its distance along its own axis.

Reference: Aicardi, Casalino, Bicchi and Balestrino 1995, "Closed loop steering of unicycle-like vehicles via Lyapunov
techniques".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.mobile_base import MobileBaseKinematic
from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.system import wrap_angle

Floats = NDArray[np.float64]

# 1/s, 1/s, 1; the best of 64 triples by mean return over 500 starts
K_RHO, K_ALPHA, K_PHI = 2.0, 3.0, 0.3
HERE = 0.03  # m


class MobileBaseController:
    """The law above for any number of copies; it remembers which way each drives.

    Args:
        system: gives the limits.
    """

    def __init__(self, system: MobileBaseKinematic) -> None:
        self.system = system
        self._backwards = np.zeros(0, dtype=np.bool_)

    def act(self, state: ArrayLike, restart: NDArray[np.bool_] | None = None) -> Floats:
        """Actions (n, 2) for states (n, n_state); `restart` marks copies whose episode has just begun."""
        states, begun = checked_batch(self.system, state, restart)
        x, y, theta = states[:, :3].T
        rho = np.hypot(x, y)
        to_goal = np.arctan2(-y, -x)
        if len(self._backwards) != len(x):  # another batch: all begin
            self._backwards, begun = np.zeros(len(x), dtype=np.bool_), np.ones(len(x), dtype=np.bool_)
        behind = np.abs(wrap_angle(to_goal - theta)) > 0.5 * np.pi
        self._backwards = np.where(begun, behind, self._backwards)
        turned = np.where(self._backwards, np.pi, 0.0)
        alpha = wrap_angle(to_goal - theta - turned)
        phi = wrap_angle(to_goal - turned)
        direction = np.where(self._backwards, -1.0, 1.0)
        speed = direction * K_RHO * rho * np.cos(alpha)
        turning = K_ALPHA * alpha + K_RHO * np.cos(alpha) * np.sinc(alpha / np.pi) * (alpha + K_PHI * phi)
        here = rho < HERE
        heading = wrap_angle(theta)
        speed = np.where(here, -K_RHO * (x * np.cos(theta) + y * np.sin(theta)), speed)
        turning = np.where(here, -K_ALPHA * heading, turning)
        # slow down while turning hard: the curve the law asks for is kept when the turning rate meets its limit
        share = np.minimum(1.0, self.system.max_turning / np.maximum(np.abs(turning), 1e-9))
        action: Floats = self.system.clip(np.stack([speed * share, turning], axis=-1))
        return action


def mobile_base_expert(system: MobileBaseKinematic) -> MobileBaseController:
    """A new controller of the base, with or without lag."""
    return MobileBaseController(system)
