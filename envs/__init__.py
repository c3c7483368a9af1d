"""Physical systems, their Gymnasium environments and registration."""

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.cart_pole_balance import CartPoleBalance
from beliefgym.envs.collect import collect
from beliefgym.envs.env import SystemEnv
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.registration import register_all, register_system, registered_ids
from beliefgym.envs.simulation import NonFiniteError
from beliefgym.envs.system import System
from beliefgym.envs.vector_env import SystemVectorEnv

__all__ = [
    "CartPole",
    "CartPoleBalance",
    "NonFiniteError",
    "Pendulum",
    "System",
    "SystemEnv",
    "SystemVectorEnv",
    "collect",
    "register_all",
    "register_system",
    "registered_ids",
]
