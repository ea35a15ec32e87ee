"""Random keys made of seeds."""

import jax
import numpy as np


def seed_key(seed: int) -> jax.Array:
    """Return the random key of a seed below 2^32, the same as `jax.random.key` makes, without compiling a program.

    A key is two words of 32 bits, of which the seed is the second.
    """
    words: jax.Array = jax.device_put(np.array([0, seed], dtype=np.uint32))
    key: jax.Array = jax.random.wrap_key_data(words, impl="threefry2x32")
    return key
