"""Stable-Baselines3 on a Gymnasium vector environment, without a Python loop over its copies.

SB3's own `make_vec_env` steps one Python environment after another. `SB3VecEnv` hands a whole batch to a native
vector environment and translates only what differs: `dones`, and an info of its own for each copy that finished.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn


class SB3VecEnv(VecEnv):
    """A Gymnasium vector environment as an SB3 `VecEnv`.

    Where copy i finishes, `infos[i]` holds "terminal_observation", "TimeLimit.truncated" and "episode" (return r,
    length l, time t, as SB3's Monitor writes them), so that neither Monitor nor VecMonitor is needed.

    Args:
        env: a vector environment with autoreset SAME_STEP.

    Raises:
        TypeError: not a vector environment.
        ValueError: another autoreset mode; SB3 takes the reset observation in the step that ends an episode.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(env, VectorEnv):
            raise TypeError(
                f"expected a gymnasium VectorEnv, got {type(env).__name__}; make one with gym.make_vec(..., "
                'vectorization_mode="vector_entry_point", autoreset_mode="SAME_STEP")'
            )
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                f"expected a vector environment with autoreset_mode SAME_STEP, got {mode}; "
                'pass autoreset_mode="SAME_STEP" to gym.make_vec'
            )
        self.env = env
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._start = time.time()
        self._actions: NDArray[Any] | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def _get_render_mode(self, render_mode: str | None) -> Any:
        return render_mode

    def reset(self) -> VecEnvObs:
        """Start every episode; seeds given to `seed` and options to `set_options` are used once."""
        seed = list(self._seeds) if any(s is not None for s in self._seeds) else None
        options = self._options[0] if self._options and self._options[0] else None
        observations, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self.reset_infos = [_row(infos, i) for i in range(self.num_envs)] if infos else self._empty_infos()
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions (n, ...) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Observations (n, ...), rewards (n,) float32, dones (n,), one info a copy."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        rows = self._empty_infos()
        if set(infos) - _FINAL:
            rows = [_row(infos, i) for i in range(self.num_envs)]
        if dones.any():
            elapsed = round(time.time() - self._start, 6)
            final = infos["final_obs"]
            for i in np.flatnonzero(dones).tolist():
                rows[i] |= {
                    "terminal_observation": final[i],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {
                        "r": round(float(self._returns[i]), 6),
                        "l": int(self._lengths[i]),
                        "t": elapsed,
                    },
                }
            self._returns[dones] = 0.0
            self._lengths[dones] = 0
        return observations, rewards.astype(np.float32), dones, rows

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute for each copy: the batch's own, split where it has one row a copy."""
        chosen = list(self._get_indices(indices))
        target: Any = self.env if hasattr(self.env, attr_name) else self.env.unwrapped
        if not hasattr(target, attr_name) and hasattr(target, "get_attr"):  # separate copies: SyncVectorEnv
            values = target.get_attr(attr_name)
            return [values[i] for i in chosen]
        value = getattr(target, attr_name)
        if isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,):
            return [value[i] for i in chosen]
        return [value for _ in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the whole batch.

        Raises:
            ValueError: for some copies only; they are one object.
        """
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(
                f"cannot set {attr_name!r} for some copies only: all copies are one vector environment"
            )
        setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once; its answer is repeated for each copy asked for."""
        target = self.env if hasattr(self.env, method_name) else self.env.unwrapped
        answer = getattr(target, method_name)(*args, **kwargs)
        return [answer for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """True for each copy where the batch is wrapped by this vector wrapper; Monitor counts as there."""
        from stable_baselines3.common.monitor import Monitor

        found, env = issubclass(wrapper_class, Monitor), self.env
        while not found and env is not env.unwrapped:
            found = isinstance(env, wrapper_class)
            env = env.env  # type: ignore[attr-defined]
        return [found for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A picture of each copy."""
        pictures: Any = self.env.render() if self.env.render_mode is not None else None
        return list(pictures) if pictures is not None else [None] * self.num_envs

    def _empty_infos(self) -> list[dict[str, Any]]:
        return [{} for _ in range(self.num_envs)]

    def _get_indices(self, indices: VecEnvIndices) -> Iterable[int]:
        return super()._get_indices(indices)


_FINAL = {"final_obs", "_final_obs", "final_info", "_final_info"}


def _row(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """The info of copy i out of Gymnasium's batched infos; what belongs to finished episodes is left out."""
    row: dict[str, Any] = {}
    for key, value in infos.items():
        if key.startswith("_") or key in ("final_obs", "final_info"):
            continue
        present = infos.get(f"_{key}")
        if present is None or present[i]:
            row[key] = _row(value, i) if isinstance(value, dict) else value[i]
    return row
