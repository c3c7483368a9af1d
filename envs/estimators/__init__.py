"""Filters that know the physics: what can be said of a hint by somebody who has the true equations of motion.

Each is a `HintFilter` of `beliefgym.learning`, so that it stands beside the learned filters in one comparison. Three
know a `System`'s exact dynamics, noise and sensors; the complementary filter knows how a measurement unit turns.
"""

from beliefgym.envs.estimators.complementary import ComplementaryFilter
from beliefgym.envs.estimators.extended import ExtendedKalmanFilter
from beliefgym.envs.estimators.particle import ParticleFilter
from beliefgym.envs.estimators.physics_filter import NumericalError, PhysicsFilter, StateEstimate
from beliefgym.envs.estimators.unscented import UnscentedKalmanFilter

__all__ = [
    "ComplementaryFilter",
    "ExtendedKalmanFilter",
    "NumericalError",
    "ParticleFilter",
    "PhysicsFilter",
    "StateEstimate",
    "UnscentedKalmanFilter",
]
