"""Returns along pieces against the sums that define them, and the policy that is taken from values.

Double precision throughout: TOLD is a few roundings of sums of a dozen numbers of unit size.
"""

import numpy as np
import pytest
import torch

from beliefgym.agents.recurrent.action_choice import action_probabilities
from beliefgym.agents.recurrent.targets import lambda_returns, n_step_returns, step_weights

TOLD = {"rtol": 1e-12, "atol": 1e-12}
GAMMA = 0.9
LENGTHS = (1, 2, 5, 8, 8, 3)


class Pieces:
    """Random pieces of several lengths; every second one is terminated, what stands in the padding is large."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        shape = (len(LENGTHS), max(LENGTHS))
        self.r, self.v, self.anchors = rng.standard_normal((3, *shape))
        self.weights = rng.uniform(0.0, 1.0, shape)
        self.is_last = np.arange(shape[1]) == np.array(LENGTHS)[:, None] - 1
        self.padding = np.arange(shape[1]) >= np.array(LENGTHS)[:, None]
        self.terminated = self.is_last & (np.arange(shape[0]) % 2 == 0)[:, None]
        self.d = GAMMA * ~self.terminated
        for x in (self.r, self.v, self.anchors):
            x[self.padding] = 1e6
        self.weights[self.is_last] = 0.0

    def n_step(self, i, t, n):
        """sum_{j<n} gamma^j r_{t+j} + gamma^n V, cut at the piece's end; V is the value after step t + n - 1."""
        n = min(n, LENGTHS[i] - t)
        last = t + n - 1
        value = 0.0 if self.terminated[i, last] else self.v[i, last]
        return sum(GAMMA**j * self.r[i, t + j] for j in range(n)) + GAMMA**n * value


def torched(*arrays):
    return [torch.from_numpy(np.asarray(x)) for x in arrays]


def compare(found, by_hand):
    for i, length in enumerate(LENGTHS):
        expected = [by_hand(i, t) for t in range(length)]
        np.testing.assert_allclose(found[i, :length].numpy(), expected, **TOLD)


@pytest.mark.parametrize("lam", [0.0, 0.6, 1.0])
def test_lambda_returns_are_the_weighted_sum_of_n_step_returns(lam):
    p = Pieces()
    weights = lam * ~p.is_last
    found = lambda_returns(*torched(p.r, p.d, p.v, weights, p.v))

    def forward_view(i, t):
        left = LENGTHS[i] - t
        shares = [(1 - lam) * lam ** (n - 1) for n in range(1, left)] + [lam ** (left - 1)]
        return sum(share * p.n_step(i, t, n) for n, share in enumerate(shares, start=1))

    compare(found, forward_view)


def test_traces_of_their_own_give_the_sum_over_temporal_differences():
    """Retrace: Q_t + sum_s gamma^(s-t) c_{t+1} .. c_s (r_s + gamma V_{s+1} - Q_s); anchors at t are Q_{t+1}."""
    p = Pieces()
    q = np.concatenate([np.ones((len(LENGTHS), 1)), p.anchors[:, :-1]], axis=1)
    c = np.concatenate([np.ones((len(LENGTHS), 1)), p.weights[:, :-1]], axis=1)
    found = lambda_returns(*torched(p.r, p.d, p.v, p.weights, p.anchors))

    def forward_view(i, t):
        return q[i, t] + sum(
            GAMMA ** (s - t) * np.prod(c[i, t + 1 : s + 1]) * (p.r[i, s] + p.d[i, s] * p.v[i, s] - q[i, s])
            for s in range(t, LENGTHS[i])
        )

    compare(found, forward_view)


def test_one_episode_by_numbers():
    """r = 1, 2, gamma 1/2, lambda 1/2, values 10 and 20: G_1 = 2 + 20/2 = 12, G_0 = 1 + (10/2 + 12/2) / 2 = 6.5."""
    found = lambda_returns(*torched([[1.0, 2.0]], [[0.5, 0.5]], [[10.0, 20.0]], [[0.5, 0.0]], [[10.0, 20.0]]))
    assert found.tolist() == [[6.5, 12.0]]
    found = lambda_returns(*torched([[1.0, 2.0]], [[0.5, 0.0]], [[10.0, 20.0]], [[0.5, 0.0]], [[10.0, 20.0]]))
    assert found.tolist() == [[4.0, 2.0]]


