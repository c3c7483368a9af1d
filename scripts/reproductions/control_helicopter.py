"""`beliefgym reproduce control-helicopter`: the thesis's Figs. 3.12 and 3.15, and hover from random exploration.

As in Sec. 3.2.3: starts up to 10 m away, gusts at every step, a model of differences (Eq. 3.14) by ridge regression or
random Fourier features, the steady-state LQR of its linearisation at hover. Ross & Bagnell's protocol: 100 transitions
an iteration, one trial of 50 steps with the exploration policy and one with the present policy. Each iteration's policy
is tried on fresh starts for 400 steps; a trial that ends early is charged its last stage cost for what is left.

Beside them, on the same budget, stand Abbeel, Ganapathi & Ng's models of accelerations in body axes, by one-step least
squares and by their criterion over many steps; their kinematics are known and need no data.

Settings are chosen on seeds that no reported run has, for each learner, arm and exploration by the same criterion:
the geometric mean over seeds and iterations of the cost on test starts.
"""

from __future__ import annotations

import warnings
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.agents.acceleration_model import AccelerationModel
from beliefgym.agents.expert import Expert
from beliefgym.agents.exploration import Exploration
from beliefgym.agents.policy_synthesis import RegulatorSynthesis
from beliefgym.agents.system_identification import SystemIdentification
from beliefgym.envs.helicopter import Helicopter
from beliefgym.learning import DataAsDemonstrator, RandomFourierRidge, Ridge
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.control_figures import NAMES, cost_curves, mean_and_error
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row
from beliefgym.wrappers.task import Task

TASK = Task("beliefgym/HelicopterHover-v0")
ITERATIONS, TUNING_ITERATIONS = 16, 12
TRIAL_STEPS, TEST_STEPS = 50, 400
TEST_TRIALS, TUNING_TRIALS, TEST_SEED = 100, 30, 1_000_000
TUNING_SEEDS = (100, 101, 102)
FACTOR = 1.2  # of the expert's cost: the target
EXPLORATIONS: dict[str, dict[str, Any]] = {  # std as a share of the greatest change, 0.3 of a stick a step
    "random": {"kind": "random", "std": 0.5, "restoring": 0.5},
    "expert": {"kind": "expert", "std": 0.1},
}
LEARNERS = {"ridge": "linear (ridge)", "rff": "random Fourier features"}
GRID: dict[str, list[dict[str, float]]] = {
    "ridge": [{"alpha": alpha} for alpha in (1e-4, 1e-2, 1e-1)],
    "rff": [
        {"alpha": a, "bandwidth": b} for a, b in ((1e-6, 10), (1e-5, 10), (1e-4, 10), (1e-6, 20), (1e-5, 20))
    ],
}
DAD = {"n_iterations": 5, "horizon": 5}
ACCELERATION: dict[str, dict[str, Any]] = {
    "accelerations, own axis, one step": {"horizon": 1, "coupling": False},
    "accelerations, own axis, lagged over 10": {"horizon": 10, "coupling": False},
    "accelerations, all terms, one step": {"horizon": 1, "coupling": True},
    "accelerations, all terms, lagged over 10": {"horizon": 10, "coupling": True},
}
COLOURS = dict(zip(ACCELERATION, ("#009E73", "#56B4E9", "#CC79A7", "#E69F00"), strict=True))
COLOURS |= {"random": "#0072B2", "expert": "#D55E00"}
FIGURES = {
    "control-helicopter.png": "Cost of each iteration's policy with expert exploration, as a share of the panel's "
    "highest mean; mean and standard error over seeds (after Fig. 3.12). Dashed: the expert on the true model.",
    "control-helicopter-exploration.png": "Random Fourier features: expert against random exploration, and expert "
    "exploration in every iteration against none, the difference made up by trials of the present policy; costs not "
    "normalised (after Fig. 3.15).",
    "control-helicopter-budget.png": "From random exploration only, by transitions, against models of accelerations "
    "(Abbeel, Ganapathi & Ng). Dotted: 1.2 times the expert's cost.",
}
COLUMNS = ("what", "thesis", "ours", "last iteration", "against the expert", "within 1.2 after", "meets")
Key = tuple[str, bool, str]  # learner, dad, exploration


