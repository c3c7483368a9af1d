"""The checks at the door of `Sequences`: shapes, lengths, finiteness, names and metadata.

Everything past the end of an episode is set to zero here, whatever stood there, so that no later code meets
it; everything inside is a finite float64, or the first one that is not is named: array, episode, step and
component.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ArrayLayout:
    """The shape of one array of `Sequences`.

    Args:
        extra_row: 1 where the array has a row for the end of the episode too (observations), 0 for one a
            step.
        size: the name of the component axis ("n_obs"), or None where there is none (rewards).
        names_field: the field that names the components.
    """

    extra_row: int
    size: str | None
    names_field: str | None = None

    def shape_text(self, n_episodes: int, n_steps: int) -> str:
        """The expected shape, as an error message writes it."""
        return f"({n_episodes}, {n_steps + self.extra_row}{f', {self.size}' if self.size else ''})"


ARRAYS: dict[str, ArrayLayout] = {
    "observations": ArrayLayout(1, "n_obs", "observation_names"),
    "actions": ArrayLayout(0, "n_act", "action_names"),
    "rewards": ArrayLayout(0, None),
    "states": ArrayLayout(1, "n_state", "state_names"),
    "hints": ArrayLayout(1, "n_hint", "hint_names"),
    "action_log_probs": ArrayLayout(0, None),
}
"""Every array of `Sequences`, in the order in which it is written."""

NAMES_FIELDS = tuple(layout.names_field for layout in ARRAYS.values() if layout.names_field)


def row_mask(lengths: NDArray[np.int64], n_rows: int, extra_row: int) -> NDArray[np.bool_]:
    """(n_episodes, n_rows): which rows lie inside their episode."""
    return np.arange(n_rows) < lengths[:, None] + extra_row


def float_array(what: str, value: Any) -> NDArray[np.float64]:
    """A C-contiguous float64 copy of an array of real numbers.

    Raises:
        ValueError: ragged lists, text, complex numbers or objects.
    """
    advice = (
        "pass numbers in one rectangular array; episodes of different lengths go to Sequences.from_episodes"
    )
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{what}: expected an array of real numbers, got a ragged list; {advice}") from error
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{what}: expected an array of real numbers, got dtype {array.dtype}; {advice}")
    return np.array(array, dtype=np.float64, order="C", copy=True)


def check_shape(name: str, array: NDArray[np.float64], n_episodes: int, n_steps: int) -> None:
    """Raise unless the array has the shape that `n_episodes` and `n_steps` ask for."""
    layout = ARRAYS[name]
    expected = (n_episodes, n_steps + layout.extra_row)
    if array.shape[:2] != expected or array.ndim != (2 if layout.size is None else 3):
        because = "one row a step and one for the end" if layout.extra_row else "one row a step"
        raise ValueError(
            f"{name}: expected shape {layout.shape_text(n_episodes, n_steps)}, {because} "
            f"(the observations say {n_episodes} episodes of at most {n_steps} steps), got {array.shape}"
        )


def checked_lengths(lengths: Any, n_episodes: int, n_steps: int) -> NDArray[np.int64]:
    """(n_episodes,) lengths as int64; None means that every episode has n_steps steps.

    Raises:
        ValueError: another shape, a fraction, or a length outside 0..n_steps.
    """
    if lengths is None:
        return np.full(n_episodes, n_steps, dtype=np.int64)
    array = np.asarray(lengths)
    if array.shape != (n_episodes,):
        raise ValueError(f"lengths: expected shape ({n_episodes},), one for each episode, got {array.shape}")
    if n_episodes and array.dtype.kind not in "iuf":
        raise ValueError(f"lengths: expected whole numbers of steps, got dtype {array.dtype}")
    array = np.asarray(array, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        bad = ~((array == np.floor(array)) & (array >= 0) & (array <= n_steps))
    if bad.any():
        episode = int(np.argmax(bad))
        raise ValueError(
            f"lengths: expected a whole number from 0 to {n_steps} (steps, one fewer than observations), "
            f"got {array[episode]:g} for episode {episode}"
        )
    return array.astype(np.int64)


def checked_terminated(terminated: Any, n_episodes: int) -> NDArray[np.bool_]:
    """(n_episodes,) flags as bool; None means that no episode terminated.

    Raises:
        ValueError: another shape, or values that are not true or false.
    """
    if terminated is None:
        return np.zeros(n_episodes, dtype=np.bool_)
    array = np.asarray(terminated)
    if array.shape != (n_episodes,):
        raise ValueError(
            f"terminated: expected shape ({n_episodes},), one for each episode, got {array.shape}"
        )
    if array.dtype != np.bool_ and not np.isin(array, (0, 1)).all():
        raise ValueError("terminated: expected true or false for each episode, got other values")
    return array.astype(np.bool_)


def clear_padding_and_check_finite(
    name: str, array: NDArray[np.float64], lengths: NDArray[np.int64], names: tuple[str, ...] | None
) -> None:
    """Set what lies past each episode's end to zero, in place, and see that the rest is finite.

    Raises:
        ValueError: a NaN or infinite number inside an episode; names the first.
    """
    layout = ARRAYS[name]
    array[~row_mask(lengths, array.shape[1], layout.extra_row)] = 0.0
    if np.isfinite(array).all():
        return
    episode, step, *component = (int(i) for i in np.argwhere(~np.isfinite(array))[0])
    where = f"episode {episode}, step {step}"
    if component:
        where += f", component {component[0]}" + (f" ({names[component[0]]!r})" if names else "")
    last = lengths[episode] - 1 + layout.extra_row
    raise ValueError(
        f"{name}: expected finite numbers inside the episodes (steps 0 to {last} of episode {episode}), "
        f"got {array[(episode, step, *component)]} at {where}; repair it, or end the episode before it "
        f"(lengths[{episode}])"
    )


def checked_names(field: str, names: Sequence[str] | None, size: int | None) -> tuple[str, ...] | None:
    """Component names as a tuple.

    Raises:
        ValueError: not one name for each component, an empty or repeated one, or names of an absent array.
    """
    if names is None:
        return None
    if isinstance(names, str):
        raise ValueError(
            f"{field}: expected a sequence of names, got the string {names!r}; write ({names!r},)"
        )
    names = tuple(names)
    if size is None:
        raise ValueError(f"{field}: expected None because that array is absent, got {names}")
    if len(names) != size:
        raise ValueError(f"{field}: expected {size} names, one for each component, got {len(names)}: {names}")
    if not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"{field}: expected non-empty strings, got {names}")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{field}: expected each name once, got {repeated} more than once")
    return tuple(str(name) for name in names)


def checked_metadata(metadata: Mapping[str, Any] | None) -> dict[str, Any]:
    """Metadata as JSON gives it back: tuples become lists, numpy numbers and arrays plain ones.

    Raises:
        ValueError: not a mapping, a key that is not a string, or a value that JSON cannot hold.
    """
    if metadata is None:
        return {}
    if not isinstance(metadata, Mapping):
        raise ValueError(
            f"metadata: expected a mapping of names to JSON values, got {type(metadata).__name__}"
        )
    plain: dict[str, Any] = {}
    for key, value in metadata.items():
        if not isinstance(key, str):
            raise ValueError(f"metadata: expected string keys, got {key!r}")
        try:
            plain[key] = json.loads(json.dumps(value, default=_plain))
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"metadata[{key!r}]: expected what JSON can hold (numbers, strings, lists, mappings), got "
                f"{error}"
            ) from error
    return plain


def nearest(name: str, known: Sequence[str]) -> str:
    """`; did you mean 'x'?` where a known name is close, otherwise an empty text."""
    match = get_close_matches(name, known, n=1)
    return f"; did you mean {match[0]!r}?" if match else ""


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"a {type(value).__name__}")
