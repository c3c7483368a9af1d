"""The Gymnasium environment of any system."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from beliefgym.envs.description import Described
from beliefgym.envs.observation import Shown
from beliefgym.envs.random_streams import spread_seeds
from beliefgym.envs.simulation import Simulation, start_state
from beliefgym.envs.system import System, build_system

RENDER_MODES = ["rgb_array", "human"]


def load_system(system: str | type[System] | System, parameters: dict[str, Any]) -> System:
    """A system from `module:Class`, a class, or an instance (which takes no further parameters)."""
    if isinstance(system, System):
        if parameters:
            raise TypeError(f"a finished system takes no further parameters, got {sorted(parameters)}")
        return system
    if isinstance(system, str):
        module, _, name = system.partition(":")
        system = getattr(import_module(module), name)
    if not (isinstance(system, type) and issubclass(system, System)):
        raise TypeError(f"expected a System, its class or 'module:Class', got {system!r}")
    return build_system(system, parameters)


def action_space(system: System) -> Box:
    """The box of a system's action limits, float32."""
    low, high = system.action_limits
    return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


class SystemEnv(Described, gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One copy of a system as a Gymnasium environment.

    `env.unwrapped.state` is the true state; `reset(options={"state": s})` starts from s. The same seed gives the
    same trajectory here and in the native vector environment.

    Args:
        system: a `System`, its class, or "module:Class".
        components: the observation components to show, by name; all by default.
        hint: put the privileged quantities of `hint_names` (the true state, unless the system names others) into
            `info["hint"]`; for training only.
        render_mode: None, "rgb_array" or "human".
        **parameters: the system's parameters by name; an unknown one is an error.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 20}  # noqa: RUF012 (as in gym.Env)

    def __init__(
        self,
        system: str | type[System] | System,
        components: Sequence[str] | None = None,
        hint: bool = False,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"expected render_mode None or one of {RENDER_MODES}, got {render_mode!r}")
        self.system = load_system(system, parameters)
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.system.dt))}
        self.render_mode = render_mode
        self._shown = Shown(self.system, components)
        self.observation_space: Any = self._shown.space
        self.action_space: Any = action_space(self.system)
        self._hint = hint
        self._simulation = Simulation(self.system, 1, type(self.system).__name__, self._shown.columns)
        self._last_action: NDArray[np.float64] | None = None
        self._window: Any = None
        self._needs_reset = True

    @property
    def state(self) -> NDArray[np.float64]:
        """(n_state,) the true state."""
        return self._simulation.state[0].copy()

    def expert(self) -> Any:
        """The controller of `System.expert`."""
        return self.system.expert()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`. Option "state": the true start state (n_state,)."""
        super().reset(seed=seed)
        self._name_simulation()
        self._simulation.reset(spread_seeds(seed, 1), state=start_state(options, self._simulation.name))
        self._last_action = None
        self._needs_reset = False
        if self.render_mode == "human":
            self.render()
        return self._simulation.observe()[0], self._info()

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One control period; see `gymnasium.Env.step`.

        Raises:
            ValueError: an action of the wrong shape, or NaN.
            NonFiniteError: the simulation diverged.
        """
        simulation = self._simulation
        if self._needs_reset:
            raise gym.error.ResetNeeded(f"{simulation.name}: step before reset; call reset() first")
        action = simulation.shaped_action(action, (self.system.n_action,))
        reward, terminated, _, _ = simulation.step(action)
        self._last_action = action[0]
        if self.render_mode == "human":
            self.render()
        return simulation.observe()[0], float(reward[0]), bool(terminated[0]), False, self._info()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The picture (height, width, 3) in mode "rgb_array"; shown in a window in mode "human"."""
        if self.render_mode is None:
            gym.logger.warn(
                'render() without a render_mode; make the environment with render_mode="rgb_array"'
            )
            return None
        from beliefgym.envs.rendering import Window, picture

        action = None if self._last_action is None else self.system.clip(self._last_action)
        frame = picture(self.system, self._simulation.state[0], action, self.observation_names)
        if self.render_mode == "rgb_array":
            return frame
        if self._window is None:
            self._window = Window(type(self.system).__name__)
        self._window.show(frame, self.metadata["render_fps"])
        return None

    def close(self) -> None:
        """Close the window, if one is open."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _info(self) -> dict[str, Any]:
        return {"hint": np.array(self.system.hint(self._simulation.state)[0])} if self._hint else {}

    def _name_simulation(self) -> None:
        if self.spec is not None:
            self._simulation.name = self.spec.id

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_window": None}
