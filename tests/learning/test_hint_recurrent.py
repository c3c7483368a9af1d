"""Recurrent networks that estimate hints, against torch's own forward pass, the Kalman filter and closed forms."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning import DivergenceWarning, Sequences
from beliefgym.learning.hint_autoregressive import AutoregressiveHints
from beliefgym.learning.hint_recurrent import GRUHints, LSTMHints
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.recurrent_training import RecurrentNetwork

FILTERS = {"gru": GRUHints, "lstm": LSTMHints}
each_filter = pytest.mark.parametrize("kind", list(FILTERS.values()), ids=list(FILTERS))
SMALL = {"hidden_size": 8, "n_epochs": 3, "batch_size": 8, "random_state": 0}
RAGGED = [30, 7, 1, 0, 22, 30]

# a lightly damped turning state seen through one noisy component: a position and what it takes to know its velocity
TURN = 0.97 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
SYSTEM = LinearGaussianSystem(TURN, np.array([[1.0, 0.3]]), 0.1 * np.eye(2), np.array([[0.3]]))


def turning(n, n_steps=40, seed=0):
    data = SYSTEM.sample(n, n_steps, np.random.default_rng(seed))
    return Sequences.from_observations(data.observations, hints=data.states)


def levels(n, n_steps=30, seed=0):
    """Noise about a level; the hint is the mean so far."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 1, 1)) + rng.normal(size=(n, n_steps + 1, 1))
    return Sequences.from_observations(x, hints=np.cumsum(x, axis=1) / np.arange(1, n_steps + 2)[:, None])


def waves(n=12, n_steps=30, seed=0, lengths=None):
    """Noisy sines of random phase and rate; the hints are a cosine and the rate, in other units."""
    rng = np.random.default_rng(seed)
    t = np.arange(n_steps + 1)
    rate, phase = rng.uniform(0.1, 0.5, (n, 1, 1)), rng.uniform(0, 6, (n, 1, 1))
    angle = rate * t[:, None] + phase
    x = np.concatenate([np.sin(angle), 100.0 + 10.0 * np.sin(angle + 1.0)], axis=2)
    x += [0.02, 0.2] * rng.standard_normal(x.shape)
    h = np.concatenate([1e3 * np.cos(angle) + 5.0, np.broadcast_to(rate, angle.shape)], axis=2)
    return Sequences.from_observations(x, hints=h, lengths=lengths)


def one_by_one(fitted, sequences, missing="raise"):
    """The public calls, one trajectory and one step at a time: mean and std, NaN past the end."""
    mean, std = (np.full((*sequences.observations.shape[:2], fitted.n_hint_), np.nan) for _ in range(2))
    for i, length in enumerate(sequences.lengths):
        belief = fitted.initial_belief()
        for t in range(length + 1):
            belief = fitted.update(belief, sequences.observations[i, t][None], missing=missing)
            mean[i, t], std[i, t] = (part[0] for part in fitted.predict_hint(belief))
    return mean, std


@each_filter
def test_it_learns_a_hint_that_needs_memory(kind):
    train, validation, test = levels(200), levels(50, seed=1), levels(200, seed=2)
    fitted = kind(hidden_size=16, n_epochs=30, random_state=0).fit(train, validation)
    error = fitted.hint_errors(test).mean
    present = AutoregressiveHints(n_past=1).fit(train, validation).hint_errors(test).mean
    window = AutoregressiveHints(n_past=5).fit(train, validation).hint_errors(test).mean
    assert error < 0.25 * present
    assert error < 0.4 * window


