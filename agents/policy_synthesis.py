"""Which policy is made of a learned model: step 4 of DAgger system identification (Fig. 3.9), as plain data.

A `Synthesis` turns a model into a policy with `begin(n) -> memory` and `act(x, memory, restart) -> u`, batched:

- `RecedingHorizonSynthesis`: iLQR, planned anew every few steps, or once an episode and tracked by its gains;
- `RegulatorSynthesis`: the LQR about a target, for ever or over a horizon;
- `OpenLoopSynthesis`: the actions of a proportional controller that is simulated on the model, run without feedback.

Reference: thesis proposal, Sec. 3.2.3: iLQR (cart-pole), steady-state LQR (helicopter, Baxter), open loop (Erratic).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.planning.learned_model import LearnedModel
from beliefgym.envs.planning.model_lqr import LinearFeedback, terminal_cost_of
from beliefgym.envs.planning.open_loop import OpenLoop, ProportionalLaw
from beliefgym.envs.planning.receding_horizon import RecedingHorizon

Floats = NDArray[np.float64]


class ModelPolicy(Protocol):
    """A policy on coordinates, for n copies at once."""

    def begin(self, n: int) -> Any:
        """The memory of n copies at the start of their episodes."""

    def act(self, state: Floats, memory: Any, restart: NDArray[np.bool_]) -> Floats:
        """(n, d), the memory (changed in place), (n,) where an episode begins -> (n, m)."""


class Synthesis(Protocol):
    """Makes a policy of a model."""

    def policy(
        self, model: LearnedModel, target: Floats, action: Floats, angles: Collection[int]
    ) -> ModelPolicy:
        """The policy.

        Args:
            model: learned, with limits and a cost. target: (d,) the state of lowest cost. action: (m,) its action.
            angles: components of the state that are angles.
        """


@dataclass(frozen=True)
class RecedingHorizonSynthesis:
    """Iterative LQR over a horizon; see `RecedingHorizon` for the arguments.

    Args:
        horizon: steps. every: steps between plans; 0 for one plan an episode, tracked to its end.
        hold, candidates, iterations, again: of `RecedingHorizon`. candidates=1 starts from actions of zero, as the
            thesis's cart-pole does.
        lqr_beyond: charge the LQR's cost at the target for what lies beyond the horizon, where it exists.
    """

    horizon: int = 40
    every: int = 1
    hold: int = 3
    candidates: int = 8
    iterations: int = 60
    again: int = 3
    lqr_beyond: bool = False

    def policy(
        self, model: LearnedModel, target: Floats, action: Floats, angles: Collection[int]
    ) -> RecedingHorizon:
        """See `Synthesis.policy`."""
        return RecedingHorizon(
            model=model,
            horizon=self.horizon,
            terminal_cost=terminal_cost_of(model, target, action, angles) if self.lqr_beyond else None,
            angles=tuple(angles),
            hold=self.hold,
            candidates=self.candidates,
            iterations=self.iterations,
            again=self.again,
            every=self.every or self.horizon,
        )


@dataclass(frozen=True)
class RegulatorSynthesis:
    """The LQR about the target; see `LinearFeedback`.

    Args:
        horizon: steps; None for the steady state.
    """

    horizon: int | None = None

    def policy(
        self, model: LearnedModel, target: Floats, action: Floats, angles: Collection[int]
    ) -> LinearFeedback:
        """See `Synthesis.policy`."""
        return LinearFeedback.of(model, target, action, horizon=self.horizon, angles=angles)


@dataclass(frozen=True)
class OpenLoopSynthesis:
    """A law simulated on the model from the episode's first state, its actions run open-loop.

    Args:
        law: coordinates (n, d) -> actions (n, m), such as `ProportionalLaw`.
        horizon: steps; the last action's place is taken by 0 afterwards.
    """

    law: ProportionalLaw
    horizon: int

    def policy(
        self, model: LearnedModel, target: Floats, action: Floats, angles: Collection[int]
    ) -> OpenLoop:
        """See `Synthesis.policy`."""
        return OpenLoop(model, self.law, self.horizon)
