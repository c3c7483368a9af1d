"""What each wrapper shows, against plain Python; its spaces, names, specs, pickles and complaints."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import beliefgym.wrappers.vector as vector
from beliefgym.envs.random_streams import RandomStreams
from beliefgym.wrappers import (
    ActionHistory,
    DiscreteActions,
    ObservationDelay,
    ObservationNoise,
    PartialObservation,
)
from beliefgym.wrappers.observation_noise import STREAM, STREAM_STRIDE


class Counter(gym.Env[Any, Any]):
    """x_t = (t, 10 + t) in [1, inf) x [10, inf); takes any action."""

    def __init__(self, action_space: gym.Space[Any], dtype: type = np.float32) -> None:
        highest = np.inf if np.issubdtype(dtype, np.floating) else 10**6
        self.observation_space = Box(
            np.array([1, 10], dtype),
            np.array([highest, highest], dtype),
            dtype=dtype,  # type: ignore[arg-type]
        )
        self.action_space = action_space
        self.t = 0

    def observation(self) -> Any:
        return np.array([1 + self.t, 10 + self.t], dtype=self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self.observation(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self.observation(), 0.0, False, False, {}


def play(env: gym.Env[Any, Any], actions: list[Any]) -> list[list[float]]:
    shown = [env.reset(seed=0)[0].tolist()]
    return shown + [env.step(action)[0].tolist() for action in actions]


BOX = Box(np.array([-2, -1], np.float32), np.array([2, 0.5], np.float32))


def test_partial_observation_shows_the_kept_components():
    env = PartialObservation(Counter(BOX), [1, 0])
    assert play(env, [BOX.sample()] * 2) == [[10, 1], [11, 2], [12, 3]]
    assert env.observation_space == Box(
        np.array([10, 1], np.float32), np.array([np.inf, np.inf], np.float32), dtype=np.float32
    )
    assert env.observation_names == ("observation_1", "observation_0")


@pytest.mark.parametrize(
    ("steps", "fill", "expected"),
    [
        (0, "initial", [1, 2, 3, 4, 5, 6]),
        (1, "initial", [1, 1, 2, 3, 4, 5]),
        (3, "initial", [1, 1, 1, 1, 2, 3]),
        (0, "zeros", [1, 2, 3, 4, 5, 6]),
        (1, "zeros", [0, 1, 2, 3, 4, 5]),
        (3, "zeros", [0, 0, 0, 1, 2, 3]),
        (9, "zeros", [0, 0, 0, 0, 0, 0]),
    ],
)
def test_delay(steps, fill, expected):
    env = ObservationDelay(Counter(BOX), steps, fill=fill)
    for _ in range(2):  # nothing is left over from the first episode
        assert [row[0] for row in play(env, [BOX.sample()] * 5)] == expected
    lowest = [0, 0] if fill == "zeros" and steps else [1, 10]
    np.testing.assert_array_equal(env.observation_space.low, lowest)
    assert env.observation_space.dtype == np.float32


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"steps": -1}, ValueError, "delay of at least 0 steps, got -1"),
        ({"steps": 1.5}, TypeError, r"whole steps \(an int\), got 1.5"),
        ({"steps": True}, TypeError, "got True"),
        ({"steps": 1, "fill": "ones"}, ValueError, "expected fill to be .*got 'ones'"),
    ],
)
def test_delay_refuses(arguments, error, message):
    with pytest.raises(error, match=message):
        ObservationDelay(Counter(BOX), **arguments)
    with pytest.raises(error, match=message):
        vector.ObservationDelay(SyncVectorEnv([lambda: Counter(BOX)]), **arguments)


def test_history_of_box_actions_is_newest_first_and_clipped():
    env = ActionHistory(Counter(BOX), 2)
    actions = [np.array([1, -0.5]), np.array([2, 0.25]), np.array([-7, 7])]
    for _ in range(2):
        assert play(env, actions) == [
            [1, 10, 0, 0, 0, 0],
            [2, 11, 1, -0.5, 0, 0],
            [3, 12, 2, 0.25, 1, -0.5],
            [4, 13, -2, 0.5, 2, 0.25],
        ]
    expected = Box(
        np.array([1, 10, -2, -1, -2, -1], np.float32),
        np.array([np.inf, np.inf, 2, 0.5, 2, 0.5], np.float32),
        dtype=np.float32,
    )
    assert env.observation_space == expected
    assert env.observation_names[2:] == (
        "previous_action_1[action_0]",
        "previous_action_1[action_1]",
        "previous_action_2[action_0]",
        "previous_action_2[action_1]",
    )


@pytest.mark.parametrize(
    ("space", "actions", "code", "names"),
    [
        (Discrete(3, start=-1), [-1, 1], [[1, 0, 0], [0, 0, 1]], ["action_0=-1", "action_0=0", "action_0=1"]),
        (
            MultiDiscrete([2, 3]),
            [np.array([1, 0]), np.array([0, 2])],
            [[0, 1, 1, 0, 0], [1, 0, 0, 0, 1]],
            ["action_0=0", "action_0=1", "action_1=0", "action_1=1", "action_1=2"],
        ),
        (MultiBinary(2), [np.array([1, 0]), np.array([1, 1])], [[1, 0], [1, 1]], ["action_0", "action_1"]),
    ],
)
def test_history_of_discrete_actions_is_one_hot(space, actions, code, names):
    env = ActionHistory(Counter(space, np.float64), 1)
    shown = play(env, actions)
    assert [row[2:] for row in shown] == [[0] * len(names), *code]
    assert env.observation_names[2:] == tuple(f"previous_action_1[{name}]" for name in names)
    assert env.observation_space.dtype == np.float64
    assert env.observation_space.contains(env.step(space.sample())[0])
    np.testing.assert_array_equal(env.observation_space.high[2:], 1)


def test_history_bounds_hold_the_zeros_before_the_first_action():
    env = ActionHistory(Counter(Box(1.0, 2.0, (1,))), 1)
    assert env.observation_space.contains(env.reset()[0])


def test_history_of_a_history_has_distinct_names():
    env = ActionHistory(ActionHistory(Counter(BOX), 1), 1)
    assert env.observation_names[-2:] == ("previous_action_1[action_0]#2", "previous_action_1[action_1]#2")
    assert len(set(env.observation_names)) == 6


def test_history_of_chosen_actions_tells_the_choice():
    import beliefgym  # noqa: F401  (registers the ids)

    env = ActionHistory(DiscreteActions(gym.make("beliefgym/Pendulum-v0"), 3), 1)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(2)[0][-3:], [0, 0, 1])
    act = env.unwrapped.action_names[0]
    assert env.observation_names[-1] == f"previous_action_1[{act}=2]"


@pytest.mark.parametrize(
    ("env", "length", "error", "message"),
    [
        (Counter(BOX), 0, ValueError, "length of at least 1 action, got 0"),
        (Counter(BOX), 2.0, TypeError, "number of actions .an int., got 2.0"),
        (Counter(BOX), True, TypeError, "got True"),
        (Counter(Dict({})), 1, TypeError, "expected a Box, Discrete, .*got Dict"),
        (Counter(BOX, np.int64), 1, TypeError, "floating-point numbers, got int64.*DtypeObservation"),
    ],
)
def test_history_refuses(env, length, error, message):
    with pytest.raises(error, match=message):
        ActionHistory(env, length)


def test_noise_is_the_stream_of_the_seed():
    """y - x is exactly std times the copy's stream, the first observation included, over episodes."""
    env = ObservationNoise(Counter(BOX, np.float64), [0.5, 2.0])
    streams = RandomStreams([42], stream=STREAM)
    for seed in (42, None):
        shown = [env.reset(seed=seed)[0], *(env.step(BOX.sample())[0] for _ in range(5))]
        for t, observation in enumerate(shown):
            noise = streams.normal(2)[0] * [0.5, 2.0]
            np.testing.assert_array_equal(observation, np.array([1 + t, 10 + t]) + noise)


