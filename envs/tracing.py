"""A system's array functions as an expression graph, by running them once on symbols.

`flow`, `observe`, `reward` and `terminated` of a system are written against the array API. `Scalar` and `Vector` are
arrays of that API which compute nothing and remember what was asked, so that the same lines give numbers under numpy,
derivatives under torch, and here a graph from which kernel.py writes one fused loop. Equal subexpressions are one
node. What cannot be traced (a matrix product, a data-dependent branch) raises `TraceError`; the system then runs
under numpy as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np


class TraceError(TypeError):
    """A function did something that an expression graph cannot hold."""


class Graph:
    """Nodes (operation, arguments) in order of evaluation; equal nodes are stored once."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, tuple[Any, ...]]] = []
        self._known: dict[tuple[str, tuple[Any, ...]], int] = {}

    def node(self, operation: str, *arguments: Any) -> Scalar:
        """The value of an operation on earlier nodes (`Scalar`) or constants."""
        key = (
            operation,
            tuple(("node", a.index) if isinstance(a, Scalar) else ("constant", a) for a in arguments),
        )
        if key not in self._known:
            self._known[key] = len(self.nodes)
            self.nodes.append(key)
        return Scalar(self, self._known[key])

    def symbols(self, name: str, size: int) -> Vector:
        """A vector of inputs name[0], name[1], ..."""
        return Vector(self, [self.node("input", name, i) for i in range(size)])


def _binary(operation: str, swap: bool = False) -> Callable[[Any, Any], Any]:
    def apply(self: Any, other: Any) -> Any:
        first, second = (other, self) if swap else (self, other)
        return _lift(self.graph, operation, first, second)

    return apply


class _Symbolic:
    graph: Graph
    dtype: ClassVar[Any] = np.float64
    device: ClassVar[str] = "cpu"
    __add__, __radd__ = _binary("+"), _binary("+", swap=True)
    __sub__, __rsub__ = _binary("-"), _binary("-", swap=True)
    __mul__, __rmul__ = _binary("*"), _binary("*", swap=True)
    __truediv__, __rtruediv__ = _binary("/"), _binary("/", swap=True)
    __lt__, __le__, __gt__, __ge__ = _binary("<"), _binary("<="), _binary(">"), _binary(">=")
    __and__, __rand__ = _binary("and"), _binary("and", swap=True)
    __or__, __ror__ = _binary("or"), _binary("or", swap=True)
    __hash__ = None  # type: ignore[assignment]
    __array_ufunc__ = None  # numpy leaves arithmetic with us to us

    def __neg__(self) -> Any:
        return _lift(self.graph, "neg", self)

    def __abs__(self) -> Any:
        return _lift(self.graph, "abs", self)

    def __invert__(self) -> Any:
        return _lift(self.graph, "not", self)

    def __pow__(self, power: Any) -> Any:
        if not isinstance(power, int) or not 1 <= power <= 4:
            raise TraceError(f"only whole powers from 1 to 4 are traced, got {power!r}")
        result = self
        for _ in range(power - 1):
            result = result * self
        return result

    def __bool__(self) -> bool:
        raise TraceError("a branch on a value cannot be traced; use where()")

    def __array_namespace__(self, api_version: str | None = None) -> Any:
        return Namespace(self.graph)


class Scalar(_Symbolic):
    """One number for each copy: an array of shape () to the function being traced."""

    shape: ClassVar[tuple[int, ...]] = ()

    def __init__(self, graph: Graph, index: int) -> None:
        self.graph, self.index = graph, index


class Vector(_Symbolic):
    """A last axis of numbers: an array of shape (k,) to the function being traced."""

    def __init__(self, graph: Graph, items: Sequence[Any]) -> None:
        self.graph, self.items = graph, list(items)

    @property
    def shape(self) -> tuple[int, ...]:
        """(k,)."""
        return (len(self.items),)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, tuple) and len(key) == 2 and key[0] is Ellipsis:
            key = key[1]
        if isinstance(key, int):
            return self.items[key]
        if isinstance(key, slice):
            return Vector(self.graph, self.items[key])
        raise TraceError(f"only the last axis can be indexed, by numbers and slices; got {key!r}")


