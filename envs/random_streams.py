"""Random numbers for a batch of environments: the same for a copy alone and in any batch.

`Philox 4x32-10` (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3") is a function of a
key and a counter and has no other state. Here the key is the seed of one copy, and the counter counts the
blocks that this copy has drawn, so a whole batch is drawn by a few array operations, and copy i sees the
numbers it would see alone, whatever the others do. A `numpy.random.Generator` per copy has the same
property at the price of a Python call for each copy and step.

One round on the counter words (c0, c1, c2, c3) with key (k0, k1):

    p = 0xD2511F53 c0,  r = 0xCD9E8D57 c2
    (c0, c1, c2, c3) <- (hi(r) ^ c1 ^ k0, lo(r), hi(p) ^ c3 ^ k1, lo(p))

and the key words grow by 0x9E3779B9 and 0xBB67AE85 from round to round.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MULTIPLIER = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_WEYL = (0x9E3779B9, 0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_32 = np.uint64(32)
_ROUNDS = 10


def philox_4x32(counter: NDArray[np.uint64], key: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Philox 4x32-10, elementwise over a batch.

    Args:
        counter: (4, ...) 32-bit words, held in uint64.
        key: (2, ...) 32-bit words, held in uint64.

    Returns:
        (4, ...) random 32-bit words, held in uint64.
    """
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for round_ in range(_ROUNDS):
        if round_:
            k0 = (k0 + np.uint64(_WEYL[0])) & _LOW
            k1 = (k1 + np.uint64(_WEYL[1])) & _LOW
        product_0 = _MULTIPLIER[0] * c0
        product_1 = _MULTIPLIER[1] * c2
        c0, c1, c2, c3 = (
            (product_1 >> _32) ^ c1 ^ k0,
            product_1 & _LOW,
            (product_0 >> _32) ^ c3 ^ k1,
            product_0 & _LOW,
        )
    return np.stack([c0, c1, c2, c3])


def spread_seeds(seed: int | Sequence[int | None] | None, n: int) -> list[int | None]:
    """The seed of each of n copies: an int s gives s, s + 1, ...; a sequence is taken as it is.

    Raises:
        ValueError: a sequence of another length than n, or a negative seed.
    """
    if seed is None:
        return [None] * n
    seeds: list[int | None]
    seeds = [seed + i for i in range(n)] if isinstance(seed, int | np.integer) else list(seed)
    if len(seeds) != n:
        raise ValueError(
            f"expected one seed for each of {n} copies, got {len(seeds)}; pass one int or {n} seeds"
        )
    for value in seeds:
        if value is not None and (not isinstance(value, int | np.integer) or value < 0):
            raise ValueError(f"expected seeds that are integers of at least 0, got {value!r}")
    return seeds


def fresh_seeds(n: int) -> NDArray[np.uint64]:
    """n seeds from the operating system's entropy."""
    return np.array([secrets.randbits(64) for _ in range(n)], dtype=np.uint64)


class RandomStreams:
    """One random stream for each copy of an environment, drawn for all copies at once.

    Args:
        seeds: (n,) seeds, of which 64 bits count.
        stream: number of the stream below the seed (0 for the physics; each wrapper that draws takes another).
    """

    def __init__(self, seeds: Sequence[int] | NDArray[np.uint64], stream: int = 0) -> None:
        words = np.array([int(seed) & 0xFFFFFFFFFFFFFFFF for seed in seeds], dtype=np.uint64)
        self._key = np.stack([words & _LOW, words >> _32])
        self._stream = np.uint64(stream)
        self._drawn = np.zeros(len(words), dtype=np.uint64)

    def __len__(self) -> int:
        return len(self._drawn)

    def reseed(self, seeds: Sequence[int | None]) -> None:
        """Start the streams of the copies whose seed is not None anew; the others run on."""
        for i, seed in enumerate(seeds):
            if seed is not None:
                self._key[0, i] = int(seed) & 0xFFFFFFFF
                self._key[1, i] = (int(seed) >> 32) & 0xFFFFFFFF
                self._drawn[i] = 0

    def uniform(self, size: int, mask: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """Uniform numbers in [0, 1) with 53 random bits.

        Args:
            size: how many for each copy.
            mask: (n,) the copies that draw; the others do not advance, and their rows are zero.

        Returns:
            (n, size).
        """
        return self._on_rows(self._uniform, size, mask)

    def normal(self, size: int, mask: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """Standard normal numbers by the Box-Muller transform; arguments and shape as `uniform`."""
        return self._on_rows(self._normal, size, mask)

    def _on_rows(self, draw: Any, size: int, mask: NDArray[np.bool_] | None) -> NDArray[np.float64]:
        if mask is None or mask.all():
            numbers: NDArray[np.float64] = draw(np.arange(len(self)), size)
            return numbers
        numbers = np.zeros((len(self), size))
        rows = np.flatnonzero(mask)
        if len(rows):
            numbers[rows] = draw(rows, size)
        return numbers

    def _normal(self, rows: NDArray[np.intp], size: int) -> NDArray[np.float64]:
        pairs = (size + 1) // 2
        u = self._uniform(rows, 2 * pairs)
        radius = np.sqrt(-2.0 * np.log1p(-u[:, :pairs]))
        angle = (2.0 * np.pi) * u[:, pairs:]
        return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], axis=1)[:, :size]

    def _uniform(self, rows: NDArray[np.intp], size: int) -> NDArray[np.float64]:
        blocks = (size + 1) // 2
        doubles = np.empty((len(rows), 2 * blocks))
        _filler()(self._key, self._drawn, self._stream, rows, doubles)
        self._drawn[rows] += np.uint64(blocks)
        return doubles[:, :size]


def fill(
    key: NDArray[np.uint64],
    drawn: NDArray[np.uint64],
    stream: np.uint64,
    rows: NDArray[np.intp],
    doubles: NDArray[np.float64],
) -> None:
    """Write each row's next uniform doubles, two from a block of four words.

    Args:
        key: (2, n) of all copies. drawn: (n,) blocks drawn before, not changed here. stream: its number.
        rows: (k,) the copies that draw.
        doubles: (k, 2 * blocks), written.
    """
    index: Any = drawn[rows][:, None] + np.arange(doubles.shape[1] // 2, dtype=np.uint64)
    counter = np.stack([index & _LOW, index >> _32, np.full_like(index, stream), np.zeros_like(index)])
    w0, w1, w2, w3 = philox_4x32(counter, key[:, rows][:, :, None])
    doubles[:, 0::2] = _to_unit(w0, w1)
    doubles[:, 1::2] = _to_unit(w2, w3)


@cache
def _filler() -> Callable[..., None]:
    """`fill`, or the same numbers from a compiled loop where numba is installed."""
    try:
        from beliefgym.envs.random_streams_numba import fill as compiled
    except ImportError:
        return fill
    return compiled  # type: ignore[no-any-return]


def _to_unit(high: NDArray[np.uint64], low: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Two 32-bit words to a double in [0, 1) with 53 random bits."""
    bits = (high >> np.uint64(5)) * np.uint64(1 << 26) + (low >> np.uint64(6))
    return bits.astype(np.float64) * 2.0**-53
