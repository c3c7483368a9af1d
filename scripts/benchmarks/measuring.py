"""Measuring two or more things side by side: interleaved repeats, medians and their ranges, one row a comparison."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Rate:
    """Units per second: the median over repeats and the range."""

    value: float
    low: float
    high: float

    def to_dict(self) -> dict[str, Any]:
        """As it stands in a row."""
        return {"value": self.value, "interval": [self.low, self.high]}


def rates(
    contestants: Mapping[str, Callable[[], int]], repeats: int = 5, seconds: float = 0.5
) -> dict[str, Rate]:
    """Measure contestants in turns, so that what else the machine does meets all of them alike.

    Args:
        contestants: name -> a call that does some work and returns how many units it did.
        repeats: rounds after one for warming up.
        seconds: least time of one measurement; the call is repeated until it is over.

    Returns:
        name -> units per second.
    """
    measured: dict[str, list[float]] = {name: [] for name in contestants}
    for call in contestants.values():
        call()
    for _ in range(repeats):
        for name, call in contestants.items():
            units, started = 0, time.perf_counter()
            while (elapsed := time.perf_counter() - started) < seconds or not units:
                units += call()
            measured[name].append(units / elapsed)
    return {name: Rate(float(np.median(v)), min(v), max(v)) for name, v in measured.items()}


def row(what: str, ours: Rate, rival_name: str, rival: Rate, target: float | None = None) -> dict[str, Any]:
    """One line of a benchmark: ours against a rival, and whether the ratio meets its target."""
    ratio = ours.value / rival.value
    return {
        "what": what,
        "ours": ours.to_dict(),
        "rival_name": rival_name,
        "rival": rival.to_dict(),
        "ratio": ratio,
        "target": target,
        "meets": None if target is None else ratio >= target,
    }
