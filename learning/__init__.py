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
    from beliefgym.learning.autoregressive_filter import AutoregressiveFilter
    from beliefgym.learning.backprop_through_time import (
        BackpropThroughTime,
        LaggedError,
        WeightedMultiHorizon,
    )
    from beliefgym.learning.belief_tracker import BeliefTracker
    from beliefgym.learning.data_as_demonstrator import DataAsDemonstrator
    from beliefgym.learning.direct_multi_step import DirectMultiStep
    from beliefgym.learning.dynamics import DivergenceWarning, DynamicsModel
    from beliefgym.learning.filter_diagnostics import (
        calibration,
        error_over_time,
        filter_jacobian,
        look_ahead_errors,
        spectral_radius,
        stability,
    )
    from beliefgym.learning.filter_errors import FilterErrors
    from beliefgym.learning.filter_files import load_filter, save_filter
    from beliefgym.learning.filters import Filter
    from beliefgym.learning.hint_autoregressive import AutoregressiveHints
    from beliefgym.learning.hint_errors import HintErrors
    from beliefgym.learning.hint_estimator import HintEstimator
    from beliefgym.learning.hint_filter import HintEstimate, HintFilter
    from beliefgym.learning.hint_kalman import KalmanHints
    from beliefgym.learning.hint_recurrent import GRUHints, LSTMHints
    from beliefgym.learning.instrumental_regression import InstrumentalVariableRegression
    from beliefgym.learning.kalman_filter import KalmanFilter
    from beliefgym.learning.linear_gaussian import LinearGaussianSystem
    from beliefgym.learning.linear_in_features import Ridge
    from beliefgym.learning.multi_step_error import MultiStepErrors, multi_step_errors
    from beliefgym.learning.polynomial import PolynomialRidge
    from beliefgym.learning.psim import PSIM
    from beliefgym.learning.psim_actions import PSIMActions
    from beliefgym.learning.psim_backprop import BackpropPSIM
    from beliefgym.learning.psim_conditional import ConditionalPSIM
    from beliefgym.learning.psim_forward import ForwardPSIM
    from beliefgym.learning.psim_hints import InferenceMachineFilter, PSIMHints
    from beliefgym.learning.psim_stream import LearningStream
    from beliefgym.learning.random_forest import RandomForest
    from beliefgym.learning.random_fourier import RandomFourierRidge
    from beliefgym.learning.recurrent_filter import GRUFilter, LSTMFilter
    from beliefgym.learning.scheduled_sampling import ScheduledSampling
    from beliefgym.learning.subspace_identification import N4SID
    from beliefgym.learning.video_textures import VideoTexture

__all__ = [
    "N4SID",
    "PSIM",
    "AutoregressiveFilter",
    "AutoregressiveHints",
    "BackpropPSIM",
    "BackpropThroughTime",
    "BeliefTracker",
    "ConditionalPSIM",
    "DataAsDemonstrator",
    "DirectMultiStep",
    "DivergenceWarning",
    "DynamicsModel",
    "Filter",
    "FilterErrors",
    "ForwardPSIM",
    "GRUFilter",
    "GRUHints",
    "HintErrors",
    "HintEstimate",
    "HintEstimator",
    "HintFilter",
    "InferenceMachineFilter",
    "InstrumentalVariableRegression",
    "KalmanFilter",
    "KalmanHints",
    "LSTMFilter",
    "LSTMHints",
    "LaggedError",
    "LearningStream",
    "LinearGaussianSystem",
    "MultiStepErrors",
    "PSIMActions",
    "PSIMHints",
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
    "calibration",
    "delay_embedding",
    "error_over_time",
    "filter_jacobian",
    "from_csv",
    "from_minari",
    "load_filter",
    "load_npz",
    "look_ahead_errors",
    "multi_step_errors",
    "read_frames",
    "save_filter",
    "save_npz",
    "spectral_radius",
    "split_video",
    "stability",
    "to_csv",
    "to_minari",
]

_MODULES = {
    "AutoregressiveFilter": "autoregressive_filter",
    "AutoregressiveHints": "hint_autoregressive",
    "BackpropPSIM": "psim_backprop",
    "BackpropThroughTime": "backprop_through_time",
    "BeliefTracker": "belief_tracker",
    "ConditionalPSIM": "psim_conditional",
    "DataAsDemonstrator": "data_as_demonstrator",
    "DirectMultiStep": "direct_multi_step",
    "DivergenceWarning": "dynamics",
    "DynamicsModel": "dynamics",
    "Filter": "filters",
    "FilterErrors": "filter_errors",
    "ForwardPSIM": "psim_forward",
    "GRUFilter": "recurrent_filter",
    "GRUHints": "hint_recurrent",
    "HintErrors": "hint_errors",
    "HintEstimate": "hint_filter",
    "HintEstimator": "hint_estimator",
    "HintFilter": "hint_filter",
    "InferenceMachineFilter": "psim_hints",
    "InstrumentalVariableRegression": "instrumental_regression",
    "KalmanFilter": "kalman_filter",
    "KalmanHints": "hint_kalman",
    "LSTMFilter": "recurrent_filter",
    "LSTMHints": "hint_recurrent",
    "LaggedError": "backprop_through_time",
    "LearningStream": "psim_stream",
    "LinearGaussianSystem": "linear_gaussian",
    "MultiStepErrors": "multi_step_error",
    "N4SID": "subspace_identification",
    "PSIM": "psim",
    "PSIMActions": "psim_actions",
    "PSIMHints": "psim_hints",
    "PolynomialRidge": "polynomial",
    "RandomForest": "random_forest",
    "RandomFourierRidge": "random_fourier",
    "Ridge": "linear_in_features",
    "ScheduledSampling": "scheduled_sampling",
    "VideoTexture": "video_textures",
    "WeightedMultiHorizon": "backprop_through_time",
    "calibration": "filter_diagnostics",
    "error_over_time": "filter_diagnostics",
    "filter_jacobian": "filter_diagnostics",
    "load_filter": "filter_files",
    "look_ahead_errors": "filter_diagnostics",
    "multi_step_errors": "multi_step_error",
    "save_filter": "filter_files",
    "spectral_radius": "filter_diagnostics",
    "stability": "filter_diagnostics",
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
