"""iLQR against Riccati's recursion, finite differences and the conditions of an optimum."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.planning.ilqr import ILQR
from beliefgym.envs.planning.linearisation import expand_cost, linearise


def riccati(system: Any, horizon: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Gains of times 0 ... T - 1 and the value matrix of time 0, with no terminal cost."""
    p, gains = np.zeros((3, 3)), []
    for _ in range(horizon):
        gain = -np.linalg.solve(system.R + system.B.T @ p @ system.B, system.B.T @ p @ system.A)
        closed = system.A + system.B @ gain
        p = system.Q + gain.T @ system.R @ gain + closed.T @ p @ closed
        gains.insert(0, gain)
    return gains, p


def _path(system: Any, start: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """States (b, T + 1, n) under open-loop actions."""
    states = [start]
    for t in range(actions.shape[1]):
        states.append(system.flow(states[-1], actions[:, t]))
    return np.stack(states, axis=1)


def swing_up_problem(batch: int, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    state = np.array([0.0, 0.0, np.pi, 0.0]) + rng.uniform(-0.1, 0.1, (batch, 4))
    return state, 3.0 * rng.normal(size=(batch, horizon, 1))


def test_a_linear_quadratic_problem_is_solved_by_one_pass(linear_class: Any) -> None:
    system = linear_class()
    start = np.random.default_rng(0).normal(size=(4, 3))
    solution = ILQR(system=system, horizon=30).solve(start)
    gains, value = riccati(system, 30)
    # The ridge of 1e-10 on Q_uu (of order 1) is the only difference besides rounding.
    np.testing.assert_allclose(solution.gains, np.broadcast_to(gains, solution.gains.shape), atol=1e-8)
    np.testing.assert_allclose(solution.cost, np.einsum("bi,ij,bj->b", start, value, start), rtol=1e-9)
    np.testing.assert_allclose(
        solution.actions, np.einsum("tij,btj->bti", np.array(gains), solution.states[:, :-1]), atol=1e-7
    )
    assert solution.converged.all()
    assert (solution.iterations == 2).all(), "the second pass only finds that nothing is left to gain"


def test_long_horizon_gains_are_the_stationary_lqr(linear_class: Any) -> None:
    system = linear_class()
    solution = ILQR(system=system, horizon=80).solve(np.ones((1, 3)))
    gain, _, _ = control.dlqr(system.A, system.B, system.Q, system.R, method="scipy")
    # Riccati's recursion has converged to rounding after 80 steps; the ridge leaves 1e-10.
    np.testing.assert_allclose(solution.gains[0, 0], -np.asarray(gain), atol=1e-8)


def test_terminal_cost_enters(linear_class: Any) -> None:
    system = linear_class()
    gain, value, _ = control.dlqr(system.A, system.B, system.Q, system.R, method="scipy")

    def terminal(state: Any) -> Any:
        weight = np.asarray(value) if isinstance(state, np.ndarray) else state.new_tensor(np.asarray(value))
        return ((state @ weight) * state).sum(-1)

    solution = ILQR(system=system, horizon=3, terminal_cost=terminal).solve(np.ones((1, 3)))
    # With the infinite-horizon value at the end, every gain of a short plan is the stationary one.
    np.testing.assert_allclose(solution.gains[0], np.broadcast_to(-np.asarray(gain), (3, 2, 3)), atol=1e-8)
    np.testing.assert_allclose(solution.cost, np.asarray(value).sum(), rtol=1e-9)


def test_the_cost_gradient_by_the_adjoint_is_that_of_finite_differences() -> None:
    system = CartPole()
    planner = ILQR(system=system, horizon=12, terminal_cost=lambda s: 3.0 * (s**2).sum(-1))
    start, actions = swing_up_problem(1, 12)

    def roll_out(u: np.ndarray) -> tuple[np.ndarray, float]:
        path = _path(system, start, u)
        return path, float(planner.cost(path, u)[0])

    path, _ = roll_out(actions)
    a, b = linearise(system, path[0, :-1], actions[0])
    slope, _ = expand_cost(system.stage_cost, path[0, :-1], actions[0])
    costate, adjoint = 6.0 * path[0, -1], np.empty(12)
    for t in reversed(range(12)):
        adjoint[t] = (slope[t, 4:] + b[t].T @ costate)[0]
        costate = slope[t, :4] + a[t].T @ costate
    numeric = np.empty(12)
    for t in range(12):
        bump = np.zeros_like(actions)
        bump[:, t] = 1e-5
        numeric[t] = (roll_out(actions + bump)[1] - roll_out(actions - bump)[1]) / 2e-5
    np.testing.assert_allclose(adjoint, numeric, rtol=1e-6, atol=1e-6)  # rounding of J (about 1e2) over 1e-5


def test_a_solution_is_stationary() -> None:
    system = CartPole()
    start = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -0.3, 0.0]])
    planner = ILQR(system=system, horizon=30, tolerance=1e-9, max_iterations=150)
    solution = planner.solve(start)
    assert solution.converged.all()

    def cost(actions: np.ndarray) -> np.ndarray:
        return planner.cost(_path(system, start, actions), actions)

    np.testing.assert_allclose(cost(solution.actions), solution.cost, rtol=1e-12)
    gradient = np.empty((2, 30))
    for t in range(30):
        bump = np.zeros((2, 30, 1))
        bump[:, t] = 1e-4
        gradient[:, t] = (cost(solution.actions + bump) - cost(solution.actions - bump)) / 2e-4
    # An expected gain g^2 / (2 H) below 1e-9 J, with J of about 100 and H of about 10, leaves g of about 1e-3.
    np.testing.assert_allclose(gradient, 0.0, atol=5e-3)


