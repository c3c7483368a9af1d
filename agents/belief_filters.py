"""Filters for policies, by name, fitted to the data of a task; and which hints a task has to offer.

Settings were chosen on validation episodes of exact and noisy pendulums under random actions: `discount` below 1
forgets what the first, weak hypotheses met, which brings the error of the estimated velocity down to a half; a filter
of hints wants a stronger ridge where sensors are noisy.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from beliefgym.agents.step_recorder import Hint
from beliefgym.learning import (
    PSIM,
    Filter,
    InferenceMachineFilter,
    PSIMActions,
    PSIMHints,
    RandomFourierRidge,
    Sequences,
    load_filter,
    save_filter,
)
from beliefgym.wrappers.components import component_names, layers
from beliefgym.wrappers.observation_noise import AddNoise
from beliefgym.wrappers.task import Task

Array = NDArray[np.float64]
LEARNED = ("psim", "psim-actions", "psim-hints", "imf")
TRAINED_BY_HINTS = LEARNED[2:]
KNOWN = ("particle", "ukf", "ekf")  # know the system; a ceiling
VALIDATION_SHARE = 0.2  # of recorded episodes, to choose among a filter's hypotheses
# standard deviation of sensors that have none, in the units of the observation: a filter needs some, and below that of
# particles too few are near enough to the first observation
LEAST_NOISE, LEAST_NOISE_OF_PARTICLES = 0.01, 0.05
PARTICLE_MARGIN = 1.3  # and a little more than the sensors have, or some clouds lose the state


def new_filter(name: str, task: Task, seed: int, options: Mapping[str, Any]) -> Filter:
    """An unfitted filter.

    Args:
        name: of `LEARNED` or `KNOWN`. task: what it is for. seed: of its random features or particles.
        options: in place of the settings of the same name; of the regressor "n_frequencies", "bandwidth" and "alpha".

    Raises:
        ValueError: an unknown name; a known filter for a task that is no beliefgym system.
    """
    if name in KNOWN:
        return _known(name, task, seed, options)
    if name not in LEARNED:
        raise ValueError(f"expected filter to be one of {', '.join((*LEARNED, *KNOWN))}, got {name!r}")
    chosen: dict[str, Any] = {
        "n_future": 5,
        "n_iterations": 30,
        "discount": 0.8,
        "n_frequencies": 300,
        "bandwidth": None,
        "alpha": 1e-4 if name in TRAINED_BY_HINTS and _noise_of(task) else 1e-6,
        **options,
    }
    regressor = RandomFourierRidge(
        n_frequencies=chosen.pop("n_frequencies"),
        bandwidth=chosen.pop("bandwidth"),
        alpha=chosen.pop("alpha"),
        include_inputs=True,
        random_state=seed,
    )
    if name == "psim":
        return PSIM(regressor, **chosen)
    chosen.setdefault("n_choices", _n_choices(task))
    if name == "psim-actions":
        return PSIMActions(regressor, **chosen)
    chosen = {"use_actions": True, "preimage": "belief", **chosen}
    if name == "psim-hints":
        return PSIMHints(regressor, **chosen)
    if "n_future" not in options:  # it has none, and says so where one is asked for
        del chosen["n_future"]
    return InferenceMachineFilter(regressor, **chosen)


def usual_filter(task: Task, hinted: Task | None, name: str = "auto") -> str:
    """The name itself, or "auto"'s choice for a task and what `task_with_hints` gave of it.

    Raises:
        ValueError: a filter that is trained by hints, for a task without.
    """
    if name in TRAINED_BY_HINTS and hinted is None:
        raise ValueError(
            f"expected a task that offers hints for the filter {name!r}, and {task.label} offers none; take "
            "'psim-actions' or 'psim'"
        )
    return name if name != "auto" else "psim-actions" if hinted is None else "psim-hints"


def filter_to_bytes(filter: Filter) -> bytes:
    """The content of the file that `save_filter` writes."""
    with tempfile.TemporaryDirectory() as folder:
        return save_filter(filter, Path(folder) / "filter.safetensors").read_bytes()


def filter_from_bytes(content: bytes) -> Filter:
    """The reverse of `filter_to_bytes`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "filter.safetensors"
        path.write_bytes(content)
        return load_filter(path)


