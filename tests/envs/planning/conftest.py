"""Small systems whose optimal control is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.system import Array, System


@dataclass(frozen=True, kw_only=True)
class Linear(System):
    """s' = A s + B u with cost s'Qs + u'Ru; 3 states, 2 actions, open-loop unstable, all matrices full."""

    limit: float = np.inf
    curl: float = 0.0  # of a cubic term that makes large states explode

    state_names: ClassVar = ("a", "b", "c")
    action_names: ClassVar = ("u", "v")
    observation_names: ClassVar = ("a", "b", "c")

    A: ClassVar = np.array([[1.05, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.05, 0.0, 1.1]])
    B: ClassVar = np.array([[0.0, 0.1], [0.5, 0.0], [0.2, 1.0]])
    Q: ClassVar = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 0.5]])
    R: ClassVar = np.array([[0.5, 0.1], [0.1, 0.3]])

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.full(2, -self.limit), np.full(2, self.limit)

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.full(3, -np.inf), np.full(3, np.inf)

    def flow(self, state: Array, action: Array) -> Array:
        xp = array_namespace(state)
        moved = state @ xp.asarray(self.A.T) + action @ xp.asarray(self.B.T)
        return moved + self.curl * state**3

    def observe(self, state: Array) -> Array:
        return state

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        xp = array_namespace(state)
        state_cost = ((state @ xp.asarray(self.Q)) * state).sum(-1)
        return -state_cost - ((action @ xp.asarray(self.R)) * action).sum(-1)

    def initial_state(self, streams: Any, mask: Any = None) -> NDArray[np.float64]:
        raise AssertionError("nothing here asks for start states")


@dataclass(frozen=True, kw_only=True)
class Cart(System):
    """A mass on a line, pushed: p'' = u. Costs are quadratic, or 1 a step until it has passed p = finish."""

    limit: float = 1.0
    finish: float | None = None

    state_names: ClassVar = ("position", "velocity")
    action_names: ClassVar = ("force",)
    observation_names: ClassVar = ("position", "velocity")

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.array([-self.limit]), np.array([self.limit])

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.full(2, -np.inf), np.full(2, np.inf)

    def flow(self, state: Array, action: Array) -> Array:
        xp = array_namespace(state)
        p, v, u = state[..., 0], state[..., 1], action[..., 0]
        return xp.stack([p + self.dt * v + 0.5 * self.dt**2 * u, v + self.dt * u], axis=-1)

    def observe(self, state: Array) -> Array:
        return state

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        if self.finish is not None:
            return -1.0 + 0.0 * next_state[..., 0]
        return -(state[..., 0] ** 2 + state[..., 1] ** 2 + 0.5 * action[..., 0] ** 2)

    def terminated(self, state: Array) -> Array:
        xp = array_namespace(state)
        passed = state[..., 0] > (np.inf if self.finish is None else self.finish)
        return xp.asarray(passed)

    def initial_state(self, streams: Any, mask: Any = None) -> NDArray[np.float64]:
        raise AssertionError("nothing here asks for start states")


@pytest.fixture(scope="session")
def linear_class() -> type[Linear]:
    return Linear


@pytest.fixture(scope="session")
def cart_class() -> type[Cart]:
    return Cart
