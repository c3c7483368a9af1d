"""What an agent is shown of a belief is what the filter says of the recorded episodes, in every form and mode."""

from __future__ import annotations

import pickle
import warnings
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from sklearn.exceptions import NotFittedError
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import beliefgym  # noqa: F401  (registers the ids)
from beliefgym.envs import ParticleFilter, UnscentedKalmanFilter, collect
from beliefgym.learning import (
    PSIM,
    AutoregressiveFilter,
    PSIMActions,
    PSIMHints,
    RandomFourierRidge,
    Sequences,
    save_filter,
)
from beliefgym.learning.belief_tracker import shown
from beliefgym.learning.filters import Filter
from beliefgym.wrappers import ActionHistory, BeliefObservation, DiscreteActions, SB3VecEnv, Task, vector
from beliefgym.wrappers.torchrl import torchrl_env

ID = "beliefgym/CartPoleSwingUpPosition-v0"
CHOICES = "beliefgym/CartPoleBalancePosition-v0"  # two pushes; episodes end by themselves
CLOSE = 1e-6  # numbers of up to 8 in float32
MODES = list(AutoresetMode)
LIMIT = 60


class Pushing:
    """One way or the other, by the episode, so that carts leave their track at different times."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        n = len(observation)
        state = np.zeros(n) if state is None else state
        state = np.where(episode_start, self.rng.uniform(-10, 10, n), state)
        return (state + self.rng.uniform(-3, 3, n))[:, None].astype(np.float32), state


class Explode(Filter):
    """m_{t+1} = 1e12 m_t + z_t, without bounds."""

    def __init__(self, standardise: bool = True) -> None:
        self.standardise = standardise

    def fit(self, train, validation=None):
        self._begin(train, validation)
        self.model_ = None
        return self

    def _initial(self):
        return np.ones(self.n_obs_)

    def _update(self, belief, z):
        return 1e12 * belief + z

    def _observe(self, belief):
        return belief


class Repeat(gym.Wrapper):
    """Each action three times."""

    def step(self, action):
        total = 0.0
        for _ in range(3):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


def native(n: int, mode: AutoresetMode = AutoresetMode.SAME_STEP, env_id: str = ID, **kwargs: Any) -> Any:
    return gym.make_vec(
        env_id,
        n,
        vectorization_mode="vector_entry_point",
        autoreset_mode=mode.name,
        max_episode_steps=LIMIT,
        **kwargs,
    )


def single(env_id: str = ID, **kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make(env_id, max_episode_steps=LIMIT, **kwargs)


DATA = collect(native(16, hint=True), Pushing(), 48, seed=0)
CHOICE_DATA = collect(native(16, env_id=CHOICES, hint=True), "random", 48, seed=0)
SYSTEM = native(1).unwrapped.system
SEEN = {"system": SYSTEM, "observed": DATA.observation_names, "observation_noise_std": 0.05}

FILTERS: dict[str, Filter] = {
    "PSIM": PSIM(n_iterations=2),
    "PSIM, random features": PSIM(
        RandomFourierRidge(n_frequencies=30, include_inputs=True, random_state=0), n_iterations=2
    ),
    "autoregression": AutoregressiveFilter(n_past=3),
    "hints": PSIMHints(n_iterations=2, preimage="belief"),
    "previous": PSIMHints(n_iterations=2, preimage="belief", use_actions=True),
    "present": PSIMActions(n_iterations=2),
    "unscented": UnscentedKalmanFilter(**SEEN),
}
CHOICE_FILTERS: dict[str, Filter] = {
    "previous choice": PSIMHints(n_iterations=2, preimage="belief", use_actions=True, n_choices=2),
    "present choice": PSIMActions(n_iterations=2, n_choices=2),
    "choice as a number": PSIMActions(n_iterations=2),
}
for fitted in FILTERS.values():
    fitted.fit(DATA)
for fitted in CHOICE_FILTERS.values():
    fitted.fit(CHOICE_DATA)


def split(seen: Sequences, n_obs: int) -> tuple[Sequences, np.ndarray]:
    """What stood below the wrapper, as episodes, and what it appended."""
    below = Sequences(
        seen.observations[:, :, :n_obs],
        seen.actions,
        seen.rewards,
        lengths=seen.lengths,
        terminated=seen.terminated,
    )
    return below, seen.observations[:, :, n_obs:]


def assert_as_recorded(
    env: Any, filter: Filter, policy: Any, n_episodes: int, show: Any = "belief"
) -> Sequences:
    """Collect through the wrapper, and filter what stood below it afterwards."""
    seen = collect(env, policy, n_episodes, seed=3)
    below, appended = split(seen, filter.n_obs_)
    expected = shown(filter, below, show)
    mask = below.observation_mask
    assert appended.shape == expected.shape
    np.testing.assert_allclose(appended[mask], expected[mask], rtol=CLOSE, atol=CLOSE)
    assert len(set(seen.lengths)) > 1  # copies do end at different times
    assert appended[mask].std() > 0.1
    return seen


@pytest.mark.filterwarnings(
    "ignore:a belief of this"
)  # `Filter.beliefs` steps past the end of short episodes
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", FILTERS)
def test_what_is_shown_is_the_belief_of_the_recorded_episodes(name, mode):
    """Over resets, each copy at its own time, final observations and partial resets included."""
    env = vector.BeliefObservation(native(5, mode), FILTERS[name])
    assert_as_recorded(env, FILTERS[name], Pushing(1), 17)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", CHOICE_FILTERS)
def test_discrete_actions(name, mode):
    env = vector.BeliefObservation(native(4, mode, CHOICES), CHOICE_FILTERS[name])
    assert_as_recorded(env, CHOICE_FILTERS[name], "random", 11)


@pytest.mark.parametrize("name", FILTERS)
def test_single_environment(name):
    assert_as_recorded(BeliefObservation(single(), FILTERS[name]), FILTERS[name], Pushing(1), 5)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", ["hints", "previous", "unscented"])
def test_estimated_hints(name, mode):
    filter = FILTERS[name]
    env = vector.BeliefObservation(native(5, mode), filter, show="hint")
    assert env.observation_names[3:] == (
        *(f"hint[{hint}]" for hint in DATA.hint_names),
        *(f"hint_std[{hint}]" for hint in DATA.hint_names),
    )
    seen = assert_as_recorded(env, filter, Pushing(1), 10, "hint")
    below, appended = split(seen, 3)
    mean, std = filter.estimate_hints(below)
    mask, scale = below.observation_mask, filter._hint_scale
    np.testing.assert_allclose(
        scale.invert(appended[:, :, :4])[mask], mean[mask], atol=CLOSE * scale.scale.max() * 10
    )
    np.testing.assert_allclose(appended[mask][:, 4:], (std / scale.scale)[mask], rtol=1e-5, atol=CLOSE)


@pytest.mark.parametrize("max_steps", [7, 23])
@pytest.mark.parametrize(
    "mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP], ids=lambda mode: mode.name
)
@pytest.mark.parametrize("name", ["PSIM", "previous", "present"])
def test_episodes_cut_off_by_a_mask(name, mode, max_steps):
    """`reset_mask` on copies that have not ended, and beside those that reset themselves."""
    filter = FILTERS[name]
    env = vector.BeliefObservation(native(5, mode), filter)
    seen = collect(env, Pushing(2), 15, seed=3, max_steps_per_episode=max_steps)
    below, appended = split(seen, 3)
    mask = below.observation_mask
    np.testing.assert_allclose(appended[mask], filter.summaries(below)[mask], rtol=CLOSE, atol=CLOSE)


@pytest.mark.parametrize("name", FILTERS)
def test_the_belief_alone_is_the_rest(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        alone = vector.BeliefObservation(native(4), FILTERS[name], include_observation=False)
    beside = vector.BeliefObservation(native(4), FILTERS[name])
    assert alone.observation_names == beside.observation_names[3:] == FILTERS[name].summary_names
    assert alone.single_observation_space.shape == (FILTERS[name].summary_size,)
    seen = [collect(env, Pushing(1), 6, seed=2).observations for env in (alone, beside)]
    np.testing.assert_array_equal(seen[0], seen[1][:, :, 3:])


def test_the_space_keeps_the_bounds_below():
    env = BeliefObservation(single(), FILTERS["PSIM"])
    below = env.env.observation_space
    assert env.observation_space.dtype == below.dtype == np.float32
    np.testing.assert_array_equal(env.observation_space.low[:3], below.low)
    np.testing.assert_array_equal(env.observation_space.high[:3], below.high)
    assert np.isinf(env.observation_space.low[3:]).all()
    assert env.observation_names[:4] == ("x", "cos_theta", "sin_theta", "belief_0")
    twice = BeliefObservation(env, AutoregressiveFilter(n_past=1).fit(collect(env, Pushing(), 4, seed=0)))
    assert twice.observation_names[-1] == "belief_17#2"  # 3 + 15 components below


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", ["PSIM", "previous", "present", "unscented"])
def test_a_copy_shows_what_it_would_show_alone(name, mode):
    around = vector.BeliefObservation(SyncVectorEnv([single] * 3, autoreset_mode=mode), FILTERS[name])
    within = SyncVectorEnv([lambda: BeliefObservation(single(), FILTERS[name])] * 3, autoreset_mode=mode)
    assert around.single_observation_space == within.single_observation_space
    seen = [collect(env, Pushing(4), 8, seed=5) for env in (around, within)]
    np.testing.assert_array_equal(seen[0].lengths, seen[1].lengths)
    np.testing.assert_allclose(seen[0].observations, seen[1].observations, rtol=CLOSE, atol=CLOSE)


@pytest.mark.parametrize("name", ["PSIM", "previous", "present"])
def test_copies_in_processes_of_their_own(name):
    """The filter goes there by pickle; around an `AsyncVectorEnv` it gets a buffer that is written into again."""
    make = partial(_wrapped, FILTERS[name])
    mode = AutoresetMode.SAME_STEP
    within = AsyncVectorEnv([make] * 2, autoreset_mode=mode)
    around = vector.BeliefObservation(
        AsyncVectorEnv([single] * 2, copy=False, autoreset_mode=mode), FILTERS[name]
    )
    reference = vector.BeliefObservation(SyncVectorEnv([single] * 2, autoreset_mode=mode), FILTERS[name])
    seen = [collect(env, Pushing(4), 4, seed=5).observations for env in (within, around, reference)]
    within.close()
    around.close()
    np.testing.assert_allclose(seen[0], seen[2], rtol=CLOSE, atol=CLOSE)
    np.testing.assert_array_equal(seen[1], seen[2])


def _wrapped(filter: Filter) -> gym.Env[Any, Any]:
    return BeliefObservation(single(), filter)


@pytest.mark.parametrize("name", ["PSIM", "previous", "present", "unscented"])
def test_actions_repeated_below(name):
    """The filter lives on the agent's clock: it sees every third observation, and each action once."""
    assert_as_recorded(BeliefObservation(Repeat(single()), FILTERS[name]), FILTERS[name], Pushing(1), 6)