def run(request: Request) -> Report:
    """Tune, then run every line of the figures at every seed."""
    folder = request.folder / "cells" / "control-helicopter"
    chosen = _tuned(request, folder)
    seeds = range(request.seed, request.seed + request.seeds)
    lines: dict[str, dict[str, Any]] = {}
    for (learner, dad, exploration), settings in chosen.items():
        lines[_line(learner, dad, exploration)] = _cell(learner, dad, exploration, settings)
    for dad in (False, True):
        lines[_line("rff", dad, "none")] = {
            **_cell("rff", dad, "expert", chosen["rff", dad, "expert"]),
            "policy_trials": 2,
            "exploration_trials": 0,
        }
    for name, settings in ACCELERATION.items():
        lines[name] = _cell("acceleration", False, "random", settings)
    cells = {
        f"{_slug(line)}-{seed}": {
            **cell,
            "seeds": [seed],
            "iterations": ITERATIONS,
            "test_trials": TEST_TRIALS,
        }
        for line, cell in lines.items()
        for seed in seeds
    }
    found = run_cells(f"{__name__}:run_cell", cells, folder, request.jobs, request.told)
    runs: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        results = [found[f"{_slug(line)}-{seed}"] for seed in seeds]
        runs[line] = [result["runs"][0] for result in results if "runs" in result]
    expert = expert_cost()
    costs = {line: np.array([one["test_costs"] for one in ones]) for line, ones in runs.items() if ones}
    rows = [_row(line, ones, expert, len(seeds)) for line, ones in runs.items()]
    rows += _comparisons(costs, len(seeds))
    if len(costs) == len(lines):
        _draw(request, costs, runs, expert)
    return Report(
        about=(__doc__ or "").split("\n\n", 1)[1].strip().replace("\n", " "),
        columns=COLUMNS,
        rows=rows,
        configuration={
            "task": TASK.to_dict(),
            "trial_steps": TRIAL_STEPS,
            "transitions_an_iteration": 2 * TRIAL_STEPS,
            "test": {"trials": TEST_TRIALS, "steps": TEST_STEPS, "seed": TEST_SEED},
            "explorations": EXPLORATIONS,
            "grid": GRID,
            "dad": DAD,
            "tuning": {"seeds": TUNING_SEEDS, "iterations": TUNING_ITERATIONS, "trials": TUNING_TRIALS},
            "acceleration": ACCELERATION,
            "expert_cost": expert,
            "chosen": {_line(*key): value for key, value in chosen.items()},
        },
        figures=FIGURES if len(costs) == len(lines) else {},
        notes=NOTES,
    )


