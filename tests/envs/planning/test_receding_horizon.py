"""iLQR on learned models and receding-horizon control: against Riccati's recursion, finite differences of the cost and
the same controller one copy at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from array_api_compat import array_namespace

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.planning.ilqr import ILQR
from beliefgym.envs.planning.learned_model import LearnedModel
from beliefgym.envs.planning.model_lqr import LinearQuadraticProblem, ModelWarning, terminal_cost_of
from beliefgym.envs.planning.receding_horizon import RecedingHorizon
from beliefgym.learning import DataAsDemonstrator, PolynomialRidge, RandomFourierRidge, Sequences

TURN = 2.0 * np.pi


def learned(
    system: Any, regressor: Any, spread: float = 1.0, angles: Any = None, n: int = 600
) -> LearnedModel:
    """A model of single steps from all over the place."""
    rng = np.random.default_rng(0)
    low, high = system.action_limits
    x = np.empty((n, 2, system.n_state))
    x[:, 0] = spread * rng.normal(size=(n, system.n_state))
    u = rng.uniform(np.maximum(low, -3.0), np.minimum(high, 3.0), (n, 1, system.n_action))
    x[:, 1] = system.flow(x[:, 0], u[:, 0])
    dynamics = DataAsDemonstrator(regressor, n_iterations=0, angles=angles)
    dynamics.fit(Sequences.from_observations(x, actions=u))
    return LearnedModel(dynamics, (low, high), system.stage_cost)


def run(policy: RecedingHorizon, system: Any, start: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States (steps + 1, n, d) and actions (steps, n, m) of the closed loop on a system."""
    memory = policy.begin(len(start))
    states, actions = [start], []
    for t in range(steps):
        actions.append(policy.act(states[-1], memory, np.full(len(start), t == 0)))
        states.append(system.flow(states[-1], actions[-1]))
    return np.stack(states), np.stack(actions)


def test_ilqr_on_a_linear_system_reaches_lqrs_solution_in_one_pass(linear_class: Any) -> None:
    system = linear_class()
    model = learned(system, PolynomialRidge(degree=1, alpha=0.0))
    start, rng = np.array([[1.0, -2.0, 0.5]]), np.random.default_rng(1)
    target = np.array([0.4, -0.3, 0.2]), np.array([0.1, -0.2])  # not an equilibrium, not the cheapest point

    def terminal(state: Any) -> Any:
        xp = array_namespace(state)
        return model.stage_cost(state, xp.zeros((*state.shape[:-1], 2), dtype=state.dtype))

    problem = LinearQuadraticProblem.at(model, *target)
    gains, offsets, _ = problem.finite_horizon(20)
    state, path, actions = start[0], [start[0]], []
    for t in range(20):
        actions.append(target[1] - offsets[t] - gains[t] @ (state - target[0]))
        state = system.flow(state[None], actions[-1][None])[0]
        path.append(state)
    planner = ILQR(system=model, horizon=20, terminal_cost=terminal, max_iterations=1)
    for guess in (None, rng.normal(size=(1, 20, 2))):
        solution = planner.solve(start, guess)
        assert (solution.iterations == 1).all()
        # ridges of 1e-9 and 1e-10 of the curvature are the only differences besides rounding
        np.testing.assert_allclose(solution.gains[0], -gains, atol=1e-6)
        np.testing.assert_allclose(solution.actions[0], actions, atol=1e-6)
        np.testing.assert_allclose(solution.states[0], path, atol=1e-6)
        np.testing.assert_allclose(solution.cost, planner.cost(np.array(path), np.array(actions)), rtol=1e-9)


