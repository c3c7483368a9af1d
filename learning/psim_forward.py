"""`ForwardPSIM`: a predictive state inference machine with a filter of its own for each step of time.

    m_{t+1} = F_t(m_t, x_t),     F_t = argmin_F  sum_i |F(m_t^i, x_t^i) - phi(f_{t+1}^i)|^2,     t = 0, 1, ..

F_t is learned from the beliefs that F_0 .. F_{t-1} give on all trajectories, so that every regression sees exactly the
inputs that it will meet (Eqs. 3.18 and 3.19). That needs many trajectories, and a filter a step. The first steps, where
a belief still gathers what there is to know, are where it gains over one filter for all times.

References: thesis proposal, Algorithm 3 and Theorems 3.3.1 to 3.3.3 (Sec. 3.3.3); Ross & Bagnell, "Efficient
reductions for imitation learning", AISTATS 2010 (forward training).
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from beliefgym.learning.aggregation import learner_for, predict_unchecked
from beliefgym.learning.dynamics import Standardise, Target
from beliefgym.learning.filters import check_whole
from beliefgym.learning.future_features import Features
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.predictive_state import PredictiveStateFilter
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]


class ForwardPSIM(PredictiveStateFilter):
    """A non-stationary filter trained forward in time (Algorithm 3).

    A belief is the predictive state and, as its last number, its step t. From `n_steps_` on, where training
    trajectories end (or are fewer than `min_trajectories`), the last F_t goes on.

    Args:
        regressor: learns each F_t; any scikit-learn regressor. None for `Ridge()`.
        n_future, features, target, standardise, belief_limit: as of `PSIM`.
        min_trajectories: fit an F_t only to this many trajectories or more.

    Attributes:
        model_: F_0, F_1, .. (or G_0, ..), regressors of (m_t, x_t), standardised. n_steps_: how many.

    Example:
        >>> ForwardPSIM(Ridge(alpha=1e-6), n_future=2).fit(train).errors(test).by_time  # doctest: +SKIP
    """

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        n_future: int = 5,
        features: Features = "first",
        target: Target = "next",
        min_trajectories: int = 1,
        standardise: Standardise = True,
        belief_limit: float = 3.0,
    ) -> None:
        self.regressor = regressor
        self.n_future = n_future
        self.features = features
        self.target = target
        self.min_trajectories = min_trajectories
        self.standardise = standardise
        self.belief_limit = belief_limit

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Learn F_0, F_1, .. one after the other.

        Args:
            train: trajectories; those of fewer than n_future + 1 observations teach nothing, and that is told.
            validation: checked, and not used: nothing is chosen.

        Raises:
            ValueError: no step for which there are min_trajectories; parameters out of range. TypeError.
        """
        check_whole("min_trajectories", self.min_trajectories, 1)
        data = self._begin_predictive(train, validation)
        z, n_targets = data.z, data.n_targets
        bound = self._bound
        assert bound is not None
        regressor = Ridge() if self.regressor is None else self.regressor
        learnt = np.arange(z.shape[1])[:, None] + 1 < n_targets  # (n_rows, n)
        self.n_steps_ = int(np.count_nonzero(learnt.sum(axis=1) >= self.min_trajectories))
        if not self.n_steps_:
            raise ValueError(
                f"expected at least {self.min_trajectories} trajectories of n_future + 1 = {self.n_future + 1} "
                f"observations, got {learnt[0].sum()}; lower min_trajectories"
            )
        self.model_: list[Any] = []
        belief = np.tile(self._first_belief, (len(z), 1))
        met = np.empty((*z.shape[:2], self._phi.size))
        for t in range(self.n_steps_):
            met[:, t] = belief
            here = np.flatnonzero(learnt[t])
            inputs = np.concatenate([belief, z[:, t]], axis=1)
            learner = learner_for(regressor, "follow_the_leader", inputs[here], data.answers[here, t])
            self.model_.append(learner.frozen())
            answer = predict_unchecked(self.model_[-1], inputs, self._phi.size)
            belief = np.clip(self._completed(answer, z[:, t]), -bound, bound)
        met[:, self.n_steps_ :] = belief[:, None]
        self._learn_to_read(met, z, np.minimum(n_targets, self.n_steps_))
        self._bound = np.append(bound, np.inf)
        self._note_beliefs(train)
        return self

    @property
    def belief_size(self) -> int:
        """Features of the future, and the step."""
        return super().belief_size + 1

    def _initial(self) -> Array:
        return np.append(self._first_belief, 0.0)

    def _state(self, belief: Array) -> Array:
        return belief[:, :-1]

    def _update(self, belief: Array, z: Array) -> Array:
        steps = np.minimum(belief[:, -1], self.n_steps_ - 1).astype(np.int64)
        inputs = np.concatenate([belief[:, :-1], z], axis=1)
        following = np.empty_like(belief)
        following[:, -1] = belief[:, -1] + 1
        for t in np.unique(steps):
            rows = slice(None) if (steps == t).all() else steps == t
            answer = predict_unchecked(self.model_[t], inputs[rows], self._phi.size)
            following[rows, :-1] = self._completed(answer, z[rows])
        return following
