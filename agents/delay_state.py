"""`DelayState`: positions without velocities become a state, by differences over the last steps, as a filter.

    b_t = (y_t, (y_t - y_{t-1})/dt, .., (y_{t-k+2} - y_{t-k+1})/dt, u_{t-1}, .., u_{t-k+1})

holds the last k observations and k - 1 actions, in an invertible linear form of the delay embedding whose differences
have the size of velocities, so that a dynamics model need not find a small difference of two large inputs. A sampled
second-order system under held actions is Markov in it from k = 2 on; more delays average measurement noise.
At an episode's start the past is taken to be at rest: y_0 throughout, and no action.

Reference: Takens 1981, "Detecting strange attractors in turbulence" (delays); thesis proposal, Sec. 3.3 (filters).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.planning.model_lqr import wrapped_difference

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DelayState:
    """The belief above.

    Args:
        n_obs: components of y. n_act: of u. n_delays: k, at least 1; 1 leaves y alone.
        dt: s, the unit of the differences. angles: components of y whose differences are wrapped.

    Raises:
        ValueError: numbers out of range.
    """

    n_obs: int
    n_act: int
    n_delays: int
    dt: float = 1.0
    angles: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.n_delays < 1:
            raise ValueError(f"expected n_delays of at least 1, got {self.n_delays!r}")
        if not self.dt > 0:
            raise ValueError(f"expected dt above 0, got {self.dt!r}")

    @property
    def belief_size(self) -> int:
        """k n_obs + (k - 1) n_act."""
        return self.n_delays * self.n_obs + (self.n_delays - 1) * self.n_act

    def names(self, observations: Collection[str], actions: Collection[str]) -> tuple[str, ...]:
        """Of the belief's components: "x", "rate_x", "rate_x[-1]", .., "force[-1]", .."""
        found = list(observations)
        for d in range(self.n_delays - 1):
            found += [f"rate_{name}" if d == 0 else f"rate_{name}[-{d}]" for name in observations]
        for d in range(1, self.n_delays):
            found += [f"{name}[-{d}]" for name in actions]
        return tuple(found)

    def initial_belief(self, n: int) -> Floats:
        """Nothing seen: NaN, (n, belief_size)."""
        return np.full((n, self.belief_size), np.nan)

    def update(self, belief: Floats, observation: Floats, action: Floats | None = None) -> Floats:
        """One step on.

        Args:
            belief: (n, belief_size); a row of NaN begins.
            observation: (n, n_obs), of now.
            action: (n, n_act), that led here; not needed in the first step.

        Returns:
            (n, belief_size).
        """
        o, k = self.n_obs, self.n_delays
        begun = np.isnan(belief[:, 0])
        new = np.empty_like(belief)
        new[:, :o] = observation
        if k == 1:
            return new
        new[:, o : 2 * o] = wrapped_difference(observation, belief[:, :o], self.angles) / self.dt
        new[:, 2 * o : k * o] = belief[:, o : (k - 1) * o]
        acted = k * o
        new[:, acted : acted + self.n_act] = 0.0 if action is None else action
        new[:, acted + self.n_act :] = belief[:, acted : -self.n_act]
        new[begun, o:] = 0.0
        return new
