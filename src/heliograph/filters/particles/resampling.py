"""Random numbers of particles: resampling of weighted ones, their normal numbers, and keys that depend on the data."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.types import Array

STEP = 2.0**-22  # between the uniform numbers of which normal ones of many particles are made
MANY = 10_000  # normal numbers, more than a program of native code draws at once


def invert_distribution(law: jax.Array, uniform: jax.Array) -> jax.Array:
    """Return the index at which the distribution function of a law passes a uniform number: a draw from the law.

    `law` (N,) are probabilities; `uniform` is a number of [0, 1), or an array of several, which give as many indices.
    """
    return jnp.searchsorted(jnp.cumsum(law)[:-1], uniform).astype(int)


def resample_systematically(weight: jax.Array, start: jax.Array) -> jax.Array:
    """Return N indices at which the distribution function of the weights passes (start + j) / N, j = 0, ..., N - 1.

    This is systematic resampling, with one uniform number `start` for all draws.
    """
    return invert_distribution(weight, (start + jnp.arange(len(weight))) / len(weight))


def resample_concrete_weights(weight: np.ndarray, start: float) -> np.ndarray:
    """Resample known weights (N,) of any sum as `resample_systematically` does, without a search for each draw.

    `start` in [0, 1) is the one random number of systematic resampling. With the distribution function C, draw j is
    the particle i with N C_(i-1) < start + j <= N C_i. So it is the number of particles i with N C_i < start + j.
    """
    count, ends = len(weight), np.cumsum(weight)
    ends *= count / ends[-1]
    ends += 1 - start
    count_below = np.minimum(ends.astype(np.int64), count)
    count_below[-1] = count  # the last particle ends at C = 1, which rounding may miss
    return np.cumsum(np.bincount(count_below)[:count])


def draw_normals(key: jax.Array, numbers: jax.Array | None, size: int, particles: int) -> jax.Array:
    """Draw standard normal numbers (B, size) for the particles that `numbers` (B,) lists; for all `particles` if None.

    A number depends on the key and on its index among all numbers, so that particles draw the same together or one by
    one. Fewer than MANY (10,000) numbers in all are those of `jax.random.normal(key, (particles, size))`. More have
    single precision, and are made two from each 64 random bits, in half of the time. They have 2^23 values, up to 5.3.
    Native code and XLA agree on them to single precision.
    """
    if size * particles < MANY:
        smallest = np.nextafter(-1.0, 0.0)
        uniform = jnp.maximum(smallest, 2 * draw_uniforms(key, numbers, size, particles) + smallest)
        # The inverse error function turns uniform numbers on (-1, 1) into normal ones.
        return jnp.sqrt(2.0) * jax.lax.erf_inv(uniform)
    bits_64 = draw_random_bits(key, numbers, -(-size // 2), particles)
    bits_32 = jnp.concatenate([bits_64 >> np.uint64(32), bits_64], axis=1)[:, :size].astype(jnp.uint32)
    # The middles of 2^23 parts of (-1, 1), a distance STEP apart.
    bits_23 = (bits_32 >> 9).astype(jnp.int32).astype(jnp.float32)
    uniform = bits_23 * np.float32(STEP) + np.float32(STEP / 2 - 1)
    return (np.float32(np.sqrt(2)) * jax.lax.erf_inv(uniform)).astype(float)


def draw_uniforms(key: jax.Array, numbers: jax.Array | None, size: int, particles: int) -> jax.Array:
    """Draw numbers of [0, 1), (B, size), for the particles with indices `numbers` (B,); for all if None.

    They are those of `jax.random.uniform(key, (particles, size))`.
    """
    # 52 random bits are the mantissa of a number in [1, 2), from which 1 is subtracted.
    mantissa = draw_random_bits(key, numbers, size, particles) >> np.uint64(12)
    return jax.lax.bitcast_convert_type(mantissa | np.float64(1.0).view(np.uint64), jnp.float64) - 1.0


def draw_random_bits(key: jax.Array, numbers: jax.Array | None, size: int, particles: int) -> jax.Array:
    """Draw `size` integers of 64 random bits (B, size) for particles with indices `numbers` (B,); for all if None."""
    if numbers is None:
        return jax.random.bits(key, (particles, size), dtype=jnp.uint64)
    # Each integer's index among those of all particles is folded into the key, which gives two halves of 32 bits.
    indices = numbers[:, None].astype(jnp.uint32) * np.uint32(size) + jnp.arange(size, dtype=jnp.uint32)
    fold_indices = jax.vmap(jax.vmap(partial(jax.random.fold_in, key)))  # over particles and integers
    halves = fold_indices(indices).astype(jnp.uint64)
    return halves[..., 0] << np.uint64(32) | halves[..., 1]


def effective_number(weight: jax.Array) -> jax.Array:
    """Return 1 / sum w^2 of weights (N,): N where all are equal, 1 where one particle has all."""
    return 1 / jnp.sum(weight**2)


def fold_in_bits(key: jax.Array, z: jax.Array) -> jax.Array:
    """Return a new key from a key and the bits of a measurement, with 0 in place of a missing number.

    So the same filter draws other numbers after other data.
    """
    bits = jax.lax.bitcast_convert_type(jnp.where(jnp.isnan(z), 0.0, z), jnp.uint32)
    for word in bits.ravel():
        key = jax.random.fold_in(key, word)
    return key


class KeysOfRows(NamedTuple):
    """Random keys and numbers with which a particle filter goes over rows of data.

    start: key by which x_0 is drawn. choice_starts (rows,): the uniform number at which each row's systematic
    resampling starts. last: key after the last row. noises, proposals (rows, ...): keys of each row's process noise,
    and of its draws that use z.
    """

    start: jax.Array
    choice_starts: jax.Array
    last: jax.Array
    noises: jax.Array
    proposals: jax.Array


def draw_keys_of_rows(filter: Any, z: Array, key: Array | None) -> KeysOfRows:
    """Draw the random keys of all rows of data at once: they depend on the data, and on no particle.

    Args:
        filter: a particle filter, which says how a key leads to the next ones.
        z: measurements (rows, received), on which keys depend.
        key: key of the state before the rows; None for the start before any data.
    """

    def draw(key: jax.Array, row: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """Return the key after a row, the uniform number of its resampling, and its keys of noise and proposal."""
        key, choice_key, noise_key = filter.keys_of_prediction(key)
        key, proposal_key = filter.keys_of_correction(key, row)
        return key, (jax.random.uniform(choice_key, (), float), noise_key, proposal_key)

    first_key, start_key = filter.start_keys()
    last_key, (choice_starts, noise_keys, proposal_keys) = jax.lax.scan(
        draw, first_key if key is None else jnp.asarray(key), jnp.asarray(z)
    )
    return KeysOfRows(
        start=start_key, choice_starts=choice_starts, last=last_key, noises=noise_keys, proposals=proposal_keys
    )


draw_keys_of_rows_by_xla = quickly_compiled(draw_keys_of_rows)
