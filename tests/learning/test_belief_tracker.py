"""Beliefs that are followed online are those of the recorded episodes, whatever the filter, the masks and the order."""

from __future__ import annotations

import pickle
import warnings

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError

from beliefgym.learning import (
    N4SID,
    PSIM,
    AutoregressiveFilter,
    BeliefTracker,
    ConditionalPSIM,
    DivergenceWarning,
    ForwardPSIM,
    GRUFilter,
    GRUHints,
    InferenceMachineFilter,
    KalmanFilter,
    KalmanHints,
    PSIMActions,
    PSIMHints,
    RandomFourierRidge,
    Ridge,
    Sequences,
    ridge_step,
)
from beliefgym.learning.belief_tracker import shown
from beliefgym.learning.filters import Filter

EXACT = 1e-9  # the order of sums, over 30 updates


def recorded(n_episodes: int, seed: int, short: bool, n_steps: int = 30) -> Sequences:
    """A noisy oscillator that actions push: position and a gauge far from zero; the hint is its velocity."""
    rng = np.random.default_rng(seed)
    turn = 0.97 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    state = rng.standard_normal((n_episodes, 2))
    actions = rng.choice(4, (n_episodes, n_steps, 1)).astype(float)
    states = [state]
    for t in range(n_steps):
        state = state @ turn.T + 0.05 * rng.standard_normal(state.shape)
        state[:, 1] += 0.3 * (actions[:, t, 0] - 1.5)
        states.append(state)
    states = np.stack(states, axis=1)
    seen = np.stack([states[:, :, 0], 500.0 + 20.0 * states[:, :, 0]], axis=2)
    lengths = rng.integers(0, n_steps + 1, n_episodes) if short else np.full(n_episodes, n_steps)
    return Sequences.from_observations(
        seen + [0.1, 2.0] * rng.standard_normal(seen.shape),
        actions=actions,
        hints=states[:, :, 1:],
        lengths=lengths,
        hint_names=("velocity",),
    )


TRAIN, TEST = recorded(60, 0, short=False), recorded(9, 1, short=True)
WAVES = RandomFourierRidge(n_frequencies=20, include_inputs=True, random_state=0)
QUICK = {
    "PSIM": PSIM(n_iterations=2),
    "PSIM, delta": PSIM(n_iterations=2, target="delta"),
    "PSIM, second moments": PSIM(n_iterations=2, features="second"),
    "PSIMHints": PSIMHints(n_iterations=2, preimage="belief"),
    "PSIMHints, previous action": PSIMHints(n_iterations=2, preimage="belief", use_actions=True),
    "InferenceMachineFilter": InferenceMachineFilter(n_iterations=2, use_actions=True),
    "PSIMActions": PSIMActions(n_iterations=2),
    "ConditionalPSIM": ConditionalPSIM(n_iterations=2),
    "PSIMActions, joint": PSIMActions(n_iterations=2, state="joint"),
    "PSIM, random features": PSIM(WAVES, n_iterations=2),
    "PSIM, random features alone, delta": PSIM(
        RandomFourierRidge(n_frequencies=20, random_state=0), n_iterations=2, target="delta"
    ),
    "PSIMHints, random features, previous action": PSIMHints(
        WAVES, n_iterations=2, preimage="belief", use_actions=True
    ),
    "PSIMActions, random features": PSIMActions(WAVES, n_iterations=2),
}
FILTERS: dict[str, Filter] = {
    **QUICK,
    "PSIM, second moments, delta": PSIM(n_iterations=2, features="second", target="delta"),
    "PSIMHints, choices": PSIMHints(n_iterations=2, preimage="belief", use_actions=True, n_choices=4),
    "PSIMActions, choices": PSIMActions(n_iterations=2, n_choices=4),
    "ForwardPSIM": ForwardPSIM(n_future=3),
    "AutoregressiveFilter": AutoregressiveFilter(n_past=2),
    "KalmanFilter": KalmanFilter(n_states=2, n_iterations=2),
    "KalmanHints": KalmanHints(),
    "N4SID": N4SID(n_states=2),
    "GRUFilter": GRUFilter(hidden_size=4, n_epochs=1, random_state=0),
    "GRUHints": GRUHints(hidden_size=4, n_epochs=1, random_state=0),
}


