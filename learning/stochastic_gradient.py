"""`GradientTrained`: the loop that the gradient-trained rivals of Data as Demonstrator share.

For a model linear in fixed features, x_hat_{t+1} = f(x_t, u_t) with output A' phi + b, a sibling says what its loss
and gradient on a mini-batch are; here are the start, Adam, the step sizes, clipping, and the choice by validation:

    min_{A, b}  loss(A, b) + alpha |A S|^2,      eta_i = learning_rate (1 + cos(pi i / n)) / 2,      i = 0 .. n - 1

where S takes the regressor's output to standardised states (the identity for target "next"), so that the one-step
loss has the ridge solution as its minimum. Adam's steps follow the axes of its parameters, and random Fourier
features are far from orthogonal; so the steps are taken for whitened features P'(phi - mean phi), with
P P' = (Cov phi + (alpha + damping) I)^-1 on the training data, which leaves the minimum where it is.

References: Kingma & Ba, "Adam", ICLR 2015, Algorithm 1. The start, the whitening, the cosine of the step sizes and
the clipping (Pascanu, Mikolov & Bengio, "On the difficulty of training recurrent neural networks", ICML 2013) are
choices made here for the rivals' best; none is part of the methods compared.
"""

from __future__ import annotations

import time
import warnings
from abc import abstractmethod
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone
from tqdm import tqdm

from beliefgym.learning.dynamics import DivergenceWarning, DynamicsModel
from beliefgym.learning.linear_in_features import LinearInFeatures
from beliefgym.learning.normal_equations import NormalEquations
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences

Array = NDArray[np.float64]
Init = Literal["ridge", "zeros", "random"]
HISTORY = (
    "epoch",
    "loss",
    "train_multi_step",
    "validation_multi_step",
    "train_single_step",
    "validation_single_step",
    "seconds",
)
RANDOM_SCALE = 0.1  # standard deviation of the outputs of init "random", in those of the targets
DAMPING = 1e-6  # added to the variances that whitening divides by, as a share of the largest


class Objective(Protocol):
    """A loss that is a sum over items, of which mini-batches are drawn."""

    n_items: int

    def loss_and_gradient(
        self,
        weights: Array,
        offset: Array,
        items: NDArray[np.int64],
        progress: float,
        rng: np.random.Generator,
    ) -> tuple[float, Array, Array]:
        """An unbiased estimate of the loss from a mini-batch, and its gradient.

        Args:
            weights: A (m, d). offset: b (d,).
            items: (n,) the mini-batch.
            progress: share of the training's updates that are done, 0 to 1.
            rng: of what is random in the loss.

        Returns:
            The loss, and its gradient by A and by b.
        """


