"""Double pendulum swing-up: bring two links that hang from a motor above it, one upon the other, and hold them.

The equations of motion are those of LAIRLAB's control simulators, which the thesis proposal's Sec. 3.2.3 points to (it
shows no experiment on this one): point masses at the ends of two massless rods, both angles measured from the
vertical. They were checked against Lagrange's equations and hold without a correction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.integrators import rk4
from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas

_LN10 = float(np.log(10.0))


@dataclass(frozen=True, kw_only=True)
class DoublePendulum(System):
    """Two links in a vertical plane, driven at one joint; they hang at the start and shall stand at the end.

    With theta = 0 hanging, D = theta_1 - theta_2, S = m1 + m2 sin(D)^2 (which is m1 + m2 - m2 cos(D)^2), and w the
    angular velocities,

        dw1/dt = -{g (2 m1 + m2) sin(theta_1) + m2 [g sin(theta_1 - 2 theta_2)
                 + 2 (l2 w2^2 + l1 w1^2 cos(D)) sin(D)]} / (2 l1 S) + a1 - d1 w1
        dw2/dt = [(m1 + m2) (l1 w1^2 + g cos(theta_1)) + l2 m2 w2^2 cos(D)] sin(D) / (l2 S) + a2 - d2 w2,

    integrated by RK4 in `substeps` equal parts of dt. The action u is, by `actuation`,

        "shoulder"      a torque on link 1:         a1 = u / (l1^2 S),    a2 = -u cos(D) / (l1 l2 S)
        "elbow"         a torque on link 2, and its reaction on link 1 (the acrobot):
                        a1 = -u (l2 + l1 cos(D)) / (l1^2 l2 S)
                        a2 = u ((m1 + m2) l1 + m2 l2 cos(D)) / (m2 l1 l2^2 S)
        "acceleration"  the source's control:       a1 = u,               a2 = 0.

    The default is the motor at the shoulder, where the source's control acts too. The source's own control is no
    single motor's: that a2 = 0 whatever the elbow's angle takes a second one, which does work of its own.

    | # | state              | unit  |   | # | observation        | range     |   | # | action | range (N m) |
    |---|--------------------|-------|---|---|--------------------|-----------|---|---|--------|-------------|
    | 0 | theta_1            | rad   |   | 0 | cos_theta_1        | -1..1     |   | 0 | drive  | -12..12     |
    | 1 | angular_velocity_1 | rad/s |   | 1 | sin_theta_1        | -1..1     |   |   |        |             |
    | 2 | theta_2            | rad   |   | 2 | cos_theta_2        | -1..1     |   |   |        |             |
    | 3 | angular_velocity_2 | rad/s |   | 3 | sin_theta_2        | -1..1     |   |   |        |             |
    |   |                    |       |   | 4 | angular_velocity_1 | unbounded |   |   |        |             |
    |   |                    |       |   | 5 | angular_velocity_2 | unbounded |   |   |        |             |

    Both angles are from the vertical, so theta_2 is not the elbow's angle, which is theta_2 - theta_1. The drive is in
    N m, or in rad/s^2 with "acceleration".

    Reward, in 0..1, of the state reached, in the shape of the cart-pole's: high, slow and gentle, with
    b(z) = exp(-ln(10) z^2), which falls from 1 to 0.1 at z = 1, and h the height of the tip:

        (1 + h) / 2 * (1 + b(w1/5)) / 2 * (1 + b(w2/5)) / 2 * (4 + b(u/u_max)) / 5
        h = -(l1 cos(theta_1) + l2 cos(theta_2)) / (l1 + l2)

    Start: hanging, every state component uniform within +-start_spread. End: after 200 steps (10 s).
    Versions: v0, the first. `beliefgym/DoublePendulumSwingUpPosition-v0` shows the cosines and sines only.

    Chosen here: the default actuation, the limit of the drive (to hold both links level takes g (m1 l1 + m2 (l1 + l2))
    = 29.4 N m at the shoulder, so 12 N m must swing to and fro), the reward, the start, the length of the episode, and
    3 substeps (without drive and damping, energy drifts by less than 0.3 J within an episode from any state with up to
    35 J, where hanging has -29.4 J and standing +29.4 J; with one substep it drifts by up to 18 J).

    Args:
        length_1: m. length_2: m. mass_1: kg. mass_2: kg, both at the ends of the links.
        damping_1: 1/s. damping_2: 1/s, both of the links' own speeds, as in the source.
        gravity: m/s^2.
        actuation: "shoulder", "elbow" or "acceleration".
        max_drive: N m, or rad/s^2 with "acceleration".
        start_spread: SI units of each component.
        substeps: of RK4 in one control period.

    Reference: LAIRLAB control_simulators (equations and constants); thesis proposal, Sec. 3.2.3, footnote 3.
    """

    length_1: float = 1.0
    length_2: float = 1.0
    mass_1: float = 1.0
    mass_2: float = 1.0
    damping_1: float = 0.0
    damping_2: float = 0.0
    gravity: float = 9.81
    actuation: Literal["shoulder", "elbow", "acceleration"] = "shoulder"
    max_drive: float = 12.0
    start_spread: float = 0.1
    substeps: int = 3

    state_names: ClassVar = ("theta_1", "angular_velocity_1", "theta_2", "angular_velocity_2")
    rates: ClassVar = {"theta_1": "angular_velocity_1", "theta_2": "angular_velocity_2"}
    action_names: ClassVar = ("drive",)
    observation_names: ClassVar = (
        "cos_theta_1",
        "sin_theta_1",
        "cos_theta_2",
        "sin_theta_2",
        "angular_velocity_1",
        "angular_velocity_2",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("length_1", "length_2", "mass_1", "mass_2", "max_drive"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        if self.actuation not in ACTUATIONS:
            raise ValueError(f"expected actuation to be one of {ACTUATIONS}, got {self.actuation!r}")
        if not (isinstance(self.substeps, int) and self.substeps >= 1):
            raise ValueError(f"expected substeps as a whole number of at least 1, got {self.substeps!r}")

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Limits of the drive in N m, or in rad/s^2 with "acceleration"."""
        return np.array([-self.max_drive]), np.array([self.max_drive])

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cosines and sines are bounded, speeds are not."""
        high = np.array([1.0, 1.0, 1.0, 1.0, np.inf, np.inf])
        return -high, high

    def derivative(self, state: Array, action: Array) -> Array:
        """Time derivative of the state, (..., 4), under a drive (..., 1)."""
        xp = array_namespace(state)
        w1, w2, u = state[..., 1], state[..., 3], action[..., 0]
        l1, l2, m1, m2, g = self.length_1, self.length_2, self.mass_1, self.mass_2, self.gravity
        s1, c1 = xp.sin(state[..., 0]), xp.cos(state[..., 0])
        s2, c2 = xp.sin(state[..., 2]), xp.cos(state[..., 2])
        s, c = s1 * c2 - c1 * s2, c1 * c2 + s1 * s2  # of theta_1 - theta_2
        per_s = 1.0 / (m1 + m2 * (s * s))
        square1, square2 = l1 * (w1 * w1), l2 * (w2 * w2)
        twice = (g * (2.0 * m1 + m2)) * s1 + m2 * (g * (s * c2 - c * s2) + 2.0 * (square2 + square1 * c) * s)
        a1 = -twice * per_s * (0.5 / l1)
        a2 = ((m1 + m2) * (square1 + g * c1) + m2 * square2 * c) * s * per_s * (1.0 / l2)
        if self.actuation == "shoulder":
            push = u * per_s * (1.0 / l1)
            a1, a2 = a1 + push * (1.0 / l1), a2 - push * c * (1.0 / l2)
        elif self.actuation == "elbow":
            push = u * per_s * (1.0 / (l1 * l2))
            a1 = a1 - push * ((l2 + l1 * c) * (1.0 / l1))
            a2 = a2 + push * (((m1 + m2) * l1 + m2 * l2 * c) * (1.0 / (m2 * l2)))
        else:
            a1 = a1 + u
        if self.damping_1:
            a1 = a1 - self.damping_1 * w1
        if self.damping_2:
            a2 = a2 - self.damping_2 * w2
        return xp.stack([w1, a1, w2, a2], axis=-1)

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        for _ in range(self.substeps):
            state = rk4(self.derivative, state, action, self.dt / self.substeps)
        return state

    def observe(self, state: Array) -> Array:
        """The cosine and sine of each angle, then the angular velocities."""
        xp = array_namespace(state)
        first, second = state[..., 0], state[..., 2]
        parts = [xp.cos(first), xp.sin(first), xp.cos(second), xp.sin(second), state[..., 1], state[..., 3]]
        return xp.stack(parts, axis=-1)

    def height(self, state: Array) -> Array:
        """Height of the tip over the pivot as a part of the links' length, -1..1."""
        xp = array_namespace(state)
        share = self.length_1 / (self.length_1 + self.length_2)
        return -share * xp.cos(state[..., 0]) - (1.0 - share) * xp.cos(state[..., 2])

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """High, slow and gentle; in 0..1; see the class."""
        xp = array_namespace(next_state)
        w1, w2, u = next_state[..., 1], next_state[..., 3], action[..., 0]
        slow = (1.0 + xp.exp((-_LN10 / 25.0) * (w1 * w1))) * (1.0 + xp.exp((-_LN10 / 25.0) * (w2 * w2)))
        gentle = 4.0 + xp.exp((-_LN10 / self.max_drive**2) * (u * u))
        return (1.0 + self.height(next_state)) * slow * gentle * (1.0 / 40.0)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """A smooth cost that leads to the reward: 4 (1 - h) + (w1^2 + w2^2) / 20 + (u / u_max)^2 / 2."""
        w1, w2, u = state[..., 1], state[..., 3], action[..., 0]
        effort = (0.5 / self.max_drive**2) * (u * u)
        return 4.0 * (1.0 - self.height(state)) + 0.05 * (w1 * w1 + w2 * w2) + effort

    def energy(self, state: Array) -> Array:
        """Kinetic and potential energy in J, 0 at rest at the height of the pivot: (..., 4) -> (...)."""
        xp = array_namespace(state)
        theta_1, w1, theta_2, w2 = (state[..., i] for i in range(4))
        l1, l2, m1, m2, g = self.length_1, self.length_2, self.mass_1, self.mass_2, self.gravity
        v1, v2 = l1 * w1, l2 * w2
        kinetic = 0.5 * (m1 + m2) * v1 * v1 + 0.5 * m2 * v2 * v2 + m2 * v1 * v2 * xp.cos(theta_1 - theta_2)
        return kinetic - g * ((m1 + m2) * l1 * xp.cos(theta_1) + m2 * l2 * xp.cos(theta_2))

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Hanging, every component within +-start_spread."""
        return (2.0 * streams.uniform(4, mask) - 1.0) * self.start_spread

    def expert(self) -> Any:
        """Iterative LQR on the true model about plans from a search, tracked by its gains; LQR once upright."""
        from beliefgym.envs.planning.double_pendulum import double_pendulum_expert

        return double_pendulum_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """Both links, the height to reach, and an arc for the drive at its joint."""
        reach = self.length_1 + self.length_2
        canvas.view(center=(0.0, 0.0), height=2.5 * reach)
        canvas.circle((0.0, 0.0), reach, "guide", width=0.008 * reach)
        canvas.circle((0.0, reach), 0.07 * reach, "target", width=0.015 * reach)
        elbow = (self.length_1 * np.sin(state[0]), -self.length_1 * np.cos(state[0]))
        tip = (elbow[0] + self.length_2 * np.sin(state[2]), elbow[1] - self.length_2 * np.cos(state[2]))
        canvas.rod((0.0, 0.0), elbow, 0.08 * reach, "body")
        canvas.rod(elbow, tip, 0.06 * reach, "body")
        for joint in ((0.0, 0.0), elbow):
            canvas.circle(joint, 0.022 * reach, "background")
        if action is not None:
            at = elbow if self.actuation == "elbow" else (0.0, 0.0)
            turn = -float(action[0]) / self.max_drive  # a positive drive turns counterclockwise
            canvas.turn_arrow(at, 0.16 * reach, turn, "force")


ACTUATIONS = ("shoulder", "elbow", "acceleration")
