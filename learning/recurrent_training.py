"""Training a recurrent network to predict the next observations: `Examples`, `RecurrentNetwork`, `Training`.

With inputs u_t and targets y_{t,j} of `recurrent_filter` (what x_{t+j} holds that is not known beforehand, at scale 1),

    h_t = cell(h_{t-1}, u_t),      min  sum_{j=1}^{k} w_j  mean_{t, i}  sum_c v_{jc} (W_j h_t + b_j - y_{t,j})_c^2

over all steps i, t whose x_{t+j} lies inside its episode, by Adam (with decoupled weight decay, gradients clipped,
the step size falling along a cosine) on segments of `segment_length` steps: truncated backpropagation through time.
A segment starts from the state that the network of the epoch's start has there, held fixed; where segments begin is
drawn anew each epoch. That costs a pass without gradients an epoch, and unlike a burn-in no step is gone through twice
with gradients.

References: Williams & Peng, "An efficient gradient-based algorithm for on-line training of recurrent network
trajectories", Neural Computation 2, 1990 (truncation); Kapturowski et al., "Recurrent experience replay in distributed
reinforcement learning", ICLR 2019 (stored states); Loshchilov & Hutter, "Decoupled weight decay regularization", ICLR
2019; Pascanu, Mikolov & Bengio, "On the difficulty of training recurrent neural networks", ICML 2013 (clipping).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from beliefgym.learning.recurrent_cells import Cell, Layer, RecurrentModel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
State = tuple[Tensor, ...]  # (n_layers, n, hidden_size) each: h, and c of an LSTM
# torch's module, its number of gates and of states
CELLS: dict[Cell, tuple[type[nn.GRU] | type[nn.LSTM], int, int]] = {
    "gru": (nn.GRU, 3, 1),
    "lstm": (nn.LSTM, 4, 2),
}
BLOCK_NUMBERS = 2**23  # in the gates of one pass without gradients; more trajectories go block by block


@dataclass(frozen=True, eq=False)
class Examples:
    """Trajectories as the network sees them, of n_steps = the longest's steps.

    Attributes:
        inputs: (n_steps, n, n_inputs) u_t. targets: (n_steps, n, k, d) y_{t,j}. inside: (n_steps, n, k) 1 where x_{t+j}
            lies inside its episode, 0 elsewhere. lengths: (n,) steps.
    """

    inputs: Tensor
    targets: Tensor
    inside: Tensor
    lengths: Indices

    @classmethod
    def of(
        cls, inputs: Array, targets: Array, lengths: Indices, device: str, dtype: torch.dtype = torch.float32
    ) -> Examples:
        """From (n, n_steps, n_inputs), (n, n_steps, k, d) and (n,)."""
        n_steps, k = targets.shape[1:3]
        inside = np.arange(n_steps)[:, None, None] + 1 + np.arange(k) <= lengths[:, None]
        u, y = (
            torch.as_tensor(np.ascontiguousarray(a.swapaxes(0, 1)), dtype=dtype, device=device)
            for a in (inputs, targets)
        )
        return cls(u, y, torch.as_tensor(inside, dtype=dtype, device=device), lengths)


class RecurrentNetwork(nn.Module):
    """A recurrent cell, its learned initial state, and a linear read-out of k heads.

    Recurrent weights start orthogonal, input weights uniform after Glorot & Bengio (AISTATS 2010), the read-out and the
    initial state at 0, an LSTM's forget gate open (bias 1).

    Args:
        cell: "gru" or "lstm". n_inputs, hidden_size, n_layers: sizes. n_future: k. n_outputs: d.
        rng: of the initial weights.
    """

    def __init__(
        self,
        cell: Cell,
        n_inputs: int,
        hidden_size: int,
        n_layers: int,
        n_future: int,
        n_outputs: int,
        rng: np.random.Generator,
    ) -> None:
        super().__init__()
        self.kind = cell
        kind, self.n_gates, self.n_states = CELLS[cell]
        with torch.random.fork_rng(devices=[]):  # modules draw from the global stream when they are made
            self.cell = kind(n_inputs, hidden_size, n_layers)
            self.read_out = nn.Linear(hidden_size, n_future * n_outputs)
        self.initial = nn.Parameter(torch.zeros(self.n_states, n_layers, hidden_size))
        self.n_future, self.n_outputs = n_future, n_outputs
        with torch.no_grad():
            for name, weights in self.cell.named_parameters():
                for gate, part in enumerate(weights.chunk(self.n_gates)):
                    if name.startswith("bias"):
                        part.fill_(float(cell == "lstm" and gate == 1 and name.startswith("bias_ih")))
                        continue
                    shape = tuple(part.shape)
                    if name.startswith("weight_hh"):
                        values = np.linalg.qr(rng.standard_normal(shape))[0]
                    else:
                        bound = np.sqrt(6.0 / sum(shape))
                        values = rng.uniform(-bound, bound, shape)
                    part.copy_(torch.as_tensor(values))
            self.read_out.weight.zero_()
            self.read_out.bias.zero_()

    def start(self, n: int) -> State:
        """The initial state, n times."""
        return tuple(s[:, None].expand(-1, n, -1) for s in self.initial)

    def run(self, inputs: Tensor, state: State) -> tuple[Tensor, State]:
        """(n_steps, n, n_inputs) -> the last layer's h_t (n_steps, n, hidden_size) and the state after the last."""
        whole = tuple(s.contiguous() for s in state)
        hidden, after = self.cell(inputs, whole if self.n_states > 1 else whole[0])
        return hidden, after if self.n_states > 1 else (after,)

    def heads(self, hidden: Tensor) -> Tensor:
        """W_j h + b_j: (..., hidden_size) -> (..., k, d)."""
        outputs: Tensor = self.read_out(hidden)
        return outputs.unflatten(-1, (self.n_future, self.n_outputs))

    def exported(self, offset: Array, scale: Array) -> RecurrentModel:
        """In numpy, with outputs offset + scale * heads; offset and scale (k, d)."""
        values = {
            name: value.detach().cpu().numpy().astype(np.float64) for name, value in self.state_dict().items()
        }
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        layers = [
            Layer(*(np.ascontiguousarray(values[f"cell.{name}_l{i}"].T) for name in names))
            for i in range(self.cell.num_layers)
        ]
        initial = values["initial"].swapaxes(0, 1).reshape(len(layers), -1)
        read_out = np.ascontiguousarray(values["read_out.weight"].T * scale.ravel())
        shift = offset.ravel() + scale.ravel() * values["read_out.bias"]
        return RecurrentModel(self.kind, tuple(layers), self.cell.hidden_size, initial, read_out, shift)


