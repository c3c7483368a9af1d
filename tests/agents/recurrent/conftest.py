"""Environments that are registered while a test runs."""

import gymnasium as gym
import pytest
from recurrent_cases import Cue, Scripted


@pytest.fixture
def scripted():
    """The id of one whose rewards tell its steps."""
    gym.register("beliefgym-tests/Scripted-v0", entry_point=Scripted, kwargs={"lengths": (5, 12, 9)})
    yield "beliefgym-tests/Scripted-v0"
    del gym.registry["beliefgym-tests/Scripted-v0"]


@pytest.fixture
def cue():
    """The id of one in which the first observation tells the last action."""
    gym.register("beliefgym-tests/Cue-v0", entry_point=Cue)
    yield "beliefgym-tests/Cue-v0"
    del gym.registry["beliefgym-tests/Cue-v0"]