def _lift(graph: Graph, operation: str, *arguments: Any) -> Any:
    """An elementwise operation with broadcasting of numbers and scalars over vectors."""
    parts = [_as_symbol(graph, argument) for argument in arguments]
    sizes = {len(part.items) for part in parts if isinstance(part, Vector)}
    if len(sizes) > 1:
        raise TraceError(f"vectors of lengths {sorted(sizes)} do not go together in {operation}")
    if not sizes:
        return graph.node(operation, *parts)
    size = sizes.pop()
    columns = [part.items if isinstance(part, Vector) else [part] * size for part in parts]
    return Vector(graph, [graph.node(operation, *items) for items in zip(*columns, strict=True)])


def _as_symbol(graph: Graph, value: Any) -> Any:
    if isinstance(value, Scalar | Vector):
        return value
    array = np.asarray(value)
    if array.dtype == object or array.ndim > 1:
        raise TraceError(f"cannot trace a value of type {type(value).__name__} and shape {array.shape}")
    if array.ndim == 1:
        return Vector(graph, [_as_symbol(graph, item) for item in array.tolist()])
    return bool(array) if array.dtype == np.bool_ else float(array)


class Namespace:
    """The part of the array API that can be traced."""

    bool = np.bool_
    float64 = np.float64
    pi = math.pi
    inf = math.inf

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    @property
    def __name__(self) -> str:
        return "beliefgym.envs.tracing"

    def __getattr__(self, name: str) -> Any:
        if name in _FUNCTIONS:
            return lambda *arguments: _lift(self._graph, name, *arguments)
        raise TraceError(
            f"{name}() cannot be traced (what can: {', '.join(_FUNCTIONS)}, stack, asarray, zeros, clip)"
        )

    def asarray(self, value: Any, dtype: Any = None, device: Any = None) -> Any:
        """A number or a vector of numbers as constants."""
        return _as_symbol(self._graph, value)

    def zeros(self, shape: tuple[int, ...], dtype: Any = float, device: Any = None) -> Any:
        """Zeros of shape () or (k,)."""
        return self._filled(shape, dtype(0))

    def zeros_like(self, value: Any) -> Any:
        """Zeros of the shape of a value."""
        return self._filled(value.shape, 0.0)

    def ones_like(self, value: Any) -> Any:
        """Ones of the shape of a value."""
        return self._filled(value.shape, 1.0)

    def _filled(self, shape: tuple[int, ...], value: Any) -> Any:
        if shape == ():
            return self._graph.node("constant", bool(value) if isinstance(value, np.bool_) else value)
        return Vector(self._graph, [value] * shape[0])

    def stack(self, parts: Sequence[Any], axis: int = 0) -> Vector:
        """Scalars as a vector, along the last axis."""
        if axis != -1 or any(isinstance(part, Vector) for part in parts):
            raise TraceError("only numbers for each copy can be stacked, along axis -1")
        return Vector(self._graph, parts)

    def concat(self, parts: Sequence[Any], axis: int = 0) -> Vector:
        """Vectors one after the other, along the last axis."""
        if axis != -1:
            raise TraceError("vectors are joined along axis -1")
        return Vector(self._graph, [item for part in parts for item in _as_symbol(self._graph, part).items])

    def clip(self, value: Any, low: Any, high: Any) -> Any:
        """The value within limits."""
        return _lift(self._graph, "minimum", _lift(self._graph, "maximum", value, low), high)


_FUNCTIONS = (
    "sin",
    "cos",
    "tan",
    "tanh",
    "exp",
    "log",
    "sqrt",
    "floor",
    "abs",
    "atan2",
    "minimum",
    "maximum",
    "where",
    "logical_and",
    "logical_or",
    "isfinite",
)
