"""A long recording filtered in chunks of rows side by side, where a filter forgets the state in which it began.

The estimate after row k of a linear filter depends on its state W rows before by the product of W closed loops
(I - K H) F. If that product is negligible, the filter has forgotten its start: a chunk may begin with any state W rows
ahead of its first row, and the chunks are runs of one program, a SIMD lane each. Each joint is checked: the state in
which a chunk ends and the one in which the next began agree to `TOLERANCE` of a deviation, or the latter chunk is
filtered again from the former's end. The difference e that remains between two means has an e' P^-1 e that never grows,
with P the covariance that the filter claims.

Behind a random gain the noise grows with the state's second moments before any data. If these grow without limit, ever
more rows are needed to forget: such recordings are filtered row after row.

A row of 4 states and 2 outputs takes 257 products, and W rows ahead of chunks of L rows make that 1 + W / L times as
many. A scan by an associative operation on elements (A, b, C, eta, J) needs no forgetting, but 3.0 times as many.

Source: the elements: Särkkä and García-Fernández, Temporal parallelization of Bayesian smoothers (2021).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.filters.rows.gaussians_in_states import beside_gaussians, find_equal_states, means_of, with_gaussians
from heliograph.filters.rows.linear_recursion import (
    FilterRecursion,
    Recursion,
    initial_state_if_linear,
    scan_chunk,
    state_after_rows,
    sum_chunk,
)
from heliograph.filters.rows.row_windows import Which, run_and_join, take, take_windows, take_windows_in_parts
from heliograph.filters.rows.settled_covariance import (
    CompleteBlocks,
    SettledState,
    find_complete_blocks,
    find_settled_state,
    means_after_settled_rows,
    repeat_state,
    scan_settled_rows,
    sum_settled_rows,
)
from heliograph.numerics.types import Array, Bool, Int, PyTree

CHUNKS = 16  # at least: two cores with eight lanes each
PROBES = 8  # chunks at which forgetting is tested before all rows are filtered
BLOCKS = 64  # blocks of rows that one call predicts without data


class ChunkLengths(NamedTuple):
    """chunk: rows of a chunk. ahead: rows filtered before its first one (warm-up), in which the start is forgotten."""

    chunk: int
    ahead: int


# Results of 2,048 rows in eight lanes take 4 MB, and are as fast as a fourth of them. 512 rows suffice to forget the
# position and speed of a target measured ten times a second, or a level that moves by a hundredth of its noise.
LADDER = ChunkLengths(2048, 512), ChunkLengths(8192, 2048)


class ScanResult(NamedTuple):
    """The state after the last row, and the output of each row (rows, ...)."""

    last: PyTree
    outputs: PyTree


class ChunkStarts(NamedTuple):
    """How chunks begin: the state of each (chunks, ...), its first row (chunks,), and how long chunks are.

    `settled`: the state whose covariances and gains complete rows no longer change, or None. `covered` (chunks,): which
    chunks have complete rows and begin in that state, so that only means need be computed. `complete`: which blocks of
    rows miss no number.
    """

    states: PyTree
    first: Int[np.ndarray, " chunks"]
    lengths: ChunkLengths
    settled: SettledState | None
    covered: Bool[np.ndarray, " chunks"]
    complete: CompleteBlocks


def is_long(total: int) -> bool:
    """Return whether a recording of `total` rows is long enough for CHUNKS chunks of the least length."""
    return total >= CHUNKS * LADDER[0].chunk


def filter_in_chunks(
    filter: Any, z: Array, u: Array, output: Callable[..., PyTree], state: PyTree | None = None, begin: int = 0
) -> ScanResult | None:
    """Filter rows in chunks side by side; None if rows are few, or the filter is not linear or forgets too slowly.

    Args:
        filter: the filter.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
        output: returns a row's output from the filter, its state after the row, the innovation and the row's number.
        state: the filter's state before the first row; by default that before any data.
        begin: number of the first row.
    """
    # `start`: the filter's state before any data; None where the filter is not linear.
    start = initial_state_if_linear(filter) if is_long(len(z)) else None
    if start is None:
        return None
    rows = FilterRecursion(filter, output, np.asarray(begin))
    return scan_in_chunks(rows, start if state is None else state, (np.asarray(z), np.asarray(u)))


def sum_filtered_in_chunks(filter: Any, z: Array, u: Array, output: Callable[..., PyTree]) -> PyTree | None:
    """Filter rows as `filter_in_chunks` does, and return the sums of outputs over all rows; None where that does."""
    start = initial_state_if_linear(filter) if is_long(len(z)) else None
    if start is None:
        return None
    by_chunk = sum_in_chunks(FilterRecursion(filter, output), start, (np.asarray(z), np.asarray(u)))
    return None if by_chunk is None else jax.tree.map(lambda sums: sums.sum(axis=0), by_chunk.outputs)


def scan_in_chunks(recursion: Recursion, start: PyTree, rows: PyTree) -> ScanResult | None:
    """Step a recursion over rows in chunks side by side; return the last state and the outputs of all rows, or None.

    None stands for few rows, or a recursion that forgets too slowly. `start` is the state before the first row.
    """
    with jax.enable_x64(True):
        by_chunk = _scan_all_chunks(recursion, start, rows, OF_ROWS)
    if by_chunk is None:
        return None
    # Outputs (chunks, rows, ...) are put in one row of chunks, without the rows that fill up the last chunk.
    total = len(jax.tree.leaves(rows)[0])
    joined = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:total], by_chunk.outputs)
    return ScanResult(by_chunk.last, joined)


def sum_in_chunks(recursion: Recursion, start: PyTree, rows: PyTree) -> ScanResult | None:
    """Step a recursion over rows as `scan_in_chunks` does; outputs are sums over each chunk (chunks, ...)."""
    with jax.enable_x64(True):
        return _scan_all_chunks(recursion, start, rows, OF_SUMS)


def find_chunk_starts(recursion: Recursion, start: PyTree, rows: PyTree) -> ChunkStarts | None:
    """Return how each chunk of rows begins; None where rows are few, or a start is forgotten too late.

    The lengths of LADDER are tried from the shortest on, until the rows ahead of a chunk suffice to forget the start,
    each first with settled covariances, where only means are computed, then in full.
    """
    total = len(jax.tree.leaves(rows)[0])
    for lengths in LADDER:
        if total < CHUNKS * lengths.chunk:
            return None
        first = np.arange(0, total, lengths.chunk)
        complete = find_complete_blocks(rows[0], lengths.ahead)
        is_complete = complete.are_complete(first, lengths.chunk)
        settled = find_settled_state(recursion, start, rows, lengths.ahead) if np.mean(is_complete) > 0.5 else None
        for settled_or_none in [None] if settled is None else [settled, None]:
            warm_up = WarmUpRun(recursion, rows, complete, settled_or_none)
            states = _find_start_states(warm_up, start, first[1:])
            if states is not None:
                begins_settled = False if settled_or_none is None else settled_or_none.matches(states)
                return ChunkStarts(
                    states=states, first=first, lengths=lengths, settled=settled_or_none,
                    covered=is_complete & begins_settled, complete=complete,
                )  # fmt: skip
    return None


def _predict_data_free_parts(recursion: Recursion, state: PyTree, rows: PyTree, first: Array) -> tuple[PyTree, PyTree]:
    """Return the data-free parts of a filter's state (all but its Gaussians) after all blocks of rows, and before each.

    Only predictions change them, so no row is corrected. `rows` are (block, row, ...), the first of number `first`.
    """

    def predict_row(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, None]:
        """Return the state predicted over one row, (data, number), without its measurement; no output."""
        return recursion.predict(state, *row), None

    def predict_block(state: PyTree, rows: tuple[PyTree, Array]) -> tuple[PyTree, PyTree]:
        """Predict over one block; return the next state, and the data-free parts before the block."""
        return jax.lax.scan(predict_row, state, rows)[0], beside_gaussians(state)

    blocks, size = jax.tree.leaves(rows)[0].shape[:2]
    k = (first + jnp.arange(blocks * size)).reshape(blocks, size)
    last, before = jax.lax.scan(predict_block, jax.tree.map(jnp.asarray, state), (rows, k))
    return beside_gaussians(last), before


class WarmUpRun(NamedTuple):
    """Warm-up: find the state before a row by filtering the `ahead` rows before it from a guess, many rows at once.

    `settled`: a state with settled covariances and gains, of which only the means are computed; None without one.
    """

    recursion: Recursion
    rows: PyTree
    complete: CompleteBlocks
    settled: SettledState | None

    @property
    def ahead(self) -> int:
        """Number of rows filtered before a chunk's first one; also the rows of a block in `complete`."""
        return self.complete.size

    def states_before(self, rows: Int[np.ndarray, " n"], starts: PyTree, one_start_each: bool = False) -> PyTree | None:
        """Return the states (n, ...) before n rows, from guesses `ahead` rows earlier; None without native code.

        `rows` are multiples of `ahead`. `starts` are guessed states at the rows 0, `ahead`, 2 `ahead`, ..., or, if
        `one_start_each`, one for each of `rows`, `ahead` rows before it (n, ...).
        """
        first = rows - self.ahead
        windows = take_windows(self.rows, first, self.ahead)
        states = starts if one_start_each else jax.tree.map(lambda leaf: leaf[first // self.ahead], starts)
        if self.settled is None:
            return self._filter_windows(states, windows, first)
        # In complete windows only the means are computed; the others are filtered in full.
        arguments = self.recursion, self.settled, means_of(states), windows, first
        choice = choose_code(means_after_settled_rows, arguments, differs_by_run=[False, False, True, True, True])
        if choice.code is None:
            return None
        results = self.settled.repeat_with_means(choice.results())
        others = np.flatnonzero(~self.complete.are_complete(first, self.ahead))
        if len(others):
            filtered = self._filter_windows(take(states, others), take(windows, others), first[others])
            replace_chunk(results, others, filtered)
        return results

    def _filter_windows(self, states: PyTree, windows: PyTree, first: Int[np.ndarray, " n"]) -> PyTree | None:
        """Return the states (n, ...) after n windows of rows (n, ahead, ...), from the states before them.

        `first` holds the number of each window's first row. Returns None without native code.
        """
        arguments = self.recursion, states, windows, first
        choice = choose_code(state_after_rows, arguments, differs_by_run=[False, True, True, True])
        return None if choice.code is None else choice.results()


def _find_start_states(warm_up: WarmUpRun, start: PyTree, first: Int[np.ndarray, " chunks"]) -> PyTree | None:
    """Return the states with which chunks begin (chunks, ...), or None if the filter forgets its start too slowly.

    Each is computed by filtering the `warm_up.ahead` rows before the chunk from the filter's first state `start`, which
    is forgotten by then. Parts of the state that data do not change may never be forgotten: they are then computed over
    all rows. `first` holds the first rows of all chunks but the first.
    """
    starts = repeat_state(start, len(jax.tree.leaves(warm_up.rows)[0]) // warm_up.ahead)  # one each `ahead` rows
    forgets = _start_is_forgotten(warm_up, starts, first)
    # Perhaps only a data-free part is not forgotten: compute that part over all rows.
    if forgets is False and jax.tree.leaves(beside_gaussians(start)) and warm_up.settled is None:
        starts = _replace_data_free_parts(warm_up.recursion, start, warm_up.rows, warm_up.ahead)
        forgets = starts is not None and _start_is_forgotten(warm_up, starts, first)
    if not forgets:
        return None
    later = warm_up.states_before(first, starts)
    return jax.tree.map(lambda at_first, at_later: np.concatenate([at_first[None], at_later]), start, later)


def _start_is_forgotten(warm_up: WarmUpRun, starts: PyTree, first: Int[np.ndarray, " chunks"]) -> bool | None:
    """Return whether a wrong state is forgotten W = `warm_up.ahead` rows later, or None without native code.

    It is forgotten before a chunk if two states before the chunk agree: one filtered from a guess W rows earlier, the
    other from a guess 2 W rows earlier. At most PROBES chunks are tested, and more than half must agree. `starts` has a
    guess for each multiple of W rows, and `first` are the first rows of chunks.
    """
    probes = first[:: -(-len(first) // PROBES)]  # the stride is rounded up
    from_nearer = warm_up.states_before(probes, starts)
    if from_nearer is None:
        return None
    # 2 W rows in two runs of W rows: the end of the first is the start of the second.
    earlier = warm_up.states_before(probes - warm_up.ahead, starts)
    from_farther = warm_up.states_before(probes, earlier, one_start_each=True)
    # Differences of derivatives are judged by the largest derivatives in these states.
    scale_states = jax.tree.map(lambda *leaves: np.concatenate(leaves), take(starts, slice(0, 1)), from_farther)
    return bool(np.mean(find_equal_states(from_nearer, from_farther, among=scale_states)) > 0.5)


def _replace_data_free_parts(recursion: Recursion, start: PyTree, rows: PyTree, ahead: int) -> PyTree | None:
    """Return guesses of the state at each multiple of `ahead` rows, with the right data-free parts; None without code.

    Data-free parts, all but the Gaussians, are predicted over all rows; the Gaussians are those of the state `start`.
    """
    # Predict over BLOCKS blocks of `ahead` rows at a time.
    parts_by_block, state, rows_at_once = list[PyTree](), start, BLOCKS * ahead
    for begin in range(0, len(jax.tree.leaves(rows)[0]), rows_at_once):
        blocks = jax.tree.map(lambda leaf: leaf.reshape(BLOCKS, ahead, *leaf.shape[2:]),
                              take_windows(rows, np.array([begin]), rows_at_once))  # fmt: skip
        arguments = recursion, state, blocks, np.asarray(begin)
        choice = choose_code(_predict_data_free_parts, arguments, differs_by_run=[False] * 4)
        if choice.code is None:
            return None
        last, before = jax.tree.map(lambda leaf: leaf[0, ...], choice.results())
        state = with_gaussians(last, start)
        parts_by_block.append(before)
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts_by_block)
    return with_gaussians(joined, repeat_state(start, BLOCKS * len(parts_by_block)))


class ChunkPrograms(NamedTuple):
    """Functions that filter a chunk: `full`, or `settled`: means alone, to which `complete` adds the other outputs."""

    full: Callable[..., Any]
    settled: Callable[..., Any]
    complete: Callable[[SettledState, PyTree], PyTree]


OF_ROWS = ChunkPrograms(scan_chunk, scan_settled_rows, SettledState.fill_rows)
OF_SUMS = ChunkPrograms(sum_chunk, sum_settled_rows, lambda settled, sums: sums)


def _scan_all_chunks(recursion: Recursion, start: PyTree, rows: PyTree, programs: ChunkPrograms) -> ScanResult | None:
    """Filter all chunks side by side from guessed first states; return the last state and the outputs (chunks, ...).

    Then, in order, each chunk whose guess differs from the state in which the chunk before it ended is filtered again,
    from that state. None where rows are few, where the filter forgets too late, and without native code. `recursion`:
    one step of a linear filter. `start`: state before the first row. `rows`: z and u (rows, ...). `programs` filter one
    chunk in full, or only its means where covariances have settled.
    """
    begun = find_chunk_starts(recursion, start, rows)
    if begun is None:
        return None
    length, total = begun.lengths.chunk, np.asarray(len(jax.tree.leaves(rows)[0]))
    # Results of chunks are pairs (state after the last row, outputs), each array (chunk, ...). The lists of booleans
    # below say which arguments of a program differ from chunk to chunk.

    def scan(states: PyTree, which: Which) -> PyTree:
        """Return the results of the chunks `which`, filtered in full from `states` (the first of each chunk)."""
        calls = [
            (recursion, take(states, batch), windows, first, total)
            for batch, first, windows in take_windows_in_parts(rows, begun.first[which], length)
        ]
        return run_and_join(programs.full, calls, differs_by_run=[False, True, True, True, False])

    def scan_means(settled: SettledState) -> PyTree:
        """Return the results of all chunks with the covariances and gains of `settled`; None without native code."""
        means = means_of(begun.states)
        calls = [
            (recursion, settled, take(means, batch), windows, first, total)
            for batch, first, windows in take_windows_in_parts(rows, begun.first, length)
        ]
        joined = run_and_join(programs.settled, calls, differs_by_run=[False, False, True, True, True, False])
        return None if joined is None else (settled.repeat_with_means(joined[0]), programs.complete(settled, joined[1]))

    results = scan_means_where_settled(begun, scan, scan_means)
    if results is None:
        return None
    rescan_wrong_starts(scan, begun.states, lambda pair: pair[0], results)  # changes the arrays of `results` in place
    last, outputs = results
    return ScanResult(jax.tree.map(lambda leaf: leaf[-1, ...], last), outputs)


def scan_means_where_settled(
    begun: ChunkStarts, scan_in_full: Callable[[PyTree, Which], PyTree], scan_means: Callable[[SettledState], PyTree]
) -> PyTree:
    """Scan all chunks, and compute only the means of the settled ones; return None without native code.

    A chunk is settled if its covariances and gains do not change from its first row on, so that only means change.

    Args:
        begun: states with which the chunks begin (chunks, ...), and in `begun.covered` whether each chunk is settled.
        scan_in_full: returns the results of some chunks from the states with which they begin.
        scan_means: returns the results of all chunks as if all were settled; None without native code.
    """
    # The means of all chunks are scanned, which does not pay if less than half of the chunks are settled.
    settled = None if np.mean(begun.covered) < 0.5 else begun.settled
    if settled is None or (results := scan_means(settled)) is None:
        return scan_in_full(begun.states, slice(None))
    if len(unsettled_chunks := np.flatnonzero(~begun.covered)):
        replace_chunk(results, unsettled_chunks, scan_in_full(take(begun.states, unsettled_chunks), unsettled_chunks))
    return results


def rescan_wrong_starts(
    scan: Callable[[PyTree, slice], PyTree], begun: PyTree, ends_of: Callable[[PyTree], PyTree], results: PyTree
) -> None:
    """Scan each chunk again that began with another state than the chunk before it ends with; change `results`.

    Args:
        scan: returns the results of some chunks from the states with which they begin.
        begun: states with which the chunks began, (chunks, ...).
        ends_of: returns from results the states in which the chunks end.
        results: results of all chunks, (chunks, ...).
    """
    ends = ends_of(results)
    wrong = ~find_equal_states(take(ends, slice(None, -1)), take(begun, slice(1, None)), among=begun)
    for c in range(1, len(wrong) + 1):
        if not wrong[c - 1]:
            continue
        chunk = slice(c, c + 1)
        replace_chunk(results, chunk, scan(take(ends, slice(c - 1, c)), chunk))
        # The chunk ends in another state now, so whether the next one began wrongly is decided anew.
        if c < len(wrong):
            wrong[c] = not find_equal_states(take(ends, chunk), take(begun, slice(c + 1, c + 2)), among=begun)[0]


def replace_chunk(results: PyTree, which: Which, new_results: PyTree) -> None:
    """Overwrite the results of the chunks `which` with new ones, in place."""
    for leaf, new_leaf in zip(jax.tree.leaves(results), jax.tree.leaves(new_results), strict=True):
        leaf[which] = new_leaf
