"""Smoothing of a long recording in chunks of rows side by side: a filter forgets how it began and how it will end.

A chunk is filtered from the state with which it begins (`heliograph.filters.chunks`) over its own rows and as many
behind them as are forgotten, and passed through backwards from the filtered state there. Of the state between two
chunks, that by which one of them was entered backwards and the one with which the later one was left have to agree;
else the earlier one is smoothed again from the latter. What a step leaves for the way back stays in the lanes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.chunks import (
    ChunkStarts,
    find_chunk_starts,
    replace_chunk,
    rescan_wrong_starts,
    scan_means_where_settled,
)
from heliograph.filters.gaussians_in_states import find_equal_states, select_state
from heliograph.filters.linear_recursion import initial_state_if_linear, scan_chunk
from heliograph.filters.row_windows import Which, take, take_windows
from heliograph.filters.settled_covariance import SettledState
from heliograph.filters.smoother_step import SmootherStep, gaussian_of
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.smoothing.fixed_interval_lag_point import sum_nis_over_blocks
from heliograph.smoothing.steady_covariance_smoothing import SmoothedChunk, SmootherStepRecursion, smooth_settled_chunks


class SmoothedRows(NamedTuple):
    """Smoothed estimates of all rows, and sums over blocks of their squared innovations, as `nis_sums` returns them."""

    estimate: Estimate
    sums: Float[np.ndarray, "5"]


def smooth_in_chunks(filter: Any, z: Array, u: Array) -> SmoothedRows | None:
    """Smooth rows in chunks side by side; None if rows are few, or the filter is not linear or forgets too slowly.

    A filter forgets its start if any two states lead to the same state after enough rows.

    Args:
        filter: the filter, which can be smoothed.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
    """
    start, rows = initial_state_if_linear(filter), (np.asarray(z), np.asarray(u))
    if start is None:
        return None
    with jax.enable_x64(True):
        chunk_starts = find_chunk_starts(SmootherStepRecursion(filter, own=0), start, rows)
        if chunk_starts is None:
            return None
        return _smooth_all(SmootherStepRecursion(filter, chunk_starts.lengths.chunk), chunk_starts, rows)


def smooth_chunk(
    recursion: SmootherStepRecursion,
    state: PyTree,
    rows: PyTree,
    first: Array,
    end: Array,
    later: Gaussian,
    is_given: Array,
) -> SmoothedChunk:
    """Smooth a chunk's own rows by all data up to row `end`: filter ahead, then pass back.

    Args:
        recursion: the filter over rows, and how many rows are the chunk's own.
        state: the filter's state at the chunk's beginning.
        rows: measurements and inputs of its own rows and of those behind them.
        first: number of its first row.
        end: number of the row before which the pass back begins; rows from it on are not used.
        later: the smoothed law with which the pass back begins, if it `is_given`; else it is the filter's there.
        is_given: whether `later` is used.
    """
    own = recursion.own
    state_after, steps = scan_chunk(recursion, state, take(rows, slice(own)), first, end)
    last_state, steps_behind = scan_chunk(recursion, state_after, take(rows, slice(own, None)), first + own, end)

    def pass_back(law: Gaussian, item: tuple[SmootherStep, Array]) -> tuple[Gaussian, None]:
        """Return the law before a row from that behind it; the same from row `end` on."""
        step, k = item
        return select_state(k < end, step.back(law), law), None

    def pass_back_and_estimate(law: Gaussian, item: tuple[SmootherStep, Array]) -> tuple[Gaussian, Estimate]:
        """Return the smoothed law before a row from the smoothed `law` after it, and the row's smoothed estimate."""
        step, _k = item
        law_before, _ = pass_back(law, item)
        return law_before, step.estimate_from(law)

    k = first + jnp.arange(len(rows[0]))
    law = select_state(is_given, later, gaussian_of(last_state))
    entered, _ = jax.lax.scan(pass_back, law, (steps_behind, k[own:]), reverse=True)
    left, estimate = jax.lax.scan(pass_back_and_estimate, entered, (steps, k[:own]), reverse=True)
    return SmoothedChunk(
        end=state_after, entered=entered, left=left, estimate=estimate, nis=steps.nis, received=steps.received
    )


