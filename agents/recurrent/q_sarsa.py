"""`RecurrentQSARSA`: on-policy recurrent Q learning that is consistent in time (Sec. 4.3).

    repeat:  h_t of pi_i's network along every running episode, from its start (consistency)
             act with pi_{i+1}(x) = arg max_a Q^{pi_i}(h_t, a) (Eq. 4.18), softened: soft-max and epsilon
             fit Q to the Bellman residuals of what was recorded (Eq. 4.17), by gradients through time

What is new against the thesis proposal, and why. The arg max is softened (`temperature`), each policy is held near the
one before (`munchausen`), and the network that acts and that targets are taken from is an average of the fitted ones
over the last gradient steps (`average`): policies then change slowly, while every one of them is learned about.
Rollouts of older policies are used again (`reuse`), weighted by min(1, pi / mu) at each step; the proposal names that
as an option. `average=0`, `temperature=0`, `reuse=1`, `bootstrap="taken"` and `gradient="residual"` is the proposal to
the letter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDict

from beliefgym.agents.recurrent.collector import RolloutCollector
from beliefgym.agents.recurrent.network import HISTORY_KEYS
from beliefgym.agents.recurrent.q_agent import RecurrentQAgent
from beliefgym.agents.recurrent.rolling import states_after_rows
from beliefgym.agents.recurrent.sarsa_loss import Bootstrap, Gradient, RecurrentSarsaLoss
from beliefgym.agents.recurrent.target_network import AveragedParams
from beliefgym.wrappers.task import Task

YOUNG_REUSE = 16  # rollouts
Refresh = Literal["all", "running", "none"]


class RecurrentQSARSA(RecurrentQAgent):
    """Recurrent-Q SARSA.

    Args:
        task, seed: see `RecurrentQAgent`, which takes all further arguments.
        reuse: rollouts that are learned from at a time, the newest among them. reuse_reach: at most about this share of
            all rollouts so far where that is more than `YOUNG_REUSE`; None for no such limit.
        n_batches: gradient steps after each rollout.
        batch_rows: rows (of `rollout_steps` steps) in each of them; None for what is kept divided among them, so that
            together they go once through it.
        importance: cut what followed a step of an older policy by min(1, pi / mu) (Retrace); False cuts nothing, which
            reaches further back and holds while policies differ little (Q(lambda) of Harutyunyan et al. 2016).
        average: the share that stays of the averaged network at each gradient step; 0 for no average.
        average_reach: the average reaches back over about this share of all gradient steps so far, while that is less;
            None for `average` from the start.
        munchausen: alpha of `RecurrentSarsaLoss`; None for 0.9 with bootstrap "expected" and gradient "semi", else 0.
        bootstrap, gradient, n_steps, weights: see `RecurrentSarsaLoss`.
        refresh: which hidden states are rolled anew when the network has changed: "all", those of running episodes and
            those that kept rollouts begin with; "running"; or "none", where states are carried on.
        auxiliary: objectives by name with their options: "weight" (lambda; "linear:0.5" falls to 0), "k", "on_hidden".

    Raises:
        ValueError: settings that contradict each other; see `RecurrentSarsaLoss`.

    Example:
        >>> agent = RecurrentQSARSA("beliefgym/CartPoleBalancePosition-v0").learn(50_000)  # doctest: +SKIP

    Reference: thesis proposal, Sec. 4.3.1 and 4.3.2.
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        n_envs: int = 16,
        reuse: int = 64,
        reuse_reach: float | None = 0.25,
        n_batches: int = 16,
        batch_rows: int | None = 32,
        importance: bool = True,
        munchausen: float | None = None,
        average: float = 0.999,
        average_reach: float | None = 0.05,
        bootstrap: Bootstrap = "expected",
        gradient: Gradient = "semi",
        n_steps: int | None = None,
        weights: float | list[float] = 0.97,
        refresh: Refresh = "all",
        learning_rate: float | str = "cubic:2e-3",
        temperature: float | str = 0.3,
        auxiliary: Mapping[str, Mapping[str, Any]] | None = None,
        **shared: Any,
    ) -> None:
        self._own: dict[str, Any] = {
            "reuse": reuse,
            "reuse_reach": reuse_reach,
            "n_batches": n_batches,
            "batch_rows": batch_rows,
            "importance": importance,
            "munchausen": 0.9 * ((bootstrap, gradient) == ("expected", "semi"))
            if munchausen is None
            else munchausen,
            "average": average,
            "average_reach": average_reach,
            "bootstrap": bootstrap,
            "gradient": gradient,
            "n_steps": n_steps,
            "weights": weights,
            "refresh": refresh,
            "auxiliary": {name: dict(options) for name, options in (auxiliary or {}).items()},
        }
        if min(reuse, n_batches, 1 if batch_rows is None else batch_rows) < 1:
            raise ValueError(
                f"expected reuse, n_batches and batch_rows of at least 1, got {reuse}, {n_batches} and {batch_rows}"
            )
        if refresh not in ("all", "running", "none"):
            raise ValueError(f'expected refresh "all", "running" or "none", got {refresh!r}')
        if reuse > 1 and bootstrap == "taken":
            raise ValueError(
                "rollouts of older policies (reuse > 1) show what those did next, not this policy: take "
                'bootstrap="expected", or reuse=1'
            )
        self._rollouts: list[TensorDict] = []
        super().__init__(
            task, seed, n_envs=n_envs, learning_rate=learning_rate, temperature=temperature, **shared
        )
        self._average = None
        if average > 0.0:
            self._average = AveragedParams(self.loss, "value_network", average, average_reach)

    def make_loss(self) -> RecurrentSarsaLoss:
        """See `RecurrentQAgent.make_loss`."""
        own = self._own
        return RecurrentSarsaLoss(
            self.network,
            gamma=self.gamma,
            n_steps=own["n_steps"],
            weights=own["weights"],
            bootstrap=own["bootstrap"],
            gradient=own["gradient"],
            importance=own["importance"] and own["reuse"] > 1,
            munchausen=own["munchausen"],
            delay_value=own["average"] > 0.0,
            auxiliary=self._objectives(own["auxiliary"]),
        )

    def before_rollout(self, collector: RolloutCollector) -> dict[str, Any]:
        """Roll the hidden states of running episodes anew with the network that will act."""
        if self._own["refresh"] == "none":
            return {}
        return {"state_drift": collector.refresh(self.acting.encoder)}

    def improve(self, rollout: TensorDict, progress: float) -> dict[str, Any]:
        """Fit Q to the rollouts that are kept; see `RecurrentQAgent.improve`."""
        self.loss.auxiliary_weights = self._objective_weights(self._own["auxiliary"], progress)
        self._rollouts = [*self._rollouts, rollout][-self._n_kept() :]
        told = {"kept_state_drift": self._refresh_kept()} if self._own["refresh"] == "all" else {}
        rows = torch.cat(self._rollouts) if len(self._rollouts) > 1 else rollout
        order = torch.randperm(len(rows), generator=self._random)
        if self._own["batch_rows"] is not None:
            order = order[: self._own["batch_rows"] * self._own["n_batches"]]
        for chosen in order.tensor_split(min(self._own["n_batches"], len(rows))):
            answer = self.step_optimizer(rows[chosen])
            if self._average is not None:
                self._average.step()
        self.sync_acting()
        return told | {key: float(value.detach()) for key, value in answer.items()}

    def _n_kept(self) -> int:
        """Rollouts to learn from, the one that has just been recorded among them."""
        reuse, reach = self._own["reuse"], self._own["reuse_reach"]
        if reach is None:
            return int(reuse)
        so_far = self.num_timesteps // (self.n_envs * self.rollout_steps) + 1
        return int(min(reuse, max(YOUNG_REUSE, reach * so_far)))

    def _refresh_kept(self) -> float:
        """The states that kept rollouts begin with, as the acting network would have come to them; how far off they
        were.

        Rollouts follow one another, so that the state after one is the state before the next. What the oldest begins
        with stays.
        """
        state = self._rollouts[0]["recurrent_state"][:, 0].clone()
        difference = size = 0.0
        for rollout in self._rollouts:
            held = rollout["recurrent_state"]
            difference += float((held[:, 0] - state).square().sum())
            size += float(state.square().sum())
            held[:, 0] = state
            inputs = [rollout[key] for key in HISTORY_KEYS]
            state = states_after_rows(self.acting.encoder, inputs, rollout["is_init"][..., 0], state)
            state = state * (~rollout["next", "done"][:, -1]).to(state.dtype)
        return (difference / size) ** 0.5 if size > 0.0 else 0.0

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        return {**super().options(), **self._own}
