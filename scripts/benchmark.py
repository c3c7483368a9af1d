"""`beliefgym benchmark NAME`: speed as ratios, ours and a rival side by side in one run."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from beliefgym.scripts.named_record import check_name, markdown_table, write_record
from beliefgym.scripts.training import machine

BENCHMARKS = {
    "env": "beliefgym.scripts.benchmarks.env:run",
    "dad": "beliefgym.scripts.benchmarks.dad:run",
    "control": "beliefgym.scripts.benchmarks.control:run",
    "filter": "beliefgym.scripts.benchmarks.filter:run",
    "hints": "beliefgym.scripts.benchmarks.hints:run",
    "belief": "beliefgym.scripts.benchmarks.belief:run",
    "recurrent": "beliefgym.scripts.benchmarks.recurrent:run",
}


@dataclass(frozen=True)
class Benchmark:
    """Measure speed against what a user would pick instead; leave the machine alone meanwhile.

    For example:

        beliefgym benchmark env
    """

    name: tyro.conf.Positional[str]
    """Which: env, dad, control, filter, hints, belief, recurrent."""
    results: Path = Path("results")
    """Folder; NAME.json and NAME.md are written to its benchmark/."""

    def run(self) -> int:
        """Measure, write, print; 0 even where a target is missed: the table says so."""
        check_name("benchmark", self.name, BENCHMARKS)
        module, _, function = BENCHMARKS[self.name].partition(":")
        console = Console()
        with console.status("measuring") as status:
            rows, limits = getattr(import_module(module), function)(
                lambda text: status.update(f"measuring {text}")
            )
        record = {"command": f"beliefgym benchmark {self.name}", "limits": limits, "rows": rows}
        path = self.results / "benchmark" / f"{self.name}.json"
        write_record(path, record, markdown({**record, "machine": machine()}))
        console.print(table(rows))
        for name, limit in limits.items():
            console.print(f"{name}: {limit}")
        console.print(f"written: {path}, {path.with_suffix('.md')}")
        return 0


def _cells(row: dict[str, Any]) -> list[str]:
    """A row as texts; a row without a rival is a number against its target."""
    meets = {None: "", True: "yes", False: "no"}[row["meets"]]
    target = "" if row["target"] is None else f"{row['target']:g}"
    rival = row["rival"]
    return [
        row["what"],
        _number(row["ours"]["value"]),
        row["rival_name"],
        "" if rival is None else _number(rival["value"]),
        "" if row["ratio"] is None else f"{row['ratio']:.2f}",
        target,
        meets,
    ]


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 or value == 0 else f"{value:.3g}"


HEADER = ("what", "ours", "rival", "rival's", "ratio", "target", "meets")


def table(rows: list[dict[str, Any]]) -> Table:
    """The rows for a terminal."""
    shown = Table()
    for name in HEADER:
        shown.add_column(name, justify="left" if name in ("what", "rival") else "right")
    for one in rows:
        shown.add_row(*_cells(one))
    return shown


def markdown(record: dict[str, Any]) -> str:
    """The record as a Markdown page."""
    lines = [f"# {record['command']}", "", f"Machine: {record['machine']}", ""]
    numbers = ("ours", "rival's", "ratio", "target")
    lines += markdown_table(HEADER, [_cells(one) for one in record["rows"]], numbers)
    if "repeats" not in record["limits"]:
        lines += ["", "Medians of interleaved repeats; their ranges stand in the JSON file."]
    lines += ["", "Limits measured beside:", ""]
    lines += [f"- {name}: {_plain(limit)}" for name, limit in record["limits"].items()]
    return "\n".join(lines) + "\n"


def _plain(limit: Any) -> str:
    if not isinstance(limit, dict):
        return str(limit)
    return ", ".join(f"{name} {value:,.3g}" for name, value in limit.items())
