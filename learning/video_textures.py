"""Videos as sequences: frames, their principal components, and trajectories of every fifth frame.

A frame with p pixels in [0, 1] is a point f in R^p. PCA of the training frames gives their mean m and k
orthonormal rows C, the directions of largest variance:

    code z = C (f - m),    frame f = m + C' z

Neighbouring frames are almost the same picture. A video is therefore split into blocks of time
(`split_video`) before PCA is fitted and trajectories are cut, so that no test frame was seen in training.

Reference: Venkatraman, thesis proposal, Sec. 3.1.3 "Video Textures": PCA, every fifth frame, trajectories of
16 to 26 time steps, a random tenth of the trajectories held out.
Deviations: held out are blocks of time, because its videos last minutes and short clips need trajectories
that overlap; and these start at any frame, so that all five phases of "every fifth frame" are used.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.decomposition import PCA
from sklearn.utils.validation import check_is_fitted

from beliefgym.learning.sequences import Sequences
from beliefgym.learning.video_frames import Frames
from beliefgym.learning.whole_files import written_whole

Array = NDArray[np.float64]

_CHUNK_FRAMES = 256  # frames held as float64 at a time
_LEAST_VARIANCE = 1e-12  # of a pixel in [0, 1]; rounding of equal frames stays far below
_FILE_ARRAYS = ("mean_", "components_", "explained_variance_ratio_", "frame_shape_")


class VideoTexture(BaseEstimator):
    """Frames as codes of a few principal components, and codes as frames.

    Args:
        n_components: how many; or, below 1, the fraction of the training frames' variance to keep.

    Attributes:
        mean_: (p,) mean training frame, in [0, 1]; p pixels (and colours).
        components_: (n_components, p) orthonormal rows, by falling variance.
        explained_variance_ratio_: (n_components,) share of the training frames' variance.
        frame_shape_: (height, width), or (height, width, 3).
    """

    def __init__(self, n_components: int | float = 20) -> None:
        self.n_components = n_components

    def fit(self, frames: Frames, y: None = None) -> VideoTexture:
        """Find the components of training frames (n, height, width[, 3]), uint8; exact, in float64.

        Raises:
            ValueError: frames of another form, too few of them, or all of them the same.
        """
        self._check_n_components()
        frames = _checked(frames)
        flat = frames.reshape(len(frames), -1) / 255.0
        most = min(len(flat) - 1, flat.shape[1])  # the mean takes one frame's freedom
        if self.n_components > most or most < 1:
            raise ValueError(
                f"expected at least {max(int(self.n_components), 1) + 1} training frames and "
                f"{max(int(self.n_components), 1)} pixels for n_components={self.n_components}, got "
                f"{len(flat)} frames of {flat.shape[1]} pixels; take more frames or fewer components"
            )
        if float(flat.var(axis=0).max()) < _LEAST_VARIANCE:
            raise ValueError(f"expected frames that differ, got {len(flat)} times the same picture")
        pca = PCA(self.n_components, svd_solver="full").fit(flat)
        self.mean_: Array = pca.mean_
        self.components_: Array = pca.components_
        self.explained_variance_ratio_: Array = pca.explained_variance_ratio_
        self.frame_shape_: tuple[int, ...] = frames.shape[1:]
        return self

    @property
    def explained_variance(self) -> float:
        """Share of the training frames' variance that all components together keep, 0 to 1."""
        check_is_fitted(self, "components_")
        return float(self.explained_variance_ratio_.sum())

    def encode(self, frames: Frames) -> Array:
        """Codes (n, n_components) of frames (n, height, width[, 3]), uint8.

        Raises:
            NotFittedError: before `fit`.
            ValueError: frames of another form or size than in training.
        """
        check_is_fitted(self, "components_")
        frames = _checked(frames)
        if frames.shape[1:] != self.frame_shape_:
            raise ValueError(
                f"expected frames of shape {self.frame_shape_} as in training, got {frames.shape[1:]}; read "
                "both with the same size, scale and grey"
            )
        codes = np.empty((len(frames), len(self.components_)))
        for i in range(0, len(frames), _CHUNK_FRAMES):
            chunk = frames[i : i + _CHUNK_FRAMES]
            codes[i : i + len(chunk)] = (
                chunk.reshape(len(chunk), -1) / 255.0 - self.mean_
            ) @ self.components_.T
        return codes

    def decode(self, codes: Array) -> Frames:
        """Frames (..., height, width[, 3]) of codes (..., n_components), rounded and clipped to uint8.

        Raises:
            NotFittedError: before `fit`.
            ValueError: another number of components, or a code that is not finite.
        """
        check_is_fitted(self, "components_")
        codes = np.asarray(codes, dtype=np.float64)
        k = len(self.components_)
        if codes.ndim < 1 or codes.shape[-1] != k:
            raise ValueError(f"expected codes of shape (..., {k}), got {codes.shape}")
        if not np.isfinite(codes).all():
            where = np.argwhere(~np.isfinite(codes))[0].tolist()
            raise ValueError(f"expected finite codes, got {codes[tuple(where)]} at {where}")
        flat = codes.reshape(-1, k)
        frames = np.empty((len(flat), len(self.mean_)), dtype=np.uint8)
        for i in range(0, len(flat), _CHUNK_FRAMES):
            pixels = flat[i : i + _CHUNK_FRAMES] @ self.components_ + self.mean_
            frames[i : i + _CHUNK_FRAMES] = np.clip(np.rint(255.0 * pixels), 0, 255)
        return frames.reshape(*codes.shape[:-1], *self.frame_shape_)

    def to_sequences(
        self,
        frames: Frames,
        n_steps: int = 16,
        *,
        every: int = 5,
        stride: int = 1,
        fps: float | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> Sequences:
        """Trajectories z_s, z_{s + every}, ..., z_{s + every n_steps} for s = 0, stride, 2 stride, ...

        With stride 1 all phases of "every fifth frame" occur and trajectories overlap: split the video first.

        Args:
            frames: (n, height, width[, 3]) neighbouring frames of one video or block of it.
            n_steps: steps of a trajectory, one fewer than its frames.
            every: frames from one step to the next.
            stride: frames from one start to the next; every * n_steps shares only end frames.
            fps: frames a second (see `frame_rate`); the metadata then holds "dt" (s).
            metadata: further entries, e.g. {"source": "pumpjack.mp4"}.

        Returns:
            Observations (n_trajectories, n_steps + 1, n_components) named pc_0, ..., without actions.

        Raises:
            NotFittedError: before `fit`.
            ValueError: an option out of range, other frames than in training, or fewer than a trajectory's.
        """
        for name, value in (("n_steps", n_steps), ("every", every), ("stride", stride)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"{name}: expected a whole number of at least 1, got {value!r}")
        if fps is not None and not fps > 0:
            raise ValueError(f"fps: expected a positive number of frames a second, got {fps}")
        codes = self.encode(frames)
        span = every * n_steps + 1
        if len(codes) < span:
            raise ValueError(
                f"expected at least {span} frames for a trajectory of {n_steps} steps of {every} frames, got "
                f"{len(codes)}; take fewer steps, a smaller `every` or a longer block of the video"
            )
        starts = np.arange(0, len(codes) - span + 1, stride)
        about = {
            "encoding": "principal components of video frames",
            "frame_shape": list(self.frame_shape_),
            "explained_variance": self.explained_variance,
            "every": int(every),
            "stride": int(stride),
        }
        return Sequences.from_observations(
            codes[starts[:, None] + every * np.arange(n_steps + 1)],
            observation_names=[f"pc_{i}" for i in range(codes.shape[1])],
            metadata=about | ({} if fps is None else {"dt": every / fps}) | dict(metadata or {}),
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the fitted components to one .npz file (the name is used as it is); returns the path."""
        check_is_fitted(self, "components_")
        path = Path(path)
        with written_whole(path) as file:
            arrays: dict[str, Any] = {name: getattr(self, name) for name in _FILE_ARRAYS}
            np.savez_compressed(file, n_components=self.n_components, **arrays)
        return path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> VideoTexture:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: no such file.
            ValueError: another kind of file.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                texture = cls(file["n_components"].item())
                for name in _FILE_ARRAYS:
                    setattr(texture, name, file[name])
        except FileNotFoundError as error:
            raise FileNotFoundError(f"no file {path}; expected one written by VideoTexture.save") from error
        except Exception as error:
            raise ValueError(f"{path}: expected a file written by VideoTexture.save ({error})") from error
        texture.frame_shape_ = tuple(int(n) for n in texture.frame_shape_)
        return texture

    def _check_n_components(self) -> None:
        n = self.n_components
        whole = isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 1
        if not whole and not (isinstance(n, float | np.floating) and 0 < n < 1):
            raise ValueError(
                "n_components: expected a whole number of at least 1, or a fraction of the variance between 0 "
                f"and 1, got {n!r}"
            )


def _checked(frames: Any) -> Frames:
    """Frames, if they are (n, height, width[, 3]) of uint8 with something in them."""
    frames = np.asarray(frames)
    if frames.dtype != np.uint8:
        raise ValueError(
            f"expected frames of uint8 from 0 to 255 as read_frames gives them, got dtype {frames.dtype}"
        )
    if frames.ndim not in (3, 4) or (frames.ndim == 4 and frames.shape[3] != 3) or not frames.size:
        raise ValueError(
            f"expected frames of shape (n, height, width) or (n, height, width, 3), got {frames.shape}; a "
            "single frame is frame[None]"
        )
    return frames
