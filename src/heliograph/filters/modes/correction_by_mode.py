"""Correction of a filter's estimates by mode, and of the probabilities of the modes, by one measurement."""

from functools import partial

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import (
    Gaussian,
)
from heliograph.filters.gaussian.signal_moments import (
    Signal,
    condition_on_measurement,
    noise_behind_gain,
)
from heliograph.filters.innovation import mixed_innovation, posterior_weights
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, pattern_of
from heliograph.model.estimate import Innovation
from heliograph.numerics.angles.angle import Angles, wrap_near


def correct_in_every_mode(
    signal: Signal,
    channel: ChannelByPattern,
    mode: jax.Array,
    weight: jax.Array,
    z: jax.Array,
    angles: Angles = (),
) -> tuple[Gaussian, jax.Array, Innovation]:
    """Correct several Gaussians of x, each in its own mode of the link, and weigh them by their likelihoods.

    Gaussian c has the weight w_c before z, and z has the density N(z; z_c, S_c) under it, by the gain and noise of its
    mode. Its weight becomes w_c P(which components arrive | its mode) N(z; z_c, S_c), divided by the sum of all. A
    Gaussian whose mode cannot produce such a z stays as it was.

    Args:
        signal: moments of the sensor's signal y under each Gaussian of the state x (K, ...).
        channel: moments of z = G y + n and probability of arrival, by mode and pattern (which components arrive).
        mode: the mode in which each Gaussian is corrected (K,).
        weight: probability of each Gaussian and its mode (K,).
        z: measurement (m,), NaN for what did not arrive.
        angles: components of z that are angles.

    Returns:
        The posteriors (K, ...), their weights (K,), and the innovation of the mixture, with the likelihood of z given
        which components arrive.
    """
    # Channel moments by mode, given which components arrived.
    pattern = pattern_of(channel, ~jnp.isnan(z)) if len(channel.present) > 1 else 0
    moments = channel.mean, channel.gain_covariance, channel.noise
    links = jax.tree.map(lambda by_mode: jnp.asarray(by_mode)[mode, pattern], moments)
    # Prior weights given which components arrived, as they were if that is impossible in all modes.
    joint = weight * jnp.asarray(channel.chance)[mode, pattern]
    total = jnp.sum(joint)
    prior = jnp.where(total > 0, joint / jnp.where(total > 0, total, 1.0), weight)
    correct = partial(_correct_in_mode, z=z, angles=angles)
    posteriors, innovations = jax.vmap(correct)(signal, *links)
    # Posterior weights. A Gaussian stays as it is if its mode, or every mode, cannot produce such a value.
    weights, density, excluded = posterior_weights(prior, jnp.where(joint > 0, innovations.log_likelihood, -jnp.inf))
    is_possible = (joint > 0) & ~excluded  # a mode in which this cannot arrive has no map for it
    corrected = jax.tree.map(lambda a, b: jnp.where(is_possible[:, None], a, b), posteriors, signal.prior)
    value = wrap_near(jnp.asarray(innovations.value), innovations.value[jnp.argmax(prior)], angles)
    return corrected, weights, mixed_innovation(prior, value, innovations.covariance, density)


def _correct_in_mode(
    signal: Signal, mean: jax.Array, gain_covariance: jax.Array, link: WeightedColumns, z: jax.Array, angles: Angles
) -> tuple[Gaussian, Innovation]:
    """Correct the Gaussian of x with z = G y + n, whose random gain G and noise n have the law of one mode.

    Args:
        signal: moments of the sensor's signal y, and the prior of x.
        mean: E[(G, n)] (m, p + 1), the mean noise as last column.
        gain_covariance: covariances of the entries of G (m, m, p + 1, p + 1).
        link: columns of Cov n.
        z: measurement (m,), NaN for what did not arrive.
        angles: components of z that are angles.
    """
    gain, offset = mean[:, :-1], mean[:, -1]  # E G and E n
    expected = gain @ signal.mean + offset
    z = wrap_near(z, expected, angles)
    slopes, noise = gain @ signal.slopes, noise_behind_gain(signal, gain, gain_covariance, link)
    return condition_on_measurement(signal.prior, slopes, noise, z, expected)
