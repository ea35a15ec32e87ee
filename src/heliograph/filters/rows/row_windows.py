"""Windows of rows of a recording, and the results of runs over them."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.numerics.types import Int, PyTree

Which = slice | np.ndarray  # which entries of a leading axis: a slice, or their indices


class WindowBatch(NamedTuple):
    """Some of several windows: their numbers, the first row of each (n,), and their rows (n, length, ...)."""

    which: slice
    first: Int[np.ndarray, " n"]
    rows: PyTree


def take_windows_in_parts(rows: PyTree, begin: Int[np.ndarray, " n"], length: int) -> Iterator[WindowBatch]:
    """Yield windows as `take_windows` returns them, in two parts: views of the rows, and then copies.

    `begin` holds the first rows of the windows. Windows at the start that follow one another need no copy.
    """
    total = len(jax.tree.leaves(rows)[0])
    begin_if_adjacent = np.arange(len(begin)) * length
    view_count = int(np.sum((begin == begin_if_adjacent) & (begin_if_adjacent + length <= total)))
    for selection in (slice(view_count), slice(view_count, None)):
        if len(first := begin[selection]):
            yield WindowBatch(selection, first, take_windows(rows, first, length))


def take_windows(rows: PyTree, begin: Int[np.ndarray, " n"], length: int) -> PyTree:
    """Return windows of rows (n, length, ...); after the end of the data the last row is repeated.

    They are views, not copies, if they follow one another from the first row on and end within the data.

    Args:
        rows: arrays (rows, ...).
        begin: number of the first row of each window (n,).
        length: rows of a window.
    """
    total = len(jax.tree.leaves(rows)[0])
    are_blocks = not np.any(begin % length) and bool(np.all(begin + length <= total))
    are_first_blocks = are_blocks and np.array_equal(begin, np.arange(len(begin)) * length)

    def take_from(leaf: np.ndarray) -> np.ndarray:
        """Return the windows of one array of rows, as views if possible, else as copies."""
        if are_first_blocks:
            return _split_into_blocks(leaf, length)[: len(begin)]
        return _split_into_blocks(leaf, length)[begin // length] if are_blocks else _copy_windows(leaf, begin, length)

    return jax.tree.map(take_from, rows)


def _split_into_blocks(leaf: np.ndarray, length: int) -> np.ndarray:
    """Return rows in blocks of this length (blocks, length, ...), a view, without rows behind the last whole block."""
    blocks = len(leaf) // length
    return leaf[: blocks * length].reshape(blocks, length, *leaf.shape[1:])


def _copy_windows(leaf: np.ndarray, begin: Int[np.ndarray, " n"], length: int) -> np.ndarray:
    """Return a copy of each window of rows (n, length, ...); after the end of the data the last row is repeated.

    `begin` is the number of each window's first row.
    """
    windows: np.ndarray = np.empty((len(begin), length, *leaf.shape[1:]), leaf.dtype)
    for window, first_row in zip(windows, begin, strict=True):
        available = leaf[first_row : first_row + length]
        window[: len(available)] = available
        window[len(available) :] = leaf[-1]
    return windows


def run_and_join(
    function: Callable[..., PyTree], calls: Sequence[tuple[Any, ...]], differs_by_run: Sequence[bool]
) -> PyTree:
    """Return the results of several calls, each of several runs, joined in the same arrays; None without native code.

    `calls` holds the arguments of each call. Calls differ in the number of runs, and one compiled code computes all.
    `differs_by_run` says which arguments have an entry for each run.
    """
    choices = [choose_code(function, arguments, differs_by_run=differs_by_run) for arguments in calls]
    codes = [choice.code for choice in choices]
    return None if None in codes else codes[0].compute_calls([choice.arrays for choice in choices])


def take(states: PyTree, which: Which) -> PyTree:
    """Return the states with the indices `which`, from states stacked along the leading axis of every array."""
    return jax.tree.map(lambda leaf: leaf[which], states)
