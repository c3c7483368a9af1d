"""`beliefgym reproduce NAME`: one command for each committed result, with its seeds and versions."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from beliefgym.scripts.named_record import check_name, markdown_table, write_record

REPRODUCTIONS = {
    "env-experts": "beliefgym.scripts.reproductions.env_experts:run",
}
HEADER = ("what", "ours", "reference", "target", "meets")


@dataclass(frozen=True)
class Reproduce:
    """Compute a committed result anew and write it down beside its target.

    For example:

        beliefgym reproduce env-experts
    """

    name: tyro.conf.Positional[str]
    """Which; a wrong name lists them."""
    seed: int = 0
    """First seed."""
    results: Path = Path("results")
    """Folder; NAME.json and NAME.md are written to its reproduction/."""

    def run(self) -> int:
        """Compute, write, print; 0 even where a target is missed: the table says so."""
        check_name("reproduction", self.name, REPRODUCTIONS)
        module, _, function = REPRODUCTIONS[self.name].partition(":")
        console = Console()
        with console.status("computing") as status:
            about, rows = getattr(import_module(module), function)(
                self.seed, lambda text: status.update(f"computing {text}")
            )
        command = f"beliefgym reproduce {self.name} --seed {self.seed}"
        record = {"command": command, "about": about, "seed": self.seed, "rows": rows}
        path = self.results / "reproduction" / f"{self.name}.json"
        write_record(path, record, _page(self.name, about, command, rows))
        table = Table()
        for name in HEADER:
            table.add_column(name, justify="left" if name == "what" else "right")
        for row in rows:
            table.add_row(*_cells(row))
        console.print(table)
        console.print(f"written: {path}, {path.with_suffix('.md')}")
        return 0


def _page(name: str, about: str, command: str, rows: list[dict[str, Any]]) -> str:
    table = markdown_table(HEADER, [_cells(row) for row in rows], ("ours", "reference", "target"))
    return "\n".join([f"# {name}", "", about, "", f"`{command}`", "", *table]) + "\n"


def _cells(row: dict[str, Any]) -> list[str]:
    meets = {None: "", True: "yes", False: "no"}[row.get("meets")]
    return [row["what"], *(str(row.get(name) or "") for name in ("ours", "reference", "target")), meets]
