"""`LearnedModel`: a fitted dynamics model in the form that the planners take, in the place of a true system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning import DynamicsModel
from beliefgym.learning.model_derivatives import derivatives

Floats = NDArray[np.float64]
Cost = Callable[[Any, Any], Any]


@runtime_checkable
class PlanningModel(Protocol):
    """What a planner asks of a model: every `System` has it, and `LearnedModel`.

    `flow` runs on torch tensors too, so that it can be differentiated; or the model has `derivatives(state, action)`,
    giving A (..., n, n) and B (..., n, m) as numpy arrays, and then only `stage_cost` need run on torch.
    """

    @property
    def n_state(self) -> int:
        """n."""

    @property
    def n_action(self) -> int:
        """m."""

    @property
    def action_limits(self) -> tuple[Floats, Floats]:
        """Lowest and highest action, each (m,)."""

    def flow(self, state: Any, action: Any) -> Any:
        """The next state: (..., n), (..., m) -> (..., n)."""

    def stage_cost(self, state: Any, action: Any) -> Any:
        """(..., n), (..., m) -> (...)."""

    def clip(self, action: Any) -> Any:
        """The action within its limits."""


@dataclass(frozen=True, eq=False)
class LearnedModel:
    """x_{t+1} = f(x_t, u_t) from a fitted `DynamicsModel`, with action limits and a cost.

    Args:
        dynamics: fitted to trajectories of x and u.
        action_limits: lowest and highest action, each (m,).
        cost: (x (..., n), u (..., m)) -> (...), on numpy and torch arrays.
        difference_step: of central differences where the regressor has no derivative of its own (forests), in
            standard deviations; see `learning.model_derivatives`.
    """

    dynamics: DynamicsModel
    action_limits: tuple[Floats, Floats]
    cost: Cost
    difference_step: float | None = None

    @property
    def n_state(self) -> int:
        """n."""
        return self.dynamics.n_obs_

    @property
    def n_action(self) -> int:
        """m."""
        return len(self.action_limits[0])

    def flow(self, state: Floats, action: Floats) -> Floats:
        """The next state, (..., n); NaN or infinite where the model diverges."""
        return self.dynamics.flow(state, action)

    def derivatives(self, state: Floats, action: Floats) -> tuple[Floats, Floats]:
        """A (..., n, n) and B (..., n, m)."""
        return derivatives(self.dynamics, state, action, self.difference_step)

    def stage_cost(self, state: Any, action: Any) -> Any:
        """The cost, (...)."""
        return self.cost(state, action)

    def clip(self, action: Floats) -> Floats:
        """The action within its limits."""
        return np.minimum(np.maximum(action, self.action_limits[0]), self.action_limits[1])
