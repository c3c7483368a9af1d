"""The grid of actions."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from gymnasium.vector import SyncVectorEnv

import beliefgym.wrappers.vector as vector
from beliefgym.wrappers import DiscreteActions


class Echo(gym.Env[Any, Any]):
    """Shows the action that it got."""

    def __init__(self, low: list[float], high: list[float], dtype: type = np.float32) -> None:
        self.action_space = Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)  # type: ignore[arg-type]
        self.observation_space = Box(-np.inf, np.inf, self.action_space.shape, dtype=dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(self.action_space.shape, self.action_space.dtype), {}

    def step(self, action: Any) -> Any:
        assert action in self.action_space
        return np.array(action), 0.0, False, False, {}


def test_one_action_from_end_to_end():
    env = DiscreteActions(Echo([-2], [2]), 5)
    env.reset()
    assert env.action_space == Discrete(5)
    assert [env.step(i)[0].item() for i in range(5)] == [-2, -1, 0, 1, 2]
    assert env.step(np.int64(3))[0].dtype == np.float32


def test_both_ends_exactly():
    """0.1 and 0.7 are no float32 numbers: the grid may not step over the rounded bounds."""
    env = DiscreteActions(Echo([0.1], [0.7]), 7)
    env.reset()
    assert env.step(0)[0] == np.float32(0.1)
    assert env.step(6)[0] == np.float32(0.7)


def test_product_runs_fastest_over_the_last_component():
    env = DiscreteActions(Echo([-1, 0], [1, 3]), [2, 4])
    env.reset()
    assert env.action_space == Discrete(8)
    shown = [env.step(i)[0].tolist() for i in range(8)]
    assert shown == [[a, b] for a in (-1, 1) for b in (0, 1, 2, 3)]


def test_multi_discrete_chooses_each_component():
    env = DiscreteActions(Echo([-1, 0], [1, 3], np.float64), [2, 4], space="multi_discrete")
    env.reset()
    assert env.action_space == MultiDiscrete([2, 4])
    assert env.step(np.array([1, 2]))[0].tolist() == [1, 2]
    assert env.step([0, 3])[0].tolist() == [-1, 3]
    assert env.step([0, 3])[0].dtype == np.float64


@pytest.mark.parametrize("space", ["discrete", "multi_discrete"])
def test_vector_form(space):
    env = vector.DiscreteActions(SyncVectorEnv([lambda: Echo([-1, 0], [1, 3])] * 3), [2, 4], space=space)
    env.reset()
    actions = np.array([[1, 2], [0, 0], [1, 3]])
    numbers = actions if space == "multi_discrete" else actions @ [4, 1]
    assert env.action_space.contains(numbers)
    np.testing.assert_array_equal(env.step(numbers)[0], [[1, 2], [-1, 0], [1, 3]])
    with pytest.raises(ValueError, match="expected actions of shape"):
        env.step(numbers[..., None])
    with pytest.raises(ValueError, match=r"expected actions from 0 to [137], got -1"):
        env.step(numbers * 0 - 1)


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        (5, ValueError, "expected actions from 0 to 4, got 5"),
        (-1, ValueError, "expected actions from 0 to 4, got -1"),
        (1.0, TypeError, r"expected integer actions in Discrete\(5\), got float64"),
        (np.nan, TypeError, "expected integer actions"),
        (True, TypeError, "got bool"),
        ([1], ValueError, r"shape \(\) for one environment, got shape \(1,\)"),
    ],
)
def test_wrong_action(action, error, message):
    env = DiscreteActions(Echo([-2], [2]), 5)
    env.reset()
    with pytest.raises(error, match=message):
        env.step(action)


def test_wrong_action_in_a_component():
    env = DiscreteActions(Echo([-1, 0], [1, 3]), [2, 4], space="multi_discrete")
    env.reset()
    with pytest.raises(ValueError, match="from 0 to 1, got 2"):
        env.step([2, 3])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"bins": 1}, ValueError, "at least 2 bins .*got 1"),
        ({"bins": [3, 3, 3]}, ValueError, "one for each of 2 action components"),
        ({"bins": 2.5}, TypeError, "expected bins to be an int"),
        ({"bins": True}, TypeError, "expected bins to be an int"),
        (
            {"bins": 100},
            ValueError,
            r"100 x 100 bins give 10000 choices, more than 4096.*or space=\"multi_discrete\"",
        ),
        ({"bins": 3, "space": "box"}, ValueError, "got 'box'"),
    ],
)
@pytest.mark.parametrize("form", ["single", "vector"])
def test_wrong_arguments(arguments, error, message, form):
    env: Any = Echo([-1, 0], [1, 3])
    wrapper: Any = DiscreteActions
    if form == "vector":
        env, wrapper = SyncVectorEnv([lambda: Echo([-1, 0], [1, 3])]), vector.DiscreteActions
    with pytest.raises(error, match=message):
        wrapper(env, **arguments)


def test_many_components_do_not_overflow():
    """3^100 points do not fit in 64 bits."""
    with pytest.raises(ValueError, match="choices, more than 4096"):
        DiscreteActions(Echo([-1] * 100, [1] * 100), 3)


def test_unbounded_actions_and_the_remedy_of_the_message():
    env = Echo([-1], [np.inf])
    with pytest.raises(ValueError, match=r"bounded action space, got Box.*TransformAction"):
        DiscreteActions(env, 3)
    bounded = gym.wrappers.TransformAction(env, lambda action: action, action_space=Box(-1.0, 1.0, (1,)))
    assert DiscreteActions(bounded, 3).action_space == Discrete(3)


def test_environment_with_discrete_actions_already():
    with pytest.raises(TypeError, match=r"one-dimensional Box action space .*got Discrete\(2\)"):
        DiscreteActions(gym.make("CartPole-v1"), 3)
