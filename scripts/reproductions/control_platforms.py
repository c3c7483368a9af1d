"""What the experiments on the base and on the arm share: runs of the loop, both arms compared, rows and figures.

Settings of each arm are chosen from the same grid by the same criterion, the mean over iterations of the logarithm of
the cost on fresh starts, on seeds that no reported run has.
"""

from __future__ import annotations

import warnings
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefgym.agents.coordinates import Coordinates
from beliefgym.agents.dad_control import DaDControl
from beliefgym.learning import Sequences
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.control_figures import COLOURS, NAMES, cost_curves, mean_and_error
from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row
from beliefgym.wrappers.task import Task

Floats = NDArray[np.float64]
ITERATIONS, DAD_ITERATIONS = 10, 10
TEST_TRIALS, TEST_SEED, HELD_OUT_SEED = 20, 1_000_000, 2_000_000
COLUMNS = ("what", "thesis", "DAgger only", "DAgger + DaD", "ours", "last three", "held-out error", "meets")


def compare(
    request: Request,
    name: str,
    function: str,
    conditions: dict[str, dict[str, Any]],
    grid: list[dict[str, Any]],
    dad_horizons: tuple[int | None, ...],
    claims: dict[str, str],
    tuning_seeds: tuple[int, ...],
    references: dict[str, float],
    reference: str,
    about: str,
    notes: list[str],
) -> Report:
    """Both arms of every condition: settings from the tuning seeds, runs at the request's seeds, rows and figures."""
    folder = request.folder / "cells" / name
    grids = {
        dad: [{**s, "dad_horizon": h} for s in grid for h in (dad_horizons if dad else (None,))]
        for dad in (False, True)
    }
    common = {
        key: {**cell, "iterations": ITERATIONS, "dad_iterations": DAD_ITERATIONS}
        for key, cell in conditions.items()
    }
    keys = [(key, dad) for key in conditions for dad in (False, True)]
    tuning = {
        _slug(key, dad, "tuning"): {
            **common[key],
            "dad": dad,
            "settings": grids[dad],
            "seeds": list(tuning_seeds),
        }
        for key, dad in keys
    }
    found = run_cells(function, tuning, folder, request.jobs, request.told)
    chosen: dict[tuple[str, bool], dict[str, Any]] = {}
    for key, dad in keys:
        result = found[_slug(key, dad, "tuning")]
        if "failed" in result:
            raise RuntimeError(
                f"expected tuning of {key} to run, got {result['failed']}; mend it and run again"
            )
        logs = np.log([one["test_costs"] for one in result["runs"]]).mean(axis=1)
        chosen[key, dad] = grids[dad][int(np.argmin(logs.reshape(len(grids[dad]), -1).mean(axis=1)))]
    seeds = range(request.seed, request.seed + request.seeds)
    cells = {
        _slug(key, dad, seed): {**common[key], "dad": dad, "settings": [chosen[key, dad]], "seeds": [seed]}
        for key, dad in keys
        for seed in seeds
    }
    found = run_cells(function, cells, folder, request.jobs, request.told)
    rows: list[Row] = []
    costs: dict[str, Any] = {}
    errors: dict[str, Any] = {}
    for key in conditions:
        good = [s for s in seeds if all("runs" in found[_slug(key, dad, s)] for dad in (False, True))]
        if not good:
            rows.append({"what": key, "ours": "every run failed", "meets": False})
            continue
        runs = {dad: [found[_slug(key, dad, s)]["runs"][0] for s in good] for dad in (False, True)}
        of = {
            what: {dad: np.array([one[what] for one in ones]) for dad, ones in runs.items()}
            for what in ("test_costs", "held_out_errors", "trial_costs")
        }
        costs[key] = {NAMES[dad]: c for dad, c in of["test_costs"].items()}
        errors[key] = {NAMES[dad]: c for dad, c in of["held_out_errors"].items()}
        rows.append(_row(key, of, claims.get(key), len(seeds)))
    figures = {}
    if costs:
        first, second = f"{name}.png", f"{name}-errors.png"
        cost_curves(request.folder / first, costs, references={k: {reference: references[k]} for k in costs})
        with matplotlib.rc_context(STYLE):
            save(_error_figure(errors), request.folder / second)
        figures = {
            first: f"Cumulative cost of each iteration's policy on {TEST_TRIALS} fresh starts, mean and standard error "
            f"over seeds as a share of the panel's highest; dashed: {reference}.",
            second: "Multi-step error of each iteration's model on held-out trajectories, mean and standard error.",
        }
    return Report(
        about=about,
        columns=COLUMNS,
        rows=rows,
        configuration={
            "conditions": common,
            "grid": grid,
            "dad_horizons": list(dad_horizons),
            "tuning_seeds": list(tuning_seeds),
            "chosen": {f"{key} / {NAMES[dad]}": setting for (key, dad), setting in chosen.items()},
            "references": {reference: references},
        },
        figures=figures,
        notes=notes,
    )


