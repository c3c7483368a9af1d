"""`beliefgym benchmark hints`: how long one update of a hint estimator takes, against an unscented filter and a GRU.

One observation at a time, as on a live stream: the x position of a swinging pendulum, its angle and speed the hints.
Every contestant takes in the same observations in turns, 20 at a time, and every single update is timed: the median and
the 99th percentile. Rivals: filterpy's own unscented filter over the same dynamics, this package's through the same
`HintEstimator`, torch's GRU cell with a linear read-out, and `GRUHints`, whose cell is numpy.

An update of a filter with b numbers in its belief, d observations and m random frequencies multiplies at least
(b + d) b numbers, or (b + d) m + (b + d + 2 m) b with random features, and reads as many weights.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from beliefgym.envs.estimators import UnscentedKalmanFilter
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.hint_estimator import HintEstimator
from beliefgym.learning.hint_recurrent import GRUHints
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim_hints import InferenceMachineFilter, PSIMHints
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.scripts.benchmarks.measuring import Rate, row
from beliefgym.scripts.reproductions.hints_data import CLEAN, pendulum, swinging

Floats = NDArray[np.float64]
Update = Callable[[Floats], Any]
N_TRAJECTORIES, K, WAVES, HIDDEN = 60, 10, 300, 64
ROUNDS, TURN = 200, 20  # turns of each contestant, updates in one
N_PARTS = 5  # of a run, whose range is given
OURS = ("PSIM+Hints, linear", f"PSIM+Hints, {WAVES} random frequencies", "IMF, linear")
RIVALS = ("UKF (filterpy)", "UKF (ours)", f"GRU of {HIDDEN} (torch)", f"GRU of {HIDDEN} (ours)")


def run(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure; one thread."""
    torch.set_num_threads(1)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        told("fitting")
        stream, contestants, work = _contestants()
        told("updates")
        seconds = timed(contestants, stream)
    rows = []
    for ours in OURS:
        for rival in RIVALS:
            for name, q in (("median", 50), ("99th percentile", 99)):
                what = f"updates a second, {name} of single ones: {ours}"
                rows.append(row(what, _rate(seconds[ours], q), rival, _rate(seconds[rival], q)))
    limits: dict[str, Any] = {
        f"microseconds, {name}": {
            "median": round(float(1e6 * np.median(taken)), 1),
            "99th percentile": round(float(1e6 * np.percentile(taken, 99)), 1),
        }
        for name, taken in seconds.items()
    }
    limits |= {f"multiplications an update needs, {name}": count for name, count in work.items()}
    limits["how"] = (
        f"{ROUNDS * TURN} updates each, in turns of {TURN}; one thread; intervals over {N_PARTS} parts"
    )
    return rows, limits


def timed(contestants: dict[str, Update], stream: Floats) -> dict[str, Floats]:
    """Seconds of each single update, (ROUNDS * TURN,) by name; the first turn of each is not counted."""
    taken: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(ROUNDS + 1):
        for name, update in contestants.items():
            for step in range(TURN):
                x = stream[(turn * TURN + step) % len(stream)]
                started = time.perf_counter()
                update(x)
                elapsed = time.perf_counter() - started
                if turn:
                    taken[name].append(elapsed)
    return {name: np.array(values) for name, values in taken.items()}


def _rate(seconds: Floats, q: float) -> Rate:
    """One over a percentile, and its range over parts of the run."""
    parts = [1.0 / float(np.percentile(part, q)) for part in np.array_split(seconds, N_PARTS)]
    return Rate(1.0 / float(np.percentile(seconds, q)), min(parts), max(parts))


def _contestants() -> tuple[Floats, dict[str, Update], dict[str, int]]:
    """A stream of observations (n, 1), an update by name, and the multiplications that ours need."""
    rng = np.random.default_rng(0)
    train, validation, test = (swinging(CLEAN, n, rng) for n in (N_TRAJECTORIES, 10, 1))
    waves = RandomFourierRidge(n_frequencies=WAVES, include_inputs=True, random_state=0, alpha=1e-4)
    shared: dict[str, Any] = {"features": "second", "preimage": Ridge(), "n_iterations": 5}
    filters = {
        OURS[0]: PSIMHints(Ridge(alpha=1e-4), n_future=K, **shared),
        OURS[1]: PSIMHints(waves, n_future=K, **shared),
        OURS[2]: InferenceMachineFilter(Ridge(alpha=1e-4), **shared),
    }
    work = {}
    for name, filter in filters.items():
        filter.fit(train, validation)
        b, n_inputs = filter.belief_size, filter.belief_size + train.n_obs
        work[name] = n_inputs * b if name != OURS[1] else n_inputs * WAVES + (n_inputs + 2 * WAVES) * b
    known: dict[str, Any] = {
        "system": pendulum(CLEAN),
        "observed": ("sin_theta",),
        "observation_noise_std": CLEAN.observation,
        "hint": ("theta", "angular_velocity"),
    }
    network = GRUHints(hidden_size=HIDDEN, n_epochs=1, random_state=0).fit(train, validation)
    ours: dict[str, Update] = {name: HintEstimator(filter).update for name, filter in filters.items()}
    rivals: dict[str, Update] = {
        RIVALS[0]: _filterpy(train),
        RIVALS[1]: HintEstimator(UnscentedKalmanFilter(**known).fit(train)).update,
        RIVALS[2]: _torch(train.n_obs),
        RIVALS[3]: HintEstimator(network).update,
    }
    return np.array(test.observations[0]), ours | rivals, work


def _filterpy(train: Any) -> Update:
    """The library's unscented filter, one predict and update for each observation."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    system, nothing = pendulum(CLEAN), np.zeros(1)
    filter = UnscentedKalmanFilter(
        dim_x=2,
        dim_z=1,
        dt=system.dt,
        fx=lambda state, dt: system.step(state, nothing),
        hx=lambda state: np.sin(state[:1]),
        points=MerweScaledSigmaPoints(2, alpha=1.0, beta=0.0, kappa=1.0),
    )
    filter.x, filter.P = train.states[0, 0].copy(), 0.01 * np.eye(2)
    filter.Q, filter.R = np.diag(np.square(CLEAN.state)), np.eye(1) * CLEAN.observation**2

    def update(x: Floats) -> Any:
        filter.predict()
        filter.update(x)
        return filter.x

    return update


def _torch(n_obs: int) -> Update:
    """A GRU cell and a linear read-out as torch runs them, without gradients."""
    cell, read_out = torch.nn.GRUCell(2 * n_obs, HIDDEN), torch.nn.Linear(HIDDEN, 2)
    state = [torch.zeros(1, HIDDEN), torch.zeros(1, n_obs)]

    def update(x: Floats) -> Any:
        with torch.inference_mode():
            now = torch.as_tensor(x, dtype=torch.float32)[None]
            state[0], state[1] = cell(torch.cat([now, now - state[1]], 1), state[0]), now
            return read_out(state[0])[0].numpy()

    return update
