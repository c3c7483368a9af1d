"""The examples on recordings, of the README and of the guide, do what they say."""

import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from beliefgym.learning import DataAsDemonstrator, Sequences, load_filter
from beliefgym.scripts.reproductions.dad_data import pendulum

README = Path(__file__).parents[1] / "README.md"


in_checkout = pytest.mark.skipif(
    not README.exists(), reason="the README and the guides lie in a checkout only"
)


@in_checkout
def test_five_lines_from_recorded_arrays_to_a_forecast(tmp_path, monkeypatch):
    (example,) = (
        block
        for block in re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
        if "DataAsDemonstrator" in block
    )
    _, body = example.split("\n\n")
    assert len(body.strip().splitlines()) == 5
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    np.save("runs.npy", pendulum(0, n=100, n_steps=120).observations)
    names: dict = {}
    exec(example, names)
    recorded, forecast = names["test"].observations[0, :101], names["forecast"]
    assert forecast.shape == (101, 3)
    assert np.sqrt(np.square(forecast - recorded).mean() / np.square(recorded).mean()) < 0.02
    plain = DataAsDemonstrator(n_iterations=0).fit(names["train"])
    # 0.0037 against 0.0164 where it was measured
    assert names["model"].errors(names["test"]).mean < 0.5 * plain.errors(names["test"]).mean
    assert len(names["plt"].gca().lines) == 6
    names["plt"].savefig("forecast.png")
    names["plt"].close("all")


@in_checkout
def test_the_guide_to_dad_runs(tmp_path, monkeypatch):
    """Both of its examples, on an arm of one joint with a torque and on a travelling wave."""
    imageio = pytest.importorskip("imageio.v3")
    pytest.importorskip("imageio_ffmpeg")
    csv_example, video_example = re.findall(
        r"```python\n(.*?)```", (README.parent / "docs" / "data-as-demonstrator.md").read_text(), re.DOTALL
    )
    monkeypatch.chdir(tmp_path)
    rng, rows = np.random.default_rng(0), ["trial,t,joint_angle,joint_speed,torque_1"]
    for trial in range(20):
        angle, speed = rng.normal(size=2)
        for k in range(40):
            torque = rng.normal()
            rows.append(f"{trial},{0.1 * k:.3f},{angle},{speed},{torque}")
            angle, speed = angle + 0.1 * speed, 0.98 * speed + 0.1 * (torque - angle)
    Path("arm.csv").write_text("\n".join(rows))
    names: dict = {}
    exec(csv_example, names)
    model, test = names["model"], names["test"]
    assert (model.n_obs_, model.n_act_) == (2, 1)
    assert model.errors(test).mean < 0.1  # a smooth map of three numbers
    assert model.history_["validation_multi_step"].shape == (26,)

    t, x, y = np.arange(450)[:, None, None], np.arange(64)[None, None], np.arange(48)[None, :, None]
    wave = 128 + 100 * np.sin(0.3 * x + 0.2 * y - 0.25 * t)
    imageio.imwrite("clip.mp4", np.repeat(wave[..., None], 3, axis=3).astype(np.uint8), fps=25)
    exec(video_example, names)
    assert names["pictures"].shape == (17, 12, 16)


@in_checkout
def test_the_guide_to_control_learns_and_saves(tmp_path, monkeypatch, capsys):
    """Its example as it stands: four trials, whose last is cheaper than the random first one."""
    guide = (README.parent / "docs" / "model-based-control.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", guide, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(example, names)
    costs = [trial["cost"] for trial in names["agent"].history]
    assert len(costs) == 4
    assert min(costs[1:]) < costs[0]
    assert Path("swing-up.zip").exists()
    assert len(capsys.readouterr().out.splitlines()) == 2


@in_checkout
def test_the_readmes_agent_acts_after_six_trials():
    (example,) = (
        block
        for block in re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
        if "DaDControl" in block
    )
    names: dict = {"observation": np.array([0.0, -1.0, 0.0, 0.0, 0.0], dtype=np.float32)}
    exec(example, names)
    assert names["action"].shape == (1,)
    assert names["agent"].num_timesteps >= 360


def blocks_of(path):
    return re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)


@in_checkout
def test_the_guide_to_filters_runs(tmp_path, monkeypatch):
    """Every block in turn, on swings of a pendulum, and what they promise."""
    monkeypatch.chdir(tmp_path)
    blocks = blocks_of(README.parent / "docs" / "predictive-state-filters.md")
    assert len(blocks) == 4
    swings = pendulum(0, n=60, n_steps=60).observations
    names: dict = {"array": swings, "live": swings[0][:, None]}
    exec(blocks[0], names)
    filter, test, belief = names["filter"], names["test"], names["belief"]
    power = np.square(test.observations).sum(axis=2).mean()
    assert filter.errors(test).mean < 1e-3 * power
    assert filter.forecast(belief, 20).shape == (2, 20, 3)
    exec(blocks[1], names)
    assert names["belief"].shape == (1, filter.belief_size)
    assert names["stream"].n_pairs > filter.history_["n_pairs"][-1]
    names["belief"] = belief
    exec(blocks[2], names)
    loaded = load_filter("arm.safetensors")
    np.testing.assert_array_equal(loaded.forecast(belief, 20), filter.forecast(belief, 20))
    exec(blocks[3], names)
    assert names["gaussian"].predict_variance(names["gaussian"].initial_belief(1)).shape == (1, 3)