@each_filter
def test_linear_gaussian_error_is_the_kalman_filters(kind):
    train, validation, test = turning(200), turning(50, seed=1), turning(400, seed=2)
    fitted = kind(hidden_size=16, n_epochs=40, random_state=0).fit(train, validation)
    known = KalmanFilter.of(SYSTEM, stationary=False)
    beliefs = known.beliefs(test)
    estimates = [known.filter_state(beliefs[:, t], test.observations[:, t]) for t in range(41)]
    squared = np.square(np.stack(estimates, axis=1) - test.hints).sum(axis=2).mean()
    errors = fitted.hint_errors(test)
    ours = np.square(errors.difference).sum(axis=2).mean()
    # nothing that does not see the future beats the exact filter by more than 400 trajectories' chance
    assert 0.99 * squared < ours < 1.1 * squared
    np.testing.assert_allclose(errors.mean_squared_z, 1.0, atol=0.15)
    np.testing.assert_allclose(errors.coverage(0.9), 0.9, atol=0.03)
    # what it expects next, from the network's state by ridge regression
    assert fitted.errors(test).mean < 1.1 * known.errors(test).mean


@pytest.mark.parametrize(
    "options", [{}, {"differences": False}, {"n_layers": 2}, {"standardise": "together"}], ids=str
)
@each_filter
def test_estimates_are_torchs_forward_pass(kind, options, monkeypatch):
    networks, exported = [], RecurrentNetwork.exported

    def keep(network, *args):
        networks.append(network)
        return exported(network, *args)

    monkeypatch.setattr(RecurrentNetwork, "exported", keep)
    train, test = waves(), waves(6, seed=1, lengths=RAGGED)
    fitted = kind(**SMALL, **options).fit(train, test)
    x, h = train.observations.reshape(-1, 2), train.hints.reshape(-1, 2)
    u = (test.observations - x.mean(axis=0)) / x.std(axis=0)
    if options.get("differences", True):
        per_step = np.diff(train.observations, axis=1).reshape(-1, 2).std(axis=0)
        change = np.diff(test.observations, axis=1, prepend=test.observations[:, :1]) / per_step
        u = np.concatenate([u, change], axis=2)
    with torch.no_grad():
        inputs = torch.as_tensor(u.swapaxes(0, 1), dtype=torch.float32)
        hidden, _ = networks[0].run(inputs, networks[0].start(6))
        outputs = networks[0].heads(hidden)[:, :, 0].numpy().swapaxes(0, 1)
    expected = h.mean(axis=0) + h.std(axis=0) * outputs
    found = (fitted.estimate_hints(test).mean - expected) / h.std(axis=0)
    inside = test.observation_mask
    np.testing.assert_allclose(found[inside], 0.0, atol=2e-5)  # float32 over 31 steps
    assert np.isnan(found[~inside]).all()
    # and the error is what training measured, over all observations, the first included
    unit = h.std(axis=0) if "standardise" not in options else np.sqrt(np.square(h.std(axis=0)).mean())
    squared = np.square(fitted.hint_errors(test).difference / unit).sum(axis=2)[inside].mean()
    assert squared == pytest.approx(fitted.history_["validation_error"][fitted.best_epoch_], rel=1e-4)


@each_filter
def test_one_trajectory_at_a_time_is_the_whole_batch(kind):
    test = waves(6, seed=1, lengths=RAGGED)
    fitted = kind(**SMALL).fit(waves())
    mean, std = one_by_one(fitted, test)
    estimate = fitted.estimate_hints(test)
    np.testing.assert_allclose(estimate.mean, mean, rtol=1e-9)  # rounding
    np.testing.assert_allclose(estimate.std, std, rtol=1e-9)


def test_batches_of_other_lengths_together_give_the_same_estimates():
    short, long = waves(5, 12, seed=1, lengths=[12, 7, 1, 0, 4]), waves(6, seed=2, lengths=RAGGED)
    fitted = GRUHints(**SMALL).fit(waves())
    both = fitted.estimate_hints(Sequences.concatenate([short, long])).mean
    np.testing.assert_allclose(both[:5, :13], fitted.estimate_hints(short).mean, rtol=1e-9)
    np.testing.assert_allclose(both[5:], fitted.estimate_hints(long).mean, rtol=1e-9)
    assert np.isnan(both[:5, 13:]).all()


