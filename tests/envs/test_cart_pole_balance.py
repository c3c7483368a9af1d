"""The balancing cart-pole against Gymnasium's CartPole-v1, and its hidden-state forms."""

import gymnasium as gym
import numpy as np
import pytest

import beliefgym  # noqa: F401
from beliefgym.envs import CartPoleBalance

NOISY = [
    "beliefgym/CartPoleBalanceNoisyEasy-v0",
    "beliefgym/CartPoleBalanceNoisyMedium-v0",
    "beliefgym/CartPoleBalanceNoisyHard-v0",
]


def test_it_moves_as_gymnasiums_cart_pole_does():
    ours, theirs = gym.make("beliefgym/CartPoleBalance-v0"), gym.make("CartPole-v1")
    rng = np.random.default_rng(0)
    lengths = []
    for episode in range(30):
        theirs.reset(seed=episode)
        ours.reset(options={"state": np.asarray(theirs.unwrapped.state)})
        done = False
        while not done:
            action = int(rng.integers(2))
            _, reward, terminated, truncated, _ = theirs.step(action)
            found = ours.step(action)
            # the order of a few products differs: the last bits, which the unstable pole makes larger in time
            assert ours.unwrapped.state == pytest.approx(theirs.unwrapped.state, rel=1e-9, abs=1e-12)
            assert found[1:4] == (reward, terminated, truncated)
            done = terminated or truncated
        lengths.append(theirs.get_wrapper_attr("_elapsed_steps"))
    assert 10 < np.mean(lengths) < 40  # the known return of random pushes is about 22


def test_the_two_actions_are_the_two_pushes():
    env = gym.make("beliefgym/CartPoleBalance-v0")
    assert env.action_space == gym.spaces.Discrete(2)
    for action, sign in ((0, -1.0), (1, 1.0)):
        env.reset(options={"state": np.zeros(4)})
        env.step(action)
        assert np.sign(env.unwrapped.state[1]) == sign


def test_the_expert_balances_for_the_whole_time():
    env = gym.make_vec(
        "beliefgym/CartPoleBalance-v0",
        500,
        vectorization_mode="vector_entry_point",
        autoreset_mode="DISABLED",
    )
    controller = env.unwrapped.expert()
    env.reset(seed=7)
    for _ in range(499):
        actions = (controller.act(env.unwrapped.state)[:, 0] > 0).astype(int)
        _, _, terminated, truncated, _ = env.step(actions)
        assert not (terminated | truncated).any()
    assert env.step(actions)[3].all()
    assert np.abs(env.unwrapped.state[:, 0]).max() < 1.0  # m: far from the track's end


@pytest.mark.parametrize(("env_id", "std"), list(zip(NOISY, (0.1, 0.2, 0.3), strict=True)))
def test_noise_is_in_the_first_observation_as_in_all_others(env_id, std):
    n = 4000
    env = gym.make_vec(env_id, n, vectorization_mode="vector_entry_point", autoreset_mode="SAME_STEP")
    assert env.single_observation_space.shape == (2,)
    first, _ = env.reset(seed=0)
    second = env.step(np.zeros(n, dtype=int))[0]
    for observation, state in ((first, None), (second, env.unwrapped.state)):
        if state is None:
            env.reset(seed=0)
            state = env.unwrapped.state
            env.step(np.zeros(n, dtype=int))
        error = observation - state[:, [0, 2]]
        # the standard error of a standard deviation over 4000 draws is 1.1 %
        assert error.std(axis=0) == pytest.approx([std, std], rel=0.05)
        assert np.abs(error.mean(axis=0)).max() < 4 * std / np.sqrt(n)


def test_the_first_observation_of_the_position_form_hides_the_velocities():
    env = gym.make("beliefgym/CartPoleBalancePosition-v0")
    observation, info = env.reset(seed=0)
    assert observation == pytest.approx(env.unwrapped.state[[0, 2]])
    assert info == {}


def test_another_level_of_noise_by_a_parameter():
    env = gym.make("beliefgym/CartPoleBalanceNoisyEasy-v0", noise=0.0)
    assert env.reset(seed=0)[0] == pytest.approx(env.unwrapped.state[[0, 2]], abs=1e-7)
    with pytest.raises(TypeError, match="CartPoleBalance has no parameter 'nois'"):
        gym.make("beliefgym/CartPoleBalanceNoisyEasy-v0", nois=0.0)


def test_impossible_parameters_are_told():
    with pytest.raises(ValueError, match="expected track above 0, got -1"):
        CartPoleBalance(track=-1.0)
