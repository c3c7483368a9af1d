"""`BeliefTracker`: the beliefs of n episodes that run side by side, one step of all of them at a time.

    "none"      m_{t+1} = F(m_t, x_t),             shown at t: S(m_{t+1})
    "previous"  m_{t+1} = F(m_t, x_t, a_{t-1}),    shown at t: S(m_{t+1})
    "present"   m_{t+1} = F(m_t, x_t, a_t),        shown at t: S(m_t); x_t is kept until a_t is known

by the filter's `action_timing`. S is the filter's `summary`, or its estimate of a hint with the standard deviation.
What is shown online is what `shown` gives for the recorded episodes afterwards, to rounding.
"""

from __future__ import annotations

import math
from copy import copy
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.filters import Filter, check_whole
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.ridge_step import RidgeStep
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
Rows = NDArray[np.intp] | slice
Show = Literal["belief", "hint"]
ALL = slice(None)
LARGEST = 1e30  # of a belief's numbers: single precision, in which agents see them, ends at 3e38


class BeliefTracker:
    """The beliefs of n copies of a process, from their observations and actions as they come.

    Args:
        filter: a fitted `Filter`. It is not changed, and later fits of it do not change the tracker.
        n: number of copies.
        show: "belief" for the filter's `summary`; "hint" for the estimated hint of a `HintFilter` and its standard
            deviation (left out where the filter has none), both on the scale of the training data's hints.

    Attributes:
        size: numbers that are shown of a copy. names: a name for each.
        n_steps: (n,) steps since each copy's episode began.

    Raises:
        TypeError: not a `Filter`; a hint of a filter without. NotFittedError, ValueError: not fitted; unknown `show`.

    Example:
        >>> tracker = BeliefTracker(filter, n=64)  # doctest: +SKIP
        >>> shown = tracker.begin(observations)  # doctest: +SKIP
        >>> shown = tracker.go_on(observations, actions)  # doctest: +SKIP
    """

    def __init__(self, filter: Filter, n: int, *, show: Show = "belief") -> None:
        check_whole("n", n, 1)
        self.filter: Filter = copy(filter)
        self._display = _Display(self.filter, show)
        self.names = self._display.names
        self.size, self.n = len(self.names), int(n)
        self.n_steps = np.zeros(self.n, dtype=np.int64)
        self._first = self.filter.initial_belief(self.n)
        self._belief = self._first.copy()
        self._held = np.zeros((self.n, self.filter.n_obs_))  # "present": x_t, until a_t is known
        self._is_present = self.filter.action_timing == "present"
        self._takes_actions = self.filter.action_timing != "none" and self.filter.n_act_ > 0
        self._quick = RidgeStep.of(self.filter, self.n)

    @property
    def belief(self) -> Array:
        """(n, belief_size) a copy of the present beliefs."""
        return self._belief.copy()

    def fork(self) -> BeliefTracker:
        """A copy that goes on by itself; the filter, which does not change, is shared."""
        other = copy(self)
        other._belief, other._held, other.n_steps = (
            self._belief.copy(),
            self._held.copy(),
            self.n_steps.copy(),
        )
        return other

    def begin(self, observations: ArrayLike, mask: ArrayLike | None = None) -> Array:
        """Begin episodes.

        Args:
            observations: (n, n_obs) the first ones, in the units of the training data.
            mask: (n,) the copies that begin; None for all. The others stay as they are.

        Returns:
            (n, size) what is shown at t = 0; rows outside the mask mean nothing.

        Raises:
            ValueError: shapes, NaN or infinities, and where. FloatingPointError: a belief that has diverged.
        """
        rows, x = self._rows(mask), self._checked(observations)
        self.n_steps[rows] = 0
        self._check_finite(x, rows, "observation")
        self._belief[rows] = self._first[rows]
        if self._is_present:
            self._held[rows] = x[rows]
        else:
            self._take(x[rows], None, rows)
        return self._shown(rows)

    def go_on(
        self, observations: ArrayLike, actions: ArrayLike | None = None, mask: ArrayLike | None = None
    ) -> Array:
        """Go on by one step.

        Args:
            observations: (n, n_obs) those after the actions.
            actions: (n, n_act), in their own units, a discrete one as one column with its number; not looked at by a
                filter fitted without actions.
            mask: (n,) the copies that go on; None for all. The others stay as they are.

        Returns:
            (n, size) what is shown then; rows outside the mask mean nothing.

        Raises:
            ValueError: shapes, NaN or infinities, and where; no actions where the filter takes them.
            FloatingPointError: a belief that has diverged.
        """
        rows, x = self._rows(mask), self._checked(observations)
        self.n_steps[rows] += 1
        self._check_finite(x, rows, "observation")
        a = self._checked_actions(actions, rows) if self._takes_actions else None
        if self._is_present:
            self._take(self._held[rows], a, rows)
            self._held[rows] = x[rows]
        else:
            self._take(x[rows], a, rows)
        return self._shown(rows)

    def catch_up(self, sequences: Sequences) -> Array:
        """Be where the copies are after recorded episodes that still run, so that a new filter takes over in the midst.

        Args:
            sequences: n episodes, that of each copy from its first observation up to now.

        Returns:
            (n, size) what is shown now.

        Raises:
            ValueError: another number of episodes, components as above.
        """
        if len(sequences) != self.n:
            raise ValueError(f"expected the running episodes of {self.n} copies, got {sequences!r}")
        if self._takes_actions and sequences.n_act != self.filter.n_act_:
            raise ValueError(
                f"expected episodes with {self.filter.n_act_} actions as at fit, got {sequences!r}"
            )
        self.begin(sequences.observations[:, 0])
        for t in range(1, int(sequences.lengths.max(initial=0)) + 1):
            self.go_on(sequences.observations[:, t], sequences.actions[:, t - 1], sequences.lengths >= t)
        return self._shown(ALL)

    def _take(self, x: NDArray[Any], actions: NDArray[Any] | None, rows: Rows) -> None:
        """m <- F(m, x, a) in these rows, whose observations and actions are given."""
        if not len(x):
            return
        belief, filter = self._belief[rows], self.filter
        if self._quick is not None:
            following = self._quick(belief, x, actions)
            if not np.abs(following).max() <= self._quick.least_bound:  # NaN is not
                following = filter._within_bounds(following, belief)
        else:
            z = filter._scale.apply(x.astype(np.float64, copy=False))
            following = filter._follow(belief, z, actions)
            self._check_size(following, rows)
        self._belief[rows] = following

    def _shown(self, rows: Rows) -> Array:
        """What is shown of these rows; the others are 0."""
        if rows is ALL:
            everything = self._display(self._belief)
            self._check_size(everything, rows)
            return everything
        shown = np.zeros((self.n, self.size))
        if len(chosen := self._belief[rows]):
            shown[rows] = self._display(chosen)
            self._check_size(shown, ALL)
        return shown

    def _rows(self, mask: ArrayLike | None) -> Rows:
        if mask is None:
            return ALL
        chosen = np.asarray(mask, dtype=np.bool_)
        if chosen.shape != (self.n,):
            raise ValueError(f"mask: expected shape {(self.n,)}, got {chosen.shape}")
        return ALL if chosen.all() else np.flatnonzero(chosen)

    def _checked(self, observations: ArrayLike) -> NDArray[Any]:
        x = np.asarray(observations)
        if x.shape != self._held.shape:
            raise ValueError(f"observations: expected shape {self._held.shape}, got {x.shape}")
        return x if x.dtype.kind == "f" else x.astype(np.float64)

    def _checked_actions(self, actions: ArrayLike | None, rows: Rows) -> Array:
        """(len(rows), n_act)."""
        if actions is None:
            raise ValueError(
                f"expected the actions (n, {self.filter.n_act_}) that led to these observations, got None: this "
                f"{type(self.filter).__name__} takes actions"
            )
        a = np.asarray(actions, dtype=np.float64)
        if a.shape != (self.n, self.filter.n_act_):
            raise ValueError(f"actions: expected shape {(self.n, self.filter.n_act_)}, got {a.shape}")
        self._check_finite(a, rows, "action")
        chosen: Array = a[rows]
        return chosen

    def _check_size(self, numbers: Array, rows: Rows) -> None:
        """Raise where a belief in these rows, or what is shown of it, is past all bounds."""
        if np.vdot(numbers, numbers) <= LARGEST or bool((np.abs(numbers) <= LARGEST).all()):  # NaN: neither
            return
        row, component = (int(i) for i in np.argwhere(~(np.abs(numbers) <= LARGEST))[0])
        raise FloatingPointError(
            f"the belief of {self._copy(rows, row)} has diverged: component {component} is "
            f"{numbers[row, component]:g}. This {type(self.filter).__name__} does not hold on such observations"
            f"{' and actions' if self._takes_actions else ''}: fit it to trajectories of the environment and policy "
            "that it is used with, or take a filter whose beliefs are bounded, such as PSIM"
        )

    def _check_finite(self, array: NDArray[Any], rows: Rows, what: str) -> None:
        """Raise where a number of these rows is NaN or infinite, and say which."""
        if _is_finite(array) or _is_finite(chosen := array[rows]):
            return
        row, component = (int(i) for i in np.argwhere(~np.isfinite(chosen))[0])
        raise ValueError(
            f"expected finite numbers, got {chosen[row, component]} in component {component} of the {what} of "
            f"{self._copy(rows, row)}; look at the {'environment' if what == 'observation' else 'policy'}"
        )

    def _copy(self, rows: Rows, row: int) -> str:
        copy = row if isinstance(rows, slice) else int(rows[row])
        return f"copy {copy} of {self.n} at step {self.n_steps[copy]} of its episode"


