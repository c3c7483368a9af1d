"""Small agents of Recurrent-Q SARSA, what they did, and what their network would have thought of it."""

from __future__ import annotations

import copy
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from beliefgym.agents.recurrent.q_sarsa import RecurrentQSARSA
from beliefgym.wrappers import Task

BALANCE = "beliefgym/CartPoleBalancePosition-v0"  # falls after 10 to 20 steps
SMALL = {"n_envs": 2, "rollout_steps": 8, "reuse": 2, "n_batches": 2, "hidden_size": 8, "width": 8}


def small(env_id: Any = BALANCE, seed: int = 0, **options: Any) -> RecurrentQSARSA:
    """An agent that learns in no time."""
    return RecurrentQSARSA(env_id, seed, **{**SMALL, **options})


def roll(agent, n=3, steps=40, env_id=BALANCE, tell=False):
    """Observations, episode starts, actions, rewards and the last memory, of greedy episodes one after another."""
    env = Task(env_id).make_vec(n)
    observation, _ = env.reset(seed=5)
    start, state, told = np.ones(n, dtype=bool), None, []
    for _ in range(steps):
        action, state = agent.predict(observation, state=state, episode_start=start, deterministic=True)
        seen = observation, start
        observation, reward, terminated, truncated, _ = env.step(action)
        told.append((*seen, action, reward))
        start = terminated | truncated
        if tell:
            agent.tell_reward(reward)
    return *(np.stack(x) for x in zip(*told, strict=True)), state


def by_network(agent, observations, starts, actions, rewards, scale=1.0):
    """Q (steps, n, n_actions) and the last states, from each episode's start in one run of the network over it."""
    steps, n = starts.shape
    values, last = np.zeros((steps, n, 2)), []
    for i in range(n):
        begins = [*np.flatnonzero(starts[:, i]), steps]
        for begin, end in pairwise(begins):
            taken = np.eye(2)[[0, *actions[begin : end - 1, i]]]
            told = scale * np.array([0.0, *rewards[begin : end - 1, i]])[:, None]
            taken[0] = 0.0
            inputs = (
                torch.as_tensor(x, dtype=torch.float32)[None]
                for x in (observations[begin:end, i], taken, told)
            )
            with torch.no_grad():
                q, _, state = agent.acting.values(*inputs, torch.zeros(1, agent.network.state_size))
            values[begin:end, i] = q[0].numpy()
        last.append(state[0].numpy())
    return values, np.stack(last)


class Watched(RecurrentQSARSA):
    """Keeps its rollouts, its batches, and the network that acted in each rollout."""

    def __init__(self, *arguments, **options):
        self.rollouts, self.batches, self.actors, self.learners, self.seen = [], [], [], [], []
        super().__init__(*arguments, **options)

    def before_rollout(self, collector):
        """See the base class."""
        self.actors.append(copy.deepcopy(self.acting))
        return super().before_rollout(collector)

    def improve(self, rollout, progress):
        """See the base class."""
        self.rollouts.append(rollout.clone())
        self.batches.append([])
        self.learners.append(copy.deepcopy(self.acting))  # with the moments of this rollout too
        answer = super().improve(rollout, progress)
        self.seen.append(
            (self.epsilon, self.optimizer.param_groups[0]["lr"], dict(self.loss.auxiliary_weights))
        )
        return answer

    def step_optimizer(self, batch):
        """See the base class."""
        self.batches[-1].append(batch.clone())
        return super().step_optimizer(batch)


def watched(env_id=BALANCE, steps=160, seed=0, **options):
    return Watched(env_id, seed, **{**SMALL, **options}).learn(steps)
