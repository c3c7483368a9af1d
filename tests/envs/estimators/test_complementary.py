"""The complementary filter, against turns in closed form and a loop written from the paper."""

import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.base import clone

from beliefgym.envs import ComplementaryFilter
from beliefgym.envs.estimators.complementary import leaning
from beliefgym.learning import Sequences

DT = 0.02
G = 9.81
BIAS = np.array([0.05, -0.08, 0.03])
NAMES = (*(f"gyro_{axis}" for axis in "xyz"), *(f"accelerometer_{axis}" for axis in "xyz"))


def turning(n=6, n_steps=400, seed=0, bias=BIAS, gyro_noise=0.0, force_noise=0.0, shaking=0.0, lean=0.3):
    """Bodies that roll and pitch as sums of sines, exactly: angles, rates from their derivatives, and the sensors."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n_steps + 1)
    frequency = rng.uniform(1.0, 3.0, (n, 3, 1))
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 3, 1))
    size = np.array([lean, lean, 0.5])[:, None]
    angles = size * np.sin(frequency * t + phase)
    speed = size * frequency * np.cos(frequency * t + phase)
    roll, pitch, yaw = angles.swapaxes(0, 1)
    dr, dp, dy = speed.swapaxes(0, 1)
    gyro = np.stack(
        [
            dr - np.sin(pitch) * dy,
            np.cos(roll) * dp + np.sin(roll) * np.cos(pitch) * dy,
            -np.sin(roll) * dp + np.cos(roll) * np.cos(pitch) * dy,
        ],
        axis=-1,
    )
    turn = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1).reshape(-1, 3))
    up = turn.inv().apply([0.0, 0.0, 1.0]).reshape(n, -1, 3)
    pushed = np.zeros_like(up)
    if shaking:  # bursts of acceleration along the body's x axis
        pushed[..., 0] = shaking * (np.sin(7.0 * t) > 0.7)
    x = np.concatenate([gyro + bias, G * up + pushed], axis=-1)
    x[..., :3] += gyro_noise * rng.standard_normal((n, n_steps + 1, 3))
    x[..., 3:] += force_noise * rng.standard_normal((n, n_steps + 1, 3))
    return Sequences.from_observations(
        x,
        hints=np.stack([roll, pitch], axis=-1),
        states=up,
        observation_names=NAMES,
        hint_names=("roll", "pitch"),
    )


def by_the_paper(x, kP, kI, q0, gate=None):
    """One trajectory with rotation matrices: R_hat' = R_hat (Omega - b + kP omega)_x by matrix exponentials."""
    R, b, before = q0.as_matrix(), np.zeros(3), None
    found = []
    for row in x:
        gyro, a = row[:3], row[3:]
        if before is not None:
            R = R @ Rotation.from_rotvec(DT * (0.5 * (before + gyro) - b)).as_matrix()
        before = gyro
        v, v_hat = a / np.linalg.norm(a), R.T @ np.array([0.0, 0.0, 1.0])
        omega = np.cross(v, v_hat)
        if gate is not None:
            omega = omega * np.exp(-(((np.linalg.norm(a) - G) / gate) ** 2) / 2)
        R = R @ Rotation.from_rotvec(DT * kP * omega).as_matrix()
        b = b - DT * kI * omega
        yaw, pitch, roll = Rotation.from_matrix(R).as_euler("ZYX")
        found.append([roll, pitch, yaw, *(R.T @ [0.0, 0.0, 1.0]), *b])
    return np.array(found)


@pytest.mark.parametrize("gate", [None, 0.7])
def test_it_is_the_papers_filter(gate):
    data = turning(n=3, n_steps=150, force_noise=0.3, gyro_noise=0.02)
    known = ComplementaryFilter.of(dt=DT, kP=1.5, kI=0.4, gate=gate)
    up = ComplementaryFilter.of(dt=DT, kP=1.5, kI=0.4, gate=gate, hint="gravity")
    mean, gravity = known.estimate_hints(data).mean, up.estimate_hints(data).mean
    beliefs = known.beliefs(data)
    for i in range(3):
        expected = by_the_paper(data.observations[i], 1.5, 0.4, Rotation.identity(), gate)
        np.testing.assert_allclose(mean[i], expected[:, :2], atol=1e-10)
        np.testing.assert_allclose(gravity[i], expected[:, 3:6], atol=1e-10)
        q, bias = known.attitude(beliefs[i, 1:])
        np.testing.assert_allclose(bias, expected[:, 6:], atol=1e-10)
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(q).as_euler("ZYX")[:, 0], expected[:, 2], atol=1e-9)


