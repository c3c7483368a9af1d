"""Learned models in the planners' form, and regulators from a model: against Riccati solvers, dense quadratic programs
and the cost of rollouts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from array_api_compat import array_namespace
from scipy.linalg import solve_discrete_are

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.planning.learned_model import LearnedModel, PlanningModel
from beliefgym.envs.planning.linearisation import linearise
from beliefgym.envs.planning.model_lqr import (
    LinearFeedback,
    LinearQuadraticProblem,
    ModelWarning,
    QuadraticDeviation,
    cheapest_point,
    terminal_cost_of,
    wrapped_difference,
)
from beliefgym.learning import DataAsDemonstrator, PolynomialRidge, RandomForest, Ridge, Sequences

TURN = 2.0 * np.pi


@dataclass
class Affine:
    """x' = A x + B u + c with the cost z'W z / 2 + w'z of z = (x, u), on numpy and torch."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    weight: np.ndarray
    slope: np.ndarray
    limit: float = np.inf
    action_limits: Any = field(init=False)

    def __post_init__(self) -> None:
        self.n_state, self.n_action = self.b.shape
        self.action_limits = np.full(self.n_action, -self.limit), np.full(self.n_action, self.limit)

    @classmethod
    def random(cls, n: int = 4, m: int = 2, seed: int = 0, affine: float = 1.0) -> Affine:
        """Open-loop unstable, with all cross terms, and a target (0, 0) that neither holds itself nor is cheapest."""
        rng = np.random.default_rng(seed)
        a = rng.normal(size=(n, n))
        root = rng.normal(size=(n + m, n + m))
        return cls(
            1.1 * a / np.abs(np.linalg.eigvals(a)).max(),
            rng.normal(size=(n, m)),
            affine * rng.normal(size=n),
            root @ root.T + 0.1 * np.eye(n + m),
            affine * rng.normal(size=n + m),
        )

    def flow(self, state: Any, action: Any) -> Any:
        xp = array_namespace(state)
        return state @ xp.asarray(self.a.T) + action @ xp.asarray(self.b.T) + xp.asarray(self.c)

    def stage_cost(self, state: Any, action: Any) -> Any:
        xp = array_namespace(state)
        z = xp.concat([state, action], axis=-1) if xp is not np else np.concatenate([state, action], axis=-1)
        return 0.5 * ((z @ xp.asarray(self.weight)) * z).sum(-1) + z @ xp.asarray(self.slope)

    def clip(self, action: Any) -> Any:
        return np.clip(action, *self.action_limits)

    def run(self, start: np.ndarray, policy: LinearFeedback, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """States (steps + 1, n) and actions (steps, m) of the closed loop."""
        states, actions, memory = [start], [], policy.begin(1)
        for t in range(steps):
            actions.append(policy.act(states[-1][None], memory, np.array([t == 0]))[0])
            states.append(self.flow(states[-1], actions[-1]))
        return np.stack(states), np.stack(actions)


def at_origin(model: Any) -> LinearQuadraticProblem:
    return LinearQuadraticProblem.at(model, np.zeros(model.n_state), np.zeros(model.n_action))


def regulator(model: Any, horizon: int | None = None) -> LinearFeedback:
    zero = np.zeros(model.n_state), np.zeros(model.n_action)
    return LinearFeedback.of(model, *zero, horizon=horizon)


# ------------------------------------------------------------------------------------------------------ learned models


def recording(model: Affine, steps: int = 40) -> Sequences:
    rng = np.random.default_rng(1)
    u = rng.normal(size=(5, steps, model.n_action))
    x = rng.normal(size=(5, steps + 1, model.n_state))
    for t in range(steps):
        x[:, t + 1] = model.flow(x[:, t], u[:, t])
        x[:, t + 1] /= np.maximum(1.0, np.abs(x[:, t + 1]).max(axis=1, keepdims=True) / 1e3)
    return Sequences.from_observations(x[:, :8], actions=u[:, :7])


@pytest.mark.parametrize("regressor", [Ridge(alpha=1e-14), PolynomialRidge(degree=2, alpha=1e-14)], ids=str)
def test_a_model_learned_from_a_linear_system_has_its_matrices(regressor: Any) -> None:
    truth = Affine.random()
    dynamics = DataAsDemonstrator(regressor, n_iterations=0).fit(recording(truth))
    model = LearnedModel(dynamics, truth.action_limits, truth.stage_cost)
    assert isinstance(model, PlanningModel)
    assert (model.n_state, model.n_action) == (4, 2)
    a, b = linearise(model, np.zeros((3, 2, 4)), np.ones((3, 2, 2)))
    # noise-free data: the ridge of 1e-14 and rounding, times the data's condition of about 1e3
    np.testing.assert_allclose(a, np.broadcast_to(truth.a, (3, 2, 4, 4)), atol=1e-6)
    np.testing.assert_allclose(b, np.broadcast_to(truth.b, (3, 2, 4, 2)), atol=1e-6)
    x, u = np.ones((3, 2, 4)), np.full((3, 2, 2), 0.5)
    np.testing.assert_allclose(model.flow(x, u), truth.flow(x, u), atol=1e-6)
    np.testing.assert_array_equal(model.stage_cost(x, u), truth.stage_cost(x, u))
    # and so its regulator is that of the system
    for found, expected in zip(at_origin(model).steady_state(), at_origin(truth).steady_state(), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_a_learned_model_clips_and_hands_on_its_difference_step() -> None:
    truth = Affine.random(n=1, m=1)
    rng = np.random.default_rng(2)
    x, u = rng.uniform(-1, 1, (500, 2, 1)), rng.uniform(-1, 1, (500, 1, 1))
    x[:, 1] = 0.5 * x[:, 0] + u[:, 0]
    dynamics = DataAsDemonstrator(RandomForest(n_estimators=5, random_state=0), n_iterations=0).fit(
        Sequences.from_observations(x, actions=u)
    )
    limits = np.array([-0.3]), np.array([0.2])
    wide = LearnedModel(dynamics, limits, truth.stage_cost, difference_step=0.5)
    narrow = LearnedModel(dynamics, limits, truth.stage_cost, difference_step=1e-6)
    np.testing.assert_array_equal(wide.clip(np.array([[-1.0], [0.1], [9.0]])), [[-0.3], [0.1], [0.2]])
    zero = np.zeros((1, 1)), np.zeros((1, 1))
    assert wide.derivatives(*zero)[1].item() == pytest.approx(1.0, rel=0.3)  # the slope, by few leaves
    assert abs(narrow.derivatives(*zero)[1].item()) < 1e-6, "within one leaf"


# ------------------------------------------------------------------------------------------------------ the regulator


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_problem_at_a_target_is_the_costs_expansion(seed: int) -> None:
    model = Affine.random(seed=seed)
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=4), rng.normal(size=2)
    found = LinearQuadraticProblem.at(model, x, u)
    z = np.concatenate([x, u])
    slope = model.weight @ z + model.slope
    np.testing.assert_allclose(found.a, model.a, atol=1e-12)  # rounding, here and below
    np.testing.assert_allclose(found.b, model.b, atol=1e-12)
    np.testing.assert_allclose(found.c, model.a @ x + model.b @ u + model.c - x, atol=1e-12)
    np.testing.assert_allclose(found.state_weight, model.weight[:4, :4], atol=1e-10)
    np.testing.assert_allclose(found.action_weight, model.weight[4:, 4:], rtol=1e-7)  # 1e-9 is added
    np.testing.assert_allclose(found.cross_weight, model.weight[:4, 4:], atol=1e-10)
    np.testing.assert_allclose(found.state_slope, slope[:4], atol=1e-10)
    np.testing.assert_allclose(found.action_slope, slope[4:], atol=1e-10)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_steady_state_is_the_riccati_equations_with_cross_terms(seed: int) -> None:
    problem = at_origin(Affine.random(seed=seed))
    gain, _, p = problem.steady_state()
    a, b, n = problem.a, problem.b, problem.cross_weight
    expected = solve_discrete_are(a, b, problem.state_weight, problem.action_weight, s=n)
    np.testing.assert_allclose(p, expected, rtol=1e-8)  # of two solvers
    h = problem.action_weight + b.T @ expected @ b
    np.testing.assert_allclose(gain, np.linalg.solve(h, b.T @ expected @ a + n.T), rtol=1e-7, atol=1e-9)
    assert np.abs(np.linalg.eigvals(a - b @ gain)).max() < 1.0


def test_lqr_cost_equals_half_x_p_x_on_rollouts(linear_class: Any) -> None:
    crossed = Affine.random(affine=0.0)
    for model, start in (
        (crossed, np.array([1.0, -2.0, 0.5, 3.0])),
        (linear_class(), np.array([1.0, 2.0, -1.0])),
    ):
        policy, p = regulator(model), at_origin(model).steady_state()[2]
        states, actions = Affine.run(model, start, policy, 400)
        assert np.abs(states[-1]).max() < 1e-8
        total = model.stage_cost(states[:-1], actions).sum()
        # R is raised by 1e-9 of the largest weight; the sum itself is exact after 400 contracting steps
        assert total == pytest.approx(0.5 * start @ p @ start, rel=1e-7)


def dense(model: Affine, horizon: int, last: np.ndarray) -> tuple[np.ndarray, ...]:
    """J(x_0, U) = z'S z / 2 + s'z + const of z = (x_0, u_0, .. u_{T-1}), multiplied out; S, s and the sizes."""
    n, m = model.n_state, model.n_action
    size = n + horizon * m
    reach, shift = np.zeros((n, size)), np.zeros(n)  # x_t = reach z + shift
    reach[:, :n] = np.eye(n)
    curvature, slope = np.zeros((size, size)), np.zeros(size)
    for t in range(horizon):
        both = np.zeros((n + m, size))
        both[:n], both[n:, n + t * m : n + (t + 1) * m] = reach, np.eye(m)
        constant = np.concatenate([shift, np.zeros(m)])
        curvature += both.T @ model.weight @ both
        slope += both.T @ (model.weight @ constant + model.slope)
        reach, shift = model.a @ reach, model.a @ shift + model.c
        reach[:, n + t * m : n + (t + 1) * m] += model.b
    curvature += reach.T @ last @ reach
    slope += reach.T @ (last @ shift + model.slope[:n])
    return curvature, slope


@pytest.mark.parametrize("horizon", [1, 2, 7])
@pytest.mark.parametrize("own_end", [False, True])
def test_a_finite_horizon_is_the_dense_quadratic_program(horizon: int, own_end: bool) -> None:
    model = Affine.random()
    last = 3.0 * np.eye(4) + 1.0 if own_end else model.weight[:4, :4]
    start = np.array([0.5, -1.0, 2.0, 0.3])
    curvature, slope = dense(model, horizon, last)
    by_actions = curvature[4:, 4:]
    best = np.linalg.solve(by_actions, -slope[4:] - curvature[4:, :4] @ start)
    gains, offsets, p = at_origin(model).finite_horizon(horizon, last if own_end else None)
    policy = LinearFeedback(np.zeros(4), np.zeros(2), gains, offsets, model.action_limits)
    _, actions = model.run(start, policy, horizon)
    # R is raised by 1e-9 of the largest weight, and the program's condition is about 1e4
    np.testing.assert_allclose(actions.ravel(), best, rtol=1e-5, atol=1e-5)
    schur = curvature[:4, :4] - curvature[:4, 4:] @ np.linalg.solve(by_actions, curvature[4:, :4])
    np.testing.assert_allclose(p, schur, rtol=1e-6, atol=1e-6)


def test_a_long_horizon_begins_as_the_steady_state() -> None:
    problem = at_origin(Affine.random())
    gain, offset, p = problem.steady_state()
    gains, offsets, first = problem.finite_horizon(300)
    # the recursion contracts by the closed loop's squared radius a step: rounding after 300
    np.testing.assert_allclose(gains[0], gain, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(offsets[0], offset, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(first, p, rtol=1e-6)
    assert np.abs(offsets[-1] - offset).max() > 1e-2, "the end differs"
    policy = regulator(Affine.random(), horizon=300)
    np.testing.assert_array_equal(policy.gains, gains)


def cheapest_equilibrium(model: Affine) -> np.ndarray:
    """(x, u) of lowest cost among those that stay, x = A x + B u + c, from the conditions of Lagrange."""
    n, m = model.n_state, model.n_action
    stays = np.concatenate([model.a - np.eye(n), model.b], axis=1)
    system = np.block([[model.weight, stays.T], [stays, np.zeros((n, n))]])
    return np.linalg.solve(system, np.concatenate([-model.slope, -model.c]))[: n + m]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_for_ever_means_the_lowest_average_cost(seed: int) -> None:
    model = Affine.random(seed=seed)
    policy = regulator(model)
    states, actions = model.run(np.ones(4), policy, 500)
    where = np.concatenate([states[-1], actions[-1]])
    np.testing.assert_allclose(states[-1], states[-2], atol=1e-9)  # it has settled
    # a long-run average is itself an equilibrium, so no policy is below this point's cost; R's 1e-9 moves it
    np.testing.assert_allclose(where, cheapest_equilibrium(model), rtol=1e-5, atol=1e-6)


def test_no_other_offset_has_a_lower_average_cost() -> None:
    model = Affine(
        np.array([[1.1]]),
        np.array([[0.5]]),
        np.array([0.7]),
        np.array([[2.0, 0.3], [0.3, 1.0]]),
        np.array([-1.0, 0.4]),
    )
    policy = regulator(model)
    costs = []
    for change in np.linspace(-1.0, 1.0, 21):
        moved = LinearFeedback(
            policy.target, policy.action, policy.gains, policy.offsets + change, policy.action_limits
        )
        states, actions = model.run(np.zeros(1), moved, 200)
        costs.append(float(model.stage_cost(states[-1:], np.asarray(actions)[-1:])[0]))
    assert int(np.argmin(costs)) == 10, "the middle one: no change"
    assert costs[9] - costs[10] == pytest.approx(
        costs[11] - costs[10], rel=1e-6
    )  # R's 1e-9 shifts the parabola


def test_where_the_target_cannot_be_stabilised_the_warning_says_what_to_do() -> None:
    model = Affine(np.diag([1.2, 0.5]), np.array([[0.0], [1.0]]), np.zeros(2), np.eye(3), np.zeros(3))
    with pytest.warns(
        ModelWarning, match=r"no stabilising regulator .*100\s*steps.*More data near the target"
    ):
        policy = regulator(model)
    assert np.isfinite(policy.gains).all()
    assert np.isfinite(policy.offsets).all()
    # the part that can be moved is regulated as it would be alone
    alone = Affine(np.array([[0.5]]), np.array([[1.0]]), np.zeros(1), np.eye(2), np.zeros(2))
    assert policy.gains[0, 0, 1] == pytest.approx(regulator(alone).gains[0, 0, 0], rel=1e-6)  # of 100 steps


def test_a_cost_that_does_not_see_an_integrator_is_told() -> None:
    model = Affine(np.eye(1), np.eye(1), np.zeros(1), np.diag([0.0, 1.0]), np.zeros(2))
    with pytest.warns(ModelWarning, match="sees every unstable direction"):
        policy = regulator(model)
    np.testing.assert_allclose(policy.gains, 0.0, atol=1e-12)  # nothing to gain by acting


def test_a_wildly_unstable_model_still_gives_finite_gains() -> None:
    model = Affine(np.diag([1e4, 0.5]), np.array([[0.0], [1.0]]), np.ones(2), np.eye(3), np.ones(3))
    with pytest.warns(ModelWarning, match="no stabilising regulator"):
        policy = regulator(model)  # P grows by 1e8 a step and overflows within 40
    assert np.isfinite(policy.gains).all()
    assert np.isfinite(policy.offsets).all()
    memory = policy.begin(2)
    assert np.isfinite(policy.act(np.ones((2, 2)), memory, np.ones(2, dtype=bool))).all()


def test_a_cost_that_curves_down_at_the_target_is_told() -> None:
    hanging = np.array([0.0, 0.0, np.pi, 0.0]), np.zeros(1)
    with pytest.warns(ModelWarning, match="positive semidefinite at the target, got a curvature of -4"):
        problem = LinearQuadraticProblem.at(CartPole(), *hanging)
    np.testing.assert_allclose(
        np.diag(problem.state_weight), [1.0, 0.1, 0.0, 0.1], atol=1e-12
    )  # flat in theta


# ------------------------------------------------------------------------------------------------------ the policy


def test_feedback_takes_angles_the_short_way_and_keeps_to_the_limits() -> None:
    model = CartPole(max_force=10.0)
    policy = LinearFeedback.of(model, np.zeros(4), np.zeros(1), angles=(2,))
    state = np.array([[0.1, 0.0, 0.05, 0.0], [0.1, 0.0, 0.05 + TURN, 0.0], [0.1, 0.0, 0.05 - 2 * TURN, 0.0]])
    actions = policy.act(state, policy.begin(3), np.ones(3, dtype=bool))
    np.testing.assert_allclose(
        actions[1:], np.broadcast_to(actions[:1], (2, 1)), atol=1e-10
    )  # turns' rounding
    assert 0.0 < abs(actions[0, 0]) < 10.0
    far = policy.act(np.array([[0.0, 0.0, 0.9, 8.0]]), policy.begin(1), np.ones(1, dtype=bool))
    assert abs(far.item()) == 10.0
    blind = LinearFeedback.of(model, np.zeros(4), np.zeros(1))
    assert abs(blind.act(state[1:2], blind.begin(1), np.ones(1, dtype=bool)).item()) == 10.0


def test_each_copy_has_its_own_step_and_the_last_gain_stays() -> None:
    gains, offsets = np.arange(1.0, 4.0)[:, None, None], np.array([[0.0], [10.0], [20.0]])
    policy = LinearFeedback(
        np.array([1.0]), np.array([5.0]), gains, offsets, (np.array([-1e3]), np.array([1e3]))
    )
    memory, seen = policy.begin(2), []
    for t in range(5):
        restart = np.array([t == 0, t in (0, 2)])
        seen.append(policy.act(np.array([[2.0], [1.0]]), memory, restart)[:, 0])
    # 5 - k_t - K_t d with d = 1 and d = 0
    np.testing.assert_array_equal(np.array(seen)[:, 0], [4.0, -7.0, -18.0, -18.0, -18.0])
    np.testing.assert_array_equal(np.array(seen)[:, 1], [5.0, -5.0, 5.0, -5.0, -15.0])


def test_differences_of_angles_are_the_short_way_round() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-20.0, 20.0, (2, 100, 3))
    found = wrapped_difference(a, b, (0, 2))
    expected = np.angle(np.exp(1j * (a - b)))
    np.testing.assert_allclose(found[:, [0, 2]], expected[:, [0, 2]], atol=1e-13)  # rounding of 40 rad
    np.testing.assert_array_equal(found[:, 1], a[:, 1] - b[:, 1])


# ------------------------------------------------------------------------------------------------ ends and targets


def test_the_terminal_cost_is_the_regulators_cost_to_go() -> None:
    model = CartPole()
    cost = terminal_cost_of(model, np.zeros(4), np.zeros(1), (2,))
    p = at_origin(model).steady_state()[2]
    near = 1e-3 * np.array([1.0, -2.0, 1.5, 0.5])
    states = [near]
    policy, memory = regulator(model), np.zeros(1, dtype=np.int64)
    total = 0.0
    for _ in range(800):
        action = policy.act(states[-1][None], memory, np.zeros(1, dtype=bool))
        total += float(model.stage_cost(states[-1][None], action)[0])
        states.append(model.flow(states[-1][None], action)[0])
    assert float(cost(near)) == pytest.approx(total, rel=1e-4)  # of second order in deviations of 1e-3
    assert float(cost(near)) == pytest.approx(0.5 * near @ p @ near, rel=1e-12)
    batch = np.stack([near, near + np.array([0.0, 0.0, TURN, 0.0])])
    np.testing.assert_allclose(cost(batch), cost(near), rtol=1e-9)  # a turn's rounding, on 1e-3
    np.testing.assert_allclose(cost(torch.as_tensor(batch)).numpy(), cost(batch), rtol=1e-12)


def test_there_is_no_terminal_cost_where_nothing_can_be_stabilised() -> None:
    model = Affine(np.diag([1.2, 0.5]), np.array([[0.0], [1.0]]), np.zeros(2), np.eye(3), np.zeros(3))
    assert terminal_cost_of(model, np.zeros(2), np.zeros(1)) is None
    assert terminal_cost_of(CartPole(), np.array([0.0, 0.0, np.pi, 0.0]), np.zeros(1)) is None, (
        "not convex there"
    )


def test_a_quadratic_deviation_counts_from_its_target() -> None:
    cost = QuadraticDeviation(np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([1.0, 3.0]), (1,))
    # d = (1, 3.5 - 3 - 0 turns) and (0, -3.2 - 3 + one turn)
    expected = [0.5 * (2.0 + 2 * 0.5 * 0.5 + 0.25), 0.5 * (TURN - 6.2) ** 2]
    np.testing.assert_allclose(cost(np.array([[2.0, 3.5], [1.0, -3.2]])), expected, rtol=1e-12)


def test_the_cheapest_point_of_a_quadratic_is_its_minimum() -> None:
    model = Affine.random()
    x, u = cheapest_point(model.stage_cost, 4, 2)
    best = -np.linalg.solve(model.weight, model.slope)
    np.testing.assert_allclose(
        np.concatenate([x, u]), best, atol=1e-4
    )  # L-BFGS-B's stop, at a condition of 1e2


def test_the_cheapest_action_is_within_its_limits() -> None:
    def cost(x: Any, u: Any) -> Any:
        return (x[..., 0] - u[..., 0]) ** 2 + (u[..., 0] - 5.0) ** 2 + (u[..., 1] + 0.25) ** 2

    limits = np.array([-1.0, -1.0]), np.array([2.0, 1.0])
    x, u = cheapest_point(cost, 1, 2, action_limits=limits)
    np.testing.assert_allclose(x, [2.0], atol=1e-4)  # L-BFGS-B's stop
    np.testing.assert_allclose(u, [2.0, -0.25], atol=1e-4)


def test_the_cheapest_point_of_the_known_systems_is_the_upright() -> None:
    for system in (CartPole(), Pendulum()):
        angle = system.state_names.index("theta")
        x, u = cheapest_point(system.stage_cost, system.n_state, 1, (angle,), system.action_limits)
        np.testing.assert_array_equal(x, np.zeros(system.n_state))  # where the search begins
        np.testing.assert_array_equal(u, [0.0])


def test_half_a_turn_is_tried_for_each_angle() -> None:
    def cost(x: Any, u: Any) -> Any:  # flat at theta = 0, where the slope is 0, and lowest at pi
        xp = array_namespace(x)
        return 2.0 * xp.cos(x[..., 1]) + (x[..., 0] - 1.0) ** 2 + u[..., 0] ** 2

    x, u = cheapest_point(cost, 2, 1, (1,))
    np.testing.assert_allclose(np.abs(x), [1.0, np.pi], atol=1e-4)  # L-BFGS-B's stop
    np.testing.assert_allclose(u, [0.0], atol=1e-4)
    assert cheapest_point(cost, 2, 1)[0][1] == 0.0, "not told of the angle, it stays on the hill"
