"""Recurrent filters against torch's own cells, finite differences, Kalman filters and closed forms."""

import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning import DivergenceWarning, Sequences
from beliefgym.learning.recurrent_filter import Arrangement, GRUFilter, LSTMFilter
from beliefgym.learning.recurrent_training import (
    Examples,
    RecurrentNetwork,
    evaluate,
    head_errors,
    loss_of,
    segment_batches,
)

FILTERS = {"gru": GRUFilter, "lstm": LSTMFilter}
each_cell = pytest.mark.parametrize("cell", list(FILTERS))
each_filter = pytest.mark.parametrize("kind", list(FILTERS.values()), ids=list(FILTERS))
SMALL = {"hidden_size": 8, "n_epochs": 3, "batch_size": 8, "random_state": 0}

# a lightly damped turning state seen through one noisy component
A = 0.97 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
C, Q, R = np.array([[1.0, 0.3]]), 0.1 * np.eye(2), np.array([[0.3]])
START = 0.1 / (1.0 - 0.97**2) * np.eye(2)  # the stationary covariance


def linear_gaussian(n, n_steps, seed):
    rng = np.random.default_rng(seed)
    s, x = rng.normal(size=(n, 2)) * np.sqrt(START[0, 0]), []
    for _ in range(n_steps + 1):
        x.append(s @ C.T + rng.normal(size=(n, 1)) * np.sqrt(R[0, 0]))
        s = s @ A.T + rng.normal(size=(n, 2)) * np.sqrt(Q[0, 0])
    return Sequences.from_observations(np.stack(x, axis=1))


def kalman_error(sequences, stationary):
    """Mean squared one-step error of the Kalman filter, after the first observation."""
    P = solve_discrete_are(A.T, C.T, Q, R) if stationary else START
    m, errors = np.zeros((len(sequences), 2)), []
    for t in range(sequences.n_steps + 1):
        S = C @ P @ C.T + R
        K = A @ P @ C.T @ np.linalg.inv(S)
        innovation = sequences.observations[:, t] - m @ C.T
        errors.append(np.square(innovation).sum(axis=1))
        m = m @ A.T + innovation @ K.T
        P = A @ P @ A.T + Q - K @ S @ K.T
    return np.mean(errors[1:])


