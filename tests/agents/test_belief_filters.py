"""Filters by name, the hints of a task, and refits whose beliefs mean what they meant."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError

from beliefgym.agents.belief_filters import (
    KNOWN,
    LEARNED,
    LEAST_NOISE,
    drawn_within,
    fit_with_validation,
    hint_of,
    new_filter,
    task_with_hints,
)
from beliefgym.envs import collect
from beliefgym.learning import InferenceMachineFilter, PSIMActions, PSIMHints, Sequences
from beliefgym.learning.filters import COORDINATES
from beliefgym.wrappers import Task

PENDULUM = Task("beliefgym/PendulumPosition-v0")
NOISY = Task("beliefgym/PendulumPositionNoisyHard-v0")
BALANCE = Task("beliefgym/CartPoleBalancePosition-v0")
SMALL = {"n_frequencies": 20, "n_iterations": 2}


def recorded(task, n_episodes=8, seed=0):
    """Episodes with the hints that filters of this task estimate."""
    make, names = hint_of(task)
    found = collect(task_with_hints(task).make_vec(n_episodes), "random", n_episodes=n_episodes, seed=seed)
    return Sequences(
        found.observations,
        found.actions,
        found.rewards,
        lengths=found.lengths,
        hints=make(found.hints),
        hint_names=names,
    )


@pytest.mark.parametrize("name", LEARNED)
@pytest.mark.parametrize("task", [PENDULUM, BALANCE], ids=["continuous", "discrete"])
def test_every_learned_filter_fits_what_is_recorded_of_a_task(name, task):
    filter = new_filter(name, task, seed=0, options=SMALL)
    fit_with_validation(filter, recorded(task), seed=(0, 0))
    assert filter.n_act_ == (0 if name == "psim" else 1)
    assert filter.n_choices == (2 if task is BALANCE and name != "psim" else None)
    assert filter.regressor.n_frequencies == 20


@pytest.mark.parametrize("name", LEARNED)
def test_a_refit_with_kept_coordinates_shows_beliefs_on_the_scale_of_the_first(name):
    first = new_filter(name, PENDULUM, 0, SMALL)
    fit_with_validation(first, recorded(PENDULUM), seed=(0, 0))
    other = recorded(PENDULUM, seed=100)
    other = other[other.observations[:, 0, 0] > 0]  # begins elsewhere: its own scales are others
    free, kept = (new_filter(name, PENDULUM, 0, SMALL) for _ in range(2))
    kept.keep_coordinates(first)
    for filter in (free, kept):
        fit_with_validation(filter, other, seed=(0, 1))
    for coordinate in (c for c in COORDINATES if hasattr(first, c)):
        assert_same_maps(getattr(kept, coordinate), getattr(first, coordinate))
    assert not np.array_equal(free._scale.offset, first._scale.offset)
    assert not np.array_equal(free.belief_scale_.offset, first.belief_scale_.offset)
    belief = first.beliefs(other)[:, 5]
    assert np.array_equal(kept.summary(belief), first.summary(belief))


def assert_same_maps(a, b):
    for name in ("offset", "scale"):
        one, two = (getattr(x, name, getattr(getattr(x, "scale", None), name, None)) for x in (a, b))
        assert np.array_equal(one, two)


def test_coordinates_of_another_kind_or_of_nothing_are_told():
    fitted = new_filter("psim-actions", PENDULUM, 0, SMALL)
    with pytest.raises(NotFittedError):
        new_filter("psim-actions", PENDULUM, 0, SMALL).keep_coordinates(fitted)
    fit_with_validation(fitted, recorded(PENDULUM), seed=(0, 0))
    with pytest.raises(TypeError, match="expected a fitted PSIM, got PSIMActions"):
        new_filter("psim", PENDULUM, 0, SMALL).keep_coordinates(fitted)
    with pytest.raises(TypeError, match="expected a fitted PSIMHints, got PSIMActions"):
        new_filter("psim-hints", PENDULUM, 0, SMALL).keep_coordinates(fitted)


def test_options_take_the_place_of_settings():
    options = {"n_future": 7, "alpha": 0.5, "bandwidth": 3.0, "discount": 1.0, "preimage": "readout"}
    filter = new_filter("psim-hints", PENDULUM, 4, options)
    assert isinstance(filter, PSIMHints)
    regressor = filter.regressor
    assert (filter.n_future, filter.discount, filter.preimage) == (7, 1.0, "readout")
    assert (regressor.alpha, regressor.bandwidth, regressor.random_state) == (0.5, 3.0, 4)
    assert regressor.n_frequencies == 300
    assert isinstance(new_filter("psim-actions", PENDULUM, 0, {}), PSIMActions)
    assert isinstance(new_filter("imf", PENDULUM, 0, {}), InferenceMachineFilter)


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("psmi", {}, ValueError, "expected filter to be one of psim, psim-actions, .*ekf, got 'psmi'"),
        ("psim", {"n_frequency": 3}, TypeError, "n_frequency"),
        ("imf", {"n_future": 3}, TypeError, "n_future"),
    ],
)
def test_unknown_names_and_options_are_told(name, options, error, message):
    with pytest.raises(error, match=message):
        new_filter(name, PENDULUM, 0, options)


@pytest.mark.parametrize("name", KNOWN)
def test_filters_that_know_the_system_have_the_noise_of_its_sensors(name):
    twice = Task(NOISY.env_id, {}, (("ObservationNoise", {"std": 0.4}),))
    exact, once, both = (new_filter(name, task, 0, {}) for task in (PENDULUM, NOISY, twice))
    assert exact.observed == ("cos_theta", "sin_theta")
    assert min(exact.observation_noise_std) >= LEAST_NOISE
    # particles may be given more than there is, in one proportion; 0.3 and 0.4 together are 0.5
    assert np.divide(both.observation_noise_std, once.observation_noise_std) == pytest.approx(5 / 3)
    assert once.observation_noise_std[0] >= 0.3
    if name != "particle":
        assert once.observation_noise_std == pytest.approx((0.3, 0.3))
    with pytest.raises(ValueError, match=f"a beliefgym system for the filter '{name}'.* got HopperPosition"):
        new_filter(name, Task("beliefgym/HopperPosition-v0"), 0, {})


def test_hints_are_asked_of_environments_that_have_them():
    asked = task_with_hints(Task(PENDULUM.env_id, {"damping": 0.1}, (("ObservationDelay", {"steps": 1}),)))
    assert asked.kwargs == {"damping": 0.1, "hint": True}
    assert asked.wrappers == (("ObservationDelay", {"steps": 1}),)
    assert task_with_hints(Task("Pendulum-v1")) is None


@pytest.mark.parametrize(
    ("env_id", "names", "of_raw"),
    [
        (
            "PendulumPosition-v0",
            ("cos_theta", "sin_theta", "angular_velocity"),
            ("theta", "angular_velocity"),
        ),
        ("QuadrotorHoverIMU-v0", ("roll", "pitch"), ("roll", "pitch")),
        ("HopperPosition-v0", None, None),
    ],
)
def test_filters_estimate_what_full_sight_would_show_or_the_hints_as_they_are(env_id, names, of_raw):
    task = Task(env_id)
    env = task_with_hints(task).make_vec(3)
    _, infos = env.reset(seed=0)
    raw = np.asarray(infos["hint"])
    make, told = hint_of(task)
    assert told == names
    if env_id.startswith("Pendulum"):
        full, _ = Task("beliefgym/Pendulum-v0").make_vec(3).reset(seed=0)
        np.testing.assert_allclose(make(raw), full, atol=1e-6)  # float32
    else:
        assert np.array_equal(make(raw), raw)
    as_they_are, told = hint_of(task, raw=True)
    assert told == of_raw
    assert np.array_equal(as_they_are(raw), raw)


def test_a_part_of_the_episodes_chooses_among_hypotheses():
    given = {}

    class Spy:
        def fit(self, train, validation):
            given["train"], given["validation"] = train, validation

    episodes = recorded(PENDULUM, n_episodes=10)
    fit_with_validation(Spy(), episodes, seed=(1, 2))
    firsts = [sorted(given[part].observations[:, 0, 1].tolist()) for part in ("train", "validation")]
    assert [len(first) for first in firsts] == [8, 2]
    assert sorted(firsts[0] + firsts[1]) == sorted(episodes.observations[:, 0, 1].tolist())
    before = given["validation"].observations
    fit_with_validation(Spy(), episodes, seed=(1, 2))
    assert np.array_equal(given["validation"].observations, before)
    fit_with_validation(Spy(), episodes, seed=(1, 3))
    assert not np.array_equal(given["validation"].observations, before)
    fit_with_validation(Spy(), episodes[:1], seed=(1, 2))
    assert len(given["train"]) == 1
    assert given["validation"] is None


def test_of_too_many_steps_whole_episodes_are_drawn():
    episodes = recorded(BALANCE, n_episodes=20)
    total = episodes.n_transitions
    assert drawn_within(episodes, total, seed=(0,)) is episodes
    half = drawn_within(episodes, total // 2, seed=(0,))
    assert total // 4 < half.n_transitions <= total // 2
    firsts = episodes.observations[:, 0].tolist()
    places = [firsts.index(first) for first in half.observations[:, 0].tolist()]
    assert places == sorted(set(places))
    assert half.lengths.tolist() == episodes.lengths[places].tolist()
    assert len(drawn_within(episodes, 1, seed=(0,))) == 1
