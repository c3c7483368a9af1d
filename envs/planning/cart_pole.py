"""The expert of the cart-pole swing-up: tree search, iterative LQR, and time-varying feedback; batched.

It minimises what the reward lacks of its highest value 1, and a barrier before the track's ends,

    l(s, u) = 1 - r(s, u) + b max(0, |x| - x_b)^2,      l_T(s) = s' P s / 2,

with P, K of the infinite-horizon LQR at the upright (theta taken in [-pi, pi)). A plan is made in three steps:
the best plans of two trees of held actions, each continued by the LQR; the best of these as the first guess of
iLQR; then u_t + K_t (s - s_t) is applied until the plan ends, -K s afterwards. A copy plans anew when a new
episode begins, and when the state has left the plan so far that the deviation's LQR cost d' P d / 2 is above a
threshold; then the rest of the old plan is one of the guesses. There is no randomness.
"""

from __future__ import annotations

from dataclasses import dataclass

import control
import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.planning.action_tree import tree_search
from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.planning.ilqr import ILQR
from beliefgym.envs.planning.linearisation import expand_cost, linearise
from beliefgym.envs.system import Array, wrap_angle

Floats = NDArray[np.float64]

TREES = ((0.15, 8), (0.25, 7))  # s for which an action is held, and how many actions
KEEP = 8  # plans of each tree that are continued by the LQR
HORIZON = 3.0  # s
BARRIER, BARRIER_START = 20.0, 5.0 / 6.0  # 1/m^2, and from which part of the track on
PLANS_AT_ONCE = 512  # bounds the memory
REPLAN_COST = 1.0  # in units of reward


def cart_pole_expert(system: CartPole) -> CartPoleController:
    """A new controller for any number of copies of the system; see the module.

    Args:
        system: with any parameters; its noise is left out of the plans.
    """
    return CartPoleController(system)


@dataclass(frozen=True)
class LackOfReward:
    """l(s, u) of the module."""

    system: CartPole

    def __call__(self, state: Array, action: Array) -> Array:
        """(..., 4), (..., 1) -> (...)."""
        xp = array_namespace(state)
        beyond = xp.abs(state[..., 0]) - BARRIER_START * self.system.track
        beyond = xp.where(beyond > 0.0, beyond, 0.0 * beyond)
        return 1.0 - self.system.reward(state, action, state) + BARRIER * (beyond * beyond)


@dataclass(frozen=True, eq=False)
class UprightCost:
    """l_T(s) of the module; matrix is P (4, 4)."""

    matrix: Floats

    def __call__(self, state: Array) -> Array:
        """(..., 4) -> (...)."""
        xp = array_namespace(state)
        s = from_upright(state)
        return 0.5 * ((s @ xp.asarray(self.matrix)) * s).sum(-1)


def from_upright(state: Array) -> Array:
    """The state with theta in [-pi, pi): (..., 4) -> (..., 4)."""
    xp = array_namespace(state)
    return xp.stack([state[..., 0], state[..., 1], wrap_angle(state[..., 2]), state[..., 3]], axis=-1)


