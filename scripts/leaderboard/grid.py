"""The grid of a leaderboard as data: which task, which agent, which seed, trained and evaluated for how long.

A `Cell` is one agent trained on one task with one seed. It is plain JSON: its `config()` is everything that
decides its result and `config_hash` is the SHA-256 of that, so a record on disk can be matched with the
cell it belongs to. Labels, time limits and the number of processes decide no result and are not in the
hash.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

from beliefgym.scripts.leaderboard.errors import NotPlainJSONError

HASH_LENGTH = 16  # hex digits: 64 bits, far beyond the number of cells anyone runs


class TaskLike(Protocol):
    """What the grid needs of a task: a readable label and itself as plain JSON."""

    @property
    def label(self) -> str: ...

    def to_dict(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class Cell:
    """One agent, trained on one task with one seed.

    Args:
        task: the task as plain JSON (`Task.to_dict()`).
        task_label: its name in tables and file names.
        agent: the agent's name in the registry, or `module:attribute`.
        seed: seed of the training; environment, network and noise derive from it.
        total_timesteps: environment steps of training, at least 0 (0: an agent that does not learn).
        eval_episodes: episodes of the final evaluation.
        agent_options: options of the agent, plain JSON.
        agent_label: its name in tables and file names; `agent` where not given.
        eval_seed: first seed of the evaluation's episodes, the same for all agents, so that they meet the
            same start states.
        curve_points: points of the learning curve, equally spaced over the training.
        curve_episodes: evaluation episodes for one point of the learning curve.

    Raises:
        ValueError: where a number is out of range, a label is empty or a mapping is not plain JSON.
    """

    task: Mapping[str, Any]
    task_label: str
    agent: str
    seed: int
    total_timesteps: int
    eval_episodes: int
    agent_options: Mapping[str, Any] = field(default_factory=dict)
    agent_label: str = ""
    eval_seed: int = 1_000_000
    curve_points: int = 10
    curve_episodes: int = 10

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", plain_json(self.task, "task"))
        object.__setattr__(self, "agent_options", plain_json(self.agent_options, "agent_options"))
        object.__setattr__(self, "agent_label", self.agent_label or self.agent)
        for name, least in LEAST.items():
            value = getattr(self, name)
            if type(value) is not int or value < least:
                raise ValueError(f"{name} of a cell is a whole number of at least {least}, not {value!r}")
        slug(self.task_label), slug(self.agent_label)

    @property
    def key(self) -> str:
        """Readable name of the cell and of its file: `PendulumPosition-v0/sac-stack/seed-0`."""
        return f"{slug(self.task_label)}/{slug(self.agent_label)}/seed-{self.seed}"

    def config(self) -> dict[str, Any]:
        """Everything that decides the cell's result, as plain JSON."""
        return {name: value for name, value in self.to_dict().items() if not name.endswith("_label")}

    @property
    def config_hash(self) -> str:
        """The first 16 hex digits of the SHA-256 of `config()` in canonical JSON."""
        text = json.dumps(self.config(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:HASH_LENGTH]

    def to_dict(self) -> dict[str, Any]:
        """The cell as plain JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Cell":
        """The cell that `to_dict` described.

        Raises:
            ValueError: where a field is unknown or missing, by its name.
        """
        known = {f.name for f in fields(cls)}
        if unknown := sorted(set(data) - known):
            raise ValueError(
                f"a cell has no field {', '.join(unknown)}; its fields are {', '.join(sorted(known))}"
            )
        try:
            return cls(**data)
        except TypeError as error:  # "missing 1 required positional argument: 'seed'"
            raise ValueError(f"a cell lacks a field: {error}") from error


LEAST = {
    "seed": 0,
    "total_timesteps": 0,
    "eval_episodes": 1,
    "eval_seed": 0,
    "curve_points": 0,
    "curve_episodes": 1,
}


@dataclass(frozen=True)
class Grid:
    """The cells of one tier of the leaderboard.

    Args:
        name: the tier's name, as in file names (`standard`, `full`).
        cells: the cells, in the order in which they are run and shown.
        time_limit_s: wall time after which one cell is stopped and becomes a failed row, in seconds.
        description: a sentence for the head of the table.

    Raises:
        ValueError: where the grid is empty, or two cells would share one record.
    """

    name: str
    cells: tuple[Cell, ...]
    time_limit_s: float
    description: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cells", tuple(self.cells))
        if slug(self.name) != self.name:
            raise ValueError(
                f"a grid's name is part of file names: {slug(self.name)!r} would do, not {self.name!r}"
            )
        if not self.cells:
            raise ValueError(f"grid {self.name!r} has no cells: give it at least one task, agent and seed")
        if not self.time_limit_s > 0:
            raise ValueError(f"time_limit_s is a number of seconds above 0, not {self.time_limit_s!r}")
        seen: dict[str, Cell] = {}
        for cell in self.cells:
            other = seen.setdefault(cell.key.casefold(), cell)
            if other is not cell:
                raise ValueError(
                    f"two cells of grid {self.name!r} would share the record {cell.key}: "
                    "give their tasks, agents (agent_label) or seeds different names"
                )

    @property
    def tasks(self) -> tuple[str, ...]:
        """Labels of the tasks, in order of appearance."""
        return tuple(dict.fromkeys(cell.task_label for cell in self.cells))

    @property
    def agents(self) -> tuple[str, ...]:
        """Labels of the agents, in order of appearance."""
        return tuple(dict.fromkeys(cell.agent_label for cell in self.cells))


@dataclass(frozen=True)
class AgentVariant:
    """An agent of the grid with options, a label or a training length of its own.

    Args:
        agent: the agent's name in the registry, or `module:attribute`.
        options: options of the agent, plain JSON.
        label: its name in tables; `agent` where not given.
        total_timesteps: its training steps, where they differ from the grid's (0: it does not learn).
    """

    agent: str
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""
    total_timesteps: int | None = None


def product(
    tasks: Iterable[TaskLike],
    agents: Iterable[str | AgentVariant],
    seeds: Iterable[int],
    *,
    total_timesteps: int,
    eval_episodes: int,
    eval_seed: int = 1_000_000,
    curve_points: int = 10,
    curve_episodes: int = 10,
) -> tuple[Cell, ...]:
    """All combinations of tasks, agents and seeds.

    The first seed of everything comes first, so that a run stopped early has each agent on each task at
    least once.

    Args:
        tasks, agents, seeds: what to combine; an agent is a name or an `AgentVariant`.
        total_timesteps, eval_episodes, eval_seed, curve_points, curve_episodes: as in `Cell`.

    Returns:
        The cells, seeds outermost, then tasks, then agents.
    """
    tasks = list(tasks)
    variants = [AgentVariant(agent) if isinstance(agent, str) else agent for agent in agents]
    return tuple(
        Cell(
            task=task.to_dict(),
            task_label=task.label,
            agent=variant.agent,
            agent_options=variant.options,
            agent_label=variant.label,
            seed=seed,
            total_timesteps=total_timesteps if variant.total_timesteps is None else variant.total_timesteps,
            eval_episodes=eval_episodes,
            eval_seed=eval_seed,
            curve_points=curve_points,
            curve_episodes=curve_episodes,
        )
        for seed in seeds
        for task in tasks
        for variant in variants
    )


def slug(text: str) -> str:
    """The text as a file name: letters, digits, `.`, `_` and `-`; everything else becomes `-`."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.")
    if not name:
        raise ValueError(f"a label needs at least one letter or digit for its file name, not {text!r}")
    return name


def plain_json(value: Any, name: str) -> Any:
    """The value as JSON gives it back: dicts with text keys, lists, text, numbers, true, false, null.

    Args:
        value: any nesting of mappings, lists, tuples and plain values.
        name: what to call the value in an error.

    Returns:
        A copy with tuples as lists.

    Raises:
        NotPlainJSONError: naming the first part that is not JSON, or is NaN or infinite.
    """
    if isinstance(value, Mapping):
        if wrong := [key for key in value if not isinstance(key, str)]:
            raise NotPlainJSONError(f"{name} has the key {wrong[0]!r}; keys are text")
        return {key: plain_json(part, f"{name}.{key}") for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(part, f"{name}[{index}]") for index, part in enumerate(value)]
    if isinstance(value, float):
        if not math.isfinite(value):
            raise NotPlainJSONError(f"{name} is {float(value)}, not a finite number")
        return float(value)
    if value is None or type(value) in (str, int, bool):
        return value
    raise NotPlainJSONError(
        f"{name} is a {type(value).__module__}.{type(value).__qualname__}, which is not plain JSON: "
        "use numbers, text, lists and dicts"
    )
