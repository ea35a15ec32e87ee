"""Arrays of a call of native code: contiguous numbers of the code's types, and their addresses."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from straightline.llvm.memory_layout import LINE
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
