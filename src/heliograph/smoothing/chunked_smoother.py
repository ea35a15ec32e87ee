"""Smoothing of a long recording in chunks of rows side by side, where smoothed states forget data far before and after.

A chunk is filtered from the state with which it begins (`filters.rows.chunks`), over its own rows and a number of
rows after them. The backward pass begins there with the filtered law; when it reaches the chunk's own rows, it has
forgotten that start. The smoothed law of the state between two chunks is then computed twice: as that after the earlier
chunk, and as that before the later one. If the two differ, the earlier chunk is smoothed again from the latter.
Smoother steps stay in the SIMD lane of their chunk.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.chunks import (
    ChunkStarts,
    find_chunk_starts,
    replace_chunk,
    rescan_wrong_starts,
    scan_means_where_settled,
)
from heliograph.filters.rows.gaussians_in_states import find_equal_states, select_state
from heliograph.filters.rows.linear_recursion import initial_state_if_linear, scan_chunk
from heliograph.filters.rows.row_windows import Which, take, take_windows
from heliograph.filters.smoother_step import SmootherStep, gaussian_of
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.smoothing.fixed_interval_lag_point import sum_nis_over_blocks
from heliograph.smoothing.steady_covariance_smoothing import SmoothedChunk, SmootherStepRecursion, smooth_settled_chunks


class SmoothedRows(NamedTuple):
    """Smoothed estimates of all rows, and sums over blocks of their squared innovations, as `nis_sums` returns them."""

    estimate: Estimate
    sums: Float[np.ndarray, "5"]


def smooth_in_chunks(filter: AbstractFilter, z: Array, u: Array) -> SmoothedRows | None:
    """Smooth a long recording in chunks of rows that are computed in parallel; None if it cannot be divided so.

    A chunk may begin with any state some rows before its own, if the filter forgets its start: any two states lead to
    the same state after enough rows. The result is None if rows are few, or the filter is not linear or forgets too
    slowly; the caller then smooths row after row.

    Args:
        filter: the filter, which can be smoothed.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
    """
    start = initial_state_if_linear(filter)
    rows = (np.asarray(z), np.asarray(u))
    if start is None:
        return None
    with jax.enable_x64(True):
        # How long chunks are is known only after their starts are found, which need no length (own=0).
        chunk_starts = find_chunk_starts(SmootherStepRecursion(filter, own=0), start, rows)
        if chunk_starts is None:
            return None
        return _smooth_all(SmootherStepRecursion(filter, own=chunk_starts.lengths.chunk), chunk_starts, rows)


def smooth_chunk(
    recursion: SmootherStepRecursion,
    state: PyTree,
    rows: PyTree,
    first: Array,
    end: Array,
    later: Gaussian,
    is_given: Array,
) -> SmoothedChunk:
    """Smooth a chunk's own rows by all data before row `end`: a filter's pass ahead, then a smoother's pass back.

    Args:
        recursion: the filter over rows, and how many rows are the chunk's own.
        state: the filter's state at the chunk's beginning.
        rows: measurements and inputs of its own rows and of those after them.
        first: number of its first row.
        end: number of the row before which the backward pass begins; rows from it on are not used.
        later: the smoothed law with which the backward pass begins, if `is_given`; else the filtered law is taken.
        is_given: whether `later` is used.
    """
    own = recursion.own
    # The smoother step of each row: of the chunk's own rows, and of the rows after them.
    state_at_end, steps = scan_chunk(recursion, state, take(rows, slice(own)), first, end)
    last_state, steps_after = scan_chunk(recursion, state_at_end, take(rows, slice(own, None)), first + own, end)

    def pass_back(law: Gaussian, item: tuple[SmootherStep, Array]) -> tuple[Gaussian, None]:
        """Return the smoothed law before a row from that after it; rows from `end` on leave it as it is."""
        step, k = item
        return select_state(k < end, step.back(law), law), None

    def pass_back_and_estimate(law: Gaussian, item: tuple[SmootherStep, Array]) -> tuple[Gaussian, Estimate]:
        """Return the smoothed law before a row from the smoothed `law` after it, and the row's smoothed estimate.

        `pass_back` takes the law one row back.
        """
        step, _k = item
        law_before, _ = pass_back(law, item)
        return law_before, step.estimate_from(law)

    k = first + jnp.arange(len(rows[0]))  # row numbers
    law = select_state(is_given, later, gaussian_of(last_state))  # the law with which the backward pass begins
    law_after, _ = jax.lax.scan(pass_back, law, (steps_after, k[own:]), reverse=True)
    law_before, estimate = jax.lax.scan(pass_back_and_estimate, law_after, (steps, k[:own]), reverse=True)
    return SmoothedChunk(
        end=state_at_end,
        law_after=law_after,
        law_before=law_before,
        estimate=estimate,
        nis=steps.nis,
        received=steps.received,
    )


# Smooths some chunks. Arguments: states before their first rows, which chunks they are, and the smoothed laws after
# their last rows (if left out, the backward pass begins later, with the filtered law).
SmoothChunks = Callable[..., SmoothedChunk | None]


def _smooth_all(recursion: SmootherStepRecursion, chunk_starts: ChunkStarts, rows: PyTree) -> SmoothedRows | None:
    """Smooth all chunks side by side, then again those whose ends differ from their neighbours'.

    A chunk smooths its `own` rows by a window of these and the `ahead` rows after them. It filters its window and
    passes back from the window's end, beginning with the filtered law instead of the smoothed one. Over the `ahead`
    rows that start is forgotten, so it enters its own rows with the law that all later data give.

    Args:
        recursion: one step of the filter and of its smoother.
        chunk_starts: for each chunk its first row and a state to begin with, the numbers `own` and `ahead`, and
            whether covariances have settled there: rows without missing numbers then change only means.
        rows: measurements and inputs, (rows, ...) each.

    Returns:
        The smoothed estimates of all rows; None without native code for a chunk.
    """
    total = len(rows[0])
    own, ahead = chunk_starts.lengths
    windows = take_windows(rows, chunk_starts.first, own + ahead)
    window_ends = np.minimum(chunk_starts.first + own + ahead, total)

    def smooth_chunks_from(states: PyTree, which: Which, later: Gaussian | None = None) -> SmoothedChunk | None:
        """Filter the chunks `which` from their first states, then smooth them; None without native code.

        The backward pass begins at the end of each chunk's window, which is before the row `window_ends`. If `later` is
        given, the smoothed law after each chunk's own rows, it begins there. The numbers of first rows and the rows of
        each chunk are in `chunk_starts` and `windows`; `recursion` is the filter over rows.
        """
        first = chunk_starts.first[which]
        is_given = np.full(len(first), later is not None)
        if later is None:
            pass_back_from = window_ends[which]
            laws = gaussian_of(states)  # these laws are not used
        else:
            pass_back_from, laws = first + own, later
        arguments = recursion, states, take(windows, which), first, pass_back_from, laws, is_given
        choice = choose_code(smooth_chunk, arguments, differs_by_run=[False, True, True, True, True, True, True])
        return None if choice.code is None else choice.results()

    # Only means are computed in chunks where covariances have settled: their window must be complete, and must not
    # reach beyond the last row.
    first = chunk_starts.first
    is_complete = chunk_starts.complete.are_complete(first, own + ahead) & (first + own + ahead <= total)
    chunk_starts = chunk_starts._replace(covered=chunk_starts.covered & is_complete)
    # A function of the settled state, by whose covariances and gains it smooths all chunks.
    smooth_means = partial(smooth_settled_chunks, recursion, chunk_starts=chunk_starts, windows=windows)
    results = scan_means_where_settled(chunk_starts, smooth_chunks_from, smooth_means)
    if results is None:
        return None
    # Results are repaired in place. From the first chunk on: each chunk that began in another state than that in which
    # the chunk before it ends. Then from the last one back: each chunk whose smoothed law at its end is wrong.
    rescan_wrong_starts(smooth_chunks_from, chunk_starts.states, lambda results: results.end, results)
    _resmooth_wrong_ends(smooth_chunks_from, chunk_starts.states, results)
    return _join_chunks(results, total)


def _join_chunks(results: SmoothedChunk, total: int) -> SmoothedRows:
    """Return the smoothed rows of all chunks, one after the other, without those that fill up the last chunk.

    Args:
        results: results of all chunks, with arrays (chunks, own, ...).
        total: number of rows of the recording.
    """
    leaves = results.estimate, results.nis, results.received
    estimate, nis, received = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:total], leaves)
    return SmoothedRows(estimate, np.asarray(sum_nis_over_blocks(nis, received)))


def _resmooth_wrong_ends(smooth: SmoothChunks, states: PyTree, results: SmoothedChunk) -> None:
    """Smooth each chunk again whose smoothed law at its end is not that at the beginning of the next chunk.

    `results` is changed in place. The joint of two chunks has two smoothed laws of one state: `law_after` of the
    earlier chunk and `law_before` of the later one. If they differ, the earlier chunk is smoothed again, with the
    latter law at its end. Chunks are taken from the last to the first, since this changes the chunk's own `law_before`,
    which is compared at the joint before it. A chunk is filtered again from the state in which the chunk before it
    ends, and the first one from its state in `states`.

    Args:
        smooth: smooths some chunks from their first states, and from the smoothed laws after them.
        states: states with which the chunks began (chunks, ...).
        results: results of all chunks (chunks, ...).
    """
    laws_at_ends = take(results.law_after, slice(None, -1))
    laws_at_starts = take(results.law_before, slice(1, None))
    disagrees_with_next = ~find_equal_states(laws_at_ends, laws_at_starts)
    for c in range(len(disagrees_with_next) - 1, -1, -1):
        if not disagrees_with_next[c]:
            continue
        previous_chunk = slice(c - 1, c)
        chunk = slice(c, c + 1)
        next_chunk = slice(c + 1, c + 2)
        state = take(results.end, previous_chunk) if c else take(states, chunk)
        replace_chunk(results, chunk, smooth(state, chunk, take(results.law_before, next_chunk)))
        if c:
            (agrees,) = find_equal_states(take(results.law_after, previous_chunk), take(results.law_before, chunk))
            disagrees_with_next[c - 1] = not agrees
