"""`beliefgym reproduce control-cart-pole`: the thesis's Fig. 3.11, DaD+DAgger against DAgger only on the swing-up.

As in Sec. 3.2.3: transition noise, with and without noise on the actuation; one random exploration trial to begin with
and one more in every iteration; a model of differences (Eq. 3.14) by ridge regression; iLQR from an initial trajectory
of zero actions, one plan a trial, tracked by its gains. Beside the ridge stand random Fourier features, and the same
features under receding-horizon control. The thesis gives no numbers for noise, dt, cost weights and horizon: the noise
here is 0.01 on each state component and step, and 1 N on the force (a tenth of its limit); trials last 3 s at 20 Hz.

Settings are chosen on seeds that no reported run has, for each learner and noise by the same criterion for both arms:
the mean over iterations of the cost on test starts.
"""

from __future__ import annotations

import warnings
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from beliefgym.agents.dad_control import DaDControl
from beliefgym.agents.policy_synthesis import RecedingHorizonSynthesis
from beliefgym.learning import RandomFourierRidge, Ridge
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.control_figures import NAMES, cost_curves, mean_and_error
from beliefgym.scripts.reproductions.control_swing_up import TRIAL_STEPS, swing_up_task, try_fresh_starts
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

ITERATIONS, TEST_TRIALS = 8, 10
TUNING_ITERATIONS, TUNING_SEEDS = 5, (100, 101)
STATE_NOISE = 0.01
NOISES = {"without actuation noise": 0.0, "with actuation noise": 1.0}
LEARNERS: dict[str, tuple[str, str]] = {  # name -> (regressor, controller)
    "ridge": ("ridge", "plan"),
    "random Fourier features": ("rff", "plan"),
    "random Fourier features, MPC": ("rff", "mpc"),
}
CONTROLLERS = {
    "plan": RecedingHorizonSynthesis(horizon=TRIAL_STEPS, every=0, candidates=1, iterations=100),
    "mpc": RecedingHorizonSynthesis(),
}
GRID: dict[str, list[dict[str, float]]] = {
    "ridge": [{"alpha": alpha} for alpha in (1e-6, 1e-2)],
    "rff": [{"alpha": alpha, "bandwidth": 4.0} for alpha in (1e-6, 1e-3)],
}
DAD_HORIZONS = (3, 10)
VERSION = 1


def run(request: Request) -> Report:
    """Tune, then run both arms."""
    folder = request.folder / "cells" / "control-cart-pole"
    chosen = _tuned(request, folder)
    seeds = range(request.seed, request.seed + request.seeds)
    cells = {
        _name(learner, noise, dad, seed): {
            **chosen[learner, noise, dad],
            "iterations": ITERATIONS,
            "seed": seed,
        }
        for learner, noise, dad, seed in product(LEARNERS, NOISES, (False, True), seeds)
    }
    found = run_cells(f"{__name__}:run_cell", cells, folder, request.jobs, request.told)
    rows: list[Row] = []
    panels: dict[str, dict[str, Any]] = {}
    for learner, noise in product(LEARNERS, NOISES):
        runs = {
            dad: [found[_name(learner, noise, dad, s)] for s in seeds if _ran(found, learner, noise, s)]
            for dad in (False, True)
        }
        if not runs[False]:
            rows.append({"what": f"{learner}, {noise}", "ours": "every run failed", "meets": False})
            continue
        panels[f"{learner},\n{noise}"] = {
            NAMES[dad]: np.array([one["test_costs"] for one in runs[dad]]) for dad in (False, True)
        }
        rows.append(_row(learner, noise, runs, len(seeds)))
    figure = "control-cart-pole.png"
    if panels:
        cost_curves(request.folder / figure, panels)
    return Report(
        about=__doc__.split("\n\n", 1)[1].strip().replace("\n", " ") if __doc__ else "",
        columns=("what", "thesis", "DAgger only", "DAgger + DaD", "gain", "gain at the end", "meets"),
        rows=rows,
        configuration={
            "trial_steps": TRIAL_STEPS,
            "iterations": ITERATIONS,
            "test_trials": TEST_TRIALS,
            "state_noise_std": STATE_NOISE,
            "actuation_noise_std_N": NOISES,
            "grid": GRID,
            "dad_horizons": DAD_HORIZONS,
            "tuning_seeds": TUNING_SEEDS,
            "chosen": {" / ".join(map(str, key)): value for key, value in chosen.items()},
        },
        figures={
            figure: "Cumulative cost of each iteration's policy on 10 fresh starts, mean and standard error over seeds "
            "as a share of the panel's highest (after Fig. 3.11)."
        },
        notes=[
            "Costs are means over iterations and seeds with standard errors; a gain is the share of DAgger only's cost "
            "that DaD takes away, over all iterations or over the last three, with its 95 % interval over paired "
            "seeds. `meets` asks for a gain above 0 by its interval.",
        ],
    )


