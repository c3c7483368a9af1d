"""Trained filters in one file of plain arrays: `save_filter` and `load_filter`.

A file is a .safetensors file: the arrays of a filter (coordinates, coefficients, first belief, bounds, history) under
the names of its attributes, and in its metadata, as JSON, the version of this format, the filter's class and its
parameters. Nothing of it is run when it is read, and every array is checked for its shape and its numbers. A loaded
filter filters, predicts and forecasts as the saved one, to the last bit on the same machine. It holds no sums: it does
not learn on, and `PSIM.partial_fit` says so.

A filter of hints keeps the pre-image that was chosen: as its parameter too, where there were several to choose from.

Parameters come back as they were, but tuples and ranges as lists, and a random_state that is a generator as None. A
`BackpropPSIM` comes back without `psim_`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from beliefgym.learning.action_coding import ActionCoding
from beliefgym.learning.filter_archive import Archive, Shape, from_plain, plain
from beliefgym.learning.filters import Filter
from beliefgym.learning.future_features import FirstMoments, SecondMoments
from beliefgym.learning.hint_files import hints_layout
from beliefgym.learning.linear_gaussian import LinearGaussianSystem, StationaryGain, WhitenedObservation
from beliefgym.learning.psim_actions import ObservationsAndActions
from beliefgym.learning.whole_files import written_whole

FORMAT_VERSION = 1
HEADER = "beliefgym_filter"
OF_PSIM = (
    "n_future",
    "features",
    "target",
    "standardise",
    "belief_limit",
)  # what a BackpropPSIM takes from its PSIM


def save_filter(filter: Filter, path: str | os.PathLike[str]) -> Path:
    """Write a fitted filter to one file; an existing file is replaced in one move.

    Args:
        filter: a `PSIM`, `PSIMActions`, `ConditionalPSIM`, `ForwardPSIM`, `BackpropPSIM`, `PSIMHints` or
            `InferenceMachineFilter` with features "first" or "second", a `KalmanFilter`, `N4SID`,
            `InstrumentalVariableRegression` or `AutoregressiveFilter`; its regressors, if any, `Ridge` or
            `RandomFourierRidge`.
        path: the file, used as it is (no ending is added; ".safetensors" is usual).

    Returns:
        The path.

    Raises:
        TypeError: another filter, regressor or features; nothing is written. NotFittedError.
        ValueError: a filter that holds NaN, or whose parameters were changed after the fit.
        FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    kind = type(filter).__name__
    if kind not in LAYOUTS:
        raise TypeError(f"expected one of {', '.join(LAYOUTS)} to save, got {kind}")
    filter._check_fitted()
    is_known = kind == "KalmanFilter" and getattr(filter, "method", None) == "known"
    header: dict[str, Any] = {"version": FORMAT_VERSION, "column_major": []}
    header |= plain(filter, leaving=("system",) if is_known else ("preimage",))
    archive = Archive(f"this {kind}", header, {}, is_loading=False)
    archive.whole(filter, "n_obs_")
    _begin_actions(filter, archive)
    LAYOUTS[kind](filter, archive)
    _shown(filter, archive)
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"cannot write {path}: the folder {path.parent} does not exist; create it first"
        )
    with written_whole(path) as file:
        file.write(save(archive.arrays, metadata={HEADER: json.dumps(header)}))
    return path


def load_filter(path: str | os.PathLike[str]) -> Any:
    """Read what `save_filter` wrote.

    Returns:
        The filter: a `PSIM` where a `PSIM` was saved.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a damaged file or another kind of file, a later version of the format, an array that is missing, of
            another shape, or with NaN.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; expected one written by save_filter")
    text, arrays = _read(path)
    try:
        header = json.loads(text)
        _check_version(path, header["version"])
        if header["class"] not in LAYOUTS:
            raise ValueError(f"{path}: expected one of {', '.join(LAYOUTS)}, got {header['class']!r}")
        filter = from_plain(header)
        archive = Archive(str(path), header, arrays, is_loading=True)
        filter.n_obs_ = archive.number("n_obs_")
        _begin_actions(filter, archive)
        LAYOUTS[header["class"]](filter, archive)
        _shown(filter, archive)
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged: its header is unreadable ({error!r}); write it again"
        ) from error
    return filter


def _read(path: Path) -> tuple[str, dict[str, NDArray[Any]]]:
    """The header's text and the arrays."""
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()} if HEADER in metadata else {}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path} is damaged or not a .safetensors file ({error}); expected one written by save_filter"
        ) from error
    if HEADER not in metadata:
        raise ValueError(f"{path} was not written by save_filter: it holds no {HEADER!r} in its metadata")
    return metadata[HEADER], arrays


