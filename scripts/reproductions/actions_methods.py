"""The filters of `beliefgym reproduce actions-interventions`, tuned alike, and what is measured of them.

Tuning knows policy A alone: k and the regressor's setting with the lowest error of the next observation on validation
trajectories of A are taken. Policy B is looked at once, by the chosen filter.

    excess   |x_hat_{t+i} - E[x_{t+i} | h_t, do(a)]|^2 over the error of that expectation itself, on histories and with
             actions of B; error over exact error is 1 + excess
    do, own  root mean square over i = 1 .. k - 1 of what m_t's block i is away from its expectation under the blind
             reference mu ("do", Eq. 4.13) and under A ("own"), on histories of A, in units of the distance between both

Measured against expectations, nothing is noise; and actions of a feedback policy, which tell of the observations in
between, are no help to a forecast that takes them for hints.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning import Sequences
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.filters import Filter
from beliefgym.learning.linear_in_features import LinearInFeatures, Ridge
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_actions import PSIMActions
from beliefgym.learning.psim_conditional import ConditionalPSIM
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.scripts.reproductions.actions_data import Colour, Feedback, LinearWorld, RingWorld
from beliefgym.scripts.reproductions.actions_pendulum import Swing
from beliefgym.scripts.reproductions.report import Interval

Floats = NDArray[np.float64]
Result = dict[str, Any]
PLAIN, NAIVE, UNWEIGHED = (
    "PSIM, observations alone",
    "naive joint model (Eq. 4.6)",
    "PSIM+Actions, no weights",
)
ORDINARY, WEIGHTED = "ordinary IS (Eq. 4.14)", "WIS"
DECISION, TRUNCATED = "per-decision WIS", "per-decision WIS, truncated"
CONDITIONAL, CONDITIONAL_IS = "ConditionalPSIM, no weights", "ConditionalPSIM, weights"
METHODS = (
    PLAIN,
    NAIVE,
    UNWEIGHED,
    ORDINARY,
    WEIGHTED,
    DECISION,
    TRUNCATED,
    CONDITIONAL,
    CONDITIONAL_IS,
)
WITH_WEIGHTS = (ORDINARY, WEIGHTED, DECISION, TRUNCATED, CONDITIONAL_IS)
FEW_METHODS = (UNWEIGHED, TRUNCATED, CONDITIONAL_IS)  # those fitted with too few observations in the belief
LIMIT = 10.0  # of truncated weights, in means
POLICIES = ("same", "blind", "opposite")  # B
AHEAD = (1, 3, 5, 10)  # observations
HEADLINE = AHEAD.index(5)  # the look-ahead of the main table
WARM, STRIDE = 10, 2  # times from which on, and at every how many, beliefs are looked at
World = LinearWorld | RingWorld | Swing


def method(name: str, world: str, k: int, setting: dict[str, Any], n_iterations: int, seed: int) -> Filter:
    """One filter, not fitted."""
    regressor = _regressor(setting, seed)
    common: dict[str, Any] = {"n_future": k, "n_iterations": n_iterations}
    if name == PLAIN:
        return PSIM(regressor, **common)
    common["n_choices"] = 2 if world == "ring" else None
    if name in (CONDITIONAL, CONDITIONAL_IS):
        effects: Any = "bilinear" if world == "ring" else "constant"
        return ConditionalPSIM(regressor, effects=effects, importance=name == CONDITIONAL_IS, **common)
    if name in (NAIVE, UNWEIGHED):
        return PSIMActions(regressor, state="joint" if name == NAIVE else "observations", **common)
    return PSIMActions(
        regressor,
        importance="ordinary" if name == ORDINARY else "weighted",
        per_decision=name in (DECISION, TRUNCATED),
        truncate=LIMIT if name == TRUNCATED else None,
        **common,
    )


def _regressor(setting: dict[str, Any], seed: int) -> LinearInFeatures:
    if "n_frequencies" not in setting:
        return Ridge(**setting)
    return RandomFourierRidge(include_inputs=True, random_state=seed, **setting)


def results(cell: dict[str, Any]) -> Result:
    """All methods on one world, policy A and seed."""
    warnings.simplefilter("ignore", DivergenceWarning)
    warnings.filterwarnings("ignore", message=".*futures carry the weight of all")
    world, recorded, others = WORLDS[cell["world"]](), *policies(cell)
    draw = _drawer(world, cell)
    n_train, n_validation, n_test = cell["sizes"]
    train, validation = draw(recorded, n_train, 0), draw(recorded, n_validation, 1)
    tests = {name: draw(policy, n_test, 2 + i) for i, (name, policy) in enumerate(others.items())}
    found: dict[str, Result] = {}
    for name in METHODS:
        best, by_k = tuned(name, cell, cell["n_future"], train, validation)
        one: Result = {"setting": best[1], "validation": best[2]}
        one |= {"effective": effective(best[0]), "n_train": _n_tests(train, best[0])}
        one["excess"] = {b: excess(world, best[0], tests[b]) for b in tests}
        if not isinstance(world, Swing):
            one["by_k"] = {
                str(k): of_beliefs(world, f, recorded, tests["same"], train) for k, f in by_k.items()
            }
            one |= one["by_k"][str(best[1]["n_future"])]
        found[name] = one
    few: dict[str, dict[str, Result]] = {}
    for k in cell["few"]:
        few[str(k)] = {}
        for name in FEW_METHODS:
            best, _ = tuned(name, cell, [k], train, validation)
            few[str(k)][name] = {"excess": {b: excess(world, best[0], tests[b]) for b in tests}}
    drift = {name: _divergence(world, others[name], recorded, tests[name]) for name in tests}
    return {"methods": found, "few": few, "drift": drift}


def policies(cell: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """A, and the policies B by their names."""
    make: Callable[[float], Any] = MAKE[cell["world"]]
    recorded = make(cell["level"])
    return recorded, dict(zip(POLICIES, (recorded, make(0.0), make(cell["opposite"])), strict=True))


def tuned(
    name: str, cell: dict[str, Any], sizes: list[int], train: Sequences, validation: Sequences
) -> tuple[tuple[Filter, dict[str, Any], float], dict[int, Filter]]:
    """The filter with the lowest one-step error on validation trajectories, and the best of each k."""
    best: tuple[Filter, dict[str, Any], float] | None = None
    by_k: dict[int, Filter] = {}
    lowest: dict[int, float] = {}
    for k, setting in product(sizes, cell["settings"]):
        made = method(name, cell["world"], k, setting, cell["n_iterations"], cell["seed"])
        fitted = made.fit(train, validation)
        error = float(fitted.errors(validation).mean)
        if k not in lowest or error < lowest[k]:
            lowest[k], by_k[k] = error, fitted
        if best is None or error < best[2]:
            best = fitted, {"n_future": k, **setting}, error
    assert best is not None
    return best, by_k


def excess(world: World, filter: Filter, test: Sequences) -> list[float]:
    """(len(AHEAD),) how far forecasts are from the exact ones, as a share of the exact ones' own squared error.

    Of the pendulum, which is free of noise, the mean squared error itself; its observations have length 1.
    """
    horizon = AHEAD[-1]
    times = np.arange(WARM, test.observations.shape[1] - horizon, STRIDE)
    beliefs = _rows(filter.beliefs(test), times)
    actions = np.stack([test.actions[:, t : t + horizon] for t in times], axis=1)
    actions = actions.reshape(len(beliefs), horizon, -1)
    forecast = filter.forecast(beliefs, horizon, actions)
    least: Any = 1.0
    if isinstance(world, Swing):
        exact = np.stack([test.observations[:, t : t + horizon] for t in times], axis=1).reshape(
            forecast.shape
        )
    else:
        known = _rows(world.known(test), times)
        exact = world.under_actions(known, actions, horizon)
        least = world.least_errors(known, actions, horizon)
    share = np.square(forecast - exact).sum(axis=2).mean(axis=0) / least
    return [float(share[i - 1]) for i in AHEAD]


def of_beliefs(
    world: LinearWorld | RingWorld, filter: Any, recorded: Any, test: Sequences, train: Sequences
) -> Result:
    """Distances "do" and "own" of a filter's beliefs on trajectories of A, and "gap", that of both expectations."""
    k = filter.n_future
    times = np.arange(WARM, test.observations.shape[1] - k, STRIDE)
    found = blocks(filter, _rows(filter.beliefs(test), times))[:, 1:]
    known = _rows(world.known(test), times)
    blind = world.under_reference(known, train.actions[train.step_mask], k)[:, 1:]
    own = world.under_policy(known, recorded, k)[:, 1:]
    gap = _rms(own - blind)
    return {"do": _rms(found - blind), "own": _rms(found - own), "gap": gap, "effective": effective(filter)}


