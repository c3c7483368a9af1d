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

from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from beliefgym.agents.agent import Agent, episode_starts, require_box
from beliefgym.agents.recurrent.action_units import ActionUnits
from beliefgym.agents.recurrent.auxiliary import make_auxiliary
from beliefgym.agents.recurrent.collector import Acted, RolloutCollector, Seen
from beliefgym.agents.recurrent.memory import Memory
from beliefgym.agents.recurrent.network import HistoryEncoder
from beliefgym.agents.recurrent.q_agent import DivergenceError, Remembered, _natural_scale, _RunningMoments
from beliefgym.agents.recurrent.q_sarsa import _annealed
from beliefgym.agents.recurrent.replay import EpisodeReplay
from beliefgym.agents.recurrent.sac_loss import RecurrentSACLoss
from beliefgym.agents.recurrent.sac_networks import RecurrentActor, RecurrentCritic, squashed_gaussian
from beliefgym.agents.training_callback import TrainingCallback
from beliefgym.wrappers.task import Task

ENCODER_SHARE = 30.0  # the heads' learning rate over the encoders' (RESeL)


class RecurrentSAC(Agent):
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
        super().__init__(task, seed)
        self.n_observation = require_box(self.observation_space, type(self).__name__).shape[0]
        self._units = ActionUnits(self.action_space, self.task, type(self).__name__)
        self.n_action = self._units.n
        self._options: dict[str, Any] = {
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
        _check(self._options)
        self.n_envs, self.rollout_steps, self.gamma = n_envs, rollout_steps, gamma
        self.num_timesteps = 0
        self.history: list[dict[str, Any]] = []
        self._reward_scale = None if reward_scale == "auto" else float(reward_scale)
        self._collector: RolloutCollector | None = None
        self._replay = EpisodeReplay(buffer_size)
        self._told_reward: NDArray[Any] | None = None
        self._moments = _RunningMoments(self.n_observation)
        self._random = torch.Generator().manual_seed(seed)
        self._fed = 0  # steps that the replay was given
        self._owed = 0.0  # gradient steps, of which whole ones are taken
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.actor = RecurrentActor(self._encoder(), self.n_observation, self.n_action, width)
            self.critic = RecurrentCritic(self._encoder(), self.n_observation, self.n_action, width)
            self.loss = self._make_loss()
        self._average = SoftUpdate(self.loss, eps=average)
        self.optimizer = torch.optim.Adam(self._parameter_groups(), foreach=True)
        self._set_learning_rates(0.0)

    @property
    def needs_rewards(self) -> bool:
        """Whether `predict` has to be told the rewards (`tell_reward`); `evaluate` does."""
        return bool(self._options["previous_rewards"])

    def tell_reward(self, reward: NDArray[Any]) -> None:
        """The rewards () or (n,) of the last step, before `predict` is asked for the next action."""
        self._told_reward = np.asarray(reward, dtype=np.float32)

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Train for this many further environment steps (rounded up to whole rollouts).

        Raises:
            DivergenceError: values that are not finite, or far beyond what the rewards can add up to.
        """
        called = TrainingCallback(self, callback, total_timesteps)
        if self._collector is None:
            env = self._units.around(self.task.make_vec(self.n_envs))
            self._collector = RolloutCollector(env, self.actor.state_size, self.seed)
            self._collector.reward_scale = self._reward_scale or 1.0
        end = self.num_timesteps + total_timesteps
        with tqdm(
            total=total_timesteps, desc=type(self).__name__, unit="step", disable=not progress_bar
        ) as bar:
            while (left := end - self.num_timesteps) > 0:
                record = self._collect_and_improve(self._collector, left, 1.0 - left / total_timesteps)
                bar.update(record["steps"])
                if not called.trial(record):
                    break
        called.end()
        return self

    def predict(
        self,
        observation: NDArray[Any],
        state: Remembered | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Remembered]:
        """See `Agent.predict`. The deterministic action is tanh(mean), in units of the Box.

        Raises:
            ValueError: the networks take rewards, and the last one was not told.
        """
        observation, single = self.batched(observation)
        starts = episode_starts(state, episode_start, len(observation))
        acted = self._act(self._seen(observation, state, starts), deterministic)
        memory = Remembered(acted.state, acted.action, torch.zeros(len(observation), 1))
        action = self._units.to_box(acted.action.numpy())
        return (action[0] if single else action), memory

    def options(self) -> dict[str, Any]:
        """See `Agent.options`.

        Raises:
            ValueError: a cell of one's own, which a file without code cannot hold.
        """
        if not isinstance(self._options["cell"], str):
            raise ValueError(
                f"expected a cell by name in an agent that is saved, got {self._options['cell']!r}; save the weights "
                "with safetensors (agent.actor.state_dict()) instead"
            )
        return dict(self._options)

    def parts(self) -> dict[str, bytes]:
        """The weights of actor, critic and averaged critic. The optimiser's moments and the replay are not kept."""
        tensors = {
            **_flat("actor", TensorDict.from_module(self.actor)),
            **_flat("critic", TensorDict.from_module(self.critic)),
            **_flat("averaged", self.loss.target_critic_network_params),
            **_flat("auxiliary", TensorDict.from_module(self.loss.auxiliary)),
        }
        tensors["log_alpha"] = self.loss.log_alpha.detach()
        tensors["reward_scale"] = torch.tensor(self._reward_scale or 0.0, dtype=torch.float64)
        tensors["moments"] = torch.from_numpy(self._moments.to_array())
        tensors["num_timesteps"] = torch.tensor(self.num_timesteps)
        return {"networks.safetensors": save_tensors(tensors)}

    @torch.no_grad()
    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`."""
        tensors = load_tensors(parts["networks.safetensors"])
        for name, target in (
            ("actor", TensorDict.from_module(self.actor)),
            ("critic", TensorDict.from_module(self.critic)),
            ("averaged", self.loss.target_critic_network_params),
            ("auxiliary", TensorDict.from_module(self.loss.auxiliary)),
        ):
            for key, value in _flat(name, target, copy=False).items():
                value.copy_(tensors[key])
        self.loss.log_alpha.copy_(tensors["log_alpha"])
        self._reward_scale = float(tensors["reward_scale"]) or None
        self._moments.from_array(tensors["moments"].numpy())
        self.num_timesteps = int(tensors["num_timesteps"])

    def step_optimizer(self, batch: TensorDict) -> TensorDict:
        """One gradient step on sequences (n, n_steps); the losses' output.

        Raises:
            DivergenceError: losses or values that have diverged.
        """
        answer: TensorDict = self.loss(batch)
        total = torch.stack([value for key, value in answer.items() if key.startswith("loss_")]).sum()
        self._check_finite(total.item(), answer["largest_value"].item())
        self.optimizer.zero_grad()
        total.backward()
        for network in (self.actor, self.critic):
            nn.utils.clip_grad_norm_(network.parameters(), self._options["max_grad_norm"])
        self.optimizer.step()
        self._average.step()
        return answer

    def sample(self) -> TensorDict:
        """Sequences to learn from, (batch_size, longest), see `EpisodeReplay`."""
        own = self._options
        n, length = own["batch_size"], own["sequence_length"]
        if length is None:
            return self._replay.episodes(n, self._random)
        return self._replay.sequences(n, length, max(length // 2, 1), self._random, own["burn_in"])

    def _collect_and_improve(self, collector: RolloutCollector, left: int, progress: float) -> dict[str, Any]:
        self._set_learning_rates(progress)
        self.loss.auxiliary_weights = {
            name: _annealed(options.get("weight", 1.0), progress)
            for name, options in self._options["auxiliary"].items()
        }
        told: dict[str, Any] = {"state_drift": collector.refresh(self.actor.encoder)}
        waiting = min(self._options["learning_starts"] - self._fed, left)
        n_steps = max(self.rollout_steps, -(-waiting // self.n_envs))
        uniform = self.num_timesteps < self._options["learning_starts"]
        rollout = collector.collect(self._act_uniformly if uniform else self._act, n_steps)
        self._scale_rewards(collector, rollout)
        self._moments.add(rollout["observation"].flatten(0, 1).numpy())
        self._set_moments()
        self._replay.extend(rollout.exclude("recurrent_state"))
        steps = self.n_envs * n_steps
        self.num_timesteps, self._fed = self.num_timesteps + steps, self._fed + steps
        if waiting <= 0:
            self._owed += steps * self._options["updates_per_step"]
        answer: TensorDict | None = None
        for _ in range(int(self._owed)):
            answer = self.step_optimizer(self.sample())
        self._owed %= 1.0
        told |= {key: value.item() for key, value in answer.items()} if answer is not None else {}
        record = {
            "steps": steps,
            "num_timesteps": self.num_timesteps,
            "returns": [value for value, _ in collector.finished],
            "lengths": [length for _, length in collector.finished],
            **told,
        }
        self.history.append(record)
        return record

    @torch.no_grad()
    def _act(self, seen: Seen, deterministic: bool = False) -> Acted:
        observation, action, reward = (x[:, None] for x in seen[:3])
        mean, log_std, state = self.actor(observation, action, reward, seen.state)
        if deterministic:
            noise = torch.zeros_like(mean)
        else:
            noise = torch.empty_like(mean).normal_(generator=self._random)
        action, log_probability = squashed_gaussian(mean, log_std, noise)
        return Acted(action[:, 0], log_probability[:, 0].exp(), state)

    def _act_uniformly(self, seen: Seen) -> Acted:
        acted = self._act(seen)
        action = 2.0 * torch.rand(acted.action.shape, generator=self._random) - 1.0
        return Acted(action, torch.full((len(action),), 0.5**self.n_action), acted.state)

    def _seen(self, observation: NDArray[Any], state: Remembered | None, starts: NDArray[np.bool_]) -> Seen:
        n = len(observation)
        if state is None:
            sizes = (self.actor.state_size, self.n_action, 1)
            state = Remembered(*(torch.zeros(n, size) for size in sizes))
        going = torch.from_numpy(~starts)[:, None]
        reward = torch.zeros(n, 1)
        if self.needs_rewards and not starts.all():
            if self._told_reward is None:
                raise ValueError(
                    "this agent's networks take the previous reward: call agent.tell_reward(reward) between "
                    "env.step and predict, evaluate it with beliefgym.agents.evaluate, or train it with "
                    "previous_rewards=False"
                )
            told = np.broadcast_to(self._told_reward, (n,)) * (self._reward_scale or 1.0)
            reward = torch.as_tensor(told.astype(np.float32))[:, None]
        self._told_reward = None
        seen = torch.as_tensor(np.asarray(observation, dtype=np.float32))
        return Seen(seen, state.previous_action * going, reward * going, state.state * going)

    def _scale_rewards(self, collector: RolloutCollector, rollout: TensorDict) -> None:
        """The scale of the first rollout is chosen from it, and holds from then on."""
        if self._reward_scale is None:
            self._reward_scale = _natural_scale(rollout["next", "reward"], self.gamma)
        if collector.reward_scale != self._reward_scale:
            collector.rescale(self._reward_scale, rollout)

    def _set_moments(self) -> None:
        """The moments of observations, into every copy of an encoder."""
        mean, scale = self._moments.mean_and_scale()
        for network in (self.actor, self.critic):
            network.encoder.mean.copy_(mean)
            network.encoder.scale.copy_(scale)
        self.loss.target_critic_network_params["encoder", "mean"].copy_(mean)
        self.loss.target_critic_network_params["encoder", "scale"].copy_(scale)

    def _encoder(self) -> HistoryEncoder:
        own = self._options
        return HistoryEncoder(
            self.n_observation,
            self.n_action,
            own["hidden_size"],
            own["width"],
            own["cell"],
            own["previous_rewards"],
            own["previous_actions"],
        )

    def _make_loss(self) -> RecurrentSACLoss:
        own = self._options
        objectives = {
            name: make_auxiliary(
                name,
                own["hidden_size"],
                self.n_observation,
                self.n_action,
                **{key: value for key, value in options.items() if key != "weight"},
            )
            for name, options in own["auxiliary"].items()
        }
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
            auxiliary=objectives,
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

    def _set_learning_rates(self, progress: float) -> None:
        rate = _annealed(self._options["learning_rate"], progress)
        own = self._options["encoder_learning_rate"]
        rates = {"heads": rate, "encoders": rate / ENCODER_SHARE if own is None else _annealed(own, progress)}
        for group in self.optimizer.param_groups:
            group["lr"] = rates[group["name"]]

    def _check_finite(self, total: float, largest: float) -> None:
        if np.isfinite(total) and largest < 1e6:
            return
        raise DivergenceError(
            f"{type(self).__name__} on {self.task.label} has diverged at step {self.num_timesteps}: loss {total:.3g}, "
            f"largest |Q| {largest:.3g} in units of scaled rewards (scale {self._reward_scale or 1.0:.3g}). Try a "
            f"smaller learning_rate (now {self._options['learning_rate']}), max_grad_norm or gamma, or a larger "
            f"average (now {self._options['average']})"
        )


def _flat(name: str, tensors: Any, copy: bool = True) -> dict[str, Tensor]:
    """ "name.path.to.tensor" -> tensor, without gradient."""
    return {
        ".".join((name, *((key,) if isinstance(key, str) else key))): value.data.clone()
        if copy
        else value.data
        for key, value in tensors.items(include_nested=True, leaves_only=True)
    }


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
