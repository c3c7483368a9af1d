"""How a target network follows the network that learns: at once every so many steps, or a little at each."""

from __future__ import annotations

from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule


class Updater(Protocol):
    """What follows; TorchRL's updaters do."""

    def step(self) -> None:
        """Called after each gradient step."""


class AveragedParams:
    """theta' <- eps_t theta' + (1 - eps_t) theta from theta' = theta on, in one call for all parameters.

        eps_t = min(eps, 1 - 1 / (1 + c t)), t = 1, 2, ..: back over about the share c of all steps so far, while young

    Without c it is TorchRL's SoftUpdate, which goes by each tensor. Buffers are not averaged.

    Args:
        loss: that holds both. name: of the network. eps: the share that stays, from 0 to below 1.
        reach: c, above 0; None for eps from the start.

    Attributes:
        n_steps: t.

    Raises:
        ValueError: a share out of range.
    """

    def __init__(self, loss: LossModule, name: str, eps: float, reach: float | None = None) -> None:
        if not 0.0 <= eps < 1.0 or (reach is not None and reach <= 0.0):
            raise ValueError(
                "expected the share of the average that stays from 0 to below 1 and a reach above 0 (or None), got "
                f"{eps} and {reach}"
            )
        loss._has_update_associated[name] = True  # or the loss warns that nothing moves its target
        self.source: TensorDictBase = getattr(loss, f"{name}_params")
        self.target: TensorDictBase = getattr(loss, f"target_{name}_params")
        self.eps, self.reach, self.n_steps = eps, reach, 0
        self._pairs: tuple[list[Tensor], list[Tensor]] | None = None
        for key, value in self.target.items(include_nested=True, leaves_only=True):
            value.data.copy_(self.source.get(key).data)

    @torch.no_grad()
    def step(self) -> None:
        """One step of the average."""
        if self._pairs is None:
            leaves = self.source.items(include_nested=True, leaves_only=True)
            keys = [key for key, value in leaves if value.requires_grad]
            self._pairs = (
                [self.target.get(key).data for key in keys],
                [self.source.get(key).data for key in keys],
            )
        self.n_steps += 1
        fresh = 1.0 - self.eps
        if self.reach is not None:
            fresh = max(fresh, 1.0 / (1.0 + self.reach * self.n_steps))
        torch._foreach_lerp_(*self._pairs, fresh)

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_pairs": None}


def target_updater(loss: LossModule, update: float) -> Updater:
    """The updater of a loss's target parameters; its `step` is called after each gradient step.

        soft: theta' <- (1 - tau) theta' + tau theta        hard: theta' <- theta

    Args:
        loss: with target parameters. update: tau where below 1 (soft); else gradient steps between copies (hard).

    Raises:
        ValueError: not above 0, or steps that are no whole number.

    References: Lillicrap et al. 2016 (soft); Mnih et al. 2015 (hard).
    """
    if update <= 0 or (update >= 1 and update != int(update)):
        raise ValueError(
            "expected target_update as a share between 0 and 1 (soft) or a whole number of gradient steps from 1 on "
            f"(hard), got {update}"
        )
    if update < 1:
        return AveragedParams(loss, "value_network", 1.0 - float(update))
    # TorchRL's counter copies at the first step after the interval
    hard: Updater = HardUpdate(loss, value_network_update_interval=int(update) - 1)
    return hard
