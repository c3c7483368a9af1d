"""`Sequences`: the checks at the door, padding, indexing, concatenation and comparison."""

import copy
import dataclasses
import pickle
import re

import numpy as np
import pytest

from beliefgym.learning import Sequences

NAMES = {"observation_names": ("cos", "sin", "rate"), "action_names": ("torque", "brake")}


def example_arrays(lengths=(4, 1, 0, 6), n_steps=7, seed=0):
    """Padded arrays with NaN past every end, and their lengths."""
    rng = np.random.default_rng(seed)
    n = len(lengths)
    arrays = {
        "observations": rng.normal(size=(n, n_steps + 1, 3)),
        "actions": rng.normal(size=(n, n_steps, 2)),
        "rewards": rng.normal(size=(n, n_steps)),
        "states": rng.normal(size=(n, n_steps + 1, 4)),
        "hints": rng.normal(size=(n, n_steps + 1, 1)),
        "action_log_probs": rng.normal(size=(n, n_steps)),
    }
    for i, length in enumerate(lengths):
        for name, array in arrays.items():
            extra = 1 if name in ("observations", "states", "hints") else 0
            array[i, length + extra :] = np.nan
    return arrays, np.array(lengths)


def example(**kwargs):
    arrays, lengths = example_arrays(**kwargs)
    terminated = np.arange(len(lengths)) % 2 == 0
    return Sequences(**arrays, lengths=lengths, terminated=terminated, metadata={"dt": 0.05}, **NAMES)


def test_padding_becomes_zero_and_the_inside_stays():
    arrays, lengths = example_arrays()
    sequences = Sequences(**arrays, lengths=lengths)
    for name, given in arrays.items():
        kept = getattr(sequences, name)
        inside = np.isfinite(given)
        np.testing.assert_array_equal(kept[inside], given[inside])
        assert (kept[~inside] == 0).all()
        assert kept.dtype == np.float64
        assert kept.flags.c_contiguous
        assert np.isnan(given).any()  # the caller's array is left as it was


def test_arrays_are_read_only_copies():
    observations = np.zeros((1, 3, 1))
    sequences = Sequences(observations, np.zeros((1, 2, 1)), np.zeros((1, 2)))
    observations[:] = 7.0
    assert (sequences.observations == 0).all()
    for array in (sequences.observations, sequences.lengths, sequences.terminated):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        sequences.rewards = np.ones((1, 2))
    with pytest.raises(TypeError):
        sequences.metadata["dt"] = 1.0


def test_masks_against_a_loop():
    sequences = example()
    for i, length in enumerate(sequences.lengths):
        for t in range(sequences.n_steps + 1):
            assert sequences.observation_mask[i, t] == (t <= length)
            if t < sequences.n_steps:
                assert sequences.step_mask[i, t] == (t < length)
    assert sequences.observation_mask.shape == (4, 8)
    assert sequences.step_mask.sum() == sequences.n_transitions == 11


def test_sizes_and_returns():
    sequences = example()
    assert (len(sequences), sequences.n_episodes, sequences.n_steps) == (4, 4, 7)
    assert (sequences.n_obs, sequences.n_act) == (3, 2)
    arrays, _ = example_arrays()
    np.testing.assert_allclose(
        sequences.returns, np.nansum(arrays["rewards"], axis=1), rtol=1e-14
    )  # rounding


