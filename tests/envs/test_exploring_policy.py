"""Exploring policies: their laws against scipy's, importance weights that average to 1, and what `collect` records."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.stats import chisquare, kstest, norm

from beliefgym.envs import EpsilonPolicy, GaussianPolicy, collect
from beliefgym.envs.exploring_policy import epsilon_greedy

BOX = Box(np.array([-1.0, 2.0], np.float32), np.array([3.0, 4.0], np.float32))  # volume 8
OBSERVATIONS = np.random.default_rng(0).normal(size=(20_000, 3))
N = len(OBSERVATIONS)


def pair(observation):
    """A policy with two actions."""
    return np.stack([observation[:, 0], 3.0 + 0.5 * observation[:, 1]], axis=1)


def third(observation):
    """A policy with the choices 0..3."""
    return np.clip(np.round(observation[:, 0] + 1.0), 0, 3)


def pendulum(copies=0, steps=5):
    make = functools.partial(gym.make, "beliefgym/Pendulum-v0", max_episode_steps=steps)
    return SyncVectorEnv([make] * copies, autoreset_mode=AutoresetMode.SAME_STEP) if copies else make()


class Counts:
    """A policy whose action is the number of calls, and which notes what it was asked."""

    def __init__(self):
        self.asked = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.asked.append((state, episode_start, deterministic))
        state = 0 if state is None else state + 1
        return np.full((len(observation), 1), float(state)), state


@pytest.mark.parametrize("std", [0.3, (0.2, 1.5)])
@pytest.mark.parametrize("space", [None, BOX])
def test_gaussian_actions_have_the_law_that_is_told(std, space):
    action, state, log_prob = GaussianPolicy(pair, std, seed=1, action_space=space).predict_with_log_prob(
        OBSERVATIONS
    )
    assert state is None
    assert (action.dtype, action.shape, log_prob.shape) == (np.float32, (N, 2), (N,))
    expected = norm.logpdf(action.astype(np.float64), pair(OBSERVATIONS), std).sum(axis=1)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-12, atol=1e-12)  # rounding
    z = (action - pair(OBSERVATIONS)) / std
    for column in z.T:
        assert kstest(column, "norm").pvalue > 1e-3  # a fixed seed; a false alarm in 1 of 1000 seeds
    assert abs(np.corrcoef(z.T)[0, 1]) < 0.03  # independent: 4 standard errors
    assert (action[:, 1] > 4.0).any()  # not clipped


@pytest.mark.parametrize(("std", "space"), [((1.0, 2.0), None), (1.5, BOX)])
def test_without_a_policy_the_mean_is_zero(std, space):
    policy = GaussianPolicy(None, std, seed=0, action_space=space)
    action, _, log_prob = policy.predict_with_log_prob(OBSERVATIONS)
    assert action.shape == (N, 2)
    expected = norm.logpdf(action.astype(np.float64), 0.0, std).sum(axis=1)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-12)


def test_the_density_is_that_of_the_action_as_recorded():
    """float32 has steps of 8e-3 at 1e5: with std 1e-2 the rounding changes the density, and is told."""
    far = GaussianPolicy(lambda x: np.full((len(x), 1), 1e5), 1e-2, seed=0)
    action, _, log_prob = far.predict_with_log_prob(OBSERVATIONS)
    np.testing.assert_allclose(log_prob, norm.logpdf(action[:, 0].astype(np.float64), 1e5, 1e-2), rtol=1e-12)
    wide = Box(-np.inf, np.inf, (1,), np.float64)
    action = GaussianPolicy(None, 1.0, seed=0, action_space=wide).predict(OBSERVATIONS)[0]
    assert action.dtype == np.float64
    assert (action != action.astype(np.float32)).any()


@pytest.mark.parametrize("start", [0, 5])
@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_on_choices(epsilon, start):
    """Frequencies and probabilities against epsilon / n + (1 - epsilon) [a = pi(x)]."""
    space = Discrete(4, start=start)
    policy = EpsilonPolicy(lambda x: start + third(x), epsilon, action_space=space, seed=3)
    action, _, log_prob = policy.predict_with_log_prob(OBSERVATIONS)
    assert action.shape == (N,)
    assert action.dtype.kind == "i"
    greedy = start + third(OBSERVATIONS)
    p = np.where(action == greedy, 1 - 0.75 * epsilon, 0.25 * epsilon)
    np.testing.assert_allclose(np.exp(log_prob), p, rtol=1e-12)
    counts = np.bincount((action - greedy).astype(int) % 4, minlength=4)
    expected = N * np.array([1 - 0.75 * epsilon, *[0.25 * epsilon] * 3])
    if epsilon:
        assert chisquare(counts, expected).pvalue > 1e-3  # as above; relabelled by the greedy choice
    else:
        assert counts.tolist() == expected.tolist()


def test_epsilon_on_a_box():
    """The mixture's density; the share of uniform draws, of which nothing but the noise leaves the box."""
    epsilon, std = 0.4, np.array([0.01, 0.02])
    policy = EpsilonPolicy(pair, epsilon, action_space=BOX, seed=4, std=std)
    action, _, log_prob = policy.predict_with_log_prob(OBSERVATIONS)
    near = norm.pdf(action.astype(np.float64), pair(OBSERVATIONS), std).prod(axis=1)
    inside = ((action >= BOX.low) & (action <= BOX.high)).all(axis=1)
    expected = epsilon * inside / 8.0 + (1 - epsilon) * near
    np.testing.assert_allclose(np.exp(log_prob), expected, rtol=1e-10)  # exp and log of sums
    assert not inside.all()
    uniform = (np.abs(action - pair(OBSERVATIONS)) > 6 * std).any(axis=1)
    # A uniform draw is taken for a near one with probability (12 0.01 / 4) (12 0.02 / 2) = 0.004 at most.
    assert uniform.mean() == pytest.approx(epsilon, abs=4 * np.sqrt(0.24 / N) + 0.004 * epsilon)
    for column, low, high in zip(action[uniform].T, BOX.low, BOX.high, strict=True):
        assert kstest((column - low) / (high - low), "uniform").pvalue > 1e-3


