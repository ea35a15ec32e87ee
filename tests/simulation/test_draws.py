"""The seed's way to a draw."""

import jax
import numpy as np
import pytest

from heliograph.simulation.draws import seed_key


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1, 2**31, 2**32 - 1])
@pytest.mark.parametrize("x64", [False, True])
def test_a_seeds_key_is_that_of_jax(seed, x64):
    with jax.enable_x64(x64):
        key, known = seed_key(seed), jax.random.key(seed)
    np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(known))
    assert key.dtype == known.dtype