def _check_version(path: Path, version: Any) -> None:
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise ValueError(
            f"{path} is damaged: expected a version of the format, got {version!r}; write it again"
        )
    if version > FORMAT_VERSION:
        raise ValueError(
            f"{path} has version {version} of the format, and this beliefgym reads up to {FORMAT_VERSION}; update "
            "beliefgym"
        )


def _begin_actions(filter: Any, archive: Archive) -> None:
    """Names, and the coding of actions where an update takes them."""
    for name in ("observation_names_", "action_names_"):
        if archive.is_loading:
            told = archive.header.get(name)  # files of before do not say
            setattr(filter, name, None if told is None else tuple(str(one) for one in told))
        else:
            held = getattr(filter, name)
            archive.header[name] = None if held is None else list(held)
    if filter.action_timing == "none":
        return
    archive.whole(filter, "n_act_")
    if archive.is_loading:
        filter._action_coding = ActionCoding.__new__(ActionCoding)
        filter._action_coding.n_choices = filter.n_choices
    size = filter.n_act_ if filter.n_choices is None else filter.n_choices
    archive.scale(filter._action_coding, "scale", size)


def _shown(filter: Any, archive: Archive) -> None:
    """The scale of what agents are shown, where it is known."""
    if not archive.is_loading:
        archive.header["has_belief_scale"] = filter.belief_scale_ is not None
    if archive.header.get("has_belief_scale", False):
        archive.scale(filter, "belief_scale_", filter.summary_size)


def _predictive(filter: Any, archive: Archive) -> tuple[int, int]:
    """What predictive state filters share; the features and the regressor's inputs."""
    k, d = filter.n_future, filter.n_obs_
    if not isinstance(k, int | np.integer) or k < 1 or filter.features not in ("first", "second"):
        raise ValueError(
            f"{archive.name}: expected n_future of at least 1 and features 'first' or 'second', got {k!r} and "
            f"{filter.features!r}"
        )
    size = k * d if filter.features == "first" else 2 * k * d
    is_joint = getattr(filter, "state", None) == "joint"
    if is_joint:
        size += k * n_code(filter)
    archive.scale(filter, "_scale", d)
    archive.array(filter, "_first_belief", (size,))
    if archive.is_loading:
        filter._phi = FirstMoments.__new__(FirstMoments if filter.features == "first" else SecondMoments)
        FirstMoments.__init__(filter._phi, int(k), d)
        if is_joint:
            filter._phi = ObservationsAndActions(int(k), d, n_code(filter))
    if filter.features == "second":
        archive.scale(filter._phi, "squares", k * d)
    archive.history(filter)
    return size, size + d + n_code(filter)


def n_code(filter: Any) -> int:
    """Numbers that a coded action adds to the inputs of an update."""
    return 0 if filter.action_timing == "none" else int(filter._action_coding.size)


def _psim(filter: Any, archive: Archive) -> None:
    size, n_inputs = _predictive(filter, archive)
    archive.array(filter, "_bound", (size,), holds="infinite")
    archive.whole(filter, "best_iteration_")
    filter.model_ = archive.regressor("model_", getattr(filter, "model_", None), n_inputs, size)


def _psim_actions(filter: Any, archive: Archive) -> None:
    _psim(filter, archive)
    archive.array(filter, "effective_samples_", (int(filter.n_future),))
    if archive.is_loading:
        filter._target_block = None


def _conditional_psim(filter: Any, archive: Archive) -> None:
    _psim_actions(filter, archive)
    k, size = int(filter.n_future), int(filter.n_future) * filter.n_obs_
    each = n_code(filter) * (1 if filter.effects == "constant" else 1 + size)
    archive.array(filter, "effects_", ((k - 1) * each, size))


def _backprop_psim(filter: Any, archive: Archive) -> None:
    for name in OF_PSIM:
        if archive.is_loading:
            setattr(filter, name, archive.header[name])
        else:
            archive.header[name] = getattr(filter, name)
    _psim(filter, archive)
    archive.whole(filter, "best_epoch_")
    if archive.is_loading:
        filter.psim_ = None


