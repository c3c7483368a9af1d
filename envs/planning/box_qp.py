"""Small quadratic programs with bounds, a whole batch at once, by the projected Newton method.

    minimise  g' d + d' H d / 2    subject to    low <= d <= high,     H positive definite

Each iteration finds the components held at a bound (descent or the Newton step would leave the box there), takes a
Newton step in the free ones, and projects it onto the box, with the best of several step sizes.

Reference: Bertsekas 1982, "Projected Newton methods for optimization problems with simple constraints"; Tassa,
Mansard and Todorov 2014, "Control-limited differential dynamic programming", Sec. III-B. Deviation: all step
sizes are tried at once, among them those at which a component meets its bound, and the best is taken. The first of
these always lowers the value, so that no Armijo test is needed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MAX_ITERATIONS = 50
STEP_SIZES = 0.5 ** np.arange(12)


def box_qp(hessian: Floats, gradient: Floats, low: Floats, high: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Solve a batch of bounded quadratic programs.

    Args:
        hessian: (b, m, m), symmetric positive definite.
        gradient: (b, m).
        low, high: (b, m), low <= high; infinite where there is no bound.

    Returns:
        the minimisers d (b, m), and where d is free, that is not held at a bound, bool (b, m).
    """
    if gradient.shape[1] == 1:
        unbounded = -gradient / hessian[..., 0]
        return np.clip(unbounded, low, high), (unbounded > low) & (unbounded < high)
    d = np.clip(np.zeros_like(gradient), low, high)
    for _ in range(MAX_ITERATIONS):
        slope = gradient + _times(hessian, d)
        step = _inward_step(hessian, slope, d, low, high)
        to_bound = np.full_like(d, np.inf)  # how far each component may go, in steps
        np.divide(np.where(step > 0, high - d, low - d), step, out=to_bound, where=step != 0)
        sizes = np.where(
            to_bound < 1.0, to_bound * (1.0 + 1e-12), 1.0
        ).T  # a little more, so that clip meets it
        sizes = np.concatenate([sizes, np.broadcast_to(STEP_SIZES[:, None], (len(STEP_SIZES), len(d)))])
        moved = np.clip(d + sizes[..., None] * step, low, high)  # (step sizes, b, m)
        value = (moved * (gradient + 0.5 * _times(hessian, moved))).sum(axis=2)
        best = value.argmin(axis=0)
        better = value.min(axis=0) < (d * (gradient + 0.5 * _times(hessian, d))).sum(axis=1)
        if not better.any():
            break
        d = np.where(better[:, None], moved[best, np.arange(len(d))], d)
    return d, ~_pushed_out(gradient + _times(hessian, d), d, low, high)


def _inward_step(hessian: Floats, slope: Floats, d: Floats, low: Floats, high: Floats) -> Floats:
    """The Newton step in the components that can move, (b, m); 0 in those that would leave the box."""
    free = ~_pushed_out(slope, d, low, high)
    for _ in range(d.shape[1]):
        step = -solve_free(hessian, free, slope[..., None])[..., 0]
        blocked = free & _pushed_out(-step, d, low, high)
        if not blocked.any():
            break
        free = free & ~blocked
    return step


def _pushed_out(slope: Floats, d: Floats, low: Floats, high: Floats) -> NDArray[np.bool_]:
    """Where descent along this slope would leave the box."""
    return ((d <= low) & (slope > 0)) | ((d >= high) & (slope < 0))


def solve_free(hessian: Floats, free: NDArray[np.bool_], right: Floats) -> Floats:
    """Solve H_ff z_f = right_f in the free components; z is 0 in the others.

    Args:
        hessian: (b, m, m). free: bool (b, m). right: (b, m, k).

    Returns:
        (b, m, k).
    """
    if hessian.shape[1] == 1:
        return free[..., None] * right / hessian
    both = free[:, :, None] & free[:, None, :]
    reduced = np.where(both, hessian, 0.0) + np.eye(hessian.shape[1]) * ~free[:, :, None]
    return np.asarray(np.linalg.solve(reduced, right * free[..., None]), dtype=np.float64)


def _times(matrices: Floats, vectors: Floats) -> Floats:
    return (matrices @ vectors[..., None])[..., 0]
