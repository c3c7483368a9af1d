"""`collect`: whole episodes, no length bias, final observations and states right, in every autoreset mode."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from beliefgym.envs.collect import collect
from beliefgym.envs.vector_env import SystemVectorEnv

MODES = list(AutoresetMode)


class Counting(gym.Env):
    """Shows (episode number, step, 1000 + length); copy k's episodes have `length` steps, or a random number."""

    observation_names = ("episode", "step", "length")
    hint_names = ("left",)

    def __init__(self, length=None, *, hint=False, forget_hint_at=None, terminates=True):
        self.observation_space = Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = Box(-np.inf, np.inf, (1,), np.float64)
        self.length, self.hint, self.forget_hint_at, self.terminates = (
            length,
            hint,
            forget_hint_at,
            terminates,
        )
        self.episode = -1

    @property
    def state(self):
        return np.array([self.episode, self.step_number])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode = 0 if seed is not None else self.episode + 1
        self.step_number = 0
        self.this_length = self.np_random.integers(1, 12) if self.length is None else self.length
        return self._observation(), self._info()

    def step(self, action):
        self.step_number += 1
        end = self.step_number >= self.this_length
        return self._observation(), 10.0 * self.step_number, end and self.terminates, end, self._info()

    def _observation(self):
        return np.array([self.episode, self.step_number, 1000 + self.this_length], dtype=np.float64)

    def _info(self):
        if not self.hint or self.step_number == self.forget_hint_at:
            return {}
        return {"hint": float(self.this_length - self.step_number)}


def counting(lengths, mode, **kwargs):
    return SyncVectorEnv([functools.partial(Counting, n, **kwargs) for n in lengths], autoreset_mode=mode)


def swing(observation):
    """A deterministic policy for Pendulum; it gives the float32 that goes to the environment."""
    return (2.0 * np.tanh(observation[:, 1:2] + observation[:, 2:3])).astype(np.float32)


def lean(observation):
    """A deterministic policy for CartPole."""
    return (observation[:, 2] + 0.5 * observation[:, 3] > 0).astype(int)


def loop(env, act, seeds):
    """Episodes by a plain loop, an episode a seed; a seed of None goes on with the environment's stream."""
    episodes = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        observations, actions, rewards, over = [observation], [], [], False
        while not over:
            action = act(observation[None])[0]
            observation, reward, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            observations.append(observation)
            actions.append(np.atleast_1d(action))
            rewards.append(reward)
        episodes.append((np.array(observations), np.array(actions), np.array(rewards), terminated))
    return episodes


def assert_same_episodes(sequences, expected):
    assert sequences.lengths.tolist() == [len(rewards) for _, _, rewards, _ in expected]
    for got, (observations, actions, rewards, terminated) in zip(
        sequences.to_episodes(), expected, strict=True
    ):
        np.testing.assert_array_equal(got["observations"], observations)
        np.testing.assert_array_equal(got["actions"], actions)
        np.testing.assert_array_equal(got["rewards"], rewards)
        assert got["terminated"] == terminated


TASKS = {"Pendulum-v1": (swing, {"max_episode_steps": 9}), "CartPole-v1": (lean, {})}


@pytest.mark.parametrize("task", TASKS)
def test_single_environment_against_a_loop(task):
    policy, kwargs = TASKS[task]
    sequences = collect(gym.make(task, **kwargs), policy, 5, seed=3)
    assert_same_episodes(sequences, loop(gym.make(task, **kwargs), policy, range(3, 8)))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", TASKS)
