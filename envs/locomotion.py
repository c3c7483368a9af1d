"""Gymnasium's planar MuJoCo tasks with hidden velocities: hopper, walker, cheetah, swimmer and inverted pendulum.

Each class here is Gymnasium's of version 5 with a true state that can be read and set, and a trained expert (see
true_state.py). The registered ids show the positions only, the index sets of the recurrent predictive-state policies
of Hefny et al. (ICML 2018), who took InvertedPendulum, Swimmer, Hopper and Walker2d; HalfCheetah was added here in the
same way. Velocities have then to be inferred from a history, which is what belief states are for.

The expert stands in for a planner, of which there is none: Stable-Baselines3's PPO, trained on the full observation;
its configuration and return are in reference_policies/. It is a yardstick, not an optimum: a score above 1 is possible.
"""

from __future__ import annotations

from typing import Any

from gymnasium.envs.mujoco import half_cheetah_v5, hopper_v5, inverted_pendulum_v5, swimmer_v5, walker2d_v5

from beliefgym.envs.planar_picture import View
from beliefgym.envs.true_state import TrueState


class HopperEnv(TrueState, hopper_v5.HopperEnv):
    """Position-only hopper: one leg that is to hop forward, Gymnasium's Hopper-v5 with its velocities hidden.

    | state | unit | the agent sees | index in Hopper-v5 |
    |---|---|---|---|
    | qpos_rootx: place along the track | m | no | left out there too |
    | qpos_rootz: height of the torso | m | yes | 0 |
    | qpos_rooty: lean of the torso | rad | yes | 1 |
    | qpos_thigh_joint | rad | yes | 2 |
    | qpos_leg_joint | rad | yes | 3 |
    | qpos_foot_joint | rad | yes | 4 |
    | qvel_rootx, qvel_rootz | m/s | no | 5, 6 |
    | qvel_rooty, qvel_thigh_joint, qvel_leg_joint, qvel_foot_joint | rad/s | no | 7 to 10 |

    | action | bounds | unit |
    |---|---|---|
    | torque_thigh_joint, torque_leg_joint, torque_foot_joint | -1..1 | 200 N m |

    Reward: 1 while healthy + forward speed in m/s - 0.001 |action|^2, a step of 0.008 s.
    Start: (0, 1.25, 0, 0, 0, 0) and rest, each component plus U(-0.005, 0.005).
    End: height not above 0.7 m, lean beyond 0.2 rad, or a component from qpos_rooty on beyond 100; or 1000 steps.
    Info: as Gymnasium's, x_velocity among them: for logs, not for agents.
    Parameters: those of Gymnasium's class, and `hint`, `render_mode`, `shown` (see `TrueState`).
    Expert: trained full-state PPO, reference_policies/Hopper.json.

    Version 0: Gymnasium's version 5.
    Sources: the task, Gymnasium's Hopper-v5 (Erez, Tassa, Todorov 2012); the index set 0 to 4, Hefny et al. 2018.
    """

    reference = "Hopper"
    velocity_limit = 10.0
    view = View(plane="xz", height=2.4, centre=0.85, floor=True)

    def over(self) -> bool:
        """Whether the present state ends an episode."""
        return bool(self._terminate_when_unhealthy and not self.is_healthy)


class Walker2dEnv(TrueState, walker2d_v5.Walker2dEnv):
    """Position-only walker: two legs that are to walk forward, Gymnasium's Walker2d-v5 with its velocities hidden.

    | state | unit | the agent sees | index in Walker2d-v5 |
    |---|---|---|---|
    | qpos_rootx: place along the track | m | no | left out there too |
    | qpos_rootz: height of the torso | m | yes | 0 |
    | qpos_rooty: lean of the torso | rad | yes | 1 |
    | qpos_thigh_joint, qpos_leg_joint, qpos_foot_joint | rad | yes | 2 to 4 |
    | qpos_thigh_left_joint, qpos_leg_left_joint, qpos_foot_left_joint | rad | yes | 5 to 7 |
    | qvel_rootx, qvel_rootz | m/s | no | 8, 9 |
    | qvel_rooty, qvel_thigh_joint, qvel_leg_joint, qvel_foot_joint | rad/s | no | 10 to 13 |
    | qvel_thigh_left_joint, qvel_leg_left_joint, qvel_foot_left_joint | rad/s | no | 14 to 16 |

    | action | bounds | unit |
    |---|---|---|
    | torque_thigh_joint, torque_leg_joint, torque_foot_joint | -1..1 | 100 N m |
    | torque_thigh_left_joint, torque_leg_left_joint, torque_foot_left_joint | -1..1 | 100 N m |

    Reward: 1 while healthy + forward speed in m/s - 0.001 |action|^2, a step of 0.008 s.
    Start: (0, 1.25, 0, 0, 0, 0, 0, 0, 0) and rest, each component plus U(-0.005, 0.005).
    End: height outside 0.8..2 m or lean beyond 1 rad; or 1000 steps.
    Info: as Gymnasium's, x_velocity among them: for logs, not for agents.
    Parameters: those of Gymnasium's class, and `hint`, `render_mode`, `shown` (see `TrueState`).
    Expert: trained full-state PPO, reference_policies/Walker2d.json.

    Version 0: Gymnasium's version 5.
    Sources: the task, Gymnasium's Walker2d-v5 (Erez, Tassa, Todorov 2012); the index set 0 to 7, Hefny et al. 2018.
    """

    reference = "Walker2d"
    velocity_limit = 10.0
    view = View(plane="xz", height=2.4, centre=0.85, floor=True, far="_left")

    def over(self) -> bool:
        """Whether the present state ends an episode."""
        return bool(self._terminate_when_unhealthy and not self.is_healthy)


