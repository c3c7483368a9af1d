"""The best play of a T-maze that knows the cue: forward to the junction, then the arm that the cue names.

Its return is the reward of the right arm, after length + 1 steps; no other play gets more, since no step pays more than
0 but the one into that arm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.planning.controller_input import checked_batch

if TYPE_CHECKING:
    from beliefgym.envs.t_maze import TMaze


@dataclass(frozen=True, eq=False)
class TMazeController:
    """Forward, and at the junction the cue.

    Attributes:
        system: gives the length.
    """

    system: TMaze

    def act(self, state: ArrayLike, restart: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """Actions (n, 1) for states (n, 3); it keeps no memory of an episode."""
        states, _ = checked_batch(self.system, state, restart)
        at_junction = states[:, 0] > self.system.length - 0.5
        return np.where(at_junction, states[:, 1], 0.0)[:, None]
