"""What the training of `PSIM` and its siblings learns from: inputs met, their targets, and the first ones of all."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.aggregation import Learner, predict_unchecked
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.predictive_state import TrainingData

Array = NDArray[np.float64]
BUFFERED = 2**22  # numbers of features that are kept before they go into the aggregate (32 MiB)
HISTORY_RIDGE = 1e-6  # a sample; of the regression on the past


class Pairs:
    """Predicts, and hands the inputs met and their targets to a learner, many at once; without one it keeps them.

    Args:
        learner: whose present model predicts; it encodes inputs once for both uses. None keeps pairs, for `all`.
    """

    def __init__(self, learner: Learner | None) -> None:
        self._learner = learner
        self._inputs: list[Array] = []
        self._targets: list[Array] = []
        self._n = 0

    def met(self, inputs: Array, targets: Array, learnt: NDArray[np.bool_], model: Any) -> Array:
        """Predict the next beliefs.

        Args:
            inputs: (n, n_inputs). targets: (n, size). learnt: (n,) which have a target.
            model: predicts where there is no learner.

        Returns:
            (n, size).
        """
        if self._learner is None:
            code, predicted = inputs, predict_unchecked(model, inputs, targets.shape[1])
        else:
            code = self._learner.encode(inputs)
            predicted = self._learner.predict(code)
        if learnt.any():
            everyone = bool(learnt.all())
            self._inputs.append(code if everyone else code[learnt])
            self._targets.append(targets if everyone else targets[learnt])
            self._n += len(self._targets[-1])
            if self._learner is not None and self._n * code.shape[1] >= BUFFERED:
                self.flush()
        return predicted

    def flush(self) -> None:
        """Hand on what is kept, where there is a learner."""
        if self._learner is not None and self._n:
            self._learner.add(*self.all())
            self._inputs, self._targets, self._n = [], [], 0

    def all(self) -> tuple[Array, Array]:
        """What is kept: (n, n_inputs) and (n, size)."""
        return np.concatenate(self._inputs), np.concatenate(self._targets)


class Constant:
    """The hypothesis that answers the same to everything.

    Args:
        answer: (size,).
    """

    def __init__(self, answer: Array) -> None:
        self.answer = answer

    def predict_unchecked(self, X: Array) -> Array:
        """(n, n_inputs) -> (n, size)."""
        return np.tile(self.answer, (len(X), 1))


def history_pairs(data: TrainingData, n_past: int) -> tuple[Array, Array]:
    """Inputs (m~_t, x_t) and what a regressor is to answer, with m~_t the regression of phi(f_t) on the past.

    Returns:
        (n, size + n_obs) and (n, size).
    """
    past = past_windows(data.inputs, n_past)
    known = np.nonzero(np.arange(data.targets.shape[1]) < data.n_targets[:, None])
    state_of_past = Ridge(alpha=HISTORY_RIDGE).fit(past[known], data.targets[known])
    episode, t = np.nonzero(data.is_learnt)
    state = state_of_past.predict_unchecked(past[episode, t])
    return np.concatenate([state, data.inputs[episode, t]], axis=1), data.answers[episode, t]


def past_windows(z: Array, n_past: int) -> Array:
    """x_{t-1}, .., x_{t-n_past} before each t, 0 before the start: (n, n_rows, d) -> (n, n_rows, n_past d)."""
    n, n_rows, d = z.shape
    past = np.zeros((n, n_rows, n_past, d))
    for lag in range(1, min(n_past, n_rows - 1) + 1):
        past[:, lag:, lag - 1] = z[:, : n_rows - lag]
    return past.reshape(n, n_rows, n_past * d)
