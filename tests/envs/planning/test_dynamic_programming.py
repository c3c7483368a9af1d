"""Values on a grid against closed forms, and the pendulum's expert against the known optimum."""

from __future__ import annotations

import pickle
from typing import Any

import control
import numpy as np
import pytest

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.planning import dynamic_programming
from beliefgym.envs.planning.dynamic_programming import (
    GridController,
    pendulum_expert,
    speed_bound,
    value_iteration,
)
from beliefgym.envs.planning.grid import Axis, GridValue, table_of
from beliefgym.envs.planning.ilqr import ILQR


def returns(
    controller: Any, system: Any, state: np.ndarray, steps: int = 200
) -> tuple[np.ndarray, np.ndarray]:
    """Undiscounted returns and the actions (n, steps, 1) from each state, without noise."""
    total, actions = np.zeros(len(state)), []
    for _ in range(steps):
        action = controller.act(state, None)
        after = system.step(state, action)
        total += system.reward(state, action, after)
        actions.append(action)
        state = after
    return total, np.stack(actions, axis=1)


def starts(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 2)) * [np.pi, 1.0]


@pytest.fixture(scope="module")
def expert() -> GridController:
    return pendulum_expert(Pendulum())


def test_interpolation_is_exact_for_bilinear_functions_and_holds_the_border() -> None:
    axes = Axis(-1.0, 2.0, 4), Axis(0.0, 1.0, 6)
    x, y = np.meshgrid(axes[0].points, axes[1].points, indexing="ij")

    def function(s: np.ndarray) -> np.ndarray:
        return 1.0 + 2.0 * s[..., 0] - 3.0 * s[..., 1] + 0.5 * s[..., 0] * s[..., 1]

    value = GridValue(axes, table_of(function(np.stack([x, y], -1)).ravel(), axes), 0, True)
    inside = np.random.default_rng(0).uniform([-1.0, 0.0], [2.0, 1.0], (5, 20, 2))
    np.testing.assert_allclose(value(inside), function(inside), atol=1e-14)
    corners = np.array([[-1.0, 0.0], [2.0, 1.0]])
    np.testing.assert_allclose(value(corners), function(corners), atol=1e-14)
    np.testing.assert_allclose(value(np.array([[5.0, 0.5]])), function(np.array([[2.0, 0.5]])), atol=1e-14)


def test_a_periodic_axis_repeats() -> None:
    axes = Axis(-np.pi, np.pi, 8, periodic=True), Axis(0.0, 1.0, 2)
    value = GridValue(axes, table_of(np.repeat(np.cos(axes[0].points), 2), axes), 0, True)
    angles = np.linspace(-3.1, 3.1, 50)
    state = np.stack([angles, np.full(50, 0.3)], axis=1)
    for turns in (-2, 1, 3):
        # 20 rad leave an error of about 1e-15 in the angle.
        np.testing.assert_allclose(
            value(state + np.array([2.0 * np.pi * turns, 0.0])), value(state), atol=1e-13
        )
    np.testing.assert_allclose(value(np.array([[np.pi - 1e-12, 0.0]])), -1.0, atol=1e-11)


def test_values_are_those_of_the_riccati_equation(cart_class: Any) -> None:
    system = cart_class(dt=0.4, limit=3.0)
    axes = Axis(-2.0, 2.0, 161), Axis(-2.0, 2.0, 161)
    actions = np.linspace(-3.0, 3.0, 61)[:, None]
    value = value_iteration(system, axes, actions)
    assert value.converged
    a = np.array([[1.0, 0.4], [0.0, 1.0]])
    b = np.array([[0.08], [0.4]])
    _, p, _ = control.dlqr(a, b, np.eye(2), np.array([[0.5]]), method="scipy")
    state = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 2))
    exact = np.einsum("ni,ij,nj->n", state, np.asarray(p), state)
    # A bilinear V lies above a convex one, here by V'' h^2 / 8 = 1e-3 a step or less, and actions 0.1 apart cost
    # about as much, for some twenty steps; single precision takes 1e-6.
    error = value(state) - exact
    assert error.min() > -1e-5
    assert error.max() < 0.05
    assert exact.max() > 5.0
    held = value_iteration(system, axes, actions, actions[::10], (2, 3))
    np.testing.assert_allclose(held(state), value(state), atol=0.03)
    restarted = value_iteration(system, axes, actions, start=value)
    assert restarted.improvements < value.improvements
    np.testing.assert_allclose(restarted(state), value(state), atol=1e-3)


def test_an_ended_task_costs_nothing_more(cart_class: Any) -> None:
    system = cart_class(dt=0.25, limit=1.0, finish=0.0)
    axes = Axis(-4.0, 1.0, 201), Axis(-2.0, 4.0, 193)
    value = value_iteration(system, axes, [[-1.0], [0.0], [1.0]])
    position = np.array([-0.5, -1.0, -2.0, -3.0])
    # From rest at -d under full force: the first k with (k dt)^2 / 2 > d; interpolation rounds the steps off.
    steps = np.floor(np.sqrt(-2.0 * position) / 0.25) + 1
    at_rest = np.stack([position, np.zeros(4)], axis=1)
    np.testing.assert_allclose(value(at_rest), steps, atol=0.7)
    controller = GridController(system, value, [[-1.0], [0.0], [1.0]])
    np.testing.assert_array_equal(controller.act(at_rest), np.ones((4, 1)))


def test_a_discount_bounds_what_is_paid_for_ever(cart_class: Any) -> None:
    system = cart_class(finish=1e9)
    value = value_iteration(
        system, (Axis(-1, 1, 11), Axis(-1, 1, 11)), [[-1.0], [1.0]], discount=0.9, tolerance=1e-6
    )
    np.testing.assert_allclose(value.table, 10.0, atol=1e-5)  # costs are held in single precision
    held = value_iteration(
        system,
        (Axis(-1, 1, 11), Axis(-1, 1, 11)),
        [[-1.0], [1.0]],
        None,
        (2, 5),
        discount=0.9,
        tolerance=1e-9,
    )
    np.testing.assert_allclose(held.table, 10.0, atol=1e-5)


