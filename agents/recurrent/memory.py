"""What a network remembers: cells that run over whole pieces of episodes, with their state as one vector.

A state (n, state_size) is h of a GRU, [h, c] of an LSTM, the last inputs of a stack, nothing where there is no memory.
PyTorch's own layers run (on a processor its LSTM is the faster by far); a cell of one's own is a `Memory` with another
`forward`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial

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


class Stack(Memory):
    """No recurrence: `NoMemory` on the last n inputs (frames) side by side, zeros before an episode's start.

    Args:
        input_size, hidden_size: see `Memory`. n_frames: n, the present one among them.

    Raises:
        ValueError: fewer than 2 frames.

    Reference: Mnih et al. 2015, the preprocessing phi of the last 4 frames.
    """

    def __init__(self, input_size: int, hidden_size: int, n_frames: int) -> None:
        if n_frames < 2:
            raise ValueError(f'expected a stack of at least 2 frames, got {n_frames}; "none" is that of 1')
        super().__init__(input_size, hidden_size, (n_frames - 1) * input_size)
        self.n_frames = n_frames
        self.layer = NoMemory(n_frames * input_size, hidden_size)

    def forward(self, inputs: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """See `Memory.forward`; the state is the last n - 1 inputs, oldest first."""
        frames = torch.cat([state.view(len(state), self.n_frames - 1, self.input_size), inputs], dim=1)
        stacked = frames.unfold(1, self.n_frames, 1).transpose(2, 3).flatten(2)
        hidden, _ = self.layer(stacked, state)
        return hidden, frames[:, 1 - self.n_frames :].flatten(1)


MEMORIES: dict[str, Callable[[int, int], Memory]] = {
    "lstm": LSTM,
    "gru": GRU,
    "none": NoMemory,
    **{f"stack{n}": partial(Stack, n_frames=n) for n in (2, 4, 8)},
}


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
