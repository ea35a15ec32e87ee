"""Rule of the LU decomposition of a small regular matrix, A = P L U, with pivots selected by data."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from heliograph.codegen.graph import Unsupported
from heliograph.codegen.lowering import IN_MEMORY, Lowering, Value, like

LARGEST = 8  # rows


def lu(a: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute L below the diagonal and U (n, n), the pivot row of each step (n,), and the order of rows (n,).

    Each step takes the largest entry of the rest of its column, and needs one reciprocal.

    Source: Golub and Van Loan, Matrix computations, section 3.4.
    """
    n = len(a)
    rows, order, pivots = list(a), list(jnp.arange(n, dtype=jnp.int32)), []
    for j in range(n):
        # Partial pivoting: the largest |a_ij|, i >= j.
        column = jnp.abs(jnp.stack([row[j] for row in rows[j:]]))
        taken = j + jnp.argmax(column).astype(jnp.int32)
        pivots.append(taken)
        for i in range(j + 1, n):  # exchange rows j and i where i is taken
            here = taken == i
            rows[j], rows[i] = jnp.where(here, rows[i], rows[j]), jnp.where(here, rows[j], rows[i])
            order[j], order[i] = jnp.where(here, order[i], order[j]), jnp.where(here, order[j], order[i])
        # Elimination: l_ij = a_ij / a_jj, a_i <- a_i - l_ij a_j.
        scale = 1 / rows[j][j]
        for i in range(j + 1, n):
            factor = rows[i][j] * scale
            rest = rows[i][j + 1 :] - factor * rows[j][j + 1 :]
            rows[i] = jnp.concatenate([rows[i][:j], factor[None], rest])
    return jnp.stack(rows), jnp.stack(pivots), jnp.stack(order)


def _lu(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    avals: list[Any] = [v.aval for v in equation.invars]
    shape = avals[0].shape
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] > LARGEST:
        raise Unsupported(f"factors of a matrix of shape {shape}")
    return lowering.inline(_program(shape[0]), inputs)


@cache
def _program(n: int) -> ClosedJaxpr:
    with jax.enable_x64(True):
        return jax.make_jaxpr(lu)(like((n, n), np.float64))


def _linear_solve(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Solve a system by the solver that it comes with."""
    programs, lengths = equation.params["jaxprs"], equation.params["const_lengths"]
    before = lengths.matvec + lengths.vecmat
    fixed = inputs[before : before + lengths.solve]
    right = inputs[before + lengths.solve + lengths.transpose_solve :]
    return lowering.inline(programs.solve, [*fixed, *right])


IN_MEMORY |= {"lu": _lu, "custom_linear_solve": _linear_solve}
