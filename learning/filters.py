"""`Filter`: what every learned or known filter shares. A belief is what a filter knows of the observations to come.

    m_0 = initial_belief,     m_{t+1} = F(m_t, x_t),     x_hat_t = predict_observation(m_t)           (Eq. 3.17)

m_t has seen x_0 .. x_{t-1}, so that x_hat_t is a prediction, made before x_t is known. Everything goes over a whole
batch at once: one call a time step for all trajectories. With actions a filter is, by its `action_timing`,

    "previous"   m_{t+1} = F(m_t, x_t, a_{t-1}),    an estimate of what holds at t, to act on
    "present"    m_{t+1} = F(m_t, x_t, a_t),        a prediction of x_{t+1}, which a_t leads to           (Sec. 4.2)

and "none" for one fitted without actions, which takes them, where a caller hands them to every filter, and does not
look at them.

References: thesis proposal, Secs. 3.3.1, 3.3.2 and 4.2. There time starts at 1; here at 0.
"""

from __future__ import annotations

import sys
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.exceptions import NotFittedError

from beliefgym.learning.action_coding import ActionCoding
from beliefgym.learning.dynamics import STANDARDISATIONS, DivergenceWarning, Standardise
from beliefgym.learning.filter_errors import FilterErrors
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
ActionTiming = Literal["none", "previous", "present"]
COORDINATES = ("_scale", "_hint_scale", "_action_coding", "belief_scale_")


