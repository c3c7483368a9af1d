"""The steady-state LQR about an equilibrium, as an expert: u = clip(u* - K (s - s*)).

K solves the discrete Riccati equation of the exact Jacobians (A, B) of `system.flow` at the equilibrium and the
Hessian of `system.stage_cost` there.
"""

from __future__ import annotations

from dataclasses import dataclass

import control
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.planning.linearisation import expand_cost, linearise
from beliefgym.envs.system import System

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BalancingController:
    """Linear feedback about an equilibrium.

    Attributes:
        system: gives the limits. state: (n,) and action: (m,) of the equilibrium. gain: K (m, n).
    """

    system: System
    state: Floats
    action: Floats
    gain: Floats

    def act(self, state: ArrayLike, restart: NDArray[np.bool_] | None = None) -> Floats:
        """Actions (rows, m) for states (rows, n); it keeps no memory of an episode."""
        states, _ = checked_batch(self.system, state, restart)
        deviation = states - self.state
        actions: Floats = self.system.clip(self.action - deviation @ self.gain.T)
        return actions


def balancing_expert(system: System, state: ArrayLike, action: ArrayLike) -> BalancingController:
    """The controller of a system about an equilibrium.

    Args:
        system: differentiable, with a stage cost that is positive definite in the action.
        state: (n,). action: (m,).

    Raises:
        ValueError: the state is no equilibrium under the action.
    """
    s, u = np.asarray(state, dtype=np.float64), np.asarray(action, dtype=np.float64)
    moved = np.abs(system.flow(s, u) - s).max()
    if moved > 1e-9:
        raise ValueError(
            f"expected an equilibrium of {type(system).__name__}, but one step moves the state by up to {moved:g}"
        )
    a, b = linearise(system, s[None], u[None])
    _, weight = expand_cost(system.stage_cost, s[None], u[None])
    n = system.n_state
    gain, _, _ = control.dlqr(a[0], b[0], weight[0, :n, :n], weight[0, n:, n:], method="scipy")
    return BalancingController(system, s, u, np.asarray(gain))
