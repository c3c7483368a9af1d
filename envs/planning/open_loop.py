"""Open-loop control from a model: simulate a simple feedback law on the model, and run the actions that it took.

    x_hat_{t+1} = f(x_hat_t, u_t),    u_t = clip(law(x_hat_t)),    x_hat_0 = x_0,    t < T

Nothing is looked at while the actions run, so the end of the path is as good as the model's many-step predictions: it
is the case in which those matter most.

Reference: thesis proposal, Sec. 3.2.3 (Videre Erratic: "simulating the learned dynamics model with a simple
proportional controller").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ProportionalLaw:
    """A differential-drive base towards the goal as it sees it, (forward, left) in its own frame.

        v = k_v (forward),    w = k_w atan2(left, forward), mirrored where the goal lies behind

    and near the goal (within `here`) w = -k_w theta turns to its heading.

    Args:
        forward, left, heading: numbers of the coordinates that hold the goal's place (m) and the own heading (rad).
        k_forward: 1/s. k_turn: 1/s. here: m.
    """

    forward: int = 0
    left: int = 1
    heading: int = 2
    k_forward: float = 1.0
    k_turn: float = 2.0
    here: float = 0.05

    def __call__(self, state: Floats) -> Floats:
        """(n, d) -> (n, 2) speed (m/s) and turning rate (rad/s)."""
        ahead, left, theta = state[:, self.forward], state[:, self.left], state[:, self.heading]
        side = np.where(ahead < 0.0, -1.0, 1.0)
        bearing = np.arctan2(side * left, side * ahead)
        far = np.hypot(ahead, left) > self.here
        heading = np.angle(np.exp(1j * theta))
        return np.stack([self.k_forward * ahead, self.k_turn * np.where(far, bearing, -heading)], axis=-1)


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """The policy of the module.

    Args:
        model: with `flow` and `action_limits`. law: (n, d) -> (n, m). horizon: T.
    """

    model: Any
    law: Any
    horizon: int

    def begin(self, n: int) -> list[Any]:
        """The memory of n copies: their actions (n, T, m), and the step each is in (n,)."""
        m = len(self.model.action_limits[0])
        return [np.zeros((n, self.horizon, m)), np.zeros(n, dtype=np.int64)]

    def act(self, state: Floats, memory: list[Any], restart: NDArray[np.bool_]) -> Floats:
        """The next action of each copy; (n, m)."""
        actions, clock = memory
        rows = np.flatnonzero(restart)
        if len(rows):
            actions[rows] = self.simulate(state[rows])[1]
            clock[rows] = 0
        t = np.minimum(clock, self.horizon - 1)
        action: Floats = np.where((clock < self.horizon)[:, None], actions[np.arange(len(t)), t], 0.0)
        clock += 1
        return action

    def simulate(self, state: Floats) -> tuple[Floats, Floats]:
        """The path on the model from states (n, d): (n, T + 1, d), and the actions (n, T, m).

        Where the model diverges the path stays at its last finite state.
        """
        low, high = self.model.action_limits
        path, actions = [state], []
        for _ in range(self.horizon):
            action = np.clip(self.law(path[-1]), low, high)
            with np.errstate(over="ignore", invalid="ignore"):
                moved = self.model.flow(path[-1], action)
            path.append(np.where(np.isfinite(moved).all(axis=-1, keepdims=True), moved, path[-1]))
            actions.append(action)
        return np.stack(path, axis=1), np.stack(actions, axis=1)
