"""What acts: experts, baselines and learned agents, all in Stable-Baselines3's face."""

from beliefgym.agents.agent import Agent
from beliefgym.agents.evaluation import Evaluation, evaluate
from beliefgym.agents.expert import Expert
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

__all__ = [
    "Agent",
    "AgentSpec",
    "Evaluation",
    "Expert",
    "RandomAgent",
    "SB3Agent",
    "agent_specs",
    "evaluate",
    "find_agent",
    "load_agent",
    "make_agent",
    "register_agent",
]
