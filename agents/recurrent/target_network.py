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
    """theta' <- eps theta' + (1 - eps) theta from theta' = theta on, in one call for all parameters.

    It is TorchRL's SoftUpdate, which goes by each tensor. Buffers are not averaged.

    Args:
        loss: that holds both. name: of the network. eps: the share that stays, from 0 to below 1.

    Raises:
        ValueError: a share out of range.
    """

    def __init__(self, loss: LossModule, name: str, eps: float) -> None:
        if not 0.0 <= eps < 1.0:
            raise ValueError(f"expected the share of the average that stays from 0 to below 1, got {eps}")
        loss._has_update_associated[name] = True  # or the loss warns that nothing moves its target
        self.source: TensorDictBase = getattr(loss, f"{name}_params")
        self.target: TensorDictBase = getattr(loss, f"target_{name}_params")
        self.eps = eps
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
        torch._foreach_lerp_(*self._pairs, 1.0 - self.eps)

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
