"""Measured components that repeat others, noise included: after those others they carry no information.

Given the components before it, such a component has slopes and a noise that are differences of equal numbers: zero, but
rounding leaves some eps. A slope of some eps over a noise of some eps would count as information, and the noise would
be correlated with components after it. The functions here say which numbers are such rounding.
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
from heliograph.numerics.linalg import WRITTEN, outer, scale, where
from heliograph.numerics.trace_settings import writes_for_derivatives
from straightline import operation


def triangularise_noise(noise: WeightedColumns) -> WeightedColumns:
    """Return L and d with L diag(d) L' = W diag(w) W', the covariance of m components' noises, by orthogonal rows.

    A component may repeat others, and its rounding must not become a noise of its own. Row i of W becomes w_i = W_i -
    sum_{j < i} L_ij w_j, orthogonal to the rows before it. An entry |w_ik| <= RANK (|W_ik| + sum_j |L_ij| |w_jk|) is
    rounding, and is set to zero. This concerns only rows between others, so that with fewer than 3 rows there is
    nothing to set.
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
    """Return the variance f' diag(d) f that rounding alone may give to computed slopes f (n,): (c n eps)^2 Var.

    Each slope is a sum of n products, so its relative rounding error is c n eps, with c = ROUNDING_UNITS. `variance`
    is that of the measured component itself.
    """
    rounding: jax.Array = (ROUNDING_UNITS * n * unit_of(variance)) ** 2 * variance
    return rounding


def rounding_of_slopes(n: int, lower: jax.Array, whole: jax.Array) -> jax.Array:
    """Return for each measured component the variance (m,) up to which its n slopes count as rounding.

    s_i are the components as measured, of variances `whole` (m,). L is `lower` (m, m), the unit lower triangular factor
    of their noises' covariance. w_i = s_i - sum_{k < i} L_ik w_k have uncorrelated noises. The rounding of w_i has the
    variance (c n eps)^2 Var s_i + share^2 sum_{k < i} L_ik^2 Var s_k, with c = ROUNDING_UNITS. The share is c n eps, or
    RANK if that is larger, since correlations of noises are not known better.
    """
    share = max(ROUNDING_UNITS * n * unit_of(whole), RANK)
    strictly_lower = where(np.tri(len(lower), k=-1, dtype=bool), lower, 0.0)
    return rounding_of_products(n, whole) + share**2 * (strictly_lower**2 @ whole)


def noise_beside_rounding(n: int, least: jax.Array) -> jax.Array:
    """Return a noise variance so large that a measurement with n slopes that are only rounding changes nothing.

    `least` is the variance rho up to which the slopes count as rounding, and u = ROUNDING_UNITS n eps their relative
    rounding, so that the measured component has the variance rho / u^2. The noise is 1024 times that: an innovation of
    one deviation moves the mean by u / 1024 = n eps / 256 of its own deviation. Single precision holds such a noise.
    """
    return 1024 / (ROUNDING_UNITS * n * unit_of(least)) ** 2 * least


def _triangularise_row_by_row(rows: jax.Array, weights: jax.Array) -> WeightedColumns:
    """Factor L diag(d) L' = A diag(w) A' by Gram-Schmidt, row by row, with entries that are only rounding set to 0.

    An entry is rounding if it is at most `share` of its size: |A_ik| plus all |L_ij a_jk| that were subtracted from it.

    Args:
        rows: A (m, columns).
        weights: w (columns,).
    """
    m, share = len(rows), max(ROUNDING_UNITS * rows.shape[1] * unit_of(rows), RANK)
    size = jnp.abs(rows)  # of each entry: its absolute value, and those of all terms subtracted from it
    lower, variances = list[jax.Array](), list[jax.Array]()
    for j in range(m):
        row = lax.index_in_dim(rows, j, keepdims=False)
        if 0 < j < m - 1:  # nothing was subtracted from the first row, and no row follows the last
            row = set_to_zero(row, jnp.abs(row) <= share * lax.index_in_dim(size, j, keepdims=False))
        weighted = scale(weights, row)
        variances.append(lax.dot(row, weighted))
        # Column j of L: L_ij = (row i, row j) / d_j. Then row i loses L_ij row j.
        reciprocal = lax.reshape(reciprocal_or_one(variances[j]), (1,))
        column = column_below_diagonal(j, outer(lax.dot(rows, weighted), reciprocal))
        rows, size = rows - outer(column, row), size + outer(jnp.abs(column), jnp.abs(row))
        lower.append(column)
    return assemble_factors(lower, variances, rows.dtype)


def _triangularise_in_loop(rows: jax.Array, weights: jax.Array) -> WeightedColumns:
    """Factor L diag(d) L' = A diag(w) A' by the steps of `_triangularise_row_by_row` in a loop, of many rows."""
    m, share = len(rows), max(ROUNDING_UNITS * rows.shape[1] * unit_of(rows), RANK)

    def eliminate_row(j: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Set the rounding of row j to 0, make the rows below orthogonal to it, and fill in column j of L and d_j.

        L diag(d) L' = A diag(weights) A'. `carry` holds the m rows of A less their projections, the `size` of each
        entry (its absolute value plus those of all terms subtracted from it), L and d. Up to `share` of its size an
        entry is rounding.
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
