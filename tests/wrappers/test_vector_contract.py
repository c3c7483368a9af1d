"""The contract of every wrapper: around n copies it shows what n wrapped single environments show, bit for bit."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import TimeLimit

import beliefgym.wrappers as single
import beliefgym.wrappers.vector as vector
from beliefgym.learning import Sequences
from beliefgym.learning.filters import ActionTiming, Filter

N = 3
Stack = list[tuple[str, dict[str, Any]]]


class Leaky(Filter):
    """m_{t+1} = m_t / 2 + (x_t, a_t or a_{t-1}): no matrix product, whose rounding depends on the number of copies."""

    def __init__(self, timing: ActionTiming, standardise: bool = True) -> None:
        self.timing, self.standardise = timing, standardise
        self.action_timing = timing

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Leaky:
        self._begin(train, validation)
        self.model_ = None
        return self

    def _initial(self) -> Any:
        return np.ones(self.n_obs_ + (self._action_coding.size if self.n_act_ else 0))

    def _update(self, belief: Any, z: Any) -> Any:
        return 0.5 * belief + z

    def _observe(self, belief: Any) -> Any:
        return belief[:, : self.n_obs_]


def leaky(timing: ActionTiming) -> dict[str, Any]:
    """A filter of two observations and one action."""
    rng = np.random.default_rng(0)
    data = Sequences.from_observations(rng.standard_normal((5, 9, 2)), actions=rng.random((5, 8, 1)))
    return {"filter": Leaky(timing).fit(data)}


STACKS: dict[str, Stack] = {
    "partial": [("PartialObservation", {"keep": [-1, 0]})],
    "noise": [("ObservationNoise", {"std": 0.3})],
    "clipped noise": [("ObservationNoise", {"std": 0.3, "clip": True})],
    "delay 0": [("ObservationDelay", {"steps": 0})],
    "delay 1": [("ObservationDelay", {"steps": 1})],
    "delay 3": [("ObservationDelay", {"steps": 3})],
    "delay 9 zeros": [("ObservationDelay", {"steps": 9, "fill": "zeros"})],
    "history 1": [("ActionHistory", {"length": 1})],
    "history 4": [("ActionHistory", {"length": 4})],
    "belief": [("PartialObservation", {"keep": [0, 1]}), ("BeliefObservation", leaky("none"))],
    "belief, previous action": [
        ("PartialObservation", {"keep": [0, 1]}),
        ("BeliefObservation", {**leaky("previous"), "include_observation": False}),
    ],
    "belief, present action": [
        ("PartialObservation", {"keep": [0, 1]}),
        ("BeliefObservation", leaky("present")),
    ],
    "delayed noise": [("ObservationNoise", {"std": 0.1}), ("ObservationDelay", {"steps": 2})],
    "noisy delay": [("ObservationDelay", {"steps": 2, "fill": "zeros"}), ("ObservationNoise", {"std": 0.1})],
    "everything": [
        ("PartialObservation", {"keep": [0, 1]}),
        ("ObservationNoise", {"std": 0.1}),
        ("ObservationDelay", {"steps": 2}),
        ("BeliefObservation", leaky("previous")),
        ("ActionHistory", {"length": 2}),
        ("ObservationNoise", {"std": 0.2}),
    ],
}
CONTINUOUS_STACKS: dict[str, Stack] = {
    "discrete": [("DiscreteActions", {"bins": 5})],
    "multi-discrete": [("DiscreteActions", {"bins": 4, "space": "multi_discrete"})],
    "discrete, history": [("DiscreteActions", {"bins": 5}), ("ActionHistory", {"length": 2})],
}
MODES = list(AutoresetMode)


def pendulum(i: int) -> gym.Env[Any, Any]:
    """Copies that end at different times, and sometimes together."""
    return TimeLimit(gym.make("Pendulum-v1", max_episode_steps=-1).unwrapped, 4 + 2 * i)


def cart_pole(i: int) -> gym.Env[Any, Any]:
    """Episodes that end by themselves after some ten to forty steps."""
    return gym.make("CartPole-v1")


def stacked(env: Any, stack: Stack, module: Any) -> Any:
    for name, arguments in stack:
        env = getattr(module, name)(env, **arguments)
    return env


def both(make: Any, stack: Stack, mode: AutoresetMode) -> tuple[VectorEnv, VectorEnv]:
    """The wrapper around the vector environment, and the vector environment of wrapped copies."""
    around = stacked(
        SyncVectorEnv([lambda i=i: make(i) for i in range(N)], autoreset_mode=mode), stack, vector
    )
    within = SyncVectorEnv(
        [lambda i=i: stacked(make(i), stack, single) for i in range(N)], autoreset_mode=mode
    )
    return around, within


def assert_same(ours: Any, theirs: Any) -> None:
    """Equal to the last bit, in value and type, through dictionaries and object arrays."""
    assert type(ours) is type(theirs)
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys()
        for key in ours:
            assert_same(ours[key], theirs[key])
    elif isinstance(ours, np.ndarray) and ours.dtype == object:
        for one, other in zip(ours, theirs, strict=True):
            assert_same(one, other)
    elif isinstance(ours, np.ndarray):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    else:
        assert ours == theirs


def run_side_by_side(around: VectorEnv, within: VectorEnv, mode: AutoresetMode, n_steps: int) -> int:
    """Step both with the same actions, resetting as the mode asks; returns how many episodes ended."""
    assert around.single_observation_space == within.single_observation_space
    assert around.observation_space == within.observation_space
    assert around.single_action_space == within.single_action_space
    assert around.action_space == within.action_space
    around.action_space.seed(1)
    ended = 0
    seeds: dict[int, Any] = {0: 7, n_steps // 2: [3, None, 11], 3 * n_steps // 4: None}
    for t in range(n_steps):
        if t in seeds:
            first, first_within = around.reset(seed=seeds[t]), within.reset(seed=seeds[t])
            assert_same(first[0], first_within[0])
            assert_same(first[1], first_within[1])
        actions = around.action_space.sample()
        ours, theirs = around.step(actions), within.step(actions)
        for one, other in zip(ours, theirs, strict=True):
            assert_same(one, other)
        assert around.observation_space.contains(ours[0])
        done = ours[2] | ours[3]
        ended += int(done.sum())
        if mode is AutoresetMode.DISABLED and done.any():
            seed = [100 + t, None, 200 + t] if t % 3 == 0 else None
            begun = [e.reset(seed=seed, options={"reset_mask": done.copy()}) for e in (around, within)]
            assert_same(begun[0][0], begun[1][0])
            assert_same(begun[0][0][~done], ours[0][~done])
    around.close()
    within.close()
    return ended


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("stack", [*STACKS, *CONTINUOUS_STACKS])
def test_vector_form_is_single_form_on_pendulum(stack: str, mode: AutoresetMode) -> None:
    around, within = both(pendulum, (STACKS | CONTINUOUS_STACKS)[stack], mode)
    assert run_side_by_side(around, within, mode, 300) > 50


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("stack", STACKS)
def test_vector_form_is_single_form_on_cart_pole(stack: str, mode: AutoresetMode) -> None:
    around, within = both(cart_pole, STACKS[stack], mode)
    assert run_side_by_side(around, within, mode, 300) > 10


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_a_mask_may_end_an_episode_early(mode: AutoresetMode) -> None:
    """`reset_mask` on copies that have not ended, and on ones whose reset NEXT_STEP has still to come."""
    around, within = both(pendulum, STACKS["everything"], mode)
    for env in (around, within):
        env.reset(seed=5)
    rng = np.random.default_rng(0)
    around.action_space.seed(0)
    for _ in range(200):
        actions = around.action_space.sample()
        ours, theirs = around.step(actions), within.step(actions)
        for one, other in zip(ours, theirs, strict=True):
            assert_same(one, other)
        mask = rng.random(N) < 0.3
        if mode is AutoresetMode.DISABLED:
            mask |= ours[2] | ours[3]
        if mask.any():
            begun = [e.reset(options={"reset_mask": mask.copy()})[0] for e in (around, within)]
            assert_same(begun[0], begun[1])
        elif rng.random() < 0.3:  # all of them
            assert_same(*(e.reset()[0] for e in (around, within)))


@pytest.mark.parametrize("stack", [STACKS["everything"], STACKS["delay 0"]], ids=["everything", "delay 0"])
def test_async_copies(stack: Stack) -> None:
    """An AsyncVectorEnv hands out a buffer that it writes into again."""
    fns = [lambda i=i: pendulum(i) for i in range(2)]
    around = stacked(AsyncVectorEnv(fns, copy=False, autoreset_mode=AutoresetMode.SAME_STEP), stack, vector)
    reference = stacked(SyncVectorEnv(fns, autoreset_mode=AutoresetMode.SAME_STEP), stack, vector)
    kept = [(around.reset(seed=2)[0], reference.reset(seed=2)[0])]
    for _ in range(30):
        actions = reference.action_space.sample()
        kept.append((around.step(actions)[0], reference.step(actions)[0]))
    around.close()
    for ours, theirs in kept:
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("env_id", ["beliefgym/Pendulum-v0", "beliefgym/CartPoleSwingUp-v0"])
def test_around_the_native_vector_environment(env_id: str, mode: AutoresetMode) -> None:
    import beliefgym  # noqa: F401  (registers the ids)

    stack = STACKS["everything"]
    native = gym.make_vec(
        env_id,
        num_envs=N,
        vectorization_mode="vector_entry_point",
        autoreset_mode=mode.name,
        max_episode_steps=6,
    )
    around = stacked(native, stack, vector)
    within = SyncVectorEnv(
        [lambda: stacked(gym.make(env_id, max_episode_steps=6), stack, single) for _ in range(N)],
        autoreset_mode=mode,
    )
    assert around.observation_names == within.envs[0].get_wrapper_attr("observation_names")
    shown = [env.reset(seed=4)[0] for env in (around, within)]
    around.action_space.seed(4)
    for _ in range(60):
        np.testing.assert_array_equal(*shown)
        actions = around.action_space.sample()
        steps = [env.step(actions) for env in (around, within)]
        shown = [step[0] for step in steps]
        done = steps[0][3]
        np.testing.assert_array_equal(done, steps[1][3])
        if done.any() and mode is AutoresetMode.SAME_STEP:
            assert_same(steps[0][4]["final_obs"], steps[1][4]["final_obs"])
        if done.any() and mode is AutoresetMode.DISABLED:
            shown = [env.reset(options={"reset_mask": done.copy()})[0] for env in (around, within)]


def test_what_is_given_out_is_not_written_into_again() -> None:
    """Every array handed out keeps its values; writing into one changes nothing that comes later."""
    spoilt, clean = (
        stacked(SyncVectorEnv([lambda: gym.make("CartPole-v1")] * N), STACKS["everything"], vector)
        for _ in range(2)
    )
    given = spoilt.reset(seed=0)[0]
    expected = clean.reset(seed=0)[0]
    for t in range(60):
        np.testing.assert_array_equal(given, expected)
        copies = given.copy()
        actions = np.full(N, t % 2)
        kept, given = given, spoilt.step(actions)[0]
        np.testing.assert_array_equal(kept, copies)
        kept[:] = np.nan
        expected = clean.step(actions)[0]


def test_copies_that_are_not_reset_show_again_what_they_showed() -> None:
    """... even where the caller has written into what he got."""
    env = SyncVectorEnv([lambda: pendulum(0)] * N, autoreset_mode=AutoresetMode.DISABLED)
    wrapped = vector.ObservationNoise(env, 1.0)
    shown = wrapped.reset(seed=0)[0]
    expected = shown.copy()
    shown[:] = np.nan
    begun = wrapped.reset(options={"reset_mask": np.array([False, True, False])})[0]
    np.testing.assert_array_equal(begun[[0, 2]], expected[[0, 2]])
    assert not np.array_equal(begun[1], expected[1])


def test_infos_of_the_environment_stay_as_they_are() -> None:
    """final_obs is replaced in the wrapper's own infos, not in the dictionary that came from below."""
    env = SyncVectorEnv([lambda: pendulum(0)] * N, autoreset_mode=AutoresetMode.SAME_STEP)
    seen: list[dict[str, Any]] = []
    step = env.step

    def recorded_step(actions: Any) -> Any:
        result = step(actions)
        seen.append(result[4])
        return result

    env.step = recorded_step  # type: ignore[method-assign]
    wrapped = vector.PartialObservation(env, [0])
    wrapped.reset(seed=0)
    for _ in range(4):
        infos = wrapped.step(np.zeros((N, 1), dtype=np.float32))[4]
    assert infos["final_obs"][0].shape == (1,)
    assert seen[-1]["final_obs"][0].shape == (3,)
    assert infos["_final_obs"].all()


