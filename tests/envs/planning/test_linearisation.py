"""Derivatives against central differences and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.planning.linearisation import clip_eigenvalues, expand_cost, linearise


def central_differences(function: Any, z: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """(..., k) -> d function / dz (..., outputs, k)."""
    columns = [(function(z + step * e) - function(z - step * e)) / (2 * step) for e in np.eye(z.shape[-1])]
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize(
    "system", [CartPole(), Pendulum(max_speed=20.0), Pendulum(integrator="rk4", damping=0.3)], ids=str
)
def test_jacobians_are_those_of_central_differences(system: Any) -> None:
    rng = np.random.default_rng(0)
    n, m = system.n_state, system.n_action
    state, action = rng.normal(size=(3, 7, n)), rng.normal(size=(3, 7, m))
    a, b = linearise(system, state, action)
    assert a.shape == (3, 7, n, n)
    assert b.shape == (3, 7, n, m)
    # Truncation is 1e-12 of the third derivative, rounding 1e-16 / 1e-6.
    np.testing.assert_allclose(a, central_differences(lambda s: system.flow(s, action), state), atol=1e-8)
    np.testing.assert_allclose(b, central_differences(lambda u: system.flow(state, u), action), atol=1e-8)


def test_a_linear_system_gives_back_its_matrices(linear_class: Any) -> None:
    system = linear_class()
    a, b = linearise(system, np.ones(3), np.ones(2))
    np.testing.assert_allclose(a, system.A, rtol=1e-15)
    np.testing.assert_allclose(b, system.B, rtol=1e-15)


def test_cost_derivatives_are_those_of_central_differences() -> None:
    system = CartPole()
    rng = np.random.default_rng(1)
    state, action = rng.normal(size=(5, 4)), rng.normal(size=(5, 1))

    def cost(z: np.ndarray) -> np.ndarray:
        return np.asarray(system.reward(z[..., :4], z[..., 4:], z[..., :4]))[..., None]

    gradient, hessian = expand_cost(lambda s, u: system.reward(s, u, s), state, action, positive=False)
    z = np.concatenate([state, action], axis=1)
    np.testing.assert_allclose(gradient, central_differences(cost, z)[:, 0], atol=1e-8)
    # Second differences with steps of 1e-4: truncation and rounding are both about 1e-8.
    second = central_differences(lambda y: central_differences(cost, y, 1e-4)[:, 0], z, 1e-4)
    np.testing.assert_allclose(hessian, second, atol=1e-6)
    np.testing.assert_array_equal(hessian, hessian.swapaxes(1, 2))


def test_positive_keeps_a_convex_cost_and_removes_negative_curvature(linear_class: Any) -> None:
    system = linear_class()
    state, action = np.ones((4, 3)), np.ones((4, 2))
    _, hessian = expand_cost(system.stage_cost, state, action)
    expected = np.zeros((5, 5))
    expected[:3, :3], expected[3:, 3:] = 2 * system.Q, 2 * system.R
    np.testing.assert_allclose(hessian, np.broadcast_to(expected, (4, 5, 5)), atol=1e-14)
    _, saddle = expand_cost(lambda s: s[..., 0] * s[..., 1] - s[..., 2] ** 2, state)
    # x y has the eigenvalues +-1 along (1, 1) and (1, -1); only the first stays.
    np.testing.assert_allclose(saddle[0], [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]], atol=1e-15)


def test_a_linear_cost_has_no_curvature_and_no_grad_mode_changes_nothing() -> None:
    with torch.no_grad():
        gradient, hessian = expand_cost(lambda s: 2.0 * s[..., 0] - s[..., 1], np.ones((3, 2)))
        a, _ = linearise(Pendulum(), np.zeros((1, 2)), np.zeros((1, 1)))
    np.testing.assert_array_equal(gradient, [[2.0, -1.0]] * 3)
    np.testing.assert_array_equal(hessian, np.zeros((3, 2, 2)))
    # Rod at the top: w' = w + dt 3 g / (2 l) theta = w + 0.75 theta, theta' = theta + dt w'.
    np.testing.assert_allclose(a[0], [[1.0375, 0.05], [0.75, 1.0]], rtol=1e-14)


def test_clipping_is_the_nearest_positive_semidefinite_matrix() -> None:
    rng = np.random.default_rng(2)
    matrices = rng.normal(size=(50, 4, 4))
    matrices = matrices + matrices.swapaxes(1, 2)
    matrices[:, 2, [0, 1, 3]] = matrices[:, [0, 1, 3], 2] = 0.0  # component 2 is coupled to nothing
    clipped = clip_eigenvalues(matrices)
    assert np.linalg.eigvalsh(clipped).min() > -1e-12  # rounding of an eigenvalue 0
    # Optimality (Higham 1988): what was removed is negative semidefinite and orthogonal to what is left.
    removed = matrices - clipped
    assert np.linalg.eigvalsh(removed).max() < 1e-12
    np.testing.assert_allclose((removed * clipped).sum(axis=(1, 2)), 0.0, atol=1e-12)


def test_a_derivative_that_is_not_finite_names_its_place() -> None:
    state = np.zeros((2, 3, 4))
    state[1, 2, 3] = np.inf
    with pytest.raises(ValueError, match=r"Jacobian of CartPole\.flow is not finite at batch index \(1, 2\)"):
        linearise(CartPole(), state, np.zeros((2, 3, 1)))
    with pytest.raises(
        ValueError, match=r"gradient of CartPole\.stage_cost is not finite at batch index \(1, 2\)"
    ):
        expand_cost(CartPole().stage_cost, state, np.zeros((2, 3, 1)))

    def root(s: Any) -> Any:
        return torch.abs(s[..., 0]) ** 1.5

    with pytest.raises(ValueError, match=r"Hessian of .*root.* is not finite at batch index \(0,\)"):
        expand_cost(root, np.zeros((1, 1)))


@pytest.mark.parametrize(
    ("state", "action"), [((5, 3), (5, 1)), ((5, 4), (5, 2)), ((5, 4), (4, 1)), ((), (1,))]
)
def test_wrong_shapes_say_what_was_expected(state: tuple[int, ...], action: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"CartPole expects states \(\.\.\., 4\) and actions \(\.\.\., 1\)"):
        linearise(CartPole(), np.zeros(state), np.zeros(action))


def test_torch_threads_are_left_alone() -> None:
    before = torch.get_num_threads()
    linearise(CartPole(), np.zeros((3, 4)), np.zeros((3, 1)))
    assert torch.get_num_threads() == before
