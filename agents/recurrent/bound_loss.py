"""`BoundLoss`: a loss module of TorchRL's whose networks hold their parameters for good."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any, Self

from torch import Tensor, nn
from torchrl.objectives import LossModule


class BoundLoss(LossModule):
    """Base class.

    TorchRL puts parameters into a stateless network for each call (`to_module`), which costs about as much as the
    forward pass of a small network. Here every set of parameters has a network that holds it: the one that was given,
    or a copy. They are the same tensors, so that optimisers and target updaters need not know; what replaces tensors
    (`to`, `load_state_dict`, copies) has them put in again.
    """

    def __init__(self) -> None:
        super().__init__()
        self.__dict__["_bound"] = {}  # beside the registry of modules: parameters are listed once
        self.register_load_state_dict_post_hook(_forget_bound)

    def bound(self, name: str, which: str = "") -> Any:
        """The network `name` with its parameters in it.

        Args:
            name: as it was given to `convert_to_functional`. which: "target" for the target parameters, "fixed" for
                its own without gradient, "" for its own.
        """
        held = self.__dict__["_bound"]
        if (name, which) not in held:
            network = getattr(self, name)
            if which:
                network = deepcopy(network)
            params = getattr(self, f"target_{name}_params" if which == "target" else f"{name}_params")
            (params.data if which == "fixed" else params).to_module(network)
            held[name, which] = network
        return held[name, which]

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> Self:
        self.__dict__["_bound"].clear()
        moved: Self = super()._apply(fn)
        for name, value in vars(self).items():
            if isinstance(value, nn.Module) and f"{name}_params" in self._modules:
                getattr(self, f"{name}_params").to_module(value)
        return moved

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bound": {}}


def _forget_bound(loss: nn.Module, _: Any) -> None:
    loss.__dict__["_bound"].clear()
