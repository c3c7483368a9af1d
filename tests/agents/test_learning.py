"""Agents learn: slow, run by `make test-slow`. The thresholds are far from what chance gives, and from the best."""

import pytest

from beliefgym.agents import evaluate, make_agent

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("agent", "env_id", "steps", "least"),
    [
        # random policy -1200, expert -140; 10,000 steps gave -180 in both of two settings
        ("sac-stack", "beliefgym/PendulumPosition-v0", 10_000, -400.0),
        # random policy about 15, expert about 170; 80 to 90 at 60,000 steps in four runs
        ("ppo-stack", "beliefgym/CartPoleSwingUpPosition-v0", 60_000, 50.0),
    ],
)
def test_it_learns_a_position_only_task(agent, env_id, steps, least):
    learned = make_agent(agent, env_id, seed=0).learn(steps)
    assert evaluate(learned, env_id, 100, seed=1_000_000).mean > least


def test_memory_is_needed_for_the_position_only_pendulum():
    env_id = "beliefgym/PendulumPosition-v0"
    returns = {
        agent: evaluate(make_agent(agent, env_id, seed=0).learn(10_000), env_id, 100, seed=1_000_000).mean
        for agent in ("sac", "sac-stack")
    }
    assert returns["sac-stack"] > returns["sac"] + 300.0
