"""Names for the positions and velocities of a MuJoCo model, after its joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# MuJoCo's joint types with more than one coordinate: number of positions and of velocities
_FREE, _BALL = 0, 1
_COORDINATES = {_FREE: (7, 6), _BALL: (4, 3)}


def joint_names(model: Any) -> tuple[list[str], list[str]]:
    """`qpos_<joint>` and `qvel_<joint>` in MuJoCo's order; `qpos_<joint>_<i>` for a joint of several coordinates.

    Args:
        model: a `mujoco.MjModel`; a joint without a name is called `joint_<number>`.

    Returns:
        nq names and nv names.
    """
    positions: list[str] = []
    velocities: list[str] = []
    for i in range(model.njnt):
        joint = model.joint(i).name or f"joint_{i}"
        n_positions, n_velocities = _COORDINATES.get(int(model.jnt_type[i]), (1, 1))
        positions += [f"qpos_{joint}{suffix}" for suffix in _suffixes(n_positions)]
        velocities += [f"qvel_{joint}{suffix}" for suffix in _suffixes(n_velocities)]
    return positions, velocities


def observation_names(model: Any, structure: Mapping[str, int]) -> list[str]:
    """Names of the observation of one of Gymnasium's MuJoCo tasks (v5).

    Args:
        model: its `mujoco.MjModel`.
        structure: its `observation_structure`: the observation's parts in order, with their sizes.
    """
    positions, velocities = joint_names(model)
    parts = {"qpos": positions[int(structure.get("skipped_qpos", 0)) :], "qvel": velocities}
    names: list[str] = []
    for part, size in structure.items():
        if not part.startswith("skipped_"):
            names += parts.get(part, [f"{part}_{i}" for i in range(int(size))])
    return names


def _suffixes(n: int) -> list[str]:
    return [""] if n == 1 else [f"_{i}" for i in range(n)]