@pytest.mark.parametrize("epsilon", [0.0, 1.0])
def test_the_limits_of_epsilon_on_a_box(epsilon):
    action, _, log_prob = EpsilonPolicy(
        pair, epsilon, action_space=BOX, seed=4, std=0.5
    ).predict_with_log_prob(OBSERVATIONS)
    near = norm.logpdf(action.astype(np.float64), pair(OBSERVATIONS), 0.5).sum(axis=1)
    np.testing.assert_allclose(log_prob, -np.log(8.0) if epsilon else near, rtol=1e-12)
    assert all(BOX.contains(a) for a in action) == bool(epsilon)


@pytest.mark.parametrize(
    "policy",
    [
        GaussianPolicy(None, 3.0, seed=5, action_space=Box(-2.0, 2.0, (1,))),
        EpsilonPolicy(
            lambda x: 2.0 * x[:, 1:2], 0.5, action_space=Box(-2.0, 2.0, (1,), np.float32), seed=5, std=0.3
        ),
    ],
    ids=["gaussian", "epsilon"],
)
def test_importance_weights_of_the_uniform_policy_average_to_one(policy):
    """E[u(a) / p(a)] = 1 for the uniform density u on -2..2; actions outside have weight 0."""
    sequences = collect(pendulum(8, steps=50), policy, 80, seed=5)
    action = sequences.actions[sequences.step_mask][:, 0]
    weight = 0.25 * (np.abs(action) <= 2.0) * np.exp(-sequences.action_log_probs[sequences.step_mask])
    assert len(weight) == 4000
    assert (weight == 0).any()
    assert abs(weight.mean() - 1.0) < 4 * weight.std() / np.sqrt(len(weight))


def test_importance_weights_estimate_another_policys_return():
    """Episodes of one policy, weighted by the product of their ratios, against episodes of the other.

    The mean weight is 1, and the weighted mean return is the other's; many actions are outside the bounds, which the
    environment clips.
    """

    def lean(observation):
        return -1.5 - 0.1 * observation[:, 2:3]

    def run(policy):
        env = gym.make_vec(
            "beliefgym/Pendulum-v0",
            num_envs=500,
            vectorization_mode="vector_entry_point",
            max_episode_steps=3,
        )
        return collect(env, policy, 10_000, seed=6)

    behaviour = run(GaussianPolicy(None, 2.0, seed=6, action_space=Box(-2.0, 2.0, (1,))))
    assert (np.abs(behaviour.actions) > 2.0).mean() > 0.2
    target = run(GaussianPolicy(lean, 1.2, seed=7))
    mean = lean(behaviour.observations[:, :-1].reshape(-1, 3)).reshape(-1, 3)
    log_target = norm.logpdf(behaviour.actions[:, :, 0], mean, 1.2)
    weight = np.exp((log_target - behaviour.action_log_probs).sum(axis=1))

    def score(sequences):  # the speed at the end, which the actions move by several tenths
        return sequences.observations[:, -1, 2]

    error = weight.std() / 100.0
    assert abs(weight.mean() - 1.0) < 4 * error
    weighted = weight * score(behaviour)
    error = np.hypot(weighted.std(), score(target).std()) / 100.0
    assert abs(weighted.mean() - score(target).mean()) < 4 * error
    assert abs(score(behaviour).mean() - score(target).mean()) > 8 * error  # so that the weights matter


