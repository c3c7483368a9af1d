"""How much of the true state a recurrent agent's hidden state tells, linearly (beside its return).

    R^2_j = 1 - sum (s_j - W h - b)^2 / sum (s_j - mean s_j)^2

W, b are a ridge regression on half of the episodes, R^2 is of the other half, and s what the fully observed sibling of
the task shows. 1: a linear map reads the state from the hidden state; 0: it knows no more than the mean.

Reference: Lambrechts et al. 2022 measure the mutual information between hidden state and belief; this is its linear
lower cousin, which needs no estimator of its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefgym.agents.agent import Agent
from beliefgym.agents.belief_filters import hint_of, task_with_hints
from beliefgym.wrappers.task import Task

RIDGE = 1e-3  # of standardised hidden states, a row


def decodability(agent: Agent, task: Task, n_episodes: int, seed: int) -> dict[str, float] | None:
    """R^2 of every component of the state, by its name.

    Args:
        agent: with a hidden state in `predict`'s state: the recurrent agents here, and RecurrentPPO.
        task: whose environment tells hints. n_episodes: half of them to fit, half to test. seed: of the first.

    Returns:
        None where the agent has no hidden state, or the environment tells no hints.
    """
    hinted = task_with_hints(task)
    if hinted is None:
        return None
    observe, names = hint_of(hinted)
    env = hinted.make_vec(n_episodes)
    observation, infos = env.reset(seed=seed)
    running = np.ones(n_episodes, dtype=np.bool_)
    start, state = running.copy(), None
    hidden: list[NDArray[Any]] = []
    truth: list[NDArray[Any]] = []
    alive: list[NDArray[np.bool_]] = []
    while running.any():
        raw = np.asarray(infos["hint"], dtype=np.float64)
        action, state = agent.predict(observation, state, start, deterministic=True)
        seen = hidden_state(state)
        if seen is None or seen.shape[1] == 0:
            env.close()
            return None
        hidden.append(seen)
        truth.append(np.asarray(observe(raw)))
        alive.append(running.copy())
        observation, _, terminated, truncated, infos = env.step(action)
        start = terminated | truncated
        running &= ~start
    env.close()
    h, s, there = np.stack(hidden), np.stack(truth), np.stack(alive)
    half = np.arange(n_episodes) < n_episodes // 2
    train, test = there & half, there & ~half
    scores = linear_r2(h[train], s[train], h[test], s[test])
    labels = names or tuple(str(j) for j in range(s.shape[-1]))
    return {name: float(score) for name, score in zip(labels, scores, strict=True) if np.isfinite(score)}


def hidden_state(state: Any) -> NDArray[np.float64] | None:
    """(n, size) out of what `predict` returned: h of this package's agents, of an LSTM of sb3-contrib's."""
    own = getattr(state, "state", None)
    if own is not None:
        return np.asarray(own, dtype=np.float64)
    recurrent = getattr(state, "recurrent", None)
    return None if recurrent is None else np.concatenate([part[-1] for part in recurrent], axis=-1)


def linear_r2(
    h: NDArray[Any], s: NDArray[Any], h_test: NDArray[Any], s_test: NDArray[Any]
) -> NDArray[np.float64]:
    """R^2 of each column of s; NaN for one that does not vary."""
    mean, scale = h.mean(0), np.maximum(h.std(0), 1e-6)
    a, b = (h - mean) / scale, (h_test - mean) / scale
    centre = s.mean(0)
    weights = np.linalg.solve(a.T @ a + RIDGE * len(a) * np.eye(a.shape[1]), a.T @ (s - centre))
    errors = ((s_test - centre - b @ weights) ** 2).sum(0)
    spread = ((s_test - s_test.mean(0)) ** 2).sum(0)
    return np.where(spread > 1e-12 * max(len(s_test), 1), 1.0 - errors / np.maximum(spread, 1e-12), np.nan)
