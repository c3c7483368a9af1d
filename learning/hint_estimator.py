"""`HintEstimator`: a hint filter at run time, one observation after the other.

    estimator = HintEstimator(filter)
    estimator.reset()
    mean, std = estimator.update(observation)

It only filters: nothing is fitted, and no torch is needed. `PSIMHints` and `InferenceMachineFilter` with `Ridge` or
`RandomFourierRidge` take some ten microseconds an update; every other `HintFilter` goes through its own batch of one.

A missing observation (NaN) is refused, or bridged by the filter's own prediction, as the user chose. An update that
raises leaves the belief as it was. A learned filter's standard deviation does not know of what was missed, so that the
variance c_j of `gap_growth` is added after j observations of which something was missing; each whole observation takes
j down by one again.

Reference: thesis proposal, Sec. 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.learning.hint_filter import HintEstimate, HintFilter, Missing, check_observed
from beliefgym.learning.hint_reading import ResidualVariance
from beliefgym.learning.psim_hints import PSIMHints
from beliefgym.learning.row_predictor import row_predictor

Array = NDArray[np.float64]
Step = Callable[[Array, Array], Array]  # m_t and standardised x_t -> m_{t+1}
Read = Callable[[Array], tuple[Array, Array]]  # m_{t+1} -> mean and std


class HintEstimator:
    """Estimates a hint on a stream of observations.

    Args:
        filter: a fitted `HintFilter`; it is not changed, and must not be fitted anew while this is in use.
        missing: what NaN stands for: "raise" refuses it, "predict" takes it as not observed.

    Attributes:
        estimate: the last estimate; before the first observation the prior of the training data.
        n_seen: updates since the last reset.

    Raises:
        TypeError: not a `HintFilter`. NotFittedError, ValueError: not fitted; an unknown `missing`.

    Example:
        >>> estimator = HintEstimator(filter, missing="predict")  # doctest: +SKIP
        >>> observation, _ = env.reset()  # doctest: +SKIP
        >>> mean, std = estimator.update(observation)  # doctest: +SKIP
    """

    def __init__(self, filter: HintFilter, *, missing: Missing = "raise") -> None:
        if not isinstance(filter, HintFilter):
            raise TypeError(
                "expected a HintFilter (PSIMHints, InferenceMachineFilter, KalmanHints, ..), got "
                f"{type(filter).__name__}"
            )
        if missing not in get_args(Missing):
            raise ValueError(f"expected missing to be one of {get_args(Missing)}, got {missing!r}")
        filter._check_fitted()
        self.filter, self.missing = filter, missing
        self._prepare()
        self.reset()

    def reset(self) -> None:
        """Begin a new episode: back to the belief before any observation."""
        self._belief = self.filter.initial_belief(1)[0]
        self._n_missed = 0
        self.n_seen = 0
        self.estimate = HintEstimate(self.filter.prior_mean_.copy(), self.filter.prior_std_.copy())

    @property
    def belief(self) -> Array:
        """(belief_size,) a copy of the present belief."""
        return self._belief.copy()

    def update(self, observation: ArrayLike, action: ArrayLike | None = None) -> HintEstimate:
        """Take in x_t and estimate h_t.

        Args:
            observation: (n_obs,) x_t, in the units of the training data; numbers or NaN, see `missing`.
            action: (n_act,) a_{t-1}, the one taken before x_t was seen; not looked at by filters without actions, nor
                at the first observation.

        Returns:
            Mean and standard deviation, (n_hint,) each, in the hint's units.

        Raises:
            ValueError: a shape, NaN or an infinity that is not expected. The belief then stays as it was.
        """
        x = np.asarray(observation, dtype=np.float64)
        if x.shape != self._shape:
            raise ValueError(f"observation: expected shape {self._shape}, got {x.shape}")
        z = (x - self._offset) * self._per_scale
        is_whole = np.isfinite(z).all()
        if not is_whole:
            check_observed(x, self.missing)
            if np.isinf(z).any():
                raise ValueError(
                    f"observation: expected numbers like the training data's, got {x}: too large"
                )
        if self._step is None or not is_whole:
            belief = self._slowly(z, action)
        else:
            belief = self._step(self._belief, z)
            if not (np.abs(belief) <= self._bound).all():  # NaN too
                belief = self._slowly(z, action)
        mean, std = self._read(belief)
        if not is_whole:
            self._n_missed += 1
        elif self._n_missed:
            self._n_missed = min(self._n_missed, self._longest) - 1
        if self._n_missed and self._growth is not None:
            std = np.sqrt(std * std + self._growth[min(self._n_missed, self._longest) - 1])
        self._belief, self.n_seen, self.estimate = belief, self.n_seen + 1, HintEstimate(mean, std)
        return self.estimate

    def _slowly(self, z: Array, action: ArrayLike | None) -> Array:
        """By the filter itself."""
        a = None if action is None else np.asarray(action, dtype=np.float64)
        if a is not None and a.ndim != 1:
            raise ValueError(f"action: expected shape (n_act,), got {a.shape}")
        if a is None and self.n_seen and self.filter.n_act_ and hasattr(self.filter, "_action_coding"):
            raise ValueError(
                f"expected the action (n_act,) = ({self.filter.n_act_},) before this observation, got None: this "
                f"{type(self.filter).__name__} was fitted with actions"
            )
        if a is not None:
            self.filter._checked_action(a[None], 1)
        if not self.n_seen:
            a = None
        return self.filter._follow(self._belief[None], z[None], None if a is None else a[None])[0]

    def _prepare(self) -> None:
        """What does not change from one observation to the next."""
        filter = self.filter
        self._shape = (filter.n_obs_,)
        self._offset, self._per_scale = filter._scale.offset.copy(), 1.0 / filter._scale.scale
        growth = filter.gap_growth_
        self._growth = growth
        self._longest = 1 if growth is None else len(growth)
        self._bound: Array | None = filter._bound
        self._step: Step | None = _step_of(filter)
        self._read: Read = _read_of(filter)

    def __getstate__(self) -> dict[str, Any]:
        state = dict(self.__dict__)
        del state["_step"], state["_read"]  # functions, made anew
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()


def _step_of(filter: Any) -> Step | None:
    """F of one row; None where the filter has more to do than to predict."""
    if not isinstance(filter, PSIMHints) or filter.use_actions:
        return None
    size = filter.belief_size
    predict, inputs = row_predictor(filter.model_, size), np.empty(size + filter.n_obs_)

    def step(belief: Array, z: Array) -> Array:
        inputs[:size] = belief
        inputs[size:] = z
        return predict(inputs)

    return step


def _read_of(filter: Any) -> Read:
    """g and sigma of one row."""
    if not isinstance(filter, PSIMHints):

        def read_batch(belief: Array) -> tuple[Array, Array]:
            mean, std = filter._read_hint(belief[None])
            return np.array(mean[0]), np.array(std[0])

        return read_batch
    predict, variance = row_predictor(filter.preimage_, filter.n_hint_), filter._reading.variance
    scale, offset = filter._hint_scale.scale, filter._hint_scale.offset
    if not np.isfinite(variance.penalty):
        constant = np.exp(0.5 * variance.offset) * scale
        return lambda belief: (predict(belief) * scale + offset, constant.copy())
    log_variance = _log_variance(variance)
    return lambda belief: (predict(belief) * scale + offset, np.exp(0.5 * log_variance(belief)) * scale)


def _log_variance(variance: ResidualVariance) -> Callable[[Array], Array]:
    """log sigma^2 of one row."""
    size = len(variance.centre) // 2
    features, transposed = np.empty(2 * size), np.ascontiguousarray(variance.weights.T)
    per_spread = 1.0 / variance.spread

    def one(belief: Array) -> Array:
        features[:size] = belief
        np.multiply(belief, belief, out=features[size:])
        standardised = variance.clipped((features - variance.centre) * per_spread)
        return np.minimum(
            np.maximum(transposed @ standardised + variance.offset, variance.low), variance.high
        )

    return one
