"""A small network as a controller, in numpy, and its file.

    a = clip(W_L h_{L-1} + b_L, low, high),   h_l = f(W_l h_{l-1} + b_l),
    h_0 = clip((y - mean) / sqrt(variance + epsilon), -c, c)

This is what a Gaussian policy of Stable-Baselines3 behind a VecNormalize does when it is asked for its deterministic
action, with the same single precision from h_0 on. The numbers are in NAME.safetensors, everything else (sizes,
activation, how it was trained, what it returned) in NAME.json beside it; neither holds code.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save

FORMAT = 1
ACTIVATIONS: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
}


@dataclass(frozen=True, eq=False)
class MLPPolicy:
    """A network from observations to actions.

    Args:
        weights: of each layer, (n_out, n_in) float32.
        biases: of each layer, (n_out,) float32.
        activation: of the hidden layers, one of `ACTIVATIONS`.
        low, high: (n_action,) bounds of the action.
        mean, variance: (n_obs,) float64 running moments of the observation in training.
        epsilon, clip: of the normalisation.
        about: how the policy came to be, as plain data.

    Raises:
        ValueError: an unknown activation, or layers that do not fit together.
    """

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    activation: str
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    epsilon: float = 1e-8
    clip: float = 10.0
    about: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS:
            raise ValueError(
                f"expected activation to be one of {', '.join(ACTIVATIONS)}, got {self.activation!r}"
            )
        sizes = [self.mean.shape[0], *(len(bias) for bias in self.biases)]
        expected = list(zip(sizes[1:], sizes[:-1], strict=True))
        found = [weight.shape for weight in self.weights]
        if found != expected or sizes[-1] != len(self.low):
            raise ValueError(
                f"layers do not fit together: weights {found}, expected {expected} with {len(self.low)} actions"
            )

    def __call__(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Deterministic actions.

        Args:
            observation: (n, n_obs).

        Returns:
            (n, n_action) float32, within the bounds.
        """
        scaled = (observation - self.mean) / np.sqrt(self.variance + self.epsilon)
        hidden = np.clip(scaled, -self.clip, self.clip).astype(np.float32)
        apply = ACTIVATIONS[self.activation]
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = hidden @ weight.T + bias
            if i < last:
                hidden = apply(hidden)
        bounded: NDArray[np.float32] = np.clip(hidden, self.low, self.high)
        return bounded

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write PATH.safetensors and PATH.json, each moved into place when whole."""
        base = Path(path)
        base.parent.mkdir(parents=True, exist_ok=True)
        numbers: dict[str, NDArray[Any]] = {
            "observation.mean": self.mean,
            "observation.variance": self.variance,
            "action.low": self.low,
            "action.high": self.high,
        }
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            numbers |= {f"layer.{i}.weight": weight, f"layer.{i}.bias": bias}
        header = {
            "format": FORMAT,
            "activation": self.activation,
            "sizes": [len(self.mean), *(len(bias) for bias in self.biases)],
            "observation": {"epsilon": self.epsilon, "clip": self.clip},
            "about": dict(self.about),
        }
        temporary = base.with_name(base.name + ".tmp")
        temporary.write_bytes(save({name: np.ascontiguousarray(value) for name, value in numbers.items()}))
        os.replace(temporary, base.with_name(base.name + ".safetensors"))
        temporary.write_text(json.dumps(header, indent=1) + "\n")
        os.replace(temporary, base.with_name(base.name + ".json"))


def load_policy(path: str | os.PathLike[str]) -> MLPPolicy:
    """Read what `MLPPolicy.save` wrote.

    Args:
        path: without suffix.

    Raises:
        FileNotFoundError: no such policy.
        ValueError: a file of another format.
    """
    base = Path(path)
    files = [base.with_name(base.name + suffix) for suffix in (".json", ".safetensors")]
    for file in files:
        if not file.exists():
            raise FileNotFoundError(f"there is no policy file {file}")
    header = json.loads(files[0].read_text())
    if header.get("format") != FORMAT:
        raise ValueError(f"{files[0]}: expected format {FORMAT}, got {header.get('format')!r}")
    numbers = load_file(files[1])
    layers = range(len(header["sizes"]) - 1)
    return MLPPolicy(
        weights=tuple(numbers[f"layer.{i}.weight"] for i in layers),
        biases=tuple(numbers[f"layer.{i}.bias"] for i in layers),
        activation=header["activation"],
        low=numbers["action.low"],
        high=numbers["action.high"],
        mean=numbers["observation.mean"],
        variance=numbers["observation.variance"],
        about=header["about"],
        **header["observation"],
    )


def reference_path(name: str) -> Path:
    """Where the package keeps the reference policy of a task, without suffix."""
    return Path(__file__).with_name(name)


@cache
def reference_policy(name: str) -> MLPPolicy:
    """The reference policy of a task ("Hopper").

    Raises:
        FileNotFoundError: none is in the package.
    """
    return load_policy(reference_path(name))
