"""What a Stable-Baselines3 model does, with the log-probability of doing it.

    PPO, A2C, RecurrentPPO on a Box    u ~ N(mu, diag std^2), a = u
    SAC, TQC, CrossQ                   u ~ N(mu, diag std^2), a = low + (tanh u + 1) (high - low) / 2,
                                       log p(a) = log N(u) - sum_i log((1 - tanh^2 u_i) (high_i - low_i) / 2)
    PPO, A2C, RecurrentPPO, discrete   p(a) = softmax of the logits
    DQN                                p(a) = epsilon / n + (1 - epsilon) [a greedy], epsilon = `exploration_rate`

The distribution is the one that the model's own `predict` has just computed. Three things differ from that `predict`
with deterministic=False. A Gaussian action is not clipped to its bounds, since at a bound it would have no density (see
beliefgym.envs.exploring_policy). DQN's coin is thrown for each row by itself, not once for the batch. Under gSDE the
noise of each call and row is new: SB3 holds its noise matrix for `sde_sample_freq` steps, and then the density that its
`log_prob` gives, here too, in which the matrix is integrated out, would be right for one step but not for the product
over an episode.

The logarithm of 1 - tanh^2 is computed from u without SB3's constant of 1e-6. Where tanh u rounds to 1 in float32, the
density is that of the action before it was rounded.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import Distribution

from beliefgym.envs.exploring_policy import epsilon_greedy

Floats = NDArray[np.float64]


class WithLogProbs:
    """A Stable-Baselines3 model that tells the log-probability of each action that it draws."""

    explores_always = False

    def __init__(self, model: BaseAlgorithm) -> None:
        self.model = model

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any]:
        """The model's own."""
        return self.model.predict(observation, state, episode_start, deterministic)

    def predict_with_log_prob(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[Any], Any, Floats]:
        """Draw actions: (n, ...), the model's memory, and the log-probabilities (n,).

        Raises:
            ValueError: deterministic=True.
        """
        refuse_deterministic(deterministic)
        return draw_with_log_prob(self.model, observation, state, episode_start)


def with_log_probs(model: BaseAlgorithm) -> WithLogProbs:
    """A raw Stable-Baselines3 model as a policy for `collect(..., deterministic=False)` with log-probabilities.

    Actions and densities are in the units of the model's own action space.

    Args:
        model: PPO, A2C, RecurrentPPO, SAC, TQC, CrossQ or DQN.

    Raises:
        TypeError: not a Stable-Baselines3 model.
        ValueError: a model that does not draw its actions from a density: TD3, DDPG.
    """
    if not isinstance(model, BaseAlgorithm):
        raise TypeError(
            f"expected a Stable-Baselines3 model, got {type(model).__name__}; an SB3Agent has predict_with_log_prob "
            "of its own, any other policy gets one by beliefgym.envs.GaussianPolicy or EpsilonPolicy"
        )
    if not isinstance(model, DQN):
        _distribution(model)
    return WithLogProbs(model)


def draw_with_log_prob(
    model: BaseAlgorithm, observation: Any, state: Any = None, episode_start: Any = None
) -> tuple[NDArray[Any], Any, Floats]:
    """Actions of a model, its memory, and the log-probabilities, in the units of the model's action space.

    Args:
        model: a Stable-Baselines3 model.
        observation: of one copy, or (n, ...) of n, as the model's `predict` takes it.
        state: the model's memory.
        episode_start: (n,) bool: where a new episode has begun.

    Returns:
        action of one copy or (n, ...), the memory, and the log-probability of one copy, () or (n,).

    Raises:
        ValueError: a model that does not draw its actions from a density.
    """
    distribution = None if isinstance(model, DQN) else _distribution(model)
    greedy, state = model.predict(observation, state, episode_start, deterministic=True)
    single = np.shape(greedy) == model.action_space.shape
    if distribution is None:
        space: Any = model.action_space
        rate = model.exploration_rate  # type: ignore[attr-defined]
        action, log_prob = epsilon_greedy(np.atleast_1d(greedy), space, rate, space.np_random)
    else:
        with torch.no_grad():
            action, log_prob = _draw(model, distribution)
    return (action[0], state, log_prob[0]) if single else (action, state, log_prob)


def refuse_deterministic(deterministic: bool) -> None:
    """Raise where the density of a deterministic action is asked for."""
    if deterministic:
        raise ValueError(
            "expected deterministic=False: a deterministic action has no density; say collect(..., "
            "deterministic=False), or explore around it with beliefgym.envs.GaussianPolicy or EpsilonPolicy"
        )


def log_half_widths(low: NDArray[Any], high: NDArray[Any]) -> float:
    """log |det| of the map from [-1, 1] onto a box: sum_i log((high_i - low_i) / 2)."""
    return float(np.log(0.5 * (np.asarray(high, np.float64) - low)).sum())


def _draw(model: BaseAlgorithm, distribution: Distribution) -> tuple[NDArray[Any], Floats]:
    """Draw from the distribution of the last call of `predict`."""
    space: Any = model.action_space
    normal = distribution.distribution
    if not isinstance(normal, torch.distributions.Normal):
        drawn = distribution.sample()
        log_prob = distribution.log_prob(drawn).double()
        return drawn.cpu().numpy().reshape(-1, *space.shape), log_prob.cpu().numpy()
    u = normal.rsample().double()
    exact = torch.distributions.Normal(normal.loc.double(), normal.scale.double())
    log_prob = exact.log_prob(u).sum(dim=1)
    action = u.cpu().numpy().reshape(-1, *space.shape)
    if model.policy.squash_output:
        # log(1 - tanh^2 u) without cancellation
        log_slope = 2.0 * (np.log(2.0) - u - torch.nn.functional.softplus(-2.0 * u))
        log_prob = log_prob - log_slope.sum(dim=1) - log_half_widths(space.low, space.high)
        action = model.policy.unscale_action(np.tanh(action))
    return action.astype(space.dtype), log_prob.cpu().numpy()


def _distribution(model: BaseAlgorithm) -> Distribution:
    """The object that holds the distribution of the model's last action."""
    found = getattr(getattr(model.policy, "actor", model.policy), "action_dist", None)
    if not isinstance(found, Distribution):
        name = type(model).__name__
        raise ValueError(
            f"expected a model that draws its actions from a density (PPO, A2C, RecurrentPPO, SAC, TQC, CrossQ, DQN), "
            f"got {name}; explore around it with beliefgym.envs.GaussianPolicy(policy, std, seed=...), or act without "
            "log-probabilities: deterministic=True"
        )
    return found
