"""PETS: its parts against independent answers, and the agent's face."""

import numpy as np
import pytest
import torch

from beliefgym.agents import load_agent
from beliefgym.agents.cross_entropy_method import CrossEntropyMethod
from beliefgym.agents.gaussian_ensemble import GaussianEnsemble, gaussian_negative_log_likelihood
from beliefgym.agents.observed_cost import ObservedCost
from beliefgym.agents.probabilistic_ensemble import ProbabilisticEnsembleControl
from beliefgym.envs.cart_pole import CartPole
from beliefgym.wrappers import Task

ENV = "beliefgym/CartPoleSwingUp-v0"
SMALL = {
    "trial_steps": 12,
    "particles": 5,
    "hidden": (16,),
    "training_steps": 40,
    "horizon": 6,
    "candidates": 16,
    "iterations": 2,
}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def agent():
    return ProbabilisticEnsembleControl(ENV, seed=3, **SMALL).learn(24)


def roll(agent, observations):
    """Actions on a given sequence of observations (T, n, 5)."""
    state, actions = None, []
    for observation in observations:
        action, state = agent.predict(observation, state)
        actions.append(action)
    return np.array(actions)


@pytest.fixture(scope="module")
def observations():
    env = Task(ENV).make_vec(3)
    seen = [env.reset(seed=8)[0]]
    env.action_space.seed(0)
    seen += [env.step(env.action_space.sample())[0] for _ in range(3)]
    env.close()
    return seen


# the ensemble


def test_the_likelihood_is_torchs():
    mean, log_variance, target = torch.randn(3, 7, 4, 5, generator=generator())
    ours = gaussian_negative_log_likelihood(target, mean, log_variance)
    normal = torch.distributions.Normal(mean, torch.exp(0.5 * log_variance))
    assert torch.allclose(ours, -normal.log_prob(target).sum(-1), atol=1e-4)  # float32, terms of order 10


def test_the_batched_members_are_separate_networks():
    """One batched product against plain layers of each member, in the inputs' own units."""
    model = GaussianEnsemble(3, 2, members=4, hidden=(8, 8), seed=1)
    x = torch.randn(50, 3, generator=generator()) * torch.tensor([1.0, 10.0, 0.1]) + 5.0
    model.fit(x, torch.stack([x[:, 0], 3.0 + x[:, 1]], 1), steps=5)
    weights, biases = model.folded()
    for member in range(4):
        h = (x - model.input_mean) / model.input_std
        for weight, bias in zip(model.weights, model.biases, strict=True):
            last = torch.nn.functional.linear(h, weight[member].T, bias[member, 0])
            h = torch.nn.functional.silu(last)
        alone = last[:, :2] * model.target_std + model.target_mean
        folded = x
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            folded = folded @ weight[member] + bias[member]
            folded = torch.nn.functional.silu(folded) if i < 2 else folded
        assert torch.allclose(
            folded[:, :2], alone, atol=1e-3
        )  # float32 with offsets of 50 standard deviations
        assert torch.allclose(folded[:, 2:], last[:, 2:], atol=1e-3)


def test_the_ensemble_learns_mean_and_noise_and_its_members_differ_away_from_the_data():
    x = 2.0 * torch.rand(800, 1, generator=generator()) - 1.0
    std = 0.05 + 0.2 * (x > 0)
    y = torch.sin(3.0 * x) + std * torch.randn(800, 1, generator=generator(1))
    model = GaussianEnsemble(1, 1, hidden=(32, 32), seed=0)
    model.fit(x, y, steps=600)
    at = torch.tensor([[-0.5], [0.5], [6.0]])
    with torch.no_grad():
        mean, log_variance = model(((at - model.input_mean) / model.input_std).expand(5, 3, 1))
    mean, noise = (
        mean * model.target_std + model.target_mean,
        torch.exp(0.5 * log_variance) * model.target_std,
    )
    assert (
        mean[:, :2] - torch.sin(3.0 * at[:2])
    ).abs().max() < 0.1  # 400 samples of std 0.25: 0.0125, and bias
    assert noise.mean(0)[:2, 0].tolist() == pytest.approx([0.05, 0.25], rel=0.35)
    spread = mean.std(0)[:, 0]
    assert (spread[:2] > 0).all()
    assert spread[2] > 5.0 * spread[:2].max()


def test_the_ensemble_says_which_shapes_it_expects():
    with pytest.raises(
        ValueError, match=r"expected inputs \(N, 3\) and targets \(N, 2\), got \(5, 3\) and \(4, 2\)"
    ):
        GaussianEnsemble(3, 2).fit(torch.zeros(5, 3), torch.zeros(4, 2))


