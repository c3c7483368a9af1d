"""`beliefgym benchmark belief`: what a belief costs, a step and in training, against what a user would pick instead.

- Steps per second of vector environments with `BeliefObservation` against the same ones without, at 1, 64 and 1024
  copies: three native ones from cheap to dear and an arm in MuJoCo; filters linear, linear with actions, and with 300
  random frequencies and hints, as `BeliefPolicy` fits them. Beside them SB3's frame stacking, `ActionHistory`, and the
  unscented Kalman filter that knows the system. The target is that 64 copies step at 70 % of their speed or more.
- Frames per second of PPO from end to end on beliefs against sb3-contrib's RecurrentPPO of the same sizes, and of SAC
  on beliefs against SAC without.

An update of n beliefs of b numbers from i inputs (belief, observation, action and a 1) multiplies n i b numbers, or
n (i m + (i + 2 m) b) with m random frequencies, and moves as many weights, n i inputs and n b results.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from typing import Any

import torch
from gymnasium.vector import VectorEnv
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack
from threadpoolctl import threadpool_limits

from beliefgym.agents.belief_filters import hint_of, new_filter, task_with_hints
from beliefgym.envs import collect
from beliefgym.learning import PSIM, Filter, PSIMActions, PSIMHints, Ridge, Sequences
from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.scripts.benchmarks.dad import product_rate
from beliefgym.scripts.benchmarks.measuring import Rate, rates, row
from beliefgym.wrappers.sb3 import SB3VecEnv
from beliefgym.wrappers.task import Task
from beliefgym.wrappers.vector import ActionHistory, BeliefObservation

COPIES = (1, 64, 1024)
NATIVE = ("PendulumPosition-v0", "CartPoleSwingUpPosition-v0", "HelicopterHoverPosition-v0")
MUJOCO = ("BaxterReachPosition-v0",)
MUJOCO_MOST = UKF_MOST = 64  # copies; the first steps them at 4 ms, the second takes as long
N_EPISODES, N_ITERATIONS = 60, 5  # to fit a filter to; how long that goes changes nothing in an update's cost
WAVES, FUTURE, STACK = 300, 5, 4
SPEED_LEFT, TARGET_COPIES = 0.7, 64
REPEATS, SECONDS = 5, 0.2
N_ENVS, N_STEPS, BATCH, EPOCHS, HIDDEN = 8, 128, 128, 10, 64  # of PPO, with and without recurrence
ROLLOUTS, SAC_STEPS, TRAINING_SECONDS = 2, 512, 2.0
LINEAR, ACTIONS, HINTS = "PSIM, linear", "PSIM+Actions, linear", "PSIM+Hints, linear"
RANDOM = f"PSIM+Hints, {WAVES} random frequencies"
PLAIN, SB3_PLAIN, STACKED = "without", "SB3VecEnv without", f"frame stacking of {STACK} (SB3)"
HISTORY, UKF = f"ActionHistory of {STACK}", "unscented filter of the known system"


def run(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure; one thread."""
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    limits: dict[str, Any] = {"GFLOP/s": {"matrix product (dgemm 1000 x 1000)": product_rate() / 1e9}}
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DivergenceWarning
        )  # random actions go where the filters have not been
        for name in (*NATIVE, *MUJOCO):
            task = Task(name)
            told(f"fitting filters of {name}")
            filters = fitted(task)
            for n in COPIES:
                if name in NATIVE or n <= MUJOCO_MOST:
                    told(f"{name}, {n} copies")
                    rows += _steps(task, filters, n, limits)
            if name == NATIVE[0]:
                told("PPO and SAC from end to end")
                trained = _training(task, filters)
    limits["MuJoCo"] = f"{', '.join(MUJOCO)} steps its copies on all cores, and at most {MUJOCO_MOST} of them"
    return rows + trained, limits


def fitted(task: Task) -> dict[str, Filter]:
    """The filters by name, fitted to episodes of random actions, and the one that knows the system."""
    hinted = task_with_hints(task)
    assert hinted is not None
    env = hinted.make_vec(8)
    data = collect(env, "random", N_EPISODES, seed=0)
    env.close()
    assert data.hints is not None
    hint, _ = hint_of(task)
    train = Sequences.from_observations(
        data.observations, actions=data.actions, hints=hint(data.hints), lengths=data.lengths
    )
    shared: dict[str, Any] = {"n_future": FUTURE, "n_iterations": N_ITERATIONS}
    options = {**shared, "n_frequencies": WAVES}
    found: dict[str, Filter] = {
        LINEAR: PSIM(Ridge(), **shared),
        ACTIONS: PSIMActions(Ridge(), **shared),
        HINTS: PSIMHints(Ridge(), use_actions=True, preimage="belief", **shared),
        RANDOM: new_filter("psim-hints", task, 0, options),
    }
    if task.env_id.rpartition("/")[2] in NATIVE:
        found[UKF] = new_filter("ukf", task, 0, {})
    for name, filter in found.items():
        filter.fit(data if name == UKF else train)  # whose hint is the state itself
    return found


