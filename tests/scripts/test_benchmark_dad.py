"""The benchmark of Data as Demonstrator compares like with like, and its rows read as they should."""

import numpy as np
import pytest

from beliefgym.scripts.benchmark import markdown
from beliefgym.scripts.benchmarks import dad


@pytest.mark.parametrize("keep_features", [False, True])
def test_both_contestants_fit_the_same_models(monkeypatch, keep_features):
    monkeypatch.setattr(dad, "M", 20)
    monkeypatch.setattr(dad, "N_STEPS", 10)
    sequences = dad.pendulum(0, 50, 10, dad.NOISE)
    ours, seconds = dad.ours(sequences, 4)
    plain, _ = dad.plain(sequences, keep_features, 4)
    assert len(ours) == len(plain) == len(seconds) == 5
    # the same normal equations, summed in another order, through four iterations of feedback
    np.testing.assert_allclose(ours, plain, rtol=1e-8)
    assert abs(ours[4] / ours[0] - 1.0) > 0.01  # and the iterations do change the model


def test_the_flops_are_those_of_the_symmetric_updates(monkeypatch):
    for name, value in {"N_TRAJECTORIES": 2, "N_STEPS": 3, "N_ITERATIONS": 4, "M": 5}.items():
        monkeypatch.setattr(dad, name, value)
    # 6 rows at first, 4 in each of 4 iterations, of 10 features: n m^2
    assert dad.aggregate_flops() == (6 + 16) * 100


def test_a_row_without_a_rival_stands_blank():
    rows = [
        dad._plain("difference", 3e-11, "plain", 1e-6, most=True),
        dad._plain("memory, MiB", 70.0, "plain", None, rival=14_000.0),
    ]
    record = {"command": "c", "machine": "m", "rows": rows, "limits": {"repeats": "1"}}
    page = markdown(record)
    assert "| difference (at most) | 3e-11 | plain |  |  | 1e-06 | yes |" in page
    assert "| memory, MiB | 70 | plain | 14,000 | 0.01 |  |  |" in page
    assert "interleaved" not in page
