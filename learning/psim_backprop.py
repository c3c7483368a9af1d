"""`BackpropPSIM`: the filter of `PSIM` trained by back-propagation through time, from random starts or after DAgger.

    min_{A, b}  1/n sum_{i, t} |m_{t+1} - phi(f_{t+1})|^2 + alpha |A|^2,    m_{t+1} = A' psi(m_t, x_t) + b   (Eq. 3.21)

for filters linear in features psi (`Ridge`, `RandomFourierRidge`), by Adam on mini-batches of whole trajectories. With
init "random" these are the thesis's PSIM-Linear_b and PSIM-RFF_b, with "dagger" its PSIM-Linear_d+b.

What only depends on observations is computed for all steps at once, so that a step of a linear filter is one product.
As in `BackpropThroughTime`, Adam walks in whitened features and along a cosine of step sizes, and gradients are
clipped; the thesis names none of that, and without it random starts come out worse than they need to. Directions of
little variance are whitened in part only: a recurrent filter is soon unstable along them.

Reference: thesis proposal, Eqs. 3.21 to 3.23, Tables 3.2 and 3.3 (Sec. 3.3).
"""

from __future__ import annotations

import time
import warnings
from copy import copy
from typing import Literal, Self, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import clone
from torch import Tensor
from tqdm import tqdm

from beliefgym.learning.dynamics import DivergenceWarning
from beliefgym.learning.filters import check_whole
from beliefgym.learning.linear_in_features import LinearInFeatures, Ridge
from beliefgym.learning.predictive_state import PredictiveStateFilter, TrainingData
from beliefgym.learning.psim import PSIM
from beliefgym.learning.psim_pairs import history_pairs
from beliefgym.learning.random_fourier import RandomFourierRidge
from beliefgym.learning.sequences import Sequences
from beliefgym.learning.stochastic_gradient import RANDOM_SCALE, Parameters

Array = NDArray[np.float64]
Init = Literal["random", "dagger"]
Loss = Literal["state", "observation"]
HISTORY = ("epoch", "loss", "validation_error", "seconds")
LEARNING_RATES: dict[Init, float] = {"random": 1e-2, "dagger": 3e-4}
DAMPING = 1e-2  # added to the variances that whitening divides by, as a share of the largest


