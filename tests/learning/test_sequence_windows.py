"""Windows, transitions and segments against plain loops over episodes and times."""

import numpy as np
import pytest

from beliefgym.learning import Sequences

LENGTHS = (4, 1, 0, 6, 3)


def coded(lengths=LENGTHS, n_steps=7):
    """Every number says where it stands: observation = 100 episode + t, action the same + 0.5, reward + 0.25."""
    n = len(lengths)
    code = 100.0 * np.arange(n)[:, None] + np.arange(n_steps + 1)
    steps = code[:, :-1]
    return Sequences(
        np.stack([code, -code], axis=2),
        steps[:, :, None] + 0.5,
        steps + 0.25,
        lengths=lengths,
        terminated=np.arange(n) % 2 == 0,
        states=code[:, :, None] + 0.75,
        hints=code[:, :, None] + 0.125,
        action_log_probs=-steps,
        observation_names=("x", "y"),
        metadata={"dt": 0.1},
    )


def loop_windows(sequences, past, future):
    """The definition, word by word: all t whose past and future observations both lie inside the episode."""
    rows = []
    for i, episode in enumerate(sequences.to_episodes()):
        x, a = episode["observations"], episode["actions"]
        for t in range(len(x)):
            if t - past + 1 >= 0 and t + future <= len(x) - 1:
                rows.append(
                    (
                        x[t - past + 1 : t + 1],
                        a[t - past + 1 : t + 1],
                        x[t + 1 : t + future + 1],
                        a[t : t + future],
                        i,
                        t,
                    )
                )
    return rows


@pytest.mark.parametrize(("past", "future"), [(1, 1), (2, 1), (1, 3), (3, 2), (6, 1), (1, 6)])
def test_windows_are_the_loops(past, future):
    sequences = coded()
    windows = sequences.windows(past, future)
    expected = loop_windows(sequences, past, future)
    assert len(windows) == len(expected) > 0
    fields = ("past_observations", "past_actions", "future_observations", "future_actions", "episode", "time")
    for field, values in zip(fields, zip(*expected, strict=True), strict=True):
        np.testing.assert_array_equal(getattr(windows, field), np.stack(values), err_msg=field)
    assert windows.past_observations.shape == (len(expected), past, 2)
    assert windows.future_actions.shape == (len(expected), future, 1)


def test_windows_are_aligned_as_said():
    windows = coded().windows(3, 2)
    code = 100.0 * windows.episode + windows.time
    np.testing.assert_array_equal(windows.past_observations[:, -1, 0], code)
    np.testing.assert_array_equal(windows.future_observations[:, 0, 0], code + 1)
    np.testing.assert_array_equal(windows.past_actions[:, -1], windows.future_actions[:, 0])
    np.testing.assert_array_equal(windows.future_actions[:, :, 0] + 0.5, windows.future_observations[:, :, 0])


def test_windows_of_one_and_one_are_the_transitions():
    sequences = coded()
    windows, transitions = sequences.windows(1, 1), sequences.transitions()
    np.testing.assert_array_equal(windows.past_observations[:, 0], transitions.observations)
    np.testing.assert_array_equal(windows.future_observations[:, 0], transitions.next_observations)
    np.testing.assert_array_equal(windows.future_actions[:, 0], transitions.actions)


def test_other_arrays_follow_by_index():
    sequences = coded()
    windows = sequences.windows(2, 2)
    np.testing.assert_array_equal(
        sequences.hints[windows.episode, windows.time, 0], windows.past_observations[:, -1, 0] + 0.125
    )


def test_windows_without_actions():
    windows = Sequences.from_observations(np.arange(5.0).reshape(1, 5, 1)).windows(2, 1)
    assert windows.past_actions.shape == (3, 2, 0)
    assert windows.past_observations[:, :, 0].tolist() == [[0, 1], [1, 2], [2, 3]]


def test_too_long_windows_and_bad_sizes():
    sequences = coded()
    message = (
        r"expected an episode of at least 7 steps for a window of 4 past and 4 future observations, got 5 episodes of "
        r"at most 6 steps; shorten the window"
    )
    with pytest.raises(ValueError, match=message):
        sequences.windows(4, 4)
    with pytest.raises(ValueError, match="got 0 episodes of at most 0 steps"):
        sequences[[]].windows(1, 1)
    with pytest.raises(ValueError, match="expected past to be a whole number of at least 1, got 0"):
        sequences.windows(0, 1)
    with pytest.raises(ValueError, match=r"expected future to be a whole number of at least 1, got 1\.5"):
        sequences.windows(1, 1.5)


