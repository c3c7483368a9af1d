"""Sequence data and the models fitted to it; knows no Gymnasium.

The data's names are imported with the package; a model's name imports its module when it is asked for, since
scikit-learn and torch take a second that somebody who only steps environments need not wait for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from beliefgym.learning.delay_embedding import delay_embedding
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.sequences_csv import from_csv, to_csv
from beliefgym.learning.sequences_minari import from_minari, to_minari
from beliefgym.learning.sequences_npz import load_npz, save_npz
from beliefgym.learning.video_frames import read_frames, split_video
from beliefgym.learning.windows import Transitions, Windows

if TYPE_CHECKING:
    from beliefgym.learning.backprop_through_time import (
        BackpropThroughTime,
        LaggedError,
        WeightedMultiHorizon,
    )
    from beliefgym.learning.data_as_demonstrator import DataAsDemonstrator
    from beliefgym.learning.direct_multi_step import DirectMultiStep
    from beliefgym.learning.dynamics import DivergenceWarning, DynamicsModel
    from beliefgym.learning.linear_in_features import Ridge
    from beliefgym.learning.multi_step_error import MultiStepErrors, multi_step_errors
    from beliefgym.learning.polynomial import PolynomialRidge
    from beliefgym.learning.random_forest import RandomForest
    from beliefgym.learning.random_fourier import RandomFourierRidge
    from beliefgym.learning.scheduled_sampling import ScheduledSampling
    from beliefgym.learning.video_textures import VideoTexture

__all__ = [
    "BackpropThroughTime",
    "DataAsDemonstrator",
    "DirectMultiStep",
    "DivergenceWarning",
    "DynamicsModel",
    "LaggedError",
    "MultiStepErrors",
    "PolynomialRidge",
    "RandomForest",
    "RandomFourierRidge",
    "Ridge",
    "ScheduledSampling",
    "Sequences",
    "Transitions",
    "VideoTexture",
    "WeightedMultiHorizon",
    "Windows",
    "delay_embedding",
    "from_csv",
    "from_minari",
    "load_npz",
    "multi_step_errors",
    "read_frames",
    "save_npz",
    "split_video",
    "to_csv",
    "to_minari",
]

_MODULES = {
    "BackpropThroughTime": "backprop_through_time",
    "DataAsDemonstrator": "data_as_demonstrator",
    "DirectMultiStep": "direct_multi_step",
    "DivergenceWarning": "dynamics",
    "DynamicsModel": "dynamics",
    "LaggedError": "backprop_through_time",
    "MultiStepErrors": "multi_step_error",
    "PolynomialRidge": "polynomial",
    "RandomForest": "random_forest",
    "RandomFourierRidge": "random_fourier",
    "Ridge": "linear_in_features",
    "ScheduledSampling": "scheduled_sampling",
    "VideoTexture": "video_textures",
    "WeightedMultiHorizon": "backprop_through_time",
    "multi_step_errors": "multi_step_error",
}


def __getattr__(name: str) -> Any:
    """Import the module of a model when its name is first asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
