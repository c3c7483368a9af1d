"""Video frames, their principal components, and the trajectories cut from them."""

import os
import sys
from itertools import pairwise
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from beliefgym.learning.video_frames import frame_rate, read_frames, split_video
from beliefgym.learning.video_textures import VideoTexture

RECORDED = Path(__file__).parents[2].parent / "shared" / "data" / "video_textures"
recorded = pytest.mark.skipif(
    not RECORDED.is_dir(), reason="the recorded videos (../shared/data) are not there"
)


@pytest.fixture
def frames():
    """(40, 6, 8) frames of noise: no two pixels are alike."""
    return np.random.default_rng(0).integers(0, 256, size=(40, 6, 8), dtype=np.uint8)


def write_lossless(path, frames, fps=10):
    """Without loss: ffv1 in an .avi."""
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra `video`")
    pixels = "gray" if frames.ndim == 3 else "bgr0"
    imageio.imwrite(
        path, frames, plugin="FFMPEG", fps=fps, codec="ffv1", pixelformat=pixels, macro_block_size=1
    )
    return path


# Reading.


def test_a_lossless_video_is_read_pixel_by_pixel(tmp_path, frames):
    path = write_lossless(tmp_path / "a.avi", frames, fps=12)
    read = read_frames(path)
    np.testing.assert_array_equal(read, frames)
    assert read.dtype == np.uint8
    assert frame_rate(path) == 12.0


def test_colours_are_kept_where_asked(tmp_path):
    colours = np.random.default_rng(1).integers(0, 256, size=(5, 8, 10, 3), dtype=np.uint8)
    path = write_lossless(tmp_path / "a.avi", colours)
    np.testing.assert_array_equal(read_frames(path, grey=False), colours)
    luma = colours @ np.array([0.299, 0.587, 0.114])  # ITU-R 601
    assert np.abs(read_frames(path) - luma).max() <= 1.0  # rounded in 16-bit integers


def test_an_animated_gif_is_read_without_ffmpeg(tmp_path, frames, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    path = tmp_path / "a.gif"
    imageio.imwrite(path, frames, plugin="pillow", duration=40)
    np.testing.assert_array_equal(read_frames(path), frames)
    assert frame_rate(path) == 25.0


def test_a_lossy_video_has_the_frames_that_were_written(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra `video`")
    levels = np.arange(20, 220, 10)
    flat = np.ones((20, 32, 48), dtype=np.uint8) * levels[:, None, None].astype(np.uint8)
    imageio.imwrite(tmp_path / "a.mp4", flat, plugin="FFMPEG", fps=10)
    read = read_frames(tmp_path / "a.mp4")
    assert read.shape == flat.shape
    assert np.abs(read.mean(axis=(1, 2)) - levels).max() < 4  # h264 moves a flat grey by a level or two


def test_frames_are_chosen_as_python_slices_are(tmp_path, frames):
    path = write_lossless(tmp_path / "a.avi", frames)
    np.testing.assert_array_equal(read_frames(path, every=5), frames[::5])
    np.testing.assert_array_equal(read_frames(path, every=3, start=4, stop=20), frames[4:20:3])
    np.testing.assert_array_equal(read_frames(path, start=30, stop=1000), frames[30:])
    np.testing.assert_array_equal(read_frames(path, every=7, max_frames=3), frames[:15:7])


def test_smaller_frames_are_averages_over_the_pixels_they_cover(tmp_path, frames):
    path = write_lossless(tmp_path / "a.avi", frames)
    blocks = frames.reshape(40, 3, 2, 4, 2).mean(axis=(2, 4))
    halved = read_frames(path, scale=0.5)
    assert halved.shape == (40, 3, 4)
    assert np.abs(halved - blocks).max() <= 1.0  # Pillow rounds after each of the two axes
    np.testing.assert_array_equal(read_frames(path, size=(4, 3)), halved)
    assert read_frames(path, scale=0.01).shape == (40, 1, 1)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"size": (4, 3), "scale": 0.5}, r"expected size or scale, got both \(\(4, 3\) and 0\.5\)"),
        ({"scale": 0.0}, "expected a positive size or scale, got 0.0"),
        ({"size": (0, 3)}, r"expected a positive size or scale, got \(0, 3\)"),
        ({"every": 0}, "every: expected at least 1, got 0"),
        ({"start": -1}, "start: expected at least 0, got -1"),
        ({"max_frames": 0}, "max_frames: expected at least 1, got 0"),
        ({"start": 5, "stop": 5}, "expected stop above start = 5, got 5"),
    ],
)
def test_bad_options_of_reading(tmp_path, options, told):
    with pytest.raises(ValueError, match=told):
        read_frames(tmp_path / "a.gif", **options)


