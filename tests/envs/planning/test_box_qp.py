"""Bounded quadratic programs against an enumeration of all active sets."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from beliefgym.envs.planning.box_qp import box_qp, solve_free


def by_enumeration(h: np.ndarray, g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The best feasible point over every choice of which components sit at which bound."""
    best, point = np.inf, np.zeros_like(g)
    for where in product((-1, 0, 1), repeat=len(g)):
        sides = np.array(where)
        d = np.where(sides < 0, low, np.where(sides > 0, high, 0.0))
        free = sides == 0
        if free.any():
            d[free] = np.linalg.solve(h[np.ix_(free, free)], -(g + h @ d)[free])
        value = g @ d + 0.5 * d @ h @ d
        if np.isfinite(value) and (d >= low - 1e-12).all() and (d <= high + 1e-12).all() and value < best:
            best, point = value, d
    return point


@pytest.mark.parametrize("size", [1, 2, 4])
def test_minimiser_is_that_of_all_active_sets(size: int) -> None:
    rng = np.random.default_rng(size)
    b = 300
    root = rng.normal(size=(b, size, size))
    h = root @ root.swapaxes(1, 2) + 0.05 * np.eye(size)
    g = rng.normal(size=(b, size))
    low, high = -rng.uniform(0.0, 1.0, (b, size)), rng.uniform(0.0, 1.0, (b, size))
    d, free = box_qp(h, g, low, high)
    expected = np.array([by_enumeration(*row) for row in zip(h, g, low, high, strict=True)])
    np.testing.assert_allclose(d, expected, atol=1e-7)  # condition numbers up to 1e4 on machine precision
    np.testing.assert_array_equal(free, (expected > low + 1e-9) & (expected < high - 1e-9))
    assert 0.1 < free.mean() < 0.9, "both kinds of component must occur"


def test_without_bounds_it_is_the_newton_step() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5, 3, 3))
    h, g = root @ root.swapaxes(1, 2) + np.eye(3), rng.normal(size=(5, 3))
    d, free = box_qp(h, g, np.full((5, 3), -np.inf), np.full((5, 3), np.inf))
    np.testing.assert_allclose(d, np.linalg.solve(h, -g[..., None])[..., 0], rtol=1e-10)
    assert free.all()


def test_held_components_get_no_gain() -> None:
    h = np.array([[[2.0, 1.0], [1.0, 3.0]]])
    right = np.ones((1, 2, 4))
    gains = solve_free(h, np.array([[True, False]]), right)
    np.testing.assert_allclose(gains, [[[0.5] * 4, [0.0] * 4]])
