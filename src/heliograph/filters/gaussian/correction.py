"""Gain and covariance bound of an update behind an uncertain channel.

Notation as in `update`: e the prior error with covariance P, y = yhat + e_y the sensor's signal, z = G y + n the
measurement.
"""

from functools import partial

import jax
import jax.numpy as jnp

from heliograph.filters.gaussian.precise import precise_update
from heliograph.numerics.linalg import (
    PRECISE,
    diagonal,
    diagonal_of,
    pivots,
    rounding,
    solve,
    symmetric,
    times,
    transpose,
    with_rounding,
)
from heliograph.numerics.over_runs import Pick, runs_last, where_any, where_each


def absent(present: jax.Array) -> jax.Array:
    """Unit variance for components that did not arrive, so that the reduced system keeps its full size."""
    return diagonal(jnp.where(present, 0.0, 1.0))


def gain_and_bound(prior: jax.Array, cross: jax.Array, omega: jax.Array) -> tuple[jax.Array, jax.Array]:
    """K = C' Omega^-1 and P - C' Omega^-1 C, which minimise P - K C - C' K' + K Omega K'.

    The difference is accurate to rounding of P alone, which the bound includes.
    """
    solved = _solved(omega, cross)
    return transpose(solved), _bound(prior, cross, solved)


def gain_and_covariance(
    prior: jax.Array,
    cross: jax.Array,
    omega: jax.Array,
    output: jax.Array,
    noise: jax.Array,
    rounded: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Gain and covariance for z = H x + noise, with H (m, n) and noise covariance N (m, m), Omega = H P H' + N.

    Where a measurement is precise, N far below Omega, the difference cancels: (1 + (m + 2) eps) P - K C is
    eps Omega / N too large. There `precise_update` uses one component after another, each with the variance `rounded`
    (m,) besides its noise. It takes several times the products, so it is computed for all runs where any needs it,
    and not otherwise; each run's numbers decide which of the two applies.
    """
    return _gain_and_covariance(prior, cross, omega, _solved(omega, cross), output, noise, rounded)


_solved = runs_last(solve)


def _difference(prior: jax.Array, cross: jax.Array, solved: jax.Array) -> jax.Array:
    return symmetric(with_rounding(prior, len(cross)) - times(transpose(cross), solved))


_bound = runs_last(_difference)


def _by_precision(
    pick: Pick,
    prior: jax.Array,
    cross: jax.Array,
    omega: jax.Array,
    solved: jax.Array,
    output: jax.Array,
    noise: jax.Array,
    rounded: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    return pick(
        is_precise(omega, noise),
        lambda: precise_update(prior, output, noise, rounded),
        lambda: (transpose(solved), _difference(prior, cross, solved)),
    )


_gain_and_covariance = runs_last(partial(_by_precision, where_any), partial(_by_precision, where_each))


def is_precise(omega: jax.Array, noise: jax.Array) -> jax.Array:
    """Test whether some component's noise, given those before it, is far below its innovation variance.

    So a combination of components that is free of noise counts, though no single component is.
    """
    return jnp.any(pivots(noise) < rounding(PRECISE, omega, 1000) * diagonal_of(omega), axis=0)