class HalfCheetahEnv(TrueState, half_cheetah_v5.HalfCheetahEnv):
    """Position-only half cheetah: to run forward, Gymnasium's HalfCheetah-v5 with its velocities hidden.

    | state | unit | the agent sees | index in HalfCheetah-v5 |
    |---|---|---|---|
    | qpos_rootx: place along the track | m | no | left out there too |
    | qpos_rootz: height of the torso, 0 at the start | m | yes | 0 |
    | qpos_rooty: lean of the torso | rad | yes | 1 |
    | qpos_bthigh, qpos_bshin, qpos_bfoot: the back leg | rad | yes | 2 to 4 |
    | qpos_fthigh, qpos_fshin, qpos_ffoot: the front leg | rad | yes | 5 to 7 |
    | qvel_rootx, qvel_rootz | m/s | no | 8, 9 |
    | qvel_rooty, qvel_bthigh, qvel_bshin, qvel_bfoot | rad/s | no | 10 to 13 |
    | qvel_fthigh, qvel_fshin, qvel_ffoot | rad/s | no | 14 to 16 |

    | action | bounds | unit |
    |---|---|---|
    | torque_bthigh, torque_bshin, torque_bfoot | -1..1 | 120, 90, 60 N m |
    | torque_fthigh, torque_fshin, torque_ffoot | -1..1 | 120, 60, 30 N m |

    Reward: forward speed in m/s - 0.1 |action|^2, a step of 0.05 s.
    Start: zero, each position plus U(-0.1, 0.1), each velocity plus N(0, 0.1).
    End: 1000 steps.
    Info: as Gymnasium's, x_velocity among them: for logs, not for agents.
    Parameters: those of Gymnasium's class, and `hint`, `render_mode`, `shown` (see `TrueState`).
    Expert: trained full-state PPO, reference_policies/HalfCheetah.json.

    Version 0: Gymnasium's version 5. Trajectories differ between MuJoCo 3 and 4: compare only results of one version.
    Sources: the task, Gymnasium's HalfCheetah-v5 (Wawrzynski 2009); the index set 0 to 7 was chosen here, all
    positions but the place along the track, as Hefny et al. 2018 have it for Walker2d.
    """

    reference = "HalfCheetah"
    view = View(plane="xz", height=2.4, centre=0.75, floor=True)


class SwimmerEnv(TrueState, swimmer_v5.SwimmerEnv):
    """Position-only swimmer: three links in a viscous fluid, Gymnasium's Swimmer-v5 with its velocities hidden.

    | state | unit | the agent sees | index in Swimmer-v5 |
    |---|---|---|---|
    | qpos_slider1, qpos_slider2: place of the front tip | m | no | left out there too |
    | qpos_free_body_rot: heading of the front link | rad | yes | 0 |
    | qpos_motor1_rot, qpos_motor2_rot | rad | yes | 1, 2 |
    | qvel_slider1, qvel_slider2 | m/s | no | 3, 4 |
    | qvel_free_body_rot, qvel_motor1_rot, qvel_motor2_rot | rad/s | no | 5 to 7 |

    | action | bounds | unit |
    |---|---|---|
    | torque_motor1_rot, torque_motor2_rot | -1..1 | 150 N m |

    Reward: speed along x in m/s - 0.0001 |action|^2, a step of 0.04 s.
    Start: zero, each component plus U(-0.1, 0.1).
    End: 1000 steps.
    Info: as Gymnasium's, x_velocity among them: for logs, not for agents.
    Parameters: those of Gymnasium's class, and `hint`, `render_mode`, `shown` (see `TrueState`).
    Expert: trained full-state PPO, reference_policies/Swimmer.json.

    Version 0: Gymnasium's version 5.
    Sources: the task, Gymnasium's Swimmer-v5 (Coulom 2002); the index set 0 to 2, Hefny et al. 2018.
    """

    reference = "Swimmer"
    view = View(plane="xy", height=5.0)


class InvertedPendulumEnv(TrueState, inverted_pendulum_v5.InvertedPendulumEnv):
    """Position-only inverted pendulum: a pole on a cart, Gymnasium's InvertedPendulum-v5 with its velocities hidden.

    | state | unit | the agent sees | index in InvertedPendulum-v5 |
    |---|---|---|---|
    | qpos_slider: place of the cart, -1..1 | m | yes | 0 |
    | qpos_hinge: angle of the pole, 0 up | rad | yes | 1 |
    | qvel_slider | m/s | no | 2 |
    | qvel_hinge | rad/s | no | 3 |

    | action | bounds | unit |
    |---|---|---|
    | force_slider | -3..3 | 100 N |

    Reward: 1 a step of 0.04 s while the pole stands, 0 at its fall.
    Start: upright at rest, each component plus U(-0.01, 0.01).
    End: the angle beyond 0.2 rad; or 1000 steps.
    Info: as Gymnasium's.
    Parameters: those of Gymnasium's class, and `hint`, `render_mode`, `shown` (see `TrueState`).
    Expert: trained full-state PPO, reference_policies/InvertedPendulum.json.

    Version 0: Gymnasium's version 5.
    Sources: the task, Gymnasium's InvertedPendulum-v5; the index set 0 and 1, Hefny et al. 2018.
    """

    reference = "InvertedPendulum"
    view = View(plane="xz", height=2.6, centre=0.35, follow=False)

    def over(self) -> bool:
        """Whether the present state ends an episode."""
        return bool(abs(self.data.qpos[1]) > 0.2)


TASKS: dict[str, type[Any]] = {
    "Hopper": HopperEnv,
    "Walker2d": Walker2dEnv,
    "HalfCheetah": HalfCheetahEnv,
    "Swimmer": SwimmerEnv,
    "InvertedPendulum": InvertedPendulumEnv,
}
