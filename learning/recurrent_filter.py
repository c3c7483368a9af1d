"""`GRUFilter` and `LSTMFilter`: recurrent networks trained by backpropagation through time, as filters.

    h_t = cell(h_{t-1}, u_t),   u_t = [(x_t - mean) / scale, (x_t - x_{t-1}) / scale'],   x_hat_{t+1} = x_t + W h_t + b

The belief m_{t+1} is the cell's state (h_t, and an LSTM's c_t), x_t, and whether anything was seen. As long as nothing
was, the mean of the training data's first observations is expected. torch trains in float32 (see `recurrent_training`);
the fitted filter is numpy in float64 (see `recurrent_cells`) and needs no torch.

References: Cho et al., "Learning phrase representations using RNN encoder-decoder for statistical machine translation",
EMNLP 2014 (GRU); Hochreiter & Schmidhuber, "Long short-term memory", Neural Computation 9, 1997 (LSTM). The rival "RNN"
of the thesis proposal's Table 3.3 is a plain recurrent network; these are stronger.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.dynamics import DivergenceWarning, Standardise
from beliefgym.learning.filters import Filter, check_whole
from beliefgym.learning.recurrent_cells import Cell, RecurrentModel
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]
FutureWeights = Literal["uniform"] | float


@dataclass(frozen=True, eq=False)
class Arrangement:
    """What the network reads and what it predicts, each at a scale of its own; all of standardised observations z.

    Attributes:
        mean, per_scale: (d,) of z. per_step_scale: (d,) of z_t - z_{t-1}. Both are 0 for what does not vary.
        offset, scale: (k, d) of the targets z_{t+j} - z_t, or z_{t+j}; the scale is 0 for what does not vary.
        first: (k, d) means of z_0 .. z_{k-1}. residual, differences: as of `RecurrentFilter`.
    """

    mean: Array
    per_scale: Array
    per_step_scale: Array
    offset: Array
    scale: Array
    first: Array
    residual: bool
    differences: bool

    @classmethod
    def of(
        cls,
        z: Array,
        lengths: NDArray[np.int64],
        constant: NDArray[np.bool_],
        k: int,
        residual: bool,
        differences: bool,
    ) -> Arrangement:
        """From the training data: z (n, n_rows, d), and the components (d,) that do not vary."""
        time = np.arange(z.shape[1])
        rows = Standardisation.of(z[time <= lengths[:, None]])
        steps = Standardisation.of(np.diff(z, axis=1)[time[1:] <= lengths[:, None]])
        targets = [
            Standardisation.of((z[:, j:] - residual * z[:, : len(time) - j])[time[j:] <= lengths[:, None]])
            for j in range(1, k + 1)
        ]
        return cls(
            mean=rows.offset,
            per_scale=np.where(constant | rows.constant, 0.0, 1.0 / rows.scale),
            per_step_scale=np.where(constant | steps.constant, 0.0, 1.0 / steps.scale),
            offset=np.array([target.offset for target in targets]),
            scale=np.array([np.where(constant | target.constant, 0.0, target.scale) for target in targets]),
            first=np.array([z[lengths >= j, j].mean(axis=0) for j in range(k)]),
            residual=residual,
            differences=differences,
        )

    def inputs(self, z: Array, change: Array) -> Array:
        """u, from z and z_t - z_{t-1} (0 for the first observation), (..., d) each."""
        scaled = (z - self.mean) * self.per_scale
        return np.concatenate([scaled, change * self.per_step_scale], axis=-1) if self.differences else scaled

    def examples(self, z: Array, lengths: NDArray[np.int64]) -> tuple[Array, Array]:
        """Inputs (n, T, n_inputs) and targets (n, T, k, d) of T steps, the longest's; 0 past an episode's end."""
        n_steps = int(lengths.max())
        time, k = np.arange(n_steps), len(self.offset)
        z = z[:, : n_steps + 1]
        inputs = self.inputs(z[:, :-1], np.diff(z[:, :-1], axis=1, prepend=z[:, :1]))
        targets = np.zeros((len(z), n_steps, k, z.shape[2]))
        per_scale = np.divide(1.0, self.scale, out=np.zeros_like(self.scale), where=self.scale > 0)
        for j in range(1, min(k, n_steps) + 1):
            target = z[:, j:] - self.residual * z[:, :-j]
            targets[:, : n_steps + 1 - j, j - 1] = (target - self.offset[j - 1]) * per_scale[j - 1]
        inputs[time >= lengths[:, None]] = 0.0
        targets[time[:, None] + np.arange(1, k + 1) > lengths[:, None, None]] = 0.0
        return inputs, targets


class RecurrentFilter(Filter):
    """Base of `GRUFilter` and `LSTMFilter`, which differ in the cell alone.

    Trained on the squared error of one-step predictions in standardised observations, over all steps after the first
    observation. Where `n_future` is above 1, further heads predict x_{t+2}, .. from the same hidden state: the belief
    then has to hold more of the future, and `forecast` answers its first `n_future` steps by the heads.

    Args:
        hidden_size: numbers in the state of a layer. n_layers: layers.
        residual: the read-out predicts x_{t+1} - x_t; otherwise x_{t+1}. Far better for signals that are smooth.
        differences: x_t - x_{t-1} is an input too, at its own scale: a network sees small changes of a large value
            badly.
        n_future: k, heads.
        future_weights: of the heads' losses, each as a share of what its target varies: "uniform", or a number beta in
            (0, 1] for beta^(j-1).
        learning_rate: of Adam at the start; it falls to 0 along a cosine over n_epochs or max_seconds.
        n_epochs: passes over the data. batch_size: segments a step of Adam.
        segment_length: steps that gradients go back through, the state before them held fixed; None for all.
            Where no trajectory is longer than twice that, they go whole.
        max_gradient_norm: longer gradients are shortened to this; None for none.
        weight_decay: of AdamW, on weights but not on biases.
        dropout: share of the hidden state that the read-out does not see in training.
        patience: training ends after so many epochs without a better one; None for never.
        max_seconds: training ends after about this time; then fits differ from run to run.
        random_state: of the initial weights, mini-batches and dropout; the global streams are left alone.
        standardise: bring the components to one scale, in which the loss is; "together" by one factor for all.
        device: of torch, to train on; the same seed gives the same fit on a CPU.
        progress_bar: show the epochs.

    Attributes:
        model_: the network, in numpy.
        best_epoch_: the epoch whose weights were kept, the best in validation error (without validation trajectories,
            in training error); 0 is the start, which predicts the mean change.
        history_: arrays, entry 0 the start: "train_error" (on the way through the epoch) and "validation_error" (mean
            over steps of |x_hat - x|^2, standardised, one step ahead; NaN without validation), "seconds" of each epoch.

    Deviations from common practice: a segment starts from the stored state of a pass at the epoch's start, not from
    zeros with a burn-in; targets and inputs have scales of their own, so that any `standardise` trains alike.
    """

    _cell: ClassVar[Cell]

    def __init__(
        self,
        *,
        hidden_size: int = 128,
        n_layers: int = 1,
        residual: bool = True,
        differences: bool = True,
        n_future: int = 1,
        future_weights: FutureWeights = 0.5,
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
        standardise: Standardise = True,
        device: str = "cpu",
        progress_bar: bool = False,
    ) -> None:
        self.hidden_size = hidden_size
        self.n_layers = n_layers
        self.residual = residual
        self.differences = differences
        self.n_future = n_future
        self.future_weights = future_weights
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
        self.standardise = standardise
        self.device = device
        self.progress_bar = progress_bar

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Train and keep the best epoch's weights.

        Where the loss stops being finite, training ends with a `DivergenceWarning` and the best weights until then.

        Args:
            train: trajectories to learn from.
            validation: whole trajectories that choose the epoch and end training. Without them the training error
                does, which does not see overfitting.

        Raises:
            ValueError: no step to learn from, other components in validation, parameters out of range.
            TypeError: not `Sequences`.
        """
        # imports torch, which a fitted filter does without
        from beliefgym.learning import recurrent_training as training

        self._check_parameters()
        self._begin(train, validation)
        if self.n_future > train.lengths.max():
            raise ValueError(
                f"expected n_future of at most the {train.lengths.max()} steps of the longest trajectory, "
                f"got {self.n_future}"
            )
        rng = np.random.default_rng(self.random_state)
        constant = Standardisation.of(train.observations[train.observation_mask]).constant
        z = self._scale.apply(train.observations)
        arrangement = Arrangement.of(
            z, train.lengths, constant, self.n_future, self.residual, self.differences
        )
        examples = training.Examples.of(*arrangement.examples(z, train.lengths), train.lengths, self.device)
        validated = None
        if validation is not None:
            parts = arrangement.examples(self._scale.apply(validation.observations), validation.lengths)
            validated = training.Examples.of(*parts, validation.lengths, self.device)
        scales = arrangement.offset, arrangement.scale
        self._train(examples, validated, *scales, self._weights_of_heads(), rng)
        self._arrangement = arrangement
        self._note_beliefs(train)
        return self

    def _train(
        self,
        examples: Any,
        validated: Any,
        offset: Array,
        scale: Array,
        head_weights: Array,
        rng: np.random.Generator,
    ) -> None:
        """Train a network on `Examples` and take it over; sets `model_`, `history_` and `best_epoch_`.

        Args:
            examples, validated: of `recurrent_training`; validated may be None.
            offset, scale: (k, d) of the targets. head_weights: (k,). rng: of all that is drawn.
        """
        from beliefgym.learning import recurrent_training as training

        n_future, n_outputs = scale.shape
        sizes = (examples.inputs.shape[2], self.hidden_size, self.n_layers, n_future, n_outputs)
        network = training.RecurrentNetwork(self._cell, *sizes, rng).to(self.device)
        plan = training.Plan(**{name: getattr(self, name) for name in training.Plan.__dataclass_fields__})
        loop = training.Training(network, examples, validated, head_weights, np.square(scale), plan, rng)
        loop.run()
        self.history_: dict[str, Array] = {name: np.array(values) for name, values in loop.history.items()}
        self.best_epoch_ = loop.best_epoch
        self.model_: RecurrentModel = network.exported(offset, scale)
        if loop.diverged is not None:
            warnings.warn(
                f"training diverged in epoch {loop.diverged} of {self.n_epochs} (an error that is not finite) and was "
                f"ended; the best weights, of epoch {self.best_epoch_}, are kept. A smaller learning_rate than "
                f"{self.learning_rate:g} or max_gradient_norm than {self.max_gradient_norm} may help",
                DivergenceWarning,
                stacklevel=3,
            )

    def _initial(self) -> Array:
        return np.concatenate([self.model_.initial.ravel(), self._arrangement.first[0], [0.0]])

    def _update(self, belief: Array, z: Array) -> Array:
        size = self.model_.initial.size
        seen = belief[:, -1:]
        u = self._arrangement.inputs(z, (z - belief[:, size:-1]) * seen)
        return np.concatenate([self.model_.step(u, belief[:, :size]), z, np.ones_like(seen)], axis=1)

    def _observe(self, belief: Array) -> Array:
        return self._heads(belief)[:, 0]

    def _forecast(self, belief: Array, horizon: int) -> Array:
        """The heads' predictions, and further on each prediction is taken for the observation that comes."""
        heads = self._heads(belief)[:, :horizon]
        predicted = np.empty((len(belief), horizon, self.n_obs_))
        predicted[:, : heads.shape[1]] = heads
        for step in range(1, horizon):
            belief = self._advance(belief, predicted[:, step - 1])
            if step >= heads.shape[1]:
                predicted[:, step] = self._observe(belief)
        return predicted

    def _heads(self, belief: Array) -> Array:
        """The k next observations that each belief expects: (n, k, d)."""
        size = self.model_.initial.size
        outputs = self.model_.outputs(belief[:, :size]).reshape(len(belief), -1, self.n_obs_)
        if self._arrangement.residual:
            outputs = outputs + belief[:, None, size:-1]
        expected: Array = np.where(belief[:, -1, None, None] > 0.5, outputs, self._arrangement.first)
        return expected

    def _weights_of_heads(self) -> Array:
        """(k,) w_j, of sum 1."""
        beta = 1.0 if isinstance(self.future_weights, str) else self.future_weights
        weights: Array = beta ** np.arange(self.n_future, dtype=float)
        return weights / weights.sum()

    def _check_parameters(self) -> None:
        whole = {"hidden_size": 1, "n_layers": 1, "n_future": 1, "n_epochs": 0, "batch_size": 1}
        optional = {"segment_length": 1, "patience": 1}
        for name, least in (whole | optional).items():
            value = getattr(self, name)
            if not (name in optional and value is None):
                check_whole(name, value, least)
        for name in ("learning_rate", "max_gradient_norm", "max_seconds"):
            value = getattr(self, name)
            left_out = value is None and name != "learning_rate"
            if not left_out and (value is None or not value > 0):
                raise ValueError(f"expected {name} above 0, got {value!r}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"expected dropout in [0, 1), got {self.dropout!r}")
        if not self.weight_decay >= 0:
            raise ValueError(f"expected weight_decay of at least 0, got {self.weight_decay!r}")
        beta: Any = self.future_weights
        if beta != "uniform" and (isinstance(beta, str) or not 0 < beta <= 1):
            raise ValueError(f"expected future_weights to be 'uniform' or a number in (0, 1], got {beta!r}")


class GRUFilter(RecurrentFilter):
    """A network of gated recurrent units as a filter.

    Args and attributes as of `RecurrentFilter`.

    Example:
        >>> errors = GRUFilter(random_state=0).fit(train, validation).errors(test)  # doctest: +SKIP
    """

    _cell = "gru"


class LSTMFilter(RecurrentFilter):
    """A network of long short-term memory as a filter.

    Args and attributes as of `RecurrentFilter`.
    """

    _cell = "lstm"
