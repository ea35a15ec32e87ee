"""Memory of results: what nobody holds any more is kept for the next ones, since fresh memory costs more than numbers.

The system gives memory in pages, of zeros, when they are first written. Of 10,000 runs of 100 Kalman steps, 32 MB of
means, that takes 12 to 33 ns a step, and the numbers themselves 21 ns of a processor. Of one run of 30,000 steps,
results of 0.2 to 4 MB, it takes 20 ns a step, and the numbers 30.
"""

import math
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from straightline.llvm.memory_layout import LINE

LEAST = 1 << 17  # bytes of an array below which the library of C has memory at hand
MOST = 1 << 28  # bytes that a process keeps: what was kept first goes back to the system
ARRAYS = 64  # that it keeps

_kept: dict[int, np.ndarray] = {}  # by identity, oldest first; a single operation of a dict needs no lock


class _LoanedBytes:
    """Kept bytes lent to an array: NumPy holds this object for it and its views, and drops it with the last one."""

    def __init__(self, memory: np.ndarray):
        """Hold an array of bytes that is lent to a result, and offer its memory to NumPy."""
        self._memory = memory
        # By this protocol NumPy makes an array of the bytes, which keeps this object alive.
        self.__array_interface__ = memory.__array_interface__

    def __del__(self, ends: Callable[[], bool] = sys.is_finalizing) -> None:
        """Keep the memory for later results, unless the process ends."""
        if not ends():  # at the end of the process the names of this module are gone
            _keep_memory(self._memory)


def make_aligned_array(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Return an array of undefined numbers at an address that is a multiple of a cache line.

    An array of LEAST bytes or more reuses the memory of an earlier result that is free again, if any fits.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize  # bytes
    needed = size + LINE  # room to begin at a multiple of a cache line
    memory = np.empty(needed, np.uint8) if size < LEAST else np.asarray(_LoanedBytes(_take_memory(needed)))
    numbers: np.ndarray = align_to_cache_line(memory)[:size].view(dtype)
    return numbers.reshape(shape)


def align_to_cache_line(memory: np.ndarray) -> np.ndarray:
    """Return the part of an array of bytes that begins at a multiple of a cache line, LINE bytes shorter than it."""
    start = -memory.ctypes.data % LINE
    return memory[start : start + len(memory) - LINE]


def _take_memory(size: int) -> np.ndarray:
    """Return an array of at least `size` bytes: kept memory of at most twice the size, or else fresh memory.

    The memory that was kept last is tried first. Other threads may take memory meanwhile; what `pop` returns belongs
    to this thread alone.
    """
    for key in reversed(tuple(_kept)):
        memory = _kept.get(key)  # None where another thread took it
        if memory is not None and size <= len(memory) <= 2 * size and _kept.pop(key, None) is not None:
            return memory
    return np.empty(size, np.uint8)


def _keep_memory(memory: np.ndarray) -> None:
    """Keep memory for later results, and give back the oldest kept memory if there is too much.

    At most MOST bytes and at most ARRAYS arrays are kept in all.
    """
    if len(memory) <= MOST:
        _kept[id(memory)] = memory
    for key in _list_surplus():
        _kept.pop(key, None)


def _list_surplus() -> Iterator[int]:
    """Yield the keys of the kept memory that is to be given back, the oldest first.

    The rest has at most MOST bytes and at most ARRAYS arrays.
    """
    kept = tuple(_kept.items())
    size, count = sum(len(memory) for _, memory in kept), len(kept)
    for key, memory in kept:
        if size <= MOST and count <= ARRAYS:
            return
        size, count = size - len(memory), count - 1
        yield key
