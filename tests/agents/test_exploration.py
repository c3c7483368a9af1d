"""Exploring policies: their distributions, what they follow, and that they keep to the action space."""

import numpy as np
import pytest
from gymnasium.spaces import Box
from scipy.stats import kstest

from beliefgym.agents.exploration import Exploration, Explorer

SPACE = Box(np.array([-1.0, 2.0], np.float32), np.array([3.0, 4.0], np.float32))  # middle (1, 3), half (2, 1)
MIDDLE, HALF = np.array([1.0, 3.0]), np.array([2.0, 1.0])


class Follows:
    """A policy whose actions say what it was asked."""

    def __init__(self, value=(0.0, 3.5)):
        self.value, self.asked = np.asarray(value), []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.asked.append((state, episode_start, deterministic))
        return np.tile(self.value, (len(observation), 1)), (0 if state is None else state) + 1


def actions_of(exploration, steps, n=4, base=None, seed=0, space=SPACE):
    explorer = Explorer(exploration, space, np.random.default_rng(seed), base)
    state, found = None, []
    for t in range(steps):
        action, state = explorer.predict(np.zeros((n, 3)), state, np.full(n, t == 0))
        found.append(action)
    return np.stack(found)


def test_random_actions_are_uniform_over_the_whole_range():
    found = actions_of(Exploration(), 1000)
    assert SPACE.low[0] <= found[..., 0].min()
    for i in range(2):
        unit = (found[..., i].ravel() - SPACE.low[i]) / (SPACE.high[i] - SPACE.low[i])
        assert kstest(unit, "uniform").pvalue > 1e-3  # a fixed seed; a false alarm in 1 of 1000 seeds
    assert abs(np.corrcoef(found[:-1, 0, 0], found[1:, 0, 0])[0, 1]) < 0.1  # independent: 3 standard errors
    assert abs(np.corrcoef(found[:, 0, 0], found[:, 1, 0])[0, 1]) < 0.1


def test_gaussian_actions_have_their_share_of_half_the_range():
    found = actions_of(Exploration(std=(0.1, 0.2)), 2000)
    np.testing.assert_allclose(found.mean(axis=(0, 1)), MIDDLE, atol=0.01)  # 4 standard errors of 8000
    np.testing.assert_allclose(found.std(axis=(0, 1)), np.array([0.1, 0.2]) * HALF, rtol=0.04)
    wide = actions_of(Exploration(std=2.0), 200)
    assert (wide >= SPACE.low).all()
    assert (wide <= SPACE.high).all()
    assert (wide == SPACE.low).any()
    assert (wide == SPACE.high).any()


def test_an_expert_without_noise_is_followed_and_told_what_goes_on():
    base = Follows()
    found = actions_of(Exploration("expert"), 3, base=base)
    np.testing.assert_array_equal(found, np.broadcast_to(base.value, found.shape))
    assert [asked[0] for asked in base.asked] == [None, 1, 2], "its memory comes back to it"
    assert base.asked[0][1].all()
    assert not base.asked[1][1].any()
    assert all(asked[2] for asked in base.asked), "deterministic"


def test_an_expert_explores_with_noise_around_its_actions():
    found = actions_of(Exploration("expert", std=0.1), 2000, base=Follows()) - Follows().value
    np.testing.assert_allclose(found.mean(axis=(0, 1)), 0.0, atol=0.01)  # 4 standard errors of 8000
    np.testing.assert_allclose(found.std(axis=(0, 1)), 0.1 * HALF, rtol=0.04)
    edge = actions_of(Exploration("expert", std=0.5), 50, base=Follows((3.0, 2.0)))
    assert (edge <= SPACE.high).all()
    assert (edge >= SPACE.low).all()


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_is_the_share_of_disturbed_actions(epsilon):
    found = actions_of(Exploration("epsilon", epsilon=epsilon), 1000, base=Follows())
    disturbed = (found != Follows().value).any(axis=-1)
    # 4 standard errors of 4000
    assert disturbed.mean() == pytest.approx(epsilon, abs=4 * (epsilon * (1 - epsilon) / 4000) ** 0.5)
    if 0 < epsilon < 1:
        assert 0.2 < (disturbed[:, 0] & disturbed[:, 1]).sum() / disturbed[:, 0].sum() < 0.4, (
            "each copy by itself"
        )


def test_without_a_policy_epsilon_is_random_throughout():
    found = actions_of(Exploration("epsilon", epsilon=0.1, std=0.1), 50)
    assert (found != MIDDLE).all()


