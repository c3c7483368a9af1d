"""`GRUHints` and `LSTMHints`: recurrent networks trained to estimate hints, by backpropagation through time.

    s_t = cell(s_{t-1}, u_t),   u_t = [(x_t - mean) / scale, (x_t - x_{t-1}) / scale'],   h_hat_t = W s_t + b

    min  mean_{t, i} |h_hat_t - h_t|^2      over every observation of every training trajectory, the first included.

The belief m_{t+1} is the cell's state (s_t, and an LSTM's c_t), x_t, and whether anything was seen, as of `GRUFilter`,
whose training this is, with hints as targets. The network predicts no observation; what a belief expects next, for
where an observation is missing, is a ridge regression of x_{t+1} - x_t on the trained network's state and x_t, kept
within the range of the training data. torch trains in float32 (see `recurrent_training`); the fitted filter is numpy
in float64 (see `recurrent_cells`) and needs no torch.

References: Cho et al., "Learning phrase representations using RNN encoder-decoder for statistical machine translation",
EMNLP 2014 (GRU); Hochreiter & Schmidhuber, "Long short-term memory", Neural Computation 9, 1997 (LSTM). The thesis
proposal's Sec. 3.4.3 has no recurrent network among its baselines; this one is the package's.
"""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.aggregation import predict_unchecked
from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.filters import Filter
from beliefgym.learning.hint_filter import HintFilter
from beliefgym.learning.hint_gaps import gap_growth
from beliefgym.learning.hint_reading import ResidualVariance, fitted
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.recurrent_filter import Arrangement, RecurrentFilter
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
OBSERVER_PENALTY = 1e-4  # a sample, of the regression of x_{t+1} - x_t: it leans to no change


