"""One compiled MuJoCo model for each payload: the same arm, another mass, kept while it is in use."""

from __future__ import annotations

import copy
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray


@dataclass
class PayloadModels:
    """Models of one arm with different payloads, made when a mass is first seen; the longest unused go first.

    Args:
        unloaded: the model of an arm with a body `payload` without mass.
        kept: how many models to keep, of about 0.1 MB each; more only while one batch needs more.
    """

    unloaded: Any
    kept: int = 2048
    _models: OrderedDict[float, Any] = field(default_factory=OrderedDict, init=False)

    def __post_init__(self) -> None:
        self._scratch = mujoco.MjData(self.unloaded)

    def __len__(self) -> int:
        return len(self._models)

    def of(self, masses: NDArray[np.float64]) -> list[Any]:
        """A model for each mass (n,) in kg."""
        found = []
        for mass in masses.tolist():
            model = self._models.pop(mass, None)
            model = self._make(mass) if model is None else model
            self._models[mass] = model
            found.append(model)
        while len(self._models) > max(self.kept, len(found)):
            self._models.popitem(last=False)
        return found

    def _make(self, mass: float) -> Any:
        model = copy.copy(self.unloaded)
        model.body("payload").mass = mass
        mujoco.mj_setConst(model, self._scratch)  # what follows from the masses
        return model
