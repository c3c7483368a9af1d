"""A replay memory of episodes: the last steps of every copy of an environment, and pieces of single episodes drawn.

Each copy's steps are written one after another into a ring; a table says where in it episodes begin and end. What is
drawn lies within one episode and has the layout of a rollout (n, n_steps), padded at its end, with "mask" True at the
steps that exist. An episode that has not ended yet is drawn from too, as far as it has come: what followed its newest
step stands under "next". An episode whose beginning is overwritten is no longer drawn from.

References: Hausknecht and Stone 2015 (episodes, and random starts in them); Kapturowski et al. 2019 (sequences).
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor


class EpisodeReplay:
    """The replay memory.

    Args:
        capacity: steps that are kept, of all copies together.

    Raises:
        ValueError: a capacity below 1.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"expected a replay memory of at least 1 step, got {capacity}")
        self.capacity = capacity
        self._now = 0  # steps of each copy so far
        self._size = 0  # steps of each copy that are kept
        self._store: TensorDict | None = None
        self._rows = self._begins = self._ends = torch.zeros(
            0, dtype=torch.long
        )  # of episodes, in steps so far

    def __len__(self) -> int:
        """Steps that can be drawn."""
        return int((self._ends - self._begins).sum())

    @property
    def n_episodes(self) -> int:
        """Episodes that can be drawn from, those that have not ended yet among them."""
        return len(self._rows)

    def extend(self, rollout: TensorDict) -> None:
        """Write the next steps of every copy, over the oldest.

        Args:
            rollout: (n, n_steps), always of the same copies; see `RolloutCollector.collect`.

        Raises:
            ValueError: a rollout longer than what is kept, or of another number of copies than before.
        """
        n, n_steps = rollout.shape
        if self._store is None:
            self._size = size = self.capacity // n
            self._store = rollout.apply(
                lambda x: x.new_zeros(n, size, *x.shape[2:]), batch_size=torch.Size([n, size])
            )
        assert self._store is not None
        if n_steps > self._size or n != len(self._store):
            raise ValueError(
                f"expected rollouts of {len(self._store)} copies and at most {self._size} steps of each, got {n} and "
                f"{n_steps}; enlarge the capacity (now {self.capacity}), or take a memory for each number of copies"
            )
        times = torch.arange(self._now, self._now + n_steps)
        self._store[:, times % self._size] = rollout
        rows, steps = rollout["is_init"][..., 0].nonzero(as_tuple=True)
        self._tabulate(torch.cat([self._rows, rows]), torch.cat([self._begins, self._now + steps]), n_steps)

    def episodes(self, n: int, generator: torch.Generator) -> TensorDict:
        """Whole episodes, each as likely.

        Args:
            n: how many. generator: of the draw.

        Returns:
            (n, longest episode's steps).

        Raises:
            ValueError: nothing to draw from, here and below.
        """
        chosen, _ = self._drawn(torch.ones_like(self._begins), n, generator)
        return self._pieces(chosen, self._begins[chosen], self._ends[chosen])

    def windows(self, n: int, length: int, generator: torch.Generator, burn_in: int = 0) -> TensorDict:
        """Starts anywhere in episodes, each step as likely: an episode is as likely as it is long.

        Args:
            n: how many. length: steps from the start on, fewer where the episode ends before.
            generator: of the draw. burn_in: steps in front of the start, as far as the episode has them.

        Returns:
            (n, up to burn_in + length steps).
        """
        chosen, steps = self._drawn(self._ends - self._begins, n, generator)
        starts = self._begins[chosen] + steps
        return self._pieces(chosen, torch.maximum(starts - burn_in, self._begins[chosen]), starts + length)

    def sequences(
        self, n: int, length: int, stride: int, generator: torch.Generator, burn_in: int = 0
    ) -> TensorDict:
        """Sequences that begin every `stride` steps of an episode, each of all sequences as likely.

        Those inside an episode of which nothing would be left after the burn-in are not drawn.

        Args:
            n: how many. length: steps after the burn-in, fewer where the episode ends before.
            stride: steps from one sequence's beginning to the next. generator: of the draw.
            burn_in: steps at the front.

        Returns:
            (n, up to burn_in + length steps).
        """
        lengths = self._ends - self._begins
        counts = 1 + (lengths - burn_in - 1).clamp(min=0) // stride
        chosen, which = self._drawn(counts, n, generator)
        starts = self._begins[chosen] + which * stride
        return self._pieces(chosen, starts, starts + burn_in + length)

    def _tabulate(self, rows: Tensor, begins: Tensor, n_steps: int) -> None:
        """Order the episodes, each ending where the copy's next begins, and drop those that are overwritten."""
        self._now += n_steps
        order = torch.argsort(rows * self._now + begins)
        rows, begins = rows[order], begins[order]
        ends = torch.full_like(begins, self._now)
        ends[:-1] = torch.where(rows[1:] == rows[:-1], begins[1:], self._now)
        kept = begins >= self._now - self._size
        self._rows, self._begins, self._ends = rows[kept], begins[kept], ends[kept]

    def _drawn(self, counts: Tensor, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Of as many things in each episode, each as likely: the episode's number, and the thing's number in it."""
        self._require_episodes()
        up_to = counts.cumsum(0)
        drawn = torch.randint(int(up_to[-1]), (n,), generator=generator)
        chosen = torch.searchsorted(up_to, drawn, right=True)
        return chosen, drawn - (up_to - counts)[chosen]

    def _require_episodes(self) -> None:
        if self.n_episodes == 0:
            raise ValueError(
                "there is no episode to draw from: "
                + (
                    "call extend with a rollout first"
                    if self._now == 0
                    else f"none began within the last {self._size} steps of a copy; enlarge the capacity, now "
                    f"{self.capacity}"
                )
            )

    def _pieces(self, episodes: Tensor, starts: Tensor, ends: Tensor) -> TensorDict:
        """Steps from starts to ends, or to the episodes' ends; past them a piece's last step is repeated."""
        assert self._store is not None
        ends = torch.minimum(ends, self._ends[episodes])
        times = starts[:, None] + torch.arange(int((ends - starts).max()))
        mask = times < ends[:, None]
        slots = torch.minimum(times, ends[:, None] - 1) % self._size
        pieces: TensorDict = self._store[self._rows[episodes, None], slots]
        return pieces.set("mask", mask)
