"""`ActionCoding`: actions as a filter takes them in: standardised, or one-hot where they are choices.

    u = (c(a) - mean) / deviation,     c(a) = a, or the unit vector of the choice a;     u = 0 for "no action yet"

so that the missing action before an episode's first observation stands for the average one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beliefgym.learning.standardisation import Standardisation

Array = NDArray[np.float64]


class ActionCoding:
    """Actions (n, n_act) in their own units -> codes (n, size).

    Args:
        scale: of the code's components.
        n_choices: number of choices where an action is one column of numbers from 0; None for real numbers.
    """

    def __init__(self, scale: Standardisation, n_choices: int | None = None) -> None:
        self.scale, self.n_choices = scale, n_choices

    @classmethod
    def of(cls, actions: Array, n_choices: int | None = None) -> ActionCoding:
        """The coding of training data's actions (n, n_act).

        Raises:
            ValueError: choices that are not one column of whole numbers from 0 to n_choices - 1.
        """
        return cls(Standardisation.of(_coded(actions, n_choices)), n_choices)

    @property
    def size(self) -> int:
        """Numbers in a code."""
        return len(self.scale.offset)

    def __call__(self, actions: Array) -> Array:
        """(n, n_act) -> (n, size); rows of NaN -> 0."""
        missing = np.isnan(actions).any(axis=1)
        if not missing.any():
            return self.scale.apply(_coded(actions, self.n_choices))
        codes = np.zeros((len(actions), self.size))
        codes[~missing] = self.scale.apply(_coded(actions[~missing], self.n_choices))
        return codes


def _coded(actions: Array, n_choices: int | None) -> Array:
    if n_choices is None:
        return actions
    if actions.shape[1] != 1:
        raise ValueError(f"expected choices in one column, got actions of {actions.shape[1]}")
    wrong = ~np.isin(actions[:, 0], np.arange(n_choices))
    if wrong.any():
        raise ValueError(
            f"expected actions as whole numbers from 0 to {n_choices - 1} (n_choices = {n_choices}), got "
            f"{actions[wrong, 0][0]}"
        )
    code: Array = np.eye(n_choices)[actions[:, 0].astype(np.intp)]
    return code
