"""The pages of the environments say what the code and the results say."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from beliefgym.envs import registered_ids
from beliefgym.scripts import pages
from beliefgym.scripts.benchmarks.every_env import peer


def test_every_id_is_in_one_family_and_the_full_one_leads():
    families = pages.families()
    assert sorted(env_id for ids in families.values() for env_id in ids) == registered_ids()
    assert families["CartPole"] == ["beliefgym/CartPoleSwingUp-v0", "beliefgym/CartPoleSwingUpPosition-v0"]
    assert families["CartPoleBalance"][0] == "beliefgym/CartPoleBalance-v0"
    assert families["MobileBase"][0] == "beliefgym/MobileBase-v0"  # although the landmarks are more numbers
    assert pages.shown_id(families["Helicopter"]) == "beliefgym/HelicopterHoverPosition-v0"
    assert families["Hopper"] == ["beliefgym/HopperPosition-v0"]


def test_a_page_holds_picture_table_and_data_sheet(tmp_path, monkeypatch):
    monkeypatch.setattr(
        pages, "families", lambda: {"Pendulum": ["beliefgym/Pendulum-v0", "beliefgym/PendulumPosition-v0"]}
    )
    results = tmp_path / "results"
    results.mkdir()
    (results / "leaderboard_difficulty.csv").write_text(
        "task,agent,seed,status,score\n"
        "Pendulum-v0,ppo,0,finished,0.9\n"
        "Pendulum-v0,ppo,1,finished,1.0\n"
        "PendulumPosition-v0,ppo,0,finished,0.25\n"
        "PendulumPosition-v0,ppo,1,failed,\n"
        "PendulumPosition-v0,random,0,finished,0.0\n"
    )
    pages.write_pages(tmp_path / "docs", results, told=lambda name: None)
    page = (tmp_path / "docs" / "environments" / "Pendulum.md").read_text()
    assert "0.95 (0.90 to 1.00)" in page
    assert "With everything shown, PPO without memory scores 0.95 after 200,000 steps" in page
    assert "On `PendulumPosition-v0` the same agent with the same budget scores 0.25." in page
    assert "| 0 | theta " in page  # the data sheet
    picture = Image.open(tmp_path / "docs" / "images" / "environments" / "Pendulum.png")
    assert picture.width == pages.WIDTH
    assert "[Pendulum](Pendulum.md)" in (tmp_path / "docs" / "environments" / "README.md").read_text()


def test_the_moments_of_a_short_episode_are_its_own():
    """The expert leaves the T-maze after 11 of 50 steps: the start, a place on the way and the end are shown."""
    picture = pages.strip(pages.shown_id(["beliefgym/TMaze-v0", "beliefgym/TMazeMemory-v0"]))
    frames = np.split(picture, 3, axis=1)
    assert picture.shape == (480, 3 * 720, 3)
    assert not any(np.array_equal(a, b) for a, b in pairwise(frames))


def test_what_was_not_measured_is_said_to_be(tmp_path):
    assert pages.scores_without_memory(tmp_path) == {}
    assert pages.difficulty(["beliefgym/Pendulum-v0"], {}) == ""


def test_every_id_has_a_peer_in_the_benchmark():
    for env_id in registered_ids():
        assert peer(env_id).endswith(tuple("0123456789"))
    with pytest.raises(ValueError, match="no peer of beliefgym/Unheard-v0 is named"):
        peer("beliefgym/Unheard-v0")