@pytest.fixture(scope="module", autouse=True)
def _fitted():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for filter in FILTERS.values():
            filter.fit(TRAIN)


def online(tracker: BeliefTracker, data: Sequences, n_steps: int | None = None) -> np.ndarray:
    """(n, n_steps + 1, size) what is shown on the way; 0 past an episode's end."""
    steps = range(1, (data.n_steps if n_steps is None else n_steps) + 1)
    seen = [tracker.begin(data.observations[:, 0])]
    for t in steps:
        mask = data.lengths >= t
        seen.append(tracker.go_on(data.observations[:, t], data.actions[:, t - 1], mask) * mask[:, None])
    return np.stack(seen, axis=1)


@pytest.mark.parametrize("name", FILTERS)
def test_it_shows_what_the_filter_says_of_the_recorded_episodes(name):
    filter = FILTERS[name]
    tracker = BeliefTracker(filter, len(TEST))
    expected, mask = filter.summaries(TEST), TEST.observation_mask
    assert tracker.size == expected.shape[2] == len(tracker.names)
    for _ in range(2):  # nothing is left over from the first episodes
        np.testing.assert_allclose(online(tracker, TEST)[mask], expected[mask], rtol=EXACT, atol=EXACT)
    assert tracker.n_steps.tolist() == TEST.lengths.tolist()


@pytest.mark.parametrize(
    "name", ["PSIMHints", "PSIMHints, previous action", "InferenceMachineFilter", "KalmanHints"]
)
def test_it_shows_hints_on_the_scale_of_the_training_data(name):
    filter = FILTERS[name]
    tracker = BeliefTracker(filter, len(TEST), show="hint")
    assert tracker.names == ("hint[velocity]", "hint_std[velocity]")
    found, mask = online(tracker, TEST), TEST.observation_mask
    np.testing.assert_allclose(found[mask], shown(filter, TEST, "hint")[mask], rtol=EXACT, atol=EXACT)
    mean, std = filter.estimate_hints(TEST)
    scale = filter._hint_scale
    np.testing.assert_allclose(scale.invert(found[mask][:, :1]), mean[mask], rtol=EXACT, atol=EXACT)
    np.testing.assert_allclose(found[mask][:, 1:] * scale.scale, std[mask], rtol=EXACT, atol=EXACT)
    if name != "KalmanHints":  # which learns little of a velocity here
        assert 0.5 < found[mask][:, 0].std() < 2.0


def test_hints_without_a_standard_deviation_stand_alone(monkeypatch):
    filter = FILTERS["PSIMHints"]
    plain = PSIMHints._read_hint
    monkeypatch.setattr(
        PSIMHints, "_read_hint", lambda self, b: (plain(self, b)[0], np.full((len(b), 1), np.nan))
    )
    tracker = BeliefTracker(filter, len(TEST), show="hint")
    assert tracker.names == ("hint[velocity]",)
    assert np.isfinite(online(tracker, TEST)).all()


@pytest.mark.parametrize("name", FILTERS)
def test_the_present_and_the_future_change_nothing_before(name):
    """Other observations after t and other actions from t on: the same up to t, and not afterwards."""
    filter, t = FILTERS[name], 12
    data = TEST[TEST.lengths > t + 2]
    observations, actions = data.observations.copy(), data.actions.copy()
    rng = np.random.default_rng(0)
    observations[:, t + 1 :] += rng.standard_normal(observations[:, t + 1 :].shape)
    actions[:, t:] = 3.0 - actions[:, t:]
    other = Sequences.from_observations(observations, actions=actions, lengths=data.lengths)
    for found in (lambda d: filter.summaries(d), lambda d: online(BeliefTracker(filter, len(d)), d)):
        one, two = found(data), found(other)
        np.testing.assert_array_equal(one[:, : t + 1], two[:, : t + 1])
        assert np.abs(one - two)[:, t + 2].max() > 1e-3


