"""The expert of the payload lift: the torque that the loaded arm needs, as offsets of its inner controller.

The inner controller (envs/mico.py) gives K (r + u - q) + D (dr/dt - dq/dt) + g_0(q). On the reference, q = r, that is
the torque of the motion where

    u = K^-1 (M_m(r) d2r/dt2 + c_m(r, dr/dt) + g_m(r) - g_0(r)),

with M_m, c_m, g_m of the arm that carries m (rigid_body.py), taken in the middle of the control period.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.mico import MicoLift
from beliefgym.envs.mico_arm import LINKS, TIP
from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.rigid_body import RigidArm

Floats = NDArray[np.float64]


def mico_arm(system: MicoLift) -> RigidArm:
    """The rigid-body equations of the system's arm without payload."""
    return RigidArm(links=LINKS, tip=TIP, armature=system.armature, gravity=system.gravity)


class PayloadFeedforward:
    """Offsets from inverse dynamics; see the module. It has no memory.

    Args:
        system: the task.
        assumed_mass: kg, what it takes the payload for; the true mass if None.
    """

    def __init__(self, system: MicoLift, assumed_mass: float | None = None) -> None:
        self.system = system
        self.assumed_mass = assumed_mass
        self.arm = mico_arm(system)

    def act(self, state: ArrayLike, restart: ArrayLike | None = None) -> Floats:
        """The offsets of one step of n copies.

        Args:
            state: (n, 26).
            restart: not used: the expert plans nothing.

        Returns:
            (n, 6) in rad, within the limits.

        Raises:
            ValueError: a wrong shape, or a state that is not finite.
        """
        state, _ = checked_batch(self.system, state, restart)
        time, start = state[:, 19], state[:, 20:]
        known = state[:, 18] if self.assumed_mass is None else np.full(len(state), self.assumed_mass)
        mass = np.where(self.system.carries(time), known, 0.0)
        r, speed, acceleration = self.system.reference(time + 0.5 * self.system.dt, start)
        needed = self.arm.inverse_dynamics(r, speed, acceleration, payload=mass)
        offset: Floats = (needed - self.arm.gravity_torque(r)) / np.array(self.system.stiffness)
        return self.system.clip(offset)


def mico_expert(system: MicoLift) -> PayloadFeedforward:
    """The expert of `MicoLift`: it knows the mass."""
    return PayloadFeedforward(system)