def test_an_error_fades_as_the_linear_equations_say():
    """A level body at rest, little tilted in belief: with e the angle, e'' + kP e' + kI e = 0 and b = -kI int e."""
    kP, kI, dt, e0 = 2.0, 5.0, 1e-3, 1e-3
    n_steps = 3000
    x = np.zeros((1, n_steps + 1, 6))
    x[..., 5] = G
    data = Sequences.from_observations(x, hints=np.zeros((1, n_steps + 1, 2)))
    known = ComplementaryFilter.of(dt=dt, kP=kP, kI=kI)
    known._start = Rotation.from_euler("x", e0).as_quat()
    found = known.estimate_hints(data).mean[0]
    t = dt * np.arange(n_steps + 1)
    w = np.sqrt(kI - 0.25 * kP**2)
    expected = e0 * np.exp(-0.5 * kP * t) * (np.cos(w * t) - 0.5 * kP / w * np.sin(w * t))
    np.testing.assert_allclose(found[:, 0], expected, atol=5e-3 * e0)
    np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-12)


def test_it_converges_to_the_truth_and_to_the_bias():
    """Exact sensors: from a tilt of 0.6 rad the error fades to what steps of 0.02 s leave, and the bias is found.

    It takes minutes: the bias about the vertical is seen by little, and only because the body leans."""
    data = turning(n=3, n_steps=10_000)
    known = ComplementaryFilter.of(dt=DT, kP=2.0, kI=1.0)
    known._start = Rotation.from_euler("ZYX", [0.0, 0.6, -0.6]).as_quat()
    mean = known.estimate_hints(data).mean
    late = np.abs(mean - data.hints)[:, 9000:].max()
    assert late < 5e-4
    assert np.abs(mean - data.hints)[:, 0].max() > 0.3
    _, bias = known.attitude(known.beliefs(data)[:, -1])
    np.testing.assert_allclose(bias, np.tile(BIAS, (3, 1)), atol=2e-3)
    still = Sequences.from_observations(
        np.tile(np.array([*BIAS, 0.0, 0.0, G]), (1, 4001, 1)), hints=np.zeros((1, 4001, 2))
    )
    _, bias = known.attitude(known.beliefs(still)[:, -1])
    np.testing.assert_allclose(bias[0], [*BIAS[:2], 0.0], atol=1e-9)  # about the vertical nothing is seen


def test_fitted_gains_beat_others_and_are_reproducible():
    train, test = (turning(n=5, n_steps=300, seed=s, gyro_noise=0.02, force_noise=1.0) for s in (1, 2))
    fitted = ComplementaryFilter(dt=DT).fit(train, test)
    assert fitted.gate_ == np.inf
    for kP, kI in (
        (1.0, 0.1),
        (0.1, 0.01),
        (10.0, 1.0),
        (0.5 * fitted.kP_, fitted.kI_),
        (2.0 * fitted.kP_, 0.0),
    ):
        other = ComplementaryFilter(dt=DT, kP=kP, kI=kI).fit(train)
        assert (other.kP_, other.kI_) == (kP, kI)
        assert fitted.training_error_ < other.training_error_
    assert (
        fitted.hint_errors(test).mean
        < ComplementaryFilter(dt=DT, kP=1.0, kI=0.1).fit(train).hint_errors(test).mean
    )
    np.testing.assert_allclose(fitted.hint_errors(train).mean, fitted.training_error_)
    std = fitted.estimate_hints(test).std
    np.testing.assert_allclose(std, np.broadcast_to(fitted.hint_errors(train).rmse, std.shape))
    np.testing.assert_allclose(fitted.hint_errors(train).mean_squared_z, 1.0)
    again = clone(fitted).fit(train)
    assert (again.kP_, again.kI_) == (fitted.kP_, fitted.kI_)
    half = ComplementaryFilter(dt=DT, kP=fitted.kP_).fit(train)
    assert half.kP_ == fitted.kP_
    np.testing.assert_allclose(half.training_error_, fitted.training_error_, rtol=1e-2)