def test_the_pendulums_expert_is_at_the_known_optimum(expert: GridController) -> None:
    assert expert.value.converged
    total, actions = returns(expert, Pendulum(), starts(1500))
    # The optimum is -137.6 with a standard error of 1.9; ours here is 74 / sqrt(1500) = 1.9: 3 sigma of both.
    assert abs(total.mean() + 137.6) < 3.0 * np.hypot(1.9, 1.9)
    assert (np.abs(actions) <= 2.0).all()


def test_the_expert_holds_the_pendulum_upright(expert: GridController) -> None:
    system, state = Pendulum(), starts(300, seed=1)
    for _ in range(200):
        state = system.step(state, expert.act(state))
    assert (np.abs(np.sin(0.5 * state[:, 0])) < 0.01).all()
    assert (np.abs(state[:, 1]) < 0.05).all()


@pytest.mark.slow
def test_the_expert_loses_less_than_a_third_of_a_point_to_the_optimum(expert: GridController) -> None:
    """iLQR on the whole episode, from the expert's own actions and from its mirror's, bounds the optimum."""
    system, state = Pendulum(), starts(300, seed=2)
    total, actions = returns(expert, system, state)
    planner = ILQR(system=system, horizon=200, max_iterations=40)
    gap = -planner.solve(state, actions).cost - total
    assert (gap > -1e-9).all()
    assert gap.mean() < 0.3


def test_noise_shares_the_value_and_the_plan_does_not_depend_on_the_batch(expert: GridController) -> None:
    noisy = pendulum_expert(Pendulum(actuation_noise_std=0.3, process_noise_std=(0.01, 0.02)))
    assert noisy.value is expert.value
    state = starts(50)
    together = expert.act(state, np.ones(50, dtype=bool))
    np.testing.assert_array_equal(together[[7]], expert.act(state[[7]]))
    np.testing.assert_array_equal(together, pickle.loads(pickle.dumps(expert)).act(state))


def test_under_noise_the_expert_still_holds(expert: GridController) -> None:
    system = Pendulum(actuation_noise_std=0.3, process_noise_std=0.01)
    controller, state = pendulum_expert(system), starts(100)
    rng = np.random.default_rng(0)
    for _ in range(200):
        state = system.step(state, controller.act(state), rng.normal(size=(100, 3)))
    assert (np.cos(state[:, 0]) > 0.98).mean() > 0.97


@pytest.mark.parametrize(
    "system",
    [
        Pendulum(max_speed=np.inf, integrator="rk4", inertia="point", max_torque=4.0),
        Pendulum(mass=2.0, damping=0.2),
        Pendulum(dt=0.02),
    ],
    ids=["rk4, point, no speed limit", "heavy and damped", "short steps"],
)
def test_other_pendulums_are_swung_up_too(system: Pendulum, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dynamic_programming, "ANGLES", 240)
    monkeypatch.setattr(dynamic_programming, "SPEEDS", 193)
    monkeypatch.setattr(
        dynamic_programming, "_pendulum_value", dynamic_programming._pendulum_value.__wrapped__
    )
    controller, state = pendulum_expert(system), starts(50)
    fastest = 0.0
    for _ in range(round(12.0 / system.dt)):
        state = system.step(state, controller.act(state))
        fastest = max(fastest, np.abs(state[:, 1]).max())
    assert (np.cos(state[:, 0]) > 0.99).all()
    assert fastest <= controller.value.axes[1].high


def test_an_unlimited_speed_gets_a_grid_by_energy() -> None:
    free = Pendulum(max_speed=np.inf)
    # Rod: gravity gives 3 g / (2 l) = 15, torque 3 u / (m l^2) = 6 rad/s^2; w^2 = 1 + 4 15 + 4 pi 6.
    np.testing.assert_allclose(speed_bound(free), np.sqrt(61.0 + 24.0 * np.pi), rtol=1e-12)


def test_an_uncontrolled_pendulum_has_no_expert() -> None:
    with pytest.raises(
        ValueError, match=r"uncontrolled pendulum has no expert: max_torque is 0\.0; set it above 0"
    ):
        pendulum_expert(Pendulum.uncontrolled(damping=0.3))


def test_bad_input_says_what_was_expected(expert: GridController) -> None:
    axes = Axis(-1.0, 1.0, 3), Axis(-1.0, 1.0, 3)
    with pytest.raises(ValueError, match="needs a system with 2 state components, CartPole has 4"):
        value_iteration(CartPole(), axes, [[0.0]])
    with pytest.raises(ValueError, match=r"expected discount in \(0, 1\], got 1\.5"):
        value_iteration(Pendulum(), axes, [[0.0]], discount=1.5)
    with pytest.raises(ValueError, match=r"expected actions as \(k, 1\) with k above 0, got shape \(3,\)"):
        value_iteration(Pendulum(), axes, [0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match=r"expected holds of at least 2 steps, got \[1, 4\]"):
        value_iteration(Pendulum(), axes, [[0.0]], holds=(1, 4))
    with pytest.raises(ValueError, match="at least 2 nodes in a finite range"):
        Axis(0.0, np.inf, 10)
    with pytest.raises(ValueError, match=r"expected state as \(n, 2\), got shape \(2,\)"):
        expert.act(np.zeros(2))
    with pytest.raises(ValueError, match="the state of copy 1 is not finite"):
        expert.act(np.array([[0.0, 0.0], [np.nan, 0.0]]))
