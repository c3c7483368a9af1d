"""What all recurrent agents share: the training loop, memory when acting, scales, files, the check for divergence."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule
from tqdm import tqdm

from beliefgym.agents.agent import Agent, episode_starts, require_box
from beliefgym.agents.recurrent.auxiliary import make_auxiliary
from beliefgym.agents.recurrent.collector import Acted, RolloutCollector, Seen
from beliefgym.agents.recurrent.network import HistoryEncoder
from beliefgym.agents.recurrent.scaling import RunningMoments, natural_scale
from beliefgym.agents.recurrent.schedules import annealed
from beliefgym.agents.training_callback import TrainingCallback
from beliefgym.wrappers.task import Task

FILE = "networks.safetensors"
MOMENTS_SHARE = 0.15  # of a training, over which moments of observations are taken


class DivergenceError(FloatingPointError):
    """Training has diverged; the message says where it was noticed, and what to try."""


class Remembered(NamedTuple):
    """What an agent remembers between two calls of `predict`, on the processor, (n, size) each."""

    state: Tensor
    previous_action: Tensor
    previous_reward: Tensor


class RecurrentAgent(Agent):
    """Base class; a subclass builds networks, `loss` and `optimizer`, and says how it acts and learns.

    Observations are standardised by the moments of those of the first `MOMENTS_SHARE` of a training. Then the moments
    stay: as they went on, they would change what networks make of the same history, and a network that no longer
    learns fast would not follow.

    Args:
        task, seed: see `Agent`; with a flat Box of observations.
        options: all further arguments of the subclass by name, which `options` returns. Read here are n_envs,
            rollout_steps, cell, hidden_size, width, previous_actions, previous_rewards, gamma, learning_rate,
            max_grad_norm and reward_scale.

    Attributes:
        n_observation, n_action: sizes of what the networks take in; n_action is set by the subclass.
        num_timesteps: environment steps so far.
        history: a mapping for each rollout: steps, returns of finished episodes, what the subclass says.

    Raises:
        ValueError: observations that do not fit.
    """

    n_action: int
    loss: LossModule
    optimizer: torch.optim.Optimizer

    def __init__(self, task: Task | str, seed: int, options: dict[str, Any]) -> None:
        super().__init__(task, seed)
        self.n_observation = require_box(self.observation_space, type(self).__name__).shape[0]
        self._options = options
        self.n_envs, self.rollout_steps = options["n_envs"], options["rollout_steps"]
        self.gamma = options["gamma"]
        self.num_timesteps = 0
        self.history: list[dict[str, Any]] = []
        scale = options["reward_scale"]
        self._reward_scale = None if scale == "auto" else float(scale)
        self._largest_reward = 0.0
        self._collector: RolloutCollector | None = None
        self._told_reward: NDArray[Any] | None = None
        self._moments = RunningMoments(self.n_observation)
        self._random = torch.Generator().manual_seed(seed)

    @abstractmethod
    def improve(self, rollout: TensorDict, progress: float) -> dict[str, Any]:
        """Learn from a rollout (n_envs, n_steps); what is returned joins the history.

        Args:
            rollout: see `RolloutCollector.collect`. progress: share of the training that is over, 0 to 1.
        """

    @abstractmethod
    def _networks(self) -> tuple[Any, ...]:
        """All modules with an `encoder`, first the one that acts."""

    @abstractmethod
    def _target_params(self) -> Any:
        """The parameters of the network that targets are taken from; None where it is the one that learns."""

    @abstractmethod
    def _saved(self) -> dict[str, Any]:
        """Name in the file -> a tensor, or a tensordict of parameters."""

    @abstractmethod
    def _clipped(self) -> Iterable[Iterable[nn.Parameter]]:
        """Sets of parameters whose gradients are each scaled down to max_grad_norm."""

    @abstractmethod
    def _vec_env(self) -> VectorEnv[Any, Any, Any]:
        """n_envs copies of the task, with actions as the networks choose them."""

    @abstractmethod
    def _choose(self, seen: Seen, deterministic: bool) -> Acted:
        """The action after what was seen."""

    @abstractmethod
    def _encoded(self, action: Tensor) -> Tensor:
        """An action as the networks take it in, (n, n_action)."""

    @abstractmethod
    def _to_task(self, action: NDArray[Any]) -> NDArray[Any]:
        """Actions as the task takes them."""

    @abstractmethod
    def _collect(self, collector: RolloutCollector, left: int) -> TensorDict:
        """The next rollout, with as many environment steps left to train for."""

    @abstractmethod
    def _anneal(self, progress: float) -> None:
        """Set what changes over a training."""

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
            self._collector = RolloutCollector(self._vec_env(), self._networks()[0].state_size, self.seed)
            self._collector.reward_scale = self._reward_scale or 1.0
        begin = self.num_timesteps
        with tqdm(
            total=total_timesteps, desc=type(self).__name__, unit="step", disable=not progress_bar
        ) as bar:
            while (done := self.num_timesteps - begin) < total_timesteps:
                record = self._collect_and_improve(
                    self._collector, total_timesteps - done, done / total_timesteps
                )
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
        """See `Agent.predict`. Without `deterministic` actions are drawn from the policy that explores.

        Raises:
            ValueError: the network takes rewards, and was not told the last one.
        """
        observation, single = self.batched(observation)
        starts = episode_starts(state, episode_start, len(observation))
        acted = self._choose(self._seen(observation, state, starts), deterministic)
        memory = Remembered(acted.state, self._encoded(acted.action), torch.zeros(len(observation), 1))
        action = self._to_task(acted.action.numpy())
        return (action[0] if single else action), memory

    def options(self) -> dict[str, Any]:
        """See `Agent.options`.

        Raises:
            ValueError: a cell of one's own, which a file without code cannot hold.
        """
        if not isinstance(self._options["cell"], str):
            raise ValueError(
                f"expected a cell by name in an agent that is saved, got {self._options['cell']!r}; save the weights "
                "of its networks (state_dict()) with safetensors instead"
            )
        return dict(self._options)

    def parts(self) -> dict[str, bytes]:
        """The weights of all networks and auxiliary objectives, moments of observations, scale of rewards.

        The optimiser's moments, replays and running episodes are not kept.
        """
        tensors = {key: value.contiguous() for key, value in self._tensors().items()}
        tensors["reward_scale"] = torch.tensor(self._reward_scale or 0.0, dtype=torch.float64)
        tensors["moments"] = torch.from_numpy(self._moments.to_array())
        tensors["num_timesteps"] = torch.tensor(self.num_timesteps)
        return {FILE: save_tensors(tensors)}

    @torch.no_grad()
    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`; into an agent that has not learned yet, as `Agent.load` makes it.

        `learn` then goes on with new episodes and an empty replay (learning_starts counts what is in it). An averaged
        network in the file is the target network again; where there is none, the network that acts becomes it.

        Raises:
            ValueError: weights of other networks than these.
        """
        saved, own = load_tensors(parts[FILE]), self._tensors()
        held = {key: value for key, value in saved.items() if key not in _SCALARS}
        differ = {key for key in own.keys() | held.keys() if _shape(own, key) != _shape(held, key)}
        if differ:
            name = min(differ)
            raise ValueError(
                f"expected weights as {type(self).__name__} has them with these options, got {len(differ)} others: "
                f"{name} of shape {_shape(held, name)} in the file, {_shape(own, name)} here; load it with the version "
                "that saved it"
            )
        for key, value in own.items():
            value.copy_(held[key])
        self._reward_scale = float(saved["reward_scale"]) or None
        self._moments.from_array(saved["moments"].numpy())
        self.num_timesteps = int(saved["num_timesteps"])

    def step_optimizer(self, batch: TensorDict) -> TensorDict:
        """One gradient step on a batch (n, n_steps); the loss's output.

        Raises:
            DivergenceError: a loss or values that have diverged.
        """
        answer: TensorDict = self.loss(batch)
        total = torch.stack([value for key, value in answer.items() if key.startswith("loss_")]).sum()
        loss, largest = total.item(), answer["largest_value"].item()
        if not np.isfinite(loss) or not largest < self._largest_sum():
            self._tell_divergence(loss, largest)
        self.optimizer.zero_grad()
        total.backward()
        for parameters in self._clipped():
            nn.utils.clip_grad_norm_(parameters, self._options["max_grad_norm"])
        self.optimizer.step()
        return answer

    def before_rollout(self, collector: RolloutCollector) -> dict[str, Any]:
        """Called before each rollout; what is returned joins the history."""
        del collector
        return {}

    def _collect_and_improve(self, collector: RolloutCollector, left: int, progress: float) -> dict[str, Any]:
        self._anneal(progress)
        told = self.before_rollout(collector)
        rollout = self._collect(collector, left)
        if self._reward_scale is None:  # which then holds from here on
            self._reward_scale = natural_scale(rollout["next", "reward"], self.gamma)
        if collector.reward_scale != self._reward_scale:
            collector.rescale(self._reward_scale, rollout)
        self._largest_reward = max(self._largest_reward, float(rollout["next", "reward"].abs().max()))
        if progress <= MOMENTS_SHARE:
            self._moments.add(rollout["observation"].flatten(0, 1).numpy())
            self._set_moments()
        told |= self.improve(rollout, progress)
        steps = rollout.numel()
        self.num_timesteps += steps
        record = {
            "steps": steps,
            "num_timesteps": self.num_timesteps,
            "returns": [value for value, _ in collector.finished],
            "lengths": [length for _, length in collector.finished],
            **told,
        }
        self.history.append(record)
        return record

    def _seen(self, observation: NDArray[Any], state: Remembered | None, starts: NDArray[np.bool_]) -> Seen:
        n = len(observation)
        if state is None:
            sizes = (self._networks()[0].state_size, self.n_action, 1)
            state = Remembered(*(torch.zeros(n, size) for size in sizes))
        going = torch.from_numpy(~starts)[:, None]
        reward = torch.zeros(n, 1)
        if self.needs_rewards and not starts.all():
            if self._told_reward is None:
                raise ValueError(
                    "this agent's network takes the previous reward: call agent.tell_reward(reward) between "
                    "env.step and predict, evaluate it with beliefgym.agents.evaluate, or train it with "
                    "previous_rewards=False"
                )
            told = np.broadcast_to(self._told_reward, (n,)) * (self._reward_scale or 1.0)
            reward = torch.as_tensor(told.astype(np.float32))[:, None]
        self._told_reward = None
        seen = torch.as_tensor(np.asarray(observation, dtype=np.float32))
        return Seen(seen, state.previous_action * going, reward * going, state.state * going)

    def _set_moments(self) -> None:
        """The moments of observations, into every copy of an encoder."""
        mean, scale = self._moments.mean_and_scale()
        for network in self._networks():
            network.encoder.mean.copy_(mean)
            network.encoder.scale.copy_(scale)
        targets = self._target_params()
        if targets is not None:
            targets["encoder", "mean"].copy_(mean)
            targets["encoder", "scale"].copy_(scale)

    def _tensors(self) -> dict[str, Tensor]:
        """ "name.path.to.tensor" -> the agent's own tensor, without gradient."""
        tensors: dict[str, Tensor] = {}
        for name, value in self._saved().items():
            if isinstance(value, Tensor):
                tensors[name] = value.data
                continue
            for key, leaf in value.items(include_nested=True, leaves_only=True):
                path = (key,) if isinstance(key, str) else key
                tensors[".".join((name, *path))] = leaf.data
        return tensors

    def _tell_divergence(self, loss: float, largest: float) -> None:
        raise DivergenceError(
            f"{type(self).__name__} on {self.task.label} has diverged at step {self.num_timesteps}: loss {loss:.3g}, "
            f"largest |Q| {largest:.3g} in units of scaled rewards (scale {self._reward_scale or 1.0:.3g}). Try a "
            f"smaller learning_rate (now {self._options['learning_rate']}), a smaller max_grad_norm or gamma"
            f"{self._further_remedy()}"
        )

    def _further_remedy(self) -> str:
        return ""

    def _largest_sum(self) -> float:
        """A hundred times what the largest reward so far can add up to, and at least 1000."""
        return max(1000.0, 100.0 * self._largest_reward / max(1.0 - self.gamma, 1e-3))

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

    def _objectives(self, settings: Mapping[str, Mapping[str, Any]]) -> dict[str, nn.Module]:
        """Auxiliary objectives by name, from their options with "weight" among them."""
        return {
            name: make_auxiliary(
                name,
                self._options["hidden_size"],
                self.n_observation,
                self.n_action,
                **{key: value for key, value in options.items() if key != "weight"},
            )
            for name, options in settings.items()
        }

    @staticmethod
    def _objective_weights(settings: Mapping[str, Mapping[str, Any]], progress: float) -> dict[str, float]:
        """The lambdas of auxiliary objectives."""
        return {name: annealed(options.get("weight", 1.0), progress) for name, options in settings.items()}


_SCALARS = ("reward_scale", "moments", "num_timesteps")


def _shape(tensors: Mapping[str, Tensor], key: str) -> tuple[int, ...] | None:
    return tuple(tensors[key].shape) if key in tensors else None
