"""`beliefgym train`: train an agent on a task and save it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from beliefgym.agents import evaluate, find_agent, make_agent
from beliefgym.scripts.options import TaskOptions, Words, assignments
from beliefgym.scripts.training import LearningCurve, git_commit, machine, versions


@dataclass(frozen=True)
class Train:
    """Train an agent on a task, show its learning curve, save it.

    For example:

        beliefgym train --agent sac-stack --env beliefgym/PendulumPosition-v0 --steps 20000
        beliefgym train --agent ppo --noise 0.1 --option n_stack=8 --tensorboard runs/tensorboard
        beliefgym train --agent my_package.agents:MyAgent --env beliefgym/CartPoleSwingUpPosition-v0

    Ctrl-C ends the training and saves what has been learned so far.
    """

    agent: str = "sac-stack"
    """A registered agent (`beliefgym agents` lists them) or "module:attribute" of your own."""
    task: Annotated[TaskOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=TaskOptions)
    steps: int = 20_000
    """Environment steps."""
    seed: int = 0
    """Seed of the agent and its training environments."""
    option: Words = ()
    """An option of the agent, NAME=VALUE; may be repeated (--option n_envs=8)."""
    out: Path | None = None
    """Where to save the agent; runs/TASK/AGENT-seed-SEED.zip by default."""
    points: int = 10
    """Points of the learning curve."""
    episodes: int = 20
    """Evaluation episodes for each point."""
    tensorboard: str | None = None
    """Folder for TensorBoard, in SB3's layout (agents of Stable-Baselines3)."""
    progress: bool = True
    """Show SB3's progress bar."""

    def run(self) -> int:
        """Train, save, print; 0, or 130 after Ctrl-C."""
        if self.steps < 1:
            raise ValueError(f"expected --steps of at least 1, got {self.steps}")
        task = self.task.task()
        options = assignments(self.option)
        if self.tensorboard is not None:
            if not find_agent(self.agent).entry_point.endswith(":SB3Agent"):
                raise ValueError(f"--tensorboard is for agents of Stable-Baselines3, not {self.agent!r}")
            options["tensorboard_log"] = self.tensorboard
        agent = make_agent(self.agent, task, seed=self.seed, **options)
        slug = self.agent.replace(":", ".").replace("/", "-")
        path = self.out or Path("runs") / task.label.replace(" ", "_") / f"{slug}-seed-{self.seed}.zip"
        path = path if path.suffix == ".zip" else path.with_name(path.name + ".zip")

        learning = LearningCurve(agent, task, self.steps, self.points, self.episodes)
        print(f"training {self.agent} on {task.label} for {self.steps} steps")
        interrupted = False
        try:
            learning.train(progress_bar=self.progress)
        except KeyboardInterrupt:
            interrupted = True
            print("\ninterrupted: keeping what has been learned so far")
        agent.save(path)
        configuration = {
            "agent": self.agent,
            "options": agent.options(),
            "task": task.to_dict(),
            "seed": self.seed,
            "steps": self.steps,
            "interrupted": interrupted,
            "learning_curve": learning.curve,
            "versions": versions(),
            "git_commit": git_commit(),
            "machine": machine(),
        }
        record = path.with_suffix(".json")
        record.write_text(json.dumps(configuration, indent=1) + "\n")
        for point in learning.curve:
            print(f"{point['step']:>9} steps  return {point['mean_return']:10.2f}")
        if not interrupted:
            result = evaluate(agent, task, 100, seed=1_000_000)
            print(
                f"100 test episodes: return {result.mean:.2f} ± {result.standard_error:.2f} (standard error)"
            )
        print(
            f"agent:  {path}\nrecord: {record}\nnext:   beliefgym evaluate {path}   or   beliefgym record {path}"
        )
        return 130 if interrupted else 0