@pytest.mark.parametrize("name", ["bad.mp4", "bad.gif"])
def test_files_that_cannot_be_read(tmp_path, name):
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg", reason="needs the extra `video`")
    (tmp_path / name).write_bytes(b"no picture" * 50)
    for reads in (read_frames, frame_rate):
        with pytest.raises(
            ValueError, match=rf"cannot read .*{name} \(.+\); expected a video .*; convert it"
        ):
            reads(tmp_path / name)
        with pytest.raises(FileNotFoundError, match=r"no file .*nowhere\.mp4; expected a video"):
            reads(tmp_path / "nowhere.mp4")


def test_a_start_after_the_end(tmp_path, frames):
    imageio.imwrite(tmp_path / "a.gif", frames, plugin="pillow")
    with pytest.raises(ValueError, match=r"expected a frame from 40 on, got none; the video ends before"):
        read_frames(tmp_path / "a.gif", start=40)


def test_a_picture_that_says_no_frame_rate(tmp_path, frames):
    imageio.imwrite(tmp_path / "a.png", frames[0], plugin="pillow")
    with pytest.raises(ValueError, match="expected a video that says its frame rate, got none; pass fps"):
        frame_rate(tmp_path / "a.png")


def test_without_ffmpeg_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    (tmp_path / "a.mp4").write_bytes(b"")
    for reads in (read_frames, frame_rate):
        with pytest.raises(
            ImportError, match=r"install the extra `video` \(pip install 'beliefgym\[video\]'\)"
        ):
            reads(tmp_path / "a.mp4")


# Splitting.


def test_blocks_are_contiguous_in_time_and_hold_every_frame():
    frames = np.arange(101)
    train, validation, test = split_video(frames, (0.7, 0.1, 0.2))
    np.testing.assert_array_equal(np.concatenate([train, validation, test]), frames)
    assert [len(block) for block in (train, validation, test)] == [71, 10, 20]
    assert np.shares_memory(train, frames)


@pytest.mark.parametrize("fractions", [(0.5, 0.3, 0.2), (0.5, 0.0, 0.5), (0.0, 1.0)])
def test_a_gap_keeps_blocks_apart(fractions):
    blocks = [block for block in split_video(np.arange(100), fractions, gap=7) if len(block)]
    assert blocks[0][0] == 0
    assert blocks[-1][-1] == 99
    for before, after in pairwise(blocks):
        assert after[0] - before[-1] == 8
    assert len(split_video(np.arange(100), fractions)) == len(fractions)


def test_bad_splits():
    for fractions in ((0.5, 0.6), (1.5, -0.5), (), (np.nan,)):
        with pytest.raises(ValueError, match="fractions: expected shares of at least 0 that sum to 1, got"):
            split_video(np.arange(10), fractions)
    with pytest.raises(ValueError, match="gap: expected at least 0 frames, got -1"):
        split_video(np.arange(10), (1.0,), gap=-1)
    with pytest.raises(ValueError, match=r"at least one, got 10 with 1 gaps of 10 frames"):
        split_video(np.arange(10), (0.5, 0.5), gap=10)


# Components.


def test_components_are_those_of_the_singular_value_decomposition(frames):
    texture = VideoTexture(7).fit(frames)
    flat = frames.reshape(40, -1) / 255.0
    mean = flat.mean(axis=0)
    _, singular, rows = np.linalg.svd(flat - mean, full_matrices=False)
    np.testing.assert_allclose(texture.mean_, mean, atol=1e-14)
    np.testing.assert_allclose(np.abs(texture.components_ @ rows[:7].T), np.eye(7), atol=1e-10)
    share = singular**2 / (singular**2).sum()
    np.testing.assert_allclose(texture.explained_variance_ratio_, share[:7], rtol=1e-10)
    assert texture.explained_variance == pytest.approx(share[:7].sum())
    codes = texture.encode(frames)
    np.testing.assert_allclose(np.abs(codes), np.abs((flat - mean) @ rows[:7].T), atol=1e-10)


