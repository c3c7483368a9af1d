"""PILCO on TorchRL's parts: the moments against TorchRL's own, and the agent's face."""

import importlib.util

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from beliefgym.agents import load_agent
from beliefgym.agents.pilco import PILCO, spread_points
from beliefgym.wrappers import Task

ENV = "beliefgym/CartPoleSwingUp-v0"
SMALL = {"trial_steps": 8, "horizon": 4, "n_basis": 5, "evaluations": 3}
MISSING = [name for name in ("gpytorch", "botorch") if importlib.util.find_spec(name) is None]
needs_gps = pytest.mark.skipif(
    bool(MISSING), reason=f"PILCO learns with {' and '.join(MISSING)}; pip install 'beliefgym[pilco]'"
)


@needs_gps
def test_the_moments_are_torchrls():
    from torchrl.modules.models.gp import GPWorldModel

    from beliefgym.agents.gp_moments import GPMoments

    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x, u = normal(40, 3), normal(40, 2)
    following = x + torch.stack([torch.sin(x[:, 1]), u[:, 0], x[:, 2] * u[:, 1]], 1)
    model = GPMoments(3, 2)
    model.fit(TensorDict({"observation": x, "action": u, ("next", "observation"): following}, [40]))
    root = 0.4 * normal(5, 5)
    joint = root @ root.T + 0.05 * torch.eye(5)
    belief = {
        "observation": {"mean": normal(3), "var": joint[:3, :3]},
        "action": {
            "mean": normal(2),
            "var": joint[3:, 3:],
            "cross_covariance": torch.linalg.solve(joint[:3, :3], joint[:3, 3:]),
        },
    }
    ours = model.uncertain_forward(TensorDict(belief, []))["next", "observation"]
    theirs = GPWorldModel.uncertain_forward(model, TensorDict(belief, []))["next", "observation"]
    assert torch.allclose(ours["mean"], theirs["mean"], atol=1e-8)
    assert torch.allclose(
        ours["var"], theirs["var"], atol=1e-4
    )  # sums of numbers up to signal / noise = 1e4 and more
    # and the mean against samples through the GPs' posterior mean
    samples = torch.distributions.MultivariateNormal(
        torch.cat([belief["observation"]["mean"], belief["action"]["mean"]]), joint
    ).sample((100_000,))
    beta = model.compute_factorizations()[1]
    change = []
    for a in range(3):
        distance = torch.cdist(samples / model.ell[a], model.X_tilde_train / model.ell[a])
        change.append(model.alpha_sq[a] * torch.exp(-0.5 * distance**2) @ beta[a])
    moved = samples[:, :3] + torch.stack(change, 1)
    error = moved.std() / 100_000**0.5
    assert torch.allclose(ours["mean"], moved.mean(0), atol=5.0 * float(error))


@needs_gps
def test_it_learns_in_trials_and_a_saved_policy_acts_the_same(tmp_path):
    near = {
        "target": [0.0, -1.0, 0.0, 0.0, 0.0],
        "weights": (0.1 * np.eye(5)).tolist(),
    }  # hanging: a slope at the start
    agent = PILCO(ENV, seed=1, **near, **{**SMALL, "trial_steps": 20, "evaluations": 10})
    before = [parameter.detach().clone() for parameter in agent.controller.parameters()]
    agent.learn(40)
    assert [trial["kind"] for trial in agent.history] == ["exploration", "policy"]
    assert all(0.0 < trial["expected"] <= 1.0 for trial in agent.history)
    assert any((a != b).any() for a, b in zip(before, agent.controller.parameters(), strict=True))
    agent.save(tmp_path / "pilco.zip")
    loaded = load_agent(tmp_path / "pilco.zip")
    y = np.random.default_rng(0).normal(size=(4, 5)).astype(np.float32)
    assert (loaded.predict(y)[0] == agent.predict(y)[0]).all()
    assert len(loaded.history) == 2


@pytest.mark.skipif(not MISSING, reason="gpytorch and botorch are installed")
def test_what_is_missing_is_named():
    with pytest.raises(ImportError, match=r"needs gpytorch and botorch; pip install 'beliefgym\[pilco\]'"):
        PILCO(ENV, **SMALL).learn(8)


def test_the_policy_stays_within_the_limits_and_acts_the_same_alone_and_in_a_batch():
    agent = PILCO(ENV, **SMALL)
    with torch.no_grad():
        agent.controller.weights.mul_(100.0)
    y = np.random.default_rng(0).normal(size=(50, 5)).astype(np.float32)
    actions, state = agent.predict(y)
    assert state is None
    assert actions.shape == (50, 1)
    assert np.abs(actions).max() <= 10.0
    assert np.abs(actions).max() > 5.0
    assert agent.predict(y[7])[0] == pytest.approx(actions[7], abs=1e-5)


def test_the_default_cost_is_the_distance_of_the_poles_tip():
    agent = PILCO(Task(ENV, {"length": 0.8}), **SMALL)
    x, theta = 0.3, 0.4
    y = torch.tensor([x, np.cos(theta), np.sin(theta), 5.0, -3.0], dtype=torch.float64) - agent.target
    squared = (x + 0.8 * np.sin(theta)) ** 2 + (0.8 * np.cos(theta) - 0.8) ** 2
    assert float(y @ agent.weights @ y) == pytest.approx(squared / 0.8**2)


def test_points_are_spread():
    line = torch.cat([torch.zeros(50, 1), torch.tensor([[1.0], [2.0], [10.0]])])
    assert sorted(line[spread_points(line, 4), 0].tolist()) == [0.0, 1.0, 2.0, 10.0]
    assert len(spread_points(line, 100)) == 53


def test_wrong_arguments_are_told():
    with pytest.raises(ValueError, match="expected target and weights for Pendulum-v0, got none"):
        PILCO("beliefgym/Pendulum-v0", **SMALL)
    with pytest.raises(
        ValueError, match=r"expected target \(5,\) and weights \(5, 5\).*got \(2,\) and \(5, 5\)"
    ):
        PILCO(ENV, target=[0.0, 1.0], weights=np.eye(5), **SMALL)
    with pytest.raises(ValueError, match="expected horizon, n_basis and evaluations of at least 1"):
        PILCO(ENV, evaluations=0)
    with pytest.raises(ValueError, match="expected finite observations"):
        PILCO(ENV, **SMALL).predict(np.full(5, np.inf))
