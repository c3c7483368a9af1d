"""What acts: experts, baselines and learned agents, all in Stable-Baselines3's face."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from beliefgym.agents.agent import Agent
from beliefgym.agents.belief_policy import BeliefPolicy
from beliefgym.agents.dad_control import DaDControl
from beliefgym.agents.evaluation import Evaluation, evaluate
from beliefgym.agents.expert import Expert
from beliefgym.agents.exploration import Exploration
from beliefgym.agents.filter_expert import FilterExpert
from beliefgym.agents.policy_synthesis import (
    OpenLoopSynthesis,
    RecedingHorizonSynthesis,
    RegulatorSynthesis,
)
from beliefgym.agents.probabilistic_ensemble import ProbabilisticEnsembleControl
from beliefgym.agents.random_agent import RandomAgent
from beliefgym.agents.registry import (
    AgentSpec,
    agent_specs,
    find_agent,
    load_agent,
    make_agent,
    register_agent,
)
from beliefgym.agents.sb3_agent import SB3Agent
from beliefgym.agents.sb3_log_probs import with_log_probs
from beliefgym.agents.system_identification import SystemIdentification

if TYPE_CHECKING:
    from beliefgym.agents.recurrent import (
        DRQN,
        R2D2,
        RecurrentPQN,
        RecurrentQSARSA,
        RecurrentSAC,
        RecurrentSarsaLoss,
    )

__all__ = [
    "DRQN",
    "R2D2",
    "Agent",
    "AgentSpec",
    "BeliefPolicy",
    "DaDControl",
    "Evaluation",
    "Expert",
    "Exploration",
    "FilterExpert",
    "OpenLoopSynthesis",
    "ProbabilisticEnsembleControl",
    "RandomAgent",
    "RecedingHorizonSynthesis",
    "RecurrentPQN",
    "RecurrentQSARSA",
    "RecurrentSAC",
    "RecurrentSarsaLoss",
    "RegulatorSynthesis",
    "SB3Agent",
    "SystemIdentification",
    "agent_specs",
    "evaluate",
    "find_agent",
    "load_agent",
    "make_agent",
    "register_agent",
    "with_log_probs",
]

_RECURRENT = ("DRQN", "R2D2", "RecurrentPQN", "RecurrentQSARSA", "RecurrentSAC", "RecurrentSarsaLoss")


def __getattr__(name: str) -> Any:
    """The recurrent agents, which bring TorchRL with them, when they are asked for."""
    if name in _RECURRENT:
        return getattr(import_module("beliefgym.agents.recurrent"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_RECURRENT})
