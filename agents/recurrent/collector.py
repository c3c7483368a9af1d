"""Rollouts of a vector environment in TorchRL's layout, with the memory of the network that acts.

Every copy goes on with its episode from one rollout to the next. `previous_action` and `previous_reward` are part of
what is recorded, under "next" too, so that a network can be run over any piece of it.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from gymnasium.spaces import Discrete
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from beliefgym.agents.recurrent.network import HistoryEncoder
from beliefgym.agents.recurrent.rolling import final_states


class Seen(NamedTuple):
    """What is put into a network at one step, (n, size) each: see `HistoryEncoder`."""

    observation: Tensor
    previous_action: Tensor
    previous_reward: Tensor
    state: Tensor


class Acted(NamedTuple):
    """What a network answers: the actions (n,) or (n, n_action), their probability or density (n,), the next state."""

    action: Tensor
    probability: Tensor
    state: Tensor


class Act(Protocol):
    """An acting network."""

    def __call__(self, seen: Seen) -> Acted:
        """Choose."""
        ...


class RolloutCollector:
    """Steps a vector environment and records.

    Args:
        env: with autoreset SAME_STEP and a flat Box of observations.
        state_size: of the network's recurrent state.
        seed: of the first reset.

    Attributes:
        reward_scale: every reward is multiplied by it before it is recorded.
        finished: (return, length) of the episodes that ended in the last rollout, rewards unscaled.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], state_size: int, seed: int) -> None:
        self.env, self.n = env, env.num_envs
        self.state_size = state_size
        self.reward_scale = 1.0
        self.finished: list[tuple[float, int]] = []
        space = env.single_action_space
        self._n_choices = int(space.n) if isinstance(space, Discrete) else None
        self.n_action = self._n_choices or int(np.prod(space.shape or ()))
        observation, _ = env.reset(seed=seed)
        self._observation = _tensor(observation)
        self._previous_action = torch.zeros(self.n, self.n_action)
        self._previous_reward = torch.zeros(self.n, 1)
        self._state = torch.zeros(self.n, state_size)
        self._is_init = torch.ones(self.n, dtype=torch.bool)
        self._returns = np.zeros(self.n)
        self._past = _RunningEpisodes(self.n, self._observation.shape[1], self.n_action)

    def collect(self, act: Act, n_steps: int) -> TensorDict:
        """The next n_steps of every copy.

        Args:
            act: the network that acts; its state goes on from the last call.
            n_steps: steps of each copy.

        Returns:
            (n, n_steps): "observation", "previous_action", "previous_reward", "recurrent_state" (before the step),
            "is_init", "action", "action_probability", and under "next" "observation" (an episode's last where it
            ended), "previous_action", "previous_reward", "reward", "terminated", "truncated", "done".
        """
        self.finished = []
        rows: dict[str, list[Tensor]] = {name: [] for name in (*_KEYS, *_NEXT)}
        for _ in range(n_steps):
            seen = Seen(self._observation, self._previous_action, self._previous_reward, self._state)
            acted = act(seen)
            self._past.append(seen)
            action = acted.action.numpy()
            observation, reward, terminated, truncated, infos = self.env.step(action)
            done = terminated | truncated
            following = self._following(observation, done, infos)
            now = (*seen, self._is_init[:, None], acted.action, acted.probability)
            for name, value in zip(_KEYS, now, strict=True):
                rows[name].append(value)
            self._advance(acted, reward, done, observation)
            scaled = _tensor(reward)[:, None] * self.reward_scale
            flags = (torch.from_numpy(flag[:, None].copy()) for flag in (terminated, truncated, done))
            for name, value in zip(
                _NEXT, (following, self._encoded(acted.action), scaled, *flags), strict=True
            ):
                rows[name].append(value)
        whole = {name: torch.stack(values, dim=1) for name, values in rows.items()}
        after = {name.removeprefix("next_"): whole.pop(name) for name in _NEXT}
        after["previous_reward"] = after["reward"]
        return TensorDict({**whole, "next": TensorDict(after, [self.n, n_steps])}, [self.n, n_steps])

    @torch.no_grad()
    def refresh(self, encoder: HistoryEncoder) -> float:
        """Set every copy's state to what this network would have come to over its episode so far.

        So the states are those of the present network throughout (temporal consistency), though earlier ones chose
        the actions before.

        Returns:
            how far the states had drifted: |carried - refreshed| / |refreshed|, 0 where no episode runs.
        """
        refreshed = self._past.states(encoder, self.state_size)
        size = float(refreshed.norm())
        drift = float((self._state - refreshed).norm()) / size if size > 0.0 else 0.0
        self._state = refreshed
        return drift

    def rescale(self, reward_scale: float, rollout: TensorDict) -> None:
        """Change `reward_scale`; what was seen of rewards follows, in a rollout too."""
        ratio = reward_scale / self.reward_scale
        self.reward_scale = reward_scale
        self._previous_reward = self._previous_reward * ratio
        self._past.scale_rewards(ratio)
        for key in ("previous_reward", ("next", "previous_reward"), ("next", "reward")):
            rollout.set(key, rollout.get(key) * ratio)  # two of them are one tensor

    def _advance(
        self, acted: Acted, reward: NDArray[np.float64], done: NDArray[np.bool_], observation: NDArray[Any]
    ) -> None:
        self._returns += reward
        going = torch.from_numpy(~done)[:, None]
        self._observation = _tensor(observation)
        self._previous_action = self._encoded(acted.action) * going
        self._previous_reward = _tensor(reward)[:, None] * self.reward_scale * going
        self._state = acted.state * going
        self._is_init = ~going[:, 0]
        if done.any():
            for i in np.flatnonzero(done).tolist():
                self.finished.append((float(self._returns[i]), int(self._past.lengths[i])))
            self._returns[done] = 0.0
            self._past.lengths[done] = 0

    def _following(self, observation: NDArray[Any], done: NDArray[np.bool_], infos: dict[str, Any]) -> Tensor:
        if not done.any():
            return _tensor(observation)
        following = np.array(observation)
        following[done] = np.stack(list(infos["final_obs"][done]))
        return _tensor(following)

    def _encoded(self, action: Tensor) -> Tensor:
        if self._n_choices is None:
            return action.to(torch.float32)
        return torch.nn.functional.one_hot(action, self._n_choices).to(torch.float32)


