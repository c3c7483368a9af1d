"""Splits of episodes into parts and folds, as arrays of episode indices.

Whole episodes only: neighbouring steps of one episode are nearly the same data, so a split inside an episode
would test on what was trained on. Inside a part the episodes keep their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SUM_TOLERANCE = 1e-9  # fractions such as 0.7 + 0.2 + 0.1 miss 1 by rounding only


def split_indices(
    n_episodes: int, sizes: Sequence[float], seed: int | np.random.Generator
) -> list[NDArray[np.int64]]:
    """Random disjoint parts that together hold every episode.

    Args:
        n_episodes: number of episodes.
        sizes: all whole numbers (ints): episodes in each part; otherwise the fraction in each part.
        seed: seed or generator of the shuffle.

    Returns:
        One sorted index array for each part.

    Raises:
        ValueError: sizes that are negative or do not sum to the whole, or too few episodes for a fraction.
    """
    sizes = list(sizes)
    if not sizes or any(isinstance(size, bool) or not size >= 0 for size in sizes):
        raise ValueError(f"sizes: expected at least one number of at least 0, got {sizes}")
    if all(isinstance(size, int | np.integer) for size in sizes):
        counts = np.array(sizes, dtype=np.int64)
        if counts.sum() != n_episodes:
            raise ValueError(
                f"sizes: expected counts that sum to the {n_episodes} episodes, got {sizes} (sum "
                f"{counts.sum()}); add a part for the rest, or pass fractions"
            )
    else:
        counts = _counts_of_fractions(n_episodes, np.array(sizes, dtype=np.float64))
    order = np.random.default_rng(seed).permutation(n_episodes)
    return [np.sort(part) for part in np.split(order, np.cumsum(counts)[:-1])]


def fold_indices(
    n_episodes: int, n_folds: int, seed: int | np.random.Generator, groups: ArrayLike | None
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Cross-validation folds: every episode is in exactly one test part.

    Episodes of one group always go together; groups are dealt, largest first, to the fold with the fewest
    episodes so far.

    Args:
        n_episodes: number of episodes.
        n_folds: number of folds, at least 2.
        seed: seed or generator of the shuffle.
        groups: (n_episodes,) a label for each episode (subject, recording); None makes each episode its own.

    Returns:
        An iterator over n_folds pairs of sorted index arrays (train, test).

    Raises:
        ValueError: n_folds below 2, groups of another shape, or fewer groups than folds.
    """
    if isinstance(n_folds, bool) or not isinstance(n_folds, int | np.integer) or n_folds < 2:
        raise ValueError(f"expected n_folds to be a whole number of at least 2, got {n_folds!r}")
    labels = np.arange(n_episodes) if groups is None else np.asarray(groups)
    if labels.shape != (n_episodes,):
        raise ValueError(
            f"groups: expected shape ({n_episodes},), a label for each episode, got {labels.shape}"
        )
    group_of = np.unique(labels, return_inverse=True)[1].reshape(-1)
    group_sizes = np.bincount(group_of)
    if len(group_sizes) < n_folds:
        what = "episodes" if groups is None else "groups"
        raise ValueError(f"expected at least {n_folds} {what} for {n_folds} folds, got {len(group_sizes)}")
    shuffled = np.random.default_rng(seed).permutation(len(group_sizes))
    largest_first = shuffled[np.argsort(-group_sizes[shuffled], kind="stable")]
    fold_of_group = np.zeros(len(group_sizes), dtype=np.int64)
    fold_sizes = np.zeros(n_folds, dtype=np.int64)
    for group in largest_first:
        fold = int(np.argmin(fold_sizes))
        fold_of_group[group] = fold
        fold_sizes[fold] += group_sizes[group]
    fold_of = fold_of_group[group_of]
    return ((np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)) for fold in range(n_folds))


def _counts_of_fractions(n_episodes: int, fractions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Whole numbers nearest to the fractions that sum to n_episodes (largest remainders are rounded up)."""
    if abs(fractions.sum() - 1.0) > _SUM_TOLERANCE:
        raise ValueError(
            f"sizes: expected fractions that sum to 1, got {fractions.tolist()} (sum {fractions.sum():g}); "
            "counts are passed as ints"
        )
    exact = fractions * n_episodes
    counts = np.floor(exact + _SUM_TOLERANCE).astype(np.int64)
    largest_remainders = np.argsort(counts - exact, kind="stable")[: n_episodes - counts.sum()]
    counts[largest_remainders] += 1
    if ((counts == 0) & (fractions > 0)).any():
        raise ValueError(
            f"expected enough episodes to give each of the fractions {fractions.tolist()} at least one, "
            f"got {n_episodes}; record more, or pass counts"
        )
    return counts
