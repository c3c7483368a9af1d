"""Quaternion helpers against scipy's Rotation, and their derivatives against finite differences."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from beliefgym.envs import quaternions

N = 200
RNG = np.random.default_rng(0)


def unit(seed):
    q = np.random.default_rng(seed).normal(size=(N, 4))
    return q / np.linalg.norm(q, axis=1)[:, None]


def stacked(components):
    return np.stack(components, axis=-1)


def assert_same_turn(found, expected):
    """q and -q are the same turn."""
    sign = np.sign((found * expected).sum(axis=1))[:, None]
    assert sign * found == pytest.approx(expected, abs=1e-14)  # a few roundings of numbers up to 1


def test_products_and_turns_are_scipys():
    p, q, v = unit(1), unit(2), RNG.normal(size=(N, 3))
    assert_same_turn(
        stacked(quaternions.product(p.T, q.T)), (Rotation.from_quat(p) * Rotation.from_quat(q)).as_quat()
    )
    turned = Rotation.from_quat(q).apply(v)
    assert stacked(quaternions.rotate(q.T, v.T)) == pytest.approx(turned, abs=1e-14)
    assert stacked(quaternions.rotate_inverse(q.T, turned.T)) == pytest.approx(v, abs=1e-14)
    assert_same_turn(stacked(quaternions.conjugate(q.T)), Rotation.from_quat(q).inv().as_quat())


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.0099999, 0.0100001, 0.3, 3.0, 10.0])
def test_exponential_is_scipys_at_every_size_and_has_unit_norm(size):
    direction = RNG.normal(size=(N, 3))
    turn = size * direction / np.linalg.norm(direction, axis=1)[:, None]
    found = stacked(quaternions.exponential(turn.T))
    assert_same_turn(found, Rotation.from_rotvec(turn).as_quat())
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0, abs=4e-16)  # two roundings


def test_exponential_has_its_derivatives_at_zero():
    zero = torch.zeros(3, dtype=torch.float64)

    def exponential(a):
        return torch.stack(quaternions.exponential([a[0], a[1], a[2]]))

    jacobian = torch.autograd.functional.jacobian(exponential, zero).numpy()
    assert jacobian == pytest.approx(np.vstack([0.5 * np.eye(3), np.zeros(3)]), abs=1e-15)
    hessian = torch.autograd.functional.hessian(lambda a: exponential(a)[3], zero).numpy()
    assert hessian == pytest.approx(-0.25 * np.eye(3), abs=1e-15)  # w = cos(|a|/2)


def test_exponential_has_its_derivatives_across_the_series_limit():
    step = 1e-5
    for size in (0.0099, 0.0101, 0.5):
        at = torch.tensor([size, 0.3 * size, -0.2 * size], dtype=torch.float64)
        jacobian = torch.autograd.functional.jacobian(
            lambda a: torch.stack(quaternions.exponential([a[0], a[1], a[2]])), at
        ).numpy()
        for j, shift in enumerate(np.eye(3) * step):
            difference = stacked(quaternions.exponential(at.numpy() + shift)) - stacked(
                quaternions.exponential(at.numpy() - shift)
            )
            assert jacobian[:, j] == pytest.approx(difference / (2 * step), abs=1e-9)  # central: step^2


def test_integration_turns_about_body_axes():
    q, rates = unit(3), RNG.normal(size=(N, 3))
    expected = Rotation.from_quat(q) * Rotation.from_rotvec(0.05 * rates)
    assert_same_turn(stacked(quaternions.integrate(q.T, rates.T, 0.05)), expected.as_quat())


def test_euler_angles_are_scipys_both_ways():
    q = unit(4)
    yaw, pitch, roll = Rotation.from_quat(q).as_euler("ZYX").T
    found = stacked(quaternions.euler_angles(q.T))
    assert found == pytest.approx(
        stacked([roll, pitch, yaw]), abs=1e-11
    )  # ill-conditioned near pitch 90 degrees
    assert_same_turn(stacked(quaternions.from_euler_angles(roll, pitch, yaw)), q)


def test_tilt_is_the_angle_between_the_vertical_axes():
    q = unit(5)
    assert quaternions.tilt_cosine(q.T) == pytest.approx(
        Rotation.from_quat(q).as_matrix()[:, 2, 2], abs=1e-14
    )


def test_random_turns_are_even():
    """Under an even spread, every vector is sent to the mean 0 and to second moments of a third."""
    q = quaternions.random_turn(np.random.default_rng(6).random((20000, 3)))
    assert np.linalg.norm(q, axis=1) == pytest.approx(1.0, abs=1e-15)
    turned = Rotation.from_quat(q).apply([1.0, 0.0, 0.0])
    assert turned.mean(axis=0) == pytest.approx(0.0, abs=0.02)  # 5 standard errors: 0.577 / sqrt(20000)
    assert turned.T @ turned / len(q) == pytest.approx(np.eye(3) / 3.0, abs=0.012)  # 0.3 / sqrt(20000) each
