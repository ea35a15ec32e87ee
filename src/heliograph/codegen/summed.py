"""Results that a block of runs adds to sums over runs [entry][batch].

Run r belongs to batch r mod BATCHES. A row of sums is W - 1 longer than the number of batches, so that W consecutive
runs of a block never wrap around; what is beyond the end is added to the beginning at last (`folded`).
"""

from typing import NamedTuple

import numpy as np


class Summed(NamedTuple):
    """Outputs that are summed, leaf by leaf; into how many batches; which input is the run's number (u32)."""

    outputs: tuple[bool, ...]
    batches: int
    number: int


def row_length(width: int, batches: int) -> int:
    """Return the length of a row of sums."""
    return batches + width - 1


def folded(sums: np.ndarray, batches: int) -> np.ndarray:
    """Return sums (..., batch) from rows (..., `row_length`)."""
    result = sums[..., :batches].copy()
    beyond = sums[..., batches:]
    result[..., : beyond.shape[-1]] += beyond
    return result
