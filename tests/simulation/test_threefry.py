"""Keys with the written-out hash give JAX's own bits, one or many at once."""

import jax
import numpy as np
import pytest

from heliograph.simulation.threefry import WRITTEN_OUT


def both(seed):
    key = jax.random.key(seed)
    return key, jax.random.wrap_key_data(jax.random.key_data(key), impl=WRITTEN_OUT)


@pytest.mark.parametrize("seed", [0, 1, 2**31 + 5])
def test_keys_are_split_and_folded_alike(seed):
    for make in (lambda k: jax.random.split(k, (3, 2)), lambda k: jax.random.fold_in(k, 2**32 - 1)):
        one, other = (np.asarray(jax.random.key_data(make(key))) for key in both(seed))
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "uint32", "uint64"])
@pytest.mark.parametrize("shape", [(), (5,), (3, 4)])
def test_bits_are_the_same(kind, shape):
    with jax.enable_x64(True):
        one, other = (np.asarray(jax.random.bits(key, shape, kind)) for key in both(3))
    np.testing.assert_array_equal(one, other)


def test_many_keys_give_each_its_own_bits():
    """Over two axes, one of them of the keys alone and one of keys and numbers; compiled, and not."""

    def drawn(key, number):
        return jax.random.bits(jax.random.fold_in(key, number), (3,))

    def many(keys):
        each = jax.vmap(drawn, in_axes=(0, 0), out_axes=-1)
        return jax.vmap(each, in_axes=(0, None), out_axes=1)(keys, np.arange(5))

    one, other = (jax.random.split(key, (2, 5)) for key in both(11))
    np.testing.assert_array_equal(many(one), many(other))
    np.testing.assert_array_equal(many(one), jax.jit(many)(other))
