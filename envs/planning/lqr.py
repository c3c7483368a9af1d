"""Linear quadratic regulators on the error to a target, for states that hold unit quaternions.

The error dx of a state s to a target s* is s - s*, but a quaternion's four numbers become the three of vec(q*^-1 q)
(of the shorter turn). With E(s*) the derivative of s by dx at 0, whose transpose takes small changes of s back to dx,

    dx_{t+1} = A dx_t + B du_t + c,    A = E(s*_{t+1})^T (df/ds) E(s*_t),    B = E(s*_{t+1})^T (df/du),

and c the error of f(s*_t, u*_t) to s*_{t+1}, 0 where the target can be flown exactly. The controller is
u = u*_t - k_t - K_t dx_t: one K for ever (the Riccati equation), or one for each step of a target trajectory (its
backward recursion, where k looks ahead to what the target cannot have).

Reference: Abbeel and Ng 2005; Anderson and Moore 1990, "Optimal Control: Linear Quadratic Methods", Ch. 2 and 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.planning.controller_input import checked_batch
from beliefgym.envs.planning.linearisation import linearise
from beliefgym.envs.quaternions import conjugate, product
from beliefgym.envs.system import System

if TYPE_CHECKING:
    from beliefgym.envs.helicopter import Helicopter
    from beliefgym.envs.helicopter_competition import HelicopterCompetition
    from beliefgym.envs.helicopter_funnel import HelicopterFunnel

Floats = NDArray[np.float64]


def error_state(system: System, state: ArrayLike, target: ArrayLike) -> Floats:
    """The error dx of states to targets.

    Args:
        system: names where its quaternions begin. state: (..., n_state). target: (..., n_state), broadcast.

    Returns:
        (..., n_state - number of quaternions).
    """
    s, goal = np.broadcast_arrays(np.asarray(state, dtype=float), np.asarray(target, dtype=float))
    parts, after = [], 0
    for start in system.quaternions:
        parts.append(s[..., after:start] - goal[..., after:start])
        inverse = conjugate([goal[..., start + i] for i in range(4)])
        x, y, z, w = product(inverse, [s[..., start + i] for i in range(4)])
        parts.append(np.where(w < 0.0, -1.0, 1.0)[..., None] * np.stack([x, y, z], axis=-1))
        after = start + 4
    return np.concatenate([*parts, s[..., after:] - goal[..., after:]], axis=-1)


def error_basis(system: System, target: ArrayLike) -> Floats:
    """E: the derivative of the state by its error, at a target.

    Args:
        system: names where its quaternions begin. target: (..., n_state).

    Returns:
        (..., n_state, n_error), with orthonormal columns.
    """
    goal = np.asarray(target, dtype=float)
    n, size = goal.shape[-1], goal.shape[-1] - len(system.quaternions)
    basis = np.zeros((*goal.shape[:-1], n, size))
    shift = 0
    column = 0
    for i in range(n):
        if i in system.quaternions:
            x, y, z, w = (goal[..., i + j] for j in range(4))
            for j, parts in enumerate(((w, z, -y, -x), (-z, w, x, -y), (y, -x, w, -z))):
                basis[..., i : i + 4, column + j] = np.stack(parts, axis=-1)
            shift, column = i + 4, column + 3
        elif i >= shift:
            basis[..., i, column] = 1.0
            column += 1
    return basis


def error_dynamics(
    system: System, target: ArrayLike, action: ArrayLike, next_target: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """The linear model of the error, by automatic differentiation of `system.flow`.

    Args:
        system: the model. target: (..., n_state). action: (..., n_action). next_target: (..., n_state).

    Returns:
        A (..., n_error, n_error), B (..., n_error, n_action), c (..., n_error).
    """
    a, b = linearise(system, target, action)
    before, after = error_basis(system, target), error_basis(system, next_target).swapaxes(-1, -2)
    reached = system.flow(np.asarray(target, dtype=float), np.asarray(action, dtype=float))
    return after @ a @ before, after @ b, error_state(system, reached, next_target)


def steady_state_gain(a: ArrayLike, b: ArrayLike, q: ArrayLike, r: ArrayLike) -> tuple[Floats, Floats]:
    """K of the infinite-horizon regulator u = -K dx and the closed loop's eigenvalues.

    Args:
        a: (n, n). b: (n, m). q: (n, n) weight of the state. r: (m, m) weight of the action, positive definite.

    Returns:
        K (m, n), eigenvalues (n,), complex.

    Raises:
        ImportError: the package `control` is not installed.
    """
    try:
        import control
    except ImportError as error:
        raise ImportError("the LQR experts need python-control: pip install control") from error
    gain, _, eigenvalues = control.dlqr(*(np.asarray(part) for part in (a, b, q, r)), method="scipy")
    return np.asarray(gain, dtype=float), np.asarray(eigenvalues)


def trajectory_gains(a: Floats, b: Floats, c: Floats, q: Floats, r: Floats) -> tuple[Floats, Floats]:
    """K_t and k_t of the finite-horizon regulator u_t = -k_t - K_t dx_t that minimises the sum of dx'Q dx + u'R u.

    With V(dx) = dx'P dx + 2 p'dx from the end backwards, H = R + B'P B,

        K = H^-1 B'P A,   k = H^-1 B'(P c + p),   P <- Q + A'P (A - B K),   p <- (A - B K)'(P c + p)

    Args:
        a: (t, n, n). b: (t, n, m). c: (t, n). q: (n, n), also of the last state. r: (m, m), positive definite.

    Returns:
        K (t, m, n), k (t, m).
    """
    steps, n, m = b.shape
    gains, offsets = np.empty((steps, m, n)), np.empty((steps, m))
    cost, slope = np.array(q), np.zeros(n)
    for t in reversed(range(steps)):
        h = r + b[t].T @ cost @ b[t]
        pull = cost @ c[t] + slope
        gains[t] = np.linalg.solve(h, b[t].T @ cost @ a[t])
        offsets[t] = np.linalg.solve(h, b[t].T @ pull)
        closed = a[t] - b[t] @ gains[t]
        cost, slope = q + a[t].T @ cost @ closed, closed.T @ pull
        cost = 0.5 * (cost + cost.T)
    return gains, offsets


@dataclass(frozen=True, kw_only=True)
class ErrorFeedback:
    """u = u*_t - K_t dx, within the action limits, for a batch of states.

    Args:
        system: whose limits and quaternions count.
        targets: (t, n_state). actions: (t, n_action), the target's own with k_t taken off.
        gains: (t, n_action, n_error).
        clock: the state component that counts the steps of the episode and so chooses t; None where t is always 0.
    """

    system: System
    targets: Floats
    actions: Floats
    gains: Floats
    clock: int | None = None

    def act(self, state: ArrayLike, restart: NDArray[np.bool_] | None = None) -> Floats:
        """The action of each copy: it has no memory, so restarts change nothing.

        Args:
            state: (n, n_state). restart: (n,) or None.

        Returns:
            (n, n_action), within the limits.
        """
        states, _ = checked_batch(self.system, state, restart)
        if self.clock is None:
            error = error_state(self.system, states, self.targets[0])
            action = self.actions[0] - error @ self.gains[0].T
        else:
            t = np.clip(np.rint(states[:, self.clock]).astype(int), 0, len(self.targets) - 1)
            error = error_state(self.system, states, self.targets[t])
            action = self.actions[t] - np.einsum("nij,nj->ni", self.gains[t], error)
        return np.asarray(self.system.clip(action), dtype=float)


def regulator(
    system: System,
    target: Floats,
    action: Floats,
    state_weights: Floats,
    action_weights: Floats,
    ignored: Sequence[int] = (),
) -> ErrorFeedback:
    """The steady-state LQR around a state that its action keeps.

    Args:
        system: the model. target: (n_state,). action: (n_action,). state_weights: (n_error,), the diagonal of Q.
        action_weights: (n_action,), the diagonal of R.
        ignored: components of the error left out (such as a count of steps, which nothing can hold back).

    Returns:
        the controller.
    """
    a, b, _ = error_dynamics(system, target, action, target)
    kept = np.setdiff1d(np.arange(len(a)), ignored)
    gain, _ = steady_state_gain(
        a[np.ix_(kept, kept)], b[kept], np.diag(state_weights[kept]), np.diag(action_weights)
    )
    gains = np.zeros((1, *b.T.shape))
    gains[0][:, kept] = gain
    return ErrorFeedback(system=system, targets=target[None], actions=action[None], gains=gains)


def helicopter_weights(system: Helicopter) -> tuple[Floats, Floats]:
    """Q and R (diagonals) of a helicopter's cost: du_prev of the next state is the action, so its weight is R's."""
    change, velocity, position, rates, turn = system.weights
    state = np.zeros(20)
    for start, weight in ((8, velocity), (11, position), (14, rates), (17, turn)):
        state[start : start + 3] = weight
    return system.dt * state, np.full(4, system.dt * change)


def hover_expert(system: Helicopter, effort: float = 1.0) -> ErrorFeedback:
    """Steady-state LQR at trim; the source's du = K dx.

    Args:
        system: the model.
        effort: factor on the cost's weight of du. Below 1 the helicopter stays nearer to its place, with more stick
            and at a higher cost: at gusts of standard deviation 1 the cost's own optimum wanders by about 0.6 m.

    Returns:
        the controller.
    """
    state_weights, action_weights = helicopter_weights(system)
    return regulator(system, system.trim, np.zeros(4), state_weights, effort * action_weights)


def funnel_expert(system: HelicopterFunnel) -> ErrorFeedback:
    """LQR along the funnel: one gain for each step, and a look ahead to where the target turns."""
    targets = system.targets(np.arange(system.n_steps + 1))
    a, b, c = error_dynamics(system, targets[:-1], np.zeros((system.n_steps, 4)), targets[1:])
    state_weights, action_weights = helicopter_weights(system)
    q, r = np.diag(np.append(state_weights, 0.0)), np.diag(action_weights)  # the clock costs nothing
    gains, offsets = trajectory_gains(a, b, c, q, r)
    return ErrorFeedback(
        system=system, targets=targets[:-1], actions=-offsets, gains=gains, clock=system.n_state - 1
    )


def competition_expert(system: HelicopterCompetition) -> ErrorFeedback:
    """Steady-state LQR at trim for the reward's own weights; it knows the gust and its decay."""
    state_weights = np.zeros(19)
    state_weights[:12] = 1.0
    return regulator(
        system,
        system.trim,
        system.trim_action,
        state_weights,
        np.full(4, system.expert_effort),
        ignored=(18,),
    )
