"""GRU and LSTM cells in numpy, one step at a time: what a trained recurrent filter runs on, without torch.

    GRU     r, k = sigma(..),  n = tanh(W_n u + b_n + r (V_n h + c_n)),  h' = n + k (h - n)
    LSTM    i, f, o = sigma(..),  c' = f c + i tanh(W_g u + V_g h + b_g),  h' = o tanh(c')

where each gate is sigma(W u + b + V h + c) of its own weights. Gates stand in torch's order: r, k, n and i, f, g, o.

References: Cho et al., "Learning phrase representations using RNN encoder-decoder for statistical machine translation",
EMNLP 2014, with the reset gate after the product as torch has it; Gers, Schmidhuber & Cummins, "Learning to forget",
Neural Computation 12, 2000.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

Array = NDArray[np.float64]
Cell = Literal["gru", "lstm"]


@dataclass(frozen=True, eq=False)
class Layer:
    """Weights of one layer; gates = their number times hidden_size.

    Attributes:
        from_input: (n_inputs, gates). from_hidden: (hidden_size, gates). input_bias, hidden_bias: (gates,).
    """

    from_input: Array
    from_hidden: Array
    input_bias: Array
    hidden_bias: Array


def gru_step(layer: Layer, u: Array, state: Array) -> Array:
    """The next state, from inputs (n, n_inputs) and the state h (n, hidden_size)."""
    size = state.shape[1]
    a, b = u @ layer.from_input + layer.input_bias, state @ layer.from_hidden + layer.hidden_bias
    gates = expit(a[:, : 2 * size] + b[:, : 2 * size])
    new = np.tanh(a[:, 2 * size :] + gates[:, :size] * b[:, 2 * size :])
    following: Array = new + gates[:, size:] * (state - new)
    return following


def lstm_step(layer: Layer, u: Array, state: Array) -> Array:
    """The next state, from inputs (n, n_inputs) and the state h, c (n, 2 hidden_size)."""
    size = state.shape[1] // 2
    a = u @ layer.from_input + state[:, :size] @ layer.from_hidden + (layer.input_bias + layer.hidden_bias)
    into, forget, out = expit(a[:, :size]), expit(a[:, size : 2 * size]), expit(a[:, 3 * size :])
    c = forget * state[:, size:] + into * np.tanh(a[:, 2 * size : 3 * size])
    return np.concatenate([out * np.tanh(c), c], axis=1)


STEPS: dict[str, Callable[[Layer, Array, Array], Array]] = {"gru": gru_step, "lstm": lstm_step}


@dataclass(frozen=True, eq=False)
class RecurrentModel:
    """A trained network: cells and a linear read-out.

    Attributes:
        cell: "gru" or "lstm". layers: first to last. hidden_size: numbers in h.
        initial: (n_layers, size of a layer's state) before anything was seen.
        read_out: (hidden_size, n_outputs). offset: (n_outputs,).
    """

    cell: Cell
    layers: tuple[Layer, ...]
    hidden_size: int
    initial: Array
    read_out: Array
    offset: Array

    def step(self, u: Array, state: Array) -> Array:
        """Inputs (n, n_inputs) and the states of all layers (n, initial.size) -> the states after them."""
        step, following = STEPS[self.cell], []
        for layer, own in zip(self.layers, np.split(state, len(self.layers), axis=1), strict=True):
            following.append(step(layer, u, own))
            u = following[-1][:, : self.hidden_size]
        return following[0] if len(following) == 1 else np.concatenate(following, axis=1)

    def outputs(self, state: Array) -> Array:
        """W h + b of the last layer: (n, initial.size) -> (n, n_outputs)."""
        first = state.shape[1] - self.initial.shape[1]
        output: Array = state[:, first : first + self.hidden_size] @ self.read_out + self.offset
        return output
