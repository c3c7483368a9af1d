"""What an environment says of itself, single or vector: the names of its components, and what steps it."""

from __future__ import annotations

from beliefgym.envs.observation import Shown
from beliefgym.envs.simulation import Simulation
from beliefgym.envs.system import System


class Described:
    """Names for an environment that has a system, a simulation of it, and shows a part of its observation."""

    system: System
    _simulation: Simulation
    _shown: Shown
    _hint: bool

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the components that are shown."""
        return self._shown.names

    @property
    def kernel_name(self) -> str:
        """What steps it: "numba" (a fused, compiled loop) or "numpy"; see kernel.py."""
        return self._simulation.kernel.name

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the components of the true state, and of the hint."""
        return self.system.state_names

    @property
    def hint_names(self) -> tuple[str, ...] | None:
        """Names of the hint's components, if hints were asked for."""
        return (self.system.hint_names or self.system.state_names) if self._hint else None

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the action components."""
        return self.system.action_names
