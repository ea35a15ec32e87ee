"""Rows in which only means move: on complete rows the covariances of a linear filter converge, and its gains with them.

A row is complete if no number of it is missing. Native code finds which numbers depend on data: given states that
differ between runs only in their means, and a complete row, all other numbers after the row are common to all runs,
unless plant, sensor or channel vary by time or by an input. If so, and two states a thousand rows apart agree to
rounding, the covariances and gains have settled: they are computed once, and each further complete row only needs the
closed loop m = m- + K (z - H m-). For four states and two outputs this takes a tenth of a filter's time.

Settled covariances may still alternate by a rounding; the stored one differs from them by as much. Means differ by
roundings from those of a pass that computes all covariances.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.filters.rows.gaussians_in_states import ROUNDING, find_equal_states, means_of, select_state, with_means
from heliograph.filters.rows.linear_recursion import Recursion, make_row_numbers, sum_rows
from heliograph.filters.rows.row_windows import take
from heliograph.numerics.process.repeated_rows_in_memory import repeat_row
from heliograph.numerics.types import Array, Bool, Int, PyTree
from straightline import present

TURNS = 4  # rows until covariances count as settled, in units of the rows in which the start is forgotten


class SettledState(NamedTuple):
    """A state of which complete rows change only the means, and the output of such a row.

    `varies` has a flag for each leaf of `outputs`: True where it depends on data. Those leaves and the means of `state`
    have no meaning here: each row has its own.
    """

    state: PyTree
    outputs: PyTree
    varies: tuple[bool, ...]

    def repeat_with_means(self, means: Sequence[np.ndarray]) -> PyTree:
        """Return n copies of the settled state, along a leading axis, with these means (n, ...) in place of its own."""
        return with_means(repeat_state(self.state, len(means[0])), means)

    def fill_rows(self, varying: list[np.ndarray]) -> PyTree:
        """Return the outputs of rows (chunks, rows, ...) from their leaves that vary with data.

        `self.varies` has a flag for each leaf: whether it depends on data. All others are those of `self.outputs`, the
        output of a settled row, and are repeated for each row.
        """
        chunks, rows = varying[0].shape[:2]
        leaves, structure = jax.tree.flatten(self.outputs)

        def repeat(leaf: np.ndarray) -> np.ndarray:
            """Return a leaf that does not vary, once for each row."""
            return repeat_row(leaf, chunks * rows).reshape(chunks, rows, *leaf.shape)

        filled = [leaf if varies else repeat(leaf) for leaf, varies in zip(leaves, self.varies, strict=True)]
        return self._replace(outputs=jax.tree.unflatten(structure, filled)).fill_row(varying)

    def fill_row(self, varying: list[Any]) -> PyTree:
        """Return the output of a row from its leaves that vary with data.

        `self.varies` says of each leaf whether it depends on data. All others are those of `self.outputs`, the output
        of a settled row.
        """
        next_varying = iter(varying)
        leaves = jax.tree.leaves(self.outputs)
        joined = [next(next_varying) if varies else leaf for leaf, varies in zip(leaves, self.varies, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(self.outputs), joined)

    def select_varying(self, output: PyTree) -> list[Any]:
        """Return the leaves of a row's output that depend on data, those for which `self.varies` is True."""
        return [leaf for leaf, varies in zip(jax.tree.leaves(output), self.varies, strict=True) if varies]

    def matches(self, states: PyTree) -> Bool[np.ndarray, " n"]:
        """Return which of the states (n, ...) have the covariances of this one, and all else but the means.

        In such a state the covariances and gains no longer change, so that only means need be computed.
        """
        means = means_of(states)
        no_means = [()] * len(means)  # an empty tuple has no leaves, so that means are not compared
        other_leaves, own_leaves = (jax.tree.leaves(with_means(x, no_means)) for x in (states, self.state))
        # Most states have the same numbers. Other factors may have the same covariance, so these are compared by it.
        are_same = [(x == y).reshape(len(x), -1).all(axis=1) for x, y in zip(other_leaves, own_leaves, strict=True)]
        is_equal: np.ndarray = np.all(are_same, axis=0)
        unsure = np.flatnonzero(~is_equal)
        if len(unsure):
            is_equal[unsure] = find_equal_states(
                take(states, unsure), self.repeat_with_means([mean[unsure] for mean in means])
            )
        return is_equal


