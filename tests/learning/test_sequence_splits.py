"""Splits and folds: whole episodes, each exactly once, the same for the same seed."""

import numpy as np
import pytest

from beliefgym.learning import Sequences


def numbered(n):
    """n episodes whose single observation is their number."""
    return Sequences.from_observations(np.arange(float(n)).reshape(n, 1, 1))


def numbers(sequences):
    return sequences.observations[:, 0, 0].astype(int).tolist()


@pytest.mark.parametrize(
    ("sizes", "counts"),
    [
        ((0.7, 0.2, 0.1), [7, 2, 1]),
        ((0.5, 0.5), [5, 5]),
        ((0.75, 0.25), [8, 2]),  # 7.5 and 2.5: both remainders equal, the first is rounded up
        ((0.74, 0.26), [7, 3]),  # 7.4 and 2.6: the larger remainder is rounded up
        ((1.0, 0.0), [10, 0]),
        ((6, 4), [6, 4]),
        ((np.int64(3), 7), [3, 7]),
        ((10,), [10]),
    ],
)
def test_split_sizes(sizes, counts):
    parts = numbered(10).split(sizes, seed=3)
    assert [len(part) for part in parts] == counts
    assert sorted(n for part in parts for n in numbers(part)) == list(range(10))
    assert all(numbers(part) == sorted(numbers(part)) for part in parts)


def test_split_is_random_but_reproducible():
    sequences = numbered(50)
    first = [numbers(part) for part in sequences.split((0.5, 0.5), seed=1)]
    assert first == [numbers(part) for part in sequences.split((0.5, 0.5), seed=1)]
    assert first == [numbers(part) for part in sequences.split((0.5, 0.5), np.random.default_rng(1))]
    assert first != [numbers(part) for part in sequences.split((0.5, 0.5), seed=2)]
    assert first[0] != list(range(25))


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        (
            (0.5, 0.4),
            r"sizes: expected fractions that sum to 1, got \[0\.5, 0\.4\] \(sum 0\.9\); counts are passed as ints",
        ),
        ((5, 4), r"sizes: expected counts that sum to the 10 episodes, got \[5, 4\] \(sum 9\)"),
        ((-0.5, 1.5), "sizes: expected at least one number of at least 0"),
        ((float("nan"), 1.0), "sizes: expected at least one number of at least 0"),
        ((), "sizes: expected at least one number"),
        (
            (0.99, 0.01),
            r"expected enough episodes to give each of the fractions \[0\.99, 0\.01\] at least one, got 10",
        ),
    ],
)
def test_bad_splits(sizes, message):
    with pytest.raises(ValueError, match=message):
        numbered(10).split(sizes, seed=0)


def test_folds_test_every_episode_once():
    folds = list(numbered(11).folds(3, seed=0))
    assert sorted(len(test) for _, test in folds) == [3, 4, 4]
    assert sorted(n for _, test in folds for n in numbers(test)) == list(range(11))
    for train, test in folds:
        assert sorted(numbers(train) + numbers(test)) == list(range(11))
    assert numbers(folds[0][1]) != [0, 1, 2, 3]
    again = [numbers(test) for _, test in numbered(11).folds(3, seed=0)]
    assert again == [numbers(test) for _, test in folds]
    assert again != [numbers(test) for _, test in numbered(11).folds(3, seed=1)]


def test_groups_are_held_out_whole_and_balanced():
    groups = np.array(["a"] * 6 + ["b"] * 3 + ["c"] * 3 + ["d"] * 2 + ["e"])
    for train, test in numbered(15).folds(2, seed=5, groups=groups):
        assert not set(groups[numbers(train)]) & set(groups[numbers(test)])
        assert len(train) in (7, 8)  # 15 episodes in two folds, which these groups allow
    tested = [numbers(test) for _, test in numbered(15).folds(5, seed=5, groups=groups)]
    assert sorted(len(t) for t in tested) == [1, 2, 3, 3, 6]


def test_bad_folds_are_told_at_the_call():
    sequences = numbered(4)
    with pytest.raises(ValueError, match="expected n_folds to be a whole number of at least 2, got 1"):
        sequences.folds(1, seed=0)
    with pytest.raises(ValueError, match="expected at least 5 episodes for 5 folds, got 4"):
        sequences.folds(5, seed=0)
    with pytest.raises(ValueError, match="expected at least 3 groups for 3 folds, got 2"):
        sequences.folds(3, seed=0, groups=[0, 0, 1, 1])
    with pytest.raises(
        ValueError, match=r"groups: expected shape \(4,\), a label for each episode, got \(3,\)"
    ):
        sequences.folds(2, seed=0, groups=[0, 1, 2])