def test_transitions_are_the_loops():
    sequences = coded()
    transitions = sequences.transitions()
    rows = [
        (e["observations"][t], e["actions"][t], e["rewards"][t], e["observations"][t + 1], i, t)
        for i, e in enumerate(sequences.to_episodes())
        for t in range(len(e["actions"]))
    ]
    fields = ("observations", "actions", "rewards", "next_observations", "episode", "time")
    for field, values in zip(fields, zip(*rows, strict=True), strict=True):
        np.testing.assert_array_equal(getattr(transitions, field), np.stack(values), err_msg=field)
    assert len(transitions) == sequences.n_transitions == 14
    ends = [(0, 3), (4, 2)]  # last steps of the terminated episodes 0 and 4; episode 2 has no step
    got = list(
        zip(
            transitions.episode[transitions.terminated], transitions.time[transitions.terminated], strict=True
        )
    )
    assert got == ends


def loop_segments(lengths, horizon, stride, keep_tail):
    pieces = []
    for i, length in enumerate(lengths):
        start, covered = 0, 0
        while start + horizon <= length:
            pieces.append((i, start, horizon))
            covered = start + horizon
            start += stride
        if keep_tail and start < length and covered < length:
            pieces.append((i, start, length - start))
    return pieces


@pytest.mark.parametrize("keep_tail", [False, True])
@pytest.mark.parametrize(
    ("horizon", "stride"), [(1, 1), (2, 2), (2, 1), (3, 2), (3, None), (2, 4), (6, 1), (4, 9)]
)
def test_segments_are_the_loops(horizon, stride, keep_tail):
    sequences = coded()
    pieces = sequences.segments(horizon, stride, keep_tail=keep_tail)
    expected = loop_segments(LENGTHS, horizon, horizon if stride is None else stride, keep_tail)
    assert pieces.n_steps == horizon
    assert pieces.lengths.tolist() == [length for _, _, length in expected]
    episodes = sequences.to_episodes()
    for got, (i, start, length) in zip(pieces.to_episodes(), expected, strict=True):
        for name, value in episodes[i].items():
            if name == "terminated":
                assert got[name] == (value and start + length == LENGTHS[i])
            else:
                extra = len(value) - LENGTHS[i]
                np.testing.assert_array_equal(got[name], value[start : start + length + extra])
    assert (pieces.observations[~pieces.observation_mask] == 0).all()
    assert (pieces.action_log_probs[~pieces.step_mask] == 0).all()
    assert pieces.observation_names == ("x", "y")
    assert dict(pieces.metadata) == {"dt": 0.1}


def test_without_overlap_the_pieces_and_tails_hold_every_step_once():
    sequences = coded()
    pieces = sequences.segments(4, keep_tail=True)
    assert pieces.n_transitions == sequences.n_transitions
    np.testing.assert_array_equal(pieces.transitions().rewards, sequences.transitions().rewards)


def test_a_horizon_longer_than_the_arrays():
    sequences = coded(lengths=(2,), n_steps=2)
    pieces = sequences.segments(5, keep_tail=True)
    assert pieces.observations.shape == (1, 6, 2)
    assert pieces.equals(sequences)
    assert (pieces.observations[0, 3:] == 0).all()
    assert (pieces.rewards[0, 2:] == 0).all()


def test_bad_segments():
    with pytest.raises(
        ValueError, match=r"at least 7 steps to cut a segment from, got 5 episodes of at most 6 steps; lower"
    ):
        coded().segments(7)
    with pytest.raises(ValueError, match="expected horizon to be a whole number of at least 1, got 0"):
        coded().segments(0)
    with pytest.raises(ValueError, match="expected stride to be a whole number of at least 1, got -1"):
        coded().segments(2, -1)
    with pytest.raises(ValueError, match="pass keep_tail=True"):
        Sequences.from_episodes([np.ones((1, 1))]).segments(1, keep_tail=True)
