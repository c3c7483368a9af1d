"""Trained filters in files: the same to the last bit, nothing run, everything that is wrong told."""

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from beliefgym.learning import RandomForest, RandomFourierRidge, Ridge, Sequences
from beliefgym.learning.autoregressive_filter import AutoregressiveFilter
from beliefgym.learning.filter_files import load_filter, save_filter
from beliefgym.learning.filters import Filter
from beliefgym.learning.instrumental_regression import InstrumentalVariableRegression
from beliefgym.learning.kalman_filter import KalmanFilter
from beliefgym.learning.linear_gaussian import LinearGaussianSystem
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_forward import ForwardPSIM
from beliefgym.learning.subspace_identification import N4SID

FOURIER = RandomFourierRidge(n_frequencies=20, include_inputs=True, alpha=1e-3, random_state=0)
UNSEEDED = RandomFourierRidge(n_frequencies=20, alpha=1e-2, random_state=np.random.RandomState(3))


def some_data(n_episodes=8, n_steps=30, seed=0, n_obs=3):
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(size=(n_episodes, n_steps + 1, n_obs)), axis=1)
    x = np.sin(0.3 * walk) * [1.0, 20.0, 1e-3] + [0.0, 5.0, 0.2] + 0.05 * rng.normal(size=walk.shape)
    lengths = np.full(n_episodes, n_steps)
    lengths[0] = n_steps - 3
    return Sequences.from_observations(x, lengths=lengths)


def a_system():
    rng = np.random.default_rng(0)
    A = 0.6 * np.linalg.qr(rng.normal(size=(4, 4)))[0]
    return LinearGaussianSystem(
        A.T, rng.normal(size=(3, 4)), np.eye(4), np.diag([1.0, 2.0, 0.5]), initial_mean=np.ones(4)
    )


def a_backprop_psim(regressor, **parameters):
    from beliefgym.learning.psim_backprop import BackpropPSIM

    psim = PSIM(regressor, n_future=2, n_iterations=2, features="second")
    return BackpropPSIM(psim, n_epochs=2, random_state=0, **parameters)


FILTERS = {
    "PSIM linear": lambda: PSIM(n_future=3, n_iterations=2),
    "PSIM linear phi_2": lambda: PSIM(
        Ridge(fit_intercept=False), n_future=2, n_iterations=2, features="second"
    ),
    "PSIM fourier": lambda: PSIM(FOURIER, n_future=3, n_iterations=2, standardise="together"),
    "PSIM fourier phi_2": lambda: PSIM(UNSEEDED, n_future=2, n_iterations=2, features="second", n_past=3),
    "PSIM unscaled": lambda: PSIM(n_future=2, n_iterations=1, standardise=False, belief_limit=np.inf),
    "ForwardPSIM linear": lambda: ForwardPSIM(Ridge(alpha=0.1), n_future=2, min_trajectories=3),
    "ForwardPSIM fourier": lambda: ForwardPSIM(FOURIER, n_future=2, features="second", belief_limit=99.0),
    "BackpropPSIM linear": lambda: a_backprop_psim(None, init="random"),
    "BackpropPSIM fourier": lambda: a_backprop_psim(FOURIER, init="dagger"),
    "AR linear": lambda: AutoregressiveFilter(n_past=4),
    "AR fourier": lambda: AutoregressiveFilter(FOURIER, n_past=2, pad_start=False),
    "N4SID": lambda: N4SID(n_states=range(1, 7), n_block_rows=4),
    "IVR": lambda: InstrumentalVariableRegression(n_future=2, rank=(2, 3, 4)),
    "IVR full": lambda: InstrumentalVariableRegression(n_future=2, ridge=1e-3),
    "Kalman learned": lambda: KalmanFilter(n_states=4, n_iterations=3),
    "Kalman MAP varying": lambda: KalmanFilter(n_states=2, method="map", n_iterations=3, stationary=False),
    "Kalman known": lambda: KalmanFilter.of(a_system()),
    "Kalman known varying": lambda: KalmanFilter.of(a_system(), stationary=False),
}
every = pytest.mark.parametrize("case", list(FILTERS))


