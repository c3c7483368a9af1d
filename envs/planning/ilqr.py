"""Iterative LQR with control limits, for a whole batch of problems at once.

It minimises, from each initial state s_0 and over the actions u_0 ... u_{T-1} within their limits,

    J = sum_{t<T} l(s_t, u_t) + l_T(s_T),      s_{t+1} = f(s_t, u_t),

by repeating, with A = f_s, B = f_u at the present trajectory and V, v the Hessian and gradient of the cost to go,

    q_s = l_s + A' v,              q_u = l_u + B' v
    Q_ss = l_ss + A' V A,          Q_uu = l_uu + B' V B,           Q_us = l_us + B' V A
    k = argmin_d q_u' d + d' (Q_uu + mu (B'B + I)) d / 2    with u + d within the limits
    K = -(Q_uu + mu (B'B + I))_ff^-1 (Q_us + mu B'A)_f      in the components f that no limit holds
    V <- Q_ss + K' Q_uu K + K' Q_us + Q_us' K,    v <- q_s + K' Q_uu k + K' q_u + Q_us' k

backwards in time, and then forwards the roll-out u = clip(u + alpha k + K (s_new - s)) for all step sizes alpha at
once; the best is kept if it lowers J. mu falls after a success and rises after a failure (Levenberg-Marquardt).

Reference: Li and Todorov 2004 (iLQR); Tassa, Erez and Todorov 2012, Secs. II-F and II-G (regularisation, line
search); Tassa, Mansard and Todorov 2014 (control limits). Deviations: the Hessian of the cost is made positive
semidefinite; the step size is the best of all, not the first that passes; mu acts on V and on Q_uu.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.planning.box_qp import box_qp, solve_free
from beliefgym.envs.planning.learned_model import PlanningModel
from beliefgym.envs.planning.linearisation import expand_cost, linearise

Floats = NDArray[np.float64]

STEP_SIZES = 0.5 ** np.arange(9)
MU_MIN, MU_MAX, MU_FACTOR = 1e-6, 1e8, 2.0
RIDGE = 1e-10  # keeps Q_uu invertible where an action changes nothing
HUGE = 1e6  # a roll-out with a state component beyond this has diverged


@dataclass(frozen=True)
class ILQRSolution:
    """Plans of b problems.

    Attributes:
        states: (b, T + 1, n). actions: (b, T, m), within the limits.
        gains: (b, T, m, n); the feedback u_t + gains_t (s - s_t) is optimal near the plan.
        cost: (b,). converged: bool (b,).
        iterations: (b,) int.
    """

    states: Floats
    actions: Floats
    gains: Floats
    cost: Floats
    converged: NDArray[np.bool_]
    iterations: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class ILQR:
    """The planner; see the module for what it minimises and how.

    Args:
        system: a `System`, whose noise is left out of the plan, or a `LearnedModel`.
        horizon: T, in steps.
        stage_cost: (state (..., n), action (..., m)) -> (...), for numpy and torch; `system.stage_cost` if None.
        terminal_cost: (state (..., n)) -> (...), for numpy and torch; none if None.
        max_iterations: at most so many backward passes.
        tolerance: a problem has converged when the model expects to lower J by less than tolerance (1 + |J|).

    Raises:
        ValueError: a horizon, max_iterations or tolerance that is not positive.
    """

    system: PlanningModel
    horizon: int
    stage_cost: Callable[[Any, Any], Any] | None = None
    terminal_cost: Callable[[Any], Any] | None = None
    max_iterations: int = 100
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        for name in ("horizon", "max_iterations", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")

    def solve(
        self,
        initial_state: ArrayLike,
        initial_actions: ArrayLike | None = None,
        initial_gains: ArrayLike | None = None,
        initial_states: ArrayLike | None = None,
        allow_divergence: bool = False,
    ) -> ILQRSolution:
        """Plan from each initial state; a problem does not depend on the others of the batch.

        Args:
            initial_state: (b, n).
            initial_actions: (b, T, m), the first guess; zeros if None.
            initial_gains: (b, T, m, n), feedback about initial_states that the first roll-out uses: a plan that
                was made for a nearby initial state, as a warm start.
            initial_states: (b, T + 1, n) or (b, T, n); needed with initial_gains.
            allow_divergence: leave a problem whose first roll-out diverges as it is, with infinite cost, instead of
                raising; the others go on.

        Returns:
            the plans.

        Raises:
            ValueError: wrong shapes, a value that is not finite, or a first roll-out that diverges.
        """
        start, actions, gains, reference = self._check(
            initial_state, initial_actions, initial_gains, initial_states
        )
        search = _Search(self, start, actions, gains, reference, allow_divergence)
        for _ in range(self.max_iterations):
            if not search.improve():
                break
        return search.solution()

    def cost(self, states: ArrayLike, actions: ArrayLike) -> Floats:
        """J of trajectories: states (..., T + 1, n), actions (..., T, m) -> (...)."""
        states, actions = np.asarray(states, dtype=float), np.asarray(actions, dtype=float)
        total = self._stage(states[..., :-1, :], actions).sum(axis=-1)
        return total if self.terminal_cost is None else total + self.terminal_cost(states[..., -1, :])

    @property
    def _stage(self) -> Callable[[Any, Any], Any]:
        return self.stage_cost or self.system.stage_cost

    def _check(
        self, state: ArrayLike, actions: Any, gains: Any, reference: Any
    ) -> tuple[Floats, Floats, Floats | None, Floats | None]:
        """The inputs as time-major float64 arrays: (b, n), (T, b, m), (T, b, m, n), (T, b, n)."""
        n, m, horizon = self.system.n_state, self.system.n_action, self.horizon
        start = np.asarray(state, dtype=np.float64)
        if start.ndim != 2 or start.shape[1] != n:
            raise ValueError(f"expected initial_state as (b, {n}), got shape {start.shape}")
        if actions is None:
            actions = np.zeros((len(start), horizon, m))
        expected: dict[str, tuple[Any, tuple[int, ...]]] = {"initial_actions": (actions, (horizon, m))}
        if (gains is None) != (reference is None):
            raise ValueError("initial_gains and initial_states belong together: pass both or neither")
        if gains is not None:
            reference = np.asarray(reference)
            reference = reference[:, :horizon] if reference.ndim == 3 else reference
            expected["initial_gains"] = (gains, (horizon, m, n))
            expected["initial_states"] = (reference, (horizon, n))
        arrays = []
        for name, (value, shape) in expected.items():
            array = np.asarray(value, dtype=np.float64)
            if array.shape != (len(start), *shape):
                raise ValueError(f"expected {name} as {(len(start), *shape)}, got shape {array.shape}")
            if not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0][0])
                raise ValueError(f"{name} of problem {row} is not finite")
            arrays.append(np.ascontiguousarray(array.swapaxes(0, 1)))
        if not np.isfinite(start).all():
            raise ValueError(
                f"initial_state of problem {int(np.argwhere(~np.isfinite(start))[0][0])} is not finite"
            )
        return start, arrays[0], *((arrays[1], arrays[2]) if gains is not None else (None, None))


class _Search:
    """The state of one solve; arrays are time-major. Rows that are finished are left out of the work."""

    def __init__(
        self,
        problem: ILQR,
        start: Floats,
        actions: Floats,
        gains: Floats | None,
        reference: Floats | None,
        allow_divergence: bool,
    ) -> None:
        self.problem = problem
        self.low, self.high = problem.system.action_limits
        b, n, m, horizon = len(start), start.shape[1], actions.shape[2], problem.horizon
        if gains is None or reference is None:
            gains, reference = np.zeros((horizon, b, m, n)), np.zeros((horizon, b, n))
        states, self.actions = self._roll_out(start[None], actions[:, None], gains, reference)
        self.states, self.actions = states[:, 0], self.actions[:, 0]
        self.cost = self._cost(self.states, self.actions)
        if not (allow_divergence or np.isfinite(self.cost).all()):
            row = int(np.flatnonzero(~np.isfinite(self.cost))[0])
            raise ValueError(
                f"the first roll-out of problem {row} diverges (a state beyond {HUGE:g}); pass initial_actions "
                "that keep it bounded, with initial_gains where the system is unstable, or a shorter horizon"
            )
        self.gains = np.zeros((horizon, b, m, n))
        self.mu = np.zeros(b)
        self.active = np.flatnonzero(np.isfinite(self.cost))
        self.stale = np.ones(b, dtype=bool)  # whose derivatives belong to an older trajectory
        self.converged = np.zeros(b, dtype=bool)
        self.iterations = np.zeros(b, dtype=np.int64)
        size = n + m
        self.jacobian = np.empty((horizon, b, n, size))
        self.stage = (np.empty((horizon, b, size)), np.empty((horizon, b, size, size)))
        self.terminal = (np.zeros((b, n)), np.zeros((b, n, n)))

    def solution(self) -> ILQRSolution:
        """The plans, with undamped gains about their last trajectories."""
        rows = np.flatnonzero((~self.converged | (self.mu > 0.0)) & np.isfinite(self.cost))
        if len(rows):
            self.active = rows
            self.mu[rows] = 0.0
            self._differentiate()
            self.gains[:, rows] = self._backward(rows)[1]

        def rows_first(array: Floats) -> Floats:
            return np.ascontiguousarray(array.swapaxes(0, 1))

        return ILQRSolution(
            states=rows_first(self.states),
            actions=rows_first(self.actions),
            gains=rows_first(self.gains),
            cost=self.cost,
            converged=self.converged,
            iterations=self.iterations,
        )

    def improve(self) -> bool:
        """One iteration of every unfinished problem; False when none is left."""
        if not len(self.active):
            return False
        self._differentiate()
        rows = self.active
        steps, gains, expected = self._backward(rows)
        self.gains[:, rows] = gains
        self.iterations[rows] += 1
        done = (expected <= self.problem.tolerance * (1.0 + np.abs(self.cost[rows]))) & (self.mu[rows] <= 1.0)
        self.converged[rows[done]] = True
        rows, steps, gains = rows[~done], steps[:, ~done], gains[:, ~done]
        if not len(rows):
            return False

        old_states, old_actions = self.states[:, rows], self.actions[:, rows]
        guess = old_actions[:, None] + STEP_SIZES[:, None, None] * steps[:, None]  # (T, step sizes, rows, m)
        states, actions = self._roll_out(old_states[:1], guess, gains, old_states[:-1])
        cost = self._cost(states, actions)
        best = cost.argmin(axis=0)
        lowest = cost[best, np.arange(len(rows))]
        better = lowest < self.cost[rows]
        taken = rows[better]
        self.states[:, taken] = states[:, best[better], better.nonzero()[0]]
        self.actions[:, taken] = actions[:, best[better], better.nonzero()[0]]
        self.cost[taken] = lowest[better]
        self.stale[:] = False
        self.stale[taken] = True

        mu = self.mu[rows]
        lowered = np.where(mu > MU_MIN, mu / (2.0 * MU_FACTOR), 0.0)
        raised = np.maximum(mu * (2.0 * MU_FACTOR) ** 2, MU_MIN)
        self.mu[rows] = np.where(better, lowered, raised)
        self.active = rows[self.mu[rows] <= MU_MAX]
        return bool(len(self.active))

    def _roll_out(
        self, start: Floats, actions: Floats, gains: Floats, reference: Floats
    ) -> tuple[Floats, Floats]:
        """Trajectories under clip(action_t + K_t (s - reference_t)), for several action sequences.

        Args:
            start: (1, rows, n). actions: (T, c, rows, m). gains: (T, rows, m, n). reference: (T, rows, n).

        Returns:
            states (T + 1, c, rows, n) and actions (T, c, rows, m); not finite where they diverge.
        """
        horizon, c, rows, _ = actions.shape
        states = np.empty((horizon + 1, c, rows, start.shape[2]))
        states[0] = start
        taken = np.empty_like(actions)
        with np.errstate(over="ignore", invalid="ignore"):
            for t in range(horizon):
                feedback = (gains[t] @ (states[t] - reference[t])[..., None])[..., 0]
                taken[t] = np.clip(actions[t] + feedback, self.low, self.high)
                states[t + 1] = self.problem.system.flow(states[t], taken[t])
        return states, taken

    def _cost(self, states: Floats, actions: Floats) -> Floats:
        """J of time-major trajectories, infinite where they diverge: (T + 1, ..., n) -> (...)."""
        with np.errstate(over="ignore", invalid="ignore"):
            cost = self.problem.cost(np.moveaxis(states, 0, -2), np.moveaxis(actions, 0, -2))
            bounded = (np.abs(states) < HUGE).all(axis=(0, -1))
        return np.where(bounded & np.isfinite(cost), cost, np.inf)

    def _differentiate(self) -> None:
        """Derivatives at the trajectories that have moved."""
        rows = self.active[self.stale[self.active]]
        if not len(rows):
            return
        states, actions = self.states[:, rows], self.actions[:, rows]
        n = states.shape[2]
        a, b = linearise(self.problem.system, states[:-1], actions)
        self.jacobian[:, rows, :, :n], self.jacobian[:, rows, :, n:] = a, b
        for mine, new in zip(self.stage, expand_cost(self.problem._stage, states[:-1], actions), strict=True):
            mine[:, rows] = new
        if self.problem.terminal_cost is not None:
            for mine, new in zip(
                self.terminal, expand_cost(self.problem.terminal_cost, states[-1]), strict=True
            ):
                mine[rows] = new

    def _backward(self, rows: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
        """The steps k (T, rows, m), the gains K (T, rows, m, n), and by how much a full step should lower J."""
        v, vv = self.terminal[0][rows], self.terminal[1][rows]
        n = v.shape[1]
        mu = self.mu[rows, None, None]
        actions, jacobians = self.actions[:, rows], self.jacobian[:, rows]
        gradients, hessians = self.stage[0][:, rows], self.stage[1][:, rows]
        m = actions.shape[2]
        steps, gains = np.empty_like(actions), np.empty((*actions.shape, n))
        expected = np.zeros(len(rows))
        ridge = (mu + RIDGE) * np.eye(m)
        for t in reversed(range(self.problem.horizon)):
            jacobian = jacobians[t]
            transposed = jacobian.swapaxes(1, 2)
            q = gradients[t] + (transposed @ v[..., None])[..., 0]
            qq = hessians[t] + transposed @ vv @ jacobian
            q_u, q_uu, q_us = q[:, n:], qq[:, n:, n:], qq[:, n:, :n]
            damping = mu * (transposed[:, n:] @ jacobian)
            damped = q_uu + damping[..., n:] + ridge
            step, free = box_qp(damped, q_u, self.low - actions[t], self.high - actions[t])
            gain = -solve_free(damped, free, q_us + damping[..., :n])
            turned = gain.swapaxes(1, 2)
            quu_step = (q_uu @ step[..., None])[..., 0]
            expected -= (step * (q_u + 0.5 * quu_step)).sum(axis=1)
            v = (
                q[:, :n]
                + (turned @ (quu_step + q_u)[..., None] + q_us.swapaxes(1, 2) @ step[..., None])[..., 0]
            )
            vv = qq[:, :n, :n] + turned @ (q_uu @ gain + q_us) + q_us.swapaxes(1, 2) @ gain
            vv = 0.5 * (vv + vv.swapaxes(1, 2))
            steps[t], gains[t] = step, gain
        return steps, gains, expected
