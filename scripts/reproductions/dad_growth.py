"""`beliefgym reproduce dad-growth`: Theorems 3.1.1 and 3.1.3 made visible.

Theorem 3.1.1: a one-step model with error at most eps and Lipschitz constant L predicts T steps with error at most
sum_{t<=T} L^t eps: exponential in T for L > 1, linear for L = 1, bounded for L < 1, and this is tight. The left plot is
the thesis's own example (Eq. 3.6): x_{t+1} = A x_t with A = 1 fitted as A_hat, one error eps a step.

Theorem 3.1.3: with a regularised squared loss over a predictor linear in features, DaD finds a model whose summed error
is at most O(T eps_N). The other plots are learned: a ridge regression on cubic monomials of the free pendulum's
observation, once fitted to single steps and once by DaD.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefgym.learning import DataAsDemonstrator, PolynomialRidge
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_data import VERSION, simulated_parts
from beliefgym.scripts.reproductions.dad_figures import (
    DAD,
    FAINT,
    SINGLE,
    STEPS,
    STYLE,
    motion_figure,
    plain,
    save,
)
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

Array = NDArray[np.float64]
SETTING = {
    "data_version": VERSION,
    "n": 300,
    "n_steps": 50,
    "degree": 3,
    "alpha": 1e-6,
    "n_iterations": 40,
    "horizon": 10,
}
MOTION = "dad-growth-pendulum.png"
EARLY = 10  # steps over which the single-step model's error grows before it saturates
COLUMNS = ("what", "single step", "DaD", "expected", "meets")


def run(request: Request) -> Report:
    """Fit both models at each seed and describe how their errors grow."""
    cells = {
        f"pendulum-{seed}": {"seed": seed, **SETTING}
        for seed in range(request.seed, request.seed + request.seeds)
    }
    folder = request.folder / "cells" / "dad-growth"
    found = run_cells(f"{__name__}:cell", cells, folder, request.jobs, request.told)
    results = [result for result in found.values() if "failed" not in result]
    if not results:
        raise ValueError(f"no seed could be run: {next(iter(found.values()))['failed']}")
    curves = {arm: np.array([result[arm] for result in results]) for arm in ("single", "dad")}
    caption = (
        "Left: Theorem 3.1.1's own example. Middle and right: median over seeds of the error after t steps, "
        "logarithmic and linear; thin lines are seeds."
    )
    with matplotlib.rc_context(STYLE):
        save(growth_figure(curves), request.folder / "dad-growth.png")
        save(motion_figure({k: np.array(v) for k, v in results[0]["shown"].items()}), request.folder / MOTION)
    steps = ", ".join(map(str, STEPS))
    figures = {
        "dad-growth.png": caption,
        MOTION: f"A test trajectory at steps {steps} (after Fig. 3.2); the dot is the tip as predicted, on its circle "
        "or off it.",
    }
    return Report(ABOUT, COLUMNS, rows(curves, results), SETTING, figures, NOTES)


ABOUT = (
    "Growth of the prediction error with the horizon: free pendulum, 300 trajectories of 50 steps of 0.05 s, ridge "
    "regression on cubic monomials (linear in features with a regularised squared loss, as Theorem 3.1.3 asks for); "
    "DaD with training rollouts of 10 steps, the best of 40 iterations on validation trajectories."
)
NOTES = [
    "Errors are medians over the test trajectories, so that the few rollouts of the single-step model that blow up do "
    "not decide. A power of 1 is linear growth."
]


def rows(curves: dict[str, Array], results: list[dict[str, Any]]) -> list[Row]:
    """Rates, powers and errors, each with an interval over seeds."""
    rate = {
        arm: Interval.of([_slope(np.arange(1, EARLY + 1), c[:EARLY]) for c in curves[arm]]) for arm in curves
    }
    steps = np.log(np.arange(1, curves["dad"].shape[1] + 1))
    power = {
        "single": Interval.of([_slope(steps[:EARLY], c[:EARLY]) for c in curves["single"]]),
        "dad": Interval.of([_slope(steps, c) for c in curves["dad"]]),
    }
    last = {arm: Interval.of(curves[arm][:, -1]) for arm in curves}
    total = {arm: Interval.of(curves[arm].sum(axis=1)) for arm in curves}
    lipschitz = {arm: Interval.of([result[f"lipschitz_{arm}"] for result in results]) for arm in curves}
    return [
        {
            "what": f"exponential rate of the error over steps 1 to {EARLY}, 1/step",
            "single step": rate["single"].text(),
            "DaD": rate["dad"].text(),
            "expected": "DaD's smaller",
            "meets": rate["dad"].high < rate["single"].low,
        },
        {
            "what": f"power p of error ~ t^p (single step: to step {EARLY}; DaD: to step 50)",
            "single step": power["single"].text(),
            "DaD": power["dad"].text(),
            "expected": "DaD's at most 1",
            "meets": power["dad"].mean <= 1.0,
        },
        {
            "what": "error after 50 steps",
            "single step": last["single"].text(),
            "DaD": last["dad"].text(),
            "expected": "DaD's smaller",
            "meets": last["dad"].high < last["single"].low,
        },
        {
            "what": "error summed over 50 steps",
            "single step": total["single"].text(),
            "DaD": total["dad"].text(),
            "expected": "DaD's smaller",
            "meets": total["dad"].high < total["single"].low,
        },
        {
            "what": "stretch of a step at its own predictions (estimate of L), 99th percentile",
            "single step": lipschitz["single"].text(),
            "DaD": lipschitz["dad"].text(),
            "expected": "",
            "meets": None,
        },
    ]


def cell(cell: dict[str, Any], extra: Any) -> dict[str, Any]:
    """Errors after each step of both models at one seed."""
    train, validation, test = simulated_parts("pendulum", cell["seed"], n=cell["n"], n_steps=cell["n_steps"])
    result: dict[str, Any] = {}
    shown = int(np.argsort(test.observations[:, 0, 0])[len(test) // 2])  # starts half way up
    last = max(STEPS)
    result["shown"] = {"truth": test.observations[shown, : last + 1].tolist()}
    for arm, options in (
        ("single", {"n_iterations": 0}),
        ("dad", {"n_iterations": cell["n_iterations"], "horizon": cell["horizon"]}),
    ):
        regressor = PolynomialRidge(degree=cell["degree"], alpha=cell["alpha"])
        model = DataAsDemonstrator(regressor, target="next", **options).fit(train, validation)
        predicted = _quiet_rollout(model, test.observations[:, 0], cell["n_steps"])
        error = np.linalg.norm(predicted[:, 1:] - test.observations[:, 1:], axis=2)
        result["shown"][arm] = predicted[shown, : last + 1].tolist()
        result[arm] = np.median(error, axis=0).tolist()
        result[f"lipschitz_{arm}"] = float(
            np.percentile(_stretch(model, predicted[:, :-1].reshape(-1, 3)), 99)
        )
        result[f"eps_{arm}"] = model.single_step_error(test)
    return result


def growth_figure(curves: dict[str, Array]) -> Figure:
    """The theorem's example, and the learned models' errors on two scales."""
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    example, logarithmic, linear = figure.subplots(1, 3)
    t, eps = np.arange(0, 51), 0.01
    for a, text in ((1.1, "exponential"), (1.0, "linear"), (0.9, "bounded")):
        bound = eps * np.cumsum(a**t)
        example.plot(t, bound, color=FAINT, linewidth=4, alpha=0.35)
        example.plot(t, _example(a, eps, len(t)), color=DAD if a == 1.0 else SINGLE, linewidth=1.4)
        example.annotate(
            f"L = {a:g}: {text}", (50, bound[-1]), xytext=(-4, 5), textcoords="offset points", ha="right"
        )
    example.set_yscale("log")
    plain(example, "Theorem 3.1.1 (grey: the bound)", "step", "error")
    for axes in (logarithmic, linear):
        for arm, colour, label in (("single", SINGLE, "single step"), ("dad", DAD, "DaD")):
            steps = np.arange(1, curves[arm].shape[1] + 1)
            axes.plot(steps, curves[arm].T, color=colour, linewidth=0.6, alpha=0.45)
            axes.plot(steps, np.median(curves[arm], axis=0), color=colour, linewidth=2, label=label)
    logarithmic.set_yscale("log")
    plain(logarithmic, "learned pendulum, logarithmic", "step", "error")
    plain(linear, "the same, linear, up to DaD's last", "step", "error")
    linear.set_ylim(0, 1.15 * float(curves["dad"].max()))
    linear.legend(frameon=False, loc="upper left")
    return figure


def _example(a: float, eps: float, n: int) -> Array:
    """Errors of x_hat_{t+1} = a x_hat_t + (1 - a) + eps where x_t = 1: at the truth each step is off by eps."""
    error, errors = 0.0, []
    for _ in range(n):
        error = a * error + eps
        errors.append(error)
    return np.array(errors)


def _slope(x: Array | NDArray[np.int64], error: Array) -> float:
    return float(np.polyfit(x, np.log(error), 1)[0])


def _stretch(model: DataAsDemonstrator, states: Array, size: float = 1e-5) -> Array:
    """|f(x + d) - f(x)| / |d| for a random direction of d at each state."""
    d = np.random.default_rng(0).standard_normal(states.shape)
    d *= size / np.linalg.norm(d, axis=1, keepdims=True)
    return np.asarray(np.linalg.norm(model.predict(states + d) - model.predict(states), axis=1) / size)


def _quiet_rollout(model: DataAsDemonstrator, starts: Array, n_steps: int) -> Array:
    """Rollouts of which some may diverge; that is the point here."""
    import warnings

    from beliefgym.learning import DivergenceWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        return model.rollout(starts, n_steps)
