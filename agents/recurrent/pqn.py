"""`RecurrentPQN`: Q-learning without replay and target network, on parallel copies (Gallici et al. 2024).

    repeat:  act with epsilon-greedy arg max_a Q(h_t, a) in all copies, the state carried on
             `epochs` times in `n_minibatches` parts: roll the network along what was just recorded and fit Q to
             G_t = r_t + gamma [(1 - lambda) max_a Q(h_{t+1}, a) + lambda G_{t+1}]

Layer normalisation of the network stands in for the target network. `cell="none"` is PQN without memory. As in the
authors' recurrent program, targets are computed anew with each gradient step, and a rollout begins with the state that
the copy was in. Their window of four earlier steps in front of each rollout is left out.

Reference: Gallici et al. 2024, Alg. 1 and the recurrent form of its appendix.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from beliefgym.agents.recurrent.q_agent import RecurrentQAgent
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss
from beliefgym.wrappers.task import Task


class RecurrentPQN(RecurrentQAgent):
    """Parallelised Q-network with memory.

    Args:
        task, seed: see `RecurrentQAgent`, which takes all further arguments.
        epochs: passes over each rollout. n_minibatches: gradient steps in a pass, at most n_envs.
        weights: lambda of the returns.

    Raises:
        ValueError: numbers out of range.

    Example:
        >>> agent = RecurrentPQN("beliefgym/CartPoleBalancePosition-v0").learn(50_000)  # doctest: +SKIP
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        epochs: int = 4,
        n_minibatches: int = 4,
        weights: float = 0.9,
        n_envs: int = 16,
        **shared: Any,
    ) -> None:
        self._own: dict[str, Any] = {"epochs": epochs, "n_minibatches": n_minibatches, "weights": weights}
        if epochs < 1 or not 1 <= n_minibatches <= n_envs or not 0.0 <= weights <= 1.0:
            raise ValueError(
                f"expected epochs of at least 1, n_minibatches from 1 to n_envs={n_envs} and weights (lambda) from 0 "
                f"to 1, got {epochs}, {n_minibatches} and {weights}"
            )
        super().__init__(task, seed, n_envs=n_envs, **shared)

    def make_loss(self) -> RecurrentSarsaLoss:
        """See `RecurrentQAgent.make_loss`."""
        return RecurrentSarsaLoss(
            self.network, gamma=self.gamma, weights=self._own["weights"], bootstrap="max"
        )

    def improve(self, rollout: TensorDict, progress: float) -> dict[str, Any]:
        """Fit Q to the rollout; see `RecurrentQAgent.improve`."""
        del progress
        for _ in range(self._own["epochs"]):
            order = torch.randperm(len(rollout), generator=self._random)
            for chosen in order.chunk(self._own["n_minibatches"]):
                answer = self.step_optimizer(rollout[chosen])
        self.sync_acting()
        return {key: float(value.detach()) for key, value in answer.items()}

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        return {**super().options(), **self._own}
