"""`beliefgym benchmark filter`: training and updating predictive state filters against a recurrent network.

- Training to the same error. A linear-Gaussian system of 10 states and 5 observations, 200 trajectories of 100 steps,
  and the pendulum seen by the noisy sine and cosine of its angle alone, 200 trajectories of 100 steps. `PSIM` is
  trained; then a GRU filter, of each of three sizes, until an epoch whose validation error is no higher. The fastest
  size counts; where none gets there in its epochs, all the time of the one that came nearest stands as a lower bound.
- One belief update of a batch, with its checks and bounds, against the bare matrix products that it is made of.

What bounds an update of n beliefs is 2 n (size + n_obs) size FLOPs, and with random features those of their angles too.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits

from beliefgym.learning import Sequences
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.recurrent_filter import GRUFilter
from beliefgym.scripts.benchmarks.dad import product_rate
from beliefgym.scripts.benchmarks.measuring import Rate, rates, row
from beliefgym.scripts.reproductions.psim_data import noisy_pendulum

Floats = NDArray[np.float64]
N_TRAJECTORIES, N_STEPS = 200, 100
N_STATES, N_OBS = 10, 5
NOISE = 0.1  # standard deviation of the pendulum's sine and cosine
SIZES = (32, 64, 128)  # of the GRU
REPEATS = 3  # of PSIM's training
FASTER = 20.0  # target of the linear filter's training
NEAR = 1.0 / 3.0  # target of an update's rate, as a share of the bare products'
BATCHES = (64, 1024)
K, WIDTH, WAVES = 5, 13, 300  # of the timed updates: the thesis's 13 telemetry components


def run(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure; one thread."""
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    limits: dict[str, Any] = {}
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        for name, data in (("linear-Gaussian", linear()), ("noisy pendulum", pendulum())):
            told(f"training, {name}")
            rows += _training(name, *data, limits)
        for batch in BATCHES:
            told(f"updates of {batch}")
            rows += _updates(batch, limits)
    limits["GFLOP/s of a matrix product (dgemm 1000 x 1000)"] = product_rate() / 1e9
    limits["BLAS"] = ", ".join(
        f"{i['internal_api']} {i['version']} {i.get('architecture', '')}" for i in threadpool_info()
    )
    limits["repeats"] = (
        "training: PSIM the median of 3 fits, GRU 1 run a size; updates: medians of 5; one thread"
    )
    return rows, limits


