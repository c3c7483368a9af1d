"""`LaggedError` and `WeightedMultiHorizon`: the multi-step error itself, minimised by backpropagation through time.

With x_hat_{t+h|t} the prediction of h steps from the true x_t with the recorded actions, for models linear in fixed
features (output A' phi + b),

    min_{A, b}  sum_{h=1}^{H} w_h mean_t |x_{t+h} - x_hat_{t+h|t}|^2 + alpha |A S|^2

in standardised states, over every t that has h steps after it in its episode. The gradient goes through all h steps.
The loss is neither convex nor linear in A (Sec. 3.1); Adam starts from the single-step ridge solution.

References: Abbeel & Ng, "Learning first-order Markov models for control", NIPS 2004 (the thesis's 2005a): the
criterion, as a likelihood maximised by EM; Abbeel, Ganapathi & Ng, "Learning vehicular dynamics", NIPS 2005: as a
squared error; thesis proposal, Sec. 3.1. Benechehab et al., "Multi-timestep models for model-based reinforcement
learning", 2023, and "A multi-step loss function for robust learning of the dynamics in model-based reinforcement
learning", 2024: weights that decay with h. Werbos, "Backpropagation through time", 1990. The optimiser is a choice
made here; see `stochastic_gradient`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from beliefgym.learning.dynamics import Standardise, Target
from beliefgym.learning.linear_in_features import LinearInFeatures
from beliefgym.learning.multi_step_loss import MultiStepLoss, SubTrajectories
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.stochastic_gradient import GradientTrained, Init

Array = NDArray[np.float64]


class BackpropThroughTime(GradientTrained):
    """A one-step model trained on its predictions of 1 .. H steps, by gradients through all of them.

    A sub-trajectory whose prediction leaves the divergence limit stays at its last prediction inside, as in `rollout`.

    Args:
        regressor: linear in features: `Ridge`, `RandomFourierRidge` or `PolynomialRidge`; its alpha is the penalty.
            None for `RandomFourierRidge(random_state=0)`.
        horizon: H, at most the steps of the longest trajectory; sub-trajectories start at every step.
        horizon_weights: "uniform" for w_h = 1/H, or a number beta in (0, 1] for w_h proportional to beta^h; they
            sum to 1.
        target: "delta" to learn x_{t+1} - x_t, or "next" to learn x_{t+1}.
        init: start from the single-step "ridge" solution, from "zeros", or from small "random" weights.
        n_epochs: passes over all sub-trajectories; 0 leaves the start.
        batch_size: sub-trajectories a step of Adam.
        learning_rate: of Adam, at the start; it falls to 0 along a cosine.
        max_gradient_norm: longer gradients (in whitened features) are shortened to this; None for none.
        precondition: whether Adam works in whitened features.
        random_state: of the mini-batches and of init "random".
        standardise: bring the components of states and actions to one scale, as of `DataAsDemonstrator`.
        use_actions: whether actions, where the trajectories have them, are inputs.
        divergence_limit: standard deviations of the training data beyond which a rollout is cut.
        progress_bar: show the epochs.

    Attributes:
        model_: the best model's regressor, in standardised coordinates; it needs no torch.
        best_epoch_: which it was; 0 is the start.
        history_: arrays (n_epochs + 1,), entry 0 the start: "epoch", "loss" (mean over the epoch's mini-batches, with
            the penalty), "train_multi_step" (on rollouts of H steps) and "validation_multi_step" (mean of e_k / p_k;
            NaN without validation), "train_single_step", "validation_single_step" (RMS, data's units), "seconds".

    Example:
        >>> model = BackpropThroughTime(RandomFourierRidge(random_state=0), horizon=5)  # doctest: +SKIP
        >>> model.fit(train, validation).rollout(test.observations[:, 0], 100)  # doctest: +SKIP
    """

    horizon: int

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        horizon: int = 5,
        horizon_weights: Literal["uniform"] | float = "uniform",
        target: Target = "delta",
        init: Init = "ridge",
        n_epochs: int = 25,
        batch_size: int = 256,
        learning_rate: float = 3e-3,
        max_gradient_norm: float | None = 1.0,
        precondition: bool = True,
        random_state: int | np.random.Generator | None = None,
        standardise: Standardise = True,
        use_actions: bool = True,
        divergence_limit: float = 100.0,
        progress_bar: bool = False,
    ) -> None:
        self.regressor = regressor
        self.horizon = horizon
        self.horizon_weights = horizon_weights
        self.target = target
        self.init = init
        self.n_epochs = n_epochs
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.max_gradient_norm = max_gradient_norm
        self.precondition = precondition
        self.random_state = random_state
        self.standardise = standardise
        self.use_actions = use_actions
        self.divergence_limit = divergence_limit
        self.progress_bar = progress_bar

    def criterion(self, sequences: Sequences) -> float:
        """sum_h w_h mean_t |x_{t+h} - x_hat_{t+h|t}|^2 of the fitted model, in standardised states, no penalty."""
        self._check_fitted()
        pieces = SubTrajectories(*self._coordinates(sequences), sequences.lengths, self.horizon)
        z, u, inside = pieces.cut(np.arange(len(pieces)))
        error = np.square(self._forecast(z[:, 0], u)[0][:, 1:] - z[:, 1:]).sum(axis=2)
        return float((error * inside).sum(axis=0) / pieces.n_at_step @ self._weights_of_steps())

    def _objective(self, train: Sequences, regressor: LinearInFeatures) -> MultiStepLoss:
        return MultiStepLoss(self, train, regressor)

    def _weights_of_steps(self) -> Array:
        """(H,) w_h."""
        beta = 1.0 if isinstance(self.horizon_weights, str) else self.horizon_weights
        weights: Array = beta ** np.arange(self.horizon, dtype=float)
        return weights / weights.sum()

    def _check_parameters(self) -> None:
        super()._check_parameters()
        if self.horizon is None:
            raise ValueError("expected horizon to be a whole number of at least 1, got None")
        beta = self.horizon_weights
        if isinstance(beta, str):
            if beta != "uniform":
                raise ValueError(f"expected horizon_weights 'uniform' or a number, got {beta!r}")
        elif not 0 < beta <= 1:
            raise ValueError(f"expected the decay of the horizon's weights in (0, 1], got {beta!r}")


class LaggedError(BackpropThroughTime):
    """The lagged error of Abbeel & Ng: all of 1 .. H steps weigh the same.

    Args and attributes as of `BackpropThroughTime`.

    Deviations: the gradient is exact, where Abbeel & Ng have EM and Abbeel, Ganapathi & Ng alternate least-squares
    approximations for linear models; the penalty; standardised states.
    """

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        horizon: int = 5,
        target: Target = "delta",
        init: Init = "ridge",
        n_epochs: int = 25,
        batch_size: int = 256,
        learning_rate: float = 3e-3,
        max_gradient_norm: float | None = 1.0,
        precondition: bool = True,
        random_state: int | np.random.Generator | None = None,
        standardise: Standardise = True,
        use_actions: bool = True,
        divergence_limit: float = 100.0,
        progress_bar: bool = False,
    ) -> None:
        super().__init__(
            regressor,
            horizon=horizon,
            horizon_weights="uniform",
            target=target,
            init=init,
            n_epochs=n_epochs,
            batch_size=batch_size,
            learning_rate=learning_rate,
            max_gradient_norm=max_gradient_norm,
            precondition=precondition,
            random_state=random_state,
            standardise=standardise,
            use_actions=use_actions,
            divergence_limit=divergence_limit,
            progress_bar=progress_bar,
        )


class WeightedMultiHorizon(BackpropThroughTime):
    """The weighted multi-step loss of Benechehab et al.: the error after h steps weighs beta^h.

    Args:
        horizon_weights: beta in (0, 1]; 1 gives the lagged error. Theirs is tuned for each task and horizon.

    The other args and the attributes as of `BackpropThroughTime`.

    Deviations: their models are neural networks; here the features are fixed and only A and b are trained.
    """

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        horizon: int = 5,
        horizon_weights: float = 0.5,
        target: Target = "delta",
        init: Init = "ridge",
        n_epochs: int = 25,
        batch_size: int = 256,
        learning_rate: float = 3e-3,
        max_gradient_norm: float | None = 1.0,
        precondition: bool = True,
        random_state: int | np.random.Generator | None = None,
        standardise: Standardise = True,
        use_actions: bool = True,
        divergence_limit: float = 100.0,
        progress_bar: bool = False,
    ) -> None:
        super().__init__(
            regressor,
            horizon=horizon,
            horizon_weights=horizon_weights,
            target=target,
            init=init,
            n_epochs=n_epochs,
            batch_size=batch_size,
            learning_rate=learning_rate,
            max_gradient_norm=max_gradient_norm,
            precondition=precondition,
            random_state=random_state,
            standardise=standardise,
            use_actions=use_actions,
            divergence_limit=divergence_limit,
            progress_bar=progress_bar,
        )
