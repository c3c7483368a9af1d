"""Tuning both arms of a comparison, single step against Data as Demonstrator, alike: same learners, same criterion.

The criterion is the multi-step error on validation trajectories. The single-step arm takes the learner of the grid that
is best by it, fitted to all training trajectories. The DaD arm runs DaD from each learner with each of DaD's own
options (length of the training rollouts) for a few iterations on a share of the training trajectories, the best few of
these for all iterations on all of them, and takes the best of their models and of the single-step arm's. The test
trajectories are not looked at before both arms have chosen.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from sklearn.base import clone

from beliefgym.learning import DataAsDemonstrator, Sequences

Options = Mapping[str, Any]
TUNING_VERSION = 2  # of the protocol; cells made with another one run again


@dataclass(frozen=True)
class Choice:
    """A tuned arm.

    Attributes:
        model: fitted. learner: the regressor's settings. options: DaD's.
        validation: its multi-step error there. seconds: of all the fits.
    """

    model: DataAsDemonstrator
    learner: dict[str, Any]
    options: dict[str, Any]
    validation: float
    seconds: float


@dataclass(frozen=True)
class Pair:
    """Both arms, and DaD's whole run at its chosen settings (its history, its last model)."""

    single: Choice
    dad: Choice


def tune(
    train: Sequences,
    validation: Sequences,
    learner: Any,
    settings: Sequence[Options],
    dad_options: Sequence[Options],
    *,
    n_iterations: int,
    screening: int,
    screening_share: float = 0.25,
    finalists: int = 2,
    common: Options | None = None,
) -> Pair:
    """Tune both arms.

    Args:
        train, validation: trajectories.
        learner: a regressor. settings: of the regressor, one mapping for each point of the grid.
        dad_options: DaD's own options to try.
        n_iterations: of the finalists. screening: iterations of everybody else.
        screening_share: of the training trajectories. finalists: how many go on.
        common: options of `DataAsDemonstrator` for both arms.

    Raises:
        ValueError: an empty grid.
    """
    if not settings or not dad_options:
        raise ValueError("expected at least one setting of the learner and one of DaD's options")
    common = dict(common or {})

    def fitted(part: Sequences, setting: Options, options: Options, iterations: int) -> DataAsDemonstrator:
        regressor = clone(learner).set_params(**setting)
        model = DataAsDemonstrator(regressor, n_iterations=iterations, **common, **options)
        return model.fit(part, validation)

    started = time.perf_counter()
    singles = [fitted(train, setting, {}, 0) for setting in settings]
    scores = [_validation(model) for model in singles]
    best = int(np.argmin(scores))
    single = Choice(singles[best], dict(settings[best]), {}, scores[best], time.perf_counter() - started)

    started = time.perf_counter()
    part = train[: max(1, round(screening_share * len(train)))]
    grid = list(product(settings, dad_options))
    screened = [_validation(fitted(part, setting, options, screening)) for setting, options in grid]
    dad = single
    for i in np.argsort(screened, kind="stable")[:finalists]:
        setting, options = grid[i]
        model = fitted(train, setting, options, n_iterations)
        if dad is single or _validation(model) < dad.validation:
            dad = Choice(model, dict(setting), dict(options), _validation(model), 0.0)
    if single.validation < dad.validation:
        dad = single
    return Pair(single, replace(dad, seconds=time.perf_counter() - started))


def _validation(model: DataAsDemonstrator) -> float:
    return float(model.history_["validation_multi_step"][model.best_iteration_])
