"""Weighted Gram-Schmidt: random numbers, as rows over weighted columns, less their projections on the first ones."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, eliminate
from heliograph.factors.pivots import reciprocal_or_zero, spoil_derivatives
from heliograph.numerics.linalg import outer
from heliograph.numerics.trace_settings import writes_for_derivatives

FEW_DIGITS = 1e-10  # share of its second moment: of a smaller variance few digits are left beside others


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


def spoil_where_known(
    numbers: jax.Array, power: jax.Array, moments: tuple[jax.Array, jax.Array], noise: WeightedColumns
) -> jax.Array:
    """Return numbers, whose derivatives are NaN where a combination of states, or a noise, is known to rounding.

    Rows of many modes, most of which depend on others, are made orthogonal to them: of derivatives of what is known
    only rounding would be left. Where nothing is differentiated the numbers are returned.

    Args:
        numbers: of whose derivatives that is said.
        power: second moments (n,) of the states before data.
        moments: rows of (x - c, 1) in each mode (M, n + 1, columns), and the weights of their columns (M, columns).
        noise: triangular factors of the noise of z in each mode, (M, m, m) and (M, m).
    """
    if not writes_for_derivatives():
        return numbers
    # E[(x - c, 1) (x - c, 1)'], summed over the modes; its last row and column are those of the constant 1.
    x, weights = moments
    second = jnp.einsum("jac,jc,jbc->ab", x, weights, x)
    total_probability = second[-1, -1]
    mean = second[:-1, -1] / total_probability
    # What is left of each state's variance, given the states before it: the pivots of Cov x.
    left = eliminate(second[:-1, :-1] / total_probability - jnp.outer(mean, mean)).weights
    is_state_known = jnp.any(left <= FEW_DIGITS * power)
    # The same of the noise; a mode of no probability has none.
    is_possible = jnp.sum(x[:, -1] ** 2 * weights, axis=1, keepdims=True) > 0
    of_noise = jnp.einsum("jlc,jc->l", noise.matrix**2, noise.weights) + jnp.max(power)
    is_noise_known = jnp.any(is_possible & (noise.weights <= FEW_DIGITS**2 * of_noise))
    known = is_state_known | is_noise_known
    return spoil_derivatives(numbers, known)