@pytest.mark.parametrize("shape", [(40, 6, 8), (300, 3, 4), (20, 4, 5, 3)])
def test_at_full_rank_decode_undoes_encode(shape):
    frames = np.random.default_rng(2).integers(0, 256, size=shape, dtype=np.uint8)
    texture = VideoTexture(min(shape[0] - 1, int(np.prod(shape[1:])))).fit(frames)
    codes = texture.encode(frames)
    np.testing.assert_array_equal(texture.decode(codes), frames)
    assert texture.explained_variance == pytest.approx(1.0)


def test_frames_outside_of_the_training_are_centred_by_the_training_mean(frames):
    texture = VideoTexture(5).fit(frames[:30])
    unseen = texture.encode(frames[30:])
    expected = (frames[30:].reshape(10, -1) / 255.0 - texture.mean_) @ texture.components_.T
    np.testing.assert_allclose(unseen, expected, atol=1e-13)


def test_a_fraction_keeps_the_fewest_components_that_reach_it(frames):
    texture = VideoTexture(0.8).fit(frames)
    assert texture.explained_variance >= 0.8 > texture.explained_variance_ratio_[:-1].sum()
    assert texture.encode(frames).shape == (40, len(texture.components_))


def test_decode_clips_and_takes_batches_of_trajectories(frames):
    texture = VideoTexture(3).fit(frames)
    decoded = texture.decode(np.random.default_rng(0).normal(scale=100.0, size=(2, 4, 3)))
    assert decoded.shape == (2, 4, 6, 8)
    assert decoded.dtype == np.uint8
    assert set(np.unique(decoded)) >= {0, 255}
    np.testing.assert_array_equal(
        texture.decode(np.zeros(3)), np.rint(255 * texture.mean_).reshape(6, 8).astype(np.uint8)
    )


def test_save_and_load(tmp_path, frames):
    texture = VideoTexture(4).fit(frames)
    assert texture.save(tmp_path / "texture.npz") == tmp_path / "texture.npz"
    again = VideoTexture.load(tmp_path / "texture.npz")
    assert again.get_params() == {"n_components": 4}
    np.testing.assert_array_equal(again.encode(frames), texture.encode(frames))
    np.testing.assert_array_equal(again.decode(np.ones((1, 4))), texture.decode(np.ones((1, 4))))
    assert again.frame_shape_ == (6, 8)
    assert os.listdir(tmp_path) == ["texture.npz"]
    with pytest.raises(
        FileNotFoundError, match=r"no file .*nowhere; expected one written by VideoTexture\.save"
    ):
        VideoTexture.load(tmp_path / "nowhere")
    np.savez(tmp_path / "other.npz", a=1)
    with pytest.raises(ValueError, match=r"other\.npz: expected a file written by VideoTexture\.save"):
        VideoTexture.load(tmp_path / "other.npz")


def test_follows_scikit_learn(frames):
    texture = VideoTexture(n_components=4)
    assert clone(texture).n_components == 4
    assert texture.fit(frames) is texture
    with pytest.raises(NotFittedError):
        clone(texture).encode(frames)
    for use in (lambda t: t.decode(np.ones((1, 4))), lambda t: t.save("a"), lambda t: t.explained_variance):
        with pytest.raises(NotFittedError):
            use(VideoTexture(4))


@pytest.mark.parametrize("n_components", [0, -1, 1.0, 1.5, 0.0, True, "mle", None])
def test_bad_numbers_of_components(frames, n_components):
    with pytest.raises(
        ValueError, match=r"n_components: expected a whole number of at least 1, or a fraction"
    ):
        VideoTexture(n_components).fit(frames)


def test_bad_frames(frames):
    with pytest.raises(
        ValueError,
        match=r"expected at least 41 training frames and 40 pixels for n_components=40, got 40 frames of 48 "
        "pixels; take more frames or fewer components",
    ):
        VideoTexture(40).fit(frames)
    with pytest.raises(ValueError, match="expected at least 2 training frames"):
        VideoTexture(0.9).fit(frames[:1])
    with pytest.raises(ValueError, match="expected frames that differ, got 5 times the same picture"):
        VideoTexture(2).fit(np.repeat(frames[:1], 5, axis=0))
    texture = VideoTexture(2).fit(frames)
    with pytest.raises(
        ValueError, match=r"expected frames of shape \(6, 8\) as in training, got \(6, 4\); read both"
    ):
        texture.encode(frames[:, :, :4])
    with pytest.raises(ValueError, match="expected frames of uint8 from 0 to 255.*, got dtype float64"):
        texture.encode(frames / 255.0)
    with pytest.raises(ValueError, match=r"expected frames of shape .*, got \(6, 8\); a single frame is"):
        texture.encode(frames[0])
    with pytest.raises(ValueError, match=r"expected codes of shape \(\.\.\., 2\), got \(1, 3\)"):
        texture.decode(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"expected finite codes, got nan at \[1, 0\]"):
        texture.decode(np.array([[0.0, 1.0], [np.nan, 0.0]]))


