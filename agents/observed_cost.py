"""A system's stage cost as a function of what is observed, found by the names of the components.

A state component is read off the observation where it stands there under its own name, or as the cosine and sine of an
angle: theta = atan2(sin_theta, cos_theta).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


class ObservedCost:
    """c(y, u) = stage_cost(s(y), u) of a system whose state s can be read off its observation y by name.

    Args:
        system: with `state_names` and `stage_cost(state, action)` on torch tensors.
        observation_names: names of y's components.

    Raises:
        ValueError: a state component that is not in the observation.
    """

    def __init__(self, system: Any, observation_names: Sequence[str]) -> None:
        self.system = system
        where = {name: i for i, name in enumerate(observation_names)}
        self._columns: list[tuple[int, ...]] = []
        for name in system.state_names:
            if name in where:
                self._columns.append((where[name],))
            elif {f"cos_{name}", f"sin_{name}"} <= where.keys():
                self._columns.append((where[f"sin_{name}"], where[f"cos_{name}"]))
            else:
                raise ValueError(
                    f"expected state {name!r} of {type(system).__name__} in the observation, as {name!r} or as "
                    f"'cos_{name}' and 'sin_{name}', got {', '.join(observation_names)}; give a cost of your own "
                    "(cost=...) on what is observed"
                )

    def __call__(self, observation: Tensor, action: Tensor) -> Tensor:
        """Observations (..., n_observation) and actions (..., n_action) -> costs (...)."""
        parts = [
            observation[..., columns[0]]
            if len(columns) == 1
            else torch.atan2(observation[..., columns[0]], observation[..., columns[1]])
            for columns in self._columns
        ]
        cost: Tensor = self.system.stage_cost(torch.stack(parts, dim=-1), action)
        return cost


def circles(observation_names: Sequence[str]) -> list[tuple[int, int]]:
    """Columns of the cosine and sine of each angle that is observed so."""
    where = {name: i for i, name in enumerate(observation_names)}
    return [
        (i, where[f"sin_{name.removeprefix('cos_')}"])
        for name, i in where.items()
        if name.startswith("cos_") and f"sin_{name.removeprefix('cos_')}" in where
    ]
