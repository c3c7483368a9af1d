"""Target "delta": what the regressor learns is added to the last observation, and ridges shrink to that."""

import numpy as np
import pytest
from sklearn.base import BaseEstimator, RegressorMixin

from beliefgym.learning import (
    PSIM,
    AutoregressiveFilter,
    BackpropPSIM,
    ForwardPSIM,
    LearningStream,
    RandomFourierRidge,
    Sequences,
    load_filter,
    save_filter,
)
from beliefgym.learning.linear_in_features import Ridge

D, K = 2, 3  # components; observations in a predictive state
ALPHA = 0.3  # large, so that what it shrinks to shows


class RidgeAround(RegressorMixin, BaseEstimator):
    """Ridge regression that shrinks to a given function of the latest observation instead of to the mean.

    Args:
        base: (n, D) -> (n, d). columns: of the inputs, where that observation stands.
    """

    def __init__(self, base, columns, alpha=ALPHA):
        self.base, self.columns, self.alpha = base, columns, alpha

    def fit(self, X, y):
        Y = y - self.base(X[:, self.columns])
        self.mean_, answer = X.mean(axis=0), Y.mean(axis=0)
        centred = X - self.mean_
        gram = centred.T @ centred / len(X) + self.alpha * np.eye(X.shape[1])
        self.weights_ = np.linalg.solve(gram, centred.T @ (Y - answer) / len(X))
        self.answer_ = answer
        return self

    def predict(self, X):
        return (X - self.mean_) @ self.weights_ + self.answer_ + self.base(X[:, self.columns])

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def slow(n, n_steps, seed):
    """Two components that change little in a step, seen with noise."""
    rng = np.random.default_rng(seed)
    steps = 0.1 * rng.normal(size=(n, n_steps + 1, D))
    x = rng.normal(size=(n, 1, D)) + np.cumsum(steps, axis=1) + 0.05 * rng.normal(size=steps.shape)
    return Sequences.from_observations(x * [1.0, 40.0] + [0.0, 7.0])


TRAIN, TEST = slow(8, 20, 0), slow(4, 30, 1)


def first(x):
    """phi_1 of an observation that stays."""
    return np.tile(x, (1, K))


def second_of(filter):
    """phi_2 of an observation that stays, by the filter's own coordinates of squares."""
    offset, scale = filter._phi.squares.offset, filter._phi.squares.scale
    return lambda x: np.concatenate([np.tile(x, (1, K)), (np.tile(x, (1, K)) ** 2 - offset) / scale], axis=1)


FILTERS = {
    "psim": lambda regressor, **options: PSIM(
        regressor, n_future=K, n_iterations=3, belief_limit=np.inf, **options
    ),
    "psim from teacher": lambda regressor, **options: PSIM(
        regressor, n_future=K, n_iterations=2, init="teacher", belief_limit=np.inf, **options
    ),
    "forward": lambda regressor, **options: ForwardPSIM(
        regressor, n_future=K, belief_limit=np.inf, **options
    ),
}


@pytest.mark.parametrize("features", ["first", "second"])
@pytest.mark.parametrize("make", FILTERS.values(), ids=FILTERS)
def test_it_is_a_ridge_that_shrinks_to_the_last_observation(make, features):
    """The same filter through the other target, by a regressor that knows what to shrink to."""
    filter = make(Ridge(alpha=ALPHA), target="delta", features=features).fit(TRAIN)
    base = first if features == "first" else second_of(filter)
    by_hand = make(RidgeAround(base, slice(-D, None)), features=features).fit(TRAIN)
    np.testing.assert_allclose(filter.beliefs(TEST), by_hand.beliefs(TEST), rtol=0, atol=1e-8)
    if isinstance(filter, PSIM):
        for name in ("train_error", "aggregate_error", "n_pairs"):
            np.testing.assert_allclose(filter.history_[name], by_hand.history_[name], rtol=1e-7)
    other = make(Ridge(alpha=ALPHA), features=features).fit(TRAIN)
    assert np.abs(filter.beliefs(TEST) - other.beliefs(TEST)).max() > 0.1


def test_so_is_the_autoregression():
    filter = AutoregressiveFilter(Ridge(alpha=ALPHA), n_past=4, target="delta").fit(TRAIN)
    by_hand = AutoregressiveFilter(RidgeAround(lambda x: x, slice(0, D)), n_past=4).fit(TRAIN)
    found, expected = (one.errors(TEST, 6).squared for one in (filter, by_hand))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("kind", ["psim", "forward"])
