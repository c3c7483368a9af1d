"""Records a vector environment step by step and cuts its episodes by hand: the oracle of what an agent is shown."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorWrapper

from beliefgym.learning import Sequences


class Diary(VectorWrapper):
    """Keeps everything that happens to each copy, in plain lists.

    Attributes:
        episodes: for each copy a list of episodes, the last of which runs; each a dict of lists "observations",
            "actions", "rewards", "hints", and "end": None, "terminated", "truncated" or "cut" (by a reset).
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.episodes: list[list[dict[str, Any]]] = [[] for _ in range(env.num_envs)]
        self.n_steps = 0

    def reset(self, **arguments: Any) -> Any:
        observations, infos = self.env.reset(**arguments)
        for copy, own in enumerate(self.episodes):
            if own and own[-1]["end"] is None:
                own[-1]["end"] = "cut"
            self._begin(copy, observations, infos)
        return observations, infos

    def step(self, actions: Any) -> Any:
        result = observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self.n_steps += 1
        for copy, own in enumerate(self.episodes):
            running, ended = own[-1], bool(terminated[copy] or truncated[copy])
            last = infos["final_obs"][copy] if ended else observations[copy]
            running["observations"].append(np.array(last))
            running["actions"].append(np.array(actions[copy], dtype=float).reshape(-1))
            running["rewards"].append(float(rewards[copy]))
            if "hint" in infos:
                known = infos["final_info"]["hint"][copy] if ended else infos["hint"][copy]
                running["hints"].append(np.array(known))
            if ended:
                running["end"] = "terminated" if terminated[copy] else "truncated"
                self._begin(copy, observations, infos)
        return result

    def _begin(self, copy: int, observations: Any, infos: dict[str, Any]) -> None:
        hints = [np.array(infos["hint"][copy])] if "hint" in infos else []
        first = np.array(observations[copy])
        self.episodes[copy].append(
            {"observations": [first], "actions": [], "rewards": [], "hints": hints, "end": None}
        )

    @property
    def ends(self) -> set[str]:
        """How episodes have ended."""
        return {episode["end"] for own in self.episodes for episode in own} - {None}


def sequences(episode: dict[str, Any]) -> Sequences:
    """One episode, or what there is of it, for a filter."""
    n_act = len(episode["actions"][0]) if episode["actions"] else 0
    return Sequences(
        np.array(episode["observations"], dtype=float)[None],
        np.array(episode["actions"], dtype=float).reshape(1, -1, n_act),
        np.array(episode["rewards"]).reshape(1, -1),
    )


def seen(filter: Any, episode: dict[str, Any]) -> np.ndarray:
    """What an agent sees of an episode at t = 0 .. length: (length + 1, n_obs + summary_size)."""
    observations = np.array(episode["observations"], dtype=float)
    if not episode["actions"]:
        # a filter with actions checks their number: one step more, whose row is left out
        longer = {**episode, "observations": [*episode["observations"]] * 2, "rewards": [0.0]}
        longer["actions"] = [np.zeros(max(filter.n_act_, 1))]
        return np.concatenate([observations, filter.summaries(sequences(longer))[0, :1]], axis=1)
    return np.concatenate([observations, filter.summaries(sequences(episode))[0]], axis=1)


def rows(filter: Any, diary: Diary) -> list[list[dict[str, Any]]]:
    """All that SB3 is to keep of each copy's steps, in the order of time."""
    found = []
    for own in diary.episodes:
        steps = []
        for episode in own:
            shown = seen(filter, episode)
            for t, (action, reward) in enumerate(zip(episode["actions"], episode["rewards"], strict=True)):
                end = episode["end"] if t + 1 == len(episode["actions"]) else None
                steps.append(
                    {
                        "observations": shown[t],
                        "next_observations": shown[t + 1],
                        "actions": action,
                        "rewards": reward,
                        "dones": end in ("terminated", "truncated"),
                        "timeouts": end == "truncated",
                    }
                )
        found.append(steps)
    return found
