"""The Data as Demonstrator reproductions on small settings: what they choose, split, write and say."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from beliefgym.learning import DataAsDemonstrator, RandomFourierRidge, Sequences, VideoTexture
from beliefgym.scripts.cli import main
from beliefgym.scripts.reproductions import dad_data, dad_growth, dad_map, dad_table, dad_video
from beliefgym.scripts.reproductions.dad_tuning import tune
from beliefgym.scripts.reproductions.report import Interval

SMALL = {"n_frequencies": 20, "bandwidths": [1.0, 2.0], "alphas": [1e-6], "horizons": [5, None]}
SMALL |= {"n_iterations": 3, "screening": 1}


def reproduce(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(["reproduce", *arguments])
    return ended.value.code


def record_of(folder, name):
    return json.loads((folder / "reproduction" / f"{name}.json").read_text())


@pytest.fixture
def small_data(monkeypatch):
    monkeypatch.setattr(dad_data, "N_TRAJECTORIES", 40)
    for name in ("pendulum", "cart_pole", "helicopter"):
        function = getattr(dad_data, name)
        monkeypatch.setitem(
            dad_data.SIMULATED, name.replace("_", "-"), lambda seed, f=function, **k: f(seed, **{"n": 40} | k)
        )


def test_both_arms_choose_by_the_validation_error():
    train, validation, _ = dad_data.simulated_parts("pendulum", 0, n=60, dt=0.2)
    learner = RandomFourierRidge(n_frequencies=20, random_state=0)
    settings = [{"bandwidth": b, "alpha": 1e-4} for b in (0.2, 1.5, 6.0)]
    pair = tune(train, validation, learner, settings, [{"horizon": 5}], n_iterations=6, screening=2)
    plain = [
        DataAsDemonstrator(learner.set_params(**setting), n_iterations=0).fit(train).errors(validation).mean
        for setting in settings
    ]
    assert pair.single.learner == settings[int(np.argmin(plain))]
    assert pair.single.validation == pytest.approx(min(plain), rel=1e-12)
    assert pair.single.model.n_iterations == 0
    assert pair.dad.validation < pair.single.validation
    assert pair.dad.model.errors(validation).mean == pytest.approx(pair.dad.validation, rel=1e-12)


def test_where_dad_is_no_better_on_validation_its_arm_is_the_single_step_model():
    """On a linear noise-free system nothing is to be gained, up to rounding."""
    x = [np.random.default_rng(0).normal(size=(40, 2))]
    for _ in range(10):
        x.append(x[-1] @ np.array([[0.9, -0.2], [0.2, 0.9]]))
    train, validation = Sequences.from_observations(np.stack(x, axis=1)).split((30, 10), seed=0)
    learner = RandomFourierRidge(n_frequencies=5, include_inputs=True, alpha=0.0, random_state=0)
    pair = tune(train, validation, learner, [{}], [{"horizon": 5}], n_iterations=2, screening=1)
    assert pair.dad.validation <= pair.single.validation < 1e-9


def test_the_data_are_those_of_the_thesis():
    train, validation, test = dad_data.simulated_parts("cart-pole", 3)
    assert [len(part) for part in (train, validation, test)] == [800, 100, 100]
    assert set(train.lengths) == {30}
    radius = np.linalg.norm(dad_data.pendulum(0, n=5).observations[:, :, :2], axis=2)
    assert_allclose(radius, 1.0, rtol=1e-12)  # the tip stays on its circle
    flown = dad_data.helicopter(0, n=20, n_steps=10)
    assert (flown.n_obs, flown.n_act, flown.n_episodes) == (21, 0, 20)
    distance = np.linalg.norm(flown.observations[:, 0, 11:14], axis=1)
    assert distance.max() <= 10.0
    assert distance.max() > 5.0


def test_a_test_block_of_a_video_is_seen_by_nothing_else(monkeypatch):
    """Frames carry their number as brightness: every component of a part comes from its own block."""
    frames = np.zeros((120, 4, 5), dtype=np.uint8)
    frames += np.arange(120, dtype=np.uint8)[:, None, None]
    frames[:, 0, 0] = np.random.default_rng(0).integers(0, 255, 120)
    frames += np.random.default_rng(1).integers(0, 9, frames.shape, dtype=np.uint8)
    monkeypatch.setattr(dad_data, "COMPONENTS", 6)
    for fold in range(5):
        (train, validation, test), texture, shown = dad_data.video_parts(frames, fold, 5, 2, 4)
        border = np.linspace(0, 120, 7).round().astype(int)
        np.testing.assert_array_equal(shown, frames[border[fold] : border[fold + 1]])
        rest = np.concatenate([frames[: border[fold]], frames[border[fold + 2] :]])
        assert_allclose(texture.mean_, VideoTexture(6).fit(rest).mean_)
        assert len(test) == len(validation) == 20 - 8
        n_runs = 1 if fold in (0, 4) else 2
        assert len(train) == 80 - 8 * n_runs


def test_a_random_split_of_a_video_keeps_every_window(monkeypatch):
    monkeypatch.setattr(dad_data, "COMPONENTS", 5)
    frames = np.random.default_rng(0).integers(0, 255, (100, 4, 5), dtype=np.uint8)
    train, validation, test = dad_data.video_random_parts(frames, 0, 2, 10)
    assert [len(part) for part in (train, validation, test)] == [64, 8, 8]  # 80 windows of 21 frames
    again = dad_data.video_random_parts(frames, 0, 2, 10)[2]
    assert test.equals(again)
    assert not test.equals(dad_data.video_random_parts(frames, 1, 2, 10)[2])


def test_an_interval_is_students():
    interval = Interval.of([1.0, 2.0, 3.0, 4.0, 5.0])
    assert interval.mean == 3.0
    # t(0.975, 4) = 2.776 from any table; the standard error is sqrt(2.5 / 5)
    assert interval.high - 3.0 == pytest.approx(2.776 * 0.5**0.5, abs=1e-3)
    assert Interval.of([2.0]).text() == "2"


def test_the_table_is_written_with_figures(tmp_path, monkeypatch, small_data, capsys):
    monkeypatch.setattr(
        dad_table, "THESIS", {("pendulum", dad_table.RFF, ""): 44.7, ("pumpjack", dad_table.RFF, ""): 17.0}
    )
    monkeypatch.setattr(dad_table, "_settings", lambda *entry: SMALL)
    monkeypatch.setattr(dad_table, "flag_video", lambda request: tmp_path / "none")
    assert reproduce("dad-table", "--seeds", "2", "--results", str(tmp_path)) == 0
    record = record_of(tmp_path, "dad-table")
    pendulum, pumpjack = record["rows"]
    cells = [
        json.loads(p.read_text())["result"] for p in (tmp_path / "reproduction/cells/dad-table").iterdir()
    ]
    gains = [100 * (1 - cell["dad"]["test"] / cell["single"]["test"]) for cell in cells]
    assert pendulum["values"]["improvement"]["value"] == pytest.approx(np.mean(gains))
    assert pendulum["meets"] == (np.mean(gains) >= 44.7)
    assert pumpjack["single step"] == "no data"
    assert "left out: pumpjack, fireplace (`--data` names the folder)" in record["notes"][-1]
    page = (tmp_path / "reproduction" / "dad-table.md").read_text()
    for file in record["figures"]:
        assert (tmp_path / "reproduction" / file).stat().st_size > 10_000
        assert f"]({file})" in page
    assert len(record["figures"]) == 3


def test_the_map_says_where_it_helps(tmp_path, monkeypatch, small_data, capsys):
    monkeypatch.setattr(dad_map, "POINTS", [("pendulum", 0.0, 15, 10), ("helicopter", 0.1, 10, 10)])
    monkeypatch.setattr(dad_map, "SETTING", {**SMALL, "trajectories": 60})
    assert reproduce("dad-map", "--seeds", "2", "--results", str(tmp_path)) == 0
    rows = record_of(tmp_path, "dad-map")["rows"]
    assert [row["what"].split(",")[0] for row in rows] == ["pendulum", "helicopter"]
    assert {row["verdict"] for row in rows} <= {"helps", "hurts", "no difference"}
    assert (tmp_path / "reproduction" / "dad-map.png").exists()


@pytest.mark.parametrize(
    ("dad", "verdict"),
    [([0.5, 0.6, 0.55], "helps"), ([1.5, 1.6, 1.55], "hurts"), ([0.5, 1.5, 1.0], "no difference")],
)
def test_a_verdict_follows_the_interval(dad, verdict):
    row = dad_map.row(("pendulum", 0.0, 10, 10), [{"single": 1.0, "dad": error} for error in dad])
    assert row["verdict"] == verdict
    assert row["meets"] == (verdict != "hurts")


def test_the_growth_of_errors_is_described(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dad_growth, "SETTING", {**dad_growth.SETTING, "n": 60, "n_iterations": 4})
    assert reproduce("dad-growth", "--seeds", "2", "--results", str(tmp_path)) == 0
    record = record_of(tmp_path, "dad-growth")
    assert len(record["rows"]) == 5
    for file in record["figures"]:
        assert (tmp_path / "reproduction" / file).stat().st_size > 10_000


def test_the_example_of_theorem_3_1_1_meets_its_bound():
    """sum_{t <= T} L^t eps is attained by the example, so the bound is tight."""
    for a in (1.1, 1.0, 0.9):
        assert_allclose(dad_growth._example(a, 0.01, 30), 0.01 * np.cumsum(a ** np.arange(30)), rtol=1e-12)


def test_a_video_of_ones_own(tmp_path, monkeypatch, capsys):
    imageio = pytest.importorskip("imageio.v3")
    pytest.importorskip("imageio_ffmpeg")
    t = np.arange(240)[:, None, None]
    wave = 128 + 100 * np.sin(0.3 * np.arange(64)[None, None] + 0.2 * np.arange(48)[None, :, None] - 0.25 * t)
    imageio.imwrite(tmp_path / "wave.mp4", np.repeat(wave[..., None], 3, axis=3).astype(np.uint8), fps=25)
    monkeypatch.setattr(dad_video, "SETTING", SMALL)
    arguments = ("--video", str(tmp_path / "wave.mp4"), "--seeds", "2", "--results", str(tmp_path))
    assert reproduce("dad-video", *arguments) == 0
    (row,) = record_of(tmp_path, "dad-video")["rows"]
    assert row["what"] == "wave"
    assert float(row["single step"].split()[0]) < 0.5  # a travelling wave is two sinusoids
    assert (tmp_path / "reproduction" / "dad-video-wave.png").exists()


def test_a_path_that_is_not_there_is_told(tmp_path, capsys):
    assert reproduce("dad-video", "--video", str(tmp_path / "no.mp4"), "--results", str(tmp_path)) == 2
    assert "--video: there is no" in capsys.readouterr().err
