"""`DataAsDemonstrator`: training a one-step model so that its predictions of many steps stay accurate.

A model fed its own predictions meets states that no training data show. DaD rolls the model out along the training
trajectories, and adds each predicted state together with the true next state of that time as a new input-target pair:
the data demonstrate how to get back. With a state x_hat_t predicted in place of x_t (and the recorded action u_t),

    D <- D + {([x_hat_t, u_t], x_{t+1})},      t = 1 .. T_k - 1,

and the model is fitted to the aggregate, n = 1 .. N. The model with the lowest multi-step error on validation
trajectories is returned.

References: thesis proposal, Algorithm 1 (Sec. 3.1.2), Algorithm 2 (Sec. 3.2.2, with actions), Eq. 3.14;
Venkatraman, Hebert & Bagnell, "Improving multi-step prediction of learned time series models", AAAI 2015.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from tqdm import tqdm

from beliefgym.learning.aggregation import Algorithm, Learner, learner_for, predict_unchecked
from beliefgym.learning.dynamics import DynamicsModel, Standardise, Target
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
ROWS = 8192  # rollouts whose features are held at once
HISTORY = (
    "iteration",
    "train_multi_step",
    "validation_multi_step",
    "train_single_step",
    "validation_single_step",
    "aggregate_single_step",
    "n_pairs",
    "n_added",
    "n_outlying",
    "n_diverged",
    "seconds",
)


class DataAsDemonstrator(DynamicsModel):
    """A dynamics model trained by Data as Demonstrator (Algorithms 1 and 2).

    Deviations from the algorithms as printed: corrections start at t = 1, as there, since (x_0, x_1) is in D already;
    Algorithm 2 rolls out f_n before it exists, which is read as f_{n-1}, as in Algorithm 1; the target of a difference
    model (Eq. 3.14) at a predicted state is x_{t+1} - x_hat_t, so that its next state is the true one.

    Args:
        regressor: learns one step; any scikit-learn regressor. Those of this package that are linear in features
            (`Ridge`, `RandomFourierRidge`, `PolynomialRidge`) keep sufficient statistics instead of the aggregate.
            None for `RandomFourierRidge(random_state=0)`.
        n_iterations: N; 0 gives the ordinary single-step model.
        target: "delta" to learn x_{t+1} - x_t, or "next" to learn x_{t+1}.
        horizon: length of the training rollouts, which start at steps 0, horizon, 2 horizon, ... of a trajectory (the
            remark after Theorem 3.1.3; Sec. 3.2.2). None for whole trajectories, as Algorithm 1 is printed: far from
            the truth corrections contradict each other, and long rollouts of a weak first model often improve
            nothing. 5 to 10 is a good start; choose it on validation data.
        stride: steps between the starts of rollouts (1 for every point); None for `horizon`, so that rollouts do not
            overlap. Only with a horizon.
        outlier_threshold: leave out predictions that are farther off than this many of the training data's standard
            deviations, as root mean square over components. None keeps all.
        outlier_ratio: leave out predictions farther off than this many times the mean error of all rollouts at the
            same step. None keeps all.
        algorithm: "follow_the_leader" fits to the whole aggregate; "online_gradient" takes gradient steps, which need
            neither the aggregate nor its sums, and on features as correlated as random Fourier features move little
            (a few per cent where follow-the-leader halves the error); where sums fit into memory, take the former.
        step_size: of "online_gradient", see `GradientSteps`. From about 0.3 on corrections far from the truth can
            make the model diverge (counted, and not chosen).
        standardise: bring the components of states and actions to one scale: True each by its own standard deviation,
            "together" all by one number (components of one unit, such as principal components), False not.
        use_actions: whether actions, where the trajectories have them, are inputs.
        angles: numbers of the components that are angles in rad; the regressor sees their cosines and sines, and their
            differences are taken to [-pi, pi), so that it does not matter where a recording starts to count. Only
            with target "delta".
        divergence_limit: standard deviations of the training data beyond which a rollout is cut.
        progress_bar: show the iterations.

    Attributes:
        model_: the best model's regressor, in standardised coordinates.
        best_iteration_: which it was; 0 is the single-step model.
        history_: arrays (N + 1,), one entry an iteration: "train_multi_step" and "validation_multi_step" (mean of
            e_k / p_k; NaN without validation), "train_single_step" and "validation_single_step" (RMS, data's units),
            "aggregate_single_step" (RMS on the aggregate, standardised; for "online_gradient" the online loss),
            "n_pairs" in the aggregate, "n_added", "n_outlying" and "n_diverged" in the rollouts of the model before,
            "seconds".

    Example:
        >>> model = DataAsDemonstrator(RandomFourierRidge(random_state=0))  # doctest: +SKIP
        >>> model.fit(train, validation).rollout(test.observations[:, 0], 100)  # doctest: +SKIP
    """

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        n_iterations: int = 25,
        target: Target = "delta",
        horizon: int | None = 10,
        stride: int | None = None,
        outlier_threshold: float | None = None,
        outlier_ratio: float | None = None,
        algorithm: Algorithm = "follow_the_leader",
        step_size: float = 0.1,
        standardise: Standardise = True,
        use_actions: bool = True,
        angles: Collection[int] | None = None,
        divergence_limit: float = 100.0,
        progress_bar: bool = False,
    ) -> None:
        self.regressor = regressor
        self.n_iterations = n_iterations
        self.target = target
        self.horizon = horizon
        self.stride = stride
        self.outlier_threshold = outlier_threshold
        self.outlier_ratio = outlier_ratio
        self.algorithm = algorithm
        self.step_size = step_size
        self.standardise = standardise
        self.use_actions = use_actions
        self.angles = angles
        self.divergence_limit = divergence_limit
        self.progress_bar = progress_bar

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Run N iterations and keep the model that predicts the validation trajectories best.

        Args:
            train: trajectories to learn from; those of one step or none give no corrections.
            validation: whole trajectories, rolled out from their first observation. Without them the error on the
                training rollouts chooses.

        Raises:
            ValueError: no step to learn from, other components in validation, parameters out of range.
            TypeError: not `Sequences`.
        """
        self._check_parameters()
        self._begin(train, validation)
        rollouts = (
            train if self.horizon is None else train.segments(self.horizon, self.stride, keep_tail=True)
        )
        z, u = self._coordinates(train)
        episode, t = np.nonzero(train.step_mask)
        regressor = RandomFourierRidge(random_state=0) if self.regressor is None else self.regressor
        started = time.perf_counter()
        learner = learner_for(
            regressor,
            self.algorithm,
            self._inputs(z[episode, t], u[episode, t]),
            self._targets(z[episode, t], z[episode, t + 1]),
            self.step_size,
        )
        self.history_: dict[str, Array] = {name: np.full(self.n_iterations + 1, np.nan) for name in HISTORY}
        best = np.inf
        added = {"n_added": len(t), "n_outlying": 0, "n_diverged": 0}
        for n in tqdm(range(self.n_iterations + 1), desc="DaD", disable=not self.progress_bar):
            self.model_ = learner.frozen()
            self._record(n, train, validation)
            self._note(n, **added, n_pairs=learner.n_pairs)
            self._note(n, aggregate_single_step=learner.mean_squared_error() ** 0.5)
            last = n == self.n_iterations
            predicted, added = self._demonstrate(None if last else learner, rollouts)
            self._note(n, train_multi_step=self._errors(predicted, rollouts, 0).mean)
            criterion = self.history_["train_multi_step" if validation is None else "validation_multi_step"][
                n
            ]
            if criterion < best or n == 0:
                best, self.best_iteration_, chosen = criterion, n, self.model_
            if not last:
                learner.refit()
            self._note(n, seconds=time.perf_counter() - started)
            started = time.perf_counter()
        self.model_ = chosen
        return self

    def _step(self, z: Array, u: Array) -> Array:
        output = predict_unchecked(self.model_, self._inputs(z, u), self.n_obs_)
        return self._next(z, output)

    def _demonstrate(self, learner: Learner | None, rollouts: Sequences) -> tuple[Array, dict[str, int]]:
        """Roll the present model out along the trajectories, adding a correction at each predicted state.

        Args:
            learner: whose model it is, and who gets the corrections; None only predicts.
            rollouts: the trajectories.

        Returns:
            (n, n_steps + 1, n_obs) standardised predictions, and the counts of the history.
        """
        z, u = self._coordinates(rollouts)
        if learner is None:
            predicted, cut = self._forecast(z[:, 0], u)
            diverged = int(np.count_nonzero(cut < rollouts.lengths))
            return predicted, {"n_added": 0, "n_outlying": 0, "n_diverged": diverged}
        predicted = np.empty_like(z)
        predicted[:, 0] = z[:, 0]
        going = np.arange(len(z))
        counts = {"n_added": 0, "n_outlying": 0, "n_diverged": 0}
        for t in range(rollouts.n_steps):
            predicted[:, t + 1] = predicted[:, t]
            going = going[rollouts.lengths[going] > t]
            if not len(going):
                continue
            now, action = predicted[going, t], u[going, t]
            kept = self._not_outlying(now, z[going, t]) if t else np.zeros(len(going), dtype=np.bool_)
            target = self._targets(now, z[going, t + 1])
            z_next = np.empty_like(now)
            for start in range(0, len(going), ROWS):
                block = slice(start, start + ROWS)
                code = learner.encode(self._inputs(now[block], action[block]))
                z_next[block] = self._next(now[block], learner.predict(code))
                if kept[block].all():
                    learner.add(code, target[block])
                elif t:
                    learner.add(code[kept[block]], target[block][kept[block]])
            if t:
                counts["n_added"] += int(np.count_nonzero(kept))
                counts["n_outlying"] += int(np.count_nonzero(~kept))
            inside = self._inside(z_next)
            if not inside.all():
                counts["n_diverged"] += int(np.count_nonzero(~inside))
                going, z_next = going[inside], z_next[inside]
            predicted[going, t + 1] = z_next
        return predicted, counts

    def _not_outlying(self, predicted: Array, truth: Array) -> NDArray[np.bool_]:
        """(n,) which predictions are near enough to the truth to be corrected."""
        error = np.sqrt(np.square(self._difference(predicted, truth) / self._spread).mean(axis=1))
        kept = np.ones(len(error), dtype=np.bool_)
        if self.outlier_threshold is not None:
            kept &= error <= self.outlier_threshold
        if self.outlier_ratio is not None and len(error):
            kept &= error <= self.outlier_ratio * error.mean()
        return kept

    def _record(self, n: int, train: Sequences, validation: Sequences | None) -> None:
        self._note(n, iteration=n, train_single_step=self.single_step_error(train))
        if validation is not None:
            self._note(
                n,
                validation_single_step=self.single_step_error(validation),
                validation_multi_step=self.errors(validation).mean,
            )

    def _note(self, n: int, **values: float) -> None:
        for name, value in values.items():
            self.history_[name][n] = value

    def _check_parameters(self) -> None:
        whole: dict[str, tuple[Any, int]] = {"n_iterations": (self.n_iterations, 0)}
        if self.horizon is not None:
            whole["horizon"] = (self.horizon, 1)
        if self.stride is not None:
            if self.horizon is None:
                raise ValueError(
                    "expected a horizon beside the stride: rollouts of which length start there?"
                )
            whole["stride"] = (self.stride, 1)
        for name, (value, least) in whole.items():
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"expected {name} to be a whole number of at least {least}, got {value!r}")
        for name in ("outlier_threshold", "outlier_ratio"):
            limit = getattr(self, name)
            if limit is not None and not limit > 0:
                raise ValueError(f"expected {name} above 0, got {limit!r}")
