"""Continuous actions in units of (-1, 1): what a squashed policy gives, and what a Box of an environment takes.

a_Box = low + (a + 1) / 2 (high - low)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from gymnasium.wrappers.vector import TransformAction
from numpy.typing import NDArray

from beliefgym.wrappers.task import Task


class ActionUnits:
    """The units of a task's actions.

    Args:
        space: of the task's actions. task: named in errors. who: the agent that needs them, named in errors.

    Attributes:
        n: components of an action.

    Raises:
        ValueError: not a flat Box, or one without bounds.
    """

    def __init__(self, space: Any, task: Task, who: str) -> None:
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise ValueError(
                f"{who} chooses continuous actions, a flat Box, but {task.label} has {space}: take RecurrentQSARSA, "
                "which chooses among finitely many"
            )
        if not space.is_bounded():
            raise ValueError(
                f"{who} needs bounded actions, but {task.label} has {space}: register the environment with "
                "Gymnasium's ClipAction or RescaleAction around it"
            )
        self.n = int(space.shape[0])
        self._low, self._high, self._dtype = (
            space.low.astype(np.float64),
            space.high.astype(np.float64),
            space.dtype,
        )

    def to_box(self, action: NDArray[Any]) -> NDArray[Any]:
        """(n, n_action) in (-1, 1) -> in the Box."""
        scaled = self._low + 0.5 * (action + 1.0) * (self._high - self._low)
        return scaled.clip(self._low, self._high).astype(self._dtype)

    def around(self, env: VectorEnv[Any, Any, Any]) -> VectorEnv[Any, Any, Any]:
        """The environment with actions in (-1, 1)."""
        return TransformAction(env, self.to_box, single_action_space=Box(-1.0, 1.0, (self.n,), np.float32))
