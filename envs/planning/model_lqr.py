"""Linear quadratic regulators from a model: linearise at a target, expand the cost there, solve for the feedback.

With d the deviation from the target (x*, u*), A, B the model's derivatives there and c = f(x*, u*) - x* what the target
does not hold by itself,

    d_{t+1} = A d_t + B v_t + c,     v = u - u*,
    cost = (d' Q d + 2 d' N v + v' R v) / 2 + q' d + r' v           (the cost's expansion, Eq. 3.15)

is minimised by v = -k - K d. Backwards over a finite horizon from P = P_T, p = p_T (the Riccati recursion),

    H = R + B'P B,    K = H^-1 (B'P A + N'),    k = H^-1 (r + B'(P c + p)),
    P <- Q + A'P A - (B'P A + N')' K,           p <- q - K' r + (A - B K)' (P c + p),

and for ever by the stabilising solution of the algebraic Riccati equation, with p solved from its fixed point.

References: thesis proposal, Sec. 3.2.3, Eq. 3.15; Anderson & Moore 1990, "Optimal Control: Linear Quadratic Methods".
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import control
import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from beliefgym.envs.planning.learned_model import PlanningModel
from beliefgym.envs.planning.linearisation import clip_eigenvalues, expand_cost, linearise

Floats = NDArray[np.float64]

FALLBACK_STEPS = 100  # of the recursion, where the target cannot be stabilised
SINGULAR = 1e-9  # of the largest weight: added to R, which may be 0 where the action shows in the next state
NOT_CONVEX = 1e-8  # of the largest weight: a negative curvature beyond this is told


class ModelWarning(UserWarning):
    """A learned model, or a cost, with which control cannot do what was asked; the message says what is done."""


@dataclass(frozen=True, eq=False)
class LinearQuadraticProblem:
    """The problem of the module.

    Attributes:
        a: (n, n). b: (n, m). c: (n,). state_weight: Q (n, n). action_weight: R (m, m). cross_weight: N (n, m).
        state_slope: q (n,). action_slope: r (m,).
    """

    a: Floats
    b: Floats
    c: Floats
    state_weight: Floats
    action_weight: Floats
    cross_weight: Floats
    state_slope: Floats
    action_slope: Floats

    @classmethod
    def at(cls, model: PlanningModel, state: ArrayLike, action: ArrayLike) -> LinearQuadraticProblem:
        """The problem around a target (n,), (m,).

        A cost that curves down there is made convex (its negative eigenvalues become 0), which a `ModelWarning` tells.

        Raises:
            ValueError: shapes, or a derivative that is not finite.
        """
        x, u = np.asarray(state, dtype=float), np.asarray(action, dtype=float)
        n = len(x)
        a, b = linearise(model, x[None], u[None])
        slope, hessian = expand_cost(model.stage_cost, x[None], u[None], positive=False)
        values = np.linalg.eigvalsh(hessian[0])
        if values[0] < -NOT_CONVEX * max(abs(values[-1]), abs(values[0])):
            warnings.warn(
                f"expected a cost that is positive semidefinite at the target, got a curvature of {values[0]:.3g}; its "
                "negative directions count as flat: choose a target at the cost's minimum, or a convex cost",
                ModelWarning,
                stacklevel=2,
            )
        w = clip_eigenvalues(hessian)[0]
        w = 0.5 * (w + w.T)  # to the last bit: python-control refuses what is not
        r = w[n:, n:] + SINGULAR * max(float(np.abs(w).max()), 1e-300) * np.eye(len(u))
        c = np.asarray(model.flow(x[None], u[None]))[0] - x
        return cls(a[0], b[0], c, w[:n, :n], r, w[:n, n:], slope[0, :n], slope[0, n:])

    def steady_state(self) -> tuple[Floats, Floats, Floats]:
        """K (m, n), k (m,) and P (n, n) of the infinite horizon; the gains of a long finite one where there is none.

        A target that the model cannot stabilise is told by a `ModelWarning`.
        """
        try:
            gain, p, _ = control.dlqr(
                self.a, self.b, self.state_weight, self.action_weight, self.cross_weight, method="scipy"
            )
            gain, p = np.asarray(gain), np.asarray(p)
            closed = self.a - self.b @ gain
            radius = float(np.abs(np.linalg.eigvals(closed)).max())
            if not (np.isfinite(gain).all() and radius < 1.0 - 1e-9):
                raise np.linalg.LinAlgError(f"the closed loop's spectral radius is {radius:.4g}")
            slope = np.linalg.solve(
                np.eye(len(closed)) - closed.T,
                self.state_slope - gain.T @ self.action_slope + closed.T @ p @ self.c,
            )
        except (np.linalg.LinAlgError, ValueError) as error:
            warnings.warn(
                f"the model's linearisation at the target has no stabilising regulator ({error}); the gains of "
                f"{FALLBACK_STEPS} steps are taken instead. More data near the target, a larger ridge, or a cost that "
                "sees every unstable direction would help",
                ModelWarning,
                stacklevel=2,
            )
            gains, offsets, p = self.finite_horizon(FALLBACK_STEPS)
            return gains[0], offsets[0], p
        h = self.action_weight + self.b.T @ p @ self.b
        offset = np.linalg.solve(h, self.action_slope + self.b.T @ (p @ self.c + slope))
        return gain, offset, p

    def finite_horizon(
        self, horizon: int, terminal_weight: Floats | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """K (T, m, n), k (T, m) and P (n, n) at the first step, by the Riccati recursion.

        Args:
            horizon: T. terminal_weight: P_T (n, n); Q if None.
        """
        m, n = self.b.shape[1], len(self.a)
        gains, offsets = np.empty((horizon, m, n)), np.empty((horizon, m))
        p = np.array(self.state_weight if terminal_weight is None else terminal_weight)
        slope = np.array(self.state_slope)
        with np.errstate(over="ignore", invalid="ignore"):
            for t in reversed(range(horizon)):
                h = self.action_weight + self.b.T @ p @ self.b
                both = self.b.T @ p @ self.a + self.cross_weight.T
                pull = p @ self.c + slope
                gain = np.linalg.solve(h, both)
                offset = np.linalg.solve(h, self.action_slope + self.b.T @ pull)
                if not (
                    np.isfinite(gain).all() and np.isfinite(offset).all()
                ):  # P overflowed: an unstable model
                    gains[: t + 1], offsets[: t + 1] = gains[t + 1], offsets[t + 1]
                    break
                gains[t], offsets[t] = gain, offset
                closed = self.a - self.b @ gain
                p = self.state_weight + self.a.T @ p @ self.a - both.T @ gain
                p = 0.5 * (p + p.T)
                slope = self.state_slope - gain.T @ self.action_slope + closed.T @ pull
        return gains, offsets, p


@dataclass(frozen=True, eq=False)
class LinearFeedback:
    """u = clip(u* - k_t - K_t (x - x*)), with t the step of the episode, at most the last; a policy from a model.

    Attributes:
        target: x* (n,). action: u* (m,). gains: (T, m, n). offsets: (T, m); T = 1 for a steady state.
        action_limits: lowest and highest action. angles: components whose differences are wrapped.
    """

    target: Floats
    action: Floats
    gains: Floats
    offsets: Floats
    action_limits: tuple[Floats, Floats]
    angles: Collection[int] = ()

    @classmethod
    def of(
        cls,
        model: PlanningModel,
        target: Floats,
        action: Floats,
        *,
        horizon: int | None = None,
        angles: Collection[int] = (),
    ) -> LinearFeedback:
        """The regulator of a model about a target; for ever, or over a horizon of steps."""
        problem = LinearQuadraticProblem.at(model, target, action)
        if horizon is None:
            gain, offset, _ = problem.steady_state()
            gains, offsets = gain[None], offset[None]
        else:
            gains, offsets, _ = problem.finite_horizon(horizon)
        return cls(target, action, gains, offsets, model.action_limits, angles)

    def begin(self, n: int) -> NDArray[np.int64]:
        """The memory of n copies: their steps."""
        return np.zeros(n, dtype=np.int64)

    def act(self, state: Floats, memory: NDArray[np.int64], restart: NDArray[np.bool_]) -> Floats:
        """(n, d), the memory (changed in place), (n,) bool -> (n, m)."""
        memory[restart] = 0
        t = np.minimum(memory, len(self.gains) - 1)
        memory += 1
        deviation = wrapped_difference(state, self.target, self.angles)
        action = self.action - self.offsets[t] - (self.gains[t] @ deviation[..., None])[..., 0]
        return np.clip(action, *self.action_limits)


def terminal_cost_of(
    model: PlanningModel, target: Floats, action: Floats, angles: Collection[int] = ()
) -> Any:
    """d' P d / 2 of the infinite horizon at a target, as a cost of states; None where it cannot be stabilised."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        weight = LinearQuadraticProblem.at(model, target, action).steady_state()[2]
    if any(issubclass(one.category, ModelWarning) for one in told) or not np.isfinite(weight).all():
        return None
    return QuadraticDeviation(weight, target, tuple(angles))


