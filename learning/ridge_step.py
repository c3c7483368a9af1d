"""`RidgeStep`: one update of many beliefs of a `PSIM` with `Ridge` or `RandomFourierRidge`, as few matrix products.

    F(m, (x - c)/s, (a - d)/r) = A' m + B' diag(1/s) x + C' diag(1/r) a + (b - B' c/s - C' d/r) = W' y

with y = [m, x, a, 1] and the standardisation in the weights. `FourierStep` adds the waves in the same way: with
half angles V' y and t = tan(V' y), u = 1 / (1 + t^2) is cos = 2 u - 1 and t u is sin / 2, so that

    F = W' y + P' u + Q' (t u).

Both equal the filter's own update to rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.filters import Filter
from beliefgym.learning.future_features import FirstMoments
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.random_fourier import CACHED, RandomFourierRidge

Array = NDArray[np.float64]


class RidgeStep:
    """The update of at most n beliefs at a time; later fits of the filter do not change it.

    Args:
        filter: one for which `of` gives a step. n: the most beliefs at a time.

    Attributes:
        least_bound: beliefs of no component beyond are within their bounds.
    """

    def __init__(self, filter: Any, n: int) -> None:
        size, d = filter.belief_size, filter.n_obs_
        self._size, self._end = size, size + d
        self.least_bound = float(filter._bound.min())
        offset, scale = filter._scale.offset, filter._scale.scale
        self._n_act = 0 if filter.action_timing == "none" else filter.n_act_
        if self._n_act:
            coding = filter._action_coding.scale
            self._no_action = coding.offset  # whose code is 0
            offset, scale = np.concatenate([offset, coding.offset]), np.concatenate([scale, coding.scale])
        self._offset, self._scale = offset, scale
        weights = self._of_inputs(filter.model_)
        if filter.target == "delta":
            weights[size : size + d] += filter._base(np.eye(d))
        self._weights = self._raw(weights, self._constant(filter.model_))
        self._inputs = np.ones((n, len(self._weights)))

    @staticmethod
    def of(filter: Filter, n: int) -> RidgeStep | None:
        """The step of a filter, or None where its update is another function."""
        kind = type(filter)
        is_plain = (
            isinstance(filter, PSIM)
            and kind._update is PSIM._update
            and kind._inputs is PSIM._inputs
            and kind._completed is PSIM._completed
            and kind._advance is Filter._advance
            and kind._follow in (Filter._follow, HintFilter._follow)
            and type(filter.model_) in STEPS
            and (filter.target == "next" or type(filter._phi) is FirstMoments)
            and filter.n_choices is None
            and filter._bound is not None
        )
        return STEPS[type(filter.model_)](filter, n) if is_plain else None  # type: ignore[attr-defined]

    def __call__(self, belief: Array, x: NDArray[Any], actions: NDArray[Any] | None) -> Array:
        """The next beliefs, not yet kept within bounds, of finite observations and actions in their own units.

        Args:
            belief: (n, belief_size). x: (n, n_obs). actions: (n, n_act); None where there are none yet.

        Returns:
            (n, belief_size), an array of its own.
        """
        inputs = self._inputs[: len(belief)]
        inputs[:, : self._size] = belief
        inputs[:, self._size : self._end] = x
        if self._n_act:
            inputs[:, self._end : -1] = self._no_action if actions is None else actions
        return self._following(inputs)

    def _following(self, inputs: Array) -> Array:
        """(n, inputs + 1) -> (n, belief_size)."""
        following: Array = inputs @ self._weights
        return following

    def _of_inputs(self, model: Any) -> Array:
        """(inputs, belief_size) the model's weights of the inputs themselves, a copy."""
        weights: Array = model._weights.copy()
        return weights

    def _constant(self, model: Any) -> Array:
        """(belief_size,) what the model adds."""
        offset: Array = model._offset
        return offset

    def _raw(self, weights: Array, constant: Array) -> Array:
        """Weights of standardised inputs -> (inputs + 1, k) those of [m, x, a, 1]; the first are written to."""
        weights[self._size :] /= self._scale[:, None]
        constant = constant - self._offset @ weights[self._size :]
        return np.concatenate([weights, constant[None]])


class FourierStep(RidgeStep):
    """The same with random features, in blocks of beliefs whose waves stay in the processor's cache.

    A block is kept as columns, so that u, t u and y each lie in one piece and go through one product.
    """

    def __init__(self, filter: Any, n: int) -> None:
        model = filter.model_
        self._m, factor = model.n_frequencies, 2.0 * model.n_frequencies**-0.5
        super().__init__(filter, n)
        self._halves = np.ascontiguousarray(self._raw(0.5 * model.frequencies_, np.zeros(self._m)).T)
        self._weights = np.concatenate([factor * model._weights[-2 * self._m :], self._weights])
        self._rows = min(n, max(1, CACHED // self._m))
        self._waves = np.empty(len(self._weights) * self._rows)
        self._tangents = np.empty(self._m * self._rows)

    def _following(self, inputs: Array) -> Array:
        following = np.empty((len(inputs), self._size))
        for start in range(0, len(inputs), self._rows):
            self._block(inputs[start : start + self._rows], following[start : start + self._rows])
        return following

    def _block(self, inputs: Array, following: Array) -> None:
        m, n = self._m, len(inputs)
        features = self._waves[: len(self._weights) * n].reshape(-1, n)
        u, tu, y = features[:m], features[m : 2 * m], features[2 * m :]
        t = self._tangents[: m * n].reshape(m, n)
        y[:] = inputs.T
        np.matmul(self._halves, y, out=t)
        np.tan(t, out=t)
        np.multiply(t, t, out=u)
        u += 1.0
        np.divide(1.0, u, out=u)
        np.multiply(t, u, out=tu)
        np.matmul(features.T, self._weights, out=following)

    def _of_inputs(self, model: Any) -> Array:
        start = len(model._weights) - 2 * self._m
        return model._weights[:start].copy() if start else np.zeros((len(model.frequencies_), self._size))

    def _constant(self, model: Any) -> Array:
        cosines = model._weights[-2 * self._m : -self._m]
        constant: Array = model._offset - self._m**-0.5 * cosines.sum(axis=0)
        return constant


STEPS: dict[type, type[RidgeStep]] = {Ridge: RidgeStep, RandomFourierRidge: FourierStep}
