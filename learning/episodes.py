"""Between single episodes and padded arrays: padding, stacking and choosing them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.sequence_checks import ARRAYS, float_array, nearest

KEYS = (*ARRAYS, "terminated")


def pad_episodes(episodes: Iterable[ArrayLike | Mapping[str, Any]]) -> dict[str, Any]:
    """Padded arrays, `lengths` and `terminated` from unpadded episodes; see `Sequences.from_episodes`.

    Raises:
        ValueError: no episode, an unknown key, or an episode that disagrees with the first; names it.
    """
    mappings = [e if isinstance(e, Mapping) else {"observations": e} for e in episodes]
    if not mappings:
        raise ValueError("expected at least one episode, got none")
    kept = [_checked_episode(i, episode, mappings[0]) for i, episode in enumerate(mappings)]
    lengths = np.array([len(episode["observations"]) - 1 for episode in kept])
    fields: dict[str, Any] = {"lengths": lengths}
    for key, first in kept[0].items():
        if key == "terminated":
            fields[key] = np.array([episode[key] for episode in kept])
            continue
        fields[key] = np.zeros((len(kept), lengths.max() + ARRAYS[key].extra_row, *first.shape[1:]))
        for i, episode in enumerate(kept):
            if episode[key].shape[1:] != first.shape[1:]:
                raise ValueError(
                    f"episode {i}: expected {first.shape[1]} components of {key} as in episode 0, "
                    f"got {episode[key].shape[1]}"
                )
            fields[key][i, : len(episode[key])] = episode[key]
    return fields


def stack_padded(arrays: Sequence[NDArray[np.float64]], n_rows: int) -> NDArray[np.float64]:
    """Arrays (n_i, rows_i, ...) one after the other, each padded with zeros to n_rows rows."""
    stacked = np.zeros((sum(len(a) for a in arrays), n_rows, *arrays[0].shape[2:]))
    start = 0
    for array in arrays:
        stacked[start : start + len(array), : array.shape[1]] = array
        start += len(array)
    return stacked


def episode_index(index: Any, n_episodes: int) -> slice | NDArray[np.int64]:
    """An index of episodes as a slice, or as (k,) numbers from 0 to n_episodes - 1.

    Raises:
        IndexError: an episode that is not there, a mask of another length, or any other index.
    """
    if isinstance(index, slice):
        return index
    array = np.asarray(index)
    if array.shape == (0,) and array.dtype != np.bool_:
        array = array.astype(np.int64)
    if array.dtype == np.bool_ and array.shape == (n_episodes,):
        return np.flatnonzero(array)
    if array.dtype.kind not in "iu" or array.ndim > 1:
        raise IndexError(
            f"expected an episode, a slice, a list of episodes or a bool mask of {n_episodes}, "
            f"got {array.dtype} of shape {array.shape}"
        )
    array = np.atleast_1d(array).astype(np.int64)
    outside = (array < -n_episodes) | (array >= n_episodes)
    if outside.any():
        raise IndexError(f"expected an episode below {n_episodes}, got {array[outside][0]}")
    return np.where(array < 0, array + n_episodes, array)


def _checked_episode(i: int, episode: Mapping[str, Any], first: Mapping[str, Any]) -> dict[str, Any]:
    """One episode's float arrays and flag, with their shapes checked against its own observations."""
    for key in episode:
        if key not in KEYS:
            raise ValueError(
                f"episode {i}: unknown key {key!r}{nearest(str(key), KEYS)} (expected among {KEYS})"
            )
    if "observations" not in episode or set(episode) != set(first):
        raise ValueError(
            f"episode {i}: expected the keys {sorted({'observations', *first})}, as in episode 0, "
            f"got {sorted(episode)}"
        )
    checked: dict[str, Any] = {}
    for key, layout in ARRAYS.items():
        if key not in episode:
            continue
        array = float_array(f"episode {i}: {key}", episode[key])
        if key == "observations":
            if array.ndim != 2 or not len(array):
                raise ValueError(
                    f"episode {i}: expected observations of shape (L + 1, n_obs), got {array.shape}; a "
                    "series of one component has the shape (L + 1, 1)"
                )
        else:
            n_rows = len(checked["observations"]) - 1 + layout.extra_row
            if array.ndim != (1 if layout.size is None else 2) or len(array) != n_rows:
                shape = f"({n_rows}{f', {layout.size}' if layout.size else ','})"
                raise ValueError(
                    f"episode {i}: expected {key} of shape {shape} beside {len(checked['observations'])} "
                    f"observations, got {array.shape}"
                )
        checked[key] = array
    if "terminated" in episode:
        flag = np.asarray(episode["terminated"])
        if flag.ndim or flag.dtype.kind not in "biu" or flag not in (0, 1):
            raise ValueError(
                f"episode {i}: expected terminated to be true or false, got {episode['terminated']!r}"
            )
        checked["terminated"] = bool(flag)
    return checked