def linear() -> tuple[Sequences, Sequences, float]:
    """Training and validation part, and the Kalman filter's own error on the latter, standardised."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.standard_normal((N_STATES, N_STATES)))[0]
    system = LinearGaussianSystem(
        0.97 * turn, rng.standard_normal((N_OBS, N_STATES)), 0.1 * np.eye(N_STATES), np.eye(N_OBS)
    )
    train = system.sample_innovations(N_TRAJECTORIES, N_STEPS, rng)
    validation = system.sample_innovations(N_TRAJECTORIES, N_STEPS, rng)
    scale = train.observations.reshape(-1, N_OBS).std(axis=0)
    predicted = KalmanFilter.of(system)
    beliefs = predicted.beliefs(validation)[:, :-1]
    guess = predicted.predict_observation(beliefs.reshape(-1, N_STATES)).reshape(
        validation.observations.shape
    )
    floor = np.square((guess - validation.observations) / scale).sum(axis=2)[:, 1:].mean()
    return train, validation, float(floor)


def pendulum() -> tuple[Sequences, Sequences, float]:
    """The same of the free pendulum, by the noisy cosine and sine of its angle; the noise alone is the floor."""
    rng = np.random.default_rng(1)
    train, validation = (noisy_pendulum(N_TRAJECTORIES, N_STEPS, NOISE, rng) for _ in range(2))
    return train, validation, float(np.square(NOISE / train.observations.reshape(-1, 2).std(axis=0)).sum())


def _training(
    name: str, train: Sequences, validation: Sequences, floor: float, limits: dict[str, Any]
) -> list[dict[str, Any]]:
    inputs = (K + 1) * train.n_obs
    waves = RandomFourierRidge(
        n_frequencies=WAVES, bandwidth=inputs**0.5, alpha=1e-5, include_inputs=True, random_state=0
    )
    networks = {size: _network(size, train, validation) for size in SIZES}
    rows = []
    for kind, regressor, target in (("PSIM-Linear_d", Ridge(), FASTER), ("PSIM-RFF_d", waves, None)):
        seconds = []
        for _ in range(REPEATS):
            started = time.perf_counter()
            filter = PSIM(regressor, n_future=K).fit(train, validation)
            seconds.append(time.perf_counter() - started)
        error = float(filter.history_["validation_error"][filter.best_iteration_])
        reached = {size: _time_to(error, network) for size, network in networks.items()}
        fastest = min(reached, key=lambda size: (not reached[size][0], reached[size][1]))
        there, time_needed = reached[fastest]
        if not there:
            fastest = min(networks, key=lambda size: float(np.nanmin(networks[size]["validation_error"])))
            time_needed = float(np.nansum(networks[fastest]["seconds"]))
        best = min(float(np.nanmin(network["validation_error"])) for network in networks.values())
        rival = f"GRU of {fastest}" + ("" if there else ", which does not get there: all its time")
        rows.append(
            row(
                f"fits a second to an error of {error:.4f}, {name}: {kind}",
                Rate(1 / float(np.median(seconds)), 1 / max(seconds), 1 / min(seconds)),
                rival,
                Rate(1 / time_needed, 1 / time_needed, 1 / time_needed),
                target,
            )
        )
        limits[f"errors, {name}, {kind}"] = {kind: error, "best GRU": best, "floor": floor}
        limits[f"seconds, {name}, {kind}"] = {kind: float(np.median(seconds)), "GRU": time_needed}
    return rows


def _network(size: int, train: Sequences, validation: Sequences) -> dict[str, Floats]:
    """The history of a whole run, without an early end."""
    network = GRUFilter(hidden_size=size, patience=None, random_state=0)
    return dict(network.fit(train, validation).history_)


def _time_to(error: float, history: dict[str, Floats]) -> tuple[bool, float]:
    """Whether a run gets to an error, and the seconds until it does."""
    reached = np.flatnonzero(history["validation_error"] <= error)
    if not len(reached):
        return False, float(np.nansum(history["seconds"]))
    return True, float(np.nansum(history["seconds"][: reached[0] + 1]))


def _updates(batch: int, limits: dict[str, Any]) -> list[dict[str, Any]]:
    rng = np.random.default_rng(2)
    system = LinearGaussianSystem(
        0.9 * np.eye(WIDTH), np.eye(WIDTH), 0.1 * np.eye(WIDTH), 0.1 * np.eye(WIDTH)
    )
    train = system.sample(40, 60, rng)
    x = train.observations[np.arange(batch) % 40, np.arange(batch) % 60]
    rows = []
    for kind, regressor in (
        ("PSIM-Linear_d", Ridge()),
        (
            "PSIM-RFF_d",
            RandomFourierRidge(n_frequencies=WAVES, include_inputs=True, alpha=1e-3, random_state=0),
        ),
    ):
        filter = PSIM(regressor, n_future=K, n_iterations=1).fit(train)
        state = {"belief": filter.initial_belief(batch)}
        inputs = np.concatenate([state["belief"], x], axis=1)
        products: list[tuple[Floats, Floats]] = [(filter.model_.features(inputs), filter.model_._weights)]
        if kind == "PSIM-RFF_d":
            products.append((inputs, filter.model_.frequencies_))

        def update(filter: PSIM = filter, state: dict[str, Floats] = state) -> int:
            state["belief"] = filter.update(state["belief"], x)
            return 1

        def bare(products: list[tuple[Floats, Floats]] = products) -> int:
            for left, right in products:
                left @ right
            return 1

        contestants: dict[str, Callable[[], int]] = {"ours": update, "bare": bare}
        found = rates(contestants, seconds=0.3)
        rows.append(
            row(
                f"updates/s, batch of {batch}: {kind}",
                found["ours"],
                "its bare products",
                found["bare"],
                NEAR,
            )
        )
        flops = sum(2.0 * len(a) * b.shape[0] * b.shape[1] for a, b in products)
        limits[f"update of {batch}, {kind}"] = {
            "FLOPs": flops,
            "microseconds": 1e6 / found["ours"].value,
            "GFLOP/s of the bare products": flops * found["bare"].value / 1e9,
        }
    network = GRUFilter(hidden_size=WIDTH * K, n_epochs=1, random_state=0).fit(train)
    held = {"belief": network.initial_belief(batch)}

    def recurrent() -> int:
        held["belief"] = network.update(held["belief"], x)
        return 1

    linear_filter = PSIM(n_future=K, n_iterations=1).fit(train)
    mine = {"belief": linear_filter.initial_belief(batch)}

    def ours() -> int:
        mine["belief"] = linear_filter.update(mine["belief"], x)
        return 1

    found = rates({"ours": ours, "GRU": recurrent}, seconds=0.3)
    rows.append(
        row(
            f"updates/s, batch of {batch}: PSIM-Linear_d", found["ours"], "GRU of the same size", found["GRU"]
        )
    )
    return rows
