"""Small symmetric matrices: factors, solves and the half-vectorised form.

Loops over rows are unrolled when traced (the matrices of state estimation are small), so that a batch of runs
becomes elementwise arithmetic that vectorises, instead of one library call per matrix.
"""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int

UNROLL_LIMIT = 8  # above this size the library factorisation is faster and compiles in less time
PIVOT_TOLERANCE = 1e-14  # relative to the largest diagonal entry: a pivot this small is zero up to rounding


def symmetrize(a: Float[Array, "... n n"]) -> Float[Array, "... n n"]:
    """Return (A + A') / 2."""
    return jnp.asarray((a + jnp.swapaxes(a, -1, -2)) / 2)


def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower factor L of a positive semidefinite matrix, A = L L'.

    A zero pivot (to rounding) gives a zero column, so a singular covariance (a component known exactly) has its
    factor; a negative pivot gives NaN, which the driver reports with its step. Nothing is repaired.

    Shapes: (n, n) -> (n, n).
    """
    n = a.shape[-1]

    def eliminate(j: int | Int[Array, ""], carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        a, factor = carry
        pivot = a[j, j]
        root = jnp.where(pivot > tolerance, jnp.sqrt(pivot), jnp.nan)
        scale = jnp.where(jnp.abs(pivot) <= tolerance, 0.0, 1 / root)
        column = jnp.where(jnp.arange(n) >= j, a[:, j] * scale, 0.0)
        return a - jnp.outer(column, column), factor.at[:, j].set(column)  # a: the Schur complement of the pivot

    tolerance = PIVOT_TOLERANCE * jnp.max(jnp.abs(jnp.diagonal(a)))
    carry = (jnp.asarray(a), jnp.zeros_like(a))
    if n > UNROLL_LIMIT:
        carry = jax.lax.fori_loop(0, n, eliminate, carry)
    else:
        for j in range(n):
            carry = eliminate(j, carry)
    factor: jax.Array = carry[1]
    return factor


def psd_solve(a: Float[Array, "n n"], b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solve A X = B for a positive definite A.

    Shapes: (n, n), (n, k) -> (n, k). An indefinite A gives NaN.
    """
    n = a.shape[-1]
    if n > UNROLL_LIMIT:
        return jnp.asarray(cho_solve((jnp.linalg.cholesky(a), True), b))
    factor = cholesky(a)
    forward: list[jax.Array] = []
    for i in range(n):  # L Y = B
        known = sum((factor[i, j] * forward[j] for j in range(i)), jnp.zeros_like(b[i]))
        forward.append((b[i] - known) / factor[i, i])
    backward: list[jax.Array] = [jnp.zeros_like(b[0])] * n
    for i in reversed(range(n)):  # L' X = Y
        known = sum((factor[j, i] * backward[j] for j in range(i + 1, n)), jnp.zeros_like(b[i]))
        backward[i] = (forward[i] - known) / factor[i, i]
    return jnp.stack(backward)