@pytest.mark.parametrize("name", ["PSIM", "previous", "present", "unscented"])
def test_actions_repeated_above(name):
    """The filter lives on the environment's clock, and the agent sees every third belief."""
    filter = FILTERS[name]
    outside, inside = Repeat(BeliefObservation(single(), filter)), single()
    rng = np.random.default_rng(0)
    chosen = rng.uniform(-3, 3, (10, 1)).astype(np.float32)
    seen = [outside.reset(seed=2)[0]] + [outside.step(action)[0] for action in chosen]
    actions = np.repeat(chosen, 3, axis=0)
    rows = [inside.reset(seed=2)[0]] + [inside.step(action)[0] for action in actions]
    below = Sequences.from_observations(np.array(rows)[None], actions=actions[None])
    expected = filter.summaries(below)[0, ::3]
    np.testing.assert_allclose(np.array(seen)[:, 3:], expected, rtol=CLOSE, atol=CLOSE)


def test_actions_reach_the_filter_as_they_were_given():
    """Not clipped: the record that `collect` makes, and a filter is fitted to, is not either."""
    env, filter = BeliefObservation(single(), FILTERS["previous"]), FILTERS["previous"]
    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.array([25.0], np.float32))
    belief = filter.update(filter.initial_belief(), first[None, :3])
    belief = filter.update(belief, second[None, :3], [[25.0]])
    np.testing.assert_allclose(second[3:], filter.summary(belief)[0], rtol=CLOSE, atol=CLOSE)


