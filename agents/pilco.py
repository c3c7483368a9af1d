"""PILCO: search a policy on a Gaussian-process model that carries whole beliefs through its predictions.

On TorchRL's parts: after every trial a `GPWorldModel` of the change of the observation is fitted to the transitions so
far; then the expected saturating cost of the beliefs p(y_1), ..., p(y_H) under an `RBFController`,

    J = sum_t E[ 1 - exp(-(y_t - y*)' W (y_t - y*) / 2) ],    y_t ~ N(mu_t, Sigma_t),

with `ExponentialQuadraticCost`, is minimised by L-BFGS-B through the moments of all H steps.

Deviations from the source: the belief is one over what is observed, so that the cosine and sine of an angle are two
Gaussian components with a GP each (the source keeps the angle and takes its cosine and sine inside), because that is
what TorchRL's model does; at most `max_points` transitions, spread over those seen, in place of a sparse GP. TorchRL's
model fits GPs to targets that BoTorch standardises and then uses their parameters on the raw targets; observations are
therefore given to it in units of the standard deviation of their change.

Reference: Deisenroth & Rasmussen 2011, "PILCO: A Model-Based and Data-Efficient Approach to Policy Search".
"""

from __future__ import annotations

import importlib.util
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from tensordict import TensorDict
from torch import Tensor
from torchrl.modules.models.rbf_controller import RBFController
from torchrl.objectives.pilco import ExponentialQuadraticCost

from beliefgym.agents.gp_moments import GPMoments
from beliefgym.agents.observed_cost import circles
from beliefgym.agents.trial_learner import Cost, TrialLearner
from beliefgym.wrappers.task import Task

_RESETS = 100  # starts from which the moments of the start distribution are taken; PILCO supposes them known
_WIDTH = 1.0  # of the default cost, in lengths of the pole
_LONGEST = np.sqrt(3.0)  # a uniform action in units of its standard deviation


