"""The filters of Tables 3.6 to 3.8 and their grids: every one tuned on the same validation trajectories.

A method is a grid of settings; each is fitted to the training part, and the one with the lowest mean error of the hint
on the validation part is taken; the test part is looked at once, by that one. As in the thesis, F is linear or of
random Fourier features, and so is the autoregressive filter; the pre-image g is a random forest, random Fourier
features or linear, by cross-validation on the training part. Settings are screened with fewer random features and
iterations and a g without forests, and the best two fitted in full. The features of beliefs are the thesis's: first
and second moments for the pendulum and for every IMF, first ones for all else.

On the lifts, where episodes are short against k_f and go through the same phases, futures go on past an episode's end
(`pad_end`), and the weight of the hint in the belief is among the settings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from beliefgym.learning import Sequences
from beliefgym.learning.hint_autoregressive import AutoregressiveHints
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim_hints import InferenceMachineFilter, PSIMHints
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.standardisation import Standardisation
from beliefgym.scripts.reproductions.hints_data import TASKS, Parts
from beliefgym.scripts.reproductions.psim_methods import quiet

VERSION = 1  # of the grids; cells made with another one run again
VERSIONS = {
    ("lift", group): 2 for group in ("ar", "imf", "psim-5", "psim-20")
}  # where a task's and group's are others


@dataclass(frozen=True)
class Grid:
    """Settings of a task's learned filters: ridges a sample, in standardised units, and of random features theirs.

    Attributes:
        alphas: of linear ones. bandwidths: of random features, times the square root of the number of inputs.
        wave_alphas: their ridges. hint_weights: of PSIM+Hints with random features.
    """

    alphas: tuple[float, ...]
    bandwidths: tuple[float, ...]
    wave_alphas: tuple[float, ...]
    hint_weights: tuple[float, ...] = (1.0,)


SWINGS = Grid((1e-8, 1e-5, 1e-2), (0.5, 1.0, 2.0), (1e-8, 1e-5, 1e-2))
ATTITUDES = Grid((1e-6, 1e-4, 1e-2, 1e-1), (1.0, 2.0, 4.0), (1e-6, 1e-4, 1e-2))
GRIDS = {
    "pendulum-full": SWINGS,
    "pendulum-partial": SWINGS,
    "pendulum-noisy": SWINGS,
    "pendulum-many": SWINGS,
    "quadrotor": ATTITUDES,
    "imu": ATTITUDES,
    "lift": Grid((1e-5, 1e-3, 1e-1), (2.0, 4.0), (1e-5, 1e-4, 1e-3), (1.0, 3.0)),
    "payload": Grid((1e-8, 1e-5, 1e-2, 1e-1), (1.0, 2.0), (1e-6, 1e-5), (1.0, 3.0)),
}
WAVES, SCREENED_WAVES = 300, 100  # random frequencies; of the settings that are only screened
N_ITERATIONS, SCREENING = 25, 12  # of DAgger; of these
N_FINAL = 2  # settings that are fitted in full
FOREST: dict[str, Any] = {"n_estimators": 30, "max_samples": 4000, "min_samples_leaf": 5, "max_features": 0.4}
PREIMAGE_WAVES, LARGE = 200, 600
N_PAST = 5  # k_p of the autoregressive filter, as in the thesis
RATES, N_EPOCHS, PATIENCE = (1e-2,), 60, 15  # of the recurrent network: its default rate
WIDE = {"lift", "payload"}  # tasks of many components: fewer iterations, fewer settings
N_MOTIONS, MOTION_BINS = 4, 10  # of the recorded lifts: pick, hold, shake, lower
Setting = dict[str, Any]
Make = Callable[[Setting, bool], HintFilter]  # a setting, and whether it is to be fitted in full


def groups(name: str) -> tuple[str, ...]:
    """Of the methods on a task, each run as one cell."""
    return (
        "kalman",
        "ar",
        "imf",
        *(f"psim-{k}" for k in TASKS[name].horizons),
        *(("gru",) if TASKS[name].horizons else ()),
        *(("physics",) if has_physics(name) else ()),
        *(("whole", "told-phase", "imf-large") if name == "payload" else ()),
    )


def has_physics(name: str) -> bool:
    """Whether there is a filter that knows the system."""
    return name in ("pendulum-full", "pendulum-noisy", "pendulum-many", "quadrotor", "imu")


def results(group: str, name: str, parts: Parts, seed: int) -> dict[str, Any]:
    """Every method of a group on one fold: name -> what it came to."""
    train, validation, test = parts
    with quiet():
        if group == "physics":
            from beliefgym.scripts.reproductions.hints_physics import physics

            return {method: measured(one, test) for method, one in physics(name, parts, seed)}
        if group == "kalman":
            from beliefgym.learning.hint_kalman import KalmanHints

            return {"Linear KF": measured(_timed(KalmanHints(), train, validation), test)}
        if group == "gru":
            from beliefgym.learning.hint_recurrent import GRUHints

            def network(setting: Setting, whole: bool) -> HintFilter:
                return GRUHints(random_state=seed, patience=PATIENCE, n_epochs=N_EPOCHS, **setting)

            return {"GRU": _chosen(network, [{"learning_rate": rate} for rate in RATES], parts)}
        if group == "whole":
            return {"ridge, whole trajectory": _whole_trajectory(parts)}
        if group == "told-phase":
            told = (_with_phase(train), _with_phase(validation), _with_phase(test))
            found = _chosen(_psim(name, 0, told[0], seed), _settings(name), told)
            return {"IMF, told the phase": found}
        if group == "imf-large":
            return {f"IMF, {LARGE} frequencies": _large(parts, seed)}
        if group == "ar":

            def past(setting: Setting, whole: bool) -> HintFilter:
                regressor = _regressor(setting, N_PAST * train.n_obs, whole, seed)
                return AutoregressiveHints(regressor, n_past=N_PAST)

            return {f"AR (k_p = {N_PAST})": _chosen(past, _settings(name), parts)}
        if group == "imf":
            return {"IMF": _chosen(_psim(name, 0, train, seed), _settings(name), parts)}
        k = int(group.removeprefix("psim-"))
        settings = _settings(name, GRIDS[name].hint_weights)
        return {f"PSIM+Hints (k_f = {k})": _chosen(_psim(name, k, train, seed), settings, parts)}


def measured(one: dict[str, Any], test: Sequences) -> dict[str, Any]:
    """What a fitted filter does on the test part, beside how it was found."""
    errors = one.pop("filter").hint_errors(test)
    last = errors.difference[np.arange(len(test)), test.lengths]
    norm = errors.norm
    return one | {
        "test": errors.mean,
        "by_episode": errors.by_episode.tolist(),
        "by_time": _short(np.nansum(norm, axis=0)),
        "squares_by_time": _short(np.nansum(np.square(norm), axis=0)),
        "n_by_time": np.isfinite(norm).sum(axis=0).tolist(),
        "rmse": errors.rmse.tolist(),
        "end_squared": np.square(last).sum(axis=1).tolist(),
        "mean_squared_z": errors.mean_squared_z.tolist(),
        "coverage": errors.coverage().tolist(),
    }


def _whole_trajectory(parts: Parts) -> dict[str, Any]:
    """A ridge from all observations of a trajectory to the hint at its end, which only then is there: no filter."""
    began = time.perf_counter()
    inputs, targets = zip(*(_at_the_end(part) for part in parts), strict=True)
    scale = Standardisation.of(inputs[0])
    x = [scale.apply(one) for one in inputs]
    best: dict[str, Any] = {"validation": np.inf}
    for alpha in (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0):
        model = Ridge(alpha=alpha).fit(x[0], targets[0])
        error = float(np.abs(model.predict(x[1]) - targets[1]).mean())
        if error < best["validation"]:
            test = model.predict(x[2]) - targets[2]
            best = {"validation": error, "setting": {"alpha": alpha}}
    end = np.square(test).sum(axis=1)
    return best | {
        "test": float(np.sqrt(end).mean()),
        "by_episode": np.sqrt(end).tolist(),
        "end_squared": end.tolist(),
        "mean_squared_z": [float("nan")],
        "coverage": [float("nan")],
        "seconds": time.perf_counter() - began,
    }


def _with_phase(part: Sequences) -> Sequences:
    """The lifts with what the robot itself knows: which of its four motions it is in, and how far."""
    n, n_rows, _ = part.observations.shape
    time = np.arange(n_rows)
    motion = np.eye(N_MOTIONS)[time // MOTION_BINS]
    told = np.column_stack([motion, (time % MOTION_BINS) / MOTION_BINS])
    everyone = np.broadcast_to(told, (n, *told.shape))
    observations = np.concatenate([part.observations, everyone], axis=2)
    return Sequences.from_observations(observations, hints=part.hints, lengths=part.lengths)


def _at_the_end(part: Sequences) -> tuple[Any, Any]:
    assert part.hints is not None
    return part.observations.reshape(len(part), -1), part.hints[np.arange(len(part)), part.lengths]


def _large(parts: Parts, seed: int) -> dict[str, Any]:
    """The IMF of the recorded lifts with twice the random features and iterations, and one finer ridge."""

    def make(setting: Setting, whole: bool) -> HintFilter:
        regressor = RandomFourierRidge(
            n_frequencies=LARGE,
            bandwidth=(2 + parts[0].n_obs) ** 0.5,
            alpha=setting["alpha"],
            include_inputs=True,
            random_state=seed,
        )
        return InferenceMachineFilter(
            regressor, features="second", preimage=_preimages(False, seed), n_iterations=30
        )

    return _chosen(make, [{"alpha": alpha} for alpha in (1e-7, 1e-6)], parts, n_final=1)


def _short(values: Any) -> list[float]:
    """To five digits: sums over trajectories at each time, from which figures are drawn."""
    return [float(f"{value:.5g}") for value in values]


def _psim(name: str, k: int, train: Sequences, seed: int) -> Make:
    features: Any = "second" if name.startswith("pendulum") or k == 0 else "first"
    assert train.hints is not None
    size = (train.hints.shape[2] + k * train.n_obs) * (2 if features == "second" else 1)

    def make(setting: Setting, whole: bool) -> HintFilter:
        wide = name in WIDE
        shared: dict[str, Any] = {
            "features": features,
            "preimage": _preimages(whole, seed),
            "n_iterations": (15 if wide else N_ITERATIONS) if whole else (5 if wide else SCREENING),
        }
        regressor = _regressor(setting, size + train.n_obs, whole, seed)
        if not k:
            return InferenceMachineFilter(regressor, **shared)
        shared |= {"pad_end": wide, "hint_weight": setting.get("hint_weight", 1.0)}
        return PSIMHints(regressor, n_future=k, **shared)

    return make


def _settings(name: str, weights: Sequence[float] = (1.0,)) -> list[Setting]:
    grid = GRIDS[name]
    return [
        *({"family": "linear", "alpha": alpha} for alpha in grid.alphas),
        *(
            {"family": "RFF", "bandwidth": bandwidth, "alpha": alpha} | _weighed(weight)
            for bandwidth in grid.bandwidths
            for alpha in grid.wave_alphas
            for weight in weights
        ),
    ]


def _weighed(weight: float) -> Setting:
    return {} if weight == 1.0 else {"hint_weight": weight}


def _regressor(setting: Setting, n_inputs: int, whole: bool, seed: int) -> Any:
    if setting["family"] == "linear":
        return Ridge(alpha=setting["alpha"])
    return RandomFourierRidge(
        n_frequencies=WAVES if whole else SCREENED_WAVES,
        bandwidth=setting["bandwidth"] * n_inputs**0.5,
        alpha=setting["alpha"],
        include_inputs=True,
        random_state=seed,
    )


def _preimages(whole: bool, seed: int) -> Sequence[Any]:
    n = PREIMAGE_WAVES if whole else PREIMAGE_WAVES // 2
    waves = [
        RandomFourierRidge(n_frequencies=n, alpha=alpha, include_inputs=True, random_state=seed)
        for alpha in ((1e-5, 1e-3) if whole else (1e-4,))
    ]
    forest = [RandomForest(**FOREST, random_state=seed)]
    return [Ridge(alpha=1e-4), *waves, *(forest if whole else [])]


def _timed(filter: HintFilter, train: Sequences, validation: Sequences) -> dict[str, Any]:
    began = time.perf_counter()
    filter.fit(train, validation)
    return {
        "filter": filter,
        "seconds": time.perf_counter() - began,
        "validation": filter.hint_errors(validation).mean,
    }


def _chosen(make: Make, settings: list[Setting], parts: Parts, n_final: int | None = None) -> dict[str, Any]:
    """Screen all settings, fit the best few in full, and measure the best of these."""
    train, validation, test = parts
    began = time.perf_counter()
    screened = [(_timed(make(setting, False), train, validation), setting) for setting in settings]
    order = np.argsort([one["validation"] for one, _ in screened], kind="stable")
    best: dict[str, Any] | None = None
    for i in order[: n_final or N_FINAL]:
        one = _timed(make(settings[i], True), train, validation) | {"setting": settings[i]}
        if best is None or one["validation"] < best["validation"]:
            best = one
    assert best is not None
    best["preimage"] = getattr(getattr(best["filter"], "_reading", None), "name", None)
    return measured(best, test) | {"seconds_tuning": time.perf_counter() - began}
