"""Smoothing of chunks of complete rows in which covariances are steady: only means are computed, ahead and back.

The pass back over the rows of a settled filter is a recursion as its pass ahead is: of the smoothed law, with the parts
of a smoother step that depend on data as its rows. Its covariance settles too, some rows before the end.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.chunks import ChunkStarts
from heliograph.filters.gaussians_in_states import means_of, with_means
from heliograph.filters.linear_recursion import Recursion
from heliograph.filters.row_windows import take
from heliograph.filters.settled_covariance import SettledState, find_settled_state, scan_settled_rows, step_settled
from heliograph.filters.smoother_step import SmootherStep, StepTrace, gaussian_of, make_smoother_step
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Array, PyTree


class SmootherStepRecursion(Recursion):
    """A filter's recursion over rows, with the smoother step of each row as its output.

    Args:
        filter: the filter.
        own: number of rows of a chunk, without those behind it that it is smoothed by.
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
    """Results of a chunk: the filter's state behind it, and what is smoothed of each row.

    The pass back entered it by one smoothed law, of the row behind it, and left it by another, of its first row.
    """

    end: PyTree
    entered: Gaussian
    left: Gaussian
    estimate: Estimate
    nis: Array
    received: Array


class BackwardRecursion(Recursion):
    """The smoothed law passed back over rows (parts of smoother steps that vary, nothing), with an estimate of each."""

    settled: SettledState

    def step(self, law: Gaussian, row: tuple[list[Array], Array], k: Array) -> tuple[Gaussian, Estimate]:
        """Smooth the state before a row from the law behind it, of which the row's estimate is."""
        step = self.settled.fill_row(row[0])
        return step.back(law), step.estimate_from(law)


def smooth_settled_chunks(
    recursion: SmootherStepRecursion, settled: SettledState, begun: ChunkStarts, windows: PyTree
) -> SmoothedChunk | None:
    """Smooth chunks as if the filter's covariance stood still in all of them; None where that is not possible.

    It is not where the smoothed law's covariance does not come to stand still, or without native code.

    Args:
        recursion: the filter over rows.
        settled: the state at which its covariance stands still, and its smoother step there.
        begun: the states with which the chunks begin.
        windows: the rows of each chunk and those behind it, (chunks, rows, ...).
    """
    # The smoothed law that stands still, by repeating the settled smoother step.
    back = BackwardRecursion(settled)
    leaves = zip(jax.tree.leaves(settled.outputs), settled.varies, strict=True)
    varying = [np.asarray(leaf)[None] for leaf, varies in leaves if varies]
    smoothed = find_settled_state(back, settled.outputs.after, (varying, np.zeros((1, 0))), begun.lengths.ahead)
    if smoothed is None:
        return None
    arguments = recursion, back, smoothed, means_of(begun.states), windows, begun.first
    differs_by_chunk = [False, False, False, True, True, True]  # means, rows and numbers of first rows
    choice = choose_code(_smooth_settled, arguments, differs_by_run=differs_by_chunk)
    if choice.code is None:
        return None
    end, entered, left, estimates, nis = choice.results()
    return SmoothedChunk(
        end=settled.repeat_with_means(end),
        entered=smoothed.repeat_with_means(entered),
        left=smoothed.repeat_with_means(left),
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
    """Smooth one chunk in which covariances stand still: filter its means ahead, then pass them back.

    Args:
        recursion: the filter over rows, and how many rows are the chunk's own.
        back: the pass back over settled smoother steps.
        smoothed: the smoothed law at which its covariance stands still.
        means: the filter's means at the chunk's beginning, one array for each Gaussian of its state.
        rows: of the chunk and of those behind it.
        first: number of its first row.

    Returns:
        The filter's means at the end of its own rows, the means of the smoothed laws by which it is entered and left,
        the leaves of its estimates that vary (own, ...), and the squared innovations (own,).
    """
    own, settled, end = recursion.own, back.settled, first + len(rows[0])
    means_after, steps = scan_settled_rows(recursion, settled, means, take(rows, slice(own)), first, end)
    rows_behind = take(rows, slice(own, None))
    last, steps_behind = scan_settled_rows(recursion, settled, means_after, rows_behind, first + own, end)

    def pass_back(means: list[jax.Array], varying: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        """Return the smoothed means before a row from those behind it, and what varies of its estimate."""
        law, estimate = step_settled(back, smoothed.state, means, (varying, jnp.zeros(0)), jnp.zeros((), int))
        return means_of(law), smoothed.select_varying(estimate)

    law = [gaussian_of(with_means(settled.state, last)).mean]
    entered, _ = jax.lax.scan(pass_back, law, steps_behind, reverse=True)
    left, estimates = jax.lax.scan(pass_back, entered, steps, reverse=True)
    nis = settled.fill_row(steps).nis
    return means_after, entered, left, estimates, jnp.broadcast_to(nis, (own,))
