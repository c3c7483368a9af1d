"""`HintFilter`: filters that estimate a quantity which was measured for the training data and is not at run time.

Such a quantity is a hint, h_t: a pose from motion capture, a mass on a scale, the true state of a simulator. With the
belief of every filter, m_{t+1} = F(m_t, x_t), which has seen x_0 .. x_t, the estimate of h_t may use x_t:

    h_hat_t = g(m_{t+1})                                                                 (Eq. 3.42; there m_t)

The belief at time t of the thesis's Sec. 3.4, which has taken in x_t, is therefore m_{t+1} here, as it is for all
filters of this package.

Reference: thesis proposal, Sec. 3.4.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.dynamics import STANDARDISATIONS
from beliefgym.learning.filters import Filter, check_finite
from beliefgym.learning.hint_errors import HintErrors
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
Missing = Literal["raise", "predict"]


class HintEstimate(NamedTuple):
    """An estimate of hints.

    Attributes:
        mean: (n, n_hint) h_hat, in the hint's units. std: (n, n_hint) its standard deviation; NaN where a filter has
            no uncertainty to give.
    """

    mean: Array
    std: Array


class HintFilter(Filter):
    """Base of the filters with `predict_hint`.

    A subclass begins its `fit` with `_begin` and `_begin_hints`, and implements, beside what `Filter` asks for,
    `_read_hint`. One that knows better what to do without an observation has its own `_follow`.

    Attributes:
        n_hint_: components of the hint. hint_names_: their names, where the training data have them.
        prior_mean_, prior_std_: (n_hint,) of the training data's first hints, what is known before any observation.
    """

    hints_from: Literal["hints", "states"] = "hints"  # the trajectories' array that holds them
    n_hint_: int
    hint_names_: tuple[str, ...] | None = None
    prior_mean_: Array
    prior_std_: Array
    gap_growth_: Array | None = None  # see `HintEstimator`
    _hint_scale: Standardisation

    @abstractmethod
    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        """Mean and standard deviation of h_t from m_{t+1}: (n, belief_size) -> (n, n_hint) twice; no checks."""

    def predict_hint(self, belief: ArrayLike) -> HintEstimate:
        """h_hat_t and its standard deviation.

        Args:
            belief: (n, belief_size) m_{t+1}, of an `update` with x_t. Before any update there is only `prior_mean_`.

        Raises:
            NotFittedError, ValueError: not fitted; a belief of another shape.
        """
        return HintEstimate(*self._read_hint(self._checked_belief(belief)))

    def update(
        self,
        belief: ArrayLike,
        observation: ArrayLike,
        action: ArrayLike | None = None,
        *,
        missing: Missing = "raise",
    ) -> Array:
        """Take in one observation.

        Args:
            belief: (n, belief_size) m_t, of `initial_belief` or the last update.
            observation: (n, n_obs) x_t, in the units of the training data.
            action: (n, n_act) the one before it, a_{t-1}; None where there is none yet. Not looked at by a filter
                fitted without actions.
            missing: what NaN stands for: "raise" refuses it, "predict" takes it as not observed. The belief then moves
                by its own prediction of what is missing, and by all of the rest.

        Returns:
            (n, belief_size) m_{t+1}.

        Raises:
            NotFittedError, ValueError: not fitted; shapes, infinities and (with "raise") NaN, and where.
        """
        b = self._checked_belief(belief)
        x = np.asarray(observation, dtype=np.float64)
        if x.shape != (len(b), self.n_obs_):
            raise ValueError(f"observation: expected shape {(len(b), self.n_obs_)}, got {x.shape}")
        if missing not in get_args(Missing):
            raise ValueError(f"expected missing to be one of {get_args(Missing)}, got {missing!r}")
        check_observed(x, missing)
        return self._follow(b, self._scale.apply(x), self._checked_action(action, len(b)))

    def estimate_hints(self, sequences: Sequences) -> HintEstimate:
        """Filter whole trajectories; their hints are not looked at.

        Returns:
            Mean and standard deviation, (n_episodes, n_steps + 1, n_hint) each; NaN past an episode's end.
        """
        z = self._standardised(sequences)
        self._check_actions(sequences)
        n, n_rows, _ = z.shape
        mean, std = (np.full((n, n_rows, self.n_hint_), np.nan) for _ in range(2))
        belief = self.initial_belief(n)
        for t in range(n_rows):
            going = np.flatnonzero(sequences.lengths >= t)
            if not len(going):
                break
            action = sequences.actions[going, t - 1] if t and self.n_act_ and sequences.n_act else None
            belief[going] = self._follow(belief[going], z[going, t], action)
            mean[going, t], std[going, t] = self._read_hint(belief[going])
        return HintEstimate(mean, std)

    def hint_errors(self, sequences: Sequences) -> HintErrors:
        """Filter whole trajectories and compare the estimates with their hints.

        Raises:
            ValueError: trajectories without hints, or with others than at fit.
        """
        self._check_fitted()
        hints = self._hints_of(sequences, "trajectories")
        mean, std = self.estimate_hints(sequences)
        return HintErrors(mean - hints, std)

    def _follow(self, belief: Array, z: Array, action: Array | None) -> Array:
        """m_{t+1} of standardised observations (n, n_obs) that may hold NaN, and a_{t-1}; no checks."""
        unseen = np.isnan(z)
        if unseen.any():
            z = np.where(unseen, self._observe(belief), z)
        return super()._follow(belief, z, action)

    def _begin_hints(self, train: Sequences, validation: Sequences | None = None) -> None:
        """Check the hints and take their coordinates from those to train on; after `_begin`."""
        self.__dict__.pop("n_hint_", None)
        hints = self._hints_of(train, "training trajectories")
        rows = hints[train.observation_mask]
        self.n_hint_ = hints.shape[2]
        self.hint_names_ = train.hint_names if self.hints_from == "hints" else train.state_names
        if validation is not None:
            self._hints_of(validation, "validation")
        self._hint_scale = self._coordinates("_hint_scale", STANDARDISATIONS[self.standardise], rows)
        self.prior_mean_, self.prior_std_ = hints[:, 0].mean(axis=0), hints[:, 0].std(axis=0)
        constant = Standardisation.of(rows).constant
        if constant.any():
            told = [self.hint_names_[i] if self.hint_names_ else int(i) for i in np.flatnonzero(constant)]
            warnings.warn(
                f"hints {told} do not vary in the training data: nothing can be learned of them", stacklevel=3
            )

    def _rows(self, sequences: Sequences) -> tuple[Array, Array, NDArray[np.int64]]:
        """Every m_{t+1} of trajectories, h_t standardised, and the trajectory of each."""
        mask = sequences.observation_mask
        hints = self._hint_scale.apply(self._hints_of(sequences, "trajectories"))
        return self.beliefs(sequences)[:, 1:][mask], hints[mask], np.nonzero(mask)[0]

    def _hints_of(self, sequences: Sequences, what: str) -> Array:
        """(n_episodes, n_steps + 1, n_hint), NaN past an episode's end."""
        if self.hints_from not in ("hints", "states"):
            raise ValueError(f"expected hints_from to be 'hints' or 'states', got {self.hints_from!r}")
        hints: Array | None = getattr(sequences, self.hints_from)
        if hints is None:
            raise ValueError(
                f"expected {what} with {self.hints_from}, got {sequences!r}; pass {self.hints_from}=.. to Sequences, "
                "or collect from an environment made with hint=True"
            )
        if hasattr(self, "n_hint_") and hints.shape[2] != self.n_hint_:
            raise ValueError(
                f"expected {what} with {self.n_hint_} hints as in training, got {hints.shape[2]}"
            )
        return np.where(sequences.observation_mask[:, :, None], hints, np.nan)


def check_observed(x: Array, missing: Missing) -> None:
    """Raise where an observation holds an infinity, or NaN that is not allowed, and say which."""
    if missing == "raise" and np.isnan(x).any():
        where = tuple(int(i) for i in np.argwhere(np.isnan(x))[0])
        raise ValueError(
            f"observation: expected finite numbers, got nan at index {where}; missing='predict' takes NaN for not "
            "observed and goes on by prediction"
        )
    check_finite("observation", np.where(np.isnan(x), 0.0, x) if missing == "predict" else x)
