"""DaD+DAgger against DAgger only on one platform: tuning, runs, rows and the figure of one experiment.

Each panel (a learner on a platform) has two arms that differ in the flag `dad` alone. Settings of each arm are chosen
from the same grid by the same criterion, the mean over iterations and tuning seeds of the cost on fresh starts; the
tuning seeds have no reported run. An iteration's cost is that of its policy on fresh starts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.control_figures import NAMES, cost_curves, mean_and_error
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

Floats = NDArray[np.float64]
COLUMNS = ("what", "thesis", "DAgger only", "DAgger + DaD", "gain", "gain at the end", "meets")
LAST = 3  # iterations that count as the end
NOTE = (
    "Costs are means over iterations and seeds with standard errors; a gain is the share of DAgger only's cost that "
    "DaD takes away, over all iterations or over the last three, with its 95 % interval over paired seeds. Where the "
    "thesis claims a gain, `meets` asks for one above 0 by its interval. Where tuning gave the arms "
    "different settings, a second row has DAgger only with DaD's: a gain that is gone there is the settings', not "
    "DaD's."
)


@dataclass(frozen=True)
class Panel:
    """One learner on one platform.

    Args:
        cell: what the cell function is given beside settings, arm, iterations and seed.
        grid: settings to choose from.
        thesis: the claim, in words. claims_gain: whether it is that DaD's cost is lower.
    """

    cell: Mapping[str, Any]
    grid: Sequence[Mapping[str, Any]]
    thesis: str
    claims_gain: bool


@dataclass(frozen=True)
class Comparison:
    """The experiment.

    Args:
        name: the reproduction's. function: "module:name" of the cell function: its result has "test_costs".
        panels: title -> panel. iterations: of the loop. tuning_iterations, tuning_seeds: of the tuning runs.
        dad_horizons: lengths of DaD's rollouts to choose from.
    """

    name: str
    function: str
    panels: Mapping[str, Panel]
    iterations: int
    tuning_iterations: int
    tuning_seeds: Sequence[int]
    dad_horizons: Sequence[int]

    def run(self, request: Request, log: bool = False) -> tuple[list[Row], dict[str, Any], str]:
        """Tune and run; rows, what was chosen, and the figure's name."""
        folder = request.folder / "cells" / self.name
        chosen = self._tuned(request, folder)
        seeds = range(request.seed, request.seed + request.seeds)
        cells = {
            cell_name(title, dad, seed): {**chosen[title, dad], "iterations": self.iterations, "seed": seed}
            for title, dad, seed in product(self.panels, (False, True), seeds)
        }
        for title in self.panels:
            if chosen[title, False]["settings"] != chosen[title, True]["settings"]:
                same = {**chosen[title, True], "dad": False}
                for seed in seeds:
                    cells[f"same-{cell_name(title, False, seed)}"] = {
                        **same,
                        "iterations": self.iterations,
                        "seed": seed,
                    }
        found = run_cells(self.function, cells, folder, request.jobs, request.told)
        rows: list[Row] = []
        drawn: dict[str, dict[str, Floats]] = {}
        for title, panel in self.panels.items():
            good = [
                s for s in seeds if all("test_costs" in found[cell_name(title, d, s)] for d in (False, True))
            ]
            runs = {dad: [found[cell_name(title, dad, s)] for s in good] for dad in (False, True)}
            if not good:
                reason = found[cell_name(title, True, seeds[0])].get("failed", "the other arm failed")
                rows.append(
                    {"what": f"{title}: every run failed: {reason}", "thesis": panel.thesis, "meets": False}
                )
                continue
            drawn[title.replace(", ", ",\n")] = {
                NAMES[dad]: np.array([one["test_costs"] for one in ones]) for dad, ones in runs.items()
            }
            rows.append(_row(title, panel, runs, len(seeds)))
            alike = [found.get(f"same-{cell_name(title, False, seed)}", {}) for seed in good]
            if all("test_costs" in one for one in alike):
                words = f"{title}; DAgger only with DaD's settings"
                rows.append(_row(words, panel, {False: alike, True: runs[True]}, len(seeds)))
        figure = f"{self.name}.png"
        if drawn:
            cost_curves(request.folder / figure, drawn, log=log)
        return rows, {" / ".join(map(str, key)): value for key, value in chosen.items()}, figure

    def report(self, request: Request, about: str, caption: str, configuration: Mapping[str, Any]) -> Report:
        """`run`, written up.

        Args:
            request: of the command. about: the module's docstring, whose first line is left out.
            caption: of the figure. configuration: beyond the comparison's own.
        """
        rows, chosen, figure = self.run(request)
        return Report(
            about=about.split("\n\n", 1)[1].strip().replace("\n", " "),
            columns=COLUMNS,
            rows=rows,
            configuration={
                **configuration,
                "grids": {title: list(panel.grid) for title, panel in self.panels.items()},
                "iterations": self.iterations,
                "dad_horizons": list(self.dad_horizons),
                "tuning_iterations": self.tuning_iterations,
                "tuning_seeds": list(self.tuning_seeds),
                "chosen": chosen,
            },
            figures={figure: caption},
            notes=[NOTE],
        )

    def _tuned(self, request: Request, folder: Path) -> dict[tuple[str, bool], dict[str, Any]]:
        """The cell of each panel and arm with its best settings."""
        cells: dict[str, dict[str, Any]] = {}
        options: dict[tuple[str, bool], list[tuple[dict[str, Any], list[str]]]] = {}
        for (title, panel), dad in product(self.panels.items(), (False, True)):
            horizons = self.dad_horizons if dad else self.dad_horizons[:1]
            for i, (settings, horizon) in enumerate(product(panel.grid, horizons)):
                cell = {**panel.cell, "settings": dict(settings), "dad": dad, "dad_horizon": horizon}
                names = [f"tuning-{i}-{cell_name(title, dad, seed)}" for seed in self.tuning_seeds]
                for name, seed in zip(names, self.tuning_seeds, strict=True):
                    cells[name] = {**cell, "iterations": self.tuning_iterations, "seed": seed}
                options.setdefault((title, dad), []).append((cell, names))
        found = run_cells(self.function, cells, folder, request.jobs, request.told)

        def criterion(names: list[str]) -> float:
            return float(np.mean([np.mean(found[name].get("test_costs", [np.inf])) for name in names]))

        return {key: min(several, key=lambda one: criterion(one[1]))[0] for key, several in options.items()}


