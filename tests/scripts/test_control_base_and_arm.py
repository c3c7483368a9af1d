"""The base and arm comparisons on tiny runs: what the cells give, and that the arms differ by DaD alone."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from beliefgym.envs.baxter import NEUTRAL, BaxterReach
from beliefgym.scripts.reproductions import control_arm, control_base
from beliefgym.scripts.reproductions.control_base import BaseBeforeGoal

BASE = {"condition": {"degree": 1}, "seeds": [100], "iterations": 2}
BASE |= {"settings": [{"alpha": 1e-4, "law": [1.0, 2.0], "dad_horizon": 5}]}
ARM = {"condition": {"noise": 1.0, "start_range": 0.1}, "seeds": [100], "iterations": 1}
ARM |= {"settings": [{"alpha": 1e-2, "dad_horizon": 2}]}


@pytest.mark.parametrize(("module", "cell"), [(control_base, BASE), (control_arm, ARM)])
def test_a_cell_gives_finite_costs_and_errors_again_and_again(module, cell):
    first = module.run_cell({**cell, "dad": True}, None)["runs"]
    again = module.run_cell({**cell, "dad": True}, None)["runs"]
    assert len(first) == 1
    for name in ("test_costs", "trial_costs", "held_out_errors"):
        assert len(first[0][name]) == cell["iterations"]
        assert np.isfinite(first[0][name]).all()
        assert first[0][name] == again[0][name]


def test_the_arms_share_their_exploration_trial_and_differ_afterwards():
    single, dad = (control_base.run_cell({**BASE, "dad": dad}, None)["runs"][0] for dad in (False, True))
    assert single["test_costs"][0] != dad["test_costs"][0]
    no_rollouts = {**BASE, "settings": [{**BASE["settings"][0], "dad_horizon": 1}], "dad": True}
    # rollouts of one step have no predicted state to correct, so DaD is the single-step model
    assert_allclose(
        control_base.run_cell(no_rollouts, None)["runs"][0]["test_costs"], single["test_costs"], rtol=1e-9
    )


def test_the_goal_lies_ahead_at_every_start():
    env = control_base.base_task({"degree": 1}).make_vec(200)
    observation, _ = env.reset(seed=0)
    env.close()
    forward, left = observation[:, 0], observation[:, 1]
    distance, bearing = np.hypot(forward, left), np.arctan2(left, forward)
    assert distance.min() >= 1.0 - 1e-6
    assert distance.max() <= 2.0 + 1e-6
    assert np.abs(bearing).max() <= np.radians(60.0) + 1e-6
    assert np.abs(bearing).max() > np.radians(50.0)  # the whole cone is used
    assert_allclose(observation[:, 2:], np.tile([1.0, 0.0], (200, 1)), atol=1e-6)
    assert isinstance(env.unwrapped.system, BaseBeforeGoal)


@pytest.mark.parametrize(
    ("cost", "x", "u", "expected"),
    [
        (control_base.goal_cost, [1.0, 2.0, 0.5], [0.5, 1.0], 5.0 + 0.025 + 0.0025 + 0.001),
        # 0.1 rad off at each joint, 1 rad/s, full effort
        (
            control_arm.reach_cost,
            [*(np.add(NEUTRAL, 0.1)), *[1.0] * 7],
            BaxterReach().arm.efforts,
            0.07 + 0.07 + 0.07,
        ),
    ],
)
def test_the_costs_are_those_of_their_docstrings_on_numpy_and_torch(cost, x, u, expected):
    assert_allclose(cost(np.array(x), np.array(u)), expected, rtol=1e-12)
    assert_allclose(float(cost(torch.tensor(np.array(x)), torch.tensor(np.array(u)))), expected, rtol=1e-12)


def test_a_plan_on_the_true_model_costs_less_than_doing_nothing():
    task = control_base.base_task({"degree": 1})
    still = control_base._Replay(np.zeros((20, 50, 2)))
    x, u = control_base.run_fresh(still, task, control_base.COORDINATES, 20, 50, control_base.TEST_SEED)
    assert (
        control_base.plan_cost({"degree": 1}) < 0.5 * control_base.goal_cost(x[:, :-1], u).sum(axis=1).mean()
    )