@each_filter
def test_padding_never_matters_to_the_fit(kind):
    lengths = [30, 12, 30, 5, 1, 0, 30, 22, 9, 30, 30, 18]
    train = waves(lengths=lengths)
    padded = Sequences.from_observations(
        np.pad(train.observations, ((0, 0), (0, 25), (0, 0)), constant_values=99.0),
        hints=np.pad(train.hints, ((0, 0), (0, 25), (0, 0)), constant_values=-1e9),
        lengths=lengths,
    )
    one, other = (kind(**SMALL, segment_length=7).fit(data, data) for data in (train, padded))
    for name in ("train_error", "validation_error"):
        np.testing.assert_array_equal(one.history_[name], other.history_[name])
    a, b = one.estimate_hints(train), other.estimate_hints(train)
    np.testing.assert_array_equal(a.mean, b.mean)
    np.testing.assert_allclose(a.std, b.std, rtol=1e-9)
    np.testing.assert_allclose(one.errors(train).mean, other.errors(train).mean, rtol=1e-9)


def test_a_seed_fixes_the_fit_and_leaves_the_global_streams_alone():
    options = {**SMALL, "dropout": 0.2, "segment_length": 7}
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    fits = [
        GRUHints(**{**options, "random_state": seed}).fit(waves(), waves(4, seed=1)) for seed in (0, 0, 1)
    ]
    assert torch.equal(before[0], torch.get_rng_state())
    assert np.array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
    means = [fitted.estimate_hints(waves()).mean for fitted in fits]
    assert np.array_equal(means[0], means[1])
    assert not np.array_equal(means[0], means[2])


def test_the_best_epoch_in_validation_is_kept_and_patience_ends_training():
    train, validation = waves(3, 20), waves(6, 20, seed=1)
    fitted = GRUHints(hidden_size=32, n_epochs=400, patience=15, weight_decay=0.0, random_state=0)
    fitted.fit(train, validation)
    errors = fitted.history_["validation_error"]
    assert fitted.best_epoch_ == np.argmin(errors) == len(errors) - 16
    assert len(errors) < 401
    alone = GRUHints(**SMALL).fit(train)
    assert alone.best_epoch_ == np.argmin(alone.history_["train_error"])
    assert np.isnan(alone.history_["validation_error"]).all()


def test_the_start_estimates_the_mean_hint():
    train = waves()
    fitted = GRUHints(**{**SMALL, "n_epochs": 0}).fit(train)
    h = train.hints.reshape(-1, 2)
    np.testing.assert_allclose(fitted.estimate_hints(train).mean.reshape(-1, 2), [h.mean(axis=0)] * len(h))
    assert fitted.history_["train_error"] == pytest.approx(2.0, rel=1e-5)  # standardised, two hints


def test_before_any_observation_it_says_the_first_hints_and_observations():
    train = waves()
    fitted = GRUHints(**SMALL).fit(train)
    belief = fitted.initial_belief(2)
    mean, std = fitted.predict_hint(belief)
    np.testing.assert_allclose(mean, [train.hints[:, 0].mean(axis=0)] * 2)
    np.testing.assert_allclose(std, [train.hints[:, 0].std(axis=0)] * 2)
    expected = train.observations[:, 0].mean(axis=0)
    np.testing.assert_allclose(fitted.predict_observation(belief), [expected] * 2)


def test_what_is_missing_is_taken_from_the_beliefs_own_expectation():
    train = waves()
    fitted = GRUHints(**SMALL).fit(train)
    belief = fitted.beliefs(train)[:, 6]
    x, filled = train.observations[:, 6].copy(), train.observations[:, 6].copy()
    x[0], x[1, 1] = np.nan, np.nan
    expected = fitted.predict_observation(belief)
    filled[0], filled[1, 1] = expected[0], expected[1, 1]
    np.testing.assert_allclose(
        fitted.update(belief, x, missing="predict"), fitted.update(belief, filled), atol=1e-12
    )
    with pytest.raises(ValueError, match=r"got nan at index \(0, 0\); missing='predict'"):
        fitted.update(belief, x)


