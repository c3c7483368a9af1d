"""`beliefgym benchmark dad`: Data as Demonstrator against a plain implementation that refits on the growing aggregate.

Both fit the same model (1000 random Fourier features, ridge) to the same data (1000 noisy pendulum trajectories of 30
steps) in the same 25 iterations with the same rollouts, whole batches at a time, on one thread, and must give the same
errors. The plain one appends the corrections to the aggregate and fits scikit-learn's Ridge to all of it: once with the
features of the aggregate computed anew, as a pipeline does, and once with the features kept, which costs memory.

The ridge is 1e-4 on purpose: at 1e-6, rollouts of whole trajectories amplify rounding from iteration to iteration, and
two correct programs differ visibly after 25; errors could not be compared.

What bounds the time is the matrix product: each iteration adds n rows of m features to Z'Z, n m^2 FLOPs by symmetry.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import Ridge as PlainRidge
from threadpoolctl import threadpool_info, threadpool_limits

from beliefgym.learning import DataAsDemonstrator, RandomFourierRidge, Sequences
from beliefgym.scripts.reproductions.dad_data import pendulum

Array = NDArray[np.float64]
N_TRAJECTORIES, N_STEPS, M, N_ITERATIONS = 1000, 30, 500, 25
NOISE, BANDWIDTH, ALPHA = 0.01, 1.5, 1e-4
SAME = 1e-6  # largest relative difference of errors that is allowed
FASTER, BUSY, FLAT = 10.0, 0.5, 1.1
OURS, ANEW, KEPT = "DataAsDemonstrator", "plain, features anew", "plain, features kept"


def run(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure; each contestant in a process of its own, so that its peak of memory is its own."""
    found = {}
    for name in (OURS, KEPT, ANEW):
        told(name)
        found[name] = _apart(name)
    told("matrix product")
    rate = product_rate()
    ours = found[OURS]
    rows = [_row(f"pairs/s, {N_ITERATIONS} iterations", ours, name, found[name]) for name in (ANEW, KEPT)]
    for name in (ANEW, KEPT):
        difference = float(np.max(np.abs(np.divide(ours["errors"], found[name]["errors"]) - 1.0)))
        rows.append(
            _plain(
                "largest relative difference of errors x 1e9", difference * 1e9, name, SAME * 1e9, most=True
            )
        )
        rows.append(
            _plain(
                "peak memory beyond the data, MiB", ours["memory"], name, None, rival=found[name]["memory"]
            )
        )
    seconds = np.array(ours["seconds"][1:-1])  # iteration 0 starts the aggregate, the last one only predicts
    flat = 100 * seconds[-5:].mean() / seconds[:5].mean()
    grown = 100 * ours["memory"] / ours["memory_2"]
    rows.append(_plain("last five iterations / first five, per cent", flat, "", 100 * FLAT, most=True))
    rows.append(_plain("memory, 25 iterations / 2, per cent", grown, "", 100 * FLAT, most=True))
    flops = aggregate_flops()
    share = flops / sum(ours["seconds"]) / rate
    rows.append(_plain("share of the matrix product's rate, per cent", 100 * share, "dgemm", 100 * BUSY))
    limits = {
        "useful FLOPs": {"Z'Z, half by symmetry": flops},
        "GFLOP/s": {
            "matrix product (dgemm 1000 x 1000)": rate / 1e9,
            "DataAsDemonstrator": share * rate / 1e9,
        },
        "seconds": {name: float(sum(one["seconds"])) for name, one in found.items()},
        "BLAS": ", ".join(
            f"{i['internal_api']} {i['version']} {i.get('architecture', '')}" for i in threadpool_info()
        ),
        "repeats": "ours the median of 3 fits, the plain ones 1 fit each (minutes); one thread",
    }
    return rows, limits


def aggregate_flops() -> float:
    """n m^2 for the first data set and each iteration's corrections."""
    first, later = N_TRAJECTORIES * N_STEPS, N_TRAJECTORIES * (N_STEPS - 1)
    return float((first + N_ITERATIONS * later) * (2 * M) ** 2)


def product_rate(n: int = 1000, repeats: int = 20) -> float:
    """FLOP/s of a matrix product of the size that matters here."""
    a = np.random.default_rng(0).standard_normal((n, n))
    best = np.inf
    with threadpool_limits(1):
        for _ in range(repeats):
            started = time.perf_counter()
            a @ a
            best = min(best, time.perf_counter() - started)
    return 2.0 * n**3 / best


def trajectories() -> Sequences:
    """The data."""
    return pendulum(0, N_TRAJECTORIES, N_STEPS, NOISE)


