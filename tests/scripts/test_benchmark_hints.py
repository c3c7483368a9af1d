"""The benchmark of hint estimators times single updates of filters that estimate the same thing."""

import time

import numpy as np
import pytest

from beliefgym.scripts.benchmarks import hints as benchmark


@pytest.fixture
def small(monkeypatch):
    for name, value in {"N_TRAJECTORIES": 20, "WAVES": 10, "HIDDEN": 4, "ROUNDS": 5, "TURN": 4}.items():
        monkeypatch.setattr(benchmark, name, value)


def test_single_updates_are_timed_in_turns(small):
    order = []

    def slow(x):
        order.append("slow")
        time.sleep(0.003)

    taken = benchmark.timed({"slow": slow, "quick": lambda x: order.append("quick")}, np.zeros((3, 1)))
    assert {name: len(values) for name, values in taken.items()} == {
        "slow": 20,
        "quick": 20,
    }  # but the first turn
    assert order[:8] == ["slow"] * 4 + ["quick"] * 4
    assert taken["slow"].min() >= 0.003 > np.median(taken["quick"])


def test_a_rate_is_one_over_a_percentile_with_its_range_over_parts():
    seconds = np.repeat([1.0, 2.0, 4.0, 8.0, 10.0], 10)
    rate = benchmark._rate(seconds, 50)
    assert (rate.value, rate.low, rate.high) == (0.25, 0.1, 1.0)


def test_the_contestants_estimate_the_same_pendulum(small):
    stream, contestants, work = benchmark._contestants()
    assert set(contestants) == {*benchmark.OURS, *benchmark.RIVALS}
    assert work["IMF, linear"] == 5 * 4  # (4 moments + 1 observation) times 4
    ours, theirs = [], []
    for x in stream:
        ours.append(contestants["UKF (ours)"](x).mean)
        theirs.append(np.array(contestants["UKF (filterpy)"](x)))
    # from different starts; on a long stream both are at the filter's own error of a few hundredths
    assert np.abs(np.sin(np.array(ours)[50:, 0]) - np.sin(np.array(theirs)[50:, 0])).mean() < 0.05


def test_every_row_compares_medians_or_tails(small):
    told = []
    rows, limits = benchmark.run(told.append)
    assert told == ["fitting", "updates"]
    assert len(rows) == 3 * 4 * 2
    for row in rows:
        assert row["ratio"] == pytest.approx(row["ours"]["value"] / row["rival"]["value"])
        assert row["ours"]["interval"][0] <= row["ours"]["interval"][1]
    assert set(limits["microseconds, IMF, linear"]) == {"median", "99th percentile"}