class CartPoleController:
    """Swings up and holds; keeps the plan of every copy. See the module."""

    def __init__(self, system: CartPole) -> None:
        self.system = system
        self.stage_cost = LackOfReward(system)
        zero = np.zeros((1, system.n_state)), np.zeros((1, system.n_action))
        a, b = linearise(system, *zero)
        weight = expand_cost(self.stage_cost, *zero)[1][0]
        n = system.n_state
        gain, p, _ = control.dlqr(a[0], b[0], weight[:n, :n], weight[n:, n:], method="scipy")
        self.upright_gain: Floats = -np.asarray(gain)
        self.upright_cost = UprightCost(np.asarray(p))
        self.horizon = round(HORIZON / system.dt)
        self.planner = ILQR(
            system=system,
            horizon=self.horizon,
            stage_cost=self.stage_cost,
            terminal_cost=self.upright_cost,
            max_iterations=60,
            tolerance=1e-4,
        )
        self.states: Floats
        self.actions: Floats
        self.gains: Floats
        self.clock: NDArray[np.int64]
        self.planned: NDArray[np.bool_]
        self._forget(0)

    def act(self, state: ArrayLike, restart: ArrayLike | None = None) -> Floats:
        """The actions of one step of n copies; call it once a step, in order.

        Args:
            state: (n, 4).
            restart: bool (n,), where a new episode has begun; nowhere if None. Another number of copies than in
                the last call means a new batch: all plan anew.

        Returns:
            (n, 1) in N, within the limits.

        Raises:
            ValueError: a wrong shape, or a state that is not finite.
        """
        state, begun = checked_batch(self.system, state, restart)
        if len(state) != len(self.clock):
            self._forget(len(state))
        self.planned &= ~begun
        action, gain, deviation = self._on_plan(state)
        again = np.flatnonzero(~self.planned | (self.upright_cost(deviation) > REPLAN_COST))
        if len(again):
            for first in range(0, len(again), PLANS_AT_ONCE):
                self._plan(state, again[first : first + PLANS_AT_ONCE])
            action, gain, deviation = self._on_plan(state)
        self.clock = np.minimum(self.clock + 1, self.horizon)
        return self.system.clip(action + (gain @ deviation[..., None])[..., 0])

    def _forget(self, copies: int) -> None:
        """No plan for any copy. The last entry of a plan holds the upright, for ever."""
        n, m, steps = self.system.n_state, self.system.n_action, self.horizon + 1
        self.states = np.zeros((copies, steps, n))
        self.actions = np.zeros((copies, steps, m))
        self.gains = np.broadcast_to(self.upright_gain, (copies, steps, m, n)).copy()
        self.clock = np.zeros(copies, dtype=np.int64)
        self.planned = np.zeros(copies, dtype=bool)

    def _on_plan(self, state: Floats) -> tuple[Floats, Floats, Floats]:
        """The planned action and gain of the present step, and the deviation from the planned state."""
        at = np.arange(len(state)), self.clock
        return self.actions[at], self.gains[at], from_upright(state - self.states[at])

    def _plan(self, state: Floats, rows: NDArray[np.int64]) -> None:
        start = state[rows]
        solution = self.planner.solve(start, self._first_guess(start, rows))
        self.states[rows, :-1] = solution.states[:, :-1]
        self.actions[rows, :-1] = solution.actions
        self.gains[rows, :-1] = solution.gains
        self.clock[rows] = 0
        self.planned[rows] = True

    def _first_guess(self, start: Floats, rows: NDArray[np.int64]) -> Floats:
        """(rows, T, m): the best of the trees' plans and the rest of the old one, each continued by the LQR."""
        count, m, horizon = len(rows), self.system.n_action, self.horizon
        guesses, lengths = [], []
        for seconds, depth in TREES:
            plans = tree_search(
                self.system,
                start,
                hold=max(1, round(seconds / self.system.dt)),
                depth=depth,
                stage_cost=self.stage_cost,
                terminal_cost=self.upright_cost,
                keep=KEEP,
            )
            filled = np.zeros((count, KEEP, horizon, m))
            filled[:, :, : plans.actions.shape[2]] = plans.actions[:, :, :horizon]
            guesses.append(filled)
            lengths.append(plans.lengths)
        actions, costs = self._continue(start, np.concatenate(guesses, 1), np.concatenate(lengths, 1))
        old = np.flatnonzero(self.planned[rows])
        if len(old):
            followed, cost = self._follow(start[old], rows[old])
            actions = np.concatenate([actions, np.zeros((count, 1, horizon, m))], axis=1)
            costs = np.concatenate([costs, np.full((count, 1), np.inf)], axis=1)
            actions[old, -1], costs[old, -1] = followed, cost
        return actions[np.arange(count), costs.argmin(axis=1)]

    def _continue(self, start: Floats, actions: Floats, lengths: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Plans (rows, c, T, m) with the LQR after their lengths (rows, c), and their costs (rows, c)."""
        state = np.repeat(start[:, None], actions.shape[1], axis=1)
        actions = actions.copy()
        cost = np.zeros(lengths.shape)
        for t in range(self.horizon):
            lqr = self.system.clip(from_upright(state) @ self.upright_gain.T)
            actions[:, :, t] = np.where((t < lengths)[..., None], actions[:, :, t], lqr)
            cost += self.stage_cost(state, actions[:, :, t])
            state = self.system.flow(state, actions[:, :, t])
        return actions, cost + self.upright_cost(state)

    def _follow(self, start: Floats, rows: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """What the present plans of the rows would do from here, (rows, T, m), and its cost."""
        state, cost = start, np.zeros(len(rows))
        actions = np.empty((len(rows), self.horizon, self.system.n_action))
        for t in range(self.horizon):
            at = rows, np.minimum(self.clock[rows] + t, self.horizon)
            deviation = from_upright(state - self.states[at])
            actions[:, t] = self.system.clip(
                self.actions[at] + (self.gains[at] @ deviation[..., None])[..., 0]
            )
            cost += self.stage_cost(state, actions[:, t])
            state = self.system.flow(state, actions[:, t])
        return actions, cost + self.upright_cost(state)