def test_integers_and_lists_become_float():
    sequences = Sequences([[[1], [2]]], np.ones((1, 1, 1), dtype=np.int8), [[True]])
    assert sequences.observations.dtype == sequences.actions.dtype == sequences.rewards.dtype == np.float64
    assert sequences.lengths.tolist() == [1]
    assert not sequences.terminated.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"observations": np.zeros((2, 4))},
            r"observations: expected shape \(n_episodes, n_steps \+ 1, n_obs\).*\(2, 4\)",
        ),
        ({"observations": np.zeros((2, 0, 1))}, r"at least one row and one component, got \(2, 0, 1\)"),
        (
            {"observations": np.full((2, 4, 1), "a")},
            "observations: expected an array of real numbers, got dtype <U1",
        ),
        ({"observations": np.zeros((2, 4, 1), dtype=complex)}, "got dtype complex128"),
        ({"observations": [[[1.0]], [[1.0], [2.0]]]}, r"got a ragged list; .*Sequences\.from_episodes"),
        (
            {"actions": np.zeros((2, 4, 1))},
            r"actions: expected shape \(2, 3, n_act\), one row a step .*, got \(2, 4, 1\)",
        ),
        ({"actions": np.zeros((2, 3))}, r"actions: expected shape \(2, 3, n_act\).*got \(2, 3\)"),
        ({"actions": None}, r"actions: expected an array, got None; Sequences\.from_observations"),
        ({"rewards": np.zeros((2, 3, 1))}, r"rewards: expected shape \(2, 3\).*got \(2, 3, 1\)"),
        (
            {"states": np.zeros((2, 3, 1))},
            r"states: expected shape \(2, 4, n_state\), one row a step and one for the end",
        ),
        ({"hints": np.zeros((1, 4, 1))}, r"hints: expected shape \(2, 4, n_hint\)"),
        ({"action_log_probs": np.zeros((2, 4))}, r"action_log_probs: expected shape \(2, 3\)"),
        ({"lengths": [3]}, r"lengths: expected shape \(2,\), one for each episode, got \(1,\)"),
        ({"lengths": [3, 4]}, r"lengths: expected a whole number from 0 to 3 .* got 4 for episode 1"),
        ({"lengths": [-1, 3]}, "got -1 for episode 0"),
        ({"lengths": [3, 1.5]}, r"got 1\.5 for episode 1"),
        ({"lengths": [3, np.nan]}, "got nan for episode 1"),
        ({"lengths": [True, False]}, "lengths: expected whole numbers of steps, got dtype bool"),
        ({"terminated": [True]}, r"terminated: expected shape \(2,\)"),
        ({"terminated": [2, 0]}, "terminated: expected true or false"),
        (
            {"observation_names": "x"},
            r"observation_names: expected a sequence of names, got the string 'x'; write \('x',\)",
        ),
        (
            {"observation_names": ("x", "y")},
            "observation_names: expected 1 names, one for each component, got 2",
        ),
        ({"action_names": ("",)}, "action_names: expected non-empty strings"),
        ({"state_names": ("x",)}, "state_names: expected None because that array is absent"),
        (
            {"observations": np.zeros((2, 4, 2)), "observation_names": ("x", "x")},
            r"observation_names: expected each name once, got \['x'\] more than once",
        ),
        ({"metadata": [1]}, "metadata: expected a mapping of names to JSON values, got list"),
        ({"metadata": {1: 2}}, "metadata: expected string keys, got 1"),
        ({"metadata": {"env": object()}}, r"metadata\['env'\]: expected what JSON can hold .* got a object"),
    ],
)
def test_bad_input_says_what_was_expected_and_what_came(change, message):
    good = {"observations": np.zeros((2, 4, 1)), "actions": np.zeros((2, 3, 1)), "rewards": np.zeros((2, 3))}
    with pytest.raises(ValueError, match=message):
        Sequences(**{**good, **change})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_non_finite_number_inside_is_named(value):
    arrays, lengths = example_arrays()
    arrays["observations"][3, 6, 2] = value
    expected = (
        f"observations: expected finite numbers inside the episodes (steps 0 to 6 of episode 3), got {value} at "
        "episode 3, step 6, component 2 ('rate'); repair it, or end the episode before it (lengths[3])"
    )
    with pytest.raises(ValueError, match=re.escape(expected)):
        Sequences(**arrays, lengths=lengths, **NAMES)


