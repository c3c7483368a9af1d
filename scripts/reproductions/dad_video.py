"""`beliefgym reproduce dad-video`: predicted frames beside true ones, of recorded, simulated and your own videos.

After Figs. 3.5 to 3.7: a video's frames as principal components, predicted over a whole trajectory by a single-step
model and by DaD, both tuned alike, and turned back into pictures. Beside the error stands the contrast of the last
predicted frames, the spread of their components over the test trajectories as a share of the true frames': predictions
that have run into the mean of the data, which the thesis shows for the single-step model's fireplace, have none.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefgym.learning import RandomFourierRidge, Sequences
from beliefgym.learning.video_frames import read_frames
from beliefgym.scripts.reproductions import dad_data as data
from beliefgym.scripts.reproductions.cells import run_cells
from beliefgym.scripts.reproductions.dad_figures import DAD, GRID, SINGLE, STYLE, TRUTH, save
from beliefgym.scripts.reproductions.dad_table import VIDEO_ALPHAS, VIDEO_BANDWIDTHS, flag_video, present
from beliefgym.scripts.reproductions.dad_tuning import TUNING_VERSION, tune
from beliefgym.scripts.reproductions.report import Interval, Report, Request, Row

COLUMNS = ("what", "single step", "DaD", "improvement", "contrast single", "contrast DaD", "meets")
SETTING: dict[str, Any] = {
    "data_version": data.VERSION,
    "tuning_version": TUNING_VERSION,
    "n_frequencies": 200,
    "bandwidths": list(VIDEO_BANDWIDTHS),
    "alphas": list(VIDEO_ALPHAS),
    "horizons": [5, 10, None],
    "n_iterations": 15,
    "screening": 3,
}
SHOWN = 5  # frames of a trajectory in a figure
LONG_ENOUGH = 600  # frames of a user's video from which on every fifth is taken


def run(request: Request) -> Report:
    """The user's video alone where one is given; otherwise the flag and the recorded clips that there are."""
    if request.video is not None:
        sources = {request.video.stem: str(request.video)}
    else:
        sources = {name: str(request.data) for name in data.CLIPS if present(name, request.data)}
        sources["flag"] = str(flag_video(request))
    cells = {}
    for name, fold in product(sources, range(request.seeds)):
        cells[f"{name}-{fold}"] = {
            "source": name,
            "fold": fold,
            "n_folds": request.seeds,
            "seed": request.seed,
            "own": request.video is not None,
            **SETTING,
        }
    folder = request.folder / "cells" / "dad-video"
    found = run_cells(f"{__name__}:cell", cells, folder, request.jobs, request.told, sources)
    rows, figures = [], {}
    for name in sources:
        results = [found[cell_name] for cell_name, cell in cells.items() if cell["source"] == name]
        rows.append(row(name, results))
        good = [result for result in results if "failed" not in result]
        if good and "frames" in good[0]:
            file = f"dad-video-{name}.png"
            with matplotlib.rc_context(STYLE):
                save(frames_figure(good[0]["frames"]), request.folder / file)
            title = "simulated flag" if name == "flag" else name
            figures[file] = f"Frames of a test trajectory of the {title}: true, single step, DaD."
    notes = [
        "Every fold holds out another block of time as test part and the next for validation; intervals are 95 % over "
        "folds, which share most of their training data. Contrast: 1 is as lively as the true frames, 0 is the mean.",
    ]
    absent = [name for name in data.CLIPS if request.video is None and name not in sources]
    if absent:
        notes.append(f"Without data, and so left out: {', '.join(absent)} (`--data` names the folder).")
    return Report(ABOUT, COLUMNS, rows, SETTING, figures, notes)


ABOUT = (
    "Video textures: 20 principal components of small grey frames, random Fourier features, DaD against single step; "
    "the multi-step error is RMSE over signal power of the components on test trajectories."
)


def row(name: str, results: list[dict[str, Any]]) -> Row:
    """One video."""
    base: Row = {"what": "flag (simulated)" if name == "flag" else name, "meets": None}
    good = [result for result in results if "failed" not in result]
    if not good:
        return base | {"single step": results[0]["failed"]}
    improvement = Interval.of([100.0 * (1.0 - result["dad"] / result["single"]) for result in good])
    return base | {
        "single step": Interval.of([result["single"] for result in good]).text(),
        "DaD": Interval.of([result["dad"] for result in good]).text(),
        "improvement": improvement.text(".1f", " %"),
        "contrast single": Interval.of([result["contrast_single"] for result in good]).text(".2f"),
        "contrast DaD": Interval.of([result["contrast_dad"] for result in good]).text(".2f"),
        "meets": improvement.high >= 0 or len(good) < 2,
    }


