"""`StepRecorder`: all steps of a vector environment, as they were, below whatever an agent is shown of them.

What is recorded is enough to show any filter the whole of training again: its beliefs at every step, for data to fit
the next filter to, for a replay buffer that is to hold one filter's beliefs only, and for episodes that still run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from beliefgym.learning import Sequences

Array = NDArray[np.float64]
Hint = Callable[[Array], Array]  # raw hints (n, ..) -> the hints that a filter is to estimate (n, n_hint)


class Steps(NamedTuple):
    """Steps t = 0 .. T - 1 of n copies, each array (T, n, ...).

    Attributes:
        observations: x_t. actions: a_t, a discrete one as one column. rewards. terminated, truncated: at the end of the
            step. next_observations: x_{t+1} of the same episode, also where the step ended it.
    """

    observations: NDArray[Any]
    actions: NDArray[Any]
    rewards: Array
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    next_observations: NDArray[Any]


class StepRecorder(VectorWrapper[Any, Any, Any, Any, Any]):
    """Records a vector environment with autoreset SAME_STEP.

    Args:
        env: the environment. keeps_hints: also record infos["hint"].

    Raises:
        ValueError: another autoreset mode; no hints where they are to be kept.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], keeps_hints: bool = False) -> None:
        super().__init__(env)
        if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
            raise ValueError(
                f"expected a vector environment with autoreset SAME_STEP, got {env.metadata.get('autoreset_mode')}"
            )
        self._keeps_hints = keeps_hints
        self._steps: dict[str, list[NDArray[Any]]] = {}
        self._starts: list[int] = []  # where all copies were reset from outside
        self._now: NDArray[Any] | None = None
        self._hint: NDArray[Any] | None = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Reset every copy; episodes that run are cut off."""
        if options and options.get("reset_mask") is not None:
            raise ValueError(
                "expected a reset of all copies while their steps are recorded, got a reset_mask"
            )
        observations, infos = self.env.reset(seed=seed, options=options)
        self._starts.append(self.n_recorded)
        self._now, self._hint = np.array(observations), self._hints_of(infos)
        return observations, infos

    def step(self, actions: Any) -> Any:
        """Step and record."""
        before, hint = self._now, self._hint
        if before is None:
            raise RuntimeError("expected reset() before step()")
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = terminated | truncated
        following = np.array(observations)
        next_hint = self._hints_of(infos)
        self._now, self._hint = following.copy(), None if next_hint is None else next_hint.copy()
        if ended.any():
            rows = np.flatnonzero(ended)
            following[rows] = np.stack(list(infos["final_obs"][rows]))
            if next_hint is not None:
                next_hint[rows] = np.asarray(infos["final_info"]["hint"])[rows]
        kept = {
            "observations": before,
            "actions": np.array(actions).reshape(self.num_envs, -1),
            "rewards": np.array(rewards, dtype=np.float64),
            "terminated": np.array(terminated, dtype=np.bool_),
            "truncated": np.array(truncated, dtype=np.bool_),
            "next_observations": following,
        }
        if hint is not None and next_hint is not None:
            kept |= {"hints": hint, "next_hints": next_hint}
        for name, value in kept.items():
            self._steps.setdefault(name, []).append(value)
        return observations, rewards, terminated, truncated, infos

    @property
    def n_recorded(self) -> int:
        """Steps of each copy so far."""
        return len(self._steps.get("rewards", ()))

    def steps(self) -> Steps:
        """All of them.

        Raises:
            RuntimeError: there are none.
        """
        self._require_steps()
        return Steps(*(np.stack(self._steps[name]) for name in Steps._fields))

    def episodes(self, hint_of: Hint | None = None, **names: Any) -> tuple[Sequences, NDArray[np.int64]]:
        """All episodes, those that still run (or were cut off) with what there is of them.

        Args:
            hint_of: makes hints of the recorded ones; None for none.
            **names: names of components, as of `Sequences`.

        Returns:
            The episodes, and (n_episodes, 2) the first step and the copy of each.

        Raises:
            RuntimeError: there are no steps. ValueError: hints are asked for and were not kept.
        """
        self._require_steps()
        if hint_of is not None and "hints" not in self._steps:
            raise ValueError(
                "expected a recorder with keeps_hints=True for episodes with hints, got one without"
            )
        n_steps, n = self.n_recorded, self.num_envs
        ended = np.stack(self._steps["terminated"]) | np.stack(self._steps["truncated"])
        begins = np.zeros((n_steps + 1, n), dtype=np.bool_)
        begins[[start for start in self._starts if start <= n_steps]] = True
        begins[1:] |= ended
        copy, start = np.nonzero(begins[:n_steps].T)
        stop = np.empty_like(start)
        last_of_copy = np.append(copy[1:] != copy[:-1], True)
        stop[:-1] = start[1:]
        stop[last_of_copy] = n_steps
        lengths = stop - start
        t = np.minimum(start[:, None] + np.arange(lengths.max()), n_steps - 1)
        index = t, copy[:, None]
        rows = np.arange(len(start))

        def with_last(name: str) -> NDArray[Any]:
            array = np.stack(self._steps[name])[index]
            array = np.concatenate([array, np.zeros_like(array[:, :1])], axis=1)
            array[rows, lengths] = np.stack(self._steps[f"next_{name}"])[stop - 1, copy]
            return array

        arrays: dict[str, Any] = {"observations": with_last("observations")}
        for name in ("actions", "rewards"):
            arrays[name] = np.stack(self._steps[name])[index]
        if hint_of is not None:
            raw = with_last("hints")
            flat = hint_of(raw.reshape(-1, raw.shape[2]).astype(np.float64))
            arrays["hints"] = flat.reshape(*raw.shape[:2], -1)
        terminated = np.stack(self._steps["terminated"])[stop - 1, copy]
        found = Sequences(**arrays, lengths=lengths, terminated=terminated, **names)
        return found, np.stack([start, copy], axis=1)

    def running(self) -> Sequences:
        """What there is of the episode that each copy is in, one each; of length 0 where it has just begun.

        Raises:
            RuntimeError: nothing has begun.
        """
        n_steps, n = self.n_recorded, self.num_envs
        if self._now is None:
            raise RuntimeError("expected reset() before running()")
        begin = np.full(n, self._starts[-1])
        if n_steps:
            ended = np.stack(self._steps["terminated"]) | np.stack(self._steps["truncated"])
            last = np.where(ended.any(axis=0), n_steps - np.argmax(ended[::-1], axis=0), 0)
            begin = np.maximum(begin, last)
        lengths = n_steps - begin
        longest, rows = int(lengths.max()), np.arange(n)
        observations = np.zeros((n, longest + 1, self._now.shape[1]))
        n_act = self._steps["actions"][0].shape[1] if n_steps else 0
        actions, rewards = np.zeros((n, longest, n_act)), np.zeros((n, longest))
        if longest:
            index = np.minimum(begin[:, None] + np.arange(longest), n_steps - 1), rows[:, None]
            observations[:, :-1] = np.stack(self._steps["observations"])[index]
            actions[:] = np.stack(self._steps["actions"])[index]
            rewards[:] = np.stack(self._steps["rewards"])[index]
        observations[rows, lengths] = self._now
        return Sequences(observations, actions, rewards, lengths=lengths)

    def _require_steps(self) -> None:
        if not self.n_recorded:
            raise RuntimeError("expected at least one step() before what was recorded is asked for, got none")

    def _hints_of(self, infos: dict[str, Any]) -> NDArray[Any] | None:
        if not self._keeps_hints:
            return None
        if "hint" not in infos:
            raise ValueError(f"expected 'hint' in the infos of {self.env}, got the keys {sorted(infos)}")
        return np.array(infos["hint"], dtype=np.float64)
