"""`DirectMultiStep`: a regressor of its own for each number of steps, so that no prediction is fed back.

    x_hat_{t+k} = f_k(x_t, u_t, .., u_{t+k-1}),      k = 1 .. H,

each learned from every start t of every training trajectory that has k steps after it. The errors of one prediction
do not compound within H steps; the price is H models, none of which knows that they describe one system, and inputs
that grow with k. Beyond H steps the last prediction x_hat_{t+H} is the next start.

References: thesis proposal, Sec. 3.1.1, of which it avoids Eq. 3.5; Cox, "Prediction by exponentially weighted moving
averages and related methods", 1961, for the direct strategy; Ben Taieb & Hyndman, "Recursive and direct multi-step
forecasting", 2012. That it starts again from its last prediction beyond H is a choice made here.
"""

from __future__ import annotations

import time
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from tqdm import tqdm

from beliefgym.learning.aggregation import learner_for, predict_unchecked
from beliefgym.learning.dynamics import DynamicsModel, Standardise, Target
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]


class DirectMultiStep(DynamicsModel):
    """Direct models of 1 .. H steps.

    `predict` is the model of one step; `rollout` takes each step up to H from its own model, and starts again from
    the last prediction every H steps.

    Args:
        regressor: learns each k; any scikit-learn regressor. It is cloned for each. One with a fixed length scale
            (a bandwidth) meets n_obs + k n_act inputs; `RandomFourierRidge(bandwidth=None)` scales with them.
            None for `RandomFourierRidge(random_state=0)`.
        horizon: H, at most the steps of the longest trajectory.
        target: "delta" to learn x_{t+k} - x_t, or "next" to learn x_{t+k}.
        standardise: bring the components of states and actions to one scale, as of `DataAsDemonstrator`.
        use_actions: whether actions, where the trajectories have them, are inputs.
        divergence_limit: standard deviations of the training data beyond which a rollout is cut.
        progress_bar: show the models.

    Attributes:
        models_: (H,) the regressors of 1 .. H steps, in standardised coordinates.
        history_: arrays (1,), for one fit: "train_multi_step" (on rollouts of H steps) and "validation_multi_step"
            (mean of e_k / p_k; NaN without validation), "train_single_step", "validation_single_step" (RMS, data's
            units), "seconds". Nothing is chosen on validation.

    Example:
        >>> model = DirectMultiStep(RandomFourierRidge(random_state=0), horizon=10)  # doctest: +SKIP
        >>> model.fit(train).rollout(test.observations[:, 0], 100)  # doctest: +SKIP
    """

    _fitted_attribute = "models_"

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        horizon: int = 10,
        target: Target = "delta",
        standardise: Standardise = True,
        use_actions: bool = True,
        divergence_limit: float = 100.0,
        progress_bar: bool = False,
    ) -> None:
        self.regressor = regressor
        self.horizon = horizon
        self.target = target
        self.standardise = standardise
        self.use_actions = use_actions
        self.divergence_limit = divergence_limit
        self.progress_bar = progress_bar

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Fit the H models.

        Args:
            train: trajectories to learn from.
            validation: whole trajectories, for the history only.

        Raises:
            ValueError: no step to learn from, a horizon longer than every trajectory, other components in validation.
            TypeError: not `Sequences`.
        """
        if (
            isinstance(self.horizon, bool)
            or not isinstance(self.horizon, int | np.integer)
            or self.horizon < 1
        ):
            raise ValueError(f"expected horizon to be a whole number of at least 1, got {self.horizon!r}")
        self._begin(train, validation)
        longest = int(train.lengths.max())
        if self.horizon > longest:
            raise ValueError(
                f"expected horizon of at most the longest trajectory's {longest} steps, got {self.horizon}"
            )
        started = time.perf_counter()
        z, u = self._coordinates(train)
        regressor = RandomFourierRidge(random_state=0) if self.regressor is None else self.regressor
        self.models_: list[Any] = []
        self._scales: list[Array] = []
        for k in tqdm(range(1, self.horizon + 1), desc="DirectMultiStep", disable=not self.progress_bar):
            episode, t = np.nonzero(np.arange(train.n_steps) + k <= train.lengths[:, None])
            now, then = z[episode, t], z[episode, t + k]
            steps = u[episode[:, None], t[:, None] + np.arange(k)]
            if self.target == "delta":
                scaled = Standardisation.together if self.standardise == "together" else Standardisation.of
                self._scales.append(scaled(then - now).scale)
                targets = (then - now) / self._scales[-1]
            else:
                self._scales.append(np.ones(self.n_obs_))
                targets = then
            inputs = np.concatenate([now, steps.reshape(len(now), -1)], axis=1)
            self.models_.append(learner_for(regressor, "follow_the_leader", inputs, targets).frozen())
        history = {
            "train_multi_step": self.errors(train.segments(self.horizon, keep_tail=True)).mean,
            "validation_multi_step": np.nan if validation is None else self.errors(validation).mean,
            "train_single_step": self.single_step_error(train),
            "validation_single_step": np.nan if validation is None else self.single_step_error(validation),
            "seconds": time.perf_counter() - started,
        }
        self.history_ = {name: np.array([value]) for name, value in history.items()}
        return self

    def _step(self, z: Array, u: Array) -> Array:
        return self._direct(z, u[:, None])

    def _direct(self, z: Array, u: Array) -> Array:
        """States k steps on: (n, n_obs) and the actions between, (n, k, n_act) -> (n, n_obs)."""
        k = u.shape[1]
        inputs = np.concatenate([z, u.reshape(len(u), -1)], axis=1)
        output = predict_unchecked(self.models_[k - 1], inputs, self.n_obs_)
        return z + output * self._scales[k - 1] if self.target == "delta" else output

    def _forecast(self, z: Array, u: Array) -> tuple[Array, NDArray[np.int64]]:
        n_steps = u.shape[1]
        predicted = np.empty((len(z), n_steps + 1, z.shape[1]))
        predicted[:, 0] = z
        cut = np.full(len(z), n_steps)
        going = np.arange(len(z))
        for t in range(n_steps):
            predicted[:, t + 1] = predicted[:, t]
            if not len(going):
                continue
            start = t - t % self.horizon
            z_next = self._direct(predicted[going, start], u[going, start : t + 1])
            inside = self._inside(z_next)
            if not inside.all():
                cut[going[~inside]] = t
                going, z_next = going[inside], z_next[inside]
            predicted[going, t + 1] = z_next
        return predicted, cut
