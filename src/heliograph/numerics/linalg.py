"""Small symmetric matrices: products, factors and solves, fast for batches of runs."""

from collections.abc import Callable, Sequence
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import solve_triangular

from heliograph.numerics.over_runs import runs_last, runs_last_of
from heliograph.numerics.types import Array, Float

UNROLL_LIMIT = 8  # above this size XLA compiles a loop over columns in less time; native code is written out always
PIVOT_TOLERANCE = 1e-14  # of a component's own variance: what is left of it, given those before it, is zero
NEGATIVE_TOLERANCE = 1e-10  # of the same: a pivot this far below zero is rounding of a singular matrix
OFF_SUPPORT = 1e-6  # standard deviations, and
KNOWN = 16  # roundings of its size: a deviation of no more says that a component is known
OFF_VALUE = 1e-9  # of its size: how far a component that the others determine may be from what they say


def transpose(a: Array) -> jax.Array:
    """A', (n, m, ...)."""
    return jnp.swapaxes(a, 0, 1)


def symmetric(a: jax.Array) -> jax.Array:
    """A symmetric matrix from what is symmetric but for rounding: its upper triangle, mirrored.

    Native code does not compute the lower one.
    """
    n = len(a)
    upper = np.triu(np.ones((n, n), bool)).reshape(n, n, *[1] * (a.ndim - 2))
    return jnp.where(upper, a, transpose(a))


def add(terms: Sequence[Array]) -> jax.Array:
    """Sum of terms one by one: a library reduction over a short axis costs more than all its additions."""
    return jnp.asarray(sum(terms[1:], terms[0]))


def summed(a: jax.Array, axis: int) -> jax.Array:
    """Sum over a short axis, one by one."""
    return jnp.asarray(lax.squeeze(reduce(lax.add, lax.split(a, (1,) * a.shape[axis], axis)), (axis,)))


def times(a: Array, b: jax.Array) -> jax.Array:
    """A B; of many runs as a sum of columns of A times rows of B."""
    if np.ndim(a) == b.ndim == 2:
        return jnp.asarray(a) @ b
    inner = b.shape[0]
    if not 0 < inner <= 2 * UNROLL_LIMIT:  # twice: cubature has two points for each state
        return jnp.einsum("ij...,jk...->ik...", a, b)
    columns, rows = lax.split(a, (1,) * inner, 1), lax.split(b, (1,) * inner)
    return add([column * row for column, row in zip(columns, rows, strict=True)])


def times_vector(a: Array, x: jax.Array) -> jax.Array:
    """A x."""
    return jnp.asarray(lax.squeeze(times(a, lax.expand_dims(x, (1,))), (1,)))


def congruence(a: Array, p: jax.Array) -> jax.Array:
    """A P A' for a symmetric P."""
    return symmetric(times(times(a, p), transpose(a)))


def inner(a: jax.Array, b: jax.Array) -> jax.Array:
    """tr(A' B)."""
    products = a * b
    return summed(products.reshape(-1, *products.shape[2:]), 0)


def trace(a: jax.Array) -> jax.Array:
    """tr A."""
    return summed(diagonal_of(a), 0)


def diagonal_of(a: jax.Array) -> jax.Array:
    """The diagonal of A, (n, ...): each component's own entry."""
    n = a.shape[0]
    return lax.slice_in_dim(a.reshape(n * n, *a.shape[2:]), 0, n * n, n + 1)


def identity(n: int, like: jax.Array) -> np.ndarray:
    """I (n, n, 1, ...) of as many axes and of the precision of another array."""
    return np.eye(n, dtype=like.dtype).reshape(n, n, *[1] * (like.ndim - 2))


def diagonal(d: jax.Array) -> jax.Array:
    """diag(d)."""
    return jnp.where(identity(d.shape[0], d[None]) == 1, d[None], 0.0)


def rounding(tolerance: float, like: jax.Array | np.ndarray, units: int = 10) -> float:
    """A relative tolerance, or so many units of an array's rounding where its precision does not allow that."""
    return max(tolerance, units * float(np.finfo(like.dtype).eps))


