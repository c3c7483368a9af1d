"""A trained full-state policy in an expert's face: `act(state, restart)`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.reference_policies.policy import MLPPolicy

Floats = NDArray[np.float64]


class ReferenceController:
    """A trained full-state policy in an expert's face.

    Args:
        policy: from Gymnasium's observation to actions.
        n_positions: joint positions at the head of the state.
        skipped: positions that the observation leaves out, from the first.
        velocity_limit: velocities are clipped to plus or minus this in the observation.
    """

    def __init__(self, policy: MLPPolicy, n_positions: int, skipped: int, velocity_limit: float) -> None:
        self.policy = policy
        self._n_positions = n_positions
        self._skipped = skipped
        self._limit = velocity_limit

    @property
    def kind(self) -> str:
        """What it is, in a few words."""
        return str(self.policy.about["kind"])

    def act(self, state: Floats, restart: NDArray[np.bool_] | None = None) -> Floats:
        """Actions (n, n_action) for true states (n, n_state); it has no memory, so `restart` changes nothing."""
        return self.policy(self.observation(state)).astype(np.float64)

    def observation(self, state: Floats) -> Floats:
        """Gymnasium's full observation of true states (n, n_state)."""
        position, velocity = np.split(state, [self._n_positions], axis=1)
        return np.concatenate(
            [position[:, self._skipped :], velocity.clip(-self._limit, self._limit)], axis=1
        )