def _row(title: str, panel: Panel, runs: dict[bool, list[dict[str, Any]]], n: int) -> Row:
    costs = {dad: np.array([one["test_costs"] for one in ones]) for dad, ones in runs.items()}
    texts = {}
    for dad, several in costs.items():
        mean, error = mean_and_error(several.mean(axis=1, keepdims=True))
        texts[dad] = f"{mean[0]:,.4g} ± {error[0]:.2g}"
    gain = Interval.of(100.0 * (1.0 - costs[True].mean(axis=1) / costs[False].mean(axis=1)))
    end = Interval.of(
        100.0 * (1.0 - costs[True][:, -LAST:].mean(axis=1) / costs[False][:, -LAST:].mean(axis=1))
    )
    return {
        "what": title + ("" if len(costs[True]) == n else f" ({len(costs[True])} of {n} seeds)"),
        "thesis": panel.thesis,
        "DAgger only": texts[False],
        "DAgger + DaD": texts[True],
        "gain": gain.text(".0f", " %"),
        "gain at the end": end.text(".0f", " %"),
        "meets": bool(gain.low > 0.0) if panel.claims_gain else None,
        "values": {
            "gain": gain.to_dict(),
            "gain_at_the_end": end.to_dict(),
        },
    }


def cell_name(title: str, dad: bool, seed: int) -> str:
    """The name of a run's file."""
    words = "".join(c for c in title if c.isalnum() or c in " -.").replace(" ", "-")
    return f"{words}-{'dad' if dad else 'dagger'}-{seed}"