def drawn_within(episodes: Sequences, n_steps: int, seed: Sequence[int]) -> Sequences:
    """All episodes where they have no more than so many steps, else a random part of them, but one at least."""
    if episodes.n_transitions <= n_steps:
        return episodes
    drawn = np.random.default_rng(seed).permutation(len(episodes))
    count = np.count_nonzero(np.cumsum(episodes.lengths[drawn]) <= n_steps)
    return episodes[np.sort(drawn[: max(1, count)])]


def fit_with_validation(filter: Filter, episodes: Sequences, seed: Sequence[int]) -> None:
    """Fit to a random part of the episodes, the rest for validation; a single one is all for fitting."""
    count = max(1, round(VALIDATION_SHARE * len(episodes)))
    held = np.random.default_rng(seed).permutation(len(episodes)) < count
    train, validation = (episodes[~held], episodes[held]) if len(episodes) > 1 else (episodes, None)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*trajectories have fewer than.*")
        filter.fit(train, validation)


def task_with_hints(task: Task) -> Task | None:
    """The same task whose environment tells hints; None where it has none to offer."""
    asked = Task(task.env_id, {**task.kwargs, "hint": True}, task.wrappers)
    try:
        asked.make_vec(1).close()
    except TypeError:  # the environment knows no such parameter
        return None
    return asked


def hint_of(task: Task, raw: bool = False) -> tuple[Hint, tuple[str, ...] | None]:
    """What filters of this task are to estimate, made of its raw hints, and the names of the components.

    Of a system whose hint is the whole state that is its full observation: what the fully observed sibling shows, in
    which angles are cosines and sines. Other hints, and with `raw` all, are taken as they are.
    """
    env = task.make_vec(1)
    system = getattr(env.unwrapped, "system", None)
    env.close()
    if system is None or system.hint_names or raw:
        names = None if system is None else tuple(system.hint_names or system.state_names)
        return (lambda hints: hints), names
    return system.observe, tuple(system.observation_names)


def _n_choices(task: Task) -> int | None:
    env = task.make_vec(1)
    space = env.single_action_space
    env.close()
    return int(space.n) if isinstance(space, Discrete) else None


def _known(name: str, task: Task, seed: int, options: Mapping[str, Any]) -> Filter:
    """A filter of the task's own system, with the noise of its own sensors."""
    from beliefgym.envs import ExtendedKalmanFilter, ParticleFilter, UnscentedKalmanFilter

    env, noise = task.make_vec(1), _noise_of(task)
    system, names = getattr(env.unwrapped, "system", None), component_names(env)
    env.close()
    if system is None:
        raise ValueError(
            f"expected a task of a beliefgym system for the filter {name!r}, which knows its dynamics, got {task.label}"
        )
    least = LEAST_NOISE_OF_PARTICLES if name == "particle" else LEAST_NOISE
    std = np.maximum(np.sqrt(sum(np.square(one.std) for one in noise)), least)
    if name == "particle":
        std = PARTICLE_MARGIN * std
    kinds: dict[str, Callable[..., Filter]] = {
        "particle": ParticleFilter,
        "ukf": UnscentedKalmanFilter,
        "ekf": ExtendedKalmanFilter,
    }
    settings: dict[str, Any] = {
        "system": system,
        "observed": names,
        "observation_noise_std": tuple(np.broadcast_to(std, len(names)).tolist()),
    }
    if name == "particle":
        settings |= {"n_particles": 1000, "roughening": 0.3, "random_state": seed}
        if noise and noise[0].clips:
            settings["clipped_to"] = noise[0].observation_space.low, noise[0].observation_space.high
    return kinds[name](**{**settings, **options})


def _noise_of(task: Task) -> list[AddNoise]:
    """The noise on the task's sensors, outermost first."""
    env = task.make_vec(1)
    transforms = [getattr(layer, "transform", None) for layer in layers(env)]
    env.close()
    return [transform for transform in transforms if isinstance(transform, AddNoise)]
