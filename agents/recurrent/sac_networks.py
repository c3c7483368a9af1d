"""The networks of recurrent soft actor-critic: histories in, a squashed Gaussian or two action values out.

    h_t^pi = encoder^pi(history_t)    mu_t, sigma_t = head^pi(h_t^pi, x_t)        a_t = tanh(mu_t + sigma_t eps_t)
    h_t^Q  = encoder^Q(history_t)     Q_i(h_t^Q, a)  = head_i(h_t^Q, x_t, a)      i = 1, 2

Actor and critic each have an encoder of their own: the gradients of one would drown the other's in a shared one (Ni et
al. 2022, Sec. 4). The heads see the present observation besides the hidden state (their shortcut), so that the memory
may change slowly. A hidden state is normalised first: its entries are small at the start, beside observations of unit
size, and what tells velocities is smaller still. Actions are in units of (-1, 1) in each component.

References: Haarnoja et al. 2018b, App. C (squashed Gaussian); Ni et al. 2022; layer normalisation in the heads as in
Hiraoka et al. 2022.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from beliefgym.agents.recurrent.network import HistoryEncoder

LOG_STD_RANGE = (-5.0, 2.0)  # of the Gaussian before it is squashed
EDGE = 1e-6  # about how near to 1 a tanh comes in single precision before it is rounded to 1


def squashed_gaussian(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Actions and their log-density.

        a = tanh(u), u = mu + sigma eps
        log pi(a) = sum_j [log N(eps_j; 0, 1) - log sigma_j - log(1 - tanh(u_j)^2)]

    with log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)), which holds for large |u| too.

    Args:
        mean, log_std, noise: (..., n_action); noise is eps, standard normal.

    Returns:
        (..., n_action) in (-1, 1), and (...) log-densities.
    """
    u = mean + log_std.exp() * noise
    return u.tanh(), _log_density(u, noise, log_std)


def log_density(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """The log-density (...) of actions (..., n_action) in [-1, 1]; see `squashed_gaussian`.

    Actions that were rounded to -1 or 1 are taken to lie `EDGE` inside.
    """
    u = action.clamp(EDGE - 1.0, 1.0 - EDGE).atanh()
    return _log_density(u, (u - mean) * (-log_std).exp(), log_std)


def _log_density(u: Tensor, noise: Tensor, log_std: Tensor) -> Tensor:
    gaussian = -0.5 * (noise.square() + math.log(2.0 * math.pi)) - log_std
    squash = 2.0 * (math.log(2.0) - u - softplus(-2.0 * u))
    return (gaussian - squash).sum(-1)


def _head(size: int, n_outputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(
        *(nn.Linear(size, width), nn.LayerNorm(width), nn.ReLU()),
        *(nn.Linear(width, width), nn.LayerNorm(width), nn.ReLU()),
        nn.Linear(width, n_outputs),
    )


class RecurrentActor(nn.Module):
    """The policy.

    Args:
        encoder: of histories. n_observation, n_action: sizes. width: of the head's two layers.
    """

    def __init__(self, encoder: HistoryEncoder, n_observation: int, n_action: int, width: int = 128) -> None:
        super().__init__()
        self.encoder, self.n_action = encoder, n_action
        self.norm = nn.LayerNorm(encoder.memory.hidden_size)
        self.head = _head(encoder.memory.hidden_size + n_observation, 2 * n_action, width)

    @property
    def state_size(self) -> int:
        """Size of the recurrent state."""
        return self.encoder.memory.state_size

    def forward(
        self, observation: Tensor, previous_action: Tensor, previous_reward: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Along sequences of one episode each; see `HistoryEncoder.forward`.

        Returns:
            mean and log_std (n, n_steps, n_action) before squashing, and the state after the last step.
        """
        hidden, state = self.encoder(observation, previous_action, previous_reward, state)
        outputs = self.head(torch.cat([self.norm(hidden), self.encoder.standardised(observation)], dim=-1))
        mean, spread = outputs.chunk(2, dim=-1)
        low, high = LOG_STD_RANGE
        return mean, low + 0.5 * (high - low) * (spread.tanh() + 1.0), state


class RecurrentCritic(nn.Module):
    """Two action values over one hidden state.

    Args:
        encoder: of histories. n_observation, n_action: sizes. width: of the heads' two layers.
    """

    def __init__(self, encoder: HistoryEncoder, n_observation: int, n_action: int, width: int = 128) -> None:
        super().__init__()
        self.encoder = encoder
        self.norm = nn.LayerNorm(encoder.memory.hidden_size)
        size = encoder.memory.hidden_size + n_observation + n_action
        self.heads = nn.ModuleList(_head(size, 1, width) for _ in range(2))

    @property
    def state_size(self) -> int:
        """Size of the recurrent state."""
        return self.encoder.memory.state_size

    def hidden(
        self, observation: Tensor, previous_action: Tensor, previous_reward: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See `HistoryEncoder.forward`."""
        answer: tuple[Tensor, Tensor] = self.encoder(observation, previous_action, previous_reward, state)
        return answer

    def values(self, hidden: Tensor, observation: Tensor, action: Tensor) -> Tensor:
        """Q_1 and Q_2.

        Args:
            hidden: (n, n_steps, hidden_size). observation: (n, n_steps, n_observation), not standardised. action:
                (n, n_steps, n_action) in (-1, 1).

        Returns:
            (2, n, n_steps).
        """
        seen = torch.cat([self.norm(hidden), self.encoder.standardised(observation), action], dim=-1)
        return torch.stack([head(seen)[..., 0] for head in self.heads])
