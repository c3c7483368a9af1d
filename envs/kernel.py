"""One step of n copies: by one fused, compiled loop where numba is installed, else by numpy as the system stands.

A step of a few dozen copies under numpy is some forty calls of about a microsecond each, whatever the number of
copies. The fused loop is one call. It is written from the traced graph of the system's own functions (tracing.py), so
no dynamics are written twice, and compiled once for each system, kept in the user's cache folder.

`BELIEFGYM_KERNEL` = auto (numba where it is installed and the system can be traced), numpy or numba (an error where
it cannot). The two may differ in the last bit of a sine, which a chaotic system makes visible in time: records say
which was used.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.system import System
from beliefgym.envs.tracing import Graph, Scalar, TraceError

NOT_FINITE, NAN_ACTION, TERMINATED, TRUNCATED = 1, 2, 4, 8
NO_LIMIT = np.iinfo(np.int64).max


class Outcome(NamedTuple):
    """Where a kernel writes what a step gives: (n, n_state), (n,), (n,), (n,)."""

    next_state: NDArray[np.float64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class Kernel(Protocol):
    """What a simulation runs on."""

    name: str

    def step(
        self,
        state: NDArray[np.float64],
        action: NDArray[np.float64],
        noise: NDArray[np.float64] | None,
        steps: NDArray[np.int64],
        limit: int,
        out: Outcome,
    ) -> int:
        """One control period of every copy.

        Args:
            state: (n, n_state). action: (n, n_action). noise: (n, noise_size) or None.
            steps: (n,) steps taken; one is added. limit: steps after which an episode is truncated.
            out: written.

        Returns:
            a sum of NOT_FINITE, NAN_ACTION, TERMINATED and TRUNCATED: whether any copy is so.
        """

    def observe(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """(n, n_state) -> (n, n_kept) float32, in an array of its own."""


class NumpyKernel:
    """A system's functions, called as they are.

    Args:
        system: the system.
        columns: which components of its observation to show.
    """

    name = "numpy"

    def __init__(self, system: System, columns: Sequence[int]) -> None:
        self._system = system
        keeps_order = list(columns) == list(range(len(columns)))
        self._columns: Any = slice(0, len(columns)) if keeps_order else list(columns)

    def step(
        self,
        state: NDArray[np.float64],
        action: NDArray[np.float64],
        noise: NDArray[np.float64] | None,
        steps: NDArray[np.int64],
        limit: int,
        out: Outcome,
    ) -> int:
        """See `Kernel.step`."""
        system = self._system
        action = system.clip(action)
        out.next_state[...] = system.step(state, action, noise)
        out.reward[...] = system.reward(state, action, out.next_state)
        out.terminated[...] = system.terminated(out.next_state)
        steps += 1
        out.truncated[...] = steps >= limit
        flags = TERMINATED * bool(out.terminated.any()) + TRUNCATED * bool(out.truncated.any())
        if not np.isfinite(out.next_state.sum()):
            flags += NOT_FINITE * (not np.isfinite(out.next_state).all())
        if np.isnan(action.sum()):
            flags += NAN_ACTION * bool(np.isnan(action).any())
        return flags

    def observe(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """See `Kernel.observe`."""
        observation: NDArray[np.float32] = self._system.observe(state)[..., self._columns].astype(np.float32)
        return observation


class NumbaKernel:
    """A system's functions as one compiled loop.

    Args:
        system: the system.
        columns: which components of its observation to show.

    Raises:
        TraceError: the system's functions cannot be traced.
        ImportError: numba is not installed.
    """

    name = "numba"

    def __init__(self, system: System, columns: Sequence[int]) -> None:
        module = _compiled(write_source(system, columns))
        self._step: Callable[..., int] = module.step
        self._observe: Callable[..., None] = module.observe
        self._made_of = (system, tuple(columns))
        self._n_shown = len(columns)
        self._no_noise = np.zeros((0, 0))

    def step(
        self,
        state: NDArray[np.float64],
        action: NDArray[np.float64],
        noise: NDArray[np.float64] | None,
        steps: NDArray[np.int64],
        limit: int,
        out: Outcome,
    ) -> int:
        """See `Kernel.step`."""
        noise = self._no_noise if noise is None else noise
        return self._step(state, action, noise, steps, limit, *out)

    def observe(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """See `Kernel.observe`."""
        shown = np.empty((len(state), self._n_shown), dtype=np.float32)
        self._observe(state, shown)
        return shown

    def __reduce__(self) -> tuple[Any, ...]:
        return NumbaKernel, self._made_of


def make_kernel(system: System, columns: Sequence[int]) -> Kernel:
    """The kernel that `BELIEFGYM_KERNEL` asks for.

    Raises:
        ValueError: the variable is none of auto, numpy, numba.
        TraceError, ImportError: numba was asked for by name and cannot be had.
    """
    wanted = os.environ.get("BELIEFGYM_KERNEL", "auto")
    if wanted not in ("auto", "numpy", "numba"):
        raise ValueError(f"expected BELIEFGYM_KERNEL to be auto, numpy or numba, got {wanted!r}")
    if wanted != "numpy":
        try:
            return NumbaKernel(system, columns)
        except (ImportError, TraceError):
            if wanted == "numba":
                raise
    return NumpyKernel(system, columns)


def write_source(system: System, columns: Sequence[int]) -> str:
    """Python source of the fused loops `step` and `observe` of a system, for numba.

    Raises:
        TraceError: the system's functions cannot be traced.
    """
    try:
        stepping, targets, observing, seen = _traced(system, columns)
    except TraceError:
        raise
    except Exception as error:  # a function that wants a real array may fail in any way on a symbol
        raise TraceError(f"{type(system).__name__} cannot be traced: {error}") from error
    finite = " and ".join(f"isfinite(next_state[i, {j}])" for j in range(system.n_state))
    nan_action = " or ".join(f"isnan(action[i, {j}])" for j in range(system.n_action))
    return "\n".join(
        [
            '"""Written by beliefgym.envs.kernel from the system\'s own functions; safe to delete."""',
            "from math import isfinite, isnan",
            "from numpy import arctan2 as atan2, cos, exp, floor, log, sin, sqrt, tan, tanh",
            "from numba import njit",
            "",
            '@njit(cache=True, error_model="numpy")',
            "def step(state, action, noise, steps, limit, next_state, reward, terminated, truncated):",
            "    flags = 0",
            "    for i in range(state.shape[0]):",
            *_statements(stepping, targets),
            f"        if not ({finite}):",
            f"            flags |= {NOT_FINITE}",
            f"        if {nan_action}:",
            f"            flags |= {NAN_ACTION}",
            "        if terminated[i]:",
            f"            flags |= {TERMINATED}",
            "        steps[i] += 1",
            "        truncated[i] = steps[i] >= limit",
            "        if truncated[i]:",
            f"            flags |= {TRUNCATED}",
            "    return flags",
            "",
            '@njit(cache=True, error_model="numpy")',
            "def observe(state, shown):",
            "    for i in range(state.shape[0]):",
            *_statements(observing, seen),
            "",
        ]
    )


