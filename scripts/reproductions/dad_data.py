"""The data sets of the Data as Demonstrator experiments: systems simulated here, recorded and simulated videos.

The uncontrolled pendulum and cart-pole (1000 trajectories of 30 steps) and the helicopter under its LQR are those of
the thesis proposal's Sec. 3.1.3. What it leaves open is chosen here: the time step (0.05 s, the systems' own); the
starts (pendulum: any angle, +-1 rad/s; cart-pole: within +-(1 m, 1 m/s, pi, 0.5 rad/s), the public DaD
demonstration's); the coordinates (what the environments show: a pendulum's predicted tip can leave its circle, as in
Fig. 3.1); no noise unless asked for; 1000 trajectories of 30 steps for the helicopter too, from trim displaced by up to
10 m, with a speed up to 5 m/s and a turn of up to 1 rad, in gusts of 0.1 N and 0.1 N m.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import beliefgym.envs  # noqa: F401 - registers the environments
from beliefgym.agents import make_agent
from beliefgym.envs import collect
from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.system import System
from beliefgym.learning import Sequences
from beliefgym.learning.video_frames import read_frames
from beliefgym.learning.video_textures import VideoTexture
from beliefgym.wrappers.task import Task

Array = NDArray[np.float64]
Parts = tuple[Sequences, Sequences, Sequences]
VERSION = 2  # of these data; cells made with another one run again
N_TRAJECTORIES, N_STEPS = 1000, 30
SHARES = (0.8, 0.1, 0.1)  # training, validation, test; the thesis holds out a random tenth for the test
CLIPS = {"pumpjack": "video_textures/pumpjack.mp4", "fireplace": "video_textures/fire_pot0.avi"}
CLIP_SIZE = (80, 60)  # pixels, grey
CLIP_EVERY, CLIP_STEPS = (
    2,
    16,
)  # every second frame: the recordings are of 8 and 10 s, the thesis's of minutes
FLAG_SECONDS, FLAG_EVERY, FLAG_STEPS = 240.0, 5, 20  # as in the thesis
FLAG_STRIDE = 4  # frames between starts: no divisor of the step, so that all phases occur
COMPONENTS = 20


def pendulum(
    seed: int, n: int = N_TRAJECTORIES, n_steps: int = N_STEPS, noise: float = 0.0, dt: float = 0.05
) -> Sequences:
    """The free pendulum as its environment shows it: cos, sin of its angle from upright, and its velocity (rad/s).

    Args:
        seed: of starts and noise. n: trajectories. n_steps: steps of each.
        noise: standard deviation added to angle and velocity at each step, in their units. dt: s.
    """
    rng = np.random.default_rng([seed, 1])
    starts = rng.uniform(-1.0, 1.0, (n, 2)) * np.array([np.pi, 1.0])
    return _shown(Pendulum.uncontrolled(dt=dt), starts, n_steps, noise, rng)


def cart_pole(
    seed: int, n: int = N_TRAJECTORIES, n_steps: int = N_STEPS, noise: float = 0.0, dt: float = 0.05
) -> Sequences:
    """The unforced cart-pole as its environment shows it: place, cos and sin of the angle, velocities.

    Args: as of `pendulum`; noise is added to each of the four states.
    """
    rng = np.random.default_rng([seed, 2])
    starts = rng.uniform(-1.0, 1.0, (n, 4)) * np.array([1.0, 1.0, np.pi, 0.5])
    return _shown(CartPole(dt=dt), starts, n_steps, noise, rng)


def _shown(system: System, starts: Array, n_steps: int, noise: float, rng: np.random.Generator) -> Sequences:
    states = free_motion(system, starts, n_steps, noise, rng)
    return Sequences.from_observations(
        system.observe(states),
        states=states,
        observation_names=system.observation_names,
        state_names=system.state_names,
        metadata={"dt": system.dt, "noise": noise},
    )


def helicopter(seed: int, n: int = N_TRAJECTORIES, n_steps: int = N_STEPS, gusts: float = 0.1) -> Sequences:
    """The 21 states of the helicopter under its LQR; its controls are not shown.

    Args:
        gusts: standard deviation of the forces (N) and torques (N m). The others as of `pendulum`.
    """
    parameters: dict[str, Any] = {
        "wrench_noise_std": gusts,
        "start_distance": 10.0,
        "start_speed": 5.0,
        "start_turn": 1.0,
    }
    task = Task("beliefgym/HelicopterHover-v0", parameters)
    env = gym.make_vec(task.env_id, num_envs=n, vectorization_mode="vector_entry_point", **parameters)
    expert: Any = make_agent("expert", task, seed=0)
    expert.set_env(env)
    flown = collect(env, expert, n, seed=4_000_000 + 10_000 * seed, max_steps_per_episode=n_steps)
    return Sequences.from_observations(
        flown.observations,
        lengths=flown.lengths,
        observation_names=flown.observation_names,
        metadata={"dt": 0.05, "gusts": gusts},
    )


def free_motion(system: System, starts: Array, n_steps: int, noise: float, rng: np.random.Generator) -> Array:
    """Every start under no action: (n, n_state) -> (n, n_steps + 1, n_state)."""
    states = [starts]
    action = np.zeros((len(starts), system.n_action))
    for _ in range(n_steps):
        moved = system.flow(states[-1], action)
        states.append(moved + noise * rng.standard_normal(moved.shape) if noise else moved)
    return np.stack(states, axis=1)


SIMULATED: dict[str, Callable[..., Sequences]] = {
    "pendulum": pendulum,
    "cart-pole": cart_pole,
    "helicopter": helicopter,
}


def simulated_parts(name: str, seed: int, **arguments: Any) -> Parts:
    """Training, validation and test trajectories of a simulated system; another seed gives other data."""
    train, validation, test = SIMULATED[name](seed, **arguments).split(SHARES, seed=seed)
    return train, validation, test


def video_parts(
    frames: NDArray[np.uint8], fold: int, n_folds: int, every: int, n_steps: int, stride: int = 1
) -> tuple[Parts, VideoTexture, NDArray[np.uint8]]:
    """Trajectories of principal components, from blocks of time.

    The video is cut in n_folds + 1 blocks; in each fold another one is the test part and the next the validation part;
    what lies before and after is the training part, on which alone the components are fitted. No trajectory reaches
    over a border.

    Args:
        frames: (n, height, width) uint8.
        fold: 0 .. n_folds - 1. every: frames in a step. n_steps: of a trajectory. stride: frames between starts.

    Returns:
        (train, validation, test), the fitted texture, and the test frames.
    """
    border = np.linspace(0, len(frames), n_folds + 2).round().astype(int)
    test, validation = frames[border[fold] : border[fold + 1]], frames[border[fold + 1] : border[fold + 2]]
    rest = [
        part for part in (frames[: border[fold]], frames[border[fold + 2] :]) if len(part) > every * n_steps
    ]
    texture = VideoTexture(COMPONENTS).fit(np.concatenate(rest))

    def cut(part: NDArray[np.uint8]) -> Sequences:
        return texture.to_sequences(part, n_steps=n_steps, stride=stride, every=every)

    parts = (Sequences.concatenate([cut(part) for part in rest]), cut(validation), cut(test))
    return parts, texture, test


def video_random_parts(
    frames: NDArray[np.uint8], seed: int, every: int, n_steps: int, stride: int = 1
) -> Parts:
    """Trajectories of principal components of a whole video, split at random as the thesis does it.

    Overlapping trajectories share frames, so that the test part is not new: this measures recall of a video, not
    prediction of its future. Arguments as of `video_parts`.
    """
    texture = VideoTexture(COMPONENTS).fit(frames)
    trajectories = texture.to_sequences(frames, n_steps=n_steps, stride=stride, every=every)
    train, validation, test = trajectories.split(SHARES, seed=seed)
    return train, validation, test


def clip_frames(name: str, data: Path) -> NDArray[np.uint8]:
    """The frames of a recorded clip, small and grey."""
    return read_frames(data / CLIPS[name], size=CLIP_SIZE, grey=True)