def test_stepping_changes_nothing_in_the_filter():
    for filter in (*FILTERS.values(), *CHOICE_FILTERS.values()):
        before = pickle.dumps(filter)
        is_choice = filter in CHOICE_FILTERS.values()
        env = vector.BeliefObservation(native(3, env_id=CHOICES if is_choice else ID), filter)
        collect(env, "random" if is_choice else Pushing(1), 4, seed=0)
        assert pickle.dumps(filter) == before


@pytest.mark.parametrize("name", FILTERS)
def test_pickle_in_the_middle_of_an_episode(name):
    env = BeliefObservation(single(), FILTERS[name])
    env.reset(seed=1)
    around = vector.BeliefObservation(native(3, AutoresetMode.NEXT_STEP), FILTERS[name])
    around.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(7):
        env.step(rng.uniform(-9, 9, 1))
        around.step(rng.uniform(-9, 9, (3, 1)))
    twins = pickle.loads(pickle.dumps((env, around)))
    for _ in range(20):
        action, actions = rng.uniform(-9, 9, 1), rng.uniform(-9, 9, (3, 1))
        np.testing.assert_array_equal(env.step(action)[0], twins[0].step(action)[0])
        np.testing.assert_array_equal(around.step(actions)[0], twins[1].step(actions)[0])


