"""Smoothing of chunks of complete rows in which covariances are steady: only means are computed, ahead and back.

A filter has settled if its covariances and gains no longer change. Its backward pass is a recursion too, from the
smoothed law after a row to that before it; its rows are the parts of smoother steps that depend on data. Some rows
before the end, the covariance of the smoothed law settles as well.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.rows.chunks import ChunkStarts
from heliograph.filters.rows.gaussians_in_states import means_of, with_means
from heliograph.filters.rows.linear_recursion import Recursion
from heliograph.filters.rows.row_windows import take
from heliograph.filters.rows.settled_covariance import SettledState, find_settled_state, scan_settled_rows, step_settled
from heliograph.filters.smoother_step import SmootherStep, StepTrace, gaussian_of, make_smoother_step
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Array, PyTree


class SmootherStepRecursion(Recursion):
    """A filter's recursion over rows, with the smoother step of each row as its output.

    Args:
        filter: the filter.
        own: number of rows of a chunk, without the rows after it whose data it is smoothed by.
    """

    filter: Any
    own: int = eqx.field(static=True)

    def step(self, state: PyTree, row: tuple[Array, Array], k: Array) -> tuple[PyTree, SmootherStep]:
        """Predict and correct by the row (z, u) of step k; return the state after it, and the smoother step.

        A smoother step holds what a backward pass needs of the row, and the row's squared innovation.
        """
        z, u = row
        prior = self.filter.predict(state, u, k)
        after, innovation = self.filter.correct(prior, z, k)
        trace = StepTrace(state, prior, after, innovation, z, u, jnp.asarray(k))
        return after, make_smoother_step(self.filter, trace)


class SmoothedChunk(NamedTuple):
    """Results of a chunk of rows.

    Attributes:
        end: the filter's state after its last row.
        law_after: smoothed law of the state after its last row, with which the backward pass entered the chunk.
        law_before: smoothed law of the state before its first row, with which the backward pass left the chunk.
        estimate: smoothed estimate of each row (rows, ...).
        nis: squared innovation e' S^-1 e of each row (rows,).
        received: number of components of that innovation (rows,).
    """

    end: PyTree
    law_after: Gaussian
    law_before: Gaussian
    estimate: Estimate
    nis: Array
    received: Array


class SmoothedMeans(NamedTuple):
    """Results of one chunk in which covariances are steady, so that only these numbers depend on its data.

    Attributes:
        end: the filter's means after the chunk's own rows, one array for each Gaussian of its state.
        after: smoothed mean of the state after the last row, in a list of one array.
        before: smoothed mean of the state before the first row, in a list of one array.
        estimates: the leaves of the rows' smoothed estimates that depend on data, (own, ...) each.
        nis: squared innovation e' S^-1 e of each row (own,).
    """

    end: list[Any]
    after: list[Any]
    before: list[Any]
    estimates: list[Any]
    nis: Any


class BackwardRecursion(Recursion):
    """Backward pass of the smoothed law over rows, with an estimate of each row.

    A row is a pair: the leaves of its smoother step that depend on data, and an empty array in place of inputs.
    `settled` is the filter's settled state, whose output is a smoother step.
    """

    settled: SettledState

    def step(self, law: Gaussian, row: tuple[list[Array], Array], k: Array) -> tuple[Gaussian, Estimate]:
        """Return the smoothed law of the state before a row, and the row's smoothed estimate.

        `law` is the smoothed law of the state after the row, which gives the row's estimate. All leaves of the smoother
        step that do not depend on data are those of the settled one.
        """
        varying_leaves, _ = row
        step = self.settled.fill_row(varying_leaves)
        return step.back(law), step.estimate_from(law)


def smooth_settled_chunks(
    recursion: SmootherStepRecursion, settled: SettledState, chunk_starts: ChunkStarts, windows: PyTree
) -> SmoothedChunk | None:
    """Smooth chunks of complete rows by their means alone, with steady covariances; None where that is not possible.

    On complete rows the covariances of a filter converge, and so does that of its smoothed law. Where both are steady,
    only means depend on data. It is not possible if the smoothed covariance does not converge, or without native code.

    Args:
        recursion: the filter over rows, and how many rows are a chunk's own.
        settled: the filter's state with its steady covariance; its `outputs` are the smoother step of a row there.
        chunk_starts: the states before the chunks, the numbers of their first rows, and `lengths.ahead`, the number of
            rows in which a filter is supposed to forget its start.
        windows: the rows of each chunk and those after it, (chunks, rows, ...).
    """
    # Repeat the settled smoother step backward, from the filtered law, until the smoothed covariance is steady. A row
    # of this pass is the leaves of the smoother step that depend on data, and no input.
    back = BackwardRecursion(settled)
    varying_leaves = [np.asarray(leaf)[None] for leaf in settled.select_varying(settled.outputs)]
    rows_back = varying_leaves, np.zeros((1, 0))
    smoothed = find_settled_state(back, settled.outputs.after, rows_back, chunk_starts.lengths.ahead)
    if smoothed is None:
        return None
    # Smooth the means of all chunks in one call of native code, then put the steady covariances to them.
    arguments = recursion, back, smoothed, means_of(chunk_starts.states), windows, chunk_starts.first
    differs_by_chunk = [False, False, False, True, True, True]  # means, rows and numbers of first rows
    choice = choose_code(_smooth_settled, arguments, differs_by_run=differs_by_chunk)
    if choice.code is None:
        return None
    means: SmoothedMeans = choice.results()  # each array with a leading axis over the chunks
    return SmoothedChunk(
        end=settled.repeat_with_means(means.end),
        law_after=smoothed.repeat_with_means(means.after),
        law_before=smoothed.repeat_with_means(means.before),
        estimate=smoothed.fill_rows(means.estimates),
        nis=means.nis,
        received=np.full(means.nis.shape, settled.outputs.received),
    )


def _smooth_settled(
    recursion: SmootherStepRecursion,
    back: BackwardRecursion,
    smoothed: SettledState,
    means: Sequence[Array],
    rows: PyTree,
    first: Array,
) -> SmoothedMeans:
    """Smooth one chunk in which covariances have settled: filter its means ahead, then pass them back.

    Covariances have settled where they are the same in each row, so only means are computed. The smoothed mean at the
    chunk's end needs data from after it: the backward pass begins some rows later, from the filtered mean.

    Args:
        recursion: the filter over rows, and how many rows are the chunk's own.
        back: the backward pass over smoother steps (what a smoother needs of each row) with the settled covariances.
        smoothed: the smoothed law with a settled covariance.
        means: the filter's means before the first row, one array for each Gaussian of its state.
        rows: measurements and inputs (rows, ...) of the chunk and of some rows after it.
        first: number of the chunk's first row.
    """
    own = recursion.own
    settled = back.settled
    end = first + len(rows[0])
    # Steps are the leaves of smoother steps that depend on data, of the own rows and of those after them.
    means_at_end, steps = scan_settled_rows(recursion, settled, means, take(rows, slice(own)), first, end)
    rows_after = take(rows, slice(own, None))
    last_means, steps_after = scan_settled_rows(recursion, settled, means_at_end, rows_after, first + own, end)

    def pass_back(means: list[jax.Array], varying: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        """Return the smoothed means before a row from those after it, and the estimate's leaves that depend on data.

        `back` is the backward pass with steady covariances, and `varying` the leaves of the row's smoother step that
        depend on data.
        """
        row = (varying, jnp.zeros(0))
        row_number = jnp.zeros((), int)  # no inputs; a backward step ignores its number
        law, estimate = step_settled(back, smoothed.state, means, row, row_number)
        return means_of(law), smoothed.select_varying(estimate)

    # Back over the rows after the chunk, which yields the smoothed mean at its end, and then over its own.
    filtered_mean = [gaussian_of(with_means(settled.state, last_means)).mean]
    smoothed_after, _ = jax.lax.scan(pass_back, filtered_mean, steps_after, reverse=True)
    smoothed_before, estimates = jax.lax.scan(pass_back, smoothed_after, steps, reverse=True)
    nis = settled.fill_row(steps).nis
    return SmoothedMeans(means_at_end, smoothed_after, smoothed_before, estimates, nis=jnp.broadcast_to(nis, (own,)))
