"""What every controller's `act` takes, checked once: states of n copies, and which of them begin a new episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.system import System


def checked_batch(
    system: System, state: ArrayLike, restart: ArrayLike | None = None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The arguments of `act` as arrays.

    Args:
        system: whose states they are.
        state: (n, n_state).
        restart: bool (n,), where a new episode has begun; nowhere if None.

    Returns:
        (n, n_state) float64 and (n,) bool.

    Raises:
        ValueError: a wrong shape, or a state that is not finite (which copy is said).
    """
    states = np.asarray(state, dtype=np.float64)
    if states.ndim != 2 or states.shape[1] != system.n_state:
        raise ValueError(f"expected state as (n, {system.n_state}), got shape {states.shape}")
    if not np.isfinite(states).all():
        raise ValueError(f"the state of copy {int(np.argwhere(~np.isfinite(states))[0][0])} is not finite")
    if restart is None:
        return states, np.zeros(len(states), dtype=np.bool_)
    begun = np.asarray(restart, dtype=bool)
    if begun.shape != (len(states),):
        raise ValueError(f"expected restart as ({len(states)},), got shape {begun.shape}")
    return states, begun
