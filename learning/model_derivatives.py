"""`derivatives`: the linearisation of a learned dynamics model, at a whole batch of states and actions.

    A = df/dx,   B = df/du,      f(x + dx, u + du) = f(x, u) + A dx + B du + O(2)

For a difference model f(x, u) = x + s g(z, v), with z, v the standardised state and action and g the regressor,
A = I + s g_z / sigma_x and B = s g_v / sigma_u, and an angle that g sees as cosine and sine contributes
g_sin cos - g_cos sin. g's own derivative is exact where the regressor has a `jacobian` (`Ridge`, `PolynomialRidge`,
`RandomFourierRidge`); else it is taken by central differences of the model.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.dynamics import DynamicsModel

Array = NDArray[np.float64]
SMOOTH_STEP = 1e-5  # standard deviations; near the best for float64
TREE_STEP = 0.25  # a tree is constant between its splits: only a wide step sees a slope


def derivatives(
    model: DynamicsModel, observations: Array, actions: Array, step: float | None = None
) -> tuple[Array, Array]:
    """The Jacobians of `model.flow`.

    Args:
        model: fitted.
        observations: (..., n_obs). actions: (..., n_act), same leading shape.
        step: of the central differences, where they are needed, in the model's standardised units (standard deviations
            of the training data, rad for its angles, the data's units where it does not standardise); None for 1e-5,
            and 0.25 for trees and forests.

    Returns:
        A (..., n_obs, n_obs) and B (..., n_obs, n_act); B is 0 for actions that the model does not use.

    Raises:
        NotFittedError: not fitted.
    """
    model._check_fitted()
    leading, n_given = observations.shape[:-1], actions.shape[-1]
    x = observations.reshape(-1, observations.shape[-1])
    u = actions.reshape(len(x), n_given)
    z, v = model._observed.apply(x), model._acted.apply(u[:, : model.n_act_])
    regressor = getattr(model, "model_", None)
    if hasattr(regressor, "jacobian"):
        by_z, by_v = _exact(model, regressor, z, v)
    else:
        by_z, by_v = _central_differences(model, z, v, _step(regressor) if step is None else step)
    scale = model._observed.scale
    a = by_z * (scale[:, None] / scale)
    b = np.zeros((len(x), model.n_obs_, n_given))
    b[:, :, : model.n_act_] = by_v * (scale[:, None] / model._acted.scale)
    return a.reshape(*leading, *a.shape[1:]), b.reshape(*leading, *b.shape[1:])


def _exact(model: DynamicsModel, regressor: Any, z: Array, v: Array) -> tuple[Array, Array]:
    """Of the next standardised state, by the standardised state and action."""
    n_obs, turns = model.n_obs_, model._turns
    slopes = regressor.jacobian(model._inputs(z, v))
    by_z = np.array(slopes[:, :, :n_obs])
    if len(turns):
        cosine, sine = np.cos(z[:, None, turns]), np.sin(z[:, None, turns])
        by_z[:, :, turns] = slopes[:, :, n_obs : n_obs + len(turns)] * cosine - by_z[:, :, turns] * sine
    by_v = slopes[:, :, n_obs + len(turns) :]
    if model.target == "delta":
        change = model._change_scale[:, None]
        return np.eye(n_obs) + change * by_z, change * by_v
    return by_z, by_v


def _central_differences(model: DynamicsModel, z: Array, v: Array, step: float) -> tuple[Array, Array]:
    """The same, from 2 (n_obs + n_act) predictions of each row, in one batch."""
    n, n_obs, size = len(z), z.shape[1], z.shape[1] + v.shape[1]
    both = np.concatenate([z, v], axis=1)
    moved = step * np.concatenate([np.eye(size), -np.eye(size)])
    rows = (both[:, None] + moved).reshape(n * 2 * size, size)
    after = model._step(rows[:, :n_obs], rows[:, n_obs:]).reshape(n, 2, size, n_obs)
    slopes = np.moveaxis(after[:, 0] - after[:, 1], 1, 2) / (2.0 * step)
    return slopes[:, :, :n_obs], slopes[:, :, n_obs:]


def _step(regressor: Any) -> float:
    return (
        TREE_STEP if hasattr(regressor, "estimators_") or hasattr(regressor, "for_aggregate") else SMOOTH_STEP
    )
