"""Filters with actions in files, as scikit-learn estimators, and what they tell of data that do not fit."""

import json
import pickle

import numpy as np
import pytest
from filters_with_actions import FILTERS, PRESENT, PREVIOUS, WITH_ACTIONS, fitted, recorded
from safetensors import safe_open
from safetensors.numpy import save
from sklearn.base import clone

from beliefgym.learning import Sequences, load_filter, save_filter
from beliefgym.learning.action_coding import ActionCoding
from beliefgym.learning.hint_estimator import HintEstimator
from beliefgym.learning.psim_stream import LearningStream

each = pytest.mark.parametrize("name", FILTERS)
with_actions = pytest.mark.parametrize("name", WITH_ACTIONS)


def uses(filter, test):
    """What a filter says of trajectories, by name."""
    beliefs = filter.beliefs(test)
    found = {"beliefs": beliefs, "forecast": filter.forecast(beliefs[:, 4], 7, test.actions[:, 4:])}
    found |= {"summaries": filter.summaries(test), "errors": filter.errors(test, 3).squared}
    if hasattr(filter, "estimate_hints"):
        found |= dict(zip(("mean", "std"), filter.estimate_hints(test), strict=True))
    return found


@each
def test_a_loaded_filter_is_the_saved_one_to_the_last_bit(name, tmp_path):
    filter, test = fitted(name), recorded(name, 4, seed=5)
    loaded = load_filter(save_filter(filter, tmp_path / "f"))
    assert type(loaded) is type(filter)
    assert repr(loaded) == repr(filter)
    expected = uses(filter, test)
    for what, found in uses(loaded, test).items():
        np.testing.assert_array_equal(found, expected[what], err_msg=what)
    assert (loaded.n_act_, loaded.action_timing) == (filter.n_act_, filter.action_timing)
    assert loaded.observation_names_ == ("position",)
    assert loaded.action_names_ == (("force",) if name in WITH_ACTIONS else None)
    for attribute in ("effects_", "effective_samples_", "gap_growth_"):
        if hasattr(filter, attribute):
            np.testing.assert_array_equal(getattr(loaded, attribute), getattr(filter, attribute))
    again = save_filter(loaded, tmp_path / "g")
    assert again.read_bytes() == (tmp_path / "f").read_bytes()
    if name in PREVIOUS:
        one, other = HintEstimator(filter), HintEstimator(loaded)
        for t in range(5):
            rows = test.observations[0, t], test.actions[0, t - 1] if t else None
            np.testing.assert_array_equal(other.update(*rows).mean, one.update(*rows).mean)
    loaded.fit(recorded(name, 12))  # and can be fitted anew


