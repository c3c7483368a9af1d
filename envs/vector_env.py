"""The native vector environment: n copies of a system, stepped by one set of array operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from beliefgym.envs.description import Described
from beliefgym.envs.env import RENDER_MODES, action_space, load_system
from beliefgym.envs.observation import Shown
from beliefgym.envs.random_streams import spread_seeds
from beliefgym.envs.simulation import Simulation, start_state
from beliefgym.envs.system import System

_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)


class SystemVectorEnv(Described, VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """n copies of a system as one Gymnasium vector environment.

    Copy i of `reset(seed=s)` goes through the trajectory that the single environment goes through after
    `reset(seed=s + i)`, whatever the other copies do. With autoreset SAME_STEP, `infos["final_obs"]` (an object
    array under the mask `infos["_final_obs"]`) and `infos["final_info"]["state"]` hold the end of the episodes
    that have just finished, while the returned observation is already the next episode's first.

    Args:
        system: a `System`, its class, or "module:Class".
        num_envs: number of copies.
        max_episode_steps: steps after which an episode is truncated; None for no limit.
        components: the observation components to show, by name; all by default.
        hint: put the privileged quantities of `hint_names` (n, n_hint) into `infos["hint"]`; for training only.
        autoreset_mode: an `AutoresetMode` or its name; Gymnasium's default NEXT_STEP by default.
        render_mode: None or "rgb_array" (`render()` then gives one picture a copy).
        **parameters: the system's parameters by name; an unknown one is an error.

    Raises:
        ValueError: fewer than one copy, a time limit below 1, an unknown autoreset or render mode.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES[:1], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        system: str | type[System] | System,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        components: Sequence[str] | None = None,
        hint: bool = False,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"expected num_envs of at least 1, got {num_envs!r}")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"expected max_episode_steps of at least 1 or None, got {max_episode_steps!r}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"expected render_mode None or 'rgb_array', got {render_mode!r}")
        self.system = load_system(system, parameters)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.max_episode_steps = max_episode_steps
        self._mode = _autoreset_mode(autoreset_mode)
        self.metadata = {
            **self.metadata,
            "autoreset_mode": self._mode,
            "render_fps": max(1, round(1.0 / self.system.dt)),
        }
        self._shown = Shown(self.system, components)
        self.single_observation_space = self._shown.space
        self.single_action_space = action_space(self.system)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._hint = hint
        self._simulation = Simulation(
            self.system, num_envs, type(self.system).__name__, self._shown.columns, max_episode_steps
        )
        self._finished = np.zeros(num_envs, dtype=np.bool_)
        self._any_finished = False
        self._last_action: NDArray[np.float64] | None = None
        self._needs_reset = True

    @property
    def state(self) -> NDArray[np.float64]:
        """(n, n_state) the true states."""
        return self._simulation.state.copy()

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """When finished copies start anew (TorchRL asks for it by this name, as SyncVectorEnv has it)."""
        return self._mode

    def expert(self) -> Any:
        """The controller of `System.expert`."""
        return self.system.expert()

    def reset(  # type: ignore[override]
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: s gives copy i the seed s + i; a sequence gives one each; None goes on with the running streams.
            options: "state" (n_state,) or (n, n_state): true start states; "reset_mask" (n,) bool: the copies to
                reset (autoreset DISABLED); the others stay as they are.

        Returns:
            observations (n, n_kept), infos.
        """
        if self.spec is not None:
            self._simulation.name = self.spec.id
        name = self._simulation.name
        mask = None if options is None else options.get("reset_mask")
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise ValueError(
                    f"{name}: expected reset_mask with a bool for each of {self.num_envs} copies, one true"
                )
            if self._needs_reset and not mask.all():
                raise ValueError(
                    f"{name}: the first reset must be of all copies, got a reset_mask of {mask.sum()}"
                )
        seeds = None if seed is None else spread_seeds(seed, self.num_envs)
        if seeds is not None and mask is not None:
            seeds = [s if chosen else None for s, chosen in zip(seeds, mask, strict=True)]
        self._simulation.reset(seeds, mask, start_state(options, name))
        self._finished &= False if mask is None else ~mask
        self._any_finished = bool(self._finished.any())
        self._last_action = None
        self._needs_reset = False
        return self._simulation.observe(), self._infos()

    def step(  # type: ignore[override]
        self, actions: Any
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Step every copy by one control period; see `gymnasium.vector.VectorEnv.step`.

        Raises:
            ValueError: actions of the wrong shape, or NaN (naming copy and step).
            NonFiniteError: the simulation diverged.
            ResetNeeded: autoreset DISABLED and a finished copy was not reset.
        """
        simulation = self._simulation
        if self._needs_reset:
            raise gym.error.ResetNeeded(f"{simulation.name}: step before reset; call reset() first")
        actions = simulation.shaped_action(actions, (self.num_envs, self.system.n_action))
        self._last_action = actions
        restarting = self._finished if self._any_finished else None
        if restarting is not None and self._mode == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded(
                f"{simulation.name}: copy {int(np.argmax(restarting))} has finished; "
                'call reset(options={"reset_mask": ...}) for it'
            )
        active = None if restarting is None else ~restarting
        reward, terminated, truncated, any_done = simulation.step(actions, active)
        if restarting is not None:
            simulation.reset(mask=restarting)
        if not any_done:
            self._any_finished = False
            return simulation.observe(), reward, terminated, truncated, self._infos()
        done = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP:
            final_state = simulation.state
            simulation.reset(mask=done)
            return simulation.observe(), reward, terminated, truncated, self._final_infos(final_state, done)
        self._finished, self._any_finished = done, bool(done.any())
        return simulation.observe(), reward, terminated, truncated, self._infos()

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """One picture (height, width, 3) for each copy."""
        if self.render_mode is None:
            gym.logger.warn(
                'render() without a render_mode; make the environment with render_mode="rgb_array"'
            )
            return None
        from beliefgym.envs.rendering import picture

        actions = [None] * self.num_envs if self._last_action is None else self.system.clip(self._last_action)
        return tuple(
            picture(self.system, state, action, self.observation_names)
            for state, action in zip(self._simulation.state, actions, strict=True)
        )

    def _infos(self) -> dict[str, Any]:
        if not self._hint:
            return {}
        hint = np.array(self.system.hint(self._simulation.state))
        return {"hint": hint, "_hint": np.ones(self.num_envs, dtype=np.bool_)}

    def _final_infos(self, final_state: NDArray[np.float64], done: NDArray[np.bool_]) -> dict[str, Any]:
        final_observations = np.full(self.num_envs, None, dtype=object)
        rows = np.flatnonzero(done)
        for row, observation in zip(rows, self._simulation.kernel.observe(final_state[rows]), strict=True):
            final_observations[row] = observation
        final_info: dict[str, Any] = {"state": final_state, "_state": done}
        if self._hint:
            final_info |= {"hint": np.array(self.system.hint(final_state)), "_hint": done}
        return self._infos() | {
            "final_obs": final_observations,
            "_final_obs": done,
            "final_info": final_info,
            "_final_info": done,
        }


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    for known in _MODES:
        if mode in (known, known.value, known.name):
            return known
    raise ValueError(f"expected autoreset_mode to be one of {[known.name for known in _MODES]}, got {mode!r}")
