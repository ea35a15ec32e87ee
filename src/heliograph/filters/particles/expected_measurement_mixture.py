"""Mixture that each particle expects of a measurement, where particles are Gaussians by mode; sums of these."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.model.estimate import Innovation
from heliograph.numerics.angles.angle import Angles, wrap_near


class ExpectedMixture(NamedTuple):
    """Mixture of Gaussians that each particle expects of z, with one part for each mode and atom of its noise.

    Of particles with a leading axis: shapes share (a,) of each part, expected (a, m), total covariance (a, m, m), and
    chance () of what arrived.
    """

    share: jax.Array
    expected: jax.Array
    total: jax.Array
    chance: jax.Array


class ReceivedSums(NamedTuple):
    """Sums of weights, of innovations less that of a reference (m,), of their second moments, of weights by chances."""

    weight: jax.Array
    value: jax.Array
    spread: jax.Array
    of_all: jax.Array
    chance: jax.Array


def find_reference_innovation(reference: ExpectedMixture, z: jax.Array, angles: Angles) -> jax.Array:
    """Return the innovation (m,) of the largest part of what a particle expects, 0 for one that is no number."""
    expected = jnp.asarray(reference.expected)[jnp.argmax(jnp.asarray(reference.share))]
    return wrap_near(z - jnp.where(jnp.isfinite(expected), expected, 0.0), jnp.zeros(len(z)), angles)


def sum_mixtures(
    base: jax.Array, weight: jax.Array, predicted: ExpectedMixture, z: jax.Array, angles: Angles
) -> ReceivedSums:
    """Return sums over particles (B,) of weights before z; parts that are no number do not count."""
    present, m = ~jnp.isnan(z), len(z)
    value = wrap_near(z - predicted.expected - base, jnp.zeros(m), angles)
    valid = jnp.all(jnp.isfinite(value) | ~present, axis=-1)
    share = jnp.where(valid, weight[:, None] * predicted.share, 0.0).ravel()
    value = jnp.where(valid[..., None], value, 0.0).reshape(-1, m)
    total = jnp.where(valid[..., None, None], predicted.total, 0.0).reshape(-1, m, m)
    spread = (value * share[:, None]).T @ value + jnp.einsum("a,aij->ij", share, total)
    return ReceivedSums(
        weight=jnp.sum(share),
        value=share @ value,
        spread=spread,
        of_all=jnp.sum(weight),
        chance=weight @ predicted.chance,
    )


def compute_mixture_innovation(sums: ReceivedSums, base: jax.Array, z: jax.Array, density: jax.Array) -> Innovation:
    """Return the innovation's mean, covariance and log-likelihood, given which components arrived.

    `base` is a reference innovation, about which the sums are taken. `density` is log p(z, arrivals). p(z | arrivals)
    is p(z, arrivals) over the mean chance of these arrivals.
    """
    present = ~jnp.isnan(z)
    weight = jnp.where(sums.weight > 0, sums.weight, 1.0)
    mean = jnp.asarray(sums.value) / weight
    covariance = sums.spread / weight - jnp.outer(mean, mean)
    covariance = jnp.where(present[:, None] & present, covariance, jnp.nan)
    log_likelihood = density - jnp.log(jnp.asarray(sums.chance) / sums.of_all)
    nothing_arrived = ~jnp.any(present)  # then the density is exactly 1
    return Innovation(base + mean, covariance, jnp.where(nothing_arrived, 0.0, log_likelihood))
