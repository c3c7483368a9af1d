"""Sequences to Minari and back, and Minari datasets from elsewhere."""

import sys

import gymnasium as gym
import numpy as np
import pytest

from beliefgym.learning import Sequences, from_minari, to_minari

minari = pytest.importorskip("minari")
from minari.data_collector import EpisodeBuffer  # noqa: E402

pytestmark = pytest.mark.filterwarnings(
    "ignore:.* is set to None:UserWarning", "ignore:env_spec is None:UserWarning"
)


@pytest.fixture(autouse=True)
def datasets_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def example(n_act=2):
    rng = np.random.default_rng(0)
    return Sequences(
        rng.normal(size=(3, 9, 2)),
        rng.normal(size=(3, 8, n_act)),
        rng.normal(size=(3, 8)),
        lengths=[5, 1, 7],
        terminated=[True, False, False],
        states=rng.normal(size=(3, 9, 4)),
        hints=rng.normal(size=(3, 9, 1)),
        action_log_probs=rng.normal(size=(3, 8)),
        observation_names=("x", "angle θ"),
        hint_names=("height",),
        metadata={"dt": 0.05, "env": {"id": "Pendulum-v1"}},
    )


def foreign(observation_space, action_space, observations, actions, dataset_id="other/data-v0", **fields):
    """A dataset of one episode of 3 steps, written with Minari alone."""
    fields = {"terminations": [False, False, True], "truncations": [False] * 3, **fields}
    buffer = EpisodeBuffer(
        observations=observations,
        actions=actions,
        rewards=[1.0, 2.0, 3.0],
        infos={"states": np.zeros((4, 9))},
        **fields,
    )
    return minari.create_dataset_from_buffers(
        dataset_id, [buffer], observation_space=observation_space, action_space=action_space
    )


def test_round_trip_is_equal():
    sequences = example()
    dataset = to_minari(sequences, "beliefgym/example-v0")
    assert from_minari(dataset).equals(sequences)
    assert from_minari("beliefgym/example-v0").equals(sequences)


