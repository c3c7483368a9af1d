"""Estimators, settings and functions as plain data, so that an agent is saved without pickles.

An estimator is its class's name and its parameters; a settings object (a frozen dataclass) is its class's name and its
fields; a function is its module's and its own name. Reading makes objects of this package and of scikit-learn only: a
file cannot make the reader import anything else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator

KEY = "class"
TRUSTED = ("beliefgym.", "sklearn.")


def to_plain(value: Any) -> Any:
    """JSON values for an object; see the module.

    Raises:
        ValueError: an object that has no plain form; the message says what to do.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [to_plain(one) for one in value]
    if isinstance(value, BaseEstimator):
        parameters = {k: to_plain(v) for k, v in value.get_params(deep=False).items()}
        return {KEY: _name(type(value)), **parameters}
    if is_dataclass(value) and not isinstance(value, type):
        return {
            KEY: _name(type(value)),
            **{f.name: to_plain(getattr(value, f.name)) for f in fields(value) if f.init},
        }
    raise ValueError(
        f"expected something that can be written down as plain data (a number, an estimator of beliefgym or "
        f"scikit-learn, a settings object), got {type(value).__name__}; the agent can be used, but not saved"
    )


def from_plain(value: Any) -> Any:
    """The object of `to_plain`'s data; objects themselves are handed through.

    Raises:
        ValueError: a class that is not of beliefgym or scikit-learn.
    """
    if isinstance(value, list):
        return [from_plain(one) for one in value]
    if not (isinstance(value, Mapping) and KEY in value):
        return value
    module, _, name = value[KEY].partition(":")
    if not module.startswith(TRUSTED):
        raise ValueError(
            f"expected a class of beliefgym or scikit-learn in a saved agent, got {value[KEY]!r}"
        )
    found = getattr(import_module(module), name)
    if not (isinstance(found, type) and (issubclass(found, BaseEstimator) or is_dataclass(found))):
        raise ValueError(f"expected an estimator or a settings class in a saved agent, got {value[KEY]!r}")
    return found(**{k: from_plain(v) for k, v in value.items() if k != KEY})


def _name(kind: type) -> str:
    name = f"{kind.__module__}:{kind.__qualname__}"
    if not kind.__module__.startswith(TRUSTED):
        raise ValueError(
            f"expected a class of beliefgym or scikit-learn, got {name}; the agent can be used, but not saved"
        )
    return name