def head_errors(predicted: Tensor, targets: Tensor, inside: Tensor, weights: Tensor) -> Tensor:
    """(k,) sum over steps inside of sum_c v_{jc} (predicted - target)_c^2."""
    return ((predicted - targets).square() * weights).sum(-1).mul(inside).sum((0, 1))


def loss_of(errors: Tensor, inside: Tensor, head_weights: Tensor) -> Tensor:
    """The loss of a mini-batch, from `head_errors` (k,) and w (k,)."""
    return (head_weights * errors / inside.sum((0, 1)).clamp(min=1.0)).sum()


def evaluate(network: RecurrentNetwork, examples: Examples, weights: Tensor) -> float:
    """The first head's mean error over all steps, sum_c v_{1c} (..)_c^2, from the initial state."""
    total = 0.0
    with torch.no_grad():
        for block in blocks(network, examples, examples.inputs.shape[0]):
            hidden, _ = network.run(examples.inputs[:, block], network.start(len(block)))
            parts = head_errors(
                network.heads(hidden), examples.targets[:, block], examples.inside[:, block], weights
            )
            total += float(parts[0])
    return total / float(examples.lengths.sum())


def blocks(network: RecurrentNetwork, examples: Examples, n_steps: int) -> Iterator[Indices]:
    """Trajectories in blocks whose gates fit into memory."""
    n = len(examples.lengths)
    size = max(1, BLOCK_NUMBERS // (n_steps * network.n_gates * network.initial.shape[-1]))
    return iter(np.array_split(np.arange(n), -(-n // size)))


def states_at(network: RecurrentNetwork, examples: Examples, cuts: Indices) -> list[State]:
    """The state before each of the times in `cuts`, which ascend from 0: (n_layers, n, hidden_size) each."""
    found: list[list[State]] = []
    with torch.no_grad():
        longest = int(np.diff(cuts, append=cuts[-1] + 1).max())
        for block in blocks(network, examples, longest):
            state = network.start(len(block))
            found.append([state])
            for begin, end in pairwise(cuts):
                _, state = network.run(examples.inputs[begin:end, block], state)
                found[-1].append(state)
    return [tuple(torch.cat(parts, 1) for parts in zip(*at, strict=True)) for at in zip(*found, strict=True)]


def segment_batches(
    network: RecurrentNetwork,
    examples: Examples,
    segment_length: int | None,
    batch_size: int,
    rng: np.random.Generator,
) -> Iterator[tuple[tuple[Tensor, Tensor, Tensor], State]]:
    """Mini-batches of one epoch: every step of every trajectory once, with the state that each segment starts from."""
    n_steps, device = examples.inputs.shape[0], examples.inputs.device
    size = n_steps if segment_length is None or n_steps <= 2 * segment_length else segment_length
    first = size if size == n_steps else int(rng.integers(1, size + 1))
    cuts = np.array([0, *range(first, n_steps, size)])
    ends = np.append(cuts[1:], n_steps)
    stored = states_at(network, examples, cuts)
    piece, episode = np.nonzero(examples.lengths > cuts[:, None])
    order = rng.permutation(len(piece))
    # (pieces, n_layers, n, hidden_size) each
    states = [torch.stack([s[i] for s in stored]) for i in range(network.n_states)]
    for i in range(0, len(order), batch_size):
        p, e = piece[order[i : i + batch_size]], episode[order[i : i + batch_size]]
        rows = cuts[p] + np.arange(int((ends[p] - cuts[p]).max()))[:, None]
        outside = torch.as_tensor(rows >= ends[p], device=device)
        rows = np.minimum(rows, n_steps - 1)
        inside = examples.inside[rows, e].masked_fill(outside[..., None], 0.0)
        begins = torch.as_tensor(p == 0, device=device)[None, :, None]  # there the initial state learns
        state = tuple(
            torch.where(begins, s, kept[p, :, e].transpose(0, 1))
            for s, kept in zip(network.start(len(e)), states, strict=True)
        )
        yield (examples.inputs[rows, e], examples.targets[rows, e], inside), state


@dataclass(frozen=True)
class Plan:
    """How to train; see `RecurrentFilter` for each."""

    learning_rate: float
    n_epochs: int
    batch_size: int
    segment_length: int | None
    max_gradient_norm: float | None
    weight_decay: float
    dropout: float
    patience: int | None
    max_seconds: float | None
    progress_bar: bool


class Training:
    """Trains a network in place; it ends with the best epoch's weights.

    Args:
        network: to train. examples: to learn from. validation: to choose the epoch by; None for the training error.
        head_weights: (k,) w_j. component_weights: (k, d) v_{jc}.
        plan: how. rng: of segments, mini-batches and dropout.

    Attributes:
        history: of each epoch, the start first: "train_error", "validation_error" and "seconds".
        best_epoch: the one kept. diverged: the epoch that ended in a loss that is not finite; None without.
    """

    def __init__(
        self,
        network: RecurrentNetwork,
        examples: Examples,
        validation: Examples | None,
        head_weights: Array,
        component_weights: Array,
        plan: Plan,
        rng: np.random.Generator,
    ) -> None:
        self._network, self._examples, self._validation = network, examples, validation
        self._plan, self._rng = plan, rng
        self._components = self._tensor(component_weights)
        # an untrained head's loss is then about w_j in any units, and clipping means the same for all data
        power = component_weights.sum(axis=1)
        self._heads = self._tensor(head_weights / np.where(power > 0, power, 1.0))
        decayed: list[nn.Parameter] = []
        free: list[nn.Parameter] = []
        for name, parameter in network.named_parameters():
            (decayed if "weight" in name else free).append(parameter)
        self._optimiser = torch.optim.AdamW(
            [
                {"params": decayed, "weight_decay": plan.weight_decay},
                {"params": free, "weight_decay": 0.0},
            ],
            lr=plan.learning_rate,
        )
        self._n_steps = float(examples.lengths.sum())
        self.history: dict[str, list[float]] = {"train_error": [], "validation_error": [], "seconds": []}
        self.best_epoch, self.diverged = 0, None

    def run(self) -> None:
        """Train for the plan's epochs, or until time or patience are spent or the loss is not finite."""
        plan = self._plan
        self._started = begun = time.perf_counter()
        best = np.inf
        for epoch in tqdm(range(plan.n_epochs + 1), desc="epochs", disable=not plan.progress_bar):
            error = self._epoch(epoch) if epoch else evaluate(self._network, self._examples, self._components)
            validation = np.nan
            if self._validation is not None:
                validation = evaluate(self._network, self._validation, self._components)
            criterion = error if self._validation is None else validation
            if not np.isfinite([error, criterion]).all():
                self.diverged = epoch
            self.history["train_error"].append(error)
            self.history["validation_error"].append(validation)
            self.history["seconds"].append(time.perf_counter() - begun)
            begun = time.perf_counter()
            if epoch == 0 or (criterion < best and self.diverged is None):
                best, self.best_epoch = criterion, epoch
                kept = {name: value.clone() for name, value in self._network.state_dict().items()}
            waited = plan.patience is not None and epoch - self.best_epoch >= plan.patience
            if self.diverged is not None or waited or self._share_of_time() >= 1.0:
                break
        self._network.load_state_dict(kept)

    def _epoch(self, epoch: int) -> float:
        """Go once over all steps; the error on the way, with the weights as they were."""
        network, plan = self._network, self._plan
        total = counted = 0.0
        batches = segment_batches(network, self._examples, plan.segment_length, plan.batch_size, self._rng)
        for (inputs, targets, inside), state in batches:
            progress = max((epoch - 1 + counted / self._n_steps) / plan.n_epochs, self._share_of_time())
            for group in self._optimiser.param_groups:
                group["lr"] = 0.5 * plan.learning_rate * (1.0 + np.cos(np.pi * min(progress, 1.0)))
            hidden, _ = network.run(inputs, state)
            if plan.dropout:
                kept = self._rng.random(hidden.shape[1:]) >= plan.dropout  # for all steps of a segment
                hidden = hidden * self._tensor(kept / (1.0 - plan.dropout))
            errors = head_errors(network.heads(hidden), targets, inside, self._components)
            loss = loss_of(errors, inside, self._heads)
            self._optimiser.zero_grad()
            loss.backward()
            longest = np.inf if plan.max_gradient_norm is None else plan.max_gradient_norm
            norm = nn.utils.clip_grad_norm_(network.parameters(), longest)
            total += float(errors[0].detach())
            counted += float(inside[..., 0].sum())
            if not (np.isfinite(total) and np.isfinite(float(norm))):
                return float("nan")
            self._optimiser.step()
            if self._share_of_time() >= 1.0:
                break
        finite = all(bool(torch.isfinite(parameter).all()) for parameter in network.parameters())
        return total / counted if finite else float("nan")

    def _tensor(self, array: Array) -> Tensor:
        like = self._examples.inputs
        return torch.as_tensor(array, dtype=like.dtype, device=like.device)

    def _share_of_time(self) -> float:
        limit = self._plan.max_seconds
        return 0.0 if limit is None else (time.perf_counter() - self._started) / limit
