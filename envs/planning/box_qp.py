"""Small quadratic programs with bounds, a whole batch at once, by the projected Newton method.

    minimise  g' d + d' H d / 2    subject to    low <= d <= high,     H positive definite

Each iteration finds the components held at a bound (there the gradient points outwards), takes a Newton step in
the free ones, and projects it onto the box, with the best of several step sizes.

Reference: Bertsekas 1982, "Projected Newton methods for optimization problems with simple constraints"; Tassa,
Mansard and Todorov 2014, "Control-limited differential dynamic programming", Sec. III-B. Deviation: all step
sizes are tried at once and the best is taken, instead of the first that passes Armijo's test.
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
        free = ~(((d <= low) & (slope > 0)) | ((d >= high) & (slope < 0)))
        step = -solve_free(hessian, free, slope[..., None])[..., 0]
        moved = np.clip(d + STEP_SIZES[:, None, None] * step, low, high)  # (step sizes, b, m)
        value = (moved * (gradient + 0.5 * _times(hessian, moved))).sum(axis=2)
        best = value.argmin(axis=0)
        better = value.min(axis=0) < (d * (gradient + 0.5 * _times(hessian, d))).sum(axis=1)
        if not better.any():
            break
        d = np.where(better[:, None], moved[best, np.arange(len(d))], d)
    slope = gradient + _times(hessian, d)
    return d, ~(((d <= low) & (slope > 0)) | ((d >= high) & (slope < 0)))


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
    solved: Floats = np.linalg.solve(reduced, right * free[..., None])
    return solved


def _times(matrices: Floats, vectors: Floats) -> Floats:
    return (matrices @ vectors[..., None])[..., 0]
