"""The command line as a user types it."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from beliefgym.scripts.cli import main

FAST = ["--option", "n_envs=2", "--option", 'arguments={"policy":"MlpPolicy","n_steps":32,"batch_size":64}']


def run(*arguments):
    """The exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return ended.value.code


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A trained agent's file."""
    path = tmp_path_factory.mktemp("agents") / "small.zip"
    command = ["train", "--agent", "ppo", "--env", "PendulumPosition-v0", "--steps", "200", "--points", "2"]
    assert run(*command, "--episodes", "3", "--no-progress", "--out", str(path), *FAST) == 0
    return path


def test_train_saves_an_agent_and_a_record(trained):
    record = json.loads(trained.with_suffix(".json").read_text())
    assert record["agent"] == "ppo"
    assert record["task"]["env_id"] == "beliefgym/PendulumPosition-v0"
    assert record["options"]["n_envs"] == 2
    assert [point["step"] for point in record["learning_curve"]] == [0, 100, 200]
    assert record["versions"]["torch"].startswith("2.")
    assert record["interrupted"] is False


def test_evaluate_prints_return_and_score(trained, capsys):
    assert run("evaluate", str(trained), "--episodes", "5") == 0
    printed = capsys.readouterr().out
    assert "small.zip on PendulumPosition-v0, 5 episodes" in printed
    assert "score" in printed
    assert run("evaluate", "random", "--env", "CartPoleSwingUp-v0", "--episodes", "5") == 0
    assert run("evaluate", "random", "--env", "CartPole-v1", "--episodes", "5") == 0
    assert "no score: CartPole-v1 has no expert" in capsys.readouterr().out


def test_record_writes_a_video(trained, tmp_path, capsys):
    pytest.importorskip("moviepy", reason="the video extra is not installed")
    assert run("record", str(trained), "--out", str(tmp_path), "--param", "max_speed=8.0") == 0
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 5000
    assert str(video) in capsys.readouterr().out


def test_envs_and_agents_list_what_there_is(capsys):
    assert run("envs") == 0
    assert run("agents") == 0
    assert run("envs", "CartPoleSwingUpPosition-v0") == 0
    printed = capsys.readouterr().out
    for text in ("sac-stack", "recurrent-ppo", "d2theta/dt2", "time limit: 200 steps"):
        assert text in printed


def test_task_options_make_the_task(capsys):
    options = [
        "--keep",
        "cos_theta",
        "--noise",
        "0.1",
        "--delay",
        "1",
        "--action-history",
        "2",
        "--bins",
        "3",
    ]
    assert (
        run(
            "evaluate",
            "random",
            "--env",
            "Pendulum-v0",
            "--param",
            "damping=0.2",
            *options,
            "--episodes",
            "2",
        )
        == 0
    )
    printed = capsys.readouterr().out
    for text in ("damping=0.2", "keep=cos_theta", "std=0.1", "steps=1", "length=2", "bins=3"):
        assert text in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["evaluate", "random", "--env", "beliefgym/PendulumPositon-v0"],
            "did you mean 'beliefgym/PendulumPosition-v0'",
        ),
        (["train", "--agent", "sac-stak"], "did you mean 'sac-stack'"),
        (["evaluate", "ppo"], "must be trained first"),
        (["evaluate", "nowhere.zip"], "no saved agent at nowhere.zip"),
        (["evaluate", "random", "--keep", "cos_teta"], "cos_teta.*did you mean 'cos_theta'"),
        (["evaluate", "random", "--delay", "-1"], "steps.*-1"),
        (["evaluate", "random", "--param", "dampng=1"], "did you mean 'damping'"),
        (["evaluate", "random", "--param", "damping"], "expected NAME=VALUE, got 'damping'"),
        (["train", "--steps", "0"], "--steps of at least 1, got 0"),
        (["train", "--agent", "ppo", "--option", "n_stak=2"], "unexpected keyword argument 'n_stak'"),
        (["benchmark", "enw"], "did you mean 'env'"),
        (["leaderboard", "--tier", "ful"], "no tier 'ful'; did you mean 'full'"),
        (["leaderboard", "--name", "mine"], "needs --name, --envs and --agents together"),
    ],
)
def test_bad_input_is_told_without_a_traceback(arguments, message, capsys):
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert re.search(message, error, re.S), error


def test_an_unknown_option_is_told_with_the_nearest(capsys):
    assert run("train", "--sed", "3") == 2
    printed = capsys.readouterr()
    assert "Unrecognized options: --sed" in printed.err + printed.out
    assert "--seed" in printed.err + printed.out


def test_a_checkpoint_for_another_space_is_told(trained, capsys):
    assert run("evaluate", str(trained), "--env", "CartPoleSwingUp-v0") == 2
    assert "choose a task with the same space" in capsys.readouterr().err


def test_help_has_examples(capsys):
    for command in ("train", "evaluate", "record", "leaderboard", "envs", "benchmark"):
        assert run(command, "--help") == 0
        assert f"\n    beliefgym {command} " in capsys.readouterr().out


def test_ctrl_c_keeps_what_was_learned(tmp_path, monkeypatch, capsys):
    from beliefgym.scripts import training

    def interrupt(self):
        if self.num_timesteps >= 64:
            raise KeyboardInterrupt
        return True

    monkeypatch.setattr(training.LearningCurve, "_on_step", interrupt)
    path = tmp_path / "stopped.zip"
    command = ["train", "--agent", "ppo", "--steps", "5000", "--no-progress", "--out", str(path), *FAST]
    assert run(*command) == 130
    assert json.loads(path.with_suffix(".json").read_text())["interrupted"] is True
    assert "keeping what has been learned" in capsys.readouterr().out
    assert run("evaluate", str(path), "--episodes", "2") == 0


def test_an_agent_in_the_users_own_folder_joins(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n"
        "from beliefgym.agents import RandomAgent\n"
        "class Still(RandomAgent):\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=False):\n"
        "        return np.zeros((len(observation), 1), dtype=np.float32), None\n"
    )
    command = [
        "leaderboard",
        "--name",
        "mine",
        "--envs",
        "Pendulum-v0",
        "--agents",
        "mine:Still",
        "--steps",
        "10",
    ]
    done = subprocess.run(
        [
            shutil.which("beliefgym", path=Path(sys.executable).parent),
            *command,
            "--seeds",
            "1",
            "--processes",
            "1",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "mine:Still" in (tmp_path / "results" / "leaderboard_mine.md").read_text()


def test_python_m_beliefgym():
    done = subprocess.run([sys.executable, "-m", "beliefgym", "--help"], capture_output=True, text=True)
    assert done.returncode == 0
    assert "leaderboard" in done.stdout
