"""Gymnasium's locomotion tasks with hidden velocities: the physics stays Gymnasium's, the state is the true one."""

import copy
import inspect
import pickle
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import beliefgym  # noqa: F401
from beliefgym.agents import Expert
from beliefgym.envs import NonFiniteError, collect, locomotion
from beliefgym.envs.reference_policies import reference_policy
from beliefgym.wrappers import SB3VecEnv
from beliefgym.wrappers.components import action_names, component_names
from beliefgym.wrappers.task import Task

# the index sets of the position-only tasks, on Gymnasium's observation
POSITIONS = {"InvertedPendulum": 2, "Swimmer": 3, "Hopper": 5, "Walker2d": 8, "HalfCheetah": 8}
every_task = pytest.mark.parametrize("name", POSITIONS)


def position_id(name):
    return f"beliefgym/{name}Position-v0"


def plain(name, **kwargs):
    """The full-state environment of a name, unwrapped."""
    return locomotion.TASKS[name](**kwargs)


def actions_of(env, steps, seed=0):
    rng = np.random.default_rng(seed)
    # a little beyond the limits too, which MuJoCo clips and the reward does not
    return rng.uniform(
        1.2 * env.action_space.low, 1.2 * env.action_space.high, (steps, len(env.action_space.low))
    )


@every_task
def test_physics_rewards_and_ends_are_gymnasiums(name):
    ours, theirs = gym.make(position_id(name)), gym.make(f"{name}-v5")
    index = np.arange(POSITIONS[name])
    assert ours.action_space == theirs.action_space
    assert ours.spec.max_episode_steps == theirs.spec.max_episode_steps == 1000
    seeds = iter(range(1500))
    seed = next(seeds)
    mine, other = ours.reset(seed=seed), theirs.reset(seed=seed)
    assert np.array_equal(mine[0], other[0][index])
    assert mine[1] == other[1]
    ended = 0
    for action in actions_of(ours, 1500).astype(np.float32):
        mine, other = ours.step(action), theirs.step(action)
        assert np.array_equal(mine[0], other[0][index])
        assert mine[1:] == other[1:]  # reward, terminated, truncated, info: to the last bit
        if mine[2] or mine[3]:
            ended += 1
            seed = next(seeds) if ended % 2 else None  # a running stream goes on as Gymnasium's
            assert np.array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0][index])
    assert ended >= 1


@every_task
def test_it_shows_all_positions_but_the_place(name):
    env = gym.make(position_id(name))
    full = component_names(gym.make(f"{name}-v5"))
    assert component_names(env) == full[: POSITIONS[name]]
    assert all(shown.startswith("qpos_") for shown in component_names(env))
    assert [n for n in full if n.startswith("qpos_")] == list(full[: POSITIONS[name]])
    assert env.unwrapped.observation_names == full
    assert action_names(env, 99) == tuple(f"action_{i}" for i in range(99))
    assert action_names(env, len(env.action_space.low)) == env.unwrapped.action_names


@every_task
def test_the_data_sheet_names_every_component(name):
    env = gym.make(position_id(name)).unwrapped
    sheet = inspect.getdoc(type(env))
    for component in (*env.state_names, *env.observation_names, *env.action_names):
        assert component in sheet
    for joint, gear in zip(env.action_names, env.model.actuator_gear[:, 0], strict=True):
        assert f"{gear:g}" in sheet, joint
    assert f"{env.dt:g} s" in sheet


@every_task
def test_the_state_can_be_read_and_set(name):
    env = gym.make(position_id(name))
    env.reset(seed=3)
    base = env.unwrapped
    assert len(base.state_names) == len(base.state) == base.model.nq + base.model.nv
    for action in actions_of(env, 4):
        env.step(action)
    assert np.array_equal(base.state, np.concatenate([base.data.qpos, base.data.qvel]))
    state = base.state
    first, _ = env.reset(options={"state": state})
    assert np.array_equal(base.state, state)
    names = dict(zip(base.state_names, state, strict=True))
    assert first.tolist() == [names[shown] for shown in component_names(env)]
    base.state[:] = 5.0  # a copy: writing to it changes nothing
    assert np.array_equal(base.state, state)
    # a given start draws nothing: the stream goes on where it was
    one, other = gym.make(position_id(name)), gym.make(position_id(name))
    one.reset(seed=1)
    other.reset(seed=1)
    one.reset(options={"state": state})
    assert np.array_equal(one.reset()[0], other.reset()[0])


@every_task
def test_a_trajectory_goes_on_from_its_states(name):
    """The solver's warm start is no part of the state, so to its tolerance (1e-8 relative), not to the last bit."""
    env, again = gym.make(position_id(name)), gym.make(position_id(name))
    env.reset(seed=0)
    for action in actions_of(env, 8):
        again.reset(seed=0)  # so that nothing of the last round stays
        again.reset(options={"state": env.unwrapped.state})
        expected, found = env.step(action), again.step(action)
        assert found[0] == pytest.approx(expected[0], abs=1e-6)
        assert found[1] == pytest.approx(
            expected[1], abs=1e-4
        )  # a speed: a position's error over a step of 8 ms
        if expected[2]:
            break


