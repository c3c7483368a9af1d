"""Derivatives of regressors and of learned models, against autograd, closed forms and finite differences."""

import numpy as np
import pytest
import torch
from sklearn import linear_model
from sklearn.exceptions import NotFittedError
from sklearn.kernel_ridge import KernelRidge

from beliefgym.learning import (
    DataAsDemonstrator,
    PolynomialRidge,
    RandomForest,
    RandomFourierRidge,
    Ridge,
    Sequences,
    linear_in_features,
)
from beliefgym.learning.model_derivatives import derivatives

SCALES = np.array([1.0, 30.0, 0.2])  # of the components: a forgotten standardisation is off by these
POLYNOMIALS = [
    PolynomialRidge(degree=degree, interaction_only=interaction, fit_intercept=intercept, alpha=1e-3)
    for degree in (1, 2, 4)
    for interaction in (False, True)
    for intercept in (True, False)
]
FOURIERS = [
    RandomFourierRidge(
        n_frequencies=9, bandwidth=bandwidth, include_inputs=inputs, fit_intercept=intercept, random_state=3
    )
    for bandwidth in (None, 0.7)
    for inputs in (False, True)
    for intercept in (True, False)
]


def linear_predict(model, x):
    return x @ torch.as_tensor(np.atleast_2d(model.coef_)).T + torch.as_tensor(model.intercept_)


def polynomial_predict(model, x):
    monomials = (x[:, None] ** torch.as_tensor(model.powers_)).prod(-1)
    return linear_predict(model, monomials)


def fourier_predict(model, x):
    turned = x @ torch.as_tensor(model.frequencies_)
    parts = [torch.cos(turned), torch.sin(turned)]
    features = torch.cat(parts, 1) * model.n_frequencies**-0.5
    return linear_predict(model, torch.cat([x, features], 1) if model.include_inputs else features)


def fitted(regressor, n_targets=2):
    rng = np.random.default_rng(0)
    X = rng.normal(size=(60, 3))
    y = np.stack([np.sin(X[:, 0]) * X[:, 1] + 1.0, X[:, 2] ** 3 - 2.0 * X[:, 0]], 1)[:, :n_targets]
    return regressor.fit(X, y), rng.normal(size=(7, 3))


@pytest.mark.parametrize(
    ("regressor", "predict"),
    [(Ridge(), linear_predict), (Ridge(fit_intercept=False), linear_predict)]
    + [(one, polynomial_predict) for one in POLYNOMIALS]
    + [(one, fourier_predict) for one in FOURIERS],
    ids=lambda one: getattr(one, "__name__", str(one)),
)
def test_a_regressors_jacobian_is_autograds_of_the_same_sum(regressor, predict):
    model, X = fitted(regressor)
    x = torch.as_tensor(X).requires_grad_()
    outputs = predict(model, x)
    np.testing.assert_allclose(
        outputs.detach(), model.predict(X), atol=1e-11
    )  # the oracle is the same function
    expected = torch.stack(
        [torch.autograd.grad(outputs[:, i].sum(), x, retain_graph=True)[0] for i in (0, 1)], 1
    )
    found = model.jacobian(X)
    assert found.shape == (7, 2, 3)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11)  # rounding of some hundred terms


def test_the_jacobian_of_a_single_target_keeps_its_axis():
    rng = np.random.default_rng(1)
    X = rng.normal(size=(30, 3))
    model = PolynomialRidge(degree=2, alpha=0.0).fit(X, X[:, 0] * X[:, 2] + 4.0 * X[:, 1])
    expected = np.stack([X[:, 2], np.full(30, 4.0), X[:, 0]], 1)[:, None]
    np.testing.assert_allclose(model.jacobian(X), expected, atol=1e-9)  # noise-free data, well conditioned


@pytest.mark.parametrize("regressor", [PolynomialRidge(degree=3), FOURIERS[2]], ids=str)
def test_a_jacobian_in_blocks_is_that_in_one_piece(regressor, monkeypatch):
    model, _ = fitted(regressor)
    X = np.random.default_rng(2).normal(size=(700, 3))
    whole = model.jacobian(X)
    monkeypatch.setattr(
        linear_in_features, "BLOCK_BYTES", 1
    )  # the least block: 256 rows, the last one shorter
    np.testing.assert_allclose(model.jacobian(X), whole, rtol=1e-12, atol=1e-13)  # BLAS sums blocks otherwise


def trajectories(n_act=2, seed=0, n=8, steps=25):
    """(angle, fast, slow): a driven, damped pendulum and a slow product, on quite different scales."""
    rng = np.random.default_rng(seed)
    x = np.zeros((n, steps + 1, 3))
    u = rng.normal(size=(n, steps, 2)) * (1.0, 5.0)
    x[:, 0] = rng.normal(size=(n, 3))
    for t in range(steps):
        a, b, c = np.moveaxis(x[:, t], -1, 0)
        x[:, t + 1, 0] = a + 0.3 * b
        x[:, t + 1, 1] = 0.9 * b - 0.5 * np.sin(a) + 0.2 * u[:, t, 0]
        x[:, t + 1, 2] = 0.8 * c + 0.1 * np.cos(a) * b + 0.02 * u[:, t, 1]
    return Sequences.from_observations(x * SCALES + (0.0, 7.0, -3.0), actions=u[:, :, :n_act])


def numeric(function, z):
    """(n, k) -> d function / dz (n, d, k): central differences of steps h and h / 2, extrapolated, O(h^4)."""

    def central(h):
        columns = [(function(z + h * e) - function(z - h * e)) / (2 * h) for e in np.eye(z.shape[1])]
        return np.stack(columns, -1)

    return (4.0 * central(5e-4) - central(1e-3)) / 3.0