# Trajectories.


def test_trajectories_take_every_fifth_frame_from_every_start(frames):
    texture = VideoTexture(3).fit(frames)
    codes = texture.encode(frames)
    sequences = texture.to_sequences(frames, 6)
    assert sequences.observations.shape == (10, 7, 3)  # starts 0 .. 9: the last one ends at frame 39
    for start in range(10):
        np.testing.assert_array_equal(sequences.observations[start], codes[start : start + 31 : 5])
    assert sequences.observation_names == ("pc_0", "pc_1", "pc_2")
    assert sequences.n_act == 0


@pytest.mark.parametrize(
    ("every", "stride", "starts"), [(5, 4, [0, 4, 8]), (2, 12, [0, 12, 24]), (1, 33, [0, 33])]
)
def test_starts_are_a_stride_apart(frames, every, stride, starts):
    texture = VideoTexture(3).fit(frames)
    codes = texture.encode(frames)
    sequences = texture.to_sequences(frames, 6, every=every, stride=stride)
    assert len(sequences) == len(starts)
    for sequence, start in zip(sequences.observations, starts, strict=True):
        np.testing.assert_array_equal(sequence, codes[start : start + 6 * every + 1 : every])


def test_metadata_says_where_the_codes_come_from(frames):
    texture = VideoTexture(3).fit(frames)
    metadata = texture.to_sequences(frames, 2, fps=25.0, metadata={"source": "noise"}).metadata
    assert metadata["dt"] == 0.2
    assert metadata["source"] == "noise"
    assert metadata["frame_shape"] == [6, 8]
    assert metadata["explained_variance"] == texture.explained_variance
    assert (metadata["every"], metadata["stride"]) == (5, 1)
    assert "dt" not in texture.to_sequences(frames, 2).metadata


def test_a_video_shorter_than_a_trajectory(frames):
    texture = VideoTexture(3).fit(frames)
    assert len(texture.to_sequences(frames[:31], 6)) == 1
    with pytest.raises(
        ValueError,
        match=r"expected at least 31 frames for a trajectory of 6 steps of 5 frames, got 30; take fewer steps",
    ):
        texture.to_sequences(frames[:30], 6)


def test_bad_options_of_trajectories(frames):
    texture = VideoTexture(3).fit(frames)
    for option in ({"n_steps": 0}, {"every": 0}, {"stride": 1.5}):
        with pytest.raises(ValueError, match=f"{next(iter(option))}: expected a whole number of at least 1"):
            texture.to_sequences(frames, **{"n_steps": 2, **option})
    with pytest.raises(ValueError, match="fps: expected a positive number of frames a second, got 0"):
        texture.to_sequences(frames, 2, fps=0)


# Recorded videos.


@recorded
@pytest.mark.parametrize(
    ("name", "shape", "fps", "least"),
    # `least`: variance that 20 components keep, below the 0.98 and 0.69 measured for the whole clips
    [("pumpjack.mp4", (226, 36, 64), 30.0, 0.95), ("fire_pot0.avi", (260, 180, 320), 25.0, 0.6)],
)
def test_recorded_videos_become_trajectories(name, shape, fps, least):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra `video`")
    frames = read_frames(RECORDED / name, scale=0.25)
    assert frames.shape == shape
    assert frame_rate(RECORDED / name) == fps
    train, test = split_video(frames, (0.5, 0.5))
    texture = VideoTexture(20).fit(train)
    assert texture.explained_variance > least
    for block in (train, test):
        sequences = texture.to_sequences(block, 16, fps=fps, metadata={"source": name})
        assert len(sequences) == shape[0] // 2 - 80
        assert sequences.metadata["dt"] == pytest.approx(5 / fps)
    blurred = texture.decode(texture.encode(train))
    error = (blurred.astype(float) - train).var() / train.astype(float).var(axis=0).mean()
    assert error == pytest.approx(1 - texture.explained_variance, abs=0.02)  # rounding and clipping to uint8