@pytest.fixture(scope="module")
def fitted():
    """Each filter, fitted once."""
    made = {}
    train, validation = some_data(), some_data(3, 25, 1)

    def get(case):
        if case not in made:
            made[case] = FILTERS[case]()
            if not case.startswith("Kalman known"):
                made[case].fit(train, validation)
        return made[case]

    return get


def plain_parameters(parameters):
    """What parameters come back as."""
    found = {}
    for name, value in parameters.items():
        if name.endswith("random_state") and not isinstance(value, int):
            value = None
        elif isinstance(value, tuple | range):
            value = list(value)
        elif not isinstance(value, str | int | float | list | None):
            value = type(value).__name__
        found[name] = value
    return found


@every
def test_a_loaded_filter_is_the_saved_one_to_the_last_bit(case, fitted, tmp_path):
    filter = fitted(case)
    path = save_filter(filter, tmp_path / "a filter.safetensors")
    assert path == tmp_path / "a filter.safetensors"
    loaded = load_filter(path)
    assert type(loaded) is type(filter)
    assert isinstance(loaded, Filter)
    assert plain_parameters(loaded.get_params()) == plain_parameters(filter.get_params())
    assert loaded.belief_size == filter.belief_size
    fresh = some_data(5, 40, 2)
    beliefs = filter.beliefs(fresh)
    np.testing.assert_array_equal(loaded.beliefs(fresh), beliefs)
    np.testing.assert_array_equal(loaded.errors(fresh, horizon=7).squared, filter.errors(fresh, 7).squared)
    belief, x = beliefs[:, 20], fresh.observations[:, 20]
    np.testing.assert_array_equal(loaded.initial_belief(2), filter.initial_belief(2))
    np.testing.assert_array_equal(loaded.update(belief, x), filter.update(belief, x))
    np.testing.assert_array_equal(loaded.predict_observation(belief), filter.predict_observation(belief))
    np.testing.assert_array_equal(loaded.forecast(belief, 9), filter.forecast(belief, 9))
    if hasattr(filter, "predict_variance") and getattr(filter, "features", "second") == "second":
        np.testing.assert_array_equal(loaded.predict_variance(belief), filter.predict_variance(belief))
    for attribute in ("best_iteration_", "best_epoch_", "n_steps_", "n_states_", "rank_", "errors_by_rank_"):
        assert getattr(loaded, attribute, None) == getattr(filter, attribute, None)
    for name, values in getattr(filter, "history_", {}).items():
        np.testing.assert_array_equal(loaded.history_[name], values)
    if case.startswith(("PSIM", "BackpropPSIM")):
        np.testing.assert_array_equal(loaded.model_.coef_, filter.model_.coef_)
        assert not np.shares_memory(loaded.model_._weights, filter.model_._weights)
    # and once more: what was loaded can be saved, and is the same file
    again = save_filter(loaded, tmp_path / "again.safetensors")
    assert same_content(again, path)


def same_content(one, other):
    return all(
        np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b
        for a, b in zip(content(one), content(other), strict=True)
    )


def content(path):
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["beliefgym_filter"])
        return [header, *(file.get_tensor(name) for name in sorted(file.keys()))]


def test_the_bounds_of_beliefs_are_loaded_too(fitted, tmp_path):
    filter = fitted("PSIM linear")
    loaded = load_filter(filter.save(tmp_path / "f"))
    np.testing.assert_array_equal(loaded._bound, filter._bound)
    with pytest.warns(UserWarning, match="left its bounds"):
        following = loaded.update(loaded.initial_belief(), np.full((1, 3), 1e9))
    assert (np.abs(following) == filter._bound).any()


def test_arrays_in_column_major_order_are_saved_as_they_are(fitted, tmp_path):
    """safetensors writes the memory of an array, whatever its order."""
    filter = pickle.loads(pickle.dumps(fitted("PSIM linear")))
    filter.model_._weights = np.asfortranarray(filter.model_._weights)
    loaded = load_filter(save_filter(filter, tmp_path / "f"))
    np.testing.assert_array_equal(loaded.model_._weights, filter.model_._weights)
    kalman = KalmanFilter.of(a_system())
    assert not kalman.system_.transition_matrix.flags.c_contiguous  # A.T of above
    loaded = load_filter(save_filter(kalman, tmp_path / "f"))
    assert not loaded.system_.transition_matrix.flags.c_contiguous
    np.testing.assert_array_equal(loaded.system_.transition_matrix, kalman.system_.transition_matrix)
    assert loaded.system is loaded.system_


