"""Random keys by run, step, source and purpose, so that no draw depends on the others."""

from zlib import crc32

import jax
import numpy as np

# What a key is for: folded in last, so that uses have separate streams.
INITIAL, PROCESS, SENSOR, CHANNEL, CHANNEL_START, MEMORY, MEMORY_START, TRIGGER, DITHER = range(9)
WORLD = 0  # the plant's place among the checksums of names

Number = int | jax.Array | np.ndarray


def draw_key(run_key: jax.Array, k: Number, source: Number, purpose: int) -> jax.Array:
    """Return the key of one draw of a run: step k, source and purpose are folded into the run's key.

    Different draws have different keys and are independent. `source`: checksum of the name of what draws. `purpose`:
    number of what is drawn.
    """
    key = run_key
    for number in (k, source, purpose):
        key = jax.random.fold_in(key, number)
    return key


def checksum(name: str) -> int:
    """Return the checksum of the name of a node, or of a hop "SENDER to LISTENER", as its place among all keys."""
    return crc32(name.encode())
