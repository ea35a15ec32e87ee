"""Small symmetric matrices: products, factors and solves, fast for batches of runs."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heliograph.numerics.small_matrix import (
    PIVOT_TOLERANCE,
    UNROLL_LIMIT,
    factor,
    pivot_scale,
    rounding,
    runs_last,
    solve,
)


def symmetrize(a: Float[Array, "... n n"]) -> Float[Array, "... n n"]:
    """Return (A + A') / 2."""
    return jnp.asarray((a + jnp.swapaxes(a, -1, -2)) / 2)


def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower factor L of a positive semidefinite matrix, A = L L'.

    A zero pivot (to rounding) gives a zero column, so a singular covariance (a component known exactly) has its
    factor; a negative pivot gives NaN, which the driver reports with its step. Nothing is repaired.

    Shapes: (n, n) -> (n, n).
    """
    return _long_cholesky(a) if a.shape[-1] > UNROLL_LIMIT else _short_cholesky(jnp.asarray(a))


@runs_last
def _short_cholesky(a: jax.Array) -> jax.Array:
    return jnp.stack(factor(a)[0], axis=1)


def _long_cholesky(a: jax.Array) -> jax.Array:
    n = a.shape[-1]
    tolerance = rounding(PIVOT_TOLERANCE, a) * jnp.max(jnp.abs(jnp.diagonal(a)))

    def eliminate(j: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        a, done = carry
        pivot = a[j, j]
        column = jnp.where(jnp.arange(n) >= j, a[:, j] * pivot_scale(pivot, tolerance), 0.0)
        return a - jnp.outer(column, column), done.at[:, j].set(column)  # a: the Schur complement of the pivot

    result: jax.Array = jax.lax.fori_loop(0, n, eliminate, (jnp.asarray(a), jnp.zeros_like(a)))[1]
    return result


def psd_solve(a: Float[Array, "n n"], b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solve A X = B for a positive definite A.

    Shapes: (n, n), (n, k) -> (n, k). An indefinite A gives NaN.
    """
    return _solve(jnp.asarray(a), jnp.asarray(b))


_solve = runs_last(solve)
