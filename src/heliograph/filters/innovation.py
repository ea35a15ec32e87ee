"""Innovation of a measurement: its value, its covariance under the filter's model, and its log-likelihood."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.correction import Signal, homogeneous
from heliograph.model.estimate import Innovation
from heliograph.numerics.over_runs import runs_last, runs_last_of
from heliograph.numerics.small_matrix import (
    NEGATIVE_TOLERANCE,
    OFF_SUPPORT,
    OFF_VALUE,
    PIVOT_TOLERANCE,
    UNROLL_LIMIT,
    congruence,
    rounding,
)
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.moments.second_moments import SecondOrder


def gaussian_innovation(
    z: "Float[Array, ' m']", expected: "Float[Array, ' m']", covariance: "Float[Array, 'm m']"
) -> "Innovation":
    """z - expected and its Gaussian log-likelihood; NaN where a component did not arrive.

    Args:
        z: measurement (m,), NaN for a component that did not arrive.
        expected: its predicted mean (m,).
        covariance: the innovation covariance (m, m).
    """
    present = ~jnp.isnan(z)
    value, both = jnp.asarray(z - expected), present[:, None] & present
    likelihood = log_density(value, jnp.asarray(covariance), jnp.abs(z) + jnp.abs(expected))
    return Innovation(value, jnp.where(both, covariance, jnp.nan), likelihood)


def no_innovation() -> Innovation:
    """Return the empty innovation of a filter that uses no measurements."""
    return Innovation(jnp.zeros(0), jnp.zeros((0, 0)), jnp.zeros(()))


def innovation_covariance(signal: Signal, channel: SecondOrder) -> Float[Array, "m m"]:
    """M Cov(y) M' + E[((G - M) y + n - b)(...)'] under the nominal law, from the prior moments of the signal y."""
    return _innovation_covariance(signal, channel)


@runs_last
def _innovation_covariance(signal: Signal, channel: SecondOrder) -> jax.Array:
    second = homogeneous(signal.second, signal.mean, 1.0)
    everything = jnp.ones((len(channel.mean_gain), *second.shape[2:]), dtype=bool)
    return congruence(channel.mean_gain, signal.covariance) + channel.nominal.middle(second, everything)


def mixed_innovation(
    weight: "Float[Array, ' parts']",
    value: "Float[Array, 'parts m']",
    total: "Float[Array, 'parts m m']",
    density: "Float[Array, '']",
) -> "Innovation":
    """Mean and covariance of the innovation of a mixture: within its components, and between their means.

    Args:
        weight: prior probability (parts,) of each component.
        value: its innovation (parts, m).
        total: its innovation covariance (parts, m, m).
        density: log-likelihood of z under the mixture.
    """
    mean = weight @ value
    apart = value - mean
    covariance = jnp.einsum("a,aij->ij", weight, total) + jnp.einsum("a,ai,aj->ij", weight, apart, apart)
    nothing = jnp.all(jnp.isnan(mean))  # then the density is 1, to rounding
    return Innovation(mean, covariance, jnp.where(nothing, 0.0, density))


def _shape_of_runs(value: jax.Array, covariance: jax.Array, size: jax.Array) -> tuple[int, ...]:
    return jnp.broadcast_shapes(value.shape[1:], covariance.shape[2:], size.shape[1:])


@runs_last_of(_shape_of_runs)
def log_density(value: jax.Array, covariance: jax.Array, size: jax.Array) -> jax.Array:
    """log N(value; 0, covariance) of the components that are not NaN, 0 if all are.

    Component after component given those before it: sum_j -(d_j^2 / s_j + log(2 pi s_j)) / 2, s_j the pivots of the
    covariance. A component that those before it determine (s_j = 0) adds nothing where it agrees with them, and -inf
    where it does not: the density is that of the free components. `size` (m,) is the size of the terms whose difference
    is `value`, for its rounding. An indefinite covariance gives NaN.
    """
    m = value.shape[0]
    # Absent components: value and covariance zero, so that they are determined and agree.
    present = ~jnp.isnan(value)
    rest = jnp.where(present, value, 0.0)
    left = jnp.where(present[:, None] & present[None], covariance, 0.0)
    rest = jnp.broadcast_to(rest, left.shape[1:])
    # Deviation within which a determined component agrees with those before it.
    variance = jnp.stack([left[j, j] for j in range(m)]) if m else rest
    reach = OFF_SUPPORT * jnp.sqrt(variance) + OFF_VALUE * jnp.where(present, size, 0.0)

    def condition(j: int | jax.Array, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        rest, left, total = carry
        pivot = left[j, j]
        # Determined: the pivot is zero, to rounding.
        determined = (pivot <= rounding(PIVOT_TOLERANCE, value) * variance[j]) & (
            pivot >= -rounding(NEGATIVE_TOLERANCE, value) * variance[j]
        )
        safe = jnp.where(determined, 1.0, pivot)
        scale = 1 / safe
        # Density of component j given those before it.
        density = -(rest[j] ** 2 * scale + jnp.log(2 * np.pi * safe)) / 2
        agrees = jnp.where(jnp.abs(rest[j]) <= reach[j], 0.0, -jnp.inf)
        # Condition the remaining components on component j.
        column = jnp.where(determined, 0.0, left[:, j] * scale)
        after = rest - column * rest[j], left - column[:, None] * left[j][None]
        return *after, total + jnp.where(determined, agrees, density)

    carry: tuple[jax.Array, ...] = (rest, left, jnp.zeros_like(jnp.sum(left, axis=(0, 1))))
    if m > UNROLL_LIMIT:
        carry = jax.lax.fori_loop(0, m, condition, carry)
        return carry[2]
    for j in range(m):
        carry = condition(j, carry)
    return carry[2]
