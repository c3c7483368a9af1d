"""`PSIMHints` and `InferenceMachineFilter`: filters that estimate hints, trained as predictors of hints and futures.

The belief is the expectation of features of the present hint and the observations to come,

    m_{t+1} = E[phi(h_t, x_{t+1:t+k}) | x_0 .. x_t] = F(m_t, x_t),                       (Eqs. 3.37, 3.38; there m_t)

where F is learned by dataset aggregation: F_n filters all training trajectories, the pairs of what it met and of the
targets join the aggregate, and F_{n+1} is fitted to it, as in `PSIM`,

    D <- D + {((m_t^{F_n}, x_t), phi(h_t, x_{t+1:t+k}))}_{t, i}.                                          (Algorithm 5)

The F_n with the lowest error of the hint on validation trajectories is kept, and the pre-image g, h_hat_t = g(m_{t+1}),
is fitted to the beliefs it has on the training trajectories (Eq. 3.42). With k = 0 and the whole state for the hint
this is the Inference Machine Filter (Eq. 3.43).

Garbled in the thesis and put right here: Algorithm 5 initialises "m_1" with the mean of phi(h_1, f_1 = x_{1:k}), which
is the message before x_1, m_0 of its line 6; and its line 6 names the target phi(h_t, f_t) with f_t = x_{t:t+k-1},
where Eqs. 3.37 and 3.39 have x_{t+1:t+k}: the present observation is known already. The hint of m_0 is that of the
first time: there is none before it.

References: thesis proposal, Sec. 3.4; Venkatraman, Sun, Hebert, Bagnell & Boots, "Inference machines for nonparametric
filter learning", IJCAI 2016.
"""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator

from beliefgym.learning.aggregation import Algorithm, predict_unchecked
from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filter_errors import nan_mean
from beliefgym.learning.filters import ActionTiming, Filter, check_whole
from beliefgym.learning.hint_features import (
    FromBelief,
    HintFeatures,
    HintMoments,
    OwnHintFeatures,
    hint_features,
)
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.hint_gaps import gap_growth
from beliefgym.learning.hint_reading import HintReading, fitted
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.predictive_state import Counts, TrainingData, cut_futures
from beliefgym.learning.psim import PSIM, Init
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
Preimage = Any  # a regressor, a sequence of them, "belief" or None: scikit-learn has no type for regressors
LEAST_PAST = 5  # observations that F_0 sees twice as many of where k is smaller


