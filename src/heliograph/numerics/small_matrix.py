"""Arithmetic on batches of small matrices, written once for one matrix and for many.

The leading axes of an array are the matrix's own; any further axes (runs) are carried along elementwise, so the runs
are innermost in memory, a[i, j] is a contiguous vector over them, and loops over them vectorise. `runs_last` makes vmap
feed a kernel like that. Larger matrices go to the library.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.scipy.linalg import cho_solve

from heliograph.numerics.types import Array, PyTree

UNROLL_LIMIT = 8  # above this size the library factorisation is faster and compiles in less time
PIVOT_TOLERANCE = 1e-14  # relative to the largest diagonal entry: a pivot this small is zero up to rounding

P = ParamSpec("P")
R = TypeVar("R")


def runs_last(kernel: Callable[P, R]) -> Callable[P, R]:
    """Have vmap put its axis last in every argument and result of a kernel; derivatives are those of its arithmetic."""
    traced = jax.jit(kernel)  # once per shapes, however many filters use it
    batched = custom_vmap(lambda *args: jax.lax.platform_dependent(*args, cpu=_alone(traced), default=traced))

    @batched.def_vmap
    def rule(size: int, is_batched: PyTree, *args: PyTree) -> tuple[PyTree, PyTree]:
        moved = jax.tree.map(_to_last, args, tuple(is_batched))
        results = jax.tree.map(lambda x: _to_first(x, size), batched(*moved))
        return results, jax.tree.map(lambda _: True, results)

    differentiable = jax.custom_jvp(batched)
    differentiable.defjvp(lambda primals, tangents: jax.jvp(kernel, primals, tangents))
    return wraps(kernel)(differentiable)


def _alone(kernel: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """The kernel as the branch of a conditional that is always taken, since the compiler fuses nothing across it.

    Without it (barriers are dropped for processors) a covariance is computed again inside each of its uses. The
    condition hangs on the data, or the compiler would see through it: a number's bits with the last one set are not 0.
    """

    def call(*args: PyTree) -> PyTree:
        number = next(leaf for leaf in jax.tree.leaves(args) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating))
        taken = jnp.any((jnp.ravel(number)[:1].view(jnp.uint32) | 1) != 0)
        shapes = jax.eval_shape(kernel, *args)
        return jax.lax.cond(
            taken, kernel, lambda *_: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), *args
        )

    return call


def _to_last(x: Array, is_batched: bool) -> jax.Array:
    return jnp.moveaxis(x, 0, -1) if is_batched else jnp.asarray(x)[..., None]


def _to_first(x: jax.Array, size: int) -> jax.Array:
    return jnp.moveaxis(jnp.broadcast_to(x, (*x.shape[:-1], size)), -1, 0)


def transpose(a: Array) -> jax.Array:
    """A', (n, m, ...)."""
    return jnp.swapaxes(a, 0, 1)


def symmetric(a: jax.Array) -> jax.Array:
    """(A + A') / 2."""
    return (a + transpose(a)) / 2


def add(terms: Sequence[Array]) -> jax.Array:
    """Sum of terms one by one: a library reduction over a short axis costs more than all its additions."""
    return jnp.asarray(sum(terms[1:], terms[0]))


def times(a: Array, b: jax.Array) -> jax.Array:
    """A B, as a sum of columns of A times rows of B."""
    inner = b.shape[0]
    if not 0 < inner <= 2 * UNROLL_LIMIT:  # twice: cubature has two points for each state
        return jnp.einsum("ij...,jk...->ik...", a, b)
    columns, rows = jnp.split(a, inner, axis=1), jnp.split(b, inner)
    return add([column * row for column, row in zip(columns, rows, strict=True)])


def times_vector(a: Array, x: jax.Array) -> jax.Array:
    """A x."""
    return times(a, x[:, None])[:, 0]


def congruence(a: Array, p: jax.Array) -> jax.Array:
    """A P A'."""
    return times(times(a, p), transpose(a))


def inner(a: jax.Array, b: jax.Array) -> jax.Array:
    """tr(A' B)."""
    products = a * b
    return add(jnp.split(products.reshape(-1, *products.shape[2:]), products.shape[0] * products.shape[1]))[0]


def trace(a: jax.Array) -> jax.Array:
    """tr A."""
    return add([a[i, i] for i in range(a.shape[0])])