def geometric(values: Iterable[float]) -> Interval:
    """The geometric mean with its interval."""
    log = Interval.of(np.log(np.array(list(values))))
    mean, low, high = (float(np.exp(v)) for v in (log.mean, log.low, log.high))
    return Interval(mean, low, high, log.n)


def shown(world: str, excess: Iterable[float]) -> Interval:
    """Errors as the tables show them: over the exact predictor's, or of the pendulum in % of its length."""
    values = np.array(list(excess))
    return geometric(100.0 * np.sqrt(values) if world == "swing" else 1.0 + values)


def paired(results: list[Result], better: str, worse: str, measure: str) -> Interval:
    """Ratio of distances from do() ("do", over all k) or of excess errors 5 steps ahead under B, seed by seed."""

    def of(one: Result) -> float:
        if measure == "do":
            return geometric(held["do"] / held["gap"] for held in one["by_k"].values()).mean
        return float(one["excess"][measure][HEADLINE])

    return geometric(of(one["methods"][better]) / of(one["methods"][worse]) for one in results)


def blocks(filter: Any, beliefs: Floats) -> Floats:
    """The observations that beliefs hold, in the data's units: (n, belief_size) -> (n, k, n_obs)."""
    shifted = [np.roll(beliefs, -i * filter.n_obs_, axis=1) for i in range(filter.n_future)]
    return np.stack([filter.predict_observation(rows) for rows in shifted], axis=1)