def run_loop(agent: DaDControl, iterations: int, held_out: Sequences, steps: int) -> dict[str, Any]:
    """The loop: cost on fresh starts, of the own trials, and errors on held-out trajectories, by iteration."""
    costs, errors = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(iterations):
            agent.run_iterations(1)
            x, u = run_fresh(agent, agent.task, agent.coordinates, TEST_TRIALS, steps, TEST_SEED)
            costs.append(float(np.asarray(agent.cost(x[:, :-1], u)).sum(axis=1).mean()))
            errors.append(agent.dynamics.errors(held_out).mean)
    return {
        "test_costs": costs,
        "trial_costs": [one["cost"] for one in agent.models],
        "held_out_errors": errors,
        "told": sorted({text for one in agent.models for text in one["told"]}),
    }


def run_fresh(
    policy: Any, task: Task, coordinates: Coordinates, n: int, steps: int, seed: int
) -> tuple[Floats, Floats]:
    """A policy from n fresh starts, all at once; for environments that do not end within `steps`.

    Args:
        policy: with SB3's `predict`; it sees what the task shows, noise included.

    Returns:
        True coordinates (n, steps + 1, d) and applied actions (n, steps, m).
    """
    env = task.make_vec(n)
    system: Any = env.unwrapped.system  # type: ignore[attr-defined]
    columns = [system.observation_names.index(name) for name in coordinates.observation_names]

    def true() -> Floats:
        state = env.unwrapped.state  # type: ignore[attr-defined]
        return coordinates.encode(np.asarray(system.observe(state))[:, columns])

    if hasattr(policy, "set_env"):
        policy.set_env(env)
    observation, _ = env.reset(seed=seed)
    memory: Any = None
    start = np.ones(n, dtype=np.bool_)
    states, actions = [true()], []
    for _ in range(steps):
        action, memory = policy.predict(observation, state=memory, episode_start=start, deterministic=True)
        observation, *_ = env.step(action)
        start = np.zeros(n, dtype=np.bool_)
        actions.append(np.asarray(system.clip(np.asarray(action, dtype=float))))
        states.append(true())
    env.close()
    return np.stack(states, axis=1), np.stack(actions, axis=1)


def _row(key: str, of: dict[str, dict[bool, Floats]], claim: str | None, n: int) -> Row:
    def gain(what: str, last: int = 0) -> Interval:
        logs = np.log(of[what][True] / of[what][False])[:, -last:].mean(axis=1)
        one = Interval.of(logs)
        mean, high, low = (100.0 * (1.0 - float(np.exp(v))) for v in (one.mean, one.low, one.high))
        return Interval(mean, low, high, one.n)

    texts = {}
    for dad, c in of["test_costs"].items():
        mean, error = mean_and_error(c.mean(axis=1, keepdims=True))
        texts[dad] = f"{mean[0]:.4g} ± {error[0]:.2g}"
    whole, end, error_gain = gain("test_costs"), gain("test_costs", 3), gain("held_out_errors")
    own = of["trial_costs"]
    return {
        "what": key + ("" if len(own[True]) == n else f" ({len(own[True])} of {n} seeds)"),
        "thesis": claim or "",
        "DAgger only": texts[False],
        "DAgger + DaD": texts[True],
        "ours": whole.text(".0f", " %"),
        "last three": end.text(".0f", " %"),
        "held-out error": error_gain.text(".0f", " %"),
        "meets": None if claim is None else bool(whole.low > 0.0),
        "values": {
            "gain": whole.to_dict(),
            "gain_last_three": end.to_dict(),
            "gain_held_out_error": error_gain.to_dict(),
            **{f"{what}, {NAMES[dad]}": v.tolist() for what, arms in of.items() for dad, v in arms.items()},
        },
    }


def _error_figure(errors: dict[str, dict[str, Floats]]) -> Figure:
    """Multi-step errors by iteration, a small plot a condition."""
    figure = Figure(figsize=(4.2 * len(errors), 3.2), layout="constrained")
    for axes, (title, arms) in zip(
        figure.subplots(1, len(errors), squeeze=False)[0], errors.items(), strict=True
    ):
        for name, values in arms.items():
            mean, error = mean_and_error(values)
            at = np.arange(1, len(mean) + 1)
            axes.plot(at, mean, color=COLOURS[name], label=name, marker="o", markersize=3)
            low = np.maximum(mean - error, 0.05 * mean)
            axes.fill_between(at, low, mean + error, color=COLOURS[name], alpha=0.2, linewidth=0)
        axes.set_yscale("log")
        plain(axes, title, "DAgger iteration", "held-out multi-step error")
        axes.legend(frameon=False)
    return figure


def _slug(key: str, dad: bool, seed: Any) -> str:
    words = "-".join("".join(c if c.isalnum() else " " for c in key).split())
    return f"{words}-{'dad' if dad else 'dagger'}-{seed}"
