"""`BeliefPolicy`: an SB3 algorithm on the belief of a learned filter, from nothing but a partially observed task.

    1   act at random for `explore_steps`, and fit the filter to these episodes
    2   train the algorithm on (x_t, belief); what was explored is in its replay buffer already
    3   every `refit_every` steps fit the filter anew to all episodes so far, those under the policy's own actions among
        them: dataset aggregation, as in DAgger, since a filter must hold where its policy goes

A refit keeps the coordinates of the first filter, so that the policy's inputs mean what they meant; every belief in the
replay buffer is computed anew from the recorded observations and actions, and so are those of the episodes that still
run. The policy that did best on episodes of its own (`evaluate_every`) is kept, with its filter.

With hints, privileged quantities that the environment tells in training only, the filter is fitted to estimate them. It
needs none afterwards.

References: thesis proposal, Secs. 3.3.3, 3.4 and 4.2; Ross, Gordon & Bagnell, "A reduction of imitation learning and
structured prediction to no-regret online learning", AISTATS 2011.
"""

from __future__ import annotations

import io
import tempfile
import time
import warnings
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from beliefgym.agents.agent import Agent, episode_starts, require_box
from beliefgym.agents.belief_filters import LEARNED, hint_of, new_filter, task_with_hints
from beliefgym.agents.evaluation import evaluate
from beliefgym.agents.hyperparameters import hyperparameters
from beliefgym.agents.sb3_agent import ALGORITHMS, UnitActions
from beliefgym.agents.sb3_models import algorithm_class, normalizer_moments, resolve, set_normalizer_moments
from beliefgym.agents.step_recorder import Hint, StepRecorder
from beliefgym.learning import BeliefTracker, Filter, load_filter, save_filter
from beliefgym.learning.belief_tracker import shown
from beliefgym.wrappers.components import component_names
from beliefgym.wrappers.sb3 import SB3VecEnv
from beliefgym.wrappers.task import Task
from beliefgym.wrappers.vector import BeliefObservation

Array = NDArray[np.float64]
VALIDATION_SHARE = 0.2  # of the recorded episodes, to choose among a filter's hypotheses
EVALUATION_SEED = 4_000_000  # of the episodes that choose the policy to keep


class BeliefMemory(NamedTuple):
    """What the policy remembers between two calls of `predict`: its filter's beliefs, and the actions it took."""

    tracker: BeliefTracker
    actions: NDArray[Any]


