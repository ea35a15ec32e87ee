"""Resampling of weighted particles, and random keys that depend on the data."""

import jax
import jax.numpy as jnp


def invert_distribution(law: jax.Array, uniform: jax.Array) -> jax.Array:
    """Invert each distribution function at a uniform number: the index that it draws."""
    return jnp.searchsorted(jnp.cumsum(law)[:-1], uniform)


def resample_systematically(weight: jax.Array, start: jax.Array) -> jax.Array:
    """Resample systematically: indices where the distribution function passes (start + 0 ... N - 1) / N."""
    return invert_distribution(weight, (start + jnp.arange(len(weight))) / len(weight))


def effective_number(weight: jax.Array) -> jax.Array:
    """Return 1 / sum w^2 of weights (N,): N where all are equal, 1 where one particle has all."""
    return 1 / jnp.sum(weight**2)


def fold_in_bits(key: jax.Array, z: jax.Array) -> jax.Array:
    """Return the key made of another one and of the bits of a measurement."""
    bits = jax.lax.bitcast_convert_type(jnp.where(jnp.isnan(z), 0.0, z), jnp.uint32)
    for word in bits.ravel():
        key = jax.random.fold_in(key, word)
    return key
