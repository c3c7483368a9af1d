"""The camera for drawings in space."""

import numpy as np
import pytest

from beliefgym.envs.projection import Camera


def test_from_the_x_axis_y_is_to_the_right_and_z_up():
    (place,), depth = Camera(azimuth=0.0, elevation=0.0).project([1.0, 2.0, 3.0])
    assert place == pytest.approx((2.0, 3.0))
    assert depth == pytest.approx([-1.0])  # nearer than the origin, towards the viewer


def test_from_above_the_height_is_the_nearness():
    (place,), depth = Camera(azimuth=-np.pi / 2, elevation=np.pi / 2).project([1.0, 2.0, 3.0])
    assert place == pytest.approx((1.0, 2.0))
    assert depth == pytest.approx([-3.0])


def test_it_is_a_rotation():
    points = np.random.default_rng(0).normal(size=(50, 3))
    places, depth = Camera(azimuth=0.7, elevation=0.4).project(points)
    seen = np.column_stack([places, depth])
    assert seen @ seen.T == pytest.approx(points @ points.T)


def test_wrong_points_are_told():
    with pytest.raises(ValueError, match=r"expected points \(k, 3\), got shape \(1, 2\)"):
        Camera(azimuth=0.0, elevation=0.0).project([1.0, 2.0])