def test_a_psim_that_started_from_its_prior_is_saved(tmp_path):
    train = some_data()
    filter = PSIM(n_future=2, n_iterations=1, init="prior").fit(train)
    filter.model_ = pickle.loads(pickle.dumps(filter.model_))
    from beliefgym.learning.psim_pairs import Constant

    filter.model_ = Constant(np.arange(6.0))  # as where no iteration is better than F_0
    loaded = load_filter(filter.save(tmp_path / "f"))
    np.testing.assert_array_equal(loaded.beliefs(train), filter.beliefs(train))


PROGRAM = """
import sys
import numpy as np
from beliefgym.learning.filter_files import load_filter
folder = sys.argv[1]
for name in sys.argv[2:]:
    filter = load_filter(f"{folder}/{name}.safetensors")
    belief = filter.initial_belief(2)
    for x in np.load(f"{folder}/x.npy"):
        belief = filter.update(belief, x)
    np.save(f"{folder}/{name}.npy", filter.forecast(belief, 8))
assert "torch" not in sys.modules
"""


def test_another_process_loads_and_filters_without_torch(fitted, tmp_path):
    x = some_data(2, 10, 5).observations.swapaxes(0, 1)
    np.save(tmp_path / "x.npy", x)
    cases = [case for case in FILTERS if not case.startswith("BackpropPSIM")]
    for case in cases:
        save_filter(fitted(case), tmp_path / f"{case}.safetensors")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path), *cases], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for case in cases:
        filter = fitted(case)
        belief = filter.initial_belief(2)
        for observation in x:
            belief = filter.update(belief, observation)
        np.testing.assert_array_equal(np.load(tmp_path / f"{case}.npy"), filter.forecast(belief, 8), case)


def test_a_loaded_psim_does_not_learn_on(fitted, tmp_path):
    loaded = load_filter(fitted("PSIM linear").save(tmp_path / "f"))
    with pytest.raises(ValueError, match="still holds its aggregate, got one from a file"):
        loaded.partial_fit(some_data())
    loaded.fit(some_data()).partial_fit(some_data(2, 30, 1))  # but can be fitted anew


def test_it_is_plain_safetensors(fitted, tmp_path):
    path = fitted("PSIM linear phi_2").save(tmp_path / "f.safetensors")
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["beliefgym_filter"])
        weights = file.get_tensor("model_.weights")
    assert (header["version"], header["class"], header["n_obs_"]) == (1, "PSIM", 3)
    assert header["parameters"]["features"] == "second"
    assert header["model_"]["class"] == "Ridge"
    assert header["model_"]["parameters"]["fit_intercept"] is False
    np.testing.assert_array_equal(weights, fitted("PSIM linear phi_2").model_._weights)
    assert list(tmp_path.iterdir()) == [path]  # nothing else is left


def mean_of_future(futures):
    return futures.mean(axis=1)


class Mine(PSIM):
    """Of the user's."""


REFUSED = {
    "own features": (lambda: PSIM(n_future=2, features=mean_of_future), "features: expected plain data"),
    "scikit-learn": (
        lambda: PSIM(LinearRegression(), n_future=2),
        "Ridge or RandomFourierRidge to save, got one",
    ),
    "forest": (lambda: ForwardPSIM(RandomForest(n_estimators=2), n_future=2), "got one with RandomForest"),
    "AR": (lambda: AutoregressiveFilter(LinearRegression()), "got one with LinearRegression"),
    "own class": (lambda: Mine(n_future=2), "expected one of PSIM, .* to save, got Mine"),
}


@pytest.mark.parametrize("case", list(REFUSED))
def test_what_cannot_be_plain_arrays_is_refused_and_nothing_written(case, tmp_path):
    make, message = REFUSED[case]
    filter = make().fit(some_data(8, 7))
    (tmp_path / "f").write_text("before")
    with pytest.raises(TypeError, match=message):
        save_filter(filter, tmp_path / "f")
    assert (tmp_path / "f").read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 1


