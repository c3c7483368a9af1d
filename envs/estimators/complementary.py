"""`ComplementaryFilter`: attitude from a gyroscope and an accelerometer, the explicit complementary filter.

    dq/dt = 1/2 q (Omega_y - b + kP omega_mes, 0),     db/dt = -kI omega_mes,
    omega_mes = v x v_hat,     v = a / |a|,     v_hat = R(q)' e_3

with the gyroscope's Omega_y and the accelerometer's a, which at rest reads g along the upward direction in body axes.
The correction turns v_hat towards v, so the gyroscope is trusted over times shorter than 1 / kP and the accelerometer
over longer ones. The heading is not observed. In steps of dt, with exp the exact quaternion of a turn:

    q_t^- = q_{t-1} exp(((Omega_{t-1} + Omega_t) / 2 - b_{t-1}) dt)          (from the second observation on)
    q_t   = q_t^- exp(w kP omega_mes dt),     b_t = b_{t-1} - w kI omega_mes dt      (omega_mes of a_t and q_t^-)

with w = 1, or with a gate w = exp(-((|a| - g) / gate)^2 / 2), which trusts the accelerometer less where it reads other
than gravity. So h_hat_t has seen x_0 .. x_t, and nothing is integrated before the first rate was measured: at t = 0
there is only the correction. A gyroscope component that is missing counts as the bias, a rate of 0; without all of the
accelerometer, or in free fall, there is no correction.

References: Hamel & Mahony, "Attitude estimation on SO(3) based on direct inertial measurements", 2006; Mahony, Hamel &
Pflimlin, "Nonlinear complementary filters on the special orthogonal group", 2008; thesis proposal, Sec. 3.4.3.
"""

from __future__ import annotations

from itertools import product as every_pair
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from beliefgym.envs.quaternions import euler_angles, from_euler_angles, integrate, rotate_inverse
from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filter_errors import nan_mean
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
Hint = Literal["roll_pitch", "gravity"]
Initial = Literal["prior", "accelerometer"]
Columns = tuple[str, str, str] | tuple[int, int, int]
UP = (0.0, 0.0, 1.0)
GRIDS = {"kP": np.logspace(-2, 1, 7), "kI": np.logspace(-4, 0, 5), "gate": np.logspace(-1, 1, 5)}
REFINEMENTS = 80  # runs over the training data after the grid, for each gain that is fitted


class Gains(NamedTuple):
    """kP in 1/s, kI in 1/s^2, gate in m/s^2 (infinite for none): a number each, or (n, 1) one for each row."""

    kP: Any
    kI: Any
    gate: Any


