"""The expert of the double pendulum's swing-up: a searched plan, iterative LQR, and time-varying feedback; batched.

It minimises what the reward lacks of its highest value 1,

    l(s, u) = 1 - r(s, u),      l_T(s) = d' P d / 2,      d = s - upright, with both angles in [-pi, pi),

with P, K of the infinite-horizon LQR at the upright. l alone is too flat to find a way up by. So one plan, from
hanging at rest, is searched for with the system's smooth stage cost c and kept in memory for each set of parameters:
iLQR from many random bang-bang first guesses (of a fixed seed) on a model with one substep; the best are polished on
the true model, first with c and then with l. It may use a part of the drive only, so that feedback along it has room.

A copy's own plan begins with the known one or its mirror image, whichever ends better from the copy's start, and iLQR
fits it to l with the whole drive. Where neither ends near the upright, iLQR with c comes between, and where that
fails too, a search from that state. The copy then follows its plan by

    u_t + K_t (s - s_t),   K_t = -(c_uu + B' V_{t+1} B)^-1 B' V_{t+1} A,
    V_t = c_ss + K_t' c_uu K_t + (A + B K_t)' V_{t+1} (A + B K_t),   V_T = P,

which, unlike iLQR's own gains, do not vanish where the plan is at a limit; K d after its end. It plans anew when a
new episode begins, and when (s - s_t)' V_t (s - s_t) / 2, what its deviation is expected to cost, is above a
threshold; what is left of the old plan is then one of the guesses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import control
import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.double_pendulum import DoublePendulum
from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.planning.ilqr import ILQR, ILQRSolution
from beliefgym.envs.planning.linearisation import expand_cost, linearise
from beliefgym.envs.system import Array, wrap_angle

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Policy = Callable[[int, Floats], Floats]

UPRIGHT = np.array([np.pi, 0.0, np.pi, 0.0])
HORIZON = 9.0  # of a plan, in units of sqrt((l1 + l2) / g)
HELD_FOR = (1 / 3, 9 / 10)  # shortest and longest hold of a random guess, in the same unit
LIBRARY_GUESSES, GUESSES = 64, 16  # random first guesses, for the plan from hanging and for another state
KEEP = 6  # of these are polished
SMOOTH_TERMINAL = 20.0  # weight of l_T beside the smooth stage cost
BASIN = 2.0  # l_T up to which the LQR at the upright catches: over 99.5 % of 4000 states, with each actuation
RESERVE = (
    0.9  # share of the drive that plans may use where feedback needs the rest: the known one, all under noise
)
REPLAN_COST = 10.0  # in units of the smooth cost
PLANS_AT_ONCE = 256  # bounds the memory


def double_pendulum_expert(system: DoublePendulum) -> DoublePendulumController:
    """A new controller for any number of copies of the system; see the module.

    Args:
        system: with any parameters and actuation; its noise is left out of the plans.
    """
    return DoublePendulumController(system)


def wrapped(difference: Array) -> Array:
    """A difference of states with both angles in [-pi, pi): (..., 4) -> (..., 4)."""
    xp = array_namespace(difference)
    first, second = wrap_angle(difference[..., 0]), wrap_angle(difference[..., 2])
    return xp.stack([first, difference[..., 1], second, difference[..., 3]], axis=-1)


@dataclass(frozen=True)
class LackOfReward:
    """l(s, u) of the module."""

    system: DoublePendulum

    def __call__(self, state: Array, action: Array) -> Array:
        """(..., 4), (..., 1) -> (...)."""
        return 1.0 - self.system.reward(state, action, state)


@dataclass(frozen=True, eq=False)
class UprightCost:
    """weight * l_T(s) of the module; matrix is P (4, 4)."""

    matrix: Floats
    weight: float = 1.0

    def __call__(self, state: Array) -> Array:
        """(..., 4) -> (...)."""
        xp = array_namespace(state)
        d = wrapped(state - xp.asarray(UPRIGHT))
        return (0.5 * self.weight) * ((d @ xp.asarray(self.matrix)) * d).sum(-1)


@dataclass(frozen=True, eq=False)
class SwingUp:
    """What is computed once for a set of parameters.

    Attributes:
        horizon: T of a plan in steps.
        gain: (1, 4) of the LQR at the upright. upright_cost: l_T.
        states: (T + 1, 4), actions (T, 1), gains (T, 1, 4): the plan from hanging at rest.
    """

    horizon: int
    gain: Floats
    upright_cost: UprightCost
    states: Floats
    actions: Floats
    gains: Floats


@lru_cache(maxsize=8)
def swing_up(system: DoublePendulum) -> SwingUp:
    """The LQR at the upright and the plan from hanging, of a system without noise."""
    lack = LackOfReward(system)
    at = UPRIGHT[None], np.zeros((1, 1))
    a, b = linearise(system, *at)
    weight = expand_cost(lack, *at)[1][0]
    gain, p, _ = control.dlqr(a[0], b[0], weight[:4, :4], weight[4:, 4:], method="scipy")
    cost = UprightCost(np.asarray(p))
    horizon = round(HORIZON * _tempo(system) / system.dt)
    weaker = replace(system, max_drive=RESERVE * system.max_drive)
    plan = search(weaker, np.zeros((1, 4)), horizon, cost, LIBRARY_GUESSES)
    gains, _ = tracking(system, plan, cost.matrix)
    return SwingUp(horizon, -np.asarray(gain), cost, plan.states[0], plan.actions[0], gains[0])


def tracking(system: DoublePendulum, plan: ILQRSolution, terminal: Floats) -> tuple[Floats, Floats]:
    """The gains K_t (b, T, 1, 4) and value matrices V_t (b, T, 4, 4) of the module along plans."""
    n = system.n_state
    a, b = linearise(system, plan.states[:, :-1], plan.actions)
    hessian = expand_cost(system.stage_cost, plan.states[:, :-1], plan.actions)[1]
    gains, values, value = np.empty_like(plan.gains), np.empty_like(a), terminal
    for t in reversed(range(plan.actions.shape[1])):
        at, bt = a[:, t], b[:, t]
        pulled = bt.swapaxes(-1, -2) @ value
        gains[:, t] = -np.linalg.solve(hessian[:, t, n:, n:] + pulled @ bt, pulled @ at)
        closed = at + bt @ gains[:, t]
        value = hessian[:, t, :n, :n] + closed.swapaxes(-1, -2) @ value @ closed
        value = value + gains[:, t].swapaxes(-1, -2) @ hessian[:, t, n:, n:] @ gains[:, t]
        values[:, t] = value
    return gains, values


def search(
    system: DoublePendulum, start: Floats, horizon: int, upright_cost: UprightCost, guesses: int
) -> ILQRSolution:
    """The best of many local optima from each start state; see the module.

    Args:
        system: the true model.
        start: (b, 4). horizon: steps of a plan.
        upright_cost: l_T. guesses: random first guesses for each start.

    Returns:
        b plans.
    """
    count = len(start)
    firsts = _bang_bang(system, horizon, guesses)
    lack, smooth_end = LackOfReward(system), replace(upright_cost, weight=SMOOTH_TERMINAL)

    def solve(
        model: DoublePendulum, smooth: bool, iterations: int, states: Floats, actions: Floats
    ) -> ILQRSolution:
        planner = ILQR(
            system=model,
            horizon=horizon,
            stage_cost=system.stage_cost if smooth else lack,
            terminal_cost=smooth_end if smooth else upright_cost,
            max_iterations=iterations,
            tolerance=1e-3 if smooth else 1e-4,
        )
        return planner.solve(states, actions)

    rough = solve(
        replace(system, substeps=1), True, 60, np.repeat(start, guesses, 0), np.tile(firsts, (count, 1, 1))
    )
    loss = lack(rough.states[:, :-1], rough.actions).sum(axis=1) + upright_cost(rough.states[:, -1])
    keep = min(KEEP, guesses)
    best = np.argsort(loss.reshape(count, guesses), axis=1, kind="stable")[:, :keep]
    chosen = (best + guesses * np.arange(count)[:, None]).ravel()
    starts = np.repeat(start, keep, axis=0)
    polished = solve(system, True, 20, starts, rough.actions[chosen])
    final = solve(system, False, 20, starts, polished.actions)
    winner = final.cost.reshape(count, keep).argmin(axis=1) + keep * np.arange(count)
    return ILQRSolution(**{name: getattr(final, name)[winner] for name in ILQRSolution.__dataclass_fields__})


def _tempo(system: DoublePendulum) -> float:
    """The unit of time of the links, sqrt((l1 + l2) / g), in s."""
    return float(np.sqrt((system.length_1 + system.length_2) / system.gravity))


def _bang_bang(system: DoublePendulum, horizon: int, count: int) -> Floats:
    """Random sequences of held actions, low, none or high: (count, horizon, 1)."""
    rng = np.random.default_rng(0)
    shortest, longest = (max(1, round(part * _tempo(system) / system.dt)) for part in HELD_FOR)
    actions = np.empty((count, horizon, 1))
    for row in actions[..., 0]:
        hold = int(rng.integers(shortest, longest + 1))
        levels = rng.choice([-0.9, 0.0, 0.9], size=horizon // hold + 1)
        row[:] = np.repeat(levels, hold)[:horizon] * system.max_drive
    return actions


class DoublePendulumController:
    """Swings up and holds; keeps the plan of every copy. See the module."""

    def __init__(self, system: DoublePendulum) -> None:
        self.system = system
        self.known = swing_up(
            replace(system, process_noise_std=0.0, actuation_noise_std=0.0, start_spread=0.0)
        )
        self.stage_cost = LackOfReward(system)
        share = RESERVE if system.noise_size else 1.0
        self.model = replace(system, max_drive=share * system.max_drive)
        self.planner = ILQR(
            system=self.model,
            horizon=self.known.horizon,
            stage_cost=self.stage_cost,
            terminal_cost=self.known.upright_cost,
            max_iterations=30,
            tolerance=1e-4,
        )
        self.smooth_planner = replace(
            self.planner,
            stage_cost=system.stage_cost,
            terminal_cost=replace(self.known.upright_cost, weight=SMOOTH_TERMINAL),
        )
        self.states: Floats
        self.actions: Floats
        self.gains: Floats
        self.values: Floats
        self.clock: Integers
        self.planned: NDArray[np.bool_]
        self._forget(0)

    def act(self, state: ArrayLike, restart: ArrayLike | None = None) -> Floats:
        """The actions of one step of n copies; call it once a step, in order.

        Args:
            state: (n, 4).
            restart: bool (n,), where a new episode has begun; nowhere if None. Another number of copies than in
                the last call means a new batch: all plan anew.

        Returns:
            (n, 1) in units of the drive, within its limits.

        Raises:
            ValueError: a wrong shape, or a state that is not finite.
        """
        state, begun = checked_batch(self.system, state, restart)
        if len(state) != len(self.clock):
            self._forget(len(state))
        self.planned &= ~begun
        at = np.arange(len(state)), self.clock
        deviation = wrapped(state - self.states[at])
        loss = 0.5 * np.einsum("ij,ijk,ik->i", deviation, self.values[at], deviation)
        again = np.flatnonzero(~self.planned | (loss > REPLAN_COST))
        for first in range(0, len(again), PLANS_AT_ONCE):
            self._plan(state, again[first : first + PLANS_AT_ONCE])
        action = self._follow(state, np.arange(len(state)), self.clock)
        self.clock = np.minimum(self.clock + 1, self.known.horizon)
        return action

    def _forget(self, copies: int) -> None:
        """No plan for any copy. The last entry of a plan holds the upright, for ever."""
        n, m, steps = self.system.n_state, self.system.n_action, self.known.horizon + 1
        self.states = np.broadcast_to(UPRIGHT, (copies, steps, n)).copy()
        self.actions = np.zeros((copies, steps, m))
        self.gains = np.broadcast_to(self.known.gain, (copies, steps, m, n)).copy()
        self.values = np.broadcast_to(self.known.upright_cost.matrix, (copies, steps, n, n)).copy()
        self.clock = np.zeros(copies, dtype=np.int64)
        self.planned = np.zeros(copies, dtype=bool)

    def _follow(self, state: Floats, rows: Integers, clock: Integers) -> Floats:
        """The actions of some rows' plans at some of their steps, with feedback."""
        at = rows, clock
        feedback = (self.gains[at] @ wrapped(state - self.states[at])[..., None])[..., 0]
        return self.system.clip(self.actions[at] + feedback)

    def _plan(self, state: Floats, rows: Integers) -> None:
        start = state[rows]
        solution = self.planner.solve(start, self._first_guess(start, rows))
        self.states[rows, :-1] = solution.states[:, :-1]
        self.actions[rows, :-1] = solution.actions
        tracked = tracking(self.system, solution, self.known.upright_cost.matrix)
        self.gains[rows, :-1], self.values[rows, :-1] = tracked
        self.clock[rows] = 0
        self.planned[rows] = True

    def _first_guess(self, start: Floats, rows: Integers) -> Floats:
        """(rows, T, 1): the best of the known plan, its mirror image and the old plan, followed with their gains;
        where it does not end near the upright, what iLQR makes of it with the smooth cost, or else a search."""
        known, horizon = self.known, self.known.horizon

        def image(sign: float) -> Policy:
            return lambda t, s: (
                sign * known.actions[t] + wrapped(s - sign * known.states[t]) @ known.gains[t].T
            )

        def old(t: int, s: Floats) -> Floats:
            return self._follow(s, rows, np.minimum(self.clock[rows] + t, horizon))

        rolled = [self._roll_out(start, policy) for policy in (image(1.0), image(-1.0), old)]
        actions, ends, costs = (np.stack(parts) for parts in zip(*rolled, strict=True))
        costs[2, ~self.planned[rows]] = np.inf
        best = costs.argmin(axis=0), np.arange(len(rows))
        guess, lost = actions[best], np.flatnonzero(ends[best] > BASIN)
        if len(lost):
            smooth = self.smooth_planner.solve(start[lost], guess[lost])
            guess[lost] = smooth.actions
            lost = lost[known.upright_cost(smooth.states[:, -1]) > BASIN]
        for first in range(0, len(lost), PLANS_AT_ONCE // GUESSES):
            part = lost[first : first + PLANS_AT_ONCE // GUESSES]
            found = search(self.model, start[part], horizon, known.upright_cost, GUESSES)
            guess[part] = found.actions
        return guess

    def _roll_out(self, start: Floats, policy: Policy) -> tuple[Floats, Floats, Floats]:
        """Actions (rows, T, 1), l_T of the last state (rows,), and the whole cost (rows,), of a policy(t, state)."""
        model, state, cost = self.planner.system, start, np.zeros(len(start))
        actions = np.empty((len(start), self.known.horizon, model.n_action))
        for t in range(self.known.horizon):
            actions[:, t] = model.clip(policy(t, state))
            cost += self.stage_cost(state, actions[:, t])
            state = model.flow(state, actions[:, t])
        end = self.known.upright_cost(state)
        return actions, end, cost + end
