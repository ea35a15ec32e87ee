"""Random numbers of particles: resampling of weighted ones, their normal numbers, and keys that depend on the data."""

import math

import jax
import jax.numpy as jnp
import numpy as np

STEP = 2.0**-22  # between the uniform numbers of which normal ones of many particles are made
MANY = 10_000  # normal numbers, more than a program of native code draws at once


def invert_distribution(law: jax.Array, uniform: jax.Array) -> jax.Array:
    """Return the index that a uniform number draws by the law: where the distribution function passes the number."""
    return jnp.searchsorted(jnp.cumsum(law)[:-1], uniform).astype(int)


def resample_systematically(weight: jax.Array, start: jax.Array) -> jax.Array:
    """Resample systematically: indices where the distribution function passes (start + 0 ... N - 1) / N."""
    return invert_distribution(weight, (start + jnp.arange(len(weight))) / len(weight))


def draw_normals(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Return standard normal numbers.

    From MANY numbers on in single precision, two from each 64 random bits: 2^23 distinct values, |x| <= 5.3, in a
    third of the time. Only XLA runs draws of that size; smaller ones run in native code too, and must agree to the
    last digit.
    """
    size = math.prod(shape)
    if size < MANY:
        return jax.random.normal(key, shape, dtype=float)
    words = jax.random.bits(key, (-(-size // 2),), dtype=jnp.uint64)
    halves = jnp.concatenate([(words >> 32).astype(jnp.uint32), words.astype(jnp.uint32)])[:size]
    # The middles of 2^23 parts of (-1, 1).
    uniform = (halves >> 9).astype(jnp.int32).astype(jnp.float32) * np.float32(STEP) + np.float32(STEP / 2 - 1)
    normal = np.float32(np.sqrt(2)) * jax.lax.erf_inv(uniform)
    return normal.astype(float).reshape(shape)


def effective_number(weight: jax.Array) -> jax.Array:
    """Return 1 / sum w^2 of weights (N,): N where all are equal, 1 where one particle has all."""
    return 1 / jnp.sum(weight**2)


def fold_in_bits(key: jax.Array, z: jax.Array) -> jax.Array:
    """Return the key made of another one and of the bits of a measurement."""
    bits = jax.lax.bitcast_convert_type(jnp.where(jnp.isnan(z), 0.0, z), jnp.uint32)
    for word in bits.ravel():
        key = jax.random.fold_in(key, word)
    return key
