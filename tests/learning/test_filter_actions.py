"""Filters with actions: which action an update takes, what forecasts are told, what agents are shown, and hints."""

import numpy as np
import pytest
from by_hand import poison_empty
from controlled_systems import INNOVATION, PREDICTED, C, kalman_states, linear
from filters_with_actions import FILTERS, PRESENT, PREVIOUS, WITH_ACTIONS, fitted, recorded
from sklearn.base import clone

from beliefgym.learning import Sequences
from beliefgym.learning.action_coding import ActionCoding
from beliefgym.learning.hint_estimator import HintEstimator
from beliefgym.learning.hint_gaps import gap_growth
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.linear_in_features import Ridge
from beliefgym.learning.psim_hints import InferenceMachineFilter, PSIMHints

LENGTHS = (10, 4, 0, 14, 1, 7)
each = pytest.mark.parametrize("name", FILTERS)
with_actions = pytest.mark.parametrize("name", WITH_ACTIONS)


def action_at(filter, actions, t):
    """The action (1, n_act) that goes with x_t of one trajectory, or None where there is none."""
    at = t if filter.action_timing == "present" else t - 1
    return actions[None, at] if 0 <= at < len(actions) else None


def stepped(filter, x, actions):
    """m_0 .. m_{L+1} of one trajectory, one update after the other."""
    found = [filter.initial_belief()]
    for t in range(len(x)):
        action = action_at(filter, actions, t)
        if action is None and filter.action_timing == "present":  # after the last one: the average action
            found.append(filter._follow(found[-1], filter._scale.apply(x[None, t]), None))
        else:
            found.append(filter.update(found[-1], x[None, t], action))
    return np.concatenate(found)


