"""Recursion of linear filters over the rows of a recording, of whose states data change the means alone."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.rows.gaussians_in_states import gaussians_of, select_state
from heliograph.numerics.module import Module, unwritten
from heliograph.numerics.types import Array, PyTree


class Recursion(Module):
    """Recursion of a linear filter over rows (z, u): data change only the means of the Gaussians in its state."""

    def step(self, state: PyTree, row: tuple[PyTree, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Return the state after row k, from that before it and the row's data (z, u), and the row's output."""
        raise unwritten(self, "step")

    def predict(self, state: PyTree, row: tuple[PyTree, Array], k: Array) -> PyTree:
        """Return the state predicted over row k, as if nothing of its measurement z had arrived (NaN)."""
        z, u = row
        missing = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), z)
        after, _ = self.step(state, (missing, u), k)
        return after


class FilterRecursion(Recursion):
    """Recursion of one filter, with output(filter, state, innovation, k) as the output of row k.

    begin: the number k of the first row.
    """

    filter: Any
    output: Callable[..., PyTree] = eqx.field(static=True)
    begin: Array = eqx.field(default_factory=lambda: np.asarray(0))

    def step(self, state: PyTree, row: tuple[Array, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Predict and correct with the data of row k; return the state after it, and its output.

        `self.begin` is the number of the recording's first row. `self.output` computes a row's output from filter,
        state, innovation and row number.
        """
        z, u = row
        number = self.begin + k
        prior = self.filter.predict(state, u, number)
        after, innovation = self.filter.correct(prior, z, number)
        return after, self.output(self.filter, after, innovation, number)


def initial_state_if_linear(filter: Any) -> PyTree | None:
    """Return the initial state of a linear filter; None where more than the mean of its state depends on data."""
    start = jax.tree.map(np.asarray, filter.init()) if getattr(filter, "is_linear", False) else ()
    return start if gaussians_of(start) else None


def scan_chunk(recursion: Recursion, state: PyTree, rows: PyTree, first: Array, count: Array) -> tuple[PyTree, PyTree]:
    """Step a recursion over rows; return the last state and the output of each row.

    `first` is the number of the first row. The data end before row `count`: from there on the state does not change.
    """

    def step(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, PyTree]:
        """Step over one row (data, number); from row `count` on, after the end of the data, the state stays."""
        data, k = row
        after, output = recursion.step(state, data, k)
        return select_state(k < count, after, state), output

    return jax.lax.scan(step, jax.tree.map(jnp.asarray, state), (rows, make_row_numbers(rows, first)))


def sum_chunk(recursion: Recursion, state: PyTree, rows: PyTree, first: Array, count: Array) -> tuple[PyTree, PyTree]:
    """Step over rows as `scan_chunk` does; return the last state and the sums of the outputs over rows."""

    def step(state: PyTree, data: PyTree, k: Array) -> tuple[PyTree, PyTree]:
        """Step over row k; return the state after it and its output."""
        return recursion.step(state, data, k)

    return sum_rows(step, jax.tree.map(jnp.asarray, state), rows, first, count)


def sum_rows(
    step: Callable[..., tuple[PyTree, PyTree]], state: PyTree, rows: PyTree, first: Array, count: Array
) -> tuple[PyTree, PyTree]:
    """Step over rows from number `first` on, before row `count`: the last state, and the sums of what steps return.

    `count`: number of the row at which the data end; from it on nothing changes.
    """

    def body(before: tuple[PyTree, PyTree], row: tuple[PyTree, Array]) -> tuple[tuple[PyTree, PyTree], None]:
        """Step over one row and add its output to the sums; from row `count` on nothing changes.

        `before` holds the state and the sums of outputs. `step` returns the state after a row, and the row's output.
        """
        state, sums = before
        data, k = row
        after, output = step(state, data, k)
        sums_after = jax.tree.map(jnp.add, sums, output)
        return select_state(k < count, (after, sums_after), before), None

    numbers = make_row_numbers(rows, first)
    shapes = jax.eval_shape(lambda: step(state, jax.tree.map(lambda leaf: leaf[0], rows), numbers[0])[1])
    zero_sums = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.scan(body, (state, zero_sums), (rows, numbers))[0]


def state_after_rows(recursion: Recursion, state: PyTree, rows: PyTree, first: Array) -> PyTree:
    """Return only the state after some rows; `first` is the number of the first one."""

    def step(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, None]:
        """Return the state after one row (data, number), and None as its output."""
        after, _ = recursion.step(state, *row)
        return after, None

    last_state, _ = jax.lax.scan(step, jax.tree.map(jnp.asarray, state), (rows, make_row_numbers(rows, first)))
    return last_state


def make_row_numbers(rows: PyTree, first: Array) -> Array:
    """Return the numbers first, first + 1, ... of the rows (rows, ...)."""
    return first + jnp.arange(len(jax.tree.leaves(rows)[0]))