def test_with_limits_a_convex_problem_is_solved_as_by_bounded_least_squares(cart_class: Any) -> None:
    system = cart_class(dt=0.4, limit=1.0)
    start = np.array([[3.0, 0.0], [-2.0, 2.0], [0.1, 0.0]])
    solution = ILQR(system=system, horizon=25, tolerance=1e-12).solve(start)
    assert solution.converged.all()
    responses = [_path(system, np.zeros((1, 2)), u.reshape(1, 25, 1))[0, :-1].ravel() for u in np.eye(25)]
    matrix = np.concatenate([np.array(responses).T, np.sqrt(0.5) * np.eye(25)])
    for row in range(3):
        free = _path(system, start[row : row + 1], np.zeros((1, 25, 1)))[0, :-1].ravel()
        exact = lsq_linear(matrix, -np.concatenate([free, np.zeros(25)]), (-1.0, 1.0), tol=1e-14)
        np.testing.assert_allclose(
            solution.actions[row, :, 0], exact.x, atol=1e-4
        )  # lsq_linear's own accuracy
        np.testing.assert_allclose(solution.cost[row], 2.0 * exact.cost, rtol=1e-8)
    held = np.abs(solution.actions) == 1.0
    assert held[:2].any(axis=(1, 2)).all()
    assert not held[2].any()
    np.testing.assert_array_equal(solution.gains[held], 0.0)


def test_the_cost_never_increases_and_the_limits_hold() -> None:
    system = CartPole()
    start, actions = swing_up_problem(6, 40)
    costs = []
    for iterations in (1, 2, 3, 5, 8, 13, 21):
        solution = ILQR(system=system, horizon=40, max_iterations=iterations).solve(start, actions)
        assert (np.abs(solution.actions) <= system.max_force).all()
        costs.append(solution.cost)
    assert (np.diff(costs, axis=0) <= 0).all()
    assert (costs[-1] < 0.95 * costs[0]).all(), "and it does fall"


def test_the_first_guess_is_clipped_to_the_limits() -> None:
    start, actions = swing_up_problem(2, 5)
    planner = ILQR(system=CartPole(), horizon=5, max_iterations=1)
    huge, clipped = (
        planner.solve(start, f(actions)) for f in (lambda u: 1e3 * u, lambda u: 10.0 * np.sign(u))
    )
    np.testing.assert_array_equal(huge.actions, clipped.actions)


def test_limits_of_two_actions_hold_and_bind(linear_class: Any) -> None:
    start = 2.0 * np.random.default_rng(0).normal(size=(5, 3))
    free = ILQR(system=linear_class(), horizon=20).solve(start)
    bound = ILQR(system=linear_class(limit=0.5), horizon=20, tolerance=1e-9).solve(start)
    assert (np.abs(bound.actions) <= 0.5).all()
    assert (np.abs(bound.actions) == 0.5).any()
    assert bound.converged.all()
    assert (bound.cost > free.cost).all(), "the limits cost something"
    held = np.abs(bound.actions) == 0.5
    np.testing.assert_array_equal(bound.gains[held], 0.0)