@pytest.mark.parametrize("k", [0, 1, 3, 12])
def test_n_step_returns_are_sums_of_rewards_up_to_a_pieces_end(k):
    p = Pieces()
    found = n_step_returns(*torched(p.r, p.d, p.v, p.is_last), k)
    assert len(found) == k + 1
    for n, targets in enumerate(found, start=1):
        compare(targets, lambda i, t, n=n: p.n_step(i, t, n))


def test_gradients_of_n_step_returns_reach_the_value_that_is_bootstrapped_from_alone():
    p = Pieces()
    r, d, v, is_last = torched(p.r, p.d, p.v, p.is_last)
    v.requires_grad_()
    n_step_returns(r, d, v, is_last, 3)[2][3, 1].backward()  # from step 1 over three rewards: gamma^3 V_4
    expected = torch.zeros_like(v)
    expected[3, 3] = GAMMA**3
    torch.testing.assert_close(v.grad, expected, **TOLD)


@pytest.mark.parametrize(
    ("k", "weights", "expected"),
    [
        (0, 0.5, [1.0]),
        (2, 0.5, [4 / 7, 2 / 7, 1 / 7]),
        (2, 1.0, [1 / 3, 1 / 3, 1 / 3]),
        (2, 1, [1 / 3, 1 / 3, 1 / 3]),
        (1, 0.0, [1.0, 0.0]),
        (2, [0.0, 2.0, 6.0], [0.0, 0.25, 0.75]),
    ],
)
def test_step_weights_sum_to_one_in_the_given_proportions(k, weights, expected):
    assert step_weights(k, weights) == pytest.approx(expected, rel=1e-15)  # a rounding


@pytest.mark.parametrize(("k", "weights"), [(1, [1.0]), (1, [1.0, -0.5]), (1, [0.0, 0.0]), (2, -0.5)])
def test_weights_that_are_none_are_refused(k, weights):
    with pytest.raises(
        ValueError, match=rf"expected lambda, or {k + 1} weights of at least 0 for the residuals"
    ):
        step_weights(k, weights)


VALUES = torch.tensor([[[1.0, 3.0, 2.0], [5.0, 5.0, -1.0]]], dtype=torch.float64)


def test_the_policy_is_the_first_arg_max_without_softening():
    assert action_probabilities(VALUES).tolist() == [[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]]


@pytest.mark.parametrize("temperature", [0.3, 2.0])
def test_temperature_makes_it_a_soft_max(temperature):
    found = action_probabilities(VALUES, 0.0, temperature).numpy()
    odds = np.exp(VALUES.numpy() / temperature)
    np.testing.assert_allclose(found, odds / odds.sum(-1, keepdims=True), **TOLD)


def test_a_small_temperature_comes_to_the_arg_max():
    cold = action_probabilities(VALUES[:, :1], 0.0, 0.01)
    # the second best is 1 below: its share is exp(-100)
    torch.testing.assert_close(cold, action_probabilities(VALUES[:, :1]), rtol=0, atol=1e-40)


@pytest.mark.parametrize("temperature", [0.0, 0.7])
@pytest.mark.parametrize("epsilon", [0.3, 1.0])
def test_epsilon_is_the_share_of_uniform_actions(epsilon, temperature):
    greedy, found = (action_probabilities(VALUES, e, temperature) for e in (0.0, epsilon))
    torch.testing.assert_close(found, (1 - epsilon) * greedy + epsilon / 3, **TOLD)


@pytest.mark.parametrize("values", [VALUES, 1e4 * VALUES.float(), torch.linspace(-3.0, 4.0, 14).view(7, 2)])
@pytest.mark.parametrize("epsilon", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("temperature", [0.0, 0.05, 10.0])
def test_probabilities_sum_to_one_and_hold_no_gradient(values, epsilon, temperature):
    found = action_probabilities(values.clone().requires_grad_(), epsilon, temperature)
    assert not found.requires_grad
    assert found.dtype == values.dtype
    assert (found >= 0.0).all()
    # of float32, a few roundings
    torch.testing.assert_close(found.sum(-1), torch.ones_like(found[..., 0]), rtol=0, atol=1e-6)
