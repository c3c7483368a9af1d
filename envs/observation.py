"""What an environment shows of a state: the named components that it keeps, and their space."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np
from gymnasium.spaces import Box

from beliefgym.envs.system import System


class Shown:
    """The kept components of a system's full observation.

    Attributes:
        names: of the components. columns: their places in the full observation. space: a float32 box.

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
        self.columns = tuple(available.index(name) for name in self.names)
        low, high = system.observation_limits
        index = list(self.columns)
        self.space = Box(low[index].astype(np.float32), high[index].astype(np.float32), dtype=np.float32)