def _traced(
    system: System, columns: Sequence[int]
) -> tuple[Graph, list[tuple[str, Any]], Graph, list[tuple[str, Any]]]:
    """The graphs of a step and of an observation, each with (where to write, value)."""
    stepping = Graph()
    state = stepping.symbols("state", system.n_state)
    action = system.clip(stepping.symbols("action", system.n_action))
    noise = stepping.symbols("noise", system.noise_size) if system.noise_size else None
    next_state = system.step(state, action, noise)
    targets = [(f"next_state[i, {j}]", item) for j, item in enumerate(next_state.items)]
    targets.append(("reward[i]", system.reward(state, action, next_state)))
    targets.append(("terminated[i]", system.terminated(next_state)))
    observing = Graph()
    shown = system.observe(observing.symbols("state", system.n_state))
    seen = [(f"shown[i, {k}]", shown.items[column]) for k, column in enumerate(columns)]
    return stepping, targets, observing, seen


_INFIX = ("+", "-", "*", "/", "<", "<=", ">", ">=", "and", "or")
_CALLS = ("sin", "cos", "tan", "tanh", "exp", "log", "sqrt", "floor", "atan2", "abs", "isfinite")
# minimum and maximum pass NaN on, as numpy's do
_FORMS = {
    "neg": "-{0}",
    "not": "not {0}",
    "logical_and": "{0} and {1}",
    "logical_or": "{0} or {1}",
    "where": "{1} if {0} else {2}",
    "minimum": "{0} if {0} < {1} or {0} != {0} else {1}",
    "maximum": "{0} if {0} > {1} or {0} != {0} else {1}",
    "constant": "{0}",
}


def _statements(graph: Graph, targets: Sequence[tuple[str, Any]]) -> list[str]:
    """The body of the loop: one assignment for each node that a target needs, then the targets."""
    needed: set[int] = set()
    waiting = [value.index for _, value in targets if isinstance(value, Scalar)]
    while waiting:
        index = waiting.pop()
        if index not in needed:
            needed.add(index)
            waiting += [value for kind, value in graph.nodes[index][1] if kind == "node"]
    lines = [f"        v{index} = {_expression(*graph.nodes[index])}" for index in sorted(needed)]
    return lines + [f"        {name} = {_operand_of(value)}" for name, value in targets]


def _expression(operation: str, arguments: tuple[tuple[str, Any], ...]) -> str:
    if operation == "input":
        return f"{arguments[0][1]}[i, {arguments[1][1]}]"
    operands = [f"v{value}" if kind == "node" else _constant(value) for kind, value in arguments]
    if operation in _INFIX:
        return f" {operation} ".join(operands)
    if operation in _CALLS:
        return f"{operation}({', '.join(operands)})"
    return _FORMS[operation].format(*operands)


def _operand_of(value: Any) -> str:
    return f"v{value.index}" if isinstance(value, Scalar) else _constant(value)


def _constant(value: Any) -> str:
    if isinstance(value, float):
        text = repr(value)
        return {"inf": "1e400", "-inf": "(-1e400)", "nan": "(1e400 - 1e400)"}.get(text, f"({text})")
    return repr(value)


_MODULES: dict[str, ModuleType] = {}


def _compiled(source: str) -> ModuleType:
    """The module of a source, written to the cache folder so that numba can keep its machine code beside it."""
    import numba

    digest = hashlib.sha256(
        f"{numba.__version__} {np.__version__} {sys.version}\n{source}".encode()
    ).hexdigest()[:16]
    if digest not in _MODULES:
        path = _cache_folder() / f"kernel_{digest}.py"
        if not path.exists():
            handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
            with os.fdopen(handle, "w") as file:
                file.write(source)
            os.replace(temporary, path)
        spec = importlib.util.spec_from_file_location(f"beliefgym_kernel_{digest}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # where numba looks a kept function's module up
        spec.loader.exec_module(module)
        _MODULES[digest] = module
    return _MODULES[digest]


def _cache_folder() -> Path:
    """The user's cache folder; a temporary one where it cannot be written."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "beliefgym" / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        global _TEMPORARY
        if _TEMPORARY is None:
            _TEMPORARY = tempfile.TemporaryDirectory(prefix="beliefgym-kernels-")
        return Path(_TEMPORARY.name)


_TEMPORARY: tempfile.TemporaryDirectory[str] | None = None
