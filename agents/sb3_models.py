"""SB3's algorithms by name, their arguments as plain data, and the moments of their normalisation as bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

_ACTIVATIONS = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh, "elu": torch.nn.ELU}


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    module = stable_baselines3 if hasattr(stable_baselines3, name) else sb3_contrib
    found: type[BaseAlgorithm] = getattr(module, name)
    return found


def resolve(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments with activations and schedules looked up by name."""
    resolved = dict(arguments)
    for name, value in arguments.items():
        if isinstance(value, str) and value.startswith("linear:"):
            start = float(value.removeprefix("linear:"))
            resolved[name] = lambda remaining, start=start: start * remaining
    policy = dict(resolved.get("policy_kwargs", {}))
    if isinstance(policy.get("activation_fn"), str):
        policy["activation_fn"] = _ACTIVATIONS[policy["activation_fn"]]
    if policy:
        resolved["policy_kwargs"] = policy
    return resolved


def normalizer_moments(normalizer: VecNormalize) -> bytes:
    """The running moments of observations and returns, as an .npz file."""
    moments = io.BytesIO()
    observation, reward = normalizer.obs_rms, normalizer.ret_rms
    assert isinstance(observation, RunningMeanStd)
    np.savez(
        moments,
        observation=np.stack([observation.mean, observation.var]),
        reward=np.stack([reward.mean, reward.var]),
        counts=np.array([observation.count, reward.count]),
    )
    return moments.getvalue()


def set_normalizer_moments(normalizer: VecNormalize, content: bytes) -> None:
    """The reverse of `normalizer_moments`."""
    with np.load(io.BytesIO(content), allow_pickle=False) as moments:
        running: Any = zip(
            (normalizer.obs_rms, normalizer.ret_rms),
            (moments["observation"], moments["reward"]),
            moments["counts"],
            strict=True,
        )
        for rms, (mean, variance), count in running:
            rms.mean, rms.var, rms.count = mean, variance, float(count)