@pytest.mark.parametrize(
    ("name", "takes"),
    [
        ("PSIM", {"x_t"}),
        ("PSIMHints", {"x_t"}),
        ("PSIMHints, previous action", {"x_t", "a_{t-1}"}),
        ("PSIMHints, choices", {"x_t", "a_{t-1}"}),
        ("PSIMActions", {"a_{t-1}", "x_{t-1}"}),
        ("PSIMActions, choices", {"a_{t-1}", "x_{t-1}"}),
    ],
)
def test_what_is_shown_at_t_has_taken_in(name, takes):
    """The latest things by the filter's `action_timing`: those that change it, and none else."""
    filter, t = FILTERS[name], 5
    data = TEST[TEST.lengths > t]

    def at_t(what):
        observations, actions = data.observations.copy(), data.actions.copy()
        if what == "x_t":
            observations[:, t] += [1.0, 20.0]
        elif what == "x_{t-1}":
            observations[:, t - 1] += [1.0, 20.0]
        elif what:
            actions[:, t - 1 if what == "a_{t-1}" else t] = (
                3.0 - data.actions[:, t - 1 if what == "a_{t-1}" else t]
            )
        other = Sequences.from_observations(observations, actions=actions, lengths=data.lengths)
        return online(BeliefTracker(filter, len(data)), other, t)[:, t]

    for what in ("x_t", "a_{t-1}", "a_t"):
        changed = np.abs(at_t(what) - at_t("")).max() > 1e-3
        assert changed == (what in takes), what
    assert np.abs(at_t("x_{t-1}") - at_t("")).max() > 1e-3


