"""Stable-Baselines3's algorithms, as they are, in the face that every beliefgym agent has.

What SB3 leaves outside a model (stacking of frames, normalisation, the scale of actions) is part of the agent here:
it trains through SB3's own VecNormalize and VecFrameStack, and `predict` repeats the same on raw observations, so
that a saved agent is one file and `evaluate_policy(agent, env)` works on the plain environment. A stack of frames is
then a memory, and travels in `predict`'s state as an LSTM's does.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from beliefgym.agents.agent import Agent, episode_starts, require_box
from beliefgym.agents.sb3_log_probs import draw_with_log_prob, log_half_widths, refuse_deterministic
from beliefgym.agents.sb3_models import algorithm_class, normalizer_moments, resolve, set_normalizer_moments
from beliefgym.wrappers.sb3 import SB3VecEnv
from beliefgym.wrappers.task import Task

ALGORITHMS = ("PPO", "A2C", "SAC", "TD3", "DDPG", "DQN", "RecurrentPPO", "TQC", "CrossQ")
_CONTINUOUS = ("SAC", "TD3", "DDPG", "TQC", "CrossQ")


class Memory(NamedTuple):
    """What an SB3 agent remembers between two calls of `predict`."""

    stack: NDArray[Any] | None
    recurrent: Any


class _Shown(NamedTuple):
    """What the model is shown in one call."""

    observation: NDArray[Any]
    starts: NDArray[np.bool_]
    stack: NDArray[Any] | None
    recurrent: Any


class UnitActions(VecEnvWrapper):
    """Actions in [-1, 1], mapped onto the box of the environment.

    Args:
        venv: an SB3 vector environment with a bounded Box action space.

    Raises:
        ValueError: the action space has no bounds.
    """

    def __init__(self, venv: VecEnv) -> None:
        space = require_box(venv.action_space, "rescale_actions")
        if not space.is_bounded():
            raise ValueError(f"rescale_actions needs a bounded action space, got {space}")
        self.low, self.high = space.low, space.high
        super().__init__(venv, action_space=Box(-1.0, 1.0, space.shape, np.float32))

    def scale(self, actions: NDArray[Any]) -> NDArray[Any]:
        """[-1, 1] -> [low, high]."""
        return self.low + 0.5 * (actions + 1.0) * (self.high - self.low)

    @property
    def log_stretch(self) -> float:
        """log |det| of `scale`: what the log density of an action loses by it."""
        return log_half_widths(self.low, self.high)

    def reset(self) -> VecEnvObs:
        """Pass on."""
        return self.venv.reset()

    def step_async(self, actions: NDArray[Any]) -> None:
        """Scale and pass on."""
        self.venv.step_async(self.scale(actions))

    def step_wait(self) -> VecEnvStepReturn:
        """Pass on."""
        return self.venv.step_wait()


class SB3Agent(Agent):
    """One of SB3's or sb3-contrib's algorithms.

    Args:
        task: the task or environment id.
        seed: seed of the algorithm and its training environments.
        algorithm: one of `ALGORITHMS`.
        n_envs: copies of the environment that experience is collected from.
        n_stack: frames shown at once; 1 shows the observation alone. Zeros stand before an episode's start.
        normalize: running normalisation of observations and rewards (VecNormalize).
        rescale_actions: let the policy act in [-1, 1] (PPO and A2C; the off-policy algorithms do so themselves).
        arguments: the algorithm's own arguments; `policy_kwargs["activation_fn"]` by name ("relu"), a schedule as
            "linear:1e-3" (falling to 0).
        tensorboard_log: folder for TensorBoard, in SB3's layout; None for none.

    Raises:
        ValueError: an unknown algorithm, an action space that it cannot act in, or an observation that cannot be
            stacked.
    """

    explores_always = False  # so that `collect(..., deterministic=True)` asks `predict`

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        algorithm: str = "PPO",
        n_envs: int = 1,
        n_stack: int = 1,
        normalize: bool = False,
        rescale_actions: bool = False,
        arguments: Mapping[str, Any] | None = None,
        tensorboard_log: str | None = None,
    ) -> None:
        super().__init__(task, seed)
        if algorithm not in ALGORITHMS:
            raise ValueError(f"expected algorithm to be one of {', '.join(ALGORITHMS)}, got {algorithm!r}")
        if algorithm in _CONTINUOUS and not isinstance(self.action_space, Box):
            raise ValueError(
                f"{algorithm} acts in a Box of continuous actions, but {self.task.label} has {self.action_space}; "
                "take PPO, A2C, RecurrentPPO or DQN"
            )
        if algorithm == "DQN" and not isinstance(self.action_space, Discrete):
            raise ValueError(
                f"DQN chooses among finitely many actions, but {self.task.label} has {self.action_space}; put "
                "DiscreteActions around it "
                f'(Task("{self.task.env_id}", wrappers=(("DiscreteActions", {{"bins": 5}}),))), or take SAC'
            )
        if n_stack > 1:
            require_box(self.observation_space, "a stack of frames")
        self.algorithm = algorithm
        self.n_envs = n_envs
        self.n_stack = n_stack
        self.normalize = normalize
        self.rescale_actions = rescale_actions
        self.arguments = dict(arguments or {})
        self.tensorboard_log = tensorboard_log
        self._learned = False
        env, self._scaler, self._normalizer = self._training_env(n_envs)
        self.model: BaseAlgorithm = algorithm_class(algorithm)(
            env=env, seed=seed, device="cpu", tensorboard_log=tensorboard_log, **resolve(self.arguments)
        )

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Train for this many further environment steps; see SB3's `learn`."""
        self.model.learn(
            total_timesteps,
            callback=callback,
            progress_bar=progress_bar,
            reset_num_timesteps=not self._learned,
            tb_log_name=self.registered_name or self.algorithm,
        )
        self._learned = True
        return self

    def predict(
        self,
        observation: NDArray[Any],
        state: Memory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Memory]:
        """See `Agent.predict`; the state holds the stacked frames and the LSTM's state."""
        shown, single = self._shown(observation, state, episode_start)
        action, recurrent = self.model.predict(
            shown.observation, state=shown.recurrent, episode_start=shown.starts, deterministic=deterministic
        )
        if self._scaler is not None:
            action = self._scaler.scale(action)
        return (action[0] if single else action), Memory(shown.stack, recurrent)

    def predict_with_log_prob(
        self,
        observation: NDArray[Any],
        state: Memory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Memory, NDArray[np.float64]]:
        """Draw actions, as `predict` takes its arguments, and tell their log-probabilities.

        The density is in the environment's units, of the action that is returned. PPO's and A2C's Gaussian actions
        are returned unclipped; see sb3_log_probs.py for this and for every formula.

        Returns:
            action of one copy or (n, ...), the state for the next call, the log-probability, () or (n,).

        Raises:
            ValueError: deterministic=True, or TD3 or DDPG, whose actions have no density.
        """
        refuse_deterministic(deterministic)
        shown, single = self._shown(observation, state, episode_start)
        action, recurrent, log_prob = draw_with_log_prob(
            self.model, shown.observation, shown.recurrent, shown.starts
        )
        if self._scaler is not None:
            action = self._scaler.scale(action)
            log_prob = log_prob - self._scaler.log_stretch
        if single:
            action, log_prob = action[0], log_prob[0]
        return action, Memory(shown.stack, recurrent), log_prob

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        return {
            "algorithm": self.algorithm,
            "n_envs": self.n_envs,
            "n_stack": self.n_stack,
            "normalize": self.normalize,
            "rescale_actions": self.rescale_actions,
            "arguments": self.arguments,
        }

    def parts(self) -> dict[str, bytes]:
        """SB3's own zip file, and the running moments of the normalisation."""
        model = io.BytesIO()
        self.model.save(model)
        parts = {"model.zip": model.getvalue()}
        if self._normalizer is not None:
            parts["normalisation.npz"] = normalizer_moments(self._normalizer)
        return parts

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`. SB3's file holds pickled fields: open only files that you trust."""
        env = self.model.get_env()
        self.model = algorithm_class(self.algorithm).load(
            io.BytesIO(parts["model.zip"]), env=env, device="cpu"
        )
        self._learned = True
        if self._normalizer is not None:
            set_normalizer_moments(self._normalizer, parts["normalisation.npz"])

    def _training_env(self, n_envs: int) -> tuple[VecEnv, UnitActions | None, VecNormalize | None]:
        env: VecEnv = SB3VecEnv(self.task.make_vec(n_envs))
        scaler = normalizer = None
        if self.rescale_actions:
            env = scaler = UnitActions(env)
        if self.normalize:
            env = normalizer = VecNormalize(env, gamma=self.arguments.get("gamma", 0.99))
        if self.n_stack > 1:
            env = VecFrameStack(env, self.n_stack)
        return env, scaler, normalizer

    def _shown(
        self, observation: NDArray[Any], state: Memory | None, episode_start: NDArray[np.bool_] | None
    ) -> tuple[_Shown, bool]:
        """What the model sees of raw observations: a batch, normalised and stacked; and whether it was of one copy."""
        observation, single = self.batched(observation)
        starts = episode_starts(state, episode_start, len(observation))
        if self._normalizer is not None:
            observation = np.asarray(self._normalizer.normalize_obs(observation))
        stack = None
        if self.n_stack > 1:
            stack = self._push(None if state is None else state.stack, observation, starts)
            observation = stack
        return _Shown(observation, starts, stack, None if state is None else state.recurrent), single

    def _push(
        self, stack: NDArray[Any] | None, observation: NDArray[Any], starts: NDArray[np.bool_]
    ) -> NDArray[Any]:
        """(n, n_stack * d), oldest frame first, as VecFrameStack lays it out."""
        size = observation.shape[1]
        if stack is None:
            older = np.zeros((len(observation), (self.n_stack - 1) * size), dtype=observation.dtype)
        else:
            older = np.where(starts[:, None], 0.0, stack[:, size:]).astype(observation.dtype)
        return np.concatenate([older, observation], axis=1)