def test_wrong_start_states_are_told():
    env = gym.make("beliefgym/HopperPosition-v0")
    env.reset(seed=0)
    state = env.unwrapped.state
    with pytest.raises(
        ValueError, match=r"HopperPosition-v0: expected a start state of shape \(12,\) .* got \(1,\)"
    ):
        env.reset(options={"state": [0.0]})
    with pytest.raises(ValueError, match="expected a finite start state"):
        env.reset(options={"state": state * np.nan})
    with pytest.raises(ValueError, match="unknown reset option 'stat'"):
        env.reset(options={"stat": state})
    for component, value in ((1, 0.69), (2, 0.21), (8, 101.0)):  # too low, leaning, a wild velocity
        fallen = state.copy()
        fallen[component] = value
        with pytest.raises(
            ValueError, match="impossible start state of copy 0: the episode would already be over"
        ):
            env.reset(options={"state": fallen})
    assert np.array_equal(env.unwrapped.state, state)  # a refused start leaves the running episode as it is
    env.step(np.zeros(3))
    relaxed = gym.make("beliefgym/HopperPosition-v0", terminate_when_unhealthy=False)
    relaxed.reset(options={"state": fallen})


@pytest.mark.parametrize(
    ("name", "component", "value"),
    [
        ("Walker2d", 1, 0.79),
        ("Walker2d", 2, -1.01),
        ("InvertedPendulum", 1, 0.21),
        ("InvertedPendulum", 1, -0.21),
    ],
)
def test_starts_in_which_the_episode_is_over_are_impossible(name, component, value):
    env = gym.make(position_id(name))
    env.reset(seed=0)
    state = env.unwrapped.state
    state[component] = value
    with pytest.raises(ValueError, match="would already be over"):
        env.reset(options={"state": state})
    state[component] *= 0.9 if abs(value) < 0.5 or value < 0 else 1.1
    env.reset(options={"state": state})


@every_task
def test_wrong_actions_are_told(name):
    env = gym.make(position_id(name)).unwrapped
    with pytest.raises(gym.error.ResetNeeded, match=f"{name}Position-v0: step before reset; call reset"):
        env.step(np.zeros(1))
    env.reset(seed=0)
    n = len(env.action_names)
    with pytest.raises(ValueError, match=rf"expected an action of shape \({n},\) .* got shape \({n + 2},\)"):
        env.step(np.zeros(n + 2))
    env.step(np.zeros(n))
    before = env.state
    action = np.zeros(n)
    action[-1] = np.nan
    with pytest.raises(ValueError, match=f"action '{env.action_names[-1]}' of copy 0 is NaN at step 2"):
        env.step(action)
    with pytest.raises(ValueError, match=f"action '{env.action_names[0]}' of copy 0 is infinite at step 2"):
        env.step(np.full(n, np.inf))
    assert np.array_equal(env.state, before)
    env.step(np.zeros(n))


def test_a_diverged_simulation_is_told():
    env = gym.make("beliefgym/HalfCheetahPosition-v0")
    env.reset(seed=0)
    state = env.unwrapped.state
    state[9:] = 1e200  # within the numbers, beyond what can be integrated
    env.reset(options={"state": state})
    with pytest.raises(
        NonFiniteError, match=r"HalfCheetahPosition-v0: state 'q.*' of copy 0 became .* at step 1 "
    ):
        env.step(np.zeros(6))
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(np.zeros(6))
    env.reset(seed=0)
    env.step(np.zeros(6))


@every_task
def test_hints_are_the_true_state_and_only_on_request(name):
    assert "hint" not in gym.make(position_id(name)).reset(seed=0)[1]
    env = gym.make(position_id(name), hint=True)
    _, info = env.reset(seed=0)
    assert np.array_equal(info["hint"], env.unwrapped.state)
    assert env.unwrapped.hint_names == env.unwrapped.state_names
    info = env.step(env.action_space.sample())[4]
    assert np.array_equal(info["hint"], env.unwrapped.state)


@every_task
def test_the_expert_sees_gymnasiums_observation(name):
    env = plain(name)
    env.reset(seed=0)
    controller = env.expert()
    for action in 20 * actions_of(env, 30):  # violent: so that velocities reach Gymnasium's clipping
        observation, _, terminated, _, _ = env.step(action)
        found = controller.observation(env.state[None])[0]
        assert np.array_equal(found, observation)
        if terminated:
            env.reset()
    observation, _ = env.reset(seed=1)
    assert controller.act(env.state[None]).shape == (1, len(env.action_names))
    assert np.array_equal(controller.act(env.state[None])[0], controller.policy(observation[None])[0])
    assert controller.kind == env.expert_kind == "trained full-state PPO"


