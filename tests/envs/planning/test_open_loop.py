"""Open-loop control: a law simulated on a model, its actions run without looking."""

import numpy as np
import pytest

from beliefgym.envs.mobile_base import MobileBaseKinematic
from beliefgym.envs.planning.open_loop import OpenLoop, ProportionalLaw


class Base:
    """The true kinematic base in the coordinates goal_forward, goal_left, theta."""

    def __init__(self):
        self.system = MobileBaseKinematic()
        self.action_limits = self.system.action_limits

    def coordinates(self, state):
        x, y, theta = state.T
        c, s = np.cos(theta), np.sin(theta)
        return np.stack([-c * x - s * y, s * x - c * y, theta], axis=-1)

    def flow(self, x, u):
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        state = np.stack([-c * x[:, 0] + s * x[:, 1], -s * x[:, 0] - c * x[:, 1], x[:, 2]], axis=-1)
        return self.coordinates(self.system.flow(state, u))


STARTS = np.array([[-2.0, -1.5, 0.0], [1.0, 1.0, 2.0], [0.0, 2.0, -1.0]])


def test_the_coordinates_of_the_stub_are_those_that_the_base_shows():
    base = Base()
    np.testing.assert_allclose(
        base.coordinates(STARTS)[:, :2], base.system.observe(STARTS)[:, :2], atol=1e-12
    )


def test_on_the_true_model_the_open_loop_is_the_closed_loop_and_reaches_the_goal():
    base, law = Base(), ProportionalLaw()
    policy = OpenLoop(base, law, 200)
    memory = policy.begin(3)
    open_loop = closed = base.coordinates(STARTS)
    for t in range(200):
        action = policy.act(open_loop, memory, np.full(3, t == 0))
        np.testing.assert_allclose(action, np.clip(law(closed), *base.action_limits), atol=1e-9)
        open_loop, closed = (
            base.flow(open_loop, action),
            base.flow(closed, np.clip(law(closed), *base.action_limits)),
        )
    assert (
        np.hypot(open_loop[:, 0], open_loop[:, 1]) < 0.06
    ).all()  # the law turns on the spot within 0.05 m


def test_what_happens_meanwhile_is_not_looked_at():
    base = Base()
    policy = OpenLoop(base, ProportionalLaw(), 10)
    x = base.coordinates(STARTS)
    first, second = policy.begin(3), policy.begin(3)
    policy.act(x, first, np.ones(3, dtype=bool)), policy.act(x, second, np.ones(3, dtype=bool))
    still = np.zeros(3, dtype=bool)
    np.testing.assert_array_equal(policy.act(x, first, still), policy.act(x + 7.0, second, still))


def test_single_copies_begin_anew_and_after_the_horizon_nothing_is_done():
    base = Base()
    policy = OpenLoop(base, ProportionalLaw(), 3)
    x = base.coordinates(STARTS)
    memory = policy.begin(3)
    begun = policy.act(x, memory, np.ones(3, dtype=bool)).copy()
    for _ in range(2):
        policy.act(x, memory, np.zeros(3, dtype=bool))
    action = policy.act(x, memory, np.array([False, True, False]))
    np.testing.assert_array_equal(action[1], begun[1])
    np.testing.assert_array_equal(action[[0, 2]], 0.0)


def test_a_model_that_diverges_keeps_its_last_finite_state():
    base = Base()
    base.flow = lambda x, u: np.where(np.arange(len(x))[:, None] == 1, np.nan, x + 1.0)
    path, actions = OpenLoop(base, ProportionalLaw(), 4).simulate(np.ones((2, 3)))
    np.testing.assert_array_equal(path[1], 1.0)
    np.testing.assert_array_equal(path[0, -1], 5.0)
    assert np.isfinite(actions).all()


@pytest.mark.parametrize("behind", [False, True])
def test_the_law_drives_forwards_or_backwards_whichever_is_nearer(behind):
    side = -1.0 if behind else 1.0
    speed, turning = ProportionalLaw(k_forward=1.0, k_turn=2.0)(np.array([[side * 2.0, side * 1.0, 0.0]]))[0]
    assert speed == pytest.approx(side * 2.0)
    assert turning == pytest.approx(2.0 * np.arctan2(1.0, 2.0))
