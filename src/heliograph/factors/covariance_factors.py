"""Covariances as sums of squares W diag(w) W', and the two ways to their factors L diag(d) L'.

L is unit lower triangular and d is never negative, so that a variance is a sum of positive terms in any precision. Rows
are made orthogonal (`triangularise`) where digits matter: a row is known to eps, so its square to eps^2. The sum is
formed and eliminated (`eliminate`) where products matter: two thirds of them, and a pivot is known to eps of its
variance.

A known zero of a matrix stays a known zero through a matrix product, not through a product of numbers, which might be
NaN: so products of rows and columns are written as matrix products here.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.factors.pivots import is_positive, reciprocal_or_one, take_pivot, unit_of
from heliograph.numerics.caching import cache_arrays
from heliograph.numerics.linalg import WRITTEN, diagonal, outer, scale, symmetric
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.trace_settings import write_for_derivatives, writes_for_derivatives
from heliograph.numerics.types import Array
from straightline import operation

ROUNDING_UNITS = 4  # how many eps of a number are noise of it
LARGEST = 1e30  # variance by rounding: beyond it numbers are absurd, and their squares none in single precision
RANK = 1e-12  # a pivot of a known covariance below this share of its variance counts as 0


class WeightedColumns(NamedTuple):
    """A covariance W diag(w) W'.  Shapes: matrix W (n, columns), weights w (columns,)."""

    matrix: Any  # Float[Array, "n columns"], NumPy's or JAX's
    weights: Any

    @property
    def covariance(self) -> jax.Array:
        """W diag(w) W' (n, n)."""
        matrix = jnp.asarray(self.matrix)
        return symmetric((matrix * self.weights) @ matrix.T)

    @property
    def diagonal(self) -> jax.Array:
        """Variances (n,): the diagonal of W diag(w) W', without forming the matrix."""
        variances: jax.Array = jnp.asarray(self.matrix) ** 2 @ self.weights
        return variances

    def through(self, matrix: Array) -> "WeightedColumns":
        """Return the covariance of A v, for a v with this covariance: the columns A W with the same weights."""
        return WeightedColumns(matrix @ self.matrix, self.weights)

    def times(self, factor: Array) -> "WeightedColumns":
        """Return the covariance times a number `factor`: the same columns, with weights times it."""
        return WeightedColumns(self.matrix, self.weights * factor)


def join_columns(*covariances: WeightedColumns) -> WeightedColumns:
    """Return the sum of covariances W diag(w) W': their columns side by side, in one matrix."""
    matrix = jnp.concatenate([jnp.asarray(covariance.matrix) for covariance in covariances], axis=1)
    return WeightedColumns(matrix, jnp.concatenate([jnp.asarray(covariance.weights) for covariance in covariances]))


def side_by_side(parts: WeightedColumns, weights: Array) -> WeightedColumns:
    """Return the columns of sum_i w_i P_i, such as the mean of covariances P_i over modes of probability w_i.

    `parts` has the columns of each P_i along a first axis (i, n, columns), and `weights` (i,) are w_i.
    """
    matrix = jnp.asarray(parts.matrix)
    columns = jnp.moveaxis(matrix, 0, 1).reshape(matrix.shape[1], -1)
    scaled_weights = (jnp.asarray(weights)[:, None] * parts.weights).reshape(-1)
    return WeightedColumns(columns, scaled_weights)


def zero_covariance(n: int) -> WeightedColumns:
    """Return the covariance of n components that are known: (n, 0), a matrix without columns."""
    return WeightedColumns(np.zeros((n, 0)), np.zeros(0))


def unit_lower(entries: Array) -> Any:
    """Build L (..., n, n) from its n (n - 1) / 2 entries below the diagonal, row by row: ones on it, zeros above."""
    # A 0 and a 1 are appended to the entries: then each number of L is one of them, of the number `index` (n, n).
    xp, index = library(entries), _place_unit_lower(entries.shape[-1])
    zero_and_one = np.broadcast_to(np.array([0.0, 1.0], np.dtype(entries.dtype)), (*entries.shape[:-1], 2))
    numbers = xp.concatenate([entries, zero_and_one], axis=-1)
    return numbers[..., index] if xp is np else _take_entries(numbers, index)


