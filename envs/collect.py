"""`collect`: run a policy in an environment, single or vector, and get its episodes as `Sequences`.

Which copy of a vector environment runs which episode is fixed beforehand: with n copies, episode j is the
(j // n)-th episode of copy j mod n. Taking the first episodes that end would favour short ones, since a long
one is still running when the count is full. The price is that copies which have done their share are stepped
along, unrecorded, until the last is done.
"""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from tqdm import tqdm

from beliefgym.envs.acting import Actor, Policy
from beliefgym.envs.copies import AnyEnv, Array, Copies, Mask, SingleCopy, VectorCopies, rows_of
from beliefgym.learning import Sequences


def collect(
    env: AnyEnv,
    policy: Policy,
    n_episodes: int,
    seed: int,
    *,
    deterministic: bool = True,
    max_steps_per_episode: int | None = None,
    progress_bar: bool = False,
) -> Sequences:
    """Exactly `n_episodes` whole episodes of a policy in an environment.

    The same seed gives the same episodes, as far as the policy itself is deterministic. What `seed` means:

    - single environment: episode j starts with `reset(seed=seed + j)`;
    - vector environment, autoreset DISABLED: the same, so that the episodes are those of the single one;
    - vector environment, autoreset SAME_STEP or NEXT_STEP: copy i is reset once, with seed + i, so the first
      episode of each copy is that of the single environment; its later ones follow from the copy's own random
      stream, and depend on the seed and on the number of copies.

    The random policy draws from a stream of its own, so its actions differ between one copy and several.

    Recorded beside observations, actions (as given to the environment, before any clipping inside) and
    rewards:

    - hints, where `info["hint"]` is there after reset;
    - true states, where they are certain. Single: `env.get_wrapper_attr("state")`, if it is a fixed number of
      floats. Vector: `env.unwrapped.state` of shape (n, n_state), if the environment also says `state_names`
      (or has a beliefgym system); with SAME_STEP, `infos["final_info"]["state"]` must give the state at each
      end. Otherwise no states are recorded;
    - action log probabilities, where the policy has `predict_with_log_prob(observation, state, episode_start,
      deterministic) -> (action, state, log_prob)`, with log_prob (n,), and for the random policy. Where the
      policy says `explores_always = False` and `deterministic` is true, it is asked by `predict` and none are
      recorded: so do `SB3Agent` and `with_log_probs(model)` of beliefgym.agents. `GaussianPolicy` and
      `EpsilonPolicy` make any policy one that explores and knows its log-probabilities;
    - component names, from the outermost layer that has `observation_names`, `action_names`, `state_names`,
      `hint_names` with as many names as components.

    Args:
        env: observations Box (flattened to columns where not 1-D) or Discrete; actions Box, Discrete,
            MultiDiscrete or MultiBinary. A discrete number becomes one column.
        policy: None or "random" for actions sampled from the action space; a function of observations (n,
            n_obs) to actions (n, n_act); or an object with `predict(observation, state, episode_start,
            deterministic) -> (action, state)`. Also with a single environment the observations come as a
            batch, of 1.
        n_episodes: number of episodes, at least 1.
        seed: at least 0.
        deterministic: handed to `predict` or `predict_with_log_prob`.
        max_steps_per_episode: cut longer episodes off (truncated) at this many steps; needed where the
            environment sets no limit. On a vector environment it takes `reset(options={"reset_mask": ...})`.
        progress_bar: show finished episodes.

    Returns:
        `Sequences` of the n_episodes episodes; its metadata holds the environment's id and spec, dt where the
        environment has one, the seed and the policy's name.

    Raises:
        TypeError: not a Gymnasium environment, or a policy of none of these forms.
        ValueError: unusable numbers or spaces, actions of the wrong shape or with NaN, infos that lack a
            final observation or a hint.
        RuntimeError: a vector environment that resets all copies when asked to reset some.
    """
    _check_number("n_episodes", n_episodes, 1)
    _check_number("seed", seed, 0)
    if max_steps_per_episode is not None:
        _check_number("max_steps_per_episode", max_steps_per_episode, 1)
    copies: Copies
    if isinstance(env, VectorEnv):
        copies = VectorCopies(env)
    elif isinstance(env, gym.Env):
        copies = SingleCopy(env)
    else:
        raise TypeError(f"expected a gymnasium.Env or gymnasium.vector.VectorEnv, got {type(env).__name__}")
    actor = Actor(policy, copies, int(seed), deterministic)
    recorder = _Recorder(copies, n_episodes, int(seed), max_steps_per_episode)
    with tqdm(total=n_episodes, desc="episodes", disable=not progress_bar) as bar:
        while recorder.remaining.any():
            action, log_prob = actor(recorder.observation, recorder.episode_start)
            bar.update(recorder.step(action, log_prob))
    return recorder.sequences(_metadata(copies, actor.name, seed, deterministic))


