"""`SystemIdentification`: model-based control that learns its model where its own policies take it (DAgger).

The loop of Fig. 3.9:

    1. collect trajectories of the real system with an exploration policy;
    2. aggregate them into the data set;
    3. learn a dynamics model f(x_t, u_t) -> x_{t+1} from all of it;
    4. make a new policy that minimises the cost under the model; run it on the real system, aggregate what it met;
    5. repeat, and return the best of all policies.

With `exploration_trials` in each iteration the data keep a constant share of the exploration distribution, which the
guarantee of Ross & Bagnell needs; with 0 it is the loop of Abbeel & Ng.

References: thesis proposal, Sec. 3.2.1, Fig. 3.9; Ross & Bagnell 2012, "Agnostic system identification for model-based
reinforcement learning"; Abbeel & Ng 2005, "Exploration and apprenticeship learning in reinforcement learning".
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from sklearn.base import clone
from tqdm import tqdm

from beliefgym.agents.agent import Agent, episode_starts, require_box
from beliefgym.agents.coordinates import Coordinates
from beliefgym.agents.delay_state import DelayState
from beliefgym.agents.expert import Expert
from beliefgym.agents.exploration import Exploration, Explorer
from beliefgym.agents.policy_synthesis import ModelPolicy, RecedingHorizonSynthesis, Synthesis
from beliefgym.agents.training_callback import TrainingCallback
from beliefgym.envs.collect import collect
from beliefgym.envs.planning.learned_model import Cost, LearnedModel
from beliefgym.envs.planning.model_lqr import ModelWarning, cheapest_point
from beliefgym.learning import DynamicsModel, Sequences
from beliefgym.wrappers.task import Task

Floats = NDArray[np.float64]


@dataclass
class Memory:
    """What the agent remembers between two calls of `predict`: of n copies.

    Attributes:
        belief: (n, b) the state source's. action: (n, m) the last one. plan: the policy's. policy: whose plan it is.
    """

    belief: Floats
    action: Floats
    plan: Any
    policy: Any


class SystemIdentification(Agent):
    """The loop above with any dynamics model and any policy made from it; in SB3's face.

    Args:
        task: observations a flat Box with named components, actions a bounded Box. seed: of starts and exploration.
        model: an unfitted `DynamicsModel`; a clone is fitted to all data in each iteration. One with a parameter
            `angles` is told which coordinates are angles.
        synthesis: which policy is made of the model.
        cost: (x (..., d), u (..., m)) -> (...) of the coordinates (see `coordinates`), on numpy and torch; None for the
            system's own `stage_cost`, where its state can be read off the coordinates.
        target: (x* (d,), u* (m,)), where a regulator is to go; None for the cheapest point of the cost.
        delays: observations that make up the state; 1 where one observation is the state. With more, see `DelayState`.
        filter: a fitted filter whose belief is the state, with `initial_belief(n)` and `update(belief, observation,
            action)`, whose action is the one that led to the observation, 0 at first. With `cost`; not with delays.
        trial_steps: length of a trial; the environment's own end if None.
        initial_trials: exploration trials before the first model.
        policy_trials, exploration_trials: trials of each iteration with the present policy, and with exploration.
        exploration: how to explore.
        act_with: "best" of the policies so far, by the mean cost of their trials, or the "last".

    Attributes:
        history: one mapping a trial: "iteration" (the policy's; exploration before the first model has 0), "kind",
            "steps", "seconds" (of the system: steps dt), "cost" (sum of the stage cost; a trial that ends early is
            charged its last stage cost until `trial_steps`), "return", "terminated".
        models: one mapping an iteration: "n_transitions", "trials", "interaction_steps", "interaction_seconds",
            "fit_seconds", "policy_seconds", "single_step_error", "multi_step_error" (on the data), "cost" (mean of the
            policy's trials; None before they were run), "told" (warnings).
        trials: every trial as `Sequences` of one episode: observations as the environment showed them.
        num_timesteps: interaction steps so far.

    Raises:
        ValueError: spaces or numbers that do not fit; a cost that cannot be had from the system.
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        model: DynamicsModel,
        synthesis: Synthesis | None = None,
        cost: Cost | None = None,
        target: tuple[Any, Any] | None = None,
        delays: int = 1,
        filter: Any = None,
        trial_steps: int | None = None,
        initial_trials: int = 1,
        policy_trials: int = 1,
        exploration_trials: int = 0,
        exploration: Exploration | None = None,
        act_with: str = "best",
    ) -> None:
        super().__init__(task, seed)
        require_box(self.observation_space, type(self).__name__)
        space = require_box(self.action_space, type(self).__name__)
        if not space.is_bounded():
            raise ValueError(f"{type(self).__name__} needs bounded actions, got {space}")
        self._space: Box = space
        self._limits = np.asarray(space.low, dtype=float), np.asarray(space.high, dtype=float)
        self.model, self.filter = model, filter
        self.synthesis = RecedingHorizonSynthesis() if synthesis is None else synthesis
        self.trial_steps = trial_steps
        self.initial_trials, self.policy_trials = initial_trials, policy_trials
        self.exploration_trials = exploration_trials
        self.exploration = Exploration() if exploration is None else exploration
        self.act_with = act_with
        self._check()
        env = self.task.make()
        names = _declared(env, "observation_names")
        if names is None:
            names = [f"observation_{i}" for i in range(self.observation_space.shape[0])]  # type: ignore[index]
        self.system = getattr(env.unwrapped, "system", None)
        self.dt = float(getattr(self.system, "dt", getattr(env.unwrapped, "dt", 1.0)))
        limit = None if env.spec is None else env.spec.max_episode_steps
        env.close()
        self._steps_of_trial = trial_steps if trial_steps is not None else limit
        self.coordinates = Coordinates.of(names, self.system)
        self._source: Any = filter
        if filter is None:
            self._source = DelayState(
                self.coordinates.size, len(self._limits[0]), delays, self.dt, self.coordinates.angles
            )
        elif delays != 1:
            raise ValueError("expected delays=1 beside a filter: its belief is the state already")
        self.cost = self._cost_of_system() if cost is None else cost
        self._own_cost = cost is None
        size = np.asarray(self._source.initial_belief(1)).shape[1]
        self.target = (
            cheapest_point(self.cost, size, len(self._limits[0]), self.coordinates.angles, self._limits)
            if target is None
            else (np.asarray(target[0], dtype=float), np.asarray(target[1], dtype=float))
        )
        if self.target[0].shape != (size,) or self.target[1].shape != self._limits[0].shape:
            raise ValueError(
                f"expected target as ({size},) and {self._limits[0].shape}, got {self.target[0].shape} and "
                f"{self.target[1].shape}"
            )
        self.history: list[dict[str, Any]] = []
        self.models: list[dict[str, Any]] = []
        self.num_timesteps = 0
        self.trials: list[Sequences] = []
        self._policies: list[ModelPolicy] = []
        self._idle = _Constant(self.target[1])
        self._fitted: list[DynamicsModel] = []

    # ------------------------------------------------------------------------------------------------------- learning

    def learn(self, total_timesteps: int, callback: Any = None, progress_bar: bool = False) -> Self:
        """Run whole trials until at least this many more interaction steps are used; a second call goes on.

        Args:
            total_timesteps: at least 1. The last trial is run to its end.
            callback: SB3's; its `on_step` is called for each step once the trial is over, and may end the learning
                there.
            progress_bar: show the steps.

        Raises:
            ValueError: total_timesteps below 1.
        """
        if total_timesteps < 1:
            raise ValueError(f"expected total_timesteps of at least 1, got {total_timesteps}")
        told = TrainingCallback(self, callback, total_timesteps)
        until = self.num_timesteps + total_timesteps
        with tqdm(total=total_timesteps, desc=type(self).__name__, disable=not progress_bar) as bar:
            while self.num_timesteps < until:
                before = self.num_timesteps
                go_on = self._next_trial(told)
                bar.update(self.num_timesteps - before)
                if not go_on:
                    break
        if self._due_for_model():
            self._make_policy()
        told.end()
        return self

    def run_iterations(self, n: int) -> Self:
        """Run this many iterations: a model, a policy and its trials each; before the first the initial exploration.

        The policy of the last iteration has been run; call `fit_policy` for one more from all data.
        """
        told = TrainingCallback(self, None, 0)
        done = sum(one["cost"] is not None for one in self.models)
        while sum(one["cost"] is not None for one in self.models) < done + n:
            self._next_trial(told)
        return self

    def fit_policy(self) -> Self:
        """Fit a model to all data and make its policy, if there are data newer than the last one's."""
        if self.trials and (not self.models or self.models[-1]["trials"] < len(self.trials)):
            self._make_policy()
        return self

    def _due_for_model(self) -> bool:
        """Whether the next thing to do is a model."""
        if len(self.trials) < max(1, self.initial_trials):
            return False
        per_iteration = self.policy_trials + self.exploration_trials
        return (len(self.trials) - max(1, self.initial_trials)) // per_iteration >= len(self.models)

    def _next_trial(self, told: TrainingCallback) -> bool:
        """One trial of the schedule, with the model before it where one is due; False to stop."""
        if self._due_for_model():
            self._make_policy()
        first = max(1, self.initial_trials)
        place = (len(self.trials) - first) % (self.policy_trials + self.exploration_trials)
        explores = len(self.trials) < first or place >= self.policy_trials
        self._run_trial("exploration" if explores else "policy")
        if not explores or place + 1 == self.policy_trials + self.exploration_trials:
            self._account()
        return told.trial(self.history[-1])

    def _run_trial(self, kind: str) -> None:
        """Run the real system once, and keep the trial."""
        number = len(self.trials)
        env = self.task.make()
        if kind == "policy":
            policy: Any = _Acting(self, self._policies[-1])
        else:
            policy = self._explorer(env, number)
        trial = collect(
            env,
            policy,
            1,
            int(np.random.SeedSequence([self.seed, number]).generate_state(1)[0]),
            max_steps_per_episode=self.trial_steps,
        )
        env.close()
        steps = int(trial.lengths[0])
        self.trials.append(trial)
        self.num_timesteps += steps
        self.history.append(
            {
                "iteration": len(self.models),
                "kind": kind,
                "steps": steps,
                "seconds": steps * self.dt,
                "cost": self._trial_cost(trial),
                "return": float(trial.returns[0]),
                "terminated": bool(trial.terminated[0]),
            }
        )

    def _explorer(self, env: Any, number: int) -> Explorer:
        base: Any = None
        if self.exploration.kind == "expert":
            base = Expert(self.task)
            base.set_env(env)
        elif self.exploration.kind == "epsilon" and self._policies:
            base = _Acting(self, self._policies[-1])
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, number], spawn_key=(1,)))
        return Explorer(self.exploration, self._space, rng, base)

    def _trial_cost(self, trial: Sequences) -> float:
        """Sum of the stage cost; by the true state where the cost is the system's and the state was recorded."""
        steps = int(trial.lengths[0])
        actions = np.clip(trial.actions[0, :steps], *self._limits)
        if self._own_cost and trial.states is not None:
            stage = np.asarray(self.system.stage_cost(trial.states[0, :steps], actions))  # type: ignore[union-attr]
        else:
            stage = np.asarray(self.cost(self._beliefs(trial)[:steps], actions))
        left = 0 if self._steps_of_trial is None else max(0, self._steps_of_trial - steps)
        return float(stage.sum() + left * stage[-1])

    def _account(self) -> None:
        """Write down what the present policy's trials cost."""
        if self.models:
            costs = [
                one["cost"]
                for one in self.history
                if one["kind"] == "policy" and one["iteration"] == len(self.models)
            ]
            self.models[-1]["cost"] = float(np.mean(costs)) if len(costs) == self.policy_trials else None

    def _make_policy(self) -> None:
        """Steps 3 and 4: a model of all data, and the policy that is best under it."""
        data = self.dataset()
        started = time.perf_counter()
        model = clone(self.model)
        if "angles" in model.get_params():
            model.set_params(angles=self._angles() or None)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.fit(data)
            fitted = time.perf_counter()
            learned = LearnedModel(model, self._limits, self.cost)
            policy = self._synthesise(learned)
            ended = time.perf_counter()
            errors = model.errors(data)
            if errors.n_diverged:
                warnings.warn(
                    f"{errors.n_diverged} of {data.n_episodes} trials diverge when the model predicts them from their "
                    "first state; plans under it are not to be trusted far ahead. A larger ridge, a shorter planning "
                    "horizon or more data would help; the loop goes on, and its next trial is such data",
                    ModelWarning,
                    stacklevel=2,
                )
        told = list(dict.fromkeys(str(one.message) for one in caught))
        self._fitted.append(model)
        self._policies.append(policy)
        self.models.append(
            {
                "trials": len(self.trials),
                "n_transitions": data.n_transitions,
                "interaction_steps": self.num_timesteps,
                "interaction_seconds": self.num_timesteps * self.dt,
                "fit_seconds": fitted - started,
                "policy_seconds": ended - fitted,
                "single_step_error": model.single_step_error(data),
                "multi_step_error": errors.mean,
                "cost": None,
                "told": told,
            }
        )
        for message in told:
            warnings.warn(f"iteration {len(self.models)}: {message}", ModelWarning, stacklevel=4)

    def _synthesise(self, learned: LearnedModel) -> ModelPolicy:
        """The policy of a model; the one before, or doing nothing, where the model gives none."""
        try:
            state, action = self.target
            return self.synthesis.policy(learned, state, action, self._angles())
        except (ValueError, np.linalg.LinAlgError) as error:
            before = bool(self._policies)
            warnings.warn(
                f"no policy could be made of this model ({error}); the loop goes on with "
                + ("the policy before" if before else "the target's action throughout")
                + ", whose data may mend the model; more exploration or a larger ridge would help",
                ModelWarning,
                stacklevel=2,
            )
            return self._policies[-1] if before else self._idle

    def _angles(self) -> tuple[int, ...]:
        return self.coordinates.angles if self.filter is None else ()

    def dataset(self) -> Sequences:
        """All trials so far as trajectories of states x and applied actions u.

        Raises:
            ValueError: there are none.
        """
        if not self.trials:
            raise ValueError("expected trials to learn from, got none; call learn(total_timesteps) first")
        episodes = []
        skipped = 0 if self.filter is not None else self._source.n_delays - 1
        for trial in self.trials:
            steps = int(trial.lengths[0])
            if steps <= skipped:
                continue  # too short to hold a state
            episodes.append(
                {
                    "observations": self._beliefs(trial)[skipped:],
                    "actions": np.clip(trial.actions[0, skipped:steps], *self._limits),
                }
            )
        if not episodes:
            raise ValueError(
                f"expected a trial of more than {skipped} steps to learn from, got {len(self.trials)} shorter ones; "
                "take fewer delays, or start where the episode does not end at once"
            )
        return Sequences.from_episodes(episodes)

    def _beliefs(self, trial: Sequences) -> Floats:
        """(steps + 1, b) the states of a trial."""
        steps = int(trial.lengths[0])
        x = self._seen(trial.observations[0, : steps + 1])
        actions = np.clip(trial.actions[0], *self._limits)
        belief = np.asarray(self._source.initial_belief(1))
        found = []
        for t in range(steps + 1):
            action = actions[t - 1 : t] if t else np.zeros((1, actions.shape[1]))  # as in `act`
            belief = self._source.update(belief, x[t : t + 1], action)
            found.append(belief)
        return np.concatenate(found)

    def _seen(self, observation: Floats) -> Floats:
        """What the state source is given: coordinates, or the observation itself for a fitted filter."""
        return self.coordinates.encode(observation) if self.filter is None else observation

    # --------------------------------------------------------------------------------------------------------- acting

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """See `Agent.predict`; the policies are deterministic. The returned state is changed by the next call.

        Before anything was learned the action is the target's, u*.
        """
        return self.act(self.policy, observation, state, episode_start)

    @property
    def best_iteration(self) -> int:
        """Number (from 0) of the model whose policy `predict` runs.

        Raises:
            RuntimeError: there is none.
        """
        if not self._policies:
            raise RuntimeError("expected a learned policy, got none; call learn(total_timesteps) first")
        tried = [(one["cost"], i) for i, one in enumerate(self.models) if one["cost"] is not None]
        if self.act_with == "last" or not tried:
            return len(self._policies) - 1
        return min(tried)[1]

    @property
    def policy(self) -> ModelPolicy:
        """The policy that `predict` runs; doing nothing but u* before there is one."""
        return self._policies[self.best_iteration] if self._policies else self._idle

    @property
    def dynamics(self) -> DynamicsModel:
        """The fitted model behind `policy`."""
        return self._fitted[self.best_iteration]

    def act(
        self,
        policy: ModelPolicy,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
    ) -> tuple[NDArray[Any], Any]:
        """`predict` with a policy of one's own choice; see there."""
        batch, single = self.batched(observation)
        n = len(batch)
        if not isinstance(state, Memory) or len(state.belief) != n or state.policy is not policy:
            m = len(self._limits[0])
            state = Memory(
                np.asarray(self._source.initial_belief(n)), np.zeros((n, m)), policy.begin(n), policy
            )
            begun = np.ones(n, dtype=np.bool_)
        else:
            begun = episode_starts(state, episode_start, n)
            if begun.any():
                state.belief[begun] = self._source.initial_belief(int(begun.sum()))
                state.action[begun] = 0.0
        state.belief = np.array(
            self._source.update(state.belief, self._seen(batch.astype(float)), state.action)
        )
        action = policy.act(state.belief, state.plan, begun)
        action = np.clip(action, *self._limits)
        state.action = action
        chosen = action.astype(self._space.dtype)
        return (chosen[0] if single else chosen), state

    # --------------------------------------------------------------------------------------------------------- saving

    def parts(self) -> dict[str, bytes]:
        """The trials, the records and the model's settings: the policies are fitted anew from them on loading."""
        from beliefgym.agents.saved_trials import pack

        return pack(self.trials, self.history, self.models)

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """The reverse of `parts`."""
        from beliefgym.agents.saved_trials import unpack

        trials, self.history, models = unpack(parts)
        self.num_timesteps = sum(one["steps"] for one in self.history)
        self._policies, self._fitted, self.models = [], [], []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for one in models:
                self.trials = trials[: one["trials"]]
                self._make_policy()
        self.trials, self.models = trials, models

    # ------------------------------------------------------------------------------------------------------- settings

    def _cost_of_system(self) -> Cost:
        if self.filter is not None:
            raise ValueError(
                "expected cost=function(belief (..., b), action (..., m)) with a filter: a belief has no named state"
            )
        if self.system is None:
            raise ValueError(
                f"expected cost=function(x (..., d), u (..., m)) for {self.task.env_id}: it has no beliefgym system "
                "whose stage cost could be taken"
            )
        names = self._source.names(self.coordinates.names, getattr(self.system, "action_names", ()))
        whole = Coordinates(
            self.coordinates.observation_names,
            names,
            self.coordinates.angles,
            self.coordinates.target_attitude,
        )
        derived = {
            velocity: f"rate_{position}"
            for position, velocity in self.system.rates.items()
            if velocity not in names
        }
        return whole.cost_of(self.system, derived)

    def _check(self) -> None:
        if not isinstance(self.model, DynamicsModel):
            raise TypeError(
                f"expected model to be a DynamicsModel such as DataAsDemonstrator(), got {type(self.model).__name__}"
            )
        least = {"initial_trials": 0, "policy_trials": 1, "exploration_trials": 0}
        for name, low in least.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise ValueError(f"expected {name} to be a whole number of at least {low}, got {value!r}")
        if self.initial_trials == 0:
            warnings.warn(
                "initial_trials=0 gives no exploration data, and no model can be fitted without data: one exploration "
                "trial is run all the same",
                ModelWarning,
                stacklevel=3,
            )
        if self.trial_steps is not None and self.trial_steps < 1:
            raise ValueError(f"expected trial_steps of at least 1, or None, got {self.trial_steps!r}")
        if self.act_with not in ("best", "last"):
            raise ValueError(f"expected act_with to be 'best' or 'last', got {self.act_with!r}")


class _Acting:
    """A policy of an agent in SB3's `predict`, for `collect`."""

    def __init__(self, agent: SystemIdentification, policy: ModelPolicy) -> None:
        self._agent, self._policy = agent, policy

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """See `Agent.predict`."""
        return self._agent.act(self._policy, observation, state, episode_start)


@dataclass(frozen=True, eq=False)
class _Constant:
    """The same action throughout."""

    action: Floats

    def begin(self, n: int) -> None:
        """No memory."""

    def act(self, state: Floats, memory: Any, restart: NDArray[np.bool_]) -> Floats:
        """(n, m)."""
        return np.tile(self.action, (len(state), 1))


def _declared(env: Any, name: str) -> Any:
    try:
        return env.get_wrapper_attr(name)
    except AttributeError:
        return None