# the planner


def test_the_cross_entropy_method_finds_the_constrained_optimum_of_a_quadratic():
    """(a - g)'(a - g) over [-1, 1]: the optimum is g clipped, for each copy its own g."""
    method = CrossEntropyMethod(horizon=6, candidates=200, iterations=12, elites=20, noise_exponent=0.0)
    goal = torch.tensor([0.3, -0.6, 1.7])[:, None, None] * torch.ones(3, 6, 2)
    plan = method.start(3, 2)
    for seed in range(3):
        plan, costs = method.improve(
            lambda plans: ((plans - goal[:, None]) ** 2).sum((-2, -1)), plan, method.draw(2, generator(seed))
        )
    optimum = goal.clamp(-1.0, 1.0)
    assert (plan.elites[:, 0] - optimum).abs().max() < 0.05
    least = ((optimum - goal) ** 2).sum((-2, -1))
    assert (costs[:, 0] - least).abs().max() < 0.1  # the slope at the bound is 1.4 for each of 12 actions
    assert (costs.diff(dim=1) >= 0).all()


def test_the_noise_has_unit_variance_and_the_colour_that_was_asked_for():
    for exponent, neighbours in ((0.0, 0.0), (2.0, 0.75)):
        method = CrossEntropyMethod(horizon=24, candidates=20_000, iterations=1, noise_exponent=exponent)
        (noise,) = method.draw(1, generator())
        assert noise.shape == (20_000, 24, 1)
        assert noise.var().item() == pytest.approx(1.0, abs=0.03)  # strongly correlated draws: wide
        correlation = (noise[:, 1:] * noise[:, :-1]).mean().item()
        assert correlation >= neighbours - 0.02
        if exponent == 0.0:
            assert abs(correlation) < 0.02  # 460,000 products: std 0.0015, wide for the share of the mean


def test_a_cost_that_is_not_finite_is_never_chosen():
    method = CrossEntropyMethod(horizon=4, candidates=32)
    plan, costs = method.improve(
        lambda plans: torch.where(plans[..., 0, 0] > 0, torch.nan, 1.0 - plans[..., 0, 0]),
        method.start(2, 1),
        method.draw(1, generator()),
    )
    assert (plan.elites[:, :, 0] <= 0).all()
    assert torch.isfinite(costs).all()


def test_a_shifted_plan_begins_one_step_later():
    method = CrossEntropyMethod(horizon=4, kept=1)
    plan = method.start(1, 1)
    plan = plan._replace(
        mean=torch.arange(4.0).reshape(1, 4, 1), elites=torch.arange(4.0).reshape(1, 1, 4, 1)
    )
    shifted = method.shift(plan)
    assert shifted.mean.flatten().tolist() == shifted.elites.flatten().tolist() == [1.0, 2.0, 3.0, 3.0]


def test_the_planner_says_which_numbers_it_expects():
    with pytest.raises(ValueError, match="expected 1 <= kept <= elites <= candidates"):
        CrossEntropyMethod(candidates=4, elites=8)
    with pytest.raises(ValueError, match="expected horizon of at least 2"):
        CrossEntropyMethod(horizon=1)


# the cost


def test_the_cost_by_names_is_the_systems_stage_cost():
    system = CartPole()
    rng = np.random.default_rng(0)
    state, action = rng.normal(size=(50, 4)) * 3.0, rng.uniform(-10, 10, size=(50, 1))
    for names in (system.observation_names, system.observation_names[::-1]):
        order = [system.observation_names.index(name) for name in names]
        cost = ObservedCost(system, names)
        found = cost(torch.as_tensor(system.observe(state)[:, order]), torch.as_tensor(action))
        assert found.numpy() == pytest.approx(system.stage_cost(state, action), rel=1e-12)


def test_a_state_that_is_not_observed_is_named():
    with pytest.raises(
        ValueError, match=r"expected state 'velocity' of CartPole in the observation.*give a cost"
    ):
        ProbabilisticEnsembleControl("beliefgym/CartPoleSwingUpPosition-v0", **SMALL)


# the agent