def rewritten(path, change):
    """The file once more, with its header and arrays changed."""
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["beliefgym_filter"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    change(header, arrays)
    path.write_bytes(save(arrays, metadata={"beliefgym_filter": json.dumps(header)}))
    return path


@pytest.mark.parametrize("name", ["without", "hints without"])
def test_files_from_before_there_were_actions_are_read(name, tmp_path):
    """They hold no names, no scale of what is shown, and no parameters of actions."""

    def older(header, arrays):
        for key in ("observation_names_", "action_names_", "has_belief_scale"):
            del header[key]
        for key in ("use_actions", "n_choices"):
            header["parameters"].pop(key, None)
        for key in [key for key in arrays if key.startswith("belief_scale_")]:
            del arrays[key]

    filter, test = fitted(name), recorded(name, 4, seed=5)
    loaded = load_filter(rewritten(save_filter(filter, tmp_path / "f"), older))
    np.testing.assert_array_equal(loaded.beliefs(test), filter.beliefs(test))
    belief = filter.beliefs(test)[:, 3]
    np.testing.assert_array_equal(loaded.forecast(belief, 6), filter.forecast(belief, 6))
    assert loaded.observation_names_ is None
    assert loaded.belief_scale_ is None
    np.testing.assert_array_equal(loaded.summary(belief), belief)
    assert loaded.action_timing == "none"


DAMAGED = {
    "coding": ("plain", lambda h, a: a.pop("scale.scale"), "has no array 'scale.scale'"),
    "coding shape": (
        "choices",
        lambda h, a: a.update({"scale.offset": np.zeros(3)}),
        r"scale.offset: expected shape \(4,\), got \(3,\)",
    ),
    "shown": ("plain", lambda h, a: a.pop("belief_scale_.offset"), "has no array 'belief_scale_.offset'"),
    "effects": (
        "conditional",
        lambda h, a: a.update({"effects_": np.zeros((3, 3))}),
        r"effects_: expected shape \(2, 3\), got \(3, 3\)",
    ),
    "shares": ("weighted", lambda h, a: a.pop("effective_samples_"), "has no array 'effective_samples_'"),
    "columns": (
        "plain",
        lambda h, a: h.update({"n_act_": 2}),
        r"scale.offset: expected shape \(2,\), got \(1,\)",
    ),
    "timing": ("hints", lambda h, a: h["parameters"].update({"use_actions": False}), "expected shape"),
    "state": ("joint", lambda h, a: h["parameters"].update({"state": "observations"}), "expected shape"),
}


@pytest.mark.parametrize("case", list(DAMAGED))
def test_a_damaged_file_is_told(case, tmp_path):
    name, change, message = DAMAGED[case]
    path = rewritten(save_filter(fitted(name), tmp_path / "f"), change)
    with pytest.raises(ValueError, match=message):
        load_filter(path)


@each
def test_it_is_a_scikit_learn_estimator(name):
    """A clone with the same parameters fits to the same filter; the data decide nothing of them."""
    filter, test = fitted(name), recorded(name, 4, seed=5)
    parameters = filter.get_params()
    assert repr(filter) == repr(FILTERS[name])
    assert repr(filter).startswith(f"{type(filter).__name__}(")
    again = clone(filter)
    assert not again.__sklearn_is_fitted__()
    assert repr(again.get_params()) == repr(parameters)
    again.fit(recorded(name, 40), recorded(name, 10, seed=1))
    np.testing.assert_array_equal(again.beliefs(test), filter.beliefs(test))
    changed = type(filter)().set_params(**clone(filter).get_params())
    assert repr(changed) == repr(filter)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(filter)).summaries(test), filter.summaries(test))


@pytest.mark.parametrize("name", WITH_ACTIONS)
def test_actions_that_do_not_fit_are_told(name):
    filter, test = fitted(name), recorded(name, 4, seed=5)
    belief, x, a = filter.beliefs(test)[:, 3], test.observations[:, 3], test.actions[:, 3]
    for wrong, message in (
        (a[:3], r"action: expected shape \(4, 1\), got \(3, 1\)"),
        (a[:, 0], r"action: expected shape \(4, 1\), got \(4,\)"),
        (np.hstack([a, a]), r"action: expected shape \(4, 1\), got \(4, 2\)"),
        (
            np.where(np.arange(4)[:, None] == 2, np.nan, a),
            r"action: expected finite numbers, got nan at index \(2, 0\)",
        ),
        (a + np.inf, r"action: expected finite numbers, got inf at index \(0, 0\)"),
    ):
        with pytest.raises(ValueError, match=message):
            filter.update(belief, x, wrong)
    if filter.n_choices:
        with pytest.raises(ValueError, match=r"whole numbers from 0 to 3 \(n_choices = 4\), got 4.0"):
            filter.update(belief, x, np.full((4, 1), 4.0))
    two = Sequences(test.observations, np.dstack([test.actions] * 2), test.rewards, hints=test.hints)
    none = Sequences(
        test.observations,
        test.actions[:, :, :0],
        test.rewards,
        hints=test.hints,
        action_log_probs=test.action_log_probs,
    )
    for call in (filter.beliefs, filter.errors, filter.summaries):
        for data, n in ((two, 2), (none, 0)):
            with pytest.raises(ValueError, match=f"trajectories with 1 actions as at fit, got {n}"):
                call(data)
    with pytest.raises(
        ValueError, match="expected trajectories with actions, got Sequences.*without them is PSIM"
    ):
        clone(filter).set_params(n_choices=None).fit(none)
    with pytest.raises(ValueError, match="expected validation with 1 actions as in training, got 2"):
        clone(filter).fit(recorded(name, 10), two)


