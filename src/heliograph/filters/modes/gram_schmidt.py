"""Weighted Gram-Schmidt: random numbers, as rows over weighted columns, less their projections on the first ones."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import reciprocal_or_zero
from heliograph.numerics.linalg import outer


def orthogonalise_first_rows(
    rows: jax.Array, numbers: jax.Array, weights: jax.Array, count: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Subtract from each row its projections on those of the first `count` rows that are above it (Gram-Schmidt).

    Args:
        rows: random numbers a, b, ... (k, columns), whose second moments are a W b' with W = diag(weights).
        numbers: values (k,) of the rows, from which the same multiples are subtracted.
        weights: weights (columns,) of the columns.
        count: number of first rows on which the rows below them are projected, one after another.

    Returns:
        The rows, the numbers, and the second moments (count,) of the first rows after the subtraction.
    """
    variances = []
    for i in range(count):
        weighted = weights * rows[i]
        variances.append(rows[i] @ weighted)
        # Only rows below row i change; a row without variance has no projection.
        multiples = jnp.where(np.arange(len(rows)) > i, rows @ weighted * reciprocal_or_zero(variances[i]), 0.0)
        rows = rows - outer(multiples, rows[i])
        numbers = numbers - multiples * numbers[i]
    return rows, numbers, jnp.stack(variances)
