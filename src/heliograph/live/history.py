"""Rows of a timeline in order, as a compiled program reads them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.types import PyTree


class History(NamedTuple):
    """Rows in order: measurements of all nodes, inputs (NaN where none was given), and the time.

    For each row there are also the filters' states after it, the inputs held, the step number, and the outputs.

    Shapes: rows (row, received + given + 1), held (row, given), step (row,).
    """

    rows: jax.Array | np.ndarray
    state: PyTree
    held: jax.Array | np.ndarray
    step: jax.Array | np.ndarray
    outputs: PyTree

    def parts(self, row: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the measurements, the inputs and the time of a row."""
        given = self.held.shape[1]
        numbers = self.rows[row]
        return numbers[: -given - 1], numbers[-given - 1 : -1], numbers[-1]

    def known(self, row: jax.Array) -> PyTree:
        """Return the filters' states after a row."""
        return jax.tree.map(lambda leaf: leaf[row], self.state)

    def interval(self, row: jax.Array, dt: int) -> jax.Array:
        """Return the inputs of a plant of continuous time since the row before, as held then."""
        return jnp.insert(self.held[row - 1], dt, self.parts(row)[2] - self.parts(row - 1)[2])

    def at_step(self, row: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return measurements and inputs at step k, which is the row's or one between it and the row before."""
        received, given, last = self.parts(row)
        there, held = k == last.astype(self.step.dtype), self.held[row - 1]
        u = jnp.where(there, jnp.where(jnp.isnan(given), held, given), held)
        return jnp.where(there, received, jnp.nan), u
