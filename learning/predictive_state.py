"""`PredictiveStateFilter`: filters whose belief is the expectation of features of the next k observations.

    m_t = E[phi(f_t) | x_0 .. x_{t-1}],     f_t = [x_t, .., x_{t+k-1}],     m_0 = mean of phi(f_0)       (Eq. 3.16)

With phi_1 a belief is a forecast: its first block is x_hat_t, its last one x_hat_{t+k-1}. Further ahead than that, the
filter takes its own predictions for the observations that come.

A filter m_{t+1} = F(m_t, x_t) is learned as a regression, G, in one of two forms:

    target "next":   F(m, x) = G(m, x)                        (the thesis)
    target "delta":  F(m, x) = G(m, x) + phi([x, .., x])

Both can represent the same filters where phi is linear. A regularised G falls back to the mean in the first form and to
"the observation stays as it is" in the second, which is the better guess where observations change little in a step and
data are few.

Reference: thesis proposal, Secs. 3.3.1 to 3.3.3. Eqs. 3.19 and 3.23 print the mean over trajectories i = 1 .. M as
1/T sum_i^T phi(f_i^i); it is 1/M sum_i^M phi(f_1^i), as in Algorithm 3, line 2.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.dynamics import Target
from beliefgym.learning.filters import Filter, check_whole
from beliefgym.learning.future_features import (
    Features,
    FutureFeatures,
    OwnFeatures,
    SecondMoments,
    future_features,
)
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
Counts = NDArray[np.int64]


class PredictiveStateFilter(Filter):
    """Base of the predictive state filters; a subclass has the parameters below, and implements `fit` and `_update`.

    Args of every subclass:
        n_future: k.
        features: "first" (phi_1), "second" (phi_2) or a function of standardised futures (n, k, n_obs) -> (n, d).
        target: "next" or "delta", see above.
        standardise: True each component by its own standard deviation, "together" all by one number, False not.
        belief_limit: bound of a belief's components, as a multiple of the training features' largest.
    """

    n_future: int
    features: Features
    target: Target
    belief_limit: float

    def predict_variance(self, belief: ArrayLike) -> Array:
        """Variance of the next observation, (n, belief_size) -> (n, n_obs), in squared units.

        E[x^2] - E[x]^2, of which a filter linear in (m, x) cannot carry the first: it takes the square of x. With
        `PolynomialRidge(degree=2)` or `RandomFourierRidge` the variance is right on noisy data. Where data are nearly
        free of noise it is a small difference of two regressions, and mostly error: see `calibration`.

        Raises:
            ValueError: a belief without second moments.
        """
        b = self._checked_belief(belief)
        if not isinstance(self._phi, SecondMoments):
            raise ValueError(
                "expected features='second', whose beliefs hold second moments, got a belief without"
            )
        return self._phi.read_variance(self._state(b))[:, 0] * np.square(self._scale.scale)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the fitted filter to one file of plain arrays, as `save_filter`; `load_filter` reads it.

        Args:
            path: the file, used as it is; ".safetensors" is usual.

        Returns:
            The path.

        Raises:
            TypeError: features of one's own, or a regressor that is neither `Ridge` nor `RandomFourierRidge`.
        """
        from beliefgym.learning.filter_files import save_filter

        return save_filter(self, path)

    def _begin_predictive(self, train: Sequences, validation: Sequences | None) -> TrainingData:
        """Coordinates, features, the initial belief and the bounds, from the training data.

        Returns:
            The trajectories of k + 1 observations or more; the others are left out of everything.

        Raises:
            ValueError: parameters out of range; not one trajectory of k + 1 observations.
        """
        check_whole("n_future", self.n_future, 1)
        if self.target not in get_args(Target):
            raise ValueError(f"expected target to be one of {get_args(Target)}, got {self.target!r}")
        train = self._long_enough(train, f"n_future + 1 = {self.n_future + 1}")
        self._begin(train, validation)
        z, n_targets = self._scale.apply(train.observations), self._n_targets(train)
        futures = cut_futures(z, self.n_future)
        complete = np.arange(futures.shape[1]) < n_targets[:, None]
        self._phi: FutureFeatures = future_features(self.features, futures[complete])
        data = self._training_data(train)
        self._begin_beliefs(data)
        return data

    def _long_enough(self, train: Sequences, needed: str) -> Sequences:
        """The trajectories that something can be learned from; the others are told."""
        if not self.belief_limit > 0:
            raise ValueError(f"expected belief_limit above 0, got {self.belief_limit!r}")
        if not isinstance(train, Sequences) or not train.n_transitions:
            return train  # which `_begin` refuses
        short = self._n_targets(train) < 2
        if short.any():
            warnings.warn(
                f"{short.sum()} of {len(train)} trajectories have fewer than {needed} observations: nothing is learned "
                "from them",
                stacklevel=4,
            )
        return train[~short]

    def _begin_beliefs(self, data: TrainingData) -> None:
        """The initial belief and the bounds."""
        self._first_belief = data.targets[:, 0].mean(axis=0)
        rows = data.targets[np.arange(data.targets.shape[1]) < data.n_targets[:, None]]
        largest = np.abs(rows).max(axis=0)
        # where a feature does not vary, its largest value may be rounding: no bound of that size
        still = Standardisation.of(rows).constant | (self.standardise is True)
        self._bound = self.belief_limit * np.where(still, np.maximum(largest, 1.0), largest)

    def _training_data(self, sequences: Sequences) -> TrainingData:
        z, base = self._scale.apply(sequences.observations), None
        z[~sequences.observation_mask] = 0.0
        if self.target == "delta":
            base = self._base(z.reshape(-1, self.n_obs_)).reshape(*z.shape[:2], -1)
        return TrainingData(*self._targets(sequences), z, base, sequences, self._beside_actions(z, sequences))

    def _base(self, z: Array) -> Array:
        """phi of an observation that stays as it is: (n, n_obs) -> (n, size)."""
        return self._phi(np.repeat(z[:, None], self.n_future, axis=1))

    def _completed(self, answer: Array, z: Array) -> Array:
        """F(m, x) of the regressor's answer: (n, size) and (n, n_obs or more) -> (n, size)."""
        return answer if self.target == "next" else answer + self._base(z[:, : self.n_obs_])

    def _targets(self, sequences: Sequences) -> tuple[Array, Counts]:
        """phi(f_t) of every t.

        Returns:
            (n_episodes, n_steps + 1, size), 0 where f_t is not complete, and (n_episodes,) for how many t it is.
        """
        n_targets = self._n_targets(sequences)
        z = self._scale.apply(sequences.observations)
        futures = cut_futures(z, self.n_future)
        complete = np.arange(futures.shape[1]) < n_targets[:, None]
        targets = np.zeros((*z.shape[:2], self._phi.size))
        targets[:, : futures.shape[1]][complete] = self._phi(futures[complete])
        return targets, n_targets

    def _n_targets(self, sequences: Sequences) -> Counts:
        """(n_episodes,) times at which k observations are still to come."""
        n_targets: Counts = np.maximum(sequences.lengths + 2 - self.n_future, 0)
        if not (n_targets > 1).any():
            raise ValueError(
                f"expected a trajectory of at least n_future + 1 = {self.n_future + 1} observations, got "
                f"{len(sequences)} of at most {sequences.lengths.max(initial=-1) + 1}; lower n_future"
            )
        return n_targets

    def _initial(self) -> Array:
        return self._first_belief

    @property
    def belief_size(self) -> int:
        """Features of the future."""
        self._check_fitted()
        return self._phi.size

    def _state(self, belief: Array) -> Array:
        """E[phi] of a belief: (n, belief_size) -> (n, size)."""
        return belief

    def _observe(self, belief: Array) -> Array:
        return self._phi.read_next(self._state(belief))

    def _forecast(self, belief: Array, horizon: int) -> Array:
        k = self.n_future
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        predicted[:, :k] = self._phi.read(self._state(belief))[:, :horizon]
        for step in range(k, horizon):
            belief = self._advance(belief, self._with_actions(self._observe(belief), None))
            predicted[:, step] = self._phi.read_last(self._state(belief))
        return predicted

    def _history_error(self, sequences: Sequences) -> float:
        """The error that the histories hold: see `mean_next_error`."""
        inputs = self._driven(sequences)
        beliefs = np.empty((*inputs.shape[:2], self.belief_size))
        beliefs[:, 0] = self._initial()
        for t in range(inputs.shape[1] - 1):
            beliefs[:, t + 1] = self._advance(beliefs[:, t], inputs[:, t])
        return self._error_of(beliefs, inputs[:, :, : self.n_obs_], sequences.lengths)

    def _error_of(self, beliefs: Array, z: Array, lengths: Counts) -> float:
        """The same, of beliefs (n, n_rows, belief_size) that are there already."""
        n, n_rows, size = beliefs.shape
        predicted = self._observe(beliefs.reshape(-1, size)).reshape(n, n_rows, -1)
        return mean_next_error(predicted, z, lengths)

    def _learn_to_read(self, beliefs: Array, z: Array, n_targets: Counts) -> None:
        """Where the features are the user's, learn to read observations off beliefs.

        Args:
            beliefs: (n, n_rows, size), m_t of each t. z: (n, n_rows, n_obs). n_targets: (n,) complete futures.
        """
        if isinstance(self._phi, OwnFeatures):
            futures = cut_futures(z, self.n_future)
            complete = np.arange(futures.shape[1]) < n_targets[:, None]
            self._phi.learn_to_read(beliefs[:, : futures.shape[1]][complete], futures[complete])


