"""What a filter of a known system is told, checked: names, noise, hint, and prior."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.system import System
from beliefgym.learning.linear_gaussian import symmetric
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
ASYMMETRY = 1e-8  # a covariance may differ from its transpose by this share of the deviations, as rounding
NEGATIVE = 1e-8  # a correlation matrix may have eigenvalues this far below 0, as rounding


class Parameters(NamedTuple):
    """Checked parameters of a `PhysicsFilter`.

    Attributes:
        observed: names of what is observed, and observed_columns (n_obs,) their places in the full observation.
        noise_variance: (n_obs,) of the observation noise.
        hint_names: names of the hint's components. hint_columns: (n_hint,) their places in the state; None where the
            system computes them.
        additive_variance: (n_state,) of the noise that one step adds to the state, where the system's noise is no more
            than that; None where it enters the step.
    """

    observed: tuple[str, ...]
    observed_columns: NDArray[np.intp]
    noise_variance: Array
    hint_names: tuple[str, ...]
    hint_columns: NDArray[np.intp] | None
    additive_variance: Array | None


def checked_parameters(system: Any, observed: Any, noise_std: Any, hint: Any) -> Parameters:
    """See `PhysicsFilter`.

    Raises:
        TypeError: no `System`, or names that are not in a tuple or list.
        ValueError: unknown, repeated or no names; noise that is not above 0 or not one number each.
    """
    if not isinstance(system, System):
        raise TypeError(f"expected a System such as Pendulum(), got {type(system).__name__}")
    available = tuple(system.observation_names)
    observed = available if observed is None else observed
    observed_columns = _columns("observed", observed, available)
    std = np.asarray(noise_std, dtype=np.float64)
    if std.shape not in ((), (len(observed),)):
        raise ValueError(
            f"expected observation_noise_std as one number or {len(observed)}, got {noise_std!r}"
        )
    if not (np.isfinite(std).all() and (std > 0).all()):
        raise ValueError(
            f"expected observation_noise_std finite and above 0, got {noise_std!r}; give exact sensors a small one"
        )
    if isinstance(hint, str) and hint == "hint":
        names = tuple(system.hint_names or system.state_names)
        columns = None if system.hint_names else np.arange(system.n_state)
    else:
        columns = _columns("hint", hint, tuple(system.state_names), ', or "hint"')
        names = tuple(hint)
    variance = np.broadcast_to(np.square(std), (len(observed),)).copy()
    return Parameters(tuple(observed), observed_columns, variance, names, columns, additive_variance(system))


def checked_prior(prior: Any, system: System) -> tuple[Array, Array]:
    """Mean (n_state,) and covariance (n_state, n_state), or the message what is wrong with them."""
    n = system.n_state
    if not isinstance(prior, tuple | list) or len(prior) != 2:
        raise ValueError(f"expected prior as (mean, covariance), got {prior!r}")
    mean, covariance = (np.array(part, dtype=np.float64) for part in prior)
    for name, array, shape in (("mean", mean, (n,)), ("covariance", covariance, (n, n))):
        if array.shape != shape:
            raise ValueError(
                f"prior: expected a {name} of shape {shape} for {system.state_names}, got {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"prior: expected a {name} of finite numbers, got {array.tolist()}")
    variance = np.diag(covariance)
    if (variance < 0).any():
        raise ValueError(f"prior: expected variances of at least 0, got {variance.tolist()}")
    scale = np.sqrt(np.outer(variance, variance))
    if (np.abs(covariance - covariance.T) > ASYMMETRY * scale).any():
        raise ValueError(f"prior: expected a symmetric covariance, got {covariance.tolist()}")
    covariance = symmetric(covariance)
    least = np.linalg.eigvalsh(np.divide(covariance, scale, out=covariance.copy(), where=scale > 0))[0]
    if least < -NEGATIVE:
        raise ValueError(
            "prior: expected a positive semidefinite covariance, got one whose correlations have the eigenvalue "
            f"{least:g}"
        )
    return mean, covariance


def empirical_prior(train: Sequences, system: System) -> tuple[Array, Array]:
    """Mean and covariance of s_0 over trajectories, from their states or from hints that are the whole state.

    Warns where there are too few trajectories for a covariance of full rank.

    Raises:
        ValueError: there are none, they have other components than the system's, or there is one trajectory only.
    """
    advice = "; give prior=(mean, covariance) instead"
    states, names, field = train.states, train.state_names, "states"
    if states is None and system.hint_names is None:
        states, names, field = train.hints, train.hint_names, "hints"
    if states is None:
        what = "states" if system.hint_names else "states, or hints that are the whole state"
        raise ValueError(f"expected training trajectories with {what}, got {train!r}{advice}")
    expected = tuple(system.state_names)
    if states.shape[2] != len(expected) or names not in (None, expected):
        raise ValueError(
            f"expected {field} of the components {expected}, got {names or states.shape[2]}{advice}"
        )
    if len(states) < 2:
        raise ValueError(f"expected at least 2 training trajectories for a prior, got {len(states)}{advice}")
    first = states[:, 0]
    covariance = np.cov(first.T, bias=True).reshape(len(expected), len(expected))
    varying = int(np.count_nonzero(np.diag(covariance)))
    if len(first) <= varying:
        warnings.warn(
            f"the prior covariance of {varying} state components comes from {len(first)} trajectories: it is singular, "
            f"and the filter believes its correlations of chance{advice}",
            stacklevel=3,
        )
    return first.mean(axis=0), covariance


def additive_variance(system: System) -> Array | None:
    """(n_state,) of noise that is only added after the step; None where some enters the step or is projected."""
    plain = type(system).step is System.step and type(system).project is System.project
    if (
        not plain
        or system.quaternions
        or np.any(system.actuation_noise_std)
        or np.any(system.disturbance_std)
    ):
        return None
    std = np.broadcast_to(np.asarray(system.process_noise_std, dtype=np.float64), (system.n_state,))
    return np.square(std)


def columns_of(names: Sequence[str], among: Sequence[str]) -> NDArray[np.intp] | None:
    """The places of names; None where one is not there."""
    if not set(names) <= set(among):
        return None
    return np.array([list(among).index(name) for name in names], dtype=np.intp)


def _columns(what: str, names: Any, available: tuple[str, ...], more: str = "") -> NDArray[np.intp]:
    if isinstance(names, str) or not isinstance(names, tuple | list):
        raise TypeError(f"expected {what} as a tuple of names among {available}{more}, got {names!r}")
    for name in names:
        if name not in available:
            raise ValueError(f"{what}: unknown name {name!r}; the system has {available}{more}")
    if not names or len(set(names)) != len(names):
        raise ValueError(f"expected {what} as one or more different names, got {names!r}")
    return np.array([available.index(name) for name in names], dtype=np.intp)
