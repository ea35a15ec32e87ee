"""The seed's way to a draw."""

import logging

import jax
import numpy as np
import pytest

from heliograph.numerics import seed_key


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1, 2**31, 2**32 - 1])
@pytest.mark.parametrize("x64", [False, True])
def test_a_seeds_key_is_that_of_jax(seed, x64):
    with jax.enable_x64(x64):
        key, known = seed_key(seed), jax.random.key(seed)
    np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(known))
    assert key.dtype == known.dtype


def test_a_seeds_key_is_no_program(caplog):
    jax.clear_caches()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        seed_key(3)
    assert not [record for record in caplog.records if "XLA compilation of" in record.getMessage()]
