"""The expert on a filter's estimate: LQG control where the system is nearly linear and its noise Gaussian."""

import numpy as np
import pytest

from beliefgym.agents import evaluate, load_agent, make_agent
from beliefgym.agents.filter_expert import FilterExpert, LinearFeedback
from beliefgym.envs import CartPoleBalance
from beliefgym.wrappers import Task

NOISY = "beliefgym/CartPoleBalanceNoisyEasy-v0"


def test_without_noise_it_is_as_good_as_the_expert():
    task = "beliefgym/CartPoleBalancePosition-v0"
    assert (evaluate(FilterExpert(task), task, 20, seed=5).returns == 500.0).all()


def kalman_by_hand(task, observations, actions):
    """A linear Kalman filter of the linearised cart-pole, by the textbook, from finite differences of its step."""
    env = task.make_vec(4000)
    env.reset(seed=11)
    system, first = env.unwrapped.system, np.asarray(env.unwrapped.state)
    env.close()
    n, h = system.n_state, 1e-5
    zero, push = np.zeros((1, n)), np.zeros((1, 1))
    A = np.stack(
        [(system.step(zero + h * e, push) - system.step(zero - h * e, push))[0] / (2 * h) for e in np.eye(n)],
        1,
    )
    B = (system.step(zero, push + h) - system.step(zero, push - h))[0][:, None] / (2 * h)
    C = np.eye(n)[[0, 2]]
    R = 0.1**2 * np.eye(2)
    m, P = first.mean(0), np.cov(first.T)
    means = []
    for t, x in enumerate(observations):
        if t:
            m, P = A @ m + B @ actions[t - 1], A @ P @ A.T
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        m, P = m + K @ (x - C @ m), (np.eye(n) - K @ C) @ P
        means.append(m)
    return np.array(means)


def test_its_estimate_is_a_kalman_filters_near_the_upright():
    task = Task(NOISY)
    agent = FilterExpert(task, filter="ekf")
    env = task.make_vec(1)
    observation, _ = env.reset(seed=3)
    state, start = None, np.ones(1, dtype=bool)
    seen, forces, means = [], [], []
    for _ in range(12):
        action, state = agent.predict(observation, state, start)
        seen.append(observation[0])
        forces.append(state.action[0])
        means.append(agent.filter.estimate_state(state.belief).mean[0])
        observation, _, terminated, truncated, _ = env.step(action)
        start = terminated | truncated
        assert not start.any()
    env.close()
    assert set(np.ravel(forces)) == {-10.0, 10.0}
    expected = kalman_by_hand(task, seen, forces)
    assert np.allclose(means, expected, atol=0.02)
    assert np.abs(np.array(means)[-1]).max() > 0.05  # there is something to agree on


def test_an_episode_begins_with_the_prior_and_others_go_on():
    agent = FilterExpert(NOISY)
    x = np.array([[0.1, 0.05], [-0.2, 0.1]], dtype=np.float32)
    _, first = agent.predict(x, None, np.ones(2, dtype=bool))
    _, second = agent.predict(x, first, np.array([False, True]))
    _, alone = agent.predict(x[1:], None, np.ones(1, dtype=bool))
    assert np.allclose(second.belief[1], alone.belief[0])
    assert not np.allclose(second.belief[0], first.belief[0])


def test_under_noise_a_tuned_gain_is_better_than_the_experts_and_both_than_none():
    tuned = FilterExpert(NOISY, filter="ekf", gain=[[0.0, -10.0, -100.0, -25.0]])
    lengths = [evaluate(a, NOISY, 100, seed=7).mean for a in (tuned, FilterExpert(NOISY, filter="ekf"))]
    assert lengths[0] > lengths[1] > 150.0
    assert evaluate(make_agent("random", NOISY, seed=0), NOISY, 100, seed=7).mean < 40.0


def test_the_gain_is_that_of_linear_feedback_within_the_limits():
    system = CartPoleBalance()
    control = LinearFeedback(system, [[1.0, 2.0, 3.0, 4.0]])
    action = control.act(np.array([[0.1, 0.1, 0.1, 0.1], [9.0, 9.0, 9.0, 9.0]]), np.zeros(2, dtype=bool))
    assert np.allclose(action, [[-1.0], [-10.0]])
    with pytest.raises(ValueError, match=r"\(1, 4\).*got \(4,\)"):
        LinearFeedback(system, [1.0, 2.0, 3.0, 4.0])


def test_what_has_no_known_dynamics_is_told():
    with pytest.raises(ValueError, match="beliefgym system"):
        FilterExpert("beliefgym/HopperPosition-v0")


def test_it_is_saved_and_loaded(tmp_path):
    agent = make_agent("filter-expert", NOISY, seed=2, filter="ekf", gain=[[0.0, -10.0, -100.0, -25.0]])
    agent.save(tmp_path / "agent.zip")
    loaded = load_agent(tmp_path / "agent.zip")
    assert loaded.options() == agent.options()
    assert (evaluate(loaded, NOISY, 5, seed=1).returns == evaluate(agent, NOISY, 5, seed=1).returns).all()
