"""Systems whose dynamics MuJoCo computes: whole batches by `mujoco.rollout`, on as many threads as there are cores.

With q the joint positions, v the joint velocities and tau the actuators' forces, MuJoCo integrates

    M(q) dv/dt + c(q, v) = tau + J'f,      dq/dt = v,      at a time step of dt / substeps,

f the forces of constraints such as joint limits. Each control period starts from (q, v) alone (no warm start of the
constraint solver), so a state says all there is, and a copy moves the same alone and in a batch.

Numpy, and torch or any other array-API library by way of numpy: values only. Gradients do not pass through MuJoCo;
`transition_derivatives` gives its own linearisation.
"""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from array_api_compat import array_namespace, is_torch_array
from numpy.typing import ArrayLike, NDArray

from beliefgym.envs.system import Array, System

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MujocoSystem(System):
    """A system with hinge and slide joints in MuJoCo; its state begins with (q, v).

    Args:
        substeps: MuJoCo steps in one control period.

    Raises:
        ValueError: fewer than one substep, or a model with other joints or counts than the state's names say.
    """

    substeps: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (isinstance(self.substeps, int) and self.substeps >= 1):
            raise ValueError(f"expected substeps as a whole number of at least 1, got {self.substeps!r}")

    @abstractmethod
    def mjcf(self) -> str:
        """The model in MuJoCo's XML; the time step and the switch of its silent resets are set by `model`."""

    @property
    def model(self) -> Any:
        """The compiled `mujoco.MjModel`, made once for each system. Shared: copy it before you change it."""
        return _compiled(self)

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`; the action is the control of the model's actuators.

        Raises:
            TypeError: a torch tensor that asks for gradients.
        """
        xp = array_namespace(state)
        if is_torch_array(state) and (state.requires_grad or action.requires_grad):
            raise TypeError(
                f"{type(self).__name__} is computed by MuJoCo, through which torch cannot differentiate; "
                "use transition_derivatives(state, action) for its linearisation, or detach() the state and action"
            )
        moved = self.advance(to_numpy(state), to_numpy(action))
        return xp.asarray(moved, dtype=state.dtype, device=state.device)

    @abstractmethod
    def advance(self, state: Floats, action: Floats) -> Floats:
        """`flow` on numpy arrays: (..., n_state), (..., n_action) -> (..., n_state)."""

    def simulate(self, motion: Floats, control: Floats, models: Sequence[Any] | None = None) -> Floats:
        """One control period of MuJoCo.

        Args:
            motion: (..., nq + nv) joint positions and velocities, in rad or m and per s.
            control: (..., nu) of the actuators, held over the period; or (..., substeps, nu), one for each substep.
            models: one model for each row (all of one structure) instead of `model`.

        Returns:
            (..., nq + nv); NaN in the rows where MuJoCo diverged.
        """
        return self.simulate_and_sense(motion, control, models)[0]

    def simulate_and_sense(
        self, motion: Floats, control: Floats, models: Sequence[Any] | None = None
    ) -> tuple[Floats, Floats]:
        """As `simulate`, with what the model's sensors measured in the last substep.

        Returns:
            motion (..., nq + nv) and sensor data (..., nsensordata); NaN in the rows where MuJoCo diverged, or
            where the motion or control were not finite.
        """
        rows = np.ascontiguousarray(motion, dtype=np.float64).reshape(-1, motion.shape[-1])
        model = self.model
        lead = motion.shape[:-1]
        if not len(rows):
            return np.array(motion, dtype=np.float64), np.zeros((*lead, model.nsensordata))
        n_controls = self.substeps if np.ndim(control) > motion.ndim else 1
        controls = np.ascontiguousarray(control, dtype=np.float64).reshape(len(rows), n_controls, model.nu)
        # MuJoCo takes a control that is not a number for 0, and logs what it finds bad: such rows do not reach it
        good = np.asarray((np.abs(rows) < HUGE).all(axis=1))
        good &= (np.abs(controls) < HUGE).all(axis=(1, 2))
        if not good.all():
            rows = np.where(good[:, None], rows, 0.0)
            controls = np.where(good[:, None, None], controls, 0.0)
        with_time = np.concatenate([np.zeros((len(rows), 1)), rows], axis=1)
        n_threads = min(_n_threads(), max(1, len(rows) // ROWS_PER_THREAD))
        states, sensed = _pool(n_threads, os.getpid()).rollout(
            models if models is not None else model,
            _workspaces(self, n_threads, os.getpid()),
            with_time,
            controls,
            nstep=self.substeps,
        )
        end, sensed = states[:, -1], sensed[:, -1]
        # a rollout that diverges stops there, and gives a state from before that may be finite
        good &= (end[:, 0] > (self.substeps - 0.5) * model.opt.timestep) & (np.abs(end) < HUGE).all(axis=1)
        end[~good] = sensed[~good] = np.nan
        return end[:, 1:].reshape(motion.shape), sensed.reshape(*lead, model.nsensordata)

    def transition_derivatives(
        self, motion: ArrayLike, control: ArrayLike, model: Any = None
    ) -> tuple[Floats, Floats]:
        """MuJoCo's own linearisation of one control period, by finite differences (`mjd_transitionFD`).

            d motion' = A d motion + B d control,     A = product of the substeps' A_i

        Args:
            motion: (nq + nv,) one state.
            control: (nu,), or (substeps, nu); d control is the same in each substep.
            model: instead of the system's own.

        Returns:
            A (nq + nv, nq + nv) and B (nq + nv, nu).
        """
        model = self.model if model is None else model
        data = mujoco.MjData(model)
        motion = np.asarray(motion, dtype=np.float64)
        data.qpos[:], data.qvel[:] = motion[: model.nq], motion[model.nq :]
        n, m = 2 * model.nv, model.nu
        controls = np.broadcast_to(np.asarray(control, dtype=np.float64), (self.substeps, m))
        total_a, total_b = np.eye(n), np.zeros((n, m))
        a, b = np.zeros((n, n)), np.zeros((n, m))
        for row in controls:
            data.ctrl[:] = row
            mujoco.mjd_transitionFD(model, data, 1e-6, True, a, b, None, None)
            total_a, total_b = a @ total_a, a @ total_b + b
            mujoco.mj_step(model, data)
        return total_a, total_b


ROWS_PER_THREAD = 8  # fewer rows than this are not worth waking a thread
HUGE = 1e10  # MuJoCo's own mark of a number gone bad (mjMAXVAL)


def to_numpy(array: Array) -> Floats:
    """Any array-API array of numbers as float64 numpy.

    Raises:
        TypeError: a symbol, or another thing that holds no numbers.
    """
    if is_torch_array(array):
        array = array.detach().cpu().numpy()
    return np.asarray(array, dtype=np.float64)


@lru_cache(maxsize=32)
def _compiled(system: MujocoSystem) -> Any:
    spec = mujoco.MjSpec.from_string(system.mjcf())
    spec.option.timestep = system.dt / system.substeps
    # without this MuJoCo answers a diverged step with a silent reset to the model's initial state
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model = spec.compile()
    if model.nq != model.nv:
        raise ValueError(
            f"{type(system).__name__}: expected hinge and slide joints only, got ball or free ones"
        )
    if system.n_state < model.nq + model.nv:
        raise ValueError(
            f"{type(system).__name__}: expected a state that begins with {model.nq} positions and {model.nv} "
            f"velocities, got {system.n_state} components"
        )
    return model


def _n_threads() -> int:
    """Threads for batches: `BELIEFGYM_THREADS`, or the cores that this process may use.

    Raises:
        ValueError: the variable is not a whole number of at least 1.
    """
    wanted = os.environ.get("BELIEFGYM_THREADS")
    if wanted is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not wanted.isdigit() or int(wanted) < 1:
        raise ValueError(f"expected BELIEFGYM_THREADS as a whole number of at least 1, got {wanted!r}")
    return int(wanted)


@lru_cache(maxsize=8)
def _pool(n_threads: int, process: int) -> Any:
    """A thread pool of this process (threads do not survive a fork, so the process is a part of the key)."""
    return mujoco.rollout.Rollout(nthread=n_threads if n_threads > 1 else 0)


@lru_cache(maxsize=32)
def _workspaces(system: MujocoSystem, n_threads: int, process: int) -> list[Any]:
    return [mujoco.MjData(system.model) for _ in range(n_threads)]