REGRESSORS = [
    Ridge(alpha=1e-8),
    PolynomialRidge(degree=3, alpha=1e-6),
    RandomFourierRidge(n_frequencies=20, random_state=0),
    RandomFourierRidge(n_frequencies=20, include_inputs=True, fit_intercept=False, random_state=0),
    KernelRidge(alpha=0.1, kernel="rbf", gamma=0.3),  # no jacobian of its own: central differences inside
]


@pytest.mark.parametrize("regressor", REGRESSORS, ids=lambda one: type(one).__name__)
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"target": "next"},
        {"angles": (0,)},
        {"angles": (2, 0), "standardise": "together"},
        {"standardise": False, "target": "next"},
        {"standardise": False, "angles": (0,)},
    ],
    ids=lambda one: getattr(one, "__name__", str(one)),
)
def test_a_models_derivatives_are_those_of_differences_of_its_predictions(regressor, how):
    train = trajectories()
    model = DataAsDemonstrator(regressor, n_iterations=0, **how).fit(train)
    x, u = train.observations[:3, 4:8].copy(), train.actions[:3, 4:8].copy()
    a, b = derivatives(model, x, u)
    assert a.shape == (3, 4, 3, 3)
    assert b.shape == (3, 4, 3, 2)
    rows, acts = x.reshape(-1, 3), u.reshape(-1, 2)
    units = train.observations.std(axis=(0, 1))  # differences and tolerances in these
    by_x = numeric(lambda z: model.predict(z * units, acts) / units, rows / units)
    by_u = numeric(lambda v: model.predict(rows, v) / units, acts)
    # truncation h^4 f'''''/ 480, rounding 1e-15 / h, and 1e-10 of f''' where there are central differences inside;
    # a kernel on data that nothing standardises has slopes of 70
    np.testing.assert_allclose(a.reshape(-1, 3, 3) * units / units[:, None], by_x, rtol=1e-6, atol=3e-7)
    np.testing.assert_allclose(b.reshape(-1, 3, 2) / units[:, None], by_u, rtol=1e-6, atol=3e-7)


@pytest.mark.parametrize(
    "regressor", [RandomFourierRidge(n_frequencies=20, random_state=0), KernelRidge(kernel="rbf")]
)
def test_actions_that_a_model_does_not_use_have_no_effect(regressor):
    train = trajectories()
    model = DataAsDemonstrator(regressor, n_iterations=0, use_actions=False, angles=(0,)).fit(train)
    x, u = train.observations[:, 3], train.actions[:, 3]
    a, b = derivatives(model, x, u)
    np.testing.assert_array_equal(b, np.zeros((8, 3, 2)))
    without = DataAsDemonstrator(regressor, n_iterations=0, angles=(0,)).fit(trajectories(n_act=0))
    expected, none = derivatives(without, x, u[:, :0])
    assert none.shape == (8, 3, 0)
    np.testing.assert_allclose(a, expected, rtol=1e-10, atol=1e-10)  # the same fit but for its summation


@pytest.mark.parametrize(
    "regressor", [Ridge(alpha=0.0), linear_model.LinearRegression()], ids=["jacobian", "differences"]
)
@pytest.mark.parametrize("target", ["delta", "next"])
def test_a_linear_system_gives_back_its_matrices(regressor, target):
    rng = np.random.default_rng(4)
    A = np.array([[0.9, 0.2, 0.0], [-0.1, 0.7, 0.3], [0.0, 0.1, 0.8]])
    B = np.array([[0.0, 1.0], [0.5, 0.0], [20.0, 0.1]])
    u = rng.normal(size=(4, 30, 2))
    x = rng.normal(size=(4, 31, 3))
    for t in range(30):
        x[:, t + 1] = x[:, t] @ A.T + u[:, t] @ B.T + 2.0
    model = DataAsDemonstrator(regressor, n_iterations=0, target=target).fit(
        Sequences.from_observations(x, actions=u)
    )
    a, b = derivatives(model, x[:, 0], u[:, 0])
    # noise-free and well conditioned: rounding; central differences divide it by their step of 1e-5
    np.testing.assert_allclose(a, np.broadcast_to(A, (4, 3, 3)), atol=1e-8)
    np.testing.assert_allclose(b, np.broadcast_to(B, (4, 3, 2)), atol=1e-8)


def test_a_forests_slope_is_seen_by_wide_differences_only():
    rng = np.random.default_rng(5)
    x, u = rng.uniform(-1.0, 1.0, (2000, 2, 1)), rng.uniform(-1.0, 1.0, (2000, 1, 1))
    x[:, 1] = 0.8 * x[:, 0] + 0.5 * u[:, 0]
    model = DataAsDemonstrator(
        RandomForest(n_estimators=20, min_samples_leaf=3, random_state=0), n_iterations=0, target="next"
    ).fit(Sequences.from_observations(x, actions=u))
    inside = np.abs(x[:, 0, 0]) + np.abs(u[:, 0, 0]) < 1.2  # away from the edge, where leaves end
    a, b = derivatives(model, x[inside, 0], u[inside, 0])
    # steps of 0.25 deviations cross a few leaves each: the mean of hundreds of slopes is within 10 %
    assert a.mean() == pytest.approx(0.8, rel=0.1)
    assert b.mean() == pytest.approx(0.5, rel=0.1)
    narrow, _ = derivatives(model, x[inside, 0], u[inside, 0], step=1e-5)
    assert (narrow == 0.0).mean() > 0.95, "a tree is constant between its splits"


def test_derivatives_of_an_unfitted_model_raise():
    with pytest.raises(NotFittedError, match="is not fitted yet; call fit"):
        derivatives(DataAsDemonstrator(), np.zeros((1, 3)), np.zeros((1, 2)))
