"""Small symmetric matrices that may be singular: factors, solves and distances.

What is written out row by row is compiled by `jax.jit`, so that it is traced once for equal shapes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.numerics.types import Array, Float

WRITTEN = 24  # rows that are written out one after another; more are a loop
PIVOT_TOLERANCE = 1e-14  # of a component's own variance: what is left of it, given those before it, is zero
NEGATIVE_TOLERANCE = 1e-10  # of the same: a pivot this far below zero is rounding of a singular matrix
# How far a component that others determine may be from what they say: OFF_SUPPORT deviations and OFF_VALUE of its size.
OFF_SUPPORT, OFF_VALUE = 1e-6, 1e-9
KNOWN = 16  # a component whose deviation is at most so many roundings of its size is known


def symmetric(a: jax.Array) -> jax.Array:
    """Return a matrix that is symmetric up to rounding as an exactly symmetric one, by mirroring its upper triangle.

    Native code then does not compute the lower triangle.
    """
    return lax.select(np.triu(np.ones(a.shape, bool)), a, lax.transpose(a, (1, 0)))


def diagonal(a: Array) -> jax.Array:
    """Return the diagonal (n,) of a matrix: one strided slice, which JAX traces in a tenth of `jnp.diagonal`."""
    n = len(a)
    return lax.slice(lax.reshape(a, (n * n,)), (0,), (n * n,), (n + 1,))


def symmetrize(a: Float[jax.Array, "... n n"]) -> Float[jax.Array, "... n n"]:
    """Return the symmetric part (A + A') / 2 of matrices (..., n, n)."""
    return jnp.asarray((a + jnp.swapaxes(a, -1, -2)) / 2)


def outer(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return a b' of two vectors as a matrix product, in which native code knows that 0 times any entry is zero."""
    return lax.dot(lax.expand_dims(a, (1,)), lax.expand_dims(b, (0,)))


def scale(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the products a_i b_i of two vectors, in which an entry known to be zero stays known to be zero.

    They are written as matrix products of one number each: native code leaves out a known zero's term there, while it
    computes 0 x in an elementwise product, since x may be NaN.
    """
    return lax.dot_general(a, b, (((), ()), ((0,), (0,))))


def where(condition: Array, a: Array | float, b: Array | float) -> jax.Array:
    """Return a where the condition holds, else b: `jnp.where` as operations that JAX traces in a tenth of its time.

    `jnp.where` is a function that JAX traces anew for each shape. As there, shapes are broadcast and types promoted.
    """
    shape = np.broadcast_shapes(np.shape(condition), np.shape(a), np.shape(b))
    dtype = jnp.result_type(a, b)

    def broadcast(x: Array | float, dtype: np.dtype[Any]) -> Array:
        """Return x as an array of this type, broadcast to the common shape by one operation of JAX, if any."""
        if np.shape(x) == shape and isinstance(x, jax.Array | np.ndarray) and x.dtype == dtype:
            return x
        known = np.asarray(x, dtype) if not isinstance(x, jax.Array) else lax.convert_element_type(x, dtype)
        return lax.broadcast_in_dim(known, shape, range(len(shape) - known.ndim, len(shape)))

    return lax.select(broadcast(condition, np.dtype(bool)), broadcast(a, dtype), broadcast(b, dtype))


def contract(tensor: Array, matrix: Array) -> jax.Array:
    """Return the matrix of entries sum_ab T_ijab W_ab, of a tensor T (m, m, n, n) and a matrix W (n, n)."""
    return jnp.einsum("ijab,ab->ij", tensor, matrix)


def rounding(tolerance: float, like: jax.Array | np.ndarray, units: int = 10) -> float:
    """Return a relative tolerance, or if that is larger `units` times eps, the rounding of the array `like`."""
    return max(tolerance, units * float(np.finfo(like.dtype).eps))


@jax.jit
def factor(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return lower L (n, n) with A = L L' of a positive semidefinite A, and the reciprocals (n,) of its diagonal.

    Column j of L is the first column of the Schur complement A - sum_{k < j} L_k L_k', times the reciprocal root of its
    pivot, or 0 for a zero column. A pivot is judged relative to the component's own diagonal entry, so that units do
    not decide what is singular. More than WRITTEN columns are computed in a loop, so that the program stays short.
    """
    n, remainder, columns, scales = len(a), a, list[jax.Array](), list[jax.Array]()
    if not 0 < n <= WRITTEN:
        return _factor_in_loop(a)
    growth = jnp.zeros((), a.dtype)  # the largest ratio so far of a diagonal entry of A to its pivot
    for j in range(n):
        scales.append(compute_pivot_reciprocal_root(remainder[0, 0], a[j, j], growth))
        growth = jnp.maximum(growth, a[j, j] * scales[j] * scales[j])
        column = remainder[:, 0] * scales[j]
        columns.append(jnp.concatenate([jnp.zeros(j, a.dtype), column]))
        # The Schur complement of the pivot.
        remainder = remainder[1:, 1:] - outer(column[1:], column[1:])
    return jnp.stack(columns, axis=1), jnp.stack(scales)


def _factor_in_loop(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return what `factor` does, L (n, n) with A = L L' and the reciprocals (n,) of its diagonal, by a loop.

    It is for matrices of many rows, of which a program written out column by column would be long.
    """
    n, whole = len(a), diagonal(a)

    def eliminate(j: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Compute column j of the factor and its scale, and subtract L_j L_j' from the remaining matrix.

        `whole` is the matrix's diagonal, by which a pivot is judged. A scale is the reciprocal root of a pivot.
        `growth` is the largest ratio so far of an entry of `whole` to its pivot.
        """
        remainder, lower, scales, growth = carry
        scale = compute_pivot_reciprocal_root(remainder[j, j], whole[j], growth)
        column = jnp.where(np.arange(n) >= j, remainder[:, j] * scale, 0.0)
        growth = jnp.maximum(growth, whole[j] * scale * scale)
        is_column_j = np.arange(n) == j
        lower, scales = jnp.where(is_column_j, column[:, None], lower), jnp.where(is_column_j, scale, scales)
        return remainder - outer(column, column), lower, scales, growth

    start = a, jnp.zeros_like(a), jnp.zeros_like(whole), jnp.zeros((), a.dtype)
    _, lower, scales, _ = lax.fori_loop(0, n, eliminate, start) if n else start
    return lower, scales


def compute_pivot_reciprocal_root(pivot: jax.Array, whole: jax.Array, growth: jax.Array) -> jax.Array:
    """Return 1 / sqrt(pivot); it is 0 for a pivot that is zero up to rounding, and NaN for a negative one.

    `whole` is the matrix's diagonal entry from which the pivot was computed, by subtracting squares. `growth` is the
    largest ratio so far of a diagonal entry to its pivot: dividing by such a pivot multiplies rounding errors by this
    ratio, so that rounding may make a later pivot negative by as much. For a zero pivot the root is taken of infinity,
    which makes its derivative 0.
    """
    is_zero_or_more = pivot >= -negative_tolerance(pivot, growth) * whole
    if_not_positive = jnp.where(is_zero_or_more, jnp.inf, jnp.nan)
    is_positive = pivot > rounding(PIVOT_TOLERANCE, pivot) * whole
    return 1 / jnp.sqrt(jnp.where(is_positive, pivot, if_not_positive))


def negative_tolerance(like: jax.Array, growth: jax.Array) -> jax.Array:
    """Return how far below zero a pivot may be by rounding, as a share of its diagonal entry, in a singular matrix.

    `like` has the precision; `growth` is the largest ratio so far of a diagonal entry to its pivot, by which rounding
    errors are multiplied.
    """
    eps = float(np.finfo(like.dtype).eps)
    return jnp.maximum(rounding(NEGATIVE_TOLERANCE, like, 1000), 10 * eps * growth)


def cholesky(a: Float[Array, "n n"]) -> Float[jax.Array, "n n"]:
    """Return the lower factor L of a positive semidefinite matrix, A = L L'.

    A pivot that is zero to rounding of its own diagonal entry gives a zero column, so a singular covariance (a
    component known exactly) has its factor whatever the units; a negative pivot gives NaN, which the driver reports
    with its step. Nothing is repaired.

    Shapes: (n, n) -> (n, n).
    """
    return jnp.asarray(factor(jnp.asarray(a))[0])


def psd_solve(a: Float[Array, "n n"], b: Float[Array, "n k"]) -> Float[jax.Array, "n k"]:
    """Solve A X = B for a positive semidefinite A and B in its range.

    If row i of A depends on those above it, row i of X is chosen as 0. Every solution has the same B' X = B' A^+ B. An
    indefinite A gives NaN.

    Shapes: (n, n), (n, k) -> (n, k).
    """
    return solver(a)(b)


def solver(a: Float[Array, "n n"]) -> Callable[[Array], jax.Array]:
    """Return the function B -> X that solves A X = B for one positive semidefinite A, factored once for many B.

    It is for B (n, k) in the range of A, as `psd_solve` says.
    """
    lower, scales = factor(jnp.asarray(a))

    def solve(b: Array) -> jax.Array:
        """Return X of A X = B with A = L L'; `scales` are the reciprocals of L's diagonal, 0 for a pivot of zero."""
        # Solve L Y = B, then L' X = Y. With rows and columns in reverse order, the upper L' becomes lower, and Y and X
        # are upside down.
        y = _substitute(lower, scales, jnp.asarray(b)) * scales[:, None]
        reversed_numerators = _substitute(lower.T[::-1, ::-1], scales[::-1], y[::-1])
        return jnp.asarray(reversed_numerators[::-1] * scales[:, None])

    return solve


@jax.jit
def _substitute(lower: jax.Array, scales: jax.Array, b: jax.Array) -> jax.Array:
    """Return the numerators B_i - sum_{j < i} L_ij Y_j of the solution Y of L Y = B (n, k), by forward substitution.

    Y_i is numerator i times `scales`, the reciprocals of L's diagonal (n,). Above WRITTEN rows it is a loop.
    """
    n, remainder, numerators = len(b), b, list[jax.Array]()

    def take_off(j: jax.Array, rows: jax.Array) -> jax.Array:
        """Subtract L_ij Y_j from each row i below row j, with Y_j = `rows[j] * scales[j]`."""
        is_below = (np.arange(n) > j)[:, None]
        return jnp.where(is_below, rows - outer(lower[:, j], rows[j] * scales[j]), rows)

    if not 0 < n <= WRITTEN:
        return jnp.asarray(lax.fori_loop(0, n, take_off, b) if n else b)
    for j in range(n):
        numerators.append(remainder[0])
        remainder = remainder[1:] - outer(lower[j + 1 :, j], remainder[0] * scales[j])
    return jnp.stack(numerators)


def squared_distance(a: jax.Array, x: jax.Array, size: Array | float = 0.0) -> jax.Array:
    """Return x' A^-1 x = |L^-1 x|^2 for a positive semidefinite A = L L'; NaN for an indefinite one.

    Each component of x adds its squared difference from what the components before it predict, over the variance of
    that. If the components before it determine it, or it is known up to rounding, this is 0 / 0: it adds 1, the mean of
    any other component's square, if it agrees with the prediction, and infinity if not. `size` (n,) is the size of the
    numbers whose difference x is, which decides the rounding.
    """
    return jnp.sum(squared_distance_terms(a, x, size, KNOWN)[0])


def squared_distance_terms(
    a: jax.Array, x: jax.Array, size: Array | float = 0.0, roundings: float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """Return the terms (n,) of x' A^-1 x, of each component given earlier ones, and which of them these determine.

    A is x's covariance. A determined component counts 1 if it agrees with the earlier ones, and infinity if not. It
    also counts as determined if its standard deviation is at most `roundings` roundings of `size`, the size of the
    numbers whose difference x is.
    """
    variance = diagonal(a)
    # Up to this a determined component agrees: shares of its deviation and of the size of the subtracted numbers.
    agreement = OFF_SUPPORT * jnp.sqrt(jnp.maximum(variance, 0.0)) + OFF_VALUE * jnp.abs(size)
    lower, scales = factor(a)
    unexplained = _substitute(lower, scales, x[:, None])[:, 0]  # of each component, by those before it
    determined = scales == 0  # `factor` gives 0 for a pivot that is zero
    if roundings:
        variance_of_rounding = (roundings * float(np.finfo(a.dtype).eps) * jnp.asarray(size)) ** 2
        determined |= (variance >= 0) & (variance <= variance_of_rounding)
    if_determined = jnp.where(jnp.abs(unexplained) <= agreement, 1.0, jnp.inf)
    return jnp.where(determined, if_determined, (unexplained * scales) ** 2), determined


def whiten(a: jax.Array, x: jax.Array) -> jax.Array:
    """Return L^-1 x for a positive semidefinite A = L L'; NaN for a component that those before it determine."""
    lower, scales = factor(a)
    return jnp.where(scales == 0, jnp.nan, _substitute(lower, scales, x[:, None])[:, 0] * scales)


def find_not_finite(values: np.ndarray, axes: int) -> np.ndarray:
    """Return which arrays, along the last `axes` axes, have a number that is not finite.

    If all numbers are finite, so is their sum, which takes a third of the time to check. Each number is looked at only
    if the sum is not finite, since it may also have overflowed.
    """
    with np.errstate(all="ignore"):
        if np.isfinite(np.sum(values)):
            return np.zeros(values.shape[: values.ndim - axes], dtype=bool)
    last_axes = tuple(range(-axes, 0))
    not_finite: np.ndarray = ~np.isfinite(values).all(axis=last_axes)
    return not_finite
