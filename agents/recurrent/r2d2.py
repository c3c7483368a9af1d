"""`R2D2`: recurrent Q-learning from stored states, with burn-in (Kapturowski et al. 2019).

    repeat:  act with epsilon-greedy arg max_a Q(h_t, a); keep sequences with the state that the network was in
             roll the network from the stored state over `burn_in` steps, then over `sequence_length` more, and there
             fit Q to sum_{i<n} gamma^i r_{t+i} + gamma^n Q'(h'_{t+n}, arg max_a Q(h_{t+n}, a)), Q' the target network

Stored states are those of older networks; the burn-in brings them up to date. What is left out: priorities of
sequences, the rescaling of values, and actors apart from the learner. Gradients go through the burn-in too. A sequence
that begins with its episode has the right state, and is learned from without burn-in.

Reference: Kapturowski et al. 2019, Sec. 2.3 and 3.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from beliefgym.agents.recurrent.q_agent import RecurrentQAgent
from beliefgym.agents.recurrent.replay import EpisodeReplay
from beliefgym.agents.recurrent.replay_drift import EVERY, replay_drift
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss
from beliefgym.agents.recurrent.target_network import target_updater
from beliefgym.wrappers.task import Task


class R2D2(RecurrentQAgent):
    """Recurrent replay (not distributed here) with stored states.

    Args:
        task, seed: see `RecurrentQAgent`, which takes all further arguments.
        sequence_length: steps of a sequence that are learned from. burn_in: steps in front of them without loss.
        stride: steps from one sequence's beginning to the next; None for half of sequence_length (overlapping),
            sequence_length for adjacent ones.
        zero_state: begin sequences with zeros in place of the stored state.
        n_steps: rewards in a target before it bootstraps.
        batch_size: sequences in a gradient step. n_batches: gradient steps after each rollout.
        capacity: steps that the replay keeps. learning_starts: steps in it before the first gradient step.
        target_update: see `target_updater`. learning_rate: see `RecurrentQAgent`.

    Raises:
        ValueError: numbers out of range.

    Example:
        >>> agent = R2D2("beliefgym/CartPoleBalancePosition-v0").learn(50_000)  # doctest: +SKIP
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        sequence_length: int = 40,
        burn_in: int = 20,
        stride: int | None = None,
        zero_state: bool = False,
        n_steps: int = 5,
        batch_size: int = 16,
        n_batches: int = 32,
        capacity: int = 100_000,
        learning_starts: int = 1000,
        target_update: float = 0.05,
        learning_rate: float | str = "linear:1e-3",
        **shared: Any,
    ) -> None:
        self._own: dict[str, Any] = {
            "sequence_length": sequence_length,
            "burn_in": burn_in,
            "stride": stride,
            "zero_state": zero_state,
            "n_steps": n_steps,
            "batch_size": batch_size,
            "n_batches": n_batches,
            "capacity": capacity,
            "learning_starts": learning_starts,
            "target_update": target_update,
        }
        self._stride = max(sequence_length // 2, 1) if stride is None else stride
        if min(sequence_length, self._stride, n_steps, batch_size, n_batches) < 1 or burn_in < 0:
            raise ValueError(
                "expected sequence_length, stride, n_steps, batch_size and n_batches of at least 1 and burn_in of at "
                f"least 0, got {sequence_length}, {stride}, {n_steps}, {batch_size}, {n_batches} and {burn_in}"
            )
        if self._stride > sequence_length:
            raise ValueError(
                f"expected a stride of at most sequence_length={sequence_length}, or steps between sequences are "
                f"never learned from, got {stride}"
            )
        self._replay = EpisodeReplay(capacity)
        super().__init__(task, seed, learning_rate=learning_rate, **shared)
        self._target = target_updater(self.loss, target_update)
        self._draws_of_drift = torch.Generator().manual_seed(seed)  # which leave the training's alone

    def make_loss(self) -> RecurrentSarsaLoss:
        """See `RecurrentQAgent.make_loss`."""
        return RecurrentSarsaLoss(
            self.network,
            gamma=self.gamma,
            n_steps=self._own["n_steps"] - 1,
            weights=[0.0] * (self._own["n_steps"] - 1) + [1.0],
            bootstrap="double",
            delay_value=True,
            burn_in=self._own["burn_in"],
        )

    def improve(self, rollout: TensorDict, progress: float) -> dict[str, Any]:
        """Keep the rollout and fit Q to sequences of the replay; see `RecurrentQAgent.improve`."""
        del progress
        self._replay.extend(rollout)
        if len(self._replay) < self._own["learning_starts"]:
            return {}
        told = {}
        if len(self.history) % EVERY == 0:
            own = {"length": self._own["sequence_length"], "burn_in": self._own["burn_in"]}
            told["kept_state_drift"] = replay_drift(
                self.network.encoder,
                self._replay,
                self._draws_of_drift,
                **own,
                stored=not self._own["zero_state"],
            )
        for _ in range(self._own["n_batches"]):
            answer = self.step_optimizer(self.sample())
            self._target.step()
        self.sync_acting()
        return told | {key: float(value.detach()) for key, value in answer.items()}

    def sample(self) -> TensorDict:
        """Sequences with the state that was stored at their first step, or zeros."""
        own = self._own
        batch = self._replay.sequences(
            own["batch_size"], own["sequence_length"], self._stride, self._random, own["burn_in"]
        )
        if own["zero_state"]:
            batch["recurrent_state"].zero_()
        return batch

    def sync_acting(self) -> None:
        """The network that learns acts, not the target network."""
        self.acting.load_state_dict(self.network.state_dict())

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        return {**super().options(), **self._own}