class Filter(BaseEstimator, ABC):
    """Base of the filters: `fit`, then `initial_belief`, `update`, `predict_observation`, `forecast`.

    A subclass has the parameter `standardise` and implements `fit`, which begins with `_begin`, and `_initial`,
    `_update` and `_observe` in standardised observations. It may set `_bound` (belief_size,): components of a belief
    are then kept within +-_bound, and the first time that matters a `DivergenceWarning` says so.

    Attributes:
        n_obs_: components of an observation. belief_size: numbers in a belief.
        action_timing: which action an update takes, see above. n_act_: columns of an action; 0 where none is looked at.
        observation_names_, action_names_: names in the training data, or None.
        belief_scale_: brings what `summary` shows to mean 0 and deviation 1 over the training data; None where it is
            shown as it is.
    """

    standardise: Standardise
    action_timing: ActionTiming = "none"
    n_choices: int | None = None  # of a discrete action, which then is one column of whole numbers from 0
    n_act_: int = 0
    observation_names_: tuple[str, ...] | None = None
    action_names_: tuple[str, ...] | None = None
    belief_scale_: Standardisation | None = None
    _action_coding: ActionCoding
    _kept: Mapping[str, Any] = MappingProxyType({})  # coordinates of another filter, by attribute
    _fitted_attribute = "model_"  # there once a fit has given something to filter with
    _bound: Array | None = None
    _told_divergence = False

    @abstractmethod
    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Learn from trajectories; see the subclass."""

    @abstractmethod
    def _initial(self) -> Array:
        """(belief_size,) the belief before any observation."""

    @abstractmethod
    def _update(self, belief: Array, z: Array) -> Array:
        """The next belief: (n, belief_size) and standardised observations (n, n_obs) -> (n, belief_size); no checks.

        Where an update takes an action its code stands behind the observation.
        """

    @abstractmethod
    def _observe(self, belief: Array) -> Array:
        """The standardised observation that a belief expects: (n, belief_size) -> (n, n_obs); no checks."""

    def _forecast(self, belief: Array, horizon: int) -> Array:
        """Standardised (n, horizon, n_obs); by default each prediction is taken for the observation that comes."""
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        for step in range(horizon):
            predicted[:, step] = self._observe(belief)
            if step + 1 < horizon:
                belief = self._advance(belief, self._with_actions(predicted[:, step], None))
        return predicted

    @property
    def belief_size(self) -> int:
        """Numbers in a belief."""
        self._check_fitted()
        return len(self._initial())

    def initial_belief(self, n: int = 1) -> Array:
        """The belief before any observation, n times: (n, belief_size)."""
        self._check_fitted()
        return np.tile(self._initial(), (n, 1))

    def update(self, belief: ArrayLike, observation: ArrayLike, action: ArrayLike | None = None) -> Array:
        """Take in one observation (Eq. 3.17).

        Args:
            belief: (n, belief_size), of `initial_belief` or the last update.
            observation: (n, n_obs), in the units of the training data.
            action: (n, n_act), in its own units: by `action_timing` the one before the observation (None where
                there is none yet) or the one taken at it; not looked at by a filter fitted without actions.

        Returns:
            (n, belief_size), of the observations that follow.

        Raises:
            NotFittedError, ValueError: not fitted; shapes, NaN or infinities, and where; the action is missing.
        """
        b = self._checked_belief(belief)
        x = np.asarray(observation, dtype=np.float64)
        if x.shape != (len(b), self.n_obs_):
            raise ValueError(f"observation: expected shape {(len(b), self.n_obs_)}, got {x.shape}")
        check_finite("observation", x)
        return self._follow(b, self._scale.apply(x), self._checked_action(action, len(b)))

    def predict_observation(self, belief: ArrayLike) -> Array:
        """x_hat, the next observation that the belief expects: (n, belief_size) -> (n, n_obs)."""
        return self._scale.invert(self._observe(self._checked_belief(belief)))

    def forecast(self, belief: ArrayLike, horizon: int, actions: ArrayLike | None = None) -> Array:
        """The next `horizon` observations that the belief expects: x_hat_t .. x_hat_{t + horizon - 1}.

        Args:
            belief: (n, belief_size). horizon: at least 1.
            actions: a_t, a_{t+1}, .. (n, at least horizon - 1, n_act) for a filter whose `action_timing` is "present":
                a_t leads to x_hat_{t+1}. None stands for the average action of the training data. Other filters expect
                the actions of the policy that they were trained under, and do not look at these.

        Returns:
            (n, horizon, n_obs).
        """
        b = self._checked_belief(belief)
        check_whole("horizon", horizon, 1)
        if self.action_timing != "present":
            return self._scale.invert(self._forecast(b, int(horizon)))
        codes = np.zeros((len(b), int(horizon), self._action_coding.size))
        if actions is not None:
            a = np.asarray(actions, dtype=np.float64)
            if a.ndim != 3 or len(a) != len(b) or a.shape[1] < horizon - 1 or a.shape[2] != self.n_act_:
                raise ValueError(
                    f"actions: expected shape ({len(b)}, at least {horizon - 1}, {self.n_act_}), got {a.shape}"
                )
            check_finite("actions", a)
            for step in range(min(int(horizon), a.shape[1])):
                codes[:, step] = self._action_coding(a[:, step])
        return self._scale.invert(self._forecast_under(b, int(horizon), codes))

    def beliefs(self, sequences: Sequences) -> Array:
        """Filter whole trajectories: m_0 .. m_{n_steps + 1} of each.

        Returns:
            (n_episodes, n_steps + 2, belief_size); after an episode's end its last belief stands. Where an update takes
            the present action, the last one of an episode takes the average action: there is none any more.
        """
        z = self._driven(sequences)
        n, n_rows, _ = z.shape
        found = np.empty((n, n_rows + 1, self.belief_size))
        found[:, 0] = self.initial_belief(n)
        for t in range(n_rows):
            going = sequences.lengths >= t
            if going.all():
                found[:, t + 1] = self._advance(found[:, t], z[:, t])
                continue
            found[:, t + 1] = found[:, t]
            if going.any():
                found[going, t + 1] = self._advance(found[going, t], z[going, t])
        return found

    def errors(self, sequences: Sequences, horizon: int = 1) -> FilterErrors:
        """Filter whole trajectories and compare what is predicted with what comes (Figs. 3.20 and Table 3.3).

        A filter whose `action_timing` is "present" is told the actions that were taken.

        Args:
            sequences: trajectories. horizon: observations ahead at each step, at least 1.
        """
        z = self._driven(sequences)
        n, n_rows, _ = z.shape
        squared = np.full((n, n_rows, horizon), np.nan)
        belief = self.initial_belief(n)
        for t in range(n_rows):
            ahead = min(horizon, n_rows - t)
            if self.action_timing == "present":
                predicted = self._forecast_under(belief, ahead, z[:, t : t + ahead, self.n_obs_ :])
            else:
                predicted = self._forecast(belief, ahead)
            predicted = self._scale.invert(predicted)
            difference = predicted - sequences.observations[:, t : t + ahead]
            squared[:, t, :ahead] = np.square(difference).sum(axis=2)
            belief = self._advance(belief, z[:, t])
        last = sequences.lengths[:, None, None]
        squared[np.arange(n_rows)[:, None] + np.arange(horizon) > last] = np.nan
        power = np.square(sequences.observations[sequences.observation_mask]).sum(axis=1).mean()
        return FilterErrors(squared, float(power))

    @property
    def summary_size(self) -> int:
        """Numbers that `summary` shows of a belief."""
        return self.belief_size

    @property
    def summary_names(self) -> tuple[str, ...]:
        """A name for each of them."""
        return tuple(f"belief_{i}" for i in range(self.summary_size))

    def summary(self, belief: ArrayLike) -> Array:
        """What an agent is shown: (n, belief_size) -> (n, summary_size), on one scale where that is known."""
        return self._summary(self._checked_belief(belief))

    def _summary(self, belief: Array) -> Array:
        return belief.copy() if self.belief_scale_ is None else self.belief_scale_.apply(belief)

    def summaries(self, sequences: Sequences) -> Array:
        """What an agent that acts at t can be shown, for every t of recorded trajectories.

        That is the summary of m_{t+1}, which has seen x_t, or of m_t where an update takes the present action, which is
        not chosen yet: then x_t belongs beside it.

        Returns:
            (n_episodes, n_steps + 1, summary_size); after an episode's end its last summary stands.
        """
        known = self._known(self.beliefs(sequences))
        return self._summary(known.reshape(-1, known.shape[2])).reshape(*known.shape[:2], -1)

    def _known(self, beliefs: Array) -> Array:
        """Of m_0, m_1, .. those known at t = 0, 1, .. to who is to act: (n, n_rows + 1, size) -> (n, n_rows, size)."""
        return beliefs[:, :-1] if self.action_timing == "present" else beliefs[:, 1:]

    def _note_beliefs(self, train: Sequences) -> None:
        """Take the scale of what `summary` shows from the training trajectories; the last act of a fit."""
        told, self._told_divergence = self._told_divergence, True
        rows = self._known(self.beliefs(train))[train.observation_mask]
        self.belief_scale_ = self._coordinates("belief_scale_", Standardisation.of, rows)
        self._told_divergence = told

    def _coordinates(self, name: str, of: Callable[[Array], Any], rows: Array) -> Any:
        """Those kept from another filter, or those of the data."""
        kept = self._kept.get(name)
        return of(rows) if kept is None else kept

    def _follow(self, belief: Array, z: Array, action: Array | None) -> Array:
        """The next belief of standardised observations (n, n_obs), and actions (n, n_act) in their own units.

        Actions of NaN, or None for all, are not there yet. No checks.
        """
        return self._advance(belief, self._with_actions(z, action))

    def _with_actions(self, z: Array, action: Array | None) -> Array:
        """[z, u], the inputs of `_update`: (n, n_obs) -> (n, n_obs + code's size); z itself without actions."""
        if self.action_timing == "none":
            return z
        coding = self._action_coding
        inputs = np.zeros((len(z), self.n_obs_ + coding.size))
        inputs[:, : self.n_obs_] = z
        if action is not None:
            inputs[:, self.n_obs_ :] = coding(action)
        return inputs

    def _driven(self, sequences: Sequences) -> Array:
        """[z_t, u] of every t, u the code of the action that goes with x_t: (n, n_rows, n_obs + code's size)."""
        return self._beside_actions(self._standardised(sequences), sequences)

    def _beside_actions(self, z: Array, sequences: Sequences) -> Array:
        if self.action_timing == "none":
            return z
        self._check_actions(sequences)
        coding, mask = self._action_coding, sequences.step_mask
        codes = np.zeros((*mask.shape, coding.size))
        codes[mask] = coding(sequences.actions[mask])
        inputs = np.zeros((*z.shape[:2], z.shape[2] + coding.size))
        inputs[:, :, : z.shape[2]] = z
        rows = slice(0, -1) if self.action_timing == "present" else slice(1, None)
        inputs[:, rows, z.shape[2] :] = codes
        return inputs

    def _forecast_under(self, belief: Array, horizon: int, codes: Array) -> Array:
        """`_forecast` under the coded actions (n, horizon, size); each prediction is taken for what comes."""
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        for step in range(horizon):
            predicted[:, step] = self._observe(belief)
            if step + 1 < horizon:
                belief = self._advance(belief, np.concatenate([predicted[:, step], codes[:, step]], axis=1))
        return predicted

    def _advance(self, belief: Array, z: Array) -> Array:
        """`_update` within the bounds."""
        return self._within_bounds(self._update(belief, z), belief)

    def _within_bounds(self, following: Array, belief: Array) -> Array:
        """What follows a belief, kept inside +-_bound; what is NaN stays as it was."""
        bound = self._bound
        if bound is None or bool((np.abs(following) <= bound).all()):
            return following
        outside = ~(np.abs(following) <= bound)
        if not self._told_divergence:
            self._told_divergence = True
            row, component = (int(i) for i in np.argwhere(outside)[0])
            warnings.warn(
                f"a belief of this {type(self).__name__} left its bounds (row {row}, component {component}: "
                f"{following[row, component]:g} in standardised units, bound {bound[component]:g}) and is kept inside; "
                "this is told once. Observations unlike the training data, or an unstable filter, do that",
                DivergenceWarning,
                stacklevel=_level_of_user(),
            )
        following = np.where(np.isnan(following), belief, following)
        return np.clip(following, -bound, bound)

    def keep_coordinates(self, other: Self) -> Self:
        """Fit in the coordinates of another filter of the same kind, so that beliefs of both mean the same.

        Standardisation of observations, actions, hints and of what `summary` shows is then the other's, not that of the
        data to fit to. With features "first" every number in a belief is such a quantity.

        Args:
            other: a fitted filter.

        Raises:
            TypeError: another kind of filter. NotFittedError: it is not fitted.
        """
        if type(other) is not type(self):
            raise TypeError(f"expected a fitted {type(self).__name__}, got {type(other).__name__}")
        other._check_fitted()
        self._kept = {name: getattr(other, name) for name in COORDINATES if hasattr(other, name)}
        return self

    def _begin(self, train: Sequences, validation: Sequences | None = None) -> None:
        """Check the data and take the coordinates from those to train on."""
        for sequences in (train,) if validation is None else (train, validation):
            if not isinstance(sequences, Sequences):
                raise TypeError(
                    f"expected Sequences, got {type(sequences).__name__}; arrays go through "
                    "Sequences.from_observations(observations)"
                )
            if not sequences.n_transitions:
                raise ValueError(f"expected at least one step, got {sequences!r}")
        if validation is not None and validation.n_obs != train.n_obs:
            raise ValueError(
                f"expected validation with {train.n_obs} observations as in training, got {validation.n_obs}"
            )
        if self.standardise not in STANDARDISATIONS:
            raise ValueError(
                f"expected standardise to be one of {list(STANDARDISATIONS)}, got {self.standardise!r}"
            )
        self.n_obs_, self.observation_names_ = train.n_obs, train.observation_names
        self.n_act_, self.action_names_, self.belief_scale_ = 0, None, None
        if self.action_timing != "none":
            self._begin_actions(train, validation)
        self._told_divergence, self._bound = False, None
        rows = train.observations[train.observation_mask]
        self._scale: Standardisation = self._coordinates("_scale", STANDARDISATIONS[self.standardise], rows)
        constant = Standardisation.of(rows).constant
        if constant.any():
            names = train.observation_names
            told = [names[i] if names else int(i) for i in np.flatnonzero(constant)]
            warnings.warn(
                f"observations {told} do not vary in the training data: nothing can be learned of them",
                stacklevel=3,
            )

    def _begin_actions(self, train: Sequences, validation: Sequences | None) -> None:
        """Take the actions' coding from the data to train on."""
        if not train.n_act:
            raise ValueError(
                f"expected trajectories with actions, got {train!r}; a filter without them is PSIM"
            )
        if validation is not None and validation.n_act != train.n_act:
            raise ValueError(
                f"expected validation with {train.n_act} actions as in training, got {validation.n_act}"
            )
        if self.n_choices is not None:
            check_whole("n_choices", self.n_choices, 2)
        rows = train.actions[train.step_mask]
        self._action_coding = self._coordinates(
            "_action_coding", lambda actions: ActionCoding.of(actions, self.n_choices), rows
        )
        self.n_act_, self.action_names_ = train.n_act, train.action_names

    def _standardised(self, sequences: Sequences) -> Array:
        """(n_episodes, n_steps + 1, n_obs), 0 past an episode's end, where no belief is to leave its bounds."""
        self._check_fitted()
        if sequences.n_obs != self.n_obs_:
            raise ValueError(
                f"expected trajectories with {self.n_obs_} observations as at fit, got {sequences.n_obs}"
            )
        z = self._scale.apply(sequences.observations)
        z[~sequences.observation_mask] = 0.0
        return z

    def _check_actions(self, sequences: Sequences) -> None:
        """Raise unless trajectories have the actions of the training data."""
        if self.action_timing != "none" and sequences.n_act != self.n_act_:
            raise ValueError(
                f"expected trajectories with {self.n_act_} actions as at fit, got {sequences.n_act}"
            )

    def _checked_action(self, action: ArrayLike | None, n: int) -> Array | None:
        """(n, n_act), or None where there is none; the message what is wrong with it."""
        if self.action_timing == "none":
            if action is not None and (np.ndim(action) != 2 or len(np.asarray(action)) != n):
                raise ValueError(f"action: expected shape ({n}, n_act), got {np.shape(action)}")
            return None
        if action is None:
            if self.action_timing == "previous":
                return None
            raise ValueError(
                f"action: expected the action (n, {self.n_act_}) taken at this observation, got None: this "
                f"{type(self).__name__} was fitted with actions"
            )
        a = np.asarray(action, dtype=np.float64)
        if a.shape != (n, self.n_act_):
            raise ValueError(f"action: expected shape {(n, self.n_act_)}, got {a.shape}")
        check_finite("action", a)
        return a

    def _checked_belief(self, belief: ArrayLike) -> Array:
        self._check_fitted()
        b = np.asarray(belief, dtype=np.float64)
        if b.ndim != 2 or b.shape[1] != self.belief_size:
            raise ValueError(f"belief: expected shape (n, {self.belief_size}), got {b.shape}")
        return b

    def _check_fitted(self) -> None:
        if not self.__sklearn_is_fitted__():
            raise NotFittedError(f"this {type(self).__name__} is not fitted yet; call fit(train, validation)")

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "n_obs_") and hasattr(self, self._fitted_attribute)


def _level_of_user() -> int:
    """The `stacklevel` with which a warning of the caller points at the code that uses this package."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("beliefgym."):
        frame, level = frame.f_back, level + 1
    return level


def check_finite(what: str, array: Array) -> None:
    """Raise where a number is NaN or infinite, and say which."""
    if not np.isfinite(array).all():
        where: Any = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{what}: expected finite numbers, got {array[where]} at index {where}")


def check_whole(name: str, value: Any, least: int) -> None:
    """Raise unless value is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"expected {name} to be a whole number of at least {least}, got {value!r}")