class BeliefPolicy(Agent):
    """Collects, fits a filter, trains an SB3 algorithm on its belief, and goes on.

    Args:
        task: the task or environment id, with a one-dimensional observation.
        seed: of everything random.
        algorithm: one of SB3's or sb3-contrib's by name: "SAC", "PPO", "TD3", "TQC", "A2C", "DDPG", "DQN", "CrossQ".
        filter: "psim", "psim-actions", "psim-hints" or "imf"; "auto" for psim-hints where the task offers hints, else
            psim-actions; "particle", "ukf" or "ekf" for one that knows the system (a ceiling).
        filter_options: settings of the filter, as plain data; see `beliefgym.agents.belief_filters`.
        explore_steps: steps of random actions before the first fit; they count.
        refit_every: steps between two fits of the filter; 0 for the first fit alone.
        n_refits: refits at most; None for any number.
        show: what the policy sees of the filter, "belief" or "hint" (its estimate).
        include_observation: let it see the latest observation too.
        evaluate_every: steps between two evaluations, of which the best policy is kept; 0 keeps the last one. Their
            episodes do not count as training steps (`evaluation_steps_` tells how many they were).
        evaluation_episodes: episodes of each.
        n_envs, normalize, rescale_actions, arguments: of the algorithm, as of `SB3Agent`; None for those that are usual
            on this environment.

    Attributes:
        filter_: the fitted filter. model: SB3's. history_: a dict for each fit and each evaluation.

    Raises:
        ValueError: an unknown algorithm or filter; hints asked of a task that offers none; an observation that is not
            one-dimensional; an algorithm that cannot act in the action space.

    Example:
        >>> agent = BeliefPolicy("beliefgym/PendulumPosition-v0", algorithm="SAC").learn(20_000)  # doctest: +SKIP
        >>> evaluate(agent, agent.task, 100).mean  # doctest: +SKIP
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        algorithm: str = "SAC",
        filter: str = "auto",
        filter_options: Mapping[str, Any] | None = None,
        explore_steps: int = 2000,
        refit_every: int = 5000,
        n_refits: int | None = None,
        show: str = "belief",
        include_observation: bool = True,
        evaluate_every: int = 0,
        evaluation_episodes: int = 20,
        n_envs: int | None = None,
        normalize: bool | None = None,
        rescale_actions: bool | None = None,
        arguments: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(task, seed)
        known = tuple(name for name in ALGORITHMS if name != "RecurrentPPO")
        if algorithm not in known:
            raise ValueError(f"expected algorithm to be one of {', '.join(known)}, got {algorithm!r}")
        if algorithm in ("SAC", "TD3", "DDPG", "TQC", "CrossQ"):
            require_box(self.action_space, algorithm)
        require_box(self.observation_space, "a belief")
        for name, value in (("explore_steps", explore_steps), ("refit_every", refit_every)):
            if isinstance(value, bool) or value < (name == "explore_steps"):
                raise ValueError(f"expected {name} to be a number of steps, got {value!r}")
        self._hinted = task_with_hints(self.task)
        if filter == "auto":
            filter = "psim-actions" if self._hinted is None else "psim-hints"
        if filter in ("psim-hints", "imf") and self._hinted is None:
            raise ValueError(
                f"expected a task that offers hints for the filter {filter!r}, and {self.task.label} offers none; take "
                "'psim-actions' or 'psim'"
            )
        usual = hyperparameters(algorithm, self.task.env_id)
        self.algorithm, self.filter, self.filter_options = algorithm, filter, dict(filter_options or {})
        self.explore_steps, self.refit_every, self.n_refits = explore_steps, refit_every, n_refits
        self.show, self.include_observation = show, include_observation
        self.evaluate_every, self.evaluation_episodes = evaluate_every, evaluation_episodes
        self.n_envs = usual.get("n_envs", 1) if n_envs is None else n_envs
        self.normalize = usual.get("normalize", False) if normalize is None else normalize
        self.rescale_actions = (
            usual.get("rescale_actions", False) if rescale_actions is None else rescale_actions
        )
        self.arguments = dict(usual.get("arguments", {}) if arguments is None else arguments)
        new_filter(self.filter, self.task, seed, self.filter_options)  # what is wrong with it is told now
        self.filter_: Filter | None = None
        self.model: BaseAlgorithm | None = None
        self.history_: list[dict[str, Any]] = []
        self.evaluation_steps_ = 0
        self._recorder: StepRecorder | None = None
        self._scaler: UnitActions | None = None
        self._normalizer: VecNormalize | None = None
        self._best: tuple[float, dict[str, Any]] | None = None
        self._next_refit, self._next_evaluation = refit_every, evaluate_every
        self._hint: Hint | None = None
        self._hint_names: tuple[str, ...] | None = None

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Train for this many further environment steps, those of exploring among them; see SB3's `learn`.

        A callback is called from the first step of the algorithm on.
        """
        explored = 0
        if self._recorder is None:
            if self.filter_ is not None:
                raise ValueError(
                    "expected an agent that has recorded its training, got one from a file, which only acts; train a "
                    "new one"
                )
            explored = self._begin(min(self.explore_steps, total_timesteps))
        assert self.model is not None
        ours = _Cadence(self)
        given = callback if isinstance(callback, list) else [] if callback is None else [callback]
        callbacks = [_as_callback(one) for one in given]
        if total_timesteps > explored:
            self.model.learn(
                total_timesteps - explored,
                callback=CallbackList([ours, *callbacks]),
                progress_bar=progress_bar,
                reset_num_timesteps=False,
            )
        if self.evaluate_every:
            ours.evaluate()
        self._recall_best()
        return self

    def predict(
        self,
        observation: NDArray[Any],
        state: BeliefMemory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], BeliefMemory | None]:
        """See `Agent.predict`; the state holds beliefs. Before any training actions are drawn at random."""
        observation, single = self.batched(observation)
        n = len(observation)
        if self.model is None or self.filter_ is None:
            drawn = np.stack([self.action_space.sample() for _ in range(n)])
            return (drawn[0] if single else drawn), None
        starts = episode_starts(state, episode_start, n)
        tracker = BeliefTracker(self.filter_, n, show=self.show) if state is None else state.tracker.fork()  # type: ignore[arg-type]
        beliefs = np.zeros((n, tracker.size))
        if starts.any():
            beliefs[starts] = tracker.begin(observation, starts)[starts]
        if state is not None and not starts.all():
            beliefs[~starts] = tracker.go_on(observation, state.actions, ~starts)[~starts]
        seen = self._beside(observation, beliefs)
        if self._normalizer is not None:
            seen = np.asarray(self._normalizer.normalize_obs(seen))
        action, _ = self.model.predict(seen, deterministic=deterministic)
        if self._scaler is not None:
            action = self._scaler.scale(action)
        return (action[0] if single else action), BeliefMemory(tracker, action.reshape(n, -1))

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        names = (
            *("algorithm", "filter", "filter_options", "explore_steps", "refit_every", "n_refits", "show"),
            *("include_observation", "evaluate_every", "evaluation_episodes", "n_envs", "normalize"),
            *("rescale_actions", "arguments"),
        )
        return {name: getattr(self, name) for name in names}

    def parts(self) -> dict[str, bytes]:
        """SB3's own zip file, the filter in its own format, and the running moments of the normalisation.

        Raises:
            ValueError: not trained. TypeError: a filter that knows its system, which is not saved.
        """
        if self.model is None or self.filter_ is None:
            raise ValueError("expected a trained agent to save; call learn first")
        if self.filter not in LEARNED:
            raise TypeError(
                f"expected a learned filter ({', '.join(LEARNED)}) to save an agent, got {self.filter!r}"
            )
        model = io.BytesIO()
        self.model.save(model)
        with tempfile.TemporaryDirectory() as folder:
            path = save_filter(self.filter_, Path(folder) / "filter.safetensors")
            parts = {"model.zip": model.getvalue(), "filter.safetensors": path.read_bytes()}
        if self._normalizer is not None:
            parts["normalisation.npz"] = normalizer_moments(self._normalizer)
        return parts

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`. SB3's file holds pickled fields: open only files that you trust.

        The agent acts as the saved one; its recorded steps are not in the file, so that it does not learn on.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "filter.safetensors"
            path.write_bytes(parts["filter.safetensors"])
            self.filter_ = load_filter(path)
        if self.model is None:
            env = self._on_beliefs(self.task.make_vec(1))
            self.model = algorithm_class(self.algorithm).load(
                io.BytesIO(parts["model.zip"]), env=env, device="cpu"
            )
        else:
            self.model.set_parameters(io.BytesIO(parts["model.zip"]), device="cpu")  # type: ignore[arg-type]
        if self._normalizer is not None:
            set_normalizer_moments(self._normalizer, parts["normalisation.npz"])

    def _begin(self, explore_steps: int) -> int:
        """Explore, fit the filter, and make the model; the steps that were taken."""
        needs_hints = self.filter in ("psim-hints", "imf") or self.filter not in LEARNED
        hinted = self._hinted if needs_hints else None
        if hinted is not None:
            self._hint, self._hint_names = hint_of(self.task)
        env = (hinted or self.task).make_vec(self.n_envs)
        self._names = {"observation_names": component_names(env), "hint_names": self._hint_names}
        recorder = self._recorder = StepRecorder(env, keeps_hints=hinted is not None)
        recorder.reset(seed=self.seed)
        recorder.action_space.seed(self.seed)
        while recorder.n_recorded * self.n_envs < explore_steps:
            recorder.step(recorder.action_space.sample())
        self._fit_filter()
        stack = self._on_beliefs(recorder)
        arguments = resolve(self.arguments)
        is_off_policy = issubclass(algorithm_class(self.algorithm), OffPolicyAlgorithm)
        if is_off_policy:
            arguments["learning_starts"] = 0  # what was explored is in the buffer
        self.model = algorithm_class(self.algorithm)(env=stack, seed=self.seed, device="cpu", **arguments)
        explored = self.model.num_timesteps = self._steps_taken
        if self.refit_every:
            self._next_refit = (explored // self.refit_every + 1) * self.refit_every
        self._take_over()
        return explored

    @property
    def _steps_taken(self) -> int:
        """Environment steps of training so far."""
        return 0 if self._recorder is None else self._recorder.n_recorded * self.n_envs

    def _on_beliefs(self, env: Any) -> VecEnv:
        """SB3's face of a vector environment, on beliefs."""
        assert self.filter_ is not None
        self._belief_env = BeliefObservation(env, self.filter_, self.include_observation, show=self.show)  # type: ignore[arg-type]
        stack: VecEnv = SB3VecEnv(self._belief_env)
        self._sb3_env = stack
        if self.rescale_actions:
            stack = self._scaler = UnitActions(stack)
        if self.normalize:
            stack = self._normalizer = VecNormalize(stack, gamma=self.arguments.get("gamma", 0.99))
        return stack

    def _fit_filter(self) -> None:
        """Fit the filter to all episodes so far, in the coordinates of the last one."""
        assert self._recorder is not None
        started = time.perf_counter()
        episodes, _ = self._recorder.episodes(self._hint, **self._names)
        fresh = new_filter(self.filter, self.task, self.seed, self.filter_options)
        if self.filter in LEARNED and self.filter_ is not None:
            fresh.keep_coordinates(self.filter_)
        rng = np.random.default_rng([self.seed, len(self.history_)])
        held = rng.permutation(len(episodes)) < max(1, round(VALIDATION_SHARE * len(episodes)))
        train, validation = (episodes[~held], episodes[held]) if len(episodes) > 1 else (episodes, None)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*trajectories have fewer than.*")
            fresh.fit(train, validation)
        self.filter_ = fresh
        self.history_.append(
            {
                "what": "fit",
                "step": self._steps_taken,
                "episodes": len(episodes),
                "seconds": time.perf_counter() - started,
                "best_iteration": getattr(fresh, "best_iteration_", None),
            }
        )

    def _take_over(self) -> None:
        """Show the present filter everywhere: in the environment, in the replay buffer, in what is seen next."""
        model, recorder, filter = self.model, self._recorder, self.filter_
        assert model is not None
        assert recorder is not None
        assert filter is not None
        transform = self._belief_env.transform
        transform.tracker = BeliefTracker(filter, self.n_envs, show=self.show)  # type: ignore[attr-defined, arg-type]
        running = recorder.running()
        beliefs = transform.tracker.catch_up(running)  # type: ignore[attr-defined]
        now = running.observations[np.arange(self.n_envs), running.lengths]
        seen = self._beside(now, beliefs)
        self._sb3_env._returns[:], self._sb3_env._lengths[:] = 0.0, running.lengths  # type: ignore[attr-defined]
        if self._normalizer is not None:
            model._last_original_obs = seen
            if not self.history_ or len(self.history_) == 1:
                self._normalizer.obs_rms.update(self._all_seen()[0].reshape(-1, seen.shape[1]))  # type: ignore[union-attr]
            self._normalizer.returns = np.zeros(self.n_envs)
            self._normalizer.old_obs = seen
            seen = np.asarray(self._normalizer.normalize_obs(seen))
        model._last_obs = seen
        model._last_episode_starts = running.lengths == 0
        if isinstance(model, OffPolicyAlgorithm):
            self._fill(model)

    def _fill(self, model: OffPolicyAlgorithm) -> None:
        """Write the recorded steps into the replay buffer, with the present filter's beliefs."""
        buffer, recorder = model.replay_buffer, self._recorder
        assert type(buffer) is ReplayBuffer
        assert recorder is not None
        steps = recorder.steps()
        seen, following = self._all_seen()
        n_steps, size = len(steps.rewards), buffer.buffer_size
        times = np.arange(max(0, n_steps - size), n_steps)
        places = times % size
        actions = steps.actions[times]
        if isinstance(model.action_space, Box):
            space = model.action_space
            shaped = actions.reshape(-1, *space.shape)
            actions = model.policy.scale_action(shaped).reshape(len(times), self.n_envs, -1)
        ended = steps.terminated | steps.truncated
        buffer.observations[places] = seen[times].reshape(len(times), *buffer.observations.shape[1:])
        buffer.next_observations[places] = following[times].reshape(
            len(times), *buffer.next_observations.shape[1:]
        )
        buffer.actions[places] = actions.reshape(len(times), *buffer.actions.shape[1:])
        buffer.rewards[places] = steps.rewards[times]
        buffer.dones[places] = ended[times]
        buffer.timeouts[places] = (steps.truncated & ~steps.terminated)[times]
        buffer.pos, buffer.full = n_steps % size, n_steps >= size

    def _all_seen(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """What the policy sees at each recorded step, and after it in the same episode: (T, n, d) twice."""
        recorder, filter = self._recorder, self.filter_
        assert recorder is not None
        assert filter is not None
        steps = recorder.steps()
        episodes, places = recorder.episodes()
        beliefs = shown(filter, episodes, show=self.show)  # type: ignore[arg-type]
        t = np.arange(episodes.n_steps)
        inside = t < episodes.lengths[:, None]
        start, copy_ = places[:, :1], np.broadcast_to(places[:, 1:], inside.shape)
        time_of = (start + t)[inside]
        copy_of = copy_[inside]
        now, later = (np.empty((*steps.rewards.shape, beliefs.shape[2])) for _ in range(2))
        now[time_of, copy_of], later[time_of, copy_of] = beliefs[:, :-1][inside], beliefs[:, 1:][inside]
        return self._beside(steps.observations, now), self._beside(steps.next_observations, later)

    def _beside(self, observations: NDArray[Any], beliefs: Array) -> NDArray[Any]:
        """(.., n_obs) and (.., size) -> what the policy sees, in the observation's type."""
        dtype = self.observation_space.dtype
        parts = [observations, beliefs] if self.include_observation else [beliefs]
        return np.concatenate(parts, axis=-1).astype(dtype)

    def _evaluated(self) -> None:
        """Evaluate, and keep the policy and its filter where they are the best so far."""
        assert self.model is not None
        result = evaluate(self, self.task, self.evaluation_episodes, seed=EVALUATION_SEED)
        self.evaluation_steps_ += int(result.lengths.sum())
        self.history_.append({"what": "evaluation", "step": self._steps_taken, "mean_return": result.mean})
        if self._best is None or result.mean > self._best[0]:
            self._best = result.mean, self._snapshot()

    def _snapshot(self) -> dict[str, Any]:
        assert self.model is not None
        moments = None if self._normalizer is None else normalizer_moments(self._normalizer)
        parameters = deepcopy(self.model.get_parameters())
        return {"model": parameters, "filter": self.filter_, "moments": moments}

    def _recall_best(self) -> None:
        """Take the best policy and its filter."""
        if self._best is None:
            return
        assert self.model is not None
        kept: dict[str, Any] = self._best[1]
        self.model.set_parameters(kept["model"], device="cpu")
        if kept["filter"] is not self.filter_:
            self.filter_ = kept["filter"]
            self._take_over()
        if self._normalizer is not None:
            set_normalizer_moments(self._normalizer, kept["moments"])


class _Cadence(BaseCallback):
    """Refits and evaluates between two rollouts, where they are due."""

    def __init__(self, agent: BeliefPolicy) -> None:
        super().__init__()
        self._agent = agent

    def _on_rollout_start(self) -> None:
        agent, step = self._agent, self._agent._steps_taken
        if agent.evaluate_every and step >= agent._next_evaluation:
            agent._next_evaluation = (step // agent.evaluate_every + 1) * agent.evaluate_every
            agent._evaluated()
        n_fits = sum(entry["what"] == "fit" for entry in agent.history_)
        may = agent.filter in LEARNED and (agent.n_refits is None or n_fits <= agent.n_refits)
        if may and agent.refit_every and step >= agent._next_refit:
            agent._next_refit = (step // agent.refit_every + 1) * agent.refit_every
            agent._fit_filter()
            agent._take_over()

    def evaluate(self) -> None:
        """At the end."""
        self._agent._evaluated()

    def _on_step(self) -> bool:
        return True


def _as_callback(callback: Any) -> BaseCallback:
    if isinstance(callback, BaseCallback):
        return callback
    from stable_baselines3.common.callbacks import ConvertCallback

    return ConvertCallback(callback)
