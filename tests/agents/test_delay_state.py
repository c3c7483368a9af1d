"""Delays as a state: what they hold, and that a sampled second-order system is Markov in them."""

import numpy as np
import pytest

from beliefgym.agents.delay_state import DelayState


def run(source, observations, actions):
    """(n, steps + 1, b) the beliefs along trajectories (n, steps + 1, n_obs) under actions (n, steps, n_act)."""
    belief = source.initial_belief(len(observations))
    found = []
    for t in range(observations.shape[1]):
        belief = source.update(belief, observations[:, t], actions[:, t - 1] if t else None)
        found.append(belief)
    return np.stack(found, axis=1)


@pytest.mark.parametrize("n_delays", [1, 2, 3, 4])
@pytest.mark.parametrize("n_act", [0, 1, 2])
def test_the_belief_is_the_formula_of_the_last_observations_and_actions(n_delays, n_act):
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(5, 9, 3)), rng.normal(size=(5, 8, n_act))
    source = DelayState(3, n_act, n_delays, dt=0.5)
    beliefs = run(source, y, u)
    assert beliefs.shape == (5, 9, source.belief_size)
    for t in range(n_delays - 1, 9):
        parts = [y[:, t]]
        parts += [(y[:, t - d] - y[:, t - d - 1]) / 0.5 for d in range(n_delays - 1)]
        parts += [u[:, t - d] for d in range(1, n_delays)]
        np.testing.assert_allclose(beliefs[:, t], np.concatenate(parts, axis=1), atol=1e-15)


def test_before_the_first_observation_it_was_at_rest():
    source = DelayState(1, 1, 3, dt=0.1)
    y = np.array([[[2.0], [2.5], [4.0]]])
    u = np.array([[[7.0], [8.0]]])
    beliefs = run(source, y, u)[0]
    np.testing.assert_allclose(
        beliefs,
        [[2.0, 0.0, 0.0, 0.0, 0.0], [2.5, 5.0, 0.0, 7.0, 0.0], [4.0, 15.0, 5.0, 8.0, 7.0]],
        atol=1e-13,
    )


def test_a_row_that_begins_anew_leaves_the_others_as_they_are():
    source = DelayState(2, 1, 2)
    rng = np.random.default_rng(1)
    belief = source.update(source.initial_belief(3), rng.normal(size=(3, 2)), None)
    alone = belief[[0, 2]].copy()
    belief[1] = source.initial_belief(1)
    y, u = rng.normal(size=(3, 2)), rng.normal(size=(3, 1))
    found = source.update(belief, y, u)
    np.testing.assert_array_equal(found[1], [*y[1], 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(found[[0, 2]], source.update(alone, y[[0, 2]], u[[0, 2]]))


def test_the_rate_of_an_angle_goes_the_short_way_round():
    source = DelayState(2, 1, 2, dt=0.1, angles=(1,))
    belief = source.update(source.initial_belief(1), np.array([[3.1, 3.1]]))
    found = source.update(belief, np.array([[-3.1, -3.1]]), np.zeros((1, 1)))
    np.testing.assert_allclose(found[0, 2:4], [-62.0, (2 * np.pi - 6.2) / 0.1], rtol=1e-12)


def linear_fit_residual(beliefs, actions, skipped):
    """The largest error of the best linear map of (belief, action) to the next belief, beyond the first steps."""
    now = beliefs[:, skipped:-1].reshape(-1, beliefs.shape[2])
    inputs = np.concatenate([now, actions[:, skipped:].reshape(len(now), -1)], axis=1)
    after = beliefs[:, skipped + 1 :].reshape(len(now), -1)
    solution = np.linalg.lstsq(inputs, after, rcond=None)[0]
    return np.abs(inputs @ solution - after).max()


def test_a_sampled_double_integrator_is_markov_in_two_delays():
    rng = np.random.default_rng(2)
    dt, n, steps = 0.1, 6, 40
    u = rng.normal(size=(n, steps, 1))
    p, v = rng.normal(size=(n, 1)), rng.normal(size=(n, 1))
    seen = [p]
    for t in range(steps):  # the force is held over a step: exact sampling
        p, v = p + dt * v + 0.5 * dt**2 * u[:, t], v + dt * u[:, t]
        seen.append(p)
    y = np.stack(seen, axis=1)
    for delays in (2, 3):
        source = DelayState(1, 1, delays, dt=dt)
        # exact but for rounding: 1e-15 of positions of 10, divided by dt
        assert linear_fit_residual(run(source, y, u), u, delays - 1) < 1e-11
    assert linear_fit_residual(run(DelayState(1, 1, 1, dt=dt), y, u), u, 0) > 0.05, (
        "a position alone is no state"
    )
    assert linear_fit_residual(run(DelayState(1, 1, 2, dt=dt), y, u), u, 0) > 0.05, (
        "nor is a start taken at rest"
    )


def test_names_say_what_each_component_is():
    source = DelayState(2, 1, 3)
    names = source.names(("x", "theta"), ("force",))
    assert names == (
        "x",
        "theta",
        "rate_x",
        "rate_theta",
        "rate_x[-1]",
        "rate_theta[-1]",
        "force[-1]",
        "force[-2]",
    )
    assert len(names) == source.belief_size
    assert DelayState(2, 1, 1).names(("x", "theta"), ("force",)) == ("x", "theta")


def test_numbers_out_of_range_raise():
    with pytest.raises(ValueError, match="expected n_delays of at least 1, got 0"):
        DelayState(1, 1, 0)
    with pytest.raises(ValueError, match="expected dt above 0, got 0"):
        DelayState(1, 1, 2, dt=0.0)