@dataclass(frozen=True, eq=False)
class QuadraticDeviation:
    """d' W d / 2 with d = x - x* and differences of angles wrapped; (..., n) -> (...), numpy and torch."""

    weight: Floats
    target: Floats
    angles: tuple[int, ...] = ()

    def __call__(self, state: Any) -> Any:
        """(..., n) -> (...)."""
        xp = array_namespace(state)
        d = state - xp.asarray(self.target)
        if self.angles:
            parts = [d[..., i] for i in range(d.shape[-1])]
            for i in self.angles:
                parts[i] = parts[i] - 2.0 * np.pi * xp.floor(parts[i] / (2.0 * np.pi) + 0.5)
            d = xp.stack(parts, axis=-1)
        return 0.5 * ((d @ xp.asarray(self.weight)) * d).sum(-1)


def wrapped_difference(a: Floats, b: Floats, angles: Collection[int]) -> Floats:
    """a - b, with the differences of the angles in [-pi, pi); (..., n)."""
    difference = a - b
    for i in angles:
        difference[..., i] -= 2.0 * np.pi * np.floor(difference[..., i] / (2.0 * np.pi) + 0.5)
    return difference


def cheapest_point(
    cost: Any, n_state: int, n_action: int, angles: Collection[int] = (), action_limits: Any = None
) -> tuple[Floats, Floats]:
    """The state and action of lowest cost: where a regulator is to go.

    Searched from 0, and from half a turn of each angle, by BFGS with exact gradients; a cost without a minimum gives
    the best point found.

    Returns:
        (n_state,) and (n_action,), the action within the limits.
    """

    def with_gradient(z: Floats) -> tuple[float, Floats]:
        slope, _ = expand_cost(cost, z[None, :n_state], z[None, n_state:], positive=False)
        value = cost(z[None, :n_state], z[None, n_state:])
        return float(np.asarray(value)[0]), slope[0]

    bounds: list[tuple[float | None, float | None]] = [(None, None)] * n_state
    low, high = ([None] * n_action,) * 2 if action_limits is None else action_limits
    bounds += list(zip(low, high, strict=True))
    starts = [np.zeros(n_state + n_action)]
    for i in angles:
        starts += [np.pi * np.eye(n_state + n_action)[i] + 1e-3]
    found = [minimize(with_gradient, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    best = min(found, key=lambda one: one.fun if np.isfinite(one.fun) else np.inf)
    z = found[0].x if found[0].fun <= best.fun + 1e-9 * (1.0 + abs(best.fun)) else best.x
    return z[:n_state], z[n_state:]
