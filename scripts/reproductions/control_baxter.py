"""`beliefgym reproduce control-arm`: the thesis's Fig. 3.14, a seven-joint arm moved to a target configuration.

As in Sec. 3.2.3: the simulated Baxter-like arm in torque control without gravity compensation, a state of 14 joint
angles and velocities, a ridge model, the steady-state LQR of its linearisation, and an epsilon-random controller for
exploration. The regulator's cost knows the target angles alone (Eq. 3.15: squared angle errors, velocities and
torques); the torque that holds the target has to be learned, as the constant of the linear model. The second panel has
actuators four times as noisy as the environment's own.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from beliefgym.agents.dad_control import DaDControl
from beliefgym.agents.exploration import Exploration
from beliefgym.agents.policy_synthesis import RegulatorSynthesis
from beliefgym.envs.baxter import NEUTRAL
from beliefgym.learning import Ridge
from beliefgym.scripts.reproductions.control_loop import Comparison, Panel, run_loop
from beliefgym.scripts.reproductions.report import Report, Request
from beliefgym.wrappers.task import Task

TRIAL_STEPS, TEST_TRIALS = 100, 20  # 5 s
EXPLORATION = Exploration("epsilon", std=0.2, epsilon=0.3, hold=2)
TARGET = (np.concatenate([NEUTRAL, np.zeros(7)]), np.zeros(7))
NOISE = (0.5, 1.0, 0.5, 0.5, 0.15, 0.15, 0.15)  # N m, the environment's own
NOISES = {"actuation noise as registered": 1.0, "actuation noise four times that": 4.0}
GRID = [{"alpha": alpha} for alpha in (1e-6, 1e-4, 1e-2)]
EXPERIMENT = Comparison(
    name="control-arm",
    function=f"{__name__}:run_cell",
    panels={
        f"ridge, {noise}": Panel({"version": 1, "actuation_noise": std}, GRID, "a small gain", False)
        for noise, std in NOISES.items()
    },
    iterations=10,
    tuning_iterations=8,
    tuning_seeds=(100, 101, 102),
    dad_horizons=(3, 10),
)


@dataclass(frozen=True)
class ReachCost:
    """c = |q - q*|^2 + rate |v|^2 + effort |u|^2, of x = (q, v): (..., 14), (..., 7) -> (...).

    Args:
        rate: s^2. effort: rad^2/(N m)^2.
    """

    rate: float = 0.1
    effort: float = 1e-6

    def __call__(self, x: Any, u: Any) -> Any:
        """See the class."""
        total = 0.0
        for joint, angle in enumerate(NEUTRAL):
            total = (
                total
                + (x[..., joint] - float(angle)) ** 2
                + self.rate * x[..., 7 + joint] ** 2
                + self.effort * u[..., joint] ** 2
            )
        return total


def run(request: Request) -> Report:
    """Tune, then run both arms."""
    return EXPERIMENT.report(
        request,
        __doc__ or "",
        "Cumulative cost of each iteration's policy on 20 fresh starts, mean and standard error over seeds as a share "
        "of the panel's highest (after Fig. 3.14).",
        {"trial_steps": TRIAL_STEPS, "test_trials": TEST_TRIALS, "noise_N_m": NOISE, "noises": NOISES},
    )


def run_cell(cell: Any, extra: Any) -> dict[str, Any]:
    """One run of the loop."""
    agent = DaDControl(
        Task(
            "beliefgym/BaxterReach-v0",
            {"actuation_noise_std": [cell["actuation_noise"] * std for std in NOISE]},
        ),
        seed=cell["seed"],
        dad=cell["dad"],
        dad_horizon=cell["dad_horizon"],
        regressor=Ridge(**cell["settings"]),
        synthesis=RegulatorSynthesis(),
        cost=ReachCost(),
        target=TARGET,
        trial_steps=TRIAL_STEPS,
        exploration_trials=1,
        exploration=EXPLORATION,
        act_with="last",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return run_loop(agent, cell["iterations"], TEST_TRIALS, TRIAL_STEPS)
