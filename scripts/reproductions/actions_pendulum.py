"""The position-only pendulum of `beliefgym reproduce actions-interventions`, and the policies that act on it.

Nothing is exactly known of what its filters should believe, but it is free of noise: what comes is the expectation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import beliefgym.envs  # noqa: F401  registers the environments
from beliefgym.envs import GaussianPolicy, collect
from beliefgym.learning import Sequences
from beliefgym.scripts.reproductions.actions_data import kl_of_stds

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Swing:
    """A torque with or against the motion of a position-only pendulum, with exploration; gain 0 is blind.

    a_t ~ N(gain times the angular velocity, std^2), the velocity from the last two positions and held to +-LIMIT. A
    negative gain brakes, a positive one drives.
    """

    gain: float
    std: float = 1.0
    LIMIT: ClassVar = 4.0  # rad/s
    DT: ClassVar = 0.05  # s

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Floats, Floats]:
        """The mean action, and the angle for its memory; the face of `Predictor`."""
        angle = np.arctan2(observation[:, 1], observation[:, 0])
        before = angle if state is None else np.where(episode_start, angle, state)
        return self._mean(angle - before)[:, None], angle

    def mean_actions(self, sequences: Sequences) -> Floats:
        """(n, n_steps) of recorded positions."""
        x = sequences.observations[:, :-1]
        angle = np.arctan2(x[:, :, 1], x[:, :, 0])
        return self._mean(np.diff(angle, axis=1, prepend=angle[:, :1]))

    def _mean(self, turned: Floats) -> Floats:
        turned = (turned + np.pi) % (2.0 * np.pi) - np.pi
        mean: Floats = self.gain * np.clip(turned / self.DT, -self.LIMIT, self.LIMIT)
        return mean

    def sample(self, n: int, n_steps: int, seed: int) -> Sequences:
        """Episodes of beliefgym/PendulumPosition-v0."""
        envs = gym.make_vec(
            "beliefgym/PendulumPosition-v0", num_envs=n, vectorization_mode="vector_entry_point"
        )
        policy = GaussianPolicy(self, self.std, seed=seed, action_space=envs.single_action_space)
        return collect(envs, policy, n, seed=seed, max_steps_per_episode=n_steps)

    def divergence(self, theirs: Swing, sequences: Sequences) -> float:
        """Mean of KL(self | theirs) of the next action, nats, over the histories of self."""
        gap = self.mean_actions(sequences) - theirs.mean_actions(sequences)
        return float(np.square(gap).mean() / (2.0 * theirs.std**2)) + kl_of_stds(self.std, theirs.std)
