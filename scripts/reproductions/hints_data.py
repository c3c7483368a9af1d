"""The data of the hint experiments, in ten folds: the thesis's Sec. 3.4.3, simulated, and on public recordings.

Every fold has a test part, the next fold as its validation part, and the other eight to train on; whole trajectories,
recordings or objects are held out together. The thesis names neither rates, nor lengths, nor numbers of trajectories,
nor noise; they are chosen here.

- pendulum: free and undamped, 5 s at 20 Hz, started up to 162 degrees from hanging and up to 1 rad/s, so that it is
  above the horizontal for a quarter of the time; the Cartesian x position of its tip is observed, which does not tell
  above from below. Noise a step: 0.01 rad and 0.01 rad/s of the state, 0.01 m of the observation; in the noisy variant
  0.1 m. (A first version, damped and less wide, was above the horizontal too rarely to be a problem of partial state:
  there a window of five observations was as good as any filter on the validation part.)
- quadrotor (simulated): `beliefgym/QuadrotorHoverIMUNoisy-v0` under its expert, wind, gusts and drifting gyro biases;
  4 s at 50 Hz; the hints are roll and pitch.
- imu (recorded): an inertial measurement unit moved by hand in a motion capture arena, 6 s at 50 Hz, ten recordings
  held out whole. The hint is the upward direction in the unit's axes: some pass through +-90 degrees of pitch.
- lift (simulated): `beliefgym/MicoLiftTorqueNoisy-v0` under its expert, 8 s, every second step of it (10 Hz), masses of
  45 to 355 g: joint angles and motor torques. The lift begins at 3 s.
- payload (recorded): joint efforts and forces of an arm that picks up, holds, shakes and lowers 95 objects of four
  masses, five times each; 40 bins of time; objects held out whole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from beliefgym.agents import Expert
from beliefgym.envs import Pendulum, collect
from beliefgym.learning import Sequences
from beliefgym.scripts.reproductions.psim_data import Parts, split

Floats = NDArray[np.float64]
DAMPING, PENDULUM_DT, PENDULUM_STEPS = 0.0, 0.05, 99
START_ANGLE, START_SPEED = 0.9 * np.pi, 1.0
N_PENDULUMS, N_MANY, N_FLIGHTS, N_LIFTS = 100, 400, 60, 100
FLIGHT_STEPS, IMU_DT = 199, 0.02
EVERY = 2  # steps of a lift
GRAMS = 1000.0
FILES = {"imu": "imu_vicon/imu_vicon.npz", "payload": "ur5_payload/ur5_payload.npz"}


@dataclass(frozen=True)
class Task:
    """How a data set enters the experiments.

    Attributes:
        title: in tables. unit: of the hint. table: of the thesis. column: of that table.
        horizons: k_f of PSIM+Hints, the thesis's where it names some. version: of these parts.
    """

    title: str
    unit: str
    table: str
    horizons: tuple[int, ...]
    column: str = ""
    version: int = 1


TASKS = {
    "pendulum-full": Task("pendulum, full state", "rad, rad/s", "3.6", (5, 10, 20), "full"),
    "pendulum-partial": Task("pendulum, angle alone", "rad", "3.6", (5, 10, 20), "partial"),
    "pendulum-noisy": Task("noisy pendulum, full state", "rad, rad/s", "3.6", (20,)),
    "pendulum-many": Task("pendulum, full state, 400 trajectories", "rad, rad/s", "3.6", (), "full"),
    "quadrotor": Task("quadrotor attitude, simulated", "rad", "3.7", (5, 20), "quadrotor"),
    "imu": Task("upward direction, recorded IMU", "rad", "3.7", (5,)),
    "lift": Task("payload mass, simulated arm", "g", "3.8", (5, 20), "mass"),
    "payload": Task("payload mass, recorded lifts", "g", "3.8", (5,)),
}


@dataclass(frozen=True)
class Noise:
    """Standard deviations a step of the pendulum: of the state (rad, rad/s), of the observation (m)."""

    state: tuple[float, float]
    observation: float


CLEAN, NOISY = Noise((0.01, 0.01), 0.01), Noise((0.01, 0.01), 0.1)


def present(name: str, folder: Path | None) -> bool:
    """Whether the folder of recorded data holds what this one needs; the others are simulated."""
    return name not in FILES or (folder is not None and (folder / FILES[name]).exists())


def pendulum(noise: Noise) -> Pendulum:
    """The system, with its noise."""
    return Pendulum.uncontrolled(damping=DAMPING, dt=PENDULUM_DT, process_noise_std=noise.state)


def parts(name: str, fold: int, data: Path | None) -> Parts:
    """Training, validation and test part of a task.

    Args:
        name: of `TASKS`. fold: 0 .. 9. data: folder of the recordings.
    """
    whole, groups = _whole(name, data)
    train, validation, test = split(len(whole), fold, groups)
    return whole[train], whole[validation], whole[test]


@lru_cache(maxsize=1)
def _whole(name: str, data: Path | None) -> tuple[Sequences, NDArray[Any]]:
    """All trajectories, and what is held out together."""
    if name.startswith("pendulum"):
        n = N_MANY if name.endswith("many") else N_PENDULUMS
        swings = swinging(NOISY if name.endswith("noisy") else CLEAN, n, np.random.default_rng(36))
        if name.endswith("partial"):
            swings = _with_hints(swings, lambda hints: hints[:, :, :1], ("theta",))
        return swings, np.arange(len(swings))
    if name == "quadrotor":
        flights = _flown("beliefgym/QuadrotorHoverIMUNoisy-v0", N_FLIGHTS, FLIGHT_STEPS)
        return flights, np.arange(len(flights))
    if name == "lift":
        lifts = _flown("beliefgym/MicoLiftTorqueNoisy-v0", N_LIFTS, None)
        return _with_hints(lifts, lambda hints: GRAMS * hints, ("mass",), EVERY), np.arange(len(lifts))
    assert data is not None
    with np.load(data / FILES[name]) as file:
        arrays = {key: file[key] for key in file}
    observations = arrays["observations"].astype(float)
    names = [str(component) for component in arrays["names"]]
    if name == "imu":
        gravity = arrays["rotations"][:, :, 2].astype(float)  # R^T e3: the third row of R
        hint_names: tuple[str, ...] = ("up_x", "up_y", "up_z")
        hints, groups = gravity, arrays["recording"]
    else:
        mass = arrays["mass_g"].astype(float)
        hints = np.repeat(mass[:, None, None], observations.shape[1], axis=1)
        hint_names, groups = ("mass",), arrays["object"]
    whole = Sequences.from_observations(
        observations, hints=hints, observation_names=names, hint_names=list(hint_names)
    )
    return whole, groups


def swinging(noise: Noise, n: int, rng: np.random.Generator) -> Sequences:
    """Pendulums of which the tip's x position is seen; hints and states are the angle (from upright) and its speed."""
    system = pendulum(noise)
    state = rng.uniform(-1.0, 1.0, (n, 2)) * (START_ANGLE, START_SPEED) + (np.pi, 0.0)
    states = [state]
    for _ in range(PENDULUM_STEPS):
        state = system.step(state, np.zeros((n, 1)), rng.standard_normal((n, system.noise_size)))
        states.append(state)
    s = np.stack(states, axis=1)
    x = system.observe(s)[:, :, 1:2]
    return Sequences.from_observations(
        x + noise.observation * rng.standard_normal(x.shape),
        states=s,
        hints=s,
        observation_names=["sin_theta"],
        state_names=list(system.state_names),
        hint_names=list(system.state_names),
    )


def _flown(env_id: str, n: int, n_steps: int | None) -> Sequences:
    """Episodes of the expert, with hints."""
    env: Any = gym.make_vec(env_id, num_envs=n, vectorization_mode="vector_entry_point", hint=True)
    expert = Expert(env_id)
    expert.set_env(env)
    episodes = collect(env, expert, n, seed=0, max_steps_per_episode=n_steps)
    env.close()
    return episodes


def _with_hints(
    sequences: Sequences, change: Callable[[Floats], Floats], names: tuple[str, ...], every: int = 1
) -> Sequences:
    """Without actions, with other hints, and every so many-th step."""
    assert sequences.hints is not None
    return Sequences.from_observations(
        sequences.observations[:, ::every],
        hints=change(sequences.hints)[:, ::every],
        states=None if sequences.states is None else sequences.states[:, ::every],
        lengths=sequences.lengths // every,
        observation_names=sequences.observation_names,
        state_names=sequences.state_names,
        hint_names=names,
    )
