"""Receding-horizon control on top of iterative LQR, batched: plan T steps, do the first ones, plan again.

At an episode's start the plan has to be found: a tree of held actions (or random held actions, where there are several)
gives candidates, each improved by iLQR, and the cheapest is taken. Afterwards the rest of the old plan, with its
feedback, is the first guess of the next one, and a few iterations do. Between two plans the feedback

    u = clip(u_t + K_t (x - x_t))

keeps the state near the plan, with differences of angles in [-pi, pi). The cost beyond the horizon is that of the
LQR at the target where the model's linearisation there can be stabilised, l_T(x) = (x - x*)' P (x - x*) / 2; else
the stage cost counts once more.

References: Tassa, Erez & Todorov 2012, "Synthesis and stabilization of complex behaviors through online trajectory
optimization"; thesis proposal, Sec. 3.2.3 (iLQR about a nominal swing-up trajectory).
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.planning.action_tree import tree_search
from beliefgym.envs.planning.ilqr import ILQR
from beliefgym.envs.planning.learned_model import PlanningModel
from beliefgym.envs.planning.model_lqr import ModelWarning, wrapped_difference

Floats = NDArray[np.float64]

TREE_DEPTH = 8  # held actions of the first guess: 3^8 sequences
SHOTS = 2048  # random sequences of held actions, where there are several actions


@dataclass
class Plan:
    """What each of n copies is doing; a policy's memory.

    Attributes:
        states: (n, T + 1, d). actions: (n, T, m). gains: (n, T, m, d).
        clock: (n,) steps since the plan was made. planned: (n,) bool.
    """

    states: Floats
    actions: Floats
    gains: Floats
    clock: NDArray[np.int64]
    planned: NDArray[np.bool_]

    @classmethod
    def none(cls, n: int, horizon: int, n_state: int, n_action: int) -> Plan:
        """No plans yet."""
        return cls(
            np.zeros((n, horizon + 1, n_state)),
            np.zeros((n, horizon, n_action)),
            np.zeros((n, horizon, n_action, n_state)),
            np.zeros(n, dtype=np.int64),
            np.zeros(n, dtype=np.bool_),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class RecedingHorizon:
    """Model-predictive control; see the module.

    Args:
        model: a `System` or a `LearnedModel`.
        horizon: T, steps.
        terminal_cost: (x (..., d)) -> (...); see `terminal_cost_of`.
        angles: components of the state that are angles, whose differences are wrapped.
        hold: steps that an action of the first guess is held.
        candidates: first guesses that iLQR improves.
        iterations: of iLQR at an episode's start. again: of iLQR for each later plan.
        every: steps between plans; `horizon` for one plan an episode, tracked to its end.
    """

    model: PlanningModel
    horizon: int
    terminal_cost: Any = None
    angles: Collection[int] = ()
    hold: int = 3
    candidates: int = 8
    iterations: int = 60
    again: int = 3
    every: int = 1
    _long: ILQR = field(init=False, repr=False)
    _short: ILQR = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("horizon", "hold", "candidates", "iterations", "again", "every"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"expected {name} of at least 1, got {getattr(self, name)!r}")
        for name, iterations in (("_long", self.iterations), ("_short", self.again)):
            planner = ILQR(
                system=self.model,
                horizon=self.horizon,
                stage_cost=self.model.stage_cost,
                terminal_cost=self.terminal_cost,
                max_iterations=iterations,
                tolerance=1e-4,
            )
            object.__setattr__(self, name, planner)

    def begin(self, n: int) -> Plan:
        """The memory of n copies that have planned nothing yet."""
        return Plan.none(n, self.horizon, self.model.n_state, self.model.n_action)

    def act(self, state: Floats, plan: Plan, restart: NDArray[np.bool_]) -> Floats:
        """The actions of one step; the memory is changed in place.

        Args:
            state: (n, d). plan: of `begin`. restart: (n,) where a new episode begins.

        Returns:
            (n, m), within the limits.
        """
        plan.planned &= ~restart
        new = np.flatnonzero(~plan.planned)
        if len(new):
            self._plan(state, plan, new)
        due = np.flatnonzero(plan.clock >= min(self.every, self.horizon))
        if len(due):
            self._plan_again(state, plan, due)
        at = np.arange(len(state)), plan.clock
        deviation = wrapped_difference(state, plan.states[at], self.angles)
        action = plan.actions[at] + (plan.gains[at] @ deviation[..., None])[..., 0]
        plan.clock += 1
        low, high = self.model.action_limits
        return np.clip(action, low, high)

    def _plan(self, state: Floats, plan: Plan, rows: NDArray[np.int64]) -> None:
        """Plan from nothing: the cheapest of several improved guesses."""
        start = state[rows]
        guesses = self._guesses(start)  # (rows, candidates, T, m)
        count, many = guesses.shape[:2]
        solution = self._long.solve(
            np.repeat(start, many, axis=0),
            guesses.reshape(count * many, self.horizon, -1),
            allow_divergence=True,
        )
        cost = solution.cost.reshape(count, many)
        best = np.arange(count) * many + np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=1)
        self._keep(plan, rows, solution, best)

    def _plan_again(self, state: Floats, plan: Plan, rows: NDArray[np.int64]) -> None:
        """Improve the rest of the old plan from the present state; where it diverges, plan from nothing."""
        shift = np.minimum(plan.clock[rows, None] + np.arange(self.horizon), self.horizon)
        inside = shift < self.horizon
        kept = np.minimum(shift, self.horizon - 1)
        actions = plan.actions[rows[:, None], kept] * inside[..., None]
        gains = plan.gains[rows[:, None], kept]
        reference = plan.states[rows[:, None], shift]
        start = state[rows]
        turns = (
            start - reference[:, 0] - wrapped_difference(start, reference[:, 0], self.angles)
        )  # whole turns
        solution = self._short.solve(start, actions, gains, reference + turns[:, None], allow_divergence=True)
        good = np.isfinite(solution.cost)
        self._keep(plan, rows[good], solution, np.flatnonzero(good))
        if not good.all():
            self._plan(state, plan, rows[~good])

    def _keep(self, plan: Plan, rows: NDArray[np.int64], solution: Any, which: NDArray[np.int64]) -> None:
        bad = ~np.isfinite(solution.cost[which])
        plan.states[rows], plan.actions[rows] = solution.states[which], solution.actions[which]
        plan.gains[rows] = solution.gains[which]
        if bad.any():
            warnings.warn(
                f"every first guess diverges under the model from {np.count_nonzero(bad)} of {len(rows)} states, the "
                f"first {np.array2string(solution.states[which[bad]][0, 0], precision=3)}: nothing is done there until "
                "a plan is found. A shorter horizon, a larger ridge or data from there would help",
                ModelWarning,
                stacklevel=4,
            )
            lost = rows[bad]
            plan.states[lost] = solution.states[which[bad]][:, :1]
            plan.actions[lost], plan.gains[lost] = 0.0, 0.0
        plan.clock[rows] = 0
        plan.planned[rows] = True

    def _guesses(self, start: Floats) -> Floats:
        """(n, candidates, T, m) first guesses: doing nothing, and the best sequences of held actions."""
        n, m = len(start), self.model.n_action
        guesses = np.zeros((n, self.candidates, self.horizon, m))
        if self.candidates == 1:
            return guesses
        depth = min(TREE_DEPTH, max(1, self.horizon // self.hold))
        if m == 1:
            plans = tree_search(
                self.model,
                start,
                hold=self.hold,
                depth=depth,
                stage_cost=self.model.stage_cost,
                terminal_cost=self._rest,
                keep=self.candidates - 1,
            )
            found = plans.actions[:, :, : self.horizon]
        else:
            found = self._shots(start, depth)
        guesses[:, 1:, : found.shape[2]] = found
        return guesses

    def _shots(self, start: Floats, depth: int) -> Floats:
        """(n, candidates - 1, depth hold, m) the best of random sequences of held actions."""
        low, high = self.model.action_limits
        rng = np.random.default_rng(0)
        levels = rng.uniform(low, high, (SHOTS, depth, self.model.n_action))
        actions = np.repeat(levels, self.hold, axis=1)
        state = np.repeat(start[:, None], SHOTS, axis=1)
        cost = np.zeros(state.shape[:2])
        with np.errstate(over="ignore", invalid="ignore"):
            for t in range(actions.shape[1]):
                now = np.broadcast_to(actions[:, t], (len(start), SHOTS, actions.shape[2]))
                cost += self.model.stage_cost(state, now)
                state = self.model.flow(state, now)
            cost += self._rest(state)
        cost = np.where(np.isfinite(cost), cost, np.inf)
        best = np.argsort(cost, axis=1)[:, : self.candidates - 1]
        return actions[best]

    def _rest(self, state: Floats) -> Floats:
        """What a guess is charged for where it ends."""
        if self.terminal_cost is not None:
            return np.asarray(self.terminal_cost(state))
        return 10.0 * np.asarray(
            self.model.stage_cost(state, np.zeros((*state.shape[:-1], self.model.n_action)))
        )