@cache_arrays
def _place_unit_lower(count: int) -> np.ndarray:
    """Return for each number of L (n, n) its index in a list: `count` entries below the diagonal, then a 0, then a 1.

    Entries are listed row by row. Numbers above the diagonal are the 0, those on it the 1.
    """
    n = (1 + int(np.sqrt(1 + 8 * count))) // 2  # of count = n (n - 1) / 2
    index = np.full((n, n), count)  # the 0
    index[np.tril_indices(n, -1)] = np.arange(count)
    np.fill_diagonal(index, count + 1)  # the 1
    return index


def below_diagonal(lower: jax.Array) -> jax.Array:
    """Read off the entries of L below its diagonal, row by row: the inverse of `unit_lower`."""
    n = lower.shape[-1]
    return _take_entries(lax.reshape(lower, (n * n,)), np.flatnonzero(np.tri(n, k=-1)))


def _take_entries(entries: jax.Array, indices: np.ndarray) -> jax.Array:
    """Return `entries[..., indices]` as one operation: the indices are known, and need no check of their bounds.

    `entries` is (..., count) and `indices` an array of integers; the result is (..., *indices.shape).
    """
    axis = entries.ndim - 1  # the entries' axis: indexed, and replaced by those of the indices; all others are kept
    numbers = lax.GatherDimensionNumbers(tuple(range(axis)), (axis,), (axis,))
    sizes = (*entries.shape[:-1], 1)
    return lax.gather(entries, indices[..., None], numbers, sizes, mode=lax.GatherScatterMode.CLIP)


def triangularise(columns: WeightedColumns) -> WeightedColumns:
    """Find L and d with L diag(d) L' = W diag(w) W', by making the rows of W orthogonal from the first one down.

    d_j = |row j|^2 in the weights, L_ij = (row i, row j) / d_j, and row i loses L_ij row j. c n (n + 1) products for c
    columns, n reciprocals. A row that depends on those above it has d = 0 and adds nothing to those below. More than
    WRITTEN rows are a loop.

    Source: Thornton, Triangular covariance factorizations for Kalman filtering (1976), modified weighted Gram-Schmidt.
    """
    if len(columns.matrix) > WRITTEN:
        return _triangularise_by_loop(columns)
    return _triangularise_row_by_row(columns)


def _triangularise_row_by_row(columns: WeightedColumns) -> WeightedColumns:
    """Return L and d with L diag(d) L' = A diag(w) A', by weighted Gram-Schmidt, one row of A after another.

    d_j is the square of row j in the weights, after the rows below lost their parts along the rows above.
    """
    rows, weights = jnp.asarray(columns.matrix), jnp.asarray(columns.weights)
    n, lower, variances = len(rows), [], []
    for j in range(n):
        row = lax.index_in_dim(rows, j, keepdims=False)
        weighted = scale(weights, row)
        variances.append(lax.dot(row, weighted))
        # Column j of L: L_ij = (row i, row j) / d_j. Then row i loses L_ij row j.
        reciprocal = lax.reshape(reciprocal_or_one(variances[j]), (1,))
        column = column_below_diagonal(j, outer(lax.dot(rows, weighted), reciprocal))
        rows = rows - outer(column, row)
        lower.append(column)
    return assemble_factors(lower, variances, rows.dtype)