class PSIMHints(PSIM, HintFilter):
    """PSIM+Hints (Algorithm 5): the belief holds the present hint and the next k observations.

    Args:
        regressor: learns F, as of `PSIM`. None for `Ridge()`.
        n_future: k, observations to come in the belief, at least 0.
        n_hints: l, hints in the belief, the present one first; at least 1 (the thesis's footnote 9).
        features: "first" for first moments, "second" for first and second ones, or a function of standardised hints
            (n, l, n_hint) and futures (n, k, n_obs) -> (n, d).
        preimage: learns g: a regressor; several, of which cross-validation over whole training trajectories chooses;
            "belief" to read the hint's first moment off the belief; None for the choice between `Ridge` and
            `RandomFourierRidge`.
        hints_from: the trajectories' array that holds the hints, "hints" or "states".
        pad_end: take an episode's last observation and hint for those after its end, so that something is learned from
            every step: for episodes of a few k steps that all go through the same phases, whose last one would else be
            left out. False learns from complete futures alone.
        hint_weight: scale of the standardised hints in a belief, against 1 of the observations. Regressors that measure
            distances (random Fourier features) see a hint among many observations better where it is above 1.
        use_actions: let an update take the action before its observation, m_{t+1} = F(m_t, x_t, a_{t-1}); forecasts
            then expect the actions of the policy trained under.
        n_choices: number of choices of a discrete action, one column of whole numbers from 0; None for real numbers.
        n_iterations, init, discount, algorithm, step_size, standardise, belief_limit, progress_bar: as of `PSIM`. Hints
            are standardised as the observations are, by themselves.
        n_past: observations of the history of `init`; None for 2 max(k, 5).

    Attributes:
        model_, best_iteration_, history_: as of `PSIM`; the errors in the history are those of the hint as the belief
            itself holds it, without g, squared and summed over standardised components.
        preimage_: g. preimage_errors_: root mean squared error of each candidate for g in cross-validation, by name.
        n_hint_, hint_names_, prior_mean_, prior_std_: as of `HintFilter`.
        gap_growth_: what is added to the variance of an estimate after 1, 2, .. observations that were missed, measured
            on the validation (or training) trajectories.

    Example:
        >>> filter = PSIMHints(RandomFourierRidge(include_inputs=True, random_state=0), n_future=10)  # doctest: +SKIP
        >>> filter.fit(train, validation).hint_errors(test).mean  # doctest: +SKIP
    """

    target = "next"
    features: Any  # HintFeatures; the base's are functions of futures alone
    _phi: HintMoments

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        n_future: int = 5,
        n_hints: int = 1,
        features: HintFeatures = "first",
        preimage: Preimage = None,
        hints_from: Literal["hints", "states"] = "hints",
        pad_end: bool = False,
        hint_weight: float = 1.0,
        use_actions: bool = False,
        n_choices: int | None = None,
        n_iterations: int = 20,
        init: Init = "history",
        n_past: int | None = None,
        discount: float = 1.0,
        algorithm: Algorithm = "follow_the_leader",
        step_size: float = 0.1,
        standardise: Standardise = True,
        belief_limit: float = 3.0,
        progress_bar: bool = False,
    ) -> None:
        self.regressor = regressor
        self.n_future = n_future
        self.pad_end = pad_end
        self.hint_weight = hint_weight
        self.n_hints = n_hints
        self.features = features
        self.preimage = preimage
        self.hints_from = hints_from
        self.use_actions = use_actions
        self.n_choices = n_choices
        self.n_iterations = n_iterations
        self.init = init
        self.n_past = n_past
        self.discount = discount
        self.algorithm = algorithm
        self.step_size = step_size
        self.standardise = standardise
        self.belief_limit = belief_limit
        self.progress_bar = progress_bar

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Run N iterations, keep the best filter, and learn to read it.

        Args:
            train: trajectories with hints; F learns nothing from those of fewer than max(k, l - 1) + 1 observations.
            validation: whole trajectories with hints, which choose among the F_n and tell how sure estimates are.
                Without them the error in training chooses, and uncertainties come from cross-validation of g alone:
                F has seen these trajectories, so that they are somewhat too small.

        Raises:
            ValueError: no hints; no trajectory long enough; other components in validation; parameters out of range.
            TypeError: not `Sequences`, a pre-image that is no regressor.
        """
        candidates = self._candidates()
        self.__dict__.pop("model_", None)
        super().fit(train, validation)
        self._told_divergence = True  # here it is no news: `n_bounded` counts it
        if isinstance(self.preimage, str):
            candidates = {"belief": FromBelief(self._phi, self.hint_weight)}
        seen = self._rows(train)
        unseen = None if validation is None else self._rows(validation)
        self._reading = HintReading().fit(*seen, candidates, unseen)
        self.preimage_, self.preimage_errors_ = self._reading.model, self._reading.errors
        if not self.n_future:
            mask, z = train.observation_mask, self._standardised(train)
            regressor = Ridge() if self.regressor is None else self.regressor
            self._observer = fitted(regressor, self.beliefs(train)[:, :-1][mask], z[mask])
        self.gap_growth_ = gap_growth(self, train if validation is None else validation)
        self._told_divergence = False
        return self

    def partial_fit(self, train: Sequences) -> Self:
        """Not here: g and the uncertainties would be left behind.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            f"expected fit(train, validation): a {type(self).__name__} does not learn on, since its pre-image stands "
            "on the beliefs of all training trajectories; fit anew, or go on learning with PSIM"
        )

    @property
    def action_timing(self) -> ActionTiming:  # type: ignore[override]
        """Whether an update takes the action before its observation."""
        return "previous" if self.use_actions else "none"

    @property
    def past_length(self) -> int:
        """Observations of the history that F_0 sees."""
        return 2 * max(self.n_future, LEAST_PAST) if self.n_past is None else self.n_past

    def predict_variance(self, belief: ArrayLike) -> Array:
        """Variance of the next observation, as of `PSIM`.

        Raises:
            ValueError: a belief without second moments, or without observations to come (k = 0).
        """
        b = self._checked_belief(belief)
        if self._phi.squares is None or not self.n_future:
            raise ValueError("expected features='second' and n_future of at least 1, got a belief without")
        start = self._phi.n_hints * self._phi.hint_size
        variance = self._phi.variance(b)[:, start : start + self.n_obs_]
        return variance * np.square(self._scale.scale)

    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        mean = self._hint_scale.invert(self._reading.mean(belief, self.n_hint_))
        return mean, np.sqrt(self._reading.variance(belief)) * self._hint_scale.scale

    def _observe(self, belief: Array) -> Array:
        if self.n_future:
            return self._phi.read_next(belief)
        return predict_unchecked(self._observer, belief, self.n_obs_)

    def _forecast(self, belief: Array, horizon: int) -> Array:
        if self.n_future:
            return super()._forecast(belief, horizon)
        return Filter._forecast(self, belief, horizon)

    def _begin_predictive(self, train: Sequences, validation: Sequences | None) -> TrainingData:
        check_whole("n_future", self.n_future, 0)
        check_whole("n_hints", self.n_hints, 1)
        if not (np.isfinite(self.hint_weight) and self.hint_weight > 0):
            raise ValueError(f"expected hint_weight finite and above 0, got {self.hint_weight!r}")
        needed = max(self.n_future, self.n_hints - 1) + 1
        train = self._long_enough(train, f"max(n_future, n_hints - 1) + 1 = {needed}")
        self._begin(train, validation)
        self._begin_hints(train, validation)
        flat, n_targets = self._flat(train)
        complete = np.arange(flat.shape[1]) < n_targets[:, None]
        sizes = self.n_hints, self.n_hint_, self.n_future, self.n_obs_
        self._phi = hint_features(self.features, flat[complete], *sizes)
        data = self._training_data(train)
        self._begin_beliefs(data)
        return data

    def _training_data(self, sequences: Sequences) -> TrainingData:
        """One row more than there are observations: m_{t+1} of the last one has a target too, where k = 0."""
        flat, n_targets = self._flat(sequences)
        complete = np.arange(flat.shape[1]) < n_targets[:, None]
        targets = np.zeros((*flat.shape[:2], self._phi.size))
        targets[complete] = self._phi(flat[complete])
        z = np.pad(self._scale.apply(sequences.observations), ((0, 0), (0, 1), (0, 0)))
        z[:, :-1][~sequences.observation_mask] = 0.0
        inputs = np.pad(self._beside_actions(z[:, :-1], sequences), ((0, 0), (0, 1), (0, 0)))
        data = TrainingData(targets, n_targets, z, None, sequences, inputs)
        data.lengths = sequences.lengths + 1
        return data

    def _flat(self, sequences: Sequences) -> tuple[Array, Counts]:
        """v of m_0, m_1, .., that is [h_0.., x_0..], then [h_t.., x_{t+1}..] of each t; and how many are complete.

        Returns:
            (n, n_steps + 2, n_first), 0 where it is not complete, and (n,).
        """
        n_targets, k, n = self._n_targets(sequences), self.n_future, len(sequences)
        z = self._scale.apply(sequences.observations)
        h = self._hint_scale.apply(self._hints_of(sequences, "trajectories"))
        n_rows, longest = z.shape[1], max(k, self.n_hints - 1)
        row = np.arange(n_rows + longest)
        if self.pad_end:
            row = np.minimum(row, sequences.lengths[:, None])  # (n, n_rows + longest)
        else:
            row = np.broadcast_to(
                np.minimum(row, n_rows - 1), (n, len(row))
            )  # what is not complete is cleared below
        episode = np.arange(n)[:, None]
        hints = cut_futures(h[episode, row], self.n_hints)[:, :n_rows].reshape(n, n_rows, -1)
        flat = np.zeros((n, n_rows + 1, hints.shape[2] + k * self.n_obs_))
        flat[:, 1:, : hints.shape[2]] = self.hint_weight * hints
        flat[:, 0, : hints.shape[2]] = self.hint_weight * hints[:, 0]
        if k:
            futures = cut_futures(z[episode, row], k)[:, : n_rows + 1]
            flat[:, :, hints.shape[2] :] = futures.reshape(n, n_rows + 1, -1)
        flat[np.arange(n_rows + 1) >= n_targets[:, None]] = 0.0
        return flat, n_targets

    def _n_targets(self, sequences: Sequences) -> Counts:
        needed = 0 if self.pad_end else max(self.n_future, self.n_hints - 1)
        count: Counts = sequences.lengths + 1 - needed
        if not (count > 0).any():
            raise ValueError(
                f"expected a trajectory of at least max(n_future, n_hints - 1) + 1 = {needed + 1} observations, got "
                f"{len(sequences)} of at most {sequences.lengths.max(initial=-1) + 1}; lower n_future or n_hints, or "
                "pass pad_end=True"
            )
        return np.where(count > 0, count + 1, 0)

    def _training_error(self, beliefs: Array, data: TrainingData) -> float:
        if isinstance(self._phi, OwnHintFeatures):
            flat, n_targets = self._flat(data.sequences)
            complete = np.arange(flat.shape[1]) < n_targets[:, None]
            self._phi.learn_to_read(beliefs[complete], flat[complete])
        return self._hint_error(beliefs, data.sequences)

    def _history_error(self, sequences: Sequences) -> float:
        return self._hint_error(self.beliefs(sequences), sequences)

    def _hint_error(self, beliefs: Array, sequences: Sequences) -> float:
        """Of the hint as the belief itself holds it: mean over trajectories of the mean over t, standardised."""
        n, n_rows, size = beliefs[:, 1:].shape
        read = self._phi.read_hint(beliefs[:, 1:].reshape(-1, size)).reshape(n, n_rows, -1) / self.hint_weight
        truth = self._hint_scale.apply(self._hints_of(sequences, "trajectories"))
        return float(nan_mean(np.square(read - truth).sum(axis=2), 1).mean())

    def _candidates(self) -> dict[str, Any]:
        """Regressors for g by name."""
        if self.preimage is None:
            given: list[Any] = [
                Ridge(),
                RandomFourierRidge(n_frequencies=200, include_inputs=True, random_state=0),
            ]
        elif isinstance(self.preimage, str):
            if self.preimage != "belief":
                raise ValueError(
                    f"expected preimage as a regressor, several or 'belief', got {self.preimage!r}"
                )
            return {}
        else:
            given = list(self.preimage) if isinstance(self.preimage, list | tuple) else [self.preimage]
        if not given or not all(hasattr(one, "fit") and hasattr(one, "predict") for one in given):
            raise TypeError(f"expected preimage as a regressor, several or 'belief', got {self.preimage!r}")
        names = [type(one).__name__ for one in given]
        return {
            name if names.count(name) == 1 else f"{name} {names[:i].count(name) + 1}": one
            for i, (name, one) in enumerate(zip(names, given, strict=True))
        }