@pytest.mark.parametrize("copies", [0, 3])
def test_collect_records_them_and_repeats(copies):
    def run(seed):
        policy = GaussianPolicy(lambda x: x[:, 1:2], 0.7, seed=seed)
        return collect(pendulum(copies), policy, 5, seed=2)

    sequences = run(0)
    assert sequences.metadata["policy"] == "GaussianPolicy"
    mean = sequences.observations[:, :-1, 1]
    np.testing.assert_allclose(
        sequences.action_log_probs, norm.logpdf(sequences.actions[:, :, 0], mean, 0.7), rtol=1e-12
    )
    assert sequences.equals(run(0))
    assert not np.array_equal(sequences.actions, run(1).actions)


@pytest.mark.parametrize("copies", [0, 3])
def test_collect_records_choices(copies):
    make = functools.partial(gym.make, "CartPole-v1")
    env = SyncVectorEnv([make] * copies, autoreset_mode=AutoresetMode.SAME_STEP) if copies else make()
    policy = EpsilonPolicy(lambda x: (x[:, 2] > 0).astype(int), 0.2, action_space=Discrete(2), seed=0)
    sequences = collect(env, policy, 20, seed=0)
    greedy = sequences.observations[:, :-1, 2] > 0
    p = np.where(sequences.actions[:, :, 0] == greedy, 0.9, 0.1)
    inside = sequences.step_mask
    np.testing.assert_allclose(np.exp(sequences.action_log_probs[inside]), p[inside], rtol=1e-12)
    assert (p[inside] == 0.1).any()


def test_the_noise_is_not_the_environments_own_stream():
    """The same seed for both, as a user will give it: the noise is no copy of the start states' draws."""
    noise = GaussianPolicy(None, 1.0, seed=3, action_space=Box(-1, 1, (4,))).predict(np.zeros((1, 1)))[0]
    assert not np.isin(noise, np.random.default_rng(3).standard_normal(100).astype(np.float32)).any()


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize(
    "around",
    [
        lambda inner: GaussianPolicy(inner, 0.1, seed=0),
        lambda inner: EpsilonPolicy(
            inner, 0.5, std=0.1, action_space=Box(-2.0, 2.0, (1,), np.float32), seed=0
        ),
    ],
    ids=["gaussian", "epsilon"],
)
def test_the_policy_inside_keeps_its_memory_and_is_told_deterministic(around, deterministic):
    inner = Counts()
    sequences = collect(pendulum(), around(inner), 2, seed=0, deterministic=deterministic)
    assert sequences.action_log_probs is not None
    assert [state for state, _, _ in inner.asked] == [None, *range(9)]
    assert [bool(start[0]) for _, start, _ in inner.asked] == [True, *[False] * 4] * 2
    assert {told for _, _, told in inner.asked} == {deterministic}


def test_predict_is_the_same_without_the_log_probability():
    draws = [
        getattr(GaussianPolicy(Counts(), 0.1, seed=0), name)(OBSERVATIONS, 4)
        for name in ("predict", "predict_with_log_prob")
    ]
    assert len(draws[0]) == 2
    assert draws[0][1] == draws[1][1] == 5
    np.testing.assert_array_equal(draws[0][0], draws[1][0])


def test_shapes_of_several_dimensions():
    space = Box(-1.0, 1.0, (2, 3), np.float32)
    for policy in (
        GaussianPolicy(None, np.full((2, 3), 0.5), seed=0, action_space=space),
        EpsilonPolicy(
            lambda x: np.zeros((len(x), 2, 3)), 0.0, action_space=space, seed=0, std=np.full(6, 0.5)
        ),
    ):
        action, _, log_prob = policy.predict_with_log_prob(OBSERVATIONS)
        assert action.shape == (N, 2, 3)
        np.testing.assert_allclose(
            log_prob, norm.logpdf(action.astype(np.float64), 0.0, 0.5).sum(axis=(1, 2)), rtol=1e-12
        )


@pytest.mark.parametrize(
    ("always", "deterministic", "logged"),
    [
        (None, True, True),
        (True, True, True),
        (False, True, False),
        (False, False, True),
        (None, False, True),
    ],
)
def test_a_policy_that_does_not_always_explore_is_asked_by_predict_when_deterministic(
    always, deterministic, logged
):
    class Sometimes:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return np.zeros((len(observation), 1)), state

        def predict_with_log_prob(self, observation, state=None, episode_start=None, deterministic=False):
            return np.ones((len(observation), 1)), state, np.zeros(len(observation))

    policy = Sometimes()
    if always is not None:
        policy.explores_always = always
    sequences = collect(pendulum(), policy, 1, seed=0, deterministic=deterministic)
    assert (sequences.action_log_probs is not None) == logged
    assert (sequences.actions == float(logged)).all()


