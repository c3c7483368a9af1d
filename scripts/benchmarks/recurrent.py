"""`beliefgym benchmark recurrent`: training of recurrent agents, frames per second, acting and gradient work together.

Recurrent-Q SARSA against sb3-contrib's RecurrentPPO on the position-only cart-pole: the same memory (LSTM of 64), the
same copies, and the same gradient work: every frame goes through the network's gradient 10 times, in batches of 128
frames (RecurrentPPO's default) and of 512. RecurrentPPO has an LSTM for the actor and one for the critic; a second
rival has the actor's alone. With one thread and with two. Beside them, the agents here with the settings that they are
registered with, against RecurrentPPO in batches of 128.

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
N_ENVS, HIDDEN, EPOCHS = 8, 64, 10
BATCHES = (128, 512)  # frames in a gradient step
PPO_STEPS, Q_STEPS = 128, 32  # of a rollout
TARGET = 20.0
REPEATS, SECONDS = 3, 2.0
OURS, RIVAL, RIVAL_SMALL = "Recurrent-Q SARSA", "RecurrentPPO, two LSTMs", "RecurrentPPO, one LSTM"
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
        "gradient steps for 1,024 frames": {
            f"batches of {batch}": 1024 * EPOCHS / batch for batch in BATCHES
        },
    }
    return rows, limits


def equal_work(batch: int) -> RecurrentQSARSA:
    """The agent with as much gradient work for a frame as RecurrentPPO: `EPOCHS` uses in batches of so many frames."""
    frames = N_ENVS * Q_STEPS
    return RecurrentQSARSA(
        TASK,
        0,
        n_envs=N_ENVS,
        rollout_steps=Q_STEPS,
        hidden_size=HIDDEN,
        width=HIDDEN,
        reuse=EPOCHS,
        batch_rows=None,
        n_batches=frames * EPOCHS // batch,
    )


def recurrent_ppo(batch: int, critic_lstm: bool) -> RecurrentPPO:
    """The rival, with SB3's rollouts of the same copies."""
    policy = {"net_arch": [HIDDEN], "lstm_hidden_size": HIDDEN, "enable_critic_lstm": critic_lstm}
    return RecurrentPPO(
        "MlpLstmPolicy",
        _env(),
        n_steps=PPO_STEPS,
        batch_size=batch,
        n_epochs=EPOCHS,
        policy_kwargs=policy,
        device="cpu",
        seed=0,
    )


def _training(threads: int) -> list[dict[str, Any]]:
    models: dict[str, Any] = {}
    for batch in BATCHES:
        models[_of(OURS, batch)] = equal_work(batch).learn(
            EPOCHS * N_ENVS * Q_STEPS
        )  # as many rollouts as it keeps
        models[_of(RIVAL, batch)] = recurrent_ppo(batch, critic_lstm=True)
        models[_of(RIVAL_SMALL, batch)] = recurrent_ppo(batch, critic_lstm=False)
    for name in REGISTERED:
        models[name] = make_agent(name, TASK, seed=0)
    frames = N_ENVS * PPO_STEPS
    calls = {name: _learning(model, frames) for name, model in models.items()}
    found = rates(calls, repeats=REPEATS, seconds=SECONDS)
    what = f"training frames/s, {TASK}, {threads} threads: "
    rows = []
    for batch in BATCHES:
        ours = _of(OURS, batch)
        for rival, target in ((_of(RIVAL, batch), TARGET), (_of(RIVAL_SMALL, batch), None)):
            rows.append(row(what + ours, found[ours], rival, found[rival], target))
    usual = _of(RIVAL, BATCHES[0])
    rows += [row(what + name, found[name], usual, found[usual]) for name in REGISTERED]
    return rows


def _of(name: str, batch: int) -> str:
    return f"{name}, batches of {batch}"


def _env() -> SB3VecEnv:
    return SB3VecEnv(Task(TASK).make_vec(N_ENVS))


def _learning(model: Any, frames: int) -> Callable[[], int]:
    def call() -> int:
        model.learn(frames)
        return frames

    return call