@pytest.mark.parametrize("kind", [str, lambda path: path], ids=["str", "Path"])
def test_a_file_serialises_in_the_spec_and_in_a_task(tmp_path, kind):
    path = save_filter(FILTERS["PSIM"], tmp_path / "psim.safetensors")
    env = ActionHistory(BeliefObservation(single(), kind(path), include_observation=False), 1)
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec == env.spec
    rebuilt = gym.make(spec)
    assert str(rebuilt) == str(env)
    for twin in (rebuilt, gym.make(env.spec)):
        np.testing.assert_array_equal(env.reset(seed=6)[0], twin.reset(seed=6)[0])
        for action in np.linspace(-1, 1, 5, dtype=np.float32)[:, None]:
            np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])
    task = Task(ID, {}, (("BeliefObservation", {"filter": str(path)}),))
    again = Task.from_dict(task.to_dict())
    assert again == task
    one, several = again.make(), again.make_vec(2)
    assert one.reset(seed=4)[0].shape == (3 + 15,)
    np.testing.assert_allclose(several.reset(seed=3)[0][1], one.reset(seed=4)[0], rtol=CLOSE, atol=CLOSE)


def test_a_loaded_filter_shows_what_the_saved_one_shows(tmp_path):
    path = save_filter(FILTERS["PSIM"], tmp_path / "psim.safetensors")
    seen = [
        collect(vector.BeliefObservation(native(2), filter), Pushing(1), 4, seed=0).observations
        for filter in (path, FILTERS["PSIM"])
    ]
    np.testing.assert_allclose(*seen, rtol=CLOSE, atol=CLOSE)


def test_a_filter_itself_pickles_and_is_told_to_be_no_json():
    env = BeliefObservation(single(), FILTERS["PSIM"])
    again = gym.make(pickle.loads(pickle.dumps(env.spec)))
    np.testing.assert_array_equal(again.reset(seed=0)[0], env.reset(seed=0)[0])
    with pytest.raises(TypeError, match="PSIM is not JSON serializable"):
        env.spec.to_json()
    task = Task(ID, {}, (("BeliefObservation", {"filter": FILTERS["PSIM"]}),))
    assert task.make_vec(2).reset(seed=0)[0].shape == (2, 18)
    with pytest.raises(
        TypeError, match=r"does not go into plain data.*path of the file that save_filter wrote"
    ):
        task.to_dict()
    assert collect(env, Pushing(), 1, seed=0).metadata["env_id"] == ID  # `collect` goes without the spec


@pytest.mark.parametrize("name", ["PSIM", "previous", "present"])
def test_stable_baselines_trains_on_it(name):
    env = SB3VecEnv(vector.BeliefObservation(native(4), FILTERS[name]))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=2, seed=0, device="cpu").learn(512)
    assert model.predict(env.reset(), deterministic=True)[0].shape == (4, 1)


@pytest.mark.parametrize("name", ["PSIM", "previous", "present"])
def test_checkers(name):
    env = BeliefObservation(gym.make(ID), FILTERS[name])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
        sb3_check_env(env)
    unavoidable = (
        "different from the unwrapped version",  # the checker is told a wrapper
        "alternative environments",  # the same, from the spec
        "infinity",  # a belief has no bounds
        "symmetric and normalized",  # the environment's own action space
        "left its bounds",  # the checkers' actions are not the training data's
    )
    left = [str(w.message) for w in caught if not any(text in str(w.message) for text in unavoidable)]
    assert not left


