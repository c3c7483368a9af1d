"""The random policy: actions uniform in the action space. The zero of every leaderboard score."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from beliefgym.agents.agent import Agent
from beliefgym.wrappers.task import Task


class RandomAgent(Agent):
    """Draws every action from the action space, whatever it sees and however `deterministic` is set.

    Args:
        task: the task or environment id.
        seed: seed of the action stream.
    """

    def __init__(self, task: Task | str, seed: int = 0) -> None:
        super().__init__(task, seed)
        self._spaces: dict[int, Any] = {}

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Nothing to learn."""
        return self

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """See `Agent.predict`; the state is None."""
        observation, single = self.batched(observation)
        n = len(observation)
        if n not in self._spaces:
            self._spaces[n] = batch_space(self.action_space, n)
            self._spaces[n].seed(self.seed)
        actions = self._spaces[n].sample()
        return (actions[0] if single else actions), None

    def parts(self) -> dict[str, bytes]:
        """Nothing beyond the header."""
        return {}

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """Nothing to restore."""
