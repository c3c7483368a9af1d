"""The reproductions of hint filters on small settings: data, tuning, rows, figures, what is written and said."""

import json
from pathlib import Path

import numpy as np
import pytest

from beliefgym.learning import KalmanHints, Ridge
from beliefgym.scripts.cli import main
from beliefgym.scripts.reproductions import hints_data, hints_methods, hints_physics, hints_tables

RECORDINGS = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture
def small(monkeypatch):
    """Data, grids and networks of seconds, and two folds."""
    for module, settings in {
        hints_data: {
            "N_PENDULUMS": 20,
            "N_MANY": 20,
            "PENDULUM_STEPS": 29,
            "N_FLIGHTS": 12,
            "FLIGHT_STEPS": 30,
            "N_LIFTS": 10,
        },
        hints_methods: {
            "GRIDS": dict.fromkeys(hints_data.TASKS, hints_methods.Grid((1e-6, 1e-2), (1.0, 2.0), (1e-4,))),
            "WAVES": 12,
            "SCREENED_WAVES": 6,
            "SCREENING": 1,
            "N_ITERATIONS": 2,
            "RATES": (1e-2,),
            "N_EPOCHS": 2,
            "N_FINAL": 1,
            "PREIMAGE_WAVES": 10,
            "FOREST": {"n_estimators": 2, "max_depth": 3},
        },
        hints_physics: {"N_PARTICLES": 200, "ROUGHENINGS": ({"roughening": 0.01},)},
        hints_tables: {
            "N_FOLDS": 2,
            "TABLES": {
                "hints-pendulum": ("pendulum-full", "pendulum-partial"),
                "hints-attitude": ("quadrotor", "imu"),
            },
        },
    }.items():
        for name, value in settings.items():
            monkeypatch.setattr(module, name, value)
    hints_data._whole.cache_clear()
    yield
    hints_data._whole.cache_clear()


