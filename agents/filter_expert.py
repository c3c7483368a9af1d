"""The expert on the estimate of a filter that knows the system: what sensors alone allow certainty equivalence.

    m_t = E[s_t | x_0 .. x_t, a_0 .. a_{t-1}]  (Kalman filter of the exact model)        a_t = expert(m_t)

Beside agents that learn from observations it stands for the textbook: a linear system with Gaussian noise is
controlled best so (LQG, the separation principle), others nearly so while the estimate is good. Where a belief has
several modes, as of a pendulum's angle that was not seen yet, its mean is no state to act on.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beliefgym.agents.agent import episode_starts
from beliefgym.agents.belief_filters import new_filter
from beliefgym.agents.expert import Expert
from beliefgym.envs.system import System
from beliefgym.wrappers.task import Task

PRIOR_STATES = 10_000  # start states from which the prior's moments are taken


class Followed(NamedTuple):
    """What is remembered between two calls of `predict`: beliefs (n, belief_size), last actions (n, n_action)."""

    belief: NDArray[np.float64]
    action: NDArray[np.float64]


class LinearFeedback:
    """a = clip(-K s), as a controller of `Expert`'s.

    Args:
        system: the system. gain: K, (n_action, n_state).

    Raises:
        ValueError: a gain of another shape.
    """

    def __init__(self, system: System, gain: ArrayLike) -> None:
        self.system, self.gain = system, np.asarray(gain, dtype=np.float64)
        if self.gain.shape != (system.n_action, system.n_state):
            raise ValueError(
                f"expected a gain of shape {(system.n_action, system.n_state)} (actions, states "
                f"{', '.join(system.state_names)}), got {self.gain.shape}"
            )

    def act(self, state: NDArray[np.float64], restart: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(n, n_state) -> (n, n_action)."""
        del restart
        return np.asarray(self.system.clip(-state @ self.gain.T))


class FilterExpert(Expert):
    """The expert of a beliefgym system acting on a Kalman filter's mean; it sees observations only.

    Args:
        task: a task of a beliefgym system whose observations are components of the system's, with or without noise.
        seed: of the states that the prior is taken from.
        filter: "ukf", "ekf" or "particle", with the exact dynamics and the task's own noise.
        gain: K of a = clip(-K m_t) in place of the expert's, (n_action, n_state) or nested lists; None for the expert.

    Raises:
        ValueError: no such system, an unknown filter, or a gain of another shape.
    """

    def __init__(
        self, task: Task | str, seed: int = 0, *, filter: str = "ukf", gain: ArrayLike | None = None
    ) -> None:
        super().__init__(task, seed)
        if self.system is None:
            raise ValueError(
                f"expected a task of a beliefgym system, whose dynamics a filter can know, got {self.task.label}"
            )
        self._options = {"filter": filter, "gain": None if gain is None else np.asarray(gain).tolist()}
        if gain is not None:
            self._controller = LinearFeedback(self.system, gain)
        env = self.task.make_vec(PRIOR_STATES)
        env.reset(seed=seed)
        first = np.asarray(env.unwrapped.state)  # type: ignore[attr-defined]
        env.close()
        n = self.system.n_state
        prior = first.mean(axis=0), np.cov(first.T, bias=True).reshape(n, n)
        unfitted: Any = new_filter(filter, self.task, seed, {"prior": prior})
        self.filter = type(unfitted).of(**{**unfitted.get_params(deep=False), "prior": prior})
        self._initial = self.filter.initial_belief(1)

    def set_env(self, env: Any) -> None:
        """Nothing of the environment is read."""

    def predict(
        self,
        observation: NDArray[Any],
        state: Followed | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Followed]:
        """See `Agent.predict`; the state holds the beliefs."""
        observation, single = self.batched(observation)
        starts = episode_starts(state, episode_start, len(observation))
        assert self.system is not None
        belief = np.repeat(self._initial, len(observation), axis=0)
        action = np.zeros((len(observation), self.system.n_action))
        if state is not None:
            belief = np.where(starts[:, None], belief, state.belief)
            action = np.where(starts[:, None], action, state.action)
        belief = self.filter.update(belief, np.asarray(observation, dtype=np.float64), action)
        wanted = self._controller.act(self.filter.estimate_state(belief).mean, starts)
        chosen = self._in_action_space(wanted, False)
        return (chosen[0] if single else chosen), Followed(belief, self._carried_out(chosen))

    def _carried_out(self, chosen: NDArray[Any]) -> NDArray[np.float64]:
        """(n, n_action) in the system's units."""
        return np.asarray(chosen if self._table is None else self._table[chosen], dtype=np.float64)

    def options(self) -> dict[str, Any]:
        """See `Agent.options`."""
        return dict(self._options)
