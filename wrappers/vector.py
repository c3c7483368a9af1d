"""The wrappers for vector environments.

Each is the wrapper of the same name in `beliefgym.wrappers`, with the same arguments, around a whole
`gymnasium.vector.VectorEnv`: the same transform on all copies at once, and copy i shows what it would show
alone. All three autoreset modes work; with SAME_STEP, `infos["final_obs"]` is changed as the episode's last
observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorActionWrapper, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from beliefgym.wrappers.action_history import AppendActions, check_length
from beliefgym.wrappers.belief_observation import AppendBelief
from beliefgym.wrappers.discrete_actions import ActionGrid, SpaceKind
from beliefgym.wrappers.observation_delay import DelayObservations, Fill, check_delay
from beliefgym.wrappers.observation_noise import AddNoise, Std
from beliefgym.wrappers.partial_observation import KeepComponents
from beliefgym.wrappers.transform import VectorTransformObservation, require_vector

if TYPE_CHECKING:
    from beliefgym.learning.belief_tracker import Show
    from beliefgym.wrappers.belief_observation import FilterOrPath

__all__ = [
    "ActionHistory",
    "BeliefObservation",
    "DiscreteActions",
    "ObservationDelay",
    "ObservationNoise",
    "PartialObservation",
    "VectorTransformObservation",
]


class PartialObservation(VectorTransformObservation):
    """Shows some components of every copy's observation; see `beliefgym.wrappers.PartialObservation`.

    Args:
        env: a vector environment.
        keep: names, indices and patterns of components, in the order wanted.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], keep: str | Sequence[str | int]) -> None:
        super().__init__(env, partial(KeepComponents, keep=keep))


class ObservationNoise(VectorTransformObservation):
    """Adds Gaussian noise to every copy's observation; see `beliefgym.wrappers.ObservationNoise`.

    Every copy has a random stream of its own: `reset(seed=s)` gives copy i the noise of a single environment
    after `reset(seed=s + i)`.

    Args:
        env: a vector environment.
        std: standard deviation: one for all components, or one for each.
        clip: keep the observation within its bounds.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], std: Std, clip: bool = False) -> None:
        super().__init__(env, partial(AddNoise, std=std, clip=clip))


class ObservationDelay(VectorTransformObservation):
    """Shows every copy's observation of k steps ago; see `beliefgym.wrappers.ObservationDelay`.

    Args:
        env: a vector environment.
        steps: the delay in steps.
        fill: "initial" or "zeros": what to show while the episode is younger than the delay.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], steps: int, fill: Fill = "initial") -> None:
        super().__init__(env, partial(DelayObservations, steps=check_delay(steps, fill), fill=fill))


class ActionHistory(VectorTransformObservation):
    """Appends every copy's previous k actions to its observation; see `beliefgym.wrappers.ActionHistory`.

    Args:
        env: a vector environment.
        length: the number of actions.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], length: int) -> None:
        super().__init__(env, partial(AppendActions, length=check_length(length)))


class BeliefObservation(VectorTransformObservation):
    """Appends the belief of a fitted filter about every copy; see `beliefgym.wrappers.BeliefObservation`.

    Args:
        env: a vector environment.
        filter: a fitted `Filter`, or the path of a file written by `save_filter`.
        include_observation: False shows the belief alone.
        show: "belief" or "hint".
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: FilterOrPath,
        include_observation: bool = True,
        show: Show = "belief",
    ) -> None:
        super().__init__(
            env, partial(AppendBelief, filter=filter, include_observation=include_observation, show=show)
        )


class DiscreteActions(VectorActionWrapper[Any, Any, Any, Any]):
    """Lets every copy's action be chosen from a grid; see `beliefgym.wrappers.DiscreteActions`.

    The action of a copy that is only being reset (NEXT_STEP) counts for nothing, but must be in range.

    Args:
        env: a vector environment.
        bins: points along each action component.
        space: "discrete" or "multi_discrete".
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], bins: int | Sequence[int], space: SpaceKind = "discrete"
    ) -> None:
        require_vector(env, type(self).__name__)
        super().__init__(env)
        self._grid = ActionGrid(env.single_action_space, bins, space)
        self.single_action_space = self._grid.action_space
        self.action_space = batch_space(self.single_action_space, env.num_envs)

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """When finished copies start anew, under the name by which TorchRL asks for it."""
        mode: AutoresetMode = self.metadata["autoreset_mode"]
        return mode

    def actions(self, actions: Any) -> NDArray[Any]:
        """(n,) or (n, n_act) numbers of grid points -> (n, n_act) actions."""
        return self._grid(np.asarray(actions))
