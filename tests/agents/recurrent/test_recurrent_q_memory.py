"""`RecurrentQSARSA` learns to remember: slow, run by `make test-slow`."""

import pytest

from beliefgym.agents import evaluate
from beliefgym.agents.recurrent.q_sarsa import RecurrentQSARSA

pytestmark = pytest.mark.slow

USUAL = {
    "n_envs": 16,
    "rollout_steps": 16,
    "reuse": 8,
    "n_batches": 4,
    "hidden_size": 16,
    "width": 16,
    "gamma": 0.9,
    "learning_rate": "linear:2e-2",
}
LETTER = {"average": 0.0, "reuse": 1, "bootstrap": "taken", "gradient": "residual", "n_steps": 4}


@pytest.mark.parametrize(
    "options",
    [{}, {"cell": "gru", "auxiliary": {"predictive_rewards": {"weight": 0.1, "k": 4}}}, LETTER],
    ids=["lstm", "gru", "by residuals"],
)
def test_what_was_seen_at_an_episodes_start_is_remembered_at_its_end(cue, options):
    """All three came to 1.0 at seed 0. No policy without memory has more than 0.5."""
    agent = RecurrentQSARSA(cue, 0, **{**USUAL, **options}).learn(10_000)
    assert evaluate(agent, cue, n_episodes=200, seed=1000).mean > 0.9


def test_without_memory_it_is_not(cue):
    """A deviation of the mean of 200 is 0.035."""
    agent = RecurrentQSARSA(cue, 0, **{**USUAL, "cell": "none"}).learn(2_000)
    assert evaluate(agent, cue, n_episodes=200, seed=1000).mean < 0.65