class InferenceMachineFilter(PSIMHints):
    """The Inference Machine Filter (Eq. 3.43): the belief holds the present state alone, m = E[phi(s_t) | x_0 .. x_t].

    Args:
        hints_from: the trajectories' array that holds the states, "hints" or "states".
        The other arguments are those of `PSIMHints`, without n_future and n_hints.

    Example:
        >>> InferenceMachineFilter(hints_from="states").fit(train, validation)  # doctest: +SKIP
    """

    n_future = 0
    n_hints = 1
    pad_end = False
    hint_weight = 1.0

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        features: HintFeatures = "first",
        preimage: Preimage = None,
        hints_from: Literal["hints", "states"] = "hints",
        use_actions: bool = False,
        n_choices: int | None = None,
        n_iterations: int = 20,
        init: Init = "history",
        n_past: int | None = None,
        discount: float = 1.0,
        algorithm: Algorithm = "follow_the_leader",
        step_size: float = 0.1,
        standardise: Standardise = True,
        belief_limit: float = 3.0,
        progress_bar: bool = False,
    ) -> None:
        self.regressor = regressor
        self.features = features
        self.preimage = preimage
        self.hints_from = hints_from
        self.use_actions = use_actions
        self.n_choices = n_choices
        self.n_iterations = n_iterations
        self.init = init
        self.n_past = n_past
        self.discount = discount
        self.algorithm = algorithm
        self.step_size = step_size
        self.standardise = standardise
        self.belief_limit = belief_limit
        self.progress_bar = progress_bar
