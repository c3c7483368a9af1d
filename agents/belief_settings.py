"""What a `BeliefPolicy` can be asked for; what is wrong with it is told before the first step."""

from __future__ import annotations

from typing import Any, get_args

from gymnasium.spaces import Box, Discrete, Space
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from beliefgym.agents.agent import require_box
from beliefgym.agents.sb3_agent import ALGORITHMS
from beliefgym.learning.belief_tracker import Show
from beliefgym.learning.filters import Filter, check_whole
from beliefgym.learning.hint_filter import HintFilter

CONTINUOUS = ("SAC", "TD3", "DDPG", "TQC", "CrossQ")
LEAST = {
    **dict.fromkeys(("explore_steps", "evaluation_episodes", "n_envs", "max_fit_steps"), 1),
    **dict.fromkeys(("refit_every", "n_refits", "evaluate_every"), 0),
}


def check_algorithm(algorithm: str, space: Space[Any], rescale_actions: bool) -> None:
    """Raise ValueError unless it is an algorithm for beliefs that acts in this space."""
    known = tuple(name for name in ALGORITHMS if name != "RecurrentPPO")
    if algorithm not in known:
        raise ValueError(f"expected algorithm to be one of {', '.join(known)}, got {algorithm!r}")
    if algorithm in CONTINUOUS:
        require_box(space, algorithm)
    if algorithm == "DQN" and not isinstance(space, Discrete):
        raise ValueError(
            f"DQN needs a Discrete action space, got {space}; put DiscreteActions around the task, or take SAC or PPO"
        )
    if rescale_actions and not require_box(space, "rescale_actions").is_bounded():
        raise ValueError(f"rescale_actions needs a bounded action space, got {space}")
    if isinstance(space, Box) and algorithm in CONTINUOUS and not space.is_bounded():
        raise ValueError(f"{algorithm} needs a bounded action space, got {space}")


def check_schedule(refit_growth: float, **counts: int | None) -> None:
    """Raise ValueError unless the growth is no decay, and each count whole and not below `LEAST`; None is usual."""
    for name, value in counts.items():
        if value is not None:
            check_whole(name, value, LEAST[name])
    if not refit_growth >= 1:
        raise ValueError(f"expected refit_growth of at least 1, got {refit_growth!r}")


def check_show(show: str, filter: Filter) -> None:
    """Raise ValueError unless this filter, fitted or not, has that to show."""
    if show not in get_args(Show):
        raise ValueError(f"expected show to be one of {get_args(Show)}, got {show!r}")
    if show == "hint" and not isinstance(filter, HintFilter):
        raise ValueError(
            f"expected a filter that estimates hints with show='hint', got a {type(filter).__name__}; take "
            "'psim-hints' or 'imf', or show='belief'"
        )


def check_replay_buffer(model: BaseAlgorithm) -> None:
    """Raise ValueError unless the model's replay buffer, if it has one, can be written anew."""
    if not isinstance(model, OffPolicyAlgorithm):
        return
    buffer = model.replay_buffer
    if type(buffer) is not ReplayBuffer or buffer.optimize_memory_usage:
        kind = type(buffer).__name__ + (" with optimize_memory_usage" if type(buffer) is ReplayBuffer else "")
        raise ValueError(
            "expected SB3's plain ReplayBuffer, whose beliefs can be computed anew when the filter is refitted, got "
            f"{kind}; leave n_steps, replay_buffer_class and optimize_memory_usage out of the arguments"
        )
