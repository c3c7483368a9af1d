"""`beliefgym reproduce control-cart-pole`: the thesis's Fig. 3.11, DaD+DAgger against DAgger only on the swing-up.

As in Sec. 3.2.3: transition noise, with and without noise on the actuation; one random exploration trial to begin with
and one more in every iteration; a model of differences (Eq. 3.14) by ridge regression; iLQR from an initial trajectory
of zero actions, one plan a trial, tracked by its gains. Beside the ridge stand random Fourier features, and the same
features under receding-horizon control (without actuation noise). The thesis gives no numbers for noise, dt, cost
weights and horizon: the noise here is 0.01 on each state component and step, and 1 N on the force (a tenth of its
limit); trials last 3 s at 20 Hz.

Settings are chosen on seeds that no reported run has, for each learner and noise by the same criterion for both arms:
the mean over iterations of the cost on test starts.
"""

from __future__ import annotations

import warnings
from itertools import product
from typing import Any

from beliefgym.agents.dad_control import DaDControl
from beliefgym.agents.policy_synthesis import RecedingHorizonSynthesis
from beliefgym.learning import RandomFourierRidge, Ridge
from beliefgym.scripts.reproductions.control_loop import Comparison, Panel
from beliefgym.scripts.reproductions.control_swing_up import TRIAL_STEPS, swing_up_task, try_fresh_starts
from beliefgym.scripts.reproductions.report import Report, Request

TEST_TRIALS = 10
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


def _panel(learner: str, noise: str) -> Panel:
    regressor, controller = LEARNERS[learner]
    quiet = noise == "without actuation noise"
    return Panel(
        {
            "version": 1,
            "regressor": regressor,
            "controller": controller,
            "actuation_noise": NOISES[noise],
            "state_noise": STATE_NOISE,
        },
        GRID[regressor],
        "DaD below DAgger only" if quiet else "a smaller gain",
        quiet,
    )


EXPERIMENT = Comparison(
    name="control-cart-pole",
    function=f"{__name__}:run_cell",
    panels={
        f"{learner}, {noise}": _panel(learner, noise)
        for learner, noise in product(LEARNERS, NOISES)
        if (learner, noise) != ("random Fourier features, MPC", "with actuation noise")
    },
    iterations=8,
    tuning_iterations=5,
    tuning_seeds=(100, 101),
    dad_horizons=(3, 10),
)


def run(request: Request) -> Report:
    """Tune, then run both arms."""
    return EXPERIMENT.report(
        request,
        __doc__ or "",
        "Cumulative cost of each iteration's policy on 10 fresh starts, mean and standard error over seeds as a share "
        "of the panel's highest (after Fig. 3.11).",
        {
            "trial_steps": TRIAL_STEPS,
            "test_trials": TEST_TRIALS,
            "state_noise_std": STATE_NOISE,
            "actuation_noise_std_N": NOISES,
        },
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
