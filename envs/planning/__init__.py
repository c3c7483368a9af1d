"""Planners and experts: batched optimal control on a `System`'s true model. They know no Gymnasium."""

from beliefgym.envs.planning.action_tree import TreePlans, tree_search
from beliefgym.envs.planning.arm import (
    ReachController,
    hand_reach_expert,
    inverse_kinematics,
    joint_reach_expert,
)
from beliefgym.envs.planning.cart_pole import CartPoleController, cart_pole_expert
from beliefgym.envs.planning.dynamic_programming import GridController, pendulum_expert, value_iteration
from beliefgym.envs.planning.grid import Axis, GridValue
from beliefgym.envs.planning.ilqr import ILQR, ILQRSolution
from beliefgym.envs.planning.linearisation import expand_cost, linearise
from beliefgym.envs.planning.mico import PayloadFeedforward, mico_expert

__all__ = [
    "ILQR",
    "Axis",
    "CartPoleController",
    "GridController",
    "GridValue",
    "ILQRSolution",
    "PayloadFeedforward",
    "ReachController",
    "TreePlans",
    "cart_pole_expert",
    "expand_cost",
    "hand_reach_expert",
    "inverse_kinematics",
    "joint_reach_expert",
    "linearise",
    "mico_expert",
    "pendulum_expert",
    "tree_search",
    "value_iteration",
]
