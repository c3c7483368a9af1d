"""Control from a handful of trials by planning through an ensemble of probabilistic networks (PETS).

The model is a `GaussianEnsemble` of the change of the observation in a step, y_{t+1} - y_t given (y_t, a_t), trained
from new weights after every trial on all transitions so far. A plan a_0..a_{H-1} costs what it costs on average over
P particles, each of which keeps one member e of the ensemble through the whole plan (trajectory sampling TS-infinity):

    y_{t+1} = R(y_t + mu_e(y_t, a_t) + sigma_e(y_t, a_t) eps_t),
    J = 1/P sum_particles [ sum_{t<H} c(y_t, a_t) + c(y_H, 0) ],

with R giving every observed (cos, sin) pair its unit norm back. `CrossEntropyMethod` plans anew at every step, from the
last step's plan, and the first action is taken.

Deviations from the source: iCEM in place of CEM; a cost of the last state; two hidden layers of 64, and weights begun
anew after every trial, for data sets of a few hundred transitions; eps is common to all plans that are compared;
10 particles by default, which is two a member, in place of 20, and smaller searches, for the sake of time.

Reference: Chua et al. 2018, "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models".
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from beliefgym.agents.agent import episode_starts
from beliefgym.agents.cross_entropy_method import CrossEntropyMethod, Plan
from beliefgym.agents.gaussian_ensemble import GaussianEnsemble
from beliefgym.agents.observed_cost import circles
from beliefgym.agents.trial_learner import Cost, TrialLearner
from beliefgym.wrappers.task import Task

_CHUNK = 16384  # particles that step together: what stays in a core's cache


class PlannerState(NamedTuple):
    """What the policy remembers between two calls of `predict`: its plans, and how often it was called."""

    plan: Plan
    calls: int


class ProbabilisticEnsembleControl(TrialLearner):
    """PETS: learn(k * trial_steps) runs k trials, of which the first are random.

    Args:
        task: the task or environment id, with flat Box spaces and bounded actions.
        seed: of trials, weights and plans.
        cost, trial_steps, exploration_trials: see `TrialLearner`.
        members: networks of the ensemble. particles: P, a multiple of the members. hidden: widths of the layers.
        training_steps: gradient steps after each trial. learning_rate: of AdamW.
        horizon, candidates, iterations: of `CrossEntropyMethod`.

    Attributes:
        history: see `TrialLearner`; "loss" is that of the ensemble after the trial.

    Raises:
        ValueError: spaces, a cost or numbers that do not fit.
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        cost: Cost | str | None = None,
        trial_steps: int = 60,
        exploration_trials: int = 1,
        members: int = 5,
        particles: int = 10,
        hidden: tuple[int, ...] = (64, 64),
        training_steps: int = 5000,
        learning_rate: float = 3e-3,
        horizon: int = 25,
        candidates: int = 128,
        iterations: int = 3,
    ) -> None:
        super().__init__(task, seed, cost, trial_steps, exploration_trials)
        if particles < members or particles % members:
            raise ValueError(
                f"expected particles as a multiple of the {members} members, got {particles}; each keeps one member"
            )
        self.members, self.particles, self.hidden = members, particles, tuple(hidden)
        self.training_steps, self.learning_rate = training_steps, learning_rate
        self.planner = CrossEntropyMethod(horizon=horizon, candidates=candidates, iterations=iterations)
        self._low, self._high = torch.as_tensor(self.low), torch.as_tensor(self.high)
        self._circles = circles(self.names)
        n, m = len(self.names), len(self.low)
        self.model = GaussianEnsemble(n + m, n, members, self.hidden, seed)
        self._folded = self.model.folded()

    def predict(
        self,
        observation: NDArray[Any],
        state: PlannerState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], PlannerState]:
        """See `Agent.predict`; the state holds the plans. The k-th call from state None always draws the same numbers,
        so that the policy is a deterministic one, whatever `deterministic` says.

        Raises:
            ValueError: an observation of another shape, or one that is not finite.
        """
        observation, single = self.batched(observation)
        observation = self.finite(observation)
        n, m = len(observation), len(self._low)
        starts = torch.as_tensor(np.array(episode_starts(state, episode_start, n)))
        fresh = self.planner.start(n, m)
        calls = 0 if state is None else state.calls
        if state is not None:
            if len(state.plan.mean) != n:
                raise ValueError(
                    f"expected {len(state.plan.mean)} observations, as many as the state has plans for, got {n}; "
                    "pass state=None to begin anew"
                )
            old = self.planner.shift(state.plan)
            fresh = Plan(
                torch.where(starts[:, None, None], fresh.mean, old.mean),
                torch.where(starts[:, None, None, None], fresh.elites, old.elites),
            )
        plan = self._plan(torch.as_tensor(observation, dtype=torch.float32), fresh, calls)
        action = self._scaled(plan.elites[:, 0, 0]).numpy().astype(self.action_space.dtype)
        return (action[0] if single else action), PlannerState(plan, calls + 1)

    @torch.inference_mode()
    def _plan(self, observation: Tensor, plan: Plan, calls: int) -> Plan:
        """Plans for all copies, a few at a time so that their particles stay in the cache."""
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + calls) % 2**63)
        noise = self.planner.draw(len(self._low), generator)
        shape = (
            self.planner.horizon,
            self.members,
            self.particles // self.members,
            1,
            1,
            observation.shape[1],
        )
        eps = torch.randn(shape, generator=generator)
        size = max(1, _CHUNK // (self.particles * self.planner.candidates))
        means, elites = [], []
        for first in range(0, len(observation), size):
            rows = slice(first, first + size)
            found, _ = self.planner.improve(
                partial(self.plan_costs, observation[rows], eps=eps),
                Plan(plan.mean[rows], plan.elites[rows]),
                noise,
            )
            means.append(found.mean)
            elites.append(found.elites)
        return Plan(torch.cat(means), torch.cat(elites))

    def plan_costs(self, observation: Tensor, plans: Tensor, eps: Tensor) -> Tensor:
        """J of each plan.

        Args:
            observation: (n, n_observation) at the plans' start.
            plans: (n, N, H, n_action) in [-1, 1].
            eps: (H, members, particles / members, 1, 1, n_observation) standard normal numbers.

        Returns:
            (n, N).
        """
        n, count, horizon, m = plans.shape
        batch = (self.members, eps.shape[2], n, count)
        actions = self._scaled(plans)
        y = observation[:, None].expand(*batch, -1)
        total = torch.zeros(batch)
        for t in range(horizon):
            u = actions[:, :, t].expand(*batch, -1)
            total = total + self.cost(y, u)
            mean, std = self._change(torch.cat([y, u], dim=-1).reshape(self.members, -1, y.shape[-1] + m))
            y = y + (mean.view(y.shape) + std.view(y.shape) * eps[t])
            for cosine, sine in self._circles:
                pair = y[..., [cosine, sine]]
                y[..., [cosine, sine]] = pair / torch.linalg.vector_norm(pair, dim=-1, keepdim=True)
        return (total + self.cost(y, torch.zeros(*batch, m))).mean(dim=(0, 1))

    def _change(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of y_{t+1} - y_t: (members, B, n + m) -> (members, B, n) twice."""
        weights, biases = self._folded
        x = inputs
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            x = functional.silu(torch.baddbmm(bias, x, weight), inplace=True)
        x = torch.baddbmm(biases[-1], x, weights[-1])
        mean, log_variance = x.split(self.model.n_targets, dim=-1)
        return mean, torch.exp(0.5 * self.model.bounded(log_variance)) * self.model.target_std

    def _scaled(self, unit: Tensor) -> Tensor:
        return self._low + 0.5 * (unit + 1.0) * (self._high - self._low)

    def improve(self) -> dict[str, Any]:
        """Train the ensemble anew on all transitions."""
        y, u, following = self.observed()
        loss = self.model.fit(
            torch.as_tensor(np.concatenate([y, u], axis=1)),
            torch.as_tensor(following - y),
            steps=self.training_steps,
            learning_rate=self.learning_rate,
        )
        self._folded = self.model.folded()
        return {"loss": loss}

    def options(self) -> dict[str, Any]:
        """See `Agent.options`.

        Raises:
            ValueError: the cost was given as a function, which cannot stand in a file.
        """
        return {
            "cost": self.saved_cost(),
            "trial_steps": self.trial_steps,
            "exploration_trials": self.exploration_trials,
            "members": self.members,
            "particles": self.particles,
            "hidden": list(self.hidden),
            "training_steps": self.training_steps,
            "learning_rate": self.learning_rate,
            "horizon": self.planner.horizon,
            "candidates": self.planner.candidates,
            "iterations": self.planner.iterations,
        }

    def parts(self) -> dict[str, bytes]:
        """The ensemble, the transitions and the history."""
        arrays = io.BytesIO()
        model = {f"model.{name}": value.numpy() for name, value in self.model.state_dict().items()}
        np.savez(
            arrays, transitions=self.transitions, generator=self.model.generator.get_state().numpy(), **model
        )
        return {"ensemble.npz": arrays.getvalue(), "history.json": json.dumps(self.history).encode()}

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`."""
        with np.load(io.BytesIO(parts["ensemble.npz"]), allow_pickle=False) as arrays:
            self.transitions = arrays["transitions"]
            self.model.generator.set_state(torch.as_tensor(arrays["generator"]))
            self.model.load_state_dict(
                {
                    name.removeprefix("model."): torch.as_tensor(arrays[name])
                    for name in arrays.files
                    if name.startswith("model.")
                }
            )
        self.history = json.loads(parts["history.json"])
        self.num_timesteps = len(self.transitions)
        self._folded = self.model.folded()
