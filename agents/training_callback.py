"""Stable-Baselines3's callbacks for agents that learn in whole trials."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger


class TrainingCallback:
    """Calls an SB3 callback as SB3 does, with each trial's steps once the trial is over.

    Args:
        agent: the callback's `model`; it gets a `logger`. callback: SB3's, a list of them, a function
            (locals, globals) -> bool, or None. total_timesteps: told to the callback.
    """

    def __init__(self, agent: Any, callback: Any, total_timesteps: int) -> None:
        if not hasattr(agent, "logger"):
            agent.logger = Logger(folder=None, output_formats=[])
        if isinstance(callback, list):
            callback = CallbackList(callback)
        self._agent, self._callback = agent, callback
        if isinstance(callback, BaseCallback):
            callback.init_callback(agent)
            callback.on_training_start({"self": agent, "total_timesteps": total_timesteps}, {})

    def trial(self, record: dict[str, Any]) -> bool:
        """A trial is over; False to stop."""
        callback = self._callback
        if callback is None:
            return True
        if not isinstance(callback, BaseCallback):
            return callback({"self": self._agent, **record}, {}) is not False
        callback.on_rollout_start()
        callback.update_locals({"self": self._agent, **record})
        end = self._agent.num_timesteps
        go_on = True
        for step in range(record["steps"]):
            self._agent.num_timesteps = end - record["steps"] + step + 1
            go_on = callback.on_step() and go_on
        self._agent.num_timesteps = end
        callback.on_rollout_end()
        return go_on

    def end(self) -> None:
        """The learning is over."""
        if isinstance(self._callback, BaseCallback):
            self._callback.on_training_end()
