"""Computation on one run, applied to many: in parallel, in blocks that fit the cache, on all cores."""

import os
from collections.abc import Callable

import jax
import numpy as np

from heliograph.engine.choice import choose_code, get_thread_pool
from heliograph.numerics.check import check_count, fail, show_value
from heliograph.numerics.float64 import fully_optimised, to_numpy
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.types import PyTree

WIDTH = 128  # runs in parallel: the smoother steps of a hundred steps of them stay in the cache


def over_runs(function: Callable[..., PyTree], *arrays: PyTree, width: int = WIDTH) -> PyTree:
    """Return a function's results of many runs, which are the leading axis of every array and of every result.

    The function is written with jax.numpy and may step filters under `jax.lax.scan`. It is compiled once for a function
    and its shapes, so define it once. NumPy arrays come back, and each core computes its share of the runs. Native code
    computes them, or XLA, `width` runs in parallel, for functions that native code does not support
    (`heliograph.engine.engine_of` says which).

    Precision follows jax.numpy with doubles enabled: rows of float32 alone give float32 results, but together with a
    filter's numbers, which are doubles, they give doubles. A filter computes in doubles, since single precision loses a
    covariance whose variances differ by ten million; `monte_carlo(precision="float32")` has filters written for it.

    Args:
        function: a function of one run's arrays.
        arrays: arrays (run, ...) of numbers, all of the same number of runs.
        width: runs in parallel under XLA; 128 by default.

    Raises:
        ValueError: no arrays, or arrays with different numbers of runs.
    """
    if not callable(function):
        raise fail("function over runs", "a function of one run's arrays", show_value(function))
    check_count("width", width)
    # All arrays must have the same leading axis, and none may be empty.
    values = [_read_numbers(array) for array in arrays]
    if not values or any(value.ndim == 0 or len(value) != len(values[0]) or not value.size for value in values):
        raise fail("arrays over runs", "one leading axis of runs, at least one", [np.shape(a) for a in values])
    # Use native code if it supports the function.
    choice = choose_code(function, values, differs_by_run=[True] * len(values))
    return choice.results() if choice.code is not None else _apply_by_xla(function, values, width)


def _apply_by_xla(function: Callable[..., PyTree], values: list[np.ndarray], width: int) -> PyTree:
    """Return the function's results (run, ...) of `values` (run, ...), by XLA, at most `width` runs in parallel.

    The runs are shared among the cores; each core computes its share in blocks of `width` runs, a vectorised program.
    """
    # Each core computes `blocks` times `width` runs: such that all cores are busy and little is padding. Numbers of
    # both are rounded up, -(-a // b).
    runs, cores = len(values[0]), os.cpu_count() or 1
    width = min(width, runs)
    blocks = -(-runs // (width * cores))
    width = -(-runs // (blocks * cores))  # no wider than it need be: few runs are left to fill up
    share = blocks * width

    def compute_share(core: int) -> PyTree:
        """Return the results of one core's share of the runs."""
        runs_of_core = slice(core * share, (core + 1) * share)
        return _apply_in_blocks(function, [a[runs_of_core] for a in values], blocks, width)

    # Each core computes its blocks, then copies them to their place; few runs need fewer cores.
    computed = list(get_thread_pool().map(compute_share, range(-(-runs // share))))
    results = jax.tree.map(lambda leaf: np.empty((runs, *leaf.shape[1:]), leaf.dtype), computed[0])

    def copy_back(core: int) -> None:
        """Copy one core's results into the array of all runs; by all cores at once, since copying takes time too."""
        for target, leaf in zip(jax.tree.leaves(results), jax.tree.leaves(computed[core]), strict=True):
            target[core * share :][: len(leaf)] = leaf

    list(get_thread_pool().map(copy_back, range(len(computed))))
    return results


def _apply_in_blocks(function: Callable[..., PyTree], values: list[np.ndarray], blocks: int, width: int) -> PyTree:
    """Return the function's results (run, ...) of `values` (run, ...), computed in `blocks` blocks of `width` runs.

    The runs of a block are computed in parallel. The last block is filled up with runs whose results are cut off again.
    """
    runs = len(values[0])
    padded = [_pad_runs(a, blocks * width) for a in values]
    by_block = [a.reshape(blocks, width, *a.shape[1:]) for a in padded]
    with jax.enable_x64(True):
        outputs = to_numpy(_map_blocks(function, by_block))  # (block, run of the block, ...)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:runs], outputs)


def _read_numbers(value: PyTree) -> np.ndarray:
    """Return numbers as an array, with masked ones (of numpy.ma) as NaN; raise ValueError for anything else."""
    try:
        values = np.asarray(fill_masked(value))
    except ValueError:  # rows of different lengths
        raise fail("arrays over runs", "arrays of numbers", show_value(value)) from None
    if values.dtype.kind not in "biufc":
        raise fail("arrays over runs", "arrays of numbers", show_value(value))
    return values


def _pad_runs(values: np.ndarray, count: int) -> np.ndarray:
    """Return values (run, ...) padded to `count` runs with copies of the last one."""
    missing = count - len(values)
    return values if not missing else np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])


@fully_optimised
def _map_blocks(function: Callable[..., PyTree], parts: list[PyTree]) -> PyTree:
    """Return a function's results of each run of `parts`, both (block, run, ...), one block after another."""
    return jax.lax.map(lambda block: jax.vmap(function)(*block), parts)
