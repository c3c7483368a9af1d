"""Fixed-step integrators of ds/dt = g(s, u), with u held over the step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def rk4(derivative: Callable[[Any, Any], Any], state: Any, action: Any, dt: float) -> Any:
    """One step of the classical fourth-order Runge-Kutta method.

    Args:
        derivative: (state (..., n), action (..., m)) -> (..., n).
        state: (..., n).
        action: (..., m), constant over the step.
        dt: step in s.

    Returns:
        (..., n), with a local error of order dt^5.
    """
    k1 = derivative(state, action)
    k2 = derivative(state + (0.5 * dt) * k1, action)
    k3 = derivative(state + (0.5 * dt) * k2, action)
    k4 = derivative(state + dt * k3, action)
    return state + (dt / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