def add_columns_to_factors(factors: WeightedColumns, columns: WeightedColumns) -> WeightedColumns:
    """Return the factors (unit lower triangular M, e) with M diag(e) M' = L diag(d) L' + W diag(w) W'.

    `factors` are L (n, n), unit lower triangular, and d (n,); `columns` W (n, count) and w (count,), absorbed one after
    another in a loop, a shorter program than `triangularise`. A column c of weight w goes from row to row j: with
    d_j' = d_j + w c_j^2, s = d_j / d_j' and g = w c_j / d_j', column j of L becomes s L_j + g c, c loses c_j L_j, and w
    becomes s w. These rotations without roots keep each row to eps of itself.

    Source: Gentleman, Least squares computations by Givens transformations without square roots (1973).
    """
    n, dtype = len(factors.matrix), jnp.asarray(columns.matrix).dtype
    # L is held as a flat list of its entries below the diagonal; `flat_place`: index of entry (i, j) in it.
    rows, places = np.tril_indices(n, -1)
    flat_place = {(i, j): e for e, (i, j) in enumerate(zip(rows.tolist(), places.tolist(), strict=True))}

    def absorb(carry: tuple[jax.Array, jax.Array], column: tuple[jax.Array, jax.Array]) -> tuple[Any, None]:
        """Absorb one column c of weight w: return the factors of L diag(d) L' + w c c'.

        `carry` holds the entries of L below its diagonal and d, `column` holds c and w.
        """
        lower, variances = list(carry[0]), list(carry[1])
        c, weight = list(column[0]), column[1]
        # Row after row takes its part of the column: d_j' = d_j + w c_j^2, s = d_j / d_j', g = w c_j / d_j'
        # (1 and 0 if d_j' = 0).
        for j in range(n):
            d = variances[j] + weight * c[j] ** 2
            reciprocal = reciprocal_or_one(d)
            s = jnp.where(is_positive(d), variances[j] * reciprocal, 1.0)
            g = weight * c[j] * reciprocal
            variances[j] = d
            for i in range(j + 1, n):
                e = flat_place[i, j]  # of L_ij among the entries
                lower[e], c[i] = s * lower[e] + g * c[i], c[i] - c[j] * lower[e]
            weight = weight * s
        return (jnp.asarray(lower, dtype), jnp.asarray(variances, dtype)), None

    start = below_diagonal(jnp.asarray(factors.matrix)).astype(dtype), jnp.asarray(factors.weights).astype(dtype)
    (lower, variances), _ = lax.scan(absorb, start, (jnp.asarray(columns.matrix).T, jnp.asarray(columns.weights)))
    return WeightedColumns(unit_lower(lower), variances)


def eliminate(covariance: jax.Array, least: float = 0.0) -> WeightedColumns:
    """Factor P = L diag(d) L' by elimination: n^3 / 6 products, n reciprocals.

    Rounding may make a pivot d_j negative, so each pivot is raised to at least `least` times |P_jj|.
    """
    least_pivots = least * lax.abs(diagonal(covariance))
    if len(covariance) <= WRITTEN:
        return _eliminate_column_by_column(covariance, least_pivots)
    # What is to be differentiated is another program of the loop, which an operation would not know.
    factor = _eliminate_in_loop if writes_for_derivatives() else _eliminate_by_loop
    return factor(covariance, least_pivots)


def _eliminate_column_by_column(covariance: jax.Array, least: jax.Array) -> WeightedColumns:
    """Return L and d with L diag(d) L' = P, by elimination without square roots, no d below `least` (n,)."""
    n, remainder, lower, variances = len(covariance), covariance, [], []
    for j in range(n):
        column = lax.index_in_dim(remainder, j, axis=1, keepdims=False)
        d, column, reciprocal = take_pivot(column, j, least, covariance)
        variances.append(d)
        multiples = column_below_diagonal(j, outer(column, lax.reshape(reciprocal, (1,))))  # column j of L
        remainder = symmetric(remainder - outer(multiples, column))
        lower.append(multiples)
    return assemble_factors(lower, variances, covariance.dtype)


def decorrelate(lower: jax.Array, rows: jax.Array) -> jax.Array:
    """Return L^-1 times rows (m, ...), by substitution, of a unit lower triangular L.

    Of z = rows x + n with Cov n = L diag(d) L' these are the rows of L^-1 z, of uncorrelated noises.
    """
    solved_rows: list[jax.Array] = []
    for i in range(len(rows)):
        rows_above = jnp.stack(solved_rows) if solved_rows else jnp.zeros((0, rows.shape[1]))
        solved_rows.append(rows[i] - lower[i, :i] @ rows_above)
    return jnp.stack(solved_rows) if solved_rows else rows


