"""`Sequences` to and from Minari datasets (minari 0.5), an optional extra.

In Minari an episode's observations have one row more than its actions, as here. The true states, hints and
action log probabilities go into the episode's infos, the component names and the metadata into one JSON text
of the dataset's metadata (`beliefgym_sequences`), so that a dataset written here comes back equal. In a
dataset from elsewhere, structured spaces are laid out in columns. Spaces are read and written in the form in
which Minari stores them, so that Gymnasium is not needed here beyond what Minari itself imports.
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.sequence_checks import NAMES_FIELDS, nearest
from beliefgym.learning.sequences import Sequences

if TYPE_CHECKING:
    from minari import MinariDataset

HEADER = "beliefgym_sequences"
_FORMAT_VERSION = 1
_INFOS = ("states", "hints", "action_log_probs")


def to_minari(
    sequences: Sequences,
    dataset_id: str,
    *,
    env: Any = None,
    algorithm_name: str | None = None,
    author: str | None = None,
    author_email: str | None = None,
    code_permalink: str | None = None,
    description: str | None = None,
) -> MinariDataset:
    """Write a Minari dataset into the local Minari folder (environment variable MINARI_DATASETS_PATH).

    Observations and actions are stored as unbounded float64 boxes. Recordings without actions get one column
    of zeros, which `from_minari` takes away again.

    Args:
        sequences: at least one episode, none of length 0.
        dataset_id: "(namespace/)name-v0".
        env: id, spec or environment from which the data comes, stored so that Minari can rebuild it.
        algorithm_name, author, author_email, code_permalink, description: Minari's own metadata.

    Returns:
        The new dataset.

    Raises:
        ImportError: Minari is not installed.
        ValueError: an id of another form or already taken, no episode, or one of length 0.
    """
    minari = _import("minari")
    match = _import("minari.dataset.minari_dataset").DATASET_ID_RE.fullmatch(dataset_id)
    if match is None or match["version"] is None:
        raise ValueError(f"expected a dataset id of the form (namespace/)name-v0, got {dataset_id!r}")
    folder = _import("minari.storage").get_dataset_path(dataset_id)
    if folder.exists():
        raise ValueError(
            f"there is a dataset {dataset_id!r} already ({folder}); take a new version or delete it"
        )
    if not len(sequences) or not sequences.lengths.all():
        what = (
            "no episode"
            if not len(sequences)
            else f"length 0 for episode {int(np.argmin(sequences.lengths))}"
        )
        raise ValueError(
            f"expected at least one episode and one step in each, got {what}; leave such episodes out"
        )
    spaces = {
        "observation_space": _box(sequences.n_obs),
        "action_space": _box(max(sequences.n_act, 1)),
    }
    header = {
        "version": _FORMAT_VERSION,
        "n_act": sequences.n_act,
        "names": {field: getattr(sequences, field) for field in NAMES_FIELDS},
        "metadata": dict(sequences.metadata),
    }
    buffers = [_buffer(episode) for episode in sequences.to_episodes()]
    try:
        with warnings.catch_warnings():
            # Minari warns about each of its own metadata that is left None.
            warnings.filterwarnings("ignore", message=".* is (set to )?None", category=UserWarning)
            dataset = minari.create_dataset_from_buffers(
                dataset_id,
                buffers,
                env=env,
                algorithm_name=algorithm_name,
                author=author,
                author_email=author_email,
                code_permalink=code_permalink,
                description=description,
                **spaces,
            )
        dataset.storage.update_metadata({HEADER: json.dumps(header)})
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)  # so that half a dataset does not block its id
        raise
    return dataset


def from_minari(dataset: MinariDataset | str, *, download: bool = False) -> Sequences:
    """Read a Minari dataset, one written by `to_minari` or any other.

    In a dataset from elsewhere, boxes are laid out in columns, a discrete action or observation becomes one
    column holding its number, and the columns of Dict and Tuple spaces are named by their path
    ("achieved_goal[0]"). Its infos are not read, and an episode counts as terminated by its last step's flag.

    Args:
        dataset: a dataset, or the id of a local one.
        download: fetch the dataset of that id where it is not local.

    Returns:
        Its episodes; the metadata is what was written, or "minari_dataset" and "env_id" from elsewhere.

    Raises:
        ImportError: Minari is not installed.
        FileNotFoundError: no local dataset of that id; names the nearest.
        ValueError: no episode, or a space that is not made of numbers (text, graphs, sequences).
    """
    if isinstance(dataset, str):
        dataset = _load(dataset, download)
    if not dataset.total_episodes:
        raise ValueError(f"expected at least one episode in the dataset {dataset.id!r}, got none")
    observation_space, action_space = (
        _described(s) for s in (dataset.observation_space, dataset.action_space)
    )
    text = dataset.storage.metadata.get(HEADER)
    header: dict[str, Any] = {} if text is None else json.loads(text)
    if header.get("version", 0) > _FORMAT_VERSION:
        raise ValueError(
            f"dataset {dataset.id!r} has version {header['version']} of the format, and this beliefgym reads "
            f"up to {_FORMAT_VERSION}; update beliefgym"
        )
    episodes = []
    for data in dataset.iterate_episodes():
        n_steps = len(data.rewards)
        episode: dict[str, Any] = {
            "observations": np.hstack(_columns(observation_space, data.observations, n_steps + 1)),
            "actions": np.hstack(_columns(action_space, data.actions, n_steps)),
            "rewards": data.rewards,
            "terminated": bool(data.terminations[-1]),
        }
        if header:
            episode["actions"] = episode["actions"][:, : header["n_act"]]
            episode |= {name: data.infos[name] for name in _INFOS if name in (data.infos or {})}
        episodes.append(episode)
    if header:
        return Sequences.from_episodes(episodes, **header["names"], metadata=header["metadata"])
    spec = dataset.env_spec
    return Sequences.from_episodes(
        episodes,
        observation_names=_column_names(observation_space),
        action_names=_column_names(action_space),
        metadata={"minari_dataset": dataset.id} | ({} if spec is None else {"env_id": spec.id}),
    )


def _import(module: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(
            f'Minari datasets need the optional package minari ({error}); pip install "beliefgym[minari]"'
        ) from error


def _load(dataset_id: str, download: bool) -> MinariDataset:
    minari = _import("minari")
    try:
        return minari.load_dataset(dataset_id, download=download)
    except FileNotFoundError as error:
        local = list(minari.list_local_datasets())
        raise FileNotFoundError(
            f"no local Minari dataset {dataset_id!r}{nearest(dataset_id, local)}; there are {local}; "
            "download=True fetches one from Minari's server"
        ) from error


def _box(n: int) -> Any:
    """An unbounded box of n float64 numbers, made from Minari's own description of one."""
    description = {
        "type": "Box",
        "dtype": "float64",
        "shape": [n],
        "low": [-np.inf] * n,
        "high": [np.inf] * n,
    }
    return _import("minari.serialization").deserialize_space(description)


