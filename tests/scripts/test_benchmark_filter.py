"""The benchmark of filters times what it says it times."""

import numpy as np
import pytest

from beliefgym.learning import GRUFilter, KalmanFilter
from beliefgym.scripts.benchmarks import filter as benchmark


@pytest.fixture
def small(monkeypatch):
    for name, value in {
        "N_TRAJECTORIES": 12,
        "N_STEPS": 20,
        "SIZES": (4, 6),
        "REPEATS": 1,
        "WAVES": 10,
    }.items():
        monkeypatch.setattr(benchmark, name, value)


def test_the_time_to_an_error_ends_with_the_epoch_that_reaches_it():
    history = {
        "validation_error": np.array([np.nan, 5.0, 3.0, 4.0, 1.0]),
        "seconds": np.array([0.5, 1, 1, 1, 1]),
    }
    assert benchmark._time_to(3.0, history) == (True, 2.5)
    assert benchmark._time_to(1.0, history) == (True, 4.5)
    assert benchmark._time_to(0.5, history) == (False, 4.5)


def test_the_floors_are_what_no_filter_goes_below(small):
    """The Kalman filter's own error, in units that the other filters are judged in; the noise of a pendulum."""
    train, validation, floor = benchmark.linear()
    scale = train.observations.reshape(-1, 5).std(axis=0)
    assert (len(train), train.n_steps, train.n_obs) == (12, 20, 5)
    known = KalmanFilter(n_states=10, method="em", n_iterations=5, random_state=0).fit(train)
    predicted = known.predict_observation(known.beliefs(validation)[:, 1:-1].reshape(-1, known.belief_size))
    error = predicted.reshape(validation.observations[:, 1:].shape) - validation.observations[:, 1:]
    assert np.square(error / scale).sum(axis=2).mean() > floor > 0
    swung, _, noise = benchmark.pendulum()
    assert noise == pytest.approx((0.01 / swung.observations.reshape(-1, 2).var(axis=0)).sum())


def test_training_rows_compare_at_the_same_error(small, monkeypatch):
    monkeypatch.setattr(
        benchmark,
        "_network",
        lambda size, train, validation: dict(
            GRUFilter(hidden_size=size, n_epochs=3, patience=None, random_state=0)
            .fit(train, validation)
            .history_
        ),
    )
    limits: dict = {}
    rows = benchmark._training("a system", *benchmark.linear(), limits)
    assert [row["target"] for row in rows] == [20.0, None]
    for row, kind in zip(rows, ("PSIM-Linear_d", "PSIM-RFF_d"), strict=True):
        errors, seconds = limits[f"errors, a system, {kind}"], limits[f"seconds, a system, {kind}"]
        assert ("does not get there" in row["rival_name"]) == (errors["best GRU"] > errors[kind])
        assert row["ratio"] == pytest.approx(seconds["GRU"] / seconds[kind], rel=1e-6)


def test_an_updates_flops_are_those_of_its_products(small):
    limits: dict = {}
    rows = benchmark._updates(8, limits)
    inputs, size = 6 * 13, 5 * 13
    assert limits["update of 8, PSIM-Linear_d"]["FLOPs"] == 2 * 8 * inputs * size
    features = inputs + 2 * 10  # the inputs themselves, cosines and sines
    assert limits["update of 8, PSIM-RFF_d"]["FLOPs"] == 2 * 8 * (features * size + inputs * 10)
    assert len(rows) == 3
    assert all(row["ratio"] > 0 for row in rows)
