"""`PhysicsFilter`: filters that know a system's exact dynamics and sensors.

    s_{t+1} = step(s_t, a_t, eps_t),     x_t = observe(s_t)[observed] + observation_noise_std n_t

with the standard normal eps_t that the `System` declares (of actions, states and disturbances) and n_t. Before any
observation the belief is the prior of s_0. The first observation corrects it without a step of the dynamics; each later
one comes after a step with a_{t-1}. So after `update` with x_t the belief is of p(s_t | x_0 .. x_t, a_0 .. a_{t-1}).

The filters of `learning` hold a prediction of what comes next instead. Here that needs the action of the meantime, so
that `predict_observation` and `forecast` make the step themselves, with the actions that are given, or zeros.

Angles are not wrapped: states hold them unwrapped, and so do means and estimates.

Reference: thesis proposal, Secs. 3.3.4 and 3.4.3; Sarkka, "Bayesian filtering and smoothing", 2013, Ch. 4.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.estimators.physics_setup import (
    Parameters,
    checked_parameters,
    checked_prior,
    columns_of,
    empirical_prior,
)
from beliefgym.envs.system import System
from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filter_errors import FilterErrors
from beliefgym.learning.filters import check_finite, check_whole
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]


class NumericalError(FloatingPointError):
    """A belief stopped being a distribution: numbers that are not finite, or a covariance far from one."""


class StateEstimate(NamedTuple):
    """An estimate of states.

    Attributes:
        mean: (n, n_state), in the system's units. covariance: (n, n_state, n_state).
    """

    mean: Array
    covariance: Array


class PhysicsFilter(HintFilter):
    """Base of the filters of a known `System`.

    `X(system=.., ..).fit(train)` takes the prior from data; `X.of(system, prior=.., ..)` is ready to use.

    A subclass implements `_initial`, `_predict`, `_correct`, `_expect`, `_read_hint`, `_moments` and `_state`. The last
    number of a belief is 0 before any update and 1 afterwards.

    Args:
        system: the true one, with its noise.
        observed: names of the observation's components, in the data's order. None for all of them.
        observation_noise_std: of the white noise on each, above 0, in their units; one number or one each.
        hint: "hint" for `system.hint(state)`, or names of state components.
        prior: mean (n_state,) and covariance (n_state, n_state) of s_0. None to take those of the first states of the
            training data: from `states`, or from `hints` where the hint is the whole state. It takes several times
            as many trajectories as the state has components, or the filter believes correlations of chance.

    Attributes:
        prior_: the prior of s_0, a `StateEstimate` of one row. prior_mean_, prior_std_: of the hint, by the prior.
    """

    standardise: Standardise = False
    action_timing = "previous"
    _fitted_attribute = "prior_"
    prior_: StateEstimate
    _set: Parameters

    def __init__(
        self,
        *,
        system: System,
        observation_noise_std: float | tuple[float, ...],
        observed: tuple[str, ...] | None = None,
        hint: str | tuple[str, ...] = "hint",
        prior: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        self.system = system
        self.observation_noise_std = observation_noise_std
        self.observed = observed
        self.hint = hint
        self.prior = prior

    @classmethod
    def of(cls, system: System, *, prior: tuple[ArrayLike, ArrayLike], **parameters: Any) -> Self:
        """The filter of a known prior, ready to use without `fit`.

        Args:
            system, prior, parameters: as of the class.
        """
        made = cls(system=system, prior=prior, **parameters)
        made._use(made._checked(), *checked_prior(prior, system))
        return made

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Take the prior; nothing else is learned.

        Args:
            train: trajectories that begin as those to filter do. Where the prior is given they are only checked.
            validation: only checked.

        Raises:
            ValueError: parameters out of range, other components than the system's, or no first states.
            TypeError: no `System`, no `Sequences`.
        """
        setting = self._checked()
        with warnings.catch_warnings():  # of components that do not vary: nothing is learned of any
            warnings.filterwarnings("ignore", message="observations .* do not vary")
            self._begin(train, validation)
        self.__dict__.pop("prior_", None)
        names = tuple(setting.observed)
        if train.n_obs != len(names) or train.observation_names not in (None, names):
            raise ValueError(f"expected trajectories with the observations {names}, got {train!r}")
        if not train.n_act and np.any(self.system.action_limits):
            warnings.warn(
                f"{type(self.system).__name__} takes actions and the trajectories have none: zeros stand for them",
                stacklevel=2,
            )
        if self.prior is not None:
            mean, covariance = checked_prior(self.prior, self.system)
        else:
            mean, covariance = empirical_prior(train, self.system)
        self._use(setting, mean, covariance)
        return self

    def estimate_state(self, belief: ArrayLike) -> StateEstimate:
        """Mean and covariance of s_t given x_0 .. x_t: (n, belief_size) of an `update` with x_t."""
        return self._state(self._checked_belief(belief))

    def forecast(self, belief: ArrayLike, horizon: int, actions: ArrayLike | None = None) -> Array:
        """The next `horizon` observations that the belief expects: x_hat_t .. x_hat_{t + horizon - 1}.

        Args:
            belief: (n, belief_size) m_t. horizon: at least 1.
            actions: (n, horizon, n_action) a_{t-1} .. a_{t + horizon - 2}: row j leads to prediction j. The first is
                not looked at before any observation. None for zeros.

        Returns:
            (n, horizon, n_obs).
        """
        b = self._checked_belief(belief)
        check_whole("horizon", horizon, 1)
        shape = (len(b), int(horizon), self.system.n_action)
        a = np.zeros(shape) if actions is None else np.asarray(actions, dtype=np.float64)
        if a.shape != shape:
            raise ValueError(f"actions: expected shape {shape}, got {a.shape}")
        check_finite("actions", a)
        return self._forecast(b, int(horizon), a)

    def beliefs(self, sequences: Sequences) -> Array:
        """Filter whole trajectories with their actions; see `Filter.beliefs`."""
        z, actions = self._standardised(sequences), self._leading_actions(sequences)
        n, n_rows, _ = z.shape
        found = np.empty((n, n_rows + 1, self.belief_size))
        found[:, 0] = self.initial_belief(n)
        for t in range(n_rows):
            going = sequences.lengths >= t
            found[:, t + 1] = found[:, t]
            found[going, t + 1] = self._follow(found[going, t], z[going, t], actions[going, t])
        return found

    def errors(self, sequences: Sequences, horizon: int = 1) -> FilterErrors:
        """Filter whole trajectories with their actions and compare predictions; see `Filter.errors`."""
        z, actions = self._standardised(sequences), self._leading_actions(sequences)
        n, n_rows, _ = z.shape
        squared = np.full((n, n_rows, horizon), np.nan)
        belief = self.initial_belief(n)
        for t in range(n_rows):
            going = sequences.lengths >= t
            ahead = min(horizon, n_rows - t)
            predicted = self._forecast(belief[going], ahead, actions[going, t : t + ahead])
            squared[going, t, :ahead] = np.square(predicted - z[going, t : t + ahead]).sum(axis=2)
            belief[going] = self._follow(belief[going], z[going, t], actions[going, t])
        last = sequences.lengths[:, None, None]
        squared[np.arange(n_rows)[:, None] + np.arange(horizon) > last] = np.nan
        power = np.square(sequences.observations[sequences.observation_mask]).sum(axis=1).mean()
        return FilterErrors(squared, float(power))

    @abstractmethod
    def _predict(self, belief: Array, action: Array) -> Array:
        """The belief about s_{t+1} from that about s_t and a_t (n, n_action)."""

    @abstractmethod
    def _correct(self, belief: Array, z: Array) -> Array:
        """The belief after an observation of the same time, NaN where a component is missing."""

    @abstractmethod
    def _expect(self, belief: Array) -> Array:
        """(n, n_obs) the mean of the observation at the belief's own time."""

    @abstractmethod
    def _state(self, belief: Array) -> StateEstimate:
        """Mean and covariance of the state; no checks."""

    def _follow(self, belief: Array, z: Array, action: Array | None) -> Array:
        return self._correct(self._move(belief, self._action(action, len(belief))), z)

    def _update(self, belief: Array, z: Array) -> Array:
        return self._follow(belief, z, None)

    def _observe(self, belief: Array) -> Array:
        return self._forecast(belief, 1)[:, 0]

    def _forecast(self, belief: Array, horizon: int, actions: Array | None = None) -> Array:
        """Steps without observations: the mean of what would be seen."""
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        for step in range(horizon):
            belief = self._move(
                belief, self._action(None if actions is None else actions[:, step], len(belief))
            )
            predicted[:, step] = self._expect(belief)
        return predicted

    def _move(self, belief: Array, action: Array) -> Array:
        """One step of the dynamics for the rows that have seen something; all have, afterwards."""
        seen = belief[:, -1] > 0
        moved = belief.copy()
        if seen.any():
            moved[seen] = self._predict(belief[seen], action[seen])
        moved[:, -1] = 1.0
        return moved

    def _action(self, action: Array | None, n: int) -> Array:
        """(n, n_action), zeros for None and NaN, or the message what is wrong with it."""
        shape = (n, self.system.n_action)
        if action is None:
            return np.zeros(shape)
        if action.shape != shape:
            raise ValueError(
                f"action: expected shape {shape} ({self.system.action_names}), got {action.shape}"
            )
        action = np.where(np.isnan(action), 0.0, action)
        check_finite("action", action)
        return action

    def _checked_action(self, action: ArrayLike | None, n: int) -> Array | None:
        if action is None:
            return None
        a = self._action(np.asarray(action, dtype=np.float64), n)
        check_finite("action", np.asarray(action, dtype=np.float64))
        return a

    def _check_actions(self, sequences: Sequences) -> None:
        if sequences.n_act not in (0, self.n_act_):
            raise ValueError(
                f"expected trajectories with {self.n_act_} actions as the system, got {sequences!r}"
            )

    def _begin_actions(self, train: Sequences, validation: Sequences | None) -> None:
        """The system says what its actions are."""

    @property
    def summary_size(self) -> int:
        """Mean and standard deviation of each component of the system's full observation."""
        self._check_fitted()
        return 2 * len(self.system.observation_names)

    @property
    def summary_names(self) -> tuple[str, ...]:
        """`mean[name]` of each component, then `std[name]` of each."""
        names = self.system.observation_names
        return (*(f"mean[{name}]" for name in names), *(f"std[{name}]" for name in names))

    def _summary(self, belief: Array) -> Array:
        """E[observe(s_t)] and its standard deviation, in the observation's units: what full sight would show."""
        return np.concatenate(self._moments(belief, self.system.observe), axis=1)

    @abstractmethod
    def _moments(self, belief: Array, function: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Mean and standard deviation, (n, d) each, of a function of states (..., n_state) -> (..., d)."""

    def _leading_actions(self, sequences: Sequences) -> Array:
        """(n_episodes, n_steps + 1, n_action): the action before each observation; zeros where there is none."""
        n, n_steps, n_act = sequences.actions.shape
        size = self.system.n_action
        self._check_actions(sequences)
        before = np.zeros((n, n_steps + 1, size))
        if n_act:
            before[:, 1:] = sequences.actions
        return before

    def _possible(self, state: Array) -> Array:
        """The possible state nearest to one (..., n_state): inside the system's limits, quaternions of norm 1."""
        low, high = self.system.state_limits
        moved: Array = self.system.project(np.clip(state, low, high))
        return moved

    def _sensed(self, state: Array) -> Array:
        """(..., n_state) -> (..., n_obs) without noise."""
        seen: Array = self.system.observe(state)[..., self._set.observed_columns]
        return seen

    def _hint(self, state: Array) -> Array:
        """(..., n_state) -> (..., n_hint)."""
        columns = self._set.hint_columns
        found: Array = self.system.hint(state) if columns is None else state[..., columns]
        return found

    def _hints_of(self, sequences: Sequences, what: str) -> Array:
        """The hints by name, from the trajectories' hints or their states."""
        own = self.system.hint_names or self.system.state_names
        for array, names, usual in (
            (sequences.hints, sequences.hint_names, own),
            (sequences.states, sequences.state_names, self.system.state_names),
        ):
            if array is None or (names is None and array.shape[2] != len(usual)):
                continue
            columns = columns_of(self._set.hint_names, names or usual)
            if columns is not None:
                return np.where(sequences.observation_mask[:, :, None], array[..., columns], np.nan)
        raise ValueError(f"expected {what} with hints or states {self._set.hint_names}, got {sequences!r}")

    def _checked(self) -> Parameters:
        """The parameters, checked; a subclass adds its own."""
        return checked_parameters(self.system, self.observed, self.observation_noise_std, self.hint)

    def _use(self, setting: Parameters, mean: Array, covariance: Array) -> None:
        """Become the filter of these parameters and this prior."""
        self._set = setting
        self.n_obs_, self.n_hint_ = len(setting.observed), len(setting.hint_names)
        self.hint_names_, self.observation_names_ = setting.hint_names, setting.observed
        self.n_act_, self.action_names_ = self.system.n_action, self.system.action_names
        self._scale = Standardisation.none(np.zeros((0, self.n_obs_)))
        self._hint_scale = Standardisation.none(np.zeros((0, self.n_hint_)))
        self.prior_ = StateEstimate(self._possible(mean[None]), covariance[None])
        first, spread = self._read_hint(self.initial_belief(1))
        self.prior_mean_, self.prior_std_ = first[0], spread[0]
