"""Small symmetric matrices: products, factors and solves, fast for batches of runs."""

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float

from heliograph.numerics.over_runs import runs_last, runs_last_of
from heliograph.numerics.small_matrix import UNROLL_LIMIT, factor, long_factor, solve


def symmetrize(a: Float[Array, "... n n"]) -> Float[Array, "... n n"]:
    """Return (A + A') / 2."""
    return jnp.asarray((a + jnp.swapaxes(a, -1, -2)) / 2)


def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower factor L of a positive semidefinite matrix, A = L L'.

    A pivot that is zero to rounding of its own diagonal entry gives a zero column, so a singular covariance (a
    component known exactly) has its factor whatever the units; a negative pivot gives NaN, which the driver reports
    with its step. Nothing is repaired.

    Shapes: (n, n) -> (n, n).
    """
    return long_factor(jnp.asarray(a)) if a.shape[-1] > UNROLL_LIMIT else _short_cholesky(jnp.asarray(a))


@runs_last_of(jnp.shape)
def _short_cholesky(a: jax.Array) -> jax.Array:
    return jnp.stack(factor(a)[0], axis=1)


def psd_solve(a: Float[Array, "n n"], b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solve A X = B for a positive semidefinite A and B in its range.

    Of a component that those before it determine, X is zero. An indefinite A gives NaN.

    Shapes: (n, n), (n, k) -> (n, k).
    """
    return _solve(jnp.asarray(a), jnp.asarray(b))


_solve = runs_last(solve)


def eigh(a: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues and eigenvectors of a symmetric matrix; of a batch one after another.

    A batch at once is dealt out to the processor's threads by a call that waits for them on one of them: programs that
    run side by side on as many threads then wait for each other for ever.
    """
    values, vectors = _eigh(a)
    return values, vectors


def regular_solve(a: Float[Array, "n n"], b: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solve A X = B for a regular A; of a batch one after another, as `eigh`."""
    return jnp.asarray(_regular_solve(a, b))


_eigh = sequential_vmap(lambda a: tuple(jnp.linalg.eigh(a)))  # type: ignore[no-untyped-call]
_regular_solve = sequential_vmap(jnp.linalg.solve)  # type: ignore[no-untyped-call]