def test_a_non_finite_reward_is_named_without_component():
    arrays, lengths = example_arrays()
    arrays["rewards"][0, 3] = np.nan
    with pytest.raises(
        ValueError, match=r"rewards: .*steps 0 to 3 of episode 0\), got nan at episode 0, step 3;"
    ):
        Sequences(**arrays, lengths=lengths)


def test_the_first_row_past_the_end_of_an_action_is_padding_but_of_an_observation_is_not():
    arrays, lengths = example_arrays(lengths=(2,), n_steps=3)
    arrays["actions"][0, 2] = np.nan
    Sequences(**arrays, lengths=lengths)
    arrays["observations"][0, 2] = np.nan
    with pytest.raises(ValueError, match="episode 0, step 2, component 0;"):
        Sequences(**arrays, lengths=lengths)


def test_from_episodes_is_the_padded_constructor():
    sequences = example()
    episodes = sequences.to_episodes()
    assert [len(e["observations"]) for e in episodes] == [5, 2, 1, 7]
    assert [len(e["action_log_probs"]) for e in episodes] == [4, 1, 0, 6]
    again = Sequences.from_episodes(episodes, metadata={"dt": 0.05}, **NAMES)
    assert again.n_steps == 6  # as wide as the longest, not as the original's padding
    assert again.equals(sequences)


def test_from_episodes_of_bare_observations_and_from_observations_agree():
    rng = np.random.default_rng(1)
    series = [rng.normal(size=(n, 2)) for n in (5, 1, 3)]
    listed = Sequences.from_episodes(series, observation_names=("x", "y"))
    padded = np.full((3, 5, 2), np.nan)
    for i, one in enumerate(series):
        padded[i, : len(one)] = one
    direct = Sequences.from_observations(padded, lengths=[4, 0, 2], observation_names=("x", "y"))
    assert listed.equals(direct)
    assert listed.n_act == 0
    assert listed.actions.shape == (3, 4, 0)
    assert (listed.rewards == 0).all()


def test_from_observations_takes_inputs_states_and_hints():
    recorded = Sequences.from_observations(
        np.ones((1, 3, 1)),
        actions=np.full((1, 2, 1), 2.0),
        states=np.full((1, 3, 1), 3.0),
        hints=np.full((1, 3, 1), 4.0),
        hint_names=("angle",),
    )
    assert [a.max() for a in (recorded.actions, recorded.states, recorded.hints)] == [2.0, 3.0, 4.0]
    assert recorded.hint_names == ("angle",)
    with pytest.raises(ValueError, match="observations: expected shape"):
        Sequences.from_observations(3.0)


def test_a_recording_of_one_observation():
    one = Sequences.from_episodes([np.ones((1, 2))])
    assert (one.n_steps, one.n_transitions) == (0, 0)
    assert one.lengths.tolist() == [0]
    assert len(one.transitions()) == 0


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "expected at least one episode, got none"),
        ([{"observation": 1}], r"episode 0: unknown key 'observation'; did you mean 'observations'\?"),
        ([{"actions": np.zeros((1, 1))}], r"episode 0: expected the keys \['actions', 'observations'\]"),
        (
            [{"observations": np.zeros((2, 1)), "rewards": [1.0]}, np.zeros((2, 1))],
            r"episode 1: expected the keys \['observations', 'rewards'\], as in episode 0, got \['observations'\]",
        ),
        (
            [np.zeros((2, 1)), np.zeros(4)],
            r"episode 1: expected observations of shape \(L \+ 1, n_obs\), got \(4,\); a series",
        ),
        ([np.zeros((0, 1))], r"episode 0: expected observations of shape \(L \+ 1, n_obs\), got \(0, 1\)"),
        (
            [np.zeros((2, 1)), np.zeros((2, 3))],
            "episode 1: expected 1 components of observations as in episode 0, got 3",
        ),
        (
            [{"observations": np.zeros((3, 1)), "actions": np.zeros((3, 1))}],
            r"episode 0: expected actions of shape \(2, n_act\) beside 3 observations, got \(3, 1\)",
        ),
        (
            [{"observations": np.zeros((3, 1)), "rewards": np.zeros((2, 1))}],
            r"expected rewards of shape \(2,\) beside 3 observations, got \(2, 1\)",
        ),
        (
            [{"observations": np.zeros((3, 1)), "states": np.zeros((2, 1))}],
            r"expected states of shape \(3, n_state\)",
        ),
        (
            [{"observations": np.zeros((2, 1)), "terminated": [True]}],
            r"episode 0: expected terminated to be true or false, got \[True\]",
        ),
        ([np.array([["a"]])], "episode 0: observations: expected an array of real numbers, got dtype <U1"),
    ],
)
def test_bad_episodes_are_named(episodes, message):
    with pytest.raises(ValueError, match=message):
        Sequences.from_episodes(episodes)


