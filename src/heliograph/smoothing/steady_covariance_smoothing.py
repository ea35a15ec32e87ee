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
    recursion: SmootherStepRecursion, settled: SettledState, begun: ChunkStarts, windows: PyTree
) -> SmoothedChunk | None:
    """Smooth chunks as if the filter's covariances had settled in all of them; None where that is not possible.

    A covariance has settled if complete rows change it no more, so that only means must be computed. Chunks are parts
    of a long recording, which are smoothed side by side. It is not possible if the covariance of the smoothed law does
    not settle, or without native code.

    Args:
        recursion: the filter over rows.
        settled: the filter's settled state, and its smoother step there.
        begun: the states with which the chunks begin, the numbers of their first rows, and `lengths.ahead`, the number
            of rows in which a filter is supposed to forget its start.
        windows: the rows of each chunk and those after it, (chunks, rows, ...).
    """
    # The smoothed law with a settled covariance, found by repeating the settled smoother step.
    back = BackwardRecursion(settled)
    leaves = zip(jax.tree.leaves(settled.outputs), settled.varies, strict=True)
    varying = [np.asarray(leaf)[None] for leaf, varies in leaves if varies]
    smoothed = find_settled_state(back, settled.outputs.after, (varying, np.zeros((1, 0))), begun.lengths.ahead)
    if smoothed is None:
        return None
    # Filter and smooth the means of all chunks in one call of compiled code, and put the settled covariances to them.
    arguments = recursion, back, smoothed, means_of(begun.states), windows, begun.first
    differs_by_chunk = [False, False, False, True, True, True]  # means, rows and numbers of first rows
    choice = choose_code(_smooth_settled, arguments, differs_by_run=differs_by_chunk)
    if choice.code is None:
        return None
    end, means_after, means_before, estimates, nis = choice.results()
    return SmoothedChunk(
        end=settled.repeat_with_means(end),
        law_after=smoothed.repeat_with_means(means_after),
        law_before=smoothed.repeat_with_means(means_before),
        estimate=smoothed.fill_rows(estimates),
        nis=nis,
        received=np.full(nis.shape, settled.outputs.received),
    )


def _smooth_settled(
    recursion: SmootherStepRecursion,
    back: BackwardRecursion,
    smoothed: SettledState,
    means: Sequence[Array],
    rows: PyTree,
    first: Array,
) -> tuple[PyTree, ...]:
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

    Returns:
        The filter's means after the chunk's own rows, the smoothed means of the states after and before these rows, the
        leaves of its estimates that depend on data (own, ...), and the squared innovations (own,).
    """
    own, settled, end = recursion.own, back.settled, first + len(rows[0])
    # Steps are the leaves of smoother steps that depend on data, of the own rows and of those after them.
    means_at_end, steps = scan_settled_rows(recursion, settled, means, take(rows, slice(own)), first, end)
    rows_after = take(rows, slice(own, None))
    last_means, steps_after = scan_settled_rows(recursion, settled, means_at_end, rows_after, first + own, end)

    def pass_back(means: list[jax.Array], varying: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        """Return the smoothed means before a row from those after it, and the estimate's leaves that depend on data."""
        law, estimate = step_settled(back, smoothed.state, means, (varying, jnp.zeros(0)), jnp.zeros((), int))
        return means_of(law), smoothed.select_varying(estimate)

    # Back over the rows after the chunk, which yields the smoothed mean at its end, and then over its own.
    filtered_mean = [gaussian_of(with_means(settled.state, last_means)).mean]
    smoothed_after, _ = jax.lax.scan(pass_back, filtered_mean, steps_after, reverse=True)
    smoothed_before, estimates = jax.lax.scan(pass_back, smoothed_after, steps, reverse=True)
    nis = settled.fill_row(steps).nis
    return means_at_end, smoothed_after, smoothed_before, estimates, jnp.broadcast_to(nis, (own,))
