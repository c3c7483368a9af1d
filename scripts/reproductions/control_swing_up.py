"""The cart-pole swing-up as the model-based experiments have it: trials of 3 s at 20 Hz, and what counts as solved.

A policy has solved the task when, from fresh hanging starts, the pole stays within 0.2 rad of upright during the whole
last second of a trial, in at least 95 of 100 trials. A cart that leaves the track ends its trial and has failed; its
cost goes on at the last state's until the trial's end, as that of every trial that ends early.

Reference: Amadio et al. 2022 (MC-PILCO): 1 exploration trial and 5 trials of 3 s at 20 Hz.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.wrappers.task import Task

ENV_ID = "beliefgym/CartPoleSwingUp-v0"
TRIAL_STEPS = 60  # 3 s at 20 Hz
LAST_SECOND = 20  # steps
UPRIGHT = 0.2  # rad
SOLVED = 0.95  # of the test trials
TEST_TRIALS, TEST_SEED = 100, 1_000_000  # starts that no training trial has


@dataclass(frozen=True)
class SwingUpTest:
    """What a policy does on fresh starts.

    Attributes:
        upright: (n,) bool, who was upright for the last second.
        costs: (n,) sums of the stage cost over the trial.
    """

    upright: NDArray[np.bool_]
    costs: NDArray[np.float64]

    @property
    def solved(self) -> bool:
        """Whether enough trials were upright."""
        return bool(self.upright.mean() >= SOLVED)

    def to_dict(self) -> dict[str, Any]:
        """As it stands in a cell."""
        return {
            "upright": float(self.upright.mean()),
            "cost": float(self.costs.mean()),
            "solved": self.solved,
        }


def swing_up_task(parameters: Mapping[str, Any] | None = None, wrappers: Any = ()) -> Task:
    """The environment with other parameters or wrappers than registered."""
    return Task(ENV_ID, dict(parameters or {}), tuple(wrappers))


def try_fresh_starts(
    agent: Any, task: Task, seed: int = TEST_SEED, n: int = TEST_TRIALS, n_steps: int = TRIAL_STEPS
) -> SwingUpTest:
    """Run an agent's policy from n fresh starts, all at once.

    Args:
        agent: with SB3's `predict(observation, state, episode_start, deterministic)`.
        task: where it acts. seed: of the starts. n: trials. n_steps: steps of a trial.
    """
    env = task.make_vec(n)
    system = env.unwrapped.system  # type: ignore[attr-defined]
    observation, _ = env.reset(seed=seed)
    state: Any = None
    start = np.ones(n, dtype=np.bool_)
    running, upright, costs = np.ones(n, dtype=np.bool_), np.ones(n, dtype=np.bool_), np.zeros(n)
    last = np.zeros(n)
    for t in range(n_steps):
        before = env.unwrapped.state.copy()  # type: ignore[attr-defined]
        action, state = agent.predict(observation, state=state, episode_start=start, deterministic=True)
        observation, _, terminated, _, _ = env.step(action)
        stage = np.asarray(
            system.stage_cost(before, system.clip(np.asarray(action, dtype=float).reshape(n, -1)))
        )
        last = np.where(running, stage, last)
        costs += last
        running &= ~terminated
        start = np.asarray(terminated)
        if t >= n_steps - LAST_SECOND:
            theta = env.unwrapped.state[:, system.state_names.index("theta")]  # type: ignore[attr-defined]
            upright &= np.abs((theta + np.pi) % (2.0 * np.pi) - np.pi) < UPRIGHT
    env.close()
    return SwingUpTest(upright & running, costs)
