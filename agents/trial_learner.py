"""Agents that learn from a handful of trials: run one, learn from all transitions so far, run the next.

The first trials act at random. What a trial cost is the sum of a stage cost c(y_t, u_t) of what is observed; a trial
that ends early goes on costing what its last step cost, so that an early end is never cheap.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from beliefgym.agents.agent import Agent, require_box
from beliefgym.agents.observed_cost import ObservedCost
from beliefgym.agents.training_callback import TrainingCallback
from beliefgym.wrappers.task import Task

Cost = Callable[[Tensor, Tensor], Tensor]


class TrialLearner(Agent):
    """Base class: `learn(k * trial_steps)` runs k trials; a subclass says how it learns and how it acts.

    Args:
        task: the task or environment id, with flat Box spaces and bounded actions.
        seed: of everything random.
        cost: c(y, u) on torch tensors, (..., n_observation) and (..., n_action) -> (...), or its "module:name" (which
            an agent that is saved needs); by default the stage cost of the task's system (`ObservedCost`).
        trial_steps: steps of a trial.
        exploration_trials: first trials, whose actions are uniformly random.

    Attributes:
        names: of the observation's components.
        transitions: (N, 2 n_observation + n_action) float32, rows (y_t, u_t, y_{t+1}), of all trials.
        num_timesteps: steps of all trials.
        history: one mapping for each trial: kind ("exploration" or "policy"), steps, cost, seconds ("acting" and
            "learning"), and what the subclass says of its learning.

    Raises:
        ValueError: spaces or a cost that do not fit, numbers of trials or steps below 1.
    """

    def __init__(
        self, task: Task | str, seed: int, cost: Cost | str | None, trial_steps: int, exploration_trials: int
    ) -> None:
        super().__init__(task, seed)
        box = require_box(self.action_space, type(self).__name__)
        require_box(self.observation_space, type(self).__name__)
        if not box.is_bounded():
            raise ValueError(
                f"expected bounded actions, got {box}; rescale them with a Gymnasium wrapper first"
            )
        if trial_steps < 1 or exploration_trials < 1:
            raise ValueError(
                "expected trial_steps and exploration_trials of at least 1, got "
                f"{trial_steps} and {exploration_trials}"
            )
        self.trial_steps, self.exploration_trials = trial_steps, exploration_trials
        self.low, self.high = box.low.astype(np.float32), box.high.astype(np.float32)
        self.names = _observation_names(self.task)
        self.cost = _resolved(cost, self.task, self.names)
        self._given_cost = cost
        self.transitions = np.zeros((0, 2 * len(self.names) + len(self.low)), dtype=np.float32)
        self.history: list[dict[str, Any]] = []
        self.num_timesteps = 0

    @abstractmethod
    def improve(self) -> dict[str, Any]:
        """Learn from `transitions` after a trial; what is returned joins the trial's history."""

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Run total_timesteps / trial_steps further trials (rounded up), each followed by learning.

        Args:
            total_timesteps: a trial counts with its full length, however early it ends.
            callback: SB3's; called with each trial's steps once the trial is over and learned from.
            progress_bar: over trials.
        """
        called = TrainingCallback(self, callback, total_timesteps)
        trials = -(-total_timesteps // self.trial_steps)
        for _ in tqdm(range(trials), desc=type(self).__name__, unit="trial", disable=not progress_bar):
            record = self._trial()
            if not called.trial(record):
                break
        called.end()
        return self

    def observed(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """All transitions as y_t (N, n_observation), u_t (N, n_action) and y_{t+1}."""
        n, m = len(self.names), len(self.low)
        return self.transitions[:, :n], self.transitions[:, n : n + m], self.transitions[:, n + m :]

    def finite(self, observation: NDArray[Any]) -> NDArray[Any]:
        """The observation.

        Raises:
            ValueError: it is not finite.
        """
        if not np.isfinite(observation).all():
            raise ValueError("expected finite observations, got NaN or infinity; look at what produced them")
        return observation

    def saved_cost(self) -> str | None:
        """The cost as it stands in a saved agent.

        Raises:
            ValueError: it was given as a function, which cannot stand in a file.
        """
        if callable(self._given_cost):
            raise ValueError(
                f"expected cost as 'module:name' in an agent that is saved, got {self._given_cost!r}; "
                "write the function into a module and give its name"
            )
        return self._given_cost

    def _trial(self) -> dict[str, Any]:
        began = time.perf_counter()
        number = len(self.history)
        start, stream = np.random.SeedSequence([self.seed, number]).spawn(2)
        rng = np.random.default_rng(stream)
        exploring = number < self.exploration_trials
        env = self.task.make()
        observation, _ = env.reset(seed=int(start.generate_state(1)[0]))
        state: Any = None
        rows: list[NDArray[Any]] = []
        ended = False
        while len(rows) < self.trial_steps and not ended:
            if exploring:
                action = rng.uniform(self.low, self.high).astype(np.float32)
            else:
                action, state = self.predict(observation, state, deterministic=True)
            following, _, terminated, truncated, _ = env.step(action)
            rows.append(np.concatenate([observation, action, following]))
            observation, ended = following, terminated or truncated
        env.close()
        self.transitions = np.concatenate([self.transitions, np.asarray(rows, dtype=np.float32)])
        y, u, _ = self.observed()
        costs = self.cost(torch.as_tensor(y[-len(rows) :]), torch.as_tensor(u[-len(rows) :]))
        acted = time.perf_counter()
        told = self.improve()
        record = {
            "kind": "exploration" if exploring else "policy",
            "steps": len(rows),
            "cost": float(costs.sum() + costs[-1] * (self.trial_steps - len(rows))),
            "seconds": {"acting": acted - began, "learning": time.perf_counter() - acted},
            **told,
        }
        self.history.append(record)
        self.num_timesteps += len(rows)
        return record


def _observation_names(task: Task) -> tuple[str, ...]:
    """Names of what is observed, through the task's wrappers; "observation_i" where an environment names nothing."""
    env = task.make()
    names = (
        tuple(env.get_wrapper_attr("observation_names")) if env.has_wrapper_attr("observation_names") else ()
    )
    size = int(np.prod(env.observation_space.shape or ()))
    env.close()
    return names if len(names) == size else tuple(f"observation_{i}" for i in range(size))


def _resolved(cost: Cost | str | None, task: Task, names: tuple[str, ...]) -> Cost:
    if callable(cost):
        return cost
    if cost is not None:
        module, _, attribute = cost.partition(":")
        try:
            found: Cost = getattr(import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise ValueError(
                f"expected cost as 'module:name' of a function, got {cost!r} ({error})"
            ) from error
        return found
    env = task.make()
    system = getattr(env.unwrapped, "system", None)
    env.close()
    if system is None:
        raise ValueError(
            f"expected a task of one of beliefgym's systems, which have a stage cost, got {task.label}; give a cost "
            "(cost=...) of observations and actions"
        )
    return ObservedCost(system, names)
