"""A T-maze: what is seen at the start decides which arm is right at the end; the task of memory over a known delay.

The maze is a row of places 0..L with an arm on either side of the last one:

                         north  (+1)
    start - 1 - 2 - ... - L
                         south  (-1)

With place p, cue c in {-1, +1}, arm a (0 before one is entered) and turn d in {-1, 0, +1}, the rounded action,

    p <- p + 1 where d = 0 and p < L,      a <- d where d != 0 and p = L,      everything else is a wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas

THIRD = 1.0 / 3.0  # actions beyond it are turns


@dataclass(frozen=True, kw_only=True)
class TMaze(System):
    """A cue at the start of a corridor names the arm to take at its end: the T-maze, by Bakker 2001.

    | # | state | values                    |   | # | observation | values     | is                           |
    |---|-------|---------------------------|   |---|-------------|------------|------------------------------|
    | 0 | place | 0 (start)..length         |   | 0 | at_start    | 0, 1       | place 0                      |
    | 1 | cue   | -1 (south), +1 (north)    |   | 1 | in_corridor | 0, 1       | a place between              |
    | 2 | arm   | -1, +1; 0 before the end  |   | 2 | at_junction | 0, 1       | place length, in no arm      |
    |   |       |                           |   | 3 | cue_seen    | -1, 0, 1   | the cue at place 0, else 0   |
    |   |       |                           |   | 4 | cue         | -1, 1      | the cue at every place       |
    |   |       |                           |   | 5 | place       | 0..length  |                              |

    | # | action | -1..-1/3 | -1/3..1/3 | 1/3..1 |   | the ids | 0     | 1       | 2     |
    |---|--------|----------|-----------|--------|   |---------|-------|---------|-------|
    | 0 | turn   | south    | forward   | north  |   |         | south | forward | north |

    Reward: goal_reward (4) for entering the arm that the cue names; -penalty (-0.1) for entering the other one, and for
    every step into a wall (a turn before the junction, forward at it), which moves nothing; 0 for a step forward.
    Start: at place 0, either cue with probability 1/2. End: an arm is entered (terminated), or the time limit. The
    best return is 4, after length + 1 steps; the best one without memory in the partial form is (4 - 0.1)/2 = 1.95 on
    average, as one arm is as good as the other there.

    | id                       | shows                                        | steps |
    |--------------------------|----------------------------------------------|-------|
    | beliefgym/TMaze-v0       | all six                                      | 50    |
    | beliefgym/TMazeMemory-v0 | at_start, in_corridor, at_junction, cue_seen | 50    |

    In the partial form the cue is seen until the first step forward and never again, and the places of the corridor
    look alike; in an arm every component shown there is 0. `info["hint"]` (with hint=True): cue, place.

    `gym.make(id, length=30)` makes a longer delay. The time limit does not grow with it: 50 steps are five times the
    default length. For a length above 20 or so give `max_episode_steps` too (5 * length, say); from 50 on one must, as
    an episode would end before an arm could be reached.

    Of the source: maze, rewards, start, what is seen where. Unlike there nobody goes back (west), so the cue cannot be
    looked up a second time; the observation has a component for each kind of place, where the source codes all in three
    bits; the time limit is chosen here. The passive T-maze of Ni et al. has the same maze and cue, pays 1 for the right
    arm, and ends after length + 1 steps whatever was done. Versions: v0, the first.

    Args:
        length: steps from the start to the junction, a whole number of at least 1. goal_reward, penalty: see above.
        dt: s, of no consequence but for the speed of a film. actuation_noise_std: on the action before it is rounded.
            process_noise_std: on the state before it is rounded; the nearest possible state counts.

    Reference: Bakker 2001, "Reinforcement learning with long short-term memory", the T-maze;
    Ni et al. 2023, "When do transformers shine in RL?".
    """

    dt: float = 0.2
    length: int = 10
    goal_reward: float = 4.0
    penalty: float = 0.1

    state_names: ClassVar = ("place", "cue", "arm")
    action_names: ClassVar = ("turn",)
    observation_names: ClassVar = ("at_start", "in_corridor", "at_junction", "cue_seen", "cue", "place")
    hint_names: ClassVar = ("cue", "place")

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.length, bool) or not isinstance(self.length, int | np.integer) or self.length < 1:
            raise ValueError(f"expected length as a whole number of at least 1, got {self.length!r}")
        object.__setattr__(self, "length", int(self.length))
        if not (math.isfinite(self.goal_reward) and self.goal_reward > 0):
            raise ValueError(f"expected goal_reward above 0, got {self.goal_reward!r}")
        if not (math.isfinite(self.penalty) and self.penalty >= 0):
            raise ValueError(f"expected penalty of at least 0, got {self.penalty!r}")

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """-1..1."""
        return np.array([-1.0]), np.array([1.0])

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Flags within 0..1, the cue within -1..1, the place within 0..length."""
        low = np.array([0.0, 0.0, 0.0, -1.0, -1.0, 0.0])
        return low, np.array([1.0, 1.0, 1.0, 1.0, 1.0, float(self.length)])

    @property
    def state_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The places there are, the two cues, the two arms."""
        return np.array([0.0, -1.0, -1.0]), np.array([float(self.length), 1.0, 1.0])

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """One step; who is in an arm stays there. See the module."""
        xp = array_namespace(state)
        place, cue, arm = state[..., 0], state[..., 1], state[..., 2]
        none, one = xp.zeros_like(place), xp.ones_like(place)
        d = action[..., 0]
        turn = xp.where(d > THIRD, one, xp.where(d < -THIRD, -one, none))
        at_end, inside = place > self.length - 0.5, xp.abs(arm) > 0.5
        walks = (xp.abs(turn) < 0.5) & ~at_end
        enters = at_end & ~inside
        return xp.stack(
            [place + xp.where(walks, one, none), cue, xp.where(enters, turn, arm)],
            axis=-1,
        )

    def project(self, state: Array) -> Array:
        """The nearest whole place and arm, the sign of the cue; there are no arms but at the junction."""
        xp = array_namespace(state)
        place, cue, arm = state[..., 0], state[..., 1], state[..., 2]
        none, one = xp.zeros_like(place), xp.ones_like(place)
        place = xp.minimum(xp.maximum(xp.floor(place + 0.5), none), none + float(self.length))
        arm = xp.where(arm > 0.5, one, xp.where(arm < -0.5, -one, none))
        arm = xp.where(place > self.length - 0.5, arm, none)
        return xp.stack([place, xp.where(cue < 0.0, -one, one), arm], axis=-1)

    def observe(self, state: Array) -> Array:
        """What kind of place it is, the cue where it is seen, the cue, the place; see the class."""
        xp = array_namespace(state)
        place, cue, arm = state[..., 0], state[..., 1], state[..., 2]
        none, one = xp.zeros_like(place), xp.ones_like(place)
        at_start = xp.where(place < 0.5, one, none)
        at_end = xp.where(place > self.length - 0.5, one, none)
        at_junction = xp.where(xp.abs(arm) > 0.5, none, at_end)
        return xp.stack([at_start, 1.0 - at_start - at_end, at_junction, cue * at_start, cue, place], axis=-1)

    def hint(self, state: Array) -> Array:
        """The cue and the place."""
        return array_namespace(state).stack([state[..., 1], state[..., 0]], axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Of the arm that was entered, or of the wall that was met; see the class. Nothing more inside an arm."""
        xp = array_namespace(next_state)
        none = xp.zeros_like(next_state[..., 0])
        minus = none - self.penalty
        named = next_state[..., 2] * next_state[..., 1]  # the arm times the cue
        entered = xp.where(named > 0.5, none + self.goal_reward, minus)
        walked = xp.where(next_state[..., 0] > state[..., 0] + 0.5, none, minus)
        step = xp.where(xp.abs(named) > 0.5, entered, walked)
        return xp.where(xp.abs(state[..., 2]) > 0.5, none, step)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """The negative reward of the step that the action makes."""
        return -self.reward(state, action, self.flow(state, action))

    def terminated(self, state: Array) -> Array:
        """Where an arm has been entered."""
        return array_namespace(state).abs(state[..., 2]) > 0.5

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """At the start, either cue with probability 1/2."""
        drawn = streams.uniform(1, mask)[:, 0]
        cue = np.where(drawn < 0.5, -1.0, 1.0)
        return np.stack([np.zeros_like(cue), cue, np.zeros_like(cue)], axis=1)

    def expert(self) -> Any:
        """Forward to the junction, then the cue's arm: the best there is."""
        from beliefgym.envs.planning.t_maze import TMazeController

        return TMazeController(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """Corridor and arms from above, the cue (pale where it is not seen), its arm, the agent, its last action."""
        place, cue, arm = (float(value) for value in state)
        end, width = float(self.length), max(1.18 * (self.length + 1.0), 6.0)
        half = max(
            0.5, 0.055 * width
        )  # of the corridor's width: long corridors are drawn wider than one place
        wall, reach = 0.01 * width, 0.29 * width  # an arm is one place, whatever its length in the picture
        canvas.view(center=(0.5 * end, 0.0), width=width)
        for grown, color in ((wall, "joint"), (0.0, "panel")):
            out = half + grown
            canvas.line((-out, 0.0), (end + out, 0.0), 2.0 * out, color)
            canvas.line((end, -reach - out), (end, reach + out), 2.0 * out, color)
        for k in range(self.length if self.length <= 60 else 0):
            if k + 0.5 < end - 0.9 * half:
                canvas.line((k + 0.5, -half), (k + 0.5, half), 0.003 * width, "guide")
        for side in (-1.0, 1.0):
            canvas.circle((end, side * reach), 0.76 * half, "target" if side == cue else "guide", 0.14 * half)
        sign = 1.75 * cue * half
        seen = "target" if place < 0.5 else "guide"
        canvas.arrow((0.0, sign), (0.0, sign + cue * 1.8 * half), 0.36 * half, seen)
        x, y, d = place, arm * reach, None if action is None else float(action[0])
        turn = 0.0 if d is None or abs(d) <= THIRD else math.copysign(1.0, d)
        if turn and not arm:  # into the wall
            canvas.line(
                (x - half, turn * (half + 0.5 * wall)), (x + half, turn * (half + 0.5 * wall)), wall, "force"
            )
            y = 0.36 * turn * half
        canvas.circle((x, y), 0.56 * half, "body")
        if d is not None:
            ahead = np.array([0.0, turn] if turn else [1.0, 0.0])
            start, tip = ((x + r * half * ahead[0], y + r * half * ahead[1]) for r in (0.0, 1.3))
            canvas.arrow(start, tip, 0.22 * half, "force")
