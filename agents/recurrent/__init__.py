"""Recurrent agents that learn action values: Recurrent-Q SARSA, its auxiliary objectives, its siblings and rivals."""

from beliefgym.agents.recurrent.auxiliary import (
    AuxiliaryObjective,
    Dynamics,
    LatentSelfPrediction,
    PredictiveRewards,
    PredictiveState,
    PredictiveValues,
)
from beliefgym.agents.recurrent.collector import RolloutCollector
from beliefgym.agents.recurrent.drqn import DRQN
from beliefgym.agents.recurrent.memory import Memory
from beliefgym.agents.recurrent.network import HistoryEncoder, RecurrentQNetwork
from beliefgym.agents.recurrent.pqn import RecurrentPQN
from beliefgym.agents.recurrent.q_agent import RecurrentQAgent
from beliefgym.agents.recurrent.q_sarsa import RecurrentQSARSA
from beliefgym.agents.recurrent.r2d2 import R2D2
from beliefgym.agents.recurrent.recurrent_agent import DivergenceError, RecurrentAgent
from beliefgym.agents.recurrent.sac import RecurrentSAC
from beliefgym.agents.recurrent.sarsa_loss import RecurrentSarsaLoss

__all__ = [
    "DRQN",
    "R2D2",
    "AuxiliaryObjective",
    "DivergenceError",
    "Dynamics",
    "HistoryEncoder",
    "LatentSelfPrediction",
    "Memory",
    "PredictiveRewards",
    "PredictiveState",
    "PredictiveValues",
    "RecurrentAgent",
    "RecurrentPQN",
    "RecurrentQAgent",
    "RecurrentQNetwork",
    "RecurrentQSARSA",
    "RecurrentSAC",
    "RecurrentSarsaLoss",
    "RolloutCollector",
]
