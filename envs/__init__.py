"""Physical systems, their Gymnasium environments and registration."""

from beliefgym.envs.baxter import BaxterReach
from beliefgym.envs.baxter_hand import BaxterReachHand
from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.cart_pole_balance import CartPoleBalance
from beliefgym.envs.catalogue import register_all
from beliefgym.envs.collect import collect
from beliefgym.envs.double_pendulum import DoublePendulum
from beliefgym.envs.env import SystemEnv
from beliefgym.envs.helicopter import Helicopter
from beliefgym.envs.helicopter_competition import HelicopterCompetition
from beliefgym.envs.helicopter_funnel import HelicopterFunnel
from beliefgym.envs.locomotion import (
    HalfCheetahEnv,
    HopperEnv,
    InvertedPendulumEnv,
    SwimmerEnv,
    Walker2dEnv,
)
from beliefgym.envs.mico import MicoLift
from beliefgym.envs.mobile_base import MobileBase, MobileBaseKinematic
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.quadrotor import Quadrotor
from beliefgym.envs.registration import register_composed, register_system, registered_ids
from beliefgym.envs.simulation import NonFiniteError
from beliefgym.envs.system import System
from beliefgym.envs.true_state import TrueState
from beliefgym.envs.vector_env import SystemVectorEnv

__all__ = [
    "BaxterReach",
    "BaxterReachHand",
    "CartPole",
    "CartPoleBalance",
    "DoublePendulum",
    "HalfCheetahEnv",
    "Helicopter",
    "HelicopterCompetition",
    "HelicopterFunnel",
    "HopperEnv",
    "InvertedPendulumEnv",
    "MicoLift",
    "MobileBase",
    "MobileBaseKinematic",
    "NonFiniteError",
    "Pendulum",
    "Quadrotor",
    "SwimmerEnv",
    "System",
    "SystemEnv",
    "SystemVectorEnv",
    "TrueState",
    "Walker2dEnv",
    "collect",
    "register_all",
    "register_composed",
    "register_system",
    "registered_ids",
]