def test_a_plan_does_not_depend_on_the_rest_of_the_batch() -> None:
    start, actions = swing_up_problem(5, 30)
    planner = ILQR(system=CartPole(), horizon=30, max_iterations=25)
    together = planner.solve(start, actions)
    for i in (0, 3):
        alone = planner.solve(start[i : i + 1], actions[i : i + 1])
        # Vectorised sines may round the last bit differently at other places of an array.
        np.testing.assert_allclose(alone.actions[0], together.actions[i], atol=1e-6)
        np.testing.assert_allclose(alone.cost[0], together.cost[i], rtol=1e-9)


def test_a_warm_start_with_its_gains_is_taken_as_it_is() -> None:
    start, actions = swing_up_problem(2, 30)
    planner = ILQR(system=CartPole(), horizon=30, max_iterations=200)
    first = planner.solve(start, actions)
    again = planner.solve(start, first.actions, first.gains, first.states)
    assert (again.iterations <= 2).all()
    np.testing.assert_allclose(again.cost, first.cost, rtol=1e-5)
    nearby = start + 0.02
    followed = planner.solve(nearby, first.actions, first.gains, first.states)
    one_pass = ILQR(system=CartPole(), horizon=30, max_iterations=1)
    assert (
        one_pass.solve(nearby, first.actions, first.gains, first.states).cost
        <= one_pass.solve(nearby, first.actions).cost + 1e-9
    ).all()
    assert np.isfinite(followed.cost).all()


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e9])
def test_roll_outs_that_diverge_are_refused_by_the_line_search(linear_class: Any, poison: float) -> None:
    refused = []

    class Fragile(linear_class):  # type: ignore[misc]
        def flow(self, state: Any, action: Any) -> Any:
            after = super().flow(state, action)
            if isinstance(after, np.ndarray):  # any action above 0.5 blows up what the planner rolls out
                breaks = (np.abs(action) > 0.5).any(axis=-1)
                refused.append(breaks.any())
                after[breaks] = poison
            return after

    start = np.array([[1.2, -0.5, 0.8], [0.1, 0.0, 0.0]])
    planner = ILQR(system=Fragile(), horizon=10)
    nothing = planner.cost(_path(linear_class(), start, np.zeros((2, 10, 2))), np.zeros((2, 10, 2)))
    solution = planner.solve(start)
    assert any(refused)
    assert (solution.cost < 0.95 * nothing).all(), "smaller steps were taken instead"
    assert (np.abs(solution.actions) <= 0.5).all()
    for values in (solution.states, solution.gains):
        assert (np.abs(values) < 1e3).all()


def test_a_first_roll_out_that_diverges_is_an_error_that_names_the_problem(linear_class: Any) -> None:
    start = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match=r"first roll-out of problem 1 diverges.*pass initial_actions"):
        ILQR(system=linear_class(curl=1.0), horizon=20).solve(start)


def test_bad_input_says_what_was_expected() -> None:
    with pytest.raises(ValueError, match="expected horizon above 0, got 0"):
        ILQR(system=Pendulum(), horizon=0)
    with pytest.raises(ValueError, match="expected tolerance above 0"):
        ILQR(system=Pendulum(), horizon=3, tolerance=-1.0)
    planner = ILQR(system=Pendulum(), horizon=3)
    with pytest.raises(ValueError, match=r"expected initial_state as \(b, 2\), got shape \(2,\)"):
        planner.solve(np.zeros(2))
    with pytest.raises(ValueError, match=r"expected initial_actions as \(4, 3, 1\), got shape \(4, 2, 1\)"):
        planner.solve(np.zeros((4, 2)), np.zeros((4, 2, 1)))
    with pytest.raises(ValueError, match="initial_actions of problem 2 is not finite"):
        planner.solve(
            np.zeros((4, 2)), np.where(np.arange(4)[:, None, None] == 2, np.nan, np.zeros((4, 3, 1)))
        )
    with pytest.raises(ValueError, match="initial_state of problem 1 is not finite"):
        planner.solve(np.array([[0.0, 0.0], [np.nan, 0.0]]))
    with pytest.raises(ValueError, match="belong together"):
        planner.solve(np.zeros((1, 2)), initial_gains=np.zeros((1, 3, 1, 2)))
    with pytest.raises(ValueError, match=r"expected initial_states as \(1, 3, 2\)"):
        planner.solve(np.zeros((1, 2)), initial_gains=np.zeros((1, 3, 1, 2)), initial_states=np.zeros((1, 2)))
