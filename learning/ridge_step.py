"""`RidgeStep`: one update of many beliefs of a `PSIM` with `Ridge`, as one matrix product.

    F(m, (x - c)/s, (a - d)/r) = A' m + B' diag(1/s) x + C' diag(1/r) a + (b - B' c/s - C' d/r)

that is [m, x, a, 1] W, with the standardisation in the weights. It equals the filter's own update to rounding.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.filters import Filter
from beliefgym.learning.future_features import FirstMoments
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim import PSIM

Array = NDArray[np.float64]


class RidgeStep:
    """The update of at most n beliefs at a time; later fits of the filter do not change it.

    Args:
        filter: one for which `of` gives a step. n: the most beliefs at a time.
    """

    def __init__(self, filter: Any, n: int) -> None:
        size, d = filter.belief_size, filter.n_obs_
        weights = filter.model_._weights.copy()
        if filter.target == "delta":
            weights[size : size + d] += filter._base(np.eye(d))
        offset, scale = filter._scale.offset, filter._scale.scale
        self._n_act = 0 if filter.action_timing == "none" else filter.n_act_
        if self._n_act:
            coding = filter._action_coding.scale
            offset, scale = np.concatenate([offset, coding.offset]), np.concatenate([scale, coding.scale])
        weights[size:] /= scale[:, None]
        constant = filter.model_._offset - offset @ weights[size:]
        self._weights = np.concatenate([weights, constant[None]])
        self._bound, self._least_bound = filter._bound, float(filter._bound.min())
        self._inputs = np.ones((n, len(self._weights)))
        self._size, self._end = size, size + d

    @classmethod
    def of(cls, filter: Filter, n: int) -> Self | None:
        """The step of a filter, or None where its update is another function."""
        kind = type(filter)
        is_plain = (
            isinstance(filter, PSIM)
            and kind._update is PSIM._update
            and kind._inputs is PSIM._inputs
            and kind._completed is PSIM._completed
            and kind._advance is Filter._advance
            and kind._follow in (Filter._follow, HintFilter._follow)
            and type(filter.model_) is Ridge
            and (filter.target == "next" or type(filter._phi) is FirstMoments)
            and filter.n_choices is None
            and filter._bound is not None
        )
        return cls(filter, n) if is_plain else None

    def __call__(self, belief: Array, x: NDArray[Any], actions: Array | None) -> Array | None:
        """The next beliefs, of finite observations and actions in their own units.

        Args:
            belief: (n, belief_size). x: (n, n_obs). actions: (n, n_act), or None.

        Returns:
            (n, belief_size); None where one leaves its bounds or an action is needed and not there, which is left to
            the filter.
        """
        if self._n_act and actions is None:
            return None
        inputs = self._inputs[: len(belief)]
        inputs[:, : self._size] = belief
        inputs[:, self._size : self._end] = x
        if self._n_act:
            inputs[:, self._end : -1] = actions
        following = inputs @ self._weights
        largest = np.abs(following)
        is_inside = largest.max(initial=0.0) <= self._least_bound or (largest <= self._bound).all()
        return following if is_inside else None  # NaN is not
