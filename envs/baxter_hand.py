"""Baxter's left arm brings its hand to a place in the air that is drawn anew for each episode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.baxter import BaxterReach
from beliefgym.envs.baxter_arm import BaxterArm, Floats
from beliefgym.envs.system import Array

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas

ROUNDS = 1000  # of drawing targets, before they are called impossible


@dataclass(frozen=True, kw_only=True)
class BaxterReachHand(BaxterArm):
    """Baxter's left hand is to reach a place and stay there, the arm held by its motors against gravity.

    The arm, its torques, their noise (1 % of the efforts), its start and its limits are those of `BaxterReach`;
    contacts are off. The place is a part of the state that does not change, and is shown to the agent.

    | #    | state                                                      | unit  |
    |------|------------------------------------------------------------|-------|
    | 0-6  | s0_angle, s1_angle, e0_angle, e1_angle, w0_angle,          | rad   |
    |      | w1_angle, w2_angle                                         |       |
    | 7-13 | s0_velocity, s1_velocity, e0_velocity, e1_velocity,        | rad/s |
    |      | w0_velocity, w1_velocity, w2_velocity                      |       |
    | 14-16| target_x, target_y, target_z: forwards, left and up in the | m     |
    |      | torso's frame                                              |       |

    | #     | observation (all unbounded)                               | unit  |
    |-------|-----------------------------------------------------------|-------|
    | 0-13  | angles and velocities, as in the state                    |       |
    | 14-16 | target_x, target_y, target_z                              | m     |
    | 17-19 | hand_x, hand_y, hand_z: where the hand is                 | m     |

    | # | action    | range (N m) |   | # | action    | range (N m) |
    |---|-----------|-------------|---|---|-----------|-------------|
    | 0 | s0_torque | -50..50     |   | 4 | w0_torque | -15..15     |
    | 1 | s1_torque | -100..100   |   | 5 | w1_torque | -15..15     |
    | 2 | e0_torque | -50..50     |   | 6 | w2_torque | -15..15     |
    | 3 | e1_torque | -50..50     |   |   |           |             |

    Reward, in 0..1, of the state reached (chosen here), with the hand's distance D from the target in m, means over
    the seven joints, v in rad/s and u = torque / effort:

        1 / (1 + (D / 0.1)^2) * (0.8 + 0.1 mean(1 / (1 + v^2)) + 0.1 (1 - mean(u^2)))

    Start: angles uniform in the middle 80 % of each joint's range, velocities uniform within +-0.1 rad/s. The target is
    where the hand is in another such configuration, drawn again until it lies above the table and in front of the
    robot: so that every target can be reached. End: after 200 steps of 0.05 s (truncated). All of this was chosen here;
    it is not in the thesis. Versions: v0, the first. `beliefgym/BaxterReachHandPosition-v0` shows the seven angles and
    the target, and neither velocities nor the hand.

    Args:
        table: m, least height of targets in the torso's frame (whose origin is about 0.93 m above the floor).
        front: m, least distance of targets forwards of the torso's middle.
        damping: N m s/rad of every joint (0.7 in the robot's description; other published models have 0).
        armature: kg m^2 of every joint. gravity: m/s^2.
        start_range: part of each joint's range, around its middle, that start angles are uniform in.
        start_speed: rad/s; start velocities are uniform within +-this.

    Reference: thesis proposal, Sec. 3.2.3 (Baxter robot), for the arm and its torques.
    """

    table: float = -0.1
    front: float = 0.3

    state_names: ClassVar = (*BaxterReach.state_names, "target_x", "target_y", "target_z")
    observation_names: ClassVar = (*state_names, "hand_x", "hand_y", "hand_z")

    def observe(self, state: Array) -> Array:
        """The state, and where the hand is."""
        xp = array_namespace(state)
        return xp.concat([state, self.arm.tip_position(state[..., :7])], axis=-1)

    def nearness(self, state: Array) -> Array:
        """1 / (1 + (D / 0.1 m)^2)."""
        miss = (self.arm.tip_position(state[..., :7]) - state[..., 14:17]) * 10.0
        return 1.0 / (1.0 + array_namespace(state).sum(miss * miss, axis=-1))

    def stage_cost(self, state: Array, action: Array) -> Array:
        """100 D^2 + 0.01 |v|^2 + 0.01 |torque / effort|^2."""
        miss = (self.arm.tip_position(state[..., :7]) - state[..., 14:17]) * 10.0
        return self.reaching_cost(miss, state[..., 7:14], action)

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """The arm anywhere in the middle of its joint ranges, almost at rest; a target that it can reach."""
        motion = self.initial_motion(streams, mask)
        return np.concatenate([motion, self._draw_targets(streams, mask)], axis=1)

    def _draw_targets(self, streams: RandomStreams, mask: NDArray[np.bool_] | None) -> Floats:
        """(n, 3) m.

        Raises:
            ValueError: none found: table or front leave no room.
        """
        targets = np.zeros((len(streams), 3))
        waiting = np.ones(len(streams), dtype=np.bool_) if mask is None else mask.copy()
        for _ in range(ROUNDS):
            hand = self.arm.tip_position(self.draw_angles(streams, waiting, self.start_range))
            found = waiting & (hand[:, 2] >= self.table) & (hand[:, 0] >= self.front)
            targets[found] = hand[found]
            waiting &= ~found
            if not waiting.any():
                return targets
        raise ValueError(
            f"found no place for the hand in {ROUNDS} drawings of copy {int(np.argmax(waiting))}; expected table and "
            f"front to leave room, got table={self.table:g} m, front={self.front:g} m, start_range={self.start_range:g}"
        )

    def expert(self) -> Any:
        """Inverse kinematics at the start, then inverse dynamics towards the configuration."""
        from beliefgym.envs.planning.arm import hand_reach_expert

        return hand_reach_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The arm on its pedestal, and the place to reach."""
        from beliefgym.envs.arm_picture import draw_baxter

        draw_baxter(canvas, self.arm, state[:7], place=state[14:17])