def test_noise_has_the_standard_deviation_asked_for():
    n = 20_000
    env = vector.ObservationNoise(
        gym.make_vec("beliefgym/Pendulum-v0", n, "vector_entry_point"), std=[0.0, 0.3, 2.0]
    )
    bare = gym.make_vec("beliefgym/Pendulum-v0", n, "vector_entry_point")
    noise = env.reset(seed=3)[0].astype(np.float64) - bare.reset(seed=3)[0]
    # five standard errors: of a mean std/sqrt(n), of a standard deviation std/sqrt(2n), of a correlation 1/sqrt(n)
    error = 5 / np.sqrt(n)
    np.testing.assert_array_equal(noise[:, 0], 0)
    assert np.all(np.abs(noise.mean(axis=0)[1:]) < error * np.array([0.3, 2.0]))
    np.testing.assert_allclose(noise.std(axis=0)[1:], [0.3, 2.0], rtol=error / np.sqrt(2))
    assert abs(np.corrcoef(noise[:, 1], noise[:, 2])[0, 1]) < error


def test_noise_bounds():
    env = ObservationNoise(gym.make("Pendulum-v1"), [0.1, 0.0, 0.1])
    np.testing.assert_array_equal(env.observation_space.high, np.array([np.inf, 1, np.inf], dtype=np.float32))
    np.testing.assert_array_equal(env.observation_space.low, -env.observation_space.high)
    clipped = ObservationNoise(gym.make("Pendulum-v1"), 5.0, clip=True)
    assert clipped.observation_space == clipped.env.observation_space
    shown = np.array([clipped.reset(seed=s)[0] for s in range(50)])
    assert np.abs(shown).max(axis=0) == pytest.approx([1, 1, 8])  # most draws lie outside, none is shown
    assert shown.dtype == np.float32


