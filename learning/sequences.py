"""`Sequences`: a batch of trajectories, the one form of data that every learner takes.

An episode of length L holds observations x_0 .. x_L, actions a_0 .. a_{L-1} and rewards r_0 .. r_{L-1}: a_t
is taken at x_t, gives r_t and leads to x_{t+1}. Episodes of different lengths stand in one array, padded with
zeros; `lengths` says where each ends. An episode of length 0 is a single observation from which no step was
taken: it has no transition, no window and no segment.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning import sequence_checks as checks
from beliefgym.learning.episodes import episode_index, pad_episodes, stack_padded
from beliefgym.learning.sequence_checks import ARRAYS, NAMES_FIELDS
from beliefgym.learning.splits import fold_indices, split_indices
from beliefgym.learning.windows import Transitions, Windows, cut_windows, segment_index

Array = NDArray[np.float64]


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Sequences:
    """A batch of episodes, checked once and read-only.

    Every array is copied to float64; what lies past an episode's end is set to 0, whatever stood there.

    Args:
        observations: (n_episodes, n_steps + 1, n_obs), SI units and radians.
        actions: (n_episodes, n_steps, n_act); n_act may be 0.
        rewards: (n_episodes, n_steps).
        lengths: (n_episodes,) steps (= actions) of each episode, 0 to n_steps; all n_steps by default.
        terminated: (n_episodes,) true where the last step reached a terminal state; the others were cut off
            (truncated). All false by default.
        states: (n_episodes, n_steps + 1, n_state) true states, where known.
        hints: (n_episodes, n_steps + 1, n_hint) privileged quantities for training only.
        action_log_probs: (n_episodes, n_steps) log density (or probability) of each action when it was drawn.
        observation_names, action_names, state_names, hint_names: a name for each component.
        metadata: where the data comes from (environment, seed, dt); anything JSON can hold.

    Raises:
        ValueError: shapes that disagree, lengths out of range, or a NaN or infinite number inside an episode;
            the message names the array, episode, step and component.
    """

    observations: Array
    actions: Array
    rewards: Array
    lengths: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    states: Array | None
    hints: Array | None
    action_log_probs: Array | None
    observation_names: tuple[str, ...] | None
    action_names: tuple[str, ...] | None
    state_names: tuple[str, ...] | None
    hint_names: tuple[str, ...] | None
    metadata: Mapping[str, Any]

    def __init__(
        self,
        observations: ArrayLike,
        actions: ArrayLike,
        rewards: ArrayLike,
        *,
        lengths: ArrayLike | None = None,
        terminated: ArrayLike | None = None,
        states: ArrayLike | None = None,
        hints: ArrayLike | None = None,
        action_log_probs: ArrayLike | None = None,
        observation_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        state_names: Sequence[str] | None = None,
        hint_names: Sequence[str] | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        first = checks.float_array("observations", observations)
        if first.ndim != 3 or first.shape[1] == 0 or first.shape[2] == 0:
            raise ValueError(
                "observations: expected shape (n_episodes, n_steps + 1, n_obs) with at least one row and one "
                f"component, got {first.shape}"
            )
        n_episodes, n_steps = first.shape[0], first.shape[1] - 1
        given = {"actions": actions, "rewards": rewards, "states": states, "hints": hints}
        given["action_log_probs"] = action_log_probs
        arrays: dict[str, Any] = {"observations": first}
        for name, value in given.items():
            if value is None and name in ("actions", "rewards"):
                raise ValueError(
                    f"{name}: expected an array, got None; Sequences.from_observations does without"
                )
            arrays[name] = None if value is None else checks.float_array(name, value)
            if arrays[name] is not None:
                checks.check_shape(name, arrays[name], n_episodes, n_steps)
        checked_lengths = checks.checked_lengths(lengths, n_episodes, n_steps)
        names: dict[str, Any] = dict(
            zip(NAMES_FIELDS, (observation_names, action_names, state_names, hint_names), strict=True)
        )
        for name, array in arrays.items():
            names_field = ARRAYS[name].names_field
            if names_field:
                size = None if array is None else array.shape[2]
                names[names_field] = checks.checked_names(names_field, names[names_field], size)
            if array is not None:
                own = names[names_field] if names_field else None
                checks.clear_padding_and_check_finite(name, array, checked_lengths, own)
        self._set(
            {
                **arrays,
                **names,
                "lengths": checked_lengths,
                "terminated": checks.checked_terminated(terminated, n_episodes),
                "metadata": checks.checked_metadata(metadata),
            }
        )

    @classmethod
    def from_observations(
        cls,
        observations: ArrayLike,
        *,
        actions: ArrayLike | None = None,
        lengths: ArrayLike | None = None,
        states: ArrayLike | None = None,
        hints: ArrayLike | None = None,
        observation_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        state_names: Sequence[str] | None = None,
        hint_names: Sequence[str] | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> Sequences:
        """Recorded series without rewards, and without actions unless given (then n_act = 0).

        Args:
            observations: (n_episodes, n_steps + 1, n_obs), padded.
            actions: (n_episodes, n_steps, n_act), where the recording has inputs.
            lengths: (n_episodes,) steps: one fewer than the observations of each series.

        The other arguments are those of the constructor. Rewards are zeros.
        """
        shape = (*np.shape(observations), 0, 0)
        n_episodes, n_steps = shape[0], max(shape[1] - 1, 0)
        return cls(
            observations,
            np.zeros((n_episodes, n_steps, 0)) if actions is None else actions,
            np.zeros((n_episodes, n_steps)),
            lengths=lengths,
            states=states,
            hints=hints,
            observation_names=observation_names,
            action_names=action_names,
            state_names=state_names,
            hint_names=hint_names,
            metadata=metadata,
        )

    @classmethod
    def from_episodes(
        cls,
        episodes: Iterable[ArrayLike | Mapping[str, Any]],
        *,
        observation_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        state_names: Sequence[str] | None = None,
        hint_names: Sequence[str] | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> Sequences:
        """Episodes of any lengths, one after the other.

        Args:
            episodes: for each episode either its observations (L + 1, n_obs), or a mapping with
                "observations" and, the same in every episode, any of "actions" (L, n_act), "rewards" (L,),
                "states" (L + 1, n_state), "hints" (L + 1, n_hint), "action_log_probs" (L,) and "terminated"
                (one flag). Without actions n_act = 0, without rewards they are zeros.

        The other arguments are those of the constructor.

        Raises:
            ValueError: no episode, an unknown key, or an episode that disagrees with the first; names it.
        """
        fields = pad_episodes(episodes)
        n_episodes, n_rows, _ = fields["observations"].shape
        fields.setdefault("actions", np.zeros((n_episodes, n_rows - 1, 0)))
        fields.setdefault("rewards", np.zeros((n_episodes, n_rows - 1)))
        return cls(
            **fields,
            observation_names=observation_names,
            action_names=action_names,
            state_names=state_names,
            hint_names=hint_names,
            metadata=metadata,
        )

    @classmethod
    def concatenate(cls, parts: Iterable[Sequences]) -> Sequences:
        """The episodes of several batches in one, in order, padded to the longest.

        The metadata keeps the entries on which all parts agree.

        Raises:
            ValueError: no part, or parts with other components, names or optional arrays than the first.
        """
        parts = list(parts)
        if not parts:
            raise ValueError("expected at least one Sequences to concatenate, got none")
        first, n_steps = parts[0], max(part.n_steps for part in parts)
        for number, part in enumerate(parts[1:], start=1):
            for name, array in part._arrays().items():
                other = getattr(first, name)
                sizes = [None if a is None else a.shape[2:] for a in (other, array)]
                if sizes[0] != sizes[1]:
                    told = ["absent" if s is None else f"{s[0]} components" if s else "there" for s in sizes]
                    raise ValueError(
                        f"{name}: expected as in part 0 ({told[0]}), got {told[1]} in part {number}"
                    )
            for field in NAMES_FIELDS:
                if getattr(part, field) != getattr(first, field):
                    raise ValueError(
                        f"{field}: expected {getattr(first, field)} as in part 0, "
                        f"got {getattr(part, field)} in part {number}"
                    )
        fields: dict[str, Any] = {field: getattr(first, field) for field in NAMES_FIELDS}
        for name, layout in ARRAYS.items():
            arrays = [getattr(part, name) for part in parts]
            fields[name] = None if arrays[0] is None else stack_padded(arrays, n_steps + layout.extra_row)
        fields["lengths"] = np.concatenate([part.lengths for part in parts])
        fields["terminated"] = np.concatenate([part.terminated for part in parts])
        fields["metadata"] = {
            key: value
            for key, value in first.metadata.items()
            if all(key in part.metadata and _same_json(part.metadata[key], value) for part in parts)
        }
        return cls._from_checked(fields)

    @classmethod
    def load_npz(cls, path: str | os.PathLike[str]) -> Sequences:
        """Read what `save_npz` wrote; see `beliefgym.learning.sequences_npz`."""
        from beliefgym.learning.sequences_npz import load_npz

        return load_npz(path)

    def save_npz(self, path: str | os.PathLike[str]) -> Path:
        """Write to one .npz file, atomically; see `beliefgym.learning.sequences_npz`."""
        from beliefgym.learning.sequences_npz import save_npz

        return save_npz(self, path)

    @property
    def n_episodes(self) -> int:
        """Number of episodes, also `len(sequences)`."""
        return self.observations.shape[0]

    @property
    def n_steps(self) -> int:
        """Steps of the padded arrays: at least the longest episode's."""
        return self.actions.shape[1]

    @property
    def n_obs(self) -> int:
        """Components of an observation."""
        return self.observations.shape[2]

    @property
    def n_act(self) -> int:
        """Components of an action; 0 for recordings without any."""
        return self.actions.shape[2]

    @property
    def n_transitions(self) -> int:
        """Steps of all episodes together."""
        return int(self.lengths.sum())

    @property
    def returns(self) -> Array:
        """(n_episodes,) sum of each episode's rewards."""
        return self.rewards.sum(axis=1)

    @property
    def observation_mask(self) -> NDArray[np.bool_]:
        """(n_episodes, n_steps + 1): which observations (states, hints) lie inside their episode."""
        return checks.row_mask(self.lengths, self.n_steps + 1, 1)

    @property
    def step_mask(self) -> NDArray[np.bool_]:
        """(n_episodes, n_steps): which actions (rewards, log probabilities) lie inside their episode."""
        return checks.row_mask(self.lengths, self.n_steps, 0)

    def __len__(self) -> int:
        return self.n_episodes

    def __iter__(self) -> Iterator[Sequences]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int | slice | ArrayLike) -> Sequences:
        """The chosen episodes as a `Sequences`, padded as before.

        Args:
            index: an episode, a slice, (k,) episodes in any order, or a (n_episodes,) bool mask.

        Raises:
            IndexError: an episode that is not there, a mask of another length, or any other index.
        """
        chosen = episode_index(index, len(self))
        fields = {name: None if a is None else a[chosen] for name, a in self._arrays().items()}
        return self._from_checked(
            {
                **self._others(),
                **fields,
                "lengths": self.lengths[chosen],
                "terminated": self.terminated[chosen],
            }
        )

    def windows(self, past: int, future: int) -> Windows:
        """Every window of `past` observations up to a time t and the `future` observations after it.

        With x_0 .. x_L and a_0 .. a_{L-1} (a_s is taken at x_s and leads to x_{s+1}), for each episode and
        each t with past - 1 <= t <= L - future:

            past_observations   x_{t-past+1} .. x_t        past_actions    a_{t-past+1} .. a_t
            future_observations x_{t+1} .. x_{t+future}    future_actions  a_t .. a_{t+future-1}

        The future is x_{t+1:t+k}, of which the predictive state after seeing x_t is built (Venkatraman,
        thesis proposal, Sec. 3.3, and Eq. 3.36; there f_{t+1}). Row j of the past actions was taken at row j
        of the past observations; row j of the future actions leads to row j of the future observations. The
        action a_t therefore stands in both: a belief that an agent acts on does not know it yet, and is built
        from `past_actions[:, :-1]`; a one-step regression of x_{t+1} takes all of them. An episode shorter
        than past + future - 1 gives no window, and `windows(1, 1)` gives every transition.

        Other arrays follow by index: `sequences.hints[w.episode, w.time]`.

        Raises:
            ValueError: past or future below 1, or not one window in all episodes.
        """
        return cut_windows(self.observations, self.actions, self.lengths, past, future)

    def transitions(self) -> Transitions:
        """Every step (x_t, a_t, r_t, x_{t+1}) of every episode, flat; none for episodes of length 0."""
        episode, time = np.nonzero(self.step_mask)
        return Transitions(
            observations=self.observations[episode, time],
            actions=self.actions[episode, time],
            rewards=self.rewards[episode, time],
            next_observations=self.observations[episode, time + 1],
            terminated=self.terminated[episode] & (time + 1 == self.lengths[episode]),
            episode=episode,
            time=time,
        )

    def segments(self, horizon: int, stride: int | None = None, *, keep_tail: bool = False) -> Sequences:
        """Pieces of `horizon` steps, each as an episode of its own, ordered by episode, then by time.

        Pieces start at steps 0, stride, 2 stride, ... A piece is `terminated` where it ends with the last
        step of a terminated episode. Split into training and test data before cutting: pieces of one episode
        are alike.

        Args:
            horizon: steps of a piece (it has horizon + 1 observations).
            stride: steps between starts; `horizon` by default, so that pieces share no step.
            keep_tail: also keep the steps that no full piece covers, as one shorter piece for each episode.

        Raises:
            ValueError: horizon or stride below 1, or not one piece.
        """
        index = segment_index(self.lengths, horizon, horizon if stride is None else stride, keep_tail)
        episode, start, lengths = index
        fields: dict[str, Any] = {}
        for name, array in self._arrays().items():
            fields[name] = None
            if array is not None:
                n_rows = horizon + ARRAYS[name].extra_row
                rows = np.minimum(start[:, None] + np.arange(n_rows), max(array.shape[1] - 1, 0))
                piece = array[episode[:, None], rows]
                piece[~checks.row_mask(lengths, n_rows, ARRAYS[name].extra_row)] = 0.0
                fields[name] = piece
        terminated = self.terminated[episode] & (start + lengths == self.lengths[episode])
        return self._from_checked({**self._others(), **fields, "lengths": lengths, "terminated": terminated})

    def split(self, sizes: Sequence[float], seed: int | np.random.Generator) -> tuple[Sequences, ...]:
        """Random parts of whole episodes, e.g. `train, test = sequences.split((0.8, 0.2), seed=0)`.

        Args:
            sizes: fractions that sum to 1, or (all ints) counts that sum to n_episodes.
            seed: seed or generator of the shuffle.

        Raises:
            ValueError: sizes that do not sum to the whole, or too few episodes to give each fraction one.
        """
        return tuple(self[part] for part in split_indices(len(self), sizes, seed))

    def folds(
        self, n_folds: int, seed: int | np.random.Generator, groups: ArrayLike | None = None
    ) -> Iterator[tuple[Sequences, Sequences]]:
        """Cross-validation: n_folds pairs (train, test); every episode is in one test part.

        Args:
            n_folds: at least 2.
            seed: seed or generator of the shuffle.
            groups: (n_episodes,) labels (subject, recording); episodes of one group are held out together.

        Raises:
            ValueError: at the call: fewer than 2 folds, or fewer episodes (groups) than folds.
        """
        pairs = fold_indices(len(self), n_folds, seed, groups)
        return ((self[train], self[test]) for train, test in pairs)

    def to_episodes(self) -> list[dict[str, Any]]:
        """Each episode's arrays without padding, and its "terminated" flag: what `from_episodes` takes."""
        arrays = {name: array for name, array in self._arrays().items() if array is not None}
        return [
            {name: array[i, : length + ARRAYS[name].extra_row] for name, array in arrays.items()}
            | {"terminated": bool(self.terminated[i])}
            for i, length in enumerate(self.lengths)
        ]

    def equals(self, other: object) -> bool:
        """Whether both hold the same episodes, names and metadata, number for number, however far padded."""
        if not isinstance(other, Sequences) or len(self) != len(other):
            return False
        if any(getattr(self, field) != getattr(other, field) for field in NAMES_FIELDS):
            return False
        if not (
            np.array_equal(self.lengths, other.lengths) and np.array_equal(self.terminated, other.terminated)
        ):
            return False
        longest = int(self.lengths.max(initial=0))
        for name, array in self._arrays().items():
            others, n_rows = getattr(other, name), longest + ARRAYS[name].extra_row
            if (array is None) != (others is None):
                return False
            if array is not None and not np.array_equal(array[:, :n_rows], others[:, :n_rows]):
                return False
        return _same_json(dict(self.metadata), dict(other.metadata))

    def __repr__(self) -> str:
        shortest, longest = int(self.lengths.min(initial=self.n_steps)), int(self.lengths.max(initial=0))
        lengths = f"length {longest}" if shortest >= longest else f"lengths {shortest} to {longest}"
        parts = [f"{len(self)} episodes", f"{self.n_transitions} steps", lengths]
        for name, array in self._arrays().items():
            names_field = ARRAYS[name].names_field
            if array is not None and names_field:
                names = getattr(self, names_field)
                parts.append(f"{array.shape[2]} {name}" + (f" ({', '.join(names)})" if names else ""))
        if self.action_log_probs is not None:
            parts.append("action_log_probs")
        return f"Sequences({', '.join(parts)})"

    def __reduce__(self) -> tuple[Callable[..., Sequences], tuple[dict[str, Any]]]:
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Sequences._from_checked, ({**fields, "metadata": dict(self.metadata)},)

    @classmethod
    def _from_checked(cls, fields: Mapping[str, Any]) -> Sequences:
        """A `Sequences` of fields that have been through the checks; copies nothing."""
        sequences = cls.__new__(cls)
        sequences._set(fields)
        return sequences

    def _set(self, fields: Mapping[str, Any]) -> None:
        for name in self.__dataclass_fields__:
            value = fields[name]
            if isinstance(value, np.ndarray):
                value = np.ascontiguousarray(value)
                value.setflags(write=False)
            elif name == "metadata":
                value = MappingProxyType(dict(value))
            object.__setattr__(self, name, value)

    def _arrays(self) -> dict[str, Array | None]:
        return {name: getattr(self, name) for name in ARRAYS}

    def _others(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in (*NAMES_FIELDS, "metadata")}


def _same_json(a: Any, b: Any) -> bool:
    return json.dumps(a, sort_keys=True) == json.dumps(b, sort_keys=True)
