"""The belief of a fitted filter as a part of the observation: learned memory under any agent.

    y_t = (x_t, s_t),     s_t = S(m_{t+1}),     m_{t+1} = F(m_t, x_t)  or  F(m_t, x_t, a_{t-1})
                          s_t = S(m_t),         m_{t+1} = F(m_t, x_t, a_t)

where F is the filter's update and S its summary. The second line is for a filter that predicts what the present action
leads to: m_t has seen all before x_t, and x_t stands beside it.

Reference: thesis proposal, Secs. 4.1 and 4.2.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from beliefgym.wrappers.action_history import _distinct
from beliefgym.wrappers.transform import Interface, Mask, ObservationTransform, TransformObservation

if TYPE_CHECKING:
    from pathlib import Path

    from beliefgym.learning import Filter
    from beliefgym.learning.belief_tracker import Show

    FilterOrPath = Filter | str | Path

NAMELESS = re.compile(r"observation_\d+")  # what `component_names` calls a component without a name


class AppendBelief(ObservationTransform):
    """y_t = (x_t, s_t), batched; see `BeliefObservation`."""

    def __init__(
        self, below: Interface, filter: FilterOrPath, include_observation: bool = True, show: Show = "belief"
    ) -> None:
        space = below.observation_space
        if not np.issubdtype(space.dtype, np.floating):
            raise TypeError(
                f"a belief needs an observation of floating-point numbers, got {space.dtype}; "
                "put gymnasium.wrappers.DtypeObservation(env, numpy.float32) around the environment first"
            )
        from beliefgym.learning import BeliefTracker  # here, since scikit-learn takes a second to import

        filter = _filter_of(filter)
        self.tracker = BeliefTracker(filter, below.n, show=show)
        _check_fits(filter, below)
        if filter.action_timing == "present" and not include_observation:
            warnings.warn(
                f"the belief that this {type(filter).__name__} shows at t has not seen x_t (its update takes the "
                "action at t, which is not chosen yet): with include_observation=False the agent acts without the "
                "latest observation",
                stacklevel=4,
            )
        names = below.observation_names if include_observation else ()
        self._n_obs = len(names)
        edge = np.full(self.tracker.size, np.inf)
        super().__init__(
            Box(
                np.concatenate([space.low[: self._n_obs], -edge]).astype(space.dtype),
                np.concatenate([space.high[: self._n_obs], edge]).astype(space.dtype),
                dtype=space.dtype.type,
            ),
            names + _distinct(list(self.tracker.names), names),
        )

    def reset(
        self, observations: NDArray[Any], mask: Mask = None, seeds: Sequence[int | None] | None = None
    ) -> NDArray[Any]:
        """The first observations and beliefs."""
        return self._beside(observations, self.tracker.begin(observations, mask))

    def step(self, observations: NDArray[Any], actions: NDArray[Any], mask: Mask = None) -> NDArray[Any]:
        """The observations and the beliefs that have taken in what led to them."""
        given = actions.reshape(len(observations), -1)
        return self._beside(observations, self.tracker.go_on(observations, given, mask))

    def _beside(self, observations: NDArray[Any], beliefs: NDArray[np.float64]) -> NDArray[Any]:
        shown = np.empty((len(beliefs), self._n_obs + beliefs.shape[1]), observations.dtype)
        if self._n_obs:
            shown[:, : self._n_obs] = observations
        shown[:, self._n_obs :] = beliefs
        return shown


class BeliefObservation(TransformObservation):
    """Appends the belief of a fitted filter to the observation, or shows it alone.

    y_t = (x_t, s_t),  s_t what the filter's `summary` shows of its belief at t

    The belief has taken in x_0 .. x_t, and a_0 .. a_{t-1} where the filter takes actions; with `action_timing`
    "present" x_0 .. x_{t-1} and a_0 .. a_{t-1}. It starts anew at every reset. Nothing is fitted or changed in the
    filter. Actions reach it as the agent gave them, not clipped; a discrete one as one column with its number, as
    `collect` records it. Offline, `beliefgym.learning.belief_tracker.shown(filter, sequences)` gives the same numbers
    for episodes collected below this wrapper.

    Components are called `belief_0`, .. for most filters, `mean[..]` and `std[..]` for those of a known system,
    `hint[..]` and `hint_std[..]` with show="hint".

    With the path of a file the environment's spec, and a `Task`, holds that path and serialises to JSON. With a filter
    itself it pickles, whole and in the middle of an episode, but not to JSON: `save_filter` it and pass the path.

    Args:
        env: an environment with a one-dimensional Box observation of floating-point numbers, that the filter was fitted
            on.
        filter: a fitted `Filter`, or the path of a file written by `save_filter`.
        include_observation: False shows the belief alone.
        show: "belief", or "hint" for the estimate of a `HintFilter` and its standard deviation.

    Raises:
        TypeError: a vector environment, another observation or action space; neither a filter nor a path; a hint of a
            filter without.
        NotFittedError: the filter is not fitted.
        ValueError: other numbers of observations or actions, or other names, than those at fit.
        FloatingPointError: in `reset` or `step`, a belief that has diverged; it names the copy and its step.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        filter: FilterOrPath,
        include_observation: bool = True,
        show: Show = "belief",
    ) -> None:
        recorded = os.fspath(filter) if isinstance(filter, os.PathLike) else filter
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,  # the filter is not changed
            filter=recorded,
            include_observation=include_observation,
            show=show,
        )
        super().__init__(
            env, partial(AppendBelief, filter=filter, include_observation=include_observation, show=show)
        )


