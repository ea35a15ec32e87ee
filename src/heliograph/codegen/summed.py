"""Results that a block of runs adds to sums over runs [entry][batch].

Run r goes to batch r mod BATCHES. A row of sums is W - 1 longer than there are batches, so that the W consecutive runs
of a block never turn back to its beginning; what stands beyond its end is added to its beginning at last (`folded`).
"""

from typing import NamedTuple

import numpy as np


class Summed(NamedTuple):
    """Which outputs are summed, leaf by leaf; into how many batches; which input is the run's number (u32)."""

    outputs: tuple[bool, ...]
    batches: int
    number: int


def row_length(width: int, batches: int) -> int:
    """Numbers of a row of sums."""
    return batches + width - 1


def folded(sums: np.ndarray, batches: int) -> np.ndarray:
    """Sums (..., batch) of rows (..., `row_length`)."""
    result = sums[..., :batches].copy()
    beyond = sums[..., batches:]
    result[..., : beyond.shape[-1]] += beyond
    return result