def diagonal(d: jax.Array) -> jax.Array:
    """diag(d)."""
    n = d.shape[0]
    return d[None] * jnp.eye(n).reshape(n, n, *[1] * (d.ndim - 1))


def rounding(tolerance: float, like: jax.Array, units: int = 10) -> float:
    """A relative tolerance, or so many units of an array's rounding where its precision does not allow that."""
    return max(tolerance, units * float(np.finfo(like.dtype).eps))


def factor(a: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
    """Columns of the lower factor, (n, ...) each, and the reciprocals of its diagonal (zero for a zero column).

    Column by column: what is left of a column after those before it, times the reciprocal root of its pivot.
    """
    n = a.shape[0]
    tolerance = rounding(PIVOT_TOLERANCE, a) * jnp.max(jnp.abs(jnp.stack([a[i, i] for i in range(n)])), axis=0)
    columns: list[jax.Array] = []
    scales: list[jax.Array] = []
    for j in range(n):
        rest = add([a[j:, j], *(-c[j:] * c[j] for c in columns)])
        scales.append(pivot_scale(rest[0], tolerance))
        columns.append(jnp.concatenate([jnp.zeros_like(a[:j, j]), rest * scales[j]]))
    return columns, scales


def pivot_scale(pivot: jax.Array, tolerance: jax.Array) -> jax.Array:
    """1 / root of a pivot; 0 for one that is zero up to rounding, NaN for a negative one.

    The root is taken of a positive number in any case, so that what a zero pivot leaves out has the derivative 0.
    """
    positive = pivot > tolerance
    scale = 1 / jnp.sqrt(jnp.where(positive, pivot, 1.0))
    return jnp.where(positive, scale, jnp.where(jnp.abs(pivot) <= tolerance, 0.0, jnp.nan))


def solve(a: jax.Array, b: jax.Array) -> jax.Array:
    """X with A X = B for a positive definite A; NaN for any other."""
    n = a.shape[0]
    if n > UNROLL_LIMIT:
        return _each(lambda a, b: jnp.asarray(cho_solve((jnp.linalg.cholesky(a), True), b)), a, b)
    columns, scales = factor(a)
    scales = [jnp.where(s == 0, jnp.nan, s) for s in scales]
    forward: list[jax.Array] = []
    for i in range(n):  # L Y = B
        forward.append(add([b[i], *(-columns[j][i] * forward[j] for j in range(i))]) * scales[i])
    backward = forward[:]
    for i in reversed(range(n)):  # L' X = Y
        backward[i] = add([forward[i], *(-columns[i][j] * backward[j] for j in range(i + 1, n))]) * scales[i]
    return jnp.stack(backward)


def squared_distance(a: jax.Array, x: jax.Array) -> jax.Array:
    """x' A^-1 x = |L^-1 x|^2 for a positive definite A = L L'; NaN for any other."""
    n = a.shape[0]
    if n > UNROLL_LIMIT:
        return add(list(x * solve(a, x[:, None])[:, 0]))
    columns, scales = factor(a)
    forward: list[jax.Array] = []
    for i in range(n):  # L y = x
        scale = jnp.where(scales[i] == 0, jnp.nan, scales[i])
        forward.append(add([x[i], *(-columns[j][i] * forward[j] for j in range(i))]) * scale)
    return add([y * y for y in forward])


def _each(function: Callable[..., jax.Array], a: jax.Array, b: jax.Array) -> jax.Array:
    """A function of two single matrices, for each of the further axes."""
    shape = jnp.broadcast_shapes(a.shape[2:], b.shape[2:])
    a, b = (jnp.broadcast_to(x, (*x.shape[:2], *shape)) for x in (a, b))
    for _ in shape:
        function = jax.vmap(function, in_axes=-1, out_axes=-1)
    return function(a, b)


def contract(tensor: Array, matrix: jax.Array) -> jax.Array:
    """sum_ab T_ijab W_ab."""
    n = matrix.shape[0]
    if n > UNROLL_LIMIT // 2:
        return jnp.einsum("ijab...,ab...->ij...", tensor, matrix)
    flat = jnp.asarray(tensor).reshape(*tensor.shape[:2], n * n, *tensor.shape[4:])
    parts = zip(jnp.split(flat, n * n, axis=2), jnp.split(matrix.reshape(n * n, *matrix.shape[2:]), n * n), strict=True)
    return add([part[:, :, 0] * weight for part, weight in parts])
