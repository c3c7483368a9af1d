"""Pictures of planar MuJoCo models on beliefgym's own canvas: no display, no graphics driver.

The capsules of the model are drawn in the plane in which it moves, the camera follows, and beside the scene stands
what the agent sees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefgym.envs.rendering import SIZE, Canvas, panel

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class View:
    """How a model is looked at.

    Args:
        plane: "xz" from the side, with a floor at z = 0 if `floor`; "xy" from above, with a grid.
        height: of the window in m.
        centre: second coordinate of the window's centre in m, kept in "xz".
        follow: the window moves with the model: along x in "xz", along both in "xy".
        floor: there is a floor.
        far: ending of the names of bodies on the far side, drawn fainter and first.
    """

    plane: Literal["xz", "xy"]
    height: float
    centre: float = 0.0
    follow: bool = True
    floor: bool = False
    far: str | None = None


def planar_picture(
    title: str,
    model: Any,
    position: Floats,
    view: View,
    observation: Mapping[str, float | None],
    action: Mapping[str, float | None],
) -> NDArray[np.uint8]:
    """The scene, and the panel beside it.

    Args:
        title: of the panel.
        model: the `mujoco.MjModel`.
        position: (nq,) joint positions.
        view: how to look at it.
        observation: name -> value, None where it is hidden from the agent.
        action: name -> value of each motor in its control range, None where there was no action yet.

    Returns:
        (480, 720, 3) uint8.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = position
    mujoco.mj_kinematics(model, data)
    canvas = Canvas(SIZE, SIZE)
    _draw(canvas, model, data, view, list(action.values()))
    seen = [
        (name, "hidden" if value is None else f"{value:.2f}", "faint" if value is None else "text")
        for name, value in observation.items()
    ]
    done = [(name, "-" if value is None else f"{value:.2f}", "force") for name, value in action.items()]
    return np.concatenate([canvas.image(), panel(title, seen, done)], axis=1)


def _draw(canvas: Canvas, model: Any, data: Any, view: View, action: list[float | None]) -> None:
    axes = [0, 2] if view.plane == "xz" else [0, 1]
    moving = np.flatnonzero(model.geom_bodyid > 0)
    middle = data.geom_xpos[moving].mean(axis=0)[axes]
    if not view.follow:
        middle = np.zeros(2)
    centre = (float(middle[0]), view.centre if view.plane == "xz" else float(middle[1]))
    canvas.view(centre, height=view.height)
    (_ground if view.plane == "xz" else _grid)(canvas, centre, view)

    def capsule(geom: int, color: str) -> None:
        half = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        start, end = (data.geom_xpos[geom] + sign * half for sign in (-1.0, 1.0))
        canvas.rod(_point(start[axes]), _point(end[axes]), 2.0 * float(model.geom_size[geom, 0]), color)

    capsules = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    names = [model.body(int(model.geom_bodyid[geom])).name for geom in capsules]
    far = np.array([bool(view.far) and name.endswith(str(view.far)) for name in names])
    order = np.argsort(~far, kind="stable")
    for i in order:
        geom = int(capsules[i])
        capsule(geom, "guide" if geom not in moving else "far" if far[i] else "body")
    across = [1, 2][view.plane == "xy"]
    sign = (
        1.0 if view.plane == "xz" else -1.0
    )  # a turn about y is clockwise from the side, about z not from above
    for motor, value in enumerate(action):
        joint = int(model.actuator_trnid[motor, 0])
        anchor, axis = data.xanchor[joint], data.xaxis[joint]
        body = model.body(int(model.jnt_bodyid[joint])).name
        radius = 0.055 * view.height
        share = 0.0 if value is None else value / float(np.abs(model.actuator_ctrlrange[motor]).max())
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            end = anchor[axes] + 6.0 * radius * share * axis[axes]
            canvas.arrow(_point(anchor[axes]), _point(end), 0.4 * radius, "force")
            continue
        canvas.circle(_point(anchor[axes]), 0.2 * radius, "joint")
        if not (view.far and body.endswith(view.far)):
            canvas.turn_arrow(_point(anchor[axes]), radius, sign * float(axis[across]) * share, "force")


def _ground(canvas: Canvas, centre: tuple[float, float], view: View) -> None:
    """A floor with a mark every half metre, so that one sees the speed."""
    if not view.floor:
        return
    half = 0.5 * view.height
    bottom = view.centre - half
    canvas.box((centre[0], bottom), 2.6 * half, -2.0 * bottom, "panel")
    canvas.line((centre[0] - half, 0.0), (centre[0] + half, 0.0), 0.008 * view.height, "guide")
    for mark in np.arange(np.ceil(2 * (centre[0] - half)), 2 * (centre[0] + half)) / 2:
        depth = 0.05 if mark % 1 else 0.1
        canvas.line((mark, 0.0), (mark, -depth * half), 0.006 * view.height, "guide")


def _grid(canvas: Canvas, centre: tuple[float, float], view: View) -> None:
    """Lines a metre apart."""
    half = 0.5 * view.height
    for mark in np.arange(np.ceil(centre[0] - half), centre[0] + half):
        canvas.line((mark, centre[1] - half), (mark, centre[1] + half), 0.003 * view.height, "guide")
    for mark in np.arange(np.ceil(centre[1] - half), centre[1] + half):
        canvas.line((centre[0] - half, mark), (centre[0] + half, mark), 0.003 * view.height, "guide")


def _point(pair: Floats) -> tuple[float, float]:
    return float(pair[0]), float(pair[1])
