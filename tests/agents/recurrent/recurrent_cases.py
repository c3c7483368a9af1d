"""Small networks, rollouts made by hand, and the loss of Recurrent-Q SARSA as a slow loop over single episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from tensordict import TensorDict
from torch import Tensor

from beliefgym.agents.recurrent.network import HistoryEncoder, RecurrentQNetwork

STATE_SIZES = {"lstm": 10, "gru": 5, "none": 0, "stack2": 6, "stack4": 18}  # of `q_network`


def q_network(
    cell: Any = "lstm",
    n_observation: int = 3,
    n_actions: int = 4,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
    **more: Any,
) -> RecurrentQNetwork:
    """One whose every parameter is drawn, those of layer normalisation too, large enough for memory to matter."""
    encoder = HistoryEncoder(n_observation, n_actions, hidden_size=5, width=6, cell=cell, **more)
    network = RecurrentQNetwork(encoder, n_actions, width=6)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.7 * torch.randn(parameter.shape, generator=generator))
        encoder.mean.copy_(torch.randn(n_observation, generator=generator))
        encoder.scale.copy_(1.0 + torch.rand(n_observation, generator=generator))
    return network.to(dtype)


def made_up_rollout(
    n: int = 5,
    n_steps: int = 7,
    state_size: int = 10,
    n_observation: int = 3,
    n_actions: int = 4,
    p_end: float = 0.3,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> TensorDict:
    """Rows of episodes that end anywhere, by themselves or cut, in the collector's layout; all else is noise.

    Row 0 begins inside an episode, row 1 at an episode's start.
    """
    rng = np.random.default_rng(seed)
    shape = (n, n_steps)
    done = rng.random(shape) < p_end
    terminated = done & (rng.random(shape) < 0.5)
    begins = np.concatenate([rng.random((n, 1)) < 0.5, done[:, :-1]], axis=1)
    begins[0, 0], begins[1:2, 0] = False, True
    action = rng.integers(n_actions, size=shape)
    taken = np.eye(n_actions)[action]
    reward = rng.standard_normal((*shape, 1))
    observation = rng.standard_normal((*shape, n_observation))
    following = np.concatenate([observation[:, 1:], rng.standard_normal((n, 1, n_observation))], axis=1)
    following[done] = rng.standard_normal((done.sum(), n_observation))
    previous_action = np.concatenate(
        [np.eye(n_actions)[rng.integers(n_actions, size=(n, 1))], taken[:, :-1]], axis=1
    )
    previous_reward = np.concatenate([rng.standard_normal((n, 1, 1)), reward[:, :-1]], axis=1)
    previous_action[begins], previous_reward[begins] = 0.0, 0.0
    state = np.where(begins[..., None], 0.0, 0.5 * rng.standard_normal((*shape, state_size)))

    def real(x: Any) -> Tensor:
        return torch.as_tensor(x, dtype=dtype)

    def flag(x: Any) -> Tensor:
        return torch.as_tensor(x)[..., None]

    after = {
        "observation": real(following),
        "previous_action": real(taken),
        "previous_reward": real(reward),
        "reward": real(reward),
        "terminated": flag(terminated),
        "truncated": flag(done & ~terminated),
        "done": flag(done),
    }
    return TensorDict(
        {
            "observation": real(observation),
            "previous_action": real(previous_action),
            "previous_reward": real(previous_reward),
            "recurrent_state": real(state),
            "is_init": flag(begins),
            "action": torch.as_tensor(action),
            "action_probability": real(rng.uniform(0.1, 1.0, shape)),
            "next": TensorDict(after, shape),
        },
        shape,
    )


def pieces_by_loop(is_init: Any, valid: Any = None) -> list[tuple[int, int, int]]:
    """(row, first step, step after the last) of every piece."""
    found = []
    for row, begins in enumerate(np.asarray(is_init).tolist()):
        n_valid = len(begins) if valid is None else int(np.asarray(valid)[row].sum())
        for t in range(n_valid):
            if t == 0 or begins[t]:
                found.append([row, t, t])
            found[-1][2] = t + 1
    return [(row, begin, end) for row, begin, end in found]


def values_along(
    network: RecurrentQNetwork, rollout: TensorDict, piece: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Q (steps + 1, n_actions) and h of one piece and of what followed it, one step at a time from its own state."""
    row, begin, end = piece
    state = rollout["recurrent_state"][row, begin][None]
    if rollout["is_init"][row, begin]:
        state = torch.zeros_like(state)
    keys = ("observation", "previous_action", "previous_reward")
    seen = [[rollout[key][row, t] for key in keys] for t in range(begin, end)]
    seen.append([rollout["next", key][row, end - 1] for key in keys])
    values, hidden = [], []
    for inputs in seen:
        q, h, state = network.values(*(x[None, None] for x in inputs), state)
        values.append(q[0, 0])
        hidden.append(h[0, 0])
    return torch.stack(values), torch.stack(hidden)


