"""Estimators, settings and trials as plain data: the way there and back, and what a file cannot do."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from sklearn.base import BaseEstimator
from sklearn.linear_model import BayesianRidge
from sklearn.multioutput import MultiOutputRegressor

from beliefgym.agents.exploration import Exploration
from beliefgym.agents.plain_data import from_plain, to_plain
from beliefgym.agents.policy_synthesis import OpenLoopSynthesis, RecedingHorizonSynthesis, RegulatorSynthesis
from beliefgym.agents.saved_trials import pack, unpack
from beliefgym.envs.planning.open_loop import ProportionalLaw
from beliefgym.learning import DataAsDemonstrator, RandomFourierRidge, Sequences


class Foreign(BaseEstimator):
    """An estimator of somebody else's package."""


@dataclass
class ForeignSettings:
    """Settings of somebody else's package."""

    n: int = 1


def through_json(value):
    return from_plain(json.loads(json.dumps(to_plain(value))))


@pytest.mark.parametrize(
    "value",
    [
        Exploration("epsilon", std=(0.1, 0.2), hold=3, restoring=0.5),
        RecedingHorizonSynthesis(horizon=7, lqr_beyond=True),
        RegulatorSynthesis(horizon=None),
        OpenLoopSynthesis(ProportionalLaw(heading=4, k_turn=3.0), horizon=9),
        None,
        True,
        0.1,
        "text",
        [1, 2.5, None],
    ],
    ids=str,
)
def test_settings_come_back_as_they_were(value):
    again = through_json(value)
    assert again == value
    assert type(again) is type(value)


@pytest.mark.parametrize(
    "estimator",
    [
        RandomFourierRidge(n_frequencies=7, bandwidth=0.1, random_state=3),
        MultiOutputRegressor(BayesianRidge(tol=1e-5)),
        DataAsDemonstrator(RandomFourierRidge(), n_iterations=3, angles=[1]),
    ],
    ids=lambda one: type(one).__name__,
)
def test_estimators_come_back_with_their_parameters_nested_ones_too(estimator):
    again = through_json(estimator)
    assert type(again) is type(estimator)
    assert repr(again.get_params()) == repr(estimator.get_params())
    assert again is not estimator


def test_numpys_numbers_and_arrays_become_pythons():
    plain = to_plain([np.float64(0.5), np.int64(3), np.bool_(True), np.arange(4.0).reshape(2, 2)])
    assert json.dumps(plain) == "[0.5, 3, true, [[0.0, 1.0], [2.0, 3.0]]]"


def test_objects_that_are_no_plain_data_are_handed_through():
    synthesis = RegulatorSynthesis()
    assert from_plain(synthesis) is synthesis
    assert from_plain({"no": "class"}) == {"no": "class"}


@pytest.mark.parametrize(
    "value", [Foreign(), ForeignSettings(), np.sin, object(), {"a": 1}], ids=lambda one: type(one).__name__
)
def test_what_a_file_could_not_be_read_back_from_is_not_written(value):
    with pytest.raises(ValueError, match="the agent can be used, but not saved"):
        to_plain(value)


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "subprocess:Popen",
        "builtins:eval",
        f"{__name__}:Foreign",
        "sklearnish.tree:Tree",  # the dot after the package's name counts
        "beliefgymnastics:run",
        "",
    ],
)
def test_a_class_of_another_package_is_refused(name):
    with pytest.raises(
        ValueError, match="expected a class of beliefgym or scikit-learn in a saved agent, got"
    ):
        from_plain({"class": name})
    with pytest.raises(ValueError, match="expected a class of beliefgym or scikit-learn"):
        from_plain([{"class": "beliefgym.agents.policy_synthesis:OpenLoopSynthesis", "law": {"class": name}}])


@pytest.mark.parametrize(
    "name",
    [
        "sklearn.base:clone",  # a function
        "beliefgym.agents.dad_control:Any",  # what a module imports
        "beliefgym.agents.saved_trials:Path",
        "beliefgym.agents.saved_trials:tempfile",
        "beliefgym.agents.expert:Expert",  # a class that is no settings
    ],
)
def test_only_estimators_and_settings_are_made(name):
    with pytest.raises(ValueError, match="expected an estimator or a settings class in a saved agent, got"):
        from_plain({"class": name})


def test_trials_and_records_come_back_from_their_files_in_order():
    rng = np.random.default_rng(0)
    trials = [
        Sequences.from_observations(rng.normal(size=(1, n + 1, 2)), actions=rng.normal(size=(1, n, 1)))
        for n in (3, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5)  # more than 10: order by number, not by text
    ]
    history = [{"cost": 0.1 + 0.2, "kind": "policy", "terminated": False}]
    models = [{"cost": None, "told": ["a", "b"], "trials": 3}]
    parts = pack(trials, history, models)
    assert all(isinstance(content, bytes) for content in parts.values())
    again, told, records = unpack(dict(reversed(parts.items())))
    assert (told, records) == (history, models)
    assert len(again) == len(trials)
    for one, other in zip(again, trials, strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)
        np.testing.assert_array_equal(one.actions, other.actions)


def test_nothing_tried_is_saved_and_read_too():
    assert unpack(pack([], [], [])) == ([], [], [])