def test_stacked_noise_draws_different_numbers():
    """Single on single, vector on vector, and vector around copies that are noisy already."""
    noise = [RandomStreams([7], STREAM + layer * STREAM_STRIDE).normal(2)[0] for layer in range(2)]
    expected = np.array([1, 10]) + noise[0] + noise[1]
    inner = ObservationNoise(Counter(BOX, np.float64), 1.0)
    doubled = ObservationNoise(gym.wrappers.TimeLimit(inner, 5), 1.0)
    around = vector.ObservationNoise(
        SyncVectorEnv([lambda: ObservationNoise(Counter(BOX, np.float64), 1.0)]), 1.0
    )
    bare = SyncVectorEnv([lambda: Counter(BOX, np.float64)])
    twice = vector.ObservationNoise(vector.ObservationNoise(bare, 1.0), 1.0)
    # two additions in another order: a few units in the last place of numbers near 10
    np.testing.assert_allclose(doubled.reset(seed=7)[0], expected, rtol=1e-14)
    np.testing.assert_allclose(around.reset(seed=7)[0][0], expected, rtol=1e-14)
    np.testing.assert_allclose(twice.reset(seed=7)[0][0], expected, rtol=1e-14)


def test_unseeded_noise_differs_from_one_environment_to_the_next():
    first, second = (ObservationNoise(Counter(BOX), 1.0).reset()[0] for _ in range(2))
    assert not np.array_equal(first, second)
    copies = vector.ObservationNoise(SyncVectorEnv([lambda: Counter(BOX)] * 2), 1.0).reset()[0]
    assert not np.array_equal(copies[0], copies[1])


@pytest.mark.parametrize(
    ("std", "message"),
    [
        ([0.1, 0.2, 0.3], r"one for each of the 2 components \(observation_0, observation_1\).*shape \(3,\)"),
        ([[0.1, 0.2]], r"shape \(1, 2\)"),
        (-0.1, "finite and at least 0, got -0.1 for 'observation_0'"),
        ([0.1, np.inf], "got inf for 'observation_1'"),
        (np.nan, "got nan"),
    ],
)
def test_noise_refuses(std, message):
    with pytest.raises(ValueError, match=message):
        ObservationNoise(Counter(BOX), std)


def test_noise_on_integers():
    with pytest.raises(TypeError, match=r"got int64.*DtypeObservation"):
        ObservationNoise(Counter(BOX, np.int64), 1.0)


