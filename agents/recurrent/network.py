"""The recurrent Q network: observations, previous actions and rewards in, a value for each action out (Fig. 4.3).

    e_t = relu(norm(W [x_t, a_{t-1}, r_{t-1}]))      (h_t, s_t) = memory(e_t, s_{t-1})
    Q(h_t, a) = V(h_t) + A(h_t, a) - mean_a A(h_t, a)

x is standardised by running moments; layer normalisation keeps values from running away without a target network
(Gallici et al. 2024); V and A are the duelling heads of Wang et al. 2016.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from beliefgym.agents.recurrent.memory import Memory, make_memory
from beliefgym.agents.recurrent.rolling import states_after_rows
from beliefgym.agents.recurrent.segments import Segments

HISTORY_KEYS = ("observation", "previous_action", "previous_reward")


class HistoryEncoder(nn.Module):
    """What has been seen and done -> the hidden state h_t.

    Args:
        n_observation, n_action: sizes of an observation and of an action as it is put in (one-hot where discrete).
        hidden_size: size of h. width: of the layer before the memory.
        cell: "lstm", "gru", "none", "stack4" (and 2, 8), or a `Memory` class.
        rewards: put the previous reward in; it then has to be told when acting.
        previous_actions: put the previous action in.
    """

    mean: Tensor
    scale: Tensor

    def __init__(
        self,
        n_observation: int,
        n_action: int,
        hidden_size: int = 64,
        width: int = 64,
        cell: str | Callable[[int, int], Memory] = "lstm",
        rewards: bool = False,
        previous_actions: bool = True,
    ) -> None:
        super().__init__()
        self.n_action, self.rewards, self.previous_actions = n_action, rewards, previous_actions
        size = n_observation + n_action * previous_actions + rewards
        self.embed = nn.Sequential(nn.Linear(size, width), nn.LayerNorm(width), nn.ReLU())
        self.memory = make_memory(cell, width, hidden_size)
        self.register_buffer("mean", torch.zeros(n_observation))
        self.register_buffer("scale", torch.ones(n_observation))

    def standardised(self, observation: Tensor) -> Tensor:
        """(x - mean) / scale, within +-10."""
        return ((observation - self.mean) / self.scale).clamp(-10.0, 10.0)

    def forward(
        self, observation: Tensor, previous_action: Tensor, previous_reward: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Along sequences of one episode each.

        Args:
            observation: (n, n_steps, n_observation). previous_action: (n, n_steps, n_action), 0 at an episode's start.
            previous_reward: (n, n_steps, 1), 0 at an episode's start. state: (n, state_size).

        Returns:
            h (n, n_steps, hidden_size), and the state after the last step.
        """
        seen = [self.standardised(observation)]
        if self.previous_actions:
            seen.append(previous_action)
        if self.rewards:
            seen.append(previous_reward)
        answer: tuple[Tensor, Tensor] = self.memory(self.embed(torch.cat(seen, dim=-1)), state)
        return answer


class DuellingHead(nn.Module):
    """h -> Q(h, a) of every action.

    Args:
        hidden_size: size of h. n_actions: number of actions. width: of the layer between.
    """

    def __init__(self, hidden_size: int, n_actions: int, width: int = 64) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(hidden_size),
            nn.Linear(hidden_size, width),
            nn.LayerNorm(width),
            nn.ReLU(),
            nn.Linear(width, n_actions + 1),
        )

    def forward(self, hidden: Tensor) -> Tensor:
        """(..., hidden_size) -> (..., n_actions)."""
        outputs: Tensor = self.layers(hidden)
        advantages = outputs[..., 1:]
        return outputs[..., :1] + advantages - advantages.mean(-1, keepdim=True)


class RecurrentQNetwork(TensorDictModuleBase):
    """The network as a module of TorchRL's.

    Reads "observation", "previous_action", "previous_reward", "recurrent_state" and "is_init"; writes "action_value",
    "hidden" and ("next", "recurrent_state"). Under TorchRL's `set_recurrent_mode` the batch is (n, n_steps) and the
    recurrent state that of the first step, with episodes that may begin anywhere (`is_init`); else it is (n,), one
    step. Under it ("next", "recurrent_state") is the state after each row's last step, repeated along the row; where
    episodes begin inside rows it has no gradient.

    Args:
        encoder: the history's encoder. n_actions: number of actions. width: of the layer in the head.
    """

    def __init__(self, encoder: HistoryEncoder, n_actions: int, width: int = 64) -> None:
        super().__init__()
        self.in_keys = [*HISTORY_KEYS, "recurrent_state", "is_init"]
        self.out_keys = ["action_value", "hidden", ("next", "recurrent_state")]
        self.encoder = encoder
        self.head = DuellingHead(encoder.memory.hidden_size, n_actions, width)

    @property
    def state_size(self) -> int:
        """Size of the recurrent state."""
        return self.encoder.memory.state_size

    def values(
        self, observation: Tensor, previous_action: Tensor, previous_reward: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Q (n, n_steps, n_actions), h and the last state; see `HistoryEncoder.forward`."""
        hidden, state = self.encoder(observation, previous_action, previous_reward, state)
        return self.head(hidden), hidden, state

    def forward(self, tensordict: TensorDictBase, *arguments: Any, **more: Any) -> TensorDictBase:
        """See the class."""
        seen = (
            tensordict.get("observation"),
            tensordict.get("previous_action"),
            tensordict.get("previous_reward"),
        )
        is_init = tensordict.get("is_init")[..., 0]
        state = tensordict.get("recurrent_state")
        if not recurrent_mode():
            state = torch.where(is_init[..., None], 0.0, state)
            flat = state.reshape(state.shape[:-1].numel(), self.state_size)
            observation, action, reward = (x.reshape(len(flat), 1, -1) for x in seen)
            values, hidden, after = self.values(observation, action, reward, flat)
            shape = state.shape[:-1]
            tensordict.set("action_value", values.reshape(*shape, -1))
            tensordict.set("hidden", hidden.reshape(*shape, -1))
            return tensordict.set(("next", "recurrent_state"), after.reshape(state.shape))
        if not is_init[:, 1:].any():  # every row lies within one episode
            first = torch.where(is_init[:, :1], 0.0, state[:, 0])
            values, hidden, after = self.values(*seen, first)
            tensordict.set("action_value", values)
            tensordict.set("hidden", hidden)
            return tensordict.set(("next", "recurrent_state"), after[:, None].expand(*is_init.shape, -1))
        pieces = Segments(is_init)
        first = torch.where(pieces.fresh[:, None], 0.0, state[:, 0][pieces.rows])
        observation, action, reward = (pieces.steps(x) for x in seen)
        values, hidden, _ = self.values(observation, action, reward, first)
        n, n_steps = is_init.shape
        tensordict.set("action_value", pieces.back(values).view(n, n_steps, -1))
        tensordict.set("hidden", pieces.back(hidden).view(n, n_steps, -1))
        last = states_after_rows(self.encoder, seen, is_init, state[:, 0])
        return tensordict.set(("next", "recurrent_state"), last[:, None].expand(n, n_steps, -1))
