"""Density of a Gaussian vector of which components may be missing or determined by others, and its derivatives."""

from typing import Any, NamedTuple

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


class _ConditionedVector(NamedTuple):
    """What is left of a vector given its first components: its value and covariance, with the log density of these.

    `growth`: the largest quotient of a component's variance and what was left of it, by which rounding was amplified.
    """

    value: Float[jax.Array, " m"]
    covariance: Float[jax.Array, "m m"]
    total: Float[jax.Array, ""]
    growth: Float[jax.Array, ""]


@jax.jit
def log_density(
    value: "Float[jax.Array, ' m']",
    covariance: "Float[jax.Array, 'm m']",
    size: "Float[jax.Array, ' m']",
    present: "Bool[jax.Array, ' m'] | None" = None,
) -> "Float[jax.Array, '']":
    """Return log N(value; 0, covariance) of the components that are present; 0 if none is.

    It is the sum over the components of each one's log density given those before it: -(e_j^2 / s_j + log(2 pi s_j)) /
    2. Here e_j is component j less what those before it predict of it, and s_j its variance given them, a pivot of the
    covariance. A component that those before it determine (s_j = 0) adds nothing where it agrees with them, and -inf
    where it does not: the density is that of the free components. An indefinite covariance gives NaN.

    Args:
        value: deviations from the mean.
        covariance: of the value.
        size: the size of the terms whose difference is the value, for its rounding.
        present: which components count; those that are not NaN if None.
    """
    # Absent components: value and covariance zero, so that they are determined and agree.
    present = ~jnp.isnan(value) if present is None else present
    present_value = jnp.where(present, value, 0.0)
    present_covariance = jnp.where(present[:, None] & present, covariance, 0.0)
    # Deviation within which a determined component agrees with those before it.
    variance = jnp.diagonal(present_covariance)
    agreement = OFF_SUPPORT * jnp.sqrt(variance) + OFF_VALUE * jnp.where(present, size, 0.0)

    def condition_on_component(j: Any, state: _ConditionedVector) -> _ConditionedVector:
        """Add the log density of component j given those before it, and condition the later components on it.

        With the deviations e and covariance S given the earlier ones, e_i becomes e_i - (s_ij / s_jj) e_j.
        """
        e, left = state.value, state.covariance
        pivot = left[j, j]
        # Zero but for rounding, which may leave it below zero: by the more, the more rounding was amplified before.
        highest, lowest = rounding(PIVOT_TOLERANCE, value), -negative_tolerance(value, state.growth)
        determined = (pivot <= highest * variance[j]) & (pivot >= lowest * variance[j])
        safe_pivot = jnp.where(determined, 1.0, pivot)
        reciprocal = 1 / safe_pivot
        density = -(e[j] ** 2 * reciprocal + jnp.log(safe_pivot) + LOG_TURN) / 2
        if_determined = jnp.where(jnp.abs(e[j]) <= agreement[j], 0.0, -jnp.inf)
        # Regression of the other components on component j, which takes from them what it explains.
        column = jnp.where(determined, 0.0, left[:, j] * reciprocal)
        return _ConditionedVector(
            value=e - column * e[j],
            covariance=left - jnp.outer(column, left[j]),
            total=state.total + jnp.where(determined, if_determined, density),
            growth=jnp.maximum(state.growth, jnp.where(determined, 0.0, variance[j] * reciprocal)),
        )

    zero = jnp.zeros((), value.dtype)
    state = _ConditionedVector(value=present_value, covariance=present_covariance, total=zero, growth=zero)
    if len(value) > WRITTEN:  # a loop, so that the program stays short
        state = jax.lax.fori_loop(0, len(value), condition_on_component, state)
    else:
        for j in range(len(value)):
            state = condition_on_component(j, state)
    return state.total


def differentiate_log_density(
    value: "Float[jax.Array, ' m']",
    covariance: "Float[jax.Array, 'm m']",
    slopes: "tuple[Float[jax.Array, 'p m'], Float[jax.Array, 'p m m']]",
    size: "Float[jax.Array, ' m']",
    present: "Bool[jax.Array, ' m']",
) -> "tuple[Float[jax.Array, ''], Float[jax.Array, ' p'], Float[jax.Array, 'p p']]":
    """Return log N(e; 0, S) of the components that are present, its derivatives in p numbers, and their information.

    With e the value and S the covariance, the derivatives are -de' S^-1 e - tr(S^-1 dS) / 2 + e' S^-1 dS S^-1 e / 2 and
    the information is de' S^-1 de + tr(S^-1 dS S^-1 dS) / 2. Here de and dS are the `slopes`, the derivatives of value
    and covariance in the p numbers; see `log_density` for the other arguments.
    """
    slopes_of_value, slopes_of_covariance = slopes
    both = present[:, None] & present  # pairs of components of which both are present
    density = log_density(value, covariance, size, present)
    e, s = jnp.where(present, value, 0.0), jnp.where(both, covariance, 0.0)
    de, ds = jnp.where(present, slopes_of_value, 0.0), jnp.where(both, slopes_of_covariance, 0.0)
    p, m = de.shape
    # S^-1 e (m,), S^-1 de (m, p) and S^-1 dS (m, p, m) by one factorisation: their right sides stand side by side.
    solved = psd_solve(s, jnp.concatenate([e[:, None], de.T, jnp.moveaxis(ds, 0, 1).reshape(m, p * m)], axis=1))
    inv_e, inv_de, inv_ds = solved[:, 0], solved[:, 1 : 1 + p], solved[:, 1 + p :].reshape(m, p, m)
    score = -de @ inv_e - jnp.einsum("iai->a", inv_ds) / 2 + jnp.einsum("i,aij,j->a", inv_e, ds, inv_e) / 2
    return density, score, de @ inv_de + jnp.einsum("iaj,jbi->ab", inv_ds, inv_ds) / 2
