"""What recurrent agents that learn action values share: network, collector, exploration, SB3's face."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from tensordict import TensorDict
from torch import Tensor, nn
from tqdm import tqdm

from beliefgym.agents.agent import Agent, episode_starts, require_box
from beliefgym.agents.recurrent.action_choice import action_probabilities
from beliefgym.agents.recurrent.collector import Acted, RolloutCollector, Seen
from beliefgym.agents.recurrent.memory import Memory
from beliefgym.agents.recurrent.network import HistoryEncoder, RecurrentQNetwork
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss
from beliefgym.agents.training_callback import TrainingCallback
from beliefgym.wrappers.discrete_actions import ActionGrid
from beliefgym.wrappers.task import Task


class DivergenceError(FloatingPointError):
    """Training has diverged; the message says where it was noticed, and what to try."""


class Remembered(NamedTuple):
    """What an agent remembers between two calls of `predict`, on the processor, (n, size) each."""

    state: Tensor
    previous_action: Tensor
    previous_reward: Tensor


class RecurrentQAgent(Agent):
    """Base class; a subclass builds its loss and says what it does with a rollout.

    Args:
        task: the task or environment id, with discrete actions (or `bins`) and a flat Box of observations.
        seed: seed of everything random.
        bins: points of a grid in each component of continuous actions (`DiscreteActions`); None for none.
        n_envs: copies that act at once. rollout_steps: steps of each between two improvements.
        cell, hidden_size, width: of the network, see `HistoryEncoder`.
        previous_actions, previous_rewards: what the network is told besides observations. With rewards, `predict`
            has to be told them (`tell_reward`).
        gamma: discount.
        learning_rate: a number, or "linear:1e-3" for one that falls to 0.
        max_grad_norm: gradients are scaled down to it.
        epsilon: share of random actions at the start, at the end, and the share of training over which it falls.
        temperature: of the soft-max policy, in units of scaled rewards; 0 for arg max.
        reward_scale: rewards are multiplied by it; "auto" chooses sqrt(1 - gamma^2) / rms(r) from the first rollout.

    Attributes:
        num_timesteps: environment steps so far.
        history: a mapping for each rollout: steps, returns of finished episodes, what the subclass says.

    Raises:
        ValueError: spaces that do not fit.
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        bins: int | None = None,
        n_envs: int = 8,
        rollout_steps: int = 32,
        cell: str | Callable[[int, int], Memory] = "lstm",
        hidden_size: int = 64,
        width: int = 64,
        previous_actions: bool = True,
        previous_rewards: bool = False,
        gamma: float = 0.99,
        learning_rate: float | str = "linear:2e-3",
        max_grad_norm: float = 10.0,
        epsilon: tuple[float, float, float] = (1.0, 0.05, 0.1),
        temperature: float = 0.0,
        reward_scale: float | str = "auto",
    ) -> None:
        super().__init__(task, seed)
        require_box(self.observation_space, type(self).__name__)
        self._options: dict[str, Any] = {
            "bins": bins,
            "n_envs": n_envs,
            "rollout_steps": rollout_steps,
            "cell": cell,
            "hidden_size": hidden_size,
            "width": width,
            "previous_actions": previous_actions,
            "previous_rewards": previous_rewards,
            "gamma": gamma,
            "learning_rate": learning_rate,
            "max_grad_norm": max_grad_norm,
            "epsilon": list(epsilon),
            "temperature": temperature,
            "reward_scale": reward_scale,
        }
        self._grid = self._action_grid(bins)
        self.n_actions = int(self._choices().n)
        self.n_envs, self.rollout_steps, self.gamma = n_envs, rollout_steps, gamma
        self.epsilon, self.temperature = self._epsilon_at(0.0), temperature
        self.num_timesteps = 0
        self.history: list[dict[str, Any]] = []
        self._reward_scale = None if reward_scale == "auto" else float(reward_scale)
        self._largest_reward = 0.0
        self._collector: RolloutCollector | None = None
        self._told_reward: NDArray[Any] | None = None
        self._moments = _RunningMoments(self.observation_space.shape[0])  # type: ignore[index]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            encoder = HistoryEncoder(
                self.observation_space.shape[0],  # type: ignore[index]
                self.n_actions,
                hidden_size,
                width,
                cell,
                previous_rewards,
                previous_actions,
            )
            self.network = RecurrentQNetwork(encoder, self.n_actions, width)
            self.loss = self.make_loss()
        self.acting = deepcopy(self.network)
        self._random = torch.Generator().manual_seed(seed)
        self.optimizer = torch.optim.RAdam(
            self.loss.parameters(), lr=self._learning_rate_at(0.0), foreach=True
        )

    @abstractmethod
    def make_loss(self) -> RecurrentSarsaLoss:
        """The loss of `self.network`."""

    @abstractmethod
    def improve(self, rollout: TensorDict, progress: float) -> dict[str, Any]:
        """Learn from a rollout (n_envs, rollout_steps); what is returned joins the history.

        Args:
            rollout: see `RolloutCollector.collect`. progress: share of the training that is over, 0 to 1.
        """

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
            self._collector = RolloutCollector(self._vec_env(), self.network.state_size, self.seed)
            self._collector.reward_scale = self._reward_scale or 1.0
        a_rollout = self.n_envs * self.rollout_steps
        with tqdm(
            total=total_timesteps, desc=type(self).__name__, unit="step", disable=not progress_bar
        ) as bar:
            for i in range(-(-total_timesteps // a_rollout)):
                progress = i * a_rollout / total_timesteps
                self.epsilon = self._epsilon_at(progress)
                for group in self.optimizer.param_groups:
                    group["lr"] = self._learning_rate_at(progress)
                record = self._collect_and_improve(progress)
                bar.update(a_rollout)
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
        seen = self._seen(observation, state, starts)
        acted = self._act(
            seen, 0.0 if deterministic else self.epsilon, 0.0 if deterministic else self.temperature
        )
        chosen = acted.action.numpy()
        memory = Remembered(
            acted.state,
            torch.nn.functional.one_hot(acted.action, self.n_actions).to(torch.float32),
            torch.zeros(len(chosen), 1),
        )
        action = chosen if self._grid is None else self._grid(chosen)
        return (action[0] if single else action), memory

    def options(self) -> dict[str, Any]:
        """See `Agent.options`.

        Raises:
            ValueError: a cell of one's own, which a file without code cannot hold.
        """
        if not isinstance(self._options["cell"], str):
            raise ValueError(
                f"expected a cell by name in an agent that is saved, got {self._options['cell']!r}; save the weights "
                "with safetensors (agent.network.state_dict()) instead"
            )
        return dict(self._options)

    def parts(self) -> dict[str, bytes]:
        """The weights of the network that learns, of the one that acts, and of auxiliary objectives.

        The optimiser's moments, replays and running episodes are not kept.
        """
        tensors = {
            f"{name}.{key}": value.contiguous()
            for name, network in self._modules().items()
            for key, value in network.state_dict().items()
        }
        tensors["reward_scale"] = torch.tensor(self._reward_scale or 0.0, dtype=torch.float64)
        tensors["moments"] = torch.from_numpy(self._moments.to_array())
        tensors["num_timesteps"] = torch.tensor(self.num_timesteps)
        return {"networks.safetensors": save_tensors(tensors)}

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`."""
        tensors = load_tensors(parts["networks.safetensors"])
        for name, network in self._modules().items():
            network.load_state_dict(
                {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}
            )
        if self.loss.delay_value:
            _copy(TensorDict.from_module(self.acting), self.loss.target_value_network_params)
        self._reward_scale = float(tensors["reward_scale"]) or None
        self._moments.from_array(tensors["moments"].numpy())
        self.num_timesteps = int(tensors["num_timesteps"])
        self.epsilon = self._epsilon_at(1.0)

    def _modules(self) -> dict[str, nn.Module]:
        return {"network": self.network, "acting": self.acting, "auxiliary": self.loss.auxiliary}

    def step_optimizer(self, batch: TensorDict) -> TensorDict:
        """One gradient step on a batch (n, n_steps); the loss's output.

        Raises:
            DivergenceError: a loss or values that have diverged.
        """
        answer = self.loss(batch)
        total = sum(value for key, value in answer.items() if key.startswith("loss_"))
        self._check_finite(answer, total)
        self.optimizer.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.loss.parameters(), self._options["max_grad_norm"])
        self.optimizer.step()
        return answer

    def sync_acting(self) -> None:
        """The acting network becomes the target network of the loss, or the network itself without one."""
        with torch.no_grad():
            source = (
                self.loss.target_value_network_params if self.loss.delay_value else self.network.state_dict()
            )
            if self.loss.delay_value:
                _copy(source, TensorDict.from_module(self.acting))
            else:
                self.acting.load_state_dict(source)

    def before_rollout(self, collector: RolloutCollector) -> dict[str, Any]:
        """Called before each rollout; what is returned joins the history."""
        del collector
        return {}

    def _collect_and_improve(self, progress: float) -> dict[str, Any]:
        collector = self._collector
        assert collector is not None
        told = self.before_rollout(collector)
        rollout = collector.collect(
            lambda seen: self._act(seen, self.epsilon, self.temperature), self.rollout_steps
        )
        if self._reward_scale is None:
            self._reward_scale = _natural_scale(rollout["next", "reward"], self.gamma)
        if collector.reward_scale != self._reward_scale:
            collector.rescale(self._reward_scale, rollout)
        self._largest_reward = max(self._largest_reward, float(rollout["next", "reward"].abs().max()))
        self._moments.add(rollout["observation"].flatten(0, 1).numpy())
        self._set_moments()
        self.loss.epsilon, self.loss.temperature = self.epsilon, self.temperature
        told |= self.improve(rollout, progress)
        steps = self.n_envs * self.rollout_steps
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

    @torch.no_grad()
    def _act(self, seen: Seen, epsilon: float, temperature: float) -> Acted:
        observation, action, reward = (x[:, None] for x in seen[:3])
        values, _, state = self.acting.values(observation, action, reward, seen.state)
        if not values.isfinite().all():
            self._tell_divergence(float("nan"), float(values.abs().max()))
        probabilities = action_probabilities(values[:, 0], epsilon, temperature)
        if epsilon == 0.0 and temperature == 0.0:
            action = probabilities.argmax(-1)
        else:
            action = torch.multinomial(probabilities, 1, generator=self._random)[:, 0]
        return Acted(action, probabilities.gather(1, action[:, None])[:, 0], state)

    def _seen(self, observation: NDArray[Any], state: Remembered | None, starts: NDArray[np.bool_]) -> Seen:
        n = len(observation)
        if state is None:
            state = Remembered(
                torch.zeros(n, self.network.state_size), torch.zeros(n, self.n_actions), torch.zeros(n, 1)
            )
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
        """The moments of observations, into every copy of the network."""
        mean, scale = self._moments.mean_and_scale()
        for network in (self.network, self.acting):
            network.encoder.mean.copy_(mean)
            network.encoder.scale.copy_(scale)
        if self.loss.delay_value:
            self.loss.target_value_network_params["encoder", "mean"].copy_(mean)
            self.loss.target_value_network_params["encoder", "scale"].copy_(scale)

    def _check_finite(self, answer: TensorDict, total: Tensor) -> None:
        loss, largest = float(total.detach()), float(answer["largest_value"])
        if not np.isfinite(loss) or not largest < self._largest_sum():
            self._tell_divergence(loss, largest)

    def _tell_divergence(self, loss: float, largest: float) -> None:
        raise DivergenceError(
            f"{type(self).__name__} on {self.task.label} has diverged at step {self.num_timesteps}: loss {loss:.3g}, "
            f"largest |Q| {largest:.3g} in units of scaled rewards (scale {self._reward_scale or 1.0:.3g}). Try a "
            f"smaller learning_rate (now {self._options['learning_rate']}), a smaller max_grad_norm or gamma"
            + (', or gradient="semi"' if self.loss.gradient == "residual" else "")
        )

    def _largest_sum(self) -> float:
        """A hundred times what the largest reward so far can add up to, and at least 1000."""
        return max(1000.0, 100.0 * self._largest_reward / max(1.0 - self.gamma, 1e-3))

    def _vec_env(self) -> Any:
        if self._grid is None:
            return self.task.make_vec(self.n_envs)
        layers = (*self.task.wrappers, ("DiscreteActions", {"bins": self._options["bins"]}))
        return Task(self.task.env_id, self.task.kwargs, layers).make_vec(self.n_envs)

    def _action_grid(self, bins: int | None) -> ActionGrid | None:
        if bins is not None:
            return ActionGrid(self.action_space, bins, "discrete")
        if isinstance(self.action_space, Discrete):
            if self.action_space.start != 0:
                raise ValueError(
                    f"expected actions that are counted from 0, but {self.task.label} has {self.action_space}; "
                    "shift them with gymnasium.wrappers.TransformAction"
                )
            return None
        what = "continuous actions" if isinstance(self.action_space, Box) else "actions of several numbers"
        raise ValueError(
            f"{type(self).__name__} chooses among finitely many actions, but {self.task.label} has {what}, "
            f"{self.action_space}: pass bins=5 (a grid of torques, forces, ..), put "
            "DiscreteActions around the environment "
            f'(Task("{self.task.env_id}", wrappers=(("DiscreteActions", {{"bins": 5}}),))), or take RecurrentSAC'
        )

    def _choices(self) -> Discrete:
        space = self.action_space if self._grid is None else self._grid.action_space
        assert isinstance(space, Discrete)
        return space

    def _epsilon_at(self, progress: float) -> float:
        start, end, share = self._options["epsilon"]
        return float(end if progress >= share else start + (end - start) * progress / share)

    def _learning_rate_at(self, progress: float) -> float:
        rate = self._options["learning_rate"]
        if isinstance(rate, str):
            return float(rate.removeprefix("linear:")) * (1.0 - progress)
        return float(rate)


class _RunningMoments:
    """Mean and deviation of everything seen (Chan et al. 1979)."""

    def __init__(self, size: int) -> None:
        self._count, self._mean, self._sum = 0.0, np.zeros(size), np.zeros(size)

    def add(self, rows: NDArray[Any]) -> None:
        n, mean = len(rows), rows.mean(0, dtype=np.float64)
        total = self._count + n
        self._sum += ((rows - mean) ** 2).sum(0) + (mean - self._mean) ** 2 * self._count * n / total
        self._mean += (mean - self._mean) * n / total
        self._count = total

    def mean_and_scale(self) -> tuple[Tensor, Tensor]:
        deviation = np.sqrt(self._sum / max(self._count, 1.0))
        scale = np.where(deviation > 1e-6, deviation, 1.0)
        return torch.as_tensor(self._mean, dtype=torch.float32), torch.as_tensor(scale, dtype=torch.float32)

    def to_array(self) -> NDArray[np.float64]:
        return np.stack([np.full_like(self._mean, self._count), self._mean, self._sum])

    def from_array(self, array: NDArray[np.float64]) -> None:
        self._count, self._mean, self._sum = float(array[0, 0]), array[1].copy(), array[2].copy()


def _natural_scale(rewards: Tensor, gamma: float) -> float:
    """sqrt(1 - gamma^2) / rms(r): discounted sums of rewards that are independent have about unit size."""
    size = float(rewards.square().mean().sqrt())
    return float(np.sqrt(max(1.0 - gamma**2, 1e-4)) / size) if size > 0.0 else 1.0


@torch.no_grad()
def _copy(source: Any, target: Any) -> None:
    for key, value in target.items(include_nested=True, leaves_only=True):
        value.data.copy_(source.get(key).data)
