"""Random keys made of seeds."""

import jax
import numpy as np


def seed_key(seed: int) -> jax.Array:
    """Return key of a seed below 2^32: that of `jax.random.key`, which compiles a program for it in each process."""
    words: jax.Array = jax.device_put(np.array([0, seed], dtype=np.uint32))
    key: jax.Array = jax.random.wrap_key_data(words, impl="threefry2x32")
    return key
