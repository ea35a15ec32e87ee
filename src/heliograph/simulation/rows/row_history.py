"""The history of rows that a sweep back goes over: what came, and what the filters made of it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from typing_extensions import TypeAliasType

from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, Float, Int, PyTree

Rows = TypeAliasType("Rows", Float[Array, "row column"])


@readable
class RowHistory(NamedTuple):
    """Rows in order: measurements of all nodes, inputs (NaN where none was given), and the time.

    Args:
        rows: these numbers (row, received + given + 1).
        state: the filters' states after each row.
        held: inputs held there (row, given).
        step: number of the step (row,).
        outputs: estimates and judgements after each row.
    """

    rows: Rows
    state: PyTree
    held: Rows
    step: Int[Array, " row"]
    outputs: PyTree

    def read_row(self, row: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the measurements, the inputs and the time of a row, which stand side by side in `self.rows[row]`.

        `self.held` (row, inputs) has a column for each input that a row gives.
        """
        inputs = self.held.shape[1]
        numbers = self.rows[row]
        measurements, u = numbers[: -inputs - 1], numbers[-inputs - 1 : -1]
        time = numbers[-1]
        return measurements, u, time

    def state_after(self, row: jax.Array) -> PyTree:
        """Return the filters' states after a row."""
        return jax.tree.map(lambda leaf: leaf[row], self.state)

    def inputs_into_row(self, row: jax.Array, dt: int) -> jax.Array:
        """Return the inputs that led to a row, for a plant whose input number `dt` is the length of a step.

        They are the inputs held since the previous row, and in their midst the time that has passed since then.
        """
        held_inputs = self.held[row - 1]
        _, _, time = self.read_row(row)
        _, _, time_before = self.read_row(row - 1)
        return jnp.concatenate([held_inputs[:dt], (time - time_before)[None], held_inputs[dt:]])

    def read_step(self, row: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return measurements and inputs at step k, the row's own step or one between it and the previous row.

        Between rows nothing is measured (NaN), and the inputs held since the previous row apply. They also replace
        inputs that the row does not give (NaN).
        """
        z, u_of_row, step_of_row = self.read_row(row)
        is_step_of_row, held_inputs = k == step_of_row.astype(self.step.dtype), self.held[row - 1]
        u_given_or_held = jnp.where(jnp.isnan(u_of_row), held_inputs, u_of_row)
        u = jnp.where(is_step_of_row, u_given_or_held, held_inputs)
        return jnp.where(is_step_of_row, z, jnp.nan), u