SmoothChunks = Callable[..., SmoothedChunk | None]  # of states, which chunks, and the laws behind them, if given


def _smooth_all(recursion: SmootherStepRecursion, begun: ChunkStarts, rows: PyTree) -> SmoothedRows | None:
    """Smooth all chunks side by side, and again those that a neighbour contradicts; None without native code.

    A chunk has `own` rows, of which it smooths the estimates, and a window of these and the `ahead` rows behind them.
    It filters its window and passes back from the window's end, where it begins with the filtered law instead of the
    smoothed one. Over the `ahead` rows that is forgotten, so it enters its own rows with the law that all later data
    give.
    """
    total, (own, ahead) = len(rows[0]), begun.lengths
    windows = take_windows(rows, begun.first, own + ahead)
    window_ends = np.minimum(begun.first + own + ahead, total)

    def smooth_chunks_from(states: PyTree, which: Which, later: Gaussian | None = None) -> SmoothedChunk | None:
        """Filter the chunks `which` from their first states, then smooth them; None without native code.

        A window has the `own` rows of a chunk and rows after them, and ends before the row `window_ends`. The pass back
        begins at the end of the window. If `later` is given, it begins at the end of the chunk's own rows, where
        `later` is the smoothed law. `recursion` steps the filter, and `begun.first` is each chunk's first row.
        """
        first = begun.first[which]
        is_given = np.full(len(first), later is not None)
        if later is None:
            pass_back_from, laws = window_ends[which], gaussian_of(states)  # these laws are not used
        else:
            pass_back_from, laws = first + own, later
        arguments = recursion, states, take(windows, which), first, pass_back_from, laws, is_given
        choice = choose_code(smooth_chunk, arguments, differs_by_run=[False, True, True, True, True, True, True])
        return None if choice.code is None else choice.results()

    def smooth_means(settled: SettledState) -> SmoothedChunk | None:
        """Smooth all chunks as if they were settled."""
        return smooth_settled_chunks(recursion, settled, begun, windows)

    # Means alone are computed of chunks in which covariances stand still: that takes a window in which everything
    # arrived, and which does not reach beyond the last row.
    is_complete = begun.complete.are_complete(begun.first, own + ahead) & (begun.first + own + ahead <= total)
    begun = begun._replace(covered=begun.covered & is_complete)
    results = scan_means_where_settled(begun, smooth_chunks_from, smooth_means)
    if results is None:
        return None
    # Repaired in place: from the first chunk on, those that began in another state than that in which the one before
    # them ends; then from the last one back, those that a later chunk contradicts.
    rescan_wrong_starts(smooth_chunks_from, begun.states, lambda results: results.end, results)
    _resmooth_wrong_ends(smooth_chunks_from, begun.states, results)
    parts = results.estimate, results.nis, results.received  # (chunks, own, ...) each
    estimate, nis, received = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:total], parts)
    return SmoothedRows(estimate, np.asarray(sum_nis_over_blocks(nis, received)))


def _resmooth_wrong_ends(smooth: SmoothChunks, states: PyTree, results: SmoothedChunk) -> None:
    """Smooth each chunk again whose smoothed law at its end is not that at the beginning of the next chunk.

    `results` is changed in place. Smoothing passes back: it enters a chunk at its end with the law `entered`, and
    leaves it at its beginning with the law `left`. Chunks are taken from the last to the first, since a chunk that is
    smoothed again changes `left`, with which the chunk before it must agree. A chunk is filtered from the state in
    which the chunk before it ends, and the first chunk from its state in `states`.
    """
    disagrees_with_next = ~find_equal_states(take(results.entered, slice(None, -1)), take(results.left, slice(1, None)))
    for chunk in range(len(disagrees_with_next) - 1, -1, -1):
        if not disagrees_with_next[chunk]:
            continue
        before, after = slice(chunk - 1, chunk), slice(chunk + 1, chunk + 2)
        this = slice(chunk, chunk + 1)
        state = take(results.end, before) if chunk else take(states, this)
        replace_chunk(results, this, smooth(state, this, take(results.left, after)))
        if chunk:
            (agrees,) = find_equal_states(take(results.entered, before), take(results.left, this))
            disagrees_with_next[chunk - 1] = not agrees
