"""The last observations as one: times, names, ends and errors."""

import numpy as np
import pytest

from beliefgym.learning import DataAsDemonstrator, Ridge, Sequences, delay_embedding


@pytest.fixture
def sequences():
    time = np.arange(8.0)
    observations = np.stack([np.stack([10 * e + time, -time], axis=1) for e in (1, 2, 3)])
    return Sequences(
        observations,
        time[None, :7, None] + np.zeros((3, 1, 1)),
        time[None, :7] + np.zeros((3, 1)),
        lengths=[7, 4, 2],
        terminated=[True, False, True],
        states=observations[:, :, :1],
        observation_names=("x", "y"),
    )


def test_each_observation_stands_before_its_past(sequences):
    embedded = delay_embedding(sequences, 3)
    assert embedded.observation_names == ("x", "y", "x[-1]", "y[-1]", "x[-2]", "y[-2]")
    np.testing.assert_array_equal(embedded.lengths, [5, 2, 0])
    np.testing.assert_array_equal(embedded.observations[0, 0], [12, -2, 11, -1, 10, 0])
    np.testing.assert_array_equal(embedded.observations[1, 2], [24, -4, 23, -3, 22, -2])
    assert not embedded.observations[1, 3:].any()  # padding
    # the action of a row is still the one taken at its newest observation, and the state the one of that time
    np.testing.assert_array_equal(embedded.actions[0, :, 0], np.arange(2.0, 7.0))
    np.testing.assert_array_equal(embedded.rewards[1, :2], [2.0, 3.0])
    np.testing.assert_array_equal(embedded.states[0, 0], [12.0])
    np.testing.assert_array_equal(embedded.terminated, sequences.terminated)


def test_one_delay_changes_nothing(sequences):
    assert delay_embedding(sequences, 1) is sequences


def test_positions_alone_become_predictable():
    """A harmonic motion seen by position obeys x_{t+1} = 2 cos(w) x_t - x_{t-1}: exact with two delays only."""
    phase = np.random.default_rng(0).uniform(0, 6.28, (20, 1))
    seen = Sequences.from_observations(np.sin(0.3 * np.arange(41) + phase)[:, :, None])
    errors = []
    for k in (1, 2):
        embedded = delay_embedding(seen, k)
        model = DataAsDemonstrator(Ridge(alpha=0.0), n_iterations=0).fit(embedded[:15])
        errors.append(model.errors(embedded[15:]).mean)
    assert errors[0] > 0.5
    assert errors[1] < 1e-10  # 40 steps of rounding


def test_what_cannot_be_embedded_is_told(sequences):
    with pytest.raises(
        ValueError, match="at least 3 steps for 4 delays, got 1 shorter ones, the first episode 2 of 2"
    ):
        delay_embedding(sequences, 4)
    with pytest.raises(ValueError, match="expected n_delays to be a whole number of at least 1, got 0"):
        delay_embedding(sequences, 0)
