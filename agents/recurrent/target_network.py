"""How a target network follows the network that learns: at once every so many steps, or a little at each."""

from __future__ import annotations

from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater


def target_updater(loss: LossModule, update: float) -> TargetNetUpdater:
    """TorchRL's updater; its `step` is called after each gradient step.

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
        return SoftUpdate(loss, tau=float(update))
    # TorchRL's counter copies at the first step after the interval
    return HardUpdate(loss, value_network_update_interval=int(update) - 1)