NOTES = [
    "Costs are means of the summed stage cost over 100 fresh starts of 400 steps; `ours` is the geometric mean "
    "over all iterations, with its 95 % interval over seeds, `last iteration` the mean over seeds with its "
    "standard error, `against the expert` that over the expert's cost on the same starts with its 95 % interval. "
    "`within 1.2 after` gives the transitions of the data when the mean over seeds first came, and from there "
    "stayed, within 1.2 times the expert's; at random exploration `meets` asks that there is one and that the "
    "interval at the last iteration lies below 1.2.",
    "A comparison's `ours` is the ratio of geometric means, paired over seeds: the first named over the second.",
    "Random exploration must suit an action that is a change of the stick: white noise on it is a random walk of "
    "the stick. Here each action takes back half of the sum of those before it. The regulator goes to the trim "
    "state, which is where a trial starts up to its position; at the cost's own minimum the sticks are free, and "
    "random features far from all data have no slope to go by.",
    "Deviations: trials of 50 steps, so that an iteration has 100 transitions in two halves; the thesis's initial"
    " data also had one random trial beside the expert's, here the expert has noise of 0.03 on its actions. "
    "Exploration was chosen by about 70 short runs on tuning seeds 100 to 102, nearly all without DaD; DaD's "
    "rollouts have 5 steps. Of the ten seeds five were run first, and five more after a look at them, with "
    "nothing else changed.",
    "What weakens the comparison of DaD with DAgger only: tuning had 3 seeds, and its starts are the first 30 of "
    "the 100 test starts; with random exploration it gave random Fourier features another ridge in each arm "
    "(DAgger only 1e-5, DaD 1e-4, the grid's largest). A check afterwards, with other starts and seeds 200 to "
    "209, at the same ridge in both arms: at 1e-4 the last policy costs 1.22 times the expert's without DaD "
    "(median 1.08) and 2.53 with it (median 1.13); over all iterations DaD / DAgger only is 1.57 [0.95, 2.60]. So"
    " the lead of DaD with random Fourier features and random exploration in this table and its figures comes "
    "from the ridge, not from DaD, and is withdrawn; the linear model's had the same ridge in both arms.",
]


def run_cell(cell: Any, extra: Any) -> dict[str, Any]:
    """Runs of the loop, one a seed: the cost of each iteration's policy on fresh starts, and of its own trials."""
    trim = Helicopter().trim
    results = []
    for seed in cell["seeds"]:
        agent = SystemIdentification(
            TASK,
            seed,
            model=_model(cell),
            synthesis=RegulatorSynthesis(),
            target=(np.concatenate([trim[:17], np.zeros(3)]), np.zeros(4)),
            trial_steps=TRIAL_STEPS,
            policy_trials=cell["policy_trials"],
            exploration_trials=cell["exploration_trials"],
            exploration=Exploration(**cell["exploration"]),
            act_with="last",
        )
        costs = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for _ in range(cell["iterations"]):
                agent.run_iterations(1)
                costs.append(float(hover_costs(agent, cell["test_trials"]).mean()))
        results.append(
            {
                "test_costs": costs,
                "trial_costs": [one["cost"] for one in agent.models],
                "transitions": [one["n_transitions"] for one in agent.models],
                "single_step_errors": [one["single_step_error"] for one in agent.models],
                "multi_step_errors": [one["multi_step_error"] for one in agent.models],
                "told": sorted({text for one in agent.models for text in one["told"]}),
            }
        )
    return {"runs": results}