def test_single_form_on_a_vector_environment_names_the_right_class() -> None:
    env = SyncVectorEnv([lambda: gym.make("Pendulum-v1")])
    for name, arguments in [*STACKS["everything"], *CONTINUOUS_STACKS["discrete"]]:
        with pytest.raises(TypeError, match=rf"use beliefgym\.wrappers\.vector\.{name}"):
            getattr(single, name)(env, **arguments)


def test_vector_form_on_a_single_environment_names_the_right_class() -> None:
    env = gym.make("Pendulum-v1")
    for name, arguments in [*STACKS["everything"], *CONTINUOUS_STACKS["discrete"]]:
        with pytest.raises(TypeError, match=rf"use beliefgym\.wrappers\.{name}"):
            getattr(vector, name)(env, **arguments)


@pytest.mark.parametrize("module", [single, vector], ids=["single", "vector"])
def test_something_else_than_an_environment(module: Any) -> None:
    for name, arguments in [*STACKS["partial"], *CONTINUOUS_STACKS["discrete"]]:
        with pytest.raises(TypeError, match="got int"):
            getattr(module, name)(3, **arguments)


def test_observation_that_is_no_vector() -> None:
    env = gym.make("FrozenLake-v1")
    with pytest.raises(TypeError, match=r"one-dimensional Box .* Discrete\(16\).*gymnasium.wrappers.Flatten"):
        single.ObservationDelay(env, 1)
    with pytest.raises(TypeError, match=r"gymnasium.wrappers.vector.FlattenObservation"):
        vector.ObservationDelay(SyncVectorEnv([lambda: gym.make("FrozenLake-v1")]), 1)


def test_vector_environment_that_does_not_say_how_it_resets() -> None:
    env = SyncVectorEnv([lambda: gym.make("Pendulum-v1")])
    del env.metadata["autoreset_mode"]
    with pytest.raises(ValueError, match=r"expected env.metadata.*AutoresetMode, got None"):
        vector.ObservationDelay(env, 1)


def test_same_step_without_final_observations() -> None:
    """A vector environment that drops them must not be passed over in silence."""
    env = SyncVectorEnv([lambda: pendulum(0)], autoreset_mode=AutoresetMode.SAME_STEP)
    step = env.step
    env.step = lambda actions: (*step(actions)[:4], {})  # type: ignore[method-assign]
    wrapped = vector.ObservationDelay(env, 1)
    wrapped.reset(seed=0)
    actions = np.zeros((1, 1), dtype=np.float32)
    for _ in range(3):
        wrapped.step(actions)
    with pytest.raises(RuntimeError, match=r"without infos\['final_obs'\]"):
        wrapped.step(actions)
