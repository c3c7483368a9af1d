"""Numbers that fall to 0 over a training."""

from __future__ import annotations


def annealed(value: float | str, progress: float) -> float:
    """A constant, or "linear:v" for v (1 - progress).

    Args:
        value: the number or the schedule. progress: share of the training that is over, 0 to 1.
    """
    if isinstance(value, str):
        return float(value.removeprefix("linear:")) * (1.0 - progress)
    return float(value)
