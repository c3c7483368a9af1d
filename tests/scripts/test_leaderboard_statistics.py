"""Interquartile means, stratified intervals, probability of improvement and profiles against other sources."""

import numpy as np
import pytest
from scipy import stats

from beliefgym.scripts.leaderboard.statistics import (
    estimate,
    interquartile_mean,
    mean,
    median,
    normalised_score,
    performance_profile,
    probability_of_improvement,
)

RNG = np.random.default_rng(3)
TASK_A, TASK_B = RNG.normal(0.4, 0.2, size=7), RNG.normal(0.8, 0.1, size=5)


def test_a_score_is_0_for_the_random_policy_and_1_for_the_expert() -> None:
    assert normalised_score([-1300, -1100], -1200, -140) == 0.0
    assert normalised_score([-140], -1200, -140) == 1.0
    assert normalised_score([-670, -670], -1200, -140) == pytest.approx(0.5)


def test_a_score_needs_returns_and_an_expert_above_random() -> None:
    with pytest.raises(ValueError, match=r"one number an episode, not of shape \(0,\)"):
        normalised_score([], -1, 1)
    with pytest.raises(ValueError, match="expert_score is above random_score, not -1 against 1"):
        normalised_score([0.0], 1, -1)


@pytest.mark.parametrize("n_runs", range(1, 14))
def test_the_iqm_is_the_mean_of_the_sorted_middle(n_runs: int) -> None:
    scores = RNG.normal(size=n_runs)
    cut = n_runs // 4
    assert interquartile_mean(scores) == pytest.approx(np.sort(scores)[cut : n_runs - cut].mean())
    both = interquartile_mean(np.stack([scores, 2 * scores]))
    np.testing.assert_allclose(both, np.array([1, 2]) * interquartile_mean(scores))


def test_one_outlier_does_not_move_the_iqm() -> None:
    scores = np.array([0.1, 0.2, 0.3, 0.4])
    assert interquartile_mean(np.array([0.1, 0.2, 0.3, 1e6])) == interquartile_mean(scores)


@pytest.mark.parametrize("statistic", [interquartile_mean, mean, median])
@pytest.mark.parametrize("strata", [[TASK_A], [TASK_A, TASK_B]], ids=["one task", "two tasks"])
def test_intervals_agree_with_scipys_percentile_bootstrap(statistic, strata: list) -> None:
    ours = estimate(strata, statistic)
    theirs = stats.bootstrap(
        strata,
        lambda *samples, axis: statistic(np.concatenate(samples, axis=-1)),
        vectorized=True,
        n_resamples=10_000,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    assert ours.value == pytest.approx(float(statistic(np.concatenate(strata))))
    # A 2.5 % quantile of 10,000 draws has a standard error of about 3 % of the draws' own standard deviation,
    # which is about a quarter of the interval's width; five such errors of a difference of two.
    tolerance = 5 * np.sqrt(2) * 0.03 * (ours.high - ours.low) / 4
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=tolerance)


def test_resampling_stays_within_tasks() -> None:
    # Runs differ between tasks only: within each there is nothing to vary, so the interval is a point. Drawing
    # from all runs together would give an interval from about 0 to 1.
    result = estimate([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert (result.low, result.value, result.high) == (0.5, 0.5, 0.5)


def test_intervals_are_reproducible_and_come_from_the_seed() -> None:
    assert estimate([TASK_A, TASK_B]) == estimate([TASK_A, TASK_B])
    assert estimate([TASK_A], seed=1).low != estimate([TASK_A], seed=2).low


def test_a_normal_mean_gets_the_textbook_interval() -> None:
    runs = np.random.default_rng(0).normal(size=400)
    result = estimate([runs], mean)
    half = 1.96 * runs.std() / np.sqrt(runs.size)
    # The width is that of 10,000 draws: 3 % of a standard error at each end, as above.
    assert (result.low, result.high) == pytest.approx(
        (runs.mean() - half, runs.mean() + half), abs=0.15 * half / 1.96
    )


def test_one_run_has_no_interval() -> None:
    result = estimate([[0.7]])
    assert (result.value, result.n_runs, result.has_interval) == (0.7, 1, False)
    assert not estimate([TASK_A, [0.7]]).has_interval  # one task with a single run is enough to say nothing


def test_two_runs_span_the_interval() -> None:
    result = estimate([[0.2, 0.6]])
    assert (result.low, result.value, result.high) == pytest.approx((0.2, 0.4, 0.6))


def test_no_run_is_no_number() -> None:
    result = estimate([[], []])
    assert np.isnan(result.value)
    assert (result.n_runs, result.has_interval) == (0, False)
    assert estimate([TASK_A, []]) == estimate([TASK_A])


def test_scores_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="a vector of finite numbers"):
        estimate([[0.1, np.nan]])


def test_probability_of_improvement_is_mann_whitneys_u() -> None:
    ours, theirs = np.array([1.0, 2.0, 2.0, 5.0]), np.array([0.5, 2.0, 3.0])
    expected = stats.mannwhitneyu(ours, theirs).statistic / (ours.size * theirs.size)
    assert probability_of_improvement([ours], [theirs]).value == pytest.approx(expected)
    assert probability_of_improvement([theirs], [ours]).value == pytest.approx(1 - expected)


def test_probability_of_improvement_averages_over_tasks() -> None:
    result = probability_of_improvement([[1.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]])
    assert (result.low, result.value, result.high) == (0.75, 0.75, 0.75)
    assert np.isnan(probability_of_improvement([[1.0], []], [[], [1.0]]).value)
    assert not probability_of_improvement([[1.0]], [[0.0, 0.0]]).has_interval
    with pytest.raises(ValueError, match="same tasks in the same order, not 1 and 2"):
        probability_of_improvement([[1.0]], [[1.0], [2.0]])


def test_clear_improvement_has_a_clear_interval() -> None:
    result = probability_of_improvement([TASK_A], [TASK_A + 0.5 * TASK_A.std()])
    assert result.low < result.value < result.high
    assert result.value < 0.5


def test_a_profile_counts_the_runs_above() -> None:
    share, low, high = performance_profile([[0.1, 0.5], [0.5, 0.9]], np.array([0.0, 0.1, 0.5, 0.7, 0.9]))
    assert share.tolist() == [1.0, 0.75, 0.25, 0.25, 0.0]
    assert (low <= share).all()
    assert (share <= high).all()
    assert high[3] == 0.5  # within the second task at most both of its two runs are above 0.7
    assert np.isnan(performance_profile([[0.1]], np.array([0.0]))[1]).all()
    assert np.isnan(performance_profile([[]], np.array([0.0]))[0]).all()
