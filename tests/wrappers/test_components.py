"""Names of observation components, and their choice."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

import beliefgym.wrappers.vector as vector
from beliefgym.wrappers import (
    ActionHistory,
    ObservationDelay,
    ObservationNoise,
    PartialObservation,
    component_names,
)
from beliefgym.wrappers.components import select_components

NAMES = ("x", "cos_theta", "sin_theta", "omega[rad/s]")


@pytest.mark.parametrize(
    ("keep", "expected"),
    [
        (["sin_theta", "x"], [2, 0]),
        ([-1, 0], [3, 0]),
        (["*_theta"], [1, 2]),
        ("*_theta", [1, 2]),
        (["sin*", 0, "cos*"], [2, 0, 1]),
        (["omega[rad/s]"], [3]),  # a name with brackets, not a pattern of characters
        (np.array([2, 1]), [2, 1]),
        (("?",), [0]),
    ],
)
def test_select(keep, expected):
    assert select_components(NAMES, keep) == expected


@pytest.mark.parametrize(
    ("keep", "error", "message"),
    [
        (
            ["sin_teta"],
            ValueError,
            r"no observation component 'sin_teta'; did you mean 'sin_theta'\? .*x, cos_theta",
        ),
        (["qpos_*"], ValueError, r"no observation component 'qpos_\*'.*\(the observation has x, cos_theta"),
        ([4], IndexError, "index 4 is out of range: the observation has 4 components"),
        ([-5], IndexError, "index -5 is out of range"),
        (["x", 0], ValueError, "'x' is kept twice .again by 0"),
        (["cos_theta", "*_theta"], ValueError, "'cos_theta' is kept twice"),
        ([0, -4], ValueError, "'x' is kept twice"),
        ([], ValueError, "at least one observation component of x, cos_theta"),
        ([True, False], TypeError, "got True .*flatnonzero"),
        ([1.0], TypeError, "names, patterns or indices, got 1.0"),
    ],
)
def test_select_refuses(keep, error, message):
    with pytest.raises(error, match=message):
        select_components(NAMES, keep)


@pytest.mark.parametrize(
    "env_id",
    [
        "Hopper-v5",
        "HalfCheetah-v5",
        "Ant-v5",
        "Swimmer-v5",
        "Walker2d-v5",
        "InvertedPendulum-v5",
        "Humanoid-v5",
    ],
)
def test_mujoco_names_are_the_joints(env_id):
    """Oracle: MuJoCo's own access to a joint's coordinates by name."""
    env = gym.make(env_id)
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(env.action_space.sample())
    names = component_names(env)
    assert len(set(names)) == len(names) == len(observation)
    data, model = env.unwrapped.data, env.unwrapped.model
    expected = {}
    for i in range(model.njnt):
        joint = data.joint(model.joint(i).name)
        for kind, values in (("qpos", joint.qpos), ("qvel", joint.qvel)):
            for k, value in enumerate(values):
                expected[f"{kind}_{joint.name}" + (f"_{k}" if len(values) > 1 else "")] = value
    named = {name: value for name, value in zip(names, observation, strict=True) if name in expected}
    assert len(named) == sum(env.unwrapped.observation_structure[part] for part in ("qpos", "qvel"))
    for name, value in named.items():
        clipped = env_id in ("Hopper-v5", "Walker2d-v5") and name.startswith(
            "qvel_"
        )  # Gymnasium's own limits
        assert value == (np.clip(expected[name], -10, 10) if clipped else expected[name])
    rest = [name for name in names if name not in expected]
    assert all(name.rpartition("_")[2].isdigit() for name in rest)
    if env_id == "Ant-v5":
        assert rest[:2] == ["cfrc_ext_0", "cfrc_ext_1"]
        assert "qpos_root_2" in named
        assert "qpos_root_1" not in names


def test_hopper_positions_only():
    env = PartialObservation(gym.make("Hopper-v5"), keep=["qpos_*"])
    observation, _ = env.reset(seed=0)
    assert env.observation_space.shape == observation.shape == (5,)
    assert env.observation_names == (
        "qpos_rootz",
        "qpos_rooty",
        "qpos_thigh_joint",
        "qpos_leg_joint",
        "qpos_foot_joint",
    )
    for _ in range(5):
        observation, *_ = env.step(env.action_space.sample())
        np.testing.assert_array_equal(observation, env.unwrapped.data.qpos[1:])
    assert observation.dtype == np.float64
    around = vector.PartialObservation(SyncVectorEnv([lambda: gym.make("Hopper-v5")] * 2), keep=["qpos_*"])
    assert around.observation_names == env.observation_names
    assert around.observation_space.shape == (2, 5)


def test_generic_names():
    assert component_names(gym.make("CartPole-v1")) == tuple(f"observation_{i}" for i in range(4))
    assert component_names(gym.make("Reacher-v5")) == tuple(f"observation_{i}" for i in range(10))
    assert component_names(gym.make_vec("CartPole-v1", 2, "async"))[0] == "observation_0"


def test_names_of_a_changed_observation_are_not_trusted():
    """A wrapper that adds a component without naming it makes the names below wrong."""
    env = gym.wrappers.TimeAwareObservation(gym.make("Hopper-v5"), flatten=True)
    assert component_names(env) == tuple(f"observation_{i}" for i in range(12))


@pytest.mark.parametrize("vectorized", [False, True])
def test_names_through_a_stack(vectorized):
    import beliefgym  # noqa: F401  (registers the ids)

    if vectorized:
        env = gym.make_vec("beliefgym/Pendulum-v0", 2, "vector_entry_point")
        history, noise, delay, partial = (
            vector.ActionHistory,
            vector.ObservationNoise,
            vector.ObservationDelay,
            vector.PartialObservation,
        )
    else:
        env = gym.make("beliefgym/Pendulum-v0")
        history, noise, delay, partial = ActionHistory, ObservationNoise, ObservationDelay, PartialObservation
    whole, act = component_names(env), env.unwrapped.action_names[0]
    env = history(delay(noise(partial(env, whole[1:]), 0.1), 2), 2)
    expected = (*whole[1:], f"previous_action_1[{act}]", f"previous_action_2[{act}]")
    assert env.observation_names == component_names(env) == expected
    again = partial(env, [f"previous_action_1[{act}]", "previous_action_2*"])
    assert again.observation_names == expected[2:]
    if not vectorized:
        outer = gym.wrappers.TimeLimit(env, 5)
        assert outer.get_wrapper_attr("observation_names") == expected