def effective(filter: Any) -> float:
    """Share of effective samples for the last observation of a belief; 1 without weights."""
    return float(getattr(filter, "effective_samples_", np.ones(1))[-1])


def _n_tests(train: Sequences, filter: Any) -> int:
    return int(np.maximum(train.lengths + 2 - filter.n_future, 0).sum())


def _rows(values: Floats, times: NDArray[np.intp]) -> Floats:
    return values[:, times].reshape(-1, values.shape[2])


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _drawer(world: World, cell: dict[str, Any]) -> Callable[[Any, int, int], Sequences]:
    """Trajectories of a policy; each part has random numbers of its own."""

    def draw(policy: Any, n: int, part: int) -> Sequences:
        if isinstance(policy, Swing):
            return policy.sample(n, cell["n_steps"], 100_000 * (part + 1) + 1000 * cell["seed"])
        rng = np.random.default_rng([cell["seed"], part])
        sampled: Sequences = world.sample(policy, n, cell["n_steps"], rng)  # type: ignore[union-attr,call-arg,arg-type]
        return sampled

    return draw


def _divergence(world: Any, ours: Any, theirs: Any, test: Sequences) -> float:
    if isinstance(ours, Swing):
        return ours.divergence(theirs, test)
    return float(world.divergence(ours, theirs, test))


def _swing() -> World:
    return Swing(0.0)


WORLDS: dict[str, Callable[[], World]] = {
    "output": LinearWorld,
    "cancelling": LinearWorld,
    "ring": RingWorld,
    "swing": _swing,
}
MAKE: dict[str, Callable[[float], Any]] = {
    "output": Feedback,
    "cancelling": lambda gain: Feedback(gain, "estimate"),
    "ring": Colour,
    "swing": Swing,
}