def piece_loss(
    q: Tensor,
    rollout: TensorDict,
    piece: tuple[int, int, int],
    policy: Callable[[Tensor], Tensor],
    *,
    later: Tensor,
    gamma: float,
    n_steps: int | None,
    weights: Any,
    bootstrap: str,
    importance: bool = False,
    munchausen: float = 0.0,
    temperature: float = 0.0,
) -> list[Tensor]:
    """l_t of every step, by the sums that define it. `later` are the values that targets are taken from."""
    row, begin, end = piece
    n = end - begin
    action, reward = rollout["action"][row, begin:end].tolist(), rollout["next", "reward"][row, begin:end, 0]
    over = bool(rollout["next", "terminated"][row, end - 1])
    if munchausen:
        logs = [policy(later[t]).log()[action[t]] for t in range(n)]
        reward = reward + munchausen * temperature * torch.stack(logs)

    def value_after(t: int) -> Any:
        if over and t == n - 1:
            return 0.0
        if bootstrap == "max":
            return later[t + 1].max()
        if bootstrap == "double":
            return later[t + 1][q[t + 1].argmax()]
        if bootstrap == "expected" or t == n - 1:
            share = policy(later[t + 1])
            entropy = -(share * share.log()).sum() if munchausen else 0.0
            return (share * later[t + 1]).sum() + temperature * entropy
        return later[t + 1][action[t + 1]]

    def target(t: int, steps: int) -> Any:
        last = min(t + steps, n) - 1
        return sum(gamma**i * reward[t + i] for i in range(last - t + 1)) + gamma ** (
            last - t + 1
        ) * value_after(last)

    def traced(t: int) -> Any:
        """Munos et al. 2016, Eq. 3: the sum over temporal differences."""
        total, product = later[t][action[t]], 1.0
        for s in range(t, n):
            if s > t:
                mu = rollout["action_probability"][row, begin + s]
                ratio = float(policy(later[s])[action[s]] / mu) if importance else 1.0
                product = product * weights * min(1.0, ratio)
            difference = reward[s] + gamma * value_after(s) - later[s][action[s]]
            total = total + gamma ** (s - t) * product * difference
        return total

    losses = []
    for t in range(n):
        chosen = q[t][action[t]]
        if n_steps is not None:
            shares = [weights**i for i in range(n_steps + 1)] if isinstance(weights, float) else weights
            squares = [w * (chosen - target(t, i + 1)) ** 2 for i, w in enumerate(shares)]
            losses.append(sum(squares) / sum(shares))
        elif bootstrap == "expected":
            losses.append((chosen - traced(t)) ** 2)
        else:
            left = n - t
            mixed = sum((1 - weights) * weights**i * target(t, i + 1) for i in range(left - 1))
            losses.append((chosen - mixed - weights ** (left - 1) * target(t, left)) ** 2)
    return losses


def loss_by_loop(
    network: RecurrentQNetwork,
    rollout: TensorDict,
    *,
    target: RecurrentQNetwork | None = None,
    fixed: bool = True,
    burn_in: int = 0,
    epsilon: float = 0.0,
    temperature: float = 0.0,
    mask: Any = None,
    **form: Any,
) -> Tensor:
    """The mean of l_t over steps, piece by piece and step by step, with a graph to the network's parameters.

    Args:
        target: network that targets are taken from; None for the network itself. fixed: no gradient through targets.
        burn_in, epsilon, temperature, form: as the loss's. mask: the steps that exist.
    """
    losses = []
    for piece in pieces_by_loop(rollout["is_init"][..., 0], mask):
        q, _ = values_along(network, rollout, piece)
        later = q if target is None else values_along(target, rollout, piece)[0]
        form["temperature"] = temperature if form.get("munchausen") else 0.0
        steps = piece_loss(
            q,
            rollout,
            piece,
            lambda values: policy_by_hand(values.detach(), epsilon, temperature),
            later=later.detach() if fixed else later,
            **form,
        )
        fresh = rollout["is_init"][piece[0], piece[1], 0]
        losses += steps if fresh else steps[burn_in:]
    return torch.stack(losses).mean()


def policy_by_hand(values: Tensor, epsilon: float, temperature: float) -> Tensor:
    """Of the values (n_actions,) of one step."""
    greedy = torch.softmax(values / temperature, 0) if temperature else torch.zeros_like(values)
    if not temperature:
        greedy[values.argmax()] = 1.0
    return (1 - epsilon) * greedy + epsilon / len(values)


def gradient(value: Tensor, network: torch.nn.Module) -> Tensor:
    """With regard to all parameters, as one vector."""
    parameters = list(network.parameters())
    found = torch.autograd.grad(value, parameters, allow_unused=True)
    return torch.cat(
        [(torch.zeros_like(p) if g is None else g).flatten() for p, g in zip(parameters, found, strict=True)]
    )


class Scripted(gym.Env):
    """Episodes of the given lengths, again and again; an observation tells copy, episode and step; the reward both.

    Episodes of an even number are cut, the others end by themselves.
    """

    def __init__(self, copy: int = 0, lengths: tuple[int, ...] = (1, 3, 1, 1, 2), n_actions: int = 4) -> None:
        self.observation_space = Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = Discrete(n_actions)
        self.copy, self.lengths = copy, lengths
        self.episode, self.t = -1, 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """The next episode."""
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        """One step on, whatever is done."""
        self.t += 1
        over = self.t == self.lengths[self.episode % len(self.lengths)]
        cut = self.episode % 2 == 0
        return self._observation(), self.episode + 0.1 * self.t, over and not cut, over and cut, {}

    def _observation(self) -> Any:
        return np.array([self.copy, 0.3 * self.episode, 0.2 * self.t], dtype=np.float32)


class Cue(gym.Env):
    """Four steps: the first observation is 1 or -1, the others are 0; the reward is 1 if the last action tells which.

    No policy without memory has more than 1/2 on average.
    """

    def __init__(self) -> None:
        self.observation_space = Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """Another cue."""
        super().reset(seed=seed)
        self.cue, self.t = int(self.np_random.integers(2)), 0
        return np.array([2.0 * self.cue - 1.0, 0.0], dtype=np.float32), {}

    def step(self, action: Any) -> Any:
        """The time is seen too."""
        self.t += 1
        observation = np.array([0.0, self.t / 4], dtype=np.float32)
        return observation, float(self.t == 4 and action == self.cue), self.t == 4, False, {}
