"""What a reproduction is given and what it gives back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

Row = dict[str, Any]


@dataclass(frozen=True)
class Request:
    """What the command line hands to a reproduction.

    Attributes:
        seed: the first seed.
        seeds: how many.
        jobs: processes.
        folder: where the record goes; figures are written there too.
        data: folder of recorded data, or None.
        video: a video of the user's, or None.
        told: hears of the progress.
    """

    seed: int = 0
    seeds: int = 5
    jobs: int = 1
    folder: Path = Path("results/reproduction")
    data: Path | None = None
    video: Path | None = None
    told: Callable[[str], None] = print


@dataclass(frozen=True)
class Report:
    """What a reproduction found.

    Attributes:
        about: what was done, in words.
        columns: names of the rows' entries that the table shows, in order.
        rows: each with `what` and the columns; `meets` is True, False or None.
        configuration: everything that decides the numbers.
        figures: file names beside the record, with a caption each.
        notes: what else is to be said, below the table.
    """

    about: str
    columns: tuple[str, ...]
    rows: list[Row]
    configuration: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Interval:
    """A mean over seeds with its 95 % interval by Student's t.

    Attributes:
        mean, low, high: NaN bounds where there is one value only. n: values.
    """

    mean: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, values: ArrayLike) -> Interval:
        """Of independent values, one a seed."""
        v = np.asarray(values, dtype=float)
        mean = float(v.mean())
        if len(v) < 2:
            return cls(mean, float("nan"), float("nan"), len(v))
        half = float(student.ppf(0.975, len(v) - 1) * v.std(ddof=1) / len(v) ** 0.5)
        return cls(mean, mean - half, mean + half, len(v))

    def text(self, form: str = ".3g", unit: str = "") -> str:
        """`mean [low, high]`."""
        if np.isnan(self.low):
            return f"{self.mean:{form}}{unit}"
        return f"{self.mean:{form}}{unit} [{self.low:{form}}, {self.high:{form}}]"

    def to_dict(self) -> dict[str, Any]:
        """As it stands in a record."""
        return {"value": self.mean, "interval": [self.low, self.high], "n": self.n}
