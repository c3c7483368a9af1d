"""A task in TorchRL: specs, rollouts over episode ends, and the same numbers as the environment's own."""

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from beliefgym.wrappers import Task
from beliefgym.wrappers.torchrl import torchrl_env

TASK = Task(
    "beliefgym/PendulumPosition-v0",
    {},
    (("ObservationNoise", {"std": 0.1}), ("ActionHistory", {"length": 1})),
)


@pytest.mark.parametrize("num_envs", [None, 3])
def test_specs_hold(num_envs):
    check_env_specs(torchrl_env(TASK, num_envs))


def test_a_rollout_over_the_ends_of_episodes_shows_each_last_observation():
    env = torchrl_env(TASK, 2)
    env.set_seed(4)
    rollout = env.rollout(205, break_when_any_done=False)
    assert rollout.batch_size == torch.Size([2, 205])
    done = rollout["next", "done"][..., 0]
    assert done.nonzero().tolist() == [[0, 199], [1, 199]]
    assert rollout["next", "truncated"][..., 0].equal(done)
    # the observation after the end belongs to the old episode: its last component is the action just taken
    last = rollout["next", "observation"][:, 199, -1]
    assert last == pytest.approx(rollout["action"][:, 199, 0].numpy())
    assert rollout["observation"][:, 200, -1].tolist() == [0.0, 0.0]


def test_the_numbers_are_the_environments_own():
    env, own = torchrl_env(TASK, 2), TASK.make_vec(2)
    observation, _ = own.reset(seed=4)
    data = env.reset(seed=4)
    assert np.array_equal(data["observation"].numpy(), observation)
    for _ in range(5):
        action = torch.rand(2, 1)
        data = env.step(data.set("action", action))["next"]
        observation, reward, *_ = own.step(action.numpy())
        assert np.array_equal(data["observation"].numpy(), observation)
        assert data["reward"][:, 0].numpy() == pytest.approx(reward, rel=1e-6)  # float32
        data = data.exclude("reward")
