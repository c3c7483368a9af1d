"""Statistics over few runs: interquartile means with stratified bootstrap intervals.

A run is one trained agent; its score is the mean over its evaluation episodes of

    score = (return - random) / (expert - random)

so that 0 is the random policy and 1 the expert. Runs of several tasks are summarised by their interquartile
mean (IQM), the mean of the middle 50 % of all runs: less moved by one lucky run than the mean, and using
more of the data than the median. Its interval is the 2.5th to 97.5th percentile over resamples that draw
runs with replacement within each task (the strata), so every resample has as many runs of each task as
there are.

Reference: Agarwal, Schwarzer, Castro, Courville and Bellemare, "Deep reinforcement learning at the edge of
the statistical precipice", NeurIPS 2021, sections 4.1 (stratified bootstrap), 4.2 (performance profiles)
and 4.3 (IQM, probability of improvement).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import trim_mean

Array = NDArray[np.float64]
Statistic = Callable[[Array], Array]

RESAMPLES = 10_000
BOOTSTRAP_SEED = 20_210_828  # any fixed number: the same runs give the same interval on every machine
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A summary of runs with its interval.

    Args:
        value: the summary; NaN without runs.
        low, high: ends of the interval; NaN where a task has fewer than two runs, which say nothing about
            spread.
        n_runs: the runs it stands on.
    """

    value: float
    low: float
    high: float
    n_runs: int

    @property
    def has_interval(self) -> bool:
        """Whether there were enough runs for an interval."""
        return bool(np.isfinite(self.low) and np.isfinite(self.high))


def normalised_score(returns: ArrayLike, random_score: float, expert_score: float) -> float:
    """Mean over episodes of (return - random) / (expert - random).

    Args:
        returns: evaluation returns, shape (n_episodes,).
        random_score, expert_score: mean returns of the random policy and of the expert.

    Raises:
        ValueError: where there are no returns, or the expert is not above random.
    """
    values = np.asarray(returns, dtype=np.float64)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"returns is a vector with one number an episode, not of shape {values.shape}")
    if not expert_score > random_score:
        raise ValueError(f"expert_score is above random_score, not {expert_score:g} against {random_score:g}")
    return float((values.mean() - random_score) / (expert_score - random_score))


def interquartile_mean(scores: Array) -> Array:
    """Mean of the middle 50 % along the last axis: a quarter of the values, rounded down, is cut at each end.

    Args:
        scores: shape (..., n_runs).

    Returns:
        Shape (...).
    """
    return np.asarray(trim_mean(scores, 0.25, axis=-1))


def mean(scores: Array) -> Array:
    """Mean along the last axis."""
    return scores.mean(axis=-1)


def median(scores: Array) -> Array:
    """Median along the last axis."""
    return np.median(scores, axis=-1)


def resample(strata: Sequence[Array], n_resamples: int, rng: np.random.Generator) -> list[Array]:
    """Draws each stratum with replacement, as many runs as it has.

    Args:
        strata: for each task the scores of its runs, each of shape (n_runs of the task,).
        n_resamples: how often.
        rng: source of the draws.

    Returns:
        For each task shape (n_resamples, n_runs of the task).
    """
    return [runs[rng.integers(runs.size, size=(n_resamples, runs.size))] for runs in strata]


