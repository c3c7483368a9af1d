"""Projections of what is to come on what was seen, from one triangular factor of all windows of all trajectories.

With a one and a window of k observations in each row of W (m, 1 + k d), W = Q R and R / sqrt(m) = T,

    T'T = 1/m W'W,     (projection of columns b on columns a) = Q (U U' T_b) sqrt(m),     T_a = U s V'

so that every regression of later on earlier columns, and the covariance of what it leaves, is had from T alone. Its
first row holds the means (times T_00 = +-1), and below it, to the right of the first column, are the deviations from
them. T comes from the data by reflections, never from their squares: it keeps twice the digits of a covariance.

Reference: Van Overschee & De Moor, "Subspace Identification for Linear Systems", 1996, Sec. 6.1 (there transposed: LQ).
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.linear_in_features import BLOCK_BYTES
from beliefgym.learning.windows import ragged_range

Array = NDArray[np.float64]
ROUNDING = 1e-10  # a singular value below this share of the largest is rounding


def window_triangle(y: Array, lengths: NDArray[np.int64], width: int, what: str) -> tuple[Array, int]:
    """T, of all windows of `width` observations; none crosses an end.

    Args:
        y: (n_episodes, n_steps + 1, d). lengths: (n_episodes,) steps. width: k. what: its name, for messages.

    Returns:
        T (r, 1 + k d), r = 1 + k d, or m where there are fewer windows; and m.

    Raises:
        ValueError: not one trajectory of k observations. Some that are shorter are told.
    """
    counts = np.maximum(lengths + 2 - width, 0)
    episode, start = ragged_range(counts)
    if not len(episode):
        raise ValueError(
            f"expected a trajectory of at least {what} = {width} observations, got {len(lengths)} of at most "
            f"{lengths.max(initial=-1) + 1}; take fewer"
        )
    if not counts.all():
        warnings.warn(
            f"{np.count_nonzero(counts == 0)} of {len(lengths)} trajectories have fewer than {what} = {width} "
            "observations: nothing is learned from them",
            stacklevel=3,
        )
    n_columns = 1 + width * y.shape[2]
    triangle = np.empty((0, n_columns))
    rows = max(n_columns, BLOCK_BYTES // (8 * n_columns))
    for i in range(0, len(episode), rows):
        at = start[i : i + rows, None] + np.arange(width)
        block = y[episode[i : i + rows, None], at].reshape(len(at), -1)
        block = np.concatenate([np.ones((len(at), 1)), block], axis=1)
        triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, block]), mode="r"))
    return triangle / np.sqrt(len(episode)), len(episode)


def scaled_svd(columns: Array) -> tuple[Array, Array, Array, Array]:
    """columns = U s V' diag(norms), the columns brought to norm 1 first, without what is rounding.

    Args:
        columns: (rows, c), in any units.

    Returns:
        U (rows, r), s (r,), V' (r, c), norms (c,), 1 for columns of zeros.
    """
    norms = np.linalg.norm(columns, axis=0)
    norms[norms == 0] = 1.0
    left, values, right = np.linalg.svd(columns / norms, full_matrices=False)
    keep = values > ROUNDING * values.max(initial=0.0)
    return left[:, keep], values[keep], right[keep], norms


def tell_few_windows(n_windows: int, n_inputs: int, what: str) -> None:
    """Warn where a regression has so few rows that it fits anything."""
    if n_windows <= n_inputs:
        warnings.warn(
            f"{n_windows} windows for a regression on {n_inputs} numbers: it fits whatever the data are; lower {what}",
            stacklevel=3,
        )
