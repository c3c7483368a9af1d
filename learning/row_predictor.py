"""`row_predictor`: one row through a fitted regressor in a few microseconds, for loops that run in real time.

    Ridge:              y = A'x + b
    RandomFourierRidge: y = A'[x, cos(W'x), sin(W'x)] + b           (x where inputs are features)

Other regressors go through their own `predict`, at their own pace.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.aggregation import predict_unchecked
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.random_fourier import RandomFourierRidge

Array = NDArray[np.float64]
Row = Callable[[Array], Array]


def row_predictor(model: Any, n_targets: int) -> Row:
    """A function from one row (n_inputs,) to (n_targets,), in an array of its own.

    Args:
        model: a fitted regressor; later fits of it do not change the function where it is one of the above.
    """
    if type(model) is Ridge:
        transposed, offset = np.ascontiguousarray(model._weights.T), model._offset.copy()
        return lambda row: transposed @ row + offset
    if type(model) is RandomFourierRidge:
        return _waves(model)

    def one(row: Array) -> Array:
        return np.array(predict_unchecked(model, row[None], n_targets)[0])

    return one


def _waves(model: RandomFourierRidge) -> Row:
    n_inputs, m = model.frequencies_.shape
    start = n_inputs if model.include_inputs else 0
    frequencies = np.ascontiguousarray(model.frequencies_.T)
    scaled = model._weights.copy()
    scaled[start:] *= m**-0.5
    transposed, offset = np.ascontiguousarray(scaled.T), model._offset.copy()
    features, angle = np.empty(start + 2 * m), np.empty(m)
    inputs, cosine, sine = features[:start], features[start : start + m], features[start + m :]

    def one(row: Array) -> Array:
        np.dot(frequencies, row, out=angle)
        np.cos(angle, out=cosine)
        np.sin(angle, out=sine)
        if start:
            inputs[:] = row
        return transposed @ features + offset

    return one