@pytest.mark.parametrize("name", PRESENT)
def test_an_update_that_takes_the_present_action_needs_it_and_a_forecast_takes_enough_or_none(name):
    filter, test = fitted(name), recorded(name, 4, seed=5)
    belief, x, a = filter.beliefs(test)[:, 3], test.observations[:, 3], test.actions
    message = (
        rf"action \(n, 1\) taken at this observation, got None: this {type(filter).__name__} was fitted with"
    )
    with pytest.raises(ValueError, match=message):
        filter.update(belief, x)
    for wrong in (a[:, :3], a[:3], a[:, :, 0], np.dstack([a, a])):
        with pytest.raises(ValueError, match=r"actions: expected shape \(4, at least 4, 1\), got"):
            filter.forecast(belief, 5, wrong)
    holed = a.copy()
    holed[1, 2] = np.nan
    with pytest.raises(ValueError, match=r"actions: expected finite numbers, got nan at index \(1, 2, 0\)"):
        filter.forecast(belief, 5, holed)
    assert filter.forecast(belief, 1, a[:, :0]).shape == (4, 1, 1)
    if filter.target == "next":
        assert filter.forecast(belief[:0], 5, a[:0]).shape == (0, 5, 1)


def test_without_actions_only_what_cannot_be_actions_is_refused():
    filter, test = fitted("without"), recorded("without", 4, seed=5)
    belief, x = filter.beliefs(test)[:, 3], test.observations[:, 3]
    for wrong in (test.actions[:3, 3], test.actions[:, 3, 0]):
        with pytest.raises(ValueError, match=r"action: expected shape \(4, n_act\), got"):
            filter.update(belief, x, wrong)


@pytest.mark.parametrize("name", ["plain", "weighted", "conditional", "hints"])
def test_a_stream_that_learns_takes_no_actions(name):
    kind = type(fitted(name)).__name__
    with pytest.raises(TypeError, match=f"expected a PSIM without actions, got a {kind} fitted with them"):
        LearningStream(fitted(name))


@pytest.mark.parametrize("name", PREVIOUS)
def test_an_estimator_tells_what_is_wrong_with_an_action_and_stays_as_it_was(name):
    filter, test = fitted(name), recorded(name, 4, seed=5)
    estimator = HintEstimator(filter)
    x, a = test.observations[0], test.actions[0]
    estimator.update(x[0])  # there is none before the first
    before = estimator.belief
    for wrong, message in (
        (
            None,
            r"expected the action \(n_act,\) = \(1,\) before this observation, got None: this \w+ was fitted",
        ),
        (a[:1], r"action: expected shape \(n_act,\), got \(1, 1\)"),
        (np.zeros(2), r"action: expected shape \(1, 1\), got \(1, 2\)"),
        ([np.nan], "action: expected finite numbers, got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            estimator.update(x[1], wrong)
    np.testing.assert_array_equal(estimator.belief, before)
    assert estimator.n_seen == 1


def test_a_filter_fitted_anew_without_actions_needs_none():
    """Nothing of the earlier fit is left, in its stream either, where one that leaves its bounds goes the slow way."""
    filter = clone(fitted("hints")).fit(recorded("hints", 20)).set_params(use_actions=False)
    filter.fit(recorded("hints", 20))
    fresh = clone(fitted("hints without")).fit(recorded("hints", 20))
    test = recorded("hints", 2, seed=5)
    np.testing.assert_array_equal(filter.beliefs(test), fresh.beliefs(test))
    assert filter.n_act_ == 0
    assert filter.action_names_ is None
    estimator = HintEstimator(filter, missing="predict")
    estimator.update(test.observations[0, 0])
    estimator.update([np.nan])


def test_choices_that_are_none_are_told():
    with pytest.raises(ValueError, match="expected choices in one column, got actions of 2"):
        ActionCoding.of(np.zeros((3, 2)), 2)
    for wrong in (-1.0, 0.5, 2.0):
        with pytest.raises(ValueError, match=rf"whole numbers from 0 to 1 \(n_choices = 2\), got {wrong}"):
            ActionCoding.of(np.array([[0.0], [wrong]]), 2)
