"""`DaDControl`: DaD+Control, model-based control with a model that stays accurate over many steps.

The DAgger loop of `SystemIdentification` with Data as Demonstrator as its model fitter (Algorithm 2 inside Fig. 3.9).
`dad=False` is the thesis's "DAgger only": the same loop, data and policies with the single-step model; nothing else
changes.

References: thesis proposal, Sec. 3.2.2, Algorithm 2; Venkatraman et al. 2016, "Improved learning of dynamics models for
control" (DaD+Control).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sklearn.base import BaseEstimator

from beliefgym.agents.exploration import Exploration
from beliefgym.agents.plain_data import from_plain, to_plain
from beliefgym.agents.policy_synthesis import Synthesis
from beliefgym.agents.system_identification import SystemIdentification
from beliefgym.envs.planning.learned_model import Cost
from beliefgym.learning import DataAsDemonstrator, RandomFourierRidge
from beliefgym.wrappers.task import Task


class DaDControl(SystemIdentification):
    """DAgger system identification with Data as Demonstrator.

    Args:
        task, seed: see `SystemIdentification`.
        dad: False for "DAgger only".
        regressor: learns one step; None for `default_regressor()`.
        dad_iterations: of Data as Demonstrator in each fit. dad_horizon: length of its rollouts; None for whole trials.
        synthesis, cost, target, delays, filter, trial_steps, initial_trials, policy_trials, exploration_trials,
            exploration, act_with: see `SystemIdentification`; of the last six the defaults are those.

    Example:
        >>> agent = DaDControl("beliefgym/CartPoleSwingUp-v0", trial_steps=60).learn(240)  # doctest: +SKIP
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        *,
        dad: bool = True,
        regressor: BaseEstimator | Mapping[str, Any] | None = None,
        dad_iterations: int = 5,
        dad_horizon: int | None = 10,
        synthesis: Synthesis | Mapping[str, Any] | None = None,
        cost: Cost | None = None,
        target: tuple[Any, Any] | None = None,
        delays: int = 1,
        filter: Any = None,
        trial_steps: int | None = None,
        initial_trials: int = 1,
        policy_trials: int = 1,
        exploration_trials: int = 0,
        exploration: Exploration | Mapping[str, Any] | None = None,
        act_with: str = "best",
    ) -> None:
        self.dad, self.dad_iterations, self.dad_horizon = dad, dad_iterations, dad_horizon
        self.regressor: Any = default_regressor() if regressor is None else from_plain(regressor)
        self._given_cost, self._given_target = cost, target
        self._delays = delays
        super().__init__(
            task,
            seed,
            model=DataAsDemonstrator(
                self.regressor, n_iterations=dad_iterations if dad else 0, horizon=dad_horizon
            ),
            synthesis=from_plain(synthesis),
            cost=cost,
            target=target,
            delays=delays,
            filter=filter,
            trial_steps=trial_steps,
            initial_trials=initial_trials,
            policy_trials=policy_trials,
            exploration_trials=exploration_trials,
            exploration=from_plain(exploration),
            act_with=act_with,
        )

    def options(self) -> dict[str, Any]:
        """See `Agent.options`.

        Raises:
            ValueError: a cost or a filter of one's own, which a file cannot hold.
        """
        for name, given in (("cost", self._given_cost), ("filter", self.filter)):
            if given is not None:
                raise ValueError(
                    f"expected no {name} of one's own in an agent that is saved, got {given!r}: a file without code "
                    "cannot hold it; keep the trials (`agent.dataset().save_npz(path)`) instead"
                )
        return {
            "dad": self.dad,
            "regressor": to_plain(self.regressor),
            "dad_iterations": self.dad_iterations,
            "dad_horizon": self.dad_horizon,
            "synthesis": to_plain(self.synthesis),
            "target": to_plain(self._given_target),
            "delays": self._delays,
            "trial_steps": self.trial_steps,
            "initial_trials": self.initial_trials,
            "policy_trials": self.policy_trials,
            "exploration_trials": self.exploration_trials,
            "exploration": to_plain(self.exploration),
            "act_with": self.act_with,
        }


def default_regressor() -> RandomFourierRidge:
    """250 random Fourier features beside the inputs themselves, with a small ridge: for systems with little noise."""
    return RandomFourierRidge(
        n_frequencies=250, bandwidth=4.0, alpha=1e-8, include_inputs=True, random_state=0
    )
