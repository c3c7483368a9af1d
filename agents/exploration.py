"""Policies that explore: at random, by an expert with or without noise, or by a policy that is disturbed at times.

The exploration distribution of agnostic system identification (Fig. 3.9; Ross & Bagnell 2012) may be any of them; the
helicopter's were a random and an expert policy, the arm's an epsilon-random one, "that added random perturbation to the
commanded control with epsilon probability" (Sec. 3.2.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Exploration:
    """How to explore, as plain data.

    Args:
        kind: "random", "expert" or "epsilon" (the agent's own present policy, disturbed; random while it has none).
        std: standard deviation of Gaussian actions ("random") or of the noise on actions ("expert", "epsilon"), as a
            share of half the action range, one number or one for each action; None for uniform actions over the whole
            range ("random", "epsilon"), and for no noise ("expert").
        epsilon: probability that an action is disturbed; only "epsilon".
        hold: steps for which a random action or disturbance is held.
        restoring: share of the sum of all disturbances so far that each action takes back. Where an action is the
            change of a control, the control is a random walk with 0; with 1 it is white noise about where it began,
            with 1 - rho it is autoregressive with the coefficient rho.

    Raises:
        ValueError: an unknown kind, or numbers out of range.
    """

    kind: str = "random"
    std: float | tuple[float, ...] | None = None
    epsilon: float = 0.2
    hold: int = 1
    restoring: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("random", "expert", "epsilon"):
            raise ValueError(f"expected kind to be 'random', 'expert' or 'epsilon', got {self.kind!r}")
        if isinstance(self.std, list):
            object.__setattr__(self, "std", tuple(self.std))
        if self.std is not None and not (np.isfinite(self.std).all() and np.min(self.std) >= 0):
            raise ValueError(f"expected std finite and at least 0, or None, got {self.std!r}")
        if not 0.0 <= self.epsilon <= 1.0:
            raise ValueError(f"expected epsilon within 0..1, got {self.epsilon!r}")
        if isinstance(self.hold, bool) or not isinstance(self.hold, int) or self.hold < 1:
            raise ValueError(f"expected hold to be a whole number of at least 1, got {self.hold!r}")
        if not 0.0 <= self.restoring <= 1.0:
            raise ValueError(f"expected restoring within 0..1, got {self.restoring!r}")


class Explorer:
    """An `Exploration` at work, in SB3's `predict`.

    Args:
        exploration: how.
        space: of the actions, bounded.
        rng: where its randomness comes from.
        base: the expert or the policy that is followed ("expert", "epsilon"); None for random actions.
    """

    def __init__(
        self, exploration: Exploration, space: Box, rng: np.random.Generator, base: Any = None
    ) -> None:
        self._how, self._rng, self._base = exploration, rng, base
        self._low, self._high = np.asarray(space.low, float), np.asarray(space.high, float)
        self._disturbance = np.zeros((0, *space.shape))
        self._disturbed = np.zeros(0, dtype=np.bool_)
        self._sum = np.zeros((0, *space.shape))
        self._clock = 0

    def predict(
        self,
        observation: ArrayLike,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Floats, Any]:
        """Actions of a batch (n, ...), and the state of the policy that is followed."""
        n = len(np.asarray(observation))
        if n != len(self._disturbance) or self._clock % self._how.hold == 0:
            self._draw(n)
        self._clock += 1
        disturbance = self._disturbance
        if self._how.restoring:
            disturbance = self._restored(disturbance, episode_start)
        if self._base is None:
            middle = 0.5 * (self._high + self._low)
            return np.clip(middle + disturbance, self._low, self._high), True
        action, state = self._base.predict(
            observation, state=state, episode_start=episode_start, deterministic=True
        )
        disturbed = np.asarray(action, dtype=float) + disturbance
        action = np.where(self._disturbed[:, None], disturbed, action)
        return np.clip(action, self._low, self._high), state

    def _restored(self, disturbance: Floats, episode_start: Any) -> Floats:
        """Disturbances that take back their share of the sum so far, within half the range."""
        if len(disturbance) != len(self._sum):
            self._sum = np.zeros_like(disturbance)
        elif episode_start is not None:
            self._sum[np.asarray(episode_start, dtype=np.bool_)] = 0.0
        half = 0.5 * (self._high - self._low)
        restored = np.clip(disturbance - self._how.restoring * self._sum, -half, half)
        applied = self._disturbed[:, None] | (self._base is None)
        self._sum = self._sum + np.where(applied, restored, 0.0)
        return restored

    def _draw(self, n: int) -> None:
        """Disturbances for the next `hold` steps, and whom they meet."""
        half, shape = 0.5 * (self._high - self._low), (n, len(self._low))
        how = self._how
        if how.std is not None:
            self._disturbance = np.asarray(how.std) * half * self._rng.standard_normal(shape)
        elif how.kind == "expert":
            self._disturbance = np.zeros(shape)
        else:
            self._disturbance = self._rng.uniform(-half, half, shape)
        self._disturbed = (
            self._rng.random(n) < how.epsilon if how.kind == "epsilon" else np.ones(n, dtype=np.bool_)
        )
