"""`PSIM`: Predictive State Inference Machines, filters trained as predictors of future observations.

Filtering is one function, m_{t+1} = F(m_t, x_t), of the predictive state m_t = E[phi(f_t) | h_{t-1}] and the latest
observation. It is learned by regression of phi(f_{t+1}) on the inputs (m_t, x_t) that the filter itself meets: the
present hypothesis F_n filters every training trajectory, the pairs join the aggregate, and F_{n+1} is fitted to it,

    D <- D + {((m_t^{F_n}, x_t), phi(f_{t+1}))}_{t, i},     F_{n+1} = argmin_F  sum_D |F(m, x) - phi(f)|^2,

n = 0 .. N. The hypothesis with the lowest filter error on validation trajectories is returned.

Two things are done differently, because hypotheses that diverge on the way otherwise spoil the aggregate for good (at
worst the error doubled on recorded data): beliefs are kept within bounds, and nothing is learned from one that had to
be; and the aggregate starts with the pairs that F_0 was fitted to (see `init`), not empty.

References: thesis proposal, Algorithm 4 (Sec. 3.3.3), Eqs. 3.21 to 3.23; Sun, Venkatraman, Boots & Bagnell, "Learning
to filter with predictive state inference machines", ICML 2016.
"""

from __future__ import annotations

import time
from copy import copy
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from tqdm import tqdm

from beliefgym.learning.aggregation import Algorithm, Learner, learner_for, predict_unchecked
from beliefgym.learning.dynamics import Standardise, Target
from beliefgym.learning.filters import check_whole
from beliefgym.learning.future_features import Features
from beliefgym.learning.linear_in_features import LinearInFeatures, Ridge
from beliefgym.learning.predictive_state import PredictiveStateFilter, TrainingData
from beliefgym.learning.psim_pairs import Constant, Pairs, history_pairs
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
Init = Literal["history", "teacher", "prior"]
HISTORY = (
    "iteration",
    "train_error",
    "validation_error",
    "aggregate_error",
    "n_pairs",
    "n_bounded",
    "seconds",
)


