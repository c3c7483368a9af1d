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
from beliefgym.scripts.reproductions.report import Report, Request

REPRODUCTIONS = {
    "env-experts": "beliefgym.scripts.reproductions.env_experts:run",
    "dad-table": "beliefgym.scripts.reproductions.dad_table:run",
    "dad-map": "beliefgym.scripts.reproductions.dad_map:run",
    "dad-growth": "beliefgym.scripts.reproductions.dad_growth:run",
    "dad-rivals": "beliefgym.scripts.reproductions.dad_rivals:run",
    "dad-video": "beliefgym.scripts.reproductions.dad_video:run",
    "control-cart-pole": "beliefgym.scripts.reproductions.control_cart_pole:run",
    "control-swing-up": "beliefgym.scripts.reproductions.control_trials:run",
    "control-rivals": "beliefgym.scripts.reproductions.control_rivals:run",
    "control-helicopter": "beliefgym.scripts.reproductions.control_helicopter:run",
    "control-base": "beliefgym.scripts.reproductions.control_base:run",
    "control-arm": "beliefgym.scripts.reproductions.control_arm:run",
    "psim-synthetic": "beliefgym.scripts.reproductions.psim_synthetic:run",
    "psim-recorded": "beliefgym.scripts.reproductions.psim_recorded:run",
    "psim-amount": "beliefgym.scripts.reproductions.psim_amount:run",
    "hints-pendulum": "beliefgym.scripts.reproductions.hints_tables:pendulum",
    "hints-attitude": "beliefgym.scripts.reproductions.hints_tables:attitude",
    "hints-mass": "beliefgym.scripts.reproductions.hints_tables:mass",
    "actions-interventions": "beliefgym.scripts.reproductions.actions_interventions:run",
    "recurrent-returns": "beliefgym.scripts.reproductions.recurrent_returns:run",
    "recurrent-hypotheses": "beliefgym.scripts.reproductions.recurrent_hypotheses:run",
}


@dataclass(frozen=True)
class Reproduce:
    """Compute a committed result anew and write it down beside its target.

    For example:

        beliefgym reproduce env-experts
        beliefgym reproduce dad-table --data path/to/recordings --jobs 2
        beliefgym reproduce dad-video --video my_clip.mp4
    """

    name: tyro.conf.Positional[str]
    """Which; a wrong name lists them."""
    seed: int = 0
    """First seed."""
    seeds: int = 5
    """Number of seeds, for those that average over them."""
    jobs: int = 1
    """Processes."""
    data: Path | None = None
    """Folder of recorded data; what needs it is left out without, and said."""
    video: Path | None = None
    """A video of your own, for dad-video."""
    results: Path = Path("results")
    """Folder; NAME.json, NAME.md and figures are written to its reproduction/."""

    def run(self) -> int:
        """Compute, write, print; 0 even where a target is missed: the table says so."""
        check_name("reproduction", self.name, REPRODUCTIONS)
        self._check()
        module, _, function = REPRODUCTIONS[self.name].partition(":")
        console = Console()
        folder = self.results / "reproduction"
        folder.mkdir(parents=True, exist_ok=True)
        with console.status("computing") as status:

            def told(text: str) -> None:
                status.update(f"computing {text}")
                if not console.is_terminal:
                    console.print(text)

            request = Request(self.seed, self.seeds, self.jobs, folder, self.data, self.video, told)
            report: Report = getattr(import_module(module), function)(request)
        path = folder / f"{self.name}.json"
        record = {
            "command": self._command(),
            "about": report.about,
            "seed": self.seed,
            "configuration": report.configuration,
            "rows": report.rows,
            "figures": report.figures,
            "notes": report.notes,
        }
        write_record(path, record, _page(self.name, report, self._command()))
        table = Table()
        for name in report.columns:
            table.add_column(name, justify="left" if name == "what" else "right")
        for row in report.rows:
            table.add_row(*_cells(row, report.columns))
        console.print(table)
        for note in report.notes:
            console.print(note)
        console.print(f"written: {path}, {path.with_suffix('.md')}")
        return 0

    def _check(self) -> None:
        for name, least in (("seeds", 1), ("jobs", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"expected --{name} of at least {least}, got {getattr(self, name)}")
        for name in ("data", "video"):
            path = getattr(self, name)
            if path is not None and not path.exists():
                raise FileNotFoundError(f"--{name}: there is no {path}")

    def _command(self) -> str:
        given = f" --seed {self.seed}"
        if self.seeds != 5:
            given += f" --seeds {self.seeds}"
        if self.data is not None:
            given += " --data DATA"
        if self.video is not None:
            given += f" --video {self.video.name}"
        return f"beliefgym reproduce {self.name}{given}"


def _page(name: str, report: Report, command: str) -> str:
    numbers = tuple(column for column in report.columns if column not in ("what", "meets"))
    table = markdown_table(report.columns, [_cells(row, report.columns) for row in report.rows], numbers)
    lines = [f"# {name}", "", report.about, "", f"`{command}`", "", *table]
    for note in report.notes:
        lines += ["", note]
    for file, caption in report.figures.items():
        lines += ["", f"![{caption}]({file})", "", caption]
    return "\n".join(lines) + "\n"


def _cells(row: dict[str, Any], columns: tuple[str, ...]) -> list[str]:
    meets = {None: "", True: "yes", False: "no"}[row.get("meets")]
    return [meets if name == "meets" else str(row.get(name) or "") for name in columns]