@pytest.mark.parametrize("name", FILTERS)
def test_one_matrix_product_is_the_filters_own_update(name):
    """Where a `RidgeStep` stands in, it is the same to rounding; everywhere else the filter itself is asked."""
    filter = FILTERS[name]
    quick, slow = BeliefTracker(filter, len(TEST)), BeliefTracker(filter, len(TEST))
    assert (quick._quick is not None) == (name in QUICK)
    slow._quick = None
    np.testing.assert_allclose(online(quick, TEST), online(slow, TEST), rtol=EXACT, atol=EXACT)
    np.testing.assert_allclose(quick.belief, slow.belief, rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("cached", [1, 20 * 4, 20 * 9])
def test_random_features_go_in_blocks(monkeypatch, cached):
    """Of one belief, of four with one left over, of all at once."""
    monkeypatch.setattr(ridge_step, "CACHED", cached)
    filter = FILTERS["PSIMActions, random features"]
    expected, mask = filter.summaries(TEST), TEST.observation_mask
    found = online(BeliefTracker(filter, len(TEST)), TEST)
    np.testing.assert_allclose(found[mask], expected[mask], rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("name", QUICK)
def test_beyond_the_bounds_it_is_kept_inside_as_the_filter_keeps_it(name):
    """Beliefs are kept inside and it is told once, by every tracker; the filter does not notice."""
    filter = FILTERS[name]
    before = pickle.dumps(filter)
    wild = Sequences.from_observations(
        TEST.observations + np.array([40.0, 0.0]), actions=TEST.actions, lengths=TEST.lengths
    )
    tracker, slow = BeliefTracker(filter, len(wild)), BeliefTracker(filter, len(wild))
    slow._quick = None
    with pytest.warns(DivergenceWarning, match="left its bounds"):
        found = online(tracker, wild)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        online(tracker, wild)
    with pytest.warns(DivergenceWarning):
        expected = online(slow, wild)
    np.testing.assert_allclose(found, expected, rtol=EXACT, atol=EXACT)
    assert (np.abs(tracker.belief) <= filter._bound).all()
    assert pickle.dumps(filter) == before


@pytest.mark.parametrize(
    "name", ["PSIM", "PSIM, random features", "PSIMHints, previous action", "PSIMActions", "GRUFilter"]
)
def test_copies_outside_a_mask_stay_as_they_are(name):
    """Whatever stands in their rows."""
    filter = FILTERS[name]
    data = TEST[TEST.lengths >= 8]
    tracker = BeliefTracker(filter, len(data))
    together = online(BeliefTracker(filter, len(data)), data, 8)
    rng, at = np.random.default_rng(0), np.full(len(data), -1)
    while (at < 8).any():  # each copy at its own pace
        mask = (rng.random(len(data)) < 0.4) & (at < 8)
        at[mask] += 1
        for begins in (True, False):
            rows = mask & ((at == 0) == begins)
            x, a = np.full((len(data), 2), np.nan), np.full((len(data), 1), np.inf)
            x[rows] = data.observations[rows, at[rows]]
            a[rows] = data.actions[rows, at[rows] - 1]
            before = tracker.belief
            found = tracker.begin(x, rows) if begins else tracker.go_on(x, a, rows)
            np.testing.assert_allclose(found[rows], together[rows, at[rows]], rtol=EXACT, atol=EXACT)
            np.testing.assert_array_equal(tracker.belief[~rows], before[~rows])
    assert tracker.n_steps.tolist() == [8] * len(data)


@pytest.mark.parametrize("name", FILTERS)
def test_it_catches_up_with_running_episodes(name):
    """Then it goes on as if it had been there from the start."""
    filter = FILTERS[name]
    data = TEST[TEST.lengths >= 5]
    rng = np.random.default_rng(0)
    now = rng.integers(0, data.lengths)
    past = Sequences.from_observations(data.observations, actions=data.actions, lengths=now)
    there, late = BeliefTracker(filter, len(data)), BeliefTracker(filter, len(data))
    online(there, past)
    caught = late.catch_up(past)
    rows = np.arange(len(data))
    np.testing.assert_allclose(caught, filter.summaries(past)[rows, now], rtol=EXACT, atol=EXACT)
    following = data.observations[rows, now + 1], data.actions[rows, now]
    np.testing.assert_array_equal(there.go_on(*following), late.go_on(*following))
    assert late.n_steps.tolist() == (now + 1).tolist()


def test_a_refitted_filter_takes_over_in_the_midst():
    old, new = PSIM(n_iterations=1).fit(TRAIN[:20]), PSIM(n_iterations=2).fit(TRAIN)
    data = TEST[TEST.lengths >= 5]
    tracker = BeliefTracker(old, len(data))
    online(tracker, data, 4)
    tracker = BeliefTracker(new, len(data))
    tracker.catch_up(Sequences.from_observations(data.observations[:, :5], actions=data.actions[:, :4]))
    found = tracker.go_on(data.observations[:, 5], data.actions[:, 4])
    np.testing.assert_allclose(found, new.summaries(data)[:, 5], rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("regressor", [Ridge(), RandomFourierRidge(n_frequencies=20, random_state=0)])
def test_later_fits_of_the_filter_do_not_change_it(regressor):
    filter = PSIM(regressor, n_iterations=1).fit(TRAIN[:30])
    tracker, expected = BeliefTracker(filter, len(TEST)), filter.summaries(TEST)
    filter.partial_fit(TRAIN[30:])
    mask = TEST.observation_mask
    np.testing.assert_allclose(online(tracker, TEST)[mask], expected[mask], rtol=EXACT, atol=EXACT)
    filter.fit(Sequences.from_observations(3.0 * TRAIN.observations, lengths=TRAIN.lengths))
    np.testing.assert_allclose(online(tracker, TEST)[mask], expected[mask], rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("name", FILTERS)
def test_pickle_in_the_middle(name):
    data = TEST[TEST.lengths >= 4]
    tracker = BeliefTracker(FILTERS[name], len(data))
    online(tracker, data, 3)
    twin = pickle.loads(pickle.dumps(tracker))
    following = data.observations[:, 4], data.actions[:, 3]
    np.testing.assert_array_equal(tracker.go_on(*following), twin.go_on(*following))


@pytest.mark.parametrize("name", ["PSIM", "PSIMActions", "KalmanFilter"])
def test_a_fork_goes_its_own_way(name):
    data = TEST[TEST.lengths >= 5]
    tracker, alone = BeliefTracker(FILTERS[name], len(data)), BeliefTracker(FILTERS[name], len(data))
    online(tracker, data, 3)
    online(alone, data, 3)
    fork = tracker.fork()
    for _ in range(2):
        fork.go_on(data.observations[:, 0], data.actions[:, 0])
    fork.begin(data.observations[:, 1])
    following = data.observations[:, 4], data.actions[:, 3]
    fresh = alone.fork()
    expected = alone.go_on(*following)
    for other in (tracker, fresh):
        np.testing.assert_array_equal(other.go_on(*following), expected)
        assert other.n_steps.tolist() == [4] * len(data)
    assert fork.n_steps.tolist() == [0] * len(data)


def test_what_it_gives_is_the_callers_own():
    """Writing into it, or into what was given, changes nothing that comes later."""
    data = TEST[TEST.lengths >= 5]
    for name in ("PSIM", "PSIMActions", "AutoregressiveFilter"):
        spoilt, clean = (BeliefTracker(FILTERS[name], len(data)) for _ in range(2))
        for t in range(5):
            x, a = data.observations[:, t].copy(), data.actions[:, t - 1].copy()
            given = spoilt.begin(x) if t == 0 else spoilt.go_on(x, a)
            expected = clean.begin(x.copy()) if t == 0 else clean.go_on(x.copy(), a)
            np.testing.assert_array_equal(given, expected)
            for array in (given, x, spoilt.belief):
                array[:] = np.nan


def test_single_precision_and_whole_numbers_are_taken():
    tracker = BeliefTracker(FILTERS["PSIM"], len(TEST))
    x = np.round(TEST.observations[:, 0])
    expected = tracker.begin(x)
    for kind in (np.float32, np.int64):
        np.testing.assert_array_equal(tracker.begin(x.astype(kind)), expected)
    np.testing.assert_array_equal(tracker.begin(x.tolist()), expected)


def test_an_unstable_filter_is_told_with_the_copy_and_its_step():
    class Double(AutoregressiveFilter):
        def _update(self, belief, z):
            return 1e11 * (belief + 1.0)

    filter = Double().fit(TRAIN)
    filter._bound = None
    tracker = BeliefTracker(filter, 3)
    x = TEST.observations[:3, 0]
    tracker.begin(x)
    tracker.go_on(x)
    tracker.begin(x, [True, False, True])
    message = (
        r"copy 1 of 3 at step 2 of its episode has diverged: component 0 is .*e\+\d+.*bounded, such as PSIM"
    )
    with pytest.raises(FloatingPointError, match=message):
        tracker.go_on(x)


@pytest.mark.parametrize(
    ("name", "call", "message"),
    [
        ("PSIM", lambda t: t.begin(np.zeros((2, 2))), r"observations: expected shape \(3, 2\), got \(2, 2\)"),
        ("PSIM", lambda t: t.begin(np.zeros((3, 2)), [True]), r"mask: expected shape \(3,\), got \(1,\)"),
        (
            "PSIM",
            lambda t: t.begin([[0, 1], [0, np.nan], [0, 0]]),
            "got nan in component 1 of the observation of copy 1 of 3 at step 0 of its episode; look at the env",
        ),
        (
            "PSIM",
            lambda t: t.go_on([[0, 1], [0, 0], [np.inf, 0]], mask=[True, False, True]),
            "got inf in component 0 of the observation of copy 2 of 3 at step 1",
        ),
        (
            "PSIMActions",
            lambda t: t.go_on(np.zeros((3, 2))),
            r"expected the actions \(n, 1\) that led .* got None",
        ),
        (
            "PSIMActions",
            lambda t: t.go_on(np.zeros((3, 2)), np.zeros((3, 2))),
            r"actions: expected shape \(3, 1\), got \(3, 2\)",
        ),
        (
            "PSIMHints, previous action",
            lambda t: t.go_on(np.zeros((3, 2)), [[0], [0], [np.nan]]),
            "got nan in component 0 of the action of copy 2 of 3 at step 1 of its episode; look at the policy",
        ),
        ("PSIM", lambda t: t.catch_up(TEST), "expected the running episodes of 3 copies, got Sequences"),
        (
            "PSIMActions",
            lambda t: t.catch_up(Sequences.from_observations(np.zeros((3, 4, 2)))),
            "expected episodes with 1 actions as at fit",
        ),
    ],
)
def test_what_does_not_fit_is_told(name, call, message):
    with pytest.raises(ValueError, match=message):
        call(BeliefTracker(FILTERS[name], 3))


def test_other_filters_and_views_are_told():
    with pytest.raises(TypeError, match="expected a Filter of beliefgym.learning, got Ridge"):
        BeliefTracker(Ridge(), 1)
    with pytest.raises(ValueError, match="expected n to be a whole number of at least 1, got 0"):
        BeliefTracker(FILTERS["PSIM"], 0)
    with pytest.raises(NotFittedError, match="this PSIM is not fitted yet"):
        BeliefTracker(PSIM(), 1)
    with pytest.raises(ValueError, match=r"expected show to be one of \('belief', 'hint'\), got 'all'"):
        shown(FILTERS["PSIM"], TEST, "all")
    with pytest.raises(TypeError, match="got PSIM, which estimates no hint; show='belief' shows its belief"):
        shown(FILTERS["PSIM"], TEST, "hint")