def waves(n=12, n_steps=30, seed=0, lengths=None, d=3):
    """Sines of random phase and rate, with a little noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(n_steps + 1)
    x = np.sin(rng.uniform(0.1, 0.5, (n, 1, d)) * t[:, None] + rng.uniform(0, 6, (n, 1, d)))
    x += 0.02 * rng.standard_normal(x.shape)
    return Sequences.from_observations(x, lengths=lengths)


def random_network(cell, n_layers=1, k=2, d=3, dtype=torch.float64, seed=0, n_inputs=4, hidden_size=5):
    """No weight at 0, so that a wrong one shows."""
    rng = np.random.default_rng(seed)
    network = RecurrentNetwork(cell, n_inputs, hidden_size, n_layers, k, d, rng).to(dtype)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.as_tensor(0.5 * rng.standard_normal(parameter.shape)))
    return network


def random_examples(lengths, n_inputs=4, k=2, d=3, seed=1):
    rng = np.random.default_rng(seed)
    n, n_steps = len(lengths), max(lengths)
    u, y = rng.normal(size=(n, n_steps, n_inputs)), rng.normal(size=(n, n_steps, k, d))
    return Examples.of(u, y, np.array(lengths), "cpu", torch.float64)


@pytest.mark.parametrize("n_layers", [1, 2])
@each_cell
def test_numpy_steps_are_those_of_torchs_module(cell, n_layers):
    network = random_network(cell, n_layers, dtype=torch.float32)
    rng = np.random.default_rng(2)
    offset, scale = rng.normal(size=(2, 3)), rng.uniform(0.5, 2.0, size=(2, 3))
    model = network.exported(offset, scale)
    u = rng.normal(size=(20, 6, 4))
    module = {"gru": torch.nn.GRU, "lstm": torch.nn.LSTM}[cell](4, 5, n_layers)
    module.load_state_dict(network.cell.state_dict())
    start = network.initial[:, :, None].expand(-1, -1, 6, -1).contiguous()
    with torch.no_grad():
        hidden, _ = module(
            torch.as_tensor(u, dtype=torch.float32), start[0] if cell == "gru" else tuple(start)
        )
        expected = offset + scale * network.read_out(hidden).reshape(20, 6, 2, 3).numpy()
    state = np.tile(model.initial.ravel(), (6, 1))
    for t in range(20):
        state = model.step(u[t], state)
        found = model.outputs(state).reshape(6, 2, 3)
        np.testing.assert_allclose(found, expected[t], atol=1e-5)  # float32 over 20 steps


@pytest.mark.parametrize(
    "options", [{}, {"residual": False}, {"differences": False}, {"n_layers": 2}], ids=str
)
@each_filter
def test_stepwise_errors_are_those_that_training_measured(kind, options):
    lengths = [30, 7, 1, 0, 22, 30]
    train, validation = waves(), waves(6, seed=1, lengths=lengths)
    fitted = kind(**SMALL, **options).fit(train, validation)
    squared = fitted.errors(validation).squared[:, 1:, 0]
    scale = train.observations.std(axis=(0, 1))
    z = Sequences.from_observations(validation.observations / scale, lengths=lengths)
    standardised = np.nansum(np.square(predictions(fitted, validation) / scale - z.observations)[:, 1:])
    assert standardised / sum(lengths) == pytest.approx(
        fitted.history_["validation_error"][fitted.best_epoch_], rel=1e-5
    )
    assert np.isfinite(squared).sum() == sum(lengths)


def predictions(fitted, sequences):
    """x_hat_t by the public calls, one trajectory and one step at a time, NaN past the end."""
    found = np.full(sequences.observations.shape, np.nan)
    for i, length in enumerate(sequences.lengths):
        belief = fitted.initial_belief()
        for t in range(length + 1):
            found[i, t] = fitted.predict_observation(belief)[0]
            belief = fitted.update(belief, sequences.observations[i, t][None])
    return found


def test_one_trajectory_at_a_time_is_the_whole_batch():
    sequences = waves(5, seed=1, lengths=[30, 7, 1, 0, 22])
    fitted = GRUFilter(**SMALL).fit(waves())
    alone = np.square(predictions(fitted, sequences) - sequences.observations).sum(axis=2)
    np.testing.assert_allclose(fitted.errors(sequences).squared[..., 0], alone, rtol=1e-9)  # rounding


@each_filter
def test_linear_gaussian_error_is_the_kalman_filters(kind):
    train, validation, test = (linear_gaussian(n, 40, seed) for seed, n in enumerate((200, 50, 400)))
    fitted = kind(hidden_size=16, n_epochs=40, random_state=0).fit(train, validation)
    error = fitted.errors(test).mean
    assert error < 1.05 * kalman_error(test, stationary=True)
    # nothing that does not see the future beats the exact filter by more than 400 trajectories' chance
    assert error > 0.99 * kalman_error(test, stationary=False)


@each_cell
def test_gradients_of_the_loss_are_its_finite_differences(cell):
    network, examples = random_network(cell, n_layers=2), random_examples([6, 3, 1])
    weights = torch.as_tensor(np.random.default_rng(3).uniform(0.5, 2.0, (2, 3)))
    heads = torch.tensor([0.7, 0.3], dtype=torch.float64)

    def loss():
        hidden, _ = network.run(examples.inputs, network.start(3))
        errors = head_errors(network.heads(hidden), examples.targets, examples.inside, weights)
        return loss_of(errors, examples.inside, heads)

    loss().backward()
    for name, parameter in network.named_parameters():
        numbers = parameter.detach().view(-1)
        for i in range(0, len(numbers), 7):
            value, sides = float(numbers[i]), []
            for change in (1e-6, -1e-6):
                numbers[i] = value + change
                sides.append(loss().item())
            numbers[i] = value
            assert float(parameter.grad.view(-1)[i]) == pytest.approx(
                (sides[0] - sides[1]) / 2e-6, rel=1e-5, abs=1e-8
            ), name


@each_cell
def test_loss_is_the_mean_over_the_steps_inside(cell):
    network, examples = random_network(cell), random_examples([6, 3, 1])
    weights = np.array([[1.0, 2.0, 0.5], [0.3, 0.0, 1.0]])
    with torch.no_grad():
        hidden, _ = network.run(examples.inputs, network.start(3))
        predicted = network.heads(hidden)
        ours = loss_of(
            head_errors(predicted, examples.targets, examples.inside, torch.as_tensor(weights)),
            examples.inside,
            torch.tensor([0.7, 0.3], dtype=torch.float64),
        )
    square = (predicted - examples.targets).square().numpy()
    first = [square[t, i, 0] @ weights[0] for i, length in enumerate([6, 3, 1]) for t in range(length)]
    second = [square[t, i, 1] @ weights[1] for i, length in enumerate([6, 3, 1]) for t in range(length - 1)]
    assert float(ours) == pytest.approx(0.7 * np.mean(first) + 0.3 * np.mean(second), rel=1e-12)


@pytest.mark.parametrize("segment_length", [1, 4, 7, 25, None], ids=str)
@each_cell
def test_segments_hold_every_step_once_and_start_where_the_last_ended(cell, segment_length):
    network, examples = random_network(cell, n_layers=2), random_examples([20, 3, 1, 0, 17, 20])
    weights = torch.ones(2, 3, dtype=torch.float64)
    with torch.no_grad():
        hidden, _ = network.run(examples.inputs, network.start(6))
        whole = head_errors(network.heads(hidden), examples.targets, examples.inside, weights)
        for seed in range(3):
            total, count = torch.zeros(2, dtype=torch.float64), 0.0
            batches = segment_batches(network, examples, segment_length, 4, np.random.default_rng(seed))
            for (inputs, targets, inside), state in batches:
                hidden, _ = network.run(inputs, state)
                total += head_errors(network.heads(hidden), targets, inside, weights)
                count += float(inside[..., 0].sum())
            np.testing.assert_allclose(total, whole, rtol=1e-12)
            assert count == 61
    assert evaluate(network, examples, weights) == pytest.approx(float(whole[0]) / 61, rel=1e-12)


def test_blocks_of_trajectories_change_nothing(monkeypatch):
    network, examples = random_network("lstm"), random_examples([20, 3, 1, 0, 17, 20])
    weights = torch.ones(2, 3, dtype=torch.float64)

    def parts():
        batches = list(segment_batches(network, examples, 7, 4, np.random.default_rng(0)))
        return evaluate(network, examples, weights), [s for _, state in batches for s in state]

    error, states = parts()
    monkeypatch.setattr("beliefgym.learning.recurrent_training.BLOCK_NUMBERS", 1)
    small_error, small_states = parts()
    assert small_error == pytest.approx(error, rel=1e-12)
    for a, b in zip(states, small_states, strict=True):
        torch.testing.assert_close(a, b)


@each_filter
def test_further_padding_gives_the_same_fit(kind):
    lengths = [30, 12, 30, 5, 1, 0, 30, 22, 9, 30, 30, 18]
    train = waves(lengths=lengths)
    padded = Sequences.from_observations(
        np.pad(train.observations, ((0, 0), (0, 25), (0, 0)), constant_values=99.0), lengths=lengths
    )
    options = {**SMALL, "n_future": 3, "segment_length": 7}
    one, other = kind(**options).fit(train, train), kind(**options).fit(padded, padded)
    for name in ("train_error", "validation_error"):
        np.testing.assert_array_equal(one.history_[name], other.history_[name])
    np.testing.assert_array_equal(one.model_.read_out, other.model_.read_out)


def test_what_lies_past_an_episodes_end_is_neither_input_nor_target():
    z = np.arange(1.0, 25.0).reshape(2, 6, 2)
    lengths = np.array([5, 2])
    arrangement = Arrangement.of(z, lengths, np.zeros(2, dtype=bool), 2, True, True)
    garbled = z.copy()
    garbled[1, 3:] = 1e6
    for a, b in zip(arrangement.examples(z, lengths), arrangement.examples(garbled, lengths), strict=True):
        np.testing.assert_array_equal(a, b)
    again = Arrangement.of(garbled, lengths, np.zeros(2, dtype=bool), 2, True, True)
    np.testing.assert_array_equal(again.offset, arrangement.offset)
    np.testing.assert_array_equal(again.first, arrangement.first)


@pytest.mark.parametrize("dropout", [0.0, 0.2])
def test_a_seed_fixes_the_fit_and_leaves_the_global_streams_alone(dropout):
    options = {**SMALL, "dropout": dropout, "segment_length": 7}
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    fits = [
        GRUFilter(**{**options, "random_state": seed}).fit(waves(), waves(4, seed=1)) for seed in (0, 0, 1)
    ]
    assert torch.equal(before[0], torch.get_rng_state())
    assert np.array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
    torch.manual_seed(3)
    fits.append(GRUFilter(**options).fit(waves(), waves(4, seed=1)))
    reads = [fitted.model_.read_out for fitted in fits]
    assert np.array_equal(reads[0], reads[1])
    assert np.array_equal(reads[0], reads[3])
    assert not np.array_equal(reads[0], reads[2])


def test_the_best_epoch_in_validation_is_kept_and_patience_ends_training():
    train, validation = waves(3, 20), waves(6, 20, seed=1)
    fitted = GRUFilter(hidden_size=32, n_epochs=400, patience=15, weight_decay=0.0, random_state=0)
    fitted.fit(train, validation)
    errors = fitted.history_["validation_error"]
    assert fitted.best_epoch_ == np.argmin(errors) == len(errors) - 16
    assert len(errors) < 401
    scale = train.observations.std(axis=(0, 1))
    squared = np.square((predictions(fitted, validation) - validation.observations) / scale)[:, 1:]
    assert squared.sum(axis=2).mean() == pytest.approx(errors.min(), rel=1e-5)
    shorter = GRUFilter(**{**fitted.get_params(), "n_epochs": 0}).fit(train, validation)
    assert shorter.history_["validation_error"][0] == errors[0]
    assert errors.min() < 0.5 * errors[0]


def test_without_validation_the_training_error_chooses():
    fitted = LSTMFilter(**SMALL).fit(waves())
    assert fitted.best_epoch_ == np.argmin(fitted.history_["train_error"])
    assert np.isnan(fitted.history_["validation_error"]).all()


@pytest.mark.parametrize("residual", [True, False])
def test_the_first_beliefs_forecast_is_the_mean_of_the_training_starts(residual):
    lengths = [30, 0, 1, 2, 30, 30]
    train = waves(6, lengths=lengths)
    fitted = GRUFilter(**SMALL, n_future=3, residual=residual).fit(train)
    x = train.observations
    expected = [x[:, 0].mean(axis=0), x[[0, 2, 3, 4, 5], 1].mean(axis=0), x[[0, 3, 4, 5], 2].mean(axis=0)]
    first = fitted.initial_belief(2)
    np.testing.assert_allclose(fitted.predict_observation(first), [expected[0]] * 2, atol=1e-12)
    np.testing.assert_allclose(fitted.forecast(first, 3)[1], expected, atol=1e-12)


def test_forecasts_are_the_heads_and_further_on_take_predictions_for_observations():
    fitted = LSTMFilter(**SMALL, n_future=2).fit(waves())
    belief = fitted.beliefs(waves(5, seed=2))[:, 10]
    ahead = fitted.forecast(belief, 5)
    assert ahead.shape == (5, 5, 3)
    np.testing.assert_array_equal(ahead[:, :2], fitted._scale.invert(fitted._heads(belief)))
    np.testing.assert_array_equal(ahead[:, :1], fitted.forecast(belief, 1))
    for step in range(2, 5):
        one = belief
        for earlier in range(step):
            one = fitted.update(one, ahead[:, earlier])
        np.testing.assert_allclose(ahead[:, step], fitted.predict_observation(one), atol=1e-12)


def test_further_heads_predict_further_observations():
    """Sines of one rate: 3 steps ahead a head that predicted 1 step ahead would err by far more."""
    rng = np.random.default_rng(0)
    phases = rng.uniform(0, 6, (80, 1, 1))
    train = Sequences.from_observations(np.sin(0.7 * np.arange(31)[:, None] + phases[:60]))
    validation = Sequences.from_observations(np.sin(0.7 * np.arange(31)[:, None] + phases[60:]))
    fitted = LSTMFilter(hidden_size=16, n_epochs=40, n_future=3, future_weights="uniform", random_state=0)
    squared = fitted.fit(train, validation).errors(validation, horizon=3).squared
    errors = np.nanmean(squared[:, 3:], axis=(0, 1))  # before, the phase is not known
    assert errors.max() < 0.02 * train.observations.var()


def test_a_ramp_is_predicted_exactly_from_the_start():
    ramp = np.arange(21.0)[:, None] * [0.5, -3.0] + np.random.default_rng(0).normal(size=(7, 1, 2))
    sequences = Sequences.from_observations(ramp)
    fitted = GRUFilter(**{**SMALL, "n_epochs": 0, "n_future": 2}).fit(sequences)
    assert fitted.errors(sequences, horizon=2).by_look_ahead.max() < 1e-20  # rounding


def test_a_component_that_does_not_vary_is_told_and_does_no_harm():
    x = waves().observations
    constant = np.concatenate([x, np.full((*x.shape[:2], 1), 7.3)], axis=2)
    with pytest.warns(UserWarning, match="do not vary"):
        fitted = GRUFilter(**SMALL).fit(Sequences.from_observations(constant))
    test = np.concatenate([x, np.full((*x.shape[:2], 1), 1e5)], axis=2)  # it may vary later
    found = fitted.beliefs(Sequences.from_observations(test))[:, 5]
    as_before = fitted.beliefs(Sequences.from_observations(constant))[:, 5]
    predicted = fitted.predict_observation(found)
    np.testing.assert_allclose(predicted[:, 3], 1e5)
    np.testing.assert_allclose(fitted.predict_observation(as_before)[:, 3], 7.3)
    np.testing.assert_allclose(predicted[:, :3], fitted.predict_observation(as_before)[:, :3])
    with pytest.warns(UserWarning, match="do not vary"):
        nothing = GRUFilter(**SMALL).fit(Sequences.from_observations(np.full((4, 9, 2), 2.0)))
    np.testing.assert_allclose(nothing.predict_observation(nothing.initial_belief()), [[2.0, 2.0]])


def test_units_do_not_matter():
    x, units = waves().observations, np.array([1e-6, 1.0, 1e8])
    one = GRUFilter(**SMALL).fit(Sequences.from_observations(x))
    other = GRUFilter(**SMALL).fit(Sequences.from_observations(x * units + 3.0 * units))
    np.testing.assert_allclose(one.history_["train_error"], other.history_["train_error"], rtol=1e-4)
    raw = GRUFilter(**SMALL, standardise=False).fit(Sequences.from_observations(x))
    large = GRUFilter(**SMALL, standardise=False).fit(Sequences.from_observations(1e6 * x))
    np.testing.assert_allclose(
        1e12 * raw.history_["train_error"], large.history_["train_error"], rtol=1e-4
    )  # float32


@pytest.mark.parametrize("given", [True, False], ids=["validation", "no validation"])
def test_divergence_is_told_and_the_best_weights_are_kept(given):
    train = waves()
    fitted = GRUFilter(**{**SMALL, "n_epochs": 20, "learning_rate": 1e37})
    with pytest.warns(DivergenceWarning, match=r"diverged in epoch \d+ of 20 .* smaller learning_rate"):
        fitted.fit(train, waves(4, seed=1) if given else None)
    assert len(fitted.history_["train_error"]) < 21
    assert np.isfinite(fitted.model_.read_out).all()
    assert np.isfinite(fitted.errors(train).mean)


def test_a_time_limit_ends_training():
    fitted = GRUFilter(**{**SMALL, "n_epochs": 100_000, "patience": None, "max_seconds": 0.3}).fit(waves())
    assert 2 <= len(fitted.history_["seconds"]) < 2000
    assert fitted.history_["seconds"].sum() < 2.0  # one mini-batch and an evaluation may run over


def test_single_steps_and_single_observations_are_enough():
    x = np.random.default_rng(0).normal(size=(9, 2, 2))
    sequences = Sequences.from_observations(x, lengths=[1, 0, 1, 1, 1, 1, 0, 1, 1])
    fitted = LSTMFilter(**SMALL).fit(sequences, sequences[:3])
    assert np.isfinite(fitted.errors(sequences).mean)


def test_the_belief_holds_the_state_and_the_last_observation():
    train = waves()
    for kind, states in ((GRUFilter, 1), (LSTMFilter, 2)):
        fitted = kind(**SMALL, n_layers=2).fit(train)
        assert fitted.belief_size == 2 * states * 8 + 3 + 1
        found = fitted.beliefs(train)
        last = fitted._scale.invert(found[:, 1:, -4:-1])
        np.testing.assert_allclose(last, train.observations, atol=1e-12)
        assert (found[:, 0, -1] == 0).all()
        assert (found[:, 1:, -1] == 1).all()


@each_filter
def test_scikit_learns_contract(kind):
    model = kind(**SMALL, n_future=2)
    copy = clone(model)
    assert copy.get_params() == model.get_params()
    assert set(model.get_params()) >= {"residual", "differences", "segment_length", "max_seconds", "device"}
    with pytest.raises(NotFittedError, match="not fitted"):
        copy.initial_belief()
    fitted = model.fit(waves())
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.beliefs(waves(3, seed=4)), fitted.beliefs(waves(3, seed=4)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = fitted.model_.read_out
        np.testing.assert_array_equal(fitted.fit(waves()).model_.read_out, before)


def test_a_fitted_filter_needs_no_torch(tmp_path):
    fitted = GRUFilter(**SMALL).fit(waves())
    belief = fitted.beliefs(waves(2, seed=4))[:, 9]
    (tmp_path / "filter").write_bytes(pickle.dumps((fitted, belief)))
    program = (
        "import pickle, sys\n"
        f"fitted, belief = pickle.load(open({str(tmp_path / 'filter')!r}, 'rb'))\n"
        "print(float(fitted.forecast(belief, 4).sum()), 'torch' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    number, torch_there = said.split()
    assert float(number) == pytest.approx(float(fitted.forecast(belief, 4).sum()))
    assert torch_there == "False"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hidden_size": 0}, "hidden_size to be a whole number of at least 1, got 0"),
        ({"n_layers": 1.5}, "n_layers to be a whole number"),
        ({"n_future": 31}, "n_future of at most the 30 steps of the longest trajectory, got 31"),
        ({"segment_length": 0}, "segment_length to be a whole number"),
        ({"patience": True}, "patience to be a whole number"),
        ({"learning_rate": 0.0}, "learning_rate above 0, got 0.0"),
        ({"learning_rate": None}, "learning_rate above 0, got None"),
        ({"learning_rate": float("nan")}, "learning_rate above 0, got nan"),
        ({"max_seconds": -1.0}, "max_seconds above 0, got -1.0"),
        ({"max_gradient_norm": 0.0}, "max_gradient_norm above 0"),
        ({"dropout": 1.0}, r"dropout in \[0, 1\), got 1.0"),
        ({"weight_decay": -1.0}, "weight_decay of at least 0, got -1.0"),
        ({"future_weights": "linear"}, "future_weights to be 'uniform' or a number"),
        ({"future_weights": 0.0}, "future_weights to be 'uniform' or a number"),
        ({"standardise": "each"}, "standardise to be one of"),
    ],
    ids=str,
)
def test_what_is_out_of_range_is_told(options, message):
    with pytest.raises(ValueError, match=message):
        GRUFilter(**{**SMALL, **options}).fit(waves())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_training_on_cuda_gives_the_same_filter_nearly():
    one, other = GRUFilter(**SMALL).fit(waves()), GRUFilter(**SMALL, device="cuda").fit(waves())
    np.testing.assert_allclose(one.history_["train_error"], other.history_["train_error"], rtol=1e-3)