def find_settled_state(recursion: Recursion, start: PyTree, rows: PyTree, ahead: int) -> SettledState | None:
    """Find the state to which complete rows converge, but for its means; None if it finds none or has no native code.

    The filter steps over TURNS (4) times `ahead` rows of zeros, in two windows. Covariances have settled if the second
    window changed only means.

    Args:
        recursion: steps the filter over rows.
        start: the filter's state before any row.
        rows: measurements and inputs (rows, ...).
        ahead: number of rows in which the filter is supposed to forget its start.
    """
    row = jax.tree.map(lambda leaf: np.zeros_like(leaf[0]), rows)
    varies = find_data_dependent_leaves(recursion, start, row)
    if varies is None:
        return None
    arguments = recursion, start, row, np.arange(TURNS * ahead).reshape(2, -1)
    choice = choose_code(_repeat_row_over_windows, arguments, differs_by_run=[False] * len(arguments))
    return None if choice.code is None else find_unchanged_state(varies, *choice.results())


def find_unchanged_state(varies: tuple[bool, ...], after_windows: PyTree, outputs: PyTree) -> SettledState | None:
    """Return the settled state after the second window of rows, or None if the second window changed more than means.

    Args:
        varies: which leaves of `outputs` depend on data.
        after_windows: states after each window, with axes (run, window, ...): one run, two windows.
        outputs: outputs of the last row of each window (1, 2, ...).
    """
    after_first = jax.tree.map(lambda leaf: leaf[:, 0], after_windows)
    after_second = jax.tree.map(lambda leaf: leaf[:, 1], after_windows)
    # Means follow the data, and are left out; all else must be the same.
    zero_means = [np.zeros_like(mean) for mean in means_of(after_second)]
    first_without_mean, second_without_mean = (with_means(state, zero_means) for state in (after_first, after_second))
    if not find_equal_states(second_without_mean, first_without_mean, ROUNDING)[0]:
        return None
    # The state of the only run, and its outputs in the second window.
    state = jax.tree.map(lambda leaf: leaf[0, ...], after_second)
    last_outputs = jax.tree.map(lambda leaf: leaf[0, 1, ...], outputs)
    return SettledState(state, last_outputs, varies)


def _repeat_row_over_windows(recursion: Recursion, start: PyTree, row: PyTree, numbers: Array) -> tuple[PyTree, PyTree]:
    """Step from `start` over two windows of rows that all equal `row`; return states and outputs at the windows' ends.

    `numbers` (2, rows) are the numbers of the rows of each window. Both results have a leading axis of two windows.
    """
    AfterRow = tuple[PyTree, PyTree]  # the state after a row, and the row's output

    def step(after_row: AfterRow, k: Any) -> tuple[AfterRow, Any]:
        """Step over the row as number k."""
        state, _ = after_row
        # `step_settled` takes the means apart from the state; here they are the state's own.
        return step_settled(recursion, state, means_of(state), row, k), None

    def scan_window(after_row: AfterRow, window: Any) -> tuple[AfterRow, AfterRow]:
        """Step over one window of row numbers; return the state and output at its end, as carry and as result."""
        end, _ = jax.lax.scan(step, after_row, window)
        return end, end

    state = jax.tree.map(jnp.asarray, start)
    # The carry of `lax.scan` needs an output before the first row: zeros of the same shapes.
    shapes = jax.eval_shape(lambda: step((state, None), numbers[0, 0])[0][1])
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    ends: AfterRow = jax.lax.scan(scan_window, (state, zeros), numbers)[1]
    return ends


def find_data_dependent_leaves(recursion: Recursion, start: PyTree, row: PyTree) -> tuple[bool, ...] | None:
    """Return for each array in the output of a complete row whether it depends on data; None if nothing can settle.

    Returns None if other parts of the state than its means depend on data, or without native code. The compiled code
    says for each result, in `choice.code.common`, whether it is the same for runs with different means and rows.
    """
    rows = jax.tree.map(lambda leaf: leaf[None], row)
    means = [np.asarray(mean)[None] for mean in means_of(start)]
    # Native code of one step (None if there is none), for runs with the same state but other means, rows and numbers.
    arguments = recursion, start, means, rows, np.zeros(1, int)
    choice = choose_code(step_settled, arguments, differs_by_run=[False, False, True, True, True])
    if choice.code is None:
        return None
    # Flags in the structure of `step_settled`'s results: the state after the row, and the row's output.
    is_state_common, is_output_common = jax.tree.unflatten(choice.code.tree, choice.code.common)
    # The means may depend on data: their flags are replaced by True.
    all_but_means = with_means(is_state_common, [True] * len(means_of(is_state_common)))
    if not all(jax.tree.leaves(all_but_means)):
        return None
    return tuple(not common for common in jax.tree.leaves(is_output_common))


