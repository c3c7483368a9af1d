"""Sequence data and the models fitted to it; knows no Gymnasium."""

from beliefgym.learning.sequences import Sequences
from beliefgym.learning.sequences_minari import from_minari, to_minari
from beliefgym.learning.sequences_npz import load_npz, save_npz
from beliefgym.learning.windows import Transitions, Windows

__all__ = ["Sequences", "Transitions", "Windows", "from_minari", "load_npz", "save_npz", "to_minari"]
