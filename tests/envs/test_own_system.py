"""A system of the user's own: everything follows from one class, and what goes wrong in it is told."""

from dataclasses import dataclass
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from array_api_compat import array_namespace
from gymnasium.utils.env_checker import check_env

from beliefgym.envs import NonFiniteError, System, SystemEnv, SystemVectorEnv
from beliefgym.envs.kernel import NumbaKernel, NumpyKernel, make_kernel
from beliefgym.envs.tracing import TraceError


@dataclass(frozen=True, kw_only=True)
class Exploding(System):
    """x' = growth x + u."""

    growth: float = 1e200

    state_names: ClassVar = ("x", "y")
    action_names: ClassVar = ("push",)
    observation_names: ClassVar = ("x", "y", "sum")

    @property
    def action_limits(self):
        return np.array([-1.0]), np.array([1.0])

    @property
    def observation_limits(self):
        return np.full(3, -np.inf), np.full(3, np.inf)

    def flow(self, state, action):
        xp = array_namespace(state)
        return xp.stack([self.growth * state[..., 0] + action[..., 0], state[..., 1]], axis=-1)

    def observe(self, state):
        xp = array_namespace(state)
        return xp.stack([state[..., 0], state[..., 1], state[..., 0] + state[..., 1]], axis=-1)

    def reward(self, state, action, next_state):
        return -(next_state[..., 0] ** 2) - 0.0 * action[..., 0]

    def initial_state(self, streams, mask=None):
        return streams.uniform(2, mask)


@dataclass(frozen=True, kw_only=True)
class Untraceable(Exploding):
    """A matrix product: numpy can, the tracer cannot."""

    growth: float = 1.0

    def flow(self, state, action):
        return state @ np.eye(2) + action


@pytest.mark.parametrize("kernel", ["numpy", "numba"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_diverging_simulation_is_told_where_it_begins(kernel, monkeypatch):
    if kernel == "numba":
        pytest.importorskip("numba", reason="numba is not installed")
    monkeypatch.setenv("BELIEFGYM_KERNEL", kernel)
    env = SystemVectorEnv(Exploding(), num_envs=3)
    env.reset(options={"state": [[0.0, 1.0], [0.0, 1.0], [1e150, 1.0]]})
    with pytest.raises(
        NonFiniteError, match=r"state 'x' of copy 2 became inf at step 1 of its episode .*1e\+150"
    ):
        env.step(np.zeros((3, 1)))
    assert env.state[2].tolist() == [1e150, 1.0]  # the last good state is still there
    single = SystemEnv(Exploding(growth=1e155))
    single.reset(options={"state": [1.0, 0.0]})
    single.step(np.zeros(1))
    with pytest.raises(NonFiniteError, match="copy 0 became inf at step 2"):
        single.step(np.zeros(1))


@pytest.mark.filterwarnings("ignore:.*imum value is .*infinity")
def test_a_finished_system_makes_both_environments():
    system = Exploding(growth=0.5)
    check_env(SystemEnv(system), skip_render_check=True)
    single, vector = SystemEnv(system), SystemVectorEnv(system, num_envs=2)
    assert np.array_equal(single.reset(seed=4)[0], vector.reset(seed=3)[0][1])
    with pytest.raises(TypeError, match="takes no further parameters, got \\['growth'\\]"):
        SystemEnv(system, growth=1.0)
    with pytest.raises(TypeError, match="expected a System"):
        SystemEnv("collections:OrderedDict")


def test_components_are_chosen_and_ordered_by_name():
    system = Exploding(growth=0.5)
    env = SystemVectorEnv(system, num_envs=2, components=["sum", "x"])
    observation, _ = env.reset(seed=0)
    state = env.state
    assert observation == pytest.approx(
        np.stack([state.sum(axis=1), state[:, 0]], axis=1), abs=1e-6
    )  # float32
    assert env.observation_names == ("sum", "x")
    with pytest.raises(ValueError, match="no observation component 'summ'; did you mean 'sum'"):
        SystemEnv(system, components=["summ"])
    with pytest.raises(ValueError, match="at least one component, each once"):
        SystemEnv(system, components=["x", "x"])


def test_a_system_that_cannot_be_traced_runs_under_numpy(monkeypatch):
    pytest.importorskip("numba", reason="numba is not installed")
    monkeypatch.delenv("BELIEFGYM_KERNEL", raising=False)
    assert isinstance(make_kernel(Exploding(), range(3)), NumbaKernel)
    assert isinstance(make_kernel(Untraceable(), range(3)), NumpyKernel)
    env = SystemVectorEnv(Untraceable(), num_envs=2)
    env.reset(options={"state": [1.0, 2.0]})
    env.step(np.full((2, 1), 0.5))
    assert env.state.tolist() == [[1.5, 2.5]] * 2
    monkeypatch.setenv("BELIEFGYM_KERNEL", "numba")
    with pytest.raises((TraceError, TypeError)):
        make_kernel(Untraceable(), range(3))
    monkeypatch.setenv("BELIEFGYM_KERNEL", "fortran")
    with pytest.raises(ValueError, match="BELIEFGYM_KERNEL to be auto, numpy or numba, got 'fortran'"):
        make_kernel(Exploding(), range(3))


def test_a_system_without_expert_or_picture_says_so():
    with pytest.raises(ValueError, match="Exploding has no expert"):
        Exploding().expert()
    env = SystemEnv(Exploding(), render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="Exploding has no picture"):
        env.render()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs of at least 1"),
        ({"max_episode_steps": 0}, "max_episode_steps of at least 1"),
        ({"render_mode": "human"}, "render_mode None or 'rgb_array'"),
        ({"autoreset_mode": "LATER"}, "autoreset_mode to be one of"),
    ],
)
def test_impossible_vector_environments_are_told(arguments, message):
    with pytest.raises(ValueError, match=message):
        SystemVectorEnv(Exploding(), **arguments)


def test_render_without_a_mode_warns_and_gives_nothing():
    with pytest.warns(UserWarning, match="render_mode"):
        assert SystemEnv(Exploding()).render() is None
    with pytest.raises(ValueError, match="render_mode None or one of"):
        SystemEnv(Exploding(), render_mode="ansi")


def test_a_warm_kernel_cache_serves_a_fresh_process(tmp_path):
    """The compiled code is kept on disk: two processes in a row, the second loads what the first compiled."""
    import os
    import subprocess
    import sys

    pytest.importorskip("numba", reason="numba is not installed")
    script = (
        "import gymnasium as gym, beliefgym\n"
        "env = gym.make('beliefgym/Pendulum-v0'); env.reset(seed=0); print(env.step([0.5])[0].tolist())"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "BELIEFGYM_KERNEL": "numba"}
    printed = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout)
        kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
        assert kept
    assert printed[0] == printed[1]
    assert gym  # imported for the parent too
