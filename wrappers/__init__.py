"""What changes an observation or an action; the forms for vector environments are in `vector`."""

from beliefgym.wrappers.action_history import ActionHistory
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

__all__ = [
    "ActionHistory",
    "DiscreteActions",
    "ObservationDelay",
    "ObservationNoise",
    "ObservationTransform",
    "PartialObservation",
    "TransformObservation",
    "VectorTransformObservation",
    "component_names",
]
