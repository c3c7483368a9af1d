"""`beliefgym reproduce control-base`: the thesis's Fig. 3.13, open-loop control of a differential-drive base.

As in Sec. 3.2.3: the state is the goal's place in the robot's frame and the heading (3), the control the speed and the
turning rate (2); the actions of a whole trial are found by simulating the learned model with a proportional controller,
and run open-loop. The real Videre Erratic is replaced by the simulated base with motors that lag, which its state does
not show, and noisy actuation; the goal is 2 m ahead and 1.5 m to the left of where each trial starts. The data begin
with a random exploratory trial. The ridge model cannot hold that the goal turns in the robot's frame (a product of
turning rate and place); products of inputs can, as the second panel has them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

from beliefgym.agents.dad_control import DaDControl
from beliefgym.agents.exploration import Exploration
from beliefgym.agents.policy_synthesis import OpenLoopSynthesis
from beliefgym.envs.planning.open_loop import ProportionalLaw
from beliefgym.learning import PolynomialRidge, Ridge
from beliefgym.scripts.reproductions.control_loop import Comparison, Panel, run_loop
from beliefgym.scripts.reproductions.report import Report, Request
from beliefgym.wrappers.task import Task

SHOWN = ["goal_forward", "goal_left", "cos_theta", "sin_theta"]
START = [-2.0, -1.5, 0.0]  # the goal is 2 m ahead and 1.5 m to the left
TASK = Task("beliefgym/MobileBase-v0", {"start_pose": START}, (("PartialObservation", {"keep": SHOWN}),))
TRIAL_STEPS, TEST_TRIALS = 100, 20  # 10 s
LAW = ProportionalLaw()
GRID = [{"alpha": alpha} for alpha in (1e-6, 1e-3, 1e-1)]
EXPERIMENT = Comparison(
    name="control-base",
    function=f"{__name__}:run_cell",
    panels={
        "ridge": Panel({"version": 1, "regressor": "ridge"}, GRID, "DaD far below DAgger only", True),
        "ridge with products of inputs": Panel({"version": 1, "regressor": "quadratic"}, GRID, "", False),
    },
    iterations=10,
    tuning_iterations=8,
    tuning_seeds=(100, 101, 102, 103, 104),
    dad_horizons=(5, 10, 20),
)


@dataclass(frozen=True)
class GoalDistance:
    """c = forward^2 + left^2 + effort |u|^2 of coordinates (forward, left, ..) in m: (..., d), (..., m) -> (...)."""

    effort: float = 0.01

    def __call__(self, x: Any, u: Any) -> Any:
        """See the class."""
        return x[..., 0] ** 2 + x[..., 1] ** 2 + self.effort * (u[..., 0] ** 2 + u[..., 1] ** 2)


def run(request: Request) -> Report:
    """Tune, then run both arms."""
    return EXPERIMENT.report(
        request,
        __doc__ or "",
        "Cumulative cost of each iteration's open-loop policy on 20 fresh trials, mean and standard error over seeds "
        "as a share of the panel's highest (after Fig. 3.13).",
        {"trial_steps": TRIAL_STEPS, "test_trials": TEST_TRIALS, "task": TASK.to_dict()},
    )


def run_cell(cell: Any, extra: Any) -> dict[str, Any]:
    """One run of the loop."""
    agent = DaDControl(
        TASK,
        seed=cell["seed"],
        dad=cell["dad"],
        dad_horizon=cell["dad_horizon"],
        regressor=(Ridge if cell["regressor"] == "ridge" else PolynomialRidge)(**cell["settings"]),
        synthesis=OpenLoopSynthesis(law=LAW, horizon=TRIAL_STEPS),
        cost=GoalDistance(),
        trial_steps=TRIAL_STEPS,
        exploration=Exploration("random", hold=5),
        act_with="last",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return run_loop(agent, cell["iterations"], TEST_TRIALS, TRIAL_STEPS)
