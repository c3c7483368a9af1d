"""`beliefgym envs --pages`: one page for each family of environments in docs/environments/, and their pictures.

A family is a system with its fully and partially observed forms. Its page holds a strip of three moments of an
expert's episode, the table of its ids with their reference scores, what an agent without memory reached
(results/leaderboard_difficulty.csv, written by `beliefgym leaderboard --tier difficulty`), and the data sheet, which is
the system's own docstring: so the page cannot say something else than the code.
"""

from __future__ import annotations

import csv
import inspect
import re
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from beliefgym.agents import make_agent
from beliefgym.agents.references import references
from beliefgym.envs import registered_ids
from beliefgym.scripts.leaderboard.tiers import TIERS
from beliefgym.scripts.named_record import markdown_table
from beliefgym.wrappers.components import component_names
from beliefgym.wrappers.task import Task

HEADER = ("id", "the agent sees", "actions", "steps", "random", "expert", "PPO without memory")
NUMBERS = ("steps", "random", "expert", "PPO without memory")
WIDTH = 1200  # pixels of a strip
Scores = dict[str, list[float]]  # id -> one score a seed


def write_pages(docs: Path, results: Path, told: Callable[[str], None] = print) -> None:
    """Write every page, its picture, and the index.

    Args:
        docs: folder of the documentation; environments/ and images/environments/ are made in it.
        results: folder of the results.
        told: hears of each page.
    """
    pages, pictures = docs / "environments", docs / "images" / "environments"
    pages.mkdir(parents=True, exist_ok=True)
    pictures.mkdir(parents=True, exist_ok=True)
    without_memory = scores_without_memory(results)
    index: list[list[str]] = []
    for name, ids in families().items():
        told(name)
        save_picture(strip(shown_id(ids)), pictures / f"{name}.png")
        (pages / f"{name}.md").write_text(page(name, ids, without_memory))
        index.append([f"[{name}]({name}.md)", headline(ids[0]), ", ".join(f"`{_short(i)}`" for i in ids)])
    save_picture(mosaic([shown_id(ids) for ids in families().values()]), docs / "images" / "environments.png")
    table = markdown_table(("family", "what it is", "ids"), index, ())
    intro = "Written by `beliefgym envs --pages`; every number on these pages is measured by a command named there."
    (pages / "README.md").write_text("\n".join(["# Environments", "", intro, "", *table]) + "\n")


def families() -> dict[str, list[str]]:
    """Name of the system (or of the wrapped task) -> its ids, the fully observed one first."""
    found: dict[str, list[str]] = defaultdict(list)
    for env_id in registered_ids():
        env = gym.make(env_id).unwrapped
        found[type(getattr(env, "system", env)).__name__.removesuffix("Env")].append(env_id)
    return {name: _ordered(ids) for name, ids in sorted(found.items())}


def _ordered(ids: list[str]) -> list[str]:
    """The id without a suffix in front, then those that show more, the undisturbed before the noisy."""
    full = min(ids, key=len)

    def place(env_id: str) -> tuple[bool, int, int, str]:
        layers = len(gym.spec(env_id).kwargs.get("layers", ()))
        return env_id != full, -len(component_names(gym.make(env_id))), layers, env_id

    return sorted(ids, key=place)


def shown_id(ids: list[str]) -> str:
    """The id whose picture stands for a family: of those without noise the one that shows least."""

    def place(env_id: str) -> tuple[bool, int]:
        layers = [name for name, _ in gym.spec(env_id).kwargs.get("layers", ())]
        return "ObservationNoise" in layers, len(component_names(gym.make(env_id)))

    return min(ids, key=place)


def strip(env_id: str, moments: tuple[float, ...] = (0.0, 0.25, 1.0)) -> NDArray[np.uint8]:
    """Three pictures of one episode of the expert, side by side: (height, width, 3).

    Args:
        env_id: of the environment.
        moments: as shares of the time limit, or of the episode where it ends before the last of them.
    """
    steps = gym.spec(env_id).max_episode_steps or 200
    frames, length = _episode(env_id, [round(moment * (steps - 1)) for moment in moments])
    if len(frames) < len(moments):
        frames, _ = _episode(env_id, [round(moment * length) for moment in moments])
    joined: NDArray[np.uint8] = np.concatenate(frames, axis=1)
    return joined


def _episode(env_id: str, wanted: list[int]) -> tuple[list[Any], int]:
    """Pictures after these numbers of steps of an expert's episode, as far as it goes, and how many steps were made."""
    task = Task(env_id)
    env = task.make(render_mode="rgb_array")
    agent: Any = make_agent("expert", task, seed=0)
    agent.set_env(env)
    observation, _ = env.reset(seed=3)
    frames: list[Any] = []
    state, start = None, np.ones(1, dtype=np.bool_)
    terminated, t = False, 0
    while True:
        frames += [env.render() for moment in wanted if moment == t]
        if terminated or t >= max(wanted):
            env.close()
            return frames, t
        action, state = agent.predict(observation, state=state, episode_start=start, deterministic=True)
        start = np.zeros(1, dtype=np.bool_)
        observation, _, terminated, _, _ = env.step(action)
        t += 1


