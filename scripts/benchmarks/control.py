"""`beliefgym benchmark control`: planning and model-based learning against what a user would pick instead.

- One iLQR solve of the cart-pole swing-up (60 steps, force limits, the true model), from the same first guess to the
  same tolerance: ours with automatic differentiation, ours with central differences, and crocoddyl's BoxFDDP on
  the same dynamics and cost written for it in plain Python (its derivatives by its own NumDiff) where it is
  installed. Then a batch of 64 starts, which the rival solves one after the other.
- The LQR of the 21-D helicopter: linearise and solve the Riccati equation, against python-control alone (`nlsys`,
  `linearize` by finite differences, `dlqr`).
- One whole loop of DaD+Control on the cart-pole: 1 exploration trial and 5 policy trials with their models and plans.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from typing import Any

import control
import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from beliefgym.agents.dad_control import DaDControl
from beliefgym.envs.cart_pole import CartPole
from beliefgym.envs.helicopter import Helicopter
from beliefgym.envs.planning import ILQR
from beliefgym.envs.planning.model_lqr import LinearQuadraticProblem
from beliefgym.envs.planning.receding_horizon import RecedingHorizon
from beliefgym.scripts.benchmarks.dad import product_rate
from beliefgym.scripts.benchmarks.measuring import Rate, rates, row
from beliefgym.scripts.reproductions.control_swing_up import TRIAL_STEPS, swing_up_task

Floats = NDArray[np.float64]
HORIZON, BATCH = 60, 64
ITERATIONS, TOLERANCE = 100, 1e-6
LOOP_TRIALS, LOOP_SECONDS, LOOP_SEEDS = 6, 10.0, 5
SAME = 1e-3  # relative: how far the solutions' costs may be apart


def run(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure; one thread."""
    torch.set_num_threads(1)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows, limits = _swing_up(told)
        told("helicopter LQR")
        rows += _regulator(limits)
        told("DaD+Control loop")
        rows += _loop(limits)
    return rows, limits


class CentralDifferences:
    """The cart-pole with derivatives by central differences of `flow`, in one batch."""

    def __init__(self, system: CartPole) -> None:
        self.system = system
        self.n_state, self.n_action, self.action_limits = (
            system.n_state,
            system.n_action,
            system.action_limits,
        )
        self.flow, self.stage_cost, self.clip = system.flow, system.stage_cost, system.clip

    def derivatives(self, state: Floats, action: Floats) -> tuple[Floats, Floats]:
        """A (..., 4, 4) and B (..., 4, 1)."""
        n = self.n_state
        both = np.concatenate([state, action], axis=-1)[..., None, :]
        moved = 1e-5 * np.eye(both.shape[-1])
        ahead, behind = both + moved, both - moved
        slopes = self.flow(ahead[..., :n], ahead[..., n:]) - self.flow(behind[..., :n], behind[..., n:])
        jacobian = np.swapaxes(slopes, -1, -2) / 2e-5
        return jacobian[..., :n], jacobian[..., n:]


