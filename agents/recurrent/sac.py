"""`RecurrentSAC`: soft actor-critic on histories, for continuous actions (the sibling of `RecurrentQSARSA`).

    repeat:  h_t of the actor along every running episode, from its start
             act with a_t ~ pi(. | h_t), and keep the steps
             draw sequences of what is kept, and take gradient steps on the losses of `RecurrentSACLoss`

What is learned from was recorded under older policies: soft actor-critic corrects for it by drawing the next action
anew. The encoders' learning rate is a part of the heads' (RESeL): a step that changes the memory changes the hidden
states at every later time, and with them all that the heads have fitted.

References: Haarnoja et al. 2018b; Ni et al. 2022 (an encoder each for actor and critic, sequences out of a replay
memory); Luo et al. 2024, RESeL (encoder's learning rate, whole episodes, the previous action as an input).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor, nn

from beliefgym.agents.recurrent.action_units import ActionUnits
from beliefgym.agents.recurrent.collector import Acted, RolloutCollector, Seen
from beliefgym.agents.recurrent.memory import Memory
from beliefgym.agents.recurrent.recurrent_agent import RecurrentAgent
from beliefgym.agents.recurrent.replay import EpisodeReplay
from beliefgym.agents.recurrent.sac_loss import RecurrentSACLoss
from beliefgym.agents.recurrent.sac_networks import RecurrentActor, RecurrentCritic, squashed_gaussian
from beliefgym.agents.recurrent.schedules import annealed
from beliefgym.agents.recurrent.target_network import AveragedParams
from beliefgym.wrappers.task import Task

ENCODER_SHARE = 30.0  # the heads' learning rate over the encoders' (RESeL)


class RecurrentSAC(RecurrentAgent):
    """Soft actor-critic with a recurrent actor and a recurrent critic.

    Args:
        task: the task or environment id, with a flat Box of observations and a flat, bounded Box of actions.
        seed: seed of everything random.
        n_envs: copies that act at once. rollout_steps: steps of each between two improvements.
        cell, hidden_size: of both encoders, see `HistoryEncoder`. width: of all other layers.
        previous_actions, previous_rewards: what the networks are told besides observations. With rewards, `predict`
            has to be told them (`tell_reward`).
        gamma: discount. trace_decay, importance: see `RecurrentSACLoss`.
        learning_rate: of heads and temperature, a number, or "linear:1e-3" for one that falls to 0.
        encoder_learning_rate: the same for the encoders; None for learning_rate / 30.
        max_grad_norm: the gradients of actor and critic are each scaled down to it.
        updates_per_step: gradient steps for each environment step. batch_size: sequences in each.
        sequence_length: steps of a sequence, which begins anywhere with a state of zeros; None for whole episodes.
        burn_in: steps before those of a sequence that bring up its state.
        learning_starts: environment steps with uniform actions at the start, without learning.
        buffer_size: environment steps that are kept.
        average: the share that stays of the averaged critic at each gradient step.
        target_entropy: of actions in (-1, 1)^n, in nats; None for -n. initial_temperature: alpha at the start, in
            units of scaled rewards.
        reward_scale: rewards are multiplied by it; "auto" chooses sqrt(1 - gamma^2) / rms(r) from the first rollout.
        auxiliary: objectives on the critic's hidden state by name with their options: "weight" (lambda; "linear:0.5"
            falls to 0), "k", "on_hidden".

    Attributes:
        num_timesteps: environment steps so far.
        history: a mapping for each rollout: steps, returns of finished episodes, losses of the last gradient step.

    Raises:
        ValueError: spaces that do not fit, or settings out of range.

    Example:
        >>> agent = RecurrentSAC("beliefgym/PendulumPosition-v0").learn(30_000)  # doctest: +SKIP
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        n_envs: int = 8,
        rollout_steps: int = 8,
        cell: str | Callable[[int, int], Memory] = "lstm",
        hidden_size: int = 64,
        width: int = 128,
        previous_actions: bool = True,
        previous_rewards: bool = False,
        gamma: float = 0.99,
        trace_decay: float = 0.9,
        importance: bool = True,
        learning_rate: float | str = 1e-3,
        encoder_learning_rate: float | str | None = None,
        max_grad_norm: float = 10.0,
        updates_per_step: float = 0.25,
        batch_size: int = 16,
        sequence_length: int | None = 64,
        burn_in: int = 0,
        learning_starts: int = 1000,
        buffer_size: int = 100_000,
        average: float = 0.99,
        target_entropy: float | None = None,
        initial_temperature: float = 0.1,
        reward_scale: float | str = "auto",
        auxiliary: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        options = {
            "n_envs": n_envs,
            "rollout_steps": rollout_steps,
            "cell": cell,
            "hidden_size": hidden_size,
            "width": width,
            "previous_actions": previous_actions,
            "previous_rewards": previous_rewards,
            "gamma": gamma,
            "trace_decay": trace_decay,
            "importance": importance,
            "learning_rate": learning_rate,
            "encoder_learning_rate": encoder_learning_rate,
            "max_grad_norm": max_grad_norm,
            "updates_per_step": updates_per_step,
            "batch_size": batch_size,
            "sequence_length": sequence_length,
            "burn_in": burn_in,
            "learning_starts": learning_starts,
            "buffer_size": buffer_size,
            "average": average,
            "target_entropy": target_entropy,
            "initial_temperature": initial_temperature,
            "reward_scale": reward_scale,
            "auxiliary": {name: dict(options) for name, options in (auxiliary or {}).items()},
        }
        super().__init__(task, seed, options)
        self._units = ActionUnits(self.action_space, self.task, type(self).__name__)
        self.n_action = self._units.n
        _check(options)
        self._replay = EpisodeReplay(buffer_size)
        self._fed = 0  # steps that the replay was given
        self._owed = 0.0  # gradient steps, of which whole ones are taken
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.actor = RecurrentActor(self._encoder(), self.n_observation, self.n_action, width)
            self.critic = RecurrentCritic(self._encoder(), self.n_observation, self.n_action, width)
            self.loss: RecurrentSACLoss = self._make_loss()
        self._average = AveragedParams(self.loss, "critic_network", average)
        self.optimizer = torch.optim.Adam(self._parameter_groups(), foreach=True)
        self._anneal(0.0)

    def before_rollout(self, collector: RolloutCollector) -> dict[str, Any]:
        """Roll the hidden states of running episodes anew with the actor that will act."""
        return {"state_drift": collector.refresh(self.actor.encoder)}

    def improve(self, rollout: TensorDict, progress: float) -> dict[str, Any]:
        """Keep the rollout and fit to sequences of the replay; see `RecurrentAgent.improve`."""
        own, steps = self._options, rollout.numel()
        self.loss.auxiliary_weights = self._objective_weights(own["auxiliary"], progress)
        self._replay.extend(rollout.exclude("recurrent_state"))
        if self._fed >= own["learning_starts"]:
            self._owed += steps * own["updates_per_step"]
        self._fed += steps
        answer: TensorDict | None = None
        for _ in range(int(self._owed)):
            answer = self.step_optimizer(self.sample())
        self._owed %= 1.0
        return {} if answer is None else {key: value.item() for key, value in answer.items()}

    def step_optimizer(self, batch: TensorDict) -> TensorDict:
        """See `RecurrentAgent.step_optimizer`; the averaged critic follows."""
        answer = super().step_optimizer(batch)
        self._average.step()
        return answer

    def sample(self) -> TensorDict:
        """Sequences to learn from, (batch_size, longest), see `EpisodeReplay`."""
        own = self._options
        n, length = own["batch_size"], own["sequence_length"]
        if length is None:
            return self._replay.episodes(n, self._random)
        return self._replay.sequences(n, length, max(length // 2, 1), self._random, own["burn_in"])

    def _networks(self) -> tuple[RecurrentActor, RecurrentCritic]:
        return self.actor, self.critic

    def _target_params(self) -> Any:
        return self.loss.target_critic_network_params

    def _saved(self) -> dict[str, Any]:
        return {
            "actor": TensorDict.from_module(self.actor),
            "critic": TensorDict.from_module(self.critic),
            "averaged": self.loss.target_critic_network_params,
            "auxiliary": TensorDict.from_module(self.loss.auxiliary),
            "log_alpha": self.loss.log_alpha,
        }

    def _clipped(self) -> Iterable[Iterable[nn.Parameter]]:
        return self.actor.parameters(), self.critic.parameters()

    def _vec_env(self) -> VectorEnv[Any, Any, Any]:
        return self._units.around(self.task.make_vec(self.n_envs))

    def _collect(self, collector: RolloutCollector, left: int) -> TensorDict:
        starts = self._options["learning_starts"]
        waiting = min(starts - self._fed, left)
        n_steps = max(self.rollout_steps, -(-waiting // self.n_envs))
        return collector.collect(self._act_uniformly if self.num_timesteps < starts else self._act, n_steps)

    def _choose(self, seen: Seen, deterministic: bool) -> Acted:
        return self._act(seen, deterministic)

    def _encoded(self, action: Tensor) -> Tensor:
        return action

    def _to_task(self, action: NDArray[Any]) -> NDArray[Any]:
        return self._units.to_box(action)

    def _further_remedy(self) -> str:
        return f", or a larger average (now {self._options['average']})"

    @torch.no_grad()
    def _act(self, seen: Seen, deterministic: bool = False) -> Acted:
        observation, action, reward = (x[:, None] for x in seen[:3])
        mean, log_std, state = self.actor(observation, action, reward, seen.state)
        if deterministic:
            noise = torch.zeros_like(mean)
        else:
            noise = torch.empty_like(mean).normal_(generator=self._random)
        action, log_probability = squashed_gaussian(mean, log_std, noise)
        if not action.isfinite().all():
            self._tell_divergence(float("nan"), float("nan"))
        return Acted(action[:, 0], log_probability[:, 0].exp(), state)

    def _act_uniformly(self, seen: Seen) -> Acted:
        acted = self._act(seen)
        action = 2.0 * torch.rand(acted.action.shape, generator=self._random) - 1.0
        return Acted(action, torch.full((len(action),), 0.5**self.n_action), acted.state)

    def _make_loss(self) -> RecurrentSACLoss:
        own = self._options
        entropy = own["target_entropy"]
        return RecurrentSACLoss(
            self.actor,
            self.critic,
            gamma=self.gamma,
            trace_decay=own["trace_decay"],
            importance=own["importance"],
            target_entropy=-float(self.n_action) if entropy is None else float(entropy),
            initial_temperature=own["initial_temperature"],
            burn_in=own["burn_in"],
            auxiliary=self._objectives(own["auxiliary"]),
            generator=self._random,
        )

    def _parameter_groups(self) -> list[dict[str, Any]]:
        """Heads, temperature and decoders in one group, encoders in the other."""
        encoders = [*self.actor.encoder.parameters(), *self.critic.encoder.parameters()]
        slow = {id(parameter) for parameter in encoders}
        return [
            {"name": "heads", "params": [p for p in self.loss.parameters() if id(p) not in slow]},
            {"name": "encoders", "params": encoders},
        ]

    def _anneal(self, progress: float) -> None:
        rate = annealed(self._options["learning_rate"], progress)
        own = self._options["encoder_learning_rate"]
        rates = {"heads": rate, "encoders": rate / ENCODER_SHARE if own is None else annealed(own, progress)}
        for group in self.optimizer.param_groups:
            group["lr"] = rates[group["name"]]


def _check(options: Mapping[str, Any]) -> None:
    counts = ("n_envs", "rollout_steps", "batch_size", "sequence_length")
    few = {name: options[name] for name in counts if options[name] is not None and options[name] < 1}
    if few:
        raise ValueError(f"expected {', '.join(counts)} of at least 1, got {few}")
    if options["updates_per_step"] < 0.0 or options["learning_starts"] < 0:
        raise ValueError(
            "expected updates_per_step and learning_starts of at least 0, got "
            f"{options['updates_per_step']} and {options['learning_starts']}"
        )
    if not 0.5 <= options["average"] < 1.0:
        raise ValueError(f"expected average from 0.5 to below 1, got {options['average']}")