class _Display:
    """What an agent is shown of beliefs: (n, belief_size) -> (n, size), with names."""

    def __init__(self, filter: Filter, show: Show) -> None:
        if not isinstance(filter, Filter):
            raise TypeError(f"expected a Filter of beliefgym.learning, got {type(filter).__name__}")
        if show not in get_args(Show):
            raise ValueError(f"expected show to be one of {get_args(Show)}, got {show!r}")
        filter._check_fitted()
        self._filter = filter
        self._hints: HintFilter | None = None
        self.names = tuple(filter.summary_names)
        self._slope: Array | None = None
        if show == "belief":
            if type(filter)._summary is Filter._summary and filter.belief_scale_ is not None:
                self._slope = 1.0 / filter.belief_scale_.scale
                self._shift = filter.belief_scale_.offset * self._slope
            return
        if not isinstance(filter, HintFilter):
            raise TypeError(
                f"expected a HintFilter (PSIMHints, InferenceMachineFilter, ..) with show='hint', got "
                f"{type(filter).__name__}, which estimates no hint; show='belief' shows its belief"
            )
        self._hints = filter
        names = filter.hint_names_ or tuple(str(i) for i in range(filter.n_hint_))
        self.names = tuple(f"hint[{name}]" for name in names)
        self._has_std = bool(np.isfinite(filter._read_hint(filter.initial_belief(1))[1]).all())
        if self._has_std:
            self.names += tuple(f"hint_std[{name}]" for name in names)

    def __call__(self, belief: Array) -> Array:
        if self._slope is not None:  # `_summary`, with a product in the place of a division
            quotient: Array = belief * self._slope
            quotient -= self._shift
            return quotient
        if self._hints is None:
            return self._filter._summary(belief)
        mean, std = self._hints._read_hint(belief)
        scale = self._hints._hint_scale
        shown = scale.apply(mean)
        return np.concatenate([shown, std / scale.scale], axis=1) if self._has_std else shown


def shown(filter: Filter, sequences: Sequences, show: Show = "belief") -> Array:
    """What a `BeliefTracker` shows at every t of recorded episodes.

    Args:
        filter, show: as of `BeliefTracker`. sequences: whole episodes.

    Returns:
        (n_episodes, n_steps + 1, size); after an episode's end its last row stands.
    """
    display = _Display(filter, show)
    if show == "belief":
        return filter.summaries(sequences)
    known = filter._known(filter.beliefs(sequences))
    return display(known.reshape(-1, known.shape[2])).reshape(*known.shape[:2], -1)


def _is_finite(array: NDArray[Any]) -> bool:
    """Whether all numbers are; the sum of their squares tells that nearly always, in a third of the time."""
    return math.isfinite(np.vdot(array, array)) or bool(np.isfinite(array).all())
