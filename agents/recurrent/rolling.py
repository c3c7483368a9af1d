"""The state that a network comes to over episodes of different lengths, in as few calls as there are lengths."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from beliefgym.agents.recurrent.network import HistoryEncoder


@torch.no_grad()
def final_states(encoder: HistoryEncoder, inputs: Sequence[Tensor], lengths: Tensor, first: Tensor) -> Tensor:
    """States after the last step of every row.

    All rows end together: the longest begins, and others join it where they begin. So nothing is padded, and a memory
    that tells its state only at the end of a call (as PyTorch's do) is enough.

    Args:
        encoder: whose states are wanted.
        inputs: observations, previous actions and previous rewards, (n, n_steps, size) each; of row i the last
            lengths[i] steps count.
        lengths: (n,) whole numbers, 0 for rows that have not begun.
        first: (n, state_size) the state of every row before the first step that counts.

    Returns:
        (n, state_size).
    """
    longest = int(lengths.max())
    order = torch.argsort(lengths, descending=True, stable=True)
    ordered = lengths[order]
    states = first[order]
    joins = sorted({longest - int(length) for length in ordered if length > 0} | {longest})
    for begin, end in pairwise(joins):
        n = int((ordered >= longest - begin).sum())  # rows that have begun
        past = inputs[0].shape[1] - longest
        now = [x[order[:n], past + begin : past + end] for x in inputs]
        _, states[:n] = encoder(*now, states[:n])
    answer = torch.empty_like(states)
    answer[order] = states
    return answer


def states_after_rows(
    encoder: HistoryEncoder, inputs: Sequence[Tensor], is_init: Tensor, first: Tensor
) -> Tensor:
    """States after the last step of rows in which episodes may begin anywhere.

    Args:
        encoder, inputs: see `final_states`. is_init: (n, n_steps) bool, where an episode begins.
        first: (n, state_size) the state before each row, which counts where no episode begins in it.

    Returns:
        (n, state_size).
    """
    n_steps = is_init.shape[1]
    begins = torch.where(is_init, torch.arange(n_steps, device=is_init.device), -1).max(dim=1).values
    before = torch.where((begins < 0)[:, None], first, 0.0)
    return final_states(encoder, inputs, n_steps - begins.clamp(min=0), before)
