"""The rigid-body equations of envs/rigid_body.py, for planners."""

from beliefgym.envs.rigid_body import Frames, RigidArm

__all__ = ["Frames", "RigidArm"]