def factor(a: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
    """Columns of the lower factor from the diagonal down, (n - j, ...), and the reciprocals of its diagonal.

    Column by column: the first column of what is left of A, times the reciprocal root of its pivot; of a zero column
    that is 0. A pivot is judged by the component's own diagonal entry: units do not decide what is singular.
    """
    columns: list[jax.Array] = []
    scales: list[jax.Array] = []
    growth: jax.Array | float = 0.0
    left = a
    for j in range(len(a)):
        scale = pivot_scale(left[0, 0], a[j, j], growth)
        growth = jnp.maximum(growth, a[j, j] * scale * scale)
        column = left[:, 0] * scale
        # The Schur complement of the pivot.
        left = left[1:, 1:] - column[1:, None] * column[1:]
        columns.append(column)
        scales.append(scale)
    return columns, scales


def lower_factor(columns: list[jax.Array]) -> jax.Array:
    """Lower matrix of the columns that `factor` returns."""
    above = [jnp.zeros((j, *c.shape[1:]), c.dtype) for j, c in enumerate(columns)]
    return jnp.stack([jnp.concatenate(column) for column in zip(above, columns, strict=True)], axis=1)


def pivot_scale(pivot: jax.Array, whole: jax.Array, growth: jax.Array | float) -> jax.Array:
    """1 / root of a pivot; 0 for one that is zero up to rounding of the whole diagonal entry, NaN for a negative one.

    `growth`: the largest ratio of a diagonal entry to its pivot before; dividing by such a pivot multiplies by it what
    rounding makes of this one. The root is taken of a positive number in any case, of infinity where nothing is left:
    the derivative there is 0.
    """
    singular = pivot >= -negative_tolerance(pivot, growth) * whole
    beyond = jnp.where(singular, jnp.inf, jnp.nan)
    return 1 / jnp.sqrt(jnp.where(pivot > rounding(PIVOT_TOLERANCE, pivot) * whole, pivot, beyond))


def negative_tolerance(like: jax.Array, growth: jax.Array | float) -> jax.Array:
    """Return the share of its diagonal entry by which a pivot below zero is rounding of a singular matrix."""
    eps = float(np.finfo(like.dtype).eps)
    return jnp.maximum(rounding(NEGATIVE_TOLERANCE, like, 1000), 10 * eps * growth)


def solve(a: jax.Array, b: jax.Array) -> jax.Array:
    """X with A X = B for a positive semidefinite A and B in its range; NaN for an indefinite A.

    A component that those before it determine gets zeros: B' X is B' A^+ B whatever is chosen there.
    """
    return solver(a)(b)


def solver(a: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """`solve` of one A for several B, one after another: it is factored once."""
    return partial(_long_solve, a) if len(a) > UNROLL_LIMIT else written_solver(a)


def written_solver(a: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """`solver` written out entry by entry, whatever the size."""
    columns, scales = factor(a)
    rows = lower_factor(columns)

    def solved(b: jax.Array) -> jax.Array:
        # L Y = B, then L' X = Y from the last row up.
        left = jnp.stack([rest * scale for rest, scale in zip(_forward(columns, scales, b), scales, strict=True)])
        x: list[jax.Array] = []
        for i, scale in reversed(list(enumerate(scales))):
            x.insert(0, left[i] * scale)
            left = left[:i] - _with_axes(rows[i, :i], left) * x[0]
        return jnp.stack(x)

    return solved


def long_factor(a: jax.Array) -> jax.Array:
    """The lower factor of one larger matrix by the same rule."""
    n, whole = a.shape[-1], jnp.diagonal(a)

    def eliminate(j: jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        a, done, growth = carry
        scale = pivot_scale(a[j, j], whole[j], growth)
        column = jnp.where(jnp.arange(n) >= j, a[:, j] * scale, 0.0)
        # a: the Schur complement of the pivot.
        return a - jnp.outer(column, column), done.at[:, j].set(column), jnp.maximum(growth, whole[j] * scale * scale)

    start = jnp.asarray(a), jnp.zeros_like(a), jnp.zeros_like(a[0, 0])
    return jnp.asarray(jax.lax.fori_loop(0, n, eliminate, start)[1])


@partial(runs_last, written=lambda a: lower_factor(factor(a)[0]), shapes=jnp.shape)
def _long_root(a: jax.Array) -> jax.Array:
    return _over_matrices(lambda a, _: long_factor(a), a, a)


@partial(runs_last, written=lambda a, b: written_solver(a)(b))
def _long_solve(a: jax.Array, b: jax.Array) -> jax.Array:
    return _over_matrices(_solve_by_loop, a, b)


def _solve_by_loop(a: jax.Array, b: jax.Array) -> jax.Array:
    lower = long_factor(a)
    none = jnp.diagonal(lower) == 0
    lower = lower + jnp.diag(none.astype(lower.dtype))
    forward = jnp.where(none[:, None], 0.0, solve_triangular(lower, b, lower=True))
    return jnp.asarray(solve_triangular(lower, forward, lower=True, trans=1))


def root(a: jax.Array) -> jax.Array:
    """R, lower, with R R' = A for a positive semidefinite A, a column of zeros where a component adds nothing."""
    return _long_root(a) if len(a) > UNROLL_LIMIT else lower_factor(factor(a)[0])


def squared_distance(a: jax.Array, x: jax.Array, size: Array | float = 0.0) -> jax.Array:
    """x' A^-1 x = |L^-1 x|^2 for a positive semidefinite A = L L'; NaN for an indefinite one.

    A component that those before it determine, or that is known to its rounding, counts 1, what is expected of it in
    the limit, where x says what they say, and is infinite where it does not; `size` (n,) is what x is a difference of,
    for its rounding.
    """
    return add(list(squared_distances(a, x, size, KNOWN)[0]))


def squared_distances(
    a: jax.Array, x: jax.Array, size: Array | float = 0.0, roundings: float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """The terms of `squared_distance`, each given those before it, and which of them these determine.

    `roundings` of its size: a component with no larger deviation counts as determined.
    """
    reach = OFF_SUPPORT * jnp.sqrt(jnp.maximum(diagonal_of(a), 0.0)) + OFF_VALUE * jnp.abs(size)
    known = jnp.broadcast_to((roundings * float(np.finfo(a.dtype).eps) * jnp.asarray(size)) ** 2, reach.shape)
    squares: list[jax.Array] = []
    determined: list[jax.Array] = []
    for i, (rest, scale) in enumerate(_substituted(a, x)):
        agrees = jnp.where(jnp.abs(rest) <= reach[i], 1.0, jnp.inf)
        none = scale == 0
        determined.append(none | ((a[i, i] >= 0) & (a[i, i] <= known[i])) if roundings else none)
        squares.append(jnp.where(determined[-1], agrees, (rest * scale) ** 2))
    return jnp.stack(squares), jnp.stack(determined)


def whiten(a: jax.Array, x: jax.Array) -> jax.Array:
    """L^-1 x for a positive semidefinite A = L L'; NaN for a component that those before it determine."""
    return jnp.stack([jnp.where(scale == 0, jnp.nan, rest * scale) for rest, scale in _substituted(a, x)])


def _reciprocals(a: jax.Array) -> jax.Array:
    """1 / a, and 0 for 0."""
    return jnp.where(a == 0, 0.0, 1 / jnp.where(a == 0, 1.0, a))


def _substituted(a: jax.Array, x: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
    """Return numerators x_i - sum_j L_ij y_j and reciprocals 1 / L_ii of forward substitution; y_i is their product."""
    if len(a) > UNROLL_LIMIT:
        whole = root(a)
        columns, scales = [whole[j:, j] for j in range(len(a))], list(_reciprocals(diagonal_of(whole)))
    else:
        columns, scales = factor(a)
    return list(zip(_forward(columns, scales, x), scales, strict=True))


def _forward(columns: list[jax.Array], scales: list[jax.Array], b: jax.Array) -> list[jax.Array]:
    """Numerators of L Y = B by the columns of L: each row of Y, once known, is taken off the rows below it."""
    rests: list[jax.Array] = []
    left = b.reshape(b.shape + (1,) * (columns[0].ndim - b.ndim))
    for column, scale in zip(columns, scales, strict=True):
        rests.append(left[0])
        left = left[1:] - _with_axes(column[1:], left) * (left[0] * scale)
    return rests


def _with_axes(entries: jax.Array, matrix: jax.Array) -> jax.Array:
    """A column's entries (n, ...) with axes for the columns of a matrix (n, k, ...)."""
    return jnp.expand_dims(entries, tuple(range(1, 1 + matrix.ndim - entries.ndim)))


def _over_matrices(function: Callable[..., jax.Array], a: jax.Array, b: jax.Array) -> jax.Array:
    """A function of two single matrices, for each of the further axes."""
    shape = jnp.broadcast_shapes(a.shape[2:], b.shape[2:])
    a, b = (jnp.broadcast_to(x, (*x.shape[:2], *shape)) for x in (a, b))
    for _ in shape:
        function = jax.vmap(function, in_axes=-1, out_axes=-1)
    return function(a, b)


def contract(tensor: Array, matrix: jax.Array) -> jax.Array:
    """sum_ab T_ijab W_ab."""
    n = matrix.shape[0]
    if matrix.ndim == 2 or n > UNROLL_LIMIT // 2:
        return jnp.einsum("ijab...,ab...->ij...", tensor, matrix)
    flat = jnp.asarray(tensor).reshape(*tensor.shape[:2], n * n, *tensor.shape[4:])
    return summed(flat * matrix.reshape(n * n, *matrix.shape[2:]), 2)


def symmetrize(a: Float[jax.Array, "... n n"]) -> Float[jax.Array, "... n n"]:
    """Return (A + A') / 2."""
    return jnp.asarray((a + jnp.swapaxes(a, -1, -2)) / 2)


def cholesky(a: Float[jax.Array, "n n"]) -> Float[jax.Array, "n n"]:
    """Lower factor L of a positive semidefinite matrix, A = L L'.

    A pivot that is zero to rounding of its own diagonal entry gives a zero column, so a singular covariance (a
    component known exactly) has its factor whatever the units; a negative pivot gives NaN, which the driver reports
    with its step. Nothing is repaired.

    Shapes: (n, n) -> (n, n).
    """
    return (_long_root if len(a) > UNROLL_LIMIT else _short_cholesky)(jnp.asarray(a))


_short_cholesky = runs_last_of(jnp.shape)(lambda a: lower_factor(factor(a)[0]))


def psd_solve(a: Float[jax.Array, "n n"], b: Float[jax.Array, "n k"]) -> Float[jax.Array, "n k"]:
    """Solve A X = B for a positive semidefinite A and B in its range.

    Of a component that those before it determine, X is zero. An indefinite A gives NaN.

    Shapes: (n, n), (n, k) -> (n, k).
    """
    return _solve(jnp.asarray(a), jnp.asarray(b))


_solve = runs_last(solve)