@pytest.mark.parametrize(
    ("index", "episodes"),
    [
        (1, [1]),
        (-1, [3]),
        (np.int64(2), [2]),
        (slice(1, 3), [1, 2]),
        (slice(None, None, -1), [3, 2, 1, 0]),
        ([2, 0, 0], [2, 0, 0]),
        (np.array([-2]), [2]),
        (np.array([True, False, False, True]), [0, 3]),
        ([], []),
        (np.zeros(4, dtype=bool), []),
    ],
)
def test_indexing_chooses_episodes(index, episodes):
    sequences = example()
    chosen = sequences[index]
    expected = sequences.to_episodes()
    assert len(chosen) == len(episodes)
    assert chosen.observation_names == sequences.observation_names
    assert dict(chosen.metadata) == {"dt": 0.05}
    assert not chosen.observations.flags.writeable
    assert chosen.observations.flags.c_contiguous
    for got, episode in zip(chosen.to_episodes(), episodes, strict=True):
        assert got.keys() == expected[episode].keys()
        for name, value in got.items():
            np.testing.assert_array_equal(value, expected[episode][name])


def test_iteration_gives_single_episodes():
    sequences = example()
    assert [episode.lengths.tolist() for episode in sequences] == [[4], [1], [0], [6]]
    assert Sequences.concatenate(sequences).equals(sequences)


@pytest.mark.parametrize(
    ("index", "message"),
    [
        (4, "expected an episode below 4, got 4"),
        ([0, -5], "expected an episode below 4, got -5"),
        (np.array([True]), r"bool mask of 4, got bool of shape \(1,\)"),
        (1.0, r"got float64 of shape \(\)"),
        (np.zeros((2, 2), dtype=int), r"got int64 of shape \(2, 2\)"),
        ("x", "expected an episode, a slice, a list of episodes or a bool mask"),
    ],
)
def test_bad_indices(index, message):
    with pytest.raises(IndexError, match=message):
        example()[index]


def test_concatenate_pads_to_the_longest_and_keeps_order():
    a, b = example(lengths=(2, 3), n_steps=3, seed=1), example(lengths=(5,), n_steps=9, seed=2)
    both = Sequences.concatenate([a, b])
    assert both.n_steps == 9
    assert both.lengths.tolist() == [2, 3, 5]
    for got, expected in zip(both.to_episodes(), a.to_episodes() + b.to_episodes(), strict=True):
        for name, value in expected.items():
            np.testing.assert_array_equal(got[name], value)
    assert (both.observations[~both.observation_mask] == 0).all()


def test_concatenate_keeps_the_metadata_on_which_all_agree():
    parts = [
        Sequences.from_observations(np.zeros((1, 2, 1)), metadata={"dt": 0.1, "seed": seed, **extra})
        for seed, extra in ((0, {"note": "a"}), (1, {}))
    ]
    assert dict(Sequences.concatenate(parts).metadata) == {"dt": 0.1}


