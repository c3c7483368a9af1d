"""Filters of every `action_timing`, fitted once, for the tests that all of them pass."""

import numpy as np
from controlled_systems import linear
from sklearn.base import clone

from beliefgym.learning import Sequences
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_actions import PSIMActions
from beliefgym.learning.psim_conditional import ConditionalPSIM
from beliefgym.learning.psim_hints import InferenceMachineFilter, PSIMHints
from beliefgym.learning.random_fourier import RandomFourierRidge

WAVES = RandomFourierRidge(n_frequencies=20, include_inputs=True, alpha=1e-3, random_state=0)
few = {"n_iterations": 2}
weighed = {"importance": "weighted", "per_decision": True}
choices = {"n_choices": 4, **few}
FILTERS = {
    "plain": PSIMActions(n_future=3, **few),
    "weighted": PSIMActions(n_future=3, truncate=10.0, **weighed, **few),
    "ordinary": PSIMActions(n_future=2, importance="ordinary", truncate=5.0, **few),
    "joint": PSIMActions(n_future=2, state="joint", **weighed, **few),
    "delta": PSIMActions(n_future=2, target="delta", init="teacher", **few),
    "second": PSIMActions(WAVES, n_future=2, features="second", **weighed, **few),
    "choices": PSIMActions(n_future=3, state="joint", **weighed, **choices),
    "conditional": ConditionalPSIM(n_future=3, importance=True, **few),
    "bilinear": ConditionalPSIM(WAVES, n_future=3, effects="bilinear", **few),
    "conditional choices": ConditionalPSIM(n_future=3, importance=True, effects="bilinear", **choices),
    "hints": PSIMHints(n_future=2, use_actions=True, preimage=Ridge(), **few),
    "hints second": PSIMHints(WAVES, n_future=2, features="second", use_actions=True, preimage=WAVES, **few),
    "hints choices": PSIMHints(n_future=2, use_actions=True, preimage="belief", **choices),
    "machine": InferenceMachineFilter(use_actions=True, preimage=Ridge(), **few),
    "machine choices": InferenceMachineFilter(WAVES, use_actions=True, preimage=Ridge(), **choices),
    "without": PSIM(n_future=3, **few),
    "hints without": PSIMHints(n_future=2, preimage=Ridge(), **few),
}
PRESENT = [name for name, one in FILTERS.items() if one.action_timing == "present"]
PREVIOUS = [name for name, one in FILTERS.items() if one.action_timing == "previous"]
WITH_ACTIONS = PRESENT + PREVIOUS
FITTED = {}


def recorded(name, n, n_steps=14, seed=0, lengths=None):
    """Trajectories with hints, names, units and offsets; the fourth of the four choices is never taken."""
    data = linear(n, n_steps, seed, feedback=0.4, mean=0.3, lengths=lengths)
    actions, log_probs = 7.0 * data.actions + 2.0, data.action_log_probs - np.log(7.0)
    if FILTERS[name].n_choices:
        actions, log_probs = (
            np.digitize(data.actions, [-0.3, 0.8]).astype(float),
            np.log(0.3 + 0.0 * log_probs),
        )
    return Sequences(
        2.0 * data.observations + 30.0,
        actions,
        data.rewards,
        lengths=data.lengths,
        hints=data.hints,
        action_log_probs=log_probs,
        observation_names=["position"],
        action_names=["force"],
    )


def fitted(name):
    """Fitted once for all tests, which do not change it."""
    if name not in FITTED:
        FITTED[name] = clone(FILTERS[name]).fit(recorded(name, 40), recorded(name, 10, seed=1))
    return FITTED[name]
