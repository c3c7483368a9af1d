"""From a messy table to a forecast: every fault is told, nothing stops what can be learned."""

import warnings

import numpy as np

from beliefgym.learning import DataAsDemonstrator, Ridge, from_csv


def messy(path):
    """Twelve damped oscillations; a gap in time, an empty and an infinite cell, a constant column, a one-row trial."""
    step = np.array([[0.95, -0.3], [0.3, 0.95]]) * 0.98
    rows = ["trial,t,x,y,battery"]
    for trial in range(12):
        state = np.random.default_rng(trial).normal(size=2)
        for k in range(40):
            t = 0.1 * k + (1.0 if trial == 2 and k >= 20 else 0.0)
            x = "" if (trial, k) == (3, 10) else "inf" if (trial, k) == (4, 30) else f"{state[0]:.12f}"
            rows.append(f"{trial},{t:.6f},{x},{state[1]:.12f},12.5")
            state = step @ state
    rows.append("12,0.0,0.1,0.1,12.5")
    path.write_text("\n".join(rows) + "\n")


def test_a_messy_recording_becomes_a_model(tmp_path):
    messy(tmp_path / "run.csv")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        runs = from_csv(tmp_path / "run.csv", observations=["x", "y", "battery"], episode="trial", time="t")
        train, validation, test = runs.split((0.6, 0.2, 0.2), seed=0)
        model = DataAsDemonstrator(Ridge(alpha=0.0), n_iterations=2).fit(train, validation)
    said = " | ".join(str(warning.message) for warning in told)
    assert "1 of 464 steps in time are gaps" in said
    assert "line 101, from 1.9 to 3 (line 102)" in said  # trial 2 begins in line 82
    assert "2 missing numbers in 2 of 481 rows" in said
    assert "line 132, column 'x'" in said  # trial 3, row 10
    assert "constant columns, which carry no information to a model: battery" in said
    assert "dropped 1 of 16 episodes, shorter than min_steps=1 steps: '12' lines 482 to 482" in said
    assert "observations ['battery'] do not vary in the training data" in said
    assert runs.n_episodes == 15  # three trials in two pieces each, the one-row trial dropped
    # exact up to the twelve digits of the file, however the pieces were cut
    assert model.errors(test).mean < 1e-8
    forecast = model.rollout(test.observations[0, 0], 100)
    np.testing.assert_allclose(forecast[:, 2], 12.5)