class PILCO(TrialLearner):
    """PILCO on TorchRL's parts. Needs gpytorch and botorch to learn; a saved policy acts without them.

    Args:
        task: the task or environment id, with flat Box spaces and bounded actions.
        seed: of trials and the first policy.
        target: y*, (n_observation,). weights: W, (n_observation, n_observation) in 1 / (units of y)^2. By default,
            where "x", "cos_theta" and "sin_theta" are observed and the task's system has a `length` l (a cart-pole):
            the distance of the pole's tip from (0, l), over a width of l.
        cost, trial_steps, exploration_trials: see `TrialLearner`; the cost is only written down, not searched with.
        horizon: H, steps of the policy search; trial_steps by default.
        n_basis: radial basis functions of the policy.
        max_points: transitions that the GPs hold.
        evaluations: of J and its gradient after each trial, at most.

    Attributes:
        history: see `TrialLearner`; "expected" is J / H of the policy found, "evaluations" how often J was asked for.

    Raises:
        ValueError: spaces or numbers that do not fit, or no target where there is no default.
    """

    def __init__(
        self,
        task: Task | str,
        seed: int = 0,
        target: Sequence[float] | None = None,
        weights: Sequence[Sequence[float]] | None = None,
        cost: Cost | str | None = None,
        trial_steps: int = 60,
        exploration_trials: int = 1,
        horizon: int | None = None,
        n_basis: int = 50,
        max_points: int = 300,
        evaluations: int = 100,
    ) -> None:
        super().__init__(task, seed, cost, trial_steps, exploration_trials)
        self.horizon = trial_steps if horizon is None else horizon
        if min(self.horizon, n_basis, evaluations) < 1 or max_points < 2:
            raise ValueError(
                "expected horizon, n_basis and evaluations of at least 1 and max_points of at least 2, got "
                f"{self.horizon}, {n_basis}, {evaluations} and {max_points}"
            )
        self.n_basis, self.max_points, self.evaluations = n_basis, max_points, evaluations
        self._given_target = (target, weights)
        self.target, self.weights = self._aim(target, weights)
        n, m = len(self.names), len(self.low)
        self._middle = torch.as_tensor(0.5 * (self.high + self.low), dtype=torch.float64)
        self._action_unit = torch.as_tensor(0.5 * (self.high - self.low) / _LONGEST, dtype=torch.float64)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.controller = RBFController(n, m, float(_LONGEST), n_basis).double()
            with torch.no_grad():
                self.controller.centers.mul_(
                    2.0
                )  # from TorchRL's 0.5 to 1 and lengthscales to 2 units of the data
                self.controller.lengthscales.mul_(2.0)
        self._observation_unit = torch.ones(
            n, dtype=torch.float64
        )  # of the controller; set by the first trials
        self._starts: tuple[Tensor, Tensor] | None = None

    def improve(self) -> dict[str, Any]:
        """Fit the GPs and search the policy.

        Raises:
            ImportError: gpytorch or botorch is not installed.
        """
        if len(self.history) + 1 < self.exploration_trials:
            return {}
        missing = [name for name in ("gpytorch", "botorch") if importlib.util.find_spec(name) is None]
        if missing:
            raise ImportError(
                f"PILCO learns with TorchRL's GPWorldModel, which needs {' and '.join(missing)}; "
                "pip install 'beliefgym[pilco]'"
            )
        y, u, following = (torch.as_tensor(part, dtype=torch.float64) for part in self.observed())
        if len(self.history) + 1 == self.exploration_trials:
            self._observation_unit = y.std(0).clamp(min=1e-3)
            for pair in circles(self.names):
                self._observation_unit[list(pair)] = 0.5**0.5
        unit = (following - y).std(0).clamp(min=1e-6)
        rows = spread_points(
            torch.cat([y / y.std(0).clamp(min=1e-6), u / self._action_unit], 1), self.max_points
        )
        model = GPMoments(len(unit), len(self._middle))
        data = {
            "observation": y[rows] / unit,
            "action": (u[rows] - self._middle) / self._action_unit,
            ("next", "observation"): following[rows] / unit,
        }
        model.fit(TensorDict(data, [len(rows)]))
        return self._search(model, unit)

    def _search(self, model: GPMoments, unit: Tensor) -> dict[str, Any]:
        loss = ExponentialQuadraticCost(
            self.target / unit, unit[:, None] * self.weights * unit, reduction="none"
        )
        parameters = list(self.controller.parameters())
        mean, covariance = self._start()
        mean, covariance = mean / unit, covariance / unit[:, None] / unit
        asked = 0

        def evaluate(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
            nonlocal asked
            asked += 1
            torch.nn.utils.vector_to_parameters(torch.as_tensor(flat), parameters)
            expected = self._expected(model, loss, unit, mean, covariance)
            if not expected.requires_grad:  # no belief is left after the first step
                return 1.0, np.zeros_like(flat)
            slopes = torch.autograd.grad(expected, parameters)
            slope = torch.cat([part.reshape(-1) for part in slopes]).numpy()
            if not (torch.isfinite(expected) and np.isfinite(slope).all()):
                return 1.0, np.zeros_like(flat)
            return float(expected.detach()), slope

        first = torch.nn.utils.parameters_to_vector(parameters).detach().numpy().copy()
        found = minimize(
            evaluate,
            first,
            jac=True,
            method="L-BFGS-B",
            options={"maxfun": self.evaluations, "maxiter": 10_000},
        )
        torch.nn.utils.vector_to_parameters(torch.as_tensor(found.x), parameters)
        return {"expected": float(found.fun), "evaluations": asked}

    def _expected(
        self, model: GPMoments, loss: ExponentialQuadraticCost, unit: Tensor, mean: Tensor, covariance: Tensor
    ) -> Tensor:
        """J / H from a belief in units of the model."""
        ratio = unit / self._observation_unit
        total = torch.zeros((), dtype=torch.float64)
        for t in range(self.horizon):
            u_mean, u_covariance, slope = self.controller(ratio * mean, ratio[:, None] * covariance * ratio)
            belief = {"mean": mean, "var": covariance}
            action = {"mean": u_mean, "var": u_covariance, "cross_covariance": ratio[:, None] * slope}
            following = model.uncertain_forward(TensorDict({"observation": belief, "action": action}, []))[
                "next"
            ]
            mean, covariance = following["observation", "mean"], following["observation", "var"]
            spread = covariance.detach()
            if not torch.isfinite(spread).all() or torch.linalg.cholesky_ex(spread).info > 0:
                return (total + self.horizon - t) / self.horizon  # no belief is left: the rest costs the most
            total = (
                total + loss(TensorDict({"observation": {"mean": mean, "var": covariance}}, []))["loss_cost"]
            )
        return total / self.horizon

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], None]:
        """See `Agent.predict`; the policy has no memory and is deterministic.

        Raises:
            ValueError: an observation of another shape, or one that is not finite.
        """
        observation, single = self.batched(observation)
        y = torch.as_tensor(self.finite(observation), dtype=torch.float64) / self._observation_unit
        with torch.no_grad():
            unit, _, _ = self.controller(y, torch.zeros(*y.shape, y.shape[1], dtype=torch.float64))
        action = (self._middle + self._action_unit * unit).numpy().astype(self.action_space.dtype)
        action = np.clip(action, self.low, self.high)
        return (action[0] if single else action), None

    def _start(self) -> tuple[Tensor, Tensor]:
        """Mean and covariance of the first observation."""
        if self._starts is None:
            env = self.task.make_vec(_RESETS)
            seed = int(np.random.SeedSequence([self.seed]).generate_state(1)[0])
            first = torch.as_tensor(np.asarray(env.reset(seed=seed)[0]), dtype=torch.float64)
            env.close()
            spread = torch.atleast_2d(torch.cov(first.T)) + 1e-6 * torch.eye(first.shape[1])
            self._starts = first.mean(0), spread
        return self._starts

    def _aim(
        self, target: Sequence[float] | None, weights: Sequence[Sequence[float]] | None
    ) -> tuple[Tensor, Tensor]:
        n = len(self.names)
        if target is not None and weights is not None:
            y, w = torch.as_tensor(target, dtype=torch.float64), torch.as_tensor(weights, dtype=torch.float64)
            if y.shape != (n,) or w.shape != (n, n):
                raise ValueError(
                    f"expected target ({n},) and weights ({n}, {n}) for {', '.join(self.names)}, got "
                    f"{tuple(y.shape)} and {tuple(w.shape)}"
                )
            return y, w
        env = self.task.make()
        length = getattr(getattr(env.unwrapped, "system", None), "length", None)
        env.close()
        if length is None or not {"x", "cos_theta", "sin_theta"} <= set(self.names):
            raise ValueError(
                f"expected target and weights for {self.task.label}, got none; there is a default for cart-poles only"
            )
        x, cosine, sine = (self.names.index(name) for name in ("x", "cos_theta", "sin_theta"))
        tip = torch.zeros(2, n, dtype=torch.float64)
        tip[0, x], tip[0, sine], tip[1, cosine] = 1.0, length, length
        tip /= _WIDTH * length
        y = torch.zeros(n, dtype=torch.float64)
        y[cosine] = 1.0
        return y, tip.T @ tip

    def options(self) -> dict[str, Any]:
        """See `Agent.options`; a cost given as a function raises."""
        target, weights = self._given_target
        return {
            "target": None if target is None else [float(value) for value in target],
            "weights": None if weights is None else [[float(value) for value in row] for row in weights],
            "cost": self.saved_cost(),
            "trial_steps": self.trial_steps,
            "exploration_trials": self.exploration_trials,
            "horizon": self.horizon,
            "n_basis": self.n_basis,
            "max_points": self.max_points,
            "evaluations": self.evaluations,
        }

    def parts(self) -> dict[str, bytes]:
        """The policy, the transitions and the history; the GPs are fitted anew when learning goes on."""
        arrays = io.BytesIO()
        policy = {name: value.numpy() for name, value in self.controller.state_dict().items()}
        np.savez(arrays, transitions=self.transitions, unit=self._observation_unit.numpy(), **policy)
        return {"pilco.npz": arrays.getvalue(), "history.json": json.dumps(self.history).encode()}

    def restore(self, parts: Mapping[str, bytes]) -> None:
        """See `Agent.restore`."""
        with np.load(io.BytesIO(parts["pilco.npz"]), allow_pickle=False) as arrays:
            self.transitions = arrays["transitions"]
            self._observation_unit = torch.as_tensor(arrays["unit"])
            names = self.controller.state_dict()
            self.controller.load_state_dict({name: torch.as_tensor(arrays[name]) for name in names})
        self.history = json.loads(parts["history.json"])
        self.num_timesteps = len(self.transitions)


def spread_points(points: Tensor, count: int) -> Tensor:
    """Indices of at most `count` of the points (N, d), each in turn the farthest from those chosen before it."""
    if len(points) <= count:
        return torch.arange(len(points))
    chosen = [0]
    distance = ((points - points[0]) ** 2).sum(1)
    while len(chosen) < count:
        farthest = int(distance.argmax())
        chosen.append(farthest)
        distance = torch.minimum(distance, ((points - points[farthest]) ** 2).sum(1))
    return torch.tensor(chosen)
