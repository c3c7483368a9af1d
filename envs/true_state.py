"""What every beliefgym environment offers, for Gymnasium's own MuJoCo tasks: `TrueState` goes before their class.

    class HopperEnv(TrueState, gymnasium.envs.mujoco.hopper_v5.HopperEnv): ...

The physics, rewards, ends, seeds and infos stay Gymnasium's to the last bit. Added are the true state (read, set as a
start, given as a hint), errors instead of silent nonsense, pickling in the middle of an episode, the trained reference
policy as an expert, and a picture that needs no graphics driver.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from numpy.typing import NDArray

from beliefgym.envs.env import RENDER_MODES
from beliefgym.envs.joint_names import joint_names, observation_names
from beliefgym.envs.planar_picture import View, planar_picture
from beliefgym.envs.reference_policies import ReferenceController, reference_policy
from beliefgym.envs.simulation import NonFiniteError, start_state

Floats = NDArray[np.float64]
_PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION
_KEPT = (
    "spec",
    "action_space",
    "observation_space",
    "_np_random",
    "_np_random_seed",
    "_steps",
    "_last_action",
    "_needs_reset",
)


class TrueState(MujocoEnv):
    """Mixin for Gymnasium's MuJoCo tasks (v5) whose state is (qpos, qvel).

    MuJoCo starts its constraint solver from the last step's forces, which are no part of (qpos, qvel): an episode that
    starts from a state in the middle of another goes on as that one did to the solver's tolerance, not to the last bit.

    Args:
        hint: put the true state into `info["hint"]`; for training only.
        shown: names or patterns of the observation components that the picture marks as seen by the agent, all by
            default. It hides nothing: that is for `PartialObservation`, which the registered ids have around this.
        render_mode: None, "rgb_array" or "human".
        **parameters: of Gymnasium's class by name; an unknown one is an error.
    """

    reference: ClassVar[str]
    velocity_limit: ClassVar[float] = np.inf
    view: ClassVar[View]

    def __init__(
        self,
        *,
        hint: bool = False,
        shown: str | Sequence[str] = ("*",),
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"expected render_mode None or one of {RENDER_MODES}, got {render_mode!r}")
        self._arguments = {"hint": hint, "shown": shown, "render_mode": render_mode, **parameters}
        self._hint = hint
        self._patterns = [shown] if isinstance(shown, str) else list(shown)
        self._given: Floats | None = None
        self._last_action: Floats | None = None
        self._steps = 0
        self._needs_reset = True
        self._window: Any = None
        with _without_known_warnings():
            super().__init__(render_mode=render_mode, **parameters)  # type: ignore[call-arg]
        # without this MuJoCo answers a diverged step with a silent reset to the model's initial state
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.metadata = {"render_modes": RENDER_MODES, "render_fps": round(1.0 / self.dt)}
        positions, velocities = joint_names(self.model)
        self._state_names = (*positions, *velocities)
        self._action_names = _motor_names(self.model)

    @property
    def state(self) -> Floats:
        """(nq + nv,) the true state: joint positions, then velocities; a copy."""
        return np.concatenate([self.data.qpos, self.data.qvel])

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the components of the true state."""
        return self._state_names

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the components of Gymnasium's full observation."""
        return tuple(observation_names(self.model, self.observation_structure))  # type: ignore[attr-defined]

    @property
    def hint_names(self) -> tuple[str, ...] | None:
        """Names of the hint's components, if hints were asked for."""
        return self.state_names if self._hint else None

    @property
    def action_names(self) -> tuple[str, ...]:
        """`torque_<joint>` or `force_<joint>` of each motor."""
        return self._action_names

    @property
    def expert_kind(self) -> str:
        """What `expert` gives, in a few words."""
        return self.expert().kind

    def expert(self) -> ReferenceController:
        """The trained full-state policy of this task, as a controller `act(state, restart)`.

        Raises:
            ValueError: another model (`xml_file`), which it was not trained on.
        """
        policy, skipped = reference_policy(self.reference), len(self.state) - len(self._seen_in_training())
        if len(policy.mean) != len(self._seen_in_training()):
            raise ValueError(
                f"{self._name()}: the reference policy of {self.reference} takes {len(policy.mean)} components, this "
                f"model gives {len(self._seen_in_training())}; there is none for a model of your own"
            )
        return ReferenceController(policy, self.model.nq, skipped, self.velocity_limit)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`. Option "state": the true start state (nq + nv,).

        Raises:
            ValueError: a start state of the wrong shape, not finite, or one where the episode is over.
        """
        given = start_state(options, self._name())
        self._given = None if given is None else self._checked_state(given)
        self._last_action = None
        self._steps = 0
        self._needs_reset = False
        observation, info = super().reset(seed=seed)
        self._given = None
        return observation, self._with_hint(info)

    def reset_model(self) -> Floats:
        """Gymnasium's start, or the given one."""
        if self._given is None:
            return super().reset_model()
        self.set_state(*np.split(self._given, [self.model.nq]))
        observation: Floats = self._get_obs()  # type: ignore[attr-defined]
        return observation

    def step(self, action: Any) -> tuple[Floats, Any, bool, bool, dict[str, Any]]:
        """One control period; see `gymnasium.Env.step`.

        Raises:
            ValueError: an action of the wrong shape, or not finite.
            NonFiniteError: the simulation diverged.
        """
        if self._needs_reset:
            raise gym.error.ResetNeeded(f"{self._name()}: step before reset; call reset() first")
        action = self._checked_action(action)
        before = self.state
        self._last_action = np.clip(action, self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]
        observation, reward, terminated, truncated, info = super().step(action)
        self._steps += 1
        if not np.isfinite(self.state).all():
            self._tell_divergence(before, action)
        return observation, reward, bool(terminated), truncated, self._with_hint(info)

    def over(self) -> bool:
        """Whether the present state ends an episode."""
        return False

    def render(self) -> NDArray[np.uint8] | None:
        """The picture (480, 720, 3) in mode "rgb_array"; shown in a window in mode "human"."""
        if self.render_mode is None:
            gym.logger.warn(
                'render() without a render_mode; make the environment with render_mode="rgb_array"'
            )
            return None
        values = dict(zip(self.observation_names, self._get_obs(), strict=True))  # type: ignore[attr-defined]
        seen = {name for name in values if any(fnmatchcase(name, pattern) for pattern in self._patterns)}
        action = self._last_action
        frame = planar_picture(
            self.reference,
            self.model,
            self.data.qpos,
            self.view,
            {name: value if name in seen else None for name, value in values.items()},
            {name: None if action is None else float(action[i]) for i, name in enumerate(self.action_names)},
        )
        if self.render_mode == "rgb_array":
            return frame
        if self._window is None:
            from beliefgym.envs.rendering import Window

            self._window = Window(self.reference)
        self._window.show(frame, self.metadata["render_fps"])
        return None

    def close(self) -> None:
        """Close the window, if one is open."""
        if self._window is not None:
            self._window.close()
            self._window = None
        super().close()

    def _seen_in_training(self) -> list[str]:
        """Names of Gymnasium's full observation with its default arguments: without the places of the root."""
        roots = {"rootx", "slider1", "slider2"}
        return [name for name in self.state_names if name not in {f"qpos_{root}" for root in roots}]

    def _name(self) -> str:
        return self.reference if self.spec is None else self.spec.id

    def _with_hint(self, info: dict[str, Any]) -> dict[str, Any]:
        return {**info, "hint": self.state} if self._hint else info

    def _checked_state(self, state: Any) -> Floats:
        array = np.array(state, dtype=np.float64)
        names = self.state_names
        if array.shape != (len(names),):
            raise ValueError(
                f"{self._name()}: expected a start state of shape {(len(names),)} ({', '.join(names)}), "
                f"got {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{self._name()}: expected a finite start state, got {array.tolist()}")
        running = self.state
        try:
            self.data.qpos[:], self.data.qvel[:] = np.split(array, [self.model.nq])
            impossible = self.over()
        finally:
            self.data.qpos[:], self.data.qvel[:] = np.split(running, [self.model.nq])
        if impossible:
            raise ValueError(
                f"{self._name()}: impossible start state of copy 0: the episode would already be over there "
                f"(state: {array.tolist()})"
            )
        return array

    def _checked_action(self, action: Any) -> NDArray[Any]:
        array = np.asarray(action)
        names = self.action_names
        if array.shape != (len(names),):
            raise ValueError(
                f"{self._name()}: expected an action of shape {(len(names),)} ({', '.join(names)}), "
                f"got shape {array.shape}"
            )
        if not np.isfinite(array).all():
            worst = int(np.argmin(np.isfinite(array)))
            value = "NaN" if np.isnan(array[worst]) else "infinite"
            raise ValueError(
                f"{self._name()}: action {names[worst]!r} of copy 0 is {value} at step {self._steps + 1} of its "
                "episode; look at what produced it (a diverged policy, a 0/0)"
            )
        return array

    def _tell_divergence(self, before: Floats, action: NDArray[Any]) -> None:
        state = self.state
        worst = int(np.argmin(np.isfinite(state)))
        self._needs_reset = True
        raise NonFiniteError(
            f"{self._name()}: state {self.state_names[worst]!r} of copy 0 became {state[worst]} at step {self._steps} "
            f"of its episode (state before: {before.tolist()}, action: {action.tolist()}); reset() starts anew"
        )

    def __getstate__(self) -> dict[str, Any]:
        physics = np.empty(mujoco.mj_stateSize(self.model, _PHYSICS))
        mujoco.mj_getState(self.model, self.data, physics, _PHYSICS)
        kept = {name: self.__dict__[name] for name in _KEPT if name in self.__dict__}
        return {"arguments": self._arguments, "physics": physics, "kept": kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        type(self).__init__(self, **state["arguments"])
        mujoco.mj_setState(self.model, self.data, state["physics"], _PHYSICS)
        self.__dict__.update(state["kept"])


def _motor_names(model: Any) -> tuple[str, ...]:
    joints = [model.joint(int(i)) for i in model.actuator_trnid[:, 0]]
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    return tuple(f"{'force' if int(joint.type[0]) == slide else 'torque'}_{joint.name}" for joint in joints)


@contextmanager
def _without_known_warnings() -> Iterator[None]:
    """Keep quiet about what MuJoCo has against Gymnasium's own model files; other warnings go on to the screen."""

    def tell(message: str) -> None:
        if "settotalmass" not in message:
            gym.logger.warn(message)

    mujoco.set_mju_user_warning(tell)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)
