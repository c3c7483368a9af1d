"""Global first guesses for a local planner: a tree of held actions.

A local planner such as iLQR needs a first guess in the right valley. Here every sequence of `depth` actions is
tried, each action one of low, middle and high (in each component) and held for `hold` steps. All nodes of the tree
are plans, the root (no action at all) too; a plan of length T is rated by

    sum_{t<T} l(s_t, u_t) + l_T(s_T),

where l_T should say what it costs to go on from s_T with a simple controller. Swinging up is nearly bang-bang, so
three levels are enough. A level of the tree is one batch; common prefixes are computed once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.planning.learned_model import PlanningModel

Floats = NDArray[np.float64]

LEAVES_AT_ONCE = 1 << 16  # bounds the memory: so many leaves are rolled out together


@dataclass(frozen=True)
class TreePlans:
    """The best plans of each row, best first.

    Attributes:
        actions: (b, keep, depth * hold, m); 0 after the plan's end.
        lengths: (b, keep) steps; 0 is the plan to do nothing.
        costs: (b, keep).
    """

    actions: Floats
    lengths: NDArray[np.int64]
    costs: Floats


def tree_search(
    system: PlanningModel,
    state: Floats,
    *,
    hold: int,
    depth: int,
    stage_cost: Callable[[Any, Any], Any],
    terminal_cost: Callable[[Any], Any],
    keep: int,
) -> TreePlans:
    """The `keep` best plans of the tree from each state; a row does not depend on the others.

    Args:
        system: with finite action limits; 3^m branches at each node.
        state: (b, n).
        hold: steps for which an action is held. depth: number of actions.
        stage_cost: (state (..., n), action (..., m)) -> (...). terminal_cost: (state (..., n)) -> (...).
        keep: plans to return.

    Raises:
        ValueError: infinite action limits, or keep beyond the number of nodes.
    """
    low, high = system.action_limits
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"tree_search needs finite action limits, got {low} to {high}")
    levels = np.array(list(product(*np.stack([low, 0.5 * (low + high), high], axis=1))))  # (3^m, m)
    branches = len(levels)
    first = np.cumsum(
        [0] + [branches**d for d in range(depth + 1)]
    )  # first node of each depth; nodes breadth first
    if keep > first[-1]:
        raise ValueError(f"expected keep of at most {first[-1]}, the number of nodes, got {keep}")
    chunk = max(1, LEAVES_AT_ONCE // branches**depth)
    ranked = [
        _rank(system, state[i : i + chunk], levels, hold, depth, stage_cost, terminal_cost, keep)
        for i in range(0, len(state), chunk)
    ]
    nodes, costs = (np.concatenate(parts) for parts in zip(*ranked, strict=True))
    depths = np.searchsorted(first, nodes, side="right") - 1
    index = nodes - first[depths]
    digits = np.stack(
        [index // branches ** np.maximum(depths - d, 0) % branches for d in range(1, depth + 1)], axis=-1
    )
    used = np.arange(1, depth + 1) <= depths[..., None]
    actions = np.where(used[..., None], levels[digits], 0.0)
    return TreePlans(np.repeat(actions, hold, axis=2), depths * hold, costs)


def _rank(
    system: PlanningModel,
    state: Floats,
    levels: Floats,
    hold: int,
    depth: int,
    stage_cost: Callable[[Any, Any], Any],
    terminal_cost: Callable[[Any], Any],
    keep: int,
) -> tuple[NDArray[np.int64], Floats]:
    """Numbers and costs of the best nodes, each (b, keep), best first."""
    states, so_far = state[:, None], np.zeros((len(state), 1))
    costs = [terminal_cost(states)]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(depth):
            actions = np.broadcast_to(
                np.tile(levels, (states.shape[1], 1)),
                (len(state), states.shape[1] * len(levels), levels.shape[1]),
            )
            states, so_far = np.repeat(states, len(levels), axis=1), np.repeat(so_far, len(levels), axis=1)
            for _ in range(hold):
                so_far = so_far + stage_cost(states, actions)
                states = system.flow(states, actions)
            costs.append(so_far + terminal_cost(states))
    every = np.concatenate(costs, axis=1)
    every = np.where(np.isfinite(every), every, np.inf)
    best = np.argpartition(every, keep - 1, axis=1)[:, :keep]
    best = np.take_along_axis(
        best, np.argsort(np.take_along_axis(every, best, axis=1), axis=1, kind="stable"), axis=1
    )
    return best, np.take_along_axis(every, best, axis=1)