def test_unfitted_changed_and_spoilt_filters_are_refused(fitted, tmp_path):
    with pytest.raises(NotFittedError, match="not fitted yet"):
        save_filter(PSIM(), tmp_path / "f")
    changed = pickle.loads(pickle.dumps(fitted("PSIM linear")))
    changed.set_params(n_future=5)
    with pytest.raises(ValueError, match=r"this PSIM: _first_belief: expected shape \(15,\), got \(9,\)"):
        changed.save(tmp_path / "f")
    spoilt = pickle.loads(pickle.dumps(fitted("PSIM linear")))
    spoilt.model_._weights[1, 0] = np.nan
    with pytest.raises(ValueError, match=r"weights: expected finite numbers, got nan at index \(1, 0\)"):
        spoilt.save(tmp_path / "f")
    with pytest.raises(FileNotFoundError, match="create it first"):
        fitted("PSIM linear").save(tmp_path / "nowhere" / "f")
    with pytest.raises(FileNotFoundError, match="expected one written by save_filter"):
        load_filter(tmp_path / "f")
    assert not list(tmp_path.iterdir())


def test_a_failing_disk_leaves_the_old_file(fitted, tmp_path, monkeypatch):
    path = fitted("PSIM linear").save(tmp_path / "f")
    before = path.read_bytes()

    def full(_):
        raise OSError("no space left")

    monkeypatch.setattr("beliefgym.learning.whole_files.os.fsync", full)
    with pytest.raises(OSError, match="no space"):
        fitted("PSIM fourier").save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def rewritten(path, change):
    """The file once more, with its header and arrays changed."""
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["beliefgym_filter"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    change(header, arrays)
    path.write_bytes(save(arrays, metadata={"beliefgym_filter": json.dumps(header)}))
    return path


def set_array(name, make):
    def change(header, arrays):
        arrays[name] = np.ascontiguousarray(make(arrays[name]))

    return change


def set_header(*keys_and_value):
    *keys, last, value = keys_and_value

    def change(header, arrays):
        for key in keys:
            header = header[key]
        header[last] = value

    return change


def with_nan(array):
    array = array.copy()
    array.flat[1] = np.nan
    return array


DAMAGED = {
    "missing": (lambda h, a: a.pop("_first_belief"), "has no array '_first_belief'"),
    "missing weights": (lambda h, a: a.pop("model_.weights"), "has no array 'model_.weights'"),
    "missing squares": (lambda h, a: a.pop("squares.scale"), "has no array 'squares.scale'"),
    "missing history": (lambda h, a: a.pop("history_.seconds"), "has no array 'history_.seconds'"),
    "NaN weights": (set_array("model_.weights", with_nan), "model_.weights: expected finite .* nan at index"),
    "NaN bound": (set_array("_bound", with_nan), "_bound: expected finite numbers, got nan"),
    "NaN frequencies": (set_array("model_.frequencies", with_nan), "model_.frequencies: expected finite"),
    "infinite": (set_array("_first_belief", lambda a: a + np.inf), "_first_belief: expected finite .* inf"),
    "no scale": (set_array("_scale.scale", lambda a: 0 * a), "_scale.scale: expected numbers above 0"),
    "shape": (
        set_array("_first_belief", lambda a: a[:-1]),
        r"_first_belief: expected shape \(12,\), got \(11,\)",
    ),
    "transposed": (set_array("model_.weights", lambda a: a.T), r"model_.weights: expected shape \(40, 12\)"),
    "single precision": (
        set_array("model_.weights", lambda a: a.astype(np.float32)),
        "expected float64, got float32",
    ),
    "later version": (
        set_header("version", 2),
        "version 2 of the format, .* reads up to 1; update beliefgym",
    ),
    "no version": (lambda h, a: h.pop("version"), "its header is unreadable"),
    "odd version": (set_header("version", "1"), "expected a version of the format, got '1'"),
    "version zero": (set_header("version", 0), "expected a version of the format, got 0"),
    "class": (set_header("class", "Popen"), "expected one of PSIM, .*, got 'Popen'"),
    "class of a filter": (set_header("class", "Ridge"), "expected one of PSIM, .*, got 'Ridge'"),
    "regressor class": (set_header("model_", "class", "Popen"), "expected one of PSIM, .* got 'Popen'"),
    "filter as regressor": (
        set_header("model_", {"class": "PSIM", "parameters": {}}),
        "expected Ridge or RandomFourierRidge, got 'PSIM'",
    ),
    "parameter": (set_header("parameters", "colour", 3), "its header is unreadable"),
    "n_future": (set_header("parameters", "n_future", 2.5), "expected n_future of at least 1"),
    "other n_future": (set_header("parameters", "n_future", 3), "_first_belief: expected shape"),
    "features": (set_header("parameters", "features", "third"), "features 'first' or 'second'"),
    "n_obs": (set_header("n_obs_", -1), "n_obs_: expected a whole number, got -1"),
    "other n_obs": (set_header("n_obs_", 4), "expected shape"),
    "no model": (lambda h, a: h.pop("model_"), "its header is unreadable"),
    "frequencies": (set_header("model_", "parameters", "n_frequencies", 30), "frequencies: expected shape"),
    "n_frequencies": (set_header("model_", "parameters", "n_frequencies", -1), "expected n_frequencies"),
}


@pytest.mark.parametrize("case", list(DAMAGED))
def test_a_changed_file_is_told(case, fitted, tmp_path):
    change, message = DAMAGED[case]
    path = rewritten(fitted("PSIM fourier phi_2").save(tmp_path / "f"), change)
    with pytest.raises(ValueError, match=message):
        load_filter(path)


def test_a_changed_file_of_another_filter_is_told(fitted, tmp_path):
    for case, change, message in (
        ("Kalman learned", lambda h, a: a.pop("_limit.gain"), "has no array '_limit.gain'"),
        (
            "Kalman learned",
            set_array("system_.transition_covariance", lambda a: -a),
            "transition_covariance: expected variances",
        ),
        ("Kalman learned", set_header("system_states", 3), "expected shape"),
        ("N4SID", set_array("system_matrices_.gain", with_nan), "system_matrices_.gain: expected finite"),
        ("IVR", set_array("_extension", lambda a: a[1:]), "_extension: expected shape"),
        ("AR linear", set_array("_first", lambda a: a[1:]), "_first: expected shape"),
        ("ForwardPSIM linear", set_header("n_steps_", 99), "its header is unreadable"),
    ):
        path = rewritten(save_filter(fitted(case), tmp_path / "f"), change)
        with pytest.raises(ValueError, match=message):
            load_filter(path)


def test_truncated_and_foreign_files_are_told(fitted, tmp_path):
    whole = fitted("PSIM linear").save(tmp_path / "f").read_bytes()
    path = tmp_path / "g"
    for n in (0, 4, 8, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:n])
        with pytest.raises(ValueError, match="is damaged or not a .safetensors file"):
            load_filter(path)
    path.write_bytes(pickle.dumps(fitted("PSIM linear")))
    with pytest.raises(ValueError, match="is damaged or not a .safetensors file"):
        load_filter(path)
    bfloat = {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}
    header = json.dumps({"__metadata__": {"beliefgym_filter": "{}"}, "weights": bfloat}).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))
    with pytest.raises(ValueError, match="is damaged or not a .safetensors file"):
        load_filter(path)
    path.write_bytes(save({"weights": np.zeros(3)}))
    with pytest.raises(ValueError, match="was not written by save_filter"):
        load_filter(path)
    path.write_bytes(save({"weights": np.zeros(3)}, metadata={"beliefgym_filter": "{"}))
    with pytest.raises(ValueError, match="its header is unreadable"):
        load_filter(path)
    path.write_bytes(save({"weights": np.zeros(3)}, metadata={"beliefgym_filter": "[]"}))
    with pytest.raises(ValueError, match="its header is unreadable"):
        load_filter(path)


def test_files_are_as_small_as_their_arrays(fitted, tmp_path):
    """No sums, and nothing twice: those of a PSIM would be far more than its coefficients."""
    filter = fitted("PSIM fourier phi_2")
    size = filter.save(tmp_path / "f").stat().st_size
    numbers = filter.model_._weights.size + filter.model_.frequencies_.size
    assert size < 8 * numbers + 6000