@pytest.mark.parametrize("kind", ["random", "epsilon"])
def test_a_disturbance_is_held(kind):
    base = None if kind == "random" else Follows()
    found = actions_of(Exploration(kind, hold=4, epsilon=1.0), 40, base=base).reshape(10, 4, 4, 2)
    np.testing.assert_array_equal(found, np.broadcast_to(found[:, :1], found.shape))
    assert (np.diff(found[:, 0], axis=0) != 0.0).any(axis=(1, 2)).all()


def test_the_same_generator_gives_the_same_actions():
    one, same, other = (actions_of(Exploration(), 5, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert (one != other).all()


SYMMETRIC = Box(-1.0, 1.0, (2,))


def test_a_restored_sum_is_white_or_autoregressive():
    """Actions that change a control: with 1 the control is fresh noise at each step, with 1 - rho it has memory rho."""
    white = np.cumsum(
        actions_of(Exploration(std=0.01, restoring=1.0), 2000, n=1, space=SYMMETRIC)[:, 0], axis=0
    )
    np.testing.assert_allclose(white.std(axis=0), 0.01, rtol=0.06)  # 4 standard errors of 2000
    assert abs(np.corrcoef(white[:-1, 0], white[1:, 0])[0, 1]) < 0.1
    slow = np.cumsum(
        actions_of(Exploration(std=0.01, restoring=0.1), 4000, n=1, space=SYMMETRIC)[:, 0], axis=0
    )
    assert np.corrcoef(slow[:-1, 0], slow[1:, 0])[0, 1] == pytest.approx(0.9, abs=0.03)  # 4 standard errors
    walk = np.cumsum(actions_of(Exploration(std=0.01), 2000, n=1, space=SYMMETRIC)[:, 0], axis=0)
    assert walk.std(axis=0).min() > 0.05, "with 0 it is a random walk"


def test_only_the_disturbances_that_were_applied_are_taken_back():
    base = Follows((0.2, -0.1))
    how = Exploration("epsilon", std=0.1, epsilon=0.5, restoring=1.0)
    found = actions_of(how, 400, n=1, base=base, space=SYMMETRIC)[:, 0] - base.value
    applied = np.abs(found).max(axis=1) > 1e-12
    assert 0.4 < applied.mean() < 0.6
    control = np.cumsum(found, axis=0)
    np.testing.assert_allclose(control[applied].std(axis=0), 0.1, rtol=0.25)  # 5 standard errors of 200


def test_without_a_policy_every_disturbance_is_taken_back():
    how = Exploration("epsilon", std=0.01, epsilon=0.1, restoring=1.0)
    control = np.cumsum(actions_of(how, 1000, n=1, space=SYMMETRIC)[:, 0], axis=0)
    np.testing.assert_allclose(control.std(axis=0), 0.01, rtol=0.1)  # 4 standard errors of 1000


def test_a_new_episode_begins_with_nothing_to_take_back():
    explorer = Explorer(Exploration(std=0.1, restoring=1.0), SYMMETRIC, np.random.default_rng(0))
    free = Explorer(Exploration(std=0.1), SYMMETRIC, np.random.default_rng(0))
    for t in range(6):
        start = np.array([t in (0, 4), t == 0])
        restored, plain = (one.predict(np.zeros((2, 1)), None, start)[0] for one in (explorer, free))
        np.testing.assert_array_equal((restored == plain).all(axis=1), start)


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ({"kind": "greedy"}, "expected kind to be 'random', 'expert' or 'epsilon', got 'greedy'"),
        ({"std": -0.1}, "expected std finite and at least 0, or None, got -0.1"),
        ({"std": (0.1, np.nan)}, "expected std finite"),
        ({"epsilon": 1.5}, "expected epsilon within 0..1, got 1.5"),
        ({"hold": 0}, "expected hold to be a whole number of at least 1, got 0"),
        ({"hold": True}, "expected hold to be a whole number"),
        ({"restoring": 2.0}, "expected restoring within 0..1, got 2.0"),
    ],
)
def test_numbers_out_of_range_raise(how, told):
    with pytest.raises(ValueError, match=told):
        Exploration(**how)


def test_a_list_of_deviations_as_a_file_holds_it_is_a_tuple():
    assert Exploration(std=[0.1, 0.2]) == Exploration(std=(0.1, 0.2))
