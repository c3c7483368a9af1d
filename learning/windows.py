"""Windows, transitions and segments of episodes: which indices they take, and the arrays they give.

Observations x_0 .. x_L and actions a_0 .. a_{L-1} of an episode of length L, where a_s is taken at x_s and
leads to x_{s+1}. Nothing here reaches over an episode's end, and nothing loops over episodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Windows:
    """All windows of a batch of episodes, ordered by episode, then by time; see `Sequences.windows`.

    Attributes:
        past_observations: (m, past, n_obs) x_{t-past+1} .. x_t.
        past_actions: (m, past, n_act) a_{t-past+1} .. a_t.
        future_observations: (m, future, n_obs) x_{t+1} .. x_{t+future}.
        future_actions: (m, future, n_act) a_t .. a_{t+future-1}.
        episode: (m,) index of the episode.
        time: (m,) t, the step of the last past observation.
    """

    past_observations: NDArray[np.float64]
    past_actions: NDArray[np.float64]
    future_observations: NDArray[np.float64]
    future_actions: NDArray[np.float64]
    episode: NDArray[np.int64]
    time: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.episode)


@dataclass(frozen=True, eq=False)
class Transitions:
    """All steps of a batch of episodes, ordered by episode, then by time.

    Attributes:
        observations: (m, n_obs) x_t.
        actions: (m, n_act) a_t.
        rewards: (m,) r_t.
        next_observations: (m, n_obs) x_{t+1}.
        terminated: (m,) true where the step ended its episode by termination.
        episode: (m,) index of the episode.
        time: (m,) t.
    """

    observations: NDArray[np.float64]
    actions: NDArray[np.float64]
    rewards: NDArray[np.float64]
    next_observations: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    episode: NDArray[np.int64]
    time: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.episode)


def ragged_range(counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each i, counts[i] times i, and beside it 0 .. counts[i] - 1; both (sum of counts,)."""
    owner = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
    return owner, np.arange(len(owner), dtype=np.int64) - np.repeat(np.cumsum(counts) - counts, counts)


def cut_windows(
    observations: NDArray[np.float64],
    actions: NDArray[np.float64],
    lengths: NDArray[np.int64],
    past: int,
    future: int,
) -> Windows:
    """The windows at every time t with past - 1 <= t <= length - future; see `Sequences.windows`.

    Args:
        observations: (n_episodes, n_steps + 1, n_obs).
        actions: (n_episodes, n_steps, n_act).
        lengths: (n_episodes,) steps.
        past: observations of the past, the present one included; at least 1.
        future: observations of the future; at least 1.

    Raises:
        ValueError: past or future below 1, or no episode long enough for one window.
    """
    check_positive("past", past)
    check_positive("future", future)
    # Length L holds the times past - 1 .. L - future: L - future - past + 2 of them.
    episode, offset = ragged_range(np.maximum(lengths - (past + future - 2), 0))
    if not len(episode):
        longest = int(lengths.max(initial=0))
        raise ValueError(
            f"expected an episode of at least {past + future - 1} steps for a window of {past} past and "
            f"{future} future observations, got {len(lengths)} episodes of at most {longest} steps; shorten "
            "the window"
        )
    time = offset + (past - 1)
    row = episode[:, None]
    back = time[:, None] + np.arange(1 - past, 1)
    ahead = time[:, None] + np.arange(future)
    return Windows(
        past_observations=observations[row, back],
        past_actions=actions[row, back],
        future_observations=observations[row, ahead + 1],
        future_actions=actions[row, ahead],
        episode=episode,
        time=time,
    )


def segment_index(
    lengths: NDArray[np.int64], horizon: int, stride: int, keep_tail: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Episode, first step and length of every segment; see `Sequences.segments`.

    Raises:
        ValueError: horizon or stride below 1, or no segment at all.
    """
    check_positive("horizon", horizon)
    check_positive("stride", stride)
    n_full = np.maximum(lengths - horizon + stride, 0) // stride
    covered = np.where(n_full > 0, (n_full - 1) * stride + horizon, 0)
    tail_start = n_full * stride
    has_tail = keep_tail & (covered < lengths) & (tail_start < lengths)
    episode, number = ragged_range(n_full + has_tail)
    if not len(episode):
        longest = int(lengths.max(initial=0))
        raise ValueError(
            f"expected an episode of at least {horizon} steps to cut a segment from, got {len(lengths)} "
            f"episodes of at most {longest} steps; lower the horizon or pass keep_tail=True"
        )
    start = number * stride
    return episode, start, np.minimum(lengths[episode] - start, horizon)


def check_positive(name: str, value: int) -> None:
    """Raise unless value is a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"expected {name} to be a whole number of at least 1, got {value!r}")