class RecurrentHints(RecurrentFilter, HintFilter):
    """Base of `GRUHints` and `LSTMHints`, which differ in the cell alone.

    Args:
        hidden_size, n_layers, differences, learning_rate, n_epochs, batch_size, segment_length, max_gradient_norm,
            weight_decay, dropout, patience, max_seconds, random_state, device, progress_bar: as of `RecurrentFilter`.
        hints_from: the trajectories' array that holds the hints, "hints" or "states".
        standardise: bring observations and hints to one scale each, in which the loss is; "together" by one factor for
            all components, so that a hint counts by what it varies.

    Attributes:
        model_: the network, in numpy.
        best_epoch_: the epoch whose weights were kept, the best in validation error (without validation trajectories,
            in training error); 0 is the start, which estimates the mean hint.
        history_: arrays, entry 0 the start: "train_error" (on the way through the epoch) and "validation_error" (mean
            over observations of |h_hat - h|^2, standardised; NaN without validation), "seconds" of each epoch.
        gap_growth_: as of `PSIMHints`. n_hint_, hint_names_, prior_mean_, prior_std_: as of `HintFilter`.
    """

    # the network has one head, and its targets are hints
    residual = False
    n_future = 1
    future_weights = "uniform"

    def __init__(
        self,
        *,
        hidden_size: int = 128,
        n_layers: int = 1,
        differences: bool = True,
        learning_rate: float = 1e-2,
        n_epochs: int = 150,
        batch_size: int = 32,
        segment_length: int | None = 25,
        max_gradient_norm: float | None = 1.0,
        weight_decay: float = 0.1,
        dropout: float = 0.0,
        patience: int | None = 30,
        max_seconds: float | None = None,
        random_state: int | np.random.Generator | None = None,
        hints_from: Literal["hints", "states"] = "hints",
        standardise: Standardise = True,
        device: str = "cpu",
        progress_bar: bool = False,
    ) -> None:
        self.hidden_size = hidden_size
        self.n_layers = n_layers
        self.differences = differences
        self.learning_rate = learning_rate
        self.n_epochs = n_epochs
        self.batch_size = batch_size
        self.segment_length = segment_length
        self.max_gradient_norm = max_gradient_norm
        self.weight_decay = weight_decay
        self.dropout = dropout
        self.patience = patience
        self.max_seconds = max_seconds
        self.random_state = random_state
        self.hints_from = hints_from
        self.standardise = standardise
        self.device = device
        self.progress_bar = progress_bar

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Train, keep the best epoch's weights, and learn how sure its estimates are.

        Where the loss stops being finite, training ends with a `DivergenceWarning` and the best weights until then.

        Args:
            train: trajectories with hints.
            validation: whole trajectories that choose the epoch, end training and tell how sure estimates are. Without
                them the training trajectories do, which do not see overfitting: the network was fitted to them, and
                the standard deviation is then too small.

        Raises:
            ValueError: no hints, no step to learn from, other components in validation, parameters out of range.
            TypeError: not `Sequences`.
        """
        # imports torch, which a fitted filter does without
        from beliefgym.learning import recurrent_training as training

        self._check_parameters()
        self.__dict__.pop("model_", None)
        self._begin(train, validation)
        self._begin_hints(train, validation)
        rng = np.random.default_rng(self.random_state)
        z, mask = self._scale.apply(train.observations), train.observation_mask
        constant = Standardisation.of(train.observations[mask]).constant
        self._arrangement = Arrangement.of(z, train.lengths, constant, 1, False, self.differences)
        self._low, self._high = z[mask].min(axis=0), z[mask].max(axis=0)
        self._target = Standardisation.of(self._hint_scale.apply(self._hints_of(train, "trajectories"))[mask])
        scale = np.where(self._target.constant, 0.0, self._target.scale)[None]

        examples = training.Examples.of(*self._examples(train), train.lengths + 1, self.device)
        validated = None
        if validation is not None:
            parts = self._examples(validation)
            validated = training.Examples.of(*parts, validation.lengths + 1, self.device)
        self._train(examples, validated, self._target.offset[None], scale, np.ones(1), rng)
        self._learn_rest(train, train if validation is None else validation)
        self._note_beliefs(train)
        return self

    def _learn_rest(self, train: Sequences, judged: Sequences) -> None:
        """What a belief expects next, and how sure its hint is, of a trained network."""
        beliefs, z = self.beliefs(train), self._standardised(train)
        followed = train.observation_mask[:, 1:]
        self._observer = fitted(
            Ridge(alpha=OBSERVER_PENALTY),
            beliefs[:, 1:-1, :-1][followed],
            np.diff(z, axis=1)[followed],
        )
        rows, hints, episode = self._rows(judged)
        # the estimate of a constant hint may be exact, and the variance's logarithm needs a number above 0
        squared = np.maximum(np.square(self._estimated(rows) - hints), np.finfo(float).eps ** 2)
        self._variance = ResidualVariance().fit(rows, squared, episode)
        self.gap_growth_ = gap_growth(self, judged)

    def _examples(self, sequences: Sequences) -> tuple[Array, Array]:
        """Inputs (n, T, n_inputs) and targets (n, T, 1, n_hint) at all T observations of the longest trajectory."""
        outside = ~sequences.observation_mask
        z = self._scale.apply(sequences.observations)
        inputs = self._arrangement.inputs(z, np.diff(z, axis=1, prepend=z[:, :1]))
        hints = self._hint_scale.apply(self._hints_of(sequences, "trajectories"))
        targets = self._target.apply(hints)
        targets[..., self._target.constant] = 0.0
        inputs[outside] = targets[outside] = 0.0
        n_rows = int(sequences.lengths.max()) + 1
        return inputs[:, :n_rows], targets[:, :n_rows, None]

    def _observe(self, belief: Array) -> Array:
        size = self.model_.initial.size
        change = predict_unchecked(self._observer, belief[:, :-1], self.n_obs_)
        following = np.clip(belief[:, size:-1] + change, self._low, self._high)
        expected: Array = np.where(belief[:, -1:] > 0.5, following, self._arrangement.first[0])
        return expected

    def _forecast(self, belief: Array, horizon: int) -> Array:
        return Filter._forecast(self, belief, horizon)

    def _read_hint(self, belief: Array) -> tuple[Array, Array]:
        seen = belief[:, -1:] > 0.5
        mean = self._hint_scale.invert(self._estimated(belief))
        std = np.sqrt(self._variance(belief)) * self._hint_scale.scale
        return np.where(seen, mean, self.prior_mean_), np.where(seen, std, self.prior_std_)

    def _estimated(self, belief: Array) -> Array:
        """Standardised h_hat_t of beliefs that have seen something."""
        return self.model_.outputs(belief[:, : self.model_.initial.size])


class GRUHints(RecurrentHints):
    """A network of gated recurrent units that estimates hints.

    Args and attributes as of `RecurrentHints`.

    Example:
        >>> GRUHints(random_state=0).fit(train, validation).hint_errors(test).mean  # doctest: +SKIP
    """

    _cell = "gru"


class LSTMHints(RecurrentHints):
    """A network of long short-term memory that estimates hints.

    Args and attributes as of `RecurrentHints`.
    """

    _cell = "lstm"
