"""n copies of one system in time: states, random streams, step counts and the checks at the door.

The single environment (n = 1) and the native vector environment (n copies) are both thin faces of this class,
so that they cannot disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.kernel import (
    NAN_ACTION,
    NO_LIMIT,
    NOT_FINITE,
    TERMINATED,
    TRUNCATED,
    Outcome,
    make_kernel,
)
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
        columns: which components of the system's observation to show; all by default.
        max_steps: steps after which an episode is truncated; None for no limit.
    """

    def __init__(
        self,
        system: System,
        n: int,
        name: str,
        columns: Sequence[int] | None = None,
        max_steps: int | None = None,
    ) -> None:
        self.system = system
        self.name = name
        self.kernel = make_kernel(
            system, range(len(system.observation_names)) if columns is None else columns
        )
        self.state: NDArray[np.float64] = np.zeros((n, system.n_state))
        self.steps = np.zeros(n, dtype=np.int64)
        self._limit = NO_LIMIT if max_steps is None else max_steps
        self._streams: RandomStreams | None = None
        self._noise_size = system.noise_size

    def __len__(self) -> int:
        return len(self.steps)

    def observe(self) -> NDArray[np.float32]:
        """(n, n_shown) what is shown of the states, in an array of its own."""
        return self.kernel.observe(self.state)

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
            ValueError: a start state of the wrong shape, not finite or not possible; names the copy.
        """
        if self._streams is None:
            self._streams = RandomStreams(fresh_seeds(len(self)))
        if seeds is not None:
            self._streams.reseed(seeds)
        drawn = (
            self.system.initial_state(self._streams, mask) if state is None else self._checked_state(state)
        )
        if mask is None or mask.all():
            self.state = np.array(drawn)
            self.steps[:] = 0
        else:
            self.state = np.where(mask[:, None], drawn, self.state)
            self.steps[mask] = 0

    def step(
        self, action: NDArray[np.float64], active: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], bool]:
        """Step every copy (or the active ones) by one control period.

        Args:
            action: (n, n_action), of the shape that `shaped_action` has checked.
            active: (n,) the copies that move; the others keep their state and draw no noise.

        Returns:
            reward (n,), terminated (n,), truncated (n,), and whether any copy is one of the two.

        Raises:
            ValueError: NaN in an action; names the copy, the component and the step.
            NonFiniteError: a state became NaN or infinite; names the copy, the component and the step.
        """
        state, n = self.state, len(self.steps)
        noise = None
        if self._noise_size:
            if self._streams is None:
                raise RuntimeError(f"{self.name}: step before reset; call reset() first")
            noise = self._streams.normal(self._noise_size, active)
        next_state = np.empty_like(state)
        reward = np.empty(n)
        terminated = np.empty(n, dtype=np.bool_)
        truncated = np.empty(n, dtype=np.bool_)
        out = Outcome(next_state, reward, terminated, truncated)
        flags = self.kernel.step(state, action, noise, self.steps, self._limit, out)
        if active is not None:
            still = ~active
            self.steps[still] -= 1
            next_state[still] = state[still]
            reward[still] = 0.0
            terminated[still] = truncated[still] = False
        if flags & (NAN_ACTION | NOT_FINITE):
            self.steps -= 1 if active is None else active
            self._tell_what_is_wrong(next_state, action)
            self.steps += 1 if active is None else active
        self.state = next_state
        return reward, terminated, truncated, bool(flags & (TERMINATED | TRUNCATED))

    def shaped_action(self, action: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """The action as (n, n_action) float64; infinite numbers are clipped to the limits by the system.

        Raises:
            ValueError: another shape.
        """
        array = np.asarray(action, dtype=np.float64)
        if array.shape != shape:
            raise ValueError(
                f"{self.name}: expected an action of shape {shape} ({', '.join(self.system.action_names)}), "
                f"got shape {array.shape}"
            )
        return array.reshape(len(self.steps), -1)

    def _checked_state(self, state: Any) -> NDArray[np.float64]:
        array = np.asarray(state, dtype=np.float64)
        if array.shape not in ((self.system.n_state,), self.state.shape):
            raise ValueError(
                f"{self.name}: expected a start state of shape {(self.system.n_state,)} "
                f"({', '.join(self.system.state_names)}), or one for each of {len(self)} copies, got {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{self.name}: expected a finite start state, got {array.tolist()}")
        states = np.broadcast_to(array, self.state.shape)
        self._tell_what_is_impossible(states)
        return states

    def _tell_what_is_impossible(self, states: NDArray[np.float64]) -> None:
        system = self.system
        low, high = system.state_limits
        for copy, component in np.argwhere((states < low) | (states > high)):
            raise ValueError(
                f"{self.name}: impossible start state of copy {copy}: expected {system.state_names[component]!r} "
                f"within {low[component]:g}..{high[component]:g}, got {states[copy, component]:g}"
            )
        for start in system.quaternions:
            norm = np.sqrt((states[:, start : start + 4] ** 2).sum(axis=1))
            for copy in np.flatnonzero(np.abs(norm - 1.0) > 1e-6):
                raise ValueError(
                    f"{self.name}: impossible start state of copy {copy}: expected a quaternion of norm 1 in "
                    f"{', '.join(system.state_names[start : start + 4])}, got norm {norm[copy]:g}; divide it by "
                    "its norm"
                )
        nearest = np.asarray(system.project(states))
        for copy, component in np.argwhere(np.abs(states - nearest) > 1e-6):
            raise ValueError(
                f"{self.name}: impossible start state of copy {copy}: the nearest possible "
                f"{system.state_names[component]!r} is {nearest[copy, component]:g}, got {states[copy, component]:g}"
            )
        for copy in np.flatnonzero(np.asarray(system.terminated(states))):
            raise ValueError(
                f"{self.name}: impossible start state of copy {copy}: the episode would already be over there "
                f"(state: {states[copy].tolist()})"
            )

    def _tell_what_is_wrong(self, state: NDArray[np.float64], action: NDArray[np.float64]) -> None:
        for copy, component in np.argwhere(np.isnan(action)):
            raise ValueError(
                f"{self.name}: action {self.system.action_names[component]!r} of copy {copy} is NaN at step "
                f"{self.steps[copy] + 1} of its episode; look at what produced it (a diverged policy, a 0/0)"
            )
        for copy, component in np.argwhere(~np.isfinite(state)):
            raise NonFiniteError(
                f"{self.name}: state {self.system.state_names[component]!r} of copy {copy} became "
                f"{state[copy, component]} at step {self.steps[copy] + 1} of its episode (state before: "
                f"{self.state[copy].tolist()}, action: {action[copy].tolist()}); a smaller dt or milder "
                "parameters may help"
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