def test_short_gaps_are_bridged_and_long_ones_stay_within_the_data():
    train, validation, test = waves(60), waves(20, seed=1), waves(40, seed=2)
    fitted = GRUHints(hidden_size=32, n_epochs=30, random_state=0).fit(train, validation)
    belief = fitted.beliefs(test)[:, 16]
    expected = fitted.predict_observation(belief)
    stays = np.square(test.observations[:, 16] - test.observations[:, 15]).mean(axis=0)
    assert (np.square(expected - test.observations[:, 16]).mean(axis=0) < 0.3 * stays).all()
    bridged = fitted.predict_hint(fitted.update(belief, np.full((40, 2), np.nan), missing="predict")).mean
    before = fitted.predict_hint(belief).mean
    truth = test.hints[:, 16]
    assert np.abs(bridged - truth)[:, 0].mean() < 0.7 * np.abs(before - truth)[:, 0].mean()
    assert (np.diff(fitted.gap_growth_, axis=0) >= 0).all()
    seen = np.square(fitted.hint_errors(validation).rmse)
    assert fitted.gap_growth_[-1, 0] > seen[0]  # after 20 missed ones more than twice the squared error
    forecast = fitted.forecast(belief, 300)
    rows = train.observations.reshape(-1, 2)
    assert (forecast >= rows.min(axis=0) - 1e-9).all()
    assert (forecast <= rows.max(axis=0) + 1e-9).all()


def test_the_belief_holds_the_state_and_the_last_observation():
    train = waves()
    for kind, states in ((GRUHints, 1), (LSTMHints, 2)):
        fitted = kind(**SMALL, n_layers=2).fit(train)
        assert fitted.belief_size == 2 * states * 8 + 2 + 1
        belief = fitted.beliefs(train)[:, 4]
        np.testing.assert_allclose(fitted._scale.invert(belief[:, -3:-1]), train.observations[:, 3])


def test_units_do_not_matter():
    data = waves()
    other = Sequences.from_observations(
        data.observations * [1e-6, 1e8] + [3.0, 0.0], hints=data.hints * [1e4, 1e-9] - [1.0, 2.0]
    )
    one, scaled = GRUHints(**SMALL).fit(data), GRUHints(**SMALL).fit(other)
    np.testing.assert_allclose(one.history_["train_error"], scaled.history_["train_error"], rtol=1e-4)
    raw = GRUHints(**SMALL, standardise=False).fit(data)
    assert raw.hint_errors(data).rmse[0] == pytest.approx(one.hint_errors(data).rmse[0], rel=0.2)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_constant_components_are_told_and_do_no_harm():
    data = waves()
    still = Sequences.from_observations(
        np.concatenate([data.observations, np.full((12, 31, 1), 7.0)], axis=2),
        hints=np.concatenate([data.hints, np.full((12, 31, 1), 3.0)], axis=2),
    )
    with (
        pytest.warns(UserWarning, match="observations .* do not vary"),
        pytest.warns(UserWarning, match="hints .* do not vary"),
    ):
        fitted = GRUHints(**SMALL).fit(still, still)
    mean, std = fitted.estimate_hints(still)
    np.testing.assert_allclose(mean[..., 2], 3.0)
    assert np.isfinite(std).all()
    assert (std[..., 2] < 1e-6).all()
    assert np.isfinite(fitted._variance.penalty)  # the other hints' variance still depends on the belief
    np.testing.assert_allclose(fitted.predict_observation(fitted.beliefs(still)[:, 5])[:, 2], 7.0)


def test_states_serve_as_hints():
    data = waves()
    other = Sequences.from_observations(data.observations, states=data.hints)
    one, states = GRUHints(**SMALL).fit(data), GRUHints(**SMALL, hints_from="states").fit(other)
    np.testing.assert_array_equal(one.estimate_hints(data).mean, states.estimate_hints(other).mean)