def step_settled(
    recursion: Recursion, state: PyTree, means: Sequence[Array], row: PyTree, k: Array
) -> tuple[PyTree, PyTree]:
    """Step over a complete row from `state` with the given means; return the state after it and the row's output.

    `present` marks all numbers as arrived, so that no result depends on whether they are NaN.
    """
    z, u = row
    return recursion.step(with_means(state, means), (jax.tree.map(present, z), u), k)


def scan_settled_rows(
    recursion: Recursion, settled: SettledState, means: Sequence[Array], rows: PyTree, first: Array, count: Array
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Scan complete rows from a settled state, whose covariances and gains no longer change.

    `means` are those before the first row, which has the number `first`. Rows from number `count` on fill up the last
    chunk after the end of the data, and change no mean.

    Returns the last means, and for each row the leaves of its output that depend on data.
    """

    def step(means: list[jax.Array], row: tuple[PyTree, Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        """Step over one row (data, number); return the next means, and the leaves of the output that depend on data.

        The state is `settled.state` with these means. From row `count` on, after the end of the data, means stay.
        """
        data, k = row
        after, outputs = step_settled(recursion, settled.state, means, data, k)
        return select_state(k < count, means_of(after), means), settled.select_varying(outputs)

    return jax.lax.scan(step, [jnp.asarray(mean) for mean in means], (rows, make_row_numbers(rows, first)))


def sum_settled_rows(
    recursion: Recursion, settled: SettledState, means: Sequence[Array], rows: PyTree, first: Array, count: Array
) -> tuple[list[jax.Array], PyTree]:
    """Scan complete rows as `scan_settled_rows` does; return the last means, and the sums of outputs over rows.

    Covariances and gains are those of `settled`. From row `count` on, after the end of the data, nothing changes.
    """

    def step(means: list[jax.Array], data: PyTree, k: Array) -> tuple[list[jax.Array], PyTree]:
        """Step over complete row k from the settled state with these means; return the next means and the output."""
        after, outputs = step_settled(recursion, settled.state, means, data, k)
        return means_of(after), outputs

    return sum_rows(step, [jnp.asarray(mean) for mean in means], rows, first, count)


def means_after_settled_rows(
    recursion: Recursion, settled: SettledState, means: Sequence[Array], rows: PyTree, first: Array
) -> list[jax.Array]:
    """Return only the means after some complete rows; `first` is the number of the first row.

    Covariances and gains are those of `settled`, and do not change.
    """

    def step(means: list[jax.Array], row: tuple[PyTree, Array]) -> tuple[list[jax.Array], None]:
        """Step over one complete row (data, number) from the settled state with these means; return the next means."""
        data, k = row
        after, _ = step_settled(recursion, settled.state, means, data, k)
        return means_of(after), None

    first_means = [jnp.asarray(mean) for mean in means]
    last_means, _ = jax.lax.scan(step, first_means, (rows, make_row_numbers(rows, first)))
    return last_means


class CompleteBlocks(NamedTuple):
    """Which blocks of `size` rows have no missing number: `complete_before`[i] counts them among the first i blocks."""

    size: int
    complete_before: Int[np.ndarray, " blocks+1"]

    def are_complete(self, begin: Int[np.ndarray, " n"], length: int) -> Bool[np.ndarray, " n"]:
        """Return which windows of `length` rows from the rows `begin` on are complete; both are multiples of `size`."""
        count = len(self.complete_before) - 1  # of blocks
        first, end = (np.minimum(row // self.size, count) for row in (begin, begin + length))
        # A window is complete if as many of its blocks are complete as it has.
        return np.asarray(self.complete_before[end] - self.complete_before[first] == end - first)


def find_complete_blocks(z: PyTree, size: int) -> CompleteBlocks:
    """Return which blocks of `size` rows of measurements (rows, ...) are complete, without a missing number.

    The result holds the size, and how many of the first 0, 1, 2, ... blocks are complete.
    """
    total = len(jax.tree.leaves(z)[0])
    begin = np.arange(0, total, size)
    is_complete = np.ones(len(begin), bool)
    with np.errstate(over="ignore", invalid="ignore"):  # a block of huge numbers counts as incomplete
        for leaf in jax.tree.leaves(z):
            if leaf.size:
                # A sum over a block is finite only if all of its numbers are.
                is_complete &= np.isfinite(np.add.reduceat(leaf.reshape(-1), begin * (leaf.size // total)))
    return CompleteBlocks(size, np.append(0, np.cumsum(is_complete)))


def repeat_state(state: PyTree, count: int) -> PyTree:
    """Return a state `count` times, along a leading axis."""
    return jax.tree.map(lambda leaf: np.repeat(leaf[None], count, axis=0), state)