def run_cell(cell: Any, extra: Any) -> dict[str, Any]:
    """One run of the loop: costs of its own trials and on fresh starts, by iteration."""
    parameters = {"process_noise_std": STATE_NOISE, "actuation_noise_std": cell["actuation_noise"]}
    task = swing_up_task(parameters)
    settings = cell["settings"]
    regressor: Any = (
        Ridge(**settings)
        if cell["regressor"] == "ridge"
        else RandomFourierRidge(n_frequencies=250, include_inputs=True, random_state=0, **settings)
    )
    agent = DaDControl(
        task,
        seed=cell["seed"],
        dad=cell["dad"],
        regressor=regressor,
        dad_horizon=cell["dad_horizon"],
        synthesis=CONTROLLERS[cell["controller"]],
        trial_steps=TRIAL_STEPS,
        exploration_trials=1,
        act_with="last",
    )
    costs, upright = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(cell["iterations"]):
            agent.run_iterations(1)
            test = try_fresh_starts(agent, task, n=TEST_TRIALS)
            costs.append(float(test.costs.mean()))
            upright.append(float(test.upright.mean()))
    return {
        "test_costs": costs,
        "upright": upright,
        "trial_costs": [one["cost"] for one in agent.models],
        "single_step_errors": [one["single_step_error"] for one in agent.models],
        "multi_step_errors": [one["multi_step_error"] for one in agent.models],
        "interaction_steps": agent.num_timesteps,
        "told": sorted({text for one in agent.models for text in one["told"]}),
    }


def _tuned(request: Request, folder: Path) -> dict[tuple[str, str, bool], dict[str, Any]]:
    """Settings of each learner, noise and arm, from the tuning seeds."""
    cells: dict[str, dict[str, Any]] = {}
    options: dict[tuple[str, str, bool], list[tuple[dict[str, Any], list[str]]]] = {}
    for learner, noise, dad in product(LEARNERS, NOISES, (False, True)):
        regressor, controller = LEARNERS[learner]
        for i, (settings, horizon) in enumerate(
            product(GRID[regressor], DAD_HORIZONS if dad else DAD_HORIZONS[:1])
        ):
            cell = {
                "version": VERSION,
                "regressor": regressor,
                "controller": controller,
                "settings": settings,
                "dad": dad,
                "dad_horizon": horizon,
                "actuation_noise": NOISES[noise],
                "state_noise": STATE_NOISE,
            }
            names = []
            for seed in TUNING_SEEDS:
                name = f"tuning-{i}-{_name(learner, noise, dad, seed)}"
                cells[name] = {**cell, "iterations": TUNING_ITERATIONS, "seed": seed}
                names.append(name)
            options.setdefault((learner, noise, dad), []).append((cell, names))
    found = run_cells(f"{__name__}:run_cell", cells, folder, request.jobs, request.told)

    def criterion(names: list[str]) -> float:
        costs = [found[name].get("test_costs", [np.inf]) for name in names]
        return float(np.mean([np.mean(one) for one in costs]))

    return {key: min(several, key=lambda one: criterion(one[1]))[0] for key, several in options.items()}


def _row(learner: str, noise: str, runs: dict[bool, list[dict[str, Any]]], n: int) -> Row:
    costs = {dad: np.array([one["test_costs"] for one in ones]) for dad, ones in runs.items()}
    texts = {}
    for dad, c in costs.items():
        mean, error = mean_and_error(c.mean(axis=1, keepdims=True))
        texts[dad] = f"{mean[0]:.0f} ± {error[0]:.0f}"
    gain = Interval.of(100.0 * (1.0 - costs[True].mean(axis=1) / costs[False].mean(axis=1)))
    end = Interval.of(100.0 * (1.0 - costs[True][:, -3:].mean(axis=1) / costs[False][:, -3:].mean(axis=1)))
    smaller = "DaD below DAgger only" if noise == "without actuation noise" else "a smaller gain"
    return {
        "what": f"{learner}, {noise}"
        + ("" if len(costs[True]) == n else f" ({len(costs[True])} of {n} seeds)"),
        "thesis": smaller,
        "DAgger only": texts[False],
        "DAgger + DaD": texts[True],
        "gain": gain.text(".0f", " %"),
        "gain at the end": end.text(".0f", " %"),
        "meets": bool(gain.low > 0.0) if noise == "without actuation noise" else None,
        "values": {
            "gain": gain.to_dict(),
            "gain_at_the_end": end.to_dict(),
            "upright_at_the_end": {
                NAMES[dad]: float(np.mean([one["upright"][-1] for one in ones])) for dad, ones in runs.items()
            },
        },
    }


def _ran(found: dict[str, Any], learner: str, noise: str, seed: int) -> bool:
    return all("test_costs" in found[_name(learner, noise, dad, seed)] for dad in (False, True))


def _name(learner: str, noise: str, dad: bool, seed: int) -> str:
    parts = (learner, noise, "dad" if dad else "dagger")
    return "-".join(part.replace(" ", "-").replace(",", "") for part in parts) + f"-{seed}"