@pytest.mark.parametrize("with_end", [False, True])
def test_a_plan_on_a_learned_model_is_stationary_inside_the_limits_and_pressed_against_them(
    with_end: bool,
) -> None:
    model = learned(
        CartPole(max_force=4.0),
        RandomFourierRidge(n_frequencies=60, bandwidth=4.0, include_inputs=True, random_state=0),
        angles=(2,),
    )
    end = terminal_cost_of(model, np.zeros(4), np.zeros(1), (2,)) if with_end else None
    start = np.array([[0.1, 0.0, 0.3, -0.2], [0.0, -0.2, -0.2, 0.5]])
    planner = ILQR(system=model, horizon=15, terminal_cost=end, tolerance=1e-10, max_iterations=200)
    solution = planner.solve(start)
    assert solution.converged.all()

    def cost(actions: np.ndarray) -> np.ndarray:
        states = [start]
        for t in range(15):
            states.append(model.flow(states[-1], actions[:, t]))
        return planner.cost(np.stack(states, axis=1), actions)

    np.testing.assert_allclose(cost(solution.actions), solution.cost, rtol=1e-12)
    slope = np.empty((2, 15))
    for t in range(15):
        bump = np.zeros((2, 15, 1))
        bump[:, t] = 1e-5
        slope[:, t] = (cost(solution.actions + bump) - cost(solution.actions - bump)) / 2e-5
    action = solution.actions[..., 0]
    held = np.abs(action) == 4.0
    assert held.any()
    assert not held.all()
    # an expected gain g^2 / (2 H) below 1e-10 J with J of about 1e2 and H of at least 1e-2: g of about 1e-5 and more
    np.testing.assert_allclose(slope[~held], 0.0, atol=1e-3)
    assert (slope[held] * action[held] < 0.0).all(), "beyond the limit it would be cheaper still"
    nothing = cost(np.zeros((2, 15, 1)))
    assert (solution.cost < 0.9 * nothing).all()


def test_the_exact_learned_model_and_the_true_one_give_the_same_plans(linear_class: Any) -> None:
    system = linear_class(limit=0.8, curl=-0.02)  # cubic: in the span of the monomials
    model = learned(system, PolynomialRidge(degree=3, alpha=0.0))
    start = np.array([[1.0, -2.0, 0.5], [0.2, 0.0, -1.0]])
    how: dict[str, Any] = {"horizon": 12, "hold": 3, "candidates": 4}
    by_truth = run(RecedingHorizon(model=system, **how), system, start, 8)
    by_model = run(RecedingHorizon(model=model, **how), system, start, 8)
    assert (np.abs(by_truth[1]) == 0.8).any()
    # noise-free fit to 1e-12; where iLQR stops within its tolerance of 1e-4 is the same to about its square root
    np.testing.assert_allclose(by_model[1], by_truth[1], atol=1e-5)
    np.testing.assert_allclose(by_model[0], by_truth[0], atol=1e-5)


STARTS = np.array(
    [[0.0, 0.0, np.pi, 0.0], [0.3, 0.0, 2.5, 1.0], [0.0, 0.5, 0.2, 0.0], [-0.5, 0.0, -3.0, -2.0]]
)


def swing_up(**how: Any) -> RecedingHorizon:
    settings: dict[str, Any] = {"horizon": 30, "candidates": 4, "iterations": 20, "angles": (2,), "again": 2}
    return RecedingHorizon(model=CartPole(), **(settings | how))


@pytest.mark.parametrize("every", [1, 3, 30])
def test_n_copies_act_as_one_by_one(every: int) -> None:
    policy, system = swing_up(every=every, iterations=8), CartPole()
    together = run(policy, system, STARTS, 7)[1]
    for i in range(len(STARTS)):
        alone = run(policy, system, STARTS[i : i + 1], 7)[1]
        # vectorised sines may round the last bit otherwise elsewhere in an array; iterations amplify it
        np.testing.assert_allclose(alone[:, 0], together[:, i], atol=1e-5)