@pytest.mark.parametrize("num_envs", [None, 3])
def test_torchrl(num_envs, tmp_path):
    from torchrl.envs.utils import check_env_specs

    path = save_filter(FILTERS["PSIM"], tmp_path / "psim.safetensors")
    task = Task(ID, {"max_episode_steps": 20}, (("BeliefObservation", {"filter": str(path)}),))
    check_env_specs(torchrl_env(task, num_envs))


def test_a_torchrl_rollout_over_the_ends_of_episodes():
    filter = FILTERS["previous"]
    env = torchrl_env(Task(ID, {"max_episode_steps": 20}, (("BeliefObservation", {"filter": filter}),)), 2)
    env.set_seed(4)
    rollout = env.rollout(25, break_when_any_done=False)
    last = rollout["next", "observation"][:, :20].numpy().astype(float)
    first = rollout["observation"][:, :1].numpy().astype(float)
    assert rollout["next", "done"][:, 19].all()
    below = Sequences.from_observations(
        np.concatenate([first, last], axis=1)[:, :, :3], actions=rollout["action"][:, :20].numpy()
    )
    expected = filter.summaries(below)
    np.testing.assert_allclose(last[:, :, 3:], expected[:, 1:], rtol=1e-5, atol=1e-5)
    anew = rollout["observation"][:, 20].numpy()
    begun = filter.summary(filter.update(filter.initial_belief(2), anew[:, :3]))
    np.testing.assert_allclose(anew[:, 3:], begun, rtol=CLOSE, atol=CLOSE)


def test_particles_keep_their_random_stream_over_partial_resets():
    """`initial_belief` sets a particle filter's generator back, which no copy's reset may do to the others."""
    filter = ParticleFilter(**SEEN, n_particles=50).fit(DATA)
    env = vector.BeliefObservation(native(2, AutoresetMode.DISABLED), filter)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros((2, 1)))
    stream = env.transform.tracker.filter._rng.bit_generator.state
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.transform.tracker.filter._rng.bit_generator.state == stream
    env.reset(seed=0)
    assert env.transform.tracker.filter._rng.bit_generator.state == stream


