"""What changes an observation or an action; the forms for vector environments are in `vector`."""

from beliefgym.wrappers.action_history import ActionHistory
from beliefgym.wrappers.belief_observation import BeliefObservation
from beliefgym.wrappers.components import component_names
from beliefgym.wrappers.discrete_actions import DiscreteActions
from beliefgym.wrappers.observation_delay import ObservationDelay
from beliefgym.wrappers.observation_noise import ObservationNoise
from beliefgym.wrappers.partial_observation import PartialObservation
from beliefgym.wrappers.transform import (
    ObservationTransform,
    TransformObservation,
    VectorTransformObservation,
)

from beliefgym.wrappers.sb3 import SB3VecEnv  # isort: skip
from beliefgym.wrappers.task import Task  # isort: skip  (it uses the names above)

__all__ = [
    "ActionHistory",
    "BeliefObservation",
    "DiscreteActions",
    "ObservationDelay",
    "ObservationNoise",
    "ObservationTransform",
    "PartialObservation",
    "SB3VecEnv",
    "Task",
    "TransformObservation",
    "VectorTransformObservation",
    "component_names",
]