def test_a_gate_helps_where_the_body_is_pushed():
    train = turning(n=5, n_steps=250, gyro_noise=0.05, force_noise=0.1, shaking=8.0)
    plain = ComplementaryFilter(dt=DT).fit(train)
    gated = ComplementaryFilter(dt=DT, gate="fit").fit(train)
    assert gated.training_error_ < 0.8 * plain.training_error_
    assert 0.0 < gated.gate_ < 5.0
    fixed = ComplementaryFilter(dt=DT, kP=plain.kP_, kI=plain.kI_, gate=1e6).fit(train)
    np.testing.assert_allclose(fixed.training_error_, plain.training_error_, rtol=1e-6)


def test_the_first_attitude_is_the_priors_or_the_accelerometers():
    data = turning(bias=0.0)
    prior = ComplementaryFilter(dt=DT, kP=0.0, kI=0.0).fit(data)
    first = data.hints[:, 0].mean(axis=0)
    np.testing.assert_allclose(prior.prior_mean_, first)
    np.testing.assert_allclose(prior.predict_hint(prior.initial_belief()).mean[0], first, atol=1e-12)
    np.testing.assert_allclose(prior.estimate_hints(data).mean[:, 0], np.tile(first, (6, 1)), atol=1e-12)
    sensed = ComplementaryFilter(dt=DT, kP=0.0, kI=0.0, initial="accelerometer").fit(data)
    estimate = sensed.estimate_hints(data).mean
    np.testing.assert_allclose(estimate[:, 0], data.hints[:, 0], atol=1e-12)
    assert np.abs(estimate - data.hints)[:, :50].max() < 1e-3  # then the rates alone, over a second
    turned = Sequences.from_observations(
        data.observations, hints=data.states, observation_names=NAMES, hint_names=("a", "b", "c")
    )
    up = ComplementaryFilter(dt=DT, kP=0.0, kI=0.0, hint="gravity", initial="accelerometer").fit(turned)
    np.testing.assert_allclose(up.estimate_hints(turned).mean[:, :50], data.states[:, :50], atol=1e-3)
    mean = data.states[:, 0].mean(axis=0)
    np.testing.assert_allclose(
        up.predict_hint(up.initial_belief()).mean[0], mean / np.linalg.norm(mean), atol=1e-12
    )


def test_the_gravity_hint_is_the_third_row_of_the_attitude():
    rng = np.random.default_rng(0)
    turn = Rotation.random(20, rng=rng)
    known = ComplementaryFilter.of(dt=DT, kP=1.0, kI=0.0, hint="gravity")
    belief = np.tile(known.initial_belief(), (20, 1))
    belief[:, :4] = turn.as_quat()
    up = turn.as_matrix().swapaxes(1, 2) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(known.predict_hint(belief).mean, up, atol=1e-12)
    roll, pitch, yaw = leaning(up.T)
    again = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(again, up, atol=1e-12)
    expected = known.predict_observation(belief)
    np.testing.assert_allclose(expected[:, 3:], G * up, atol=1e-12)
    assert np.isnan(known.predict_hint(belief).std).all()


def test_what_is_missing_of_the_sensors():
    data = turning(n=2, n_steps=60)
    known = ComplementaryFilter.of(dt=DT, kP=2.0, kI=0.5)
    belief = known.beliefs(data)[:, 31]
    q, bias = known.attitude(belief)
    gyro, force = np.array([[0.3, -0.2, 0.1]] * 2), data.observations[:, 31, 3:]
    no_force = known.update(belief, np.hstack([gyro, np.full((2, 3), np.nan)]), missing="predict")
    rates = 0.5 * (belief[:, 7:10] + gyro) - bias
    expected = (Rotation.from_quat(q) * Rotation.from_rotvec(DT * rates)).as_quat()
    np.testing.assert_allclose(known.attitude(no_force)[0], expected, atol=1e-12)  # the gyroscope alone
    np.testing.assert_array_equal(known.attitude(no_force)[1], bias)
    partly = np.hstack([gyro, force])
    partly[:, 4] = np.nan
    np.testing.assert_array_equal(known.update(belief, partly, missing="predict"), no_force)
    falling = known.update(belief, np.hstack([gyro, np.zeros((2, 3))]))
    np.testing.assert_array_equal(falling, no_force)
    nothing = np.full((2, 6), np.nan)
    once = known.update(belief, nothing, missing="predict")
    twice = known.update(once, nothing, missing="predict")
    np.testing.assert_allclose(twice[:, :7], once[:, :7], atol=1e-12)  # it holds
    with_zero = np.hstack([bias, force])
    no_gyro = known.update(belief, np.hstack([np.full((2, 3), np.nan), force]), missing="predict")
    np.testing.assert_allclose(no_gyro, known.update(belief, with_zero), atol=1e-12)
    start = known.initial_belief(2)
    late = ComplementaryFilter.of(dt=DT, kP=2.0, kI=0.5, initial="accelerometer")
    level = late.update(start, np.hstack([gyro, np.full((2, 3), np.nan)]), missing="predict")
    np.testing.assert_allclose(level[:, :4], start[:, :4], atol=1e-12)
    with pytest.raises(ValueError, match="missing='predict'"):
        known.update(belief, nothing)


