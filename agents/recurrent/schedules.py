"""Numbers that fall to 0 over a training."""

from __future__ import annotations

POWERS = {"linear": 1, "cubic": 3}


def annealed(value: float | str, progress: float) -> float:
    """A constant, "linear:v" for v (1 - progress), or "cubic:v" for v (1 - progress)^3.

    Args:
        value: the number or the schedule. progress: share of the training that is over, 0 to 1.

    Raises:
        ValueError: another schedule.
    """
    if not isinstance(value, str):
        return float(value)
    name, _, start = value.partition(":")
    if name not in POWERS or not start:
        raise ValueError(f'expected a number, "linear:1e-3" or "cubic:1e-3", got {value!r}')
    return float(start) * float((1.0 - progress) ** POWERS[name])