def test_single_steps_and_single_observations_are_enough():
    rng = np.random.default_rng(0)
    x, h = rng.normal(size=(9, 2, 2)), rng.normal(size=(9, 2, 1))
    data = Sequences.from_observations(x, hints=h, lengths=[1, 0, 1, 1, 1, 1, 0, 1, 1])
    fitted = LSTMHints(**SMALL).fit(data, data[:3])
    assert np.isfinite(fitted.hint_errors(data).mean)


@pytest.mark.parametrize("given", [True, False], ids=["validation", "no validation"])
def test_divergence_is_told_and_the_best_weights_are_kept(given):
    train = waves()
    fitted = GRUHints(**{**SMALL, "n_epochs": 20, "learning_rate": 1e37})
    with pytest.warns(DivergenceWarning, match=r"diverged in epoch \d+ of 20 .* smaller learning_rate"):
        fitted.fit(train, waves(4, seed=1) if given else None)
    assert len(fitted.history_["train_error"]) < 21
    assert np.isfinite(fitted.hint_errors(train).mean)


def test_a_time_limit_ends_training():
    fitted = GRUHints(**{**SMALL, "n_epochs": 100_000, "patience": None, "max_seconds": 0.3}).fit(waves())
    assert 2 <= len(fitted.history_["seconds"]) < 2000


def test_a_fitted_filter_needs_no_torch(tmp_path):
    data = waves()
    fitted = GRUHints(**SMALL).fit(data)
    path = tmp_path / "filter.pkl"
    path.write_bytes(pickle.dumps((fitted, data, fitted.estimate_hints(data))))
    code = (
        "import pickle, sys, numpy as np\n"
        f"fitted, data, expected = pickle.load(open({str(path)!r}, 'rb'))\n"
        "found = fitted.estimate_hints(data)\n"
        "np.testing.assert_array_equal(found.mean, expected.mean)\n"
        "np.testing.assert_array_equal(found.std, expected.std)\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_clone_fits_anew():
    fitted = GRUHints(**SMALL).fit(waves())
    other = clone(fitted)
    assert other.get_params() == fitted.get_params()
    with pytest.raises(NotFittedError):
        other.initial_belief()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("hidden_size", 0, "hidden_size to be a whole number of at least 1, got 0"),
        ("n_epochs", 2.5, "n_epochs to be a whole number"),
        ("segment_length", 0, "segment_length to be a whole number of at least 1"),
        ("learning_rate", 0.0, "learning_rate above 0, got 0.0"),
        ("dropout", 1.0, r"dropout in \[0, 1\), got 1.0"),
        ("hints_from", "rewards", "hints_from to be 'hints' or 'states', got 'rewards'"),
    ],
)
def test_parameters_out_of_range_are_told(name, value, message):
    with pytest.raises(ValueError, match=f"expected {message}"):
        GRUHints(**{**SMALL, name: value}).fit(waves())


def test_other_errors_say_what_was_expected():
    data = waves()
    bare = Sequences.from_observations(data.observations)
    with pytest.raises(ValueError, match="expected training trajectories with hints"):
        GRUHints(**SMALL).fit(bare)
    with pytest.raises(ValueError, match="expected validation with hints"):
        GRUHints(**SMALL).fit(data, bare)
    with pytest.raises(TypeError, match="expected Sequences"):
        GRUHints(**SMALL).fit(data.observations)
    fitted = GRUHints(**SMALL).fit(data)
    with pytest.raises(ValueError, match="expected trajectories with hints"):
        fitted.hint_errors(bare)
    assert np.isfinite(fitted.estimate_hints(bare).mean).all()  # these it does not need
    with pytest.raises(ValueError, match="with hints"):
        fitted.fit(bare)
    with pytest.raises(NotFittedError):
        fitted.initial_belief()
