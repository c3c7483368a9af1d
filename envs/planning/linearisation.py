"""Exact derivatives of a system's dynamics and costs, for a whole batch at once.

The dynamics f(s, u) are linearised at every row of a batch,

    A = df/ds,   B = df/du,      f(s + ds, u + du) = f(s, u) + A ds + B du + O(2),

by reverse-mode differentiation. A system acts on each row by itself, so the gradient of one output component,
summed over the rows, holds that row of every Jacobian: n backward passes for the whole batch. (On a CPU this is
about three times as fast as n + m forward passes of `torch.func.jvp`, which go through Python for each product.)
A small batch is repeated n times and each copy asked for another component: one backward pass, whose operations are
then large enough to be worth their calls.
All in float64; torch's threads are left as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.planning.learned_model import PlanningModel

Floats = NDArray[np.float64]
ROWS_AT_ONCE = 4096  # more than this are differentiated component by component


def linearise(system: PlanningModel, state: ArrayLike, action: ArrayLike) -> tuple[Floats, Floats]:
    """The Jacobians of `system.flow`, which is a step without noise and inside the action limits.

    Args:
        system: a `System` or another model; it gives its own `derivatives`, or its `flow` runs on torch.
        state: (..., n).
        action: (..., m), same leading shape.

    Returns:
        A (..., n, n) and B (..., n, m), with A[..., i, j] = d f_i / d s_j.

    Raises:
        ValueError: shapes that do not fit the system, or a derivative that is not finite.
    """
    s, u = _rows(system, state, action)
    n, m = s.shape[-1], u.shape[-1]
    leading = s.shape[:-1]
    own = getattr(system, "derivatives", None)
    if own is not None:
        a, b = own(s, u)
        _check_finite(np.concatenate([a, b], axis=-1), leading, f"the Jacobian of {type(system).__name__}")
        return a, b

    def flow(z: torch.Tensor) -> torch.Tensor:
        moved: torch.Tensor = system.flow(z[:, :n], z[:, n:])
        return moved

    z = torch.as_tensor(np.concatenate([s, u], axis=-1).reshape(-1, n + m))
    jacobian = _derivatives(flow, z, n)[1].reshape(*leading, n, n + m)
    _check_finite(jacobian, leading, f"the Jacobian of {type(system).__name__}.flow")
    return jacobian[..., :n], jacobian[..., n:]


def expand_cost(
    cost: Callable[..., Any], *arguments: ArrayLike, positive: bool = True
) -> tuple[Floats, Floats]:
    """Gradient and Hessian of a cost that acts on each row by itself.

        c(z + dz) = c(z) + g' dz + dz' H dz / 2 + O(3),      z = all arguments of the row, one after the other

    Args:
        cost: takes torch arrays (..., n), (..., m), ... and returns (...), such as `system.stage_cost`.
        arguments: (..., n), (..., m), ..., same leading shape.
        positive: replace H by the nearest positive semidefinite matrix (its negative eigenvalues become 0), as
            a minimiser needs.

    Returns:
        g (..., n + m + ...) and H (..., n + m + ..., n + m + ...), symmetric.

    Raises:
        ValueError: a derivative that is not finite.
    """
    parts = [np.asarray(a, dtype=np.float64) for a in arguments]
    sizes = [p.shape[-1] for p in parts]
    leading = parts[0].shape[:-1]

    def gradient(z: torch.Tensor) -> torch.Tensor:
        total = cost(*torch.split(z, sizes, dim=-1)).sum()
        (found,) = torch.autograd.grad(total, z, create_graph=True)
        return found

    z = torch.as_tensor(np.concatenate(parts, axis=-1).reshape(-1, sum(sizes)))
    slopes, h = _derivatives(gradient, z, sum(sizes))
    g = slopes.reshape(*leading, -1)
    h = 0.5 * (h + h.swapaxes(1, 2))
    name = getattr(cost, "__qualname__", type(cost).__name__)
    _check_finite(g[..., None], leading, f"the gradient of {name}")
    _check_finite(h.reshape(*leading, *h.shape[1:]), leading, f"the Hessian of {name}")
    return g, (clip_eigenvalues(h) if positive else h).reshape(*leading, *h.shape[1:])


def clip_eigenvalues(matrices: Floats) -> Floats:
    """The nearest positive semidefinite matrices in the Frobenius norm: negative eigenvalues become 0.

    Args:
        matrices: (rows, k, k), symmetric.

    Returns:
        (rows, k, k).

    Reference: Higham 1988, "Computing a nearest symmetric positive semidefinite matrix", Theorem 2.1.
    """
    size = matrices.shape[-1]
    coupled = np.flatnonzero((matrices * ~np.eye(size, dtype=bool)).any(axis=0).any(axis=0))
    clipped = np.maximum(matrices, 0.0) * np.eye(
        size
    )  # exact for what is coupled to nothing: cheap and common
    if len(coupled):
        block = np.ix_(np.arange(len(matrices)), coupled, coupled)
        values, vectors = np.linalg.eigh(matrices[block])
        clipped[block] = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.swapaxes(1, 2)
    return clipped


def _derivatives(
    function: Callable[[torch.Tensor], torch.Tensor], inputs: torch.Tensor, n_outputs: int
) -> tuple[Floats, Floats]:
    """Values (rows, l) and derivatives d outputs_i / d inputs_j (rows, l, k) of a function of each row by itself."""
    rows, k = inputs.shape
    repeated = rows * n_outputs <= ROWS_AT_ONCE
    with torch.enable_grad():
        z = (inputs.repeat_interleave(n_outputs, dim=0) if repeated else inputs.clone()).requires_grad_()
        outputs = function(z)
        values = outputs.detach().numpy()[:: n_outputs if repeated else 1]
        if not outputs.requires_grad:  # they are constant
            return values, np.zeros((rows, n_outputs, k))
        if repeated:
            one_each = torch.eye(n_outputs, dtype=z.dtype).repeat(rows, 1)
            (gradient,) = torch.autograd.grad(outputs, z, one_each)
            return values, gradient.numpy().reshape(rows, n_outputs, k)
        gradients = [
            torch.autograd.grad(outputs[:, i].sum(), z, retain_graph=True)[0] for i in range(n_outputs)
        ]
        return values, np.ascontiguousarray(torch.stack(gradients, dim=1).numpy())


def _rows(system: PlanningModel, state: ArrayLike, action: ArrayLike) -> tuple[Floats, Floats]:
    s, u = np.asarray(state, dtype=np.float64), np.asarray(action, dtype=np.float64)
    n, m = system.n_state, system.n_action
    if s.ndim < 1 or u.ndim < 1 or s.shape[-1] != n or u.shape[-1] != m or s.shape[:-1] != u.shape[:-1]:
        raise ValueError(
            f"{type(system).__name__} expects states (..., {n}) and actions (..., {m}) with the same leading "
            f"shape, got {s.shape} and {u.shape}"
        )
    return s, u


def _check_finite(values: Floats, leading: tuple[int, ...], what: str) -> None:
    bad = ~np.isfinite(values).all(axis=(-1, -2)).reshape(leading)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{what} is not finite at batch index {index}; the state or action there is not finite, or so large "
            "that the model overflows"
        )