def test_vector_environment_against_loops(task, mode):
    """8 episodes on 3 copies: copy i runs episodes i, i + 3, i + 6."""
    policy, kwargs = TASKS[task]
    env = SyncVectorEnv([functools.partial(gym.make, task, **kwargs)] * 3, autoreset_mode=mode)
    sequences = collect(env, policy, 8, seed=3)
    single = gym.make(task, **kwargs)
    if mode == AutoresetMode.DISABLED:
        expected = loop(single, policy, range(3, 11))
    else:
        copies = [loop(single, policy, [3 + i, None, None]) for i in range(3)]
        expected = [copies[j % 3][j // 3] for j in range(8)]
    assert_same_episodes(sequences, expected)


@pytest.mark.parametrize("mode", MODES)
def test_no_length_bias(mode):
    """Every copy runs its share, however long its episodes; the first 8 to end would nearly all have 1 step."""
    sequences = collect(counting([1, 2, 20, 41], mode), None, 8, seed=0)
    assert sequences.lengths.tolist() == [1, 2, 20, 41] * 2
    assert collect(counting([1, 2, 20, 41], mode), None, 6, seed=0).lengths.tolist() == [1, 2, 20, 41, 1, 2]
    assert collect(counting([1, 2, 20, 41], mode), None, 2, seed=0).lengths.tolist() == [1, 2]


@pytest.mark.parametrize("mode", MODES)
def test_every_observation_reward_and_hint_is_its_own(mode):
    sequences = collect(counting([None] * 3, mode, hint=True), None, 17, seed=5)
    assert len(set(sequences.lengths.tolist())) > 4  # lengths vary, so that the copies run out of step
    for j, episode in enumerate(sequences.to_episodes()):
        steps = np.arange(sequences.lengths[j] + 1)
        number = 0 if mode == AutoresetMode.DISABLED else j // 3  # DISABLED seeds each episode anew
        np.testing.assert_array_equal(episode["observations"][:, 0], number)
        np.testing.assert_array_equal(episode["observations"][:, 1], steps)
        np.testing.assert_array_equal(episode["observations"][:, 2], 1000 + sequences.lengths[j])
        np.testing.assert_array_equal(episode["rewards"], 10.0 * steps[1:])
        np.testing.assert_array_equal(episode["hints"][:, 0], steps[::-1])
        assert episode["terminated"]
    assert sequences.observation_names == ("episode", "step", "length")
    assert sequences.hint_names == ("left",)


def test_single_environment_records_hints_and_states():
    sequences = collect(Counting(hint=True), None, 4, seed=5)
    for episode in sequences.to_episodes():
        steps = np.arange(len(episode["observations"]))
        np.testing.assert_array_equal(episode["hints"][:, 0], steps[::-1])
        np.testing.assert_array_equal(episode["states"], np.column_stack([np.zeros(len(steps)), steps]))


@pytest.mark.parametrize("mode", MODES)
def test_truncation_is_not_termination(mode):
    assert not collect(counting([3, 4], mode, terminates=False), None, 4, seed=0).terminated.any()


class Remembering:
    """Acts with the number of steps since the last episode start, as a recurrent policy would know it."""

    def __init__(self):
        self.deterministic = set()

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.deterministic.add(deterministic)
        state = np.zeros(len(observation)) if state is None else state + 1
        state = np.where(episode_start, 0, state)
        return state[:, None], state


class Logging(Remembering):
    """Also gives a log probability: minus the step, minus 100 times the episode."""

    def predict_with_log_prob(self, observation, state=None, episode_start=None, deterministic=False):
        action, state = self.predict(observation, state, episode_start, deterministic)
        return action, state, -observation[:, 1] - 100 * observation[:, 0]


@pytest.mark.parametrize("env", [*MODES, "single"])
def test_policy_memory_starts_anew_with_each_episode(env):
    env = Counting() if env == "single" else counting([None] * 3, env)
    policy = Remembering()
    sequences = collect(env, policy, 7, seed=1, deterministic=False)
    for length, episode in zip(sequences.lengths, sequences.to_episodes(), strict=True):
        np.testing.assert_array_equal(episode["actions"][:, 0], np.arange(length))
    assert policy.deterministic == {False}
    assert sequences.action_log_probs is None


@pytest.mark.parametrize("env", [*MODES, "single"])
def test_log_probabilities_of_the_policy_are_recorded(env):
    env = Counting() if env == "single" else counting([None] * 2, env)
    sequences = collect(env, Logging(), 5, seed=1)
    for episode in sequences.to_episodes():
        expected = -episode["observations"][:-1, 1] - 100 * episode["observations"][:-1, 0]
        np.testing.assert_array_equal(episode["action_log_probs"], expected)


def test_a_stable_baselines3_model_acts_as_by_its_own_predict():
    from stable_baselines3 import PPO

    model = PPO(
        "MlpPolicy",
        gym.make("Pendulum-v1", max_episode_steps=6),
        n_steps=8,
        batch_size=8,
        seed=0,
        device="cpu",
    )
    sequences = collect(gym.make("Pendulum-v1", max_episode_steps=6), model, 2, seed=0)
    assert sequences.metadata["policy"] == "PPO"
    first = sequences.observations[:, :-1].reshape(-1, 3).astype(np.float32)
    # float32 arithmetic in batches of another size
    np.testing.assert_allclose(
        sequences.actions.reshape(-1, 1), model.predict(first, deterministic=True)[0], atol=1e-5
    )


@pytest.mark.parametrize(("task", "log_prob"), [("Pendulum-v1", -np.log(4.0)), ("CartPole-v1", -np.log(2.0))])
@pytest.mark.parametrize("copies", [0, 3])
def test_the_random_policy_is_reproducible_and_knows_its_probabilities(task, log_prob, copies):
    def run(seed, policy=None):
        make = functools.partial(gym.make, task, max_episode_steps=8)
        env = SyncVectorEnv([make] * copies, autoreset_mode=AutoresetMode.SAME_STEP) if copies else make()
        return collect(env, policy, 5, seed=seed)

    assert run(1).equals(run(1, "random"))
    assert not run(1).equals(run(2))
    assert not np.array_equal(run(1).actions, run(2).actions)
    sequences = run(1)
    assert len(np.unique(sequences.actions[sequences.step_mask])) > 1
    np.testing.assert_allclose(
        sequences.action_log_probs[sequences.step_mask], log_prob, rtol=1e-12
    )  # rounding


def test_random_actions_without_bounds_have_no_probability():
    assert collect(Counting(2), None, 1, seed=0).action_log_probs is None


def test_the_environments_own_action_space_is_left_alone():
    env = gym.make("Pendulum-v1", max_episode_steps=3)
    env.action_space.seed(7)
    collect(env, None, 2, seed=0)
    expected = gym.make("Pendulum-v1").action_space
    expected.seed(7)
    np.testing.assert_array_equal(env.action_space.sample(), expected.sample())


@pytest.mark.parametrize("mode", MODES)
def test_states_of_the_native_vector_environment(mode):
    """Observation and state are of the same instant, at the end of an episode too."""
    env = SystemVectorEnv(
        "beliefgym.envs.pendulum:Pendulum", num_envs=3, max_episode_steps=7, hint=True, autoreset_mode=mode
    )
    sequences = collect(env, swing, 7, seed=2)
    assert sequences.lengths.tolist() == [7] * 7
    theta = sequences.states[:, :, 0]
    # observations are float32 of numbers of at most 8 in size
    np.testing.assert_allclose(sequences.observations[:, :, 0], np.cos(theta), atol=1e-6)
    np.testing.assert_allclose(sequences.observations[:, :, 2], sequences.states[:, :, 1], atol=1e-6)
    np.testing.assert_array_equal(sequences.hints, sequences.states)
    assert sequences.state_names == ("theta", "angular_velocity")
    assert sequences.observation_names == ("cos_theta", "sin_theta", "angular_velocity")
    assert sequences.action_names == ("torque",)
    assert sequences.metadata["dt"] == 0.05
    single = collect(gym.make("beliefgym/Pendulum-v0", max_episode_steps=7, hint=True), swing, 7, seed=2)
    same = slice(None) if mode == AutoresetMode.DISABLED else slice(3)
    np.testing.assert_array_equal(sequences.states[same], single.states[same])
    np.testing.assert_array_equal(sequences.observations[same], single.observations[same])
    assert single.state_names == sequences.state_names


class WithoutFinalState(SystemVectorEnv):
    """A native vector environment that does not tell the state at an episode's end."""

    def step(self, actions):
        *result, infos = super().step(actions)
        infos.pop("final_info", None)
        return *result, infos


@pytest.mark.parametrize(("mode", "known"), [("SAME_STEP", False), ("NEXT_STEP", True), ("DISABLED", True)])
def test_states_are_not_recorded_where_the_final_one_is_unknown(mode, known):
    env = WithoutFinalState(
        "beliefgym.envs.pendulum:Pendulum", num_envs=2, max_episode_steps=3, autoreset_mode=mode
    )
    sequences = collect(env, swing, 4, seed=0)
    assert (sequences.states is not None) == known
    assert len(sequences) == 4


def test_a_foreign_vector_environments_state_of_unsaid_layout_is_not_recorded():
    """Gymnasium's own vector CartPole keeps its state transposed: (4, n)."""
    env = gym.make_vec("CartPole-v1", num_envs=4, vectorization_mode="vector_entry_point")
    sequences = collect(env, lean, 10, seed=0)
    assert env.unwrapped.state.shape == (4, 4)
    assert sequences.states is None
    last = sequences.observations[np.arange(10), sequences.lengths]
    out = (np.abs(last[:, 0]) > 2.4) | (np.abs(last[:, 2]) > 0.2095)
    np.testing.assert_array_equal(sequences.terminated, out)
    assert not ((np.abs(sequences.observations[:, :, 2]) > 0.2095).sum(axis=1) > 1).any()


def test_states_of_a_foreign_single_environment():
    sequences = collect(gym.make("CartPole-v1"), lean, 3, seed=0)
    # CartPole shows its state, rounded to float32
    np.testing.assert_array_equal(sequences.states.astype(np.float32), sequences.observations)


@pytest.mark.parametrize("env", [*MODES, "single"])
def test_the_step_limit_truncates(env):
    single = env == "single"
    env = Counting(hint=True) if single else counting([None] * 3, env, hint=True)
    sequences = collect(env, Remembering(), 60, seed=5, max_steps_per_episode=4)
    for length, episode in zip(sequences.lengths, sequences.to_episodes(), strict=True):
        natural = int(episode["observations"][0, 2]) - 1000
        assert length == min(natural, 4)
        assert episode["terminated"] == (natural <= 4)
        np.testing.assert_array_equal(episode["observations"][:, 1], np.arange(length + 1))
        np.testing.assert_array_equal(episode["hints"][:, 0], natural - np.arange(length + 1))
        np.testing.assert_array_equal(episode["actions"][:, 0], np.arange(length))
    assert {True, False} == set(sequences.terminated.tolist())


@pytest.mark.parametrize("mode", MODES)
def test_the_step_limit_on_an_environment_that_never_ends(mode):
    env = SystemVectorEnv("beliefgym.envs.pendulum:Pendulum", num_envs=3, autoreset_mode=mode)
    sequences = collect(env, swing, 7, seed=2, max_steps_per_episode=5)
    assert sequences.lengths.tolist() == [5] * 7
    np.testing.assert_allclose(sequences.observations[:, :, 0], np.cos(sequences.states[:, :, 0]), atol=1e-6)
    assert len(np.unique(sequences.states[:, 0, 0])) == 7


def test_an_environment_that_resets_all_copies_is_found_out():
    class Careless(SyncVectorEnv):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)

    env = Careless([functools.partial(Counting, n) for n in (2, 9)], autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(
        RuntimeError, match=r"expected .* to reset copies \[0\] only, .* but other copies changed"
    ):
        collect(env, None, 4, seed=0)


def test_asynchronous_copies():
    make = functools.partial(gym.make, "Pendulum-v1", max_episode_steps=4)
    env = AsyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    try:
        sequences = collect(env, swing, 3, seed=0)
    finally:
        env.close()
    sync = collect(SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode.SAME_STEP), swing, 3, seed=0)
    np.testing.assert_array_equal(sequences.observations, sync.observations)


def test_discrete_observations_become_a_column_and_images_many():
    lake = collect(gym.make("FrozenLake-v1"), None, 3, seed=0)
    assert lake.n_obs == 1
    assert set(np.unique(lake.observations)) <= set(range(16))

    class Image(Counting):
        def __init__(self):
            super().__init__(2)
            self.observation_space = Box(0, 255, (2, 3), np.uint8)

        def _observation(self):
            return np.full((2, 3), self.step_number, dtype=np.uint8)

    images = collect(Image(), None, 1, seed=0)
    np.testing.assert_array_equal(images.observations[0], np.repeat([[0], [1], [2]], 6, axis=1))
    assert images.observation_names is None  # three names do not name six components


def test_names_come_from_the_outermost_layer_that_has_them():
    class Renamed(gym.Wrapper):
        observation_names = ("a", "b", "c")

    env = Renamed(Counting(2))
    assert collect(env, None, 1, seed=0).observation_names == ("a", "b", "c")
    for useless in (("a", "a", "b"), ("a", "b", "c", "c"), "abc", (1, 2, 3)):
        env.observation_names = useless
        assert collect(env, None, 1, seed=0).observation_names is None


def test_metadata_says_where_the_episodes_come_from():
    metadata = collect(gym.make("Pendulum-v1", max_episode_steps=2), swing, 1, seed=4).metadata
    assert metadata["env_id"] == metadata["env_spec"]["id"] == "Pendulum-v1"
    assert (metadata["seed"], metadata["policy"], metadata["dt"]) == (4, "swing", 0.05)
    assert collect(Counting(2), None, 1, seed=0).metadata["env_id"] == "Counting"


def test_progress_is_shown_when_asked_for(capsys):
    collect(Counting(2), None, 3, seed=0)
    assert capsys.readouterr().err == ""
    collect(Counting(2), None, 3, seed=0, progress_bar=True)
    assert "3/3" in capsys.readouterr().err


class Modeless(SyncVectorEnv):
    def __init__(self):
        super().__init__([Counting] * 2)
        self.metadata = {}


class Forgetful(SyncVectorEnv):
    def step(self, actions):
        *result, infos = super().step(actions)
        infos.pop("final_obs", None)
        return *result, infos


class Strange(Counting):
    def __init__(self):
        super().__init__()
        self.observation_space = Dict({"a": Discrete(2)})


class StrangeAction(Counting):
    def __init__(self):
        super().__init__()
        self.action_space = Dict({"a": Discrete(2)})


@pytest.mark.parametrize(
    ("error", "message", "arguments"),
    [
        (ValueError, "expected n_episodes to be a whole number of at least 1, got 0", {"n_episodes": 0}),
        (
            ValueError,
            r"expected n_episodes to be a whole number of at least 1, got 2\.0",
            {"n_episodes": 2.0},
        ),
        (ValueError, "expected seed to be a whole number of at least 0, got -1", {"seed": -1}),
        (ValueError, "expected seed to be a whole number of at least 0, got None", {"seed": None}),
        (
            ValueError,
            "expected max_steps_per_episode to be a whole number of at least 1",
            {"max_steps_per_episode": 0},
        ),
        (
            TypeError,
            r"expected a gymnasium\.Env or gymnasium\.vector\.VectorEnv, got str",
            {"env": "Pendulum-v1"},
        ),
        (
            TypeError,
            r'expected a policy that is None, "random", a function .*got \'rand\'',
            {"policy": "rand"},
        ),
        (
            ValueError,
            r"expected actions of shape \(1, 1\) for Box.* from <lambda>, got \(3,\)",
            {"policy": lambda observation: np.zeros(3)},
        ),
        (
            ValueError,
            r"expected finite actions from .*, got nan for copy 0 of 1 at step 0 of the run; look at the policy",
            {"policy": lambda observation: np.full((1, 1), np.nan)},
        ),
        (
            ValueError,
            "expected numbers as actions from <lambda>, got dtype <U1",
            {"policy": lambda observation: np.array([["a"]])},
        ),
        (
            ValueError,
            r"expected whole numbers as actions for Discrete\(2\)",
            {"env": gym.make("CartPole-v1"), "policy": lambda observation: np.array([0.5])},
        ),
        (
            ValueError,
            "expected actions from 0 to 1 from <lambda>, got",
            {"env": gym.make("CartPole-v1"), "policy": lambda observation: np.array([[2]])},
        ),
        (
            ValueError,
            r"expected a Box or Discrete observation space, got Dict.*FlattenObservation",
            {"env": Strange()},
        ),
        (
            ValueError,
            "expected a Box, Discrete, MultiDiscrete or MultiBinary action space, got Dict",
            {"env": StrangeAction()},
        ),
        (
            ValueError,
            r"expected env\.metadata\['autoreset_mode'\] to be one of .*, got None",
            {"env": Modeless()},
        ),
        (
            ValueError,
            r"expected 'final_obs' in the infos of copies \[0\] .* at step 3 \(autoreset SAME_STEP\), got the keys",
            {"env": Forgetful([functools.partial(Counting, n) for n in (3, 4)], autoreset_mode="SameStep")},
        ),
        (
            ValueError,
            r"expected 'hint' in the infos of copies \[0\] .* at step 2 \(autoreset DISABLED\), got the keys \[\]",
            {"env": Counting(4, hint=True, forget_hint_at=2)},
        ),
    ],
)
def test_bad_arguments(error, message, arguments):
    arguments = {"env": Counting(), "policy": None, "n_episodes": 2, "seed": 0, **arguments}
    with pytest.raises(error, match=message):
        collect(**arguments)


def test_a_log_probability_of_the_wrong_shape():
    class Wrong(Logging):
        def predict_with_log_prob(self, observation, state=None, episode_start=None, deterministic=False):
            return np.zeros((1, 1)), None, np.zeros((1, 1))

    with pytest.raises(ValueError, match=r"expected log_prob of shape \(1,\) from Wrong, got \(1, 1\)"):
        collect(Counting(), Wrong(), 1, seed=0)


def test_an_environment_that_gives_nan_is_named():
    class Broken(Counting):
        def _observation(self):
            observation = super()._observation()
            observation[1] = np.nan if self.step_number == 2 else 0.0
            return observation

    with pytest.raises(
        ValueError, match=r"observations: .* got nan at episode 0, step 2, component 1 \('step'\)"
    ):
        collect(Broken(3), None, 1, seed=0)
