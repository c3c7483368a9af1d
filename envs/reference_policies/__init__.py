"""Trained full-state policies that stand in for an expert where no planner is at hand, one file pair each."""

from beliefgym.envs.reference_policies.controller import ReferenceController
from beliefgym.envs.reference_policies.policy import (
    MLPPolicy,
    load_policy,
    reference_path,
    reference_policy,
)

__all__ = ["MLPPolicy", "ReferenceController", "load_policy", "reference_path", "reference_policy"]
