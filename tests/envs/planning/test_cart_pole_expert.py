"""The cart-pole's expert: it swings up, holds, stays on the track, and treats every copy by itself."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.planning.cart_pole import CartPoleController, cart_pole_expert
from beliefgym.envs.system import wrap_angle


def hanging(count: int, seed: int = 0) -> np.ndarray:
    """Starts of the start distribution."""
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 4)) + np.array([0.0, 0.0, np.pi, 0.0])


def anywhere(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 4)) * [1.0, 2.0, np.pi, 3.0]


class Episodes:
    """Episodes of 200 steps from each start, and what they showed."""

    def __init__(self, system: CartPole, state: np.ndarray, seed: int = 0) -> None:
        controller, rng = cart_pole_expert(system), np.random.default_rng(seed)
        count = len(state)
        self.returns, self.farthest = np.zeros(count), np.zeros(count)
        self.upright_at = np.full(count, 200)
        self.held = np.ones(count, dtype=bool)
        self.plans = 0
        for t in range(200):
            action = controller.act(state, np.full(count, t == 0))
            assert (np.abs(action) <= system.max_force).all()
            self.plans += int((controller.clock == 1).sum())
            after = system.step(state, action, rng.normal(size=(count, 5)) if system.noise_size else None)
            self.returns += system.reward(state, action, after)
            state = after
            upright = np.abs(wrap_angle(state[:, 2])) < 0.2
            self.upright_at = np.where(upright, np.minimum(self.upright_at, t + 1), 200)
            self.farthest = np.maximum(self.farthest, np.abs(state[:, 0]))
            if t >= 180:  # the last second
                self.held &= upright & (np.abs(state[:, 1]) < 0.5) & (np.abs(state[:, 3]) < 1.0)


def test_it_swings_up_from_hanging_within_two_seconds_and_holds() -> None:
    episodes = Episodes(CartPole(), hanging(12))
    assert episodes.held.all()
    assert (episodes.farthest < 1.5).all()
    assert (episodes.upright_at * 0.05 < 2.0).all()
    # The best found by a search several hundred times as wide (five levels, 32 guesses polished) is 180.56.
    assert 180.0 < episodes.returns.mean() < 181.0
    assert episodes.plans == 12, "without noise one plan an episode is enough"


def test_it_swings_up_from_anywhere() -> None:
    episodes = Episodes(CartPole(), anywhere(12))
    assert episodes.held.all()
    assert (episodes.farthest < 2.4).all()


def test_it_holds_under_noise() -> None:
    episodes = Episodes(CartPole(actuation_noise_std=0.5, process_noise_std=0.01), hanging(12))
    assert (np.abs(episodes.farthest) < 2.4).all()
    assert episodes.held.mean() > 0.9
    assert episodes.returns.mean() > 178.0


@pytest.mark.slow
def test_at_least_99_percent_of_500_starts_succeed() -> None:
    for state in (hanging(500, seed=77), anywhere(500, seed=78)):
        episodes = Episodes(CartPole(), state)
        assert (episodes.held & (episodes.farthest < 2.4)).mean() >= 0.99
    noisy = Episodes(CartPole(actuation_noise_std=0.5, process_noise_std=0.01), hanging(200, seed=79))
    assert (noisy.held & (noisy.farthest < 2.4)).mean() > 0.95


@pytest.mark.parametrize("system", [CartPole(max_force=5.0), CartPole(dt=0.02)], ids=["weak", "short steps"])
def test_other_cart_poles_are_swung_up_too(system: CartPole) -> None:
    controller, state = cart_pole_expert(system), hanging(2)
    for _ in range(round(6.0 / system.dt)):
        state = system.step(state, controller.act(state))
    assert (np.cos(state[:, 2]) > 0.999).all()
    assert (np.abs(state[:, 0]) < 0.1).all()


def test_a_copy_acts_as_it_would_alone() -> None:
    system, state = CartPole(), np.concatenate([hanging(2), anywhere(2)])
    together, alone = cart_pole_expert(system), cart_pole_expert(system)
    one = state[2:3]
    for _ in range(40):
        actions = together.act(state)
        action = alone.act(one)
        # Vectorised sines may round the last bit differently at other places of an array, and swinging up
        # magnifies that; what it must not do is take another plan (a difference of order 10 N).
        np.testing.assert_allclose(action[0], actions[2], atol=1e-4)
        state, one = system.step(state, actions), system.step(one, action)


def test_only_rows_that_restart_plan_anew() -> None:
    system, state = CartPole(), hanging(3)
    controller = cart_pole_expert(system)
    for _ in range(5):
        state = system.step(state, controller.act(state))
    fresh = hanging(3, seed=5)
    state[1] = fresh[1]
    controller.act(state, np.array([False, True, False]))
    np.testing.assert_array_equal(controller.clock, [6, 1, 6])
    first = cart_pole_expert(system).act(fresh)[1]
    restarted = cart_pole_expert(system)
    restarted.act(hanging(3))
    np.testing.assert_array_equal(restarted.act(fresh, np.ones(3, dtype=bool))[1], first)


def test_a_copy_that_was_pushed_away_plans_anew_unasked() -> None:
    system, state = CartPole(), hanging(2)
    controller = cart_pole_expert(system)
    for _ in range(60):
        state = system.step(state, controller.act(state))
    state[0, 2] += 2.5
    controller.act(state)
    assert controller.clock[0] == 1
    assert controller.clock[1] == 60, "a plan that has ended holds the upright"


def test_a_pickled_controller_goes_on_with_its_plans() -> None:
    system, state = CartPole(), hanging(2)
    controller = cart_pole_expert(system)
    for _ in range(3):
        state = system.step(state, controller.act(state))
    copy: CartPoleController = pickle.loads(pickle.dumps(controller))
    np.testing.assert_array_equal(copy.act(state), controller.act(state))
    np.testing.assert_array_equal(copy.clock, [4, 4])


def test_another_number_of_copies_is_a_new_batch() -> None:
    controller = cart_pole_expert(CartPole())
    assert controller.act(hanging(3)).shape == (3, 1)
    assert controller.act(hanging(1)).shape == (1, 1)
    np.testing.assert_array_equal(controller.clock, [1])


def test_bad_input_says_what_was_expected() -> None:
    controller: Any = cart_pole_expert(CartPole())
    with pytest.raises(ValueError, match=r"expected state as \(n, 4\), got shape \(4,\)"):
        controller.act(np.zeros(4))
    with pytest.raises(ValueError, match="the state of copy 1 is not finite"):
        controller.act(np.where(np.arange(3)[:, None] == 1, np.nan, np.zeros((3, 4))))
    with pytest.raises(ValueError, match=r"expected restart as \(2,\), got shape \(3,\)"):
        controller.act(hanging(2), np.zeros(3, dtype=bool))
