"""`BeliefCadence`: evaluates and refits between two rollouts of SB3's, where they are due."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stable_baselines3.common.callbacks import BaseCallback

if TYPE_CHECKING:
    from beliefgym.agents.belief_policy import BeliefPolicy


class BeliefCadence(BaseCallback):
    """SB3's callback for it.

    Args:
        agent: whose `evaluate_every`, `refit_every` and `n_refits` say when.

    Attributes:
        is_within_rollout: still after training where another callback has stopped it there: SB3 then forgets the last
            step.
    """

    def __init__(self, agent: BeliefPolicy) -> None:
        super().__init__()
        self._agent = agent
        self.is_within_rollout = False

    def _on_rollout_start(self) -> None:
        agent = self._agent
        if agent.evaluation_is_due():
            agent.evaluate()
        if agent.refit_is_due():
            agent.refit()
        self.is_within_rollout = True

    def _on_rollout_end(self) -> None:
        self.is_within_rollout = False

    def _on_step(self) -> bool:
        return True