def test_there_is_no_expert_for_another_model(tmp_path):
    foot = '<body name="foot" pos="0.13 0 -0.35">'
    model = Path(locomotion.HopperEnv().fullpath).read_text()
    assert foot in model
    path = tmp_path / "hopper.xml"
    path.write_text(model.replace(foot, foot + '<joint axis="0 1 0" name="toe" range="-1 1" type="hinge"/>'))
    env = locomotion.HopperEnv(xml_file=str(path))
    assert "qpos_toe" in env.state_names
    with pytest.raises(ValueError, match="takes 11 components, this model gives 13"):
        env.expert()


@every_task
def test_vector_form_states_and_expert(name):
    """SyncVectorEnv, SB3 and the single form: the expert acts on the states of the copies."""
    task = Task(position_id(name))
    vector = task.make_vec(3)
    assert isinstance(vector.unwrapped, SyncVectorEnv)
    expert = Expert(task)
    expert.set_env(vector)
    observation, _ = vector.reset(seed=5)
    together, _ = expert.predict(observation)
    controller = task.make().unwrapped.expert()
    for i in range(3):
        single = task.make()
        first, _ = single.reset(seed=5 + i)
        expert.set_env(single)
        alone, _ = expert.predict(first)
        # one row or three: the matrix products add in another order
        assert together[i] == pytest.approx(alone, abs=1e-5)
        assert alone == pytest.approx(controller.act(single.unwrapped.state[None])[0])
    sb3 = SB3VecEnv(task.make_vec(3))
    sb3.seed(5)
    expert.set_env(sb3)
    assert expert.predict(sb3.reset())[0] == pytest.approx(together)
    assert [len(state) for state in sb3.get_attr("state", [0, 2])] == [len(single.unwrapped.state)] * 2
    same = vector.reset(options={"state": single.unwrapped.state})[0]
    assert np.array_equal(same, np.stack([first] * 3))


@every_task
def test_an_episode_goes_on_after_pickling_and_copying(name):
    env = gym.make(position_id(name), hint=True)
    env.reset(seed=4)
    actions = actions_of(env, 12)
    for action in actions[:4]:
        env.step(action)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert np.array_equal(twin.unwrapped.state, env.unwrapped.state)
        saved = pickle.dumps(env)
        for action in actions[4:]:
            expected, found = env.step(action), twin.step(action)
            assert np.array_equal(expected[4]["hint"], found[4]["hint"])
            assert expected[1:3] == found[1:3]
            if expected[2]:
                break
        assert np.array_equal(env.reset()[0], twin.reset()[0])
        env = pickle.loads(saved)


def test_episodes_are_collected_with_their_true_states():
    sequences = collect(gym.make("beliefgym/HopperPosition-v0", hint=True), "random", n_episodes=3, seed=0)
    assert sequences.states.shape[2] == sequences.hints.shape[2] == 12
    n = int(sequences.lengths[0])
    assert np.array_equal(sequences.states[0, : n + 1, 1:6], sequences.observations[0, : n + 1])
    vector = gym.make_vec(
        "beliefgym/HopperPosition-v0",
        2,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
    )
    assert collect(vector, "random", n_episodes=4, seed=0).observations.shape[2] == 5


@every_task
def test_the_picture_shows_the_motion_and_what_is_hidden(name):
    env = gym.make(position_id(name), render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 720, 3)
    state = env.unwrapped.state
    moved = state.copy()
    moved[-env.unwrapped.model.nv :] += 0.5
    env.reset(options={"state": moved})
    # hidden velocities leave no trace in the picture
    assert np.array_equal(env.render(), first)
    everything = plain(name, render_mode="rgb_array")
    everything.reset(options={"state": state})
    panel = everything.render()[:, 480:]
    assert (panel != first[:, 480:]).any()
    turned = state.copy()
    turned[env.unwrapped.model.nq - 1] += 0.15 if name == "InvertedPendulum" else 0.3
    env.reset(options={"state": turned})
    assert (env.render()[:, :480] != first[:, :480]).any(axis=2).mean() > 0.001


def test_the_camera_follows():
    env = plain("Swimmer", render_mode="rgb_array")
    env.reset(seed=0)
    state = env.state
    first = env.render()[:, :480]
    state[:2] += (3.0, -2.0)  # whole squares of the grid
    env.reset(options={"state": state})
    assert (env.render()[:, :480] != first).any(axis=2).mean() < 0.01  # a pixel's rounding along the edges


def test_unknown_parameters_and_modes_are_told():
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        gym.make("beliefgym/HopperPosition-v0", colour="red")
    with pytest.raises(ValueError, match="expected render_mode None or one of"):
        locomotion.HopperEnv(render_mode="depth_array")


def test_nothing_is_written_into_the_working_folder(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    gym.make("beliefgym/HalfCheetahPosition-v0").reset(seed=0)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@every_task
def test_reference_policies_say_what_they_are(name):
    about = reference_policy(name).about
    assert about["env_id"] == f"{name}-v5"
    assert about["algorithm"] == "stable_baselines3.PPO"
    assert about["validation"]["n_episodes"] == 20
    assert set(about["versions"]) >= {"mujoco", "gymnasium", "stable-baselines3", "torch"}