class PSIM(PredictiveStateFilter):
    """A stationary filter trained by dataset aggregation (Algorithm 4).

    With `Ridge` it is the thesis's PSIM-Linear_d, with `RandomFourierRidge(include_inputs=True)` its PSIM-RFF_d.

    Args:
        regressor: learns F; any scikit-learn regressor. Those of this package that are linear in features keep
            sufficient statistics instead of the aggregate. None for `Ridge()`.
        n_future: k, observations in a predictive state.
        features: "first" for phi_1 (Eq. 3.32), "second" for phi_2 (Eq. 3.33), or a function of futures (n, k, n_obs),
            standardised -> (n, d).
        target: "next" as in the thesis, or "delta": F(m, x) = G(m, x) + phi([x, .., x]), and G is learned. The second
            is for observations that change little in a step, where data are few: regularisation then holds on to x_t
            instead of the mean.
        n_iterations: N, at least 1.
        init: F_0, which the algorithm leaves open. "history" regresses phi(f_{t+1}) on (m~_t, x_t), with m~_t the
            regression of phi(f_t) on the last n_past observations, as in the first stage of two-stage regression, and
            these pairs start the aggregate; "teacher" takes phi(f_t) itself for m~_t, which holds the very
            observations to be predicted, so that these pairs do not; "prior" always answers m_0 (with target "delta"
            that x_t stays).
        n_past: observations of that history; None for 2 n_future.
        discount: weight of the aggregate against the next iteration's pairs, in (0, 1]; 1 is the algorithm. Below 1
            what weak first hypotheses met is forgotten; a regressor linear in features is needed then.
        algorithm: "follow_the_leader" or "online_gradient", see `DataAsDemonstrator`.
        step_size: of "online_gradient".
        standardise: bring components to one scale: True each by its own standard deviation, "together" all by one
            number (components of one unit), False not. Errors of the history are in these units.
        belief_limit: bound of a belief's components, as a multiple of the training features' largest.
        progress_bar: show the iterations.

    Attributes:
        model_: the chosen F (or G), a regressor of (m_t, x_t), standardised. best_iteration_: n of the chosen F_n.
        history_: arrays (N + 1,): "train_error" and "validation_error" (mean squared error of the next observation,
            standardised, summed over components), "aggregate_error" (of F_n on what it was fitted to, root mean
            square over all features), "n_pairs" in the aggregate it was fitted to, "n_bounded" beliefs that left
            their bounds in training, "seconds".

    Example:
        >>> filter = PSIM(RandomFourierRidge(include_inputs=True, random_state=0), n_future=5)  # doctest: +SKIP
        >>> filter.fit(train, validation).errors(test).mean  # doctest: +SKIP
    """

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        n_future: int = 5,
        features: Features = "first",
        target: Target = "next",
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
        self.features = features
        self.target = target
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
        """Run N iterations and keep the filter that predicts the validation trajectories best, one step ahead.

        Args:
            train: trajectories; those of fewer than n_future + 1 observations are left out, and told.
            validation: whole trajectories. Without them the error in training chooses.

        Raises:
            ValueError: no trajectory long enough, other components in validation, parameters out of range.
            TypeError: not `Sequences`.
        """
        self._check_parameters()
        data = self._begin_predictive(train, validation)
        regressor = Ridge() if self.regressor is None else self.regressor
        self._told_divergence = True  # hypotheses on the way may leave the bounds; the history counts it
        self.history_: dict[str, Array] = {name: np.full(self.n_iterations + 1, np.nan) for name in HISTORY}
        started = time.perf_counter()
        self.model_: Any
        self.model_, first_pairs = self._first_hypothesis(regressor, data)
        learner: Learner | None = None
        best = np.inf
        for n in tqdm(range(self.n_iterations + 1), desc=type(self).__name__, disable=not self.progress_bar):
            if learner is not None:
                self.model_ = learner.frozen()
                self._note(n, n_pairs=learner.n_pairs, aggregate_error=learner.mean_squared_error() ** 0.5)
            pairs = Pairs(learner if n < self.n_iterations else None)
            if learner is not None and self.discount < 1:
                learner.discount(self.discount)
            beliefs, n_bounded = self._filter(data, pairs)
            self._note(n, iteration=n, n_bounded=n_bounded, train_error=self._training_error(beliefs, data))
            if validation is not None:
                self._note(n, validation_error=self._history_error(validation))
            criterion = self.history_["train_error" if validation is None else "validation_error"][n]
            if criterion < best or n == 0:
                best, self.best_iteration_, chosen = criterion, n, (self.model_, copy(self._phi))
            if learner is None:
                inputs, targets = (np.concatenate(b) for b in zip(first_pairs, pairs.all(), strict=True))
                learner = self._new_learner(regressor, inputs, targets)
            elif n < self.n_iterations:
                learner.refit()
            self._note(n, seconds=time.perf_counter() - started)
            started = time.perf_counter()
        self.model_, self._phi = chosen
        self._learner = learner
        self._note_beliefs(train)
        self._told_divergence = False
        return self

    def partial_fit(self, train: Sequences) -> Self:
        """Go on learning from new trajectories: one iteration of Algorithm 4 on them, on top of the aggregate.

        The latest hypothesis (after `fit` that is F_N, whichever was chosen) goes over them, what it meets joins the
        aggregate of `fit`, and the next one is fitted to all of it: follow the leader, whose regret against the best
        fixed filter grows more slowly than the number of calls. Coordinates, features and initial belief stay those
        of `fit`.

        Args:
            train: trajectories of at least n_future + 1 observations.

        Raises:
            NotFittedError, ValueError: not fitted; loaded from a file, which holds no aggregate; too short.
        """
        self._check_fitted()
        learner = self._held_learner()
        self._standardised(train)
        self._filter(self._training_data(train), Pairs(learner))
        learner.refit()
        self.model_ = learner.frozen()
        return self

    @property
    def past_length(self) -> int:
        """Observations of the history that F_0 sees."""
        return 2 * self.n_future if self.n_past is None else self.n_past

    def chosen(self) -> LinearInFeatures:
        """The chosen filter's regressor as a copy that goes on learning, with the aggregate's sums.

        Raises:
            NotFittedError, ValueError, TypeError: not fitted; from a file; not linear in features.
        """
        self._check_fitted()
        held = getattr(self._held_learner(), "_regressor", None)
        if not isinstance(held, LinearInFeatures) or not isinstance(self.model_, LinearInFeatures):
            raise TypeError(f"expected a PSIM linear in features, got one of {type(self.model_).__name__}")
        regressor = held.frozen()
        regressor.equations_ = held.equations_.copy()
        regressor._set(self.model_._weights, self.model_._offset)
        return regressor

    def _update(self, belief: Array, z: Array) -> Array:
        answer = predict_unchecked(self.model_, self._inputs(belief, z), self._phi.size)
        return self._completed(answer, z)

    def _inputs(self, belief: Array, z: Array) -> Array:
        """(m_t, x_t) side by side: (n, size) and (n, n_obs) -> (n, size + n_obs)."""
        n, size = belief.shape
        inputs = np.empty((n, size + z.shape[1]))
        inputs[:, :size] = belief
        inputs[:, size:] = z
        return inputs

    def _first_hypothesis(self, regressor: Any, data: TrainingData) -> tuple[Any, tuple[Array, Array]]:
        """F_0, and the pairs that start the aggregate."""
        n_inputs, size = data.inputs.shape[2] + data.targets.shape[2], data.targets.shape[2]
        nothing = np.empty((0, n_inputs)), np.empty((0, size))
        if self.init == "prior":
            return Constant(self._first_belief if self.target == "next" else np.zeros(size)), nothing
        if self.init == "teacher":
            episode, t = np.nonzero(data.is_learnt)
            pairs = self._inputs(data.targets[episode, t], data.inputs[episode, t]), data.answers[episode, t]
        else:
            pairs = history_pairs(data, self.past_length)
        hypothesis = learner_for(regressor, "follow_the_leader", *pairs).frozen()
        return hypothesis, pairs if self.init == "history" else nothing

    def _new_learner(self, regressor: Any, X: Array, Y: Array) -> Learner:
        """The learner of the aggregate, started on its first pairs."""
        return learner_for(regressor, self.algorithm, X, Y, self.step_size)

    def _filter(self, data: TrainingData, pairs: Pairs) -> tuple[Array, int]:
        """The present filter over all trajectories at once, one step of time after the other.

        Args:
            data: the trajectories. pairs: are given ((m_t, x_t), answer) wherever f_{t+1} is complete.

        Returns:
            Beliefs m_t (n_episodes, n_steps + 1, size), 0 past an episode's end, and how many were outside their
            bounds.
        """
        z, bound = data.inputs, self._bound
        assert bound is not None
        n, n_rows, _ = z.shape
        beliefs = np.zeros((n, n_rows, self._phi.size))
        beliefs[:, 0] = self._first_belief
        n_bounded = 0
        learnt = data.is_learnt
        for t in range(n_rows - 1):
            going = np.flatnonzero(data.lengths > t)
            if not len(going):
                break
            rows = slice(None) if len(going) == n else going
            inputs = self._inputs(beliefs[rows, t], z[rows, t])
            following = pairs.met(inputs, data.answers[rows, t], learnt[rows, t], self.model_)
            if data.base is not None:
                following = following + data.base[rows, t]
            outside = ~(np.abs(following) <= bound)
            if outside.any():
                left = outside.any(axis=1)
                n_bounded += int(np.count_nonzero(left))
                learnt[going[left], t + 1] = False
                following = np.where(np.isnan(following), inputs[:, : self._phi.size], following)
                following = np.clip(following, -bound, bound)
            beliefs[rows, t + 1] = following
        pairs.flush()
        return beliefs, n_bounded

    def _training_error(self, beliefs: Array, data: TrainingData) -> float:
        """The error that the history holds, of beliefs met in training; learns to read them first where need be."""
        self._learn_to_read(beliefs, data.z, data.n_targets)
        return self._error_of(beliefs, data.z, data.lengths)

    def _note(self, n: int, **values: float) -> None:
        for name, value in values.items():
            self.history_[name][n] = value

    def _check_parameters(self) -> None:
        check_whole("n_iterations", self.n_iterations, 1)
        if self.n_past is not None:
            check_whole("n_past", self.n_past, 1)
        if not 0 < self.discount <= 1:
            raise ValueError(f"expected discount in (0, 1], got {self.discount!r}")
        if self.init not in get_args(Init):
            raise ValueError(f"expected init to be one of {get_args(Init)}, got {self.init!r}")

    def _held_learner(self) -> Learner:
        learner: Learner | None = getattr(self, "_learner", None)
        if learner is None:
            raise ValueError(
                "expected a PSIM that still holds its aggregate, got one from a file or a stream, which only "
                "filters; fit anew"
            )
        return learner