WRAPPERS: dict[str, Any] = {
    "PartialObservation": lambda env: PartialObservation(env, keep=np.array([1, 0])),
    "ObservationNoise": lambda env: ObservationNoise(env, std=np.array([0.1, 0.1, 0.2])),
    "clipped ObservationNoise": lambda env: ObservationNoise(env, std=0.1, clip=True),
    "ObservationDelay": lambda env: ObservationDelay(env, steps=np.int64(2)),
    "ObservationDelay zeros": lambda env: ObservationDelay(env, steps=2, fill="zeros"),
    "ActionHistory": lambda env: ActionHistory(env, length=2),
    "DiscreteActions": lambda env: DiscreteActions(env, bins=np.array([3])),
    "MultiDiscrete actions": lambda env: DiscreteActions(env, bins=3, space="multi_discrete"),
    "stack": lambda env: ActionHistory(
        ObservationDelay(ObservationNoise(PartialObservation(DiscreteActions(env, 5), ["*_0", -1]), 0.2), 1),
        3,
    ),
}


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_spec_rebuilds_the_stack(wrapper):
    env = WRAPPERS[wrapper](gym.make("Pendulum-v1", max_episode_steps=9))
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec == env.spec
    rebuilt = gym.make(spec)
    assert str(rebuilt) == str(env)
    assert rebuilt.observation_space == env.observation_space
    assert rebuilt.action_space == env.action_space
    env.action_space.seed(0)
    np.testing.assert_array_equal(env.reset(seed=6)[0], rebuilt.reset(seed=6)[0])
    for t in range(9):
        action = env.action_space.sample()
        (shown, _, _, truncated, _), step = env.step(action), rebuilt.step(action)
        np.testing.assert_array_equal(shown, step[0])
        assert truncated == step[3] == (t == 8)


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_pickle_in_the_middle_of_an_episode(wrapper):
    env = WRAPPERS[wrapper](gym.make("Pendulum-v1"))
    env.reset(seed=1)
    for _ in range(4):
        env.step(env.action_space.sample())
    twin = pickle.loads(pickle.dumps(env))
    for t in range(8):
        action = env.action_space.sample()
        np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])
        if t == 4:  # the noise stream runs on over the reset
            options = {"x_init": 0.0, "y_init": 0.0}
            np.testing.assert_array_equal(env.reset(options=options)[0], twin.reset(options=options)[0])


def test_pickled_vector_wrapper_goes_on():
    import beliefgym  # noqa: F401  (registers the ids)

    env = gym.make_vec("beliefgym/Pendulum-v0", 4, "vector_entry_point", max_episode_steps=5)
    env = vector.ObservationDelay(vector.ObservationNoise(vector.ActionHistory(env, 1), 0.1), 2)
    env.reset(seed=1)
    actions = np.ones((4, 1), dtype=np.float32)
    for _ in range(5):  # NEXT_STEP: the resets are still to come
        env.step(actions)
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(12):
        np.testing.assert_array_equal(env.step(actions)[0], twin.step(actions)[0])


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "MountainCarContinuous-v0"])
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_checkers(wrapper, env_id):
    """Gymnasium's and SB3's checkers pass, without warnings beyond what the bare environment earns."""
    n_obs = gym.make(env_id).observation_space.shape[0]
    if "noise" in wrapper.lower() and n_obs != 3:
        env = ObservationNoise(gym.make(env_id), 0.1, clip="clipped" in wrapper)
    else:
        env = WRAPPERS[wrapper](gym.make(env_id))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
        sb3_check_env(env)
    unavoidable = (
        "different from the unwrapped version",  # the checker is told a wrapper
        "alternative environments",  # the same, from the spec
        "infinity",  # unclipped noise has no bounds
        "symmetric and normalized",  # Pendulum's own action space
    )
    left = [str(w.message) for w in caught if not any(text in str(w.message) for text in unavoidable)]
    assert not left


def test_attributes_pass_through():
    env = ObservationDelay(gym.make("Pendulum-v1", render_mode="rgb_array"), 1)
    env.reset(seed=0)
    assert env.render_mode == "rgb_array"
    env.set_wrapper_attr("g", 3.0)
    assert env.unwrapped.g == env.get_wrapper_attr("g") == 3.0
    around = vector.ObservationDelay(SyncVectorEnv([lambda: gym.make("Pendulum-v1")] * 2), 1)
    around.unwrapped.set_attr("g", [1.0, 2.0])
    assert around.unwrapped.get_attr("g") == (1.0, 2.0)
    around.close()
    assert around.closed