def ours(sequences: Sequences, n_iterations: int = N_ITERATIONS) -> tuple[list[float], list[float]]:
    """Train multi-step error of each iteration, and its seconds."""
    regressor = RandomFourierRidge(
        n_frequencies=M, bandwidth=BANDWIDTH, alpha=ALPHA, fit_intercept=False, random_state=0
    )
    model = DataAsDemonstrator(regressor, n_iterations=n_iterations, target="next", horizon=None).fit(
        sequences
    )
    return model.history_["train_multi_step"].tolist(), model.history_["seconds"].tolist()


def plain(
    sequences: Sequences, keep_features: bool, n_iterations: int = N_ITERATIONS
) -> tuple[list[float], list[float]]:
    """Algorithm 1 as one would write it: the aggregate grows, and Ridge is fitted to all of it."""
    x = sequences.observations
    mean, std = x.reshape(-1, x.shape[2]).mean(axis=0), x.reshape(-1, x.shape[2]).std(axis=0)
    z = (x - mean) / std
    frequencies = np.random.RandomState(0).standard_normal((z.shape[2], M)) / BANDWIDTH

    def features(inputs: Array) -> Array:
        angles = inputs @ frequencies
        return np.hstack([np.cos(angles), np.sin(angles)]) / M**0.5

    inputs = z[:, :-1].reshape(-1, z.shape[2])
    targets = z[:, 1:].reshape(-1, z.shape[2])
    kept = features(inputs) if keep_features else None
    errors, seconds = [], []
    for n in range(n_iterations + 1):
        started = time.perf_counter()
        design = kept if kept is not None else features(inputs)
        model = PlainRidge(alpha=ALPHA * len(inputs), fit_intercept=False, solver="cholesky", copy_X=False)
        model.fit(design, targets)
        del design
        now, predicted, codes = z[:, 0], [z[:, 0]], []
        for t in range(N_STEPS):
            code = features(now)
            if t:
                codes.append(code)
            now = code @ model.coef_.T
            predicted.append(now)
        rolled = np.stack(predicted, axis=1)
        error = np.square((rolled[:, 1:] - z[:, 1:]) * std).sum(axis=(1, 2))
        errors.append(float(np.sqrt(error / np.square(x[:, 1:]).sum(axis=(1, 2))).mean()))
        if n < n_iterations:
            inputs = np.concatenate([inputs, *(rolled[:, t] for t in range(1, N_STEPS))])
            targets = np.concatenate([targets, *(z[:, t + 1] for t in range(1, N_STEPS))])
            if kept is not None:
                kept = np.concatenate([kept, *codes])
        seconds.append(time.perf_counter() - started)
    return errors, seconds


def _apart(name: str) -> dict[str, Any]:
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return dict(pool.apply(_measured, (name,)))


def _measured(name: str) -> dict[str, Any]:
    with threadpool_limits(1):
        sequences = trajectories()
        small = sequences[:50]
        ours(small, 1), plain(small, True, 1)  # load everything
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        found: dict[str, Any] = {}
        if name == OURS:
            ours(sequences, 2)
            found["memory_2"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
            runs = [ours(sequences) for _ in range(3)]
            errors, seconds = sorted(runs, key=lambda run: sum(run[1]))[1]
        else:
            errors, seconds = plain(sequences, name == KEPT)
        found["memory"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return found | {"errors": errors, "seconds": seconds}


def _row(what: str, ours: dict[str, Any], name: str, rival: dict[str, Any]) -> dict[str, Any]:
    pairs = N_TRAJECTORIES * (N_STEPS + N_ITERATIONS * (N_STEPS - 1))
    values = [pairs / sum(one["seconds"]) for one in (ours, rival)]
    ratio = values[0] / values[1]
    return {
        "what": what,
        "ours": {"value": values[0], "interval": [values[0], values[0]]},
        "rival_name": name,
        "rival": {"value": values[1], "interval": [values[1], values[1]]},
        "ratio": ratio,
        "target": FASTER,
        "meets": ratio >= FASTER,
    }


def _plain(
    what: str,
    value: float,
    name: str,
    target: float | None,
    *,
    most: bool = False,
    rival: float | None = None,
) -> dict[str, Any]:
    """A row that is a number against its target, at most or at least; the ratio is to the rival where there is one."""
    meets = None if target is None else bool(value <= target if most else value >= target)
    return {
        "what": f"{what} (at most)" if most else what,
        "ours": {"value": value, "interval": [value, value]},
        "rival_name": name,
        "rival": None if rival is None else {"value": rival, "interval": [rival, rival]},
        "ratio": None if rival is None else value / rival,
        "target": target,
        "meets": meets,
    }