def _steps(task: Task, filters: dict[str, Filter], n: int, limits: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of one environment at one size, and how many microseconds a step of all copies takes."""
    opened: list[VectorEnv[Any, Any, Any] | VecEnv] = []

    def vector() -> VectorEnv[Any, Any, Any]:
        return task.make_vec(n)

    space = (plain := vector()).action_space
    space.seed(0)
    drawn = [space.sample() for _ in range(32)]

    def stepping(env: VectorEnv[Any, Any, Any] | VecEnv) -> Callable[[], int]:
        opened.append(env)
        actions = itertools.cycle(drawn)
        env.reset()
        batch = max(1, 256 // n)

        def call() -> int:
            for _ in range(batch):
                env.step(next(actions))
            return batch * n

        return call

    contestants = {PLAIN: stepping(plain)}
    for name, filter in filters.items():
        if name != UKF or n <= UKF_MOST:
            contestants[name] = stepping(BeliefObservation(vector(), filter))
    contestants[HISTORY] = stepping(ActionHistory(vector(), STACK))
    contestants[SB3_PLAIN] = stepping(SB3VecEnv(vector()))
    contestants[STACKED] = stepping(VecFrameStack(SB3VecEnv(vector()), STACK))
    found = rates(contestants, repeats=REPEATS, seconds=SECONDS)
    for env in opened:
        env.close()
    where = f"{task.label}, {n} copies"
    limits[f"microseconds a step of all, {where}"] = {
        name: 1e6 * n / rate.value for name, rate in found.items()
    }
    for name in (LINEAR, ACTIONS, HINTS, RANDOM):
        limits[f"an update, {where}, {name}"] = work(filters[name], n) | {
            "microseconds taken": 1e6 * n * (1.0 / found[name].value - 1.0 / found[PLAIN].value)
        }
    rows = []
    for name, rate in found.items():
        if name in (PLAIN, SB3_PLAIN):
            continue
        without = SB3_PLAIN if name == STACKED else PLAIN
        target = SPEED_LEFT if n == TARGET_COPIES and name not in (HISTORY, STACKED, UKF) else None
        rows.append(row(f"steps/s, {where}: {name}", rate, without, found[without], target))
    return rows


def work(filter: Any, n: int) -> dict[str, float]:
    """What an update of n beliefs must do: FLOPs, and bytes in double precision."""
    size = filter.belief_size
    inputs = size + filter.n_obs_ + (0 if filter.action_timing == "none" else filter.n_act_) + 1
    waves = getattr(filter.model_, "n_frequencies", 0)
    weights = inputs * size + waves * (inputs + 2 * size)
    return {"FLOPs": 2.0 * n * weights, "bytes": 8.0 * (weights + n * (inputs + size))}


def _training(task: Task, filters: dict[str, Filter]) -> list[dict[str, Any]]:
    """Rows of PPO and SAC, gradient work included."""

    def plain(n: int) -> VecEnv:
        return SB3VecEnv(task.make_vec(n))

    def on_beliefs(name: str, n: int) -> VecEnv:
        return SB3VecEnv(BeliefObservation(task.make_vec(n), filters[name]))

    def learning(model: Any, total: int) -> Callable[[], int]:
        def call() -> int:
            model.learn(total)
            return total

        return call

    alike: dict[str, Any] = {
        "n_steps": N_STEPS,
        "batch_size": BATCH,
        "n_epochs": EPOCHS,
        "device": "cpu",
        "seed": 0,
    }
    network: dict[str, Any] = {"net_arch": [HIDDEN]}
    lstm = f"RecurrentPPO, LSTM of {HIDDEN}"
    frames = ROLLOUTS * N_STEPS * N_ENVS
    contestants = {
        name: learning(PPO("MlpPolicy", on_beliefs(name, N_ENVS), policy_kwargs=network, **alike), frames)
        for name in (LINEAR, RANDOM)
    }
    contestants[PLAIN] = learning(PPO("MlpPolicy", plain(N_ENVS), policy_kwargs=network, **alike), frames)
    recurrent = RecurrentPPO(
        "MlpLstmPolicy", plain(N_ENVS), policy_kwargs={**network, "lstm_hidden_size": HIDDEN}, **alike
    )
    contestants[lstm] = learning(recurrent, frames)
    ppo = rates(contestants, repeats=3, seconds=TRAINING_SECONDS)
    rows = []
    for name in (LINEAR, RANDOM):
        what = f"PPO end to end frames/s, {task.label}, {N_ENVS} environments: {name}"
        rows.append(row(what, ppo[name], lstm, ppo[lstm], 5.0))
        rows.append(row(what, ppo[name], f"PPO {PLAIN}", ppo[PLAIN]))
    sac = _sac({PLAIN: plain(1), LINEAR: on_beliefs(LINEAR, 1), RANDOM: on_beliefs(RANDOM, 1)}, learning)
    for name in (LINEAR, RANDOM):
        what = f"SAC end to end frames/s, {task.label}: {name}"
        rows.append(row(what, sac[name], f"SAC {PLAIN}", sac[PLAIN]))
    return rows


def _sac(envs: dict[str, VecEnv], learning: Callable[[Any, int], Callable[[], int]]) -> dict[str, Rate]:
    """One gradient step a frame."""
    settings: dict[str, Any] = {"learning_starts": 0, "buffer_size": 20_000, "device": "cpu", "seed": 0}
    models = {
        name: SAC("MlpPolicy", env, policy_kwargs={"net_arch": [HIDDEN, HIDDEN]}, **settings)
        for name, env in envs.items()
    }
    return rates(
        {name: learning(model, SAC_STEPS) for name, model in models.items()},
        repeats=3,
        seconds=TRAINING_SECONDS,
    )
