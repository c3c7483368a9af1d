"""Dynamic programming on a grid of a two-dimensional state, and the expert of the pendulum made from it.

The value of a state is what an optimal controller will pay from it on, and solves

    V(s) = min over (u, k) of  sum_{i<k} gamma^i c(s_i, u) + gamma^k V(s_k),      c = -reward, s_0 = s, noise-free,

where an action u may be held for k steps. Holding adds nothing to what can be reached, but it replaces k
interpolations of V, each with an error, by one: it halves what the expert loses to the grid. V is bilinear between
the nodes. It is found by modified policy iteration (Puterman 2005, Sec. 6.5): choose the best (u, k) at each node,
apply them `SWEEPS` times, and repeat until V no longer changes. Where some states can never get to rest, V grows
there for ever if gamma is 1; then it ends after `max_improvements`, when the policy has long settled.

At run time the controller looks one step ahead, over a fine set of actions: argmin_u c(s, u) + gamma V(f(s, u)). A
parabola through the best three made it worse, since V has a kink at each grid line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.planning.grid import Axis, GridValue, bilinear, table_of
from beliefgym.envs.system import System

Floats = NDArray[np.float64]

SWEEPS = 20  # applications of a policy between two improvements
ANGLES, SPEEDS = 640, 513  # nodes of the pendulum's grid; both have one at 0, so has the grid half as fine
TORQUES, HELD_TORQUES, LOOKAHEAD_TORQUES = 9, 3, 41
HELD_FOR = (0.1, 0.2, 0.4, 0.8)  # s


def value_iteration(
    system: System,
    axes: tuple[Axis, Axis],
    actions: ArrayLike,
    held_actions: ArrayLike | None = None,
    holds: Sequence[int] = (),
    *,
    discount: float = 1.0,
    tolerance: float = 1e-4,
    max_improvements: int = 25,
    start: GridValue | None = None,
) -> GridValue:
    """Solve the equation of the module for a system with two state components.

    Args:
        system: its noise is left out.
        axes: the grid.
        actions: (k, m), tried for one step.
        held_actions: (h, m), tried for each of `holds` steps; `actions` if None.
        holds: numbers of steps, each above 1.
        discount: gamma, in (0, 1].
        tolerance: V has converged when an improvement changes it by less at every node.
        max_improvements: policy improvements after which it ends in any case.
        start: a first guess of V, such as one of a coarser grid; 0 if None.

    Raises:
        ValueError: a system with another number of state components, actions of a wrong shape, or a discount
            outside (0, 1], or a hold below 2.
    """
    if system.n_state != 2:
        raise ValueError(
            f"value_iteration needs a system with 2 state components, {type(system).__name__} has {system.n_state}"
        )
    if not 0.0 < discount <= 1.0:
        raise ValueError(f"expected discount in (0, 1], got {discount!r}")
    if any(k < 2 for k in holds):
        raise ValueError(f"expected holds of at least 2 steps, got {list(holds)}")
    nodes = np.stack(np.meshgrid(*(axis.points for axis in axes), indexing="ij"), axis=-1).reshape(-1, 2)
    once = _actions(system, actions)
    held = once if held_actions is None else _actions(system, held_actions)
    plans: list[tuple[Floats, Sequence[int]]] = [(u, (1,)) for u in once]
    plans += [(u, holds) for u in held if holds]
    choices = [c for u, lengths in plans for c in _hold(system, axes, nodes, u, lengths, discount)]

    count, width = len(nodes), axes[1].columns
    value = np.zeros(count) if start is None else start(nodes)
    best_value, best = np.empty(count), np.empty(count, dtype=np.intp)
    converged, improvements = False, 0
    while not converged and improvements < max_improvements:
        table = table_of(value, axes).ravel()
        best_value.fill(np.inf)
        for c, choice in enumerate(choices):
            candidate = choice.cost + choice.factor * bilinear(table, width, choice.corner, *choice.place)
            lower = candidate < best_value
            best_value[lower], best[lower] = candidate[lower], c
        converged = bool(np.abs(best_value - value).max() < tolerance)
        value = best_value.copy()
        improvements += 1
        if not converged:
            paid, policy = _apply(choices, best, axes)
            for _ in range(SWEEPS):
                value = paid + policy @ value
    return GridValue(axes, table_of(value, axes), improvements, converged)


class GridController:
    """Looks one step ahead from the present state; has no memory and no randomness.

    Args:
        system: the true model; its noise is left out.
        value: V of it.
        actions: (k, m), those that are tried.
        discount: gamma of V.
    """

    def __init__(self, system: System, value: GridValue, actions: ArrayLike, discount: float = 1.0) -> None:
        self.system, self.value, self.discount = system, value, discount
        self.actions = _actions(system, actions)

    def act(self, state: ArrayLike, restart: ArrayLike | None = None) -> Floats:
        """The best action of each copy.

        Args:
            state: (n, 2).
            restart: not needed; there is no plan to forget.

        Returns:
            (n, m).

        Raises:
            ValueError: a wrong shape, or a state that is not finite.
        """
        state = np.asarray(state, dtype=np.float64)
        if state.ndim != 2 or state.shape[1] != 2:
            raise ValueError(f"expected state as (n, 2), got shape {state.shape}")
        if not np.isfinite(state).all():
            raise ValueError(f"the state of copy {int(np.argwhere(~np.isfinite(state))[0][0])} is not finite")
        shape = len(state), len(self.actions)
        states = np.broadcast_to(state[:, None], (*shape, 2))
        actions = np.broadcast_to(self.actions, (*shape, self.actions.shape[1]))
        after = self.system.flow(states, actions)
        to_go = self.value(after)
        if type(self.system).terminated is not System.terminated:
            to_go = to_go * ~self.system.terminated(after)
        cost = self.discount * to_go - self.system.reward(states, actions, after)
        return self.actions[cost.argmin(axis=1)]


def pendulum_expert(system: Pendulum) -> GridController:
    """The controller of a pendulum; its value is computed once for each set of parameters.

    Args:
        system: with any parameters but a max_torque of 0; noise is left out of the value (certainty equivalence).

    Raises:
        ValueError: the pendulum is uncontrolled.
    """
    if not system.max_torque > 0:
        raise ValueError(
            f"an uncontrolled pendulum has no expert: max_torque is {system.max_torque}; set it above 0 N m"
        )
    quiet = replace(system, process_noise_std=0.0, actuation_noise_std=0.0, start_angle=0.0)
    return GridController(system, _pendulum_value(quiet), _torques(system, LOOKAHEAD_TORQUES))


@lru_cache(maxsize=8)
def _pendulum_value(system: Pendulum) -> GridValue:
    speed = min(system.max_speed, speed_bound(system))
    holds = sorted({round(seconds / system.dt) for seconds in HELD_FOR} - {0, 1})
    tried = _torques(system, TORQUES), _torques(system, HELD_TORQUES), holds

    def axes(coarser: int) -> tuple[Axis, Axis]:
        angle = Axis(-np.pi, np.pi, ANGLES // coarser, periodic=True)
        return angle, Axis(-speed, speed, (SPEEDS - 1) // coarser + 1)

    return value_iteration(system, axes(1), *tried, start=value_iteration(system, axes(2), *tried))


def speed_bound(system: Pendulum) -> float:
    """A speed in rad/s that a good controller does not pass: that of a fall from upright under full torque.

        w^2 = start_speed^2 + 2 (2 a_g) + 2 (2 pi a_u),

    a_g the greatest acceleration by gravity and a_u that by the torque; the grid ends there when max_speed is
    higher or infinite.
    """
    quarter = np.array([[0.5 * np.pi, 0.0], [0.0, 0.0]])
    torque = np.array([[0.0], [system.max_torque]])
    gained = np.abs(system.flow(quarter, torque)[:, 1]) / system.dt
    return float(np.sqrt(system.start_speed**2 + 4.0 * gained[0] + 4.0 * np.pi * gained[1]))


def _torques(system: Pendulum, count: int) -> Floats:
    return np.linspace(-system.max_torque, system.max_torque, count)[:, None]


def _actions(system: System, actions: ArrayLike) -> Floats:
    array = np.asarray(actions, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != system.n_action or not len(array):
        raise ValueError(
            f"expected actions as (k, {system.n_action}) with k above 0, got shape {array.shape}"
        )
    return system.clip(array)


@dataclass(frozen=True, eq=False)
class _Choice:
    """An action held for some steps from every node: what it costs, and where it leads.

    Attributes:
        cost: (nodes,). factor: of V at the end; gamma^k, and 0 where the task has ended.
        corner: (nodes,) lowest node of the cell where it leads, in the flat table. place: (2, nodes) in the cell.
    """

    cost: Floats
    factor: Floats | float
    corner: NDArray[np.int32]
    place: NDArray[np.float32]


def _hold(
    system: System,
    axes: tuple[Axis, Axis],
    nodes: Floats,
    action: Floats,
    holds: Sequence[int],
    discount: float,
) -> list[_Choice]:
    """The choices to hold one action for each of some numbers of steps."""
    actions = np.broadcast_to(action, (len(nodes), len(action)))
    ends = type(system).terminated is not System.terminated
    states, cost, factor = nodes, np.zeros(len(nodes)), np.ones(len(nodes)) if ends else 1.0
    choices = []
    for step in range(1, max(holds) + 1):
        after = system.flow(states, actions)
        cost = cost - factor * system.reward(states, actions, after)
        factor = factor * discount
        if ends:
            factor = factor * ~system.terminated(after)
        states = after
        if step in holds:
            i, p = axes[0].locate(states[:, 0])
            j, q = axes[1].locate(states[:, 1])
            corner = (i * axes[1].columns + j).astype(np.int32)
            choices.append(
                _Choice(cost.astype(np.float32), factor, corner, np.stack([p, q]).astype(np.float32))
            )
    return choices


def _apply(
    choices: list[_Choice], best: NDArray[np.intp], axes: tuple[Axis, Axis]
) -> tuple[Floats, scipy.sparse.csr_matrix]:
    """The cost of the chosen choice at each node, and the matrix from V at the nodes to factor V where it leads."""
    count, (rows, columns) = len(best), (axes[0].nodes, axes[1].nodes)
    paid, factor, corner, place = (
        np.empty(count),
        np.empty(count),
        np.empty(count, np.int64),
        np.empty((2, count)),
    )
    for c, choice in enumerate(choices):
        chosen = best == c
        paid[chosen], corner[chosen] = choice.cost[chosen], choice.corner[chosen]
        place[:, chosen] = choice.place[:, chosen]
        factor[chosen] = np.broadcast_to(choice.factor, count)[chosen]
    i, j = np.divmod(corner, axes[1].columns)
    p, q = place
    ends, weights = np.empty((count, 4), np.int32), np.empty((count, 4))
    for column, (a, b) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        ends[:, column] = (i + a) % rows * columns + (j + b) % columns
        weights[:, column] = factor * (p if a else 1.0 - p) * (q if b else 1.0 - q)
    starts = np.arange(0, 4 * count + 1, 4)
    return paid, scipy.sparse.csr_matrix((weights.ravel(), ends.ravel(), starts), (count, count))
