"""`Sequences` in one .npz file, without pickle.

The file holds the arrays that are there under their field names, and `beliefgym_sequences`: a JSON text with
the version of this format, the component names and the metadata. It is written beside its final place and
moved there, so that a reader sees the old file or the new one and never half of one.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from beliefgym.learning.sequence_checks import ARRAYS, NAMES_FIELDS, nearest
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.whole_files import written_whole

FORMAT_VERSION = 1
HEADER = "beliefgym_sequences"
_REQUIRED = ("observations", "actions", "rewards", "lengths", "terminated")


def save_npz(sequences: Sequences, path: str | os.PathLike[str]) -> Path:
    """Write to one compressed .npz file; an existing file is replaced in one move.

    Args:
        sequences: what to write.
        path: the file, used as it is (no ending is added).

    Returns:
        The path.

    Raises:
        FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"cannot write {path}: the folder {path.parent} does not exist; create it first"
        )
    held = [name for name in ARRAYS if getattr(sequences, name) is not None]
    header = {
        "version": FORMAT_VERSION,
        "names": {field: getattr(sequences, field) for field in NAMES_FIELDS},
        "metadata": dict(sequences.metadata),
        "arrays": held,
    }
    arrays: dict[str, Any] = {HEADER: np.array(json.dumps(header))}
    arrays |= {name: getattr(sequences, name) for name in (*held, "lengths", "terminated")}
    with written_whole(path) as file:
        np.savez_compressed(file, **arrays)
    return path


def load_npz(path: str | os.PathLike[str]) -> Sequences:
    """Read what `save_npz` wrote; all checks of `Sequences` are made again.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a damaged file, another kind of .npz, a later version of the format, or a missing array.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; expected one written by Sequences.save_npz")
    held = _read(path)
    if HEADER not in held:
        raise ValueError(
            f"{path} was not written by Sequences.save_npz: it holds {sorted(held)}. Load it with numpy.load and "
            "pass the arrays to Sequences(observations, actions, rewards, lengths=...)"
        )
    try:
        header = json.loads(str(held.pop(HEADER)))
        if header["version"] > FORMAT_VERSION:
            raise ValueError(
                f"{path} has version {header['version']} of the format, and this beliefgym reads up to "
                f"{FORMAT_VERSION}; update beliefgym"
            )
        wanted = dict.fromkeys((*_REQUIRED, *header["arrays"]))
        names, metadata = dict(header["names"]), header["metadata"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged: its header is unreadable ({error!r}); write it again"
        ) from error
    for name in wanted:
        if name not in held:
            raise ValueError(
                f"{path} has no array {name!r}{nearest(name, list(held))} (it holds {sorted(held)})"
            )
    return Sequences(**{name: held[name] for name in wanted}, **names, metadata=metadata)


def _read(path: Path) -> dict[str, Any]:
    """Every array of an .npz file."""
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array, as .npy files do")
        with file:
            return {name: file[name] for name in file.files}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError) as error:
        raise ValueError(
            f"{path} is damaged or not an .npz file of plain arrays ({error}); expected one written by "
            "Sequences.save_npz"
        ) from error
