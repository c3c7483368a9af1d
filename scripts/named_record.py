"""What `benchmark` and `reproduce` write: a JSON record with its origin, and the same as a Markdown table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from beliefgym.scripts.training import git_commit, machine, versions


def check_name(kind: str, name: str, known: Mapping[str, str]) -> None:
    """Tell an unknown name.

    Raises:
        ValueError: with the nearest name.
    """
    if name not in known:
        near = get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"there is no {kind} {name!r}{hint} (known: {', '.join(known)})")


def write_record(path: Path, record: Mapping[str, Any], page: str) -> dict[str, Any]:
    """Write record and page as path (.json) and .md, with versions, commit and machine.

    Returns:
        the record as written.
    """
    full = {**record, "versions": versions(), "git_commit": git_commit(), "machine": machine()}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(full, indent=1) + "\n")
    path.with_suffix(".md").write_text(page)
    return full


def markdown_table(header: tuple[str, ...], rows: list[list[str]], numbers: tuple[str, ...]) -> list[str]:
    """The lines of a Markdown table; columns in `numbers` are set to the right."""
    rule = "|" + "|".join("---:" if name in numbers else "---" for name in header) + "|"
    return ["| " + " | ".join(header) + " |", rule, *("| " + " | ".join(row) + " |" for row in rows)]