_KEYS = (
    *("observation", "previous_action", "previous_reward", "recurrent_state"),
    *("is_init", "action", "action_probability"),
)
_NEXT = (
    *("next_observation", "next_previous_action", "next_reward"),
    *("next_terminated", "next_truncated", "next_done"),
)


class _RunningEpisodes:
    """What every copy has seen in the episode that it is in."""

    def __init__(self, n: int, n_observation: int, n_action: int) -> None:
        self.lengths = np.zeros(n, dtype=np.int64)
        self._rows = np.arange(n)
        self._stores = [torch.zeros(n, 64, size) for size in (n_observation, n_action, 1)]

    def append(self, seen: Seen) -> None:
        """One step more of every copy."""
        if self.lengths.max() >= self._stores[0].shape[1]:
            self._stores = [torch.cat([store, torch.zeros_like(store)], dim=1) for store in self._stores]
        for store, value in zip(self._stores, seen[:3], strict=True):
            store[self._rows, self.lengths] = value
        self.lengths += 1

    def scale_rewards(self, ratio: float) -> None:
        """Multiply what was seen of rewards."""
        self._stores[2] *= ratio

    def states(self, encoder: HistoryEncoder, state_size: int) -> Tensor:
        """(n, state_size) after what was seen."""
        longest = int(self.lengths.max())
        # row i's steps, moved so that all rows end together; what stands before them does not count
        steps = torch.from_numpy(np.arange(longest) - longest + self.lengths[:, None]).clamp(min=0)
        seen = tuple(store[torch.from_numpy(self._rows)[:, None], steps] for store in self._stores)
        first = self._stores[0].new_zeros(len(self.lengths), state_size)
        return final_states(encoder, seen, torch.from_numpy(self.lengths), first)


def _tensor(array: NDArray[Any]) -> Tensor:
    return torch.as_tensor(np.asarray(array, dtype=np.float32))
