"""`ConditionalPSIM`: a predictive state of futures given future actions, learned by two-stage regression.

    E[x_{t+i} | h_t, do(a_t .. a_{t+k-2})] = m_t^i + sum_{j < i} (B_ij + C_ij m_t) u_{t+j},     i = 0 .. k-1,

u the standardised actions: the belief m_t is what would be seen under the average action, and what other actions change
is a part of its own, so that no policy is in the belief. The stages:

    1   regress phi(f_t) on a window of the past for s_t; then phi_i(f_t) on (past, u_{t+j}, u_{t+j} s_t; j < i), for
        B and C
    2   learn F on the futures without what their actions did, phi_i(f_t) - sum_j (B_ij + C_ij s_t) u_{t+j}, by dataset
        aggregation as in `PSIM`: m_{t+1} = F(m_t, x_t, a_t)

and at last B and C once more, with the beliefs that F has in place of s_t.

Where the recorded policy looks at observations, a_{t+1} depends on what x_{t+1} held of news, and the first stage takes
that for an effect of the action, on everything from x_{t+2} on: the well-known bias of identification in closed loop.
`importance` weighs its regressions by what takes the policy out again, per decision (see `importance_weights`).

References: thesis proposal, Sec. 4.2.1 (Eqs. 4.7 and 4.8; the conditional probabilities of blind policies below Eq.
4.11); Boots, Siddiqi & Gordon, "Closing the learning-planning loop with predictive state representations", IJRR 2011;
Hefny, Downey & Gordon, "An efficient, expressive and local minima-free method for learning controlled dynamical
systems", AAAI 2018. They condition by kernel or matrix inverses; here the conditional expectation is a regression.
"""

from __future__ import annotations

from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from beliefgym.learning.dynamics import Standardise, Target
from beliefgym.learning.importance_weights import (
    BlindReference,
    Reference,
    check_truncate,
    effective_sample_share,
    future_log_weights,
    log_ratios,
    normalised_weights,
)
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.normal_equations import NormalEquations
from beliefgym.learning.predictive_state import TrainingData
from beliefgym.learning.psim import PSIM, Init
from beliefgym.learning.psim_pairs import HISTORY_RIDGE, past_windows
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
Effects = Literal["constant", "bilinear"]