def test_a_copy_that_begins_anew_forgets_its_plan_and_leaves_the_others_theirs() -> None:
    policy, system = swing_up(every=5, iterations=8), CartPole()
    plain = policy.begin(4)
    state = STARTS
    for t in range(3):
        action = policy.act(state, plain, np.full(4, t == 0))
        state = system.flow(state, action)
    before = plain.actions.copy()
    state[1] = STARTS[0]
    with_restart = policy.act(state, plain, np.array([False, True, False, False]))
    np.testing.assert_array_equal(plain.actions[[0, 2, 3]], before[[0, 2, 3]])
    np.testing.assert_array_equal(plain.clock, [4, 1, 4, 4])
    fresh = policy.act(STARTS[:1], policy.begin(1), np.ones(1, dtype=bool))
    np.testing.assert_allclose(with_restart[1], fresh[0], atol=1e-5)  # rounding, amplified by iterations


def test_a_whole_turn_of_the_state_changes_no_action() -> None:
    policy, system = swing_up(every=2, iterations=8, horizon=20), CartPole()
    memories = [policy.begin(2), policy.begin(2)]
    state = STARTS[:2]
    turn = np.array([0.0, 0.0, TURN, 0.0])
    for t in range(6):
        begun = np.full(2, t == 0)
        here = policy.act(state, memories[0], begun)
        # as an encoder would show it: wrapped at some steps, a turn more at others
        there = policy.act(state + (t % 3 - 1) * turn, memories[1], begun)
        np.testing.assert_allclose(
            there, here, atol=1e-5
        )  # 1e-15 of rounding a turn, amplified by iterations
        state = system.flow(state, here)


def test_between_plans_the_plan_is_tracked_by_its_gains() -> None:
    policy = swing_up(every=4, iterations=8, horizon=20)
    memory = policy.begin(1)
    policy.act(STARTS[1:2], memory, np.ones(1, dtype=bool))
    planned, actions, gains = memory.states[0].copy(), memory.actions[0].copy(), memory.gains[0].copy()
    for t in range(1, 4):
        state = planned[t] + np.array([0.01, 0.0, -0.02 + TURN, 0.05])
        found = policy.act(state[None], memory, np.zeros(1, dtype=bool))[0]
        deviation = np.array([0.01, 0.0, -0.02, 0.05])
        expected = np.clip(actions[t] + gains[t] @ deviation, -10.0, 10.0)
        np.testing.assert_allclose(found, expected, atol=1e-10)  # rounding of the turn
        np.testing.assert_array_equal(memory.actions[0], actions)
    policy.act(planned[4][None], memory, np.zeros(1, dtype=bool))
    assert memory.clock[0] == 1, "the fourth step later it plans anew"
    assert not np.array_equal(memory.actions[0], actions)


