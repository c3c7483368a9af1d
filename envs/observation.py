"""What an environment shows of a state: the named components it keeps, as float32, and their space."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from beliefgym.envs.system import System


class Observer:
    """The kept components of a system's full observation.

    Args:
        system: the system.
        components: names to keep, in the order wanted; None keeps all.

    Raises:
        ValueError: an unknown, repeated or empty list of names.
    """

    def __init__(self, system: System, components: Sequence[str] | None) -> None:
        available = system.observation_names
        self.names = tuple(available if components is None else components)
        if not self.names or len(set(self.names)) != len(self.names):
            raise ValueError(f"expected at least one component, each once, got {list(self.names)}")
        for name in self.names:
            if name not in available:
                near = get_close_matches(str(name), available, n=1)
                raise ValueError(
                    f"{type(system).__name__} has no observation component {name!r}"
                    + (f"; did you mean {near[0]!r}?" if near else "")
                    + f" (it has {', '.join(available)})"
                )
        index = [available.index(name) for name in self.names]
        prefix = index == list(range(len(index)))
        self._system = system
        self._columns: slice | list[int] | None = None
        if (components is not None and len(index) < len(available)) or not prefix:
            self._columns = slice(0, len(index)) if prefix else index
        low, high = system.observation_limits
        self.space = Box(low[index].astype(np.float32), high[index].astype(np.float32), dtype=np.float32)

    def __call__(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """(..., n_state) -> (..., n_kept), float32, in an array of its own."""
        full = self._system.observe(state)
        if self._columns is not None:
            full = full[..., self._columns]
        return full.astype(np.float32)
