"""How `save_filter` lays out a `PSIMHints` or an `InferenceMachineFilter`."""

from __future__ import annotations

from typing import Any

from beliefgym.learning.filter_archive import Archive, from_plain
from beliefgym.learning.hint_features import FromBelief, HintMoments
from beliefgym.learning.hint_reading import HintReading, ResidualVariance


def hints_layout(filter: Any, archive: Archive) -> None:
    """A PSIM's, the features of hints, and how they are read."""
    d, k, header = filter.n_obs_, filter.n_future, archive.header
    if filter.features not in ("first", "second"):
        raise TypeError(
            f"{archive.name}: expected features 'first' or 'second' to save, got {filter.features!r}"
        )
    archive.whole(filter, "n_hint_")
    n_hint = filter.n_hint_
    archive.scale(filter, "_scale", d)
    archive.scale(filter, "_hint_scale", n_hint)
    if archive.is_loading:
        filter._phi = HintMoments(filter.n_hints, n_hint, k, d)
        filter._reading = HintReading()
        filter._reading.variance = ResidualVariance()
        filter.hint_names_ = None if header["hint_names"] is None else tuple(header["hint_names"])
        filter._reading.errors = dict(header["preimage_errors"])
        filter._reading.name = str(header["preimage_name"])
        filter._reading.variance.penalty = float(header["variance_penalty"])
    else:
        header["hint_names"] = None if filter.hint_names_ is None else list(filter.hint_names_)
        header["preimage_errors"] = filter._reading.errors
        header["preimage_name"] = filter._reading.name
        header["variance_penalty"] = filter._reading.variance.penalty
    if filter.features == "second":
        archive.scale(filter._phi, "squares", filter._phi.n_first)
    size = filter._phi.size
    archive.array(filter, "_first_belief", (size,))
    archive.array(filter, "_bound", (size,), holds="infinite")
    archive.history(filter)
    archive.whole(filter, "best_iteration_")
    n_inputs = size + d + (filter._action_coding.size if filter.use_actions else 0)
    filter.model_ = archive.regressor("model_", getattr(filter, "model_", None), n_inputs, size)
    reading, variance = filter._reading, filter._reading.variance
    is_read = reading.name == "belief"
    if is_read and archive.is_loading:
        reading.model = FromBelief(filter._phi, filter.hint_weight)
    elif not is_read:
        reading.model = archive.regressor("preimage_", getattr(reading, "model", None), size, n_hint)
    if not k:
        filter._observer = archive.regressor("_observer", getattr(filter, "_observer", None), size, d)
    for name in ("centre", "spread"):
        archive.array(variance, name, (2 * size,), under=f"variance.{name}")
    archive.array(variance, "weights", (2 * size, n_hint), under="variance.weights")
    archive.array(variance, "offset", (n_hint,), under="variance.offset")
    for name in ("low", "high"):
        archive.array(variance, name, (n_hint,), holds="infinite", under=f"variance.{name}")
    n_gaps = archive.number("n_gaps", None if archive.is_loading else len(filter.gap_growth_))
    archive.array(filter, "gap_growth_", (n_gaps, n_hint))
    for name in ("prior_mean_", "prior_std_"):
        archive.array(filter, name, (n_hint,))
    if archive.is_loading:
        filter.preimage_, filter.preimage_errors_ = reading.model, reading.errors
        filter.preimage = "belief" if is_read else from_plain(header["preimage_"])
