"""`PSIMActions`: PSIM+ACTIONS, filters over observations and actions that hold under another policy than the data's.

    m_{t+1} = F(m_t, x_t, a_t),     m_t = E[phi(tau_t) | h_t]

with h_t = x_0, a_0, .., x_{t-1}, a_{t-1}. F is learned by dataset aggregation as in `PSIM`. What the expectation is
over depends on `importance`:

    None         the policy that was recorded (Eq. 4.6, the naive joint model): the futures in m_t are those that this
                 policy brings about, and another one does not
    "ordinary"   G_h, by targets that carry their weights: F answers w(tau) phi(tau), whose expectation is Eq. 4.14
    "weighted"   G_h, by weighted (self-normalised) importance sampling: least squares with the weights w(tau)

    w(tau) = mu(tau^a) / pi(tau | h)                                                          (see `importance_weights`)

and with `per_decision` each observation of a test has the weight of the actions before it alone. The next observation
itself, x_hat_t, needs none: no action lies between h_t and it.

A forecast steps F along with the actions that are given, and takes each prediction for the observation: the use that
Eq. 4.6 is not good for under another policy.

References: thesis proposal, Sec. 4.2, hypothesis H4; Mahmood, van Hasselt & Sutton, "Weighted importance sampling for
off-policy learning with linear function approximation", NeurIPS 2014.
"""

from __future__ import annotations

import warnings
from copy import copy
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from beliefgym.learning.aggregation import Algorithm, Learner
from beliefgym.learning.dynamics import Standardise, Target
from beliefgym.learning.future_features import Features, FirstMoments
from beliefgym.learning.importance_weights import (
    BlindReference,
    Reference,
    check_truncate,
    effective_sample_share,
    future_log_weights,
    log_ratios,
    normalised_weights,
)
from beliefgym.learning.linear_in_features import LinearInFeatures, Ridge
from beliefgym.learning.predictive_state import Counts, TrainingData, cut_futures
from beliefgym.learning.psim import PSIM, Init
from beliefgym.learning.psim_pairs import HISTORY_RIDGE, Constant, past_windows
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.weighted_aggregate import WeightedAggregate

Array = NDArray[np.float64]
State = Literal["observations", "joint"]
Importance = Literal["ordinary", "weighted"]
FEW = 0.01  # share of effective samples below which the estimate is told to stand on few


