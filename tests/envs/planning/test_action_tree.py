"""The tree against rolling out every plan by itself."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.planning.action_tree import tree_search


def terminal(state: Any) -> Any:
    return 3.0 * (state**2).sum(-1)


def every_plan(system: Any, start: np.ndarray, hold: int, depth: int) -> dict[tuple[Any, ...], float]:
    """Costs of all plans of up to `depth` held actions, by plain loops."""
    low, high = system.action_limits
    levels = list(product(*zip(low, 0.5 * (low + high), high, strict=True)))
    costs = {}
    for length in range(depth + 1):
        for plan in product(levels, repeat=length):
            state, cost = start, 0.0
            for action in plan:
                for _ in range(hold):
                    cost += float(system.stage_cost(state, np.array(action)))
                    state = system.flow(state, np.array(action))
            costs[plan] = cost + float(terminal(state))
    return costs


@pytest.mark.parametrize("hold", [1, 3])
def test_the_best_plans_are_those_of_all(linear_class: Any, hold: int) -> None:
    system = linear_class(limit=0.4)
    start = np.array([[0.5, -0.2, 0.1], [0.0, 0.0, 0.0], [-1.0, 1.0, 0.3]])
    found = tree_search(
        system, start, hold=hold, depth=2, stage_cost=system.stage_cost, terminal_cost=terminal, keep=5
    )
    assert found.actions.shape == (3, 5, 2 * hold, 2)
    for row in range(3):
        costs = every_plan(system, start[row], hold, 2)
        np.testing.assert_allclose(found.costs[row], sorted(costs.values())[:5], rtol=1e-12)
        for actions, length, cost in zip(
            found.actions[row], found.lengths[row], found.costs[row], strict=True
        ):
            plan = tuple(tuple(u) for u in actions[:length:hold])
            assert costs[plan] == pytest.approx(cost, rel=1e-12)
            np.testing.assert_array_equal(actions[length:], 0.0)
            np.testing.assert_array_equal(actions[:length], np.repeat(actions[:length:hold], hold, axis=0))
    assert found.lengths[1, 0] == 0, "at rest the best is to do nothing"


def test_chunks_and_other_rows_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    system = CartPole()
    start = np.random.default_rng(0).normal(size=(5, 4))

    def search(rows: np.ndarray) -> Any:
        return tree_search(
            system, rows, hold=3, depth=4, stage_cost=system.stage_cost, terminal_cost=terminal, keep=3
        )

    together = search(start)
    monkeypatch.setattr(sys.modules[tree_search.__module__], "LEAVES_AT_ONCE", 2 * 3**4)
    chunked = search(start)
    np.testing.assert_array_equal(together.actions, chunked.actions)
    np.testing.assert_array_equal(search(start[3:4]).actions[0], together.actions[3])


def test_bad_input_says_what_was_expected(linear_class: Any) -> None:
    arguments: dict[str, Any] = {
        "hold": 1,
        "depth": 1,
        "stage_cost": lambda s, u: 0.0,
        "terminal_cost": terminal,
    }
    with pytest.raises(ValueError, match="tree_search needs finite action limits"):
        tree_search(linear_class(), np.zeros((1, 3)), keep=1, **arguments)
    with pytest.raises(ValueError, match="expected keep of at most 10, the number of nodes, got 11"):
        tree_search(linear_class(limit=1.0), np.zeros((1, 3)), keep=11, **arguments)
