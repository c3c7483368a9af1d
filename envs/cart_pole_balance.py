"""Cart-pole balancing with two pushes to choose from: the classic of discrete control, in its hidden-state forms.

Physics, limits and reward are those of Gymnasium's CartPole-v1 (Barto, Sutton and Anderson 1983; Florian 2007), to
the last bit: Euler's method with 0.02 s. With s = sin(theta), c = cos(theta), w = dtheta/dt, M = m_c + m_p,

    p           = (u + m_p l w^2 s) / M
    d2theta/dt2 = (g s - c p) / (l (4/3 - m_p c^2 / M)),      d2x/dt2 = p - m_p l d2theta/dt2 c / M

The system takes any force in -10..10 N; the registered ids wrap it in `DiscreteActions`, two pushes of full force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.cart_pole import draw_cart_pole
from beliefgym.envs.system import Array, System

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas


@dataclass(frozen=True, kw_only=True)
class CartPoleBalance(System):
    """A pole (a uniform rod) hinged to a cart; it stands at the start, and the episode ends when it falls.

    | # | state            | unit  |   | # | observation      | ends beyond |   | # | action | range (N)       |
    |---|------------------|-------|---|---|------------------|-------------|---|---|--------|-----------------|
    | 0 | x                | m     |   | 0 | x                | -2.4..2.4   |   | 0 | force  | -10..10; the    |
    | 1 | velocity         | m/s   |   | 1 | velocity         |             |   |   |        | ids: 0 is -10,  |
    | 2 | theta            | rad   |   | 2 | theta            | +-12 deg    |   |   |        | 1 is +10        |
    | 3 | angular_velocity | rad/s |   | 3 | angular_velocity |             |   |   |        |                 |

    Reward: 1 for every step, the last one too. Start: every component uniform within +-0.05. End: the cart beyond
    the track or the pole beyond 12 degrees (terminated), or the time limit.

    | id                                       | shows                            | steps |
    |------------------------------------------|----------------------------------|-------|
    | beliefgym/CartPoleBalance-v0             | all four                         | 500   |
    | beliefgym/CartPoleBalancePosition-v0     | x, theta                         | 500   |
    | beliefgym/CartPoleBalanceNoisyEasy-v0    | x, theta with noise of std 0.1   | 200   |
    | beliefgym/CartPoleBalanceNoisyMedium-v0  | x, theta with noise of std 0.2   | 200   |
    | beliefgym/CartPoleBalanceNoisyHard-v0    | x, theta with noise of std 0.3   | 200   |

    Position-only with 500 steps is rl-baselines3-zoo's `CartPoleNoVel`; the noise levels (in m and rad) and 200 steps
    are POPGym's NoisyPositionOnlyCartPole, whose returns are ours divided by 200. Unlike in POPGym the reset shows no
    more than a step does: the first observation is masked and noisy too. `gym.make(id, noise=0.4)` sets another
    level. Versions: v0, the first.

    Args:
        cart_mass, pole_mass: kg. half_length: m, half the pole. gravity: m/s^2. max_force: N. track: half its length,
            m. max_angle: rad. start_spread: SI units of each component.

    Reference: Gymnasium's CartPole-v1; Morad et al. 2023 (POPGym).
    """

    dt: float = 0.02
    cart_mass: float = 1.0
    pole_mass: float = 0.1
    half_length: float = 0.5
    gravity: float = 9.8
    max_force: float = 10.0
    track: float = 2.4
    max_angle: float = 12 * 2 * np.pi / 360
    start_spread: float = 0.05

    state_names: ClassVar = ("x", "velocity", "theta", "angular_velocity")
    rates: ClassVar = {"x": "velocity", "theta": "angular_velocity"}
    action_names: ClassVar = ("force",)
    observation_names: ClassVar = ("x", "velocity", "theta", "angular_velocity")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("cart_mass", "pole_mass", "half_length", "max_force", "track", "max_angle"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")

    @property
    def action_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Force limits in N."""
        return np.array([-self.max_force]), np.array([self.max_force])

    @property
    def observation_limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """None: the last state of an episode lies beyond the track or the largest angle."""
        return np.full(4, -np.inf), np.full(4, np.inf)

    def flow(self, state: Array, action: Array, disturbance: Array | None = None) -> Array:
        """One step of Euler's method; see the module."""
        xp = array_namespace(state)
        x, velocity, theta, w = (state[..., i] for i in range(4))
        total, moment = self.cart_mass + self.pole_mass, self.pole_mass * self.half_length
        s, c = xp.sin(theta), xp.cos(theta)
        push = (action[..., 0] + moment * (w * w) * s) / total
        turning = (self.gravity * s - c * push) / (
            self.half_length * (4.0 / 3.0 - self.pole_mass * (c * c) / total)
        )
        moving = push - moment * turning * c / total
        dt = self.dt
        return xp.stack(
            [x + dt * velocity, velocity + dt * moving, theta + dt * w, w + dt * turning], axis=-1
        )

    def observe(self, state: Array) -> Array:
        """The state."""
        return state

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """1."""
        return array_namespace(next_state).ones_like(next_state[..., 0])

    def stage_cost(self, state: Array, action: Array) -> Array:
        """The constant reward gives a planner nothing to go by: x^2 + theta^2 + (v^2 + w^2) / 10 + u^2 / 1000."""
        x, v, theta, w = (state[..., i] for i in range(4))
        u = action[..., 0]
        return x * x + theta * theta + 0.1 * (v * v + w * w) + 1e-3 * (u * u)

    def terminated(self, state: Array) -> Array:
        """Where the cart has left the track or the pole has fallen."""
        xp = array_namespace(state)
        return (xp.abs(state[..., 0]) > self.track) | (xp.abs(state[..., 2]) > self.max_angle)

    def initial_state(
        self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Every component uniform within +-start_spread."""
        return (2.0 * streams.uniform(4, mask) - 1.0) * self.start_spread

    def expert(self) -> Any:
        """The steady-state LQR of the linearised model; of two pushes the one nearer to its force is taken."""
        from beliefgym.envs.planning.balancing import balancing_expert

        return balancing_expert(self, np.zeros(4), np.zeros(1))

    def draw(self, canvas: Canvas, state: NDArray[np.float64], action: NDArray[np.float64] | None) -> None:
        """Track with its ends, cart, pole, and an arrow for the force."""
        force = None if action is None else float(action[0]) / self.max_force
        draw_cart_pole(canvas, float(state[0]), float(state[2]), 2 * self.half_length, self.track, force)
