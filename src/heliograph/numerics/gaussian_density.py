"""Density of a Gaussian vector of which components may be missing or determined by others, and its derivatives."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.linalg import (
    OFF_SUPPORT,
    OFF_VALUE,
    PIVOT_TOLERANCE,
    WRITTEN,
    negative_tolerance,
    psd_solve,
    rounding,
)
from heliograph.numerics.types import Bool, Float

LOG_TURN = float(np.log(2 * np.pi))


@jax.jit
def log_density(
    value: "Float[jax.Array, ' m']",
    covariance: "Float[jax.Array, 'm m']",
    size: "Float[jax.Array, ' m']",
    present: "Bool[jax.Array, ' m'] | None" = None,
) -> "Float[jax.Array, '']":
    """Return log N(value; 0, covariance) of the components that are present, not NaN unless it is said; 0 if none is.

    Component after component given those before it: sum_j -(d_j^2 / s_j + log(2 pi s_j)) / 2, s_j the pivots of the
    covariance. A component that those before it determine (s_j = 0) adds nothing where it agrees with them, and -inf
    where it does not: the density is that of the free components. `size` (m,) is the size of the terms whose difference
    is `value`, for its rounding. An indefinite covariance gives NaN.
    """
    # Absent components: value and covariance zero, so that they are determined and agree.
    present = ~jnp.isnan(value) if present is None else present
    rest = jnp.where(present, value, 0.0)
    left = jnp.where(present[:, None] & present, covariance, 0.0)
    # Deviation within which a determined component agrees with those before it.
    variance = jnp.diagonal(left)
    reach = OFF_SUPPORT * jnp.sqrt(variance) + OFF_VALUE * jnp.where(present, size, 0.0)

    def condition_on_component(j: Any, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Add log N of component j given those before it, and condition the components behind it on it."""
        rest, left, total, growth = carry
        pivot = left[j, j]
        # Determined: the pivot is zero, to rounding.
        determined = (pivot <= rounding(PIVOT_TOLERANCE, value) * variance[j]) & (
            pivot >= -negative_tolerance(value, growth) * variance[j]
        )
        safe = jnp.where(determined, 1.0, pivot)
        scale = 1 / safe
        # Density of component j given those before it.
        density = -(rest[j] ** 2 * scale + jnp.log(safe) + LOG_TURN) / 2
        agrees = jnp.where(jnp.abs(rest[j]) <= reach[j], 0.0, -jnp.inf)
        # Condition the remaining components on component j.
        column = jnp.where(determined, 0.0, left[:, j] * scale)
        after = rest - column * rest[j], left - jnp.outer(column, left[j])
        growth = jnp.maximum(growth, jnp.where(determined, 0.0, variance[j] * scale))
        return *after, total + jnp.where(determined, agrees, density), growth

    none = jnp.zeros((), value.dtype)
    carry: tuple[jax.Array, ...] = (rest, left, none, none)
    if len(value) > WRITTEN:
        carry = jax.lax.fori_loop(0, len(value), condition_on_component, carry)
        return carry[2]
    for j in range(len(value)):
        carry = condition_on_component(j, carry)
    return carry[2]


def differentiate_log_density(
    value: "Float[jax.Array, ' m']",
    covariance: "Float[jax.Array, 'm m']",
    slopes: "tuple[Float[jax.Array, 'p m'], Float[jax.Array, 'p m m']]",
    size: "Float[jax.Array, ' m']",
    present: "Bool[jax.Array, ' m']",
) -> "tuple[Float[jax.Array, ''], Float[jax.Array, ' p'], Float[jax.Array, 'p p']]":
    """Return log N(e; 0, S) of the components that are present, its derivatives in p numbers, and their information.

    -de' S^-1 e - tr(S^-1 dS) / 2 + e' S^-1 dS S^-1 e / 2 and de' S^-1 de + tr(S^-1 dS S^-1 dS) / 2, with the slopes de
    and dS; see `log_density` for the other arguments.
    """
    both = present[:, None] & present
    density = log_density(value, covariance, size, present)
    e, s = jnp.where(present, value, 0.0), jnp.where(both, covariance, 0.0)
    de, ds = jnp.where(present, slopes[0], 0.0), jnp.where(both, slopes[1], 0.0)
    p, m = de.shape
    # S^-1 (e, de, dS) by one factorisation
    solved = psd_solve(s, jnp.concatenate([e[:, None], de.T, jnp.moveaxis(ds, 0, 1).reshape(m, p * m)], axis=1))
    w, v, q = solved[:, 0], solved[:, 1 : 1 + p], solved[:, 1 + p :].reshape(m, p, m)
    score = -de @ w - jnp.einsum("iai->a", q) / 2 + jnp.einsum("i,aij,j->a", w, ds, w) / 2
    return density, score, de @ v + jnp.einsum("iaj,jbi->ab", q, q) / 2
