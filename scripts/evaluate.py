"""`beliefgym evaluate` and `beliefgym record`: returns of an agent, and videos of it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import numpy as np
import tyro

from beliefgym.agents import evaluate
from beliefgym.agents.references import references
from beliefgym.scripts.options import TaskOptions, agent_from


@dataclass(frozen=True)
class Evaluate:
    """Mean return and score of a saved agent, or of the random policy or the expert.

    For example:

        beliefgym evaluate runs/PendulumPosition-v0/sac-stack-seed-0.zip --episodes 300
        beliefgym evaluate expert --env beliefgym/CartPoleSwingUp-v0
    """

    agent: tyro.conf.Positional[str]
    """File of a saved agent, "random" or "expert"."""
    task: Annotated[TaskOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=TaskOptions)
    episodes: int = 100
    """Number of episodes, each on a seed of its own."""
    seed: int = 1_000_000
    """Seed of the first episode."""
    stochastic: bool = False
    """Act with the exploration noise of training."""

    def run(self) -> int:
        """Evaluate and print."""
        agent = agent_from(self.agent, self.task)
        result = evaluate(agent, agent.task, self.episodes, self.seed, deterministic=not self.stochastic)
        print(f"{self.agent} on {agent.task.label}, {self.episodes} episodes from seed {self.seed}")
        print(
            f"return {result.mean:.2f} ± {result.standard_error:.2f} (standard error), sd {result.returns.std():.2f}"
        )
        print(f"length {result.lengths.mean():.1f}")
        try:
            scale = references(agent.task)
        except ValueError as error:
            print(f"no score: {error}")
            return 0
        print(
            f"score  {scale.score(result.mean):.3f}  (0: random, {scale.random:.1f}; 1: expert, {scale.expert:.1f})"
        )
        return 0


@dataclass(frozen=True)
class Record:
    """Record videos of a saved agent, or of the random policy or the expert.

    For example:

        beliefgym record runs/PendulumPosition-v0/sac-stack-seed-0.zip --episodes 2
        beliefgym record expert --env beliefgym/CartPoleSwingUp-v0 --out videos/expert
    """

    agent: tyro.conf.Positional[str]
    """File of a saved agent, "random" or "expert"."""
    task: Annotated[TaskOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=TaskOptions)
    episodes: int = 1
    """One video each."""
    seed: int = 0
    """Seed of the first episode."""
    out: Path = Path("videos")
    """Folder for the videos."""

    def run(self) -> int:
        """Record through Gymnasium's RecordVideo and print the paths."""
        agent = agent_from(self.agent, self.task)
        name = f"{agent.registered_name or 'agent'}-{agent.task.label.replace(' ', '_')}"
        with warnings.catch_warnings():
            warnings.filterwarnings(
                "ignore", message=".*Overwriting existing videos"
            )  # only those of this name
            env = gym.wrappers.RecordVideo(
                agent.task.make(render_mode="rgb_array"),
                str(self.out),
                episode_trigger=lambda episode: True,
                name_prefix=name,
                disable_logger=True,
            )
        agent.set_env(env)
        for episode in range(self.episodes):
            observation, _ = env.reset(seed=self.seed + episode)
            state, start, total, done = None, np.array([True]), 0.0, False
            while not done:
                action, state = agent.predict(
                    observation, state=state, episode_start=start, deterministic=True
                )
                observation, reward, terminated, truncated, _ = env.step(action)
                total, done, start = total + float(reward), terminated or truncated, np.array([False])
            print(f"episode {episode}: return {total:.2f}  {self.out / f'{name}-episode-{episode}.mp4'}")
        env.close()
        return 0
