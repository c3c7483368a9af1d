"""Frames of a video: reading them, and splitting one video into training and test blocks of time.

Reading goes through imageio: ffmpeg for videos (the optional extra `video`), Pillow for animated pictures.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.uint8]
"""(n, height, width) grey or (n, height, width, 3) coloured pictures, 0 to 255."""

_PICTURE_FILES = (".gif", ".png", ".apng", ".webp", ".tif", ".tiff")  # read by Pillow, without ffmpeg


def read_frames(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    scale: float | None = None,
    grey: bool = True,
    every: int = 1,
    start: int = 0,
    stop: int | None = None,
    max_frames: int | None = None,
) -> Frames:
    """Frames of a video or animated picture; only what is kept is held in memory.

    Args:
        path: anything ffmpeg reads, or a .gif, .png, .webp or .tif.
        size: (width, height) in pixels; or
        scale: factor of both, e.g. 0.25. Pixels are averaged over the area they cover.
        grey: luma (ITU-R 601) instead of red, green and blue.
        every, start, stop: keep frames start, start + every, ... below stop, counted from 0.
        max_frames: keep at most so many.

    Returns:
        (n, height, width), or (n, height, width, 3) with grey=False.

    Raises:
        FileNotFoundError: no such file.
        ImportError: a video, and ffmpeg is not installed.
        ValueError: a file that cannot be read, not one frame, or an option out of range.
    """
    from PIL import Image

    path = Path(path)
    if size is not None and scale is not None:
        raise ValueError(f"expected size or scale, got both ({size} and {scale}); pass one")
    for name, value, least in (("every", every, 1), ("start", start, 0), ("max_frames", max_frames, 1)):
        if value is not None and value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    if (scale is not None and not scale > 0) or (size is not None and min(size) < 1):
        raise ValueError(f"expected a positive size or scale, got {size or scale}")
    if stop is not None and stop <= start:
        raise ValueError(f"expected stop above start = {start}, got {stop}")

    def picture(frame: Any) -> Frames:
        image = Image.fromarray(np.asarray(frame)).convert("L" if grey else "RGB")
        width, height = size or image.size
        if scale is not None:
            width, height = max(round(width * scale), 1), max(round(height * scale), 1)
        same = (width, height) == image.size
        return np.asarray(image if same else image.resize((width, height), Image.Resampling.BOX))

    imageio, options = _reader(path)
    try:
        kept = islice(islice(imageio.imiter(path, **options), start, stop, every), max_frames)
        frames = [picture(frame) for frame in kept]
    except Exception as error:  # each of imageio's readers has its own kinds
        raise ValueError(_unreadable(path, error)) from error
    if not frames:
        raise ValueError(f"{path}: expected a frame from {start} on, got none; the video ends before that")
    return np.stack(frames)


def frame_rate(path: str | os.PathLike[str]) -> float:
    """Frames a second of a video.

    Raises:
        FileNotFoundError, ImportError: as in `read_frames`.
        ValueError: a file that does not say it.
    """
    path = Path(path)
    imageio, options = _reader(path)
    try:
        about = imageio.immeta(path, plugin=options["plugin"])
    except Exception as error:
        raise ValueError(_unreadable(path, error)) from error
    rate = about.get("fps") or (1000.0 / about["duration"] if about.get("duration") else None)
    if not rate:
        raise ValueError(f"{path}: expected a video that says its frame rate, got none; pass fps by hand")
    return float(rate)


def split_video(frames: Frames, fractions: Sequence[float], *, gap: int = 0) -> tuple[Frames, ...]:
    """Blocks of one video in the order of time, e.g. `train, validation, test`; views, not copies.

    Args:
        frames: (n, ...) neighbouring frames, not yet subsampled.
        fractions: share of each block; they sum to 1, and 0 is allowed.
        gap: frames left out between two blocks, because those at a border are almost the same picture.

    Returns:
        A block for each fraction.

    Raises:
        ValueError: fractions that do not sum to 1, a negative gap, or a block without a frame.
    """
    shares = np.asarray(fractions, dtype=np.float64)
    if shares.ndim != 1 or not len(shares) or not (shares >= 0).all() or abs(shares.sum() - 1.0) > 1e-9:
        raise ValueError(f"fractions: expected shares of at least 0 that sum to 1, got {list(fractions)}")
    if gap < 0:
        raise ValueError(f"gap: expected at least 0 frames, got {gap}")
    n_gaps = max(int((shares > 0).sum()) - 1, 0)
    n_left = max(len(frames) - gap * n_gaps, 0)
    ends = np.rint(np.cumsum(shares) * n_left).astype(int)
    blocks, begin, skipped = [], 0, 0
    for share, end in zip(shares, ends, strict=True):
        if share > 0 and end <= begin:
            raise ValueError(
                f"expected enough frames to give each of the fractions {list(fractions)} at least one, got "
                f"{len(frames)} with {n_gaps} gaps of {gap} frames"
            )
        blocks.append(frames[begin + skipped : end + skipped])
        if share > 0:
            begin, skipped = int(end), skipped + gap
    return tuple(blocks)


def _reader(path: Path) -> tuple[Any, dict[str, Any]]:
    """imageio and the options that make it read this file."""
    import imageio.v3 as imageio

    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; expected a video")
    if path.suffix.lower() in _PICTURE_FILES:
        return imageio, {"plugin": "pillow", "mode": "RGB"}
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"reading {path} needs ffmpeg: install the extra `video` (pip install 'beliefgym[video]')"
        ) from error
    return imageio, {"plugin": "FFMPEG"}


def _unreadable(path: Path, error: Exception) -> str:
    first_line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return (
        f"cannot read {path} ({first_line}); expected a video that ffmpeg reads or an animated picture; convert "
        "it, e.g. with `ffmpeg -i IN OUT.mp4`"
    )
