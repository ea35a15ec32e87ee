"""Eigenvalues and solves by LAPACK, for matrices of which a step takes one at a time."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap

from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.trace_settings import writes_for_derivatives
from heliograph.numerics.types import Float

A = TypeVar("A", jax.Array, np.ndarray)


def eigh(a: Float[jax.Array, "n n"]) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return the eigenvalues and eigenvectors (columns) of a symmetric matrix; a batch is computed one after another.

    A batch is what `vmap` makes of calls side by side. JAX would distribute it over the processor's threads, by a call
    on one of them that waits for the others, so that programs side by side could wait for each other for ever. The loop
    has no derivative backwards: within `write_for_derivatives` the matrices are left to JAX.
    """
    values, vectors = jnp.linalg.eigh(a) if writes_for_derivatives() else _eigh(a)
    return values, vectors


def pseudo_solve(a: A, b: A, tolerance: float = 1e-12) -> A:
    """Return A^+ B with the pseudoinverse A^+ of a positive semidefinite A, by its correlations; for NumPy or JAX.

    By the correlation matrix, units do not matter. Directions whose eigenvalue is at most `tolerance` times the largest
    are skipped, as are rows of zeros.
    """
    xp = library(a, b)
    deviation = xp.sqrt(xp.maximum(xp.diagonal(a), 0.0))
    scale = xp.where(deviation > 0, 1 / xp.where(deviation > 0, deviation, 1.0), 0.0)  # 1 / deviation, 0 for rows of 0
    # A^+ = D V L^+ V' D of the correlation matrix D A D = V L V', D the scale.
    correlation = scale[:, None] * a * scale
    eigenvalues, vectors = np.linalg.eigh(correlation) if xp is np else eigh(correlation)
    is_used = eigenvalues > tolerance * eigenvalues[-1]
    scaled_vectors = scale[:, None] * vectors  # D V
    inverse_eigenvalues = xp.where(is_used, 1 / xp.where(is_used, eigenvalues, 1.0), 0.0)
    solution: A = (scaled_vectors * inverse_eigenvalues) @ (scaled_vectors.T @ b)
    return solution


def spectral_radius(matrix: Float[np.ndarray, "N N"]) -> float:
    """Return the spectral radius of a square matrix, the largest modulus of an eigenvalue; 0 of an empty one."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def regular_solve(a: Float[jax.Array, "n n"], b: Float[jax.Array, "n k"]) -> Float[jax.Array, "n k"]:
    """Return the solution X of A X = B for a regular A; a batch of systems is solved one by one, as in `eigh`."""
    return jnp.asarray(_regular_solve(a, b))


_eigh = sequential_vmap(lambda a: tuple(jnp.linalg.eigh(a)))  # type: ignore[no-untyped-call]
_regular_solve = sequential_vmap(jnp.linalg.solve)  # type: ignore[no-untyped-call]
