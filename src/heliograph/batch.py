"""A computation on one run, done for many: side by side in blocks that stay in the cache, on all cores."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import numpy as np

from heliograph.check import check_count, fail
from heliograph.float64 import to_numpy

WIDTH = 256  # runs side by side


def over_runs(function: Callable[..., Any], *arrays: Any, width: int = WIDTH) -> Any:
    """Apply a function of one run's arrays to many runs: the leading axis of every array and of every result.

    The function is written with jax.numpy and may step filters under `jax.lax.scan`. It is compiled once for a function
    and its shapes, so define it once. NumPy arrays come back. `width` runs are computed side by side, and each core
    takes its share of the runs.

    Raises:
        ValueError: no arrays, or arrays with different numbers of runs.
    """
    check_count("width", width)
    values = [np.asarray(a) for a in arrays]
    if not values or any(a.ndim == 0 or len(a) != len(values[0]) or not len(a) for a in values):
        raise fail("arrays over runs", "one leading axis of runs, at least one", [np.shape(a) for a in values])
    runs, cores = len(values[0]), os.cpu_count() or 1
    width = min(width, runs)
    share = -(-runs // (width * cores))  # blocks of each core

    def work(core: int) -> Any:
        first = core * share * width
        taken = np.minimum(np.arange(first, first + share * width), runs - 1)  # the last run fills up
        parts = [a[taken].reshape(share, width, *a.shape[1:]) for a in values]
        with jax.enable_x64(True):
            return to_numpy(_blocks(function, parts))

    count = -(-runs // (share * width))
    with ThreadPoolExecutor(cores) as pool:
        found = list(pool.map(work, range(count)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves).reshape(-1, *leaves[0].shape[2:])[:runs], *found)


@eqx.filter_jit
def _blocks(function: Callable[..., Any], parts: list[Any]) -> Any:
    return jax.lax.map(lambda block: jax.vmap(function)(*block), parts)
