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
import time
from collections.abc import Mapping
from copy import deepcopy
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from beliefgym.agents.agent import Agent, episode_starts, require_box
from beliefgym.agents.belief_filters import (
    LEARNED,
    drawn_within,
    filter_from_bytes,
    filter_to_bytes,
    fit_with_validation,
    hint_of,
    new_filter,
    task_with_hints,
    usual_filter,
)
from beliefgym.agents.belief_settings import check_algorithm, check_replay_buffer, check_schedule, check_show
from beliefgym.agents.belief_stack import BeliefStack
from beliefgym.agents.between_rollouts import BetweenRollouts
from beliefgym.agents.evaluation import evaluate
from beliefgym.agents.hyperparameters import hyperparameters
from beliefgym.agents.sb3_models import algorithm_class, resolve
from beliefgym.agents.step_recorder import Hint, StepRecorder
from beliefgym.learning import BeliefTracker, Filter
from beliefgym.wrappers.components import component_names
from beliefgym.wrappers.task import Task

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
        refit_growth: each fit comes at least so many times as late as the one before, since ever more data change a
            filter ever less.
        max_fit_steps: steps that a filter is fitted to at most; of more, whole episodes are drawn.
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
        refit_growth: float = 1.5,
        max_fit_steps: int = 50_000,
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
        require_box(self.observation_space, "a belief")
        schedule = {
            "explore_steps": explore_steps,
            "refit_every": refit_every,
            "max_fit_steps": max_fit_steps,
        }
        schedule |= {"evaluate_every": evaluate_every, "evaluation_episodes": evaluation_episodes}
        check_schedule(refit_growth, **schedule, n_refits=n_refits, n_envs=n_envs)
        self._hinted = task_with_hints(self.task)
        filter = usual_filter(self.task, self._hinted, filter)
        check_show(show, new_filter(filter, self.task, seed, dict(filter_options or {})))
        usual = hyperparameters(algorithm, self.task.env_id)
        self.algorithm, self.filter, self.filter_options = algorithm, filter, dict(filter_options or {})
        self.explore_steps, self.refit_every, self.n_refits = explore_steps, refit_every, n_refits
        self.refit_growth, self.max_fit_steps = refit_growth, max_fit_steps
        self.show, self.include_observation = show, include_observation
        self.evaluate_every, self.evaluation_episodes = evaluate_every, evaluation_episodes
        self.n_envs = usual.get("n_envs", 1) if n_envs is None else n_envs
        self.normalize = usual.get("normalize", False) if normalize is None else normalize
        rescales = usual.get("rescale_actions", False) if rescale_actions is None else rescale_actions
        self.rescale_actions: bool = rescales
        self.arguments = dict(usual.get("arguments", {}) if arguments is None else arguments)
        check_algorithm(self.algorithm, self.action_space, self.rescale_actions)
        self.action_space.seed(seed)  # of what `predict` draws before any training
        self.filter_: Filter | None = None
        self.model: BaseAlgorithm | None = None
        self.history_: list[dict[str, Any]] = []
        self.evaluation_steps_ = 0
        self._recorder: StepRecorder | None = None
        self._stack: BeliefStack | None = None
        self._best: tuple[float, dict[str, Any]] | None = None
        self._next_refit, self._next_evaluation = refit_every, evaluate_every
        self._hint: Hint | None = None

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Train for this many further environment steps, those of exploring among them; see SB3's `learn`.

        Exploring belongs to the first call, which explores for no more than its own steps. A callback is called from
        the first step of the algorithm on.

        Raises:
            ValueError: an agent from a file, which only acts; a replay buffer that cannot hold new beliefs.
        """
        explored = 0
        if self.model is None:
            explored = self._begin(min(self.explore_steps, total_timesteps))
        elif self._recorder is None:
            raise ValueError(
                "expected an agent that was trained here, got one from a file, which only acts; train a new one"
            )
        assert self.model is not None
        ours = BetweenRollouts(self._between_rollouts)
        given = callback if isinstance(callback, list) else [] if callback is None else [callback]
        theirs = [one if isinstance(one, BaseCallback) else ConvertCallback(one) for one in given]
        if total_timesteps > explored:
            left, all_of_them = total_timesteps - explored, CallbackList([ours, *theirs])
            self.model.learn(left, all_of_them, reset_num_timesteps=False, progress_bar=progress_bar)
        if ours.is_within_rollout:  # a callback stopped it after a step that SB3 then forgets
            self._take_over()
        if self.evaluate_every:
            self._evaluate()
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
        if self.model is None or self.filter_ is None or self._stack is None:
            drawn = np.stack([self.action_space.sample() for _ in range(n)])
            return (drawn[0] if single else drawn), None
        starts = episode_starts(state, episode_start, n)
        tracker = BeliefTracker(self.filter_, n, show=self.show) if state is None else state.tracker.fork()  # type: ignore[arg-type]
        beliefs = np.zeros((n, tracker.size))
        if starts.any():
            beliefs[starts] = tracker.begin(observation, starts)[starts]
        if state is not None and not starts.all():
            beliefs[~starts] = tracker.go_on(observation, state.actions, ~starts)[~starts]
        seen = self._stack.normalized(self._stack.seen(observation, beliefs))
        action, _ = self.model.predict(seen, deterministic=deterministic)
        action = self._stack.scaled(action)
        return (action[0] if single else action), BeliefMemory(tracker, action.reshape(n, -1))

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        names = "algorithm filter filter_options explore_steps refit_every refit_growth max_fit_steps n_refits show"
        names += " include_observation evaluate_every evaluation_episodes n_envs normalize rescale_actions arguments"
        return {name: getattr(self, name) for name in names.split()}

    def parts(self) -> dict[str, bytes]:
        """SB3's own zip file, the filter in its own format, and the running moments of the normalisation.

        Raises:
            ValueError: not trained. TypeError: a filter that knows its system, which is not saved.
        """
        if self.model is None or self.filter_ is None or self._stack is None:
            raise ValueError("expected a trained agent to save; call learn first")
        if self.filter not in LEARNED:
            raise TypeError(f"expected a learned filter ({', '.join(LEARNED)}) to save, got {self.filter!r}")
        model = io.BytesIO()
        self.model.save(model)
        parts = {"model.zip": model.getvalue(), "filter.safetensors": filter_to_bytes(self.filter_)}
        moments = self._stack.moments()
        return parts if moments is None else {**parts, "normalisation.npz": moments}

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`. SB3's file holds pickled fields: open only files that you trust.

        The agent acts as the saved one; its recorded steps are not in the file, so that it does not learn on.
        """
        self.filter_ = filter_from_bytes(parts["filter.safetensors"])
        self._recorder = None
        stack = self._stack = self._on_beliefs(self.task.make_vec(1), self.filter_)
        kind, file = algorithm_class(self.algorithm), io.BytesIO(parts["model.zip"])
        self.model = kind.load(file, env=stack.vec_env, device="cpu")
        stack.set_moments(parts.get("normalisation.npz"))

    def _begin(self, explore_steps: int) -> int:
        """Explore, fit the filter, and make the model; the steps that were taken."""
        hinted = None if self.filter in ("psim", "psim-actions") else self._hinted
        self._hint, names = hint_of(self.task, raw=self.filter not in LEARNED) if hinted else (None, None)
        env = (hinted or self.task).make_vec(self.n_envs)
        self._names = {"observation_names": component_names(env), "hint_names": names}
        recorder = self._recorder = StepRecorder(env, keeps_hints=hinted is not None)
        recorder.reset(seed=self.seed)
        recorder.action_space.seed(self.seed)
        while self._steps_taken < explore_steps:
            recorder.step(recorder.action_space.sample())
        stack = self._stack = self._on_beliefs(recorder, self._fit_filter())
        made = algorithm_class(self.algorithm)
        arguments = {"policy": "MlpPolicy", **resolve(self.arguments)}
        if issubclass(made, OffPolicyAlgorithm):
            arguments["learning_starts"] = 0  # what was explored is in the buffer
        model = made(env=stack.vec_env, seed=self.seed, device="cpu", **arguments)
        check_replay_buffer(model)
        stack.note_moments(recorder)
        explored = model.num_timesteps = self._steps_taken
        if self.refit_every:
            self._next_refit = (explored // self.refit_every + 1) * self.refit_every
        self.model = model
        self._take_over()
        return explored

    @property
    def _steps_taken(self) -> int:
        """Environment steps of training so far."""
        return 0 if self._recorder is None else self._recorder.n_recorded * self.n_envs

    def _on_beliefs(self, env: Any, filter: Filter) -> BeliefStack:
        return BeliefStack(
            env,
            filter,
            show=self.show,  # type: ignore[arg-type]
            include_observation=self.include_observation,
            rescale_actions=self.rescale_actions,
            normalize=self.normalize,
            gamma=self.arguments.get("gamma", 0.99),
        )

    def _fit_filter(self) -> Filter:
        """Fit the filter to all episodes so far, in the coordinates of the last one."""
        assert self._recorder is not None
        started = time.perf_counter()
        episodes, _ = self._recorder.episodes(self._hint, **self._names)
        fresh = new_filter(self.filter, self.task, self.seed, self.filter_options)
        if self.filter in LEARNED and self.filter_ is not None:
            fresh.keep_coordinates(self.filter_)
        seed = self.seed, len(self.history_)
        episodes = drawn_within(episodes, self.max_fit_steps, seed)
        fit_with_validation(fresh, episodes, seed)
        self.filter_ = fresh
        told = {"what": "fit", "step": self._steps_taken, "episodes": len(episodes)}
        told["seconds"] = time.perf_counter() - started
        self.history_.append({**told, "best_iteration": getattr(fresh, "best_iteration_", None)})
        return fresh

    def _between_rollouts(self) -> None:
        """Evaluate and refit, where that is due."""
        step = self._steps_taken
        if self.evaluate_every and step >= self._next_evaluation:
            self._evaluate()
        n_fits = sum(entry["what"] == "fit" for entry in self.history_)
        may = self.filter in LEARNED and (self.n_refits is None or n_fits <= self.n_refits)
        if may and self.refit_every and step >= self._next_refit:
            following = (step // self.refit_every + 1) * self.refit_every
            self._next_refit = max(following, int(self.refit_growth * step))
            self._fit_filter()
            self._take_over()

    def _take_over(self) -> None:
        """Show the present filter wherever a belief is."""
        assert self._stack is not None
        assert self.model is not None
        assert self._recorder is not None
        assert self.filter_ is not None
        self._stack.take_over(self.model, self._recorder, self.filter_)

    def _evaluate(self) -> None:
        """Evaluate, and keep the policy and its filter where they are the best so far."""
        step = self._steps_taken
        self._next_evaluation = (step // self.evaluate_every + 1) * self.evaluate_every
        result = evaluate(self, self.task, self.evaluation_episodes, seed=EVALUATION_SEED)
        self.evaluation_steps_ += int(result.lengths.sum())
        self.history_.append({"what": "evaluation", "step": step, "mean_return": result.mean})
        if self._best is None or result.mean > self._best[0]:
            assert self.model is not None
            assert self._stack is not None
            model, moments = deepcopy(self.model.get_parameters()), self._stack.moments()
            self._best = result.mean, {"model": model, "filter": self.filter_, "moments": moments}

    def _recall_best(self) -> None:
        """Take the best policy, with its filter and its moments."""
        if self._best is None or self.model is None or self._stack is None:
            return
        kept = self._best[1]
        self.model.set_parameters(kept["model"], device="cpu")
        self._stack.set_moments(kept["moments"])
        if kept["filter"] is not self.filter_ or kept["moments"] is not None:
            self.filter_ = kept["filter"]
            self._take_over()
