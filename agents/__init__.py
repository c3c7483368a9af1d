"""What acts: experts, baselines and learned agents, all in Stable-Baselines3's face."""

from beliefgym.agents.agent import Agent
from beliefgym.agents.belief_policy import BeliefPolicy
from beliefgym.agents.dad_control import DaDControl
from beliefgym.agents.evaluation import Evaluation, evaluate
from beliefgym.agents.expert import Expert
from beliefgym.agents.exploration import Exploration
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

__all__ = [
    "Agent",
    "AgentSpec",
    "BeliefPolicy",
    "DaDControl",
    "Evaluation",
    "Expert",
    "Exploration",
    "OpenLoopSynthesis",
    "ProbabilisticEnsembleControl",
    "RandomAgent",
    "RecedingHorizonSynthesis",
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
