"""What a network remembers: cells that run over whole pieces of episodes, with their state as one vector.

A state (n, state_size) is h of a GRU, [h, c] of an LSTM, nothing where there is no memory. PyTorch's own layers run
(on a processor its LSTM is the faster by far); a cell of one's own is a `Memory` with another `forward`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn


class Memory(nn.Module, ABC):
    """Base class.

    Args:
        input_size, hidden_size: sizes of an input and of what the rest of the network sees of the memory.
        state_size: size of the state.
    """

    def __init__(self, input_size: int, hidden_size: int, state_size: int) -> None:
        super().__init__()
        self.input_size, self.hidden_size, self.state_size = input_size, hidden_size, state_size

    @abstractmethod
    def forward(self, inputs: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Along sequences.

        Args:
            inputs: (n, n_steps, input_size). state: (n, state_size) before the first step.

        Returns:
            hidden (n, n_steps, hidden_size), and the state after the last step.
        """


class LSTM(Memory):
    """One layer of `torch.nn.LSTM`; the state is [h, c]."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size, 2 * hidden_size)
        self.layer = nn.LSTM(input_size, hidden_size, batch_first=True)

    def forward(self, inputs: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """See `Memory.forward`."""
        h, c = (part.contiguous() for part in state[None].chunk(2, dim=-1))
        hidden, (h, c) = self.layer(inputs, (h, c))
        return hidden, torch.cat([h[0], c[0]], dim=-1)


class GRU(Memory):
    """One layer of `torch.nn.GRU`; the state is h."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size, hidden_size)
        self.layer = nn.GRU(input_size, hidden_size, batch_first=True)

    def forward(self, inputs: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """See `Memory.forward`."""
        hidden, state = self.layer(inputs, state[None].contiguous())
        return hidden, state[0]


class NoMemory(Memory):
    """No recurrence: one linear layer with a ReLU on the present input, for feed-forward rivals."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__(input_size, hidden_size, 0)
        self.layer = nn.Sequential(nn.Linear(input_size, hidden_size), nn.LayerNorm(hidden_size), nn.ReLU())

    def forward(self, inputs: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """See `Memory.forward`."""
        hidden: Tensor = self.layer(inputs)
        return hidden, state


MEMORIES: dict[str, Callable[[int, int], Memory]] = {"lstm": LSTM, "gru": GRU, "none": NoMemory}


def make_memory(cell: str | Callable[[int, int], Memory], input_size: int, hidden_size: int) -> Memory:
    """A memory by name, or of a class of one's own, which is called with the two sizes.

    Raises:
        ValueError: an unknown name. TypeError: something that is no `Memory`.
    """
    if isinstance(cell, str):
        if cell not in MEMORIES:
            raise ValueError(
                f"expected cell to be one of {', '.join(MEMORIES)}, or a class of your own, got {cell!r}"
            )
        return MEMORIES[cell](input_size, hidden_size)
    memory = cell(input_size, hidden_size) if callable(cell) else cell
    if not isinstance(memory, Memory):
        raise TypeError(f"expected a cell as a name or a subclass of Memory, got {cell!r}")
    return memory