def estimate(
    strata: Sequence[ArrayLike],
    statistic: Statistic = interquartile_mean,
    *,
    n_resamples: int = RESAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Estimate:
    """A statistic of all runs with its 95 % stratified bootstrap interval.

    Args:
        strata: for each task the scores of its runs, shape (n_runs of the task,); tasks without runs count
            for nothing.
        statistic: takes scores of shape (..., n_runs) to (...).
        n_resamples: bootstrap resamples.
        seed: of the resamples; a stream of its own for each call, so that no interval depends on another.

    Returns:
        The estimate; its interval is NaN where any task with runs has fewer than two.
    """
    runs = _strata(strata)
    n_runs = sum(task.size for task in runs)
    if n_runs == 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    value = float(statistic(np.concatenate(runs)))
    if any(task.size < 2 for task in runs):
        return Estimate(value, np.nan, np.nan, n_runs)
    drawn = resample(runs, n_resamples, np.random.default_rng(seed))
    low, high = _interval(statistic(np.concatenate(drawn, axis=-1)))
    return Estimate(value, float(low), float(high), n_runs)


def probability_of_improvement(
    ours: Sequence[ArrayLike],
    theirs: Sequence[ArrayLike],
    *,
    n_resamples: int = RESAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Estimate:
    """How likely a run of ours beats a run of theirs on the same task, averaged over the tasks.

    P = mean over tasks of [ #(x > y) + 1/2 #(x = y) ] / (n m)  over all pairs of runs x of ours, y of theirs.

    Args:
        ours, theirs: for each task the scores of the runs; tasks in the same order, those without runs on
            either side count for nothing.
        n_resamples, seed: as in `estimate`.

    Returns:
        The probability with its stratified bootstrap interval; NaN where there is no common task.

    Raises:
        ValueError: where the two have different numbers of tasks.
    """
    if len(ours) != len(theirs):
        raise ValueError(
            f"both agents have the same tasks in the same order, not {len(ours)} and {len(theirs)}"
        )
    pairs = [(_vector(x), _vector(y)) for x, y in zip(ours, theirs, strict=True)]
    pairs = [(x, y) for x, y in pairs if x.size and y.size]
    n_runs = sum(x.size + y.size for x, y in pairs)
    if not pairs:
        return Estimate(np.nan, np.nan, np.nan, 0)
    value = float(np.mean([_win_rate(x, y) for x, y in pairs]))
    if any(min(x.size, y.size) < 2 for x, y in pairs):
        return Estimate(value, np.nan, np.nan, n_runs)
    rng = np.random.default_rng(seed)
    xs = resample([x for x, _ in pairs], n_resamples, rng)
    ys = resample([y for _, y in pairs], n_resamples, rng)
    low, high = _interval(np.mean([_win_rate(x, y) for x, y in zip(xs, ys, strict=True)], axis=0))
    return Estimate(value, float(low), float(high), n_runs)


def performance_profile(
    strata: Sequence[ArrayLike],
    thresholds: Array,
    *,
    n_resamples: int = 2_000,
    seed: int = BOOTSTRAP_SEED,
) -> tuple[Array, Array, Array]:
    """Fraction of runs that score above each threshold, with a pointwise 95 % interval.

    Args:
        strata: for each task the scores of its runs.
        thresholds: shape (n_thresholds,).
        n_resamples, seed: as in `estimate`.

    Returns:
        Fraction, low and high, each of shape (n_thresholds,); NaN without runs, and a NaN interval where a
        task with runs has fewer than two.
    """
    runs = _strata(strata)
    nothing = np.full(thresholds.shape, np.nan)
    if not runs:
        return nothing, nothing, nothing
    fraction = (np.concatenate(runs) > thresholds[:, None]).mean(axis=-1)
    if any(task.size < 2 for task in runs):
        return fraction, nothing, nothing
    drawn = np.concatenate(resample(runs, n_resamples, np.random.default_rng(seed)), axis=-1)
    low, high = _interval(np.stack([(drawn > threshold).mean(axis=-1) for threshold in thresholds], axis=-1))
    return fraction, low, high


def _win_rate(x: Array, y: Array) -> Array:
    """Fraction of pairs in which x is larger, ties counting half; shapes (..., n) and (..., m) to (...)."""
    difference = x[..., :, None] - y[..., None, :]
    return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(-2, -1))


def _interval(resampled: Array) -> tuple[Array, Array]:
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(resampled, [tail, 100 - tail], axis=0)
    return low, high


def _strata(strata: Sequence[ArrayLike]) -> list[Array]:
    return [runs for runs in map(_vector, strata) if runs.size]


def _vector(scores: ArrayLike) -> Array:
    runs = np.asarray(scores, dtype=np.float64)
    if runs.ndim != 1 or not np.isfinite(runs).all():
        raise ValueError(f"the scores of a task are a vector of finite numbers, one a run, not {runs!r}")
    return runs