def test_what_minari_itself_sees():
    sequences = example()
    to_minari(sequences, "beliefgym/example-v0", author="A. Author", description="an example")
    dataset = minari.load_dataset("beliefgym/example-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 13)
    assert dataset.observation_space == gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    assert dataset.storage.metadata["author"] == {"A. Author"}
    for i, episode in enumerate(dataset.iterate_episodes()):
        length = sequences.lengths[i]
        assert episode.observations.shape == (length + 1, 2)
        np.testing.assert_array_equal(episode.actions, sequences.actions[i, :length])
        np.testing.assert_array_equal(episode.rewards, sequences.rewards[i, :length])
        np.testing.assert_array_equal(episode.infos["states"], sequences.states[i, : length + 1])
        assert episode.terminations.tolist() == [False] * (length - 1) + [i == 0]
        assert episode.truncations.tolist() == [False] * (length - 1) + [i != 0]


def test_recordings_without_actions_or_optional_arrays():
    recorded = Sequences.from_episodes([np.ones((4, 1)), np.zeros((2, 1))])
    dataset = to_minari(recorded, "recorded-v3")
    assert dataset.action_space.shape == (1,)
    again = from_minari(dataset)
    assert again.equals(recorded)
    assert again.n_act == 0
    assert again.states is None


def test_the_environment_can_be_rebuilt():
    dataset = to_minari(example(), "pendulum-v0", env="Pendulum-v1")
    assert minari.load_dataset("pendulum-v0").env_spec.id == "Pendulum-v1"
    assert from_minari(dataset).equals(example())


def test_a_filtered_dataset_gives_its_episodes():
    sequences = example()
    dataset = to_minari(sequences, "example-v0").filter_episodes(lambda episode: len(episode.rewards) > 1)
    assert from_minari(dataset).equals(sequences[[0, 2]])


def test_optional_metadata_that_is_left_out_raises_no_warning(recwarn):
    to_minari(example(), "example-v0")
    assert not list(recwarn)


@pytest.mark.parametrize("dataset_id", ["example", "example-v", "a b-v0", ""])
def test_a_malformed_id(dataset_id, datasets_folder):
    with pytest.raises(ValueError, match=r"expected a dataset id of the form \(namespace/\)name-v0"):
        to_minari(example(), dataset_id)
    assert not list(datasets_folder.iterdir())


def test_an_id_that_is_taken():
    to_minari(example(), "example-v0")
    with pytest.raises(ValueError, match=r"there is a dataset 'example-v0' already .*take a new version"):
        to_minari(example()[:1], "example-v0")
    assert from_minari("example-v0").equals(example())


def test_episodes_without_a_step():
    with pytest.raises(
        ValueError, match="one step in each, got length 0 for episode 1; leave such episodes out"
    ):
        to_minari(Sequences.from_episodes([np.ones((2, 1)), np.ones((1, 1))]), "example-v0")
    with pytest.raises(
        ValueError, match="expected at least one episode and one step in each, got no episode"
    ):
        to_minari(example()[[]], "example-v0")


def test_a_failed_write_leaves_nothing_behind(datasets_folder):
    with pytest.raises(gym.error.NameNotFound):
        to_minari(example(), "example-v0", env="NoSuchEnvironment-v0")
    assert not (datasets_folder / "example-v0").exists()
    to_minari(example(), "example-v0")


def test_an_unknown_dataset_names_the_nearest():
    to_minari(example(), "beliefgym/pendulum-v0")
    with pytest.raises(
        FileNotFoundError, match=r"no local .* 'beliefgym/pendulm-v0'; did you mean 'beliefgym/pendulum-v0'"
    ):
        from_minari("beliefgym/pendulm-v0")


def test_without_minari(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "minari"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "minari", None)
    for call in (lambda: to_minari(example(), "example-v0"), lambda: from_minari("example-v0")):
        with pytest.raises(ImportError, match=r'optional package minari .*pip install "beliefgym\[minari\]"'):
            call()


def test_a_foreign_dataset_with_discrete_actions():
    observations = np.arange(8, dtype=np.float32).reshape(4, 2)
    dataset = foreign(gym.spaces.Box(-9, 9, (2,)), gym.spaces.Discrete(5, start=1), observations, [1, 5, 2])
    sequences = from_minari(dataset)
    np.testing.assert_array_equal(sequences.observations, observations[None])
    assert sequences.actions.tolist() == [[[1.0], [5.0], [2.0]]]
    assert sequences.rewards.tolist() == [[1.0, 2.0, 3.0]]
    assert sequences.terminated.tolist() == [True]
    assert sequences.states is None  # infos from elsewhere are not read
    assert sequences.observation_names is None
    assert dict(sequences.metadata) == {"minari_dataset": "other/data-v0"}


def test_the_last_flag_decides_whether_an_episode_terminated():
    space = gym.spaces.Box(-9, 9, (1,))
    dataset = foreign(
        space,
        space,
        np.zeros((4, 1)),
        np.zeros((3, 1)),
        terminations=[False] * 3,
        truncations=[False, False, True],
    )
    assert from_minari(dataset).terminated.tolist() == [False]


def test_a_foreign_dataset_with_structured_spaces():
    box = gym.spaces.Box(-9, 9, (2,))
    observation_space = gym.spaces.Dict(
        {"observation": box, "goal": gym.spaces.Tuple((gym.spaces.Discrete(4), gym.spaces.Box(-9, 9, (1,))))}
    )
    position, cell, height = np.arange(8.0).reshape(4, 2), np.array([3, 2, 1, 0]), np.full((4, 1), 7.0)
    dataset = foreign(
        observation_space,
        gym.spaces.MultiDiscrete([3, 4]),
        {"observation": position, "goal": (cell, height)},
        np.array([[0, 1], [2, 3], [1, 1]]),
    )
    sequences = from_minari(dataset)
    assert sequences.observation_names == ("goal.0", "goal.1", "observation[0]", "observation[1]")
    np.testing.assert_array_equal(sequences.observations[0], np.column_stack([cell, height, position]))
    assert sequences.actions.tolist() == [[[0, 1], [2, 3], [1, 1]]]
    assert sequences.action_names is None


def test_foreign_boxes_of_any_shape_and_bits_become_columns():
    dataset = foreign(
        gym.spaces.Box(-9, 9, (2, 3)),
        gym.spaces.Tuple((gym.spaces.MultiBinary(2), gym.spaces.MultiDiscrete([2, 2]))),
        np.arange(24.0).reshape(4, 2, 3),
        (np.eye(3, 2, dtype=np.int8), np.zeros((3, 2), dtype=np.int64)),
    )
    sequences = from_minari(dataset)
    np.testing.assert_array_equal(sequences.observations[0], np.arange(24.0).reshape(4, 6))
    assert sequences.action_names == ("0[0]", "0[1]", "1[0]", "1[1]")
    np.testing.assert_array_equal(sequences.actions[0, :, :2], np.eye(3, 2))


def test_observations_that_are_not_numbers():
    dataset = foreign(
        gym.spaces.Dict({"mission": gym.spaces.Text(10)}),
        gym.spaces.Discrete(2),
        {"mission": ["go", "go", "go", "stop"]},
        [0, 1, 0],
    )
    with pytest.raises(ValueError, match=r"expected observations and actions made of numbers .*, got Text"):
        from_minari(dataset)


def test_a_dataset_of_a_later_format():
    dataset = to_minari(example(), "example-v0")
    dataset.storage.update_metadata({"beliefgym_sequences": '{"version": 99}'})
    with pytest.raises(ValueError, match="has version 99 of the format, and this beliefgym reads up to 1"):
        from_minari("example-v0")