class GradientTrained(DynamicsModel):
    """Base of the models trained by stochastic gradient; see the siblings for the parameters.

    A subclass implements `_objective`, and may check more in `_check_parameters`.
    """

    regressor: BaseEstimator | None
    horizon: int | None
    init: Init
    n_epochs: int
    batch_size: int
    learning_rate: float
    max_gradient_norm: float | None
    precondition: bool
    random_state: int | np.random.Generator | None
    progress_bar: bool

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Train for n_epochs and keep the model that predicts the validation trajectories best.

        Where the loss or the parameters stop being finite, training ends with a `DivergenceWarning`; the best model
        until then is kept, and the history is NaN from there on.

        Args:
            train: trajectories to learn from.
            validation: whole trajectories, rolled out from their first observation. Without them the error on
                training rollouts of `horizon` steps chooses.

        Raises:
            ValueError: no step to learn from, other components in validation, parameters out of range.
            TypeError: not `Sequences`; a regressor not linear in features.
        """
        self._check_parameters()
        self._begin(train, validation)
        started = time.perf_counter()
        rng = np.random.default_rng(self.random_state)
        rollouts = train if self.horizon is None else train.segments(self.horizon, keep_tail=True)
        regressor = self._ridge(train)
        objective = self._objective(train, regressor)
        parameters = Parameters(regressor, self.precondition)
        penalty = regressor.alpha * np.square(self._change_scale)
        parameters.set(*self._initial(regressor, parameters, rng))
        adam = Adam(parameters.theta.shape)
        self.history_: dict[str, Array] = {name: np.full(self.n_epochs + 1, np.nan) for name in HISTORY}
        n_items = objective.n_items
        n_updates = self.n_epochs * -(-n_items // self.batch_size)
        best, update = np.inf, 0
        for epoch in tqdm(range(self.n_epochs + 1), desc=type(self).__name__, disable=not self.progress_bar):
            losses: list[float] = []
            order = rng.permutation(n_items) if epoch else np.empty(0, dtype=np.int64)
            for i in range(0, len(order), self.batch_size):
                weights, offset = parameters.get()
                loss, by_weights, by_offset = objective.loss_and_gradient(
                    weights, offset, order[i : i + self.batch_size], update / max(n_updates - 1, 1), rng
                )
                losses.append(loss + float((penalty * np.square(weights)).sum()))
                gradient = parameters.pull_back(by_weights + 2.0 * penalty * weights, by_offset)
                if not (np.isfinite(losses[-1]) and np.isfinite(gradient).all()):
                    break
                rate = 0.5 * self.learning_rate * (1.0 + np.cos(np.pi * update / n_updates))
                parameters.theta -= adam.step(_clipped(gradient, self.max_gradient_norm), rate)
                update += 1
            weights, offset = parameters.get()
            if not (np.isfinite(losses).all() and np.isfinite(weights).all() and np.isfinite(offset).all()):
                self._tell_divergence(epoch, losses[-1])
                break
            self.model_ = regressor.frozen()
            self.model_._set(weights, offset)
            self._record(epoch, train, validation, rollouts)
            self.history_["loss"][epoch] = np.mean(losses) if losses else np.nan
            criterion = self.history_["train_multi_step" if validation is None else "validation_multi_step"][
                epoch
            ]
            if criterion < best or epoch == 0:
                best, self.best_epoch_, chosen = criterion, epoch, self.model_
            self.history_["seconds"][epoch] = time.perf_counter() - started
            started = time.perf_counter()
        self.model_ = chosen
        return self

    @abstractmethod
    def _objective(self, train: Sequences, regressor: LinearInFeatures) -> Objective:
        """What is minimised besides the penalty.

        Args:
            train: trajectories. regressor: fitted to their single steps; its features are fixed from here on.
        """

    def _step(self, z: Array, u: Array) -> Array:
        return self._next(z, self.model_.predict_unchecked(np.concatenate([z, u], axis=1)))

    def _ridge(self, train: Sequences) -> LinearInFeatures:
        """The regressor fitted to single steps."""
        z, u = self._coordinates(train)
        episode, t = np.nonzero(train.step_mask)
        regressor = RandomFourierRidge(random_state=0) if self.regressor is None else self.regressor
        fitted: LinearInFeatures = clone(regressor).fit(
            np.concatenate([z[episode, t], u[episode, t]], axis=1),
            self._targets(z[episode, t], z[episode, t + 1]),
        )
        return fitted

    def _initial(
        self, regressor: LinearInFeatures, parameters: Parameters, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        weights, offset = regressor._weights, regressor._offset
        if self.init == "ridge":
            return weights, offset
        if self.init == "zeros":
            return np.zeros_like(weights), np.zeros_like(offset)
        spread = RANDOM_SCALE / np.sqrt(max(parameters.variance, DAMPING))
        return spread * rng.standard_normal(weights.shape), np.zeros_like(offset)

    def _record(
        self, epoch: int, train: Sequences, validation: Sequences | None, rollouts: Sequences
    ) -> None:
        note: dict[str, float] = {
            "epoch": epoch,
            "train_single_step": self.single_step_error(train),
            "train_multi_step": self.errors(rollouts).mean,
        }
        if validation is not None:
            note["validation_single_step"] = self.single_step_error(validation)
            note["validation_multi_step"] = self.errors(validation).mean
        for name, value in note.items():
            self.history_[name][epoch] = value

    def _tell_divergence(self, epoch: int, loss: float) -> None:
        warnings.warn(
            f"training diverged in epoch {epoch} of {self.n_epochs} (a loss of {loss:g}) and was ended; the "
            f"best model, of epoch {self.best_epoch_}, is kept. A smaller learning_rate than {self.learning_rate:g} or "
            f"max_gradient_norm than {self.max_gradient_norm} may help",
            DivergenceWarning,
            stacklevel=3,
        )

    def _check_parameters(self) -> None:
        if self.regressor is not None and not isinstance(self.regressor, LinearInFeatures):
            raise TypeError(
                "expected a regressor linear in features (Ridge, RandomFourierRidge, PolynomialRidge) for "
                f"{type(self).__name__}, got {type(self.regressor).__name__}; DataAsDemonstrator takes any"
            )
        whole: dict[str, tuple[Any, int]] = {
            "n_epochs": (self.n_epochs, 0),
            "batch_size": (self.batch_size, 1),
        }
        if self.horizon is not None:
            whole["horizon"] = (self.horizon, 1)
        for name, (value, least) in whole.items():
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"expected {name} to be a whole number of at least {least}, got {value!r}")
        if not self.learning_rate > 0:
            raise ValueError(f"expected learning_rate above 0, got {self.learning_rate!r}")
        if self.max_gradient_norm is not None and not self.max_gradient_norm > 0:
            raise ValueError(f"expected max_gradient_norm above 0 or None, got {self.max_gradient_norm!r}")
        if self.init not in ("ridge", "zeros", "random"):
            raise ValueError(f"expected init to be 'ridge', 'zeros' or 'random', got {self.init!r}")


class Parameters:
    """The coefficients A and b as Adam moves them: A = P theta, b = c - A' mean, with theta and c in one array.

    Args:
        regressor: fitted; its sums give the features' mean and covariance.
        whiten: whether P whitens the features; otherwise P is the identity and the mean 0.
        damping: added to the variances that whitening divides by, as a share of the largest.
    """

    def __init__(self, regressor: LinearInFeatures, whiten: bool, damping: float = DAMPING) -> None:
        m, d = regressor._weights.shape
        mean, covariance = feature_moments(regressor.equations_)
        self.variance = float(np.trace(covariance) + mean @ mean)  # mean of |phi|^2
        self._intercept = regressor.fit_intercept
        self._mean = mean if whiten and self._intercept else np.zeros(m)
        if whiten:
            if not self._intercept:
                covariance = covariance + np.outer(mean, mean)
            values, vectors = np.linalg.eigh(covariance)
            deviation = np.sqrt(
                np.maximum(values, 0.0) + regressor.alpha + damping * max(values[-1], DAMPING)
            )
            self._from_theta, self._to_theta = vectors / deviation, (vectors * deviation).T
        else:
            self._from_theta = self._to_theta = np.eye(m)
        self.theta = np.zeros((m + 1, d))

    def set(self, weights: Array, offset: Array) -> None:
        """Take A (m, d) and b (d,)."""
        self.theta[:-1] = self._to_theta @ weights
        self.theta[-1] = offset + self._mean @ weights

    def get(self) -> tuple[Array, Array]:
        """A (m, d) and b (d,)."""
        weights = self._from_theta @ self.theta[:-1]
        return weights, self.theta[-1] - self._mean @ weights

    def pull_back(self, by_weights: Array, by_offset: Array) -> Array:
        """The gradient by theta and c (m + 1, d), from those by A and b."""
        gradient = np.zeros_like(self.theta)
        gradient[:-1] = self._from_theta.T @ (by_weights - np.outer(self._mean, by_offset))
        if self._intercept:
            gradient[-1] = by_offset
        return gradient


class Adam:
    """Steps of Adam with its authors' constants.

    Args:
        shape: of the parameters.
    """

    def __init__(self, shape: tuple[int, ...], beta_1: float = 0.9, beta_2: float = 0.999) -> None:
        self._beta_1, self._beta_2 = beta_1, beta_2
        self._mean, self._square, self._n = np.zeros(shape), np.zeros(shape), 0

    def step(self, gradient: Array, rate: float) -> Array:
        """What to subtract from the parameters."""
        self._n += 1
        self._mean += (1.0 - self._beta_1) * (gradient - self._mean)
        self._square += (1.0 - self._beta_2) * (np.square(gradient) - self._square)
        mean = self._mean / (1.0 - self._beta_1**self._n)
        square = self._square / (1.0 - self._beta_2**self._n)
        step: Array = rate * mean / (np.sqrt(square) + 1e-8)
        return step


def feature_moments(equations: NormalEquations) -> tuple[Array, Array]:
    """Mean (m,) and covariance (m, m) of the features that were added; without intercept, about zero."""
    lower = equations._centred()[0] / equations.weight
    mean = equations._shift_z + equations._sum_z / equations.weight
    return mean, np.tril(lower) + np.tril(lower, -1).T


def _clipped(gradient: Array, norm: float | None) -> Array:
    length = float(np.linalg.norm(gradient))
    return gradient if norm is None or length <= norm else gradient * (norm / length)
