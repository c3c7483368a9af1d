"""`beliefgym benchmark recurrent`: training of recurrent agents, frames per second, acting and gradient work together.

Recurrent-Q SARSA against sb3-contrib's RecurrentPPO on the position-only cart-pole: the same memory (LSTM of 64), the
same copies, and the same gradient work: every frame goes through the network's gradient 10 times, in batches of 128
frames. RecurrentPPO has an LSTM for the actor and one for the critic; a second rival has the actor's alone. With one
thread and with two. Beside them, the agents here with the settings that they are registered with.

A frame costs an LSTM of h units with i inputs 8 h (i + h) FLOPs forwards and twice that backwards.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from sb3_contrib import RecurrentPPO
from threadpoolctl import threadpool_limits

from beliefgym.agents import make_agent
from beliefgym.agents.recurrent import RecurrentQSARSA
from beliefgym.scripts.benchmarks.dad import product_rate
from beliefgym.scripts.benchmarks.measuring import rates, row
from beliefgym.wrappers.sb3 import SB3VecEnv
from beliefgym.wrappers.task import Task

TASK = "CartPoleBalancePosition-v0"
N_ENVS, HIDDEN, BATCH, EPOCHS = 8, 64, 128, 10
PPO_STEPS, Q_STEPS = 128, 32  # of a rollout
TARGET = 20.0
REPEATS, SECONDS = 3, 2.0
OURS, OURS_PLAIN = "Recurrent-Q SARSA", "Recurrent-Q SARSA without an averaged network"
RIVAL, RIVAL_SMALL = f"RecurrentPPO, two LSTMs of {HIDDEN}", f"RecurrentPPO, one LSTM of {HIDDEN}"
REGISTERED = ("recurrent-q", "recurrent-pqn", "drqn", "r2d2")


def run(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure with one and with two threads."""
    rows: list[dict[str, Any]] = []
    for threads in (1, 2):
        told(f"{threads} threads")
        torch.set_num_threads(threads)
        with threadpool_limits(threads):
            rows += _training(threads)
    torch.set_num_threads(1)
    width = HIDDEN
    forward = 8.0 * HIDDEN * (width + HIDDEN)
    limits: dict[str, Any] = {
        "GFLOP/s": {"matrix product (dgemm 1000 x 1000)": product_rate() / 1e9},
        "FLOPs of the LSTM for a frame": {"acting": forward, "learning": 3.0 * forward * EPOCHS},
        "gradient steps for 1,024 frames": 1024 * EPOCHS / BATCH,
    }
    return rows, limits


def equal_work(**options: Any) -> RecurrentQSARSA:
    """The agent with as much gradient work for a frame as RecurrentPPO: `EPOCHS` uses in batches of `BATCH` frames."""
    frames = N_ENVS * Q_STEPS
    return RecurrentQSARSA(
        TASK,
        0,
        n_envs=N_ENVS,
        rollout_steps=Q_STEPS,
        hidden_size=HIDDEN,
        width=HIDDEN,
        reuse=EPOCHS,
        n_batches=frames * EPOCHS // BATCH,
        **options,
    )


def _training(threads: int) -> list[dict[str, Any]]:
    alike: dict[str, Any] = {
        "n_steps": PPO_STEPS,
        "batch_size": BATCH,
        "n_epochs": EPOCHS,
        "device": "cpu",
        "seed": 0,
    }
    policy: dict[str, Any] = {"net_arch": [HIDDEN], "lstm_hidden_size": HIDDEN}
    models: dict[str, Any] = {
        OURS: equal_work(),
        OURS_PLAIN: equal_work(average=0.0),
        RIVAL: RecurrentPPO("MlpLstmPolicy", _env(), policy_kwargs=policy, **alike),
        RIVAL_SMALL: RecurrentPPO(
            "MlpLstmPolicy", _env(), policy_kwargs={**policy, "enable_critic_lstm": False}, **alike
        ),
    }
    for name in REGISTERED:
        models[name] = make_agent(name, TASK, seed=0)
    frames = N_ENVS * PPO_STEPS
    for name in (OURS, OURS_PLAIN):
        models[name].learn(EPOCHS * N_ENVS * Q_STEPS)  # until as many rollouts are kept as will be
    found = rates(
        {name: _learning(model, frames) for name, model in models.items()}, repeats=REPEATS, seconds=SECONDS
    )
    rows = []
    for name in models:
        if name in (RIVAL, RIVAL_SMALL):
            continue
        what = f"training frames/s, {TASK}, {threads} threads: {name}"
        rows.append(row(what, found[name], RIVAL, found[RIVAL], TARGET if name == OURS else None))
        if name == OURS:
            rows.append(row(what, found[name], RIVAL_SMALL, found[RIVAL_SMALL]))
    return rows


def _env() -> SB3VecEnv:
    return SB3VecEnv(Task(TASK).make_vec(N_ENVS))


def _learning(model: Any, frames: int) -> Callable[[], int]:
    def call() -> int:
        model.learn(frames)
        return frames

    return call
