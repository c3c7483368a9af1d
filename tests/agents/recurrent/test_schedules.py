"""Numbers that fall over a training."""

import pytest

from beliefgym.agents.recurrent.schedules import annealed


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.5, [0.5, 0.5, 0.5]), ("linear:2", [2.0, 1.0, 0.0]), ("cubic:2", [2.0, 0.25, 0.0])],
)
def test_they_fall_to_zero_or_stay(value, expected):
    assert [annealed(value, progress) for progress in (0.0, 0.5, 1.0)] == expected


@pytest.mark.parametrize("value", ["square:1", "1e-3", "linear:"])
def test_another_schedule_is_told(value):
    with pytest.raises(ValueError, match="expected a number"):
        annealed(value, 0.5)
