"""Philox against its published known answers and a second implementation; streams independent of the batch."""

import numpy as np
import pytest
from scipy import stats

from beliefgym.envs.random_streams import RandomStreams, fill, fresh_seeds, philox_4x32, spread_seeds

# Random123's kat_vectors for philox4x32-10: counter, key, answer
KNOWN = [
    ([0, 0, 0, 0], [0, 0], [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN)
def test_philox_gives_the_published_known_answers(counter, key, answer):
    words = philox_4x32(np.array(counter, dtype=np.uint64), np.array(key, dtype=np.uint64))
    assert words.tolist() == answer


def test_philox_is_elementwise_over_a_batch():
    counters = np.array([known[0] for known in KNOWN], dtype=np.uint64).T
    keys = np.array([known[1] for known in KNOWN], dtype=np.uint64).T
    assert philox_4x32(counters, keys).T.tolist() == [known[2] for known in KNOWN]


def test_a_copy_draws_the_same_numbers_alone_and_at_any_place_of_a_batch():
    batch = RandomStreams([5, 9, 7])
    alone = RandomStreams([7])
    for size in (1, 3, 2, 5):
        assert np.array_equal(batch.uniform(size)[2], alone.uniform(size)[0])
        assert np.array_equal(batch.normal(size)[2], alone.normal(size)[0])


def test_the_compiled_loop_draws_the_same_numbers_to_the_last_bit():
    compiled = pytest.importorskip(
        "beliefgym.envs.random_streams_numba", reason="numba is not installed"
    ).fill
    rng = np.random.default_rng(0)
    key = rng.integers(0, 2**32, (2, 50), dtype=np.uint64)
    drawn = rng.integers(0, 2**40, 50, dtype=np.uint64)
    rows = np.array([3, 49, 7])
    ours, theirs = np.empty((3, 6)), np.empty((3, 6))
    fill(key, drawn, np.uint64(9), rows, ours)
    compiled(key, drawn, np.uint64(9), rows, theirs)
    assert np.array_equal(ours, theirs)


def test_masked_copies_do_not_advance():
    batch = RandomStreams([1, 2])
    batch.uniform(3, np.array([True, False]))
    assert np.array_equal(batch.uniform(2)[1], RandomStreams([2]).uniform(2)[0])


def test_reseeding_starts_only_the_named_streams_anew():
    batch = RandomStreams([1, 2])
    first = batch.uniform(2)
    batch.reseed([None, 2])
    second = batch.uniform(2)
    assert np.array_equal(second[1], first[1])
    assert not np.array_equal(second[0], first[0])


def test_large_seeds_and_stream_numbers_make_different_streams():
    drawn = [
        RandomStreams([seed], stream).uniform(1)[0, 0] for seed in (3, 3 + 2**32, 2**63) for stream in (0, 1)
    ]
    assert len(set(drawn)) == len(drawn)


@pytest.mark.parametrize(("draw", "distribution"), [("uniform", "uniform"), ("normal", "norm")])
def test_the_numbers_have_their_distribution(draw, distribution):
    across = getattr(RandomStreams(range(20_000)), draw)(3)  # consecutive seeds must not be correlated
    along = getattr(RandomStreams([4]), draw)(60_000)
    for numbers in (across.ravel(), along.ravel()):
        # a fixed sample: the test is deterministic; 1e-3 is the level at which it would be suspicious
        assert stats.kstest(numbers, distribution).pvalue > 1e-3
    correlation = np.corrcoef(np.concatenate([across[:-1], across[1:]], axis=1).T)
    assert np.abs(correlation - np.eye(6)).max() < 4 / np.sqrt(len(across))  # four standard errors


def test_seeds_are_spread_over_the_copies():
    assert spread_seeds(4, 3) == [4, 5, 6]
    assert spread_seeds(None, 2) == [None, None]
    assert spread_seeds([7, None], 2) == [7, None]
    assert len(set(fresh_seeds(3).tolist())) == 3
    with pytest.raises(ValueError, match="expected one seed for each of 3 copies, got 2"):
        spread_seeds([1, 2], 3)
    with pytest.raises(ValueError, match="at least 0, got -1"):
        spread_seeds([-1], 1)