def test_concatenate_refuses_what_does_not_fit():
    plain = Sequences.from_observations(np.zeros((1, 2, 1)))
    with pytest.raises(ValueError, match="expected at least one Sequences"):
        Sequences.concatenate([])
    with pytest.raises(
        ValueError, match=r"observations: expected as in part 0 \(1 components\), got 2 components in part 1"
    ):
        Sequences.concatenate([plain, Sequences.from_observations(np.zeros((1, 2, 2)))])
    with pytest.raises(
        ValueError, match=r"hints: expected as in part 0 \(absent\), got 3 components in part 1"
    ):
        Sequences.concatenate(
            [plain, Sequences.from_observations(np.zeros((1, 2, 1)), hints=np.zeros((1, 2, 3)))]
        )
    with pytest.raises(
        ValueError, match=r"observation_names: expected None as in part 0, got \('x',\) in part 1"
    ):
        Sequences.concatenate(
            [plain, Sequences.from_observations(np.zeros((1, 2, 1)), observation_names=("x",))]
        )
    logged = Sequences(
        np.zeros((1, 2, 1)), np.zeros((1, 1, 0)), np.zeros((1, 1)), action_log_probs=np.zeros((1, 1))
    )
    with pytest.raises(
        ValueError, match=r"action_log_probs: expected as in part 0 \(there\), got absent in part 2"
    ):
        Sequences.concatenate([logged, logged, plain])


def test_equals_sees_every_difference_but_not_the_padding():
    sequences = example()
    arrays, lengths = example_arrays()
    wide = {}
    for name, array in arrays.items():
        pad = [(0, 0)] * array.ndim
        pad[1] = (0, 5)
        wide[name] = np.pad(array, pad, constant_values=np.nan)
    fields = {"lengths": lengths, "terminated": sequences.terminated, "metadata": {"dt": 0.05}, **NAMES}
    assert Sequences(**wide, **fields).equals(sequences)
    for name, array in arrays.items():
        changed = array.copy()
        changed[1, 0] += 1e-12
        assert not Sequences(**{**arrays, name: changed}, **fields).equals(sequences), name
        if name not in ("observations", "actions", "rewards"):
            assert not Sequences(**{**arrays, name: None}, **fields).equals(sequences)
    assert not Sequences(**arrays, **{**fields, "terminated": ~sequences.terminated}).equals(sequences)
    assert not Sequences(**arrays, **{**fields, "lengths": [4, 1, 0, 5]}).equals(sequences)
    assert not Sequences(**arrays, **{**fields, "metadata": {}}).equals(sequences)
    assert not Sequences(**arrays, **{**fields, "action_names": None}).equals(sequences)
    assert not sequences.equals(sequences[:3])
    assert not sequences.equals("sequences")


def test_metadata_is_what_json_gives_back():
    metadata = {"dt": np.float64(0.5), "gains": np.arange(2), "shape": (1, 2), "nested": {"a": np.int64(3)}}
    sequences = Sequences.from_observations(np.zeros((1, 1, 1)), metadata=metadata)
    assert dict(sequences.metadata) == {"dt": 0.5, "gains": [0, 1], "shape": [1, 2], "nested": {"a": 3}}


def test_copies_and_pickles_stay_read_only_and_equal():
    sequences = example()
    for again in (
        pickle.loads(pickle.dumps(sequences)),
        copy.deepcopy(sequences),
        dataclasses.replace(sequences),
    ):
        assert again.equals(sequences)
        assert not again.observations.flags.writeable
        with pytest.raises(TypeError):
            again.metadata["dt"] = 1.0
    assert dataclasses.replace(sequences, metadata={}).metadata == {}


def test_repr_is_short_and_says_what_is_inside():
    assert repr(example()) == (
        "Sequences(4 episodes, 11 steps, lengths 0 to 6, 3 observations (cos, sin, rate), "
        "2 actions (torque, brake), 4 states, 1 hints, action_log_probs)"
    )
    plain = Sequences.from_observations(np.zeros((2, 3, 1)))
    assert repr(plain) == "Sequences(2 episodes, 4 steps, length 2, 1 observations, 0 actions)"
    assert repr(plain[[]]).startswith("Sequences(0 episodes, 0 steps")
