"""n copies of one system in time: states, random streams, step counts and the checks at the door.

The single environment (n = 1) and the native vector environment (n copies) are both thin faces of this class,
so that they cannot disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.random_streams import RandomStreams, fresh_seeds
from beliefgym.envs.system import System


class NonFiniteError(FloatingPointError):
    """A simulated state stopped being a finite number."""


class Simulation:
    """n copies of a system, stepped together.

    Attributes:
        state: (n, n_state) the true states.
        steps: (n,) steps taken in the running episode.

    Args:
        system: the system.
        n: number of copies.
        name: what error messages call it (the environment id).
    """

    def __init__(self, system: System, n: int, name: str) -> None:
        self.system = system
        self.name = name
        self.state: NDArray[np.float64] = np.zeros((n, system.n_state))
        self.steps = np.zeros(n, dtype=np.int64)
        self._streams: RandomStreams | None = None
        self._noise_size = system.noise_size

    def __len__(self) -> int:
        return len(self.steps)

    def reset(
        self,
        seeds: Sequence[int | None] | None = None,
        mask: NDArray[np.bool_] | None = None,
        state: Any = None,
    ) -> None:
        """Start new episodes.

        Args:
            seeds: a seed for each copy; None goes on with the copy's running stream.
            mask: (n,) the copies that start anew; all by default.
            state: start state (n_state,) or (n, n_state) instead of a drawn one.

        Raises:
            ValueError: a start state of the wrong shape or not finite.
        """
        if self._streams is None:
            self._streams = RandomStreams(fresh_seeds(len(self)))
        if seeds is not None:
            self._streams.reseed(seeds)
        drawn = (
            self.system.initial_state(self._streams, mask) if state is None else self._checked_state(state)
        )
        if mask is None:
            self.state = drawn.copy()
            self.steps[:] = 0
        else:
            self.state = np.where(mask[:, None], drawn, self.state)
            self.steps[mask] = 0

    def step(
        self, action: NDArray[np.float64], active: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Step every copy (or the active ones) by one control period.

        Args:
            action: (n, n_action), checked by `checked_action`.
            active: (n,) the copies that move; the others keep their state and draw no noise.

        Returns:
            reward (n,), terminated (n,).

        Raises:
            NonFiniteError: a state became NaN or infinite; names the copy, the component and the step.
        """
        system, state = self.system, self.state
        action = system.clip(action)
        noise = None
        if self._noise_size:
            if self._streams is None:
                raise RuntimeError(f"{self.name}: step before reset; call reset() first")
            noise = self._streams.normal(self._noise_size, active)
        next_state = system.step(state, action, noise)
        if active is not None:
            next_state = np.where(active[:, None], next_state, state)
        if not np.isfinite(next_state.sum()):
            self._tell_non_finite(next_state, action)
        reward = system.reward(state, action, next_state)
        self.state = next_state
        self.steps += 1 if active is None else active
        return reward, system.terminated(next_state)

    def checked_action(self, action: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """The action as (n, n_action) float64.

        Raises:
            ValueError: another shape, or NaN; infinite numbers are clipped to the limits by the system.
        """
        array = np.asarray(action, dtype=np.float64)
        if array.shape != shape:
            raise ValueError(
                f"{self.name}: expected an action of shape {shape} ({', '.join(self.system.action_names)}), "
                f"got shape {array.shape}"
            )
        if np.isnan(array.sum()) and np.isnan(array).any():
            copy, component = np.argwhere(np.isnan(array.reshape(len(self), -1)))[0]
            raise ValueError(
                f"{self.name}: action {self.system.action_names[component]!r} of copy {copy} is NaN at step "
                f"{self.steps[copy]} of its episode; look at what produced it (a diverged policy, a 0/0)"
            )
        return array.reshape(len(self), -1)

    def _checked_state(self, state: Any) -> NDArray[np.float64]:
        array = np.asarray(state, dtype=np.float64)
        if array.shape not in ((self.system.n_state,), self.state.shape):
            raise ValueError(
                f"{self.name}: expected a start state of shape {(self.system.n_state,)} "
                f"({', '.join(self.system.state_names)}), or one for each of {len(self)} copies, got {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{self.name}: expected a finite start state, got {array.tolist()}")
        return np.broadcast_to(array, self.state.shape)

    def _tell_non_finite(self, state: NDArray[np.float64], action: NDArray[np.float64]) -> None:
        bad = np.argwhere(~np.isfinite(state))
        if not len(bad):
            return
        copy, component = bad[0]
        raise NonFiniteError(
            f"{self.name}: state {self.system.state_names[component]!r} of copy {copy} became "
            f"{state[copy, component]} at step {self.steps[copy] + 1} of its episode (state before: "
            f"{self.state[copy].tolist()}, action: {action[copy].tolist()}); a smaller dt or milder parameters may help"
        )


def start_state(options: dict[str, Any] | None, name: str) -> Any:
    """The start state in reset options, or None.

    Raises:
        ValueError: an option that is not known here.
    """
    if not options:
        return None
    unknown = set(options) - {"state", "reset_mask"}
    if unknown:
        raise ValueError(
            f"{name}: unknown reset option {sorted(unknown)[0]!r}; known: 'state' (and 'reset_mask')"
        )
    return options.get("state")
