"""`BetweenRollouts`: an SB3 callback that does something between two rollouts, and knows whether one was cut off."""

from __future__ import annotations

from collections.abc import Callable

from stable_baselines3.common.callbacks import BaseCallback


class BetweenRollouts(BaseCallback):
    """Calls a function before every rollout.

    Args:
        function: what to do.

    Attributes:
        is_within_rollout: still after training where another callback has stopped it there: the environment has then
            gone one step further than SB3 remembers.
    """

    def __init__(self, function: Callable[[], None]) -> None:
        super().__init__()
        self._function = function
        self.is_within_rollout = False

    def _on_rollout_start(self) -> None:
        self._function()
        self.is_within_rollout = True

    def _on_rollout_end(self) -> None:
        self.is_within_rollout = False

    def _on_step(self) -> bool:
        return True
