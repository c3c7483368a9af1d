"""Planning by the cross-entropy method: draw plans, keep the cheapest, draw again around them.

For a plan of H actions a_0..a_{H-1}, iteration i draws N_i plans, takes the cheapest K of them (the elites), and moves
the distribution that it draws from:

    a ~ clip(m + s * e),    m <- (1 - c) mean(elites) + c m,    s <- (1 - c) std(elites) + c s

What makes few draws enough is from iCEM: e has a power spectrum f^-b over the plan (neighbouring actions push the same
way), N_i falls by a factor an iteration, the best elites are kept for the next iteration and, shifted by one step, for
the next plan, the mean itself is tried last, and the best plan seen is the one that is acted on.

Deviation: every copy that is planned for gets the same draws (common random numbers), so that its plan is the same
whoever is planned for beside it.

Reference: Pinneri et al. 2020, "Sample-efficient Cross-Entropy Method for Real-time Planning" (iCEM), Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


class Plan(NamedTuple):
    """Plans of n copies, in units where every action lies in [-1, 1].

    Attributes:
        mean: (n, H, n_action), where the next draws are centred.
        elites: (n, kept, H, n_action), the cheapest plans, best first.
    """

    mean: Tensor
    elites: Tensor


@dataclass(frozen=True)
class CrossEntropyMethod:
    """iCEM on plans of H actions in [-1, 1].

    Args:
        horizon: H, steps of a plan.
        candidates: N_0, plans drawn in the first iteration.
        iterations: draws of a plan.
        elites: K, plans that the distribution is fitted to.
        kept: elites handed on to the next iteration and the next plan.
        decay: N_i = max(N_0 / decay^i, 2 K).
        momentum: c, the share of the old mean and std.
        std: s of the first iteration.
        noise_exponent: b, 0 for white noise.

    Raises:
        ValueError: a number out of its range.
    """

    horizon: int = 30
    candidates: int = 64
    iterations: int = 3
    elites: int = 8
    kept: int = 3
    decay: float = 1.25
    momentum: float = 0.1
    std: float = 0.5
    noise_exponent: float = 2.0

    def __post_init__(self) -> None:
        if self.horizon < 2 or self.iterations < 1:
            raise ValueError(
                f"expected horizon of at least 2 and iterations of at least 1, got {self.horizon} and {self.iterations}"
            )
        if not 2 <= self.elites <= self.candidates or not 1 <= self.kept <= self.elites:
            raise ValueError(
                "expected 1 <= kept <= elites <= candidates and at least 2 elites, got "
                f"kept {self.kept}, elites {self.elites}, candidates {self.candidates}"
            )
        if not (self.decay >= 1 and 0 <= self.momentum < 1 and self.std > 0 and self.noise_exponent >= 0):
            raise ValueError(
                "expected decay >= 1, momentum in [0, 1), std > 0 and noise_exponent >= 0, got "
                f"{self.decay}, {self.momentum}, {self.std}, {self.noise_exponent}"
            )

    def start(self, n: int, n_action: int) -> Plan:
        """Plans that do nothing, for n copies at the start of an episode."""
        mean = torch.zeros(n, self.horizon, n_action)
        return Plan(mean, mean[:, None].repeat(1, self.kept, 1, 1))

    def draw(self, n_action: int, generator: torch.Generator) -> list[Tensor]:
        """The noise e of each iteration: (N_i, H, n_action) with unit variance."""
        counts = [max(int(self.candidates / self.decay**i), 2 * self.elites) for i in range(self.iterations)]
        frequency = torch.fft.rfftfreq(self.horizon)
        frequency[0] = frequency[1]
        scale = frequency ** (-0.5 * self.noise_exponent)
        # irfft counts every frequency twice but the first, and the last of an even horizon
        weight = torch.full_like(scale, 2.0)
        weight[0] = 1.0
        if self.horizon % 2 == 0:
            weight[-1] = 1.0
        scale = scale * self.horizon / torch.sqrt((weight * scale**2).sum())
        drawn = []
        for count in counts:
            parts = torch.randn(2, count, n_action, len(scale), generator=generator)
            real = parts[0] * torch.where(weight == 1.0, 1.0, 0.5**0.5)
            imaginary = parts[1] * torch.where(weight == 1.0, 0.0, 0.5**0.5)
            noise = torch.fft.irfft(torch.complex(real, imaginary) * scale, n=self.horizon)
            drawn.append(noise.transpose(1, 2))
        return drawn

    def improve(
        self, cost: Callable[[Tensor], Tensor], plan: Plan, noise: list[Tensor]
    ) -> tuple[Plan, Tensor]:
        """Search from a plan.

        Args:
            cost: plans (n, N, H, n_action) -> costs (n, N); a cost that is not finite counts as the worst.
            plan: of the last step (see `shift`), or `start`'s.
            noise: of `draw`.

        Returns:
            the plan, whose elites[:, 0] is the cheapest that was seen, and the costs (n, kept) of its elites.
        """
        mean, elites = plan
        std = torch.full_like(mean, self.std)
        costs = torch.empty(0)
        for i, e in enumerate(noise):
            drawn = (mean[:, None] + std[:, None] * e).clamp(-1.0, 1.0)
            new = [drawn, mean[:, None]] if i == self.iterations - 1 else [drawn]
            if i == 0:
                new.append(elites)
            plans = torch.cat(new, dim=1)
            found = torch.nan_to_num(cost(plans), nan=torch.inf)
            if i > 0:  # models are deterministic given their noise: what was kept need not be tried again
                plans, found = torch.cat([plans, elites], dim=1), torch.cat([found, costs], dim=1)
            order = found.argsort(dim=1)[:, : self.elites]
            best = torch.take_along_dim(plans, order[:, :, None, None], dim=1)
            costs = torch.take_along_dim(found, order, dim=1)[:, : self.kept]
            elites = best[:, : self.kept]
            mean = (1.0 - self.momentum) * best.mean(dim=1) + self.momentum * mean
            std = (1.0 - self.momentum) * best.std(dim=1) + self.momentum * std
        return Plan(mean, elites), costs

    def shift(self, plan: Plan) -> Plan:
        """The plans one step later, their last action held."""
        mean, elites = plan
        return Plan(
            torch.cat([mean[:, 1:], mean[:, -1:]], dim=1),
            torch.cat([elites[:, :, 1:], elites[:, :, -1:]], dim=2),
        )
