"""An ensemble of networks that each predict a Gaussian, all trained and asked by the same batched matrix products.

Member e has the density N(y; mu_e(x), diag(sigma_e^2(x))) and minimises on its own bootstrap sample of the data

    L_e = mean_t sum_j [ (y_tj - mu_ej(x_t))^2 / sigma_ej^2(x_t) + log sigma_ej^2(x_t) + log 2 pi ] / 2.

What one member thinks is noise is in its sigma_e; what the data do not say is where the members differ.

Reference: Chua et al. 2018, "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models",
Sec. 4 and Appendix A.1 (the bounds of the log variance).
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

_LOOSE, _TIGHT = 0.5, -10.0  # where the bounds of the log variance begin, for targets of unit variance


def gaussian_negative_log_likelihood(target: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """-log N(target; mean, diag(exp(log_variance))): (..., d) each -> (...)."""
    squared = (target - mean) ** 2 * torch.exp(-log_variance)
    return 0.5 * (squared + log_variance + math.log(2.0 * math.pi)).sum(-1)


class GaussianEnsemble(nn.Module):
    """E networks of SiLU layers with a mean and a bounded log variance for each target.

    Args:
        n_inputs, n_targets: widths of x and y.
        members: E.
        hidden: widths of the hidden layers.
        seed: of the weights, bootstrap samples and minibatches.
    """

    input_mean: Tensor
    input_std: Tensor
    target_mean: Tensor
    target_std: Tensor

    def __init__(
        self,
        n_inputs: int,
        n_targets: int,
        members: int = 5,
        hidden: tuple[int, ...] = (64, 64),
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.members, self.n_targets = members, n_targets
        self.generator = torch.Generator().manual_seed(seed)
        sizes = (n_inputs, *hidden, 2 * n_targets)
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(members, a, b)) for a, b in pairwise(sizes))
        self.biases = nn.ParameterList(nn.Parameter(torch.zeros(members, 1, b)) for b in sizes[1:])
        self.highest = nn.Parameter(torch.full((n_targets,), _LOOSE))
        self.lowest = nn.Parameter(torch.full((n_targets,), _TIGHT))
        for name, size in (("input", n_inputs), ("target", n_targets)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self._begin_anew()

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance (E, B, n_targets) of the standardised targets, from standardised inputs (E, B, n)."""
        x = inputs
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if i < last:
                x = functional.silu(x)
        mean, log_variance = x[..., : self.n_targets], x[..., self.n_targets :]
        return mean, self.bounded(log_variance)

    def fit(
        self,
        inputs: Tensor,
        targets: Tensor,
        steps: int = 2000,
        batch: int = 64,
        learning_rate: float = 3e-3,
        weight_decay: float = 1e-4,
    ) -> float:
        """Train every member from new weights on its own bootstrap sample.

        AdamW, the learning rate falling to 0 as half a cosine.

        Args:
            inputs: (N, n_inputs). targets: (N, n_targets). Both in their own units.
            steps: gradient steps. batch: size of the minibatches.

        Returns:
            the mean loss over the last tenth of the steps.

        Raises:
            ValueError: shapes that do not belong together.
        """
        if inputs.ndim != 2 or len(inputs) != len(targets) or targets.shape[1:] != (self.n_targets,):
            raise ValueError(
                f"expected inputs (N, {len(self.input_mean)}) and targets (N, {self.n_targets}), got "
                f"{tuple(inputs.shape)} and {tuple(targets.shape)}"
            )
        for name, data in (("input", inputs), ("target", targets)):
            getattr(self, f"{name}_mean").copy_(data.mean(0))
            getattr(self, f"{name}_std").copy_(data.std(0, correction=0).clamp(min=1e-6))
        self._begin_anew()
        x = (inputs - self.input_mean) / self.input_std
        y = (targets - self.target_mean) / self.target_std
        n, draw = len(x), self.generator
        sample = torch.randint(n, (self.members, n), generator=draw)
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=learning_rate, weight_decay=weight_decay, fused=True
        )
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        late: list[float] = []
        for step in range(steps):
            rows = sample.gather(1, torch.randint(n, (self.members, min(batch, n)), generator=draw))
            mean, log_variance = self(x[rows])
            loss = gaussian_negative_log_likelihood(y[rows], mean, log_variance).mean(1).sum()
            bounds = 0.01 * (self.highest.sum() - self.lowest.sum())
            optimizer.zero_grad()
            (loss + bounds).backward()
            optimizer.step()
            schedule.step()
            if step >= steps - max(1, steps // 10):
                late.append(float(loss.detach()) / self.members)
        return sum(late) / len(late)

    @torch.no_grad()
    def folded(self) -> tuple[list[Tensor], list[Tensor]]:
        """Weights and biases of the same networks on inputs and targets in their own units.

        The last layer's second half is still the unbounded log variance of the standardised target.
        """
        weights = [weight.detach().clone() for weight in self.weights]
        biases = [bias.detach().clone() for bias in self.biases]
        weights[0] /= self.input_std[:, None]
        biases[0] -= (self.input_mean @ weights[0])[:, None]
        d = self.n_targets
        weights[-1][..., :d] *= self.target_std
        biases[-1][..., :d] = biases[-1][..., :d] * self.target_std + self.target_mean
        return weights, biases

    def bounded(self, log_variance: Tensor) -> Tensor:
        """A log variance between the learned bounds."""
        below = self.highest - functional.softplus(self.highest - log_variance)
        return self.lowest + functional.softplus(below - self.lowest)

    @torch.no_grad()
    def _begin_anew(self) -> None:
        for weight, bias in zip(self.weights, self.biases, strict=True):
            weight.normal_(0.0, 1.0 / math.sqrt(weight.shape[1]), generator=self.generator)
            bias.zero_()
        self.highest.fill_(_LOOSE)
        self.lowest.fill_(_TIGHT)