class PSIMActions(PSIM):
    """A filter with actions, trained by dataset aggregation with importance weights (Sec. 4.2).

    Args:
        regressor: learns F, as of `PSIM`; with importance weights one linear in features (`Ridge`,
            `RandomFourierRidge`, `PolynomialRidge`).
        n_future: k, observations in a predictive state.
        features: of the observations to come, as of `PSIM`; a function of one's own takes whole-test weights.
        state: "observations", or "joint" for a belief that also holds the k actions to come (Eq. 4.6), with features
            "first".
        importance: None, "ordinary" or "weighted", see above. The weights need the trajectories' `action_log_probs`.
        per_decision: weigh each observation by the actions before it alone.
        truncate: largest weight, as a multiple of their mean; None for no limit. It trades variance for bias.
        reference: the blind policy mu, "marginal" or "uniform" (the thesis's).
        n_choices: number of choices of a discrete action, one column of whole numbers from 0; None for real numbers.
        target, n_iterations, init, n_past, discount, algorithm, step_size, standardise, belief_limit, progress_bar: as
            of `PSIM`; with importance the target is "next" and the algorithm "follow_the_leader".

    Attributes:
        model_, best_iteration_, history_: as of `PSIM`. What chooses is the error of the next observation on validation
            trajectories, which needs no weights, whatever policy they are from.
        effective_samples_: (k,) share of effective samples among the targets for each observation to come (Kish); ones
            without importance.

    Example:
        >>> filter = PSIMActions(importance="weighted", per_decision=True)  # doctest: +SKIP
        >>> filter.fit(collect(env, GaussianPolicy(controller, 0.5, seed=0), 100, seed=0))  # doctest: +SKIP
        >>> belief = filter.update(belief, observation, action)  # doctest: +SKIP
    """

    action_timing = "present"

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        n_future: int = 5,
        features: Features = "first",
        state: State = "observations",
        importance: Importance | None = None,
        per_decision: bool = False,
        truncate: float | None = None,
        reference: Reference = "marginal",
        n_choices: int | None = None,
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
        super().__init__(
            regressor,
            n_future=n_future,
            features=features,
            target=target,
            n_iterations=n_iterations,
            init=init,
            n_past=n_past,
            discount=discount,
            algorithm=algorithm,
            step_size=step_size,
            standardise=standardise,
            belief_limit=belief_limit,
            progress_bar=progress_bar,
        )
        self.state = state
        self.importance = importance
        self.per_decision = per_decision
        self.truncate = truncate
        self.reference = reference
        self.n_choices = n_choices

    def _check_parameters(self) -> None:
        super()._check_parameters()
        for name, value, allowed in (
            ("state", self.state, get_args(State)),
            ("importance", self.importance, (None, *get_args(Importance))),
        ):
            if value not in allowed:
                raise ValueError(f"expected {name} to be one of {allowed}, got {value!r}")
        check_truncate(self.truncate)
        if self.state == "joint" and (self.features != "first" or self.target != "next"):
            raise ValueError("expected features='first' and target='next' with state='joint', got others")
        if self.importance is None:
            return
        if self.target != "next" or self.algorithm != "follow_the_leader":
            raise ValueError(
                "expected target='next' and algorithm='follow_the_leader' with importance weights, got "
                f"{self.target!r} and {self.algorithm!r}"
            )
        if callable(self.features) and self.per_decision:
            raise ValueError("expected features 'first' or 'second' with per_decision, got a function")
        if self.regressor is not None and not isinstance(self.regressor, LinearInFeatures):
            raise TypeError(
                "expected a regressor linear in features (Ridge, RandomFourierRidge, PolynomialRidge) with importance "
                f"weights, got {type(self.regressor).__name__}"
            )

    def partial_fit(self, train: Sequences) -> Any:
        """As of `PSIM`, without importance weights.

        Raises:
            TypeError: with importance weights, which are brought to mean 1 over all training data at once.
        """
        if self.importance is not None:
            raise TypeError("expected importance=None to learn on; importance weights are of a whole fit")
        return super().partial_fit(train)

    def chosen(self) -> LinearInFeatures:
        """As of `PSIM`, without weighted importance sampling.

        Raises:
            TypeError: with importance "weighted", whose sums are of each block of targets, not of one regressor.
        """
        if self.importance == "weighted":
            raise TypeError(
                "expected importance=None or 'ordinary' for a regressor with its sums, got 'weighted'"
            )
        return super().chosen()

    def _begin_predictive(self, train: Sequences, validation: Sequences | None) -> TrainingData:
        if self.importance is not None and isinstance(
            train, Sequences
        ):  # what is missing is told before the work
            log_ratios(train, BlindReference("uniform", train.actions))
        return super()._begin_predictive(train, validation)

    def _training_data(self, sequences: Sequences) -> TrainingData:
        if self.state == "joint" and isinstance(self._phi, FirstMoments):
            self._phi = ObservationsAndActions(self.n_future, self.n_obs_, self._action_coding.size)
        data = super()._training_data(sequences)
        self.effective_samples_ = np.ones(self.n_future)
        self._target_block: NDArray[np.intp] | None = None
        if self.importance is not None:
            self._weigh(data)
        return data

    def _weigh(self, data: TrainingData) -> None:
        """Bring the weights into the targets ("ordinary"), or set them behind the answers ("weighted")."""
        sequences, k = data.sequences, self.n_future
        mask = sequences.step_mask
        reference = BlindReference(self.reference, sequences.actions[mask], self.n_choices)
        n_factors = k if self.state == "joint" else k - 1
        n_rows = data.targets.shape[1]
        logs = future_log_weights(log_ratios(sequences, reference), n_factors, n_rows)
        if not self.per_decision:
            logs = logs[:, :, -1:]
        complete = np.arange(n_rows) < data.n_targets[:, None]
        weights: Array = np.zeros(logs.shape)
        for i in range(logs.shape[2]):
            weights[complete, i] = normalised_weights(logs[complete, i], self.truncate)
        shares = [effective_sample_share(weights[complete, i]) for i in range(weights.shape[2])]
        self.effective_samples_ = np.array(shares[:k] if self.per_decision else shares * k)
        if min(shares) < FEW:
            warnings.warn(
                f"{min(shares):.2%} of {complete.sum()} futures carry the weight of all (importance weights of up to "
                f"{n_factors} actions): per_decision=True, truncate=10, a smaller n_future or a policy nearer to blind "
                "make it more",
                stacklevel=6,
            )
        block = self._blocks(weights.shape[2])
        self._bounding_targets = data.targets
        if self.importance == "ordinary":
            data.targets = data.targets * weights[:, :, block]
            data.answers = data.targets[:, 1:]
        else:
            self._target_block, data.weights = block, weights
            data.answers = np.concatenate([data.targets, weights], axis=2)[:, 1:]

    def _blocks(self, n_blocks: int) -> NDArray[np.intp]:
        """(size,) which of the weights each component of a target takes."""
        if n_blocks == 1:
            return np.zeros(self._phi.size, dtype=np.intp)
        of_observations = np.repeat(np.arange(self.n_future), self.n_obs_)
        if isinstance(self._phi, ObservationsAndActions):
            of_actions = np.repeat(np.arange(1, self.n_future + 1), self._phi.n_code)
            return np.concatenate([of_observations, of_actions])
        return np.tile(of_observations, self._phi.size // len(of_observations))

    def _begin_beliefs(self, data: TrainingData) -> None:
        if self.importance is None:
            super()._begin_beliefs(data)
            return
        plain = copy(data)
        plain.targets = self._bounding_targets  # bounds are of what beliefs expect, not of weighed samples
        del self._bounding_targets
        super()._begin_beliefs(plain)
        first = data.targets[:, 0]
        if data.weights is not None and self._target_block is not None:
            weights = data.weights[:, 0][:, self._target_block]
            self._first_belief = (weights * first).sum(axis=0) / weights.sum(axis=0)
        else:
            self._first_belief = first.mean(axis=0)

    def _first_hypothesis(self, regressor: Any, data: TrainingData) -> tuple[Any, tuple[Array, Array]]:
        if data.weights is None or self._target_block is None:
            return super()._first_hypothesis(regressor, data)
        episode, t = np.nonzero(data.is_learnt)
        if self.init == "history":
            known = np.nonzero(np.arange(data.targets.shape[1]) < data.n_targets[:, None])
            past = past_windows(data.inputs, self.past_length)
            weighed = np.concatenate([data.targets[known], data.weights[known]], axis=1)
            stage = WeightedAggregate(Ridge(alpha=HISTORY_RIDGE), past[known], weighed, self._target_block)
            state = stage.predict(stage.encode(past[episode, t]))
        else:
            state = data.targets[episode, t]
        pairs = self._inputs(state, data.inputs[episode, t]), data.answers[episode, t]
        nothing = pairs[0][:0], pairs[1][:0]
        if self.init == "prior":
            return Constant(self._first_belief), nothing
        hypothesis = self._new_learner(regressor, *pairs).frozen()
        return hypothesis, pairs if self.init == "history" else nothing

    def _new_learner(self, regressor: Any, X: Array, Y: Array) -> Learner:
        if self._target_block is None:
            return super()._new_learner(regressor, X, Y)
        return WeightedAggregate(regressor, X, Y, self._target_block)

    def _n_targets(self, sequences: Sequences) -> Counts:
        """A joint test needs the action at its last observation too."""
        counts = super()._n_targets(sequences)
        if self.state != "joint":
            return counts
        if not (counts > 2).any():
            raise ValueError(
                f"expected a trajectory of at least n_future + 2 = {self.n_future + 2} observations with "
                f"state='joint', got {len(sequences)} of at most {sequences.lengths.max(initial=-1) + 1}; lower "
                "n_future"
            )
        return np.maximum(counts - 1, 0)

    def _targets(self, sequences: Sequences) -> tuple[Array, Counts]:
        if not isinstance(self._phi, ObservationsAndActions):
            return super()._targets(sequences)
        n_targets, k = self._n_targets(sequences), self.n_future
        z = self._beside_actions(self._scale.apply(sequences.observations), sequences)
        futures = cut_futures(z, k)
        complete = np.arange(futures.shape[1]) < n_targets[:, None]
        targets = np.zeros((*z.shape[:2], self._phi.size))
        flat = futures[complete]
        targets[:, : futures.shape[1]][complete] = np.concatenate(
            [
                flat[:, :, : self.n_obs_].reshape(len(flat), -1),
                flat[:, :, self.n_obs_ :].reshape(len(flat), -1),
            ],
            axis=1,
        )
        return targets, n_targets


class ObservationsAndActions(FirstMoments):
    """phi of a joint test: its k observations, then its k coded actions (Eq. 4.6).

    Args:
        n_code: numbers in a coded action.
    """

    def __init__(self, n_future: int, n_obs: int, n_code: int) -> None:
        super().__init__(n_future, n_obs)
        self.n_code = n_code

    @property
    def size(self) -> int:
        """k (n_obs + n_code)."""
        return self.n_future * (self.n_obs + self.n_code)
