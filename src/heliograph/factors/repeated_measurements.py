"""Measured components that repeat others, noise included: what rounding leaves of them carries no information.

Take away from such a component what those before it say: its slopes and its noise are differences of equal numbers,
zero, of which rounding leaves some eps. Its own noise, the rounding of numbers, is as small, so that slopes of some eps
would be information, and a noise of some eps would be correlated with those to come.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.factors.covariance_factors import (
    RANK,
    ROUNDING_UNITS,
    WeightedColumns,
    assemble_factors,
    column_below_diagonal,
    insert_column,
    triangularise,
)
from heliograph.factors.pivots import reciprocal_or_one, set_to_zero, unit_of
from heliograph.numerics.linalg import WRITTEN, outer, scale
from heliograph.numerics.trace_settings import writes_for_derivatives
from straightline import operation


def triangularise_noise(noise: WeightedColumns) -> WeightedColumns:
    """Return L and d with L diag(d) L' = W diag(w) W', the covariance of m components' noises, by orthogonal rows.

    A component may repeat others, and their rounding must not become a noise of its own. What is left of row i is
    w_i = W_i - sum_j L_ij w_j. An entry |w_ik| <= RANK (|W_ik| + sum_j |L_ij| |w_jk|) is rounding, and is set to zero.
    This concerns only rows between others, so that with fewer than 3 rows there is nothing to set.
    """
    if len(noise.matrix) < 3:
        return triangularise(noise)
    matrix, weights = jnp.asarray(noise.matrix), jnp.asarray(noise.weights)
    if len(matrix) <= WRITTEN:
        return _triangularise_row_by_row(matrix, weights)
    # What is to be differentiated is another program of the loop, which an operation would not know.
    factor = _triangularise_in_loop if writes_for_derivatives() else _triangularise_by_loop
    return factor(matrix, weights)


def rounding_of_products(n: int, variance: jax.Array) -> jax.Array:
    """Return the variance by the rounding of n slopes, each a sum of n products, of rows of these variances."""
    rounding: jax.Array = (ROUNDING_UNITS * n * unit_of(variance)) ** 2 * variance
    return rounding


def rounding_of_slopes(n: int, lower: jax.Array, whole: jax.Array) -> jax.Array:
    """Return the variance (m,) up to which n slopes of w_i = s_i - sum_k L_ik w_k count as rounding.

    s_i are the components as measured, w_i those with uncorrelated noises. L is `lower`, the noises' unit triangle.
    `whole` holds the variances (m,) of the rows s_i. The rounding is ROUNDING_UNITS n eps of s_i itself, and `share` of
    each subtracted L_ik w_k. The share is at least RANK, since correlations of noises are not known better.
    """
    share = max(ROUNDING_UNITS * n * unit_of(whole), RANK)
    below = jnp.tril(lower, -1)
    return rounding_of_products(n, whole) + share**2 * (below**2 @ whole)


def noise_beside_rounding(n: int, least: jax.Array) -> jax.Array:
    """Return a noise beside which n slopes of a variance up to `least` say nothing: 1,024 times what they round.

    An innovation as large as its deviation moves a mean by n eps / 256 of its own; single precision holds the noise.
    """
    return 1024 / (ROUNDING_UNITS * n * unit_of(least)) ** 2 * least


def _triangularise_row_by_row(rows: jax.Array, weights: jax.Array) -> WeightedColumns:
    """Factor L diag(d) L' = A diag(w) A' by Gram-Schmidt, written out row by row, for `triangularise_noise`.

    Args:
        rows: A (m, columns).
        weights: w (columns,).
    """
    m, share = len(rows), max(ROUNDING_UNITS * rows.shape[1] * unit_of(rows), RANK)
    size = jnp.abs(rows)  # of each entry, with the sizes of all that was taken off it
    lower, variances = list[jax.Array](), list[jax.Array]()
    for j in range(m):
        row = lax.index_in_dim(rows, j, keepdims=False)
        if 0 < j < m - 1:  # nothing was taken off the first one, and nothing follows the last
            row = set_to_zero(row, jnp.abs(row) <= share * lax.index_in_dim(size, j, keepdims=False))
        weighted = scale(weights, row)
        variances.append(lax.dot(row, weighted))
        # Column j of L: how much of the row is in each row below it, which is taken off there.
        over = lax.reshape(reciprocal_or_one(variances[j]), (1,))
        below = column_below_diagonal(j, outer(lax.dot(rows, weighted), over))
        rows, size = rows - outer(below, row), size + outer(jnp.abs(below), jnp.abs(row))
        lower.append(below)
    return assemble_factors(lower, variances, rows.dtype)


def _triangularise_in_loop(rows: jax.Array, weights: jax.Array) -> WeightedColumns:
    """Factor L diag(d) L' = A diag(w) A' by the steps of `_triangularise_row_by_row` in a loop, of many rows."""
    m, share = len(rows), max(ROUNDING_UNITS * rows.shape[1] * unit_of(rows), RANK)

    def eliminate_row(j: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Set the rounding of row j to 0, make the rows below orthogonal to it, and fill in column j of L and d_j.

        L diag(d) L' = A diag(weights) A'. `carry` holds what is left of the m rows of A, the `size` of each entry (its
        absolute value plus all that was taken off it), L and d. An entry up to `share` of its size is rounding.
        """
        rows, size, lower, variances = carry
        row = set_to_zero(rows[j], jnp.abs(rows[j]) <= share * size[j])
        weighted = weights * row
        d = row @ weighted
        column = jnp.where(np.arange(m) > j, rows @ weighted * reciprocal_or_one(d), 0.0)
        rows = rows - outer(column, row)
        size = size + outer(jnp.abs(column), jnp.abs(row))
        return rows, size, *insert_column(j, lower, column, variances, d)

    start = rows, jnp.abs(rows), jnp.eye(m, dtype=rows.dtype), jnp.zeros(m, rows.dtype)
    _, _, lower, variances = lax.fori_loop(0, m, eliminate_row, start)
    return WeightedColumns(lower, variances)


_triangularise_by_loop = operation(_triangularise_row_by_row)(_triangularise_in_loop)
