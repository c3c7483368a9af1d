"""The simulated flag: force of the air against the closed form, a cloth that keeps its size, and its video."""

import os
from dataclasses import replace

import numpy as np
import pytest

from beliefgym.envs.flag_picture import FlagPicture
from beliefgym.envs.simulated_flag import SimulatedFlag
from beliefgym.envs.simulation import NonFiniteError

SMALL = SimulatedFlag(columns=9, rows=7, warm_up=2.0)


@pytest.fixture(scope="module")
def motion():
    return SMALL.simulate(4.0, seed=3)


def test_model_and_rest_agree_on_the_vertices():
    model = SMALL.model
    assert np.array_equal(
        np.flatnonzero(model.body_jntnum[model.flex_vertbodyid] == 0), np.arange(7)
    )  # the hoist
    bodies = model.body_pos[model.flex_vertbodyid[7:]]
    assert bodies == pytest.approx(
        SMALL.rest[7:], abs=1e-6
    )  # MuJoCo keeps a flex's places in single precision
    cross = np.cross(*(SMALL.rest[SMALL.triangles[:, i]] - SMALL.rest[SMALL.triangles[:, 0]] for i in (1, 2)))
    assert 0.5 * np.linalg.norm(cross, axis=1).sum() == pytest.approx(6.0 * 4.0)


@pytest.mark.parametrize("degrees", [90.0, 30.0, -30.0, 0.0])
def test_force_on_a_flat_plate_is_the_closed_form(degrees):
    angle, speed = np.deg2rad(degrees), 7.0
    wind = speed * np.array([np.cos(angle), np.sin(angle), 0.0])  # 90 degrees: it faces the plate
    force = SMALL.aerodynamic_force(SMALL.rest, np.zeros_like(SMALL.rest), wind)
    q_area = 0.5 * 1.2 * 6.0 * 4.0 * speed**2
    expected = [0.05 * q_area * np.cos(angle), 1.2 * q_area * np.sin(angle), 0.0]
    assert force.sum(axis=0) == pytest.approx(expected, abs=1e-9)
    # an inner vertex has a third of six triangles: the share of one of 8 x 6 cells
    assert force[10] == pytest.approx(np.array(expected) / 48.0, abs=1e-9)


def test_only_the_motion_relative_to_the_air_counts():
    rest, wind = SMALL.rest, np.array([3.0, 4.0, -1.0])
    moving = SMALL.aerodynamic_force(rest, np.broadcast_to(-wind, rest.shape), np.zeros(3))
    assert moving == pytest.approx(SMALL.aerodynamic_force(rest, np.zeros_like(rest), wind))
    carried = SMALL.aerodynamic_force(rest, np.broadcast_to(wind, rest.shape), wind)
    assert carried == pytest.approx(0.0)


def test_the_same_seed_gives_the_same_motion_and_a_longer_video_begins_alike(motion):
    assert np.array_equal(SMALL.simulate(1.0, seed=3), motion[:25])


def test_another_seed_gives_another_motion(motion):
    assert np.abs(SMALL.simulate(0.2, seed=4) - motion[:5]).max() > 0.1  # m; they had 2 s to part


def test_the_hoist_stays_and_the_fly_flaps(motion):
    assert np.array_equal(motion[:, :7], np.broadcast_to(SMALL.rest[:7], (100, 7, 3)))
    assert motion[:, -4, 1].std() > 0.1  # m


def test_a_steady_wind_makes_it_flap_too():
    """Its waves grow where the wind is faster than they: gusts only make them irregular."""
    steady = replace(SMALL, gust=(0.0, 0.0, 0.0), warm_up=10.0)
    assert steady.simulate(2.0, seed=0)[:, -4, 1].std() > 0.1  # m


def test_edges_keep_their_length_within_a_few_per_cent():
    flag = SimulatedFlag(warm_up=3.0)
    positions = flag.simulate(1.0, seed=0)
    length, at_rest = (
        np.linalg.norm(p[..., flag.edges[:, 0], :] - p[..., flag.edges[:, 1], :], axis=-1)
        for p in (positions, flag.rest)
    )
    strain = length / at_rest - 1.0
    assert np.abs(strain).max() < 0.08  # at the corners that are pinned, and where it snaps
    assert np.quantile(np.abs(strain), 0.99) < 0.03