def test_epsilon_greedy_draws_for_each_row_by_itself():
    action, _ = epsilon_greedy(np.zeros(N, np.int64), Discrete(2), 0.5, np.random.default_rng(0))
    assert (action == 1).mean() == pytest.approx(0.25, abs=4 * np.sqrt(0.1875 / N))


REAL = Box(-1.0, 1.0, (2,), np.float32)


@pytest.mark.parametrize(
    ("error", "message", "make"),
    [
        (TypeError, r"policy that is None, a function .* got 3", lambda: GaussianPolicy(3, 0.1, seed=0)),
        (ValueError, "std finite and above 0, .* got 0", lambda: GaussianPolicy(pair, 0, seed=0)),
        (ValueError, r"shape \(n_act,\), got \(1, nan\)", lambda: GaussianPolicy(pair, (1, np.nan), seed=0)),
        (
            ValueError,
            r"one number or of shape \(2,\), got \[1, 1, 1\]",
            lambda: GaussianPolicy(pair, [1, 1, 1], seed=0, action_space=REAL),
        ),
        (
            ValueError,
            "action_space, or std of shape .* where policy is None",
            lambda: GaussianPolicy(None, 1.0, seed=0),
        ),
        (
            ValueError,
            r"GaussianPolicy needs a Box .* got Discrete\(2\); EpsilonPolicy explores on a Discrete space",
            lambda: GaussianPolicy(pair, 1.0, seed=0, action_space=Discrete(2)),
        ),
        (
            ValueError,
            "seed to be a whole number of at least 0, got None",
            lambda: GaussianPolicy(pair, 1.0, seed=None),
        ),
        (
            ValueError,
            "seed to be a whole number of at least 0, got -1",
            lambda: GaussianPolicy(pair, 1.0, seed=-1),
        ),
        (
            ValueError,
            "epsilon within 0..1, got 1.5",
            lambda: EpsilonPolicy(pair, 1.5, action_space=REAL, seed=0, std=1.0),
        ),
        (
            ValueError,
            "epsilon within 0..1, got nan",
            lambda: EpsilonPolicy(pair, np.nan, action_space=REAL, seed=0, std=1.0),
        ),
        (
            ValueError,
            r"std above 0 on Box.*, got None: .* is a point and has no density; give std",
            lambda: EpsilonPolicy(pair, 0.1, action_space=REAL, seed=0),
        ),
        (
            ValueError,
            r"std None, since Discrete\(4\) has no distances, got 0.1",
            lambda: EpsilonPolicy(third, 0.1, action_space=Discrete(4), seed=0, std=0.1),
        ),
        (
            ValueError,
            r'a policy on Discrete\(4\), got None; policy="random" is uniform',
            lambda: EpsilonPolicy(None, 0.1, action_space=Discrete(4), seed=0),
        ),
        (
            ValueError,
            "action space with bounds, .* take GaussianPolicy",
            lambda: EpsilonPolicy(
                pair, 0.1, action_space=Box(-np.inf, np.inf, (2,), np.float32), seed=0, std=1.0
            ),
        ),
        (
            ValueError,
            r"EpsilonPolicy needs a Discrete space or a Box of floating-point numbers, got MultiBinary\(2\)$",
            lambda: EpsilonPolicy(pair, 0.1, action_space=MultiBinary(2), seed=0),
        ),
        (
            ValueError,
            r"EpsilonPolicy needs .*, got Box\(0, 3, \(2,\), int8\)",
            lambda: EpsilonPolicy(pair, 0.1, action_space=Box(0, 3, (2,), np.int8), seed=0, std=1.0),
        ),
    ],
)
def test_bad_arguments(error, message, make):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("message", "policy"),
    [
        (r"shape \(20000, 3\) from pair, got \(20000, 2\)", GaussianPolicy(pair, (1.0, 1.0, 1.0), seed=0)),
        (
            r"shape \(20000, number of actions\) from third, got \(20000,\)",
            GaussianPolicy(third, 1.0, seed=0),
        ),
        (
            r"finite numbers as actions from <lambda>, got \[\[nan\]",
            GaussianPolicy(lambda x: x[:, :1] * np.nan, 1.0, seed=0),
        ),
        (
            r"whole numbers from 0 to 3 as actions from <lambda>, got",
            EpsilonPolicy(lambda x: third(x) + 0.5, 0.1, action_space=Discrete(4), seed=0),
        ),
        (
            "whole numbers from 0 to 2 as actions from third, got",
            EpsilonPolicy(third, 0.1, action_space=Discrete(3), seed=0),
        ),
    ],
)
def test_bad_actions_of_the_policy_inside(message, policy):
    with pytest.raises(ValueError, match=message):
        policy.predict(OBSERVATIONS)