def mosaic(env_ids: list[str], columns: int = 5) -> NDArray[np.uint8]:
    """The scenes of many environments in rows, without their panels: (height, width, 3)."""
    scenes = []
    for env_id in env_ids:
        env = gym.make(env_id, render_mode="rgb_array")
        env.reset(seed=3)
        for _ in range(3):
            env.step(env.action_space.sample() * 0)
        picture: Any = env.render()
        env.close()
        scenes.append(picture[:, : picture.shape[0]])
    empty = np.full_like(scenes[0], 250)
    scenes += [empty] * (-len(scenes) % columns)
    rows = [np.concatenate(scenes[i : i + columns], axis=1) for i in range(0, len(scenes), columns)]
    joined: NDArray[np.uint8] = np.concatenate(rows, axis=0)
    return joined


def save_picture(image: NDArray[np.uint8], path: Path) -> None:
    """Write a picture as a small PNG of 128 colours."""
    from PIL import Image

    height = round(image.shape[0] * WIDTH / image.shape[1])
    small = Image.fromarray(image).resize((WIDTH, height), Image.Resampling.LANCZOS)
    small.quantize(128).save(path, optimize=True)


def page(name: str, ids: list[str], without_memory: Scores) -> str:
    """The Markdown page of a family."""
    rows = []
    for env_id in ids:
        env = gym.make(env_id)
        scale = references(env_id)
        scores = without_memory.get(env_id, [])
        rows.append(
            [
                f"`{env_id}`",
                ", ".join(component_names(env)),
                ", ".join(env.unwrapped.get_wrapper_attr("action_names")),
                str(gym.spec(env_id).max_episode_steps),
                f"{scale.random:.1f}",
                f"{scale.expert:.1f}",
                _interval(scores),
            ]
        )
    lines = [f"# {name}", "", headline(ids[0]), ""]
    lines += [
        f"![Three moments of an expert's episode in {shown_id(ids)}](../images/environments/{name}.png)",
        "",
    ]
    lines += [*markdown_table(HEADER, rows, NUMBERS), ""]
    lines += [
        "Random and expert: mean returns (`beliefgym envs --measure`). PPO without memory: its score",
        "(return - random) / (expert - random) after training on what the id shows, mean and range over seeds",
        "(`beliefgym leaderboard --tier difficulty`).",
        "",
    ]
    note = difficulty(ids, without_memory)
    lines += (["## How hard it is", "", note, ""] if note else []) + ["## Data sheet", "", "```text"]
    return "\n".join([*lines, sheet(ids[0]), "```"]) + "\n"


def difficulty(ids: list[str], without_memory: Scores) -> str:
    """In words: what hiding costs an agent without memory."""
    scores = {env_id: float(np.mean(without_memory[env_id])) for env_id in ids if env_id in without_memory}
    steps = f"{TIERS['difficulty']['steps']['ppo']:,}"
    if ids[0] not in scores:
        return ""
    if len(ids) == 1:
        return f"After {steps} steps PPO without memory scores {scores[ids[0]]:.2f} (random 0, expert 1)."
    said = [
        f"With everything shown, PPO without memory scores {scores[ids[0]]:.2f} after {steps} steps "
        "(random 0, expert 1)."
    ]
    for env_id in ids[1:]:
        if env_id in scores:
            said.append(
                f"On `{_short(env_id)}` the same agent with the same budget scores {scores[env_id]:.2f}."
            )
    return "\n".join(said)


def scores_without_memory(results: Path) -> Scores:
    """Id -> scores of the seeds of PPO without memory, from the difficulty tier's table; empty without it."""
    path = results / "leaderboard_difficulty.csv"
    found: Scores = defaultdict(list)
    if path.exists():
        with path.open() as file:
            for row in csv.DictReader(file):
                if row["agent"] == "ppo" and row["status"] == "finished":
                    found[f"beliefgym/{row['task']}"].append(float(row["score"]))
    return dict(found)


def _interval(scores: list[float]) -> str:
    if not scores:
        return "not measured"
    return f"{np.mean(scores):.2f} ({min(scores):.2f} to {max(scores):.2f})"


def sheet(env_id: str) -> str:
    """The data sheet of what is behind an id."""
    env = gym.make(env_id).unwrapped
    return inspect.getdoc(type(getattr(env, "system", env))) or ""


def headline(env_id: str) -> str:
    """The first sentence of the data sheet."""
    return re.split(r"\n\s*\n", sheet(env_id))[0].replace("\n", " ")


def _short(env_id: str) -> str:
    return env_id.rpartition("/")[2]