class ComplementaryFilter(HintFilter):
    """The explicit complementary filter on an inertial measurement unit.

    A belief is q (order x, y, z, w), the gyroscope's bias b and its last reading, and 0 before any update or 1.

    Args:
        dt: s between observations.
        kP: 1/s, kI: 1/s^2, at least 0. None to fit them: `fit` takes those with the least mean hint error over the
            training trajectories, from a grid of logarithms refined by Nelder and Mead's method.
        gate: m/s^2, above 0. None for no gate, "fit" to fit it too.
        hint: "roll_pitch", rad as `euler_angles` gives them, or "gravity", the upward direction in body axes, R' e_3.
        initial: the attitude at first: "prior" from the mean of the training data's first hints, or "accelerometer"
            from the first reading, where it is there. The heading starts at 0, the bias too.
        gyro, accelerometer: which components of the observation, by names that the training data have, or by index.
        gravity: m/s^2, of the gate and of predicted observations.

    Attributes:
        kP_, kI_, gate_: the gains in use; gate_ is infinite without a gate. training_error_: mean hint error with them.
        residual_std_: (n_hint,) root mean squared error over the training data: the standard deviation that is given.

    Example:
        >>> ComplementaryFilter(dt=0.02).fit(train).hint_errors(test).mean  # doctest: +SKIP
    """

    standardise: Standardise = False
    _fitted_attribute = "kP_"

    def __init__(
        self,
        *,
        dt: float,
        kP: float | None = None,
        kI: float | None = None,
        gate: float | Literal["fit"] | None = None,
        hint: Hint = "roll_pitch",
        initial: Initial = "prior",
        gyro: Columns = ("gyro_x", "gyro_y", "gyro_z"),
        accelerometer: Columns = ("accelerometer_x", "accelerometer_y", "accelerometer_z"),
        gravity: float = 9.81,
    ) -> None:
        self.dt = dt
        self.kP = kP
        self.kI = kI
        self.gate = gate
        self.hint = hint
        self.initial = initial
        self.gyro = gyro
        self.accelerometer = accelerometer
        self.gravity = gravity

    @classmethod
    def of(cls, *, dt: float, kP: float, kI: float, n_obs: int = 6, **parameters: Any) -> Self:
        """The filter of known gains, ready to use without `fit`: level at first, and with no standard deviation.

        Args:
            dt, kP, kI, parameters: as of the class; by default gyro is components 0 to 2 and accelerometer 3 to 5.
            n_obs: components of an observation.
        """
        parameters = {"gyro": (0, 1, 2), "accelerometer": (3, 4, 5), **parameters}
        made = cls(dt=dt, kP=kP, kI=kI, **parameters)
        free = made._check_parameters()
        if free:
            raise ValueError(f"expected numbers for {free}, got none; only fit finds them")
        made.n_obs_, made.n_hint_ = n_obs, 2 if made.hint == "roll_pitch" else 3
        made.hint_names_ = HINT_NAMES[made.hint]
        made._scale = Standardisation.none(np.zeros((0, n_obs)))
        made._hint_scale = Standardisation.none(np.zeros((0, made.n_hint_)))
        made._columns = made._found_columns(n_obs, None)
        made._start, made._typical = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(n_obs)
        made.prior_mean_ = made._hint_of(made._start[None])[0]
        made.prior_std_ = made.residual_std_ = np.full(made.n_hint_, np.nan)
        made._use(made._given())
        return made

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Take the prior of the attitude, fit the gains that are None, and measure the errors.

        Args:
            train: trajectories with hints. validation: only checked.

        Raises:
            ValueError: parameters out of range, names that the data do not have, other hints than `hint` says.
            TypeError: not `Sequences`.
        """
        free = self._check_parameters()
        self._begin(train, validation)
        self.__dict__.pop("kP_", None)
        self._begin_hints(train, validation)
        expected = HINT_NAMES[self.hint]
        if self.n_hint_ != len(expected):
            raise ValueError(
                f"expected hints {expected} with hint={self.hint!r}, got {self.n_hint_} ({self.hint_names_})"
            )
        self._columns = self._found_columns(train.n_obs, train.observation_names)
        self._typical = train.observations[train.observation_mask].mean(axis=0)
        first = self.prior_mean_
        angles = (first[0], first[1], 0.0) if self.hint == "roll_pitch" else leaning(first)
        self._start = np.array(from_euler_angles(*(np.asarray(angle) for angle in angles)))
        gains = self._fitted_gains(train, free) if free else self._given()
        self._use(gains)
        self.residual_std_ = np.full(self.n_hint_, np.nan)
        errors = self.hint_errors(train)
        self.training_error_, self.residual_std_ = errors.mean, errors.rmse
        return self

    def attitude(self, belief: Array) -> tuple[Array, Array]:
        """q (n, 4), order x, y, z, w, and the gyroscope's bias (n, 3) in rad/s: (n, belief_size) of an `update`."""
        b = self._checked_belief(belief)
        return b[:, :4].copy(), b[:, 4:7].copy()

    def _initial(self) -> Array:
        return np.concatenate([self._start, np.zeros(7)])

    def _update(self, belief: Array, z: Array) -> Array:
        return self._follow(belief, z, None)

    def _follow(self, belief: Array, z: Array, action: Array | None) -> Array:
        return self._turned(belief, z, self._gains)

    def _observe(self, belief: Array) -> Array:
        """The last rates, gravity, and of other components their mean over the training data."""
        expected = np.repeat(self._typical[None], len(belief), axis=0)
        expected[:, self._columns[0]] = belief[:, 7:10]
        expected[:, self._columns[1]] = self.gravity * np.stack(rotate_inverse(belief[:, :4].T, UP), axis=1)
        return expected

    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        mean = self._hint_of(belief[:, :4])
        return mean, np.broadcast_to(self.residual_std_, mean.shape).copy()

    def _hint_of(self, q: Array) -> Array:
        found = rotate_inverse(q.T, UP) if self.hint == "gravity" else euler_angles(q.T)[:2]
        return np.stack(found, axis=1)

    def _turned(self, belief: Array, z: Array, gains: Gains) -> Array:
        """The belief after an observation (n, n_obs), which may hold NaN."""
        gyro, force = z[:, self._columns[0]], z[:, self._columns[1]]
        q, bias, before, seen = belief[:, :4].T, belief[:, 4:7], belief[:, 7:10], belief[:, 10:] > 0
        reading = np.where(np.isnan(gyro), bias, gyro)
        rates = np.where(seen, 0.5 * (before + reading) - bias, 0.0)
        size = np.sqrt(np.square(force).sum(axis=1, keepdims=True))
        there = size > 0  # not where a component is NaN
        up = np.where(there, force, UP) / np.where(there, size, 1.0)
        turned = np.stack(integrate(q, rates.T, self.dt))
        if self.initial == "accelerometer":
            aligned = np.stack(from_euler_angles(*leaning(up.T)))
            turned = np.where((there & ~seen).T, aligned, turned)
        expected = np.stack(rotate_inverse(turned, UP), axis=1)
        weight = np.where(
            there, np.exp(-0.5 * np.square((np.where(there, size, 0.0) - self.gravity) / gains.gate)), 0.0
        )
        omega = weight * np.cross(up, expected)
        turned = np.stack(integrate(turned, (gains.kP * omega).T, self.dt), axis=1)
        bias = bias - self.dt * gains.kI * omega
        return np.concatenate([turned, bias, reading, np.ones((len(z), 1))], axis=1)

    def _fitted_gains(self, train: Sequences, free: tuple[str, ...]) -> Gains:
        """The grid's best, refined in logarithms."""
        hints, given = self._hints_of(train, "training trajectories"), self._given()

        def errors(values: Array) -> Array:
            """(k, n_free) -> (k,) mean hint error; all k at once."""
            k, n = len(values), len(train)
            rows = given._replace(
                **{name: np.repeat(values[:, i], n)[:, None] for i, name in enumerate(free)}
            )
            belief = np.tile(self._initial(), (k * n, 1))
            norm = np.empty((train.n_steps + 1, k, n))
            for t in range(train.n_steps + 1):
                belief = self._turned(belief, np.tile(train.observations[:, t], (k, 1)), rows)
                difference = self._hint_of(belief[:, :4]).reshape(k, n, -1) - hints[:, t]
                norm[t] = np.sqrt(np.square(difference).sum(axis=2))
            return nan_mean(nan_mean(norm, 0), 1)

        grid = np.array(list(every_pair(*(GRIDS[name] for name in free))))
        found_by_grid = errors(grid)
        start = np.log(grid[np.argmin(found_by_grid)])
        found = minimize(
            lambda logs: errors(np.exp(logs)[None])[0],
            start,
            method="Nelder-Mead",
            options={
                "maxfev": REFINEMENTS * len(free),
                "xatol": 1e-2,
                "fatol": 1e-4 * float(found_by_grid.min()),
                "initial_simplex": start + 0.7 * np.eye(len(free) + 1, len(free), -1),
            },
        )
        return given._replace(**dict(zip(free, np.exp(found.x).tolist(), strict=True)))

    def _given(self) -> Gains:
        return Gains(self.kP, self.kI, np.inf if self.gate is None else self.gate)

    def _use(self, gains: Gains) -> None:
        self._gains = gains
        self.kP_, self.kI_, self.gate_ = (float(gain) for gain in gains)

    def _found_columns(self, n_obs: int, names: tuple[str, ...] | None) -> tuple[list[int], list[int]]:
        """The places of gyroscope and accelerometer in an observation."""
        found = []
        for what, wanted in (("gyro", self.gyro), ("accelerometer", self.accelerometer)):
            columns: list[Any] = [names.index(c) if names and c in names else c for c in wanted]
            for column in columns:
                whole = isinstance(column, int | np.integer) and not isinstance(column, bool)
                if not whole or not 0 <= column < n_obs:
                    have = f"named {names}" if names else f"of {n_obs} components without names"
                    raise ValueError(
                        f"{what}: expected three names or indices of observations {have}, got {column!r}"
                    )
            found.append([int(column) for column in columns])
        if len({*found[0], *found[1]}) != 6:
            raise ValueError(
                f"expected six different components, got gyro={self.gyro!r}, accelerometer={self.accelerometer!r}"
            )
        return found[0], found[1]

    def _check_parameters(self) -> tuple[str, ...]:
        """The names of the gains to fit, or the message what is wrong."""
        for name in ("dt", "gravity"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"expected {name} finite and above 0, got {getattr(self, name)!r}")
        for name in ("kP", "kI"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < np.inf:
                raise ValueError(f"expected {name} finite and at least 0, or None to fit it, got {value!r}")
        if self.gate not in (None, "fit") and (isinstance(self.gate, str) or not float(self.gate) > 0):
            raise ValueError(f'expected gate above 0, None or "fit", got {self.gate!r}')
        for name, allowed in (("hint", get_args(Hint)), ("initial", get_args(Initial))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"expected {name} to be one of {allowed}, got {getattr(self, name)!r}")
        for name in ("gyro", "accelerometer"):
            columns = getattr(self, name)
            if isinstance(columns, str) or len(columns) != 3:
                raise ValueError(f"expected {name} as three names or indices, got {columns!r}")
        free = {"kP": self.kP is None, "kI": self.kI is None, "gate": self.gate == "fit"}
        return tuple(name for name, is_free in free.items() if is_free)


HINT_NAMES = {"roll_pitch": ("roll", "pitch"), "gravity": ("up_x", "up_y", "up_z")}


def leaning(up: Any) -> tuple[Array, Array, Array]:
    """Roll, pitch and a yaw of 0 with which the upward direction, three components (...), is so in body axes."""
    x, y, z = up
    return np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z)), np.zeros_like(x)