def find_covariance_root(covariance: np.ndarray) -> np.ndarray:
    """Return a root W (n, rank) of a known covariance P = W W', by Cholesky's method with pivots.

    Components are in units of their deviations. The next pivot is the largest variance of P less the w_j w_j' so far.

    Source: Higham, Analysis of the Cholesky decomposition of a semi-definite matrix (1990).
    """
    deviation = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = np.where(deviation > 0, deviation, 1.0)
    remainder, columns = covariance / np.outer(unit, unit), []
    for _ in range(len(covariance)):
        j = int(np.argmax(np.diagonal(remainder)))
        if remainder[j, j] <= RANK:
            break
        columns.append(remainder[:, j] / np.sqrt(remainder[j, j]))
        remainder = remainder - np.outer(columns[-1], columns[-1])
        remainder[j] = remainder[:, j] = 0.0
    root = np.array(columns).T.reshape(len(covariance), -1)
    return unit[:, None] * np.where(np.abs(root) > RANK, root, 0.0)


def factor_known_covariance(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return L's entries below the diagonal and d of a known P = L diag(d) L', by orthogonal rows of its root.

    Row j loses its projections on the rows above it, and d_j is then its squared length: Gram-Schmidt.
    """
    rows = find_covariance_root(covariance)
    n, lower, variances = len(rows), np.zeros_like(covariance), np.zeros(len(rows))
    for j in range(n):
        variances[j] = rows[j] @ rows[j]
        lower[j + 1 :, j] = rows[j + 1 :] @ rows[j] / (variances[j] or 1.0)
        rows[j + 1 :] -= np.outer(lower[j + 1 :, j], rows[j])
    return lower[np.tril_indices(n, -1)], variances


def columns_of(covariance: Array) -> WeightedColumns:
    """Return columns W and weights w of a covariance P = W diag(w) W' (n, n).

    Of a NumPy array, whose numbers are known, there are as many columns as its rank; of a traced one n, by elimination.
    """
    if isinstance(covariance, np.ndarray):
        root = find_covariance_root(covariance)
        return WeightedColumns(root, np.ones(root.shape[1]))
    return eliminate(jnp.asarray(covariance))


def columns_with_derivatives(covariance: Array) -> WeightedColumns:
    """Return `columns_of` a covariance; of a traced one with its derivatives, also where it is zero or singular."""
    with write_for_derivatives():
        return columns_of(covariance)


def factor_covariances(covariances: Array) -> WeightedColumns:
    """Return the columns W (count, n, n) and weights w (count, n) of covariances P = W diag(w) W' (count, n, n).

    NumPy covariances are known: their columns are roots of weight 1, with columns of zeros where the rank is below n.
    All others are factored by elimination.
    """
    if not isinstance(covariances, np.ndarray):
        eliminated: WeightedColumns = jax.vmap(eliminate)(covariances)
        return eliminated
    n = covariances.shape[-1]
    all_covariances = list(covariances.reshape(-1, n, n))
    # Most steps of a long horizon have the same covariance, which is factored once.
    distinct = {covariance.tobytes(): covariance for covariance in all_covariances}
    roots = {numbers: find_covariance_root(covariance) for numbers, covariance in distinct.items()}
    padded = {numbers: np.pad(root, ((0, 0), (0, n - root.shape[1]))) for numbers, root in roots.items()}
    matrices = [padded[covariance.tobytes()] for covariance in all_covariances]
    return WeightedColumns(np.reshape(matrices, covariances.shape), np.ones(covariances.shape[:-1]))


def rounding_of(second_moments: Array) -> WeightedColumns:
    """Return the covariance (n, n) of the rounding of numbers s_i: diagonal, (ROUNDING_UNITS eps)^2 E[s_i^2].

    A filter adds the rounding of the state to Q, and that of a measurement to R. It stays in columns of its own, since
    it is so small that the sum with a variance would lose it.

    Args:
        second_moments: E[s_i^2] (n,). No variance is above LARGEST, so that all stay finite.
    """
    variances = (ROUNDING_UNITS * unit_of(second_moments)) ** 2 * second_moments
    return WeightedColumns(np.eye(len(second_moments)), library(second_moments).minimum(variances, LARGEST))


def rounding_of_variances(variances: Array, products: int) -> Array:
    """Return the rounding of variances that are sums of `products` products: ROUNDING_UNITS products eps of each."""
    return ROUNDING_UNITS * products * unit_of(variances) * variances


def noise_beside_repeated(sizes: Array) -> Array:
    """Return the noise variance eps s^2 for measured numbers of size s, so that one that repeats others has no gain.

    If earlier numbers determine s, its slopes after them are 0, but rounding leaves about eps s. Without a noise they
    would count as information. With this one, their square (eps s)^2 is eps times the noise, and so small is the gain.
    """
    return unit_of(sizes) * sizes**2


def column_below_diagonal(j: int, column: jax.Array) -> jax.Array:
    """Return column j of L - I, L unit lower triangular: the entries of `column` (n,) below row j, zeros elsewhere."""
    n = len(column)
    return lax.select(np.arange(n) > j, lax.reshape(column, (n,)), jnp.zeros(n, column.dtype))


def assemble_factors(lower: list[jax.Array], variances: list[jax.Array], dtype: np.dtype[Any]) -> WeightedColumns:
    """Return L and d, as a covariance L diag(d) L', from a list of the columns of L - I and one of the entries of d.

    A factorisation finds both one by one. The columns (n,) are 0 on and above the diagonal.
    """
    n = len(variances)
    if not n:
        return WeightedColumns(jnp.zeros((0, 0), dtype), jnp.zeros(0, dtype))
    below = lax.concatenate([lax.expand_dims(column, (1,)) for column in lower], dimension=1)
    d = lax.concatenate([lax.reshape(variance, (1,)) for variance in variances], dimension=0)
    return WeightedColumns(below + np.eye(n, dtype=dtype), d)


@operation(_triangularise_row_by_row)
def _triangularise_by_loop(columns: WeightedColumns) -> WeightedColumns:
    """Compute `triangularise` as a loop over the rows; natively row by row where known zeros leave little to compute.

    The noises of sixty links are their own columns each: of 12,000 numbers of W all but two hundred are known zeros.
    """
    rows, weights = jnp.asarray(columns.matrix), jnp.asarray(columns.weights)
    n = len(rows)

    def body(j: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Make the rows below row j orthogonal to it, in the columns' `weights`; put column j into L and d_j into d."""
        rows, lower, variances = carry
        weighted = weights * rows[j]
        d = rows[j] @ weighted
        multiples = jnp.where(np.arange(n) > j, rows @ weighted * reciprocal_or_one(d), 0.0)
        return rows - jnp.outer(multiples, rows[j]), *insert_column(j, lower, multiples, variances, d)

    start = rows, jnp.eye(n, dtype=rows.dtype), jnp.zeros(n, rows.dtype)
    _, lower, variances = lax.fori_loop(0, n, body, start)
    return WeightedColumns(lower, variances)


def _eliminate_in_loop(covariance: jax.Array, least: jax.Array) -> WeightedColumns:
    """Return L and d with L diag(d) L' = P, no d below `least` (n,), as a loop over the columns: a short program."""
    n = len(covariance)

    def body(j: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Subtract d_j L_j L_j' from the remainder of P; put column L_j into L, and d_j >= `least[j]` into d."""
        remainder, lower, variances = carry
        d, column, reciprocal = take_pivot(remainder[:, j], j, least, covariance)
        multiples = jnp.where(np.arange(n) > j, column * reciprocal, 0.0)
        return remainder - jnp.outer(multiples, column), *insert_column(j, lower, multiples, variances, d)

    start = covariance, jnp.eye(n, dtype=covariance.dtype), jnp.zeros(n, covariance.dtype)
    _, lower, variances = lax.fori_loop(0, n, body, start)
    return WeightedColumns(lower, variances)


_eliminate_by_loop = operation(_eliminate_column_by_column)(_eliminate_in_loop)


def insert_column(
    j: jax.Array, lower: jax.Array, column: jax.Array, variances: jax.Array, d: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return L (n, n) with `column` added to its column j, and `variances` (n,) with d in entry j.

    A step of a factorisation in a loop, where j is traced: column j of `lower` was that of the identity, and `column`
    (n,) is 0 on and above the diagonal.
    """
    is_j = np.arange(len(variances)) == j
    return jnp.where(is_j, lower + column[:, None], lower), jnp.where(is_j, d, variances)