def _filter_of(given: FilterOrPath) -> Filter:
    """The filter, read from its file where a path is given."""
    from beliefgym.learning import Filter, load_filter

    if isinstance(given, str | os.PathLike):
        loaded: Filter = load_filter(given)
        return loaded
    if not isinstance(given, Filter):
        raise TypeError(
            "expected a fitted Filter of beliefgym.learning, or the path of a file written by save_filter, got "
            f"{type(given).__name__}"
        )
    return given


def _check_fits(filter: Filter, below: Interface) -> None:
    """Raise where the filter was fitted on another environment."""
    names, fitted = below.observation_names, filter.observation_names_
    if len(names) != filter.n_obs_:
        of = "" if fitted is None else f" ({', '.join(fitted)})"
        raise ValueError(
            f"expected the {filter.n_obs_} observation components{of} that this {type(filter).__name__} was fitted on, "
            f"got {len(names)} ({', '.join(names)}); put the wrapper where the filter's training data were collected"
        )
    both = zip(names, fitted or (), strict=False)
    if any(a != b and not NAMELESS.fullmatch(a) and not NAMELESS.fullmatch(b) for a, b in both):
        raise ValueError(
            f"this {type(filter).__name__} was fitted on another environment: it expects the observation components "
            f"{', '.join(fitted or ())}, and these are {', '.join(names)}"
        )
    if filter.action_timing == "none" or not filter.n_act_:
        return
    space, choices = below.action_space, filter.n_choices
    n_act = _n_columns(space)
    if n_act != filter.n_act_:
        raise ValueError(
            f"expected actions of {filter.n_act_} columns as this {type(filter).__name__} was fitted on, got {n_act} "
            f"({space}); wrappers that change the action belong inside BeliefObservation only where they were inside "
            "when the data were collected"
        )
    if choices is not None and not (isinstance(space, Discrete) and (space.start, space.n) == (0, choices)):
        raise ValueError(
            f"expected the action space Discrete({choices}) that this {type(filter).__name__} was fitted on, got "
            f"{space}"
        )

    from beliefgym.envs.estimators.physics_filter import PhysicsFilter

    if isinstance(filter, PhysicsFilter) and not isinstance(space, Box):
        raise ValueError(
            f"expected actions in the units of the system ({', '.join(filter.system.action_names)}) for a "
            f"{type(filter).__name__}, got {space}; put BeliefObservation inside DiscreteActions"
        )


def _n_columns(space: gym.Space[Any]) -> int:
    if isinstance(space, Discrete):
        return 1
    if not isinstance(space, Box | MultiDiscrete | MultiBinary):
        raise TypeError(
            "expected a Box, Discrete, MultiBinary or MultiDiscrete action space for a filter with actions, got "
            f"{space}"
        )
    return int(np.prod(space.shape))
