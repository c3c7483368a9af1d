"""The estimators' names in `beliefgym.envs`: there when asked for, and not before."""

import subprocess
import sys

import pytest

import beliefgym.envs as envs

NAMES = ("ComplementaryFilter", "ExtendedKalmanFilter", "ParticleFilter", "UnscentedKalmanFilter")


def test_the_names_are_there_when_asked_for():
    code = (
        "import sys, beliefgym.envs as envs; assert not {'sklearn', 'filterpy', 'torch'} & set(sys.modules); "
        f"[getattr(envs, name) for name in {NAMES}]; assert 'sklearn' in sys.modules; "
        "assert 'filterpy' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert set(NAMES) <= set(envs.__all__) & set(dir(envs))
    from beliefgym.envs import estimators

    assert all(getattr(envs, name) is getattr(estimators, name) for name in NAMES)


def test_a_name_that_is_not_there_is_told():
    wrong = "KalmanFilter"
    with pytest.raises(AttributeError, match=r"module 'beliefgym\.envs' has no attribute 'KalmanFilter'"):
        getattr(envs, wrong)
