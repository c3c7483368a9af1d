"""Cart-pole swing-up: swing a pole up by pushing its cart, then hold it over the middle of the track.

The equations and constants are those of LAIRLAB's control simulators, which the thesis proposal's Sec. 3.2.3 uses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.integrators import rk4
from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas


@dataclass(frozen=True, kw_only=True)
class CartPole(System):
    """A pole hinged to a cart on a track; the pole hangs at the start.

    With theta = 0 upright, s = sin(theta), c = cos(theta), w = dtheta/dt and D = M + m s^2,

        d2x/dt2     = (-m g s c + m l w^2 s + f m w c + u) / D
        d2theta/dt2 = ((M + m)(g s - f w) - (m l w^2 s + u) c) / (l D),      integrated by RK4.

    | # | state            | unit  |   | # | observation      | range      |   | # | action | range (N) |
    |---|------------------|-------|---|---|------------------|------------|---|---|--------|-----------|
    | 0 | x                | m     |   | 0 | x                | -2.4..2.4  |   | 0 | force  | -10..10   |
    | 1 | velocity         | m/s   |   | 1 | cos_theta        | -1..1      |   |   |        |           |
    | 2 | theta            | rad   |   | 2 | sin_theta        | -1..1      |   |   |        |           |
    | 3 | angular_velocity | rad/s |   | 3 | velocity         | unbounded  |   |   |        |           |
    |   |                  |       |   | 4 | angular_velocity | unbounded  |   |   |        |           |

    Reward, in 0..1, of the state reached (the shape of the swing-up task of dm_control's suite, with smooth
    factors chosen here; b(z) = exp(-ln(10) z^2) falls from 1 to 0.1 at z = 1):

        (1 + cos theta)/2 * (1 + b(x/2))/2 * (1 + b(w/5))/2 * (4 + b(u/u_max))/5

    Start: hanging, every state component uniform within +-start_spread. End: |x| beyond the track (terminated),
    or after 200 steps. The observed x may leave the stated range by the last step's motion; the space says so.
    Versions: v0, the first. `beliefgym/CartPoleSwingUpPosition-v0` shows x, cos_theta and sin_theta only.

    Args:
        cart_mass: kg. pole_mass: kg. length: m, pivot to the pole's point mass. friction: of the hinge, m/s (f w is an
            acceleration). gravity: m/s^2.
        max_force: N. track: half its length, m. start_spread: SI units of each component.

    Reference: thesis proposal, Sec. 3.2.3 (cart-pole swing-up).
    """

    cart_mass: float = 1.0
    pole_mass: float = 0.1
    length: float = 0.5
    friction: float = 0.01
    gravity: float = 9.81
    max_force: float = 10.0
    track: float = 2.4
    start_spread: float = 0.1

    state_names: ClassVar = ("x", "velocity", "theta", "angular_velocity")
    rates: ClassVar = {"x": "velocity", "theta": "angular_velocity"}
    action_names: ClassVar = ("force",)
    observation_names: ClassVar = ("x", "cos_theta", "sin_theta", "velocity", "angular_velocity")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("cart_mass", "pole_mass", "length", "max_force", "track"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Force limits in N."""
        return np.array([-self.max_force]), np.array([self.max_force])

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Only the cosine and sine are bounded: the state that ends an episode lies beyond the track."""
        high = np.array([np.inf, 1.0, 1.0, np.inf, np.inf])
        return -high, high

    def derivative(self, state: Array, action: Array) -> Array:
        """Time derivative of the state, (..., 4), under a force (..., 1)."""
        xp = array_namespace(state)
        velocity, theta, w = state[..., 1], state[..., 2], state[..., 3]
        force = action[..., 0]
        total, m, length, f, g = (
            self.cart_mass + self.pole_mass,
            self.pole_mass,
            self.length,
            self.friction,
            self.gravity,
        )
        s, c = xp.sin(theta), xp.cos(theta)
        d = self.cart_mass + m * (s * s)
        push = (m * length) * (w * w) * s + force
        x_acceleration = (push - (m * g) * s * c + (f * m) * w * c) / d
        theta_acceleration = (total * (g * s - f * w) - push * c) / (length * d)
        return xp.stack([velocity, x_acceleration, w, theta_acceleration], axis=-1)

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """See `System.flow`."""
        return rk4(self.derivative, state, action, self.dt)

    def observe(self, state: Array) -> Array:
        """x, cos(theta), sin(theta), velocity, angular velocity."""
        xp = array_namespace(state)
        theta = state[..., 2]
        return xp.stack([state[..., 0], xp.cos(theta), xp.sin(theta), state[..., 1], state[..., 3]], axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """Upright, near the middle, slow and gentle; in 0..1; see the class."""
        xp = array_namespace(next_state)
        x, theta, w = next_state[..., 0], next_state[..., 2], next_state[..., 3]
        force = action[..., 0]
        near = xp.exp((-_LN10 / 4.0) * (x * x))
        slow = xp.exp((-_LN10 / 25.0) * (w * w))
        gentle = xp.exp((-_LN10 / self.max_force**2) * (force * force))
        return (1.0 + xp.cos(theta)) * (1.0 + near) * (1.0 + slow) * (4.0 + gentle) * (1.0 / 40.0)

    def stage_cost(self, state: Array, action: Array) -> Array:
        """A smooth cost that leads to the reward: 4 (1 - cos theta) + x^2 / 2 + (v^2 + w^2) / 20 + u^2 / 200."""
        xp = array_namespace(state)
        x, v, theta, w = state[..., 0], state[..., 1], state[..., 2], state[..., 3]
        u = action[..., 0]
        return 4.0 * (1.0 - xp.cos(theta)) + 0.5 * (x * x) + 0.05 * (v * v + w * w) + 0.005 * (u * u)

    def terminated(self, state: Array) -> Array:
        """Where the cart has left the track."""
        return array_namespace(state).abs(state[..., 0]) > self.track

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Hanging, every component within +-start_spread."""
        spread = (2.0 * streams.uniform(4, mask) - 1.0) * self.start_spread
        return spread + np.array([0.0, 0.0, np.pi, 0.0])

    def expert(self) -> Any:
        """Iterative LQR on the true model, tracked by its own gains; LQR once upright."""
        from beliefgym.envs.planning.cart_pole import cart_pole_expert

        return cart_pole_expert(self)

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """Track with its ends, cart, pole, and an arrow for the force."""
        force = None if action is None else float(action[0]) / self.max_force
        draw_cart_pole(canvas, float(state[0]), float(state[2]), self.length, self.track, force)


def draw_cart_pole(
    canvas: Canvas, x: float, theta: float, length: float, track: float, force: float | None
) -> None:
    """A cart at x (m) with a pole of a length (m) at theta (rad, 0 up), and its force as a share of the largest."""
    canvas.view(center=(0.0, 0.1 * length), width=2.0 * track + 1.2)
    canvas.line((-track, 0.0), (track, 0.0), 0.03, "guide")
    for end in (-track, track):
        canvas.line((end, -0.12), (end, 0.12), 0.03, "guide")
    if force is not None:
        canvas.arrow((x, 0.0), (x + 0.9 * force, 0.0), 0.05, "force")
    canvas.box((x, 0.0), 0.5, 0.26, "joint")
    tip = (x + length * np.sin(theta), length * np.cos(theta))
    canvas.rod((x, 0.0), tip, 0.09, "body")
    canvas.circle(tip, 0.08, "body")


_LN10 = float(np.log(10.0))