@each
def test_whole_ragged_trajectories_are_filtered_as_by_updates(name):
    filter, test = fitted(name), recorded(name, len(LENGTHS), seed=5, lengths=LENGTHS)
    found = filter.beliefs(test)
    for i, L in enumerate(LENGTHS):
        expected = stepped(filter, test.observations[i, : L + 1], test.actions[i, :L])
        # matrix products of one row and of many may round differently
        np.testing.assert_allclose(found[i, : L + 2], expected, rtol=0, atol=1e-11)
        np.testing.assert_allclose(found[i, L + 2 :], np.tile(expected[-1], (14 - L, 1)), rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", [name for name in WITH_ACTIONS if "choices" not in name])
def test_no_action_yet_stands_for_the_average_one(name):
    filter, test = fitted(name), recorded(name, 4, seed=5)
    train = recorded(name, 40)
    average = np.full((4, 1), train.actions.mean())
    belief, x = filter.beliefs(test)[:, 3], test.observations[:, 3]
    expected = filter._follow(belief, filter._scale.apply(x), None)
    np.testing.assert_allclose(filter.update(belief, x, average), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "name", [name for name in PRESENT if "conditional" not in name and name != "bilinear"]
)
def test_a_forecast_steps_the_filter_with_its_own_predictions_and_the_given_actions(name):
    filter, test = fitted(name), recorded(name, 4, seed=5)
    belief, actions = filter.beliefs(test)[:, 3], test.actions[:, 3:]
    following, expected = belief, []
    for step in range(9):
        expected.append(filter.predict_observation(following))
        following = filter.update(following, expected[-1], actions[:, step])
    expected = np.stack(expected, axis=1)
    for horizon in (1, 2, 5, 9):
        for told in (actions, actions[:, : horizon - 1]):  # more than it needs, and no more
            found = filter.forecast(belief, horizon, told)
            np.testing.assert_allclose(found, expected[:, :horizon], rtol=0, atol=1e-10)
    other = filter.forecast(belief, 5, actions[:, ::-1])
    assert np.abs(other - expected[:, :5]).max() > 0.01
    np.testing.assert_array_equal(other[:, 0], filter.forecast(belief, 5, actions)[:, 0])


@each
def test_errors_are_those_of_forecasts_that_are_told_the_actions_taken(name):
    filter, test = fitted(name), recorded(name, len(LENGTHS), seed=5, lengths=LENGTHS)
    beliefs, horizon = filter.beliefs(test), 4
    expected = np.full((len(LENGTHS), 15, horizon), np.nan)
    for i, L in enumerate(LENGTHS):
        for t in range(L + 1):
            ahead = min(horizon, L + 1 - t)
            told = test.actions[i : i + 1, t:L]
            x = filter.forecast(beliefs[i : i + 1, t], ahead, told)[0]
            expected[i, t, :ahead] = np.square(x - test.observations[i, t : t + ahead]).sum(axis=1)
    np.testing.assert_allclose(filter.errors(test, horizon).squared, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("name", [*PREVIOUS, "without", "hints without"])
def test_other_filters_take_actions_to_come_and_do_not_look_at_them(name):
    filter, test = fitted(name), recorded(name, 4, seed=5)
    belief = filter.beliefs(test)[:, 3]
    np.testing.assert_array_equal(filter.forecast(belief, 5, test.actions), filter.forecast(belief, 5))
    if filter.action_timing == "none":
        x = test.observations[:, 3]
        np.testing.assert_array_equal(filter.update(belief, x, test.actions[:, 3]), filter.update(belief, x))
        assert filter.n_act_ == 0


@with_actions
@pytest.mark.parametrize("t", [0, 3, 8])
def test_beliefs_know_neither_the_observations_nor_the_actions_to_come(name, t):
    """m_{t+1} has seen x_t, and a_t where that is the one it takes; nothing of what follows moves it."""
    filter, test = fitted(name), recorded(name, 4, seed=5)
    x, a = test.observations.copy(), test.actions.copy()
    n_known = t + 1 if filter.action_timing == "present" else t  # actions in m_{t+1}
    x[:, t + 1 :] -= 1.0
    a[:, n_known:] = a[:, n_known:][:, ::-1, :]
    a[:, n_known] = 2.0 - a[:, n_known] if filter.n_choices else a[:, n_known] + 3.0
    changed = filter.beliefs(Sequences(x, a, test.rewards))
    known = filter.beliefs(test)
    np.testing.assert_array_equal(changed[:, : t + 2], known[:, : t + 2])
    assert (np.abs(changed - known)[:, t + 2].max(axis=1) > 1e-3).all()


@each
def test_what_stands_past_an_episodes_end_never_matters(name):
    train = recorded(name, 12, seed=2, lengths=(14, 9, 14, 7, 14, 11) * 2)
    pads = ((0, 0), (0, 5), (0, 0))
    arrays = [
        np.pad(one, pads, constant_values=1e3) for one in (train.observations, train.actions, train.hints)
    ]
    longer = Sequences(
        *arrays[:2],
        np.pad(train.rewards, pads[:2]),
        lengths=train.lengths,
        hints=arrays[2],
        action_log_probs=np.pad(train.action_log_probs, pads[:2], constant_values=7.0),
    )
    first, second = (clone(FILTERS[name]).fit(one, one) for one in (train, longer))
    # means over arrays of other shapes
    np.testing.assert_allclose(first.beliefs(train), second.beliefs(longer)[:, :16], rtol=0, atol=1e-9)
    np.testing.assert_allclose(first.belief_scale_.scale, second.belief_scale_.scale, rtol=1e-9)
    np.testing.assert_allclose(first.errors(train, 3).mean, second.errors(longer, 3).mean, rtol=1e-9)


@with_actions
def test_nothing_is_read_before_it_is_written(name, monkeypatch):
    """`np.empty` gives whatever stood in memory; here that is 1e200."""
    train, test = recorded(name, 12, seed=2), recorded(name, 3, seed=3, lengths=(14, 3, 0))
    clean = clone(FILTERS[name]).fit(train)
    poison_empty(monkeypatch)
    again = clone(FILTERS[name]).fit(train)
    np.testing.assert_array_equal(again.summaries(test), clean.summaries(test))
    np.testing.assert_array_equal(again.errors(test, 4).squared, clean.errors(test, 4).squared)


@each
def test_agents_are_shown_beliefs_on_one_scale_that_know_all_there_is_when_they_act(name):
    filter, train = fitted(name), recorded(name, 40)
    test = recorded(name, len(LENGTHS), seed=5, lengths=LENGTHS)
    shown = filter.summaries(train)[train.observation_mask]
    varies = ~filter.belief_scale_.constant
    assert varies.sum() >= 2
    # sums of 600 numbers of about 1
    np.testing.assert_allclose(shown[:, varies].mean(axis=0), 0.0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(shown[:, varies].std(axis=0), 1.0, rtol=1e-11)
    beliefs, summaries = filter.beliefs(test), filter.summaries(test)
    assert summaries.shape == (len(LENGTHS), 15, filter.summary_size)
    for t in range(15):
        known = beliefs[:, t] if filter.action_timing == "present" else beliefs[:, t + 1]
        np.testing.assert_array_equal(summaries[:, t], filter.summary(known))
    assert filter.summary_names == tuple(f"belief_{i}" for i in range(filter.belief_size))


def test_where_no_scale_is_known_beliefs_are_shown_as_they_are():
    kalman = KalmanFilter.of(LinearGaussianSystem([[0.5]], [[1.0]], [[1.0]], [[1.0]]))
    belief = kalman.beliefs(Sequences.from_observations(np.ones((1, 4, 1))))[:, 2]
    shown = kalman.summary(belief)
    np.testing.assert_array_equal(shown, belief)
    shown[:] = 0.0
    assert belief.any()  # a copy


def test_choices_are_unit_vectors_on_one_scale_and_no_action_is_the_average():
    rows = np.array([[0.0], [2.0], [2.0], [0.0], [0.0]])
    code = ActionCoding.of(rows, 4)
    assert code.size == 4
    spread = np.sqrt(0.6 * 0.4)
    found = code(np.array([[0.0], [2.0], [3.0], [np.nan]]))
    expected = [
        [0.4 / spread, 0.0, -0.4 / spread, 0.0],
        [-0.6 / spread, 0.0, 0.6 / spread, 0.0],
        [-0.6 / spread, 0.0, -0.4 / spread, 1.0],  # never taken in training: nothing is known of its scale
        [0.0, 0.0, 0.0, 0.0],
    ]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(code(rows).mean(axis=0), 0.0, rtol=0, atol=1e-14)
    real = ActionCoding.of(np.array([[1.0, 5.0], [3.0, 5.0]]))
    np.testing.assert_allclose(real(np.array([[4.0, 6.0], [np.nan, 0.0]])), [[2.0, 1.0], [0.0, 0.0]])


def exact_hints(test):
    """E[s_t | x_0 .. x_t, a_0 .. a_{t-1}] by the Kalman filter."""
    s = kalman_states(test)
    return s + (test.observations - s @ C.T) @ np.linalg.solve(INNOVATION, C @ PREDICTED)


@pytest.mark.parametrize("kind", [PSIMHints, InferenceMachineFilter])
def test_hints_of_a_pushed_system_are_those_of_the_kalman_filter_that_knows_the_pushes(kind):
    train, test = linear(1000, 30, 0), linear(200, 30, 1)
    least = np.square(exact_hints(test) - test.hints).mean(axis=(0, 1))
    settings = {"n_iterations": 5, "preimage": Ridge()} | ({"n_future": 2} if kind is PSIMHints else {})
    knowing = kind(use_actions=True, **settings).fit(train, train[:100])
    blind = kind(**settings).fit(train, train[:100])
    # measured 1.000 to 1.003; without actions, whose variance is that of all else together, 1.3 and 1.2
    np.testing.assert_allclose(knowing.hint_errors(test).rmse ** 2, least, rtol=0.01)
    assert (blind.hint_errors(test).rmse ** 2 > 1.1 * least).all()


@pytest.mark.parametrize("name", [*PREVIOUS, "hints without"])
def test_a_stream_is_estimated_as_whole_trajectories_are_with_the_action_before_each_observation(name):
    filter, test = fitted(name), recorded(name, 3, seed=5)
    estimator = HintEstimator(filter)
    mean, std = filter.estimate_hints(test)
    for i in (0, 1, 2, 0):
        estimator.reset()
        for t in range(15):
            # the first action is not looked at: it belongs to what came before
            action = test.actions[i, max(t - 1, 0)]
            found = estimator.update(test.observations[i, t], action)
            np.testing.assert_allclose(found.mean, mean[i, t], rtol=0, atol=1e-10)
            np.testing.assert_allclose(found.std, std[i, t], rtol=1e-10)
        np.testing.assert_allclose(estimator.belief, filter.beliefs(test)[i, 15], rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", PREVIOUS)
def test_through_a_gap_a_filter_goes_on_by_its_predictions_and_the_actions(name):
    filter, test = fitted(name), recorded(name, 3, seed=5)
    belief = filter.beliefs(test)[:, 4]
    gone = filter.update(belief, np.full((3, 1), np.nan), test.actions[:, 3], missing="predict")
    seen = filter.update(belief, filter.predict_observation(belief), test.actions[:, 3])
    np.testing.assert_allclose(gone, seen, rtol=0, atol=1e-12)
    estimator = HintEstimator(filter, missing="predict")
    for t in range(4):
        estimator.update(test.observations[0, t], test.actions[0, t - 1] if t else None)
    found = estimator.update([np.nan], test.actions[0, 3])
    np.testing.assert_allclose(estimator.belief, gone[0], rtol=0, atol=1e-11)
    variance = filter.predict_hint(gone[:1]).std[0] ** 2 + filter.gap_growth_[0]
    np.testing.assert_allclose(found.std**2, variance, rtol=1e-10)


def test_how_much_a_gap_costs_is_measured_with_the_actions_taken():
    """By hand, gaps of up to 20 observations that start at each of the first three."""
    filter, test = fitted("hints"), recorded("hints", 8, n_steps=22, seed=5)
    found = gap_growth(filter, test)
    assert found.shape == (20, 2)
    beliefs, growth = filter.beliefs(test), []
    for j in range(1, 21):
        missed, seen = [], []
        for i in range(8):
            for start in range(3):
                belief = beliefs[i : i + 1, start]
                for t in range(start, start + j):
                    action = test.actions[i, t - 1][None] if t else None
                    belief = filter.update(belief, filter.predict_observation(belief), action)
                truth = test.hints[i, start + j - 1]
                missed.append(filter.predict_hint(belief).mean[0] - truth)
                seen.append(filter.predict_hint(beliefs[i : i + 1, start + j]).mean[0] - truth)
        growth.append(np.square(missed).mean(axis=0) - np.square(seen).mean(axis=0))
    expected = np.maximum.accumulate(np.maximum(growth, 0.0), axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)
