"""`control-base`: the thesis's Fig. 3.13, open-loop control of a differential-drive base by a learned model.

As in Sec. 3.2.3: state (goal forward, goal left, heading), control (speed, turning rate), a model of differences
(Eq. 3.14) by ridge regression, one random exploration trial, then one trial of each iteration's policy: the actions of
a proportional controller simulated on the learned model, run open-loop. The simulated base with lagging motors and
noisy actuation stands in for the Videre Erratic; its speeds are not in the state, as the thesis's 3 dimensions have it.
The goal is 1 to 2 m away, within 60 degrees of straight ahead. In the robot's frame it moves by

    forward' = forward - v dt + w dt left,    left' = left - w dt forward,    theta' = theta + w dt

whose products ridge regression on the coordinates cannot represent; the monomials of degree 2 can. The cost is

    c = forward^2 + left^2 + 0.1 theta^2 + 0.01 v^2 + 0.001 w^2      (m, rad, s; Eq. 3.15).

Ridge, the law's gains and DaD's rollout length are chosen for each arm on seeds that no reported run has, by one
criterion: the mean over iterations of the logarithm of the cost on fresh starts.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefgym.agents.coordinates import Coordinates
from beliefgym.agents.dad_control import DaDControl
from beliefgym.agents.exploration import Exploration
from beliefgym.agents.policy_synthesis import OpenLoopSynthesis
from beliefgym.envs.mobile_base import MobileBase
from beliefgym.envs.planning.open_loop import ProportionalLaw
from beliefgym.learning import PolynomialRidge, Ridge, Sequences
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.control_figures import COLOURS, NAMES, cost_curves, mean_and_error
from beliefgym.scripts.reproductions.dad_figures import STYLE, plain, save
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row
from beliefgym.wrappers.task import Task

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams

Floats = NDArray[np.float64]
TRIAL_STEPS, ITERATIONS, DAD_ITERATIONS = 50, 10, 10  # 5 s
TEST_TRIALS, TEST_SEED, HELD_OUT_SEED = 20, 1_000_000, 2_000_000
TUNING_SEEDS = (100, 101, 102, 103, 104)
HOLD = 5  # steps of an exploration action
SHOWN = ("goal_forward", "goal_left", "cos_theta", "sin_theta")
ODOMETRY = [0.006, 0.006, 0.051, 0.051]  # m, rad as cosine and sine show it; of the registered noisy base
HERE = "beliefgym.scripts.reproductions.control_base"
CONDITIONS: dict[str, dict[str, Any]] = {
    "ridge": {"degree": 1},
    "ridge, odometry noise": {"degree": 1, "noisy": True},
    "degree 2": {"degree": 2},
    "ridge, registered starts": {"degree": 1, "anywhere": True},
}
CLAIMS = {"ridge": "DaD clearly below DAgger only"}
GRID = [
    {"alpha": alpha, "law": list(law)}
    for alpha, law in product((1e-4, 1e-2, 1e-1), ((1.0, 2.0), (1.0, 1.0), (0.5, 1.0)))
]
DAD_HORIZONS = (2, 5, 10, None)
VERSION = 1
COLUMNS = ("what", "thesis", "DAgger only", "DAgger + DaD", "ours", "last three", "held-out error", "meets")
NOTES = [
    "`ours` is the share of DAgger only's cost that DaD takes away, by geometric means over iterations, with its 95 % "
    "interval over paired seeds; `last three` the same over the last three iterations; `held-out error` the gain in "
    "the models' multi-step error on trajectories of neither arm. Costs are means over iterations and seeds with "
    "standard errors on 20 fresh starts by the true state; an iteration's own trial is in the record.",
    "Algorithm 2 chooses DaD's model on validation trajectories; here every trial trains and the training rollouts "
    "choose. The dashed line is the law's plan on the true noise-free system, run open-loop under the same noise.",
]


@dataclass(frozen=True, kw_only=True)
class BaseBeforeGoal(MobileBase):
    """`MobileBase` that starts at rest with the goal near straight ahead, heading as the goal does.

    Args:
        near, far: m, the goal's distance is uniform between. widest: rad, its bearing is uniform within +-this.
    """

    near: float = 1.0
    far: float = 2.0
    widest: float = float(np.radians(60.0))

    def initial_state(self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None) -> Floats:
        """See the class."""
        drawn = streams.uniform(2, mask)
        distance = self.near + (self.far - self.near) * drawn[:, 0]
        bearing = self.widest * (2.0 * drawn[:, 1] - 1.0)
        state = np.zeros((len(drawn), self.n_state))
        state[:, 0], state[:, 1] = -distance * np.cos(bearing), -distance * np.sin(bearing)
        return state


def goal_cost(x: Any, u: Any) -> Any:
    """The cost of the module: (..., 3), (..., 2) -> (...); numpy and torch."""
    place = x[..., 0] ** 2 + x[..., 1] ** 2 + 0.1 * x[..., 2] ** 2
    return place + 0.01 * u[..., 0] ** 2 + 0.001 * u[..., 1] ** 2


def base_task(condition: dict[str, Any], **parameters: Any) -> Task:
    """The environment of a condition."""
    kwargs: dict[str, Any] = {"components": list(SHOWN), **parameters}
    if not condition.get("anywhere"):
        kwargs["system"] = f"{HERE}:BaseBeforeGoal"
    noise = (("ObservationNoise", {"std": ODOMETRY}),) if condition.get("noisy") else ()
    return Task("beliefgym/MobileBase-v0", kwargs, noise)


def run(request: Request) -> Report:
    """Tune, then run both arms at every seed."""
    return compare(
        request,
        "control-base",
        f"{HERE}:run_cell",
        {name: {"version": VERSION, "condition": condition} for name, condition in CONDITIONS.items()},
        GRID,
        DAD_HORIZONS,
        CLAIMS,
        TUNING_SEEDS,
        {name: plan_cost(condition) for name, condition in CONDITIONS.items()},
        "plan on the true model",
        (__doc__ or "").split("\n\n", 1)[1].strip().replace("\n", " "),
        NOTES,
    )


def run_cell(cell: Any, extra: Any) -> dict[str, Any]:
    """One or several runs of the loop: {"runs": [one for each setting and seed]}."""
    condition = cell["condition"]
    task = base_task(condition)
    held_out = _law_trajectories(base_task({**condition, "noisy": False}), 30, HELD_OUT_SEED)
    runs = []
    for setting, seed in product(cell["settings"], cell["seeds"]):
        k_forward, k_turn = setting["law"]
        agent = DaDControl(
            task,
            seed=seed,
            dad=cell["dad"],
            regressor=_regressor(condition["degree"], setting["alpha"]),
            dad_iterations=DAD_ITERATIONS,
            dad_horizon=setting["dad_horizon"],
            synthesis=OpenLoopSynthesis(ProportionalLaw(k_forward=k_forward, k_turn=k_turn), TRIAL_STEPS),
            cost=goal_cost,
            target=(np.zeros(3), np.zeros(2)),
            trial_steps=TRIAL_STEPS,
            exploration=Exploration(hold=HOLD),
            act_with="last",
        )
        runs.append(run_loop(agent, cell["iterations"], held_out, TRIAL_STEPS))
    return {"runs": runs}


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


@dataclass
class _Law:
    """`ProportionalLaw` with feedback, as a policy."""

    law: ProportionalLaw
    coordinates: Coordinates

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[Floats, Any]:
        return self.law(self.coordinates.encode(observation)).astype(np.float32), state


@dataclass
class _Replay:
    """Actions (n, T, m) one after the other."""

    actions: Floats

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[Floats, Any]:
        t = state or 0
        return self.actions[:, t].astype(np.float32), t + 1


COORDINATES = Coordinates.of(SHOWN)


def _law_trajectories(task: Task, n: int, seed: int) -> Sequences:
    x, u = run_fresh(_Law(ProportionalLaw(k_turn=1.0), COORDINATES), task, COORDINATES, n, TRIAL_STEPS, seed)
    return Sequences.from_observations(x, actions=u)


def plan_cost(condition: dict[str, Any]) -> float:
    """Mean cost on the test starts of the plans that the law makes on the true system without noise."""
    run_on = partial(run_fresh, coordinates=COORDINATES, n=TEST_TRIALS, steps=TRIAL_STEPS, seed=TEST_SEED)
    quiet = base_task({**condition, "noisy": False}, actuation_noise_std=0.0)
    _, plan = run_on(_Law(ProportionalLaw(), COORDINATES), quiet)
    x, u = run_on(_Replay(plan), base_task(condition))
    return float(goal_cost(x[:, :-1], u).sum(axis=1).mean())


def _regressor(degree: int, alpha: float) -> Ridge | PolynomialRidge:
    return Ridge(alpha=alpha) if degree == 1 else PolynomialRidge(degree=degree, alpha=alpha)


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