def test_without_regularisation_the_targets_are_one(kind):
    """With phi_1 both hold the same filters."""
    train = slow(60, 20, 2)
    beliefs = [
        FILTERS[kind](Ridge(alpha=1e-12), target=target).fit(train).beliefs(train)
        for target in ("next", "delta")
    ]
    np.testing.assert_allclose(*beliefs, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "filter",
    [
        PSIM(Ridge(alpha=1e9), n_future=K, target="delta"),
        PSIM(RandomFourierRidge(alpha=1e9, random_state=0), n_future=K, target="delta"),
        AutoregressiveFilter(Ridge(alpha=1e9), target="delta"),
    ],
    ids=["psim", "psim with random features", "autoregression"],
)
def test_with_all_regularisation_it_predicts_the_last_observation_and_the_mean_step(filter):
    filter.fit(TRAIN)
    x = TEST.observations[:, 4]
    predicted = filter.predict_observation(filter.beliefs(TEST)[:, 5])
    drift = predicted - x
    np.testing.assert_allclose(drift, np.tile(drift[0], (len(x), 1)), rtol=0, atol=1e-4)
    step = np.diff(TRAIN.observations, axis=1).reshape(-1, D)
    assert (np.abs(drift[0] - step.mean(axis=0)) < 0.3 * step.std(axis=0)).all()


def test_a_prior_that_holds_on_says_that_the_observation_stays():
    filter = PSIM(Ridge(), n_future=K, n_iterations=1, init="prior", target="delta").fit(TRAIN)
    z = filter._scale.apply(TRAIN.observations)
    stays = np.square(np.diff(z, axis=1)).sum(axis=2).mean()
    assert filter.history_["train_error"][0] == pytest.approx(stays)


def test_where_data_are_few_and_little_changes_it_is_the_better_target():
    train, validation = slow(3, 10, 3), slow(20, 30, 4)
    error = {}
    for target in ("next", "delta"):
        filters = [PSIM(Ridge(alpha=10.0**a), n_future=K, target=target).fit(train) for a in (-4, -2, 0)]
        error[target] = min(filter.errors(validation).mean for filter in filters)
    assert error["delta"] < 0.8 * error["next"]


@pytest.mark.parametrize("features", ["first", "second"])
def test_it_is_kept_in_files(tmp_path, features):
    filters = [
        PSIM(Ridge(), n_future=K, features=features, target="delta"),
        ForwardPSIM(Ridge(), n_future=K, features=features, target="delta", belief_limit=9.0),
        BackpropPSIM(
            PSIM(Ridge(), n_future=K, features=features, target="delta"), n_epochs=1, random_state=0
        ),
    ]
    if features == "first":
        filters.append(AutoregressiveFilter(Ridge(), target="delta"))
    for filter in filters:
        filter.fit(TRAIN)
        loaded = load_filter(save_filter(filter, tmp_path / "filter.safetensors"))
        assert loaded.target == "delta"
        np.testing.assert_array_equal(loaded.beliefs(TEST), filter.beliefs(TEST))


def test_after_dagger_no_epochs_leave_the_filter_of_this_target():
    psim = PSIM(Ridge(alpha=1e-3), n_future=K, target="delta")
    model = BackpropPSIM(psim, init="dagger", n_epochs=0).fit(TRAIN)
    np.testing.assert_allclose(model.beliefs(TEST), model.psim_.beliefs(TEST), rtol=0, atol=1e-12)


@pytest.mark.parametrize("features", ["first", "second"])
def test_a_stream_learns_the_same_pairs_as_the_fit(features):
    """One episode and one refit are one `partial_fit`."""
    psim = PSIM(Ridge(alpha=ALPHA), n_future=K, features=features, target="delta", n_iterations=2).fit(TRAIN)
    psim.model_ = psim._learner.frozen()  # the latest hypothesis in both
    episode = TEST[0:1]
    stream = LearningStream(psim, refit_every=episode.n_steps + 1)
    for x in episode.observations[0]:
        stream.update(x[None])
    psim.partial_fit(episode)
    np.testing.assert_allclose(stream.filter().beliefs(TEST), psim.beliefs(TEST), rtol=0, atol=1e-9)


def test_features_of_ones_own_hold_on_too():
    def features(futures):
        return np.concatenate([futures.reshape(len(futures), -1), np.sin(futures[:, :, 0])], axis=1)

    filter = PSIM(Ridge(alpha=1e6), n_future=K, features=features, target="delta").fit(TRAIN)
    expected = filter._phi(np.repeat(filter._scale.apply(TEST.observations[:, 0])[:, None], K, axis=1))
    drift = filter.beliefs(TEST)[:, 1] - expected
    np.testing.assert_allclose(drift, np.tile(drift[0], (len(TEST), 1)), rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "filter", [PSIM(target="change"), ForwardPSIM(target="change"), AutoregressiveFilter(target="change")]
)
def test_another_target_is_refused(filter):
    with pytest.raises(ValueError, match="expected target to be one of"):
        filter.fit(TRAIN)