def hover_costs(agent: Any, n: int = TEST_TRIALS, steps: int = TEST_STEPS) -> NDArray[np.float64]:
    """(n,) summed stage costs of an agent on fresh starts; what is left of a trial is charged its last stage cost."""
    env = TASK.make_vec(n)
    system = env.unwrapped.system  # type: ignore[attr-defined]
    if hasattr(agent, "set_env"):
        agent.set_env(env)
    observation, _ = env.reset(seed=TEST_SEED)
    state: Any = None
    start, running = np.ones(n, dtype=np.bool_), np.ones(n, dtype=np.bool_)
    costs, last = np.zeros(n), np.zeros(n)
    for t in range(steps):
        before = env.unwrapped.state.copy()  # type: ignore[attr-defined]
        action, state = agent.predict(observation, state=state, episode_start=start, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(action)
        stage = np.asarray(system.stage_cost(before, system.clip(np.asarray(action, dtype=float))))
        last = np.where(running, stage, last)
        costs += last
        running &= ~terminated
        start = np.asarray(terminated | truncated)
        if not running.any():
            costs += (steps - 1 - t) * last
            break
    env.close()
    return costs


def expert_cost() -> float:
    """The expert's mean cost on the test starts."""
    return float(hover_costs(Expert(TASK)).mean())


def _model(cell: Any) -> Any:
    settings = cell["settings"]
    if cell["learner"] == "acceleration":
        return AccelerationModel(**settings)
    regressor: Any = (
        Ridge(**settings)
        if cell["learner"] == "ridge"
        else RandomFourierRidge(n_frequencies=200, include_inputs=True, random_state=0, **settings)
    )
    n_iterations = DAD["n_iterations"] if cell["dad"] else 0
    return DataAsDemonstrator(regressor, n_iterations=n_iterations, horizon=DAD["horizon"])


def _cell(learner: str, dad: bool, exploration: str, settings: dict[str, Any]) -> dict[str, Any]:
    return {
        "version": 1,
        "learner": learner,
        "dad": dad,
        "dad_settings": DAD,
        "exploration": EXPLORATIONS[exploration],
        "settings": settings,
        "policy_trials": 1,
        "exploration_trials": 1,
    }


def _tuned(request: Request, folder: Any) -> dict[Key, dict[str, Any]]:
    """The settings of each learner, arm and exploration."""
    cells: dict[str, dict[str, Any]] = {}
    options: dict[Key, list[tuple[dict[str, Any], str]]] = {}
    for learner, exploration, dad in product(LEARNERS, EXPLORATIONS, (False, True)):
        for i, settings in enumerate(GRID[learner]):
            name = f"tuning-{i}-{_slug(_line(learner, dad, exploration))}"
            cells[name] = {
                **_cell(learner, dad, exploration, settings),
                "seeds": TUNING_SEEDS,
                "iterations": TUNING_ITERATIONS,
                "test_trials": TUNING_TRIALS,
            }
            options.setdefault((learner, dad, exploration), []).append((settings, name))
    found = run_cells(f"{__name__}:run_cell", cells, folder, request.jobs, request.told)

    def criterion(name: str) -> float:
        runs = found[name].get("runs")
        return float(np.log([one["test_costs"] for one in runs]).mean()) if runs else float("inf")

    return {key: min(several, key=lambda one: criterion(one[1]))[0] for key, several in options.items()}


def _row(line: str, runs: list[dict[str, Any]], expert: float, n: int) -> Row:
    if not runs:
        return {"what": line, "ours": "every run failed", "meets": False}
    costs = np.array([one["test_costs"] for one in runs])
    transitions = np.array([one["transitions"] for one in runs]).mean(axis=0)
    mean, error = mean_and_error(costs)
    geometric = _of_logs(np.log(costs).mean(axis=1))
    ratio = Interval.of(costs[:, -1] / expert)
    outside = np.flatnonzero(mean > FACTOR * expert)
    first = 0 if not len(outside) else int(outside[-1]) + 1
    reached = first < len(mean)
    return {
        "what": line + ("" if len(runs) == n else f" ({len(runs)} of {n} seeds)"),
        "ours": geometric.text(",.0f"),
        "last iteration": f"{mean[-1]:,.0f} ± {error[-1]:,.0f}",
        "against the expert": ratio.text(".2f"),
        "within 1.2 after": f"{transitions[first]:.0f} (iteration {first + 1})" if reached else "not reached",
        "meets": bool(reached and ratio.high < FACTOR)
        if "random exploration" in line or line in ACCELERATION
        else None,
        "values": {
            "geometric_mean": geometric.to_dict(),
            "ratio": ratio.to_dict(),
            "mean": mean.tolist(),
            "standard_error": error.tolist(),
            "transitions": transitions.tolist(),
            "test_costs": costs.tolist(),
            "trial_costs": [one["trial_costs"] for one in runs],
        },
    }


def _comparisons(costs: dict[str, NDArray[np.float64]], n: int) -> list[Row]:
    """The thesis's claims, each as a ratio that should be below 1."""
    pairs: list[tuple[str, str, str, str]] = []
    for learner, exploration in product(LEARNERS, EXPLORATIONS):
        lines = _line(learner, True, exploration), _line(learner, False, exploration)
        pairs.append((f"{LEARNERS[learner]}, {exploration}: DaD / DAgger only", "DaD far below", *lines))
    for dad in (False, True):
        lines = _line("rff", dad, "expert"), _line("ridge", dad, "expert")
        pairs.append((f"{NAMES[dad]}, expert: random features / linear", "features much better", *lines))
        lines = _line("rff", dad, "expert"), _line("rff", dad, "random")
        pairs.append((f"{NAMES[dad]}: expert / random exploration", "expert somewhat better", *lines))
    lines = _line("rff", True, "none"), _line("rff", False, "none")
    pairs.append(("no exploration: DaD / DAgger only", "no great difference", *lines))
    rows: list[Row] = []
    for what, claim, first, second in pairs:
        if first not in costs or second not in costs or len(costs[first]) != n or len(costs[second]) != n:
            continue
        ratio = _of_logs(np.log(costs[first] / costs[second]).mean(axis=1))
        low = n > 1 and ratio.high < 1.0
        meets = None if claim.startswith("no great") else bool(low)
        rows.append(
            {
                "what": what,
                "thesis": claim,
                "ours": ratio.text(".2f"),
                "meets": meets,
                "values": ratio.to_dict(),
            }
        )
    return rows


def _draw(
    request: Request,
    costs: dict[str, NDArray[np.float64]],
    runs: dict[str, list[dict[str, Any]]],
    expert: float,
) -> None:
    arms = (False, True)
    linear, features = (
        {NAMES[dad]: costs[_line(learner, dad, "expert")] for dad in arms} for learner in LEARNERS
    )
    first, second, third = (request.folder / name for name in FIGURES)
    panels: dict[str, Any] = {"(a) linear (ridge)": linear, "(b) random Fourier features": features}
    cost_curves(first, panels, log=True, references={title: {"expert": expert} for title in panels})
    panels, shades = {}, {"random": ("#E69F00", "#56B4E9"), "none": ("#E69F00", "#56B4E9")}
    colours = {}
    for title, other in (
        ("(a) expert against random exploration", "random"),
        ("(b) exploration against none", "none"),
    ):
        panels[title] = {f"{NAMES[dad]}, expert": costs[_line("rff", dad, "expert")] for dad in arms}
        panels[title] |= {f"{NAMES[dad]}, {other}": costs[_line("rff", dad, other)] for dad in arms}
        for dad in arms:
            colours[f"{NAMES[dad]}, {other}"] = shades[other][dad]
            colours[f"{NAMES[dad]}, expert"] = ("#D55E00", "#0072B2")[dad]
    references = {title: {"the expert itself": expert} for title in panels}
    cost_curves(second, panels, log=True, references=references, colours=colours, normalise="no")
    panels = {"random exploration: general learners": {}, "random exploration: accelerations": {}}
    general, known = panels.values()
    for learner, dad in product(LEARNERS, arms):
        name = f"{LEARNERS[learner]}, {NAMES[dad]}"
        general[name] = costs[_line(learner, dad, "random")]
        colours[name] = {"ridge": ("#E69F00", "#56B4E9"), "rff": ("#D55E00", "#0072B2")}[learner][dad]
    for name in ACCELERATION:
        short = name.removeprefix("accelerations, ")
        known[short], colours[short] = costs[name], COLOURS[name]
    cost_curves(
        third,
        panels,
        log=True,
        x=[2.0 * TRIAL_STEPS * (i + 1) - TRIAL_STEPS for i in range(ITERATIONS)],
        x_label="transitions (at most)",
        references={title: {"1.2 times the expert": FACTOR * expert} for title in panels},
        colours=colours,
        normalise="no",
    )


def _of_logs(logs: NDArray[np.float64]) -> Interval:
    one = Interval.of(logs)
    mean, low, high = (float(np.exp(value)) for value in (one.mean, one.low, one.high))
    return Interval(mean, low, high, one.n)


def _line(learner: str, dad: bool, exploration: str) -> str:
    return f"{LEARNERS[learner]}, {NAMES[dad]}, {exploration} exploration"


def _slug(line: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in line.lower()).replace("--", "-")
