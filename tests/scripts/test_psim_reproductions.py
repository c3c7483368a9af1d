"""The reproductions of predictive state filters on small settings: data, folds, tuning, what is written and said."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from beliefgym.learning import (
    PSIM,
    AutoregressiveFilter,
    GRUFilter,
    LinearGaussianSystem,
    Sequences,
)
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.scripts.cli import main
from beliefgym.scripts.reproductions import (
    psim_amount,
    psim_data,
    psim_methods,
    psim_recorded,
    psim_synthetic,
)

TURN = 0.95 * np.array([[0.8, 0.6], [-0.6, 0.8]])


def reproduce(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(["reproduce", *arguments])
    return ended.value.code


def record_of(folder, name):
    return json.loads((folder / "reproduction" / f"{name}.json").read_text())


def results_of(folder, name):
    files = sorted((folder / "reproduction" / "cells" / name).glob("*.json"))
    return {file.stem: json.loads(file.read_text())["result"] for file in files}


def turning(n, n_steps, rng):
    """A noisy turn of which one component is seen."""
    system = LinearGaussianSystem(TURN, np.array([[1.0, 0.0]]), 0.1 * np.eye(2), 0.2 * np.eye(1))
    return system.sample(n, n_steps, rng)


def small_parts(name, fold, paths):
    rng = np.random.default_rng([fold, len(name)])
    return turning(30, 30, rng), turning(10, 30, rng), turning(12, 30, rng)


@pytest.fixture
def small(monkeypatch):
    """Grids, networks and epochs of seconds."""
    settings = {
        "ALPHAS": (1e-6, 1e-4, 1e-2, 1.0),
        "BANDWIDTHS": (1.0,),
        "RIDGES": [{"alpha": 1e-6}, {"alpha": 1e-2}],
        "WAVES": 12,
        "SCREENED_WAVES": 6,
        "WAVES_B": 4,
        "SCREENING": 1,
        "N_ITERATIONS": 2,
        "HORIZON": 3,
        "RANKS": (2, 3),
        "STATES": (2,),
        "EM_ITERATIONS": 3,
        "FINE_EPOCHS": 1,
        "RANDOM_OF": {"Flag Video": (2, 2, (1e-2, 3e-2))},
        "SIZES": (4,),
    }
    for name, value in settings.items():
        monkeypatch.setattr(psim_methods, name, value)
    monkeypatch.setattr(
        psim_methods,
        "recurrent_group",
        lambda recording, parts, seed: iter(
            [
                (
                    name,
                    psim_methods.tuned(
                        lambda: GRUFilter(hidden_size=4, n_epochs=2, random_state=seed), [{}], *parts
                    ),
                )
                for name in ("GRU", "LSTM")
            ]
        ),
    )
    monkeypatch.setitem(psim_methods.GROUPS, "recurrent", psim_methods.recurrent_group)


def test_the_setting_with_the_lowest_validation_error_is_taken():
    rng = np.random.default_rng(0)
    train, validation = turning(5, 20, rng), turning(40, 20, rng)
    settings = [{"alpha": alpha} for alpha in (1e-8, 1e-3, 1e-1, 1e3)]

    def make(alpha):
        return AutoregressiveFilter(Ridge(alpha=alpha), n_past=8)

    best = psim_methods.tuned(make, settings, train, validation)
    errors = [make(**setting).fit(train).errors(validation).mean for setting in settings]
    assert best.setting == settings[int(np.argmin(errors))]
    assert best.setting not in (
        settings[0],
        settings[-1],
    )  # five trajectories and eight lags: neither extreme
    assert best.validation == pytest.approx(min(errors), rel=1e-12)
    assert best.filter.errors(validation).mean == best.validation
    assert 0 < best.seconds < best.seconds_tuning


def test_groups_are_held_out_whole_and_every_row_is_tested_once():
    groups = np.random.default_rng(0).integers(0, 14, 60)
    seen = []
    for fold in range(psim_data.N_FOLDS):
        train, validation, test = psim_data.split(60, fold, groups)
        assert sorted(np.concatenate([train, validation, test])) == list(range(60))
        for part, other in ((train, validation), (train, test), (validation, test)):
            assert not set(groups[part]) & set(groups[other])
        seen += list(test)
    assert sorted(seen) == list(range(60))


def test_five_groups_make_ten_different_folds():
    groups = np.repeat(np.arange(5), 4)
    pairs = set()
    for fold in range(psim_data.N_FOLDS):
        train, validation, test = psim_data.split(20, fold, groups)
        (tested,), (validated,) = set(groups[test]), set(groups[validation])
        assert tested != validated
        assert set(groups[train]) == set(range(5)) - {tested, validated}
        pairs.add((int(tested), int(validated)))
    assert len(pairs) == 10
    assert all(sum(tested == group for tested, _ in pairs) == 2 for group in range(5))


def test_families_are_chains_of_near_trajectories():
    rng = np.random.default_rng(0)
    level = np.array([[-3.0, 40.0], [3.0, 80.0]]).repeat(4, axis=0)[:, None]
    near = level + 0.1 * rng.normal(
        size=(8, 50, 2)
    )  # in standard deviations 8 apart, and 0.02 from each other
    assert list(psim_data.families(near)) == [0] * 4 + [1] * 4
    between = np.linspace(-3.0, 3.0, 6)[:, None, None] * np.ones((6, 50, 2))
    assert list(psim_data.families(between)) == [0] * 6  # neighbours make a chain


def test_a_pendulum_without_noise_stays_on_its_circle():
    seen = psim_data.noisy_pendulum(6, 40, 0.0, np.random.default_rng(0)).observations
    assert_allclose(np.linalg.norm(seen, axis=2), 1.0, rtol=1e-12)
    assert (np.abs(np.diff(seen, axis=1)).max(axis=(1, 2)) > 0.01).all()


def test_poses_are_those_of_the_training_part(monkeypatch):
    """Directions and mean are fitted to it alone, and the place on the floor does not matter."""
    rng = np.random.default_rng(0)
    joints = ["root", "head", "lfoot", "rfoot", "lfingers", "rthumb"]
    monkeypatch.setattr(psim_data, "N_BODY", 3)
    positions = rng.normal(size=(20, 6, 18))
    subjects = np.repeat(np.arange(10), 2).astype(str)
    train, validation, test = psim_data._poses(positions, joints, subjects, 0)
    indices = psim_data.split(20, 0, subjects)[0]
    others = np.setdiff1d(np.arange(20), indices)
    changed = positions.copy()
    changed[others] *= 5.0  # the other parts are not looked at
    changed[:, :, 12:] += rng.normal(size=(20, 6, 6))  # nor fingers and thumbs
    moved = changed.reshape(20, 6, 6, 3) + np.array([1.0, 0.0, -2.0])  # nor where on the floor
    again = psim_data._poses(moved.reshape(20, 6, 18), joints, subjects, 0)[0]
    assert_allclose(np.abs(again.observations), np.abs(train.observations), atol=1e-9)  # but for signs
    flat = train.observations.reshape(-1, 3)
    assert_allclose(flat.mean(axis=0), 0.0, atol=1e-9)
    covariance = np.cov(flat.T)
    assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-8 * covariance.max())
    assert len(validation) + len(test) == len(others)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_synthetic_systems_are_two_observable_and_remember(seed):
    system = psim_synthetic.system(seed)
    A, C = system.transition_matrix, system.observation_matrix
    assert np.linalg.matrix_rank(np.vstack([C, C @ A])) == 4
    assert_allclose(sorted(np.abs(np.linalg.eigvals(A))), [0.9, 0.9, 0.98, 0.98], rtol=1e-9)
    closed = np.abs(np.linalg.eigvals(A - system.stationary_gain().gain @ C)).max()
    assert 0.8 < closed < 0.92
    assert not np.allclose(A, psim_synthetic.system(seed + 1).transition_matrix)


def test_synthetic_ratios_are_written_and_judged(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(psim_synthetic, "N_TRAJECTORIES", (10, 100, 1000))
    monkeypatch.setattr(
        psim_synthetic, "COLUMNS", ("what", "N = 10", "N = 100", "N = 1000", "target", "meets")
    )
    monkeypatch.setattr(psim_synthetic, "METHODS", psim_synthetic.METHODS[:4])
    monkeypatch.setattr(psim_synthetic, "ALPHAS", (1e-8, 1e-2))
    monkeypatch.setattr(psim_synthetic, "N_STEPS", 12)
    monkeypatch.setattr(psim_synthetic, "N_TEST", 300)
    assert reproduce("psim-synthetic", "--seeds", "2", "--results", str(tmp_path)) == 0
    record = record_of(tmp_path, "psim-synthetic")
    cells = results_of(tmp_path, "psim-synthetic")
    assert set(cells) == {f"{start}-{seed}" for start in ("mean", "stationary") for seed in (0, 1)}
    row = record["rows"][0]
    ratios = [
        cells[f"mean-{s}"]["errors"][psim_synthetic.DAGGER][-1] / cells[f"mean-{s}"]["kalman"] for s in (0, 1)
    ]
    assert row["ratio at 1000"]["value"] == pytest.approx(np.mean(ratios))
    assert row["meets"] == (np.mean(ratios) <= 1.02)
    # where trajectories start at its mean, nothing beats the Kalman filter by more than chance
    assert (
        min(
            min(cells[f"mean-{s}"]["errors"][m]) / cells[f"mean-{s}"]["kalman"]
            for s in (0, 1)
            for m in psim_synthetic.METHODS
        )
        > 0.999
    )
    assert (tmp_path / "reproduction" / "psim-synthetic.png").stat().st_size > 10_000


def test_recorded_tables_are_means_and_paired_ratios_over_folds(tmp_path, monkeypatch, small, capsys):
    monkeypatch.setattr(psim_recorded, "N_FOLDS", 3)
    monkeypatch.setattr(psim_recorded, "parts", small_parts)
    monkeypatch.setattr(psim_recorded, "flag_video", lambda request: tmp_path / "none")
    assert reproduce("psim-recorded", "--results", str(tmp_path)) == 0  # the flag alone needs no recordings
    record = record_of(tmp_path, "psim-recorded")
    found = {}
    for one in results_of(tmp_path, "psim-recorded").values():
        for method, result in one["methods"].items():
            found.setdefault(method, []).append(result["test"])
    assert set(found) >= set(psim_recorded.ORDER)
    rows = {row["what"]: row for row in record["rows"]}
    title = "flag video (simulated)"
    for method in psim_recorded.ORDER:
        assert rows[f"{title}: {method}"]["values"]["error"]["value"] == pytest.approx(np.mean(found[method]))
    ratio = np.exp(np.mean(np.log(np.divide(found["PSIM-Linear_d"], found["N4SID"]))))
    row = rows[f"{title}: PSIM-Linear_d over N4SID"]
    assert row["values"]["ratio"]["value"] == pytest.approx(ratio)
    assert row["meets"] == (ratio <= 1)
    assert rows[f"{title}: AR-5"]["thesis"] == ""
    assert rows[f"{title}: N4SID"]["thesis"] == "3380"
    assert "left out: assembly, arm, mocap, pumpjack, fire" in " ".join(record["notes"])
    for file in record["figures"]:
        assert (tmp_path / "reproduction" / file).stat().st_size > 10_000


def test_a_result_holds_what_the_tables_need(small):
    recording = psim_data.RECORDINGS["flag"]
    train, validation, test = small_parts("flag", 0, {})
    found = psim_methods.results("linear", recording, train, validation, test, 0)
    one = found["methods"]["PSIM-Linear_d, phi_2"]
    assert one["test"] == pytest.approx(np.mean(one["by_episode"]))
    assert one["test"] == pytest.approx(one["by_look_ahead"][0])
    assert len(one["by_look_ahead"]) == 3
    assert one["calibration"]["coverage"] == sorted(one["calibration"]["coverage"])
    difference = np.diff(test.observations, axis=1)
    assert found["last_value"] == pytest.approx(np.square(difference).sum(axis=2).mean())
    again = PSIM(
        Ridge(**one["setting"]), n_future=3, features="second", standardise="together", n_iterations=2
    )
    assert again.fit(train, validation).errors(test).mean == pytest.approx(one["test"])


def test_the_amount_of_data_is_that_of_the_training_part(tmp_path, monkeypatch, small, capsys):
    monkeypatch.setattr(psim_amount, "SIZES", {"pendulum": (10, 20)})
    monkeypatch.setattr(psim_amount, "N_TEST", 30)
    monkeypatch.setattr(psim_amount, "PENDULUM_STEPS", 20)
    assert reproduce("psim-amount", "--seeds", "2", "--results", str(tmp_path)) == 0
    cells = results_of(tmp_path, "psim-amount")
    assert {name: one["n_train"] for name, one in cells.items()} == {
        "pendulum-10-0": 200,
        "pendulum-10-1": 200,
        "pendulum-20-0": 400,
        "pendulum-20-1": 400,
    }
    rows = {row["what"]: row for row in record_of(tmp_path, "psim-amount")["rows"]}
    row = rows["noisy pendulum (simulated), 20 trajectories: PSIM-RFF_d"]
    errors = [cells[f"pendulum-20-{s}"]["methods"] for s in (0, 1)]
    assert row["values"]["error"]["value"] == pytest.approx(
        np.mean([one["PSIM-RFF_d"]["test"] for one in errors])
    )
    ratio = np.exp(np.mean([np.log(one["PSIM-RFF_d"]["test"] / one["GRU"]["test"]) for one in errors]))
    assert float(row["over GRU"].split()[0]) == pytest.approx(ratio, abs=0.006)


def test_the_same_fold_gives_nested_training_sets(monkeypatch):
    """What is learned from twenty trajectories includes the ten."""
    everything = Sequences.from_observations(np.arange(40.0)[:, None, None] * np.ones((40, 5, 1)))
    monkeypatch.setattr(psim_amount, "parts", lambda *_: (everything, everything, everything))
    few, many, every = (
        psim_amount._parts({"data": "assembly", "fold": 1, "n": n}, {})[0].observations[:, 0, 0]
        for n in (10, 20, 0)
    )
    assert (len(few), len(many), len(every)) == (10, 20, 40)
    assert set(few) <= set(many)


def test_settings_that_give_no_filter_are_left_out():
    rng = np.random.default_rng(0)
    train, validation = turning(5, 20, rng), turning(5, 20, rng)
    best = psim_methods.tuned(
        lambda k: AutoregressiveFilter(n_past=k, pad_start=False), [{"k": 100}, {"k": 3}], train, validation
    )
    assert best.setting == {"k": 3}
    with pytest.raises(ValueError, match="none of"):
        psim_methods.tuned(
            lambda k: AutoregressiveFilter(n_past=k, pad_start=False), [{"k": 100}], train, validation
        )
