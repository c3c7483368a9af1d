"""Pieces of rollouts that lie within one episode, padded to one length.

A rollout is a batch of rows (n, n_steps) in TorchRL's layout: several episodes may end and begin in a row (`is_init`),
and what followed a step stands under "next": at an episode's end, the last observation, which no row of the batch
shows. A recurrent network has to go through every episode from its own start and has to see its last observation too,
since an episode that was cut (truncated) is not over. So rows are cut where episodes begin, every piece gets one more
slot for what followed its last step, and the pieces are padded: a network then runs over (n_pieces, n_steps' + 1) with
no reset inside, and the value after step t is always that of slot t + 1.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


class Segments:
    """Where the pieces of a batch of rows lie.

    Args:
        is_init: (n, n_steps) bool, True where an episode begins. valid: (n, n_steps) bool, False for padding at
            the end of rows; None for no padding.

    Attributes:
        rows: (n_pieces,) the row that each piece lies in. starts: (n_pieces,) its first step in that row.
        lengths: (n_pieces,) its steps. mask: (n_pieces, longest) bool, True at the steps that exist.
        fresh: (n_pieces,) bool, True where the piece begins with an episode.

    Raises:
        ValueError: arrays of other shapes, or padding in front of steps.
    """

    def __init__(self, is_init: Tensor, valid: Tensor | None = None) -> None:
        if is_init.ndim != 2 or is_init.dtype != torch.bool:
            raise ValueError(
                f"expected is_init as bool (n, n_steps), got {is_init.dtype} {tuple(is_init.shape)}"
            )
        n, n_steps = is_init.shape
        begins = is_init.clone()
        begins[:, 0] = True
        if valid is not None:
            if valid.shape != is_init.shape:
                raise ValueError(f"expected a mask of shape {(n, n_steps)}, got {tuple(valid.shape)}")
            if (valid[:, 1:] & ~valid[:, :-1]).any():
                raise ValueError("expected padding at the end of rows only, got steps after padding")
            begins &= valid
        first = begins.flatten().nonzero()[:, 0]
        n_valid = torch.full((n,), n_steps, device=is_init.device) if valid is None else valid.sum(1)
        self.rows, self.starts = first // n_steps, first % n_steps
        row_end = self.rows * n_steps + n_valid[self.rows]
        following = torch.cat([first[1:], row_end[-1:]])
        self.lengths = torch.minimum(following, row_end) - first
        self.fresh = is_init.flatten()[first]
        longest = int(self.lengths.max()) if len(first) else 0
        slot = torch.arange(longest + 1, device=is_init.device)
        self.mask = slot[:-1] < self.lengths[:, None]
        last = first + self.lengths - 1
        self._size = n * n_steps
        self._steps = torch.minimum(first[:, None] + slot[:-1], last[:, None])
        inside = slot < self.lengths[:, None]
        self._slots = torch.where(inside, first[:, None] + slot, self._size + last[:, None])
        self.is_last = slot[:-1] == self.lengths[:, None] - 1

    def __len__(self) -> int:
        return len(self.rows)

    def steps(self, x: Tensor) -> Tensor:
        """(n, n_steps, ...) -> (n_pieces, longest, ...); past a piece's end its last step is repeated."""
        return x.flatten(0, 1)[self._steps]

    def slots(self, x: Tensor, following: Tensor) -> Tensor:
        """The same with one slot more: x along the piece, then what followed its last step."""
        return torch.cat([x.flatten(0, 1), following.flatten(0, 1)])[self._slots]

    def back(self, pieces: Tensor) -> Tensor:
        """(n_pieces, longest, ...) -> (n_steps of all pieces, ...) in the order of the rows: the reverse of `steps`."""
        return pieces[self.mask]


def batch_segments(batch: TensorDictBase, is_init: NestedKey, mask: NestedKey) -> Segments:
    """The pieces of a batch (n, n_steps), from its flags (n, n_steps) or (n, n_steps, 1) under these keys.

    Raises:
        ValueError: a mask that is False at every step; see also `Segments`.
    """
    pieces = Segments(*(_flag(batch.get(key, None)) for key in (is_init, mask)))
    if len(pieces) == 0:
        raise ValueError(
            f"expected at least one step that exists, got {mask!r} False at all of {tuple(batch.shape)} steps: leave "
            "such a batch out, or set the mask True at the steps that were recorded"
        )
    return pieces


def _flag(flag: Tensor | None) -> Any:
    return flag if flag is None or flag.ndim == 2 else flag[..., 0]