class TrainingData:
    """Trajectories as a predictive state filter learns from them.

    Args:
        targets, n_targets: of `PredictiveStateFilter._targets`. z: (n, n_rows, n_obs) standardised.
        base: (n, n_rows, size) what the regressor's answer is added to, or None for nothing.
        sequences: the trajectories. inputs: (n, n_rows, n_obs + code's size) z and the coded actions that go with it,
            where the filter takes actions; None for z alone.

    Attributes:
        sequences, z, base, inputs: as given. lengths: (n,) steps.
        targets: (n, n_rows, size) phi(f_t), 0 where f_t is not complete. n_targets: (n,) those that are.
        answers: (n, n_rows - 1, size) what the regressor is to say of (m_t, x_t), where `is_learnt`.
        weights: (n, n_rows, n_blocks) importance weights of the targets, where there are any, else None.
    """

    def __init__(
        self,
        targets: Array,
        n_targets: Counts,
        z: Array,
        base: Array | None,
        sequences: Sequences,
        inputs: Array | None = None,
    ) -> None:
        self.sequences, self.targets, self.n_targets = sequences, targets, n_targets
        self.z, self.base, self.lengths = z, base, sequences.lengths
        self.inputs = z if inputs is None else inputs
        self.weights: Array | None = None
        self.answers = targets[:, 1:] if base is None else targets[:, 1:] - base[:, :-1]

    @property
    def is_learnt(self) -> NDArray[np.bool_]:
        """(n, n_rows) whether (m_t, x_t) has a target, phi(f_{t+1})."""
        return np.arange(self.z.shape[1]) + 1 < self.n_targets[:, None]


def mean_next_error(predicted: Array, z: Array, lengths: Counts) -> float:
    """Mean over trajectories of 1/T sum_{t=1}^T |x_hat_t - x_t|^2.

    Args:
        predicted, z: (n, n_rows, n_obs). lengths: (n,) T; those of no step do not count.
    """
    t = np.arange(z.shape[1])
    counts = (t > 0) & (t <= lengths[:, None])
    squared = np.where(counts, np.square(predicted - z).sum(axis=2), 0.0)
    used = lengths > 0
    return float((squared.sum(axis=1)[used] / lengths[used]).mean())


def cut_futures(z: Array, k: int) -> Array:
    """f_t of every t at which the padded arrays hold k rows: (n, n_rows, d) -> (n, max(n_rows - k + 1, 0), k, d)."""
    n, n_rows, d = z.shape
    if n_rows < k:
        return np.empty((n, 0, k, d))
    return np.moveaxis(np.lib.stride_tricks.sliding_window_view(z, k, axis=1), 3, 2)