def test_an_agent_that_does_not_see_the_latest_observation_is_told():
    with pytest.warns(
        UserWarning, match=r"PSIMActions shows at t has not seen x_t.*include_observation=False"
    ) as w:
        BeliefObservation(single(), FILTERS["present"], include_observation=False)
    assert w[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        BeliefObservation(single(), FILTERS["present"])
        BeliefObservation(single(), FILTERS["previous"], include_observation=False)


NAMES = {"observation_names": ("y", "cos_theta", "sin_theta")}
RENAMED = Sequences.from_observations(DATA.observations, lengths=DATA.lengths, **NAMES)


@pytest.mark.parametrize(
    ("filter", "arguments", "error", "message"),
    [
        (3, {}, TypeError, "expected a fitted Filter of beliefgym.learning, or the path .* got int"),
        (PSIM, {}, TypeError, "or the path .* got ABCMeta"),
        (PSIM(), {}, NotFittedError, r"this PSIM is not fitted yet; call fit\(train, validation\)"),
        ("nowhere.safetensors", {}, FileNotFoundError, "no file nowhere.safetensors.*save_filter"),
        (
            CHOICE_FILTERS["present choice"],
            {},
            ValueError,
            r"expected the 2 observation components \(x, theta\) that this PSIMActions was fitted on, got 3 "
            r"\(x, cos_theta, sin_theta\)",
        ),
        (
            PSIM(n_iterations=1).fit(RENAMED),
            {},
            ValueError,
            "PSIM was fitted on another environment: it expects the observation components y, cos_theta, "
            "sin_theta, and these are x, cos_theta, sin_theta",
        ),
        (
            FILTERS["PSIM"],
            {"show": "hint"},
            TypeError,
            "expected a HintFilter .* got PSIM, which estimates no hint",
        ),
        (FILTERS["PSIM"], {"show": "hints"}, ValueError, r"expected show to be one of .* got 'hints'"),
    ],
)
def test_what_does_not_fit_is_told(filter, arguments, error, message):
    with pytest.raises(error, match=message):
        BeliefObservation(single(), filter, **arguments)
    with pytest.raises(error, match=message):
        vector.BeliefObservation(native(2), filter, **arguments)


def test_names_that_say_nothing_are_no_names():
    nameless = Sequences.from_observations(
        DATA.observations, lengths=DATA.lengths, observation_names=("observation_0", "cos_theta", "sin_theta")
    )
    BeliefObservation(single(), PSIM(n_iterations=1).fit(nameless))
    BeliefObservation(
        single(),
        PSIM(n_iterations=1).fit(Sequences.from_observations(DATA.observations, lengths=DATA.lengths)),
    )


def test_actions_that_do_not_fit_are_told():
    two = Sequences.from_observations(
        DATA.observations, actions=np.repeat(DATA.actions, 2, axis=2), lengths=DATA.lengths
    )
    with pytest.raises(
        ValueError, match=r"expected actions of 2 columns as this PSIMActions was fitted on, got 1"
    ):
        BeliefObservation(single(), PSIMActions(n_iterations=1).fit(two))
    with pytest.raises(ValueError, match=r"expected the action space Discrete\(2\).*got Discrete\(3\)"):
        BeliefObservation(
            DiscreteActions(single("beliefgym/CartPoleBalancePosition-v0").env.env.env.env, 3),
            CHOICE_FILTERS["present choice"],
        )
    with pytest.raises(
        ValueError, match=r"units of the system \(force\) .*Discrete\(5\); put BeliefObs.* inside"
    ):
        BeliefObservation(DiscreteActions(single(), 5), FILTERS["unscented"])
    DiscreteActions(BeliefObservation(single(), FILTERS["unscented"]), 5).reset(seed=0)
    strange = gym.wrappers.TransformAction(
        single(), lambda a: a["force"], gym.spaces.Dict(force=single().action_space)
    )
    with pytest.raises(TypeError, match=r"expected a Box, Discrete.*for a filter with actions, got Dict"):
        BeliefObservation(strange, FILTERS["present"])
    BeliefObservation(strange, FILTERS["PSIM"]).reset(seed=0)  # which looks at no action


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")  # an infinite bound as an integer
def test_observations_of_integers_are_told():
    env = gym.wrappers.DtypeObservation(single(), np.int64)
    with pytest.raises(TypeError, match=r"belief needs .* got int64.*DtypeObservation"):
        BeliefObservation(env, FILTERS["PSIM"])


def test_a_belief_that_diverges_is_told_with_its_copy_and_step():
    env = vector.BeliefObservation(native(3, AutoresetMode.DISABLED), Explode().fit(DATA))
    env.reset(seed=0)
    message = r"belief of copy 0 of 3 at step 2 of its episode has diverged: component 0 is 1e\+36\. This Explode does"
    env.step(np.zeros((3, 1), np.float32))
    with pytest.raises(FloatingPointError, match=message):
        env.step(np.zeros((3, 1), np.float32))
    env.reset(seed=0)
    env.step(np.zeros((3, 1), np.float32))
    env.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(FloatingPointError, match="copy 1 of 3 at step 2 of its episode"):
        env.step(np.zeros((3, 1), np.float32))


def test_observations_and_actions_that_are_not_finite_are_told():
    below = native(2)
    env = vector.BeliefObservation(below, FILTERS["previous"])
    shown, _ = env.reset(seed=0)
    answer = (shown[:, :3], np.zeros(2), np.zeros(2, np.bool_), np.zeros(2, np.bool_), {})
    below.step = lambda actions: answer
    with pytest.raises(
        ValueError, match=r"got nan in component 0 of the action of copy 1 of 2 at step 1.*policy"
    ):
        env.step(np.array([[0.0], [np.nan]]))
    shown[1, 1] = np.inf
    with pytest.raises(
        ValueError, match=r"got inf in component 1 of the observation of copy 1 .* environment"
    ):
        env.step(np.zeros((2, 1)))


def test_the_other_form_is_named():
    with pytest.raises(TypeError, match=r"use beliefgym\.wrappers\.vector\.BeliefObservation"):
        BeliefObservation(native(2), FILTERS["PSIM"])
    with pytest.raises(TypeError, match=r"use beliefgym\.wrappers\.BeliefObservation"):
        vector.BeliefObservation(single(), FILTERS["PSIM"])