class _Recorder:
    """Steps the copies, keeps what they show, and knows which episode each is in.

    Every step of every copy is kept in time order; an episode is a copy, a first step and a length, cut out
    at the end by one indexing. What belongs to an episode's end (the last observation, state and hint) is
    kept apart, since a copy that resets itself within the step has lost it by the next.

    Attributes:
        observation: (n, ...) to act on next.
        episode_start: (n,) true where it is the first of an episode.
        remaining: (n,) episodes that each copy has still to finish.
    """

    def __init__(self, copies: Copies, n_episodes: int, seed: int, max_steps: int | None) -> None:
        n = copies.n
        self._copies, self._seed = copies, seed
        self._max_steps = np.inf if max_steps is None else max_steps
        self.remaining = n_episodes // n + (np.arange(n) < n_episodes % n)
        self._episode = np.arange(n)  # number of the episode that each copy is in
        self._start = np.zeros(n, dtype=np.int64)
        self._length = np.zeros(n, dtype=np.int64)
        self._resetting = np.zeros(n, dtype=np.bool_)  # NEXT_STEP: the next step only resets this copy
        self._steps: dict[str, list[Array]] = {}
        self._ends: dict[str, list[NDArray[Any]]] = {}
        self.observation, infos = copies.reset(seed, None)
        self.episode_start = np.ones(n, dtype=np.bool_)
        self._now = {"observations": self._columns(self.observation)}
        hints = rows_of(infos, "hint", np.arange(n))
        if hints is not None:
            self._now["hints"] = hints
        self._keeps_states = copies.state() is not None
        self._look_at_state()

    def step(self, action: NDArray[Any], log_prob: Array | None) -> int:
        """Step all copies; the number of episodes that ended and are kept."""
        copies, everyone = self._copies, np.arange(self._copies.n)
        for name, value in self._now.items():
            self._steps.setdefault(name, []).append(value)
        self._steps.setdefault("actions", []).append(self._columns(action))
        if log_prob is not None:
            self._steps.setdefault("action_log_probs", []).append(log_prob)
        self.observation, reward, terminated, truncated, infos = copies.step(action)
        self._steps.setdefault("rewards", []).append(reward)

        started = self._resetting
        self._length += 1
        done = terminated | truncated
        cut = ~done & ~started & (self._length >= self._max_steps) & (self.remaining > 0)
        ended = np.flatnonzero((done | cut) & (self.remaining > 0))
        self._now["observations"] = self._columns(self.observation)
        if "hints" in self._now:
            self._now["hints"] = self._needed("hint", infos, everyone)
        self._look_at_state()
        if len(ended):
            self._keep_ends(ended, done, terminated, infos)
        self.remaining[ended] -= 1
        self._episode[ended] += copies.n

        self._resetting = np.zeros_like(done)
        to_reset = cut
        if copies.mode == AutoresetMode.SAME_STEP:
            started = done
        elif copies.mode == AutoresetMode.NEXT_STEP:
            self._resetting = done
        else:
            to_reset = cut | done
        if to_reset.any() and self.remaining.any():
            self._reset(to_reset)
            started = started | to_reset
        self._start[started] = len(self._steps["rewards"])
        self._length[started] = 0
        self.episode_start = started
        return len(ended)

    def sequences(self, metadata: dict[str, Any]) -> Sequences:
        """The kept episodes, in order of their numbers."""
        if not self._keeps_states:
            self._steps.pop("states", None)
            self._ends.pop("states", None)
        ends = {name: np.concatenate(values) for name, values in self._ends.items()}
        order = np.argsort(ends["episode"])
        copy, start, lengths, terminated = (
            ends[key][order] for key in ("copy", "start", "length", "terminated")
        )
        n_steps = int(lengths.max())
        # Rows past an episode's end show the copy's later steps; Sequences sets them to zero.
        time = np.minimum(start[:, None] + np.arange(n_steps), len(self._steps["rewards"]) - 1)
        arrays: dict[str, Any] = {}
        for name, values in self._steps.items():
            array = np.stack(values)[time, copy[:, None]]
            if name in ends:
                array = np.concatenate([array, np.zeros_like(array[:, :1])], axis=1)
                array[np.arange(len(order)), lengths] = ends[name][order]
            arrays[name] = array
        fields = {"observations": "observation_names", "actions": "action_names"}
        fields |= {"states": "state_names", "hints": "hint_names"}
        names: dict[str, Any] = {
            f: self._copies.names(f, arrays[a].shape[2]) for a, f in fields.items() if a in arrays
        }
        return Sequences(**arrays, **names, lengths=lengths, terminated=terminated, metadata=metadata)

    def _keep_ends(self, rows: NDArray[np.intp], done: Mask, terminated: Mask, infos: dict[str, Any]) -> None:
        """Keep what the episodes that now end in these copies end with."""
        ends: dict[str, NDArray[Any]] = {name: value[rows] for name, value in self._now.items()}
        inside = done[rows]  # a copy that is cut off has not reset itself
        if self._copies.mode == AutoresetMode.SAME_STEP and inside.any():
            final_info = infos.get("final_info", {})
            ends["observations"][inside] = self._needed("final_obs", infos, rows[inside])
            if "hints" in ends:
                ends["hints"][inside] = self._needed("hint", final_info, rows[inside])
            if "states" in ends:
                states = rows_of(final_info, "state", rows[inside])
                if states is None or states.shape[1] != ends["states"].shape[1]:
                    self._keeps_states = False
                else:
                    ends["states"][inside] = states
        ends |= {"episode": self._episode[rows], "copy": rows, "start": self._start[rows]}
        ends |= {"length": self._length[rows], "terminated": terminated[rows]}
        for name, value in ends.items():
            self._ends.setdefault(name, []).append(value)

    def _reset(self, mask: Mask) -> None:
        """Reset some copies in the middle of the run and let the others be."""
        copies, seeds = self._copies, None
        if copies.mode == AutoresetMode.DISABLED:
            seeds = [self._seed + int(e) if m else None for e, m in zip(self._episode, mask, strict=True)]
        self.observation, infos = copies.reset(seeds, mask)
        columns = self._columns(self.observation)
        if not np.array_equal(columns[~mask], self._now["observations"][~mask], equal_nan=True):
            raise RuntimeError(
                f"expected {copies.env} to reset copies {np.flatnonzero(mask).tolist()} only, as "
                'reset(options={"reset_mask": ...}) asks, but other copies changed; give it a time limit of '
                "its own instead of max_steps_per_episode, or another autoreset mode than DISABLED"
            )
        self._now["observations"] = columns
        if "hints" in self._now:
            self._now["hints"][mask] = self._needed("hint", infos, np.flatnonzero(mask))
        self._look_at_state()

    def _look_at_state(self) -> None:
        """Read the true states, until they are not what they were."""
        if not self._keeps_states:
            self._now.pop("states", None)
            return
        states = self._copies.state()
        if states is None or ("states" in self._now and states.shape != self._now["states"].shape):
            self._keeps_states = False
            self._now.pop("states", None)
        else:
            self._now["states"] = states

    def _needed(self, key: str, infos: dict[str, Any], rows: NDArray[np.intp]) -> Array:
        """An entry of the infos that must be there."""
        values = rows_of(infos, key, rows)
        if values is None:
            raise ValueError(
                f"expected {key!r} in the infos of copies {rows.tolist()[:8]} of {self._copies.env} at step "
                f"{len(self._steps['rewards'])} (autoreset {self._copies.mode.name}), got the keys "
                f"{sorted(infos)}"
            )
        return values

    def _columns(self, batch: Any) -> Array:
        """A float copy of a batch, (n, k)."""
        return np.array(batch, dtype=np.float64).reshape(self._copies.n, -1)


def _metadata(copies: Copies, policy: str, seed: int, deterministic: bool) -> dict[str, Any]:
    """Where the episodes come from."""
    metadata: dict[str, Any] = {
        "seed": seed,
        "policy": policy,
        "deterministic": deterministic,
        "n_copies": copies.n,
    }
    try:
        spec = copies.env.spec
        metadata["env_id"] = type(copies.env.unwrapped).__name__ if spec is None else spec.id
        if spec is not None:
            metadata["env_spec"] = json.loads(spec.to_json())
    except (TypeError, ValueError, AttributeError):
        pass  # a wrapper or an argument that does not serialise: the id must do
    dt = copies.declared("dt") if copies.system is None else copies.system.dt
    if isinstance(dt, int | float):
        metadata["dt"] = float(dt)
    return metadata


def _check_number(name: str, value: int, least: int) -> None:
    """Raise unless value is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"expected {name} to be a whole number of at least {least}, got {value!r}")
