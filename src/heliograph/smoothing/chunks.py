"""A long recording smoothed in chunks of rows side by side, where a filter forgets how it began and how it will end.

A chunk is filtered from the state with which it begins (`heliograph.filters.chunks`) over its own rows and as many
behind them as are forgotten, and passed through backwards from the filtered state there. Of the state between two
chunks, that by which one of them was entered backwards and the one with which the later one was left have to agree;
else the earlier one is smoothed again from the latter. What a step leaves for the way back stays in the lanes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.factors.gaussian import Gaussian
from heliograph.filters.chunks import (
    ChunkStarts,
    find_chunk_starts,
    replace_chunk,
    rescan_wrong_starts,
    scan_settled_by_means,
)
from heliograph.filters.recursion import linear_start, scan_chunk
from heliograph.filters.settled_covariance import SettledState
from heliograph.filters.smoother_step import SmootherStep, gaussian_of
from heliograph.filters.states import find_equal_states, select_state
from heliograph.filters.windows import Which, take, take_windows
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.smoothing.fixed_interval_lag_point import sum_nis_over_blocks
from heliograph.smoothing.settled import SmoothedChunk, SmootherStepRecursion, smooth_settled_chunks


class SmoothedRows(NamedTuple):
    """Smoothed estimates of all rows, and sums over blocks of their squared innovations, as `nis_sums` returns them."""

    estimate: Estimate
    sums: Float[np.ndarray, "5"]


def smooth_in_chunks(filter: Any, z: Array, u: Array) -> SmoothedRows | None:
    """Smooth rows in chunks side by side; None where rows are few, or the filter is not linear or forgets too late.

    Args:
        filter: the filter, which can be smoothed.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
    """
    start, rows = linear_start(filter), (np.asarray(z), np.asarray(u))
    if start is None:
        return None
    with jax.enable_x64(True):
        begun = find_chunk_starts(SmootherStepRecursion(filter, 0), start, rows)
        return None if begun is None else _smooth_all(SmootherStepRecursion(filter, begun.lengths.chunk), begun, rows)


def smooth_chunk(
    recursion: SmootherStepRecursion,
    state: PyTree,
    rows: PyTree,
    first: Array,
    end: Array,
    later: Gaussian,
    is_given: Array,
) -> SmoothedChunk:
    """Smooth a chunk by its own rows and those behind it, up to row `end`.

    Args:
        recursion: the filter over rows, and how many rows are the chunk's own.
        state: the filter's state at the chunk's beginning.
        rows: measurements and inputs of its own rows and those behind.
        first: number of its first row.
        end: number of the row before which the pass back begins.
        later: the law from which it begins, if it `is_given`; else it is the filter's.
        is_given: whether `later` is used.
    """
    own = recursion.own
    after, steps = scan_chunk(recursion, state, take(rows, slice(own)), first, end)
    last, steps_behind = scan_chunk(recursion, after, take(rows, slice(own, None)), first + own, end)

    def pass_back(law: Gaussian, item: tuple[SmootherStep, Array]) -> tuple[Gaussian, None]:
        """Return the law before a row from that behind it; the same from row `end` on."""
        step, k = item
        return select_state(k < end, step.back(law), law), None

    def smooth(law: Gaussian, item: tuple[SmootherStep, Array]) -> tuple[Gaussian, Estimate]:
        """Pass back over a row, and keep its estimate."""
        return pass_back(law, item)[0], item[0].estimate_from(law)

    k = first + jnp.arange(len(rows[0]))
    law = select_state(is_given, later, gaussian_of(last))
    entered, _ = jax.lax.scan(pass_back, law, (steps_behind, k[own:]), reverse=True)
    left, estimate = jax.lax.scan(smooth, entered, (steps, k[:own]), reverse=True)
    return SmoothedChunk(after, entered, left, estimate, steps.nis, steps.received)


def _smooth_all(recursion: SmootherStepRecursion, begun: ChunkStarts, rows: PyTree) -> SmoothedRows | None:
    """Smooth all chunks side by side, and again those that a neighbour contradicts.

    A chunk has `own` rows. It filters `ahead` rows more and passes back over these, begun by the filter's own law at
    their end, which they forget: so it enters its own rows by the law that all later data give. Where the next chunk's
    first row has another law, it is smoothed once more, from that one; the last such chunk first.
    """
    total, (own, ahead) = len(rows[0]), begun.lengths
    windows = take_windows(rows, begun.first, own + ahead)
    ends = np.minimum(begun.first + own + ahead, total)

    def smooth_chunks_from(states: PyTree, which: Which, later: Gaussian | None = None) -> SmoothedChunk | None:
        """Smooth some chunks from these states; backwards from `later` at the end of their own rows, if given."""
        first = begun.first[which]
        end = ends[which] if later is None else first + own
        laws = gaussian_of(states) if later is None else later
        arguments = recursion, states, take(windows, which), first, end, laws, np.full(len(first), later is not None)
        choice = choose_code(smooth_chunk, arguments, [False, *[True] * 6])
        return None if choice.code is None else choice.results()

    def smooth_means(settled: SettledState) -> SmoothedChunk | None:
        """Smooth all chunks as if they were settled."""
        return smooth_settled_chunks(recursion, settled, begun, windows)

    # Settled chunks are those whose rows are complete, their own and those behind, of which none are beyond the end.
    whole = begun.complete.cover(begun.first, own + ahead) & (begun.first + own + ahead <= total)
    begun = begun._replace(covered=begun.covered & whole)
    results = scan_settled_by_means(begun, smooth_chunks_from, smooth_means)
    if results is None:
        return None
    rescan_wrong_starts(smooth_chunks_from, begun.states, lambda results: results.end, results)
    # The states with which chunks begin are those in which the ones before them end.
    wrong = ~find_equal_states(take(results.entered, slice(None, -1)), take(results.left, slice(1, None)))
    for c in range(len(wrong) - 1, -1, -1):
        if wrong[c]:
            here, law = slice(c, c + 1), take(results.left, slice(c + 1, c + 2))
            state = take(results.end, slice(c - 1, c)) if c else take(begun.states, here)
            replace_chunk(results, here, smooth_chunks_from(state, here, law))
            # This chunk is left by another law now, with which the one before it has to agree.
            if c:
                wrong[c - 1] = not find_equal_states(take(results.entered, slice(c - 1, c)), take(results.left, here))[
                    0
                ]
    estimate, nis, received = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:total], results[3:])
    return SmoothedRows(estimate, np.asarray(sum_nis_over_blocks(nis, received)))
