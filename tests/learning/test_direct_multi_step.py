"""Direct multi-step models, against matrix powers of linear systems and hand-made regressions."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.ensemble import GradientBoostingRegressor
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from beliefgym.learning import DivergenceWarning, RandomForest, Ridge, Sequences
from beliefgym.learning.direct_multi_step import DirectMultiStep

A = np.array([[0.9, 0.3], [-0.2, 0.95]])
B = np.array([[0.5], [1.0]])
EXACT = Ridge(alpha=0.0)
both_targets = pytest.mark.parametrize("target", ["delta", "next"])


def linear_system(n=40, n_steps=8, controlled=False, seed=0, lengths=None):
    rng = np.random.default_rng(seed)
    actions = rng.normal(size=(n, n_steps, 1)) if controlled else np.zeros((n, n_steps, 0))
    x = np.empty((n, n_steps + 1, 2))
    x[:, 0] = rng.normal(size=(n, 2)) + 1.0
    for t in range(n_steps):
        x[:, t + 1] = x[:, t] @ A.T + (actions[:, t] @ B.T if controlled else 0.0)
    return Sequences.from_observations(x, actions=actions, lengths=lengths)


@both_targets
def test_on_a_linear_system_the_model_of_k_steps_is_the_kth_power(target):
    model = DirectMultiStep(EXACT, horizon=5, target=target).fit(linear_system())
    x = np.random.default_rng(1).normal(size=(7, 2))
    rolled = model.rollout(x, 5)
    for k in range(6):
        expected = x @ np.linalg.matrix_power(A, k).T
        np.testing.assert_allclose(rolled[:, k], expected, atol=1e-10)  # rounding times the condition of X'X


@both_targets
def test_on_a_controlled_linear_system_rollouts_are_exact_also_beyond_the_horizon(target):
    test = linear_system(n=5, n_steps=11, controlled=True, seed=2)
    model = DirectMultiStep(EXACT, horizon=4, target=target).fit(linear_system(controlled=True))
    rolled = model.rollout(test.observations[:, 0], 11, test.actions)
    np.testing.assert_allclose(rolled, test.observations, atol=1e-9)  # rounding over three restarts
    assert model.errors(test).rmse.max() < 1e-9


def test_each_model_is_the_regression_on_all_starts_of_its_number_of_steps():
    rng = np.random.default_rng(3)
    episodes = [
        {"observations": rng.normal(size=(length + 1, 2)), "actions": rng.normal(size=(length, 1))}
        for length in (6, 3, 1, 0, 5)
    ]
    model = DirectMultiStep(EXACT, horizon=4, target="next", standardise=False)
    model.fit(Sequences.from_episodes(episodes))
    for k in range(1, 5):
        inputs, targets = [], []
        for episode in episodes:
            x, u = episode["observations"], episode["actions"]
            for t in range(len(u) - k + 1):
                inputs.append(np.concatenate([x[t], *u[t : t + k]]))
                targets.append(x[t + k])
        expected = np.linalg.lstsq(np.column_stack([inputs, np.ones(len(inputs))]), targets, rcond=None)[0]
        if len(inputs) > len(expected):  # fewer pairs than unknowns have many minimisers
            np.testing.assert_allclose(model.models_[k - 1].coef_, expected[:-1].T, atol=1e-9)


def test_beyond_the_horizon_a_rollout_starts_again_from_its_last_prediction():
    rng = np.random.default_rng(4)
    train = Sequences.from_observations(np.cumsum(rng.normal(size=(20, 7, 2)), axis=1))
    model = DirectMultiStep(RandomForest(n_estimators=5, random_state=0), horizon=3).fit(train)
    x = train.observations[:4, 0]
    whole = model.rollout(x, 8)
    again = model.rollout(model.rollout(whole[:, 3], 3)[:, -1], 2)
    np.testing.assert_allclose(whole[:, 6:], again, rtol=1e-12)  # the same arithmetic but for units


def test_with_horizon_one_a_rollout_is_predict_again_and_again():
    train = linear_system(controlled=True)
    model = DirectMultiStep(Ridge(alpha=0.1), horizon=1).fit(train)
    x = train.observations[:, 0]
    rolled = model.rollout(x, 8, train.actions)
    for t in range(8):
        x = model.predict(x, train.actions[:, t])
        np.testing.assert_allclose(rolled[:, t + 1], x, rtol=1e-10, atol=1e-12)  # as above


def test_what_lies_past_the_ends_never_matters():
    whole = linear_system(n=20, n_steps=6, controlled=True)
    short = Sequences.from_observations(whole.observations, actions=whole.actions, lengths=np.arange(20) % 7)
    padded = Sequences.concatenate([short, linear_system(n=1, n_steps=9, controlled=True)])[:20]
    assert padded.n_steps == 9
    model = DirectMultiStep(Ridge(), horizon=4)
    found = [[m.coef_ for m in clone(model).fit(train).models_] for train in (short, padded)]
    for coef, other in zip(*found, strict=True):
        np.testing.assert_array_equal(coef, other)


@pytest.mark.parametrize(
    "regressor",
    [
        LinearRegression(),
        RandomForest(n_estimators=3, random_state=0),
        GradientBoostingRegressor(n_estimators=3),
    ],
    ids=lambda r: type(r).__name__,
)
def test_any_scikit_learn_regressor_will_do(regressor):
    train = linear_system()
    model = clone(DirectMultiStep(regressor, horizon=3, progress_bar=False)).fit(train, train)
    assert model.rollout(train.observations[:, 0], 7).shape == (40, 8, 2)
    assert {name: values.shape for name, values in model.history_.items()} == dict.fromkeys(
        (
            "train_multi_step",
            "validation_multi_step",
            "train_single_step",
            "validation_single_step",
            "seconds",
        ),
        (1,),
    )


def test_a_single_observed_component_is_learned_too():
    x = 0.5 ** np.arange(5)[None, :, None] * np.array([1.0, 2.0, 3.0])[:, None, None]
    model = DirectMultiStep(EXACT, horizon=2).fit(Sequences.from_observations(x))
    np.testing.assert_allclose(model.rollout([8.0], 4)[:, 0], [8.0, 4.0, 2.0, 1.0, 0.5], rtol=1e-10)


def test_a_rollout_that_diverges_is_cut_and_told():
    x = 3.0 ** np.arange(5)[None, :, None] * np.linspace(1.0, 2.0, 5)[:, None, None]
    model = DirectMultiStep(EXACT, horizon=2, divergence_limit=10.0).fit(Sequences.from_observations(x))
    with pytest.warns(
        DivergenceWarning, match=r"1 of 2 rollouts diverged .* first \(trajectory 0\) in step \d"
    ):
        rolled = model.rollout([[100.0], [1e-6]], 8)
    assert np.isfinite(rolled).all()
    assert rolled[0, -1] == rolled[0, -2]


def test_what_is_wrong_is_told():
    train = linear_system(n_steps=6)
    with pytest.raises(ValueError, match="horizon of at most the longest trajectory's 6 steps, got 7"):
        DirectMultiStep(horizon=7).fit(train)
    with pytest.raises(ValueError, match="horizon to be a whole number of at least 1, got 0"):
        DirectMultiStep(horizon=0).fit(train)
    with pytest.raises(TypeError, match="expected Sequences, got ndarray"):
        DirectMultiStep().fit(train.observations)
    with pytest.raises(NotFittedError, match="this DirectMultiStep is not fitted yet"):
        DirectMultiStep().rollout([0.0, 0.0], 3)
    with pytest.raises(ValueError, match="2 observations and 0 actions as at fit, got 2 and 1"):
        DirectMultiStep(EXACT, horizon=2).fit(train, linear_system(controlled=True))
