"""From action values to a policy: Eq. 4.18's arg max, softened and with exploration."""

from __future__ import annotations

import torch
from torch import Tensor


def action_probabilities(values: Tensor, epsilon: float = 0.0, temperature: float = 0.0) -> Tensor:
    """pi(a | x) = (1 - epsilon) softmax_a(Q(x, a) / temperature) + epsilon / n_actions.

    Args:
        values: (..., n_actions). epsilon: share of uniform actions. temperature: 0 for arg max, the first of equals.

    Returns:
        (..., n_actions), summing to 1; gradients do not pass.

    Reference: thesis proposal, Eq. 4.18 and the soft-max in its place (Sec. 4.3.1).
    """
    values = values.detach()
    if temperature > 0.0:
        greedy = torch.softmax(values / temperature, dim=-1)
    else:
        greedy = torch.nn.functional.one_hot(values.argmax(-1), values.shape[-1]).to(values.dtype)
    return greedy if epsilon == 0.0 else (1.0 - epsilon) * greedy + epsilon / values.shape[-1]
