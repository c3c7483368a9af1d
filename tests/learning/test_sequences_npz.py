"""Sequences to .npz and back, and what a bad file says."""

import os

import numpy as np
import pytest

from beliefgym.learning import Sequences, load_npz, save_npz


@pytest.fixture
def sequences():
    rng = np.random.default_rng(0)
    return Sequences(
        rng.normal(size=(3, 6, 2)),
        rng.normal(size=(3, 5, 1)),
        rng.normal(size=(3, 5)),
        lengths=[5, 0, 3],
        terminated=[True, False, False],
        states=rng.normal(size=(3, 6, 4)),
        hints=rng.normal(size=(3, 6, 1)),
        action_log_probs=rng.normal(size=(3, 5)),
        observation_names=("x", "angle θ"),
        metadata={"dt": 0.05, "env": {"id": "Pendulum-v1"}, "inf": float("inf")},
    )


def resave(path, **changes):
    """The file again with arrays replaced, or taken away where None."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    arrays.update(changes)
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def test_round_trip(sequences, tmp_path):
    path = tmp_path / "run.npz"
    assert sequences.save_npz(path) == path
    again = Sequences.load_npz(str(path))
    assert again.equals(sequences)
    assert again.n_steps == sequences.n_steps
    assert again.observation_names == ("x", "angle θ")
    assert dict(again.metadata) == dict(sequences.metadata)
    assert not again.observations.flags.writeable
    assert os.listdir(tmp_path) == ["run.npz"]


def test_round_trip_without_the_optional_parts(tmp_path):
    plain = Sequences.from_episodes([np.ones((1, 1)), np.ones((3, 1))])
    save_npz(plain, tmp_path / "plain")  # the name is used as it is
    again = load_npz(tmp_path / "plain")
    assert again.equals(plain)
    assert again.states is None
    assert again.observation_names is None


def test_nothing_is_pickled(sequences, tmp_path):
    sequences.save_npz(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)


def test_an_interrupted_write_leaves_the_old_file(sequences, tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    sequences.save_npz(path)

    def fail(file, **arrays):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(KeyboardInterrupt):
        sequences[:1].save_npz(path)
    assert os.listdir(tmp_path) == ["run.npz"]
    assert load_npz(path).equals(sequences)


def test_replaces_an_existing_file(sequences, tmp_path):
    path = tmp_path / "run.npz"
    sequences.save_npz(path)
    sequences[:1].save_npz(path)
    assert len(load_npz(path)) == 1


def test_missing_file_and_folder(sequences, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no file .*nowhere\.npz; expected one written by Sequences\.save_npz"
    ):
        load_npz(tmp_path / "nowhere.npz")
    with pytest.raises(FileNotFoundError, match=r"the folder .*missing does not exist; create it first"):
        sequences.save_npz(tmp_path / "missing" / "run.npz")


@pytest.mark.parametrize("keep", [0, 10, 300, -30])
def test_a_truncated_file(sequences, tmp_path, keep):
    path = tmp_path / "run.npz"
    sequences.save_npz(path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"run\.npz is damaged or not an \.npz file"):
        load_npz(path)


def test_a_file_with_flipped_bytes(sequences, tmp_path):
    path = tmp_path / "run.npz"
    sequences.save_npz(path)
    content = bytearray(path.read_bytes())
    for i in range(len(content) // 3, len(content) // 3 + 40):
        content[i] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"run\.npz is damaged"):
        load_npz(path)


def test_foreign_files(tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, b=np.zeros(2), a=np.zeros(2))
    with pytest.raises(ValueError, match=r"was not written by Sequences\.save_npz: it holds \['a', 'b'\]"):
        load_npz(path)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(ValueError, match="it holds a single array"):
        load_npz(tmp_path / "one.npy")
    np.savez(path, a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="Object arrays cannot be loaded"):
        load_npz(path)
    path.write_text("time,angle\n0,1\n")
    with pytest.raises(ValueError, match=r"other\.npz is damaged or not an \.npz file of plain arrays"):
        load_npz(path)


def test_an_array_that_is_missing_or_misnamed(sequences, tmp_path):
    path = tmp_path / "run.npz"
    sequences.save_npz(path)
    resave(path, observations=None, observation=np.zeros((3, 6, 2)))
    with pytest.raises(
        ValueError, match=r"has no array 'observations'; did you mean 'observation'\? \(it holds \["
    ):
        load_npz(path)
    sequences.save_npz(path)
    resave(path, hints=None)
    with pytest.raises(ValueError, match="has no array 'hints'"):
        load_npz(path)


def test_a_later_version_and_a_broken_header(sequences, tmp_path):
    path = tmp_path / "run.npz"
    sequences.save_npz(path)
    resave(path, beliefgym_sequences=np.array('{"version": 99}'))
    with pytest.raises(
        ValueError, match="has version 99 of the format, and this beliefgym reads up to 1; update"
    ):
        load_npz(path)
    resave(path, beliefgym_sequences=np.array('{"version": 1}'))
    with pytest.raises(ValueError, match=r"its header is unreadable \(KeyError\('arrays'\)\)"):
        load_npz(path)
    resave(path, beliefgym_sequences=np.array("{"))
    with pytest.raises(ValueError, match="is damaged: its header is unreadable"):
        load_npz(path)


def test_the_content_is_checked_again(sequences, tmp_path):
    path = tmp_path / "run.npz"
    sequences.save_npz(path)
    resave(path, rewards=np.full((3, 5), np.nan))
    with pytest.raises(ValueError, match=r"rewards: expected finite numbers.* got nan at episode 0, step 0"):
        load_npz(path)
