"""`DRQN`: recurrent Q-learning from a replay of episodes, the rival of Recurrent-Q SARSA (Sec. 4.3.1).

    repeat:  act with epsilon-greedy arg max_a Q(h_t, a), the state carried on while the network changes
             keep what was recorded as episodes
             fit Q to r_t + gamma max_a Q'(h'_{t+1}, a), Q' the target network, on episodes drawn from all that is kept

The network is rolled along actions of older policies, so the states are those of no policy it has learned about: the
inconsistency that the thesis proposal puts right. With `updates="random"` an update begins at a random step of an
episode, from a zero state, and goes on for `unroll` steps; with "sequential" it goes from an episode's start to its
end. `double` takes the maximum by the network itself and its value by the target network.

Against the paper: a random update begins at any step that is kept as likely, where the paper draws the episode first
(the many short episodes of early policies then outweigh the others); RAdam in place of ADADELTA; a longer unroll than
10; layer normalisation and duelling heads (the network is that of the other agents here). So `cell="none", unroll=1`
is DQN, and `cell="stack4", burn_in=3` is DQN on stacked frames, each step that is learned from with all its frames.

References: Hausknecht and Stone 2015; van Hasselt et al. 2016 (double); Mnih et al. 2015 (DQN).
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDict

from beliefgym.agents.recurrent.q_agent import RecurrentQAgent
from beliefgym.agents.recurrent.replay import EpisodeReplay
from beliefgym.agents.recurrent.replay_drift import EVERY, replay_drift
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss
from beliefgym.agents.recurrent.target_network import target_updater
from beliefgym.wrappers.task import Task

Updates = Literal["random", "sequential"]


class DRQN(RecurrentQAgent):
    """Deep recurrent Q-learning.

    Args:
        task, seed: see `RecurrentQAgent`, which takes all further arguments.
        updates: "random" or "sequential", the paper's two bootstrapped updates.
        unroll: steps of a random update. burn_in: steps in front of them that bring up the state, without loss.
        batch_size: episodes in a gradient step; None for 16 of random updates, 4 of sequential ones.
        n_batches: gradient steps after each rollout; None for 32 of random updates, 8 of sequential ones.
        capacity: steps that the replay keeps. learning_starts: steps in it before the first gradient step.
        target_update: see `target_updater`.
        double: double Q-learning. learning_rate: see `RecurrentQAgent`.

    Raises:
        ValueError: numbers out of range.

    Example:
        >>> agent = DRQN("beliefgym/CartPoleBalancePosition-v0").learn(50_000)  # doctest: +SKIP
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        updates: Updates = "random",
        unroll: int = 20,
        burn_in: int = 0,
        batch_size: int | None = None,
        n_batches: int | None = None,
        capacity: int = 100_000,
        learning_starts: int = 1000,
        target_update: float = 0.05,
        double: bool = False,
        learning_rate: float | str = "linear:1e-3",
        **shared: Any,
    ) -> None:
        self._own: dict[str, Any] = {
            "updates": updates,
            "unroll": unroll,
            "burn_in": burn_in,
            "batch_size": batch_size,
            "n_batches": n_batches,
            "capacity": capacity,
            "learning_starts": learning_starts,
            "target_update": target_update,
            "double": double,
        }
        if updates not in ("random", "sequential"):
            raise ValueError(f'expected updates "random" or "sequential", got {updates!r}')
        if updates == "sequential" and burn_in > 0:
            raise ValueError('sequential updates begin with an episode: take burn_in=0, or updates="random"')
        usual = (16, 32) if updates == "random" else (4, 8)
        self._batch_size = usual[0] if batch_size is None else batch_size
        self._n_batches = usual[1] if n_batches is None else n_batches
        if min(unroll, self._batch_size, self._n_batches) < 1 or burn_in < 0:
            raise ValueError(
                "expected unroll, batch_size and n_batches of at least 1 and burn_in of at least 0, got "
                f"{unroll}, {batch_size}, {n_batches} and {burn_in}"
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
            n_steps=0,
            weights=[1.0],
            bootstrap="double" if self._own["double"] else "max",
            delay_value=True,
            burn_in=self._own["burn_in"],
        )

    def improve(self, rollout: TensorDict, progress: float) -> dict[str, Any]:
        """Keep the rollout and fit Q to episodes of the replay; see `RecurrentQAgent.improve`."""
        del progress
        self._replay.extend(rollout.exclude("recurrent_state"))
        if len(self._replay) < self._own["learning_starts"]:
            return {}
        told = {}
        if self._own["updates"] == "random" and len(self.history) % EVERY == 0:
            own = {"length": self._own["unroll"], "burn_in": self._own["burn_in"]}
            told["kept_state_drift"] = replay_drift(
                self.network.encoder, self._replay, self._draws_of_drift, **own
            )
        for _ in range(self._n_batches):
            answer = self.step_optimizer(self.sample())
            self._target.step()
        self.sync_acting()
        return told | {key: float(value.detach()) for key, value in answer.items()}

    def sample(self) -> TensorDict:
        """Episodes (whole, or from a random start on) with a zero state at their first step."""
        own = self._own
        if own["updates"] == "sequential":
            batch = self._replay.episodes(self._batch_size, self._random)
        else:
            batch = self._replay.windows(self._batch_size, own["unroll"], self._random, own["burn_in"])
        return batch.set("recurrent_state", torch.zeros(()).expand(*batch.shape, self.network.state_size))

    def sync_acting(self) -> None:
        """The network that learns acts, not the target network."""
        self.acting.load_state_dict(self.network.state_dict())

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        return {**super().options(), **self._own}