def _forward_psim(filter: Any, archive: Archive) -> None:
    size, n_inputs = _predictive(filter, archive)
    archive.array(filter, "_bound", (size + 1,), holds="infinite")
    archive.whole(filter, "n_steps_")
    models = [None] * filter.n_steps_ if archive.is_loading else filter.model_
    filter.model_ = [
        archive.regressor(f"model_.{t}", model, n_inputs, size) for t, model in enumerate(models)
    ]


def _autoregressive(filter: Any, archive: Archive) -> None:
    d = filter.n_obs_
    size = filter.n_past * d
    archive.scale(filter, "_scale", d)
    archive.array(filter, "_first", (size,))
    archive.array(filter, "_bound", (size,), holds="infinite")
    filter.model_ = archive.regressor("model_", getattr(filter, "model_", None), size, d)


def _linear(filter: Any, archive: Archive) -> None:
    from beliefgym.learning.linear_filter import SystemMatrices

    d = filter.n_obs_
    held = getattr(filter, "system_matrices_", None)
    n = archive.number("belief_size", None if held is None else len(held.first))
    shapes: dict[str, Shape] = {
        "transition": (n, n),
        "observation": (d, n),
        "gain": (n, d),
        "drift": (n,),
        "mean": (d,),
    }
    shapes |= {"first": (n,), "innovation_covariance": (d, d)}
    archive.scale(filter, "_scale", d)
    archive.parts(filter, "system_matrices_", SystemMatrices, shapes)
    filter._use(filter.system_matrices_)
    archive.array(filter, "_bound", (n,), holds="infinite")
    archive.array(filter, "_centre", (d,))
    n_varying = archive.number("n_varying", len(getattr(filter, "_varying", ())))
    archive.array(filter, "_varying", (n_varying,), dtype=np.int64)
    n_values = archive.number("n_singular_values", len(getattr(filter, "singular_values_", ())))
    archive.array(filter, "singular_values_", (n_values,))
    for name in ("n_states_", "rank_"):
        archive.whole(filter, name)
    if archive.is_loading:
        filter.errors_by_rank_ = {
            int(rank): float(error) for rank, error in archive.header["errors_by_rank_"]
        }
    else:
        archive.header["errors_by_rank_"] = [[int(r), float(e)] for r, e in filter.errors_by_rank_.items()]


def _instrumental(filter: Any, archive: Archive) -> None:
    _linear(filter, archive)
    rows = (filter.n_future + 1) * len(filter._varying)
    archive.array(filter, "_extension", (rows, len(filter.system_matrices_.first)))
    archive.array(filter, "_mean", (rows,))


def _kalman(filter: Any, archive: Archive) -> None:
    d = filter.n_obs_
    n = archive.number("system_states", None if archive.is_loading else filter.system_.n_states)
    r = min(d, n)
    archive.scale(filter, "_scale", d)
    archive.scale(filter, "_state_scale", n)
    shapes: dict[str, Shape] = {
        "transition_matrix": (n, n),
        "observation_matrix": (d, n),
        "transition_covariance": (n, n),
    }
    shapes |= {"observation_covariance": (d, d), "initial_mean": (n,), "initial_covariance": (n, n)}
    archive.parts(filter, "system_", LinearGaussianSystem, shapes)
    shapes = {"matrix": (r, n), "projection": (r, d), "whitening": (d, d), "basis": (d, r)}
    archive.parts(filter, "_whitened", WhitenedObservation, shapes)
    shapes = {"gain": (n, d), "innovation_covariance": (d, d), "predicted_covariance": (n, n)}
    if archive.is_loading:
        filter._limit = None
    if filter.stationary:
        archive.parts(filter, "_limit", StationaryGain, shapes)
    archive.history(filter)
    archive.whole(filter, "best_iteration_")
    if archive.is_loading and filter.method == "known":
        filter.system = filter.system_


LAYOUTS: dict[str, Callable[[Any, Archive], None]] = {
    "PSIM": _psim,
    "PSIMActions": _psim_actions,
    "ConditionalPSIM": _conditional_psim,
    "ForwardPSIM": _forward_psim,
    "BackpropPSIM": _backprop_psim,
    "AutoregressiveFilter": _autoregressive,
    "KalmanFilter": _kalman,
    "N4SID": _linear,
    "InstrumentalVariableRegression": _instrumental,
    "PSIMHints": hints_layout,
    "InferenceMachineFilter": hints_layout,
}