def test_a_plan_of_a_perfect_model_costs_what_the_system_says(agent, observations):
    """With the ensemble's change replaced by the true one: rollout, scales and cost against numpy."""
    system = CartPole()
    y = torch.as_tensor(observations[2], dtype=torch.float32)
    plans = 2.0 * torch.rand(3, 4, 6, 1, generator=generator()) - 1.0

    def change(inputs):
        s = inputs.double()
        state = torch.stack([s[..., 0], s[..., 3], torch.atan2(s[..., 2], s[..., 1]), s[..., 4]], -1)
        moved = system.observe(system.flow(state, s[..., 5:])).float()
        return moved - inputs[..., :5], torch.zeros_like(moved)

    other = ProbabilisticEnsembleControl(ENV, seed=3, **SMALL)
    other._change = change
    found = other.plan_costs(y, plans, torch.zeros(6, 5, 1, 1, 1, 5))
    state = np.stack([y[:, 0], y[:, 3], np.arctan2(y[:, 2], y[:, 1]), y[:, 4]], -1).astype(float)
    state, expected = np.repeat(state[:, None], 4, 1), np.zeros((3, 4))
    for t in range(6):
        action = 10.0 * plans[:, :, t].numpy().astype(float)
        expected += system.stage_cost(state, action)
        state = system.flow(state, action)
    expected += system.stage_cost(state, np.zeros((3, 4, 1)))
    assert found.numpy() == pytest.approx(expected, rel=1e-4)  # float32 over 6 steps


def test_the_history_says_what_each_trial_was(agent):
    assert [trial["kind"] for trial in agent.history] == ["exploration", "policy"]
    assert [trial["steps"] for trial in agent.history] == [12, 12]
    assert agent.num_timesteps == 24
    y, u, following = agent.observed()
    assert (y[1:12] == following[:11]).all()
    state = np.stack([y[:, 0], y[:, 3], np.arctan2(y[:, 2], y[:, 1]), y[:, 4]], -1).astype(float)
    costs = CartPole().stage_cost(state, u.astype(float))
    assert [trial["cost"] for trial in agent.history] == pytest.approx(
        [costs[:12].sum(), costs[12:].sum()], rel=1e-5
    )


def test_a_copy_acts_the_same_alone_and_in_a_batch(agent, observations):
    together = roll(agent, observations)
    assert together.shape == (4, 3, 1)
    assert (np.abs(together) <= 10.0).all()
    for i in range(3):
        alone = roll(agent, [observation[i] for observation in observations])
        assert alone == pytest.approx(together[:, i], abs=1e-3)  # N; float32 products of other shapes
    assert together.std() > 0


def test_a_copy_that_starts_anew_forgets_its_plan(agent, observations):
    _, state = agent.predict(observations[0])
    action, kept = agent.predict(observations[1], state, episode_start=np.array([True, False, False]))
    fresh, _ = agent.predict(
        observations[1], agent.predict(observations[2])[1], episode_start=np.ones(3, bool)
    )
    assert action[0] == pytest.approx(fresh[0], abs=1e-3)
    assert kept.calls == 2


def test_a_saved_agent_acts_the_same_and_goes_on_learning(agent, observations, tmp_path):
    agent.save(tmp_path / "pets.zip")
    loaded = load_agent(tmp_path / "pets.zip")
    assert (roll(loaded, observations) == roll(agent, observations)).all()
    assert loaded.history == agent.history
    loaded.learn(12)
    straight = ProbabilisticEnsembleControl(ENV, seed=3, **SMALL).learn(36)
    assert [trial["cost"] for trial in loaded.history] == [trial["cost"] for trial in straight.history]
    assert (roll(loaded, observations) == roll(straight, observations)).all()


def test_a_trial_that_ends_early_goes_on_costing(observations):
    """On a track of 2 cm the cart is off after a step or two."""
    agent = ProbabilisticEnsembleControl(Task(ENV, {"track": 0.02, "start_spread": 0.01}), **SMALL).learn(12)
    (trial,) = agent.history
    assert 1 <= trial["steps"] < 12
    assert trial["cost"] > 12 * 7.0  # hanging costs 8 a step


def test_wrong_arguments_are_told(agent, observations):
    with pytest.raises(ValueError, match="expected particles as a multiple of the 5 members, got 7"):
        ProbabilisticEnsembleControl(ENV, particles=7)
    with pytest.raises(
        ValueError, match="expected trial_steps and exploration_trials of at least 1, got 0 and 1"
    ):
        ProbabilisticEnsembleControl(ENV, trial_steps=0)
    with pytest.raises(ValueError, match="expected cost as 'module:name' of a function, got 'nowhere'"):
        ProbabilisticEnsembleControl(ENV, cost="nowhere")
    with pytest.raises(ValueError, match="expected finite observations"):
        agent.predict(np.full(5, np.nan))
    with pytest.raises(ValueError, match="as many as the state has plans for, got 3"):
        agent.predict(observations[1], agent.predict(observations[0][:2])[1])
    with pytest.raises(ValueError, match="expected cost as 'module:name' in an agent that is saved"):
        ProbabilisticEnsembleControl(ENV, cost=lambda y, u: u[..., 0], **SMALL).options()
