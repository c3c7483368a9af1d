"""From observations to coordinates and back to a system's state and cost."""

import numpy as np
import pytest
import torch

from beliefgym.agents.coordinates import Coordinates
from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.helicopter import Helicopter
from beliefgym.envs.pendulum import Pendulum
from beliefgym.envs.planning.linearisation import expand_cost
from beliefgym.envs.planning.lqr import error_state

RNG_STATES = 200


def states_of(system, seed=0):
    """Random states; quaternions of unit length, turned up to 150 degrees from the trim, with either sign."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(RNG_STATES, system.n_state))
    for start in system.quaternions:
        axis = rng.normal(size=(RNG_STATES, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        half = rng.uniform(0.0, np.radians(75.0), (RNG_STATES, 1))
        x, y, z, w = np.concatenate([axis * np.sin(half), np.cos(half)], axis=1).T
        a, b, c, d = system.trim[start : start + 4]
        turned = np.stack(  # q* times the turn, by Hamilton's rule
            [
                d * x + a * w + b * z - c * y,
                d * y - a * z + b * w + c * x,
                d * z + a * y - b * x + c * w,
                d * w - a * x - b * y - c * z,
            ],
            axis=1,
        )
        states[:, start : start + 4] = turned * rng.choice([-1.0, 1.0], (RNG_STATES, 1))
    return states, rng.normal(size=(RNG_STATES, system.n_action))


@pytest.mark.parametrize("system", [CartPole(), Pendulum(), Helicopter()], ids=lambda one: type(one).__name__)
def test_the_cost_of_coordinates_is_the_systems_stage_cost(system):
    coordinates = Coordinates.of(system.observation_names, system)
    cost = coordinates.cost_of(system)
    states, actions = states_of(system)
    x = coordinates.encode(system.observe(states))
    assert x.shape == (RNG_STATES, coordinates.size)
    expected = system.stage_cost(states, actions)
    np.testing.assert_allclose(
        cost(x, actions), expected, rtol=1e-9, atol=1e-12
    )  # rounding, of angles of a few rad
    np.testing.assert_allclose(
        cost(torch.as_tensor(x), torch.as_tensor(actions)).numpy(), expected, rtol=1e-9
    )
    shaped = cost(x.reshape(10, 20, -1), actions.reshape(10, 20, -1))
    np.testing.assert_array_equal(shaped, cost(x, actions).reshape(10, 20))


def test_the_cart_poles_coordinates_are_its_state():
    system = CartPole()
    coordinates = Coordinates.of(system.observation_names, system)
    assert coordinates.names == ("x", "theta", "velocity", "angular_velocity")
    assert coordinates.angles == (1,)
    assert coordinates.target_attitude is None
    states, _ = states_of(system)
    x = coordinates.encode(system.observe(states))
    states[:, 2] = np.angle(np.exp(1j * states[:, 2]))  # the turn it was in is not seen
    np.testing.assert_allclose(x[:, [0, 2, 1, 3]], states, atol=1e-14)  # the arctangent's rounding


def test_the_helicopters_attitude_becomes_the_error_to_its_trim():
    system = Helicopter()
    coordinates = Coordinates.of(system.observation_names, system)
    assert coordinates.names[-3:] == ("q_error_x", "q_error_y", "q_error_z")
    assert coordinates.size == 20
    states, actions = states_of(system)
    x = coordinates.encode(states)
    trim = coordinates.encode(system.trim)
    np.testing.assert_allclose(x - trim, error_state(system, states, system.trim), atol=1e-12)  # rounding
    np.testing.assert_allclose(trim[-3:], 0.0, atol=1e-15)
    flipped = states.copy()
    flipped[:, 17:] *= -1.0
    np.testing.assert_allclose(coordinates.encode(flipped), x, atol=1e-14)  # q and -q are one attitude
    back = coordinates.cost_of(system).state(x)
    same = states * np.where((states[:, 17:] * back[:, 17:]).sum(1) < 0.0, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(back[:, 17:], same[:, 17:], atol=1e-12)
    np.testing.assert_array_equal(back[:, :17], states[:, :17])
    # a planner's linearisation stays finite where no attitude has such an error
    beyond = x[:1] + np.array([*np.zeros(17), 2.0, 2.0, 2.0])
    gradient, hessian = expand_cost(coordinates.cost_of(system), beyond, actions[:1])
    assert np.isfinite(gradient).all()
    assert np.isfinite(hessian).all()


def test_without_a_system_the_target_attitude_is_no_turn():
    coordinates = Coordinates.of(("height", "q_x", "q_y", "q_z", "q_w"))
    assert coordinates.names == ("height", "q_error_x", "q_error_y", "q_error_z")
    half = 0.3
    found = coordinates.encode([2.0, 0.0, -np.sin(half), 0.0, -np.cos(half)])
    np.testing.assert_allclose(found, [2.0, 0.0, np.sin(half), 0.0], atol=1e-15)


def test_names_that_are_no_pairs_and_no_quaternion_stay():
    names = ("cos_a", "q_x", "q_y", "sin_b", "cos_b", "b_dot")
    coordinates = Coordinates.of(names)
    assert coordinates.names == ("cos_a", "q_x", "q_y", "b", "b_dot")
    assert coordinates.angles == (3,)
    y = np.array([[0.1, 0.2, 0.3, np.sin(2.5), np.cos(2.5), 7.0]])
    np.testing.assert_allclose(coordinates.encode(y), [[0.1, 0.2, 0.3, 2.5, 7.0]], atol=1e-15)


def test_a_state_that_another_name_stands_for_is_found():
    system = CartPole()
    coordinates = Coordinates.of(("x", "cos_theta", "sin_theta", "rate_x", "rate_theta"))
    cost = coordinates.cost_of(system, {"velocity": "rate_x", "angular_velocity": "rate_theta"})
    x = np.array([[0.5, 0.2, -1.0, 3.0]])  # x, theta, rates
    expected = system.stage_cost(np.array([[0.5, -1.0, 0.2, 3.0]]), np.ones((1, 1)))
    np.testing.assert_allclose(cost(x, np.ones((1, 1))), expected, rtol=1e-12)


def test_a_missing_state_component_is_named():
    coordinates = Coordinates.of(("x", "cos_theta", "sin_theta", "angular_velocity"), CartPole())
    with pytest.raises(ValueError, match=r"state of CartPole .*\['velocity'\] is not there; give a cost"):
        coordinates.cost_of(CartPole())
    with pytest.raises(ValueError, match=r"\['velocity', 'angular_velocity'\] are not there"):
        Coordinates.of(("x", "theta")).cost_of(CartPole())
    position = tuple(name for name in Helicopter.observation_names if not name.startswith("q_"))
    with pytest.raises(ValueError, match=r"\['q_x', 'q_y', 'q_z', 'q_w'\] are not there"):
        Coordinates.of(position, Helicopter()).cost_of(Helicopter())


def test_another_number_of_components_raises():
    with pytest.raises(ValueError, match=r"expected observations \(\.\.\., 3\) as .*, got shape \(2, 4\)"):
        Coordinates.of(Pendulum.observation_names).encode(np.zeros((2, 4)))
