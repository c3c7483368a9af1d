"""Trials and records of a model-based agent as files of an archive: arrays and JSON, nothing that runs."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from beliefgym.learning import Sequences

RECORD = "record.json"


def pack(trials: Sequence[Sequences], history: Sequence[Any], models: Sequence[Any]) -> dict[str, bytes]:
    """File name -> content."""
    parts = {RECORD: json.dumps({"history": list(history), "models": list(models)}).encode()}
    with tempfile.TemporaryDirectory() as folder:
        for i, trial in enumerate(trials):
            parts[f"trial_{i:05d}.npz"] = trial.save_npz(Path(folder) / f"{i}.npz").read_bytes()
    return parts


def unpack(parts: Mapping[str, bytes]) -> tuple[list[Sequences], list[Any], list[Any]]:
    """The trials, the history and the models' records of `pack`."""
    record = json.loads(parts[RECORD])
    trials = []
    with tempfile.TemporaryDirectory() as folder:
        for name in sorted(parts):
            if name.startswith("trial_"):
                path = Path(folder) / name
                path.write_bytes(parts[name])
                trials.append(Sequences.load_npz(path))
    return trials, record["history"], record["models"]
