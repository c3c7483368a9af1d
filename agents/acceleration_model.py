"""`AccelerationModel`: a helicopter's accelerations learned in body axes, all else integrated from what is known.

With v_b the velocity in body axes, w the body rates, u = u_prev + du the sticks and R the turn from body to NED,

    v' = v + dt (R C phi + [0, 0, g]),      w' = w + dt D phi,      phi = [v_b; w; u; 1]
    u_prev' = u,      du_prev' = du,      ned' = ned + dt v,      q' = q exp(dt w)

Only C (3 x 10) and D (3 x 10) are learned: gravity, inertia and the change of axes need no data. With
`coupling=False` each row has only the terms of its own axis, as the paper's models have: C of v_b's component and 1,
and u4 in the last; D of w's component, its stick and 1.

Two criteria:

- one step: least squares of the accelerations;
- lagged, with a horizon H: the error of simulations of 1 .. H steps from every state of the data,

      sum_t sum_{h=1..H} |v_{t+h} - v^_{t+h|t}|^2 / s_v^2 + |w_{t+h} - w^_{t+h|t}|^2 / s_w^2.

  For simulated states s^_{t+k|t} held fixed, v^_{t+h|t} = v_t + dt sum_{k<h} (R^_k C phi^_k + [0, 0, g]) is linear in
  C, and so is w^ in D. So: simulate with the present model, solve the least squares for new coefficients, go as far
  towards them as lowers the criterion, repeat.

Reference: Abbeel, Ganapathi & Ng 2006, "Learning vehicular dynamics, with application to modeling helicopters" (NIPS
18), acceleration prediction and the longer time-scale criterion. Chosen here: scales s_v, s_w (the one-step residuals'
root mean square), the ridge, and the halving of the step.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from beliefgym.agents.coordinates import ERROR
from beliefgym.envs.helicopter import Helicopter
from beliefgym.envs.quaternions import integrate, product, rotate, rotate_inverse
from beliefgym.learning.dynamics import DynamicsModel, Standardise, Target
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
STICKS, CHANGES, VELOCITY, POSITION = slice(0, 4), slice(4, 8), slice(8, 11), slice(11, 14)
RATES, ATTITUDE = slice(14, 17), slice(17, 20)
NAMES = (*Helicopter.state_names[:17], *ERROR)
N_TERMS = 11  # v_b (3), rates (3), sticks (4), 1
OWN_AXIS = np.zeros((6, N_TERMS), dtype=np.bool_)  # which terms each of the six rows has without coupling
for _axis in range(3):
    OWN_AXIS[_axis, [_axis, 10]] = True
    OWN_AXIS[3 + _axis, [3 + _axis, 6 + _axis, 10]] = True
OWN_AXIS[2, 9] = True  # the collective lifts
HALVINGS = 6


class AccelerationModel(DynamicsModel):
    """The model of the module, on the helicopter's 20 coordinates (its state with the attitude's error vector).

    Args:
        horizon: H of the lagged criterion; 1 for one-step least squares.
        n_iterations: of the lagged criterion, at most.
        alpha: ridge penalty a sample, on standardised terms; the constant is not penalised.
        coupling: whether every row has all terms, or only those of its own axis.
        dt: s. gravity: m/s^2. attitude: q* (x, y, z, w) that the error vector is taken to; None for `Helicopter`'s
            trim.
        target, standardise, use_actions, divergence_limit: of `DynamicsModel`; the first three must stay.

    Attributes:
        coefficients_: (6, 11) C above D, of [v_b (m/s); rates (rad/s); sticks; 1], in m/s^2 and rad/s^2 for a unit.
        criteria_: the lagged criterion before and after each iteration, mean over t and h; empty for one step.

    Raises:
        ValueError: parameters out of range, or data of other components.

    Example:
        >>> SystemIdentification("HelicopterHover-v0", model=AccelerationModel(horizon=10))  # doctest: +SKIP
    """

    _fitted_attribute = "coefficients_"

    def __init__(
        self,
        horizon: int = 1,
        *,
        n_iterations: int = 10,
        alpha: float = 1e-6,
        coupling: bool = True,
        dt: float = Helicopter.dt,
        gravity: float = Helicopter.gravity,
        attitude: tuple[float, float, float, float] | None = None,
        target: Target = "delta",
        standardise: Standardise = False,
        use_actions: bool = True,
        divergence_limit: float = 100.0,
    ) -> None:
        self.horizon = horizon
        self.n_iterations = n_iterations
        self.alpha = alpha
        self.coupling = coupling
        self.dt, self.gravity, self.attitude = dt, gravity, attitude
        self.target, self.standardise = target, standardise
        self.use_actions, self.divergence_limit = use_actions, divergence_limit

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Learn from trajectories of the 20 coordinates and the 4 changes of the sticks; validation is not used."""
        self._check_parameters()
        self._begin(train, validation)
        if (self.n_obs_, self.n_act_) != (len(NAMES), 4):
            raise ValueError(
                f"expected trajectories of the helicopter's {len(NAMES)} coordinates {NAMES} and 4 actions, got "
                f"{self.n_obs_} and {self.n_act_}"
            )
        self._target = np.asarray(Helicopter().trim[17:] if self.attitude is None else self.attitude)
        self.criteria_: list[float] = []
        self.coefficients_ = np.zeros((6, N_TERMS))
        x, u = train.observations, train.actions
        episode, t = np.nonzero(train.step_mask)
        here, after, action = x[episode, t], x[episode, t + 1], u[episode, t]
        terms = self._terms(here, action)
        turn = self._attitude(here)
        change = (after[:, VELOCITY] - here[:, VELOCITY]) / self.dt - [0.0, 0.0, self.gravity]
        accelerations = np.concatenate(
            [_stack(rotate_inverse(turn, _parts(change))), (after[:, RATES] - here[:, RATES]) / self.dt],
            axis=1,
        )
        self._scale = np.maximum(terms.std(axis=0), 1e-9)
        for row, kept in enumerate(self._kept()):
            gram, cross = terms[:, kept].T @ terms[:, kept], terms[:, kept].T @ accelerations[:, row]
            self.coefficients_[row, kept] = self._solve(gram, cross, len(terms), np.flatnonzero(kept))
        if self.horizon > 1:
            residual = self.dt * (accelerations - terms @ self.coefficients_.T)
            spread = np.sqrt(np.square(residual.reshape(-1, 2, 3)).mean(axis=(0, 2)))
            self._weights = 1.0 / np.maximum(spread, 1e-12)
            self._fit_lagged(train)
        return self

    def _fit_lagged(self, train: Sequences) -> None:
        """The iterations of the module, from the one-step solution."""
        pieces = train.segments(self.horizon, 1, keep_tail=True)
        solved, criterion = self._linear_problem(pieces)
        self.criteria_.append(criterion)
        for _ in range(self.n_iterations):
            before = self.coefficients_
            for halving in range(HALVINGS):
                self.coefficients_ = before + 0.5**halving * (solved - before)
                following, reached = self._linear_problem(pieces)
                if reached < criterion:
                    break
            else:
                self.coefficients_ = before
                return
            gain = criterion - reached
            solved, criterion = following, reached
            self.criteria_.append(criterion)
            if gain < 1e-6 * criterion:
                return

    def _linear_problem(self, pieces: Sequences) -> tuple[Array, float]:
        """Simulate every piece; the coefficients that fit the lagged error best at these states, and that error.

        Returns:
            (6, 11) and the criterion (infinite where a simulation diverges).
        """
        x, u, lengths = pieces.observations, pieces.actions, pieces.lengths
        now = x[:, 0].copy()
        n = len(now)
        kept = self._kept()
        # sums over the steps so far of R_k kron phi_k and of phi_k
        moved, turned = np.zeros((n, 3, 3, N_TERMS)), np.zeros((n, N_TERMS))
        fallen = np.array([0.0, 0.0, self.gravity * self.dt])
        size = 3 * N_TERMS
        gram_v, cross_v = np.zeros((size, size)), np.zeros(size)
        gram_w, cross_w = np.zeros((N_TERMS, N_TERMS)), np.zeros((N_TERMS, 3))
        total, count = 0.0, 0
        with np.errstate(over="ignore", invalid="ignore"):
            for h in range(1, pieces.n_steps + 1):
                terms = self._terms(now, u[:, h - 1])
                turn = self._attitude(now)
                rotation = np.stack([_stack(rotate(turn, axis)) for axis in np.eye(3)], axis=-1)  # columns
                moved += self.dt * rotation[..., None] * terms[:, None, None, :]
                turned += self.dt * terms
                now = self._advance(now, u[:, h - 1])
                on = lengths >= h
                error = x[on, h] - now[on]
                squares = np.square(error[:, VELOCITY]).sum() * self._weights[0] ** 2
                total += float(squares + np.square(error[:, RATES]).sum() * self._weights[1] ** 2)
                count += int(on.sum())
                a = moved[on].reshape(-1, size)
                gram_v += a.T @ a
                cross_v += a.T @ (x[on, h, VELOCITY] - x[on, 0, VELOCITY] - h * fallen).ravel()
                gram_w += turned[on].T @ turned[on]
                cross_w += turned[on].T @ (x[on, h, RATES] - x[on, 0, RATES])
        solved = np.zeros((6, N_TERMS))
        if not (np.isfinite(total) and np.isfinite(gram_v).all()):
            return solved, np.inf
        mine = np.flatnonzero(kept[:3].ravel())
        solved[:3].reshape(-1)[mine] = self._solve(
            gram_v[np.ix_(mine, mine)], cross_v[mine], count * self.dt**2, mine % N_TERMS
        )
        for row in range(3):
            terms_of = np.flatnonzero(kept[3 + row])
            solved[3 + row, terms_of] = self._solve(
                gram_w[np.ix_(terms_of, terms_of)], cross_w[terms_of, row], count * self.dt**2, terms_of
            )
        return solved, total / count

    def _solve(self, gram: Array, cross: Array, n: float, terms: NDArray[np.int64]) -> Array:
        """Ridge regression; `terms` (k,) says which term each column is."""
        penalty = np.where(terms == N_TERMS - 1, 1e-12, self.alpha * n * self._scale[terms] ** 2)
        solution: Array = np.linalg.lstsq(gram + np.diag(penalty), cross, rcond=None)[0]
        return solution

    def _kept(self) -> NDArray[np.bool_]:
        """(6, 11) which terms each row has."""
        return np.ones_like(OWN_AXIS) if self.coupling else OWN_AXIS

    def _attitude(self, x: Array) -> Any:
        """q = q* [d; sqrt(1 - |d|^2)], four components (n,)."""
        d = x[:, ATTITUDE]
        w = np.sqrt(np.maximum(1.0 - np.square(d).sum(axis=1), 0.0))
        return product(list(self._target), [*_parts(d), w])

    def _terms(self, x: Array, u: Array) -> Array:
        """(n, 11) phi."""
        body = _stack(rotate_inverse(self._attitude(x), _parts(x[:, VELOCITY])))
        return np.concatenate([body, x[:, RATES], x[:, STICKS] + u, np.ones((len(x), 1))], axis=1)

    def _advance(self, x: Array, u: Array) -> Array:
        """The next coordinates."""
        accelerations = self._terms(x, u) @ self.coefficients_.T
        after = np.empty_like(x)
        after[:, STICKS] = x[:, STICKS] + u
        after[:, CHANGES] = u
        pull = _stack(rotate(self._attitude(x), _parts(accelerations[:, :3])))
        after[:, VELOCITY] = x[:, VELOCITY] + self.dt * (pull + np.array([0.0, 0.0, self.gravity]))
        after[:, POSITION] = x[:, POSITION] + self.dt * x[:, VELOCITY]
        after[:, RATES] = x[:, RATES] + self.dt * accelerations[:, 3:]
        d = x[:, ATTITUDE]
        w = np.sqrt(np.maximum(1.0 - np.square(d).sum(axis=1), 0.0))
        turned = _stack(integrate([*_parts(d), w], _parts(x[:, RATES]), self.dt))
        after[:, ATTITUDE] = np.where(turned[:, 3:] < 0.0, -turned[:, :3], turned[:, :3])
        return after

    def _step(self, z: Array, u: Array) -> Array:
        after = self._advance(self._observed.invert(z), self._acted.invert(u))
        return self._observed.apply(after)

    def _check_parameters(self) -> None:
        for name in ("horizon", "n_iterations"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"expected {name} to be a whole number of at least 1, got {value!r}")
        if not (np.isfinite(self.alpha) and self.alpha >= 0):
            raise ValueError(f"expected alpha finite and at least 0, got {self.alpha!r}")
        for name, must in (("target", "delta"), ("standardise", False), ("use_actions", True)):
            if getattr(self, name) != must:
                raise ValueError(
                    f"expected {name} to stay {must!r}, got {getattr(self, name)!r}: this model works in the data's "
                    "units"
                )


def _parts(v: Array) -> list[Array]:
    """(n, 3) or (3,) -> three (n,)."""
    return [v[..., i] for i in range(v.shape[-1])]


def _stack(parts: Any) -> Array:
    return np.stack(np.broadcast_arrays(*parts), axis=-1)
