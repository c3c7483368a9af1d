"""What every registered environment must do: one contract, all ids."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.common.env_checker
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

import beliefgym  # noqa: F401
from beliefgym.envs import registered_ids
from beliefgym.envs.kernel import NumbaKernel, NumpyKernel, Outcome
from beliefgym.envs.mujoco_system import MujocoSystem
from beliefgym.envs.random_streams import RandomStreams
from beliefgym.envs.registration import ENTRY_POINT, has_native_vector_form
from beliefgym.envs.tracing import TraceError
from beliefgym.wrappers.components import component_names

IDS = registered_ids()
NATIVE = [env_id for env_id in IDS if has_native_vector_form(env_id)]
PLAIN = [env_id for env_id in NATIVE if gym.spec(env_id).entry_point == ENTRY_POINT]
SHOWING = ("components", "base", "layers", "exposes", "vector_base")
# one id for each system and its parameters: what the siblings show does not touch the dynamics
SYSTEMS = list(
    {
        str({k: v for k, v in gym.spec(env_id).kwargs.items() if k not in SHOWING}): env_id
        for env_id in reversed(NATIVE)
    }.values()
)
NOISY = {"process_noise_std": 1e-3, "actuation_noise_std": 0.05}
every_id = pytest.mark.parametrize("env_id", IDS)
every_native_id = pytest.mark.parametrize("env_id", NATIVE)
every_plain_id = pytest.mark.parametrize("env_id", PLAIN)
every_system = pytest.mark.parametrize("env_id", SYSTEMS)
exact_and_noisy = pytest.mark.parametrize("kwargs", [{}, NOISY], ids=["exact", "noisy"])


def make_vec(env_id, n, mode=AutoresetMode.SAME_STEP, **kwargs):
    return gym.make_vec(
        env_id, n, vectorization_mode="vector_entry_point", autoreset_mode=mode.name, **kwargs
    )


def actions_for(space, steps, n, seed=0, scale=1.1):
    """(steps, n, ...) actions; of a box as a share of its limits, a little beyond them too."""
    rng = np.random.default_rng(seed)
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n, size=(steps, n))
    return rng.uniform(scale * space.low, scale * space.high, (steps, n, *space.shape))


def start_states(system, n):
    """(n, n_state) states that the system starts from."""
    return system.initial_state(RandomStreams(range(n)))


def visited_states(system, n, seed=0):
    """(n, n_state) states on the way of random actions, each after 0, 10, 20 or 30 steps."""
    rng = np.random.default_rng(seed)
    low, high = system.action_limits
    state = start_states(system, n)
    for t in range(30):
        moved = system.step(state, rng.uniform(low, high, (n, system.n_action)))
        state = np.where((np.arange(n) % 4 > t // 10)[:, None], moved, state)
    return state


def test_there_are_environments():
    assert "beliefgym/PendulumPosition-v0" in IDS
    assert "beliefgym/CartPoleSwingUpPosition-v0" in IDS


@every_id
def test_gymnasiums_checker(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # what it recommends and we decline, for SI units: action boxes other than [-1, 1], unbounded velocities
        for text in (".*symmetric and normalized", ".*m..imum value is -?infinity", ".*casting to float32"):
            warnings.filterwarnings("ignore", message=text)
        # and that some ids are wrapped environments
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version")
        check_env(gym.make(env_id, render_mode="rgb_array", disable_env_checker=True).env.env)


@every_id
def test_stable_baselines_checker(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized")
        stable_baselines3.common.env_checker.check_env(gym.make(env_id))


@every_id
def test_torchrl_specs(env_id):
    check_env_specs(GymWrapper(gym.make(env_id)))


@every_native_id
def test_torchrl_specs_of_the_vector_form(env_id):
    check_env_specs(GymWrapper(make_vec(env_id, 3)))


@every_native_id
def test_make_by_module_prefix_and_the_spec_rebuilds_it(env_id):
    env = gym.make(f"beliefgym:{env_id}", process_noise_std=0.001)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.system == env.unwrapped.system
    assert np.array_equal(again.reset(seed=1)[0], env.reset(seed=1)[0])


@every_native_id
@exact_and_noisy
def test_same_seed_same_trajectory_alone_at_any_position_and_after_pickling(env_id, kwargs):
    vector = make_vec(env_id, 4, **kwargs)
    longest = 0
    for scale in (1.1, 0.03):  # a helicopter under strong actions crashes at once: gentle ones too
        actions = actions_for(vector.single_action_space, 40, 4, scale=scale)
        first, _ = vector.reset(seed=10)
        seen = [first, *(vector.step(a)[0] for a in actions)]
        for copy in range(4):
            single = gym.make(env_id, **kwargs)
            trajectory = [single.reset(seed=10 + copy)[0]]
            for t, a in enumerate(actions[:, copy]):
                if t == 3:  # in the middle of an episode
                    single = pickle.loads(pickle.dumps(single))
                observation, _, terminated, truncated, _ = single.step(a)
                if terminated or truncated:
                    break
                trajectory.append(observation)
            longest = max(longest, len(trajectory))
            for t, observation in enumerate(trajectory):
                assert np.array_equal(observation, seen[t][copy]), (copy, t)
    assert longest > 4  # uncontrolled, the helicopter of the competitions is too fast after 6 steps
    # another place in the batch, another size of the batch
    other = make_vec(env_id, 2, **kwargs)
    assert np.array_equal(other.reset(seed=12)[0], first[2:])
    assert np.array_equal(other.step(actions[0, 2:])[0], seen[1][2:])


@every_native_id
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP], ids=["same", "next"])
@exact_and_noisy
def test_the_native_vector_env_is_gymnasiums_over_single_ones(env_id, mode, kwargs):
    n, limit = 5, 7
    native = make_vec(env_id, n, mode, max_episode_steps=limit, **kwargs)
    rival = SyncVectorEnv(
        [lambda: gym.make(env_id, max_episode_steps=limit, **kwargs) for _ in range(n)], autoreset_mode=mode
    )
    assert native.single_observation_space == rival.single_observation_space
    assert native.single_action_space == rival.single_action_space
    assert native.metadata["autoreset_mode"] == mode
    assert np.array_equal(native.reset(seed=3)[0], rival.reset(seed=3)[0])
    rng = np.random.default_rng(0)
    for t, actions in enumerate(actions_for(native.single_action_space, 40, n)):
        if t in (3, 25):  # copies out of step with one another
            mask = rng.random(n) < 0.5
            mask[0] = True
            options = {"reset_mask": mask}
            a, b = native.reset(options=options)[0], rival.reset(options=options)[0]
            assert np.array_equal(a[mask], b[mask])
        ours, theirs = native.step(actions), rival.step(actions)
        for mine, other in zip(ours[:4], theirs[:4], strict=True):
            assert np.array_equal(mine, other), t
            assert mine.dtype == other.dtype
        assert ("final_obs" in ours[4]) == ("final_obs" in theirs[4])
        if "final_obs" in ours[4]:
            assert np.array_equal(ours[4]["_final_obs"], theirs[4]["_final_obs"])
            for mine, other in zip(ours[4]["final_obs"], theirs[4]["final_obs"], strict=True):
                assert (mine is None) == (other is None)
                assert mine is None or np.array_equal(mine, other)


@every_native_id
def test_disabled_autoreset_wants_finished_copies_reset(env_id):
    env = make_vec(env_id, 2, AutoresetMode.DISABLED, max_episode_steps=2)
    env.reset(seed=0)
    zero = np.zeros(env.action_space.shape, dtype=env.action_space.dtype)
    env.step(zero)
    assert env.step(zero)[3].all()
    with pytest.raises(gym.error.ResetNeeded, match="copy 0 has finished"):
        env.step(zero)
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gym.error.ResetNeeded, match="copy 1 has finished"):
        env.step(zero)
    env.reset(options={"reset_mask": np.array([False, True])})
    env.step(zero)


@every_native_id
def test_state_can_be_read_and_set(env_id):
    env, vector = gym.make(env_id), make_vec(env_id, 3)
    states = start_states(env.unwrapped.system, 3)
    state = states[0]
    env.reset(options={"state": state})
    assert np.array_equal(env.unwrapped.state, state)
    vector.reset(options={"state": states[::-1]})
    assert np.array_equal(vector.unwrapped.state, states[::-1])
    env.unwrapped.state[:] = 5.0  # a copy: writing to it changes nothing
    assert np.array_equal(env.unwrapped.state, state)
    with pytest.raises(ValueError, match=r"expected a start state of shape .* got \(1,\)"):
        env.reset(options={"state": [0.0]})
    with pytest.raises(ValueError, match="expected a finite start state"):
        env.reset(options={"state": state * np.nan})
    with pytest.raises(ValueError, match="unknown reset option 'stat'"):
        env.reset(options={"stat": state})


@every_native_id
def test_impossible_start_states_are_told(env_id):
    """Beyond the limits, a quaternion that is none, an episode that is over: with the id and the copy."""
    vector = make_vec(env_id, 3)
    system = vector.unwrapped.system
    states = start_states(system, 3)
    low, high = system.state_limits
    for component in np.flatnonzero(np.isfinite(low) | np.isfinite(high)):
        wrong = states.copy()
        wrong[1, component] = (high if np.isfinite(high[component]) else low)[component]
        wrong[1, component] += 0.1 if np.isfinite(high[component]) else -0.1
        name = system.state_names[component]
        with pytest.raises(
            ValueError, match=f"{env_id}: impossible start state of copy 1: expected '{name}'"
        ):
            vector.reset(options={"state": wrong})
    for start in system.quaternions:
        wrong = states.copy()
        wrong[2, start : start + 4] *= 1.1
        with pytest.raises(ValueError, match=r"copy 2: expected a quaternion of norm 1 .* got norm 1\.1"):
            vector.reset(options={"state": wrong})
    far = states * np.where(np.isin(np.arange(system.n_state), _quaternion_places(system)), 1.0, 1e4)
    far = np.clip(far, low, high)
    if system.terminated(far)[0]:
        with pytest.raises(ValueError, match="copy 0: the episode would already be over there"):
            vector.reset(options={"state": far})


def _quaternion_places(system):
    return [start + k for start in system.quaternions for k in range(4)]


@every_native_id
def test_hints_are_there_when_asked_for(env_id):
    assert gym.make(env_id).reset(seed=0)[1] == {}
    env = gym.make(env_id, hint=True)
    _, info = env.reset(seed=0)
    system = env.unwrapped.system
    assert np.array_equal(info["hint"], system.hint(env.unwrapped.state))
    assert info["hint"].shape == (len(env.unwrapped.hint_names),)
    vector = make_vec(env_id, 3, hint=True, max_episode_steps=1)
    vector.reset(seed=0)
    before = vector.unwrapped.state
    actions = np.zeros(vector.action_space.shape, dtype=vector.action_space.dtype)
    _, _, _, truncated, infos = vector.step(actions)
    assert truncated.all()
    assert np.array_equal(infos["hint"], system.hint(vector.unwrapped.state))
    final = infos["final_info"]
    assert np.array_equal(final["hint"], system.hint(final["state"]))
    if not system.noise_size and actions.dtype.kind == "f":
        expected = system.step(before, actions)
        assert final["state"] == pytest.approx(expected, rel=1e-12, abs=1e-12)  # the kernels' last bit


@every_id
def test_names_stand_for_every_component(env_id):
    env = gym.make(env_id)
    names = component_names(env)
    assert len(set(names)) == len(names) == env.observation_space.shape[0]
    assert len(env.unwrapped.state_names) == len(env.unwrapped.state)


@every_system
def test_the_data_sheet_names_every_component(env_id):
    env = gym.make(env_id).unwrapped
    system = env.system
    assert len(system.state_names) == len(env.state)
    assert set(env.observation_names) <= set(system.observation_names)
    for name in (*system.state_names, *system.observation_names, *system.action_names):
        assert name in type(system).__doc__, f"the data sheet lacks {name}"


@every_system
def test_numpy_and_torch_steps_agree(env_id):
    system = gym.make(env_id, **NOISY).unwrapped.system
    rng = np.random.default_rng(0)
    state = visited_states(system, 200)
    low, high = system.action_limits
    action = rng.uniform(1.2 * low, 1.2 * high, (200, system.n_action))
    noise = rng.standard_normal((200, system.noise_size))
    with_numpy = system.step(state, action, noise)
    assert np.isfinite(with_numpy).all()
    with_torch = system.step(*(torch.from_numpy(a) for a in (state, action, noise)))
    assert with_torch.numpy() == pytest.approx(with_numpy, rel=1e-12, abs=1e-12)  # the last bits of a sine
    for function in ("observe", "terminated", "stage_cost", "hint"):
        arrays = (with_numpy,) if function != "stage_cost" else (with_numpy, action)
        expected = getattr(system, function)(*arrays)
        found = getattr(system, function)(*(torch.from_numpy(a) for a in arrays)).numpy()
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


@every_system
def test_float32_steps_agree_to_float_tolerance(env_id):
    """What a GPU runs: the same lines in single precision, one step."""
    system = gym.make(env_id).unwrapped.system
    state = visited_states(system, 100)
    action = np.zeros((100, system.n_action))
    expected = system.step(state, action)
    found = system.step(*(torch.from_numpy(a).float() for a in (state, action)))
    scale = 1.0 + np.abs(expected).max(axis=0)
    assert (
        np.abs(found.double().numpy() - expected).max() < 1e-4 * scale.max()
    )  # rounding at 1e-7, through a step


@every_system
def test_it_uses_nothing_beyond_the_array_api(env_id):
    strict = pytest.importorskip("array_api_strict", reason="array-api-strict is not installed")
    system = gym.make(env_id, **NOISY).unwrapped.system
    rng = np.random.default_rng(2)
    given = {
        "state": visited_states(system, 20),
        "action": rng.normal(size=(20, system.n_action)),
        "noise": rng.normal(size=(20, system.noise_size)),
    }
    state, action, noise = (strict.asarray(array) for array in given.values())
    found = system.step(state, action, noise)
    assert np.asarray(found) == pytest.approx(system.step(*given.values()), rel=1e-12, abs=1e-12)
    for function in ("observe", "terminated", "hint"):
        assert np.asarray(getattr(system, function)(state)) == pytest.approx(
            getattr(system, function)(given["state"]), abs=1e-12
        )
    assert np.asarray(system.reward(state, action, found)).shape == (20,)
    assert np.asarray(system.stage_cost(state, action)).shape == (20,)


@every_system
@exact_and_noisy
def test_the_compiled_loop_is_the_system(env_id, kwargs):
    pytest.importorskip("numba", reason="without numba every system runs under numpy")
    system = gym.make(env_id, **kwargs).unwrapped.system
    columns = (1, 0)
    if isinstance(system, MujocoSystem):  # MuJoCo is compiled already, and cannot be traced
        with pytest.raises(TraceError):
            NumbaKernel(system, columns)
        return
    rng = np.random.default_rng(1)
    n = 300
    state = visited_states(system, n)
    low, high = system.action_limits
    action = rng.uniform(1.5 * low, 1.5 * high, (n, system.n_action))
    noise = rng.standard_normal((n, system.noise_size)) if system.noise_size else None
    results = []
    for kernel in (NumbaKernel(system, columns), NumpyKernel(system, columns)):
        steps = np.arange(n)
        out = np.empty_like(state), np.empty(n), np.empty(n, dtype=bool), np.empty(n, dtype=bool)
        flags = kernel.step(state, action, noise, steps, 250, Outcome(*out))
        results.append((np.array(flags), steps, kernel.observe(out[0]), *out))
    for mine, other in zip(*results, strict=True):
        assert np.asarray(mine, dtype=float) == pytest.approx(
            np.asarray(other, dtype=float), rel=1e-12, abs=1e-12
        )


@every_system
def test_quaternions_keep_their_norm(env_id):
    system = gym.make(env_id, **NOISY).unwrapped.system
    if not system.quaternions:
        return
    rng = np.random.default_rng(3)
    state = start_states(system, 4)
    low, high = system.action_limits
    for _ in range(1000):
        noise = rng.standard_normal((4, system.noise_size))
        moved = system.step(state, rng.uniform(low, high, (4, system.n_action)), noise)
        state = np.where(system.terminated(moved)[:, None], state, moved)
        for start in system.quaternions:
            assert np.abs((state[:, start : start + 4] ** 2).sum(axis=1) - 1.0).max() < 1e-9


@every_plain_id
def test_wrong_actions_are_told(env_id):
    env, vector = gym.make(env_id).unwrapped, make_vec(env_id, 3)
    env.reset(seed=0)
    vector.reset(seed=0)
    n_action = env.system.n_action
    with pytest.raises(ValueError, match=rf"expected an action of shape \({n_action},\) .* got shape"):
        env.step(np.zeros(n_action + 2))
    with pytest.raises(
        ValueError, match=rf"expected an action of shape \(3, {n_action}\) .* got shape \(2, {n_action}\)"
    ):
        vector.step(np.zeros((2, n_action)))
    before = vector.unwrapped.state
    actions = np.zeros((3, n_action))
    vector.step(actions)
    actions[1, -1] = np.nan
    with pytest.raises(ValueError, match=f"action '{env.action_names[-1]}' of copy 1 is NaN at step 2"):
        vector.step(actions)
    assert not np.isnan(vector.unwrapped.state).any()  # nothing is lost: the states are those before
    assert not np.array_equal(vector.unwrapped.state, before)
    with pytest.raises(ValueError, match="of copy 0 is NaN at step 1"):
        env.step(np.full(n_action, np.nan))
    env.reset(seed=1)
    env.step(np.full(n_action, np.inf))  # clipped to the limit, like any number beyond it


@every_plain_id
def test_step_before_reset_is_told(env_id):
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        gym.make(env_id).unwrapped.step(np.zeros(1))
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        make_vec(env_id, 2).step(np.zeros((2, 1)))


@every_id
def test_it_draws_itself(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 720, 3)
    assert first.dtype == np.uint8
    for _ in range(10):
        if env.step(_strong(env.action_space))[2]:
            break
    assert (env.render() != first).any(axis=2).mean() > 0.002  # something has moved
    if not has_native_vector_form(env_id):
        return
    vector = make_vec(env_id, 2, render_mode="rgb_array")
    vector.reset(seed=0)
    frames = vector.render()
    assert len(frames) == 2
    assert np.array_equal(frames[0], first)


def _strong(space):
    return space.high if isinstance(space, gym.spaces.Box) else space.n - 1


@every_id
@pytest.mark.filterwarnings("ignore:.*Overwriting existing videos")
def test_it_is_filmed_by_gymnasiums_record_video(env_id, tmp_path):
    pytest.importorskip("moviepy", reason="the video extra is not installed")
    env = gym.wrappers.RecordVideo(
        gym.make(env_id, render_mode="rgb_array", max_episode_steps=5), str(tmp_path), disable_logger=True
    )
    env.reset(seed=0)
    for _ in range(5):
        if env.step(env.action_space.sample())[2]:
            break
    env.close()
    assert [path.stat().st_size > 1000 for path in tmp_path.glob("*.mp4")] == [True]


@every_id
def test_a_window_opens_and_closes(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(env_id, render_mode="human")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.render() is None
    env.close()
    env.close()
