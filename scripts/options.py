"""Options that several commands share: which task, and how agents' options are written."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from beliefgym.agents import Agent, find_agent, load_agent, make_agent
from beliefgym.wrappers.task import Task

Words = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]


@dataclass(frozen=True)
class TaskOptions:
    """The task: an environment and what is changed about it."""

    env: str = "beliefgym/PendulumPosition-v0"
    """Environment id; `beliefgym envs` lists them. Ids of other packages work too (Hopper-v5)."""
    param: Words = ()
    """A parameter of the environment, NAME=VALUE; may be repeated (--param damping=0.3)."""
    keep: tuple[str, ...] = ()
    """Observation components to keep, by name, glob pattern or index (--keep cos_theta sin_theta)."""
    noise: float = 0.0
    """Standard deviation of Gaussian noise added to each observation component."""
    delay: int = 0
    """Steps by which the observation is delayed."""
    action_history: int = 0
    """Previous actions appended to the observation."""
    bins: int = 0
    """Discrete actions: so many values from lowest to highest."""

    def task(self) -> Task:
        """The task that these options describe.

        Raises:
            ValueError: an unknown environment, component or parameter.
        """
        wrappers: list[tuple[str, dict[str, Any]]] = []
        if self.keep:
            keep = [int(name) if name.lstrip("-").isdigit() else name for name in self.keep]
            wrappers.append(("PartialObservation", {"keep": keep}))
        if self.noise:
            wrappers.append(("ObservationNoise", {"std": self.noise}))
        if self.delay:
            wrappers.append(("ObservationDelay", {"steps": self.delay}))
        if self.action_history:
            wrappers.append(("ActionHistory", {"length": self.action_history}))
        if self.bins:
            wrappers.append(("DiscreteActions", {"bins": self.bins}))
        task = Task(self.env, assignments(self.param), tuple(wrappers))
        task.make().close()  # what is wrong is told now, not in the middle of a training
        return task

    @property
    def changed(self) -> bool:
        """Whether anything was asked for."""
        return self != TaskOptions()


def assignments(words: tuple[str, ...]) -> dict[str, Any]:
    """NAME=VALUE words as a dict; values are JSON where they can be read as such, else text.

    Raises:
        ValueError: a word without "=".
    """
    found = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not name:
            raise ValueError(f"expected NAME=VALUE, got {word!r}")
        try:
            found[name] = json.loads(value)
        except json.JSONDecodeError:
            found[name] = value
    return found


def agent_from(name_or_path: str, options: TaskOptions) -> Agent:
    """A saved agent from its file, or a registered agent that needs no training.

    Raises:
        ValueError: an agent that must be trained first, an unknown name, or a file that does not fit.
    """
    if name_or_path.endswith(".zip") or "/" in name_or_path:
        return load_agent(name_or_path, options.task() if options.changed else None)
    spec = find_agent(name_or_path)
    if spec.learns and ":" not in name_or_path:
        raise ValueError(
            f"agent {name_or_path!r} must be trained first: `beliefgym train --agent {name_or_path}`, "
            "then give the file that it writes"
        )
    return make_agent(name_or_path, options.task())