def test_a_batch_is_one_by_one_and_it_pickles():
    data = turning(n=4, n_steps=50, force_noise=0.2)
    known = ComplementaryFilter(dt=DT, kP=1.0, kI=0.1, initial="accelerometer").fit(data)
    together = known.estimate_hints(data).mean
    for i in range(4):
        np.testing.assert_allclose(known.estimate_hints(data[[i]]).mean[0], together[i], atol=1e-12)
    again = pickle.loads(pickle.dumps(known))
    np.testing.assert_array_equal(again.estimate_hints(data).mean, together)
    mixed = np.concatenate([known.beliefs(data)[:1, 10], known.initial_belief()])
    found = known.update(mixed, data.observations[[0, 1], [10, 0]])
    np.testing.assert_allclose(found, known.beliefs(data)[[0, 1], [11, 1]], atol=1e-12)
    assert np.isfinite(known.errors(data).mean)


def test_sensors_are_found_by_name_or_index_among_others():
    data = turning(n=4, n_steps=50)
    order = [5, 0, 3, 1, 4, 2]
    x = np.concatenate([data.observations[..., order], np.ones((4, 51, 1))], axis=2)
    names = (*(NAMES[i] for i in order), "height")
    named = Sequences.from_observations(x, hints=data.hints, observation_names=names)
    with pytest.warns(UserWarning, match="do not vary"):
        by_name = ComplementaryFilter(dt=DT, kP=1.0, kI=0.1).fit(named)
    expected = ComplementaryFilter(dt=DT, kP=1.0, kI=0.1).fit(data).estimate_hints(data).mean
    np.testing.assert_allclose(by_name.estimate_hints(named).mean, expected, atol=1e-12)
    assert by_name.predict_observation(by_name.initial_belief())[0, 6] == 1.0
    bare = Sequences.from_observations(data.observations, hints=data.hints)
    by_index = ComplementaryFilter(dt=DT, kP=1.0, kI=0.1, gyro=(0, 1, 2), accelerometer=(3, 4, 5)).fit(bare)
    np.testing.assert_allclose(by_index.estimate_hints(bare).mean, expected, atol=1e-12)


def test_what_is_wrong_is_told():
    data = turning(n=2, n_steps=10)
    bare = Sequences.from_observations(data.observations, hints=data.hints)
    for parameters, message in (
        ({"dt": 0.0}, "expected dt finite and above 0, got 0.0"),
        ({"kP": -1.0}, "kP finite and at least 0, or None to fit it"),
        ({"gate": 0.0}, 'gate above 0, None or "fit"'),
        ({"gate": "tune"}, 'gate above 0, None or "fit"'),
        ({"hint": "yaw"}, "hint to be one of"),
        ({"initial": "level"}, "initial to be one of"),
        ({"gyro": ("gyro_x", "gyro_y")}, "gyro as three names or indices"),
        ({"gyro": ("gyro_x", "gyro_y", "rate")}, r"gyro: expected .* named \('gyro_x'.* got 'rate'"),
        ({"gyro": (3, 4, 5)}, "six different components"),
        ({"hint": "gravity"}, r"hints \('up_x', 'up_y', 'up_z'\) with hint='gravity', got 2"),
    ):
        with pytest.raises(ValueError, match=message):
            ComplementaryFilter(**{"dt": DT, "kP": 1.0, "kI": 0.1} | parameters).fit(data)
    with pytest.raises(ValueError, match="of 6 components without names, got 'gyro_x'"):
        ComplementaryFilter(dt=DT).fit(bare)
    with pytest.raises(ValueError, match="training trajectories with hints"):
        ComplementaryFilter(dt=DT).fit(
            Sequences.from_observations(data.observations, observation_names=NAMES)
        )
    with pytest.raises(ValueError, match=r"numbers for \('kI',\)"):
        ComplementaryFilter.of(dt=DT, kP=1.0, kI=None)
