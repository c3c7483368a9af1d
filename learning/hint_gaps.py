"""How much less sure an estimate is when observations were missed.

A learned filter goes on by its own prediction where an observation is missing, and its uncertainty, a function of the
belief, does not know of that. Trajectories show it: with h_hat_{t|j} the estimate of h_t from x_0 .. x_{t-j} alone,

    c_j = mean |h_hat_{t|j} - h_t|^2 - mean |h_hat_{t|0} - h_t|^2,     at least 0 and made to grow with j,

for each component; the variance of an estimate after j missed observations is c_j more than that of the belief. (A
factor in its place is as good where the variance does not depend on the belief, and far off where it does.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
LONGEST = 20  # observations missed in a row, at most
LEAST_ROWS, MOST_ROWS = 20, 4000  # estimates that a c_j stands on


def gap_growth(filter: HintFilter, sequences: Sequences) -> Array:
    """c_1, c_2, .. of a fitted filter.

    Args:
        filter: fitted. sequences: trajectories with hints, better not those it was fitted to.

    Returns:
        (j, n_hint) in squared units of the hint, j up to 20, at least 1; the last stands for longer gaps. Zeros where
        there is too little to tell.
    """
    hints = filter._hints_of(sequences, "trajectories")
    beliefs = filter.beliefs(sequences)
    after = np.arange(1, min(LONGEST, hints.shape[1] - 1) + 1)  # estimates that j missed observations lead to
    n_starts = np.maximum(sequences.lengths[:, None] - after + 1, 0).sum(axis=0)
    longest = int(np.count_nonzero(n_starts >= LEAST_ROWS))
    if not longest:
        return np.zeros((1, hints.shape[2]))
    episode, start = np.nonzero(np.arange(hints.shape[1]) <= sequences.lengths[:, None] - longest)
    if len(start) > MOST_ROWS:
        chosen = np.sort(np.random.default_rng(0).permutation(len(start))[:MOST_ROWS])
        episode, start = episode[chosen], start[chosen]
    belief = beliefs[episode, start]
    told, filter._told_divergence = filter._told_divergence, True
    growth = np.empty((longest, hints.shape[2]))
    for j in range(1, longest + 1):
        t = start + j - 1
        action = None
        if filter.n_act_:
            action = np.where(t[:, None] > 0, sequences.actions[episode, t - 1], np.nan)
        belief = filter._follow(belief, filter._observe(belief), action)
        truth = hints[episode, t]
        missed = np.square(filter._read_hint(belief)[0] - truth).mean(axis=0)
        seen = np.square(filter._read_hint(beliefs[episode, t + 1])[0] - truth).mean(axis=0)
        growth[j - 1] = missed - seen
    filter._told_divergence = told
    return np.maximum.accumulate(np.maximum(growth, 0.0), axis=0)
