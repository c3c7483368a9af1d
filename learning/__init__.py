"""Sequence data and the models fitted to it; knows no Gymnasium."""

from beliefgym.learning.data_as_demonstrator import DataAsDemonstrator
from beliefgym.learning.dynamics import DivergenceWarning, DynamicsModel
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.multi_step_error import MultiStepErrors, multi_step_errors
from beliefgym.learning.polynomial import PolynomialRidge
from beliefgym.learning.random_forest import RandomForest
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.sequences_csv import from_csv, to_csv
from beliefgym.learning.sequences_minari import from_minari, to_minari
from beliefgym.learning.sequences_npz import load_npz, save_npz
from beliefgym.learning.video_frames import read_frames, split_video
from beliefgym.learning.video_textures import VideoTexture
from beliefgym.learning.windows import Transitions, Windows

__all__ = [
    "DataAsDemonstrator",
    "DivergenceWarning",
    "DynamicsModel",
    "MultiStepErrors",
    "PolynomialRidge",
    "RandomForest",
    "RandomFourierRidge",
    "Ridge",
    "Sequences",
    "Transitions",
    "VideoTexture",
    "Windows",
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
