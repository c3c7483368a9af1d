"""`Archive`: a filter's attributes as named arrays and a header of plain data, and back; each checked on the way.

A layout says once which attributes an object has and of which shapes:

    archive.scale(filter, "_scale", n_obs)
    archive.array(filter, "_first_belief", (size,))

and serves both ways. An archive that saves takes the attributes; one that loads sets them, from arrays that must be
there, of that shape and type, and without NaN.

Estimators stand in the header as the name of their class, one of a short list, and their parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from beliefgym.learning.linear_in_features import LinearInFeatures, Ridge
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.standardisation import Standardisation

MODULES = {  # the classes that a file may name, and where they are
    "PSIM": "psim",
    "PSIMActions": "psim_actions",
    "ConditionalPSIM": "psim_conditional",
    "ForwardPSIM": "psim_forward",
    "BackpropPSIM": "psim_backprop",
    "AutoregressiveFilter": "autoregressive_filter",
    "KalmanFilter": "kalman_filter",
    "N4SID": "subspace_identification",
    "InstrumentalVariableRegression": "instrumental_regression",
    "PSIMHints": "psim_hints",
    "InferenceMachineFilter": "psim_hints",
    "Ridge": "linear_in_features",
    "RandomFourierRidge": "random_fourier",
}
REGRESSORS = (Ridge, RandomFourierRidge)
NAMES = " or ".join(regressor.__name__ for regressor in REGRESSORS)
Shape = tuple[int, ...]
Holds = Literal[
    "finite", "infinite", "any"
]  # what an array's numbers may be: "infinite" those too, "any" NaN too


class Archive:
    """Arrays by name and a header, of one filter.

    Args:
        name: of the file or the filter, for messages.
        header: plain data. arrays: by name. is_loading: which way.
    """

    def __init__(
        self, name: str, header: dict[str, Any], arrays: dict[str, NDArray[Any]], is_loading: bool
    ) -> None:
        self.name, self.header, self.arrays, self.is_loading = name, header, arrays, is_loading

    def array(
        self,
        owner: Any,
        attribute: str,
        shape: Shape,
        dtype: type = np.float64,
        holds: Holds = "finite",
        under: str | None = None,
    ) -> None:
        """An attribute that is an array, under its own name or another."""
        name = attribute if under is None else under
        if self.is_loading:
            setattr(owner, attribute, self._taken(name, shape, dtype, holds))
        else:
            self._keep(name, getattr(owner, attribute), shape, dtype, holds)

    def parts(
        self, owner: Any, attribute: str, cls: Callable[..., Any], shapes: Mapping[str, Shape], **dtypes: type
    ) -> None:
        """An attribute that is an object of a few arrays, which cls takes by their names."""
        found: dict[str, Any] = {}
        for part, shape in shapes.items():
            name, dtype = f"{attribute}.{part}", dtypes.get(part, np.float64)
            if self.is_loading:
                found[part] = self._taken(name, shape, dtype)
            else:
                self._keep(name, getattr(getattr(owner, attribute), part), shape, dtype)
        if self.is_loading:
            setattr(owner, attribute, cls(**found))

    def scale(self, owner: Any, attribute: str, d: int) -> None:
        """An attribute that is a `Standardisation` of d components."""
        shapes = {"offset": (d,), "scale": (d,), "constant": (d,)}
        self.parts(owner, attribute, Standardisation, shapes, constant=np.bool_)
        if not (getattr(owner, attribute).scale > 0).all():
            raise ValueError(f"{self.name}: {attribute}.scale: expected numbers above 0")

    def whole(self, owner: Any, attribute: str) -> None:
        """An attribute that is a whole number of at least 0, where there is one; it stands in the header."""
        if self.is_loading and attribute in self.header:
            setattr(owner, attribute, self.number(attribute))
        elif not self.is_loading and hasattr(owner, attribute):
            self.header[attribute] = int(getattr(owner, attribute))

    def number(self, name: str, value: int | None = None) -> int:
        """A whole number of at least 0 under a name in the header: kept, or taken."""
        if not self.is_loading:
            self.header[name] = int(value or 0)
        found = self.header[name]
        if isinstance(found, bool) or not isinstance(found, int) or found < 0:
            raise ValueError(f"{self.name}: {name}: expected a whole number, got {found!r}")
        return found

    def history(self, owner: Any) -> None:
        """`history_`, where there is one: arrays of one length, of any numbers."""
        length = self.number("history_length", len(next(iter(getattr(owner, "history_", {"": ()}).values()))))
        if not self.is_loading:
            self.header["history"] = list(getattr(owner, "history_", ()))
        history: dict[str, Any] = {}
        for name in self.header["history"]:
            if self.is_loading:
                history[name] = self._taken(f"history_.{name}", (length,), holds="any")
            else:
                self._keep(f"history_.{name}", owner.history_[name], (length,), holds="any")
        if self.is_loading and history:
            owner.history_ = history

    def regressor(self, name: str, model: Any, n_inputs: int, n_targets: int) -> Any:
        """A fitted regressor under a name: the model that is kept, or where loading the one that was.

        Raises:
            TypeError: a regressor to save that is none of `REGRESSORS`, nor the `Constant` a PSIM may start from.
        """
        if not self.is_loading:
            is_constant = type(model).__name__ == "Constant"
            if not is_constant and type(model) not in REGRESSORS:
                raise TypeError(
                    f"expected a filter with {NAMES} to save, got one with {type(model).__name__}; it can be used, but "
                    "not saved as arrays"
                )
            self.header[name] = {"class": "Constant"} if is_constant else plain(model)
        told = self.header[name]
        if told["class"] == "Constant":
            if self.is_loading:
                model = getattr(import_module("beliefgym.learning.psim"), "Constant")(np.zeros(0))  # noqa: B009
            self.array(model, "answer", (n_targets,), under=f"{name}.answer")
            return model
        if self.is_loading:
            model = from_plain(told)
            if type(model) not in REGRESSORS:
                raise ValueError(f"{self.name}: expected {NAMES}, got {told['class']!r}")
            model.n_features_in_, model._y_ndim = n_inputs, 2
        return self._linear(name, model, n_inputs, n_targets)

    def _linear(self, name: str, model: LinearInFeatures, n_inputs: int, n_targets: int) -> LinearInFeatures:
        n_features = n_inputs
        if isinstance(model, RandomFourierRidge):
            model._check_parameters()
            n_features = 2 * model.n_frequencies + (n_inputs if model.include_inputs else 0)
            shape = n_inputs, model.n_frequencies
            self.array(model, "frequencies_", shape, under=f"{name}.frequencies")
        self.array(model, "_weights", (n_features, n_targets), under=f"{name}.weights")
        self.array(model, "_offset", (n_targets,), under=f"{name}.offset")
        if self.is_loading:
            model._set(model._weights, model._offset)
        return model

    def _keep(
        self, name: str, value: Any, shape: Shape, dtype: type = np.float64, holds: Holds = "finite"
    ) -> None:
        array: NDArray[Any] = np.asarray(value, dtype=dtype)
        self._check(name, array, shape, holds)
        if array.flags.f_contiguous and not array.flags.c_contiguous:
            self.header["column_major"].append(name)  # products may round otherwise in the other order
        self.arrays[name] = np.ascontiguousarray(array)

    def _taken(
        self, name: str, shape: Shape, dtype: type = np.float64, holds: Holds = "finite"
    ) -> NDArray[Any]:
        if name not in self.arrays:
            raise ValueError(f"{self.name} has no array {name!r} (it holds {sorted(self.arrays)})")
        array = self.arrays[name]
        if array.dtype != np.dtype(dtype):
            raise ValueError(f"{self.name}: {name}: expected {np.dtype(dtype)}, got {array.dtype}")
        self._check(name, array, shape, holds)
        return np.array(array, order="F" if name in self.header["column_major"] else "C")

    def _check(self, name: str, array: NDArray[Any], shape: Shape, holds: Holds) -> None:
        if array.shape != shape:
            raise ValueError(f"{self.name}: {name}: expected shape {shape}, got {array.shape}")
        wrong = ~np.isfinite(array) if holds == "finite" else np.isnan(array)
        if holds != "any" and wrong.any():
            where = tuple(int(i) for i in np.argwhere(wrong)[0])
            raise ValueError(
                f"{self.name}: {name}: expected finite numbers, got {array[where]} at index {where}"
            )


def plain(estimator: BaseEstimator, leaving: tuple[str, ...] = ()) -> dict[str, Any]:
    """The name of an estimator's class and its parameters, but those that are left out.

    Raises:
        TypeError: a class that is not in `MODULES`, a parameter that is no plain data.
    """
    kind = type(estimator)
    if kind.__module__ != f"beliefgym.learning.{MODULES.get(kind.__name__)}":
        raise TypeError(
            f"expected a filter with {NAMES} to save, got one with {kind.__name__}; it can be used, but not saved as "
            "arrays"
        )
    given = estimator.get_params(deep=False)
    return {
        "class": kind.__name__,
        "parameters": {name: _plain_value(name, given[name]) for name in given if name not in leaving},
    }


def from_plain(told: Any) -> Any:
    """The unfitted estimator of `plain`.

    Raises:
        ValueError: a class that is not in `MODULES`.
    """
    if told["class"] not in MODULES:
        raise ValueError(f"expected one of {', '.join(MODULES)} in a saved filter, got {told['class']!r}")
    cls = getattr(import_module(f"beliefgym.learning.{MODULES[told['class']]}"), told["class"])
    return cls(**{name: _from_plain_value(value) for name, value in told["parameters"].items()})


def _from_plain_value(value: Any) -> Any:
    return from_plain(value) if isinstance(value, dict) else value


def _plain_value(name: str, value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if name == "random_state":
        return None  # a generator: what it drew is among the arrays
    if isinstance(value, list | tuple | range | np.ndarray):
        return [_plain_value(name, one) for one in value]
    if isinstance(value, BaseEstimator):
        return plain(value)
    raise TypeError(
        f"{name}: expected plain data to save a filter, got {type(value).__name__}; functions of one's own are not "
        "saved, the filter can be used without"
    )