class BackpropPSIM(PredictiveStateFilter):
    """A predictive state filter trained by gradients through time.

    Args:
        psim: an unfitted `PSIM`, whose regressor (linear in features), future, features, target and scaling are taken;
            None for `PSIM()`. With init "dagger" it is fitted first, and its filter is the start.
        init: "random" or "dagger".
        loss: "state" for all features of the future (Eq. 3.21), "observation" for the next observation alone.
        n_epochs: passes over the training trajectories, at least 0.
        batch_size: trajectories in a mini-batch.
        learning_rate: of Adam, at the start; it falls to 0 along a cosine. None for 1e-2 from random starts, 3e-4 after
            DAgger.
        truncation: steps that a gradient goes back; None for whole trajectories.
        max_gradient_norm: gradients are shortened to it; None leaves them.
        random_state: of the start and the mini-batches.
        device: of torch, "cpu" or "cuda".
        progress_bar: show the epochs.

    Attributes:
        model_: the best epoch's F. best_epoch_: which; 0 is the start. psim_: the fitted `PSIM`, or None.
        history_: arrays (n_epochs + 1,): "loss", "validation_error" as of `PSIM`, "seconds".

    Example:
        >>> BackpropPSIM(PSIM(n_future=5), init="dagger", n_epochs=50).fit(train, validation)  # doctest: +SKIP
    """

    def __init__(
        self,
        psim: PSIM | None = None,
        *,
        init: Init = "random",
        loss: Loss = "state",
        n_epochs: int = 100,
        batch_size: int = 16,
        learning_rate: float | None = None,
        truncation: int | None = None,
        max_gradient_norm: float | None = 1.0,
        random_state: int | np.random.Generator | None = None,
        device: str = "cpu",
        progress_bar: bool = False,
    ) -> None:
        self.psim = psim
        self.init = init
        self.loss = loss
        self.n_epochs = n_epochs
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.truncation = truncation
        self.max_gradient_norm = max_gradient_norm
        self.random_state = random_state
        self.device = device
        self.progress_bar = progress_bar

    def fit(self, train: Sequences, validation: Sequences | None = None) -> Self:
        """Train for n_epochs and keep the filter that predicts the validation trajectories best, one step ahead.

        Where the loss stops being finite training ends with a `DivergenceWarning`; the best filter until then is kept.

        Args:
            train: trajectories; those of fewer than n_future + 1 observations teach nothing, and that is told.
            validation: whole trajectories. Without them the last epoch is kept.

        Raises:
            ValueError: as of `PSIM.fit`. TypeError: a regressor not linear in features.
        """
        self._check_parameters()
        psim = clone(PSIM() if self.psim is None else self.psim)
        if type(psim) is not PSIM:
            raise TypeError(f"expected psim as a PSIM, without actions or hints, got {type(psim).__name__}")
        self.psim_ = psim.fit(train, validation) if self.init == "dagger" else None
        self.n_future, self.features, self.target = psim.n_future, psim.features, psim.target
        self.standardise, self.belief_limit = psim.standardise, psim.belief_limit
        data = self._begin_predictive(train, validation)
        rng = np.random.default_rng(self.random_state)
        regressor = self._start(psim, data, rng)
        walk = Walk(self, regressor, LossThroughTime(self, data, regressor))
        trajectories = np.flatnonzero(data.n_targets > 1)
        n_updates = self.n_epochs * -(-len(trajectories) // self.batch_size)
        self.history_: dict[str, Array] = {name: np.full(self.n_epochs + 1, np.nan) for name in HISTORY}
        self._told_divergence = True  # filters on the way may leave the bounds
        best, update = np.inf, 0
        for epoch in tqdm(range(self.n_epochs + 1), desc=type(self).__name__, disable=not self.progress_bar):
            started = time.perf_counter()
            losses: list[float] = []
            order = rng.permutation(trajectories) if epoch else trajectories[:0]
            for i in range(0, len(order), self.batch_size):
                rate = 0.5 * self._first_rate * (1.0 + np.cos(np.pi * update / n_updates))
                losses.append(walk.step(order[i : i + self.batch_size], rate))
                update += 1
            weights, offset = walk.coefficients()
            if not (np.isfinite(losses).all() and np.isfinite(weights).all() and np.isfinite(offset).all()):
                self._tell_divergence(epoch)
                break
            self.model_ = regressor.frozen()
            self.model_._set(weights, offset)
            self.history_["epoch"][epoch] = epoch
            self.history_["loss"][epoch] = np.mean(losses) if losses else np.nan
            if callable(self.features):
                self._learn_to_read(self.beliefs(data.sequences)[:, :-1], data.z, data.n_targets)
            criterion = -float(epoch)
            if validation is not None:
                criterion = self.history_["validation_error"][epoch] = self._history_error(validation)
            if criterion < best:
                best, self.best_epoch_, chosen = criterion, epoch, (self.model_, copy(self._phi))
            self.history_["seconds"][epoch] = time.perf_counter() - started
        self.model_, self._phi = chosen
        self._told_divergence = False
        self._note_beliefs(train)
        return self

    def _update(self, belief: Array, z: Array) -> Array:
        return self._completed(self.model_.predict_unchecked(np.concatenate([belief, z], axis=1)), z)

    def _start(self, psim: PSIM, data: TrainingData, rng: np.random.Generator) -> LinearInFeatures:
        """The start: DAgger's filter, or random coefficients; with the sums that whiten its features."""
        if self.init == "dagger":
            return psim.chosen()
        given = Ridge() if psim.regressor is None else psim.regressor
        regressor: LinearInFeatures = clone(given).fit(*history_pairs(data, psim.past_length))
        variance = Parameters(regressor, whiten=False).variance
        spread = RANDOM_SCALE / np.sqrt(max(variance, np.finfo(float).tiny))
        regressor._set(
            spread * rng.standard_normal(regressor._weights.shape), np.zeros_like(regressor._offset)
        )
        return regressor

    @property
    def _first_rate(self) -> float:
        return LEARNING_RATES[self.init] if self.learning_rate is None else self.learning_rate

    def _tell_divergence(self, epoch: int) -> None:
        warnings.warn(
            f"training diverged in epoch {epoch} of {self.n_epochs} and was ended; the best filter, of epoch "
            f"{self.best_epoch_}, is kept. A learning_rate below {self._first_rate:g} may help",
            DivergenceWarning,
            stacklevel=3,
        )

    def _check_parameters(self) -> None:
        regressor = None if self.psim is None else self.psim.regressor
        if regressor is not None and not isinstance(regressor, Ridge | RandomFourierRidge):
            raise TypeError(
                f"expected a PSIM of Ridge or RandomFourierRidge, got {type(regressor).__name__}: a gradient needs its "
                "features; PSIM itself takes any regressor"
            )
        check_whole("n_epochs", self.n_epochs, 0)
        check_whole("batch_size", self.batch_size, 1)
        if self.truncation is not None:
            check_whole("truncation", self.truncation, 1)
        if self.learning_rate is not None and not self.learning_rate > 0:
            raise ValueError(f"expected learning_rate above 0 or None, got {self.learning_rate!r}")
        if self.max_gradient_norm is not None and not self.max_gradient_norm > 0:
            raise ValueError(f"expected max_gradient_norm above 0 or None, got {self.max_gradient_norm!r}")
        for name, kinds in (("init", get_args(Init)), ("loss", get_args(Loss))):
            if getattr(self, name) not in kinds:
                raise ValueError(f"expected {name} to be one of {kinds}, got {getattr(self, name)!r}")


class LossThroughTime:
    """Eq. 3.21 on mini-batches of trajectories, differentiable by the coefficients; time is the first axis.

    Args:
        model: whose parameters these are. data: trajectories. regressor: whose features.
    """

    def __init__(self, model: BackpropPSIM, data: TrainingData, regressor: LinearInFeatures) -> None:
        n_used = max(int(data.n_targets.max()) - 1, 1)
        size = data.targets.shape[2]
        self._observations = _tensor(data.z[:, :n_used].swapaxes(0, 1), model.device)
        targets, learnt = data.targets[:, 1 : n_used + 1], data.is_learnt[:, :n_used]
        kept = (
            model._phi.n_obs
            if model.loss == "observation" and model.features in ("first", "second")
            else size
        )
        self._targets = _tensor(targets[:, :, :kept].swapaxes(0, 1), model.device)
        self._learnt = _tensor(learnt.T[:, :, None].astype(float), model.device)
        self._base = (
            None if data.base is None else _tensor(data.base[:, :n_used].swapaxes(0, 1), model.device)
        )
        self._first = _tensor(model._first_belief, model.device)
        self._truncation, self._size = model.truncation, size
        self._share = len(data.n_targets[data.n_targets > 1]) / np.count_nonzero(
            learnt
        )  # of trajectories by pairs
        self._alpha = regressor.alpha
        self._frequencies, self._has_inputs = None, True
        if isinstance(regressor, RandomFourierRidge):
            self._frequencies = _tensor(regressor.frequencies_, model.device)
            self._has_inputs = regressor.include_inputs

    def __call__(self, weights: Tensor, offset: Tensor, items: NDArray[np.int64]) -> Tensor:
        """The loss of some trajectories, an unbiased estimate of that of all.

        Args:
            weights: A (m, size). offset: b (size,). items: (n,).
        """
        x, size = self._observations[:, items], self._size
        n_linear = size + x.shape[2] if self._has_inputs else 0
        linear, waves = weights[:n_linear], weights[n_linear:]
        given = offset + x @ linear[size:] if self._has_inputs else offset.expand(*x.shape[:2], size)
        if self._base is not None:
            given = given + self._base[:, items]
        angle = None if self._frequencies is None else x @ self._frequencies[size:]
        belief = self._first.expand(len(items), size)
        beliefs = []
        for t in range(len(x)):
            following = torch.addmm(given[t], belief, linear[:size]) if self._has_inputs else given[t]
            if angle is not None and self._frequencies is not None:
                turned, n_waves = torch.addmm(angle[t], belief, self._frequencies[:size]), angle.shape[2]
                phi = torch.cat([torch.cos(turned), torch.sin(turned)], dim=1)
                following = torch.addmm(following, phi, waves, alpha=n_waves**-0.5)
            beliefs.append(following)
            belief = following
            if self._truncation is not None and (t + 1) % self._truncation == 0:
                belief = belief.detach()
        error = torch.stack(beliefs)[:, :, : self._targets.shape[2]] - self._targets[:, items]
        squared = (torch.square(error) * self._learnt[:, items]).sum() * (self._share / len(items))
        return squared + self._alpha * torch.square(weights).sum()


class Walk:
    """Adam on the coefficients, in whitened features.

    Args:
        model: whose parameters these are. regressor: its coefficients are the start, its sums whiten. loss: of them.
    """

    def __init__(self, model: BackpropPSIM, regressor: LinearInFeatures, loss: LossThroughTime) -> None:
        parameters = Parameters(regressor, whiten=True, damping=DAMPING)
        parameters.set(regressor._weights, regressor._offset)
        self._theta = _tensor(parameters.theta, model.device).requires_grad_()
        self._from_theta = _tensor(parameters._from_theta, model.device)
        self._mean = _tensor(parameters._mean, model.device)
        self._intercept = regressor.fit_intercept
        self._adam = torch.optim.Adam([self._theta])
        self._norm, self._loss = model.max_gradient_norm, loss

    def step(self, items: NDArray[np.int64], rate: float) -> float:
        """One step on a mini-batch of trajectories; its loss before the step."""
        self._adam.param_groups[0]["lr"] = rate
        self._adam.zero_grad()
        loss = self._loss(*self._coefficients(), items)
        loss.backward()  # type: ignore[no-untyped-call]
        if self._norm is not None:
            torch.nn.utils.clip_grad_norm_([self._theta], self._norm)
        self._adam.step()
        return float(loss.detach())

    def coefficients(self) -> tuple[Array, Array]:
        """A (m, size) and b (size,)."""
        with torch.no_grad():
            weights, offset = self._coefficients()
        return weights.cpu().numpy(), offset.cpu().numpy()

    def _coefficients(self) -> tuple[Tensor, Tensor]:
        weights = self._from_theta @ self._theta[:-1]
        if not self._intercept:
            return weights, torch.zeros_like(self._theta[-1])
        return weights, self._theta[-1] - self._mean @ weights


def _tensor(array: Array, device: str) -> Tensor:
    return torch.tensor(np.ascontiguousarray(array), dtype=torch.float64, device=device)