def test_without_wind_it_comes_to_rest_hanging():
    still = SimulatedFlag(
        length=1.5, height=1.0, columns=9, rows=7, stiffness=2000.0, thickness=0.005, damping=2e-3,
        wind_speed=0.0, gust=(0.0, 0.0, 0.0), warm_up=0.0,
    )  # fmt: skip
    positions = still.simulate(12.0, seed=0)
    velocity = np.diff(positions, axis=0) / still.dt
    height = 0.5 * (positions[1:, :, 2] + positions[:-1, :, 2])
    kinetic = 0.5 * (velocity**2).sum(axis=-1).mean(axis=1)  # J/kg
    total = kinetic + 9.81 * height.mean(axis=1)  # without the elastic one
    early, middle, late = total[:25].mean(), total[50:75].mean(), total[-25:].mean()
    assert early > middle > late
    assert late < early - 2.0  # it falls by some 0.3 m
    assert kinetic[-50:].max() < 0.02 * kinetic.max()  # what is slow meets little drag
    assert positions[-1, -1, 2] < -0.3  # m; the fly's upper corner was at 0.5


def test_divergence_is_told_with_its_time(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        NonFiniteError, match=r"simulated flag diverged at t = -1\.\d+ s .* more substeps than 12"
    ):
        replace(SMALL, substeps=12, stiffness=1e6).simulate(1.0, seed=0)
    assert not os.listdir(tmp_path)  # MuJoCo writes its warnings to a file
    assert capfd.readouterr().err == ""


def test_pictures(motion):
    frames = SMALL.render(motion[::20], 64, 48)
    assert frames.shape == (5, 48, 64, 3)
    assert frames.dtype == np.uint8
    assert (frames.std(axis=0).max(axis=-1) > 5).mean() > 0.1  # the flag moves
    assert np.ptp(frames[:, -1, :].astype(int), axis=0).max() == 0  # the pole and the sky below it do not
    grey = SMALL.render(motion[::20], 64, 48, grey=True)
    assert grey == pytest.approx(frames @ [0.299, 0.587, 0.114], abs=0.5 + 1e-9)
    assert np.array_equal(grey, SMALL.render(motion[::20], 64, 48, grey=True))


def test_video_is_the_render_of_the_simulation(motion):
    assert np.array_equal(SMALL.video(0.2, 3, 32, 24), SMALL.render(motion[:5], 32, 24))


def test_no_sky_shows_through_the_cloth():
    """A flat flag covers its whole outline: the lattice is finer than the pixels."""
    width, height = 160, 120
    picture = FlagPicture(9, 7, 6.0, 4.0, (width, height), smoothing=1)
    changed = (picture.frame(SMALL.rest) != picture._background.round().reshape(height, width, 3)).any(
        axis=-1
    )
    for row in changed[changed.any(axis=1)]:
        inside = np.flatnonzero(row)
        assert len(inside) == inside[-1] - inside[0] + 1


@pytest.mark.parametrize(("y", "shown"), [(-0.2, "rust"), (0.2, "indigo")])
def test_the_nearer_cloth_hides_the_farther(y, shown):
    """The fly's half folded over the hoist's, before or behind it; the viewer stands at negative y."""
    grid = SMALL.rest.reshape(9, 7, 3).copy()
    grid[5:, :, 0] = 2.0 * grid[4, 0, 0] - grid[5:, :, 0]
    grid[5:, :, 1] = y
    picture = FlagPicture(9, 7, 6.0, 4.0, (80, 60)).frame(grid.reshape(-1, 3))
    red, _, blue = picture[30, 13].astype(int)  # within the band at the hoist, beside its ring
    assert (red > blue) == (shown == "rust")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": 0.0}, "expected length above 0 and finite, got 0.0"),
        ({"wind_speed": -1.0}, "expected wind_speed of at least 0 and finite, got -1.0"),
        ({"gust": (1.0, np.nan, 0.0)}, "expected gust as three numbers of at least 0 in m/s"),
        ({"rows": 2}, "expected at least 3 columns and rows, got 9 and 2"),
        ({"substeps": 10}, "expected substeps as a multiple of 4, got 10"),
    ],
)
def test_wrong_numbers_are_told(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **change)


def test_wrong_shapes_are_told():
    with pytest.raises(ValueError, match=r"expected positions \(n_frames, 63, 3\), got shape \(63, 3\)"):
        SMALL.render(SMALL.rest)
    with pytest.raises(ValueError, match=r"expected at least one frame of 0.04 s, got 0.0 s"):
        SMALL.simulate(0.0, seed=0)
