"""The acceleration model finds the helicopter's true coefficients, and predicts as the true system does."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefgym.agents.acceleration_model import AccelerationModel
from beliefgym.agents.coordinates import Coordinates
from beliefgym.envs.helicopter import Helicopter
from beliefgym.learning import Sequences


def flights(noise: float, n: int = 12, steps: int = 40) -> Sequences:
    """Flights from trim, with white sticks, in coordinates."""
    system = Helicopter(wrench_noise_std=noise)
    rng = np.random.default_rng(0)
    sticks = 0.1 * rng.standard_normal((steps + 1, n, 4))
    sticks[0] = 0.0
    state = np.tile(system.trim, (n, 1))
    state[:, 8:11] = rng.standard_normal((n, 3))
    states, actions = [state], []
    for t in range(steps):
        actions.append(sticks[t + 1] - sticks[t])
        gusts = noise * rng.standard_normal((n, 6))
        state = np.asarray(system.flow(state, actions[-1], gusts if noise else None))
        states.append(state)
    observed = Coordinates.of(system.observation_names, system).encode(np.stack(states, axis=1))
    return Sequences.from_observations(observed, actions=np.stack(actions, axis=1))


def true_coefficients() -> NDArray[np.float64]:
    """(6, 11) of `Helicopter`."""
    system = Helicopter()
    truth = np.zeros((6, 11))
    for i in range(3):
        truth[i, i] = -system.drag[i]
        truth[3 + i, 3 + i] = -system.rate_damping[i]
        truth[3 + i, 6 + i] = system.rate_gain[i]
        truth[3 + i, 10] = system.rate_offset[i]
    truth[1, 10], truth[2, 10], truth[2, 9] = system.side_force, system.lift_offset, -system.lift
    return truth


@pytest.mark.parametrize("coupling", [False, True])
@pytest.mark.parametrize("horizon", [1, 5])
def test_without_gusts_it_finds_the_true_coefficients(horizon: int, coupling: bool) -> None:
    model = AccelerationModel(horizon, coupling=coupling, alpha=0.0).fit(flights(0.0))
    # the data are exact: what is left is the rounding of the normal equations, a square of the data's condition
    np.testing.assert_allclose(model.coefficients_, true_coefficients(), atol=1e-5)


def test_its_kinematics_are_the_systems() -> None:
    data = flights(0.0)
    model = AccelerationModel(alpha=0.0).fit(data)
    predicted = model.rollout(data.observations[:, 0], 40, data.actions)
    np.testing.assert_allclose(predicted, data.observations, atol=1e-5)


def test_the_lagged_criterion_falls() -> None:
    model = AccelerationModel(10, coupling=False).fit(flights(1.0))
    assert len(model.criteria_) > 1
    assert np.all(np.diff(model.criteria_) < 0)


def test_under_gusts_it_is_near_the_truth() -> None:
    model = AccelerationModel(coupling=False).fit(flights(1.0))
    gains = model.coefficients_[[3, 4, 5], [6, 7, 8]]
    # 480 steps, sticks of 0.1, gusts of 3.3 rad/s^2: a standard error of 3.3 / (0.1 sqrt(480)) = 1.5; four of them
    np.testing.assert_allclose(gains, Helicopter().rate_gain, atol=6.0)


def test_other_data_are_refused() -> None:
    data = Sequences.from_observations(
        np.random.default_rng(0).random((2, 5, 3)), actions=np.random.default_rng(1).random((2, 4, 4))
    )
    with pytest.raises(ValueError, match="expected trajectories of the helicopter's 20 coordinates"):
        AccelerationModel().fit(data)


@pytest.mark.parametrize(
    ("parameters", "told"),
    [({"horizon": 0}, "horizon"), ({"alpha": -1.0}, "alpha"), ({"standardise": True}, "standardise")],
)
def test_parameters_out_of_range_are_told(parameters: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=f"expected {told}"):
        AccelerationModel(**parameters).fit(flights(0.0, n=2, steps=5))  # type: ignore[arg-type]
