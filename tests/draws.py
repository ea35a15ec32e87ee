"""Independent draws by native code: the numbers that XLA draws, of a program compiled in a tenth of its time."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from straightline import compile


def draw(sample: Callable[[jax.Array], Any], count: int, seed: int = 0) -> np.ndarray:
    """Draws `sample(key)` (count, ...) for as many keys, split from that of `seed`."""
    with jax.enable_x64(True):
        keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(seed), count)))
        drawn: np.ndarray = compile(lambda key: sample(jax.random.wrap_key_data(key)), keys[0])(keys)
        return drawn
