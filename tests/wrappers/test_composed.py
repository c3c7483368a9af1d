"""Ids that are an environment with wrappers around it: single, vector, rebuilt, and with parameters."""

import gymnasium as gym
import numpy as np
import pytest

import beliefgym  # noqa: F401
from beliefgym.envs.registration import NAMESPACE, register_composed
from beliefgym.wrappers import ObservationDelay, ObservationNoise, PartialObservation
from beliefgym.wrappers.task import Task

ID = f"{NAMESPACE}/Composed-v7"


@pytest.fixture
def composed():
    register_composed(
        "Composed",
        system="beliefgym.envs.pendulum:Pendulum",
        layers=[("PartialObservation", {"keep": ["sin_theta"]}), ("ObservationDelay", {"steps": 1})],
        exposes={"delay": ("ObservationDelay", "steps")},
        parameters={"damping": 0.3},
        max_episode_steps=30,
        version=7,
    )
    yield ID
    del gym.registry[ID]


def test_it_is_the_environment_in_its_wrappers(composed):
    env = gym.make(composed, delay=3)
    by_hand = ObservationDelay(
        PartialObservation(gym.make("beliefgym/Pendulum-v0", damping=0.3), ["sin_theta"]), 3
    )
    assert env.unwrapped.system == by_hand.unwrapped.system
    assert np.array_equal(env.reset(seed=0)[0], by_hand.reset(seed=0)[0])
    for action in np.linspace(-2, 2, 10)[:, None]:
        assert np.array_equal(env.step(action)[0], by_hand.step(action)[0])


def test_its_spec_rebuilds_it_with_its_parameters(composed):
    env = gym.make(composed, delay=2)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert [type(layer) for layer in _layers(again)] == [type(layer) for layer in _layers(env)]
    assert again.reset(seed=1)[0] == env.reset(seed=1)[0]


def _layers(env):
    while env is not env.unwrapped:
        yield env
        env = env.env


def test_a_task_takes_the_native_vector_form(composed):
    env = Task(composed).make_vec(3)
    assert env.unwrapped.kernel_name in ("numba", "numpy")
    single = gym.make(composed)
    assert np.array_equal(env.reset(seed=5)[0][0], single.reset(seed=5)[0])
    asked = gym.make_vec(composed, 2, vectorization_mode="vector_entry_point", delay=0)
    assert asked.reset(seed=0)[0].shape == (2, 1)


def test_unknown_parameters_and_a_double_base_are_told(composed):
    with pytest.raises(TypeError, match="Pendulum has no parameter 'dely'"):
        gym.make(composed, dely=3)
    with pytest.raises(ValueError, match="expected either system or base, and not both"):
        register_composed("Nothing", layers=[], max_episode_steps=1)


def test_noise_and_delay_of_the_helicopter_by_parameter():
    quiet = gym.make("beliefgym/HelicopterHoverNoisy-v0", noise=0.0)
    assert quiet.reset(seed=0)[0] == pytest.approx(quiet.unwrapped.state, abs=1e-5)
    late = gym.make("beliefgym/HelicopterHoverDelayed-v0", delay=3)
    first, _ = late.reset(seed=0)
    for t in range(5):
        shown = late.step(np.full(4, 0.01))[0]
        assert np.array_equal(shown, first) == (t < 3)
    assert any(isinstance(layer, ObservationNoise) for layer in _layers(quiet))
