"""Training of the reference policies: agents that see the full state of Gymnasium's MuJoCo tasks.

Each is Stable-Baselines3's PPO on the plain task, with observations and rewards normalised. HalfCheetah, Swimmer and
InvertedPendulum have the hyperparameters that rl-baselines3-zoo publishes for them, except that where the zoo collects
512 (for InvertedPendulum 32) steps from one copy, 8 (4) copies collect 512 (128) together. Hopper and Walker2d have
SB3's own defaults, 2048 steps from 4 copies: with the zoo's settings the hopper had learned to stand still (a return
of 1020 after 460,800 steps of seed 0).

Of all policies met in training the one with the best mean return over `VALIDATION_EPISODES` deterministic episodes is
kept. The seeds of those episodes belong to no other part of the package.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd

from beliefgym.agents.agent import require_box
from beliefgym.agents.evaluation import evaluate
from beliefgym.agents.sb3_agent import SB3Agent
from beliefgym.envs.reference_policies import MLPPolicy, load_policy, reference_path

VALIDATION_EPISODES = 20
VALIDATION_SEED = 3_000_000  # apart from those of training, of the leaderboard and of the reference scores
EVERY = 51_200  # steps between two evaluations


@dataclass(frozen=True)
class Recipe:
    """How a reference policy is trained.

    Args:
        env_id: the fully observed task.
        steps: environment steps.
        n_envs: copies that experience is collected from.
        arguments: of SB3's PPO.
        seed: of training.
    """

    env_id: str
    steps: int
    n_envs: int
    arguments: Mapping[str, Any]
    seed: int = 0


_WIDE = {
    "log_std_init": -2,
    "ortho_init": False,
    "activation_fn": "relu",
    "net_arch": {"pi": [256, 256], "vf": [256, 256]},
    "optimizer_kwargs": {"fused": True},  # the same Adam, faster; so below
}

_PLAIN = {
    "policy": "MlpPolicy",
    "n_steps": 512,
    "batch_size": 64,
    "policy_kwargs": {"optimizer_kwargs": {"fused": True}},
}

# hardest first
RECIPES: dict[str, Recipe] = {
    "HalfCheetah": Recipe(
        "HalfCheetah-v5",
        1_024_000,
        8,
        {
            "policy": "MlpPolicy",
            "n_steps": 64,
            "batch_size": 64,
            "gamma": 0.98,
            "learning_rate": 2.0633e-05,
            "ent_coef": 0.000401762,
            "clip_range": 0.1,
            "n_epochs": 20,
            "gae_lambda": 0.92,
            "max_grad_norm": 0.8,
            "vf_coef": 0.58096,
            "policy_kwargs": _WIDE,
        },
    ),
    "Walker2d": Recipe("Walker2d-v5", 870_400, 4, _PLAIN),
    "Hopper": Recipe("Hopper-v5", 409_600, 4, _PLAIN),
    "Swimmer": Recipe(
        "Swimmer-v5",
        1_024_000,
        4,
        {
            "policy": "MlpPolicy",
            "n_steps": 1024,
            "batch_size": 256,
            "gamma": 0.9999,
            "gae_lambda": 0.98,
            "learning_rate": 6e-4,
        },
    ),
    "InvertedPendulum": Recipe(
        "InvertedPendulum-v5",
        102_400,
        4,
        {
            "policy": "MlpPolicy",
            "n_steps": 32,
            "batch_size": 64,
            "gamma": 0.999,
            "learning_rate": 0.000222425,
            "ent_coef": 1.37976e-07,
            "clip_range": 0.4,
            "n_epochs": 5,
            "gae_lambda": 0.9,
            "max_grad_norm": 0.3,
            "vf_coef": 0.19816,
        },
    ),
}


def policy_of(agent: SB3Agent, about: Mapping[str, Any] | None = None) -> MLPPolicy:
    """The deterministic policy of a trained PPO or A2C agent, without SB3.

    Raises:
        ValueError: an agent with a memory or of another algorithm, whose policy is no plain network.
    """
    policy = agent.model.policy
    if not isinstance(policy, ActorCriticPolicy) or agent.n_stack > 1 or agent.rescale_actions:
        raise ValueError(
            f"expected a PPO or A2C agent without stacked frames and rescaled actions, got {agent.algorithm} "
            f"(n_stack={agent.n_stack}, rescale_actions={agent.rescale_actions})"
        )
    modules = [*policy.mlp_extractor.policy_net, policy.action_net]
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    activations = {type(module).__name__.lower() for module in modules} - {"linear"}
    if len(activations) != 1 or policy.squash_output:
        raise ValueError(f"expected one activation and no squashing, got {sorted(activations)}")
    normalizer = agent._normalizer
    size = linear[0].in_features
    mean, variance, epsilon, clip = np.zeros(size), np.ones(size), 0.0, np.inf
    if normalizer is not None:
        assert isinstance(normalizer.obs_rms, RunningMeanStd)
        mean, variance = normalizer.obs_rms.mean.copy(), normalizer.obs_rms.var.copy()
        epsilon, clip = normalizer.epsilon, normalizer.clip_obs
    bounds = require_box(agent.action_space, "a policy")
    return MLPPolicy(
        weights=tuple(layer.weight.detach().numpy().copy() for layer in linear),
        biases=tuple(layer.bias.detach().numpy().copy() for layer in linear),
        activation=activations.pop(),
        low=bounds.low.astype(np.float32),
        high=bounds.high.astype(np.float32),
        mean=mean,
        variance=variance,
        epsilon=epsilon,
        clip=clip,
        about=about or {},
    )


def train_reference(
    name: str,
    folder: Path,
    steps: int | None = None,
    every: int = EVERY,
    told: Callable[[str], None] = print,
) -> MLPPolicy:
    """Train the reference policy of a task, and keep the best one met.

    Every `every` steps the agent, the best policy so far and the curve are written to `folder`; a second call goes
    on from there.

    Args:
        name: one of `RECIPES`.
        folder: for NAME.zip (the agent), NAME.safetensors and NAME.json (the best policy), NAME.curve.json.
        steps: environment steps in place of the recipe's.
        every: steps between two evaluations.
        told: where progress goes.

    Returns:
        the best policy.

    Raises:
        ValueError: an unknown name.
    """
    if name not in RECIPES:
        raise ValueError(f"there is no recipe {name!r}; known: {', '.join(RECIPES)}")
    recipe = RECIPES[name]
    steps = recipe.steps if steps is None else steps
    saved, written = folder / f"{name}.zip", folder / f"{name}.curve.json"
    curve: list[dict[str, float]] = []
    if saved.exists() and written.exists():
        agent, curve = SB3Agent.load(saved), json.loads(written.read_text())
        told(f"{name}: going on from step {agent.model.num_timesteps}")
    else:
        agent = SB3Agent(
            recipe.env_id,
            seed=recipe.seed,
            algorithm="PPO",
            n_envs=recipe.n_envs,
            normalize=True,
            arguments=recipe.arguments,
        )
    while agent.model.num_timesteps < steps:
        begun = time.perf_counter()
        agent.learn(min(every, steps - agent.model.num_timesteps))
        took = time.perf_counter() - begun
        found = evaluate(agent, agent.task, VALIDATION_EPISODES, VALIDATION_SEED)
        best = max((point["mean_return"] for point in curve), default=-np.inf)
        curve.append({"steps": agent.model.num_timesteps, "mean_return": round(found.mean, 2)})
        told(
            f"{name}: step {agent.model.num_timesteps}, {every / took:.0f} steps/s, return {found.mean:.1f}, "
            f"length {found.lengths.mean():.0f}"
        )
        if found.mean > best:
            about = {
                "name": name,
                "kind": "trained full-state PPO",
                "env_id": recipe.env_id,
                "algorithm": "stable_baselines3.PPO",
                "n_envs": recipe.n_envs,
                "normalize": True,
                "arguments": dict(recipe.arguments),
                "seed": recipe.seed,
                "steps": agent.model.num_timesteps,
                "validation": {
                    "mean_return": round(found.mean, 2),
                    "standard_error": round(found.standard_error, 2),
                    "n_episodes": VALIDATION_EPISODES,
                    "seed": VALIDATION_SEED,
                },
                "versions": {
                    package: version(package)
                    for package in ("stable-baselines3", "torch", "gymnasium", "mujoco", "numpy")
                },
            }
            policy_of(agent, about).save(folder / name)
        agent.save(saved)
        written.write_text(json.dumps(curve) + "\n")
    return load_policy(folder / name)


def train_references(
    names: list[str] | None = None,
    folder: Path = Path("runs/reference_policies"),
    told: Callable[[str], None] = print,
) -> None:
    """Train the named reference policies (all by default) and put the best of each into the package."""
    for name in names or list(RECIPES):
        train_reference(name, folder, told=told)
        target = reference_path(name)
        for suffix in (".safetensors", ".json"):
            shutil.copyfile(folder / f"{name}{suffix}", target.with_name(name + suffix))
        told(f"written: {target}.safetensors, {target}.json")
