"""The filters of the hint experiments that know the system: unscented, extended and particle filters, complementary.

Those of the pendulum have its exact dynamics, observation and noise, and start from the empirical mean and covariance
of the training trajectories' first states, as all others do; one more starts near each trajectory's true state. What
there is to choose (the spread of sigma points, the gains of the complementary filter) is chosen on the training and
validation parts, as the learned filters' settings are.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from beliefgym.envs.estimators import (
    ComplementaryFilter,
    ExtendedKalmanFilter,
    NumericalError,
    ParticleFilter,
    UnscentedKalmanFilter,
)
from beliefgym.learning import Sequences
from beliefgym.learning.hint_errors import HintErrors
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.scripts.reproductions.hints_data import CLEAN, IMU_DT, NOISY, Parts, pendulum

Found = Iterator[tuple[str, dict[str, Any]]]
N_PARTICLES = 3000
NEAR = 0.1  # rad and rad/s: standard deviation of a start that is called good
SPREADS: tuple[dict[str, Any], ...] = (
    {},
    {"alpha": 0.5, "beta": 2.0},
    {"alpha": 0.1, "beta": 2.0},
    {"kappa": 0.0},
)  # of sigma points
ROUGHENINGS: tuple[dict[str, Any], ...] = (
    {},
    {"roughening": 0.003},
    {"roughening": 0.01},
    {"roughening": 0.03},
)
TYPICAL: dict[str, Any] = {"kP": 1.0, "kI": 0.3}  # gains


def physics(name: str, parts: Parts, seed: int) -> Found:
    """Every such filter on one fold: name, and the chosen one with how it was found."""
    if name.startswith("pendulum"):
        yield from _of_pendulum(name, parts, seed)
    else:
        yield from _of_attitude(name, parts)


def _of_pendulum(name: str, parts: Parts, seed: int) -> Found:
    noise = NOISY if name.endswith("noisy") else CLEAN
    shared: dict[str, Any] = {
        "system": pendulum(noise),
        "observed": ("sin_theta",),
        "observation_noise_std": noise.observation,
        "hint": ("theta", "angular_velocity"),
    }
    chosen = _best([(UnscentedKalmanFilter(**shared, **spread), spread) for spread in SPREADS], parts)
    yield "Physics UKF", chosen
    near = NearTruth(shared | chosen["setting"], seed)
    yield "Physics UKF, started well", {"filter": near, "seconds": 0.0, "setting": chosen["setting"]}
    yield "EKF", _best([(ExtendedKalmanFilter(**shared), {})], parts)
    particles = [
        (ParticleFilter(**shared, **one, n_particles=N_PARTICLES, random_state=seed), one)
        for one in ROUGHENINGS
    ]
    yield "particle filter", _best(particles, parts)


def _of_attitude(name: str, parts: Parts) -> Found:
    shared: dict[str, Any] = {"dt": IMU_DT}
    if name == "imu":
        shared |= {"hint": "gravity", "accelerometer": ("ax", "ay", "az"), "gyro": ("wx", "wy", "wz")}
    options: list[dict[str, Any]] = [
        {"initial": initial, "gate": gate} for initial in ("prior", "accelerometer") for gate in (None, "fit")
    ]
    yield (
        "complementary filter",
        _best([(ComplementaryFilter(**shared, **one), one) for one in options], parts),
    )
    typical = [(ComplementaryFilter(**shared, **TYPICAL), TYPICAL)]
    yield "complementary filter, typical gains", _best(typical, parts)


def _best(candidates: list[tuple[HintFilter, dict[str, Any]]], parts: Parts) -> dict[str, Any]:
    """The one with the lowest error on the validation part; one that breaks down there is out."""
    train, validation, _ = parts
    began = time.perf_counter()
    best: dict[str, Any] = {"validation": np.inf}
    for filter, setting in candidates:
        started = time.perf_counter()
        try:
            error = filter.fit(train, validation).hint_errors(validation).mean
        except NumericalError:
            continue
        if error < best["validation"]:
            gains = {
                gain: float(getattr(filter, gain))
                for gain in ("kP_", "kI_", "gate_")
                if hasattr(filter, gain)
            }
            finite = {gain: value for gain, value in gains.items() if np.isfinite(value)}
            seconds = time.perf_counter() - started
            best = {"filter": filter, "setting": setting | finite, "validation": error, "seconds": seconds}
    return best | {"seconds_tuning": time.perf_counter() - began}


class NearTruth:
    """The unscented filter, started for each trajectory about its true first state, as far off as its prior says.

    Args:
        parameters: of the filter. seed: of the starts.
    """

    def __init__(self, parameters: dict[str, Any], seed: int) -> None:
        self.parameters, self.seed = parameters, seed

    def hint_errors(self, sequences: Sequences) -> HintErrors:
        """As of `HintFilter`."""
        assert sequences.states is not None
        rng = np.random.default_rng(self.seed)
        starts = sequences.states[:, 0] + NEAR * rng.standard_normal(sequences.states[:, 0].shape)
        covariance = NEAR**2 * np.eye(starts.shape[1])
        each = [
            UnscentedKalmanFilter.of(prior=(start, covariance), **self.parameters).hint_errors(sequences[i])
            for i, start in enumerate(starts)
        ]
        return HintErrors(
            np.concatenate([one.difference for one in each]), np.concatenate([one.std for one in each])
        )