def cell(cell: dict[str, Any], sources: dict[str, str]) -> dict[str, Any]:
    """One fold of one video: errors, contrast, and the frames of one test trajectory."""
    frames, every, n_steps, stride = _frames(cell, sources[cell["source"]])
    (train, validation, test), texture, _ = data.video_parts(
        frames, cell["fold"], cell["n_folds"], every, n_steps, stride
    )
    scale = train.n_obs**0.5
    pair = tune(
        train,
        validation,
        RandomFourierRidge(n_frequencies=cell["n_frequencies"], random_state=cell["seed"]),
        [{"bandwidth": b * scale, "alpha": a} for b, a in product(cell["bandwidths"], cell["alphas"])],
        [{"horizon": horizon} for horizon in cell["horizons"]],
        n_iterations=cell["n_iterations"],
        screening=cell["screening"],
        common={"standardise": "together"},
    )
    result: dict[str, Any] = {"explained_variance": texture.explained_variance}
    shown = len(test) // 2
    at = np.linspace(1, n_steps, SHOWN).round().astype(int)
    pictures = {"truth": texture.decode(test.observations[shown, at])}
    for arm, choice in (("single", pair.single), ("dad", pair.dad)):
        predicted = choice.model.rollout(test.observations[:, 0], n_steps)
        result[arm] = choice.model.errors(test).mean
        result[f"contrast_{arm}"] = _contrast(predicted, test)
        result[f"{arm}_chosen"] = {"learner": choice.learner, "options": choice.options}
        pictures[arm] = texture.decode(predicted[shown, at])
    if cell["fold"] == 0:
        coded = {arm: b64encode(some.tobytes()).decode() for arm, some in pictures.items()}
        result["frames"] = {"steps": at.tolist(), "shape": pictures["truth"].shape, **coded}
    return result


def frames_figure(frames: dict[str, Any]) -> Figure:
    """True and predicted frames in three rows."""
    steps = frames["steps"]
    figure = Figure(figsize=(1.9 * len(steps) + 0.4, 4.6), layout="constrained")
    grid = figure.subplots(3, len(steps))
    arms = (("truth", "true", TRUTH), ("single", "single step", SINGLE), ("dad", "DaD", DAD))
    for r, (arm, label, colour) in enumerate(arms):
        pictures = np.frombuffer(b64decode(frames[arm]), dtype=np.uint8).reshape(frames["shape"])
        for c, step in enumerate(steps):
            axes = grid[r, c]
            axes.imshow(pictures[c], cmap="gray", vmin=0, vmax=255)
            axes.set_xticks([])
            axes.set_yticks([])
            for spine in axes.spines.values():
                spine.set_color(GRID)
            if r == 0:
                axes.set_title(f"step {step}", fontsize=10)
            if c == 0:
                axes.set_ylabel(label, color=colour, fontsize=11)
    return figure


def _contrast(predicted: NDArray[np.float64], test: Sequences) -> float:
    """Root mean square distance of the last predictions from the components' mean (0), as a share of the truth's."""
    last = test.observations[:, -1]
    return float(np.sqrt(np.square(predicted[:, -1]).sum() / np.square(last).sum()))


def _frames(cell: dict[str, Any], source: str) -> tuple[NDArray[np.uint8], int, int, int]:
    if cell["own"]:
        frames = read_frames(Path(source), size=data.CLIP_SIZE, grey=True)
        long = len(frames) >= LONG_ENOUGH
        return (
            frames,
            5 if long else data.CLIP_EVERY,
            data.FLAG_STEPS if long else data.CLIP_STEPS,
            4 if long else 1,
        )
    if cell["source"] == "flag":
        with np.load(source) as file:
            return file["frames"], data.FLAG_EVERY, data.FLAG_STEPS, data.FLAG_STRIDE
    return data.clip_frames(cell["source"], Path(source)), data.CLIP_EVERY, data.CLIP_STEPS, 1
