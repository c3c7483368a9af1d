"""`BeliefStack`: between a vector environment and an SB3 algorithm on beliefs, whose filter may change in the midst.

    StepRecorder -> BeliefObservation -> SB3VecEnv -> UnitActions -> VecNormalize -> the algorithm

When a new filter takes over, everything that holds a belief holds the new filter's from then on: the episodes that run,
what the algorithm is about to see, and every row of its replay buffer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from beliefgym.agents.sb3_agent import UnitActions
from beliefgym.agents.sb3_models import normalizer_moments, set_normalizer_moments
from beliefgym.agents.step_recorder import StepRecorder
from beliefgym.learning import BeliefTracker, Filter
from beliefgym.learning.belief_tracker import Show, shown
from beliefgym.wrappers.sb3 import SB3VecEnv
from beliefgym.wrappers.vector import BeliefObservation

Array = NDArray[np.float64]


class BeliefStack:
    """SB3's face of a vector environment, on beliefs.

    Args:
        env: with autoreset SAME_STEP; the recorder, where filters are to take over later.
        filter: fitted. show, include_observation: as of `BeliefObservation`.
        rescale_actions, normalize: as of `SB3Agent`. gamma: of the normalisation of rewards.

    Attributes:
        vec_env: for the algorithm. scaler, normalizer: its layers of that kind, or None.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: Filter,
        *,
        show: Show = "belief",
        include_observation: bool = True,
        rescale_actions: bool = False,
        normalize: bool = False,
        gamma: float = 0.99,
    ) -> None:
        self.show: Show = show
        self.include_observation = include_observation
        self.scaler: UnitActions | None = None
        self.normalizer: VecNormalize | None = None
        self._env, self._filter = env, filter
        self._dtype = env.single_observation_space.dtype
        self._belief_env = BeliefObservation(env, filter, include_observation, show=show)
        self._sb3_env = SB3VecEnv(self._belief_env)
        self.vec_env: VecEnv = self._sb3_env
        if rescale_actions:
            self.vec_env = self.scaler = UnitActions(self.vec_env)
        if normalize:
            self.vec_env = self.normalizer = VecNormalize(self.vec_env, gamma=gamma)

    def seen(self, observations: NDArray[Any], beliefs: Array) -> NDArray[Any]:
        """(.., n_obs) and (.., size) -> what the policy sees, in the observation's type, before any normalisation."""
        parts = [observations, beliefs] if self.include_observation else [beliefs]
        return np.concatenate(parts, axis=-1).astype(self._dtype)

    def normalized(self, seen: NDArray[Any]) -> NDArray[Any]:
        """What the policy is given of it."""
        return seen if self.normalizer is None else np.asarray(self.normalizer.normalize_obs(seen))

    def scaled(self, actions: NDArray[Any]) -> NDArray[Any]:
        """The policy's actions in the environment's units."""
        return actions if self.scaler is None else self.scaler.scale(actions)

    def note_moments(self, recorder: StepRecorder) -> None:
        """Take what was recorded into the moments of the normalisation, if there is one."""
        if self.normalizer is not None:
            assert isinstance(self.normalizer.obs_rms, RunningMeanStd)
            now, _ = self.seen_at_steps(recorder)
            self.normalizer.obs_rms.update(now.reshape(-1, now.shape[2]))

    def moments(self) -> bytes | None:
        """The moments of the normalisation, if there is one."""
        return None if self.normalizer is None else normalizer_moments(self.normalizer)

    def set_moments(self, moments: bytes | None) -> None:
        """The reverse of `moments`."""
        if self.normalizer is not None and moments is not None:
            set_normalizer_moments(self.normalizer, moments)

    def take_over(self, model: BaseAlgorithm, recorder: StepRecorder, filter: Filter) -> None:
        """Show this filter everywhere: in the environment, in the replay buffer, in what the model sees next."""
        self._filter, n = filter, recorder.num_envs
        running = recorder.running()
        tracker = BeliefTracker(filter, n, show=self.show)
        beliefs = tracker.catch_up(running)
        self._belief_env.transform.tracker = tracker  # type: ignore[attr-defined]
        seen = self.seen(running.observations[np.arange(n), running.lengths], beliefs)
        self._sb3_env._returns[:] = running.rewards.sum(axis=1)
        self._sb3_env._lengths[:] = running.lengths
        if self.normalizer is not None:
            since = running.lengths[:, None] - 1 - np.arange(running.n_steps)  # rewards past an end are 0
            discounts = self.normalizer.gamma ** np.maximum(since, 0)
            self.normalizer.returns = (discounts * running.rewards).sum(axis=1)
            self.normalizer.old_obs = model._last_original_obs = seen
        model._last_obs = self.normalized(seen)
        model._last_episode_starts = running.lengths == 0
        if isinstance(model, OffPolicyAlgorithm):
            self._fill(model, recorder)

    def seen_at_steps(self, recorder: StepRecorder) -> tuple[NDArray[Any], NDArray[Any]]:
        """What the policy sees at each recorded step, and after it in the same episode: (T, n, d) twice."""
        steps = recorder.steps()
        episodes, places = recorder.episodes()
        beliefs = shown(self._filter, episodes, show=self.show)
        t = np.arange(episodes.n_steps)
        inside = t < episodes.lengths[:, None]
        time_of = (places[:, :1] + t)[inside]
        copy_of = np.broadcast_to(places[:, 1:], inside.shape)[inside]
        now, later = (np.empty((*steps.rewards.shape, beliefs.shape[2])) for _ in range(2))
        now[time_of, copy_of], later[time_of, copy_of] = beliefs[:, :-1][inside], beliefs[:, 1:][inside]
        return self.seen(steps.observations, now), self.seen(steps.next_observations, later)

    def _fill(self, model: OffPolicyAlgorithm, recorder: StepRecorder) -> None:
        """Write the recorded steps into the replay buffer as SB3 would have, with the present filter's beliefs."""
        buffer = model.replay_buffer
        assert buffer is not None
        steps = recorder.steps()
        seen, following = self.seen_at_steps(recorder)
        n_steps, size = len(steps.rewards), buffer.buffer_size
        times = np.arange(max(0, n_steps - size), n_steps)
        places = times % size
        actions, space = steps.actions[times], self._env.single_action_space
        if isinstance(space, Box):  # SB3 keeps them in [-1, 1], whatever layers are above
            low, high = space.low.reshape(-1), space.high.reshape(-1)
            actions = 2.0 * ((actions - low) / (high - low)) - 1.0
        buffer.observations[places] = seen[times]
        buffer.next_observations[places] = following[times]
        buffer.actions[places] = actions
        buffer.rewards[places] = steps.rewards[times]
        buffer.dones[places] = (steps.terminated | steps.truncated)[times]
        if buffer.handle_timeout_termination:
            buffer.timeouts[places] = (steps.truncated & ~steps.terminated)[times]
        buffer.pos, buffer.full = n_steps % size, n_steps >= size
