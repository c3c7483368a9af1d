"""What a filter is like: whether it forgets, whether its variances are true, and how it errs ahead and over time.

A filter m_{t+1} = F(m_t, x_t) forgets its start where tangent vectors shrink along the trajectories it filters:

    v_{t+1} = J_t v_t,    J_t = dF / dm (m_t, x_t),    lambda = lim 1/t log |v_t|     (the largest Lyapunov exponent)

and lambda < 0. Where J is one matrix, lambda is the logarithm of its spectral radius. The radii of single J_t bound
nothing by themselves: products of contractions may grow, and of expansions shrink.

A filter that gives variances is calibrated where z = (x_t - x_hat_t) / sigma_t has mean square 1 and, for Gaussian
observations, lies in [-q, q] as often as a normal number does.

References: for the exponent, Benettin, Galgani, Giorgilli & Strelcyn, "Lyapunov characteristic exponents", Meccanica
15, 1980; for the figures, thesis proposal, Sec. 3.3.4, Fig. 3.20.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from beliefgym.learning.filter_errors import FilterErrors
from beliefgym.learning.filters import Filter, check_finite, check_whole
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.predictive_state import PredictiveStateFilter
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
STEP = float(np.finfo(float).eps) ** (1 / 3)  # of central differences, as a share of a belief's size
NOMINAL = (0.5, 0.6827, 0.9, 0.95)


@dataclass(frozen=True)
class Stability:
    """Whether a filter forgets.

    Attributes:
        radius_median, radius_max: of the spectral radii of J_t, over all t of all trajectories.
        lyapunov_exponent: log growth of a tangent vector a step; minus infinity where it is gone after a few.
        is_contracting: whether that is below 0: differences between beliefs fade.
    """

    radius_median: float
    radius_max: float
    lyapunov_exponent: float
    is_contracting: bool


@dataclass(frozen=True, eq=False)
class Calibration:
    """Whether predicted variances are true, over all observations but the first of each trajectory.

    Attributes:
        mean_squared_z: (n_obs,) 1 where a component's variance is right, below 1 where it is too large.
        nominal: (4,) probabilities of central intervals. coverage: (4,) the share of numbers that lie in them.
        log_likelihood: mean of log N(x_t; x_hat_t, diag sigma_t^2), nats an observation (all components together).
        constant_log_likelihood: the same with one variance for each component, the mean squared error on these very
            sequences. It is the best there is without a variance that varies, and knows the outcome: a filter that
            comes close to it has the right size of variance, one above it the right times.
        n_without_variance: numbers whose predicted variance was 0. With an error there, z is infinite and the
            likelihood of it all 0; without, z is 0.
    """

    mean_squared_z: Array
    nominal: Array
    coverage: Array
    log_likelihood: float
    constant_log_likelihood: float
    n_without_variance: int


@dataclass(frozen=True, eq=False)
class ErrorCurves:
    """Errors of several filters on the same trajectories, as for Fig. 3.20.

    Attributes:
        steps: (n,) observations ahead (1, 2, ..), or observations seen (0, 1, ..).
        errors: name -> (n,) mean squared error, summed over components, in the data's units squared.
        power: mean of |x_t|^2, the "trajectory power".
    """

    steps: NDArray[np.int64]
    errors: dict[str, Array]
    power: float


def filter_jacobian(filter: Filter, belief: ArrayLike, observation: ArrayLike) -> Array:
    """J = dF / dm at each row: the matrix itself where it is constant, else by central differences in one batch.

    Of F without the bounds that beliefs are kept in, and of a filter with actions at the average one. The step that a
    `ForwardPSIM` counts in its belief is no coordinate of the state, and left out.

    Args:
        filter: fitted. belief: (n, belief_size). observation: (n, n_obs), in the units of the training data.

    Returns:
        (n, size, size), size = belief_size (without that step); [i, j, l] is the derivative of component j by l.

    Raises:
        NotFittedError. ValueError: shapes, NaN or infinities.
    """
    b = filter._checked_belief(belief)
    x = np.asarray(observation, dtype=np.float64)
    if x.shape != (len(b), filter.n_obs_):
        raise ValueError(f"observation: expected shape {(len(b), filter.n_obs_)}, got {x.shape}")
    check_finite("belief", b)
    check_finite("observation", x)
    return _jacobian(filter, b, filter._scale.apply(x))


def spectral_radius(filter: Filter) -> float:
    """The largest absolute eigenvalue of J, for a filter with constant J: at this rate it forgets.

    Raises:
        NotFittedError. ValueError: a filter whose J varies; ask for its `stability` along trajectories.
    """
    filter._check_fitted()
    matrix = constant_jacobian(filter)
    if matrix is None:
        raise ValueError(
            f"expected a filter linear in its belief, got a {type(filter).__name__} whose derivative varies; "
            "stability(filter, sequences) follows it along trajectories"
        )
    return _radius(matrix)


def stability(filter: Filter, sequences: Sequences | None = None) -> Stability:
    """Spectral radii, and the largest Lyapunov exponent.

    Where J varies, the exponent is the mean log growth a step of one tangent vector for each trajectory, over the
    second half of each: in the first it turns into the direction of the largest growth. Long trajectories, of hundreds
    of steps, give it to two digits.

    Args:
        filter: fitted.
        sequences: trajectories along which J varies; a filter with constant J needs none, and does not look at them.

    Raises:
        NotFittedError. ValueError: no trajectories of at least one step where J varies.
    """
    filter._check_fitted()
    matrix = constant_jacobian(filter)
    if matrix is not None:
        radius = _radius(matrix)
        exponent = float(np.log(radius)) if radius > 0 else -np.inf
        return Stability(radius, radius, exponent, radius < 1)
    if sequences is None or not sequences.n_transitions:
        raise ValueError(
            f"expected trajectories of at least one step for a {type(filter).__name__}, whose derivative varies, got "
            f"{sequences!r}"
        )
    beliefs, z, lengths = filter.beliefs(sequences), filter._standardised(sequences), sequences.lengths
    size = _state_size(filter)
    tangent = np.random.default_rng(0).standard_normal((len(z), size))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    radii: list[Array] = []
    growth, n_steps = 0.0, 0
    for t in range(z.shape[1]):
        going = np.flatnonzero(lengths >= t)
        if not len(going):
            break
        matrices = _jacobian(filter, beliefs[going, t], z[going, t])
        radii.append(np.abs(np.linalg.eigvals(matrices)).max(axis=1))
        moved = np.einsum("nij,nj->ni", matrices, tangent[going])
        norm = np.linalg.norm(moved, axis=1)
        counted = t >= (lengths[going] + 1) // 2
        with np.errstate(divide="ignore"):
            growth += float(np.log(norm[counted]).sum())
        n_steps += int(counted.sum())
        tangent[going] = moved / np.where(norm > 0, norm, 1.0)[:, None]
    every = np.concatenate(radii)
    exponent = growth / n_steps
    return Stability(float(np.median(every)), float(every.max()), exponent, exponent < 0)


def calibration(filter: Any, sequences: Sequences, least_variance: float = 0.0) -> Calibration:
    """Compare predicted variances with the errors that came.

    Args:
        filter: fitted, with `predict_variance`: `KalmanFilter`, the linear filters, `PSIM` with features "second".
        sequences: trajectories that the filter was not fitted to.
        least_variance: predicted variances are raised to this share of the mean squared error of their component. A
            PSIM's second moments may leave a variance of 0, for which a single error is an infinite surprise.

    Raises:
        TypeError: a filter without variances. ValueError: as of the filter; no observation but first ones.
    """
    if not callable(getattr(filter, "predict_variance", None)):
        raise TypeError(
            f"expected a filter with predict_variance, got {type(filter).__name__}; KalmanFilter and PSIM("
            "features='second') have it"
        )
    if not (np.isfinite(least_variance) and least_variance >= 0):
        raise ValueError(f"expected least_variance finite and at least 0, got {least_variance!r}")
    beliefs = filter.beliefs(sequences)[:, 1:-1]
    counts = sequences.observation_mask[:, 1:]
    if not counts.any():
        raise ValueError(f"expected trajectories of at least one step, got {sequences!r}")
    rows = beliefs[counts]
    squared = np.square(sequences.observations[:, 1:][counts] - filter.predict_observation(rows))
    variance, constant = filter.predict_variance(rows), squared.mean(axis=0)
    variance = np.maximum(variance, least_variance * constant)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(squared == 0, 0.0, squared / variance)
        log_density = -0.5 * (np.log(2 * np.pi * variance) + z)
        constant_log_likelihood = -0.5 * (np.log(2 * np.pi * constant) + 1.0).sum()
    impossible = (variance == 0) & (squared > 0)
    log_likelihood = -np.inf if impossible.any() else log_density.sum(axis=1).mean()
    inside = np.square(ndtri(0.5 + 0.5 * np.array(NOMINAL)))
    coverage = np.array([(z <= limit).mean() for limit in inside])
    n_without = int(np.count_nonzero(variance == 0))
    return Calibration(
        z.mean(axis=0),
        np.array(NOMINAL),
        coverage,
        float(log_likelihood),
        float(constant_log_likelihood),
        n_without,
    )


def look_ahead_errors(filters: Mapping[str, Filter], sequences: Sequences, horizon: int) -> ErrorCurves:
    """The error of each filter 1 .. horizon observations ahead: the curves of Fig. 3.20.

    Args:
        filters: name -> fitted filter. sequences: the same trajectories for all. horizon: at least 1.

    Returns:
        With `steps` 1 .. horizon. Means as of `FilterErrors.by_look_ahead`; NaN where no trajectory is that long.
    """
    check_whole("horizon", horizon, 1)
    found = _errors(filters, sequences, int(horizon))
    curves = {name: errors.by_look_ahead for name, errors in found.items()}
    return ErrorCurves(np.arange(1, horizon + 1), curves, next(iter(found.values())).power)


def error_over_time(filters: Mapping[str, Filter], sequences: Sequences) -> ErrorCurves:
    """The error of each filter, one observation ahead, after 0, 1, .. observations of a trajectory.

    Returns:
        With `steps` 0 .. n_steps. Means over the trajectories that are that long.
    """
    found = _errors(filters, sequences, 1)
    curves = {name: errors.by_time for name, errors in found.items()}
    return ErrorCurves(np.arange(sequences.n_steps + 1), curves, next(iter(found.values())).power)


def constant_jacobian(filter: Any) -> Array | None:
    """J (size, size) where it is one matrix: of linear filters, and of predictive state filters with `Ridge`."""
    if isinstance(filter, PredictiveStateFilter):
        size, model = _state_size(filter), getattr(filter, "model_", None)
        return np.ascontiguousarray(model._weights[:size].T) if isinstance(model, Ridge) else None
    if getattr(filter, "stationary", True) and hasattr(type(filter), "transition_matrix"):
        return np.asarray(filter.transition_matrix, dtype=np.float64)
    return None


def _jacobian(filter: Filter, belief: Array, z: Array) -> Array:
    """(n, size, size), of standardised observations; no checks."""
    n, size = len(belief), _state_size(filter)
    matrix = constant_jacobian(filter)
    if matrix is not None:
        return np.tile(matrix, (n, 1, 1))
    scale = np.abs(belief[:, :size]).max(axis=0, initial=0.0)  # of each component in this batch
    step = STEP * np.where(scale > 0, scale, scale.max() if scale.any() else 1.0)
    up = np.repeat(belief[:, None], size, axis=1)
    down = up.copy()
    component = np.arange(size)
    up[:, component, component] += step
    down[:, component, component] -= step
    width = up[:, component, component] - down[:, component, component]  # as rounded
    both = np.concatenate([up, down]).reshape(2 * n * size, -1)
    inputs = np.tile(np.repeat(filter._with_actions(z, None), size, axis=0), (2, 1))
    following = filter._update(both, inputs)[:, :size]
    above, below = following.reshape(2, n, size, size)
    return np.swapaxes((above - below) / width[:, :, None], 1, 2)


def _state_size(filter: Filter) -> int:
    """Components of a belief that F is differentiated by."""
    return filter._phi.size if isinstance(filter, PredictiveStateFilter) else filter.belief_size


def _radius(matrix: Array) -> float:
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def _errors(filters: Mapping[str, Filter], sequences: Sequences, horizon: int) -> dict[str, FilterErrors]:
    if not filters:
        raise ValueError("expected at least one filter, got none")
    return {name: filter.errors(sequences, horizon) for name, filter in filters.items()}
