"""A task as data makes the same environment single and in batches, and round-trips."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from beliefgym.envs import SystemVectorEnv
from beliefgym.wrappers import Task

NOISY = Task(
    "beliefgym/Pendulum-v0",
    {"damping": 0.1},
    (
        ("PartialObservation", {"keep": ["cos_theta", "sin_theta"]}),
        ("ObservationNoise", {"std": 0.1}),
        ("ActionHistory", {"length": 2}),
    ),
)


def test_single_and_vector_are_the_same_environment():
    single, batch = NOISY.make(), NOISY.make_vec(3)
    assert isinstance(batch.unwrapped, SystemVectorEnv)
    assert batch.single_observation_space == single.observation_space
    first, _ = batch.reset(seed=5)
    assert np.array_equal(single.reset(seed=6)[0], first[1])
    for _ in range(10):
        actions = np.random.default_rng(0).uniform(-2, 2, (3, 1))
        assert np.array_equal(single.step(actions[1])[0], batch.step(actions)[0][1])


def test_it_round_trips_as_plain_data_and_has_a_label():
    assert Task.from_dict(NOISY.to_dict()) == NOISY
    assert NOISY.label == (
        "Pendulum-v0 damping=0.1 PartialObservation(keep=cos_theta+sin_theta) ObservationNoise(std=0.1) "
        "ActionHistory(length=2)"
    )
    spec = NOISY.make().spec
    rebuilt = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json()))
    assert np.array_equal(rebuilt.reset(seed=1)[0], NOISY.make().reset(seed=1)[0])


def test_foreign_environments_run_under_gymnasiums_own_vector_env():
    task = Task("Hopper-v5", {}, (("PartialObservation", {"keep": ["qpos_*"]}),))
    batch = task.make_vec(2)
    assert isinstance(batch.unwrapped, SyncVectorEnv)
    assert batch.reset(seed=0)[0].shape == (2, 5)
    assert np.array_equal(task.make().reset(seed=1)[0], batch.reset(seed=0)[0][1])


def test_the_namespace_may_be_left_out():
    assert Task("PendulumPosition-v0") == Task("beliefgym/PendulumPosition-v0")
    assert Task("CartPole-v1").env_id == "CartPole-v1"


def test_unknown_names_are_told_with_the_nearest():
    with pytest.raises(ValueError, match="'beliefgym/Pendulm-v0'; did you mean 'beliefgym/Pendulum-v0'"):
        Task("beliefgym/Pendulm-v0")
    with pytest.raises(ValueError, match="no wrapper 'ObservationNoize'; did you mean 'ObservationNoise'"):
        Task("beliefgym/Pendulum-v0", {}, (("ObservationNoize", {"std": 0.1}),))
    with pytest.raises(ValueError, match="'velocity'"):
        Task("beliefgym/Pendulum-v0", {}, (("PartialObservation", {"keep": ["velocity"]}),)).make()
