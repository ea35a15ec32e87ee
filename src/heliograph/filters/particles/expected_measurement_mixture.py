"""Mixture that each particle expects of a measurement, where particles are Gaussians by mode; sums of these."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.model.estimate import Innovation
from heliograph.numerics.angles.angle import Angles, wrap_near


class ExpectedMixture(NamedTuple):
    """Mixture of Gaussians that a particle expects of z: one for each mode, and each Gaussian of the mode's noise.

    Shapes: share (a,), probability of each Gaussian; expected (a, m) and covariance (a, m, m) of z under it; chance (),
    probability that those components arrive which did. Several particles have a leading axis.
    """

    share: jax.Array
    expected: jax.Array
    covariance: jax.Array
    chance: jax.Array


class ReceivedSums(NamedTuple):
    """Sums over the Gaussians that all particles expect of z, w the particle's weight times the Gaussian's probability.

    With d the innovation of a Gaussian less a reference innovation: weight, sum of w; value (m,), sum of w d;
    second_moment (m, m), sum of w (d d' + covariance); all_weights, sum of the particles' weights; chance, sum of the
    particles' weights times their probability of what arrived.
    """

    weight: jax.Array
    value: jax.Array
    second_moment: jax.Array
    all_weights: jax.Array
    chance: jax.Array


def find_reference_innovation(reference: ExpectedMixture, z: jax.Array, angles: Angles) -> jax.Array:
    """Return z less the mean of the most probable Gaussian that a particle expects of z (m,); z itself if it is NaN.

    It is subtracted from all innovations before they are summed, so that large numbers leave digits for differences.
    """
    expected = jnp.asarray(reference.expected)[jnp.argmax(jnp.asarray(reference.share))]
    return wrap_near(z - jnp.where(jnp.isfinite(expected), expected, 0.0), jnp.zeros(len(z)), angles)


def sum_mixtures(
    base: jax.Array, weight: jax.Array, predicted: ExpectedMixture, z: jax.Array, angles: Angles
) -> ReceivedSums:
    """Return weighted sums over particles and their Gaussians of the innovations of z, less a reference innovation.

    With the weight w of a particle times the probability of one of its Gaussians, and d its innovation less the
    reference, they are sum w, sum w d and sum w (d d' + covariance): mean and covariance of the innovation follow. The
    reference keeps d small, so that angles can be averaged and little is lost by cancellation.

    Args:
        base: the reference innovation (m,).
        weight: weights of B particles before z is known, of any sum.
        predicted: what each particle expects of z. A Gaussian whose mean is not finite is left out.
        z: measurement (m,), NaN for what did not arrive.
        angles: components of z that are angles.
    """
    present, m = ~jnp.isnan(z), len(z)
    # d (B, Gaussians, m) = (z - expected) - base; then particles and Gaussians become one axis.
    d = wrap_near(z - predicted.expected - base, jnp.zeros(m), angles)
    # Gaussians without a finite innovation get the weight 0, and zeros in place of NaN.
    is_valid = jnp.all(jnp.isfinite(d) | ~present, axis=-1)
    w = jnp.where(is_valid, weight[:, None] * predicted.share, 0.0).ravel()
    d = jnp.where(is_valid[..., None], d, 0.0).reshape(-1, m)
    covariance = jnp.where(is_valid[..., None, None], predicted.covariance, 0.0).reshape(-1, m, m)
    return ReceivedSums(
        weight=jnp.sum(w),
        value=w @ d,
        second_moment=(d * w[:, None]).T @ d + jnp.einsum("a,aij->ij", w, covariance),
        all_weights=jnp.sum(weight),
        chance=weight @ predicted.chance,
    )


def compute_mixture_innovation(sums: ReceivedSums, base: jax.Array, z: jax.Array, density: jax.Array) -> Innovation:
    """Return z - E z, Cov z and the log-likelihood of z, given which components arrived.

    Args:
        sums: weighted sums, over particles and the Gaussians they expect of z, of innovations less `base` and of their
            second moments; and of the probabilities of what arrived.
        base: the reference innovation (m,).
        z: measurement (m,), NaN for what did not arrive.
        density: log p(z, arrivals).
    """
    present = ~jnp.isnan(z)
    weight = jnp.where(sums.weight > 0, sums.weight, 1.0)
    mean = jnp.asarray(sums.value) / weight
    covariance = sums.second_moment / weight - jnp.outer(mean, mean)
    covariance = jnp.where(present[:, None] & present, covariance, jnp.nan)
    # p(z | arrivals) = p(z, arrivals) / P(arrivals), with P(arrivals) the mean over the particles.
    log_likelihood = density - jnp.log(jnp.asarray(sums.chance) / sums.all_weights)
    nothing_arrived = ~jnp.any(present)  # then the density is exactly 1
    return Innovation(base + mean, covariance, jnp.where(nothing_arrived, 0.0, log_likelihood))
