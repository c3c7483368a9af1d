"""The adapter against SB3's own vector environments on the same single environments."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

import beliefgym  # noqa: F401
from beliefgym.wrappers import SB3VecEnv, vector
from beliefgym.wrappers.vector import ObservationDelay

IDS = ["beliefgym/PendulumPosition-v0", "beliefgym/CartPoleSwingUp-v0"]


def native(env_id, n, **kwargs):
    return gym.make_vec(
        env_id, n, vectorization_mode="vector_entry_point", autoreset_mode="SAME_STEP", **kwargs
    )


@pytest.mark.parametrize("env_id", IDS)
def test_it_is_make_vec_env_on_the_same_environment(env_id):
    """Observations, rewards, dones, final observations, truncation flags and episode statistics."""
    n, limit = 6, 30
    ours = SB3VecEnv(native(env_id, n, max_episode_steps=limit))
    theirs = make_vec_env(env_id, n, env_kwargs={"max_episode_steps": limit})
    for env in (ours, theirs):
        env.seed(11)
    assert np.array_equal(ours.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    ended = {"terminated": 0, "truncated": 0}
    for _ in range(3 * limit):
        # pushing one way takes the cart off its track before the time limit in some copies
        actions = rng.uniform(0.3, 1.0, (n, 1)).astype(np.float32) * ours.action_space.high
        actions[: n // 2] *= rng.choice([-1.0, 1.0])
        a, b = ours.step(actions), theirs.step(actions)
        assert np.array_equal(a[0], b[0])
        assert np.array_equal(a[1], b[1])
        assert a[1].dtype == b[1].dtype
        assert np.array_equal(a[2], b[2])
        for mine, other in zip(a[3], b[3], strict=True):
            assert mine.get("TimeLimit.truncated", False) == other["TimeLimit.truncated"]
            assert ("terminal_observation" in mine) == ("terminal_observation" in other)
            if "terminal_observation" in mine:
                assert np.array_equal(mine["terminal_observation"], other["terminal_observation"])
                assert mine["episode"]["l"] == other["episode"]["l"]
                assert mine["episode"]["r"] == pytest.approx(
                    other["episode"]["r"], abs=2e-6
                )  # both round to 6
                ended["truncated" if mine["TimeLimit.truncated"] else "terminated"] += 1
        # SB3's environments draw the next start from a stream that ours continues, too: starts stay equal
    assert ended["truncated"] > 0
    if "CartPole" in env_id:
        assert ended["terminated"] > 0


def test_vector_wrappers_and_sb3s_own_stack_on_it():
    env = native(IDS[0], 4, max_episode_steps=10)
    stacked = VecFrameStack(VecNormalize(SB3VecEnv(ObservationDelay(env, steps=2))), 3)
    model = PPO("MlpPolicy", stacked, n_steps=16, batch_size=32, seed=0, device="cpu")
    model.learn(128)
    returns, lengths = evaluate_policy(
        model, stacked, n_eval_episodes=8, return_episode_rewards=True, warn=True
    )
    assert lengths == [10] * 8
    assert len(returns) == 8


def test_discrete_actions_reach_sb3_as_discrete():
    env = SB3VecEnv(vector.DiscreteActions(native(IDS[0], 3), bins=5))
    assert env.action_space == gym.spaces.Discrete(5)
    env.reset()
    observation, *_ = env.step(np.array([0, 2, 4]))
    assert observation.shape == (3, 2)


def test_hints_reach_the_info_of_each_copy():
    env = SB3VecEnv(native(IDS[0], 2, hint=True, max_episode_steps=1))
    env.reset()
    assert np.array_equal(env.reset_infos[1]["hint"], env.get_attr("state")[1])
    _, _, dones, infos = env.step(np.zeros((2, 1)))
    assert dones.all()
    assert np.array_equal(infos[1]["hint"], env.get_attr("state")[1])
    assert "final_info" not in infos[1]


def test_attributes_methods_and_wrappers_can_be_asked_for():
    env = SB3VecEnv(ObservationDelay(native(IDS[0], 3), steps=1))
    env.reset()
    assert np.array_equal(np.stack(env.get_attr("state")), env.env.unwrapped.state)
    assert env.get_attr("observation_names", [1]) == [("cos_theta", "sin_theta")]
    assert env.env_is_wrapped(Monitor) == [True] * 3  # its statistics are in the infos
    assert env.env_is_wrapped(ObservationDelay, indices=0) == [True]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * 3
    env.set_attr("label", "x")
    assert env.get_attr("label") == ["x"] * 3
    with pytest.raises(ValueError, match="cannot set 'label' for some copies only"):
        env.set_attr("label", "y", indices=[0])
    assert env.get_images() == [None] * 3


def test_what_does_not_fit_is_told():
    with pytest.raises(TypeError, match="expected a gymnasium VectorEnv, got TimeLimit"):
        SB3VecEnv(gym.make(IDS[0]))
    next_step = gym.make_vec(IDS[0], 2, vectorization_mode="vector_entry_point")
    with pytest.raises(ValueError, match="autoreset_mode SAME_STEP, got AutoresetMode.NEXT_STEP"):
        SB3VecEnv(next_step)
