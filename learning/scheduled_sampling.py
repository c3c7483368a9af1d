"""`ScheduledSampling`: a one-step model trained on inputs that are more and more its own predictions.

Along each training trajectory the next input is the true state with probability eps_i, and otherwise the model's own
prediction of it; the target is the true next state either way, and no gradient goes through the prediction:

    loss = mean_t |x_{t+1} - f(x~_t, u_t)|^2,      x~_t = x_t with probability eps_i, else f(x~_{t-1}, u_{t-1}).

eps_i falls from 1 to eps_n over the updates i = 0 .. n - 1 of the training.

Reference: Bengio, Vinyals, Jaitly & Shazeer, "Scheduled sampling for sequence prediction with recurrent neural
networks", NIPS 2015, Sec. 2.4. Theirs are discrete tokens drawn from a recurrent network; here the model is a Markov
regression, so a sample is its prediction. The optimiser is a choice made here; see `stochastic_gradient`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from sklearn.base import BaseEstimator

from beliefgym.learning.dynamics import Standardise, Target
from beliefgym.learning.linear_in_features import LinearInFeatures
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.stochastic_gradient import GradientTrained, Init

Array = NDArray[np.float64]
Decay = Literal["linear", "exponential", "inverse_sigmoid"]


class ScheduledSampling(GradientTrained):
    """A one-step model trained by scheduled sampling.

    A prediction that leaves the divergence limit is not used as an input: the true state stands in for it.

    Args:
        regressor: linear in features: `Ridge`, `RandomFourierRidge` or `PolynomialRidge`; its alpha is the penalty.
            None for `RandomFourierRidge(random_state=0)`.
        horizon: steps of the pieces that trajectories are cut into, each starting at a true state; None for whole
            trajectories.
        decay: of eps_i: "linear" 1 - c i, "exponential" k^i, or "inverse_sigmoid" k / (k + exp(i / k)).
        final_truth_probability: eps at the last update, which fixes c or k; 1 for true states throughout. 0 is for
            "linear" only.
        target: "delta" to learn x_{t+1} - x_t, or "next" to learn x_{t+1}.
        init: start from the single-step "ridge" solution, from "zeros", or from small "random" weights.
        n_epochs: passes over the trajectories; 0 leaves the start.
        batch_size: trajectories (or pieces) a step of Adam.
        learning_rate: of Adam, at the start; it falls to 0 along a cosine. What is best goes from 1e-4 with a small
            alpha to 3e-3 with a large one: choose it on validation data.
        max_gradient_norm: longer gradients (in whitened features) are shortened to this; None for none.
        precondition: whether Adam works in whitened features.
        random_state: of the mini-batches, the choice of inputs and init "random".
        standardise: bring the components of states and actions to one scale, as of `DataAsDemonstrator`.
        use_actions: whether actions, where the trajectories have them, are inputs.
        divergence_limit: standard deviations of the training data beyond which a rollout is cut.
        progress_bar: show the epochs.

    Attributes:
        model_: the best model's regressor, in standardised coordinates.
        best_epoch_: which it was; 0 is the start.
        history_: as of `BackpropThroughTime`, and "truth_probability" at the end of each epoch.

    Example:
        >>> model = ScheduledSampling(RandomFourierRidge(random_state=0), horizon=5)  # doctest: +SKIP
        >>> model.fit(train, validation).rollout(test.observations[:, 0], 100)  # doctest: +SKIP
    """

    def __init__(
        self,
        regressor: BaseEstimator | None = None,
        *,
        horizon: int | None = None,
        decay: Decay = "linear",
        final_truth_probability: float = 0.0,
        target: Target = "delta",
        init: Init = "ridge",
        n_epochs: int = 25,
        batch_size: int = 32,
        learning_rate: float = 3e-4,
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
        self.decay = decay
        self.final_truth_probability = final_truth_probability
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

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """See `GradientTrained.fit`."""
        super().fit(train, validation)
        schedule = truth_probability(self.decay, self.final_truth_probability)
        epochs = np.arange(self.n_epochs + 1) / max(self.n_epochs, 1)
        self.history_["truth_probability"] = np.array([schedule(done) for done in epochs])
        return self

    def _objective(self, train: Sequences, regressor: LinearInFeatures) -> SampledInputsLoss:
        return SampledInputsLoss(self, train, regressor)

    def _check_parameters(self) -> None:
        super()._check_parameters()
        truth_probability(self.decay, self.final_truth_probability)


class SampledInputsLoss:
    """The one-step loss on inputs of which some are predictions; an item is a trajectory.

    Args:
        model: whose coordinates and schedule these are.
        train: trajectories. regressor: whose features.
    """

    def __init__(self, model: ScheduledSampling, train: Sequences, regressor: LinearInFeatures) -> None:
        pieces = train if model.horizon is None else train.segments(model.horizon, keep_tail=True)
        pieces = pieces[pieces.lengths > 0]
        self._z, self._u = model._coordinates(pieces)
        self._lengths = pieces.lengths
        self.n_items = len(pieces)
        self._schedule = truth_probability(model.decay, model.final_truth_probability)
        self._model, self._features = model, regressor.features

    def loss_and_gradient(
        self,
        weights: Array,
        offset: Array,
        items: NDArray[np.int64],
        progress: float,
        rng: np.random.Generator,
    ) -> tuple[float, Array, Array]:
        """See `Objective`."""
        z, u, lengths, model = self._z[items], self._u[items], self._lengths[items], self._model
        share = 1.0 / (len(items) * self._lengths.mean())  # one over the steps a mini-batch has on average
        is_truth = rng.random((len(items), u.shape[1])) < self._schedule(progress)
        loss, by_weights, by_offset = 0.0, np.zeros_like(weights), np.zeros_like(offset)
        now = z[:, 0]
        for t in range(int(lengths.max())):
            going = np.flatnonzero(lengths > t)
            phi = self._features(np.concatenate([now[going], u[going, t]], axis=1))
            z_next = model._next(now[going], phi @ weights + offset)
            error = z_next - z[going, t + 1]
            loss += share * float(np.square(error).sum())
            by_output = (2.0 * share) * error * model._change_scale
            by_weights += phi.T @ by_output
            by_offset += by_output.sum(axis=0)
            predicted = ~is_truth[going, t] & model._inside(z_next)
            now = z[:, t + 1].copy()
            now[going[predicted]] = z_next[predicted]
        return loss, by_weights, by_offset


def truth_probability(decay: Decay, final: float) -> Callable[[float], float]:
    """eps as a function of the share s of the updates that are done.

    "linear" is 1 - (1 - final) s, "exponential" final^s, "inverse_sigmoid" k / (k + exp(i / k)) with i = 1000 s (in
    the paper i counts mini-batches; so the curve does not depend on their number) and the k that ends at `final`.

    Raises:
        ValueError: an unknown decay; final outside [0, 1], or 0 where the decay never gets there.
    """
    if decay not in ("linear", "exponential", "inverse_sigmoid"):
        raise ValueError(f"expected decay 'linear', 'exponential' or 'inverse_sigmoid', got {decay!r}")
    if not 0 <= final <= 1 or (final == 0 and decay != "linear"):
        low = "[0" if decay == "linear" else "(0"
        raise ValueError(f"expected final_truth_probability in {low}, 1] with decay {decay!r}, got {final!r}")
    if final == 1:
        return lambda s: 1.0
    if decay == "linear":
        return lambda s: 1.0 - (1.0 - final) * s
    if decay == "exponential":
        return lambda s: final**s
    # the logarithm of (1 / final - 1) k = exp(1000 / k), whose left side rises and right side falls with k
    k = brentq(lambda k: np.log1p(-final) - np.log(final) + np.log(k) - 1000.0 / k, 1.0, 1e20)
    return lambda s: float(1.0 / (1.0 + np.exp(1000.0 * s / k) / k))