def test_the_rest_of_the_old_plan_and_then_nothing_is_the_next_ones_first_guess(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy = swing_up(every=3, iterations=8, horizon=20, terminal_cost=lambda s: 50.0 * (s * s).sum(-1))
    memory, nowhere = policy.begin(1), np.zeros(1, dtype=bool)
    for _ in range(3):
        policy.act(STARTS[1:2], memory, ~memory.planned)
    states, actions, gains = memory.states.copy(), memory.actions.copy(), memory.gains.copy()
    assert abs(actions[0, -1, 0]) > 0.1, "the old plan acts to its end"
    given: list[Any] = []
    solve = ILQR.solve

    def noted(self: ILQR, *arguments: Any, **how: Any) -> Any:
        given.append(arguments)
        return solve(self, *arguments, **how)

    monkeypatch.setattr(ILQR, "solve", noted)
    policy.act(STARTS[1:2], memory, nowhere)
    ((_, guess, feedback, reference),) = given
    np.testing.assert_array_equal(guess[:, :17], actions[:, 3:])
    np.testing.assert_array_equal(guess[:, 17:], 0.0)
    np.testing.assert_array_equal(feedback[:, :17], gains[:, 3:])
    np.testing.assert_array_equal(reference[:, :17], states[:, 3:20])


def test_a_plan_of_one_episode_is_followed_to_its_end_and_made_anew_there() -> None:
    policy = swing_up(every=99, horizon=6, hold=2, iterations=3)
    memory, state = policy.begin(1), STARTS[2:3]
    clocks = []
    for t in range(9):
        action = policy.act(state, memory, np.full(1, t == 0))
        clocks.append(int(memory.clock[0]))
        state = CartPole().flow(state, action)
    assert clocks == [1, 2, 3, 4, 5, 6, 1, 2, 3]


def test_the_cart_pole_is_swung_up_on_its_true_model() -> None:
    states, actions = run(swing_up(horizon=40), CartPole(), STARTS[:1], 70)
    end = states[-1, 0]
    # 3.5 s after hanging: what a horizon of 2 s leaves of position and speed
    assert np.cos(end[2]) > 0.99
    assert abs(end[3]) < 0.5
    assert np.abs(actions).max() <= 10.0


def test_planning_again_never_costs_more_than_following_the_plan() -> None:
    """On its own model, with no disturbance, each new plan starts from the rest of the old one and improves it."""
    system, horizon = Pendulum(), 25
    followed = RecedingHorizon(model=system, horizon=horizon, every=horizon, angles=(0,), iterations=30)
    again = RecedingHorizon(model=system, horizon=horizon, every=1, angles=(0,), iterations=30)
    start = np.array([[np.pi, 0.0], [1.0, 1.0]])
    costs = [
        system.stage_cost(states[:-1], actions).sum(axis=0)
        for states, actions in (run(policy, system, start, 60) for policy in (followed, again))
    ]
    assert (costs[1] <= costs[0] + 1e-3).all()


class Breaking:
    """A double integrator that returns NaN beyond |p| = 1, as a learned model far from its data may."""

    n_state, n_action = 2, 1
    action_limits = np.array([-1.0]), np.array([1.0])

    def flow(self, state: Any, action: Any) -> Any:
        xp = array_namespace(state)
        p, v, u = state[..., 0], state[..., 1], action[..., 0]
        moved = xp.stack([p + 0.1 * v, v + 0.1 * u], axis=-1)
        return xp.where((xp.abs(p) > 1.0)[..., None], moved * float("nan"), moved)

    def derivatives(self, state: Any, action: Any) -> Any:
        a, b = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
        return np.tile(a, (*state.shape[:-1], 1, 1)), np.tile(b, (*state.shape[:-1], 1, 1))

    def stage_cost(self, state: Any, action: Any) -> Any:
        return state[..., 0] ** 2 + 0.1 * state[..., 1] ** 2 + 0.01 * action[..., 0] ** 2

    def clip(self, action: Any) -> Any:
        return np.clip(action, *self.action_limits)


@pytest.mark.parametrize("candidates", [1, 5])
def test_where_the_model_breaks_down_the_actions_are_finite_and_other_copies_are_served(
    candidates: int,
) -> None:
    policy = RecedingHorizon(model=Breaking(), horizon=15, hold=3, candidates=candidates, iterations=10)
    # healthy; lost at once; heading out, but it can be stopped; lost whatever is done
    start = np.array([[0.5, 0.0], [3.0, 0.0], [0.5, 0.6], [0.9, 9.0]])
    memory = policy.begin(4)
    lost = 2 if candidates > 1 else 3
    with pytest.warns(
        ModelWarning, match=rf"every first guess diverges under the model from {lost} of 4 states"
    ):
        first = policy.act(start, memory, np.ones(4, dtype=bool))
    assert np.isfinite(first).all()
    np.testing.assert_array_equal(first[[1, 3]], 0.0)  # every plan diverges: nothing is done
    alone = policy.act(start[:1], policy.begin(1), np.ones(1, dtype=bool))
    np.testing.assert_allclose(first[:1], alone, atol=1e-9)  # rounding
    assert first[0, 0] < 0.0
    if candidates > 1:
        assert first[2, 0] < 0.0, "the tree finds the braking that doing nothing does not"
    for state in (start, start[::-1].copy(), np.full((4, 2), 50.0)):  # planning again, there and elsewhere
        with pytest.warns(ModelWarning, match="nothing is done there until a plan is found"):
            found = policy.act(state, memory, np.zeros(4, dtype=bool))
        assert np.isfinite(found).all()
        assert (np.abs(found) <= 1.0).all()
    back = policy.act(np.tile(start[0], (4, 1)), memory, np.zeros(4, dtype=bool))
    assert (back < 0.0).all(), "back where the model holds, it plans again"


def test_ilqr_leaves_a_diverged_problem_as_it_is_and_goes_on_with_the_others() -> None:
    start = np.array([[3.0, 0.0], [0.5, 0.0]])
    planner = ILQR(system=Breaking(), horizon=10)
    with pytest.raises(ValueError, match="first roll-out of problem 0 diverges"):
        planner.solve(start)
    solution = planner.solve(start, allow_divergence=True)
    assert solution.cost[0] == np.inf
    assert not solution.converged[0]
    alone = planner.solve(start[1:])
    np.testing.assert_allclose(solution.actions[1], alone.actions[0], atol=1e-9)  # rounding
    np.testing.assert_allclose(solution.cost[1], alone.cost[0], rtol=1e-12)
    nothing_left = planner.solve(start[:1], allow_divergence=True)
    assert nothing_left.cost[0] == np.inf


def test_a_cubic_model_that_explodes_gives_finite_actions() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(300, 2, 2)), rng.uniform(-1.0, 1.0, (300, 1, 1))
    x[:, 1] = x[:, 0] + 5.0 * x[:, 0, ::-1] ** 3 + u[:, 0]
    dynamics = DataAsDemonstrator(PolynomialRidge(degree=3), n_iterations=0).fit(
        Sequences.from_observations(x, actions=u)
    )
    limits = np.array([-1.0]), np.array([1.0])
    model = LearnedModel(dynamics, limits, lambda s, a: (s**2).sum(-1) + (a**2).sum(-1))
    policy = RecedingHorizon(model=model, horizon=20, candidates=4, iterations=5)
    memory = policy.begin(3)
    for state in (np.array([[0.01, 0.0], [2.0, -3.0], [1e3, 1e3]]), np.full((3, 2), 1e5)):
        with pytest.warns(ModelWarning, match="every first guess diverges"):
            found = policy.act(state, memory, np.full(3, not memory.planned.any()))
        assert np.isfinite(found).all()
        assert (np.abs(found) <= 1.0).all()


