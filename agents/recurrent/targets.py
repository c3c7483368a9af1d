"""What action values are fitted to: bootstrapped returns along pieces of episodes.

All arrays are (n_pieces, n_steps). Step t was taken in slot t and led to slot t + 1, whose value is V_{t+1}: that of
the action that was taken there (SARSA), the expectation over the policy, or the largest. d_t = gamma (1 -
terminated_t), so that a termination has no value after it, and a truncation, or the end of a piece, has.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def lambda_returns(
    rewards: Tensor, discounts: Tensor, values: Tensor, weights: Tensor, anchors: Tensor
) -> Tensor:
    """Returns with traces, backwards through time.

        G_t = r_t + d_t [V_{t+1} + w_{t+1} (G_{t+1} - A_{t+1})]

    With w = lambda: SARSA(lambda) where V = A = Q(x, a); the lambda-returns of PQN where V = A = max_a Q(x, a);
    with w = lambda min(1, pi / mu), V = E_pi Q and A = Q(x, a): Retrace(lambda).

    Args:
        rewards, discounts: r_t, d_t. values: V_{t+1} at t. weights: w_{t+1} at t, 0 at a piece's last step.
        anchors: A_{t+1} at t.

    Returns:
        G_t, (n_pieces, n_steps).

    Reference: Sutton and Barto 2018, Sec. 12.7; Munos et al. 2016; Gallici et al. 2024.
    """
    fixed = rewards + discounts * (values - weights * anchors)
    carried = discounts * weights
    following, returns = torch.zeros_like(fixed[:, 0]), []
    for fixed_t, carried_t in zip(reversed(fixed.unbind(1)), reversed(carried.unbind(1)), strict=True):
        following = torch.addcmul(fixed_t, carried_t, following)
        returns.append(following)
    return torch.stack(returns[::-1], dim=1)


def n_step_returns(
    rewards: Tensor, discounts: Tensor, values: Tensor, is_last: Tensor, n_steps: int
) -> list[Tensor]:
    """The targets of n + 1 steps, n = 0, ..., k, through which gradients flow.

        y_t^n = sum_{i=0}^{n} gamma^i r_{t+i} + gamma^{n+1} V_{t+n+1}

    Past the last step of a piece there is nothing, so that a longer sum is the one to its end.

    Args:
        rewards, discounts, values: as in `lambda_returns`. is_last: True at the last step of a piece.
        n_steps: k, at least 0.

    Returns:
        k + 1 arrays y^0, ..., y^k, each (n_pieces, n_steps).

    Reference: thesis proposal, Sec. 4.3.1, the n-step residuals (its Q_{t+n+1}(x_{t+1}, ..) is put right: the value is
    that of x_{t+n+1}).
    """
    targets = [rewards + discounts * values]
    for _ in range(n_steps):
        shorter = torch.cat([targets[-1][:, 1:], values[:, -1:]], dim=1)
        targets.append(rewards + discounts * torch.where(is_last, values, shorter))
    return targets


def step_weights(n_steps: int, weights: Sequence[float] | float) -> list[float]:
    """The weight of each of k + 1 residuals, summing to 1.

    Args:
        n_steps: k. weights: k + 1 of them, or lambda for weights proportional to lambda^n.

    Raises:
        ValueError: another number of weights, or some that are negative or all zero.
    """
    given = [weights**n for n in range(n_steps + 1)] if isinstance(weights, float | int) else list(weights)
    if len(given) != n_steps + 1 or min(given) < 0 or sum(given) <= 0:
        raise ValueError(
            f"expected lambda, or {n_steps + 1} weights of at least 0 for the residuals of 1 to {n_steps + 1} steps, "
            f"got {weights!r}"
        )
    return [float(w) / float(sum(given)) for w in given]


def lambda_weights(n_steps: int, decay: float) -> list[float]:
    """Those of the lambda-return: (1 - lambda) lambda^n for n < k, and lambda^k for the longest.

    In a piece of fewer than k steps all sums past its end are the one to its end, so that its weights are right too.
    """
    return [(1.0 - decay) * decay**n for n in range(n_steps)] + [decay**n_steps]
