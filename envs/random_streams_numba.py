"""`random_streams.fill` as one compiled loop: the same integers, so the same numbers to the last bit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True)  # type: ignore[untyped-decorator]
def fill(key: Any, drawn: Any, stream: Any, rows: Any, doubles: Any) -> None:
    """See `beliefgym.envs.random_streams.fill`; the rounds are those of its `philox_4x32`."""
    low = np.uint64(0xFFFFFFFF)
    shift = np.uint64(32)
    for r in range(rows.shape[0]):
        i = rows[r]
        for block in range(doubles.shape[1] // 2):
            index = drawn[i] + np.uint64(block)
            c0, c1 = index & low, index >> shift
            c2, c3 = np.uint64(stream), np.uint64(0)
            k0, k1 = key[0, i], key[1, i]
            for round_ in range(10):
                if round_ > 0:
                    k0 = (k0 + np.uint64(0x9E3779B9)) & low
                    k1 = (k1 + np.uint64(0xBB67AE85)) & low
                p = np.uint64(0xD2511F53) * c0
                q = np.uint64(0xCD9E8D57) * c2
                c0, c1, c2, c3 = (q >> shift) ^ c1 ^ k0, q & low, (p >> shift) ^ c3 ^ k1, p & low
            high = (c0 >> np.uint64(5)) * np.uint64(67108864) + (c1 >> np.uint64(6))
            doubles[r, 2 * block] = np.float64(high) * 1.1102230246251565e-16
            high = (c2 >> np.uint64(5)) * np.uint64(67108864) + (c3 >> np.uint64(6))
            doubles[r, 2 * block + 1] = np.float64(high) * 1.1102230246251565e-16