def test_with_several_actions_random_shots_are_the_first_guesses(linear_class: Any) -> None:
    system = linear_class(limit=1.0)
    start = np.array([[2.0, -1.0, 2.0], [0.1, 0.0, 0.0]])
    policy = RecedingHorizon(model=system, horizon=10, hold=2, candidates=3, iterations=1)
    guesses = policy._guesses(start)
    assert guesses.shape == (2, 3, 10, 2)
    np.testing.assert_array_equal(guesses[:, 0], 0.0)
    assert (np.abs(guesses) <= 1.0).all()
    np.testing.assert_array_equal(guesses[:, :, 0::2], guesses[:, :, 1::2])  # each is held for two steps
    costs = np.empty((2, 3))
    for i in range(3):
        state, total = start, np.zeros(2)
        for t in range(10):
            total += system.stage_cost(state, guesses[:, i, t])
            state = system.flow(state, guesses[:, i, t])
        costs[:, i] = total + 10.0 * system.stage_cost(state, np.zeros((2, 2)))
    assert (costs[0, 1:] < costs[0, 0]).all(), "far off, the best of 2048 beat doing nothing"
    assert (np.diff(costs[:, 1:], axis=1) >= 0.0).all(), "best first"


@pytest.mark.parametrize("name", ["horizon", "hold", "candidates", "iterations", "again", "every"])
def test_numbers_below_one_raise(name: str) -> None:
    with pytest.raises(ValueError, match=f"expected {name} of at least 1, got 0"):
        swing_up(**{name: 0})
