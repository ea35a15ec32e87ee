"""Operations that are written as others."""

import jax.numpy as jnp
import numpy as np

from tests.straightline.over_runs import over_runs

RANDOM = np.random.default_rng(0)


def test_flags_have_an_order():
    """False before true, and the first of the largest; LLVM compares no vectors of flags."""

    def ordered(x, y):
        a, b = x > 0, y > 0
        return a < b, a <= b, a > b, a >= b, jnp.argmax(x[None, :] > 0, axis=1), jnp.argmin(x > 0)

    x, y = RANDOM.normal(size=(2, 40, 5))
    a, b = x > 0, y > 0
    expected = a < b, a <= b, a > b, a >= b, np.argmax(a, axis=1)[:, None], np.argmin(a, axis=1)
    for values, by_numpy in zip(over_runs(ordered, x, y), expected, strict=True):
        np.testing.assert_array_equal(values, by_numpy)