def _buffer(episode: Mapping[str, Any]) -> Any:
    """Minari's buffer of one unpadded episode."""
    n_steps = len(episode["rewards"])
    last = np.arange(n_steps) == n_steps - 1
    actions = episode["actions"]
    return _import("minari.data_collector").EpisodeBuffer(
        observations=episode["observations"],
        actions=actions if actions.shape[1] else np.zeros((n_steps, 1)),
        rewards=episode["rewards"],
        terminations=last & episode["terminated"],
        truncations=last & (not episode["terminated"]),
        infos={name: episode[name] for name in _INFOS if name in episode} or None,
    )


def _described(space: Any) -> dict[str, Any]:
    """A Gymnasium space as the nested mapping in which Minari stores it."""
    try:
        return _import("minari.serialization").serialize_space(space, to_string=False)
    except NotImplementedError as error:
        raise ValueError(_not_numbers(str(space))) from error


def _children(space: Mapping[str, Any]) -> dict[Any, dict[str, Any]] | None:
    """The parts of a Dict (by key) or Tuple (by index) space; None for a plain space."""
    if space["type"] == "Dict":
        return space["subspaces"]
    if space["type"] == "Tuple":
        return dict(enumerate(space["subspaces"]))
    if space["type"] not in ("Box", "Discrete", "MultiDiscrete", "MultiBinary"):
        raise ValueError(_not_numbers(space["type"]))
    return None


def _columns(space: Mapping[str, Any], value: Any, n_rows: int) -> list[NDArray[np.float64]]:
    """The parts of a value of a space, each (n_rows, k), in the space's order."""
    children = _children(space)
    if children is None:
        return [np.asarray(value, dtype=np.float64).reshape(n_rows, -1)]
    return [part for key, child in children.items() for part in _columns(child, value[key], n_rows)]


def _column_names(space: Mapping[str, Any], path: str = "") -> tuple[str, ...] | None:
    """A name for each column of a structured space; None for a plain one, which has no names to give."""
    children = _children(space)
    if children is not None:
        names: list[str] = []
        for key, child in children.items():
            names += _column_names(child, f"{path}.{key}" if path else str(key)) or ()
        return tuple(names)
    if not path:
        return None
    shape: dict[str, Any] = {"Box": space.get("shape"), "Discrete": (), "MultiBinary": space.get("n")}
    size = int(np.prod(shape.get(space["type"], np.shape(space.get("nvec", ())))))
    return (path,) if size == 1 else tuple(f"{path}[{i}]" for i in range(size))


def _not_numbers(what: str) -> str:
    return (
        "expected observations and actions made of numbers (Box, Discrete, MultiDiscrete, MultiBinary, and "
        f"Dict or Tuple of these), got {what}; convert the dataset first"
    )
