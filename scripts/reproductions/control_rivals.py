"""The rivals of our own agent on the cart-pole swing-up in a handful of trials: PETS, PILCO and model-free SAC.

All run the trials of `control_swing_up` and are tried on its fresh starts: PETS and PILCO after every trial, SAC after
as many as `SAC_TRIALS` says. PETS plans with the stage cost; PILCO searches its policy with its own saturating cost of
the pole's tip; SAC learns from the environment's reward with the settings that it has on this task in the leaderboard,
but from one copy and with the first trial alone as exploration. All are judged by the stage cost.

A cell is {"method": "pets" | "pilco" | "sac", "seed": s, "trials": N, "parameters": {...}}: N trials after the
exploration trial, in an environment with these parameters. Optional: "options" of the agent, "patience" (the cell ends
after so many solved tests in a row; none by default), "tests" (starts of a test).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch

from beliefgym.agents.agent import Agent
from beliefgym.agents.hyperparameters import hyperparameters
from beliefgym.scripts.reproductions.cells import Cell
from beliefgym.scripts.reproductions.control_swing_up import (
    ENV_ID,
    TEST_TRIALS,
    TRIAL_STEPS,
    swing_up_task,
    try_fresh_starts,
)

METHODS = ("pets", "pilco", "sac")
SAC_TRIALS = (1, 6, 20, 50, 100, 150, 200, 300, 400)  # trials in all, after which SAC is tried


def run_cell(cell: Cell, extra: Any = None) -> dict[str, Any]:
    """One method, one seed.

    Returns:
        "trials" (the trials so far, the exploration trial among them), "steps" (of interaction so far), "upright"
        (share of the test trials) and "costs" (their mean), each at every test; "trial_costs" (stage cost of each
        trial; empty for SAC, whose trials are not kept and count as 60 steps each); "solved_after" (trials at the first
        solved test, or None); "seconds" of processor time, the tests among them.

    Raises:
        ValueError: an unknown method.
    """
    del extra
    torch.set_num_threads(1)
    method, seed, trials = cell["method"], int(cell["seed"]), int(cell["trials"])
    if method not in METHODS:
        raise ValueError(f"expected method to be one of {', '.join(METHODS)}, got {method!r}")
    parameters, options = dict(cell.get("parameters", {})), dict(cell.get("options", {}))
    began = time.process_time()
    agent = _agent(method, seed, parameters, options)
    task = swing_up_task(parameters)  # without SAC's limit, at which a test's last state would be gone
    tests = [k for k in SAC_TRIALS if k <= trials + 1] if method == "sac" else list(range(1, trials + 2))
    result: dict[str, Any] = {"trials": [], "steps": [], "upright": [], "costs": [], "trial_costs": []}
    solved_in_a_row, done, solved_after = 0, 0, None
    for k in tests:
        agent.learn((k - done) * TRIAL_STEPS)
        done = k
        test = try_fresh_starts(agent, task, n=int(cell.get("tests", TEST_TRIALS)))
        history: list[Mapping[str, Any]] = getattr(agent, "history", [])
        result["trials"].append(k)
        result["steps"].append(sum(trial["steps"] for trial in history) if history else k * TRIAL_STEPS)
        result["upright"].append(float(test.upright.mean()))
        result["costs"].append(float(test.costs.mean()))
        result["trial_costs"] = [trial["cost"] for trial in history]
        solved_after = k if solved_after is None and test.solved else solved_after
        solved_in_a_row = solved_in_a_row + 1 if test.solved else 0
        if solved_in_a_row == cell.get("patience"):
            break
    return {**result, "solved_after": solved_after, "seconds": time.process_time() - began}


def _agent(method: str, seed: int, parameters: dict[str, Any], options: dict[str, Any]) -> Agent:
    if method == "pets":
        from beliefgym.agents.probabilistic_ensemble import ProbabilisticEnsembleControl

        return ProbabilisticEnsembleControl(
            swing_up_task(parameters), seed, **{"trial_steps": TRIAL_STEPS, **options}
        )
    if method == "pilco":
        from beliefgym.agents.pilco import PILCO

        return PILCO(swing_up_task(parameters), seed, **{"trial_steps": TRIAL_STEPS, **options})
    from beliefgym.agents.sb3_agent import SB3Agent

    settings = hyperparameters("SAC", ENV_ID)
    settings["n_envs"] = 1
    settings["arguments"] = {**settings["arguments"], "learning_starts": TRIAL_STEPS}
    return SB3Agent(
        swing_up_task({**parameters, "max_episode_steps": TRIAL_STEPS}), seed, **{**settings, **options}
    )
