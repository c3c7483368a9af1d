"""Physical systems, their Gymnasium environments and registration.

The state estimators are imported when one is asked for: they are filters of `beliefgym.learning`, which need
scikit-learn.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from beliefgym.envs.baxter import BaxterReach
from beliefgym.envs.baxter_hand import BaxterReachHand
from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.cart_pole_balance import CartPoleBalance
from beliefgym.envs.catalogue import register_all
from beliefgym.envs.collect import collect
from beliefgym.envs.double_pendulum import DoublePendulum
from beliefgym.envs.env import SystemEnv
from beliefgym.envs.exploring_policy import EpsilonPolicy, GaussianPolicy
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
from beliefgym.envs.t_maze import TMaze
from beliefgym.envs.true_state import TrueState
from beliefgym.envs.vector_env import SystemVectorEnv

if TYPE_CHECKING:
    from beliefgym.envs.estimators.complementary import ComplementaryFilter
    from beliefgym.envs.estimators.extended import ExtendedKalmanFilter
    from beliefgym.envs.estimators.particle import ParticleFilter
    from beliefgym.envs.estimators.unscented import UnscentedKalmanFilter

__all__ = [
    "BaxterReach",
    "BaxterReachHand",
    "CartPole",
    "CartPoleBalance",
    "ComplementaryFilter",
    "DoublePendulum",
    "EpsilonPolicy",
    "ExtendedKalmanFilter",
    "GaussianPolicy",
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
    "ParticleFilter",
    "Pendulum",
    "Quadrotor",
    "SwimmerEnv",
    "System",
    "SystemEnv",
    "SystemVectorEnv",
    "TMaze",
    "TrueState",
    "UnscentedKalmanFilter",
    "Walker2dEnv",
    "collect",
    "register_all",
    "register_composed",
    "register_system",
    "registered_ids",
]

_ESTIMATORS = {
    "ComplementaryFilter": "complementary",
    "ExtendedKalmanFilter": "extended",
    "ParticleFilter": "particle",
    "UnscentedKalmanFilter": "unscented",
}


def __getattr__(name: str) -> Any:
    """Import the module of an estimator when its name is first asked for."""
    if name not in _ESTIMATORS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.estimators.{_ESTIMATORS[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted([*globals(), *_ESTIMATORS])
