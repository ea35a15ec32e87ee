"""Rows in which only means move: on complete rows the covariances of a linear filter converge, and its gains with them.

What of a row depends on data, native code says itself: given a state whose means alone differ between runs, and a row
that is complete, all other numbers after the row are common to all runs, unless plant, sensor or channel vary by time
or by an input. If so, and two states a thousand rows apart are the same to the roundings of a number, this state is
that of all further complete rows, and what follows from it is computed once. What is left of a row is the closed loop
m = m- + K (z - H m-): of four states and two outputs a tenth of a filter's time.

Covariances at the end of a convergence may repeat in turns, a rounding apart; the one that is taken differs from them
by as much. Means differ from those of a pass with all factors by roundings of their own.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, threads
from heliograph.filters.recursion import Recursion, end_of_rows, number_rows
from heliograph.filters.states import ROUNDING, agree, means_of, with_means
from heliograph.numerics.types import Array, Bool, Int, PyTree
from straightline import present

TURNS = 4  # windows of rows after which a state is compared with what it was after half of them


class Settled(NamedTuple):
    """A state that stays as it is over complete rows but for its means, and what is kept of such a row.

    Means, and of `outputs` the leaves that `varies` marks, are of any value.
    """

    state: PyTree
    outputs: PyTree
    varies: tuple[bool, ...]

    def repeated(self, means: Sequence[np.ndarray]) -> PyTree:
        """Return states (n, ...) with these means (n, ...)."""
        return with_means(repeat_state(self.state, len(means[0])), means)

    def rows_of(self, varying: list[np.ndarray]) -> PyTree:
        """Return what is kept of rows (chunks, rows, ...), of those of its leaves that vary."""
        chunks, rows = varying[0].shape[:2]
        leaves, form = jax.tree.flatten(self.outputs)
        filled = [leaf if v else _fill_rows(leaf, chunks, rows) for leaf, v in zip(leaves, self.varies, strict=True)]
        return self._replace(outputs=jax.tree.unflatten(form, filled)).row_of(varying)

    def row_of(self, varying: list[Any]) -> PyTree:
        """Return what is kept of a row, of those of its leaves that vary."""
        given, leaves = iter(varying), jax.tree.leaves(self.outputs)
        joined = [next(given) if v else leaf for leaf, v in zip(leaves, self.varies, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(self.outputs), joined)

    def varying_of(self, output: PyTree) -> list[Any]:
        """Return those leaves of what is kept of a row that vary."""
        return [leaf for leaf, v in zip(jax.tree.leaves(output), self.varies, strict=True) if v]

    def covers(self, states: PyTree) -> Bool[np.ndarray, " n"]:
        """Test which states (n, ...) are this one but for the means."""
        return agree(states, self.repeated(means_of(states)))


def find_settled(recursion: Recursion, start: PyTree, rows: PyTree, ahead: int) -> Settled | None:
    """Find the state that complete rows lead to; None where there is none, or no native code.

    Args:
        recursion: filters over rows.
        start: their state before any row.
        rows: measurements and inputs (rows, ...).
        ahead: length of a window of rows.
    """
    quiet = jax.tree.map(lambda leaf: np.zeros((1, ahead, *leaf.shape[1:])), rows)
    state, first, halfway = repeat_state(start, 1), np.zeros(1, int), None
    varies = _find_varying(recursion, start, quiet)
    if varies is None:
        return None
    for turn in range(TURNS):
        halfway = state if turn == TURNS // 2 else halfway
        choice = choose_code(end_of_rows, (recursion, state, quiet, first), [False, True, True, True])
        if choice.code is None:
            return None
        state = choice.results()
    still = [np.zeros_like(mean) for mean in means_of(state)]
    if not agree(with_means(state, still), with_means(halfway, still), ROUNDING)[0]:
        return None
    one = jax.tree.map(lambda leaf: leaf[0, ...], state)
    outputs = jax.tree.map(lambda leaf: leaf[0, ...], _step_once(recursion, one, quiet).results()[1])
    return Settled(one, outputs, varies)


def _find_varying(recursion: Recursion, start: PyTree, quiet: PyTree) -> tuple[bool, ...] | None:
    """Return which leaves of what is kept of a complete row depend on data; None if of the state not means alone do."""
    choice = _step_once(recursion, start, quiet)
    if choice.code is None:
        return None
    after, outputs = jax.tree.unflatten(choice.code.tree, choice.code.common)
    if not all(jax.tree.leaves(with_means(after, [True] * len(means_of(after))))):
        return None
    return tuple(not common for common in jax.tree.leaves(outputs))


def _step_once(recursion: Recursion, state: PyTree, quiet: PyTree) -> Any:
    """Choose code for a step from a state that all runs share but for its means, over the first of some rows."""
    row, means = jax.tree.map(lambda leaf: leaf[:, 0], quiet), [np.asarray(mean)[None] for mean in means_of(state)]
    return choose_code(step_settled, (recursion, state, means, row, np.zeros(1, int)), [False, False, True, True, True])


def step_settled(
    recursion: Recursion, state: PyTree, means: Sequence[Array], row: PyTree, k: Array
) -> tuple[PyTree, PyTree]:
    """Step over a complete row from a state with other means."""
    z, u = row
    return recursion.step(with_means(state, means), (jax.tree.map(present, z), u), k)


def scan_settled(
    recursion: Recursion, settled: Settled, means: Sequence[Array], rows: PyTree, first: Array
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Scan complete rows from a settled state with these means; return the last means, and what varies of each row."""

    def body(means: list[jax.Array], row: tuple[PyTree, Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        after, outputs = step_settled(recursion, settled.state, means, *row)
        return means_of(after), settled.varying_of(outputs)

    return jax.lax.scan(body, [jnp.asarray(mean) for mean in means], (rows, number_rows(rows, first)))


def end_of_settled_rows(
    recursion: Recursion, settled: Settled, means: Sequence[Array], rows: PyTree, first: Array
) -> list[jax.Array]:
    """Return the means after some complete rows alone."""

    def body(means: list[jax.Array], row: tuple[PyTree, Array]) -> tuple[list[jax.Array], None]:
        return means_of(step_settled(recursion, settled.state, means, *row)[0]), None

    return jax.lax.scan(body, [jnp.asarray(mean) for mean in means], (rows, number_rows(rows, first)))[0]


def are_complete(rows: PyTree) -> Bool[np.ndarray, " n"]:
    """Test which windows (n, length, ...) of measurements and inputs lack no number."""
    with np.errstate(over="ignore", invalid="ignore"):  # a sum of huge numbers is taken for one that lacks some
        sums = [np.sum(z.reshape(len(z), -1), axis=1) for z in jax.tree.leaves(rows[0])]
    return np.asarray(np.isfinite(sums).all(axis=0))


def repeat_state(state: PyTree, count: int) -> PyTree:
    """Return a state `count` times, along a leading axis."""
    return jax.tree.map(lambda leaf: np.repeat(leaf[None], count, axis=0), state)


def _fill_rows(leaf: np.ndarray, chunks: int, rows: int) -> np.ndarray:
    """Return an array (chunks, rows, ...) of equal rows, filled by all cores: most of the memory of results."""
    filled = np.empty((chunks, rows, *leaf.shape), leaf.dtype)
    one = np.broadcast_to(leaf, (rows, *leaf.shape)).copy()

    def fill(part: Int[np.ndarray, " chunks"]) -> None:
        for chunk in part:
            filled[chunk] = one

    list(threads().map(fill, np.array_split(np.arange(chunks), 16)))
    return filled
