"""A memory of sequences: the steps of every copy in the order they came, sampled as windows or as whole episodes.

Each copy has a ring of steps, so that memory is bounded and episodes of any length fit; a running episode can be
sampled as far as it has come. Windows begin anywhere and may hold several episodes (`is_init` says where they begin);
whole episodes begin at their first step, and are padded at the end ("mask"). Either way every step is as likely as
another to be in a sample, apart from those of the newest window, which are somewhat more likely.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

KEPT = (
    *("observation", "previous_action", "previous_reward", "is_init", "action"),
    *(
        ("next", name)
        for name in ("observation", "previous_action", "previous_reward", "reward", "terminated")
    ),
)


class SequenceReplay:
    """Rings of steps.

    Args:
        n_envs: copies. capacity: steps of all copies together that are kept.

    Raises:
        ValueError: room for less than one step of each copy.
    """

    def __init__(self, n_envs: int, capacity: int) -> None:
        if capacity < n_envs:
            raise ValueError(f"expected a capacity of at least {n_envs}, a step of each copy, got {capacity}")
        self.n_envs, self._size = n_envs, capacity // n_envs
        self._total = 0  # steps of each copy that ever came; step t lies in column t % size
        self._store: TensorDict | None = None
        self._starts = self._lengths = torch.zeros(0, dtype=torch.int64)
        self._rows = torch.zeros(0, dtype=torch.int64)

    def __len__(self) -> int:
        """Steps of all copies that are kept."""
        return self.n_envs * min(self._total, self._size)

    def extend(self, rollout: TensorDict) -> None:
        """The next steps of every copy.

        Args:
            rollout: (n_envs, n_steps), see `RolloutCollector.collect`.

        Raises:
            ValueError: another number of copies.
        """
        n, n_steps = rollout.shape
        if n != self.n_envs:
            raise ValueError(f"expected a rollout of {self.n_envs} copies, got {n}")
        rollout = rollout.select(*KEPT)
        if self._store is None:
            shape = (self.n_envs, self._size)
            self._store = rollout[:, 0].apply(
                lambda x: torch.zeros(*shape, *x.shape[1:], dtype=x.dtype), batch_size=shape
            )
        kept = min(n_steps, self._size)
        columns = torch.arange(self._total + n_steps - kept, self._total + n_steps) % self._size
        self._store[:, columns] = rollout[:, n_steps - kept :]
        self._total += n_steps
        self._find_episodes()

    def sample(self, n: int, n_steps: int | None, generator: torch.Generator | None = None) -> TensorDict:
        """Sequences, drawn with replacement.

        Args:
            n: how many. n_steps: the windows' length; None for whole episodes. generator: of what is random.

        Returns:
            (n, longest) with "mask"; longest is n_steps where so many have come, or the longest episode drawn.

        Raises:
            ValueError: nothing has been put in.
        """
        if self._store is None:
            raise ValueError("expected steps to sample from, got an empty memory; call extend first")
        if n_steps is None:
            chosen = torch.randint(len(self._starts), (n,), generator=generator)
            rows, starts, lengths = self._rows[chosen], self._starts[chosen], self._lengths[chosen]
        else:
            there = min(self._total, self._size)
            rows = torch.randint(self.n_envs, (n,), generator=generator)
            starts = torch.randint(there, (n,), generator=generator).clamp(max=max(there - n_steps, 0))
            starts += self._total - there
            lengths = torch.full((n,), min(n_steps, there))
        slot = torch.arange(int(lengths.max()))
        columns = torch.minimum(starts[:, None] + slot, (starts + lengths - 1)[:, None]) % self._size
        sampled = self._store[rows[:, None], columns]
        return sampled.set("mask", (slot < lengths[:, None])[..., None])

    def _find_episodes(self) -> None:
        """Where episodes begin, and how far they go; the oldest may have lost its beginning."""
        assert self._store is not None
        oldest = max(self._total - self._size, 0)
        times = torch.arange(oldest, self._total)
        begins: Tensor = self._store["is_init"][:, times % self._size, 0].clone()
        begins[:, 0] = True
        self._rows, columns = begins.nonzero(as_tuple=True)
        self._starts = columns + oldest
        ends = torch.cat([self._starts[1:], self._starts[:1]])
        is_last = self._rows != torch.cat([self._rows[1:], self._rows.new_full((1,), -1)])
        self._lengths = torch.where(is_last, self._total, ends) - self._starts
