"""Arrays of a call of native code: contiguous numbers of the code's types, and their addresses."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from straightline.llvm.memory_layout import LINE
from straightline.machine_code import MachineCode
from straightline.result_memory import align_to_cache_line


def convert_to_memory(x: Any, dtype: Any) -> np.ndarray:
    """Return an argument of a call as a contiguous array of type `dtype`; a random key becomes its integer words.

    Reals are not rounded to integers: ValueError is raised where an integer or a flag is expected and a real is given.
    """
    if type(x) is np.ndarray and x.dtype == dtype and x.flags.c_contiguous:
        return x  # it needs no copy
    if isinstance(x, jax.Array) and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jax.random.key_data(x)
    array = np.asarray(x)
    accepted_kinds = "biuf" if np.dtype(dtype).kind == "f" else "biu"  # b: flag, i and u: integer, f: real
    if array.dtype.kind not in accepted_kinds:
        raise ValueError(f"arguments: expected numbers of type {np.dtype(dtype)}, got {array.dtype}")
    return np.ascontiguousarray(array, dtype=dtype).reshape(array.shape)


def list_addresses(arrays: Sequence[np.ndarray]) -> list[int]:
    """Return the address of each array's first number."""
    return [x.__array_interface__["data"][0] for x in arrays]


def allocate_aligned(size: int) -> np.ndarray:
    """Return so many bytes of zero, at an address that is a multiple of a cache line."""
    return align_to_cache_line(np.zeros(size + LINE, np.uint8))


class MemoryOfCall(NamedTuple):
    """Code and all the memory of one call, held by each thread that computes a part of it.

    Who waits for the parts may stop waiting, at a Ctrl-C for example: the threads go on to write.
    """

    machine: MachineCode
    pointers: np.ndarray
    memory: Any
    runs: int

    def compute(self, begin: int, end: int, scratch: int) -> None:
        """Compute blocks of runs in this thread, from number `begin` up to but without `end`.

        A block is as many runs as a vector has lanes. The thread has `scratch` bytes of memory for its own numbers.
        """
        memory = allocate_aligned(scratch)
        self.machine.run(self.pointers.ctypes.data, memory.ctypes.data, begin, end, self.runs)