def _swing_up(told: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    system = CartPole()
    rng = np.random.default_rng(0)
    starts = np.array([0.0, 0.0, np.pi, 0.0]) + rng.uniform(-0.1, 0.1, (BATCH, 4))
    guesses = RecedingHorizon(model=system, horizon=HORIZON, angles=(2,), candidates=2)._guesses(starts)[:, 1]
    costs: dict[str, float] = {}

    def ours(name: str, model: Any, n: int) -> Callable[[], int]:
        planner = ILQR(system=model, horizon=HORIZON, max_iterations=ITERATIONS, tolerance=TOLERANCE)

        def solve() -> int:
            costs[name] = float(planner.solve(starts[:n], guesses[:n]).cost[0])
            return n

        return solve

    contestants = {
        "ours": ours("ours", system, 1),
        "ours, batch of 64": ours("ours, batch of 64", system, BATCH),
        "ours with central differences": ours("ours with central differences", CentralDifferences(system), 1),
    }
    limits: dict[str, Any] = {}
    crocoddyl = _crocoddyl(system)
    if crocoddyl is None:
        limits["crocoddyl"] = "not installed here: pip install crocoddyl"
    else:

        def rival() -> int:
            costs["crocoddyl"] = crocoddyl(starts[0], guesses[0])
            return 1

        contestants["crocoddyl"] = rival
    told("swing-up solves")
    measured = rates(contestants, repeats=5, seconds=2.0)
    limits["cost of the plan from the first start"] = dict(costs)
    rows = []
    for rival_name in ("ours with central differences", "crocoddyl"):
        if rival_name not in measured:
            continue
        same = abs(costs[rival_name] / costs["ours"] - 1.0) < SAME
        note = "" if same else f" (its cost is {costs[rival_name]:.4g}, ours {costs['ours']:.4g})"
        for name in ("ours", "ours, batch of 64"):
            what = f"swing-up plans/s, {'one start' if name == 'ours' else '64 starts'}"
            rows.append(row(what, measured[name], rival_name + note, measured[rival_name]))
    flops = _flops_of_an_iteration(250)
    limits["FLOPs of one iLQR iteration on a learned model (250 frequencies, 1 start)"] = flops
    limits["GFLOP/s"] = {"matrix product (dgemm 1000 x 1000)": product_rate() / 1e9}
    return rows, limits


def _flops_of_an_iteration(m: int) -> dict[str, float]:
    """Of the parts: nine roll-outs, the derivatives, the backward pass (n = 4 states, 1 action, T = 60)."""
    n, inputs, steps = 4, 6, 9
    features = 2.0 * inputs * m + 10.0 * m
    return {
        "roll-outs": HORIZON * steps * (features + 2.0 * 2 * m * n),
        "derivatives": HORIZON * (features + 3.0 * n * m + 2.0 * n * m * inputs),
        "backward pass": HORIZON * (4.0 * (n + 1) * n * n + 4.0 * (n + 1) ** 2 * n),
    }


def _regulator(limits: dict[str, Any]) -> list[dict[str, Any]]:
    system = Helicopter()
    trim, still = system.trim, np.zeros(4)
    coordinates = _ErrorSystem(system)
    gains: dict[str, Floats] = {}

    def ours() -> int:
        gains["ours"] = LinearQuadraticProblem.at(coordinates, np.zeros(20), still).steady_state()[0]
        return 1

    problem = LinearQuadraticProblem.at(coordinates, np.zeros(20), still)

    def plain() -> int:
        model = control.nlsys(
            lambda t, x, u, params: coordinates.flow(np.asarray(x), np.asarray(u)),
            None,
            inputs=4,
            outputs=20,
            states=20,
            dt=system.dt,
        )
        linear = model.linearize(np.zeros(20), still)
        gain, _, _ = control.dlqr(
            linear.A,
            linear.B,
            problem.state_weight,
            problem.action_weight,
            problem.cross_weight,
            method="scipy",
        )
        gains["python-control"] = np.asarray(gain)
        return 1

    measured = rates({"ours": ours, "python-control": plain}, repeats=5, seconds=1.0)
    difference = float(np.abs(gains["ours"] - gains["python-control"]).max() / np.abs(gains["ours"]).max())
    limits["largest relative difference of the helicopter's gains"] = (
        f"{difference:.2g} (its derivatives are one-sided)"
    )
    limits["trim"] = f"residual {float(np.abs(system.flow(trim, still) - trim).max()):.1g}"
    return [
        row(
            "helicopter LQR syntheses/s",
            measured["ours"],
            "python-control, finite differences",
            measured["python-control"],
        )
    ]


class _ErrorSystem:
    """The helicopter's dynamics in the 20 error coordinates that the agents use."""

    n_state, n_action = 20, 4

    def __init__(self, system: Helicopter) -> None:
        from beliefgym.agents.coordinates import Coordinates

        self.coordinates = Coordinates.of(system.observation_names, system)
        self.cost = self.coordinates.cost_of(system)
        self.system, self.action_limits = system, system.action_limits
        self.stage_cost, self.clip = self.cost, system.clip

    def flow(self, x: Any, u: Any) -> Any:
        """(..., 20), (..., 4) -> (..., 20); on torch too."""
        from beliefgym.envs.quaternions import conjugate, product

        state = self.cost.state(x)
        after = self.system.flow(state, u)
        parts = [after[..., i] for i in range(17)]
        attitude = product(
            conjugate(list(self.coordinates.target_attitude or ())), [after[..., 17 + i] for i in range(4)]
        )
        xp = torch if isinstance(x, torch.Tensor) else np
        return xp.stack([*parts, *attitude[:3]], axis=-1)  # type: ignore[attr-defined]


def _loop(limits: dict[str, Any]) -> list[dict[str, Any]]:
    """Seconds of one loop; the trials of the simulated system are in them."""
    task = swing_up_task()
    DaDControl(task, seed=99, trial_steps=TRIAL_STEPS).run_iterations(1)  # load everything
    seconds = []
    for seed in range(LOOP_SEEDS):
        started = time.perf_counter()
        agent = DaDControl(task, seed=seed, trial_steps=TRIAL_STEPS)
        agent.run_iterations(LOOP_TRIALS - 1).fit_policy()
        seconds.append(time.perf_counter() - started)
    value = float(np.median(seconds))
    limits["one loop, seconds of system time"] = LOOP_TRIALS * TRIAL_STEPS * task.make().unwrapped.system.dt  # type: ignore[attr-defined]
    iterations = [60.0 * (LOOP_TRIALS - 1) / s for s in seconds]
    rate = Rate(float(np.median(iterations)), min(iterations), max(iterations))
    return [
        {
            "what": f"seconds for a loop of {LOOP_TRIALS} trials (at most)",
            "ours": {"value": value, "interval": [min(seconds), max(seconds)]},
            "rival_name": "",
            "rival": None,
            "ratio": None,
            "target": LOOP_SECONDS,
            "meets": value <= LOOP_SECONDS,
        },
        {
            "what": "DAgger iterations (trial, model, plans) a minute",
            "ours": rate.to_dict(),
            "rival_name": "",
            "rival": None,
            "ratio": None,
            "target": None,
            "meets": None,
        },
    ]


def _crocoddyl(system: CartPole) -> Callable[[Floats, Floats], float] | None:
    """(start, first guess) -> cost of crocoddyl's plan; None where it is not installed."""
    try:
        import crocoddyl
    except ImportError:
        return None

    class SwingUp(crocoddyl.ActionModelAbstract):  # type: ignore[misc]
        """The cart-pole of envs/cart_pole.py in scalar Python, the fastest that plain Python has for one state."""

        def __init__(self) -> None:
            crocoddyl.ActionModelAbstract.__init__(self, crocoddyl.StateVector(4), 1, 5)
            self.u_lb, self.u_ub = (np.array(limit) for limit in system.action_limits)

        def calc(self, data: Any, x: Floats, u: Floats | None = None) -> None:
            """The next state and the cost as a sum of squares, so that Gauss-Newton is exact in form."""
            force = 0.0 if u is None else float(u[0])
            p, v, theta, w = (float(value) for value in x)
            data.xnext = np.array(_scalar_rk4(system, (p, v, theta, w), force))
            if u is None:
                data.cost = 0.0
                data.r = np.zeros(5)
                return
            residual = np.array(
                [
                    4.0 * math.sin(0.5 * theta),
                    p,
                    math.sqrt(0.1) * v,
                    math.sqrt(0.1) * w,
                    math.sqrt(0.01) * force,
                ]
            )
            data.r = residual
            data.cost = 0.5 * float(residual @ residual)

    model = SwingUp()
    numeric = crocoddyl.ActionModelNumDiff(model, True)
    numeric.u_lb, numeric.u_ub = model.u_lb, model.u_ub
    end = crocoddyl.ActionModelNumDiff(model, True)

    def solve(start: Floats, guess: Floats) -> float:
        problem = crocoddyl.ShootingProblem(np.array(start), [numeric] * HORIZON, end)
        solver = crocoddyl.SolverBoxFDDP(problem)
        solver.th_stop = 1e-9
        actions = [np.array(u) for u in guess]
        states = problem.rollout(actions)
        solver.solve(states, actions, ITERATIONS, False)
        us = np.array(solver.us.tolist())
        state = np.array(start)
        cost = 0.0
        for u in np.clip(us, *system.action_limits):
            cost += float(system.stage_cost(state, u))
            state = np.asarray(system.flow(state, u))
        return cost

    return solve


def _scalar_rk4(
    system: CartPole, state: tuple[float, float, float, float], force: float
) -> tuple[float, ...]:
    """One RK4 step with Python floats."""
    total, m, length = system.cart_mass + system.pole_mass, system.pole_mass, system.length
    f, g, h = system.friction, system.gravity, system.dt

    def derivative(s: tuple[float, ...]) -> tuple[float, ...]:
        _, v, theta, w = s
        sine, cosine = math.sin(theta), math.cos(theta)
        d = system.cart_mass + m * sine * sine
        push = m * length * w * w * sine + force
        return (
            v,
            (push - m * g * sine * cosine + f * m * w * cosine) / d,
            w,
            (total * (g * sine - f * w) - push * cosine) / (length * d),
        )

    def moved(slope: tuple[float, ...], by: float) -> tuple[float, ...]:
        return tuple(a + by * b for a, b in zip(state, slope, strict=True))

    k1 = derivative(state)
    k2 = derivative(moved(k1, 0.5 * h))
    k3 = derivative(moved(k2, 0.5 * h))
    k4 = derivative(moved(k3, h))
    return tuple(
        a + h / 6.0 * (b + 2.0 * c + 2.0 * d + e) for a, b, c, d, e in zip(state, k1, k2, k3, k4, strict=True)
    )
