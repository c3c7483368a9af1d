"""`beliefgym reproduce recurrent-hypotheses`: is SARSA right for recurrent Q, and what should its state predict? (H5
to H7)

    H5 "SARSA is a suitable algorithm for recurrent-Q architectures."
    H6 "Predictive state statistics can help training of recurrent-Q networks on partially observed systems."
    H7 "A belief over statistics of future rewards may be sufficient hidden state for fitting Q functions."
                                                                                     (thesis proposal, Sec. 4.3)

Every method of recurrent_methods.py on every task there, with the same steps and seeds. A claim is a difference of test
returns between two methods, paired by seeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from beliefgym.agents import make_agent
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.recurrent_methods import (
    CURVE_EPISODES,
    H5,
    H6,
    H7,
    METHODS,
    SETTINGS,
    TEST_EPISODES,
    VARIANTS,
    compared,
    placed,
)
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

Found = dict[tuple[str, str], dict[int, dict[str, Any]]]  # (task, method) -> seed -> result
NAME = "recurrent-hypotheses"
VERSION = 1  # of the protocol
PLAIN = "SARSA"
RIVALS = (
    *("DRQN, random", "DRQN, sequential", "R2D2", "PQN", "RecurrentPPO"),
    *("SARSA, stack of 4", "DQN, stack of 4", "DQN of SB3, stack of 4"),
)
CLAIMS: tuple[tuple[str, str, str], ...] = (
    *(("H5", PLAIN, rival) for rival in RIVALS),
    *(("H5", PLAIN, other) for other in H5 if other.startswith("SARSA, ") and other not in RIVALS),
    *(("H6", name, PLAIN) for name in H6),
    ("H6", "predictive state", "DRQN, random"),
    *(("H7", name, PLAIN) for name in H7),
    *(("H7", name, "predictive state") for name in H7),
)
COLUMNS = (
    "what",
    "seeds",
    "return",
    "best",
    "solved",
    "kept",
    "state off",
    "R2 of state",
    "minutes",
    "difference",
    "meets",
)
ABOUT = (
    f"Returns of {TEST_EPISODES} test episodes after training (`return`), the best of 20 evaluations of "
    f"{CURVE_EPISODES} validation episodes on the way (`best`) and what of it, from the random policy's return on, "
    "is left at the end (`kept`; above 1 where little was learned and the episodes differ); of tasks with a solution, "
    "the seeds whose evaluation reached it before half of the steps and held it at the end (`solved`); how far hidden "
    "states that are kept for learning are off, relative to those of the present network (`state off`; SARSA rolls "
    "them anew before it learns, the others learn from them); linear decodability of the full observation from the "
    "hidden state; training time in minutes. Means over `seeds` with 95 % intervals: ten of what the hypotheses are "
    "about, twenty of two whose difference over all tasks was close after ten, five of the rest. Rows `X over Y`: "
    "difference of test returns, paired by seeds; `meets`: the interval lies above 0. `All tasks`: means over tasks "
    "of returns where 0 is the untrained agents' and 1 the best method's."
)


def run(request: Request) -> Report:
    """All tasks, methods and seeds; what has been run is not run again."""
    seeds = range(request.seed, request.seed + request.seeds)
    cells = {
        f"{task}--{_slug(method)}--{seed}": _cell(task, method, seed)
        for seed in seeds
        for task in SETTINGS
        for method in METHODS
        if compared(task, method, seed - request.seed)
    }
    done = run_cells(
        "beliefgym.scripts.reproductions.recurrent_methods:cell",
        cells,
        request.folder / "cells" / NAME,
        request.jobs,
        request.told,
        fresh=False,
    )
    found: Found = {}
    failed = []
    for name, result in done.items():
        cell = cells[name]
        if "failed" in result:
            failed.append(f"Failed: {name}: {result['failed']}")
        else:
            found.setdefault((cell["name"], cell["method"]), {})[cell["seed"]] = result
    rows = [row for task in SETTINGS for row in _rows(task, found)] + _rows_of_all(found)
    path = request.folder / f"{NAME}.png"
    figure(path, found)
    configuration = {
        "version": VERSION,
        "tasks": {name: setting.task.to_dict() for name, setting in SETTINGS.items()},
        "steps": {name: setting.steps for name, setting in SETTINGS.items()},
        "methods": METHODS,
    }
    caption = (
        "Returns on validation episodes over environment steps: medians over seeds, and the half around it."
    )
    return Report(ABOUT, COLUMNS, rows, configuration, {path.name: caption}, failed)


def _cell(task: str, method: str, seed: int) -> dict[str, Any]:
    setting = SETTINGS[task]
    agent, options = METHODS[method]
    where, given = placed(setting, agent, options)
    return {
        "version": VERSION,
        "name": task,
        "method": method,
        "task": where.to_dict(),
        "steps": setting.steps,
        "agent": agent,
        "options": make_agent(agent, where, seed=seed, **given).options(),  # and what is registered
        "seed": seed,
    }


def _slug(text: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in text.lower()).replace("--", "-")


def shares(found: Found) -> dict[str, dict[int, float]]:
    """method -> seed -> mean over tasks of (R - R_0) / (R_1 - R_0).

    R is the mean test return, R_0 that of all untrained agents on the task and R_1 the best method's, a mean over
    seeds. Only seeds that a method was trained with on every task.
    """
    tasks = sorted({task for task, _ in found})
    scaled: dict[tuple[str, str], dict[int, float]] = {}
    for task in tasks:
        here = {method: results for (name, method), results in found.items() if name == task}
        means = {
            method: {seed: float(np.mean(one["returns"])) for seed, one in results.items()}
            for method, results in here.items()
        }
        untrained = [one["curve"][0]["mean_return"] for results in here.values() for one in results.values()]
        low = float(np.mean(untrained))
        high = max(float(np.mean(list(by_seed.values()))) for by_seed in means.values())
        for method, by_seed in means.items():
            scaled[task, method] = {
                seed: (value - low) / max(high - low, 1e-9) for seed, value in by_seed.items()
            }
    methods = [method for method in METHODS if all((task, method) in scaled for task in tasks)]
    return {
        method: {
            seed: float(np.mean([scaled[task, method][seed] for task in tasks]))
            for seed in sorted(set.intersection(*(set(scaled[task, method]) for task in tasks)))
        }
        for method in methods
    }


def _rows_of_all(found: Found) -> list[Row]:
    if not found:
        return []
    of = {method: by_seed for method, by_seed in shares(found).items() if by_seed}
    rows: list[Row] = []
    for method, by_seed in of.items():
        score = Interval.of(list(by_seed.values()))
        rows.append(
            {
                "what": f"All tasks: {method}",
                "seeds": score.n,
                "return": score.text(".3f"),
                "meets": None,
                "values": {"return": score.to_dict()},
            }
        )
    return rows + [row for claim in CLAIMS if (row := _claim("All tasks", claim, of)) is not None]


def _claim(title: str, claim: tuple[str, str, str], of: Mapping[str, Mapping[int, float]]) -> Row | None:
    """The row of a difference; None without seeds that both methods have."""
    hypothesis, better, worse = claim
    ours, theirs = of.get(better, {}), of.get(worse, {})
    both = sorted(set(ours) & set(theirs))
    if not both:
        return None
    gap = Interval.of([ours[seed] - theirs[seed] for seed in both])
    return {
        "what": f"{title}, {hypothesis}: {better} over {worse}",
        "seeds": gap.n,
        "difference": gap.text(".3g"),
        "meets": bool(gap.low > 0.0) if gap.n > 1 else None,
        "values": {"difference": gap.to_dict()},
    }


def _rows(task: str, found: Found) -> list[Row]:
    rows: list[Row] = []
    for method in METHODS:
        results = list(found.get((task, method), {}).values())
        if results:
            rows.append(_row(task, method, results))
    means = {
        method: {seed: float(np.mean(one["returns"])) for seed, one in found.get((task, method), {}).items()}
        for method in METHODS
    }
    claims = (_claim(SETTINGS[task].title, claim, means) for claim in CLAIMS)
    rows += [row for row in claims if row is not None]
    return rows


def _row(task: str, method: str, results: list[dict[str, Any]]) -> Row:
    setting = SETTINGS[task]
    final = Interval.of([np.mean(one["returns"]) for one in results])
    curves = [[point["mean_return"] for point in one["curve"]] for one in results]
    best = Interval.of([max(curve) for curve in curves])
    kept = Interval.of(
        [
            (np.mean(one["returns"]) - c[0]) / max(max(c) - c[0], 1e-9)
            for one, c in zip(results, curves, strict=True)
        ]
    )
    off = [max(one["drifts"].values()) for one in results if one["drifts"]]
    told = [float(np.mean(list(one["decodability"].values()))) for one in results if one["decodability"]]
    minutes = Interval.of([one["seconds"] / 60 for one in results])
    row: Row = {
        "what": f"{setting.title}: {method}",
        "seeds": len(results),
        "return": final.text(".4g"),
        "best": best.text(".4g"),
        "kept": kept.text(".2f"),
        "minutes": f"{minutes.mean:.1f}",
        "meets": None,
        "values": {"return": final.to_dict(), "best": best.to_dict(), "kept": kept.to_dict()},
    }
    if setting.best is not None:
        early = [
            any(p["mean_return"] >= setting.best and p["step"] <= setting.steps / 2 for p in one["curve"])
            and float(np.mean(one["returns"])) >= setting.best
            for one in results
        ]
        row["solved"] = f"{sum(early)} of {len(early)}"
    if off:
        row["state off"] = f"{float(np.mean(off)):.3f}"
    if told:
        row["R2 of state"] = Interval.of(told).text(".2f")
    return row


def figure(path: Path, found: Found) -> None:
    """A row of panels for each group of methods: learning curves on every task."""
    shown = [task for task in SETTINGS if any(key[0] == task for key in found)]
    if not shown:
        return
    groups = {"H5": [name for name in H5 if name not in VARIANTS], "H6, H7": [PLAIN, *H6, *H7]}
    groups = {title: names for title, names in groups.items() if any(key[1] in names[1:] for key in found)}
    colours = matplotlib.colormaps["tab10"].colors  # type: ignore[attr-defined]
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(3.2 * len(shown) + 2.0, 2.9 * len(groups)), layout="constrained")
        axes = drawing.subplots(len(groups), len(shown), squeeze=False)
        for line, (title, methods) in zip(axes, groups.items(), strict=True):
            drawn = {}
            for ax, task in zip(line, shown, strict=True):
                for colour, method in zip(colours[: len(methods)], methods, strict=True):
                    results = list(found.get((task, method), {}).values())
                    if not results:
                        continue
                    steps = [point["step"] / 1000 for point in results[0]["curve"]]
                    values = np.array([[p["mean_return"] for p in one["curve"]] for one in results])
                    (drawn[method],) = ax.plot(steps, np.median(values, axis=0), color=colour, lw=1.4)
                    low, high = np.quantile(values, (0.25, 0.75), axis=0)
                    ax.fill_between(steps, low, high, color=colour, alpha=0.12, lw=0)
                plain(ax, f"{title}: {SETTINGS[task].title}", "thousand environment steps", "return")
            line[-1].legend(
                drawn.values(), drawn.keys(), frameon=False, loc="center left", bbox_to_anchor=(1.02, 0.5)
            )
        save(drawing, path)
