"""Sequence data and the models fitted to it; knows no Gymnasium."""

from typing import TYPE_CHECKING, Any

from beliefgym.learning.data_as_demonstrator import DataAsDemonstrator
from beliefgym.learning.delay_embedding import delay_embedding
from beliefgym.learning.direct_multi_step import DirectMultiStep
from beliefgym.learning.dynamics import DivergenceWarning, DynamicsModel
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.multi_step_error import MultiStepErrors, multi_step_errors
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.scheduled_sampling import ScheduledSampling
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.sequences_csv import from_csv, to_csv
from beliefgym.learning.sequences_minari import from_minari, to_minari
from beliefgym.learning.sequences_npz import load_npz, save_npz
from beliefgym.learning.video_frames import read_frames, split_video
from beliefgym.learning.video_textures import VideoTexture
from beliefgym.learning.windows import Transitions, Windows

if TYPE_CHECKING:
    from beliefgym.learning.backprop_through_time import (
        BackpropThroughTime,
        LaggedError,
        WeightedMultiHorizon,
    )

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

_NEED_TORCH = ("BackpropThroughTime", "LaggedError", "WeightedMultiHorizon")


def __getattr__(name: str) -> Any:
    """The models that need torch, which takes a second to import, when they are asked for."""
    if name in _NEED_TORCH:
        from beliefgym.learning import backprop_through_time

        return getattr(backprop_through_time, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
