"""What recurrent agents that learn action values share: network, exploration, targets."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from typing import Any

import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor, nn

from beliefgym.agents.recurrent.action_choice import action_probabilities
from beliefgym.agents.recurrent.collector import Acted, RolloutCollector, Seen
from beliefgym.agents.recurrent.memory import Memory
from beliefgym.agents.recurrent.network import RecurrentQNetwork
from beliefgym.agents.recurrent.recurrent_agent import RecurrentAgent
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss
from beliefgym.agents.recurrent.schedules import annealed
from beliefgym.wrappers.discrete_actions import ActionGrid
from beliefgym.wrappers.task import Task


class RecurrentQAgent(RecurrentAgent):
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
        learning_rate: a number, or "linear:1e-3" or "cubic:1e-3" for one that falls to 0.
        max_grad_norm: gradients are scaled down to it.
        epsilon: share of random actions at the start, at the end, and the share of training over which it falls.
        temperature: of the soft-max policy, in units of scaled rewards; "linear:0.1" falls to 0, which is arg max.
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
        temperature: float | str = 0.0,
        reward_scale: float | str = "auto",
    ) -> None:
        options = {
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
        super().__init__(task, seed, options)
        self._grid = self._action_grid(bins)
        self.n_actions = self.n_action = int(self._choices().n)
        self.epsilon, self.temperature = self._epsilon_at(0.0), annealed(temperature, 0.0)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = RecurrentQNetwork(self._encoder(), self.n_actions, width)
            self.loss: RecurrentSarsaLoss = self.make_loss()
        self.acting = deepcopy(self.network)
        self.optimizer = torch.optim.RAdam(
            self.loss.parameters(), lr=annealed(learning_rate, 0.0), foreach=True
        )

    @abstractmethod
    def make_loss(self) -> RecurrentSarsaLoss:
        """The loss of `self.network`."""

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `RecurrentAgent.restore`; the network that acts, as it was saved, becomes the target network."""
        super().restore(parts)
        if self.loss.delay_value:
            _copy(TensorDict.from_module(self.acting), self.loss.target_value_network_params)
        self.epsilon = self._epsilon_at(1.0)
        self.temperature = annealed(self._options["temperature"], 1.0)

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

    def _networks(self) -> tuple[RecurrentQNetwork, ...]:
        return self.acting, self.network

    def _target_params(self) -> Any:
        return self.loss.target_value_network_params if self.loss.delay_value else None

    def _saved(self) -> dict[str, Any]:
        modules = {"network": self.network, "acting": self.acting, "auxiliary": self.loss.auxiliary}
        return {name: TensorDict.from_module(module) for name, module in modules.items()}

    def _clipped(self) -> Iterable[Iterable[nn.Parameter]]:
        return (self.loss.parameters(),)

    def _anneal(self, progress: float) -> None:
        self.epsilon = self._epsilon_at(progress)
        self.temperature = annealed(self._options["temperature"], progress)
        self.loss.epsilon, self.loss.temperature = self.epsilon, self.temperature
        for group in self.optimizer.param_groups:
            group["lr"] = annealed(self._options["learning_rate"], progress)

    def _collect(self, collector: RolloutCollector, left: int) -> TensorDict:
        del left
        return collector.collect(
            lambda seen: self._act(seen, self.epsilon, self.temperature), self.rollout_steps
        )

    def _choose(self, seen: Seen, deterministic: bool) -> Acted:
        return self._act(seen, *((0.0, 0.0) if deterministic else (self.epsilon, self.temperature)))

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

    def _encoded(self, action: Tensor) -> Tensor:
        return nn.functional.one_hot(action, self.n_actions).to(torch.float32)

    def _to_task(self, action: NDArray[Any]) -> NDArray[Any]:
        return action if self._grid is None else self._grid(action)

    def _further_remedy(self) -> str:
        return ', or gradient="semi"' if self.loss.gradient == "residual" else ""

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


@torch.no_grad()
def _copy(source: Any, target: Any) -> None:
    for key, value in target.items(include_nested=True, leaves_only=True):
        value.data.copy_(source.get(key).data)
