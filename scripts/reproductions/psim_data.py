"""The recorded data of the filter experiments, in ten folds: the thesis's Sec. 3.3.4 on public recordings.

Every fold has a test part, the next fold as its validation part, and the other eight to train on. What belongs together
is held out together: a subject's tracks, a block of a video's time, the near replicates among the assembly trials.
Whatever is fitted to the data (scales, principal components) is fitted to the training part.

- assembly: a robot snaps a camera part together; wrist wrench (N, N m) and joint angles (rad), the first 350 samples
  of the 45 successful trials that have so many, at 20 Hz (the one failure of that length turns a joint to where no
  other trial is). Every component is divided by its standard deviation: units differ.
- arm: joint angles, velocities and motor torques of an arm in free motion, 81 trajectories of 350 steps at 250 Hz;
  divided in the same way. They fall into five families of near replicates (mean squared distances below 1 inside,
  above 5 between, in standard deviations); families are held out whole, in ten pairs of one to test and one to
  validate on. The two that alone move three of the joints are not held out together: nothing can be learned of a joint
  that stands still.
- mocap: walking, 59 tracks of 14 subjects, 300 steps at 120 Hz; joints but fingers and thumbs, relative to the root's
  place on the floor, in cm, as 10 principal components (the thesis takes those of the first trajectory).
- pumpjack, fire, flag (simulated): 20 principal components of grey frames of 80 x 60 pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from beliefgym.envs.pendulum import Pendulum
from beliefgym.learning import Sequences
from beliefgym.learning.dynamics import Standardise
from beliefgym.learning.splits import fold_indices
from beliefgym.scripts.reproductions import dad_data

Floats = NDArray[np.float64]
Parts = tuple[Sequences, Sequences, Sequences]
N_FOLDS = 10
ASSEMBLY, ARM, MOCAP = "assembly", "arm", "mocap"
FILES = {
    ASSEMBLY: "hiro_snap_assembly/hiro_snap_assembly.npz",
    ARM: "schunk_arm/schunk_arm.npz",
    MOCAP: "cmu_walk/cmu_walk.npz",
    "pumpjack": dad_data.CLIPS["pumpjack"],
    "fire": dad_data.CLIPS["fireplace"],
}
N_STEPS = 349  # of an assembly trial: 350 observations, as in the thesis
REPLICATES = [f"SA-S-{i:02d}" for i in range(2, 22)]  # assembly trials that repeat within 0.0003 rad
LEAST_SPREAD = 0.2  # of a component's deviation, that is to be left to train on
FAMILY = 5.0  # trajectories of the arm nearer than this, summed over components, are of one family
N_BODY, CM = 10, 100.0  # components of a pose; centimetres in a metre
FINGERS = ("fingers", "thumb")
CLIP_STEPS = 18  # a recorded clip's eleven blocks of time have some 20 frames each


@dataclass(frozen=True)
class Recording:
    """How a data set enters the experiments.

    Attributes:
        title: in tables. thesis_column: its column in Table 3.3, or "".
        n_future: k, as in the thesis: 5, and 3 for videos.
        standardise: of the filters: components of one unit are scaled together.
        unit: of the squared errors.
        version: of these parts; cells made with another one run again.
    """

    title: str
    thesis_column: str
    n_future: int
    standardise: Standardise
    unit: str
    version: int = 2

    @property
    def is_video(self) -> bool:
        """Whether it is one."""
        return self.n_future == 3

    @property
    def is_far(self) -> bool:
        """Whether what is tested on is unlike what is trained on: other scenes of a video, other motions of the arm."""
        return self.is_video or self is RECORDINGS[ARM]


RECORDINGS = {
    ASSEMBLY: Recording(
        "assembly telemetry", "Robot Drill", 5, True, "standard deviations squared", version=3
    ),
    ARM: Recording("arm torques", "Robot Drill", 5, True, "standard deviations squared", version=3),
    MOCAP: Recording("motion capture", "Motion Cap.", 5, "together", "cm^2"),
    "pumpjack": Recording("pumpjack video", "Beach Video", 3, "together", "grey levels squared"),
    "fire": Recording("fire video", "Beach Video", 3, "together", "grey levels squared"),
    "flag": Recording("flag video (simulated)", "Flag Video", 3, "together", "grey levels squared"),
}


def present(name: str, folder: Path | None) -> bool:
    """Whether the folder of recorded data holds what this one needs; the flag is simulated."""
    return name == "flag" or (folder is not None and (folder / FILES[name]).exists())


def parts(name: str, fold: int, paths: dict[str, Any]) -> Parts:
    """Training, validation and test part.

    Args:
        name: of `RECORDINGS`. fold: 0 .. 9.
        paths: "data", folder of the recordings, and "flag", file of the simulated frames.
    """
    if RECORDINGS[name].is_video:
        return _video(name, fold, paths)
    with np.load(Path(paths["data"]) / FILES[name]) as file:
        arrays = {key: file[key] for key in file}
    observations = arrays["observations"].astype(float)
    if name == MOCAP:
        subjects = np.array([track.split("_")[0] for track in arrays["track"]])
        return _poses(observations, [str(joint) for joint in arrays["joints"]], subjects, fold)
    allowed: Callable[[Any, Any], bool] = lambda first, second: True  # noqa: E731
    if name == ASSEMBLY:
        long = (arrays["lengths"] > N_STEPS) & arrays["success"].astype(bool)
        observations, groups = observations[long, : N_STEPS + 1], np.arange(np.count_nonzero(long))
        groups[is_replicate(arrays["trial"][long])] = -1
    else:
        groups = families(observations)

        def still_moves(first: Any, second: Any) -> bool:
            """Whether every component varies without these two."""
            rest = observations[~np.isin(groups, (first, second))]
            return bool((rest.std(axis=(0, 1)) > LEAST_SPREAD * observations.std(axis=(0, 1))).all())

        allowed = still_moves
    names = [str(component) for component in arrays["names"]]
    train, validation, test = split(len(groups), fold, groups, allowed)
    rows = observations[train].reshape(-1, observations.shape[2])
    scaled = (observations - rows.mean(axis=0)) / rows.std(axis=0)

    def part(chosen: NDArray[np.int64]) -> Sequences:
        return Sequences.from_observations(scaled[chosen], observation_names=names)

    return part(train), part(validation), part(test)


def noisy_pendulum(n: int, n_steps: int, noise: float, rng: np.random.Generator) -> Sequences:
    """A free pendulum of which only the cosine and sine of its angle are seen, with noise; 0.05 s a step.

    Args:
        n: trajectories. n_steps: of each. noise: standard deviation. rng: of starts and noise.
    """
    starts = rng.uniform(-1.0, 1.0, (n, 2)) * np.array([np.pi, 1.0])
    angle = dad_data.free_motion(Pendulum.uncontrolled(dt=0.05), starts, n_steps, 0.0, rng)[:, :, 0]
    seen = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    return Sequences.from_observations(seen + noise * rng.standard_normal(seen.shape))


def is_replicate(trials: NDArray[np.str_]) -> NDArray[np.bool_]:
    """(n,) which assembly trials are near replicates of one another."""
    return np.array([any(str(trial).endswith(name) for name in REPLICATES) for trial in trials])


def families(observations: Floats) -> NDArray[np.int64]:
    """(n,) the family of each trajectory (n, n_rows, n_obs): chains of neighbours."""
    flat = observations.reshape(-1, observations.shape[2])
    z = ((observations - flat.mean(axis=0)) / flat.std(axis=0)).reshape(len(observations), -1)
    squares = np.square(z).sum(axis=1)
    distance = (squares[:, None] + squares - 2.0 * z @ z.T) / observations.shape[1]
    return np.asarray(connected_components(distance < FAMILY)[1], dtype=np.int64)


def split(
    n: int, fold: int, groups: NDArray[Any], allowed: Callable[[Any, Any], bool] = lambda first, second: True
) -> tuple[NDArray[np.int64], ...]:
    """Indices to train, to validate and to test on.

    Args:
        n: trajectories. fold: 0 .. 9. groups: (n,), each held out whole. Fewer than folds go in pairs, one to test and
            one to validate on, every group to test equally often.
        allowed: whether two groups may be held out together, where they go in pairs.
    """
    labels = np.unique(groups)
    if len(labels) < N_FOLDS:
        first = fold % len(labels)
        others = [label for label in np.roll(labels, -first)[1:] if allowed(labels[first], label)]
        held = labels[first], others[fold // len(labels)]
        return (
            np.flatnonzero(~np.isin(groups, held)),
            np.flatnonzero(groups == held[1]),
            np.flatnonzero(groups == held[0]),
        )
    tests = [test for _, test in fold_indices(n, N_FOLDS, 0, groups)]
    test, validation = tests[fold], tests[(fold + 1) % N_FOLDS]
    train = np.setdiff1d(np.arange(n), np.concatenate([test, validation]))
    return train, validation, test


def _poses(positions: Floats, joints: list[str], subjects: NDArray[np.str_], fold: int) -> Parts:
    """Principal components of poses; y is up, so the root's x and z go."""
    n, n_rows, _ = positions.shape
    body = CM * positions.reshape(n, n_rows, len(joints), 3)
    floor = body[:, :, joints.index("root")] * np.array([1.0, 0.0, 1.0])
    kept = [i for i, joint in enumerate(joints) if not joint.endswith(FINGERS)]
    pose = (body[:, :, kept] - floor[:, :, None]).reshape(n, n_rows, -1)
    train, validation, test = split(n, fold, subjects)
    rows = pose[train].reshape(-1, pose.shape[2])
    centred = rows - rows.mean(axis=0)
    directions = np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :N_BODY]
    components = (pose - rows.mean(axis=0)) @ directions
    names = [f"pc_{i}" for i in range(N_BODY)]

    def part(chosen: NDArray[np.int64]) -> Sequences:
        return Sequences.from_observations(components[chosen], observation_names=names)

    return part(train), part(validation), part(test)


def _video(name: str, fold: int, paths: dict[str, Any]) -> Parts:
    """Blocks of a video's time: eleven, of which one to test on and the next to validate on."""
    if name == "flag":
        with np.load(paths["flag"]) as file:
            frames = file["frames"]
        cut = (dad_data.FLAG_EVERY, dad_data.FLAG_STEPS, dad_data.FLAG_STRIDE)
    else:
        frames = dad_data.clip_frames({"fire": "fireplace"}.get(name, name), Path(paths["data"]))
        cut = (1, CLIP_STEPS, 1)
    return dad_data.video_parts(frames, fold, N_FOLDS, *cut)[0]