@in_checkout
def test_the_readmes_filter_forecasts(tmp_path):
    (example,) = (block for block in blocks_of(README) if "PSIM(" in block)
    runs = pendulum(0, n=60, n_steps=60)
    train, validation, test = runs.split((0.8, 0.1, 0.1), seed=0)
    names: dict = {"train": train, "validation": validation, "test": test}
    exec(example, names)
    assert names["next_twenty"].shape == (1, 20, 3)
    last = test.observations[0, -1]
    assert np.abs(names["next_twenty"][0, 0] - last).max() < 0.5


@in_checkout
def test_the_readmes_estimator_follows_a_stream():
    (example,) = (block for block in blocks_of(README) if "HintEstimator(" in block)
    runs = pendulum(0, n=60, n_steps=60)
    hints = np.arctan2(runs.observations[:, :, 1:2], runs.observations[:, :, 0:1])
    seen = Sequences.from_observations(runs.observations[:, :, :2], hints=hints)
    train, validation, test = seen.split((0.8, 0.1, 0.1), seed=0)
    stream = np.array(test.observations[0])
    stream[7] = np.nan
    names: dict = {"train": train, "validation": validation, "stream": stream}
    exec(example, names)
    assert names["estimate"].shape == names["std"].shape == (1,)
    assert names["estimator"].n_seen == 61


@in_checkout
def test_the_guide_to_hints_runs():
    """Both blocks: a payload's mass estimated beside an environment, and a filter that knows its system."""
    first, second = blocks_of(README.parent / "docs" / "filters-with-hints.md")
    names: dict = {}
    exec(first, names)
    errors, truth = names["errors"], names["field"].unwrapped.state[18]
    # the arm lifts at half of the episode: before, the mass is not to be seen
    assert errors.by_time[-20:].mean() < 0.8 * errors.by_time[:20].mean() < 0.09
    mass, std = names["mass"][0], names["std"][0]
    assert abs(mass - truth) < 4 * std
    assert 0 < std < 1.2 * names["filter"].prior_std_[0]
    exec(second, names)
    assert (
        abs(np.sin(names["angle_and_speed"][0, 0]) - 0.2) < 0.02
    )  # what was seen of it, nearly without noise


@in_checkout
def test_the_guide_to_actions_runs():
    """Every block in turn: forecasts differ by the torque, weights have effective samples."""
    blocks = blocks_of(README.parent / "docs" / "filters-with-actions.md")
    assert len(blocks) == 3
    names: dict = {}
    exec(blocks[0], names)
    futures = names["futures"]
    assert futures.shape == (5, 10, 2)
    angles = np.unwrap(np.arctan2(futures[:, :, 1], futures[:, :, 0]), axis=1)
    turned = angles[:, -1] - angles[:, 0]
    assert (np.diff(turned) > 0.1).all()  # 1 N m for half a second is a third of a radian, by hand
    assert names["filter"].errors(names["test"]).mean < 0.01
    exec(blocks[1], names)
    samples = names["weighed"].effective_samples_
    assert samples[0] == 1.0 > samples[1] > samples[2] > 0.01
    exec(blocks[2], names)
    forecast = names["conditional"].forecast(names["belief"], 10, names["test"].actions[:, 20:])
    assert np.sqrt(np.square(forecast[:, :5] - names["test"].observations[:, 20:25]).mean()) < 0.3


SHORT = {"20_000": "2_400", "n_iterations=30": "n_iterations=3", "n_frequencies=300": "n_frequencies=30"}


def shortened(example):
    for long, short in SHORT.items():
        example = example.replace(long, short)
    return example


@in_checkout
def test_two_lines_fit_and_wrap_a_belief():
    (example,) = (block for block in blocks_of(README) if "BeliefObservation" in block)
    fit, wrap = example.strip().splitlines()[-2:]
    assert ".fit(" in fit
    assert "BeliefObservation(" in wrap
    names: dict = {"gym": pytest.importorskip("gymnasium")}
    exec(example, names)
    observation, _ = names["env"].reset(seed=0)
    assert observation.shape == (2 + 10 * 2,)
    assert np.isfinite(names["env"].step(names["env"].action_space.sample())[0]).all()


@in_checkout
def test_ten_lines_train_sac_on_a_belief(tmp_path, monkeypatch, capsys):
    (example,) = (block for block in blocks_of(README) if "BeliefPolicy" in block)
    assert len(example.strip().splitlines()) <= 10
    assert 'algorithm="SAC"' in example
    assert "PendulumPosition-v0" in example
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(shortened(example), names)
    assert names["agent"].model.num_timesteps == 2_400
    assert -1800 < float(capsys.readouterr().out) < 0
    assert Path("belief.zip").exists()


@in_checkout
def test_the_guide_to_beliefs_runs(capsys):
    blocks = blocks_of(README.parent / "docs" / "beliefs.md")
    assert len(blocks) == 2
    names: dict = {}
    exec(shortened(blocks[0].replace("20_000", "400")), names)
    assert names["model"].observation_space.shape == (2 + 10 * 2,)
    exec(shortened(blocks[1]), names)
    assert names["agent"].filter == "psim-hints"
    assert -1800 < float(capsys.readouterr().out) < 0


@in_checkout
def test_the_guide_to_recurrent_action_values_runs(capsys):
    blocks = blocks_of(README.parent / "docs" / "recurrent-q.md")
    assert len(blocks) == 2
    names: dict = {}
    exec(blocks[0].replace("50_000", "1_024").replace("n_episodes=100", "n_episodes=5"), names)
    assert names["agent"].num_timesteps == 1_024
    assert 1.0 <= float(capsys.readouterr().out) <= 500.0
    exec(blocks[1], names)
    assert names["loss"].gradient == "residual"
