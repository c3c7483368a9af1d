"""The face that every agent shows: Stable-Baselines3's, over a `Task`.

An agent learns on a task (`learn`), acts on raw observations of it (`predict`, with whatever memory it needs in
`state`), and is saved to and loaded from one file. SB3's `evaluate_policy`, and `evaluate` here, take any agent.
"""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

from beliefgym.wrappers.task import Task

HEADER = "agent.json"
FORMAT = 1


class Agent(ABC):
    """Base class of agents.

    Args:
        task: the task, or the id of its environment.
        seed: seed of everything random in the agent and its training.
    """

    registered_name: str = ""

    def __init__(self, task: Task | str, seed: int = 0) -> None:
        self.task = task if isinstance(task, Task) else Task(task)
        self.seed = seed
        env = self.task.make_vec(1)
        self.observation_space: Space[Any] = env.single_observation_space
        self.action_space: Space[Any] = env.single_action_space
        env.close()

    @abstractmethod
    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Train for this many environment steps; `callback` is SB3's."""

    @abstractmethod
    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Act.

        Args:
            observation: of one copy, or (n, ...) of n.
            state: what the last call returned; None at first.
            episode_start: (n,) bool: where a new episode has begun.
            deterministic: no exploration noise.

        Returns:
            action of one copy or (n, ...), and the state for the next call.
        """

    def set_env(self, env: Any) -> None:
        """Told which environment is about to be acted in; only agents that read the true state care."""
        del env

    @abstractmethod
    def parts(self) -> dict[str, bytes]:
        """What to save: file name in the archive -> content."""

    @abstractmethod
    def restore(self, parts: Mapping[str, bytes]) -> None:
        """The reverse of `parts`."""

    def options(self) -> dict[str, Any]:
        """Constructor arguments beyond task and seed, as plain data."""
        return {}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the agent to one zip file, atomically; ".zip" is added where it is missing."""
        header = {
            "format": FORMAT,
            "agent": self.registered_name,
            "class": f"{type(self).__module__}:{type(self).__qualname__}",
            "task": self.task.to_dict(),
            "seed": self.seed,
            "options": self.options(),
            "observation_space": str(self.observation_space),
            "action_space": str(self.action_space),
        }
        write_archive(Path(path), header, self.parts())

    @classmethod
    def load(cls, path: str | os.PathLike[str], task: Task | str | None = None) -> Self:
        """Read an agent from `save`'s file.

        Args:
            path: the file.
            task: the task to act on; the one it was trained on by default.

        Raises:
            ValueError: not such a file, or the task's spaces differ from those it was trained on.
        """
        header, parts = read_archive(Path(path))
        trained = Task.from_dict(header["task"])
        agent = cls(trained, seed=header["seed"], **header["options"])
        agent.registered_name = header["agent"]
        agent.restore(parts)
        if task is not None:
            agent.move_to(task if isinstance(task, Task) else Task(task), str(path))
        return agent

    def move_to(self, task: Task, origin: str = "this agent") -> None:
        """Act on another task with the same spaces.

        Raises:
            ValueError: the spaces differ.
        """
        env = task.make_vec(1)
        env.close()
        for what, own, other in (
            ("observation", self.observation_space, env.single_observation_space),
            ("action", self.action_space, env.single_action_space),
        ):
            if own != other:
                raise ValueError(
                    f"{origin} was trained on {self.task.label} with {what} space {own}, but {task.label} has {other}; "
                    "choose a task with the same space, or train an agent on this one"
                )
        self.task = task

    def batched(self, observation: NDArray[Any]) -> tuple[NDArray[Any], bool]:
        """The observation with a batch axis, and whether it came without.

        Raises:
            ValueError: a shape that does not belong to the observation space.
        """
        observation = np.asarray(observation)
        shape = self.observation_space.shape or ()
        if observation.shape == shape:
            return observation[None], True
        if observation.shape[1:] == shape:
            return observation, False
        raise ValueError(
            f"expected an observation of shape {shape}, or a batch (n, *{shape}), got {observation.shape}"
        )


def episode_starts(state: Any, episode_start: NDArray[np.bool_] | None, n: int) -> NDArray[np.bool_]:
    """Where episodes begin: everywhere without a state, else as told, else nowhere."""
    if state is None:
        return np.ones(n, dtype=np.bool_)
    if episode_start is None:
        return np.zeros(n, dtype=np.bool_)
    return np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), (n,))


def require_box(space: Space[Any], who: str) -> Box:
    """The space, if it is a flat Box.

    Raises:
        ValueError: otherwise.
    """
    if not isinstance(space, Box) or len(space.shape) != 1:
        raise ValueError(
            f"{who} needs a flat Box space, got {space}; flatten it with a Gymnasium wrapper first"
        )
    return space


def write_archive(path: Path, header: Mapping[str, Any], parts: Mapping[str, bytes]) -> None:
    """Write a zip of a JSON header and parts to a temporary file, then move it into place."""
    path = path if path.suffix == ".zip" else path.with_name(path.name + ".zip")
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(HEADER, json.dumps(header, indent=1))
        for name, content in parts.items():
            archive.writestr(name, content)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    with os.fdopen(handle, "wb") as file:
        file.write(buffer.getvalue())
    os.replace(temporary, path)


def read_archive(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The header and parts of `write_archive`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a saved agent.
    """
    if not path.exists() and path.suffix != ".zip":
        path = path.with_name(path.name + ".zip")
    if not path.exists():
        raise FileNotFoundError(f"there is no saved agent at {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            header = json.loads(archive.read(HEADER))
            parts = {name: archive.read(name) for name in archive.namelist() if name != HEADER}
    except (zipfile.BadZipFile, KeyError, json.JSONDecodeError) as error:
        raise ValueError(
            f"{path} is not a saved beliefgym agent ({error}); an SB3 model of your own is loaded with SB3's load"
        ) from error
    if header.get("format") != FORMAT:
        raise ValueError(
            f"{path}: expected format {FORMAT}, got {header.get('format')!r}; save it with this version"
        )
    return header, parts