class ConditionalPSIM(PSIM):
    """A filter whose belief holds no policy: futures given future actions.

    Args:
        regressor: learns F, as of `PSIM`.
        n_future: k.
        effects: what the actions to come change: "constant" B alone, right for linear systems; "bilinear" also C m.
        effect_ridge: ridge penalty a sample of B and C.
        importance: weigh the regressions of B and C by importance weights, per decision; needs `action_log_probs`.
        truncate, reference: of these weights, as of `PSIMActions`.
        n_choices: as of `PSIMActions`.
        target, n_iterations, init, n_past, standardise, belief_limit, progress_bar: as of `PSIM`.

    Attributes:
        model_, best_iteration_, history_: as of `PSIM`.
        effects_: (n_effects, k n_obs) B and C, zero where an action comes after the observation.
        effective_samples_: (k,) share of effective samples for each observation to come; ones without importance.

    Example:
        >>> filter = ConditionalPSIM(n_future=5).fit(train, validation)  # doctest: +SKIP
        >>> filter.forecast(belief, 5, actions)  # doctest: +SKIP
    """

    action_timing = "present"
    features = "first"
    discount = 1.0
    algorithm = "follow_the_leader"
    step_size = 0.1
    effects_: Array | None = None

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        n_future: int = 5,
        effects: Effects = "constant",
        effect_ridge: float = 1e-4,
        importance: bool = False,
        truncate: float | None = None,
        reference: Reference = "marginal",
        n_choices: int | None = None,
        target: Target = "next",
        n_iterations: int = 20,
        init: Init = "history",
        n_past: int | None = None,
        standardise: Standardise = True,
        belief_limit: float = 3.0,
        progress_bar: bool = False,
    ) -> None:
        self.regressor = regressor
        self.n_future = n_future
        self.effects = effects
        self.effect_ridge = effect_ridge
        self.importance = importance
        self.truncate = truncate
        self.reference = reference
        self.n_choices = n_choices
        self.target = target
        self.n_iterations = n_iterations
        self.init = init
        self.n_past = n_past
        self.standardise = standardise
        self.belief_limit = belief_limit
        self.progress_bar = progress_bar

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Learn the effects of actions, then the filter, then the effects as its beliefs show them.

        Args:
            train: trajectories with actions, of at least n_future + 1 observations.
            validation: whole trajectories; their error of the next observation chooses among the F_n.

        Raises:
            ValueError: no actions; no log-probabilities with importance; and as of `PSIM.fit`.
        """
        super().fit(train, validation)
        data = self._data
        del self._data
        rows = np.nonzero(self._complete(data))
        beliefs = self.beliefs(data.sequences)[rows]
        residual = super()._targets(data.sequences)[0][rows] - beliefs
        self.effects_ = self._regressed(beliefs, None, residual, data, rows)
        return self

    def _check_parameters(self) -> None:
        super()._check_parameters()
        if self.effects not in get_args(Effects):
            raise ValueError(f"expected effects to be one of {get_args(Effects)}, got {self.effects!r}")
        if not (np.isfinite(self.effect_ridge) and self.effect_ridge >= 0):
            raise ValueError(f"expected effect_ridge finite and at least 0, got {self.effect_ridge!r}")
        check_truncate(self.truncate)

    def partial_fit(self, train: Sequences) -> Any:
        """Not here.

        Raises:
            TypeError: always: the effects of actions are of a whole fit.
        """
        raise TypeError(
            "expected fit(train, validation): the effects of actions are of a whole fit; fit anew"
        )

    def _training_data(self, sequences: Sequences) -> TrainingData:
        data = super()._training_data(sequences)
        rows = np.nonzero(self._complete(data))
        past = past_windows(data.inputs, self.past_length)[rows]
        futures = data.targets[rows]
        first = Ridge(alpha=HISTORY_RIDGE).fit(past, futures).predict_unchecked(past)
        effects = self._regressed(first, past, futures, data, rows)
        data.targets[rows] = futures - self._changed(first, self._later_codes(data, rows), effects)
        data.answers = data.targets[:, 1:] if data.base is None else data.targets[:, 1:] - data.base[:, :-1]
        self._data = data
        return data

    def _regressed(
        self, states: Array, beside: Array | None, futures: Array, data: TrainingData, rows: Any
    ) -> Array:
        """(n_effects, k n_obs): what the codes of later actions, alone and times states, change in futures.

        Args:
            states: (n, size). beside: (n, d) further regressors, or None. futures: (n, k n_obs). rows: their places.
        """
        k, d = self.n_future, self.n_obs_
        codes = self._later_codes(data, rows)
        inputs = self._effect_inputs(states, codes)
        weights = self._effect_weights(data, rows)
        effects = np.zeros((inputs.shape[1], k * d))
        each = inputs.shape[1] // max(k - 1, 1)  # an action's regressors stand together
        for i in range(1, k):
            n = i * each
            columns = slice(i * d, (i + 1) * d)
            own = inputs[:, :n]
            regressors = own if beside is None else np.concatenate([own, beside], axis=1)
            equations = NormalEquations(regressors.shape[1], d)
            equations.add(
                np.ascontiguousarray(regressors),
                futures[:, columns],
                None if weights is None else weights[:, i],
            )
            effects[:n, columns] = equations.solve(self.effect_ridge)[0][:n]
        return effects

    def _effect_weights(self, data: TrainingData, rows: Any) -> Array | None:
        """(n, k) importance weights of each observation to come; None where all weigh the same."""
        k, sequences = self.n_future, data.sequences
        self.effective_samples_ = np.ones(k)
        if not self.importance:
            return None
        reference = BlindReference(self.reference, sequences.actions[sequences.step_mask], self.n_choices)
        logs = future_log_weights(log_ratios(sequences, reference), k - 1, data.targets.shape[1])[rows]
        weights = np.stack([normalised_weights(logs[:, i], self.truncate) for i in range(k)], axis=1)
        self.effective_samples_ = np.array([effective_sample_share(weights[:, i]) for i in range(k)])
        return weights

    def _complete(self, data: TrainingData) -> NDArray[np.bool_]:
        """(n_episodes, n_rows) which tests are complete."""
        complete: NDArray[np.bool_] = np.arange(data.targets.shape[1]) < data.n_targets[:, None]
        return complete

    def _later_codes(self, data: TrainingData, rows: Any) -> Array:
        """Codes of a_t .. a_{t+k-2}: (n, k - 1, code's size)."""
        episode, t = rows
        later = t[:, None] + np.arange(self.n_future - 1)
        return data.inputs[episode[:, None], later, self.n_obs_ :]

    def _effect_inputs(self, states: Array, codes: Array) -> Array:
        """(n, size) and (n, k - 1, c) -> (n, n_effects): for each action its code, and with C its code times states."""
        n, n_codes, c = codes.shape
        if self.effects == "constant":
            return codes.reshape(n, n_codes * c)
        products = codes[:, :, :, None] * states[:, None, None]
        each = c * (1 + states.shape[1])
        both = np.concatenate([codes, products.reshape(n, n_codes, each - c)], axis=2)
        return both.reshape(n, n_codes * each)

    def _changed(self, states: Array, codes: Array, effects: Array) -> Array:
        """What later actions change: (n, size) and (n, k - 1, c) -> (n, k n_obs)."""
        changed: Array = self._effect_inputs(states, codes) @ effects
        return changed

    def _forecast_under(self, belief: Array, horizon: int, codes: Array) -> Array:
        k, d = self.n_future, self.n_obs_
        predicted = np.empty((len(belief), horizon, d))
        following = np.zeros((len(belief), max(k - 1, 0), codes.shape[2]))
        inside = min(horizon, k)
        following[:, : inside - 1] = codes[:, : inside - 1]
        assert self.effects_ is not None
        expected = belief + self._changed(belief, following, self.effects_)
        predicted[:, :inside] = expected.reshape(len(belief), k, d)[:, :inside]
        for step in range(horizon - k):  # F takes its own predictions for what comes
            belief = self._advance(belief, np.concatenate([self._observe(belief), codes[:, step]], axis=1))
            following = codes[:, step + 1 : step + k]
            expected = belief + self._changed(belief, following, self.effects_)
            predicted[:, step + k] = expected[:, -d:]
        return predicted
