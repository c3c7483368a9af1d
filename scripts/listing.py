"""`beliefgym envs` and `beliefgym agents`: what there is."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import tyro
from rich.console import Console
from rich.table import Table

from beliefgym.agents import agent_specs
from beliefgym.agents.reference_policies import train_references
from beliefgym.agents.references import PATH, measure_all, references
from beliefgym.envs import registered_ids
from beliefgym.scripts.pages import write_pages
from beliefgym.wrappers.components import component_names
from beliefgym.wrappers.task import Task, full_id


@dataclass(frozen=True)
class Envs:
    """List the environments, or show one's data sheet.

    For example:

        beliefgym envs
        beliefgym envs beliefgym/CartPoleSwingUpPosition-v0
    """

    env: Annotated[str | None, tyro.conf.Positional] = None
    """Environment whose data sheet to show."""
    measure: bool = False
    """Measure the reference scores of every environment anew and write them to the package's table."""
    train_references: bool = False
    """Train anew the full-state policies that are the experts of the locomotion tasks (hours), and put them into the
    package. What was reached is kept in runs/reference_policies; a second call goes on from there."""
    only: tuple[str, ...] = ()
    """With --train-references: the names of the tasks, such as Hopper. With --measure: the ids to measure."""
    pages: bool = False
    """In a checkout: write docs/environments/ and its pictures anew from data sheets, references and results."""

    def run(self) -> int:
        """Print."""
        if self.pages:
            write_pages(Path("docs"), Path("results"))
            return 0
        if self.train_references:
            train_references(list(self.only) or None)
            return 0
        if self.measure:
            measure_all([full_id(env_id) for env_id in self.only] or registered_ids())
            print(f"written: {PATH}")
            return 0
        if self.env is not None:
            self._sheet(Task(self.env))
            return 0
        table = Table(title="beliefgym environments", title_justify="left")
        for column in ("id", "the agent sees", "actions", "steps"):
            table.add_column(column, overflow="fold")
        table.add_column("random", justify="right")
        table.add_column("expert", justify="right")
        table.add_column("the expert is", overflow="fold")
        for env_id in registered_ids():
            env = gym.make(env_id)
            scale = references(env_id)
            table.add_row(
                env_id,
                ", ".join(component_names(env)),
                ", ".join(env.get_wrapper_attr("action_names")),
                str(gym.spec(env_id).max_episode_steps),
                f"{scale.random:.1f}",
                f"{scale.expert:.1f}",
                getattr(env.unwrapped, "expert_kind", "a planner on the true model"),
            )
        Console().print(table)
        return 0

    def _sheet(self, task: Task) -> None:
        env = task.make()
        system = getattr(env.unwrapped, "system", None)
        print(f"{task.env_id}\n")
        print(inspect.getdoc(type(system if system is not None else env.unwrapped)))
        print(f"\nobservation space: {env.observation_space}\naction space: {env.action_space}")
        print(f"time limit: {gym.spec(task.env_id).max_episode_steps} steps")


@dataclass(frozen=True)
class Agents:
    """List the agents."""

    def run(self) -> int:
        """Print."""
        table = Table(title="beliefgym agents", title_justify="left")
        for column in ("name", "what it is"):
            table.add_column(column, overflow="fold")
        for spec in agent_specs().values():
            table.add_row(spec.name, spec.description)
        Console().print(table)
        print(
            'your own: "module:attribute" of a subclass of beliefgym.agents.Agent, or an entry point of the group'
        )
        print('"beliefgym.agents" in your package')
        return 0
