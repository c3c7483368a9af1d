"""Baxter's left arm moves to a target configuration under torque control (thesis proposal, Sec. 3.2.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.baxter_arm import JOINTS, BaxterArm
from beliefgym.envs.system import Array, constant

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas

Seven = tuple[float, float, float, float, float, float, float]
# the pose that Baxter's own interface calls neutral
NEUTRAL: Seven = (0.0, -0.55, 0.0, 0.75, 0.0, 1.26, 0.0)


@dataclass(frozen=True, kw_only=True)
class BaxterReach(BaxterArm):
    """Baxter's left arm is to move to a joint configuration and stay there, held by its motors against gravity.

        M(q) dv/dt + c(q, v) + g(q) + damping v = tau,      dq/dt = v,      integrated by MuJoCo (implicitfast).

    The action is the whole torque of each joint, "in torque control mode with suppression of the inbuilt gravity
    compensation" (thesis): without torque the arm falls. The motors are noisy: each step's torque has Gaussian noise
    with a standard deviation of 1 % of the joint's effort (chosen here; the robot's is not known). What acts stays
    within the efforts.

    | #    | state and observation                                                    | range (rad)          |
    |------|--------------------------------------------------------------------------|----------------------|
    | 0    | s0_angle (shoulder, about the vertical)                                  | -1.70168..1.70168    |
    | 1    | s1_angle (shoulder, up and down)                                         | -2.147..1.047        |
    | 2    | e0_angle (upper arm, about itself)                                       | -3.05418..3.05418    |
    | 3    | e1_angle (elbow)                                                         | -0.05..2.618         |
    | 4    | w0_angle (forearm, about itself)                                         | -3.059..3.059        |
    | 5    | w1_angle (wrist)                                                         | -1.5708..2.094       |
    | 6    | w2_angle (hand, about itself)                                            | -3.059..3.059        |
    | 7-13 | s0_velocity, s1_velocity, e0_velocity, e1_velocity, w0_velocity,         | unbounded (rad/s)    |
    |      | w1_velocity, w2_velocity                                                 |                      |

    | # | action    | range (N m) |   | # | action    | range (N m) |
    |---|-----------|-------------|---|---|-----------|-------------|
    | 0 | s0_torque | -50..50     |   | 4 | w0_torque | -15..15     |
    | 1 | s1_torque | -100..100   |   | 5 | w1_torque | -15..15     |
    | 2 | e0_torque | -50..50     |   | 6 | w2_torque | -15..15     |
    | 3 | e1_torque | -50..50     |   |   |           |             |

    MuJoCo takes 20 steps of 2.5 ms in a control period. Joint limits are its soft ones with a time constant of 10 ms
    (chosen here), so that an angle may be beyond its range by a few tenths of a rad for a moment. Contacts are off: the
    arm passes through itself, the torso and the floor. The robot's rated speeds (1.5 and 4 rad/s) are not enforced.
    The springs that carry a part of the real arm's weight are left out.

    Reward, in 0..1, of the state reached (chosen here), with means over the seven joints, e = q - target in units of
    0.2 rad, v in rad/s, and u = torque / effort:

        mean(1 / (1 + e^2)) * (0.8 + 0.1 mean(1 / (1 + v^2)) + 0.1 (1 - mean(u^2)))

    Cost (`stage_cost`), quadratic as the thesis's Eq. 3.15: |e|^2 (rad) + 0.01 |v|^2 + 0.01 |u - u_0|^2, u_0 the torque
    that holds the target.

    Start: angles uniform in the middle 80 % of each joint's range, velocities uniform within +-0.1 rad/s. End: after
    200 steps of 0.05 s (truncated). The rate, the length, the noise, the start and the target were chosen here: the
    thesis does not give them. The target is the pose that the robot's interface calls neutral.
    Versions: v0, the first. `beliefgym/BaxterReachPosition-v0` shows the seven angles only.

    Args:
        target: rad, the joint angles to reach.
        damping: N m s/rad of every joint (0.7 in the robot's description; other published models have 0).
        armature: kg m^2 of every joint. gravity: m/s^2.
        start_range: part of each joint's range, around its middle, that start angles are uniform in.
        start_speed: rad/s; start velocities are uniform within +-this.

    Raises:
        ValueError: a target beyond the joint limits.

    Reference: thesis proposal, Sec. 3.2.3 (Baxter robot, Fig. 3.14).
    """

    target: Seven = NEUTRAL

    state_names: ClassVar = tuple(f"{joint}_{part}" for part in ("angle", "velocity") for joint in JOINTS)
    rates: ClassVar = {f"{joint}_angle": f"{joint}_velocity" for joint in JOINTS}
    observation_names: ClassVar = state_names

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "target", tuple(float(angle) for angle in self.target))
        low, high = self.arm.limits
        if len(self.target) != 7:
            raise ValueError(f"expected a target of 7 joint angles, got {len(self.target)}")
        for joint, angle, least, most in zip(JOINTS, self.target, low, high, strict=True):
            if not least <= angle <= most:
                raise ValueError(
                    f"expected the target of {joint} within {least:g}..{most:g} rad, got {angle!r}"
                )

    def observe(self, state: Array) -> Array:
        """The state: angles and velocities."""
        return state

    def nearness(self, state: Array) -> Array:
        """mean(1 / (1 + (e / 0.2 rad)^2)) over the joints."""
        error = (state[..., :7] - constant(np.array(self.target), state)) * 5.0
        return array_namespace(state).mean(1.0 / (1.0 + error * error), axis=-1)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """Quadratic in the distance from the target at rest, and in the torque beyond the one that holds it."""
        error = state[..., :7] - constant(np.array(self.target), state)
        held = self.arm.gravity_torque(np.array(self.target))
        return self.reaching_cost(error, state[..., 7:14], action - constant(held, action))

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Anywhere in the middle of the joint ranges, almost at rest."""
        return self.initial_motion(streams, mask)

    def expert(self) -> Any:
        """Inverse dynamics towards the target, and the LQR of MuJoCo's linearisation near it."""
        from beliefgym.envs.planning.arm import joint_reach_expert

        return joint_reach_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """The arm on its pedestal, and the target as a ghost."""
        from beliefgym.envs.arm_picture import draw_baxter

        draw_baxter(canvas, self.arm, state[:7], ghost=np.array(self.target))