def reproduce(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(["reproduce", *arguments])
    return ended.value.code


def test_the_pendulum_is_the_systems_own_and_its_x_position_is_what_is_seen():
    swings = hints_data.swinging(hints_data.Noise((0.0, 0.0), 0.0), 7, np.random.default_rng(0))
    angle, speed = swings.states[:, :, 0], swings.states[:, :, 1]
    np.testing.assert_allclose(swings.observations[:, :, 0], np.sin(angle), atol=1e-15)
    energy = 0.5 * speed**2 + 9.81 * np.cos(angle)  # of a unit mass on a unit rod, the angle from upright
    assert np.ptp(energy, axis=1).max() < 2e-3 * 9.81  # kept, to the integrator's error over 99 steps
    noisy = hints_data.swinging(hints_data.NOISY, 200, np.random.default_rng(0))
    residual = noisy.observations[:, :, 0] - np.sin(noisy.states[:, :, 0])
    assert residual.std() == pytest.approx(0.1, rel=0.02)  # of 20,000 numbers: 0.5 %


@pytest.mark.parametrize("name", ["pendulum-full", "pendulum-partial", "quadrotor", "lift"])
def test_folds_hold_out_whole_trajectories_and_test_each_once(small, name):
    tested = []
    for fold in range(10):
        train, validation, test = hints_data.parts(name, fold, None)
        first = [part.observations[:, 0].tobytes() for part in (train, validation, test) for part in part]
        assert len(set(first)) == len(first)
        tested += [one.observations.tobytes() for one in test]
    assert len(tested) == len(set(tested)) == len(first)


def test_hints_are_in_the_units_of_the_tables(small):
    lift = hints_data.parts("lift", 0, None)[0]
    assert lift.hint_names == ("mass",)
    assert (np.ptp(lift.hints, axis=1) == 0).all()
    assert 45 <= lift.hints.min() < lift.hints.max() <= 355  # grams
    assert lift.n_steps == 80  # every second one of 160
    partial, full = (hints_data.parts(f"pendulum-{which}", 0, None)[0] for which in ("partial", "full"))
    np.testing.assert_array_equal(partial.hints[:, :, 0], full.hints[:, :, 0])


recorded = pytest.mark.skipif(
    not (RECORDINGS / hints_data.FILES["imu"]).exists(),
    reason="the recordings (../shared/data) are not there; they are not ours to ship",
)


@recorded
@pytest.mark.parametrize(("name", "n"), [("imu", 45), ("payload", 475)])
def test_recordings_and_objects_are_held_out_whole(name, n):
    hints_data._whole.cache_clear()
    whole, group = hints_data._whole(name, RECORDINGS)
    of = {row.tobytes(): label for row, label in zip(whole.observations, group, strict=True)}
    assert len(of) == n  # no two alike
    tested = []
    for fold in range(10):
        parts = hints_data.parts(name, fold, RECORDINGS)
        assert sum(map(len, parts)) == n
        train, validation, test = ({of[row.tobytes()] for row in part.observations} for part in parts)
        assert not train & test
        assert not train & validation
        assert not validation & test
        tested += [of[row.tobytes()] for row in parts[2].observations]
    assert sorted(tested) == sorted(group)  # each trajectory once
    hints_data._whole.cache_clear()


@recorded
def test_the_hint_of_the_recorded_unit_is_the_upward_direction():
    whole, _ = hints_data._whole("imu", RECORDINGS)
    np.testing.assert_allclose(np.linalg.norm(whole.hints, axis=2), 1.0, atol=1e-5)  # float32 rotations
    size = np.linalg.norm(whole.observations[:, :, :3], axis=2)
    measured = whole.observations[:, :, :3] / size[:, :, None]
    still = np.abs(size - 9.81) < 0.3
    assert (measured * whole.hints).sum(axis=2)[still].mean() > 0.98  # at rest the accelerometer reads it
    hints_data._whole.cache_clear()


def test_the_setting_with_the_lowest_validation_error_is_taken(small):
    parts = hints_data.parts("pendulum-full", 0, None)
    found = hints_methods.results("ar", "pendulum-full", parts, 0)["AR (k_p = 5)"]
    settings = hints_methods._settings("pendulum-full")
    assert found["setting"] in settings
    assert len(found["by_episode"]) == len(parts[2])
    assert found["test"] == pytest.approx(np.mean(found["by_episode"]))
    np.testing.assert_allclose(
        np.divide(found["by_time"], found["n_by_time"]).mean(), found["test"], rtol=1e-4
    )
    linear = KalmanHints().fit(*parts[:2]).hint_errors(parts[2]).mean
    assert hints_methods.results("kalman", "pendulum-full", parts, 0)["Linear KF"]["test"] == linear


def test_a_ridge_on_the_whole_trajectory_is_one():
    rng = np.random.default_rng(0)
    from beliefgym.learning import Sequences

    def part(n):
        x = rng.standard_normal((n, 4, 2))
        mass = (x * np.arange(8).reshape(4, 2)).sum(axis=(1, 2))
        return Sequences.from_observations(x, hints=np.repeat(mass[:, None, None], 4, axis=1))

    parts = part(50), part(10), part(10)
    found = hints_methods._whole_trajectory(parts)
    assert found["setting"] == {"alpha": 1e-4}  # no noise: the smallest
    model = Ridge(alpha=1e-4).fit(parts[0].observations.reshape(50, 8), parts[0].hints[:, -1])
    by_hand = np.abs(model.predict(parts[2].observations.reshape(10, 8)) - parts[2].hints[:, -1]).mean()
    assert found["test"] == pytest.approx(
        by_hand, rel=0.05, abs=0.01
    )  # there standardised before the penalty


def test_a_well_started_filter_begins_near_the_truth(small):
    parts = hints_data.parts("pendulum-full", 0, None)
    found = dict(hints_physics.physics("pendulum-full", parts, 0))
    assert set(found) == {"Physics UKF", "Physics UKF, started well", "EKF", "particle filter"}
    near = found["Physics UKF, started well"]["filter"].hint_errors(parts[2])
    assert near.norm[:, 0].mean() < 0.2  # starts are 0.1 rad and rad/s off, in each of two components
    assert found["Physics UKF"]["setting"] in hints_physics.SPREADS


def test_a_table_is_written_resumed_and_says_what_is_missing(small, tmp_path, capsys):
    assert reproduce("hints-pendulum", "--results", str(tmp_path)) == 0
    record = json.loads((tmp_path / "reproduction" / "hints-pendulum.json").read_text())
    what = [row["what"] for row in record["rows"]]
    assert not [note for note in record["notes"] if note.startswith("Failed")]
    for method in ("Physics UKF", "AR (k_p = 5)", "Linear KF", "GRU", "IMF", "PSIM+Hints (k_f = 20)"):
        assert f"pendulum, full state: {method}" in what
    assert "pendulum, angle alone: Physics UKF" not in what
    row = record["rows"][what.index("pendulum, angle alone: PSIM+Hints (k_f = 20) over IMF")]
    assert row["meets"] == (row["values"]["ratio"]["value"] <= 1.0)
    assert (tmp_path / "reproduction" / "hints-pendulum-over-time.png").stat().st_size > 10_000
    capsys.readouterr()
    assert reproduce("hints-pendulum", "--results", str(tmp_path)) == 0  # cells are there: nothing runs
    assert "(1 of" not in capsys.readouterr().out
    assert (
        json.loads((tmp_path / "reproduction" / "hints-pendulum.json").read_text())["rows"] == record["rows"]
    )


def test_without_recordings_the_simulated_tasks_are_left(small, monkeypatch, tmp_path):
    monkeypatch.setattr(hints_methods, "groups", lambda name: ("kalman", "ar", "physics"))
    assert reproduce("hints-attitude", "--results", str(tmp_path)) == 0
    record = json.loads((tmp_path / "reproduction" / "hints-attitude.json").read_text())
    assert any("left out: imu (`--data`" in note for note in record["notes"])
    assert all(row["what"].startswith("quadrotor attitude, simulated") for row in record["rows"])
    assert any("complementary filter, typical gains" in row["what"] for row in record["rows"])
